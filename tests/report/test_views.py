import numpy as np
import pytest

from sweep.report.flight_charts import (
    CAMERA_POSITION_BY_VIEW,
    WORLD_AXES,
    _hidden_axis_layout,
    _is_in_view,
    _largest_fitting_side,
)


@pytest.mark.parametrize("sides", [(1, 1, 1), (1, 1, 0.05), (0.8, 0.8, 1), (0.1, 1, 0.1)])
def test_a_box_is_seen_whole_from_every_view_and_no_smaller_than_need_be(sides):
    ends = np.linspace(-0.5, 0.5, 9)
    points = np.stack(np.meshgrid(ends, ends, ends), axis=-1).reshape(-1, 3) * sides
    eyes = [
        np.array([view[axis] for axis in WORLD_AXES]) for view in CAMERA_POSITION_BY_VIEW.values()
    ]
    size = _largest_fitting_side(np.array(sides))
    assert all(_is_in_view(size * points, eye) for eye in eyes)
    assert not all(_is_in_view(1.05 * size * points, eye) for eye in eyes)


def test_the_axis_that_a_view_looks_along_is_not_drawn():
    assert [list(_hidden_axis_layout(view)) for view in CAMERA_POSITION_BY_VIEW] == [
        [], ["scene.zaxis.visible"], ["scene.yaxis.visible"], ["scene.xaxis.visible"],
    ]  # fmt: skip
