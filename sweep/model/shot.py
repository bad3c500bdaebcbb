"""Shots, one or many: parameters in, detection and false-alarm statistics out.

Bare shots, then the effects that are needed, one by one.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace

import numpy as np

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import any_two
from sweep.model.effects.catalogue import CORE, DEFAULTS, EFFECTS, NAMES, SHARED
from sweep.model.effects.effect import Effect, Scene
from sweep.model.ground import Cast, Ground, Plane
from sweep.model.looks import fading_any_two
from sweep.model.marcum import log_any, log_at_least_one
from sweep.model.outputs import WITHOUT_ECHO
from sweep.model.preparation import Parameters, Shots, as_arrays, bare, require_finite
from sweep.model.quadratures import mean_over_angles
from sweep.model.resolution import resolved_categories
from sweep.model.segments import find
from sweep.model.strongest import outcomes

__all__ = ["Parameters", "Shots", "evaluate", "find", "prepare", "report", "statistics"]


def nodes(effects: Collection[str]) -> tuple[Effect, ...]:
    """Effects by name in the order in which they act; a ValueError for names that no effect has."""
    if unknown := sorted(set(effects) - set(NAMES)):
        raise ValueError(f"no effect {', '.join(unknown)}: choose from {', '.join(NAMES)}")
    return tuple(effect for effect in EFFECTS if effect.name in effects)


def prepare(
    parameters: Parameters, effects: Collection[str] = CORE
) -> Iterator[tuple[np.ndarray, Shots]]:
    """Shots on a flat plane, split by category: (indices, :class:`Shots`) for each.

    Parameters by dotted path are SI scalars, strings or (n,) arrays: all of instrument, target,
    footprint and accuracy, and those of effects that are not at their defaults.
    """
    for index, p in resolved_categories(DEFAULTS | dict(parameters), effects, SHARED):
        plane = Plane(p, index.size, moving="doppler_spread" in effects)
        shots = assembled(p, index.size, plane, effects)
        yield index, replace(shots, alike=True)


def prepare_cast(
    parameters: Parameters,
    ground: Cast,
    effects: Collection[str] = CORE,
    flags: np.ndarray | None = None,
) -> Shots:
    """Shots whose footprints are given, all of one category, parameters as of :func:`prepare`.

    Ranges and radial velocities are those of the beam's centre; grazing angle and law are not
    looked at. `flags` (n,) uint32 are of the effects that each shot has, where that are not all of
    them; they may differ in those that are not computed
    :attr:`~sweep.model.effects.effect.Effect.apart`.
    """
    p = as_arrays(DEFAULTS | dict(parameters))
    return assembled(p, ground.beamlets.row.size, ground, effects, flags)


def assembled(
    p: Mapping[str, np.ndarray],
    size: int,
    ground: Ground,
    effects: Collection[str],
    flags: np.ndarray | None = None,
) -> Shots:
    """Bare shots with the effects put to them, but for random ones."""
    scene = Scene(p, ground, {} if flags is None else _where(effects, flags))
    shots = bare(p, size, ground)
    for effect in nodes(effects):
        if effect.act is not None:
            shots = effect.act(shots, scene)
    require_finite(shots)
    return shots


def _where(effects: Collection[str], flags: np.ndarray) -> dict[str, np.ndarray]:
    """Of effects that not all points have: 1.0 for those that do, else 0.0."""
    lacking = int(np.bitwise_or.reduce(~flags)) if flags.size else 0
    return {
        effect.name: (flags >> k & 1).astype(float)
        for k, effect in enumerate(EFFECTS)
        if effect.name in effects and not effect.apart and lacking >> k & 1
    }


def evaluate(
    parameters: Parameters,
    effects: Collection[str] = CORE,
    *,
    look: Callable[[Shots], np.ndarray] = find,
) -> dict[str, np.ndarray]:
    """Statistics of n shots on a flat plane: (n,) by name in :data:`sweep.model.outputs.OUTPUTS`.

    Parameters as of :func:`prepare`; `look` finds the peaks in the spectra, by :func:`find` or
    another way to the same.
    """
    groups = list(prepare(parameters, effects))
    if len(groups) == 1:
        return statistics(groups[0][1], look(groups[0][1]))
    size = sum(index.size for index, _ in groups)
    results: dict[str, np.ndarray] = {}
    for index, shots in groups:
        for name, values in statistics(shots, look(shots)).items():
            results.setdefault(name, np.full(size, np.nan))[index] = values
    return results


def statistics(shots: Shots, found: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Compute outputs of prepared shots, each (n,); nan for what is unknown without an echo.

    ``found`` is the result of :func:`find`, if that is known.
    """
    found = find(shots) if found is None else found
    pd, miss, magnitude, _, exempted, leakage = np.moveaxis(found, 1, 0)
    snr = shots.snr(magnitude)
    alarms = _false_alarms(shots, exempted)
    reported = report(shots, found)
    wrong_range, wrong_velocity = misread(shots, reported)
    pd_shot, miss_shot = chances(shots, pd, miss, magnitude)
    results = {
        f"{name}_{segment}": values[s]
        for name, values in {"pd": pd, "miss": miss, "snr": snr}.items()
        for s, segment in enumerate(waveform.SEGMENTS)
    } | {
        "pd_shot": pd_shot,
        "miss_shot": miss_shot,
        **alarms,
        "p_leakage_up": leakage[0],
        "p_leakage_down": leakage[2],
        "beamlets": np.full(shots.size, float(shots.offset.shape[1])),
        "beamlets_error": shots.beamlets_error + np.zeros(shots.size),
        "noise_variance": shots.noise_variance,
        "range_error": reported.range - shots.range,
        "radial_velocity_error": reported.radial_velocity - shots.radial_velocity,
        "misread": (wrong_range | wrong_velocity).astype(float),
    }
    if shots.any_two:
        results["pd_both_chirps"] = shots.both(pd[0], pd[2], (magnitude[0], magnitude[2]))
    if shots.peaks == waveform.STRONGEST:
        results |= outcomes(shots, pd, miss, magnitude)
        # Both peaks are the echo's, and they are read as another range.
        right = np.where(wrong_range, results["pd_shot"], 0.0)
        results["p_wrong_range_shot"] = results["p_wrong_range_shot"] + right
    dark = (shots.echo_power == 0) | np.isnan(found[shots.segments, 3]).any(axis=0)
    return results | {name: np.where(dark, np.nan, results[name]) for name in WITHOUT_ECHO}


