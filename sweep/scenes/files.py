"""Files of a scene: what is wrong with one, what tells it from others, CSV tables."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from sweep.messages import PrintableError
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
    if not path.exists():
        remedy = "check the path, which is relative to the file that names it"
        if path.parent.is_dir():
            near = sorted(other.name for other in path.parent.glob(f"*{path.suffix}"))[:5]
            remedy += f" (there is: {', '.join(near)})" if near else ""
        raise SceneError(path, "does not exist", remedy)
    if not path.is_file():
        raise SceneError(path, "is a pipe or a device", "name a plain file")
    return path


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
    companion = existing(path.parent / unquote(name))
    size = companion.stat().st_size
    require_memory(companion, 4 * size, "reduce it")
    with companion.open("rb") as file:
        return file.read(size)


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
        path.parent / unquote(name)
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


class Table(NamedTuple):
    """Waypoints of a table."""

    time: np.ndarray  # (n,): rising times [s]
    position: np.ndarray  # (n, 3) [m]
    attitude: np.ndarray | None
    """(n, 4): quaternions (w, x, y, z), body to world; None where the table has no attitude."""


def read_waypoints(path: str | Path) -> Table:
    """Waypoints of a CSV table.

    The first row names the columns and their units: ``time [s]``, ``x [km]``, ``y [km]``, ``z
    [m]``. The attitude is either ``qw, qx, qy, qz`` (body to world) or angles. The angles are
    ``heading [deg]`` (counter-clockwise from the x axis), ``pitch [deg]`` (nose up) and
    ``roll [deg]`` (left side up); a missing one is 0. Lines that begin with # are skipped. A file
    that is missing or no such table raises SceneError.
    """
    table = read_columns(path, COLUMNS, _POSITION, _EXAMPLE)
    position = np.column_stack([table[name] for name in "xyz"])
    return Table(table["time"], position, _attitude(Path(path), table))


def read_columns(
    path: str | Path, columns: Mapping[str, str], required: Collection[str], example: str
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

    Raises
    ------
    SceneError
        For a file that is missing or no such table; names the line and what to write.
    """
    path = existing(path)
    lines = _lines(path)
    if len(lines) < 3:
        remedy = f"write a header ({example}) and a line for each"
        raise SceneError(path, "holds fewer than two lines of numbers", remedy)
    factors: dict[str, float] = {}
    for cell in lines[0][1]:
        match = _HEADING.fullmatch(cell)
        name = match[1].lower() if match else ""
        if match is None or name not in columns:
            raise SceneError(path, f"has an unknown column '{cell.strip()}'", f"use {example}")
        if name in factors:
            raise SceneError(path, f"has two columns '{name}'", "leave one out")
        factors[name] = _factor(path, name, columns[name], (match[2] or "").strip())
    missing = [name for name in required if name not in factors]
    if missing:
        raise SceneError(path, f"has no column '{missing[0]}'", f"add it: {example}")
    rows = np.array([_row(path, number, cells, len(factors)) for number, cells in lines[1:]])
    table = {name: rows[:, i] * factor for i, (name, factor) in enumerate(factors.items())}
    falls = np.flatnonzero(np.diff(table["time"]) <= 0)
    if len(falls):
        line = lines[falls[0] + 2][0]
        raise SceneError(path, f"line {line}: the time does not rise", "sort the lines by time")
    return table


def _lines(path: Path) -> list[tuple[int, list[str]]]:
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
    try:
        if not unit:
            raise QuantityError("has none")
        return read_unit(unit, si_unit=si, example=example).to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        rule = f"the unit of column '{name}' {error.rule}"
        raise SceneError(path, rule, f"write e.g. {example}") from None


def _row(path: Path, number: int, cells: list[str], columns: int) -> list[float]:
    """Numbers of a line."""
    if len(cells) != columns:
        rule = f"line {number} has {len(cells)} cells under {columns} columns"
        raise SceneError(path, rule, "fill or cut it")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = [np.nan]
    if not np.isfinite(values).all():
        raise SceneError(path, f"line {number} holds no finite numbers", "write plain numbers")
    return values


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
    if not (np.abs(length - 1) < 1e-3).all():
        raise SceneError(path, "has quaternions of a length other than 1", "divide them by it")
    return np.asarray(q / length[:, None])
