"""Complex spectra of a shot with noise in every bin, and what is found in them, draw by draw.

Noise is drawn as the receiver makes it: white Gaussian in the record, which is windowed, padded and
transformed. So bins are alike as far as window and padding make them, and DC and Nyquist are what
they are. Every sample is addressed by point, draw, segment and place (:mod:`sweep.model.philox`).

A real record has bins 0..N/2. A complex one, of I and Q, has N: bin k stands at index k + N/2, and
the last is a neighbour of the first. Indices that name an echo's bins may go on below 0 and beyond
N - 1.

The signal has the magnitudes that :func:`sweep.model.segments.spectrum` gives, with all
effects. If beamlets add as powers these are root mean squares, and have no phases: the signal
is then given those of a lone tone at its place, bin by bin. For footprints of less than a bin that
is what the spectrum is. In developed speckle the bins of an echo have the amplitudes that the lines
of its footprint make in a draw (:mod:`sweep.model.speckle_lines`), and its leaked signal fades with
the strongest of them. If a shot of a flight has several echoes, each has the phases of a tone of
its own, and its own speckle.
A phase common to all bins makes no difference to circular noise and is left out.

The phase of a laser of Lorentzian line width walks randomly: of each draw a walk is taken, at every
sample, and turns the signal's record (:func:`sweep.model.effects.line_width.walked_phase`).

In several looks (:mod:`sweep.model.looks`) each record has its signal where the target has come to,
its noise, its walk, and the speckle that all have, or its own. Flags are those of the mean of
|X|^2, of enough records, or of the mean record; the frequency is the mean of the looks' estimates.

A detector and an estimator of frequency look at each segment's spectrum. The detector flags bins of
|X|^2. A segment is detected where it flags any bin that the signal occupies (``peak_bin``: the one
that is the strongest without noise and speckle); adjacent flagged bins form a group. A group
outside the bins that the signal occupies is a false alarm. The estimator is given the spectrum and
the largest bin of the detected group. If all segments are detected, their frequencies are resolved
into range and radial velocity.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import fft

from sweep.model import waveform
from sweep.model.band import is_searched
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import mark
from sweep.model.detectors import DETECTORS, FIXED, Detector, Setting, main_lobe, taper
from sweep.model.effects.line_width import seen_line, walk_steps, walked_phase
from sweep.model.effects.segment_motion import looks_of
from sweep.model.estimators import (
    DETECTOR,
    ESTIMATOR,
    ESTIMATORS,
    Deviation,
    Estimator,
    beat_deviation,
    phase_deviation,
    resolved_deviation,
)
from sweep.model.interpolation import interpolator, phasors, sub_bin
from sweep.model.looks import BINARY
from sweep.model.philox import STREAM_LASER_PHASE, STREAM_RECORD, normals, uniforms
from sweep.model.preparation import Parameters, Shots
from sweep.model.search import middle_lines
from sweep.model.segments import whole_spectrum
from sweep.model.shot import fit
from sweep.model.speckle_lines import (
    NEXT_LOOK,
    RECORD_SPREAD_MAX,
    FootprintRecord,
    LineFan,
    Peaks,
    directions,
    drawn_speckle,
    line_fan,
)
from sweep.model.wander import resolved_wander
from sweep.model.window import last_part

VALUES = ("pfa_bin", "false_alarms", "range", "radial_velocity", "range_2", "radial_velocity_2")
"""Values that are averaged over draws; the last two are squares of bounds."""


class Methods(NamedTuple):
    """Detectors and estimators by name: those of the program, and any others."""

    detectors: Mapping[str, Detector] = DETECTORS
    estimators: Mapping[str, Estimator] = ESTIMATORS


class Signal(NamedTuple):
    """A segment's spectrum without noise, and what is true of it."""

    spectrum: np.ndarray
    """(N/2 + 1,) complex [V]; of a complex record (N,)."""
    strongest: int
    """Index of the largest bin; of a real record 1..N/2 - 1 where noise is taken to be circular in
    all."""
    first: int
    """First of the bins that the signal occupies: those from the first to the last of half its
    largest magnitude, and a main lobe's half-width to either side."""
    last: int
    """Last of them; below ``first`` where there is no echo, or its largest bin is not searched."""
    frequency: float
    """Place of a lone tone of these magnitudes about the largest bin [bins], with its sign."""
    cnr: float
    """Power of the signal over that of the noise in the record, before the FFT."""
    segment: int
    """0 up, 1 Doppler, 2 down."""
    echo: np.ndarray | None = None
    """Number of the echo that each bin is nearest to, int64; None where all are one."""
    others: tuple[np.ndarray, np.ndarray] | None = None
    """Strongest bin of each of several echoes, and the place of a lone tone about it, as indices.
    """
    reach: int = 0
    """Bins on either side of such an echo that it occupies."""
    records: tuple[FootprintRecord, ...] | None = None
    """Records of the speckle of each echo, none where lines spread over more than a bin; None where
    they are not known yet."""
    record_factors: tuple[np.ndarray, ...] = ()
    """(bins,) complex of each: what makes factors on ``spectrum`` of the record's transform."""
    exempt: np.ndarray | None = None
    """(bins,) bool: bins that raise no false alarm: those from ``first`` to ``last``, and those at
    or above the threshold with their neighbours, as of :func:`sweep.model.detection.mark`."""


