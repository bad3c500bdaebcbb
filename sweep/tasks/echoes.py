"""Echoes of a study that arrive late, are read as another range, or walk in phase, in words.

A record begins at the acquisition delay and ends fft_size samples later, or where the chirp does.
An echo is there from 2 R / c on. Beats beyond half the sample rate fold, and the readings of three
peaks, or of two by an assumption, then give another range. Both follow from a few parameters, so
they are told of a whole grid, and of shots spread over a flight, before anything runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import beam, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULTS
from sweep.model.effects.points import missing_of
from sweep.model.estimators import ESTIMATOR
from sweep.model.preparation import CHIRP, LASER, PROCESSING, RECEIVER, RECORD, categories
from sweep.model.shot import MISREAD_BINS
from sweep.model.window import canonical_name, window
from sweep.tasks.flight_study import FlightStudy

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.tasks.grid_study import GridStudy

LOSS_DB = 3.0
"""Loss of an echo's power beyond which is warned of."""

WALK_DELAY, WALK_PHASE = 0.125, 0.3
"""Delay over the record's duration, and variance of the laser's phase over it [rad^2], beyond which
a random walk leaves more than 0.02 of error in probabilities of detection."""

POINTS_MAX = 200_000
"""Points of the grid of the parameters that matter; of larger grids so many, spread over them."""

FLIGHT_TILES = 16
"""Tiles of a flight's shots that are looked at, of each scanner."""

ENDS_SPREAD, ENDS_REACH, ENDS_DEVIATIONS = 0.2, 4.0, 3.0
"""Deviation of a footprint's lines [bins of fs/L] beyond which an echo that any bin detects is not
one line. With the bins and deviations within which such an echo lies across DC or Nyquist."""

PARAMETERS = (
    "target.range", "target.radial_velocity", LASER + "wavelength", CHIRP + "bandwidth",
    CHIRP + "duration", CHIRP + "start_frequency", waveform.ORDER, waveform.DOPPLER_SLOPE,
    waveform.DOWN_SLOPE, PROCESSING + "acquisition_delay", PROCESSING + "sample_rate",
    PROCESSING + "fft_size", PROCESSING + "window", waveform.TWO_BEATS, RECORD,
    RECEIVER + "architecture", LASER + "line_width", LASER + "line_shape",
    PROCESSING + "detection", "footprint.speckle", "footprint.phases", "target.grazing_angle",
    "target.transverse_velocity", beam.WAIST, beam.RECEIVED_WAIST, beam.DIVERGENCE, beam.QUALITY,
    beam.FOCUS, beam.COUPLING,
)  # fmt: skip
"""Parameters by which echoes arrive and are read."""


PHASE_LOSS = 0.03
"""Share of the window's sum that an echo may lack for places by the phases of bins to be within
some 0.02 bin. Half a record without an echo sets them off by up to 0.6 bin."""

PHASE_ESTIMATORS = ("jacobsen", "candan")
"""Estimators that take the phases of neighbouring bins for those of a whole record."""


class Echoes(NamedTuple):
    """Echoes of n points."""

    range: np.ndarray
    """(n,) [m]."""
    lost: np.ndarray
    """(n,): share of the window's sum before the echo arrives, 0..1; 1: it never does."""
    misread: np.ndarray
    """(n,): true where its beats are read as another range or velocity."""
    walked: np.ndarray
    """(n,): true where the laser's phase walks further than the law of detection allows."""
    exchanged: np.ndarray
    """(n,): true where up and down beat alone are read with range and velocity exchanged, and would
    be read right by the other assumption of two beats."""
    other_exchanged: np.ndarray
    """(n,): likewise by the other assumption, where this one is right."""
    across_end: np.ndarray
    """(n,): true where an echo in developed speckle that any bin detects spreads over bins across
    DC or Nyquist."""


