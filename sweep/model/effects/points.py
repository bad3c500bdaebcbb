"""Link budget, lines and footprints of many points at once, for the sizes of effects.

The formulas are those that shots are prepared with, for arrays that broadcast over the points;
values are computed on first use. Arrays by segment have one more axis, in front, of the segments
that exist. All points share words and the parameters that :meth:`Points.whole` reads.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.model import beam, ground, link, resolution, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.lobes import Lobe, lobe
from sweep.model.footprint import (
    NO_SPREAD,
    Moments,
    beamlets,
    plane_echo_ratio,
    plane_moments,
    velocity_to_bins,
)
from sweep.model.ground import Extent, backscatter
from sweep.model.looks import Looks
from sweep.model.preparation import (
    CHIRP,
    LASER,
    PROCESSING,
    RECEIVER,
    RECORD,
    approach,
    link_scales,
    relative_amplitude,
)
from sweep.model.threshold import tnr_of
from sweep.model.window import Window, canonical_name, samples, window

_CHEBYSHEV = (1.4, 2.5, 8.0)
_NEAR_EDGE = 8.0
"""Window bins from line to image beyond which F is below 0.4 % of the bin's, F', F'' below 5 %."""


class Smear(NamedTuple):
    """Change of lines over the record by an effect: a phase, or places in their own right.

    Sizes by segment, or scalars; powers are of the place x in the record, -1..1, in cycles.
    """

    powers: tuple[np.ndarray | float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Of x, x^2, x^3, x^4."""
    rest: np.ndarray | float = 0.0
    """Of all phase that is no such power."""
    constant: np.ndarray | float = 0.0
    """In the record's middle, which matters to lines beside their images."""
    reach: np.ndarray | float = 0.0
    """Bins of fs/L that light may be moved by besides the slopes of the powers."""

    @property
    def bins(self) -> np.ndarray | float:
        """Bins of fs/L that light may be moved by."""
        slopes = sum(2 * (k + 1) * value for k, value in enumerate(self.powers))
        return slopes + self.reach

    def plus(self, other: "Smear") -> "Smear":
        """Both together."""
        powers = tuple(a + b for a, b in zip(self.powers, other.powers, strict=True))
        return Smear(powers, *(a + b for a, b in zip(self[1:], other[1:], strict=True)))


NO_SMEAR = Smear()


class Missing(NamedTuple):
    """Samples of the record that are taken before the echo arrives, by segment."""

    lost: np.ndarray
    """Sum |w| over them, over sum w."""
    step: np.ndarray
    """Factor on the sidelobes of a rectangular window that bounds what their lack adds to others,
    relative to sum w."""
    first: np.ndarray
    """Number of these samples."""
    middle: np.ndarray
    """Bound on the mean place, -1..1, of what is left in the record."""
    all: np.ndarray
    """True where all samples lack."""


def missing_of(window: Window, first: np.ndarray) -> Missing:
    """Bounds for records of which the first samples have no echo.

    The transform of the samples that lack is at most their variation over 2 sin(pi y / L), and so
    is that of the samples that are left, which is what the sidelobes are where these are fewer.
    """
    lost, before, after = _of_samples(window)
    share = lost[first]
    step = np.minimum(before[first], after[first]) * (window.length / window.sum)
    with np.errstate(divide="ignore"):
        middle = np.minimum(share / np.maximum(1 - share, 1e-300), 1.0)
    step = np.where(first > 0, step, 0.0)
    return Missing(share, step, first, middle, first >= window.length)