def signal_of(
    shots: Shots, i: int, segment: int, echoes: Sequence[int] | np.ndarray = (),
    level: float = math.inf,
) -> Signal:  # fmt: skip
    """Spectrum of point i's segment without noise: 0 up, 1 Doppler, 2 down.

    ``echoes``: strongest bins of the echoes of several surfaces, where there are several.
    ``level``: fixed threshold [V], if there is one: bins that reach it raise no false alarm.
    """
    magnitude = whole_spectrum(shots, i, segment)
    if (laser := _laser(shots, i))["line_width"] > 0:  # as it is before its phase walks
        shape = shots.window
        if shots.first_sample is not None:
            shape = last_part(shape, int(shots.first_sample[0, i]))
        kept = seen_line(window=shape, looks=shots.looks.added, **laser)[0][0]
        magnitude = magnitude / math.sqrt(kept)
    window, last = shots.window, magnitude.size - 1
    least = 0 if shots.real_ends or shots.complex_record else 1  # at DC and Nyquist taken as 0
    k = int(np.clip(np.argmax(magnitude), least, last - least))
    if not magnitude[k] > 0:
        place = float(k - index_of_zero(shots))
        none = np.zeros(magnitude.size, bool)
        return Signal(magnitude.astype(complex), k, 1, 0, place, 0.0, segment, exempt=none)
    place = _between(shots, magnitude, k)
    turn = turn_of(shots, k)
    high = np.flatnonzero(unrolled(shots, magnitude, k) >= 0.5 * magnitude[k]) - turn
    beside = math.ceil(main_lobe(window) * shots.fft_size / window.length)
    total = (magnitude**2).sum()
    if not shots.complex_record:  # and as much at negative frequencies
        total = 2 * total - magnitude[0] ** 2 - magnitude[-1] ** 2
    power = total / (shots.fft_size * max(float(shots.echo_energy(segment)[i]), 1e-300))
    aside = max(beside, int(shots.bin_levels[4, i]))  # where its pedestal is above the noise
    first, end = int(high[0]) - aside, int(high[-1]) + aside
    if not shots.complex_record:
        first, end = max(first, least), min(end, last - least)
    begun = 0 if shots.first_sample is None else int(shots.first_sample[segment, i])
    phases = _tone_phases(place, shots, begun)
    if high[-1] - high[0] > beside:  # wider than a tone: in step, as in one's main lobe
        apart = np.arange(first, end + 1) - k
        phases[(k + apart) % phases.size] = phases[k] * np.exp(
            -1j * np.pi * apart * ((window.length + begun) / shots.fft_size)
        )
    if not is_searched(shots, segment, i, k - index_of_zero(shots)):
        first, end = 1, 0
    echo, others = None, None
    if len(echoes) > 1:
        apart = np.arange(magnitude.size)[:, None] - np.asarray(echoes)
        if shots.complex_record:
            apart -= shots.fft_size * np.rint(apart / shots.fft_size).astype(np.int64)
        echo = np.abs(apart).argmin(axis=1)
        others = np.asarray(echoes), np.array([_between(shots, magnitude, int(k)) for k in echoes])
        for number, own in enumerate(echoes):
            if (own - first) % magnitude.size > end - first:
                at = _between(shots, magnitude, int(own))
                phases = np.where(echo == number, _tone_phases(at, shots, begun), phases)
    return Signal(
        spectrum=magnitude * phases,
        strongest=k,
        first=first,
        last=end,
        frequency=place - index_of_zero(shots),
        cnr=float(power / shots.noise_variance[i]),
        segment=segment,
        echo=echo,
        others=others,
        reach=beside,
        exempt=_exempt_bins(shots, magnitude, k, (first, end), level),
    )


