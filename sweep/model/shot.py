"""One shot, or many: parameters in, detection and false-alarm statistics out.

This module composes; the physics is in the others.
"""

from collections.abc import Callable, Collection

import numpy as np

from sweep.model import waveform
from sweep.model.chain import prepare
from sweep.model.effects.catalogue import CORE
from sweep.model.marcum import log_at_least_one
from sweep.model.outputs import WITHOUT_ECHO
from sweep.model.preparation import Parameters, Shots
from sweep.model.segments import find

__all__ = ["Parameters", "Shots", "evaluate", "find", "prepare", "report", "statistics"]


def evaluate(
    parameters: Parameters,
    effects: Collection[str] = CORE,
    *,
    look: Callable[[Shots], np.ndarray] = find,
) -> dict[str, np.ndarray]:
    """Statistics of n shots on a flat plane.

    Parameters
    ----------
    parameters, effects
        As of :func:`sweep.model.chain.prepare`.
    look
        What finds the peaks in the spectra, :func:`find` or another way to the same.

    Returns
    -------
    dict of (n,) ndarray
        One entry per name in :data:`sweep.model.outputs.OUTPUTS`.
    """
    groups = list(prepare(parameters, effects))
    if len(groups) == 1:
        return statistics(groups[0][1], look(groups[0][1]))
    size = sum(index.size for index, _ in groups)
    results: dict[str, np.ndarray] = {}
    for index, shots in groups:
        for name, values in statistics(shots, look(shots)).items():
            results.setdefault(name, np.empty(size))[index] = values
    return results


def statistics(shots: Shots, found: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Outputs of prepared shots, each (n,); without an echo, nan for what is then unknown.

    ``found`` is what :func:`find` finds, if that is known.
    """
    found = find(shots) if found is None else found
    pd, miss, magnitude, _, exempted, leakage = np.moveaxis(found, 1, 0)
    snr = (magnitude / shots.bin_deviation) ** 2 / 2
    alarms = _false_alarms(shots, exempted)
    reported = report(shots, found)
    results = {
        "pd_up": pd[0],
        "pd_down": pd[2],
        "pd_doppler": pd[1],
        "pd_shot": pd[0] * pd[2],
        "miss_up": miss[0],
        "miss_down": miss[2],
        "miss_doppler": miss[1],
        "miss_shot": miss[0] + pd[0] * miss[2],
        **alarms,
        "p_leakage_up": leakage[0],
        "p_leakage_down": leakage[2],
        "snr_up": snr[0],
        "snr_down": snr[2],
        "snr_doppler": snr[1],
        "beamlets": np.full(shots.size, float(shots.offset.shape[1])),
        "beamlets_error": shots.beamlets_error + np.zeros(shots.size),
        "noise_variance": shots.noise_variance,
        "range_error": reported.range - shots.range,
        "radial_velocity_error": reported.radial_velocity - shots.radial_velocity,
    }
    dark = shots.echo_power == 0
    return results | {name: np.where(dark, np.nan, results[name]) for name in WITHOUT_ECHO}


def report(shots: Shots, found: np.ndarray) -> waveform.Resolution:
    """Range and radial velocity that the peaks of the three segments report."""
    frequency = found[:, 3]
    return waveform.resolve(
        up=frequency[0],
        doppler=frequency[1] if shots.segments[1] else np.zeros_like(frequency[0]),
        down=frequency[2],
        carrier=shots.carriers[0],
        bandwidth=shots.bandwidth,
        duration=shots.duration,
        sample_rate=shots.sample_rate,
        bin_width=shots.sample_rate / shots.fft_size,
    )


def _false_alarms(shots: Shots, exempted: np.ndarray) -> dict[str, np.ndarray]:
    """False alarms of noise alone: per bin, per (up-chirp) segment, per shot, with log10."""
    log_bin = -0.5 * (shots.threshold / shots.bin_deviation) ** 2
    counted = shots.counted_bins(exempted)
    log_up = log_at_least_one(log_bin, counted[0])
    log_down = log_at_least_one(log_bin, counted[2])
    logs = {"bin": log_bin, "segment": log_up, "shot": log_up + log_down}
    return {f"pfa_{name}": np.exp(value) for name, value in logs.items()} | {
        f"log10_pfa_{name}": value / np.log(10) for name, value in logs.items()
    }
