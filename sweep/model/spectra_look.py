"""A detector and an estimator of frequency at work on draws of one shot.

Each draw of a shot has a spectrum with noise in every bin for each of its segments
(:mod:`sweep.model.noisy_spectra`). The detector flags bins of |X|^2. A segment is detected where it
flags the strongest bin of the signal or one of the two beside it; adjacent flagged bins form a
group, and a group outside the bins that the signal occupies is a false alarm. The estimator is
given the spectrum and the largest bin of the detected group. Where all segments are detected, their
frequencies are resolved into range and radial velocity.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model import noisy_spectra, waveform
from sweep.model.cramer_rao import Deviation, resolved_deviation
from sweep.model.detectors import DETECTORS, FIXED, Detector
from sweep.model.estimators import ESTIMATORS, PEAK_BIN, Estimator
from sweep.model.noisy_spectra import Signal
from sweep.model.preparation import Parameters, Shots
from sweep.model.processing import Setting

DETECTOR, ESTIMATOR = "instrument.processing.detector.", "instrument.processing.estimator."
DEFAULTS: dict[str, float | int | str] = {
    DETECTOR + "kind": FIXED,
    DETECTOR + "training": 32,
    DETECTOR + "guard": 4,
    DETECTOR + "rank": 0,
    DETECTOR + "pfa": 1e-6,
    ESTIMATOR + "kind": PEAK_BIN,
}

VALUES = ("pfa_bin", "false_alarms", "range", "radial_velocity", "range_2", "radial_velocity_2")
"""What is averaged over draws; the last two are squares of bounds."""


class Methods(NamedTuple):
    """Detectors and estimators by name: those of the program, and any others."""

    detectors: Mapping[str, Detector] = DETECTORS
    estimators: Mapping[str, Estimator] = ESTIMATORS


class View(NamedTuple):
    """A shot, and how it is looked at."""

    shots: Shots
    i: int
    """Which of the shots."""
    key: np.ndarray
    """(2,) uint64: random key of the point."""
    signals: tuple[Signal | None, ...]
    """By segment; None for one that does not exist."""
    setting: Setting
    detect: Detector
    estimate: Estimator


class Found(NamedTuple):
    """What is found in a segment of m draws, (m,) each."""

    detected: np.ndarray
    alarms: np.ndarray
    """Groups outside the signal."""
    flagged: np.ndarray
    """Bins in them."""
    frequency: np.ndarray
    """[bins]"""


def view_of(shots: Shots, i: int, p: Parameters, key: np.ndarray, methods: Methods) -> View:
    """View of one of some shots, by the parameters p of its point (:data:`DEFAULTS`)."""
    setting = noisy_spectra.setting_of(
        shots, i, training=int(p[DETECTOR + "training"]), guard=int(p[DETECTOR + "guard"]),
        rank=int(p[DETECTOR + "rank"]), pfa=float(p[DETECTOR + "pfa"]),
    )  # fmt: skip
    signals = tuple(
        noisy_spectra.signal_of(shots, i, s) if there else None
        for s, there in enumerate(shots.segments)
    )
    return View(
        shots, i, key, signals, setting, methods.detectors[str(p[DETECTOR + "kind"])],
        methods.estimators[str(p[ESTIMATOR + "kind"])],
    )  # fmt: skip


def look(spectra: np.ndarray, signal: Signal, view: View) -> Found:
    """What is found in spectra (m, N/2 + 1) of a segment."""
    power = spectra.real**2 + spectra.imag**2
    flags = view.detect(power, view.setting)
    detected, alarms, flagged, peak = np.zeros((4, len(spectra)), np.int64)
    _judge(
        flags, power, (signal.strongest, signal.first, signal.last), detected, alarms, flagged, peak
    )
    return Found(detected > 0, alarms, flagged, view.estimate(spectra, peak, view.setting))


def counted(view: View, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts of some draws, and what is averaged over them.

    Returns
    -------
    counts : (names, m) int64 ndarray
        By the names of DRAW_OUTPUTS.
    values : (names, m) ndarray
        By those of VALUES; nan where there is none.
    """
    nothing = np.zeros(draws.size, np.int64)
    found = [Found(nothing > 0, nothing, nothing, np.zeros(draws.size))] * 3
    searched = 0
    for s, signal in enumerate(view.signals):
        if signal is not None:
            spectra = noisy_spectra.noisy_spectra(
                view.shots, view.i, s, signal, key=view.key, draws=draws
            )
            found[s] = look(spectra, signal, view)
            searched += view.setting.fft_size // 2 - 1 - max(signal.last - signal.first + 1, 0)
    up, doppler, down = found
    both, alarm = up.detected & down.detected, (up.alarms > 0, down.alarms > 0)
    counts = np.array([
        up.detected, down.detected, doppler.detected, both, *alarm, alarm[0] & alarm[1]
    ], np.int64)  # fmt: skip
    flagged, alarms = sum(f.flagged for f in found), sum(f.alarms for f in found)
    least = resolved_bound(view)
    squares = [np.full(draws.size, bound**2) for bound in least]
    whole = both & (doppler.detected | (view.signals[1] is None))
    errors = [np.where(whole, error, np.nan) for error in _errors(view, found)]
    return counts, np.array([flagged / max(searched, 1), alarms, *errors, *squares])


