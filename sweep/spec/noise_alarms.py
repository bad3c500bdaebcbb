"""False-alarm probabilities of a study due to noise alone, and advice on how to reduce them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.detection.detectors import DETECTORS, FIXED_THRESHOLD_KIND
from sweep.model.detection.estimators import DETECTOR_PREFIX
from sweep.model.detection.looks import Looks
from sweep.model.detection.noise_false_alarms import bin_pfa, n_alarm_equivalent_bins, segment_pfa
from sweep.model.threshold import THRESHOLD_PATHS, tnr_from_parameters

if TYPE_CHECKING:
    from sweep.spec import GridSpec, SceneSpec

PFA_SHOT_WARNING_ABOVE = 0.01
"""False-alarm probability of a shot, due to noise, above which the user is warned."""

SAMPLED_AXIS_COMBINATIONS_MAX = 400
"""Approximate largest number of combinations for which false-alarm probabilities are computed.

A combination has one value from each axis over fields of ``instrument.processing``.
"""


class ShotFalseAlarmProbabilities(NamedTuple):
    """Probabilities of false alarms of a shot, due to noise alone."""

    either_chirp: float
    """Probability that noise raises a false alarm in the up-chirp, the down-chirp or both."""
    both_chirps: float
    """Probability that noise raises a false alarm in the up-chirp and in the down-chirp."""


def false_alarm_probabilities(spec: GridSpec | SceneSpec) -> list[ShotFalseAlarmProbabilities]:
    """Compute a shot's false-alarm probabilities, due to noise alone, over a study's axes.

    Parameters
    ----------
    spec : GridSpec or SceneSpec
        Study. Its axes over ``instrument.processing`` are sampled evenly, about 400 combinations in
        all.

    Returns
    -------
    list of ShotFalseAlarmProbabilities
        Probabilities for each sampled combination. Combinations with a user-defined detector are
        left out.

    Notes
    -----
    Noise in the up- and down-chirp is independent, so that the probability of a false alarm in both
    chirps is the product of the two. A chirp's probability follows from that of a bin and the
    number of independent bins that raise as many alarms (`n_alarm_equivalent_bins`).
    """
    axes = [
        axis for axis in spec.axes
        if any(member.path.startswith("instrument.processing.") for member in axis.parameters)
    ]  # fmt: skip
    samples_per_axis = max(2, int(SAMPLED_AXIS_COMBINATIONS_MAX ** (1 / max(len(axes), 1))))
    probabilities = []
    sampled_indices = (
        np.linspace(0, axis.size - 1, min(axis.size, samples_per_axis)).astype(int) for axis in axes
    )
    for indices in product(*sampled_indices):
        parameters = spec.parameters()
        for axis, index in zip(axes, indices, strict=True):
            parameters |= {member.path: member.values[index] for member in axis.parameters}
        kind = parameters.get("instrument.processing.detector.kind", FIXED_THRESHOLD_KIND)
        if kind == FIXED_THRESHOLD_KIND:
            pfa_bin = bin_pfa(
                float(tnr_from_parameters(parameters)), Looks.from_parameters(parameters)
            )
        elif kind in DETECTORS:
            pfa_bin = float(parameters["instrument.processing.detector.pfa"])
        else:
            continue
        n_bins_up, n_bins_down = (
            float(n_alarm_equivalent_bins(parameters, pfa_bin, segment))
            for segment in ("up", "down")
        )
        pfa_up, pfa_down, pfa_any = (
            float(segment_pfa(np.asarray(pfa_bin), bins))
            for bins in (n_bins_up, n_bins_down, n_bins_up + n_bins_down)
        )
        probabilities.append(ShotFalseAlarmProbabilities(pfa_any, pfa_up * pfa_down))
    return probabilities


def iter_false_alarm_warnings(spec: GridSpec | SceneSpec) -> Iterator[str]:
    """Yield one warning, a sentence, if noise alone raises false alarms in over 1 % of the shots.

    The sentence states the largest probability over the study's axes, and the fields to change.
    Nothing is yielded if the probability is 1 % or less.
    """
    pfa_max = max((pfa.either_chirp for pfa in false_alarm_probabilities(spec)), default=0.0)
    if pfa_max > PFA_SHOT_WARNING_ABOVE:
        yield (
            f"noise alone raises a false alarm in either chirp with probability {pfa_max:.3g} "
            f"(more than {PFA_SHOT_WARNING_ABOVE:g}): {false_alarm_remedy(spec)}"
        )


def false_alarm_remedy(spec: GridSpec | SceneSpec) -> str:
    """Return advice on the fields to change for fewer false alarms, such as ``raise ...tnr``.

    A study with both fixed and adaptive thresholds has one clause for each, joined by ``and``.
    """
    parameters, kind_path = spec.parameters(), f"{DETECTOR_PREFIX}kind"
    values_by_path = {
        member.path: member.values for axis in spec.axes for member in axis.parameters
    }
    kinds = {
        str(name)
        for name in values_by_path.get(kind_path, [parameters.get(kind_path, FIXED_THRESHOLD_KIND)])
    }
    remedies = []
    if FIXED_THRESHOLD_KIND in kinds:
        (threshold_path,) = (
            threshold_path
            for threshold_path in THRESHOLD_PATHS
            if parameters.get(threshold_path) is not None
        )
        remedies.append(f"{'lower' if 'pfa' in threshold_path else 'raise'} {threshold_path}")
    if kinds & set(DETECTORS) - {FIXED_THRESHOLD_KIND}:
        remedies.append(f"lower {DETECTOR_PREFIX}pfa")
    return " and ".join(remedies)