def _exempt_bins(
    shots: Shots, magnitude: np.ndarray, strongest: int, ends: tuple[int, int], level: float
) -> np.ndarray:
    """Bins that raise no false alarm, as of :class:`Signal`; none of an echo not searched for."""
    first, last = ends
    exempt = np.zeros(magnitude.size, bool)
    if last < first:
        return exempt
    run = unrolled(shots, magnitude, strongest)
    marked = np.zeros(run.size, bool)
    mark(run, run.size, level, marked, shots.echo_rule.beside)
    if shots.complex_record:
        marked = np.roll(marked[1:-1], 1 - turn_of(shots, strongest))
    exempt[np.arange(first, last + 1) % exempt.size] = True
    return exempt | marked


def index_of_zero(shots: Shots) -> int:
    """Index of the bin at frequency 0 in a spectrum."""
    return int(shots.index_of_bin(np.zeros((), int)))


def turn_of(shots: Shots, middle: int) -> int:
    """Places by which :func:`unrolled` moves a bin."""
    return 1 + shots.fft_size // 2 - middle if shots.complex_record else 0


def unrolled(shots: Shots, values: np.ndarray, middle: int) -> np.ndarray:
    """Values of bins (..., bins) without a seam near one of them.

    Those of a complex record are turned until index ``middle`` stands in the middle, with a 0 put
    at either end as if it were DC and Nyquist of a real one. Those of a real one are as they are.
    """
    if not shots.complex_record:
        return values
    values = np.roll(values, turn_of(shots, middle) - 1, axis=-1)
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)])


def _between(shots: Shots, magnitude: np.ndarray, k: int) -> float:
    """Place of a lone tone whose largest bin is k, as an index."""
    last = magnitude.size - 1
    if shots.complex_record:
        below, above = magnitude[k - 1], magnitude[(k + 1) % magnitude.size]
    else:
        below, above = magnitude[abs(k - 1)], magnitude[min(k + 1, 2 * last - k - 1)]
    return k + sub_bin(below, magnitude[k], above, interpolator(shots.window, shots.fft_size))


def _tone_phases(place: float, shots: Shots, begun: int) -> np.ndarray:
    """Phase factors of a lone tone at a place, by index; 1 where it vanishes.

    It begins with sample ``begun`` of the record.
    """
    size = shots.fft_size
    cycles = (place - index_of_zero(shots)) / size
    record = taper(shots.window) * phasors(-cycles, shots.window.length)
    record[:begun] = 0.0
    tone = transformed(shots, record if shots.complex_record else record.real)
    magnitude = np.abs(tone)
    return np.where(magnitude > 0, tone / np.where(magnitude > 0, magnitude, 1.0), 1.0)


def transformed(shots: Shots, record: np.ndarray) -> np.ndarray:
    """Spectrum of a windowed record (L,), which is padded."""
    if shots.complex_record:
        return np.asarray(fft.fftshift(fft.fft(record, shots.fft_size)))
    return np.asarray(fft.rfft(record, shots.fft_size))


def _laser(shots: Shots, i: int) -> dict[str, np.ndarray]:
    """Width of the laser's line [Hz]; delay of the echo and length of the record [s]."""
    return {
        "line_width": _at(shots.laser_width, i),
        "delay": 2 * _at(shots.range, i) / SPEED_OF_LIGHT,
        "duration": _at(shots.record_duration, i),
    }


