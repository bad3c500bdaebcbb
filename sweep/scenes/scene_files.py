"""Files of a scene: checks, digests and CSV tables."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import re
from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from sweep.messages import EscapedMessageError, number_with_noun
from sweep.model.geometry.quaternion import from_heading
from sweep.units import QuantityError, read_unit


class SceneError(EscapedMessageError):
    """Error about a file or object that can not be used in a scene, with problem and remedy."""

    def __init__(self, file: str | Path, problem: str, remedy: str) -> None:
        super().__init__(f"{file}: {problem}; {remedy}")
        self.file, self.problem, self.remedy = str(file), problem, remedy


def require_file(path: str | Path) -> Path:
    """Return the path of a plain file; raise `SceneError` if there is no such file."""
    path = Path(path)
    if str(path).startswith("/vsi"):
        raise SceneError(path, "is no file of this machine", "fetch it, and name the file")
    if path.is_dir():
        raise SceneError(path, "is a folder", "name the file in it")
    if _is_link_loop(path):
        raise SceneError(path, "is reached by a link that leads back to itself", "mend the link")
    if not path.exists():
        remedy = "check the path, which is relative to the file that names it"
        if path.parent.is_dir():
            sibling_names = sorted(sibling.name for sibling in path.parent.glob(f"*{path.suffix}"))[
                :5
            ]
            remedy += f" (there is: {', '.join(sibling_names)})" if sibling_names else ""
        raise SceneError(path, "does not exist", remedy)
    if not path.is_file():
        raise SceneError(path, "is a pipe or a device", "name a plain file")
    return path


def _is_link_loop(path: Path) -> bool:
    """Return True if the symbolic links of a path lead back to themselves."""
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def file_digest(path: str | Path) -> str:
    """Return the digest of a file's content; for a glTF, of its companion files as well.

    Companion files are those to which a glTF refers.

    Returns
    -------
    str
        BLAKE2b digest, 32 hexadecimal digits.

    Raises
    ------
    SceneError
        If a file is missing or can't be read.
    """
    path = require_file(path)
    digest = hashlib.blake2b(digest_size=16)
    for file_part in (path, *_companion_paths(path)):
        try:
            with require_file(file_part).open("rb") as file:
                hashlib.file_digest(file, lambda: digest)
        except OSError as error:
            raise SceneError(file_part, f"cannot be read ({error.strerror})", "check it") from None
    return digest.hexdigest()


def require_memory(subject: str | Path, bytes_needed: float, remedy: str) -> None:
    """Raise `SceneError` if a file or object needs more memory than is free.

    Parameters
    ----------
    subject : str or Path
        File or object, for the message.
    bytes_needed : float
        Required memory [bytes].
    remedy : str
        Remedy, as an imperative clause.
    """
    import psutil

    bytes_free = psutil.virtual_memory().available
    if bytes_needed > bytes_free:
        problem = (
            f"would take about {bytes_needed / 1e9:.1f} GB of memory, of which "
            f"{bytes_free / 1e9:.1f} GB"
        )
        raise SceneError(subject, f"{problem} are free", remedy)


def read_companion_file(path: Path, name: str) -> bytes:
    """Return the content of the plain file `name` to which the file at `path` refers.

    Raises
    ------
    SceneError
        If `name` is no plain file on this machine, or too large for the memory.
    """
    companion = require_file(_companion_path(path, name))
    size = companion.stat().st_size
    require_memory(companion, 4 * size, "reduce it")
    with companion.open("rb") as file:
        return file.read(size)


def _companion_path(path: Path, name: str) -> Path:
    """Return the path of the file `name` to which the file at `path` refers.

    Raise `SceneError` if `name` is a network address.
    """
    if "://" in name:
        problem = f"needs {name}, and nothing is fetched over the network"
        raise SceneError(path, problem, "fetch that, or export it in one file (GLB)")
    return path.parent / unquote(name)


def _companion_paths(path: Path) -> list[Path]:
    """Return the paths of the files to which a glTF refers; an empty list for other formats."""
    if path.suffix.lower() != ".gltf":
        return []
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return []  # the reader of the file reports its mistakes
    buffers: Any = document.get("buffers") if isinstance(document, dict) else None
    buffers = buffers if isinstance(buffers, list) else []
    uris = [buffer.get("uri", "") for buffer in buffers if isinstance(buffer, dict)]
    return [
        _companion_path(path, uri)
        for uri in uris
        if isinstance(uri, str) and uri and not uri.startswith("data:")
    ]


WAYPOINT_COLUMN_UNITS = {
    "time": "s", "x": "m", "y": "m", "z": "m",
    "qw": "", "qx": "", "qy": "", "qz": "",
    "heading": "rad", "pitch": "rad", "roll": "rad",
}  # fmt: skip
"""SI units of the columns of a table of waypoints, by column name; '' for pure numbers."""

_REQUIRED_WAYPOINT_COLUMNS = ("time", "x", "y", "z")
"""Names of the columns that every table of waypoints must have."""
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
"""Names of the columns of an attitude as a quaternion from body to world."""
_ATTITUDE_ANGLE_COLUMNS = ("heading", "pitch", "roll")
"""Names of the columns of an attitude as three angles."""
_HEADER_CELL_PATTERN = re.compile(r"\s*([A-Za-z_]+)\s*(?:[\[(]([^\])]*)[\])])?\s*")
"""Regular expression for a header cell: a name, and an optional unit in brackets."""
_EXAMPLE_WAYPOINT_HEADER = "time [s], x [m], y [m], z [m], heading [deg], pitch [deg], roll [deg]"
"""Example of the header of a table of waypoints, for error messages."""


NumberedRow = tuple[int, list[str]]
"""Line number of a row of a CSV file, and the texts of its cells."""


class WaypointTable(NamedTuple):
    """Waypoints of a CSV table."""

    time: np.ndarray
    """Times (n,) [s], in rising order."""
    position: np.ndarray
    """World positions (n, 3) [m]."""
    attitude: np.ndarray | None
    """Quaternions (n, 4) w, x, y, z from body to world; None if the table has no attitude."""


def read_waypoints(path: str | Path, time_origin: Decimal = Decimal(0)) -> WaypointTable:
    """Read the waypoints of a CSV table.

    The first row names the columns and their units: ``time [s]``, ``x [km]``, ``y [km]`` and
    ``z [m]``. The attitude is either a quaternion ``qw, qx, qy, qz`` (body to world) or angles. The
    angles are ``heading [deg]`` (counter-clockwise from the x axis), ``pitch [deg]`` (nose up) and
    ``roll [deg]`` (left side up); a missing angle is 0. Lines that begin with # are skipped.

    Parameters
    ----------
    path : str or Path
        CSV file.
    time_origin : Decimal
        Time [s] in the table that becomes 0.

    Returns
    -------
    WaypointTable
        Waypoints in SI units.

    Raises
    ------
    SceneError
        If the file is missing, or is no table of waypoints.
    """
    table = read_csv_columns(
        path,
        WAYPOINT_COLUMN_UNITS,
        _REQUIRED_WAYPOINT_COLUMNS,
        _EXAMPLE_WAYPOINT_HEADER,
        time_origin,
    )
    position = np.column_stack([table[name] for name in "xyz"])
    return WaypointTable(table["time"], position, _attitude_from_columns(Path(path), table))


def read_first_waypoint_time(path: str | Path) -> Decimal:
    """Return the first time [s] in a CSV table of waypoints as an exact decimal number.

    Raises
    ------
    SceneError
        If the file is missing, or is no table of waypoints.
    """
    path = require_file(path)
    rows = _read_csv_rows(path)
    if len(rows) < 2:
        raise _too_few_rows_error(path, _EXAMPLE_WAYPOINT_HEADER)
    factors = _header_si_factors(
        path, rows[0][1], WAYPOINT_COLUMN_UNITS, ("time",), _EXAMPLE_WAYPOINT_HEADER
    )
    _parse_row(path, rows[1], list(factors))
    return _exact_times(rows[1:2], factors)[0]


def read_csv_columns(
    path: str | Path,
    column_units: Mapping[str, str],
    required_columns: Collection[str],
    example: str,
    time_origin: Decimal = Decimal(0),
) -> dict[str, np.ndarray]:
    """Read a CSV table with rising times, and convert its columns to SI units.

    The first row names the columns and their units, such as ``time [us]``. Lines that begin with #
    are skipped.

    Parameters
    ----------
    path : str or Path
        CSV file.
    column_units : Mapping
        SI unit of each permitted column by its name; empty for a pure number. One column is
        ``time``.
    required_columns : Collection of str
        Names of the columns that must exist.
    example : str
        A valid header, for error messages.
    time_origin : Decimal
        Time [s] that is subtracted from all times before they become float64. GPS seconds (1.35e9)
        as float64 would be rounded to 1e-7 s, which falsifies the accelerations of a path.

    Returns
    -------
    dict of str to ndarray
        Columns (n,) by name.

    Raises
    ------
    SceneError
        If the file is missing, or is no such table. The error lists all lines with mistakes, and
        remedies.
    """
    path = require_file(path)
    numbered_rows = _read_csv_rows(path)
    if len(numbered_rows) < 3:
        raise _too_few_rows_error(path, example)
    factors = _header_si_factors(path, numbered_rows[0][1], column_units, required_columns, example)
    rows, mistakes = [], []
    for line in numbered_rows[1:]:
        try:
            rows.append(_parse_row(path, line, list(factors)))
        except SceneError as error:
            mistakes.append(error)
    if not mistakes:
        times = _exact_times(numbered_rows[1:], factors)
        mistakes = [
            _time_order_error(
                path, (numbered_rows[i][0], times[i - 1]), (numbered_rows[i + 1][0], times[i])
            )
            for i in range(1, len(times))
            if times[i] <= times[i - 1]
        ]
    if mistakes:
        raise _join_errors(path, mistakes)
    values = np.array(rows)
    table = {name: values[:, i] * factor for i, (name, factor) in enumerate(factors.items())}
    if time_origin:
        with localcontext(prec=_DECIMAL_TIME_DIGITS):
            table["time"] = np.array([float(time - time_origin) for time in times])
    equal_times = np.flatnonzero(np.diff(table["time"]) <= 0)
    if equal_times.size:  # equal in float64 although the decimals differ
        line = numbered_rows[equal_times[0] + 2][0]
        problem = f"has a time on line {line} too close to the one before for numbers of 64 bits"
        raise SceneError(path, problem, "leave one of the two lines out")
    return table


_MISTAKES_SHOWN_MAX = 10
"""Largest number of mistakes in a file that an error message lists; more are only counted."""


def _join_errors(path: Path, mistakes: Sequence[SceneError]) -> SceneError:
    """Return one error that combines several errors about a file."""
    shown_mistakes = mistakes[:_MISTAKES_SHOWN_MAX]
    rule = ", and ".join(mistake.problem for mistake in shown_mistakes)
    if len(mistakes) > len(shown_mistakes):
        rule += f", and {len(mistakes) - len(shown_mistakes)} more mistakes of the kind"
    return SceneError(
        path, rule, "; ".join(dict.fromkeys(mistake.remedy for mistake in shown_mistakes))
    )


def _too_few_rows_error(path: Path, example: str) -> SceneError:
    """Return the error for a table with fewer than two rows of numbers."""
    remedy = f"write a header ({example}) and a line for each"
    return SceneError(path, "holds fewer than two lines of numbers", remedy)


def _exact_times(rows: Sequence[NumberedRow], factors: Mapping[str, float]) -> list[Decimal]:
    """Return the times [s] of table rows as decimal numbers, without rounding.

    `factors` maps the name of each column to the factor from its unit to the SI unit.
    """
    column, factor = list(factors).index("time"), Decimal(repr(factors["time"]))
    with localcontext(prec=_DECIMAL_TIME_DIGITS):
        return [Decimal(cells[column].strip()) * factor for _, cells in rows]


_DECIMAL_TIME_DIGITS = 60
"""Number of significant digits with which the times of a table are computed."""


def _time_order_error(
    path: Path, earlier: tuple[int, Decimal], later: tuple[int, Decimal]
) -> SceneError:
    """Return the error for a time in a table that does not exceed the time of the row before.

    `earlier` and `later` are the line number and the time [s] of the two rows, in the file's order.
    """
    (line, time), (next_line, next_time) = earlier, later
    if next_time == time:
        problem = (
            f"has the time {next_time.normalize():f} s on line {line} and again on {next_line}"
        )
        return SceneError(path, problem, "leave one line of each time")
    problem = (
        f"has a time on line {next_line}, {next_time.normalize():f} s, that is earlier than the "
        f"{time.normalize():f} s on line {line}"
    )
    return SceneError(path, problem, "sort the lines by time")


def _header_si_factors(
    path: Path,
    header: Sequence[str],
    column_units: Mapping[str, str],
    required_columns: Collection[str],
    example: str,
) -> dict[str, float]:
    """Return the factor from each column's unit to SI, by column name in the header's order.

    If the header has mistakes, one `SceneError` lists all of them.
    """
    for separator, separator_name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and separator in header[0]:
            problem = f"separates its columns by {separator_name}"
            raise SceneError(path, problem, "separate them by commas, with points in numbers")
    factors: dict[str, float] = {}
    mistakes: list[SceneError] = []
    for cell in header:
        match = _HEADER_CELL_PATTERN.fullmatch(cell)
        name = match[1].lower() if match else ""
        if match is None or name not in column_units:
            problem = f"has an unknown column '{cell.strip()}'"
            mistakes.append(SceneError(path, problem, f"use {example}"))
        elif name in factors:
            mistakes.append(SceneError(path, f"has two columns '{name}'", "leave one out"))
        else:
            factors[name] = 1.0
            try:
                factors[name] = _column_si_factor(
                    path, name, column_units[name], (match[2] or "").strip()
                )
            except SceneError as error:
                mistakes.append(error)
    mistakes += [
        SceneError(path, f"has no column '{name}'", f"use {example}")
        for name in required_columns
        if name not in factors
    ]
    if mistakes:
        raise _join_errors(path, mistakes)
    return factors


def _read_csv_rows(path: Path) -> list[NumberedRow]:
    """Return the line number and the cells of each row of a CSV file.

    Empty lines and comments are left out.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise SceneError(path, "is no text in UTF-8", "save the table as CSV") from None
    reader = csv.reader(text.splitlines(), skipinitialspace=True)
    return [
        (reader.line_num, row)
        for row in reader
        if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
    ]