def resolved_bound(view: View) -> Deviation:
    """Cramer-Rao bound of range and velocity that are resolved from up and down beat."""
    shots, i = view.shots, view.i
    up, _, down = (
        np.inf if signal is None else noisy_spectra.beat_bound(shots, i, np.asarray(signal.cnr))
        for signal in view.signals
    )
    return resolved_deviation(
        up=up, doppler=np.inf, down=down, carriers=_carriers(shots, i),
        chirp_rate=_at(shots.chirp_rate, i), range=shots.range[i],
        radial_velocity=shots.radial_velocity[i],
    )  # fmt: skip


def _errors(view: View, found: Sequence[Found]) -> tuple[np.ndarray, np.ndarray]:
    """Reported less true range [m] and radial velocity [m/s], (m,) each."""
    shots, i = view.shots, view.i
    width = view.setting.sample_rate / view.setting.fft_size
    up, doppler, down = (segment.frequency * width for segment in found)
    reported = waveform.resolve(
        up=up, doppler=doppler, down=down, carrier=_carriers(shots, i)[0],
        bandwidth=_at(shots.bandwidth, i), duration=_at(shots.duration, i),
        sample_rate=shots.sample_rate[i], bin_width=np.asarray(width),
    )  # fmt: skip
    walked = _at(shots.walk, i) * reported.radial_velocity  # within the record
    return (
        reported.range + walked - shots.range[i],
        reported.radial_velocity - shots.radial_velocity[i],
    )


def _carriers(shots: Shots, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    up, doppler, down = (_at(carrier, i) for carrier in shots.carriers)
    return up, doppler, down


def _at(column: np.ndarray | float, i: int) -> np.ndarray:
    """Point i of a column that may be one value for all."""
    column = np.asarray(column)
    return np.asarray(column[i] if column.ndim else column)


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(flags, power, places, detected, alarms, flagged, peak):
    """Whether the signal is among the flagged bins, where its peak is, and what else is flagged."""
    bins = flags.shape[1]
    strongest, first, last = places
    for row in range(flags.shape[0]):
        hit, best = -1, -1.0
        for k in range(max(strongest - 1, 1), min(strongest + 2, bins - 1)):
            if flags[row, k] and power[row, k] > best:
                hit, best = k, power[row, k]
        detected[row] = hit >= 0
        peak[row] = _largest(flags[row], power[row], hit)
        inside, number = False, 0  # of the group that is being walked through
        for k in range(1, bins):
            if k < bins - 1 and flags[row, k]:
                number += 1
                inside |= first <= k <= last
            elif number:
                if not inside:
                    alarms[row] += 1
                    flagged[row] += number
                inside, number = False, 0


@njit(cache=True, nogil=True, error_model="numpy")
def _largest(flags, power, hit):
    """Largest bin of the group of a flagged bin; of all but DC and Nyquist where there is none."""
    low, high = 1, power.size - 2
    if hit >= 0:
        low, high = hit, hit
        while low > 1 and flags[low - 1]:
            low -= 1
        while high < power.size - 2 and flags[high + 1]:
            high += 1
    return low + np.argmax(power[low : high + 1])
