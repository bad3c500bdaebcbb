"""Files of a scene: what is wrong with one, what tells it from others, CSV tables."""

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

from sweep.messages import PrintableError, counted
from sweep.model.geometry.quaternion import from_heading
from sweep.units import QuantityError, read_unit


class SceneError(PrintableError):
    """A file that a scene can not be made of: the rule broken, and what to do about it."""

    def __init__(self, file: str | Path, rule: str, remedy: str) -> None:
        super().__init__(f"{file}: {rule}; {remedy}")
        self.file, self.rule, self.remedy = str(file), rule, remedy


def existing(path: str | Path) -> Path:
    """Path of a file that is there; SceneError where it is not, or is no plain file."""
    path = Path(path)
    if str(path).startswith("/vsi"):
        raise SceneError(path, "is no file of this machine", "fetch it, and name the file")
    if path.is_dir():
        raise SceneError(path, "is a folder", "name the file in it")
    if _is_loop(path):
        raise SceneError(path, "is reached by a link that leads back to itself", "mend the link")
    if not path.exists():
        remedy = "check the path, which is relative to the file that names it"
        if path.parent.is_dir():
            near = sorted(other.name for other in path.parent.glob(f"*{path.suffix}"))[:5]
            remedy += f" (there is: {', '.join(near)})" if near else ""
        raise SceneError(path, "does not exist", remedy)
    if not path.is_file():
        raise SceneError(path, "is a pipe or a device", "name a plain file")
    return path


def _is_loop(path: Path) -> bool:
    """Return true if symbolic links on the way to a file lead in a circle."""
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def file_digest(path: str | Path) -> str:
    """Digest of a file's bytes, and of those of files that a glTF reads; SceneError if lost."""
    path = existing(path)
    digest = hashlib.blake2b(digest_size=16)
    for part in (path, *_companions(path)):
        try:
            with existing(part).open("rb") as file:
                hashlib.file_digest(file, lambda: digest)
        except OSError as error:
            raise SceneError(part, f"cannot be read ({error.strerror})", "check it") from None
    return digest.hexdigest()


def require_memory(path: str | Path, needed: float, remedy: str) -> None:
    """Refuse a file or an object that would take more memory [bytes] than the machine has free."""
    import psutil

    free = psutil.virtual_memory().available
    if needed > free:
        rule = f"would take about {needed / 1e9:.1f} GB of memory, of which {free / 1e9:.1f} GB"
        raise SceneError(path, f"{rule} are free", remedy)


def read_companion(path: Path, name: str) -> bytes:
    """Content of a plain file that another one names; SceneError for what is none."""
    companion = existing(_companion(path, name))
    size = companion.stat().st_size
    require_memory(companion, 4 * size, "reduce it")
    with companion.open("rb") as file:
        return file.read(size)


def _companion(path: Path, name: str) -> Path:
    """Path of a file that another one names; SceneError for an address of the network."""
    if "://" in name:
        rule = f"needs {name}, and nothing is fetched over the network"
        raise SceneError(path, rule, "fetch that, or export it in one file (GLB)")
    return path.parent / unquote(name)


def _companions(path: Path) -> list[Path]:
    """Files whose content belongs to this one's."""
    if path.suffix.lower() != ".gltf":
        return []
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return []  # what is wrong with it is told where it is read
    buffers: Any = document.get("buffers") if isinstance(document, dict) else None
    buffers = buffers if isinstance(buffers, list) else []
    names = [b.get("uri", "") for b in buffers if isinstance(b, dict)]
    return [
        _companion(path, name)
        for name in names
        if isinstance(name, str) and name and not name.startswith("data:")
    ]


COLUMNS = {
    "time": "s", "x": "m", "y": "m", "z": "m",
    "qw": "", "qx": "", "qy": "", "qz": "",
    "heading": "rad", "pitch": "rad", "roll": "rad",
}  # fmt: skip
"""Columns and the SI unit of each; quaternions have none."""