def _column_si_factor(path: Path, name: str, si_unit: str, unit: str) -> float:
    """Return the factor from the unit of a column to the column's SI unit."""
    if not si_unit:
        if unit not in ("", "1"):
            raise SceneError(path, f"gives '{name}' a unit", "quaternions have none")
        return 1.0
    example = f"{name} [{si_unit}]"
    if not unit:
        raise SceneError(path, f"has no unit for column '{name}'", f"write e.g. {example}")
    try:
        return read_unit(unit, si_unit=si_unit, example=example).to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        problem = f"has a wrong unit for column '{name}': it {error.rule}"
        raise SceneError(path, problem, f"write e.g. {example}") from None


def _parse_row(path: Path, numbered_row: NumberedRow, column_names: Sequence[str]) -> list[float]:
    """Return the numbers in a row of a table.

    `SceneError` is raised if a cell has no finite number.
    """
    line_number, cells = numbered_row
    if len(cells) != len(column_names):
        problem = (
            f"has {number_with_noun(len(cells), 'cell')} under "
            f"{number_with_noun(len(column_names), 'column')} on line {line_number}"
        )
        raise SceneError(path, problem, "fill or cut the line")
    values = [_parse_finite_number(cell) for cell in cells]
    if None in values:
        wrong_column = values.index(None)
        problem = (
            f"has no finite number in column '{column_names[wrong_column]}' on line {line_number}: "
        )
        raise SceneError(path, f"{problem}'{cells[wrong_column].strip()}'", "write plain numbers")
    return [value for value in values if value is not None]


