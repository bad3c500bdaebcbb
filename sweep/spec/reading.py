"""A spec as written: YAML with the line of every value, and every mistake in plain words.

YAML becomes a `Document`, a plain mapping with the line of every value; what pydantic then finds
wrong with it becomes findings, which the document gives their lines.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from pydantic import BaseModel, ValidationError

import sweep.spec.parts as parts
from sweep.documents import is_text
from sweep.model.effects.phase_errors import ERROR_TABLE, NO_TABLE
from sweep.model.threshold import PROCESSING, WAYS
from sweep.plain_files import UnfitFileError, open_plain
from sweep.scenes.files import SceneError, read_columns
from sweep.spec.figures import Figure, SceneFigure
from sweep.spec.rules import (
    ABSENT,
    BROKEN_RULE,
    Finding,
    Location,
    Mistake,
    Numeric,
    Rejected,
    SpecError,
    dotted,
    near_miss,
    rejected,
    shown,
)
from sweep.spec.sections import parameter_rules

LARGEST_FILE = 1_000_000
DEEPEST = 30
MOST_NODES = 200_000

_INSTRUMENT: Location = ("instrument",)
_EXAMPLE = "settembrini_2026"
"""Instrument of the library that remedies name."""
_FLOOR = "error_floor"
_SECTIONS_OF_A_FILE = frozenset(
    {"title", "source", "doi", "published", "assumed", "numbers", _FLOOR, "instrument"}
)
"""Sections of an instrument's file; a study takes the last two."""
_LIBRARY = Path(__file__).parents[1] / "instruments"
_THRESHOLDS = {way.removeprefix(PROCESSING) for way in WAYS}

_MOST_DIGITS = 4000
"""Of a number: Python reads no more, unless it is asked to."""
_DECIMAL = re.compile(r"[+-]?(0|[1-9]\d*)(\.\d*)?([eE][+-]?\d{1,3})?")
_NO_FILE = "check the path, which is relative to the file that names it"
_NO_YAML = "look at the brackets, quotes, colons and indentation there and above"
_YAML_REMEDIES = {
    "'\\t'": "indent with blanks, not with tabs",
    "mapping values are not allowed": "put a blank after each colon, quotes around text that holds "
    "': ', and the same number of blanks before fields of one section",
    "found character": "put quotes around the text that holds it",
    "undefined alias": "define it above as '&name', or put quotes around text that begins with *",
    "another document": "keep one of them: a file holds one document, without lines '---' in it",
    "unexpected end of stream": "close the quotes of the text that begins there",
}
"""Remedies by what YAML's parser says."""
_PLAIN_TAGS = frozenset(
    f"tag:yaml.org,2002:{kind}"
    for kind in ("str", "int", "float", "bool", "null", "timestamp", "value", "map", "seq")
)
_MERGE_TAG = "tag:yaml.org,2002:merge"
_MERGE_KEY = "<<"
_EXTENSION = "x-"
"""Beginning of the names of sections that hold anchors for others, and are no part of a spec."""


class InstrumentFloor(NamedTuple):
    """Fields of a floor of errors that a study has from its instrument."""

    instrument: str
    """Name in the library, or path as written, of the instrument."""
    fields: dict[str, Any]
    """Fields that the study does not state, as the instrument's file has them."""


