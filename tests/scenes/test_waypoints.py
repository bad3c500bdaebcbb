import math

import numpy as np
import pytest

from sweep.model.geometry.quaternion import about, from_heading, multiply, rotate
from sweep.scenes.files import SceneError, read_waypoints

PLAIN = "time [s], x [m], y [m], z [m]\n0, 0, 0, 500\n2, 50, 0, 450\n4, 90, 10, 420\n"


@pytest.fixture
def table(tmp_path):
    def write(text):
        path = tmp_path / "path.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_units_of_the_header_become_si(table):
    path = read_waypoints(table("x (km), time [ms], z [ft], y [cm]\n1,0,10,100\n2,500,20,200\n"))
    np.testing.assert_allclose(path.time, [0, 0.5])
    np.testing.assert_allclose(path.position, [[1000, 1, 3.048], [2000, 2, 6.096]])
    assert path.attitude is None


def test_angles_of_a_table_turn_the_body_left_up_and_left_side_up(table):
    text = (
        "time [s], x [m], y [m], z [m], heading [deg], pitch [deg], roll [mrad]\n"
        "0, 0, 0, 9, 90, 0, 0\n1, 0, 0, 9, 0, 30, 0\n2, 0, 0, 9, 0, 0, 100\n"
    )
    path = read_waypoints(table(text))
    q = path.attitude
    np.testing.assert_allclose(rotate(q[0], [1.0, 0, 0]), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(
        rotate(q[1], [1.0, 0, 0]), [math.cos(math.pi / 6), 0, 0.5], atol=1e-12
    )
    assert rotate(q[2], [0, 1.0, 0])[2] == pytest.approx(math.sin(0.1))


def test_angles_left_out_are_zero(table):
    path = read_waypoints(table("time [s],x [m],y [m],z [m],pitch [deg]\n0,0,0,1,10\n1,0,0,1,20\n"))
    expected = from_heading(heading=np.zeros(2), pitch=np.radians([10.0, 20.0]))
    np.testing.assert_allclose(path.attitude, expected, atol=1e-15)


def test_quaternions_of_a_table_are_taken_as_they_are(table):
    first, last = about(2, 0.2), multiply(about(2, 0.2), about(0, 1.0))
    rows = "\n".join(
        ",".join(str(v) for v in (t, 0, 0, 9, *q)) for t, q in ((0, first), (10, last))
    )
    path = read_waypoints(table(f"time [s],x [m],y [m],z [m],qw,qx,qy,qz\n{rows}\n"))
    np.testing.assert_allclose(path.attitude, [first, last], atol=1e-15)


def test_remarks_blank_lines_and_a_byte_order_mark_are_passed_over(table):
    text = "\ufeff# flown on a Monday\n" + PLAIN.replace("\n2,", "\n\n# here it turns\n2,")
    assert len(read_waypoints(table(text)).time) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PLAIN.replace("z [m]", "height [m]"), "unknown column 'height"),
        (PLAIN.replace(", z [m]", ""), "no column 'z'"),
        (PLAIN.replace("z [m]", "y [m]"), "two columns 'y'"),
        (PLAIN.replace("x [m]", "x"), "unit of column 'x' has none"),
        (PLAIN.replace("x [m]", "x [s]"), "unit of column 'x' needs a unit like m"),
        (PLAIN.replace("50, 0,", "50,"), "line 3 has 3 cells under 4"),
        (PLAIN.replace("50, 0,", "fifty, 0,"), "line 3 holds no finite numbers"),
        (PLAIN.replace("50, 0,", "inf, 0,"), "line 3 holds no finite numbers"),
        (PLAIN.replace("\n4,", "\n2,"), "line 4: the time does not rise"),
        ("time [s], x [m], y [m], z [m]\n0,0,0,1\n", "fewer than two"),
        ("", "fewer than two"),
        ("time [s],x [m],y [m],z [m],qw\n0,0,0,1,1\n1,0,0,1,1\n", "part of a quaternion"),
        ("time [s],x [m],y [m],z [m],qw,roll [deg]\n0,0,0,1,1,0\n1,0,0,1,1,0\n", "both"),
        (
            "time [s],x [m],y [m],z [m],qw,qx,qy,qz\n0,0,0,1,1,1,0,0\n1,0,0,1,1,0,0,0\n",
            "length other than 1",
        ),
        ("time [s],x [m],y [m],z [m],qw [m]\n0,0,0,1,1\n1,0,0,1,1\n", "quaternions have none"),
    ],
)
def test_tables_that_are_no_path_are_refused_with_file_rule_and_remedy(table, text, said):
    path = table(text)
    with pytest.raises(SceneError, match=said) as refused:
        read_waypoints(path)
    assert str(refused.value).startswith(str(path)) and refused.value.remedy


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(SceneError, match="does not exist"):
        read_waypoints(tmp_path / "gone.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(SceneError, match="UTF-8"):
        read_waypoints(tmp_path / "b.csv")
