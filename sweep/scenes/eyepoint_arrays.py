"""Conversion of eyepoints (geometry of a flight's shots) to the arrays of a store, and back.

The arrays are named as in :mod:`sweep.model.outputs`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sweep.model.outputs import BEAMLET_GEOMETRY_VARIABLES, SHOT_GEOMETRY_VARIABLES
from sweep.model.pointcloud.eyepoints import Eyepoints

_EYEPOINT_FIELD_BY_ARRAY = {
    "time": "time",
    "beam": "beam",
    "shot_cycle": "cycle",
    "platform_position": "position",
    "platform_velocity": "velocity",
    "beam_direction": "direction",
    "beam_range": "range",
    "beam_radial_velocity": "radial_velocity",
    "beam_acceleration": "acceleration",
    "beam_approach": "approach_speed",
    "beam_turn_rate": "turn_rate",
    "beam_turning": "direction_rate",
    "platform_acceleration": "platform_acceleration",
    **dict(zip(BEAMLET_GEOMETRY_VARIABLES, BEAMLET_GEOMETRY_VARIABLES, strict=True)),
}
"""Names of fields of :class:`Eyepoints`, by the names of the arrays in the store."""


def eyepoints_to_arrays(eyepoints: Eyepoints) -> dict[str, np.ndarray]:
    """Return eyepoints as the arrays of a store.

    Parameters
    ----------
    eyepoints : Eyepoints
        Eyepoints of n shots with b beamlets each.

    Returns
    -------
    dict of str to ndarray
        Arrays by name, in the types of the store: shape (n,) or (n, 3) for
        `SHOT_GEOMETRY_VARIABLES`, and (n, b) for `BEAMLET_GEOMETRY_VARIABLES`.
    """
    outputs = {**SHOT_GEOMETRY_VARIABLES, **BEAMLET_GEOMETRY_VARIABLES}
    arrays = {
        name: np.asarray(getattr(eyepoints, field), outputs[name].dtype)
        for name, field in _EYEPOINT_FIELD_BY_ARRAY.items()
    }
    shots = np.arange(len(eyepoints.time))
    arrays["beam_surface"] = arrays["surface"][shots, eyepoints.reference_beamlet]
    return arrays


def eyepoints_from_arrays(arrays: Mapping[str, np.ndarray], weight: np.ndarray) -> Eyepoints:
    """Return eyepoints (ray-traced geometry of shots), given the arrays in a store.

    Parameters
    ----------
    arrays : Mapping of str to ndarray
        Arrays of n shots from `eyepoints_to_arrays`.
    weight : ndarray, shape (b,)
        Power fractions of the beamlets.

    Raises
    ------
    ValueError
        If an array is missing or has an unexpected shape.
    """
    if missing := sorted(_EYEPOINT_FIELD_BY_ARRAY.keys() - arrays.keys()):
        raise ValueError(f"eyepoints lack {', '.join(missing)}")
    fields = {field: np.asarray(arrays[name]) for name, field in _EYEPOINT_FIELD_BY_ARRAY.items()}
    fields["beam"] = fields["beam"].astype(np.int64)
    fields["cycle"] = fields["cycle"].astype(np.int64)
    weight = np.asarray(weight, float)
    for name, field in _EYEPOINT_FIELD_BY_ARRAY.items():
        trailing_shape = (
            {1: (), 2: (3,)}[len(SHOT_GEOMETRY_VARIABLES[name].dims)]
            if name in SHOT_GEOMETRY_VARIABLES
            else weight.shape
        )
        expected_shape = (fields["time"].size, *trailing_shape)
        if fields[field].shape != expected_shape:
            raise ValueError(f"{name} has shape {fields[field].shape}, not {expected_shape}")
    return Eyepoints(**fields, weight=weight)