def drawn_of(
    shots: Shots, i: int, segment: int, signal: Signal, *, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Spectra (m or 1, bins) complex of the signal in some draws, without noise [V]."""
    laser, rate = _laser(shots, i), float(_at(shots.sample_rate, i))
    if not laser["line_width"] > 0:
        return signal.spectrum[None]
    length, size = shots.window.length, shots.fft_size
    delay = float(laser["delay"]) * rate
    both = np.zeros(size, complex)  # spectrum of the analytic record
    if shots.complex_record:
        both = fft.ifftshift(signal.spectrum)
    else:
        both[: size // 2 + 1] = 2 * signal.spectrum
        both[[0, size // 2]] /= 2
    record = fft.ifft(both)[:length]
    per_sample, spectra = 2 * math.pi * float(laser["line_width"]) / rate, []
    for draw in draws:
        numbers = uniforms(
            key[None], draw[None], STREAM_LASER_PHASE[segment],
            walk_steps(delay=delay, length=length),
        )  # fmt: skip
        # |X| does not tell the phase that a record begins with, and their sum does.
        phase = walked_phase(
            normals(numbers)[0], per_sample=per_sample, delay=delay, whole=shots.looks.added > 1
        )
        turned = record * np.exp(1j * phase)
        spectra.append(transformed(shots, turned if shots.complex_record else turned.real))
    return np.array(spectra)


def noise_of(
    shots: Shots, i: int, segment: int, *, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Noise (m, bins) complex of some draws of point i's segment, by their numbers [V]."""
    length, stream = shots.window.length, STREAM_RECORD[segment]
    keys = np.broadcast_to(key, (draws.size, 2))
    numbers = 2 * length if shots.complex_record else length + length % 2
    record = normals(uniforms(keys, draws, stream, numbers))
    if shots.complex_record:  # I and Q with half of the noise each
        record = (record[:, :length] + 1j * record[:, length:]) * math.sqrt(0.5)
    record = record[:, :length] * math.sqrt(float(shots.noise_variance[i])) * taper(shots.window)
    # A transform at a time: bits do not depend on how many there are.
    return np.array([transformed(shots, each) for each in record])


def speckle_of(
    shots: Shots,
    i: int,
    segment: int,
    signal: Signal,
    *,
    key: np.ndarray,
    draws: np.ndarray,
    fan: LineFan | None = None,
) -> np.ndarray:
    """Complex factors on the bins of point i's segment in some draws, (m, bins); 1 without speckle.

    The bins that an echo occupies have those of the lines of its footprint, its other bins the one
    of its strongest bin.
    """
    if shots.speckle_lines is None:
        return np.ones((1, 1))
    fan = line_fan(shots) if fan is None else fan
    if signal.records is None:
        signal = with_footprint_records(shots, i, signal, fan)
    if signal.records:
        return _speckle_of_records(shots, signal, key, draws)
    size, zero = signal.spectrum.size, index_of_zero(shots)
    found = np.empty((draws.size, size), complex)
    at_ends = np.zeros(size, bool)  # one part is left, which has all of the power
    at_ends[[0, -1]] = shots.real_ends > 0
    echoes = [(signal.strongest, signal.frequency + zero, signal.first, signal.last)]
    if signal.echo is not None and signal.others is not None:
        echoes = [
            (int(own), place, int(own) - signal.reach, int(own) + signal.reach)
            if (own - signal.first) % size > signal.last - signal.first
            else (int(own), place, signal.first, signal.last)
            for own, place in zip(*signal.others, strict=True)
        ]
    for number, (strongest, place, first, last) in enumerate(echoes):
        first, last = min(first, strongest - 1), max(last, strongest + 1)
        middle = np.full(3, np.nan)
        middle[segment] = place
        amplitudes = drawn_speckle(
            fan, i, middle, (first, last - first + 1), key=key, draws=draws, group=number
        )
        own = slice(None) if signal.echo is None else signal.echo == number
        found[:, own] = amplitudes[:, strongest - first, None]
        bins = np.arange(first, last + 1)
        there = (amplitudes != 0).any(axis=0)
        if not shots.complex_record:
            there &= (bins >= 0) & (bins < size)
        if signal.echo is not None:
            there &= signal.echo[bins % size] == number
        bins = bins[there] % size
        found[:, bins] = amplitudes[:, there]
        if shots.real_ends and shots.speckle_table.row[segment, i] > 0:
            # Their phases are those about the record's middle, as the noise's are.
            begun = 0 if shots.first_sample is None else int(shots.first_sample[segment, i])
            turns = np.exp(-1j * np.pi * bins * ((shots.window.length + begun) / shots.fft_size))
            magnitude = np.abs(signal.spectrum[bins])
            tone = signal.spectrum[bins] / np.where(magnitude > 0, magnitude, 1.0)
            found[:, bins] *= turns * np.where(magnitude > 0, tone, 1.0).conj()
            at_ends[bins] = False
    found[:, at_ends] = math.sqrt(2) * found[:, at_ends].real
    return found


def with_footprint_records(shots: Shots, i: int, signal: Signal, fan: LineFan) -> Signal:
    """Return a signal of point i with the records of its echoes' speckle."""
    if shots.speckle_lines is None:
        return signal
    segment, zero = signal.segment, index_of_zero(shots)
    widest = np.hypot(*fan.spread[i, segment]) * shots.window.length / shots.fft_size
    if widest > RECORD_SPREAD_MAX:
        return signal._replace(records=())
    begun = 0 if shots.first_sample is None else int(shots.first_sample[segment, i])
    if not taper(shots.window)[begun:].any():
        return signal._replace(records=())
    strongest = np.full((1, 3), signal.strongest - zero)
    places = [float(middle_lines(shots, np.array([i]), strongest)[0, segment])]
    if signal.others is not None:
        places = [float(place) - zero for place in signal.others[1]]
    records = tuple(
        FootprintRecord.of(fan, i, segment, place, shots.window, begun, shots.fft_size)
        for place in places
    )
    bins, size = np.arange(signal.spectrum.size) - zero, shots.fft_size
    magnitude = np.abs(signal.spectrum)
    turned = np.where(magnitude > 0, signal.spectrum, 1.0).conj()
    turned = turned / np.where(magnitude > 0, magnitude, 1.0)
    factors = []
    for record in records:
        power = record.power[bins % size]
        if not shots.complex_record:  # half of the line and of its image
            power = 0.25 * (power + record.power[-bins % size])
        factors.append(turned / np.sqrt(power))
    return signal._replace(records=records, record_factors=tuple(factors))


def _speckle_of_records(
    shots: Shots, signal: Signal, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Compute :func:`speckle_of` by the records of a footprint's lines, which all bins see."""
    assert signal.records is not None
    found = np.empty((draws.size, signal.spectrum.size), complex)
    for number, record in enumerate(signal.records):
        own = slice(None) if signal.echo is None else signal.echo == number
        for row, draw in enumerate(draws):
            of_draw = record.draw(key, int(draw), number)
            of_draw = of_draw if shots.complex_record else of_draw.real
            factor = signal.record_factors[number]
            found[row, own] = (transformed(shots, of_draw) * factor)[own]
    return found


def spectra_of(view: "View", segment: int, draws: np.ndarray) -> Iterator[np.ndarray]:
    """Spectra (m, bins) complex of a segment in some draws, with noise [V], look by look.

    Of looks that are added in amplitude their mean alone.
    """
    looks, total = view.shots.looks, np.zeros(1, complex)
    for k, shots in enumerate(view.looks):
        numbers = draws + k * NEXT_LOOK
        given = {"key": view.key, "draws": numbers}
        signal = view.signal_in_look(segment, k)
        factors = _speckle_in_look(view, shots, segment, k, draws, signal)
        spectra = drawn_of(shots, view.i, segment, signal, **given) * factors
        spectra = spectra + noise_of(shots, view.i, segment, **given)
        if looks.added == 1:
            yield spectra
        else:
            total = total + spectra
    if looks.added > 1:
        yield total / looks.added


def _speckle_in_look(
    view: "View", shots: Shots, segment: int, look: int, draws: np.ndarray, signal: Signal
) -> np.ndarray:
    """Factors (m, bins) of a look by :func:`speckle_of`: of one speckle, its own, or shared ones.

    Speckle that changes from look to look is a sum of independent ones.
    """
    given: dict[str, Any] = {"key": view.key, "fan": view.fan}
    if shots.look_speckle is None:
        own = draws + look * NEXT_LOOK if shots.looks.independent else draws
        return speckle_of(shots, view.i, segment, signal, draws=own, **given)
    root = shots.look_speckle.root(segment, view.i)[look]
    # The mean power of the looks differs in the signal itself.
    root = root / np.sqrt((np.abs(root) ** 2).sum())
    return np.asarray(
        sum(
            share
            * speckle_of(shots, view.i, segment, signal, draws=draws + number * NEXT_LOOK, **given)
            for number, share in enumerate(root)
        )
    )


class View(NamedTuple):
    """A shot, and how it is looked at."""

    shots: Shots
    i: int
    """Number of the shot."""
    key: np.ndarray
    """(2,) uint64: random key of the point."""
    signals: tuple[Signal | None, ...]
    """By segment; None for one that does not exist."""
    looks: list[Shots]
    """The shots as each look finds them."""
    setting: Setting
    detect: Detector
    estimate: Estimator
    moved_signals: dict[tuple[int, int], Signal]
    """Signals of looks that find the target elsewhere, by segment and look, as they are asked for.
    """
    echoes: np.ndarray | None = None
    """(3, k) int64: strongest bins of the shot's echoes in each segment, -1 for none."""
    fan: LineFan | None = None
    """Lines of all shots' footprints in developed speckle."""
    level: float = math.inf
    """Fixed threshold [V], if the detector has one."""

    def signal_in_look(self, segment: int, look: int) -> Signal:
        """Return the signal of a segment as a look finds it."""
        shots, signal = self.looks[look], self.signals[segment]
        if shots is self.shots and signal is not None:
            return signal
        if (segment, look) not in self.moved_signals:
            signal = signal_of(shots, self.i, segment, self.echoes_of(segment), self.level)
            fan = line_fan(shots) if self.fan is None else self.fan
            self.moved_signals[segment, look] = with_footprint_records(shots, self.i, signal, fan)
        return self.moved_signals[segment, look]

    def echoes_of(self, segment: int) -> np.ndarray:
        """Return indices of the echoes' strongest bins in a segment; none where echoes are one."""
        bins = np.empty(0, np.int64) if self.echoes is None else self.echoes[segment]
        bins = bins[bins >= 0]
        return self.shots.index_of_bin(bins)


class Found(NamedTuple):
    """Detections, alarms and frequency of a segment in m draws, (m,) each."""

    detected: np.ndarray
    alarms: np.ndarray
    """Groups outside the signal."""
    flagged: np.ndarray
    """Bins in them."""
    frequency: np.ndarray
    """[bins], with signs of a complex record."""
    delta: np.ndarray
    """Place past the strongest bin [bins]."""
    power: np.ndarray
    """|X|^2 of the echo's strongest bin in the mean, and at least the threshold's [V^2]."""


def view_of(
    shots: Shots, i: int, p: Parameters, key: np.ndarray, methods: Methods,
    echoes: np.ndarray | None = None, fan: LineFan | None = None,
) -> View:  # fmt: skip
    """View of one of some shots, by the parameters p of its point, those of `DEFAULTS`."""
    training, rank = int(p[DETECTOR + "training"]), int(p[DETECTOR + "rank"])
    setting = Setting(
        fft_size=shots.fft_size,
        sample_rate=float(shots.sample_rate[i]),
        window=shots.window,
        noise_power=float(shots.window.energy * shots.quiet_variance[i] / shots.looks.added),
        threshold=float(shots.threshold[i]),
        training=training,
        guard=int(p[DETECTOR + "guard"]),
        rank=rank or math.ceil(0.75 * training),  # 0 stands for three quarters
        pfa=float(p[DETECTOR + "pfa"]),
        complex_record=shots.complex_record,
    )
    fan = line_fan(shots) if fan is None else fan
    view = View(
        shots, i, key, (), looks_of(shots), setting,
        methods.detectors[str(p[DETECTOR + "kind"])],
        methods.estimators[str(p[ESTIMATOR + "kind"])],
        {},
        echoes,
        fan,
        setting.threshold if str(p[DETECTOR + "kind"]) == FIXED else math.inf,
    )  # fmt: skip
    signals = tuple(
        with_footprint_records(shots, i, signal_of(shots, i, s, view.echoes_of(s), view.level), fan)
        if there
        else None
        for s, there in enumerate(shots.segments)
    )
    return view._replace(signals=signals)


def flagged(
    spectra: Sequence[np.ndarray], view: View, segment: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean power of a segment's looks, and the bins that are flagged, (m, bins) each."""
    powers = [each.real**2 + each.imag**2 for each in spectra]
    power = powers[0] if len(powers) == 1 else np.mean(powers, axis=0)
    if view.shots.looks.combine == BINARY:
        votes = sum(np.array(view.detect(each, view.setting), np.int64) for each in powers)
        flags = np.asarray(votes >= view.shots.looks.votes)
    else:
        flags = np.array(view.detect(power, view.setting), bool)
    bins = np.arange(flags.shape[1]) - index_of_zero(view.shots)
    return power, flags & is_searched(view.shots, segment, view.i, bins)


def placed(spectra: Sequence[np.ndarray], peak: np.ndarray, view: View) -> np.ndarray:
    """Places (m,) of peaks in a segment's spectra, by index: the mean of the looks' estimates."""
    places = [view.estimate(each, peak, view.setting) for each in spectra]
    return places[0] if len(places) == 1 else np.asarray(np.mean(places, axis=0))


def look(spectra: Sequence[np.ndarray], signal: Signal, view: View) -> Found:
    """Detect and estimate in spectra (m, bins) of a segment, of one or several looks."""
    power, flags = flagged(spectra, view, signal.segment)
    shots, turn = view.shots, turn_of(view.shots, signal.strongest)
    power, flags = (unrolled(shots, each, signal.strongest) for each in (power, flags))
    strongest, before, last = (k + turn for k in (signal.strongest, signal.first, signal.last))
    bins, half = np.arange(power.shape[1]), power.shape[1] - 1
    low, high = strongest, strongest + 1
    if shots.detection == "any_bin" and last >= before:
        low, high = before, last + 1
        if not shots.real_ends:
            low, high = max(low, 1), min(high, half)
    place = signal.strongest - index_of_zero(shots)
    own = flags[:, low:high] & is_searched(shots, signal.segment, view.i, place)
    near = np.where(own, power[:, low:high], -1.0)
    hit, detected = low + near.argmax(axis=1), near.max(axis=1) >= 0
    flags[:, [0, -1]] = False  # DC and Nyquist
    edges = np.diff(flags.astype(np.int8), axis=1)
    row, start = np.nonzero(edges > 0)  # of each group of flagged bins
    start, end = start + 1, np.nonzero(edges < 0)[1] + 1
    assert signal.exempt is not None
    exempt = np.cumsum(np.pad(unrolled(shots, signal.exempt, signal.strongest), (1, 0)))
    false = exempt[start] == exempt[end]  # no bin of theirs is exempt
    false &= (start <= half - shots.searched_from) & (end > shots.searched_from)
    alarms, bins_flagged = (
        np.bincount(row[false], weights, len(power)).astype(np.int64)
        for weights in (None, (end - start)[false])
    )
    own = detected[row] & (start <= hit[row]) & (hit[row] < end)
    first, beyond = np.ones((len(power), 1)), np.full((len(power), 1), half)
    first[row[own], 0], beyond[row[own], 0] = start[own], end[own]
    peak = np.where((first <= bins) & (bins < beyond), power, -1.0).argmax(axis=1)
    # The largest of several bins would be brighter than a bin whose place wanders.
    least = np.minimum(power[np.arange(len(power)), peak], view.setting.threshold**2)
    strength = np.maximum(power[:, strongest], least)
    strongest_bin = (peak - turn) % shots.fft_size if shots.complex_record else peak
    peak_place = placed(spectra, strongest_bin, view)
    frequency = peak_place - index_of_zero(shots)
    return Found(detected, alarms, bins_flagged, frequency, peak_place - strongest_bin, strength)


def counted(view: View, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count detections and alarms in some draws, and find values to be averaged over them.

    By the names of DRAW_OUTPUTS and of VALUES, (names, m); nan where there is no value.
    """
    nothing = np.zeros(draws.size, np.int64)
    found = [Found(nothing > 0, nothing, nothing, *np.zeros((3, draws.size)))] * 3
    searched = 0
    for s, signal in enumerate(view.signals):
        if signal is not None:
            found[s] = look(list(spectra_of(view, s, draws)), signal, view)
            bins = np.arange(view.shots.bins)
            inside = is_searched(view.shots, s, view.i, bins - index_of_zero(view.shots))
            occupied = inside[signal.exempt].sum()
            least = 0 if view.shots.complex_record else view.shots.searched_from
            searched += int(inside[least : bins.size - least].sum() - occupied)
    up, doppler, down = found
    detected, alarm = np.array([f.detected for f in found]), (up.alarms > 0, down.alarms > 0)
    shot = up.detected & down.detected
    whole = shot & (doppler.detected | (view.signals[1] is None))
    if view.shots.any_two:
        shot = whole = detected.sum(axis=0) >= 2
    counts = np.array([
        up.detected, down.detected, doppler.detected, shot, *alarm, alarm[0] & alarm[1]
    ], np.int64)  # fmt: skip
    flagged, alarms = sum(f.flagged for f in found), sum(f.alarms for f in found)
    squares = np.square(_bounds(view, detected)) + _wander(view, found, detected)
    if view.shots.any_two:  # they differ by what is detected
        squares = np.where(whole, squares, np.nan)
    errors = [np.where(whole, error, np.nan) for error in _errors(view, found, detected)]
    return counts, np.array([flagged / max(searched, 1), alarms, *errors, *squares])


def _bounds(view: View, detected: np.ndarray) -> np.ndarray:
    """Bounds of range and velocity in draws (2, m) by the segments (3, m) that tell of them."""
    bounds = np.empty((2, detected.shape[1]))
    bounds[...] = np.reshape(resolved_bound(view), (2, 1))
    if view.shots.any_two:
        for missed in np.eye(3, dtype=bool):
            here = (detected == ~missed[:, None]).all(axis=0)
            bounds[:, here] = np.reshape(resolved_bound(view, ~missed), (2, 1))
    return bounds


def _wander(view: View, found: Sequence[Found], detected: np.ndarray) -> np.ndarray:
    """Mean square errors of range and velocity by speckle in draws, (2, m)."""
    shots, i, m = view.shots, view.i, detected.shape[1]
    if shots.speckle_lines is None:
        return np.zeros((2, m))
    point = np.full(m, i)
    line = float(np.broadcast_to(shots.line_deviation, shots.size)[i])
    signal = np.array([
        np.nan if s is None else np.abs(s.spectrum[s.strongest]) ** 2 for s in view.signals
    ])  # fmt: skip
    mean = signal + 2 * line**2
    power = np.where(detected, [each.power for each in found], np.nan).T / mean
    delta = np.clip([each.delta for each in found], -1.0, 1.0).T
    share = np.broadcast_to(signal / mean, power.shape)
    peaks = Peaks(delta, directions(shots)[point], power, share)
    return resolved_wander(shots, point, peaks, detected)


def resolved_bound(view: View, used: Sequence[bool] | np.ndarray | None = None) -> Deviation:
    """Bound of range and velocity that are resolved from the beats that are ``used``.

    By default of up and down beat; where segments have slopes of their own, of all. Of
    Cramer and Rao in white noise, and what the laser's phase adds; looks tell independently.
    """
    shots, i = view.shots, view.i
    rate, looks, laser = (
        float(shots.sample_rate[i]),
        math.sqrt(shots.looks.number),
        _laser(shots, i),
    )
    lengths = np.full(len(view.signals), shots.window.length)
    if shots.first_sample is not None:
        lengths = np.maximum(lengths - shots.first_sample[:, i], 2)
        laser["duration"] = lengths[0] / np.asarray(rate)
    walk = phase_deviation(**laser)
    more = 2 if shots.complex_record else 1  # as much noise has two samples for one
    if used is None:
        used = (True, shots.slopes != waveform.SIGNS, True)
    up, doppler, down = (
        np.inf
        if s is None or not there
        else np.hypot(beat_deviation(cnr=more * s.cnr, samples=length, sample_rate=rate), walk)
        / looks
        for s, there, length in zip(view.signals, used, lengths.tolist(), strict=True)
    )
    return resolved_deviation(
        up=up, doppler=doppler, down=down, carriers=_carriers(shots, i),
        chirp_rate=_at(shots.chirp_rate, i), range=shots.range[i],
        radial_velocity=shots.radial_velocity[i], slopes=shots.slopes,
    )  # fmt: skip


def _errors(
    view: View, found: Sequence[Found], detected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute reported less true range [m] and radial velocity [m/s], (m,) each.

    By the segments (3, m) that are detected; up, Doppler and down beat are resolved as ever.
    """
    shots, i = view.shots, view.i
    width = view.setting.sample_rate / view.setting.fft_size
    up, doppler, down = (segment.frequency * width for segment in found)
    reported = waveform.resolve(
        up=up, doppler=doppler if shots.segments[1] else None, down=down,
        carrier=_carriers(shots, i)[0],
        bandwidth=_at(shots.bandwidth, i), duration=_at(shots.duration, i),
        sample_rate=shots.sample_rate[i], bin_width=np.asarray(width), assumed=shots.two_beats,
        signed=shots.complex_record,
    )  # fmt: skip
    velocity = reported.radial_velocity * (1 + _at(shots.slowing, i))
    walked = _at(shots.walk, i) * velocity  # within the shot
    metres = reported.range + walked
    fitted = shots.slopes != waveform.SIGNS or (shots.any_two & ~detected.all(axis=0))
    if np.any(fitted):
        cnr = np.array([[0.0 if s is None else s.cnr] for s in view.signals])
        own = fit(shots, np.array([up, doppler, down]), detected * cnr, np.array([i]))
        metres = np.where(fitted, own.range, metres)
        velocity = np.where(fitted, own.radial_velocity, velocity)
    return metres - shots.range[i], velocity - shots.radial_velocity[i]


def _carriers(shots: Shots, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    up, doppler, down = (_at(carrier, i) for carrier in shots.carriers)
    return up, doppler, down


def _at(column: np.ndarray | float, i: int) -> np.ndarray:
    """Point i of a column that may be one value for all."""
    column = np.asarray(column)
    return np.asarray(column[i] if column.ndim else column)