def chances(
    shots: Shots, pd: np.ndarray, miss: np.ndarray, magnitudes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities that a shot is detected, and that it is missed, (n,).

    By the segments' own probabilities and |X| of their bins [V], (3, n) each.
    """
    if shots.any_two:
        if shots.fading is None:
            return any_two(pd, miss), any_two(miss, pd)
        level = shots.threshold / shots.line_deviation
        if shots.looks.several:
            in_looks = shots.look_speckle
            alike = np.abs(np.array(shots.fading)) if in_looks is None else in_looks.between
            signals = magnitudes / shots.line_deviation
            return shots.looks.faded_any_two(signals, level, alike, pd, in_looks)
        alike = np.abs(np.array(shots.fading))
        found, missed = fading_any_two(pd, miss, level, alike)
        speckle = shots.speckle_table
        near = np.flatnonzero(speckle.row.any(axis=0))
        if near.size:
            level = np.broadcast_to(level, shots.size)[near]
            alike = alike[:, near]
            found[near], missed[near] = mean_over_angles(
                speckle.factors[speckle.row[:, near]],
                tuple(pd[:, near]),
                lambda *pd: fading_any_two(np.array(pd), 1 - np.array(pd), level, alike),
            )
        return found, missed
    both = shots.both(pd[0], pd[2], (magnitudes[0], magnitudes[2]))
    missed = miss[0] + pd[0] * miss[2]
    if shots.fading is not None:
        missed = miss[0] + np.maximum(pd[0] - both, 0.0)
    return both, np.minimum(missed, 1.0)  # of roundings


def report(shots: Shots, found: np.ndarray) -> waveform.Resolution:
    """Range and radial velocity that the peaks of the segments report."""
    frequency, weight = found[:, 3], found[:, 2] ** 2
    if shots.slopes != waveform.SIGNS:
        return fit(shots, frequency, np.where(shots.segments[:, None], weight, 0.0))
    return waveform.resolve(
        up=frequency[0],
        doppler=frequency[1] if shots.segments[1] else None,
        down=frequency[2],
        carrier=shots.carriers[0],
        bandwidth=shots.bandwidth,
        duration=shots.duration,
        sample_rate=shots.sample_rate,
        bin_width=shots.sample_rate / shots.fft_size,
        signed=shots.complex_record,
        assumed=shots.two_beats,
    )


MISREAD_BINS = 4
"""Bins of range or velocity by which what is read of an echo may be off: roundings of three peaks,
and motion between and within records."""


def misread(shots: Shots, reported: waveform.Resolution) -> np.ndarray:
    """Find where peaks without noise are read as another range or velocity than the echo's.

    Result (2, n) bool: of range and of velocity. The footprint's own extent, and what the target
    does between and within records, are none of it. Beats beyond half the sample rate fold, and
    readings by an assumption may be wrong.
    """
    bins = MISREAD_BINS * shots.sample_rate / shots.fft_size
    rows, last = shots.row, max(float(np.max(start)) for start in shots.schedule)
    time = last + np.asarray(shots.duration) + np.abs(shots.walk)
    moved = (np.abs(shots.approach) + np.abs(shots.radial_velocity)) * time
    moved = moved + np.abs(shots.acceleration) * time * time
    # An acceleration shifts beats between segments, which read as range and as velocity.
    shifted = np.abs(shots.acceleration) * time
    carrier = np.asarray(shots.carriers[0])
    per_metre = shots.chirp_rate * 2 / SPEED_OF_LIGHT
    metres = (bins + 2 * carrier / SPEED_OF_LIGHT * shifted) / per_metre + moved
    metres = metres + np.abs(shots.offset).max(axis=1)[rows] * shots.range
    own = SPEED_OF_LIGHT / 2 * np.abs(shots.doppler).max(axis=1)[rows]
    metres = metres + 2 * carrier / SPEED_OF_LIGHT * own / per_metre
    with np.errstate(divide="ignore"):  # a carrier of 0, of direct detection, tells no velocity
        per_hertz = SPEED_OF_LIGHT / (2 * carrier)
    speed = (bins + per_metre * metres) * per_hertz + shifted + own
    return np.array([
        np.abs(reported.range - shots.range) > metres,
        np.abs(reported.radial_velocity - shots.radial_velocity) > speed,
    ])  # fmt: skip


def fit(
    shots: Shots, peaks: np.ndarray, weights: np.ndarray, point: np.ndarray | slice = slice(None)
) -> waveform.Resolution:
    """Range and radial velocity at the shot's start, by :func:`sweep.model.waveform.fit`.

    Frequencies of peaks [Hz] by segment, (3, n), and weights, 0 where a segment is not detected;
    ``point`` says which point each is of.
    """
    carriers, rates = shots.beats_by_motion
    rate = np.broadcast_to(shots.sample_rate, (shots.size,))[point]
    return waveform.fit(
        peaks, weights=weights, carriers=carriers[:, point], rates=rates[:, point],
        sample_rate=rate, bin_width=rate / shots.fft_size, signed=shots.complex_record,
        assumed=shots.two_beats,
    )  # fmt: skip


def _false_alarms(shots: Shots, exempted: np.ndarray) -> dict[str, np.ndarray]:
    """Compute noise's Pfa in a bin, the up-chirp, both chirps and any segment, with log10."""
    log_bin = shots.looks.log_alarm(shots.threshold / shots.bin_deviation)
    exists = shots.segments[:, None]
    counted = np.where(exists, shots.counted_bins(np.where(exists, exempted, 0.0)), 0.0)
    up, doppler, down = log_at_least_one(log_bin, counted)
    logs = {"bin": log_bin, "segment": up, "both_chirps": up + down}
    logs["shot"] = log_any(log_any(up, doppler), down)
    return {f"pfa_{name}": np.exp(value) for name, value in logs.items()} | {
        f"log10_pfa_{name}": value / np.log(10) for name, value in logs.items()
    }