class Widths(NamedTuple):
    """Standard deviations over the beam of n footprints."""

    range: np.ndarray
    """[m]"""
    radial_velocity: np.ndarray
    """[m/s]"""

    @classmethod
    def on_plane(cls, p: Mapping[str, Any], range_: np.ndarray) -> Widths:
        """Return the widths of footprints on the plane of points of one category."""
        with np.errstate(all="ignore"):
            places, directions = beam.angles(p, range_)
            along = range_ * places / 4 / np.tan(p["target.grazing_angle"])
        across = np.abs(p["target.transverse_velocity"]) * directions / 4
        return cls(*(np.nan_to_num(v + 0 * range_) for v in (along, across)))

    @classmethod
    def on_ground(cls, eyepoints: Eyepoints) -> Widths:
        """Return the widths of footprints that rays have found; 0 where there are several surfaces.

        Surfaces at different ranges are echoes of their own.
        """
        weight = eyepoints.weight / eyepoints.weight.sum()
        found = []
        for values in (eyepoints.offset, eyepoints.velocity_offset):
            known = np.where(np.isfinite(values), values, 0.0)
            mean = (weight * known).sum(axis=1)[:, None]
            found.append(np.sqrt((weight * (known - mean) ** 2).sum(axis=1)))
        one = (eyepoints.surface == eyepoints.surface[:, :1]).all(axis=1)
        return cls(*(np.where(one, v, 0.0) for v in found))

    def of(self, points: np.ndarray) -> Widths:
        """Select points by their numbers."""
        return Widths(self.range[points], self.radial_velocity[points])


def echoes_of(parameters: Mapping[str, Any], widths: Widths | None = None) -> Echoes:
    """Find when the echoes of points arrive, and how their beats are read, without a footprint.

    ``widths`` are those of footprints on any ground; by default on a plane.
    """
    needed = {path: v for path, v in parameters.items() if path in PARAMETERS}
    number = max((np.size(value) for value in needed.values()), default=1)
    needed["target.range"] = np.broadcast_to(needed["target.range"], (number,))
    needed |= {path: DEFAULTS[path] for path in DEFAULTS if path not in needed}
    needed |= {"footprint.beamlets": 1}
    found = Echoes(*np.zeros((2, number)), *np.zeros((5, number), bool))
    for index, p in categories(needed):
        shape = window(canonical_name(str(p[PROCESSING + "window"])), int(p["record"]))
        range_, velocity = (p[name] for name in ("target.range", "target.radial_velocity"))
        first = waveform.samples_before_echo(
            delay=2 / SPEED_OF_LIGHT * range_, beta=0.0,
            start=p[PROCESSING + "acquisition_delay"],
            sample_rate=p[PROCESSING + "sample_rate"], length=shape.length,
        )  # fmt: skip
        found.range[index] = range_
        found.lost[index] = np.where(
            first >= shape.length, 1.0, np.minimum(missing_of(shape, first).lost, 1.0)
        )
        velocity = np.asarray(velocity)
        found.misread[index] = _is_misread(p, range_, velocity)
        if str(p[RECORD]) != "complex":
            assumed = str(p[waveform.TWO_BEATS])
            (other,) = {waveform.FAR_TARGET, waveform.FAST_TARGET} - {assumed}
            pair = {name: _is_misread(p, range_, velocity, name) for name in (assumed, other)}
            found.exchanged[index] = pair[assumed] & ~pair[other]
            found.other_exchanged[index] = pair[other] & ~pair[assumed]
        found.across_end[index] = _lies_across_end(
            p, range_, velocity, shape.length, None if widths is None else widths.of(index)
        )
        if str(p[LASER + "line_shape"]) == "lorentzian":
            delay, record = (
                2 / SPEED_OF_LIGHT * range_,
                shape.length / p[PROCESSING + "sample_rate"],
            )
            variance = 2 * np.pi * p[LASER + "line_width"] * np.minimum(delay, record)
            found.walked[index] = (delay > WALK_DELAY * record) & (variance > WALK_PHASE)
    return found