@dataclass
class Document:
    """A spec as written: values, their places and what is already known to be wrong."""

    value: dict[str, Any]
    places: dict[Location, tuple[str, int | None]] = field(default_factory=dict)
    """File and line of each location; no file and no line if it was not read from one."""
    findings: list[Finding] = field(default_factory=list)
    """Mistakes found on reading."""
    file: str = ""
    """The file read; empty where there is none."""
    nodes: int = 0
    """YAML's nodes read, each as often as an alias repeats it."""
    open_nodes: list[yaml.Node] = field(default_factory=list)
    """Mappings being read, each within the one before."""
    instrument_floor: InstrumentFloor | None = None
    """Floor of errors that comes with the instrument; None where the study states all of it."""

    @classmethod
    def from_plain(cls, value: dict[str, Any]) -> Document:
        """Make a document of plain data, which is in no file."""
        return cls(value, dict.fromkeys(_iter_locations(value, ()), ("", None)))

    def read(self, node: yaml.Node, location: Location) -> Any:
        """Value of one of YAML's nodes, whose places and mistakes are noted."""
        self.nodes += 1
        line = node.start_mark.line + 1
        if self.nodes > MOST_NODES or max(len(location), len(self.open_nodes)) > DEEPEST:
            path, rule = dotted(location)[:200], "holds too many values"
            raise SpecError([Mistake(path, rule, "", "repeat less with aliases", line, self.file)])
        self.places.setdefault(location, (self.file, line))
        if node.tag not in _PLAIN_TAGS:
            rule = f"has the tag {node.tag}, and tags are not read"
            self.findings.append(Finding(location, rule, "leave it out"))
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, location)
        if isinstance(node, yaml.SequenceNode):
            return [self.read(child, (*location, i)) for i, child in enumerate(node.value)]
        return _scalar(node)

    def _mapping(self, node: yaml.MappingNode, location: Location) -> dict[str, Any]:
        """Read a mapping with text keys; of a key given twice the first counts.

        A merge key, ``<<: *base``, brings the fields of other mappings that are not written here.
        """
        values: dict[str, Any] = {}
        merged_nodes: list[yaml.Node] = []
        self.open_nodes.append(node)
        for key_node, child in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                rule = "has a key that is no word"
                self.findings.append(Finding(location, rule, "begin it with a word"))
                continue
            key, line = key_node.value, key_node.start_mark.line + 1
            inside, is_merge = (*location, key), key_node.tag == _MERGE_TAG
            if key in values or (is_merge and merged_nodes):
                rule = f"is given twice, on lines {self.places[inside][1]} and {line}"
                remedy = "write '<<: [*first, *second]'" if is_merge else "keep one"
                self.findings.append(Finding(inside, rule, remedy))
                continue
            self.places[inside] = (self.file, line)
            if is_merge:
                is_list = isinstance(child, yaml.SequenceNode)
                merged_nodes = child.value if is_list else [child]
            else:
                values[key] = self.read(child, inside)
        fields: dict[str, Any] = {}
        for merged_node in reversed(merged_nodes):  # of several the first counts
            fields |= self._merged_fields(merged_node, location, values)
        self.open_nodes.pop()
        return fields | values

    def _merged_fields(
        self, node: yaml.Node, location: Location, written: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Fields of a mapping that a merge key names, and the places of those not written here.

        What is wrong in the mapping is told where it stands, and not once more here.
        """
        inside = (*location, _MERGE_KEY)
        if not isinstance(node, yaml.MappingNode):
            rule = "must name a mapping by its anchor, or a list of such"
            self.findings.append(Finding(inside, rule, "write e.g. '<<: *base'"))
            return {}
        if node in self.open_nodes:
            self.findings.append(Finding(inside, "merges a mapping into itself", "leave it out"))
            return {}
        base = Document({}, file=self.file, nodes=self.nodes, open_nodes=self.open_nodes)
        fields: dict[str, Any] = base.read(node, location)
        self.nodes, depth = base.nodes, len(location)
        for place, at in base.places.items():
            if len(place) > depth and place[depth] not in written:
                self.places[place] = at
        return fields

    def mistake(self, finding: Finding) -> Mistake:
        """Give a finding its file and line; those of the nearest place around it that has any.

        An instrument of the library is right by itself: what is wrong with its fields comes from
        what the user has written, and is told there.
        """
        location = finding.location
        while location and location not in self.places:
            location = location[:-1]
        file, line = self.places.get(location, (self.file, None))
        path, value, rule = dotted(finding.location), shown(finding.written), finding.rule
        if Path(file).parent == _LIBRARY and file != self.file:
            kept = _written_at(self.value, location)
            rule += "" if isinstance(kept, dict) else f" ({Path(file).stem} has {kept})"
            value = ""
            file, line = self._cause(finding)
        return Mistake(path, rule, value, finding.suggestion, line, file)

    def _cause(self, finding: Finding) -> tuple[str, int | None]:
        """File and line at which the user has set off a mistake in a field of the library's.

        That is a field that the finding names, by its path or in words, else one of the same
        section, else the instrument.
        """
        location, told = finding.location, f"{finding.rule} {finding.suggestion}"
        section = location if isinstance(_written_at(self.value, location), dict) else location[:-1]
        written = {place: at for place, at in self.places.items() if at[0] == self.file}
        fields = [place for place in written if len(place) > 1 and place[1] != "like"]
        fields.sort(key=lambda place: {"instrument": 0, "axes": 1}.get(str(place[0]), 2))
        by_words = {place: str(place[-1]).rpartition(".")[2].replace("_", " ") for place in fields}
        places = [
            *(tuple(path.split(".")) for path in re.findall(r"[a-z_]\w*(?:\.\w+)+", told)),
            *(
                place
                for place, words in by_words.items()
                if re.search(rf"\b{re.escape(words)}\b", told)
            ),
            *(place for place in fields if place[:-1] == section),
            (*_INSTRUMENT, "like"),
            _INSTRUMENT,
        ]
        return next((written[place] for place in places if place in written), (self.file, None))

    def mistakes(self, findings: Iterable[Finding]) -> list[Mistake]:
        """Return findings as they stand in the file, each once; those in other files come last."""
        mistakes = dict.fromkeys(self.mistake(finding) for finding in findings)
        return sorted(mistakes, key=lambda m: (m.file != self.file, m.file, m.line or 0))


def _iter_locations(value: Any, location: Location) -> Iterator[Location]:
    """Yield the locations of a value in plain data and of all that is in it."""
    yield location
    if isinstance(value, dict):
        for key, inside in value.items():
            yield from _iter_locations(inside, (*location, key))
    elif isinstance(value, list):
        for i, inside in enumerate(value):
            yield from _iter_locations(inside, (*location, i))


def _scalar(node: yaml.Node) -> Any:
    """Read a number, truth value, nothing or text; numbers in decimal notation only."""
    kind = node.tag.rsplit(":", 1)[-1]
    if kind == "null":
        return None
    if kind == "bool":
        return node.value.lower() in ("yes", "true", "on")
    short = len(node.value) <= _MOST_DIGITS
    if short and kind in ("int", "float") and _DECIMAL.fullmatch(node.value):
        return int(node.value) if node.value.lstrip("+-").isdigit() else float(node.value)
    return node.value


def read_document(path: Path) -> Document:
    """Read the mapping in a YAML file; lesser mistakes in it are left in the document.

    Raises
    ------
    SpecError
        Where the file is no readable YAML mapping.
    """
    return parsed(_read_text(path), path)


def parsed(text: str, path: Path) -> Document:
    """Parse a mapping in YAML text; mistakes in it are reported as those of a file."""
    try:
        root = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark, begun = error.problem_mark or error.context_mark, error.context_mark
        problem = f"{error.problem or error.context}".replace("\t", "\\t")
        rule = f"is no valid YAML: {problem}"
        if mark and begun and begun.line < mark.line:
            rule += f" (in what begins on line {begun.line + 1})"
        remedy = next((say for part, say in _YAML_REMEDIES.items() if part in problem), _NO_YAML)
        raise _file_error(path, rule, remedy, mark.line + 1 if mark else None) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        rule = f"is no valid YAML: {str(error).splitlines()[0]}"
        raise _file_error(path, rule, _NO_YAML) from None
    document = Document({}, file=str(path))
    if not isinstance(root, yaml.MappingNode):
        rule = "holds nothing" if root is None else "must hold a mapping of fields to values"
        raise _file_error(path, rule, "write e.g. 'title: A study', and a field on each line")
    document.value = without_extensions(document.read(root, ()))
    return document


def without_extensions(content: Mapping[str, Any]) -> dict[str, Any]:
    """Content of a file without the sections that hold anchors for others, ``x-...``."""
    return {name: value for name, value in content.items() if not name.startswith(_EXTENSION)}


def _read_text(path: Path) -> str:
    """Text of a file of reasonable size."""
    try:
        with open(open_plain(path), "rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise _file_error(path, "does not exist", similar_file(path)) from None
    except IsADirectoryError:
        raise _file_error(path, "is a directory", "name a YAML file") from None
    except UnfitFileError as error:
        raise _file_error(path, error.strerror or "", "name a YAML file") from None
    except (OSError, ValueError) as error:
        rule = f"cannot be read: {getattr(error, 'strerror', '') or error}"
        raise _file_error(path, rule, _NO_FILE) from None
    if len(content) > LARGEST_FILE:
        rule = f"is larger than {LARGEST_FILE} bytes"
        raise _file_error(path, rule, "give long axes as generators")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise _file_error(path, "is no UTF-8 text", "save it as UTF-8") from None


def _file_error(path: Path, rule: str, suggestion: str = "", line: int | None = None) -> SpecError:
    return SpecError([Mistake("", rule, "", suggestion, line, str(path))])


def similar_file(path: Path, *, otherwise: str = _NO_FILE) -> str:
    """Suggestion of a YAML file near a missing one, by its name without the suffix."""
    try:
        names = {p.stem: p.name for p in path.parent.iterdir() if p.suffix in (".yaml", ".yml")}
    except OSError:
        return otherwise
    suggestion = near_miss(path.stem, names)
    for stem, name in names.items():
        suggestion = suggestion.replace(repr(stem), repr(name))
    return suggestion or otherwise


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, which refuses deep nesting before Python's stack does."""

    depth = 0

    def compose_scalar_node(self, anchor: Any) -> Any:
        """Scalar of the document, whose escapes make whole characters."""
        node = super().compose_scalar_node(anchor)  # type: ignore[no-untyped-call]
        if not is_text(node.value):
            problem = "an escape there is half of a surrogate pair, and no character"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return node

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One node of the document."""
        self.depth += 1
        if self.depth > DEEPEST:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="it is nested too deeply", problem_mark=mark)
        node = super().compose_node(parent, index)  # type: ignore[no-untyped-call]
        self.depth -= 1
        return node


def resolve_instrument(document: Document, base: Path, *, has_floor: bool = False) -> bool:
    """Put an instrument of the library or of a file in the place of its name; False without one.

    With ``has_floor`` an instrument whose file has an ``error_floor`` brings that too, to a study
    that may have one; fields that the study states itself take its place.
    """
    written = document.value.get("instrument")
    reference, location = written, _INSTRUMENT
    overrides: dict[str, Any] = {}
    if isinstance(written, dict):
        _read_error_table(document, written, base)
        if "like" in written and "file" in written:
            rule = "names another instrument, besides instrument.like"
            document.findings.append(Finding(("instrument", "file"), rule, "keep one of them"))
            return False
        key = next((key for key in ("like", "file") if key in written), "")
        if not key:
            return True
        reference, location = written[key], ("instrument", key)
        overrides = {name: value for name, value in written.items() if name != key}
    elif not isinstance(written, str):
        return True
    try:
        read = _instrument_of(reference, location, base)
    except Rejected as error:
        document.findings += error.findings
        return False
    own = read.value["instrument"]
    _read_error_table(document, own, Path(read.file).parent)
    document.value["instrument"] = merged(_without_threshold(own, overrides), overrides)
    if has_floor and _FLOOR in read.value:
        _bring_floor(document, read.value[_FLOOR], str(reference))
    kept = {place: at for place, at in document.places.items() if _is_leaf(document.value, place)}
    within = {
        place: at
        for place, at in read.places.items()
        if place[:1] in (_INSTRUMENT, (_FLOOR,)) and place != _INSTRUMENT
    }
    document.places = document.places | within | kept
    document.findings += read.findings
    return True


def _bring_floor(document: Document, brought: object, instrument: str) -> None:
    """Put an instrument's floor of errors where a study does not state its own."""
    stated = document.value.get(_FLOOR, {})
    if not isinstance(stated, Mapping):  # which is told
        return
    if not isinstance(brought, Mapping):
        document.value.setdefault(
            _FLOOR, brought
        )  # what is wrong with it is told as of the study's
        return
    document.value[_FLOOR] = merged(brought, stated)
    if fields := {name: value for name, value in brought.items() if name not in stated}:
        document.instrument_floor = InstrumentFloor(instrument, fields)


def _read_error_table(document: Document, instrument: dict[str, Any], base: Path) -> None:
    """Put the rows of a CSV file of the sweep's error in the place of its path."""
    chirp, (*_, name) = instrument.get("chirp"), ERROR_TABLE.split(".")
    if not isinstance(chirp, dict) or not isinstance(chirp.get(name), str):
        return
    if (written := chirp[name]) == NO_TABLE:
        return
    columns, example = {"time": "s", "error": "Hz"}, "time [us], error [kHz]"
    try:
        table = read_columns(base / os.path.expanduser(written), columns, columns, example)
    except SceneError as error:
        rule = f"names a file that {error.rule}"
        location = tuple(ERROR_TABLE.split("."))
        document.findings.append(Finding(location, rule, error.remedy, written))
        chirp[name] = NO_TABLE
        return
    rows = zip(table["time"].tolist(), table["error"].tolist(), strict=True)
    chirp[name] = [[f"{time!r} s", f"{error!r} Hz"] for time, error in rows]


def _instrument_of(reference: object, location: Location, base: Path) -> Document:
    """Document of an instrument, where it stands as in a spec."""
    if not isinstance(reference, str):
        if "file" in location:
            remedy = "write it relative to this file"
            raise rejected(location, "must be the path of a YAML file", remedy, reference)
        rule = "must be the name of an instrument of the library"
        raise rejected(location, rule, f"the library has {', '.join(library())}", reference)
    file, known = base / os.path.expanduser(reference), library()
    if "file" not in location and reference in known:
        return read_document(known[reference])
    is_word = not re.search(r"[/\\]|\.ya?ml$", reference) and not os.path.exists(file)
    if "like" in location or (is_word and "file" not in location):
        words = re.sub(r"\W+", "_", reference.strip().lower())
        remedy = near_miss(words, known, otherwise=f"the library has {', '.join(known)}")
        raise rejected(location, "is no instrument of the library", remedy, reference)
    try:
        read = read_document(file)
    except SpecError as error:
        rule = f"names a file that {error.mistakes[0].rule}"
        raise rejected(location, rule, error.mistakes[0].suggestion, reference) from None
    return _with_sections(read)


def _with_sections(read: Document) -> Document:
    """Document of a user's instrument, in the sections that a file of the library has.

    Its file has them as well, or the instrument's fields at its root.
    """
    if "instrument" not in read.value:
        floor = {_FLOOR: read.value.pop(_FLOOR)} if _FLOOR in read.value else {}

        def moved(place: Location) -> Location:
            return place if place[:1] == (_FLOOR,) else (*_INSTRUMENT, *place)

        places = {moved(place): at for place, at in read.places.items()}
        findings = [replace(f, location=moved(f.location)) for f in read.findings]
        return Document({"instrument": read.value, **floor}, places, findings, read.file)
    findings, places = list(read.findings), dict(read.places)
    for name in sorted(read.value.keys() - _SECTIONS_OF_A_FILE):
        rule = "is no section of an instrument's file"
        remedy = near_miss(name, _SECTIONS_OF_A_FILE, otherwise="leave it out of that file")
        findings.append(Finding((*_INSTRUMENT, name), rule, remedy))
        places[(*_INSTRUMENT, name)] = places[(name,)]
    fields = read.value["instrument"]
    if not isinstance(fields, dict):
        rule = "must be a mapping of fields to values in an instrument's file"
        raise rejected(_INSTRUMENT, rule, f"write them below 'instrument:' in {read.file}", fields)
    return Document(read.value, places, findings, read.file)


def library() -> dict[str, Path]:
    """Files of the instruments that a spec may name, by name.

    Each file also names its publication, and the numbers that it must reproduce.

    >>> "settembrini_2026" in library()
    True
    """
    return {file.stem: file for file in sorted(_LIBRARY.glob("*.yaml"))}


def _without_threshold(instrument: Any, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return an instrument without its threshold, where the overrides set one in any way."""
    kept, anew = instrument.get("processing"), overrides.get("processing")
    if not (isinstance(kept, Mapping) and isinstance(anew, Mapping) and _THRESHOLDS & anew.keys()):
        return dict(instrument)
    return instrument | {"processing": {k: v for k, v in kept.items() if k not in _THRESHOLDS}}


def plain(data: Any, location: Location = ()) -> Any:
    """Copy plain data as YAML would give it: dicts with text keys, and lists."""
    if len(location) > DEEPEST:
        raise SpecError([Mistake(dotted(location), "is nested too deeply")])
    if isinstance(data, int) and data.bit_length() > _MOST_DIGITS:
        raise SpecError([Mistake(dotted(location), "is a number of too many digits")])
    if isinstance(data, Mapping) and not all(is_text(str(key)) for key in data):
        raise SpecError([Mistake(dotted(location), "has a key that is no text")])
    if isinstance(data, str) and not is_text(data):
        raise SpecError([Mistake(dotted(location), "has half of a surrogate pair, and is no text")])
    if isinstance(data, Mapping):
        return {str(key): plain(value, (*location, str(key))) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [plain(value, (*location, i)) for i, value in enumerate(data)]
    return data


def merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Lay overrides over a mapping, field by field."""
    result = dict(base)
    for key, value in overrides.items():
        below = result.get(key)
        both = isinstance(below, Mapping) and isinstance(value, Mapping)
        result[key] = merged(below, value) if both else value  # type: ignore[arg-type]
    return result


def _written_at(value: Any, location: Location) -> Any:
    """Value at a location; empty text where there is none."""
    try:
        for part in location:
            value = value[part]
    except (KeyError, IndexError, TypeError):
        return ""
    return value


def _is_leaf(value: Any, location: Location) -> bool:
    """Return true if the location holds something other than a mapping."""
    for part in location:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            return True
    return not isinstance(value, dict)


# Pydantic's errors in plain words

_PLAIN = {
    "model_type": "must be a mapping of fields to values",
    "model_attributes_type": "must be a mapping of fields to values",
    "dict_type": "must be a mapping",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "invalid_key": "must be a word",
}
_FLIES = "it is for studies with a scene, in place of a target"
_OTHER_STUDYS = {
    **dict.fromkeys(("scene", "target"), "a study has a scene or a target, not both"),
    **dict.fromkeys(("platform", "scanners", "error_floor", "navigation", "interface"), _FLIES),
}
"""Remedy for a section that only the other kind of study has."""

_DRAWN_BY = {
    parts.kind_of(model): target
    for kind, target in ((Figure, "a target"), (SceneFigure, "a scene"))
    for model in parts.models_at(kind)
}
"""Whose studies make a kind of figure."""


def findings_of(error: ValidationError, root: Any) -> list[Finding]:
    """Everything pydantic found wrong with a mapping read as `root`, one model or several."""
    return [_finding(dict(detail), root) for detail in error.errors(include_url=False)]


def _finding(detail: dict[str, Any], root: Any) -> Finding:
    """One error of pydantic's."""
    kind, written = detail["type"], detail["input"]
    place = parts.place_of(detail["loc"], root)
    location = place.location
    if kind == BROKEN_RULE:
        context, path = detail["ctx"], dotted(location)
        if isinstance(written, list | dict) and path in parameter_rules() and path != ERROR_TABLE:
            values = "[...]" if isinstance(written, list) else "{linear: [...], number: ...}"
            remedy = f"put several under axes: '{path}: {values}'"
            return Finding(location, "takes one value", remedy, written)
        shown = ABSENT if isinstance(written, dict) else written
        return Finding(location, context["rule"], context["suggestion"], shown)
    if kind == "missing":
        return Finding(location, "is missing", _remedy(place))
    if kind == "extra_forbidden":
        several = {parts.kind_of(model): model for model in parts.models_at(root)}
        model = several.get(detail["loc"][0], root)
        return Finding(location, "is no field", _sibling(place, model))
    if kind == "union_tag_invalid":
        tag, kinds = detail["ctx"]["tag"], [parts.kind_of(model) for model in place.models]
        rule = f"must be one of {', '.join(kinds)}"
        return Finding((*location, "kind"), rule, _other_kind(str(tag), kinds), tag)
    if kind == "union_tag_not_found":
        return Finding(location, "lacks its kind", f"write {_with_kind(place.models)}", written)
    rule = _PLAIN.get(kind, "has a value that cannot stand here")
    remedy = _remedy(place) if place.models else _remedy_of_list(place, kind)
    return Finding(location, rule, remedy, written)


def _remedy_of_list(place: parts.Place, kind: str) -> str:
    """Remedy for what must be a list or a mapping of parts, and is none."""
    if kind in ("list_type", "tuple_type"):
        return "put it in brackets, [...], or on lines that begin with '- '"
    return (
        f"write '{place.location[-1]}:' with a name and its fields below"
        if kind == "dict_type"
        else ""
    )


def _with_kind(models: parts.Models) -> str:
    """Text that a part of several kinds is written with."""
    return f"kind: and one of {', '.join(map(parts.kind_of, models))}"


def _other_kind(tag: str, kinds: list[str]) -> str:
    """Suggestion for a kind that is none of those here."""
    if tag in _DRAWN_BY and kinds[0] in _DRAWN_BY:
        return f"{tag} is for studies of {_DRAWN_BY[tag]}"
    return near_miss(tag, kinds)


def _remedy(place: parts.Place) -> str:
    """Remedy for a missing field or section."""
    name, section = place.location[-1], place.location[:-1]
    if place.location == _INSTRUMENT:
        return instrument_remedy()
    field = parts.fields_of(place.parents[0]).get(str(name)) if place.parents else None
    rule = parts.rule_of(field) if field is not None else None
    example = rule.example if rule is not None else ""
    if example:
        varies = isinstance(rule, Numeric) and dotted(place.location) in parameter_rules()
        return f"write e.g. '{name}: {example}'" + (", or put it on an axis" if varies else "")
    if isinstance(name, int) and place.models:
        kinds = len(place.models) > 1
        fields = _with_kind(place.models) if kinds else ", ".join(parts.fields_of(place.models[0]))
        return f"write a mapping with {fields}"
    if len(place.models) > 1:
        return f"write '{name}:' with {_with_kind(place.models)}"
    if place.models:
        remedy = f"write '{name}:' with {', '.join(parts.fields_of(place.models[0]))}"
        like = f", or take all that is missing from another: 'like: {_EXAMPLE}'"
        return remedy + (like if section == _INSTRUMENT else "")
    return f"write '{name}: ...'"


def instrument_remedy() -> str:
    """Remedy for a study without an instrument."""
    return (
        f"write e.g. 'instrument: {{like: {_EXAMPLE}}}' (the library has {', '.join(library())}), "
        "or all of its sections"
    )


def _sibling(place: parts.Place, root: type[BaseModel]) -> str:
    """Field that an unknown one resembles: beside it, else anywhere."""
    name = str(place.location[-1])
    beside = [field for model in place.parents for field in parts.fields_of(model)]
    if name in _OTHER_STUDYS and place.parents == (root,):
        return _OTHER_STUDYS[name]
    known = dict.fromkeys((*parameter_rules(), *parts.rules_of(root, "")))
    if name[:1].isdigit():
        return "a comma begins another field here: write numbers with a point, such as 2.5"
    if name in known:
        section, _, field = name.rpartition(".")
        return f"write '{field}: ...' in the section '{section}'"
    elsewhere = [path for path in known if path.rsplit(".", 1)[-1] == name]
    if elsewhere:
        return f"did you mean '{elsewhere[0]}'?"
    if suggestion := near_miss(name, beside):
        return suggestion
    return f"the fields here are {', '.join(beside)}" if beside else ""
