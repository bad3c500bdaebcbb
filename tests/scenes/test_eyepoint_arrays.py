"""Eyepoints keep every bit on their way through a store's arrays."""

import numpy as np
import pytest

from sweep.model.geometry.body_motion import ConstantAcceleration, MovingBody, NadirAttitude
from sweep.model.geometry.ray_casting import RayCaster
from sweep.model.geometry.scanner import cone_directions, fixed_beams
from sweep.model.outputs import BEAMLET_GEOMETRY_VARIABLES, SHOT_GEOMETRY_VARIABLES
from sweep.model.pointcloud.eyepoints import compute_eyepoints
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays, eyepoints_to_arrays
from sweep.scenes.meshes import clean_mesh


@pytest.fixture(scope="module")
def eyepoints():
    """Shots near the edge of a plate: some see it, some in part, some not at all."""
    corners = 30.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    ground = clean_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), 0)[0]
    path = ConstantAcceleration((0.0, 0.0, 100.0), (10.0, 0.0, 0.0), (0.0, 0.0, 0.0), 10.0)
    return compute_eyepoints(
        np.arange(24),
        flight=MovingBody(path, NadirAttitude()),
        scanner=fixed_beams(cone_directions(3, half_angle=0.2), rate=2.0),
        caster=RayCaster(ground),
        beam_divergence=0.03,
        n_beamlets=7,
    )


def test_arrays_have_names_types_and_dimensions_of_the_store(eyepoints):
    arrays = eyepoints_to_arrays(eyepoints)
    outputs = {**SHOT_GEOMETRY_VARIABLES, **BEAMLET_GEOMETRY_VARIABLES}
    sizes = {"shot": 24, "beamlet": 7, "xyz": 3}
    assert arrays.keys() == outputs.keys()
    for name, output in outputs.items():
        assert arrays[name].dtype == output.dtype
        assert arrays[name].shape == tuple(sizes[dim] for dim in output.dims)


def test_what_is_read_back_is_what_was_cast_bit_for_bit(eyepoints):
    back = eyepoints_from_arrays(eyepoints_to_arrays(eyepoints), eyepoints.weight)
    for name, array in eyepoints._asdict().items():
        assert np.array_equal(getattr(back, name), array, equal_nan=array.dtype.kind == "f"), name
        assert getattr(back, name).dtype == array.dtype, name


def test_the_surface_of_the_beam_is_that_of_its_first_beamlet_that_hits(eyepoints):
    surface = eyepoints_to_arrays(eyepoints)["beam_surface"]
    partial = (eyepoints.surface[:, 0] < 0) & eyepoints.has_target
    assert partial.any() and not eyepoints.has_target.all()
    assert np.array_equal(surface >= 0, eyepoints.has_target)
    reference = np.nanargmin(np.abs(eyepoints.offset[partial]), axis=1)
    hit = eyepoints.surface[partial, reference]
    assert np.array_equal(surface[partial], hit)


def test_arrays_that_are_missing_or_of_another_size_are_named(eyepoints):
    arrays = eyepoints_to_arrays(eyepoints)
    with pytest.raises(ValueError, match="lack offset"):
        eyepoints_from_arrays({k: v for k, v in arrays.items() if k != "offset"}, eyepoints.weight)
    with pytest.raises(ValueError, match=r"beam_range has shape \(23,\), not \(24,\)"):
        eyepoints_from_arrays(arrays | {"beam_range": arrays["beam_range"][:-1]}, eyepoints.weight)
    with pytest.raises(ValueError, match=r"offset has shape \(24, 7\), not \(24, 6\)"):
        eyepoints_from_arrays(arrays, eyepoints.weight[:-1])
