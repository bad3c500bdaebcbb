"""YAML files as plain mappings, with the line of every value and every mistake in the YAML."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sweep.spec.mistakes import (
    ABSENT,
    Finding,
    Location,
    Mistake,
    SpecError,
    dotted,
    near_miss,
    shown,
)

LARGEST_FILE = 1_000_000
DEEPEST = 30
MOST_NODES = 200_000

_MOST_DIGITS = 4000
"""Of a number: Python reads no more, unless it is asked to."""
_DECIMAL = re.compile(r"[+-]?(0|[1-9]\d*)(\.\d*)?([eE][+-]?\d{1,3})?")
_NO_FILE = "check the path, which is relative to the file that names it"
_NO_YAML = "look at the brackets, quotes, colons and indentation there and above"
_PLAIN_TAGS = frozenset(
    f"tag:yaml.org,2002:{kind}"
    for kind in ("str", "int", "float", "bool", "null", "timestamp", "value", "map", "seq")
)


@dataclass
class Document:
    """A spec as written: values, their places and what is already known to be wrong.

    Parameters
    ----------
    value : dict
        The mapping.
    places : dict
        File and line of each location.
    findings : list of Finding
        Mistakes found on reading.
    file : str
        The file read; empty where there is none.
    """

    value: dict[str, Any]
    places: dict[Location, tuple[str, int]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    file: str = ""

    def mistake(self, finding: Finding) -> Mistake:
        """A finding with its file and line; those of the nearest place around it that has any."""
        location = finding.location
        while location and location not in self.places:
            location = location[:-1]
        file, line = self.places.get(location, (self.file, None))
        return Mistake(
            dotted(finding.location),
            finding.rule,
            shown(finding.written),
            finding.suggestion,
            line,
            file,
        )


def read_document(path: Path) -> Document:
    """Mapping in a YAML file.

    Raises
    ------
    SpecError
        Where the file is no readable YAML mapping. Lesser mistakes are left in the document.
    """
    return parsed(_read_text(path), path)


def parsed(text: str, path: Path) -> Document:
    """Mapping in YAML text, mistakes in which are told as those of a file.

    Raises
    ------
    SpecError
        As of :func:`read_document`.
    """
    try:
        root = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        rule = f"is no valid YAML: {error.problem or error.context}"
        raise _file_error(path, rule, _NO_YAML, mark.line + 1 if mark else None) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        rule = f"is no valid YAML: {str(error).splitlines()[0]}"
        raise _file_error(path, rule, _NO_YAML) from None
    document = Document({}, file=str(path))
    if not isinstance(root, yaml.MappingNode):
        raise _file_error(path, "must hold a mapping", "write e.g. 'title: A study'")
    document.value = _Walk(document).value(root, ())
    return document


def _read_text(path: Path) -> str:
    """Text of a file of reasonable size."""
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise _file_error(path, "does not exist", _similar_file(path)) from None
    except IsADirectoryError:
        raise _file_error(path, "is a directory", "name a YAML file") from None
    except (OSError, ValueError) as error:
        raise _file_error(
            path, f"cannot be read: {getattr(error, 'strerror', '') or error}", _NO_FILE
        ) from None
    if len(content) > LARGEST_FILE:
        raise _file_error(
            path, f"is larger than {LARGEST_FILE} bytes", "give long axes as generators"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise _file_error(path, "is no UTF-8 text", "save it as UTF-8") from None


def _file_error(path: Path, rule: str, suggestion: str = "", line: int | None = None) -> SpecError:
    return SpecError([Mistake("", rule, "", suggestion, line, str(path))])


def _similar_file(path: Path) -> str:
    """Suggestion of a file beside the missing one."""
    try:
        names = [p.name for p in path.parent.iterdir() if p.suffix in (".yaml", ".yml")]
    except OSError:
        return _NO_FILE
    return near_miss(path.name, names, otherwise=_NO_FILE)


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, which refuses deep nesting before Python's stack does."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One node of the document."""
        self.depth += 1
        if self.depth > DEEPEST:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="it is nested too deeply", problem_mark=mark)
        node = super().compose_node(parent, index)  # type: ignore[no-untyped-call]
        self.depth -= 1
        return node