def _lies_across_end(
    p: Mapping[str, Any], range_: np.ndarray, velocity: np.ndarray, length: int,
    widths: Widths | None,
) -> np.ndarray:  # fmt: skip
    """Mark echoes of the kind of :attr:`Echoes.across_end`, (n,)."""
    rough = str(p["footprint.speckle"]) != "none" and str(p["footprint.phases"]) != "coherent"
    rough &= str(p[RECEIVER + "architecture"]) != "direct"
    if str(p[RECORD]) == "complex" or str(p[PROCESSING + "detection"]) != "any_bin" or not rough:
        return np.zeros(range_.shape, bool)
    widths = Widths.on_plane(p, range_) if widths is None else widths
    rate, width = (
        p[CHIRP + "bandwidth"] / p[CHIRP + "duration"],
        p[PROCESSING + "sample_rate"] / length,
    )
    there = waveform.order_of(str(p[RECEIVER + "architecture"]), str(p[waveform.ORDER]))
    found = np.zeros(range_.shape, bool)
    segments = zip(waveform.SEGMENTS, waveform.slopes_of(p), waveform.carriers_of(p), strict=True)
    for name, slope, carrier in segments:
        if name not in there:
            continue
        beat = waveform.beat_frequency(
            slope, carrier=carrier, chirp_rate=rate, range=range_, radial_velocity=velocity
        )
        turns = 2 * beat / p[PROCESSING + "sample_rate"]
        apart = np.abs(turns - np.rint(turns)) * length / 2
        spread = 2 / SPEED_OF_LIGHT * carrier * widths.radial_velocity
        spread = (spread + 2 / SPEED_OF_LIGHT * np.abs(slope) * rate * widths.range) / width
        found |= (spread > ENDS_SPREAD) & (apart < ENDS_REACH + ENDS_DEVIATIONS * spread)
    return found


def _is_misread(
    p: Mapping[str, Any], range_: np.ndarray, velocity: np.ndarray, pair_by: str | None = None
) -> np.ndarray:
    """Return true where a target's beats, as a spectrum shows them, tell another target, (n,).

    All its beats, or up and down beat alone, read by the assumption ``pair_by``.
    """
    carriers, slopes = waveform.carriers_of(p), waveform.slopes_of(p)
    rate = p[CHIRP + "bandwidth"] / p[CHIRP + "duration"]
    sample_rate, signed = p[PROCESSING + "sample_rate"], str(p[RECORD]) == "complex"
    width = sample_rate / int(p[PROCESSING + "fft_size"])
    there = waveform.order_of(str(p[RECEIVER + "architecture"]), str(p[waveform.ORDER]))
    if pair_by is not None:
        there = tuple(name for name in there if name != "doppler")
    peaks = []
    for slope, carrier in zip(slopes, carriers, strict=True):
        beat = waveform.beat_frequency(
            slope, carrier=carrier, chirp_rate=rate, range=range_, radial_velocity=velocity
        )
        turned = beat - sample_rate * np.floor(beat / sample_rate + 0.5)
        peaks.append((turned if signed else np.abs(turned)) + 0 * range_)
    assumed = pair_by or str(p[waveform.TWO_BEATS])
    if slopes == waveform.SIGNS:
        read = waveform.resolve(
            up=peaks[0], doppler=peaks[1] if "doppler" in there else None, down=peaks[2],
            carrier=carriers[0], bandwidth=p[CHIRP + "bandwidth"], duration=p[CHIRP + "duration"],
            sample_rate=sample_rate, bin_width=width, signed=signed, assumed=assumed,
        )  # fmt: skip
    else:
        shape = 3, range_.size
        weights = [float(name in there) for name in waveform.SEGMENTS]
        columns = [np.broadcast_to(carrier, range_.shape) for carrier in carriers]
        rates = [np.broadcast_to(slope * rate, range_.shape) for slope in slopes]
        read = waveform.fit(
            np.array(peaks), weights=np.broadcast_to(np.reshape(weights, (3, 1)), shape),
            carriers=np.array(columns), rates=np.array(rates),
            sample_rate=np.broadcast_to(sample_rate, range_.shape),
            bin_width=np.broadcast_to(width, range_.shape), signed=signed, assumed=assumed,
        )  # fmt: skip
    metres = MISREAD_BINS * width / (2 / SPEED_OF_LIGHT * rate)
    with np.errstate(divide="ignore"):  # a carrier of 0, of direct detection, tells no velocity
        speed = MISREAD_BINS * width * SPEED_OF_LIGHT / carriers[0]
    off = np.abs(read.range - range_) > metres
    return np.asarray(off | (np.abs(read.radial_velocity - velocity) > speed))