_POSITION = ("time", "x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLES = ("heading", "pitch", "roll")
_HEADING = re.compile(r"\s*([A-Za-z_]+)\s*(?:[\[(]([^\])]*)[\])])?\s*")
_EXAMPLE = "time [s], x [m], y [m], z [m], heading [deg], pitch [deg], roll [deg]"


Line = tuple[int, list[str]]
"""Number of a line, and its cells."""


class Table(NamedTuple):
    """Waypoints of a table."""

    time: np.ndarray  # (n,): rising times [s]
    position: np.ndarray  # (n, 3) [m]
    attitude: np.ndarray | None
    """(n, 4): quaternions (w, x, y, z), body to world; None where the table has no attitude."""


def read_waypoints(path: str | Path, time_origin: Decimal = Decimal(0)) -> Table:
    """Waypoints of a CSV table.

    The first row names the columns and their units: ``time [s]``, ``x [km]``, ``y [km]``, ``z
    [m]``. The attitude is either ``qw, qx, qy, qz`` (body to world) or angles. The angles are
    ``heading [deg]`` (counter-clockwise from the x axis), ``pitch [deg]`` (nose up) and
    ``roll [deg]`` (left side up); a missing one is 0. Lines that begin with # are skipped. A file
    that is missing or no such table raises SceneError. Times [s] count from `time_origin`.
    """
    table = read_columns(path, COLUMNS, _POSITION, _EXAMPLE, time_origin)
    position = np.column_stack([table[name] for name in "xyz"])
    return Table(table["time"], position, _attitude(Path(path), table))


def first_time(path: str | Path) -> Decimal:
    """First time [s] of a CSV table of waypoints, with all its digits; SceneError for no table."""
    path = existing(path)
    lines = _lines(path)
    if len(lines) < 2:
        raise _too_short(path, _EXAMPLE)
    factors = _factors(path, lines[0][1], COLUMNS, ("time",), _EXAMPLE)
    _row(path, lines[1], list(factors))
    return _exact_times(lines[1:2], factors)[0]


def read_columns(
    path: str | Path,
    columns: Mapping[str, str],
    required: Collection[str],
    example: str,
    time_origin: Decimal = Decimal(0),
) -> dict[str, np.ndarray]:
    """Columns of a CSV table in SI, by name, (n,) each; the times rise.

    The first row names the columns and their units: ``time [us]``. Lines that begin with # are
    passed over.

    Parameters
    ----------
    columns : mapping
        SI unit of each column that there may be, ``time`` among them; empty for a pure number.
    required : collection of str
        Columns that must be there.
    example : str
        A good header.
    time_origin : Decimal
        Subtracted from the times [s] in decimal arithmetic, before they become float64: seconds of
        GPS (1.35e9) would lose 1e-7 s there, and the accelerations of a path with them.

    Raises
    ------
    SceneError
        For a file that is missing or no such table; names every line at fault, and what to write.
    """
    path = existing(path)
    lines = _lines(path)
    if len(lines) < 3:
        raise _too_short(path, example)
    factors = _factors(path, lines[0][1], columns, required, example)
    rows, mistakes = [], []
    for line in lines[1:]:
        try:
            rows.append(_row(path, line, list(factors)))
        except SceneError as error:
            mistakes.append(error)
    if not mistakes:
        times = _exact_times(lines[1:], factors)
        mistakes = [
            _falling_time(path, (lines[i][0], times[i - 1]), (lines[i + 1][0], times[i]))
            for i in range(1, len(times))
            if times[i] <= times[i - 1]
        ]
    if mistakes:
        raise _joined(path, mistakes)
    values = np.array(rows)
    table = {name: values[:, i] * factor for i, (name, factor) in enumerate(factors.items())}
    if time_origin:
        with localcontext(prec=_TIME_DIGITS):
            table["time"] = np.array([float(time - time_origin) for time in times])
    same = np.flatnonzero(np.diff(table["time"]) <= 0)
    if same.size:  # apart by less than float64 can tell
        line = lines[same[0] + 2][0]
        rule = f"has a time on line {line} too close to the one before for numbers of 64 bits"
        raise SceneError(path, rule, "leave one of the two lines out")
    return table


_MISTAKES_SHOWN = 10
"""Mistakes of one file that are told; of more, their number."""


def _joined(path: Path, mistakes: Sequence[SceneError]) -> SceneError:
    """All mistakes of a file as one; their rules are predicates of the file."""
    shown = mistakes[:_MISTAKES_SHOWN]
    rule = ", and ".join(mistake.rule for mistake in shown)
    if len(mistakes) > len(shown):
        rule += f", and {len(mistakes) - len(shown)} more mistakes of the kind"
    return SceneError(path, rule, "; ".join(dict.fromkeys(mistake.remedy for mistake in shown)))


def _too_short(path: Path, example: str) -> SceneError:
    """Refusal of a table without two lines of numbers."""
    remedy = f"write a header ({example}) and a line for each"
    return SceneError(path, "holds fewer than two lines of numbers", remedy)


def _exact_times(lines: Sequence[Line], factors: Mapping[str, float]) -> list[Decimal]:
    """Return the times [s] of lines of finite numbers, with all digits that are written."""
    column, factor = list(factors).index("time"), Decimal(repr(factors["time"]))
    with localcontext(prec=_TIME_DIGITS):
        return [Decimal(cells[column].strip()) * factor for _, cells in lines]


_TIME_DIGITS = 60
"""Significant digits of times while they are decimals."""


def _falling_time(
    path: Path, before: tuple[int, Decimal], after: tuple[int, Decimal]
) -> SceneError:
    """Refusal of a time, given with its line, that does not exceed the time before."""
    (line, time), (next_line, next_time) = before, after
    if next_time == time:
        rule = f"has the time {next_time.normalize():f} s on line {line} and again on {next_line}"
        return SceneError(path, rule, "leave one line of each time")
    rule = (
        f"has a time on line {next_line}, {next_time.normalize():f} s, that is earlier than the "
        f"{time.normalize():f} s on line {line}"
    )
    return SceneError(path, rule, "sort the lines by time")


def _factors(
    path: Path,
    header: Sequence[str],
    columns: Mapping[str, str],
    required: Collection[str],
    example: str,
) -> dict[str, float]:
    """Factor that makes each column SI, by name in the order of the header; all its mistakes."""
    for mark, its_name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and mark in header[0]:
            rule = f"separates its columns by {its_name}"
            raise SceneError(path, rule, "separate them by commas, with points in numbers")
    factors: dict[str, float] = {}
    mistakes: list[SceneError] = []
    for cell in header:
        match = _HEADING.fullmatch(cell)
        name = match[1].lower() if match else ""
        if match is None or name not in columns:
            rule = f"has an unknown column '{cell.strip()}'"
            mistakes.append(SceneError(path, rule, f"use {example}"))
        elif name in factors:
            mistakes.append(SceneError(path, f"has two columns '{name}'", "leave one out"))
        else:
            factors[name] = 1.0
            try:
                factors[name] = _factor(path, name, columns[name], (match[2] or "").strip())
            except SceneError as error:
                mistakes.append(error)
    mistakes += [
        SceneError(path, f"has no column '{name}'", f"use {example}")
        for name in required
        if name not in factors
    ]
    if mistakes:
        raise _joined(path, mistakes)
    return factors


def _lines(path: Path) -> list[Line]:
    """Line numbers and cells of all lines that say something."""
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


def _factor(path: Path, name: str, si: str, unit: str) -> float:
    """Factor that makes a column SI."""
    if not si:
        if unit not in ("", "1"):
            raise SceneError(path, f"gives '{name}' a unit", "quaternions have none")
        return 1.0
    example = f"{name} [{si}]"
    if not unit:
        raise SceneError(path, f"has no unit for column '{name}'", f"write e.g. {example}")
    try:
        return read_unit(unit, si_unit=si, example=example).to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        rule = f"has a wrong unit for column '{name}': it {error.rule}"
        raise SceneError(path, rule, f"write e.g. {example}") from None


def _row(path: Path, line: Line, names: Sequence[str]) -> list[float]:
    """Numbers of a line, in the order of the columns' names."""
    number, cells = line
    if len(cells) != len(names):
        rule = (
            f"has {counted(len(cells), 'cell')} under {counted(len(names), 'column')} "
            f"on line {number}"
        )
        raise SceneError(path, rule, "fill or cut the line")
    values = [_finite_number(cell) for cell in cells]
    if None in values:
        wrong = values.index(None)
        rule = f"has no finite number in column '{names[wrong]}' on line {number}: "
        raise SceneError(path, f"{rule}'{cells[wrong].strip()}'", "write plain numbers")
    return [value for value in values if value is not None]


def _finite_number(cell: str) -> float | None:
    """Value of a cell; None if it is no finite number."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _attitude(path: Path, table: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Quaternions of the table, (n, 4)."""
    given = [name for name in _QUATERNION if name in table]
    angles = {name: table[name] for name in _ANGLES if name in table}
    if given and angles:
        raise SceneError(path, "has both a quaternion and angles", "leave one of them out")
    if angles:
        zero = np.zeros(len(table["time"]))
        return from_heading(**{name: angles.get(name, zero) for name in _ANGLES})
    if not given:
        return None
    if len(given) < len(_QUATERNION):
        raise SceneError(path, "has part of a quaternion", "give qw, qx, qy and qz")
    q = np.column_stack([table[name] for name in _QUATERNION])
    length = np.linalg.norm(q, axis=1)
    if (wrong := np.flatnonzero(~(np.abs(length - 1) < 1e-3))).size:
        numbers = [line for line, _ in _lines(path)[1:]]
        raise _joined(path, [_unfit_quaternion(path, numbers[row], length[row]) for row in wrong])
    return np.asarray(q / length[:, None])


def _unfit_quaternion(path: Path, line: int, length: float) -> SceneError:
    """Refusal of a quaternion whose length is not 1."""
    rule = f"has a quaternion of the length {length:.6g} on line {line}, which has to be 1"
    remedy = "divide it by its length" if length > 0 else "write 1, 0, 0, 0 for no turn"
    return SceneError(path, rule, remedy)
