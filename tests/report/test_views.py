import numpy as np
import pytest

from sweep.report.flights import AXES, VIEWS, _hidden, _longest, _seen


@pytest.mark.parametrize("sides", [(1, 1, 1), (1, 1, 0.05), (0.8, 0.8, 1), (0.1, 1, 0.1)])
def test_a_box_is_seen_whole_from_every_view_and_no_smaller_than_need_be(sides):
    ends = np.linspace(-0.5, 0.5, 9)
    points = np.stack(np.meshgrid(ends, ends, ends), axis=-1).reshape(-1, 3) * sides
    eyes = [np.array([view[axis] for axis in AXES]) for view in VIEWS.values()]
    size = _longest(np.array(sides))
    assert all(_seen(size * points, eye) for eye in eyes)
    assert not all(_seen(1.05 * size * points, eye) for eye in eyes)


def test_the_axis_that_a_view_looks_along_is_not_drawn():
    assert [list(_hidden(view)) for view in VIEWS] == [
        [], ["scene.zaxis.visible"], ["scene.yaxis.visible"], ["scene.xaxis.visible"],
    ]  # fmt: skip