def warnings_of(study: GridStudy | FlightStudy) -> Iterator[str]:
    """Echoes that a study has not, has in part, or reads as others, a sentence each."""
    flight = isinstance(study, FlightStudy)
    echoes = _of_flight(study) if isinstance(study, FlightStudy) else _of_grid(study)
    if not echoes.range.size:
        return
    points, gated = "shots" if flight else "points", study.spec.modes()["overlap"] != "off"
    none = (echoes.lost >= 1) if gated else np.zeros(echoes.lost.shape, bool)
    if none.any():
        yield (
            f"no echo arrives before its record ends at {_share(none)} of the {points}, "
            f"{_where(none, echoes.range)}: nothing is detected there. A record lasts from "
            "processing.acquisition_delay for processing.fft_size samples, up to chirp.duration, "
            "and an echo arrives after 2R/c"
        )
    with np.errstate(divide="ignore"):
        weak = gated & ~none & (20 * np.log10(1 - np.minimum(echoes.lost, 1.0)) < -LOSS_DB)
    if weak.any():
        yield (
            f"echoes that arrive after their record has begun lose more than {LOSS_DB:g} dB at "
            f"{_share(weak)} of the {points}, {_where(weak, echoes.range, none)}: raise "
            "processing.acquisition_delay to the largest 2R/c, and chirp.duration with it"
        )
    shifted = gated & ~none & (echoes.lost > PHASE_LOSS)
    if (kinds := _phase_estimators(study)) and shifted.any():
        yield (
            f"instrument.processing.estimator.kind {' and '.join(kinds)} takes echoes for whole "
            f"records, and echoes begin within theirs at {_share(shifted)} of the {points}, "
            f"{_where(shifted, echoes.range, none)}: places there are off by up to half a bin. "
            "Take maximum_likelihood or chirp_z, or raise processing.acquisition_delay to the "
            "largest 2R/c, and chirp.duration with it"
        )
    wrong = echoes.misread & ~none
    if _reads_pairs(study):
        yield from _exchanged(study, echoes, none, points)
        wrong &= ~echoes.exchanged
    if wrong.any():
        yield (
            f"the peaks are read as another range or velocity at {_share(wrong)} of the {points}, "
            f"{_where(wrong, echoes.range, none)} (misread): beats beyond half the sample rate "
            "fold, and two beats are read by processing.two_beats. What is detected there has a "
            "wrong range or velocity: raise processing.sample_rate, or lower chirp.bandwidth over "
            "chirp.duration"
        )
    walked = echoes.walked & ~none & (study.spec.modes()["line_width"] != "off")
    if walked.any() and (study.spec.draws is None or study.spec.draws.method != "spectra"):
        yield (
            f"the laser's phase walks so far within the delay of the echo at {_share(walked)} of "
            f"the {points}, {_where(walked, echoes.range, none)}, that probabilities of detection "
            "may be off by up to 0.1: take draws.method: spectra, which draws the walk, or lower "
            "instrument.laser.line_width"
        )
    across = echoes.across_end & ~none & (study.spec.modes()["fading"] != "off")
    if across.any() and (study.spec.draws is None or study.spec.draws.method == "probabilities"):
        yield (
            "the speckle of the footprint spreads an echo over bins on both sides of DC or half "
            f"the sample rate at {_share(across)} of the {points}, "
            f"{_where(across, echoes.range, none)}: its probability of detection by any_bin may "
            "be up to 0.06 too high. Take draws.method: noise or spectra, which draw the bins, or "
            "instrument.processing.detection: peak_bin"
        )


def _phase_estimators(study: GridStudy | FlightStudy) -> list[str]:
    """List the estimators of a study that places of late echoes are wrong by."""
    path = f"{ESTIMATOR}kind"
    values = [m.values for axis in study.spec.axes for m in axis.members if m.path == path]
    kinds = values[0] if values else [study.spec.parameters().get(path)]
    return [kind for kind in PHASE_ESTIMATORS if kind in {str(name) for name in kinds}]


