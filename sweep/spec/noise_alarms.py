"""False alarms that noise alone raises in a study, and the fields to change for fewer."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.detectors import DETECTORS, FIXED
from sweep.model.estimators import DETECTOR
from sweep.model.looks import Looks
from sweep.model.noise_only import bin_probability, bins_counted, segment_probability
from sweep.model.threshold import WAYS, tnr_of

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

ALARM_PROBABILITY_MAX = 0.01
"""Probability of a false alarm in a shot beyond which a study is warned of."""

SETTINGS_MAX = 400
"""Thresholds, FFT sizes and detectors of a study that are computed, about."""


def alarms_of_study(study: Spec | SceneSpec) -> list[tuple[float, float]]:
    """Probabilities that noise raises an alarm in any chirp of a shot, and in both, 0..1.

    One pair for each of the thresholds, FFT sizes and detectors of a study, of which some
    hundreds are sampled; none for detectors of the user's own.
    """
    axes = [
        axis for axis in study.axes
        if any(member.path.startswith("instrument.processing.") for member in axis.members)
    ]  # fmt: skip
    most = max(2, int(SETTINGS_MAX ** (1 / max(len(axes), 1))))
    found = []
    along = (np.linspace(0, axis.size - 1, min(axis.size, most)).astype(int) for axis in axes)
    for place in product(*along):
        parameters = study.parameters()
        for axis, index in zip(axes, place, strict=True):
            parameters |= {member.path: member.values[index] for member in axis.members}
        kind = parameters.get("instrument.processing.detector.kind", FIXED)
        if kind == FIXED:
            in_a_bin = bin_probability(float(tnr_of(parameters)), Looks.of(parameters))
        elif kind in DETECTORS:
            in_a_bin = float(parameters["instrument.processing.detector.pfa"])
        else:
            continue
        up, down = (float(bins_counted(parameters, in_a_bin, s)) for s in ("up", "down"))
        one, other, any_ = (
            float(segment_probability(np.asarray(in_a_bin), bins)) for bins in (up, down, up + down)
        )
        found.append((any_, one * other))
    return found


def warnings_of_alarms(study: Spec | SceneSpec) -> Iterator[str]:
    """Yield a sentence if noise alone raises false alarms in many shots, with the remedy."""
    largest = max((in_any_chirp for in_any_chirp, _ in alarms_of_study(study)), default=0.0)
    if largest > ALARM_PROBABILITY_MAX:
        yield (
            f"noise alone raises a false alarm in either chirp with probability {largest:.3g} "
            f"(more than {ALARM_PROBABILITY_MAX:g}): {fewer_alarms(study)}"
        )


def fewer_alarms(study: Spec | SceneSpec) -> str:
    """Fields of a study to change for fewer false alarms, as an imperative."""
    parameters, kind = study.parameters(), f"{DETECTOR}kind"
    along = {member.path: member.values for axis in study.axes for member in axis.members}
    kinds = {str(name) for name in along.get(kind, [parameters.get(kind, FIXED)])}
    remedies = []
    if FIXED in kinds:
        (way,) = (way for way in WAYS if parameters.get(way) is not None)
        remedies.append(f"{'lower' if 'pfa' in way else 'raise'} {way}")
    if kinds & set(DETECTORS) - {FIXED}:
        remedies.append(f"lower {DETECTOR}pfa")
    return " and ".join(remedies)
