"""Points made ready for the spectrum: link budget, receiver noise, and one line on the beam's axis.

This module prepares the least that any shot has. Everything else is an effect
(:mod:`sweep.model.effects`), put to it one after the other by :mod:`sweep.model.shot`.

Points that share their categories (architecture, window, law, sizes ...) are prepared together; a
footprint's geometry is worked out once and serves every point that has it, whatever its radiometry.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import alarms, beam, link, waveform
from sweep.model.accuracy import AUTOMATIC, Accuracy
from sweep.model.band import band_of, number_of
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detectors import main_lobe
from sweep.model.ground import Ground
from sweep.model.looks import NUMBER, VOTES, Looks
from sweep.model.threshold import tnr_of
from sweep.model.unsupported import UnsupportedShot
from sweep.model.waveform import Segment
from sweep.model.window import Window, canonical_name, window

if TYPE_CHECKING:
    from sweep.model.detection import DetectionRule, Fading, SpeckleTable
    from sweep.model.look_speckle import LookSpeckle
    from sweep.model.speckle_correlation import SpeckleLines

Parameters = Mapping[str, float | int | str | np.ndarray]

LASER, CHIRP, TELESCOPE, RECEIVER, PROCESSING = (
    f"instrument.{part}." for part in ("laser", "chirp", "telescope", "receiver", "processing")
)
RECORD = RECEIVER + "record"
"""Samples of a record: ``real``, or ``complex`` from I and Q."""

BEAMLETS_ERROR = "footprint.beamlets_error"
"""Error of pd that the number of beamlets leaves, where that followed from the tolerance."""

APPROACH = "target.approach"
"""Speed [m/s] at which the range along the beam falls, where rays have told."""

SLOPES = waveform.DOPPLER_SLOPE, waveform.DOWN_SLOPE
CATEGORIES = (PROCESSING + "fft_size", "footprint.beamlets", "record", NUMBER, VOTES, *SLOPES)
"""Numbers that points must share to be prepared together; words they must share all."""

ADC_NOISE = "quantisation"
"""Noise source that does not pass the receiver."""

UNSEEN = frozenset({"signal_shot"})
"""Noise sources that come with an echo: the threshold is not set on them."""

LINE_STEPS = 2
"""Steps of a sum of lines that leave something out, at the most: each may err by as much."""


class PhaseError(NamedTuple):
    """A deterministic phase error over the record, common to the lines of a footprint."""

    phase: Callable[..., np.ndarray]
    """Phase [cycles], (n, m), at places x (m,) of the record, given ``sign`` and the values."""
    values: dict[str, Any]
    """Arguments by name, (n,) or scalars; a tuple holds one for each segment."""

    def chosen(self, segment: int, index: np.ndarray) -> dict[str, np.ndarray]:
        """Arguments of some points in a segment, as many each."""
        found = {}
        for name, value in self.values.items():
            value = value[segment] if isinstance(value, tuple) else value
            found[name] = value[index] if np.ndim(value) else np.full(index.size, float(value))
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
    """Points of one category, ready for the spectrum.

    Arrays are (n,) or scalars unless said otherwise; SI throughout. The fields after ``amplitude``
    are there only if an effect has put them there.
    """

    architecture: str
    window: Window
    fft_size: int
    bins_counted: str
    band: np.ndarray | None
    """(3, 2, n) int64: first bin and number of bins searched (:mod:`sweep.model.band`)."""
    noise_bins: str
    """``correlated``: noise of bins as the record makes it; ``independent``: as [T] has it."""
    detection: str
    """``any_bin``: of the echo; ``peak_bin``: the largest alone, as in [T]."""
    shot_detection: str
    """``both_chirps``: a shot is detected in up and down segment; ``any_two``: in any two."""
    peaks: str
    """``all``: any crossing of a segment is reported; ``strongest``: its largest peak alone."""
    two_beats: str
    """Assumption by which two beats of real records tell: ``far`` or ``fast``."""
    noise_shape: str
    """``receiver``: noise passes the receiver as signals do; ``white``: none of it, as in [T]."""
    order: tuple[str, ...]
    """Names of the segments that there are, in the order of time."""
    gap: np.ndarray
    """Time from a segment's end to the next one's start [s]."""
    tnr: np.ndarray
    range: np.ndarray
    """(n,): of the target on the beam's axis."""
    radial_velocity: np.ndarray
    """(n,): likewise; what the lines show of it is ``beta``."""
    acceleration: np.ndarray
    """Rate at which the radial velocity grows [m/s^2]."""
    approach: np.ndarray
    """Speed [m/s] at which the range along the beam falls (:func:`approach`)."""
    bandwidth: np.ndarray
    duration: np.ndarray
    slopes: tuple[float, ...]
    """Chirp rates of up, Doppler and down segment over :attr:`chirp_rate`, signed."""
    carriers: tuple[np.ndarray, np.ndarray, np.ndarray]
    sample_rate: np.ndarray
    acquisition_delay: np.ndarray
    detector_bandwidth: np.ndarray
    amplifier_bandwidth: np.ndarray
    leakage_floor: np.ndarray
    """Of :attr:`floor`; :data:`AUTOMATIC` where it follows from the probability below."""
    leakage_tolerance: np.ndarray
    """Probability of leakage, of all bins far from the lines, that need not be looked for."""
    line_tolerance: np.ndarray
    """Error of a bin by taking few lines for many, over sigma."""
    beamlets_error: np.ndarray
    """Error of pd that the number of beamlets leaves; nan where it was not estimated."""
    echo_scale: np.ndarray
    """Echo power [W] for a relative echo of 1/sr."""
    beat_scale: np.ndarray
    """Amplitude of the beat [V] for a relative amplitude of 1."""
    noise_scale: np.ndarray
    """Noise variance at the ADC [V^2] that 1 A^2 of current makes."""
    shot_noise_scale: np.ndarray
    """Noise variance at the ADC [V^2] that 1 W of light makes."""
    noise_sources: dict[str, np.ndarray]
    """Noise variance of each source at the ADC [V^2]."""
    row: np.ndarray
    """(n,) int64: row of each point in the three arrays that follow, (rows, beamlets)."""
    offset: np.ndarray
    """(R_b - R_0) / R_0."""
    doppler: np.ndarray
    """beta_b - beta_0, beta = 2 v_r / c."""
    amplitude: np.ndarray
    """Relative amplitude: root of the relative echo, for direct detection the echo itself."""

    ground_transmission: np.ndarray | float = 1.0
    """Share of light from the ground that reaches the receiver."""
    beta: np.ndarray | float = 0.0
    """Doppler ratio 2 v_r / c of the line on the axis."""
    incoherent: bool = True
    """True where beamlets add as powers."""
    phase: np.ndarray = field(default_factory=lambda: np.empty((3, 0, 0)))
    """(3, rows, beamlets): further phases [cycles] in up, Doppler and down segment; or empty."""
    starts: tuple[np.ndarray | float, ...] = (0.0, 0.0, 0.0)
    """Time [s] from the shot's start to each segment's, in which the target moves on."""
    first_sample: np.ndarray | None = None
    """(segments, n) int64: samples of the record before the echo arrives, up to all of them; None
    where echoes fill records."""
    phase_errors: tuple[PhaseError, ...] = ()
    look_drift: np.ndarray | float = 0.0
    """(segments, n): bins by which lines move on from look to look."""
    walk: np.ndarray | float = 0.0
    """Seconds of closing by which the beats' range is below that at the shot's start, (n,)."""
    speeding: np.ndarray | float = 0.0
    """Seconds of acceleration by which a beat's velocity is above that at its segment's start."""
    slowing: np.ndarray | float = 0.0
    """Share of the radial velocity by which the beats tell less, (n,)."""
    alike: bool = False
    """True where many shots have the same phase errors, as those of a flight do not."""
    gaussian_width: np.ndarray | None = None
    """(n,): FWHM [Hz] of the beat's Gaussian line."""
    laser_width: np.ndarray | float = 0.0
    """FWHM [Hz] of the Lorentzian line of a laser, whose phase walks randomly, (n,)."""
    pedestal_beside: np.ndarray | float = 0.0
    """Noise variance at the ADC [V^2] that stands in bins beside the lines."""
    pedestal: np.ndarray | float = 0.0
    """Noise variance at the ADC [V^2] that stands under the lines, and nowhere else."""
    noise_gain: np.ndarray | float = 1.0
    """Factor on the noise variance by what happens to the record after the threshold was set."""
    complex_record: bool = False
    """True where the record is I and Q, and its spectrum has signed bins and no images."""
    antialias: dict[str, np.ndarray] = field(default_factory=dict)
    """Bandwidth [Hz] and order of the filter before the ADC; empty without one."""
    image_gain: np.ndarray | float = 0.0
    """Amplitude at the negative frequency that I and Q leave of a line's, 0..1, (n,)."""
    fading: "Fading | None" = None
    """Of echoes in developed speckle."""
    look_speckle: "LookSpeckle | None" = None
    """Speckle of looks that share it in part; None where all have the same, or each its own."""
    look_turns: np.ndarray | None = None
    """(3, n): turn of the line's phase from one look to the next [cycles]."""
    line_spread: np.ndarray | float = 0.0
    """(segments, n): deviation of the lines of an echo in developed speckle [bins of fs/N]."""
    speckle_lines: "SpeckleLines | None" = None
    """Their footprints, over which speckle is drawn."""
    leak_amplitude: np.ndarray | None = None
    """Amplitude of the leaked light's beat [V], (n,) or scalar; None without one."""
    leak_delay: np.ndarray | float = 0.0
    """Its delay [s]."""
    image: bool = False
    """True where the lines' images at negative frequencies are summed."""
    leakage: bool = False
    """True where the bins next to the detection are looked at for groups of leaked signal."""
    looks: Looks = Looks()  # noqa: RUF009  # a tuple
    """Records of each segment, and how they are combined."""

    @property
    def size(self) -> int:
        """Number of points."""
        return self.range.size

    @property
    def bins(self) -> int:
        """Bins of a spectrum: 0..N/2 of a real record, -N/2..N/2 - 1 of a complex one."""
        return self.fft_size if self.complex_record else self.fft_size // 2 + 1

    def signed_bin(self, number: np.ndarray) -> np.ndarray:
        """Return bins by their frequency over that of bin 1: 0..N/2, or -N/2..N/2 - 1.

        A complex record's bins may be numbered from anywhere on, past N and below 0.
        """
        if not self.complex_record:
            return np.asarray(number)
        half = self.fft_size // 2
        return np.asarray((np.asarray(number) + half) % self.fft_size - half)

    def index_of_bin(self, number: np.ndarray) -> np.ndarray:
        """Return places of bins in a spectrum whose bins are in the order of their frequencies.

        Those of frequency 0 stand at 0, of a complex record at N/2.
        """
        zero = self.fft_size // 2 if self.complex_record else 0
        return self.signed_bin(number) + zero

    @property
    def signed_bins(self) -> np.ndarray:
        """All bins of a spectrum in the order of their frequencies, (bins,)."""
        return self.signed_bin(np.arange(self.bins) - self.index_of_bin(np.zeros((), int)))

    @property
    def chirp_rate(self) -> np.ndarray:
        """Chirp rate S = B/T [Hz/s]."""
        return self.bandwidth / self.duration

    @property
    def record_duration(self) -> np.ndarray:
        """Length of the record L/fs [s]."""
        return self.window.length / self.sample_rate

    @property
    def echo_record(self) -> dict[str, Any]:
        """Start, since the segment's own, and duration [s] of the record that the echo has.

        By ``start`` and ``duration``: (n,) or scalars; tuples by segment where it has not all.
        """
        if self.first_sample is None:
            return {"start": self.acquisition_delay, "duration": self.record_duration}
        missing = [first / self.sample_rate for first in self.first_sample]
        left = [(self.window.length - first) / self.sample_rate for first in self.first_sample]
        return {
            "start": tuple(self.acquisition_delay + time for time in missing),
            "duration": tuple(left),
        }

    def echo_energy(self, segment: int) -> np.ndarray:
        """Sum w^2 over the samples that the echo has in a segment, (n,)."""
        if self.first_sample is None:
            return np.full(self.size, self.window.energy)
        return energy_left(self.window)[self.first_sample[segment]]

    @cached_property
    def relative_echo(self) -> np.ndarray:
        """Echo of all beamlets [1/sr], (n,)."""
        echo = self.amplitude if self.architecture == "direct" else self.amplitude**2
        return echo.sum(axis=1)[self.row]

    @property
    def echo_power(self) -> np.ndarray:
        """Echo power on the detector [W], (n,)."""
        return self.echo_scale * self.relative_echo

    @cached_property
    def quiet_variance(self) -> np.ndarray:
        """Noise variance without an echo, which the threshold is set on [V^2], (n,)."""
        seen = (v for name, v in self.noise_sources.items() if name not in UNSEEN)
        return np.asarray(sum(seen)) + np.zeros(self.size)

    @cached_property
    def whitening(self) -> np.ndarray:
        """Gain of each segment's lines in a spectrum whose noise is white, (segments, n).

        Spectra are divided by the root of the noise's density over that of white noise. It changes
        little over an echo and is taken on the beam's axis. The noise that the ADC adds is white
        before.
        """
        return in_rows([self.whitened(beat) for beat in self.beats], (self.size,))

    @property
    def beats(self) -> tuple[np.ndarray, ...]:
        """Beat frequency [Hz] of the line on the beam's axis, by segment, signed."""
        return tuple(
            s.carrier * s.beta
            - s.chirp_rate * ((2 / SPEED_OF_LIGHT) * (self.range - s.nearer) * (1 + s.beta))
            for s in self.waveform
        )

    def whitened(self, beat: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
        """Gain of a line at a beat [Hz], (n,), in a spectrum whose noise is white.

        The anti-alias filter's is in it; the poles are none of it, as each line passes them. Its
        skirts in bins at another frequency ``at`` [Hz] are beside the noise of these.
        """
        if self.noise_shape == "white":
            return np.ones(())
        shape = {
            "detector_bandwidth": self.detector_bandwidth,
            "amplifier_bandwidth": self.amplifier_bandwidth, "sample_rate": self.sample_rate,
        } | self.antialias  # fmt: skip
        density = link.noise_density(beat if at is None else at, **shape)
        white = self.noise_sources.get(ADC_NOISE, 0.0) / self.quiet_variance
        gain = (density + (1 - density) * white) ** -0.5
        if self.antialias:
            gain = gain * np.sqrt(link.antialias_power(beat, **self.antialias))
        return np.asarray(gain)

    @cached_property
    def noise_variance(self) -> np.ndarray:
        """Noise variance sigma_x^2 at the ADC [V^2], (n,)."""
        unseen = (v for name, v in self.noise_sources.items() if name in UNSEEN)
        return (self.quiet_variance + sum(unseen)) * self.noise_gain

    @cached_property
    def bin_deviation(self) -> np.ndarray:
        """Noise sigma of a bin, per quadrature [V], (n,)."""
        return self._deviation(self.noise_variance)

    @cached_property
    def line_deviation(self) -> np.ndarray:
        """Noise sigma of a bin that holds lines, per quadrature [V], (n,)."""
        return self._deviation(self.noise_variance + self.pedestal)

    @cached_property
    def bin_levels(self) -> np.ndarray:
        """Levels of a point's bins, (7, n): :class:`sweep.model.detection.BinLevels`.

        The last three rows are those of its :class:`sweep.model.detection.PedestalShape`.
        """
        beside = self._deviation(self.noise_variance + self.pedestal_beside)
        levels = self.line_deviation, self.threshold, self.bin_deviation, beside
        return in_rows((*levels, *self._pedestal_shape), (self.size,))

    @property
    def _pedestal_shape(self) -> np.ndarray:
        """Shape of the pedestal of phase noise where bins beside the lines detect by it, (3, n)."""
        shape = np.zeros((3, self.size))
        if self.detection == "peak_bin" or self.looks.several or not np.any(self.laser_width):
            return shape
        from sweep.model.detection import pedestal_reaches

        width = self.laser_width * self.fft_size / self.sample_rate
        delay = np.minimum(2 * self.range / SPEED_OF_LIGHT, self.record_duration)
        delay = delay * self.sample_rate / self.fft_size
        ratio = self.pedestal_beside / self.noise_variance
        ratio, *shape[1:] = (np.broadcast_to(v, self.size) for v in (ratio, width, delay))
        reach = pedestal_reaches(
            np.ascontiguousarray(ratio), shape[1], shape[2], self.fft_size // 2
        )
        shape[0] = np.where(reach > self.echo_rule.beside, reach, 0.0)
        return shape

    def snr(self, magnitude: np.ndarray) -> np.ndarray:
        """Mean power of a bin's signal over the mean power of its noise, (..., n).

        ``magnitude`` is |X| of the lines in the bin [V]. The pedestal that a laser's phase noise
        leaves under them is signal as well: it fades with them, and detects with them.
        """
        lines = np.square(magnitude / self.bin_deviation) / 2
        return np.asarray(lines + self.pedestal / self.noise_variance)

    @cached_property
    def threshold(self) -> np.ndarray:
        """Threshold on |X| [V], (n,)."""
        from sweep.model import detection

        return detection.threshold(tnr=self.tnr, bin_deviation=self._deviation(self.quiet_variance))

    @property
    def floor(self) -> np.ndarray:
        """Signal over sigma below which bins that are taken one by one count as noise alone."""
        from sweep.model import detection

        given, bins = self.leakage_floor, self.bins
        if not np.any(given == AUTOMATIC):
            return given
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            level = self.threshold / self.bin_deviation
        law = self.looks.quiet_below if self.looks.several else detection.quiet_below
        floor = law(chance=self.leakage_tolerance, level=level, bins=bins)
        return np.where(given == AUTOMATIC, floor, given)

    def both(
        self, up: np.ndarray, down: np.ndarray, magnitudes: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """Probability that up and down segment are detected, by their own and |X| [V]; (..., n)."""
        from sweep.model import detection
        from sweep.model.quadratures import mean_over_angles

        if self.fading is None:
            return up * down
        level, alike = self.threshold / self.line_deviation, np.abs(self.fading.over)
        if self.looks.several:
            one, other = (magnitude / self.line_deviation for magnitude in magnitudes)
            in_looks = self.look_speckle
            if in_looks is not None:
                alike = in_looks.between[1]
            both = self.looks.faded_together(one, other, level, alike, in_looks)
            if self.speckle_table.row[[0, 2]].any():  # of the same share of what can be in common
                p, q = self._of_chirps(one, other, level)
                with np.errstate(divide="ignore", invalid="ignore"):
                    part = (both - p * q) / (np.minimum(p, q) - p * q)
                part = np.clip(np.nan_to_num(part), 0.0, 1.0)
                at_ends = self.speckle_table.row[[0, 2]].any(axis=0)
                both = np.where(
                    at_ends, up * down + part * (np.minimum(up, down) - up * down), both
                )
        else:
            number = self.independent_bins((up, down), magnitudes)
            both = detection.fading_together(up, down, level, alike, number)
            speckle, rows = self.speckle_table, self.speckle_table.row[[0, 2]]
            near = np.flatnonzero(rows.any(axis=0))
            if near.size:
                level, alike, number = (
                    np.broadcast_to(v, up.shape)[..., near] for v in (level, alike, number)
                )
                (both[..., near],) = mean_over_angles(
                    speckle.factors[rows[:, near]],
                    (up[..., near], down[..., near]),
                    lambda up, down: (detection.fading_together(up, down, level, alike, number),),
                )
        return np.where((up == 0) | (down == 0), 0.0, both)

    def independent_bins(
        self, chances: tuple[np.ndarray, ...], magnitudes: tuple[np.ndarray, ...]
    ) -> np.ndarray | float:
        """Independent bins as which the echoes of some segments count, on the geometric mean.

        By the segments' probabilities of detection and |X| [V] of their strongest bins.
        """
        from sweep.model.detection import independent_bins

        if self.detection == "peak_bin":
            return 1.0
        deviation = self.line_deviation
        level = self.threshold / deviation
        number: Any = 1.0
        for pd, magnitude in zip(chances, magnitudes, strict=True):
            number = number * independent_bins(pd, magnitude / deviation, level)
        return np.asarray(number ** (1 / len(chances)))

    @property
    def any_two(self) -> bool:
        """True where any two of three segments detect a shot."""
        return self.shot_detection == waveform.ANY_TWO and len(self.order) == 3

    def detected(
        self, magnitude: np.ndarray, bins: np.ndarray, points: np.ndarray | slice = slice(None)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities that a bin is detected in several looks, and that it is missed, (..., m).

        ``magnitude`` [V] is nan for none; ``points`` says which points these are.
        """
        there, levels = np.isfinite(magnitude), (self.line_deviation, self.threshold)
        deviation, level = (np.broadcast_to(v, self.size)[points] for v in levels)
        signal = np.where(there, magnitude, 0.0) / deviation
        if self.fading is not None:
            both = self._faded(signal, level / deviation, bins, points)
        else:
            ends = np.isin(bins, (0, self.real_ends // 2)) & (self.real_ends > 0)
            both = self.looks.steady(signal, level / deviation, ends)
        found, missed = (np.where(there, chance, np.nan) for chance in both)
        return found, missed

    def _of_chirps(
        self, one: np.ndarray, other: np.ndarray, level: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities of up and down segment in several looks, far from DC and Nyquist."""
        signals = np.nan_to_num(np.stack([one, 0 * one, other], axis=-2))
        up, _, down = np.moveaxis(
            self.looks.faded(signals, level[..., None, :], self.look_speckle)[0], -2, 0
        )
        return up, down

    def _faded(
        self, signal: np.ndarray, level: np.ndarray, bins: np.ndarray, points: np.ndarray | slice
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute :meth:`detected` in developed speckle, by signal and threshold over the noise."""
        from sweep.model.quadratures import faded_looks

        in_looks = None if self.look_speckle is None else self.look_speckle.at(points)
        found, missed = self.looks.faded(signal, level, in_looks)
        rule, speckle = self.echo_rule, self.speckle_table
        row, half = np.broadcast_to(speckle.row[:, points], signal.shape), self.fft_size // 2
        k = np.minimum(bins, half - bins)
        near = (row > 0) & (k >= 0) & (k < speckle.quadratures.shape[1])
        if near.any():
            share = speckle.quadratures[row[near], k[near]]
            noise = rule.noise_quadratures[k[near]] if rule.ends else np.zeros(share.size)
            levels = np.broadcast_to(level, signal.shape)[near]
            found, missed = found.copy(), missed.copy()
            segment, point = (at[near] for at in np.indices(signal.shape)[-2:])
            covariance = self._look_covariance(segment, np.arange(self.size)[points][point])
            found[near], missed[near] = faded_looks(
                self.looks, signal[near], levels, share, noise, covariance
            )
        return found, missed

    def _look_covariance(self, segment: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Covariance of the echo's amplitudes in the looks of segments and points, (m, k, k)."""
        from sweep.model.look_speckle import turned_matrices

        number = self.looks.number
        by_lag, power = np.ones((point.size, number), complex), np.ones((point.size, number))
        if self.looks.independent:
            by_lag[:, 1:] = 0.0
        elif self.look_speckle is not None:
            by_lag = self.look_speckle.by_lag[segment, point]
            power = self.look_speckle.power[segment, point]
        cycles = (
            np.zeros(point.size) if self.look_turns is None else self.look_turns[segment, point]
        )
        return turned_matrices(by_lag, power, cycles)

    def _deviation(self, variance: np.ndarray) -> np.ndarray:
        energy = np.asarray(self.window.energy)
        mean = variance / self.looks.added
        return link.bin_deviation(noise_variance=mean, window_energy=energy)

    @cached_property
    def footprint(self) -> np.ndarray:
        """(R_b - R_0)/R_0, beta_b - beta_0, amplitude, phases if any: (3 or 6, rows, beamlets)."""
        phases = self.phase if self.phase.size else ()
        return np.stack([self.offset, self.doppler, self.amplitude, *phases])

    @cached_property
    def waveform(self) -> tuple[waveform.Segment, ...]:
        """Segments of the waveform, one after the other; no output tells of Doppler's leakage."""
        return tuple(
            waveform.Segment(
                name, slope, slope * self.chirp_rate, carrier, name != waveform.SEGMENTS[1],
                self.approach * start + 0.5 * self.acceleration * start * start,
                self.beta + doppler_ratio(self.acceleration * start), start,
            )
            for name, slope, carrier, start in zip(
                waveform.SEGMENTS, self.slopes, self.carriers, self.starts, strict=True
            )
        )  # fmt: skip

    @property
    def motion(self) -> dict[str, Any]:
        """Range [m] and radial velocity [m/s], (n,); where they differ, tuples by segment."""
        here: dict[str, Any] = {"range": self.range, "radial_velocity": self.radial_velocity}
        if self.moves_on:
            here["range"] = tuple(self.range - each.nearer for each in self.waveform)
            if np.any(self.acceleration):
                here["radial_velocity"] = tuple(
                    self.radial_velocity + self.acceleration * start for start in self.starts
                )
        return here

    @property
    def record_middle(self) -> np.ndarray:
        """Time from a segment's start to its record's middle [s], (n,); 0 without range walk."""
        return np.asarray(self.walk - (self.starts[0] + self.starts[2]) / 2) / 2

    @property
    def drifts(self) -> tuple[np.ndarray, ...]:
        """Hz by which each segment's lines have moved on at the middle of its record, (n,) each."""
        return tuple(
            self._gained(each, self.record_middle, self.speeding) for each in self.waveform
        )

    @property
    def drift_rates(self) -> tuple[np.ndarray, ...]:
        """Hz/s at which each segment's lines move on within its record, (n,) each."""
        walks, speeds = np.sign(self.record_middle), np.sign(self.speeding)
        return tuple(self._gained(each, walks, speeds) for each in self.waveform)

    def _gained(self, segment: Segment, walked: np.ndarray, sped: np.ndarray | float) -> np.ndarray:
        """Hz that a segment's lines gain in a time [s] of range walk and one of acceleration."""
        closing = self.radial_velocity + self.approach
        closing = closing + self.acceleration * (2 * segment.start + 1.5 * self.speeding)
        by_speed = segment.carrier * self.acceleration * sped
        return np.asarray(2 / SPEED_OF_LIGHT * (by_speed + segment.chirp_rate * closing * walked))

    @property
    def beats_by_motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Hz of each segment's beat for a Doppler ratio, and for -2R/c, (3, n): carriers and rates.

        They refer to the shot's start, of a target at a steady speed. A record tells the delay at
        its middle, and at twice that by the phase's own curve.
        """
        starts, slopes, carriers, walk, rate = (
            np.array([np.broadcast_to(v, self.size) for v in values])
            for values in (
                self.starts, self.slopes, self.carriers, (self.walk,), (self.chirp_rate,)
            )
        )  # fmt: skip
        times = starts + walk - (starts[0] + starts[2]) / 2
        return carriers + slopes * rate * times, slopes * rate

    @property
    def moves_on(self) -> bool:
        """True where the target moves on between segments."""
        return any(np.any(start) for start in self.starts)

    @property
    def segments(self) -> np.ndarray:
        """Segments that exist of up, Doppler and down, (3,) bool."""
        return np.array([name in self.order for name in waveform.SEGMENTS])

    @property
    def schedule(self) -> tuple[np.ndarray, ...]:
        """Times [s] from the shot's start to each segment's, by the waveform."""
        return waveform.segment_starts(self.order, duration=self.duration, gap=self.gap)

    @property
    def look_period(self) -> np.ndarray:
        """Time [s] from one look to the next: that of the whole waveform."""
        return len(self.order) * (self.duration + self.gap)

    def point_table(self) -> np.ndarray:
        """Numbers of each point as compiled code takes them, (COMMON + OWN segments, n).

        Properties common to all segments, and of each segment the signed chirp rate [Hz/s], the
        carrier, the whitening, by how much it is nearer, its Doppler ratio, and when it starts.
        """
        columns = (
            self.range, self.beta, self.chirp_rate, self.beat_scale, self.detector_bandwidth,
            self.amplifier_bandwidth, self.sample_rate, self.acquisition_delay, self.carriers[0],
            self.carriers[2], self.bin_deviation, self.threshold, self.floor,
            self.line_deviation, self.leakage_tolerance, self.line_tolerance, self.image_gain,
            *self.bin_levels[3:],
        )  # fmt: skip
        further = (
            x
            for each, gain in zip(self.waveform, self.whitening, strict=True)
            for x in (each.chirp_rate, each.carrier, gain, each.nearer, each.beta, each.start)
        )
        return in_rows((*columns, *further), (self.size,))

    @property
    def real_ends(self) -> int:
        """FFT size where noise in bins 0 and N/2 is real, as that of a real record is; else 0."""
        is_real = self.noise_bins == "correlated" and not self.complex_record
        return self.fft_size if is_real else 0

    @property
    def searched_from(self) -> int:
        """First bin searched for alarms, counted from DC and from Nyquist."""
        return alarms.first_circular(self.window, self.fft_size) if self.real_ends else 1

    @property
    def correlation(self) -> float:
        """Of the noise of adjacent bins, 0..1."""
        if self.noise_bins == "independent":
            return 0.0
        return alarms.neighbour_correlation(self.window, self.fft_size)

    @property
    def echo_rule(self) -> "DetectionRule":
        """Return the rule of detection of one record's bins."""
        from sweep.model.detection import DetectionRule
        from sweep.model.interpolation import sidelobe_correlation
        from sweep.model.quadratures import noise_quadratures
        from sweep.model.speckle_modes import NO_MODES, mode_table

        fades = -1.0 if self.fading is None else self.correlation
        noise, half = np.empty(0), 0
        if self.fading is not None and not self.complex_record:
            half = self.fft_size // 2
            if self.real_ends:
                noise = noise_quadratures(self.window, self.fft_size)
        pairs = alarms.pair_nodes(self.correlation)
        beside = sidelobe_correlation(self.window, self.fft_size)
        if self.detection == "peak_bin":
            return DetectionRule(
                self.real_ends, 0, pairs, fades, half, noise, NO_MODES, self.correlation, beside
            )
        lobe = main_lobe(self.window) * self.fft_size / self.window.length
        modes = NO_MODES if self.fading is None else mode_table(self.window, self.fft_size)
        return DetectionRule(
            self.real_ends, math.ceil(lobe), pairs, fades, half, noise, modes, self.correlation,
            beside,
        )  # fmt: skip

    @cached_property
    def speckle_table(self) -> "SpeckleTable":
        """Speckle in the bins of each segment."""
        from sweep.model.detection import SpeckleTable
        from sweep.model.quadratures import signal_quadratures

        shape = (len(self.waveform), self.size)
        spread = np.ascontiguousarray(np.broadcast_to(self.line_spread, shape), float)
        # Without images bins near DC and Nyquist hold half of the echo, and no real number.
        if self.fading is None or self.complex_record or not self.image:
            return SpeckleTable(
                spread, np.zeros(shape, np.int64), np.zeros((1, 0)), np.ones((1, 1))
            )
        return SpeckleTable(spread, *signal_quadratures(self))

    def searched_bins(
        self, exempted: np.ndarray, points: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """Bins that can raise a false alarm, less the ``exempted``, (3, m), by segment."""
        searched: Any = self.fft_size if self.complex_record else self.fft_size // 2
        if self.real_ends:
            searched += 1 - 2 * self.searched_from
        if self.band is not None:
            size, first = self.fft_size, self.searched_from
            of_band = number_of(self.band, size, first, is_signed=self.complex_record)
            searched = of_band[:, points]
        bins = np.maximum(searched - exempted, 0.0)
        if self.bins_counted == "all" and self.band is None:
            bins = np.full(np.shape(exempted), float(self.fft_size))
        return np.asarray(bins)

    def counted_bins(
        self, exempted: np.ndarray, points: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """Independent bins that would raise a false alarm as often as those that can."""
        bins = self.searched_bins(exempted, points)
        if self.noise_bins == "independent":
            return bins
        level = np.broadcast_to(self.threshold / self.bin_deviation, self.size)[points]
        return alarms.independent_bins(
            bins, level=level, correlation=self.correlation, looks=self.looks
        )


def categories(
    parameters: Parameters, further: Collection[str] = ()
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Split points by category: (indices, parameters as arrays) for each.

    Among the parameters is ``record``, the length of the record in samples. ``further`` names
    numbers that points must share besides :data:`CATEGORIES`.
    """
    arrays = as_arrays(parameters)
    size = max((a.size for a in arrays.values() if a.ndim), default=1)
    shared = {*CATEGORIES, *further}
    varying = [
        path for path, a in arrays.items() if a.ndim and (path in shared or a.dtype.kind in "UO")
    ]
    if not varying:
        yield np.arange(size), arrays
        return
    member = np.zeros(size, np.int64)
    for path in varying:
        if (arrays[path] == arrays[path][0]).all():  # the rule, and found without sorting
            continue
        different, code = np.unique(arrays[path], return_inverse=True)
        member = np.unique(member * different.size + code, return_inverse=True)[1]
    for group in range(member.max() + 1):
        index = np.flatnonzero(member == group)
        chosen = {path: a[index] if a.ndim else a for path, a in arrays.items()}
        yield index, chosen | {path: chosen[path][0] for path in varying}


def in_rows(values: Sequence[np.ndarray | float], shape: tuple[int, ...]) -> np.ndarray:
    """Values that broadcast to a shape, as rows."""
    rows = np.empty((len(values), *shape))
    for row, value in zip(rows, values, strict=True):
        row[...] = value
    return rows


def as_arrays(parameters: Parameters) -> dict[str, np.ndarray]:
    """Parameters as arrays, with the length of the record among them."""
    arrays = {path: np.asarray(value) for path, value in parameters.items()}
    arrays["record"] = waveform.record_length(arrays)
    return arrays


def bare(p: Mapping[str, np.ndarray], size: int, ground: Ground) -> Shots:
    """Points of one category with nothing but the echo on the beam's axis and receiver noise."""
    architecture, in_quadrature = str(p[RECEIVER + "architecture"]), str(p[RECORD]) == "complex"
    echo_scale, current_scale = link_scales(architecture, p)
    noise = link.receiver_noise(architecture, link.receiver_values(p), in_quadrature)
    row, offset, doppler, echo = ground.axis(size)
    everywhere, accuracy, looks = np.zeros(size), Accuracy.of(p), Looks.of(p)
    return Shots(
        architecture=architecture,
        window=window(canonical_name(str(p[PROCESSING + "window"])), int(p["record"])),
        fft_size=int(p[PROCESSING + "fft_size"]),
        bins_counted=str(p[PROCESSING + "bins_counted"]),
        band=band_of(p, size),
        noise_bins=str(p[PROCESSING + "noise_bins"]),
        detection=str(p[PROCESSING + "detection"]),
        shot_detection=str(p[waveform.SHOT_DETECTION]),
        peaks=str(p[waveform.PEAKS]),
        two_beats=str(p[waveform.TWO_BEATS]),
        noise_shape=str(p[RECEIVER + "noise_shape"]),
        order=waveform.order_of(architecture, str(p[waveform.ORDER])),
        gap=p[waveform.GAP],
        tnr=tnr_of(p),
        range=p["target.range"] + everywhere,
        radial_velocity=p["target.radial_velocity"] + everywhere,
        acceleration=p["target.acceleration"],
        approach=approach(p),
        bandwidth=p[CHIRP + "bandwidth"],
        duration=p[CHIRP + "duration"],
        slopes=waveform.slopes_of(p),
        carriers=waveform.carriers_of(p),
        sample_rate=p[PROCESSING + "sample_rate"] + everywhere,
        acquisition_delay=p[PROCESSING + "acquisition_delay"],
        detector_bandwidth=p[RECEIVER + "detector_bandwidth"],
        amplifier_bandwidth=p[RECEIVER + "amplifier_bandwidth"],
        leakage_floor=np.asarray(accuracy.leakage_floor, float),
        leakage_tolerance=accuracy.for_leakage,
        beamlets_error=p.get(BEAMLETS_ERROR, np.asarray(np.nan)),
        line_tolerance=accuracy.for_lines / math.sqrt(looks.averaged),
        echo_scale=echo_scale,
        beat_scale=current_scale * p[RECEIVER + "transimpedance"],
        noise_scale=noise.per_ampere,
        shot_noise_scale=noise.per_watt,
        noise_sources=noise.sources,
        row=row,
        offset=offset,
        doppler=doppler,
        amplitude=relative_amplitude(architecture, echo),
        incoherent=architecture != "direct",
        antialias=link.antialias_of(link.receiver_values(p)),
        complex_record=in_quadrature,
        looks=looks,
    )


@lru_cache(maxsize=8)
def energy_left(window: Window) -> np.ndarray:
    """Sum w^2 over the samples from each on, (L + 1,)."""
    return np.append(np.cumsum(window.samples()[::-1] ** 2)[::-1], 0.0)


def approach(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Speed at which the range along the beam falls [m/s], (n,) or scalar.

    This is not the radial velocity if the beam slides over slanting ground. Let V = v d + u e, d
    along the beam and e across it towards the near side. Then a plane of normal n at the grazing
    angle g is met at a range that falls by V.n / d.n = v + u cot g.
    """
    if APPROACH in p:
        return p[APPROACH]
    across = p["target.transverse_velocity"]
    if not np.any(across):
        return p["target.radial_velocity"]
    return np.asarray(p["target.radial_velocity"] + across / np.tan(p["target.grazing_angle"]))


def relative_amplitude(architecture: str, echo: np.ndarray) -> np.ndarray:
    """Relative amplitude of the beat from the relative echo; direct detection beats with power."""
    return echo if architecture == "direct" else np.sqrt(echo)


def doppler_ratio(radial_velocity: np.ndarray) -> np.ndarray:
    """Doppler ratio beta = 2 v_r / c."""
    return 2 * radial_velocity / SPEED_OF_LIGHT


def link_scales(architecture: str, p: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Echo power [W] for a backscatter of 1/sr with the whole beam at one range; its beat [A].

    [T 4.4] without its 1/(2 pi): that belongs to the reflectance law. A beamlet's echo is this
    times its power fraction, its backscatter [1/sr] and what :func:`sweep.model.beam.dimming` says
    of its range.
    """
    light = p[LASER + "power"] * beam.collecting_area(p) * p[TELESCOPE + "optical_efficiency"]
    power = light * p["target.reflectance"] / p["target.range"] ** 2
    return power, beat_current(architecture, p, power)


def beat_current(architecture: str, p: Mapping[str, np.ndarray], power: np.ndarray) -> np.ndarray:
    """Amplitude of the beat photocurrent [A] that light of a power P [W] makes.

    Coherent architectures: 2 M Re sqrt(eta P_lo P), eta the heterodyne efficiency, a share of
    power. Direct detection: m M Re P, hence 2 dB of SNR for each dB of light. [T 2.22] takes
    2 Re^2 P^2 as the mean square current, which is the peak of a fully modulated echo. With P the
    mean echo power the mean square is m^2 Re^2 P^2 / 2, a quarter of it.
    """
    gain, responsivity = p[RECEIVER + "apd_gain"], p[RECEIVER + "responsivity"]
    if architecture == "direct":
        return p[RECEIVER + "modulation_index"] * gain * responsivity * power
    light = p[RECEIVER + "local_oscillator_power"] * power
    return 2 * gain * responsivity * np.sqrt(p[RECEIVER + "mixing_efficiency"] * light)


_OF_POINTS = {
    "range": "range",
    "radial_velocity": "radial velocity",
    "acceleration": "acceleration",
    "beta": "Doppler shift",
    "echo_scale": "echo's power",
    "beat_scale": "beat's amplitude",
    "bin_deviation": "noise",
    "threshold": "threshold",
}
_OF_BEAMLETS = {
    "offset": "beamlets' ranges",
    "doppler": "beamlets' velocities",
    "amplitude": "beamlets' echoes",
}
"""Fields of shots that have to be finite, and what users call them."""


def require_finite(shots: Shots) -> None:
    """Refuse shots with a number that is not finite: the spectrum of one has no peak to be found.

    The UnsupportedShot says what is not finite, and of which shot.
    """
    for name, words in (_OF_POINTS | _OF_BEAMLETS).items():
        values = np.asarray(getattr(shots, name))
        if math.isfinite(float(values.sum())):  # not so of any nan, nor of an inf
            continue
        wrong = ~np.isfinite(values)
        if not wrong.any():
            continue
        if name in _OF_BEAMLETS:
            rows = wrong.any(axis=1)
            point = int(rows[shots.row].argmax())
            value = values[shots.row[point]][wrong[shots.row[point]]][0]
        else:
            point = int(np.broadcast_to(wrong, (shots.size,)).argmax())
            value = np.broadcast_to(values, (shots.size,))[point]
        raise UnsupportedShot(
            f"the {words} can not be computed ({value}), at a range of {shots.range[point]:.6g} m: "
            "check the scene and the path there for numbers out of all proportion",
            point,
        )
