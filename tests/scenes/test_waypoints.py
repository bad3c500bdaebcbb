import math
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from sweep.model.geometry.body_motion import Waypoints
from sweep.model.geometry.quaternion import from_axis_angle, from_heading, multiply, rotate
from sweep.scenes.scene_files import SceneError, read_first_waypoint_time, read_waypoints

PLAIN_TABLE = "time [s], x [m], y [m], z [m]\n0, 0, 0, 500\n2, 50, 0, 450\n4, 90, 10, 420\n"


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
    first, last = (
        from_axis_angle(2, 0.2),
        multiply(from_axis_angle(2, 0.2), from_axis_angle(0, 1.0)),
    )
    rows = "\n".join(
        ",".join(str(v) for v in (t, 0, 0, 9, *q)) for t, q in ((0, first), (10, last))
    )
    path = read_waypoints(table(f"time [s],x [m],y [m],z [m],qw,qx,qy,qz\n{rows}\n"))
    np.testing.assert_allclose(path.attitude, [first, last], atol=1e-15)


def test_remarks_blank_lines_and_a_byte_order_mark_are_passed_over(table):
    text = "\ufeff# flown on a Monday\n" + PLAIN_TABLE.replace("\n2,", "\n\n# here it turns\n2,")
    assert len(read_waypoints(table(text)).time) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLAIN_TABLE.replace("z [m]", "height [m]"), "unknown column 'height"),
        (PLAIN_TABLE.replace(",", ";"), "separates its columns by semicolons"),
        (PLAIN_TABLE.replace(",", "\t"), "separates its columns by tabs"),
        (PLAIN_TABLE.replace(", z [m]", ""), "no column 'z'"),
        (PLAIN_TABLE.replace("z [m]", "y [m]"), "two columns 'y'"),
        (PLAIN_TABLE.replace("x [m]", "x"), "has no unit for column 'x'"),
        (
            PLAIN_TABLE.replace("x [m]", "x [s]"),
            "has a wrong unit for column 'x': it needs a unit like m, and 's' is none",
        ),
        (PLAIN_TABLE.replace("50, 0,", "50,"), "has 3 cells under 4 columns on line 3"),
        (
            PLAIN_TABLE.replace("50, 0,", "fifty, 0,"),
            "no finite number in column 'x' on line 3: 'fifty'",
        ),
        (
            PLAIN_TABLE.replace("50, 0,", "inf, 0,"),
            "no finite number in column 'x' on line 3: 'inf'",
        ),
        (PLAIN_TABLE.replace("\n4,", "\n2,"), "has the time 2 s on line 3 and again on 4"),
        (
            PLAIN_TABLE.replace("\n4,", "\n1,"),
            "time on line 4, 1 s, that is earlier than the 2 s on line 3",
        ),
        ("time [s], x [m], y [m], z [m]\n0,0,0,1\n", "fewer than two"),
        ("", "fewer than two"),
        ("time [s],x [m],y [m],z [m],qw\n0,0,0,1,1\n1,0,0,1,1\n", "part of a quaternion"),
        ("time [s],x [m],y [m],z [m],qw,roll [deg]\n0,0,0,1,1,0\n1,0,0,1,1,0\n", "both"),
        (
            "time [s],x [m],y [m],z [m],qw,qx,qy,qz\n0,0,0,1,1,1,0,0\n1,0,0,1,1,0,0,0\n",
            "quaternion of the length 1.41421 on line 2, which has to be 1; divide it",
        ),
        (
            "time [s],x [m],y [m],z [m],qw,qx,qy,qz\n0,0,0,1,1,0,0,0\n# note\n1,0,0,1,0,0,0,0\n",
            "quaternion of the length 0 on line 4, which has to be 1; write 1, 0, 0, 0",
        ),
        ("time [s],x [m],y [m],z [m],qw [m]\n0,0,0,1,1\n1,0,0,1,1\n", "quaternions have none"),
    ],
)
def test_tables_that_are_no_path_are_refused_with_file_rule_and_remedy(table, text, message):
    path = table(text)
    with pytest.raises(SceneError, match=message) as refused:
        read_waypoints(path)
    assert str(refused.value).startswith(str(path)) and refused.value.remedy


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(SceneError, match="does not exist"):
        read_waypoints(tmp_path / "gone.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(SceneError, match="UTF-8"):
        read_waypoints(tmp_path / "b.csv")


def test_all_mistakes_of_a_table_are_reported_at_once(table):
    rows = "0, 0, 0, 500\n0, one, 0, 450\n2, 0, 0\n1, 0, 0, 1\n"
    with pytest.raises(SceneError) as refused:
        read_waypoints(table(f"time, x [m], y [s], height [m]\n{rows}"))
    for message in (
        "no unit for column 'time'",
        "column 'y'",
        "unknown column 'height [m]'",
        "no column 'z'",
    ):
        assert message in refused.value.problem
    with pytest.raises(SceneError) as refused:
        read_waypoints(table(f"time [s], x [m], y [m], z [m]\n{rows}"))
    assert refused.value.problem == (
        "has no finite number in column 'x' on line 3: 'one', and "
        "has 3 cells under 4 columns on line 4"
    )
    with pytest.raises(SceneError) as refused:
        read_waypoints(table(PLAIN_TABLE + "4, 0, 0, 0\n3, 0, 0, 0\n"))
    assert refused.value.problem == (
        "has the time 4 s on line 4 and again on 5, and "
        "has a time on line 6, 3 s, that is earlier than the 4 s on line 5"
    )
    assert refused.value.remedy == "leave one line of each time; sort the lines by time"


def test_of_many_mistakes_the_first_are_reported_and_the_others_counted(table):
    with pytest.raises(SceneError, match="on line 11: 'x', and 30 more mistakes of the kind"):
        read_waypoints(table(PLAIN_TABLE.partition("\n")[0] + "\n" + "x, 0, 0, 0\n" * 40))


GPS = Decimal("1350000000.123456")


def accelerating(first, unit="s", factor=1):
    """Table of a steady speed, 100 m/s, whose times begin with a first one, every 10 ms."""
    rows = [f"{(first + Decimal(i) / 100) * factor}, {i}, 0, 500" for i in range(200)]
    return f"time [{unit}], x [m], y [m], z [m]\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize(("unit", "factor"), [("s", 1), ("ms", 1000), ("us", 10**6)])
def test_seconds_of_gps_keep_all_their_digits(table, unit, factor):
    path = table(accelerating(GPS, unit, factor))
    assert read_first_waypoint_time(path) == GPS
    waypoints, times = read_waypoints(path, GPS), np.arange(200) / 100
    np.testing.assert_array_equal(waypoints.time, times)
    motion = Waypoints(waypoints.time, waypoints.position).motion(times)
    assert np.abs(motion.acceleration).max() < 1e-8  # 0.07 by differences of 64-bit seconds
    np.testing.assert_allclose(motion.velocity[:, 0], 100, atol=1e-9)


def test_a_first_time_is_read_from_a_table_that_is_one():
    with pytest.raises(SceneError, match="does not exist"):
        read_first_waypoint_time("nowhere.csv")


def test_a_table_without_a_line_or_a_unit_has_no_first_time(table):
    with pytest.raises(SceneError, match="fewer than two lines"):
        read_first_waypoint_time(table("time [s], x [m], y [m], z [m]\n"))
    with pytest.raises(SceneError, match="no unit for column 'time'"):
        read_first_waypoint_time(table(PLAIN_TABLE.replace("time [s]", "time")))


def test_the_table_that_the_documentation_shows_is_read_as_it_says(table):
    page = Path(__file__).parents[2] / "docs" / "howto" / "fly_a_recorded_path.md"
    text = re.search(r'write_text\("""\\\n(.*?)"""\)', page.read_text("utf-8"), re.S)[1]
    path = table(text)
    assert read_first_waypoint_time(path) == 1350000000
    waypoints = read_waypoints(path, read_first_waypoint_time(path))
    np.testing.assert_array_equal(waypoints.time, [0, 0.5, 1, 1.5])
    np.testing.assert_array_equal(waypoints.position[2], [1, 39, 371])
    forward, left = (rotate(waypoints.attitude[1], axis) for axis in ([1.0, 0, 0], [0, 1.0, 0]))
    np.testing.assert_allclose(forward, [0, math.cos(math.radians(2)), -math.sin(math.radians(2))],
                               atol=1e-15)  # fmt: skip
    assert left[2] == pytest.approx(math.sin(math.radians(1.5)) * math.cos(math.radians(2)))