@lru_cache(maxsize=8)
def _of_samples(window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bounds of :func:`missing_of` by the number of samples that lack, (L + 1,) each."""
    w = samples(window.name, window.length)
    size = np.abs(w)
    lost = np.append(0.0, np.cumsum(size)) / window.sum
    rises = np.append(0.0, np.cumsum(np.abs(np.diff(w))))  # up to each sample
    before = 0.5 * (size[0] + rises + size)
    after = 0.5 * (size + rises[-1] - rises + size[-1])
    before, after = np.append(0.0, before), np.append(after, 0.0)
    return lost, before, after


def largest_about(window: Window, first: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Largest |w| of samples less than ``reach`` away from the first one, over sum w."""
    powers = np.ceil(np.log2(np.clip(reach, 1, window.length))).astype(int)
    found = np.empty(np.broadcast_shapes(first.shape, powers.shape))
    first, powers = np.broadcast_arrays(first, powers)
    for power in np.unique(powers):
        where = powers == power
        found[where] = _largest_within(window, int(power))[first[where]]
    return found


@lru_cache(maxsize=64)
def _largest_within(window: Window, power: int) -> np.ndarray:
    """Largest |w| within 2^power samples of each place of a record, (L + 1,), over sum w."""
    from scipy.ndimage import maximum_filter1d  # slow to import

    size = np.abs(samples(window.name, window.length))
    size = np.append(size, size[-1])
    return np.asarray(maximum_filter1d(size, 2 * 2**power + 1, mode="nearest")) / window.sum


def by_power(change: np.ndarray) -> np.ndarray:
    """Relative change of a magnitude by that of its power, downwards, which is the larger one."""
    return np.asarray(1 - np.sqrt(1 - np.minimum(change, 1.0)))


class Points:
    """Some points that share every word.

    `parameters` are words, numbers or arrays by dotted path, those that effects bring among them;
    arrays broadcast against each other and have as many axes each. `footprint` is what rays have
    found, by default that of a flat plane; `rotating` tells whether any surface belongs to a body
    that turns.
    """

    def __init__(
        self,
        parameters: Mapping[str, np.ndarray | float | str],
        footprint: Extent | None = None,
        *,
        rotating: bool = False,
    ) -> None:
        self.parameters = {path: np.asarray(value) for path, value in parameters.items()}
        self.ndim = max((v.ndim for v in self.parameters.values()), default=0)
        self._footprint, self.rotating = footprint, rotating
        self.architecture = self.word(RECEIVER + "architecture")
        self.fft_size = self.whole(PROCESSING + "fft_size")
        self.at_rest = False
        """True where the Doppler effect is off."""
        self.at_one_range = False
        """True where the target stands still between segments."""
        self.fills_records = False
        """True where the effect of overlap is off."""
        self.smears: dict[str, Smear] = {}
        """Of the effects that smear lines, by name."""
        number = self.whole(resolution.BEAMLETS)
        self.number, self.pattern = resolution.finest(self.parameters)
        if number:
            self.number, self.pattern = number, ground.pattern(self.parameters)
        direct = self.architecture == "direct"
        self.order = waveform.order_of(self.architecture, self.word(waveform.ORDER))
        self.sample_rate = self[PROCESSING + "sample_rate"]
        self.start = self[PROCESSING + "acquisition_delay"]
        """Acquisition delay t_0 [s]."""
        self.bin_width = self.sample_rate / self.fft_size
        """[Hz]."""
        self.chirp_rate = self[CHIRP + "bandwidth"] / self[CHIRP + "duration"]
        self.range, self.radial_velocity = self["target.range"], self["target.radial_velocity"]
        """On the beam's axis [m, m/s], positive when closing."""
        self.delay = 2 / SPEED_OF_LIGHT * self.range
        self.beta = 2 * self.radial_velocity / SPEED_OF_LIGHT
        """Doppler ratio."""
        self.acceleration = self["target.acceleration"]
        """[m/s^2]."""
        self.looks = Looks.of(parameters)
        self.slopes: tuple[np.ndarray | float, ...] = (
            1.0,
            *(
                np.asarray(parameters.get(path, waveform.DEFAULTS[path]), float)
                for path in (waveform.DOPPLER_SLOPE, waveform.DOWN_SLOPE)
            ),
        )
        """Chirp rates of up, Doppler and down segment over :attr:`chirp_rate`, signed."""
        self.signs = self.columns(*self._there(self.slopes))
        coherent = self.word("footprint.phases") == "coherent"
        self.adds_amplitudes = coherent or direct
        self.by_roots = coherent and not direct
        """True where roots of echoes add."""

    def __getitem__(self, path: str) -> np.ndarray:
        """Return a parameter that is a number."""
        return self.parameters[path]

    def word(self, path: str) -> str:
        """Return a parameter that is a word."""
        return str(self.parameters[path])

    def whole(self, path: str) -> int:
        """Return a whole number that all points share."""
        return int(self.parameters[path].flat[0])

    def has(self, *paths: str) -> bool:
        """Return true if any of some numbers is other than 0 anywhere."""
        return any(bool(self.parameters[path].any()) for path in paths)

    def _there(self, of_all: Sequence[Any]) -> list[Any]:
        """Values of the segments that there are: up, Doppler, down."""
        named = zip(waveform.SEGMENTS, of_all, strict=True)
        return [value for name, value in named if name in self.order]

    def columns(self, *values: np.ndarray | float) -> np.ndarray:
        """Values by segment, one behind the other."""
        like = np.zeros((1,) * self.ndim)
        return np.stack(np.broadcast_arrays(like, *values)[1:]).astype(float)

    # The instrument

    @cached_property
    def window(self) -> Window:
        """Window of the record, whose length all points share."""
        length = waveform.record_length(self.parameters)
        return window(canonical_name(self.word(PROCESSING + "window")), int(length.flat[0]))

    @cached_property
    def lobe(self) -> Lobe:
        """Its transform over the FFT's bins."""
        return lobe(self.window.name, self.window.length, self.fft_size)

    @property
    def margin(self) -> float:
        """Bins of the FFT to one of fs/L."""
        return self.lobe.margin

    @cached_property
    def record_duration(self) -> np.ndarray:
        """Length of the record L/fs [s]."""
        return self.window.length / self.sample_rate

    @cached_property
    def carriers(self) -> np.ndarray:
        """Frequency that the delay turns into phase [Hz], by segment."""
        found = waveform.carrier_frequencies(
            self.architecture,
            wavelength=self[LASER + "wavelength"],
            start_frequency=self[CHIRP + "start_frequency"],
            bandwidth=self[CHIRP + "bandwidth"],
            slopes=self.slopes,
        )
        return self.columns(*self._there(found))

    @cached_property
    def receiver(self) -> link.ReceiverNoise:
        """Noise at the ADC [V^2]."""
        values = link.receiver_values(self.parameters)
        return link.receiver_noise(self.architecture, values, self.word(RECORD) == "complex")

    @cached_property
    def rounding(self) -> np.ndarray:
        """Noise of the ADC's steps [V^2]."""
        full_scale, bits = (self[PROCESSING + name] for name in ("full_scale", "bits"))
        in_quadrature = self.word(RECORD) == "complex"
        return link.rounding_variance(full_scale=full_scale, bits=bits, in_quadrature=in_quadrature)

    @cached_property
    def noise_variance(self) -> np.ndarray:
        """Of the receiver alone, at the ADC [V^2]."""
        return np.asarray(sum(self.receiver.sources.values()))

    @cached_property
    def deviation(self) -> np.ndarray:
        """Noise sigma of a bin, per quadrature [V]."""
        energy, mean = np.asarray(self.window.energy), self.noise_variance / self.looks.added
        return link.bin_deviation(noise_variance=mean, window_energy=energy)

    @cached_property
    def threshold(self) -> np.ndarray:
        """Threshold over sigma."""
        from sweep.model import detection

        tnr = tnr_of(self.parameters)
        return np.asarray(detection.threshold(tnr=tnr, bin_deviation=np.asarray(1.0)))

    @property
    def largest_noise(self) -> float | None:
        """Magnitude over sigma that any bin's noise exceeds with a probability of 0.001 at most.

        None where segments report all peaks that cross the threshold.
        """
        if self.word(waveform.PEAKS) == waveform.ALL:
            return None
        return float(np.sqrt(2 * np.log(1e3 * self.whole(PROCESSING + "fft_size"))))

    # The target

    @cached_property
    def angles(self) -> beam.Angles:
        """Full angles of the footprint [rad]."""
        return beam.angles(self.parameters)

    @cached_property
    def footprint(self) -> Extent:
        """Extent of the footprint, as given for all beams or on a plane."""
        if (found := self._footprint) is not None:
            return found if self.by_roots else found._replace(gain=1.0)
        angle = self["target.grazing_angle"]
        echo = backscatter(self.word("target.reflectance_law"), np.sin(angle))
        if self.number == 1:
            return Extent(echo, 1.0, NO_SPREAD, NO_SPREAD, NO_SPREAD)
        shape: dict[str, Any] = {
            "grazing_angle": angle, "beam_divergence": self.angles.places,
            "number": self.number, "pattern": self.pattern,
        }  # fmt: skip
        ranges, velocities = plane_moments(
            across=self["target.transverse_velocity"], along=self.radial_velocity,
            directions=self.angles.directions, **shape,
        )  # fmt: skip
        ratio = plane_echo_ratio(self.word("target.reflectance_law"), **shape)
        gain = 1.0
        if self.by_roots:
            gain = float(np.sqrt(beamlets(self.number, self.pattern)[1]).sum())
        return Extent(echo, ratio, ranges, ranges, velocities, gain * np.sqrt(ratio))

    @cached_property
    def scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Echo power [W] for a relative echo of 1/sr; amplitude of the beat [V] for that of 1."""
        power, current = link_scales(self.architecture, self.parameters)
        return power, current * self[RECEIVER + "transimpedance"]

    @cached_property
    def beat(self) -> np.ndarray:
        """Amplitude of the bare line's beat at the ADC [V], before the receiver's poles."""
        return self.scales[1] * relative_amplitude(self.architecture, self.footprint.echo)

    @cached_property
    def echo_noise(self) -> np.ndarray:
        """Shot noise of the whole echo over the receiver's noise variance."""
        whole = self.footprint.echo * np.maximum(self.footprint.echo_ratio, 1.0)
        return self.scales[0] * whole * self.receiver.per_watt / self.noise_variance

    # Lines

    @cached_property
    def approach(self) -> np.ndarray:
        """Speed at which the range along the beam falls [m/s]."""
        return np.asarray(approach(self.parameters))

    @property
    def look_period(self) -> np.ndarray:
        """Time from look to look [s]."""
        return np.asarray(len(self.order) * (self[CHIRP + "duration"] + self[waveform.GAP]))

    @property
    def late(self) -> np.ndarray | float:
        """Time from the first look to the middle one [s]."""
        return 0.5 * (self.looks.number - 1) * self.look_period if self.looks.number > 1 else 0.0

    @cached_property
    def starts(self) -> np.ndarray:
        """Time from the shot's start to each segment's, of the middle look [s]."""
        starts = waveform.segment_starts(
            self.order, duration=self[CHIRP + "duration"], gap=self[waveform.GAP]
        )
        return self.columns(*self._there([start + self.late for start in starts]))

    @cached_property
    def faster(self) -> np.ndarray:
        """Growth of the Doppler ratio from the shot's start to each segment's."""
        moving = 0.0 if self.at_one_range else 2 / SPEED_OF_LIGHT
        return np.asarray(moving * self.acceleration * self.starts)

    @cached_property
    def frequency(self) -> np.ndarray:
        """Signed beat of the line on the axis [Hz], by segment."""
        beta = self.faster + (0.0 if self.at_rest else self.beta)
        delay = self.delay
        if not self.at_one_range:
            delay = delay - (2 / SPEED_OF_LIGHT * self.approach + self.faster / 2) * self.starts
        beat = self.chirp_rate * delay * (1 + beta)
        return self.carriers * beta - self.signs * beat

    @cached_property
    def missing(self) -> Missing | None:
        """Samples of the record without an echo; None where echoes fill all records."""
        if self.fills_records:
            return None
        delay = self.delay
        if not self.at_one_range:
            delay = delay - (2 / SPEED_OF_LIGHT * self.approach + self.faster / 2) * self.starts
        first = waveform.samples_before_echo(
            delay=delay, beta=self.faster + (0.0 if self.at_rest else self.beta),
            start=self.start, sample_rate=self.sample_rate, length=self.window.length,
        )  # fmt: skip
        latest = delay * np.minimum(self.footprint.ranges.extreme, 1e3)  # beyond the axis's
        latest = latest + 2 / SPEED_OF_LIGHT * np.abs(self.approach) * self.late
        if not first.any() and not (delay + latest > self.start).any():
            return None
        return missing_of(self.window, np.broadcast_to(first, self.frequency.shape))

    def tail(self, distance: np.ndarray) -> np.ndarray:
        """Largest magnitude of a bin at least ``distance`` [bins] from a line, over its peak's.

        The peak is that of a whole record.
        """
        found = self.lobe.tail(distance)
        if self.missing is None:
            return found
        other = lobe("rectangular", self.window.length, self.fft_size)
        more = self.missing.step * other.tail(distance - self.margin)
        return np.asarray(found + np.minimum(more, self.missing.lost))

    def left_of(self, power: np.ndarray) -> np.ndarray:
        """Least power of the largest bin, by that of a whole record, over that of all on a bin."""
        if self.missing is None:
            return power
        return np.asarray(np.maximum(np.sqrt(power) - self.missing.lost, 0.0) ** 2)

    @cached_property
    def metres_between(self) -> np.ndarray:
        """Most metres by which the target moves from the shot's start to a segment's own."""
        last = self.starts + self.late
        return (np.abs(self.approach) + np.abs(self.acceleration) * last / 2) * last

    @cached_property
    def bins_between(self) -> np.ndarray:
        """Most bins by which its line moves in that time."""
        faster = np.abs(self.acceleration) * (self.starts + self.late)
        slope = np.abs(self.signs) * self.chirp_rate * (2 / SPEED_OF_LIGHT) / self.bin_width
        nearer = slope * (1 + np.abs(self.beta)) * self.metres_between
        return nearer + self.per_velocity * faster

    @cached_property
    def offset(self) -> np.ndarray:
        """Distance from the nearest bin [bins], 0..1/2."""
        place = self.frequency / self.bin_width
        return np.abs(place - np.rint(place))

    @cached_property
    def edge(self) -> np.ndarray:
        """Distance of the folded line from the nearer of DC and Nyquist [bins]."""
        half = self.fft_size / 2
        place = self.frequency / (self.bin_width * half)
        return np.abs(place - np.rint(place)) * half

    @cached_property
    def transfer(self) -> np.ndarray:
        """|H| at the line over that at DC."""
        poles = [self[RECEIVER + f"{part}_bandwidth"] for part in ("detector", "amplifier")]
        one, other = ((self.frequency / pole) ** 2 for pole in poles)
        passed = 1 / np.sqrt((1 + one) * (1 + other))
        if self.antialias:
            passed = passed * np.sqrt(link.antialias_power(self.frequency, **self.antialias))
        return np.asarray(passed)

    @cached_property
    def antialias(self) -> dict[str, np.ndarray]:
        """Bandwidth [Hz] and order of the filter before the ADC; empty without one."""
        return link.antialias_of(link.receiver_values(self.parameters))

    @cached_property
    def tilt(self) -> np.ndarray:
        """Bound on the relative change of |H|^2 a bin [1/bin]."""
        poles = (self[RECEIVER + f"{part}_bandwidth"] for part in ("detector", "amplifier"))
        return np.asarray(sum(1 / pole for pole in poles) * self.bin_width)

    @cached_property
    def level(self) -> np.ndarray:
        """Magnitude of the bare line on a bin over sigma, by segment."""
        level = self.beat * (0.5 * self.window.sum) / self.deviation * self.transfer
        if self.word(RECEIVER + "noise_shape") == "white":
            return level
        density = self.noise_density
        if self.antialias:  # where next to no noise passes, that of the ADC is what there is
            density = density + self.rounding / self.noise_variance
        return level / np.sqrt(density)

    @cached_property
    def noise_density(self) -> np.ndarray | float:
        """Density of the receiver's noise at the line over its mean over all bins, by segment."""
        if self.word(RECEIVER + "noise_shape") == "white":
            return 1.0
        names = "detector_bandwidth", "amplifier_bandwidth"
        filters = {name: self[RECEIVER + name] for name in names} | self.antialias
        return link.noise_density(self.frequency, sample_rate=self.sample_rate, **filters)

    @cached_property
    def amplitude(self) -> np.ndarray:
        """Magnitude of the largest bin of the bare line over sigma, by segment."""
        return self.level * self.lobe.near(self.offset)

    @cached_property
    def per_range(self) -> np.ndarray:
        """Bins for a relative difference of range of 1, by segment."""
        slope = self.chirp_rate * self.delay * (1 + np.abs(self.beta))
        return np.abs(self.signs) * (slope / self.bin_width)

    @cached_property
    def per_velocity(self) -> np.ndarray:
        """Bins for 1 m/s, by segment."""
        return velocity_to_bins(
            range=self.range, carrier=self.carriers, chirp_rate=self.chirp_rate,
            bin_width=self.bin_width,
        )  # fmt: skip

    @cached_property
    def own_spread(self) -> Moments:
        """Bins off the axis's line by the ranges of beamlets on the axis's surface."""
        return self.footprint.own_ranges.times(self.per_range)

    @cached_property
    def range_spread(self) -> Moments:
        """Bins off the axis's line by the ranges of all beamlets."""
        return self.footprint.ranges.times(self.per_range)

    @cached_property
    def velocity_spread(self) -> Moments:
        """Bins off the axis's line by the velocities of beamlets."""
        return self.footprint.velocities.times(self.per_velocity)

    @cached_property
    def spread(self) -> Moments:
        """Bins off the axis's line by ranges and velocities of beamlets."""
        return self.range_spread.plus(self.velocity_spread)

    @cached_property
    def smear(self) -> Smear:
        """All that smears lines over the record."""
        total = NO_SMEAR
        for one in self.smears.values():
            total = total.plus(one)
        return total

    @cached_property
    def smeared(self) -> np.ndarray | float:
        """Bins that light may be moved by over the record."""
        return self.smear.bins * self.margin

    @cached_property
    def apart(self) -> np.ndarray:
        """Bins from DC and Nyquist to the nearest light of a line."""
        return self.edge - self.spread.extreme - self.smeared

    @cached_property
    def near_image(self) -> np.ndarray:
        """True where lines and their images are so close that they may add up, or cancel."""
        return ~(2 * self.apart >= _NEAR_EDGE * self.margin)

    @cached_property
    def image(self) -> np.ndarray:
        """Most that images add to the largest bin, over the magnitude that lines make in phase."""
        smeared = 1 + 2 * self.smeared / self.margin
        uphill = np.exp(np.minimum(self.tilt * self.spread.extreme, 50.0))
        outside = self.tail(self.apart) * np.sqrt(smeared)
        return np.asarray(uphill * outside / self.lobe.near(self.offset))

    @property
    def may_add(self) -> bool:
        """True if amplitudes add, or may."""
        return self.adds_amplitudes or self.has("target.roughness")

    @cached_property
    def may_cancel(self) -> np.ndarray:
        """True where amplitudes that add, or may, might nearly cancel."""
        if not self.may_add:
            return np.zeros_like(self.near_image)
        return self.near_image | (self.number > 1)

    @cached_property
    def powers(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest power of the largest bin, over that of all lines on a bin."""
        return self.power_range(self.spread)

    def power_range(self, moments: Moments) -> tuple[np.ndarray, np.ndarray]:
        """Bound the largest bin's power for lines of a spread, over that of all lines on a bin.

        Images are included. The bounds come from Taylor's series, the line of the strongest
        beamlet, and Chebyshev's inequality: a share 1 - 1/t^2 of the power lies within t s, whose
        largest bin holds the mean at least.
        """
        form, tilt, (mean, rms, extreme) = self.lobe, self.tilt, moments
        on_axis = form.near(self.offset) ** 2
        if moments is NO_SPREAD or self.number == 1:
            return on_axis, on_axis * np.where(self.near_image, 2.0, 1.01)
        second = 0.5 * form.curvature * rms * rms
        least = on_axis - np.minimum(form.slope, form.curvature * self.offset) * mean
        least = least - second - tilt * rms
        least = np.maximum(least, np.exp(-tilt * extreme) * (form.worst**2 / self.number))
        for t in _CHEBYSHEV:
            wide = t * rms
            most = (1 - 1 / t**2) * form.energy / (2 * wide + 2 * form.margin + 1)
            least = np.maximum(least, most * np.exp(-tilt * wide))
        most = np.minimum(on_axis + form.slope * mean + second, 1.0)
        uphill = np.exp(np.minimum(tilt * extreme, 50.0))
        most = most * np.where(self.near_image, 2.0, 1.01)
        most = most * (1 + uphill * np.minimum(tilt * rms, 50.0))
        return np.minimum(least, most), most

    def moved(self, added: Moments, present: Moments, shift: np.ndarray | float = 0.0):
        """Relative change of the largest bin's power as lines are moved, or spread further.

        P_k = sum_b p_b F(k - x_0 - X_b), and with F1, F2 the bounds on |F'| and |F''|

            |P_k(with) - P_k(without)| <= F1 |m| + F2 (S s + s^2 / 2) + c s

        for the mean m and the rms s of X, added to lines of rms S, and c of the receiver's poles.
        """
        form, least = self.lobe, self.power_range(present)[0]
        change = form.slope * (added.mean + shift)
        change = change + form.curvature * (present.rms * added.rms + added.rms**2 / 2)
        away = self.tilt * (present.extreme + added.extreme + shift)
        change = change + self.tilt * (added.rms + shift)
        double = np.where(self.near_image, 2.0, 1.05)
        return double * np.exp(np.minimum(away, 50.0)) * change / least

    def in_phase(self, bins: np.ndarray | float) -> np.ndarray:
        """Bound the relative change of a sum of amplitudes whose lines move by some bins.

        Relative to the sum in phase; by |W'|, |H'| and the phase at mid-record, line and image.
        """
        turn = 2 * np.pi * (self.start + 0.5 * self.record_duration) * self.bin_width
        each = (np.sqrt(self.lobe.curvature) + 2 * self.tilt + turn) * bins
        uphill = np.exp(np.minimum(self.tilt * (self.spread.extreme + bins), 50.0))
        return 2 * uphill * np.minimum(each, 2.0) / self.lobe.worst