def _reads_pairs(study: GridStudy | FlightStudy) -> bool:
    """Return true if up and down beat alone tell range and velocity, always or now and then."""
    spec = study.spec
    p = DEFAULTS | dict(spec.parameters())
    alone = "doppler" not in waveform.order_of(
        str(p[RECEIVER + "architecture"]), str(p[waveform.ORDER])
    )
    return alone or isinstance(study, FlightStudy) or p[waveform.SHOT_DETECTION] == waveform.ANY_TWO


def _exchanged(
    study: GridStudy | FlightStudy, echoes: Echoes, none: np.ndarray, points: str
) -> Iterator[str]:
    """Yield at how many points the assumption of two beats is wrong, and whether to change it.

    Not where the target is fast at some points and far at others, and is taken to be fast.
    """
    wrong, other_wrong = echoes.exchanged & ~none, echoes.other_exchanged & ~none
    far = str((DEFAULTS | dict(study.spec.parameters()))[waveform.TWO_BEATS]) == waveform.FAR_TARGET
    if not wrong.any() or (not far and other_wrong.any()):
        return
    relation, other = ("exceeds", "fast") if far else ("is below", "far")
    if np.count_nonzero(other_wrong) < np.count_nonzero(wrong):
        remedy = f"write processing.two_beats: {other}"
        if other_wrong.any():
            remedy += f", which is wrong at {_share(other_wrong)} of the {points}"
    else:
        remedy = (
            f"{other} would be wrong at more of the {points}. Leave unconfirmed points out there, "
            "or raise chirp.bandwidth over chirp.duration"
        )
    yield (
        f"the Doppler shift {relation} the beat of the range at {_share(wrong)} of the {points}, "
        f"{_where(wrong, echoes.range, none)}, and processing.two_beats is "
        f"{'far' if far else 'fast'}: an up and a down beat that no Doppler beat confirms are read "
        f"there with range and velocity exchanged (misread): {remedy}"
    )


def _share(some: np.ndarray) -> str:
    return f"{100 * np.count_nonzero(some) / some.size:.3g} %"


def _where(some: np.ndarray, ranges: np.ndarray, dark: np.ndarray | None = None) -> str:
    """Ranges of some points: from one on where all beyond are among them, or are ``dark``."""
    if dark is not None and dark.any():
        some, ranges = some[~dark], ranges[~dark]
    low, high = ranges[some].min(), ranges[some].max()
    if some.all():
        return "at all ranges"
    if some[ranges >= low].all():
        return f"from {low:,.6g} m on"
    if some[ranges <= high].all():
        return f"up to {high:,.6g} m"
    return f"at ranges of {low:,.6g} to {high:,.6g} m"


def _of_grid(study: GridStudy) -> Echoes:
    axes = study.spec.axes
    sizes = [axis.size for axis in axes]
    used = [
        np.arange(axis.size if any(m.path in PARAMETERS for m in axis.members) else 1)
        for axis in axes
    ]
    number = int(np.prod([v.size for v in used], dtype=np.int64)) if used else 1
    few = np.arange(number)
    if number > POINTS_MAX:
        few = np.unique(np.linspace(0, number - 1, POINTS_MAX).astype(np.int64))
    if sizes:
        few = np.ravel_multi_index(np.unravel_index(few, [v.size for v in used]), sizes)
    return echoes_of(study.grid.parameters_at(few))


def _of_flight(study: FlightStudy) -> Echoes:
    from sweep.model.eyepoints import seen_ground
    from sweep.scenes.eyepoint_arrays import from_arrays

    found = []
    ends = {tuple(k * (int(axis.size) - 1) for axis in study.spec.axes) for k in (0, 1)}
    for eyepoints in study.eyepoint_studies():
        seen = from_arrays(eyepoints.cast(eyepoints.tiles(FLIGHT_TILES)), eyepoints.weight)
        there = seen.seen.nonzero()[0]
        if not there.size:
            continue
        for place in sorted(ends):
            part = study.scanners[eyepoints.scanner].first_part(place)
            parameters = DEFAULTS | dict(study.parameters_at(part))
            some = seen.some(there)
            shots, _ = seen_ground(some, parameters, study.surfaces)
            found.append(echoes_of(shots, Widths.on_ground(some)))
    return (
        Echoes(*map(np.concatenate, zip(*found, strict=True)))
        if found
        else Echoes(*[np.empty(0)] * 7)
    )
