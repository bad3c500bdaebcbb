"""Zipped axes: several parameters that vary together, in pieces laid end to end."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from sweep.spec.axes import Axis, member_of, rule_at
from sweep.spec.generators import Rejected, Values, read_pieces, read_single
from sweep.spec.mistakes import ABSENT, Finding, Location
from sweep.spec.progressions import Progression

RESERVED = ("batch", "draw", "point", "spec")
"""Names of dimensions that a store may have besides its axes."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,60}")
_REMEDY = "take a word such as 'cut'"


def is_zip(written: object) -> bool:
    """Whether an axis is written as a zipped one."""
    return isinstance(written, dict) and "zip" in written


def zip_items(written: dict[str, Any]) -> list[tuple[str, object]]:
    """Paths and values of a zipped axis, piece after piece."""
    return [(str(path), value) for piece in _zip_pieces(written) for path, value in piece.items()]


def _zip_pieces(written: dict[str, Any]) -> list[dict[str, Any]]:
    """Pieces of a zipped axis, those that are mappings."""
    pieces = written["zip"] if isinstance(written["zip"], list) else [written["zip"]]
    return [piece for piece in pieces if isinstance(piece, dict)]


def read_zip(key: str, written: dict[str, Any], location: Location) -> Axis:
    """Zipped axis, each of whose pieces gives all of its parameters.

    Raises
    ------
    Rejected
        With every mistake in it.
    """
    findings = [
        Finding(
            (*location, str(other)), "is no part of a zipped axis", "write {zip: [...]}", ABSENT
        )
        for other in written
        if other != "zip"
    ]
    if _NAME.fullmatch(key) is None or key in RESERVED:
        findings.append(Finding(location, "is no name for an axis", _REMEDY, ABSENT))
    pieces: list[Any] = []
    inside: list[Location] = []
    if written["zip"] in ([], {}, None):
        findings.append(Finding((*location, "zip"), "holds no piece", "list at least one", ABSENT))
    elif isinstance(written["zip"], list):
        pieces, inside = written["zip"], [(*location, "zip", i) for i in range(len(written["zip"]))]
    else:
        pieces, inside = [written["zip"]], [(*location, "zip")]
    read: list[dict[str, list[Any]]] = []
    for piece, at in zip(pieces, inside, strict=True):
        try:
            read.append(_read_piece(piece, at))
        except Rejected as rejected:
            findings += rejected.findings
        else:
            findings += _unlike(read[0], read[-1], at)
    if findings:
        raise Rejected(*findings)
    return Axis(
        key,
        tuple(
            member_of(path, [values for piece in read for values in piece[path]], location)
            for path in read[0]
        ),
    )


def _unlike(first: dict[str, Any], piece: dict[str, Any], location: Location) -> list[Finding]:
    """A piece that sets other parameters than the first."""
    unlike = ", ".join(sorted(set(first) ^ set(piece)))
    if not unlike:
        return []
    return [
        Finding(
            location, "must set the same parameters as the first piece", f"mind {unlike}", ABSENT
        )
    ]


def _read_piece(piece: object, location: Location) -> dict[str, list[Any]]:
    """Values of one piece by path, all of one length."""
    if not isinstance(piece, dict) or not piece:
        raise Rejected(Finding(location, "must be a mapping of paths to values", "", piece))
    findings: list[Finding] = []
    read: dict[str, list[Any]] = {}
    for path, written in piece.items():
        inside = (*location, str(path))
        try:
            rule = rule_at(str(path), inside)
            several = isinstance(written, dict | list)
            read[path] = (
                list(read_pieces(written, rule, inside))
                if several
                else [read_single(written, rule, inside)]
            )
        except Rejected as rejected:
            findings += rejected.findings
    lengths = {path: _length(read[path]) for path in read if isinstance(piece[path], dict | list)}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{path} has {n}" for path, n in lengths.items())
        findings.append(Finding(location, f"must give as many values of each: {text}", "", ABSENT))
    if findings:
        raise Rejected(*findings)
    length = max(lengths.values(), default=1)
    return {
        path: values if path in lengths else _repeated(values, length)
        for path, values in read.items()
    }


def _length(pieces: list[Any]) -> int:
    """Number of values in pieces."""
    return sum(1 if isinstance(piece, str) else len(piece.si) for piece in pieces)


def _repeated(pieces: list[Any], number: int) -> list[Any]:
    """A single value, as often as the rest of its piece is long."""
    single = pieces[0]
    if isinstance(single, str):
        return [single] * number
    assert isinstance(single, Values)
    progression = (
        Progression(single.progression.start, number=number) if single.progression else None
    )
    return [replace(single, si=np.repeat(single.si, number), progression=progression)]