def _parse_finite_number(cell: str) -> float | None:
    """Return the number in the text of a cell; None if it is no finite number."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _attitude_from_columns(path: Path, table: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the attitudes in a table of waypoints as quaternions (n, 4) from body to world.

    The result is None if the table has no columns of attitude. `table` maps names to columns.
    """
    quaternion_columns = [name for name in _QUATERNION_COLUMNS if name in table]
    angle_columns = {name: table[name] for name in _ATTITUDE_ANGLE_COLUMNS if name in table}
    if quaternion_columns and angle_columns:
        raise SceneError(path, "has both a quaternion and angles", "leave one of them out")
    if angle_columns:
        zeros = np.zeros(len(table["time"]))
        return from_heading(
            **{name: angle_columns.get(name, zeros) for name in _ATTITUDE_ANGLE_COLUMNS}
        )
    if not quaternion_columns:
        return None
    if len(quaternion_columns) < len(_QUATERNION_COLUMNS):
        raise SceneError(path, "has part of a quaternion", "give qw, qx, qy and qz")
    quaternions = np.column_stack([table[name] for name in _QUATERNION_COLUMNS])
    norms = np.linalg.norm(quaternions, axis=1)
    if (wrong_rows := np.flatnonzero(~(np.abs(norms - 1) < 1e-3))).size:
        line_numbers = [line_number for line_number, _ in _read_csv_rows(path)[1:]]
        raise _join_errors(
            path,
            [_non_unit_quaternion_error(path, line_numbers[row], norms[row]) for row in wrong_rows],
        )
    return np.asarray(quaternions / norms[:, None])


def _non_unit_quaternion_error(path: Path, line_number: int, norm: float) -> SceneError:
    """Return the error for a quaternion whose length is not 1."""
    problem = f"has a quaternion of the length {norm:.6g} on line {line_number}, which has to be 1"
    remedy = "divide it by its length" if norm > 0 else "write 1, 0, 0, 0 for no turn"
    return SceneError(path, problem, remedy)