@dataclass
class _Walk:
    """A walk over YAML's nodes that builds values and notes places."""

    document: Document
    nodes: int = 0

    def value(self, node: yaml.Node, location: Location) -> Any:
        """Value of a node."""
        self.nodes += 1
        line = node.start_mark.line + 1
        if self.nodes > MOST_NODES or len(location) > DEEPEST:
            raise SpecError(
                [
                    Mistake(
                        dotted(location)[:200],
                        "holds too many values",
                        "",
                        "repeat less with aliases",
                        line,
                        self.document.file,
                    )
                ]
            )
        self.document.places.setdefault(location, (self.document.file, line))
        if node.tag not in _PLAIN_TAGS:
            rule = f"has the tag {node.tag}, and tags are not read"
            self.finding(location, rule, "leave it out", ABSENT)
        if isinstance(node, yaml.MappingNode):
            return self.mapping(node, location)
        if isinstance(node, yaml.SequenceNode):
            return [self.value(child, (*location, i)) for i, child in enumerate(node.value)]
        return self.scalar(node, location)

    def mapping(self, node: yaml.MappingNode, location: Location) -> dict[str, Any]:
        """Mapping with text keys; of a key given twice the first counts."""
        values: dict[str, Any] = {}
        for key_node, child in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                self.finding(location, "has a key that is no word", "begin it with a word", ABSENT)
                continue
            key = key_node.value
            line = key_node.start_mark.line + 1
            if key in values:
                first = self.document.places[(*location, key)][1]
                self.finding(
                    (*location, f"{key}"),
                    f"is given twice, on lines {first} and {line}",
                    "keep one",
                    ABSENT,
                )
                continue
            self.document.places[(*location, key)] = (self.document.file, line)
            values[key] = self.value(child, (*location, key))
        return values

    def scalar(self, node: yaml.Node, location: Location) -> Any:
        """Number, truth value, nothing or text; numbers in decimal notation only."""
        kind = node.tag.rsplit(":", 1)[-1]
        if kind == "null":
            return None
        if kind == "bool":
            return node.value.lower() in ("yes", "true", "on")
        short = len(node.value) <= _MOST_DIGITS
        if short and kind in ("int", "float") and _DECIMAL.fullmatch(node.value):
            return int(node.value) if node.value.lstrip("+-").isdigit() else float(node.value)
        return node.value

    def finding(self, location: Location, rule: str, suggestion: str, written: object) -> None:
        """A mistake to be reported with all the others."""
        self.document.findings.append(Finding(location, rule, suggestion, written))


def resolve_instrument(document: Document, base: Path) -> bool:
    """A document whose instrument is no reference to a file any more, changed in place.

    Returns
    -------
    bool
        Whether the instrument is there: False where its file could not be read.
    """
    written = document.value.get("instrument")
    reference: object = written
    overrides: dict[str, Any] = {}
    location: Location = ("instrument",)
    if isinstance(written, dict) and "file" in written:
        reference, location = written["file"], ("instrument", "file")
        overrides = {key: value for key, value in written.items() if key != "file"}
    elif not isinstance(written, str):
        return True
    if not isinstance(reference, str):
        document.findings.append(
            Finding(location, "must be the path of a YAML file", "", reference)
        )
        return False
    try:
        read = read_document(base / os.path.expanduser(reference))
    except SpecError as error:
        rule = f"names a file that {error.mistakes[0].rule}"
        document.findings.append(Finding(location, rule, error.mistakes[0].suggestion, reference))
        return False
    document.value["instrument"] = merged(read.value, overrides)
    own = {place: at for place, at in document.places.items() if _is_leaf(document.value, place)}
    inside = {("instrument", *place): at for place, at in read.places.items() if place}
    document.places = document.places | inside | own
    document.findings += [
        Finding(("instrument", *f.location), f.rule, f.suggestion, f.written) for f in read.findings
    ]
    return True


def plain(data: Any, location: Location = ()) -> Any:
    """A copy of plain data as YAML would give it: dicts with text keys, and lists.

    Raises
    ------
    SpecError
        Where it is nested too deeply, or a number is too long to be read.
    """
    if len(location) > DEEPEST:
        raise SpecError([Mistake(dotted(location), "is nested too deeply")])
    if isinstance(data, int) and data.bit_length() > _MOST_DIGITS:
        raise SpecError([Mistake(dotted(location), "is a number of too many digits")])
    if isinstance(data, Mapping):
        return {str(key): plain(value, (*location, str(key))) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [plain(value, (*location, i)) for i, value in enumerate(data)]
    return data


def merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Mapping with the overrides laid over it, field by field."""
    result = dict(base)
    for key, value in overrides.items():
        below = result.get(key)
        both = isinstance(below, Mapping) and isinstance(value, Mapping)
        result[key] = merged(below, value) if both else value  # type: ignore[arg-type]
    return result


def _is_leaf(value: Any, location: Location) -> bool:
    """Whether the location holds something other than a mapping."""
    for part in location:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            return True
    return not isinstance(value, dict)
