"""Reading of a spec as written: YAML text to a `Document`, and errors to findings with lines.

A `Document` is a mapping of plain data with the file and line of every value. It turns findings
about values into mistakes that name their file and line.
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

import sweep.spec.fields as spec_fields
from sweep.model.effects.phase_errors import ERROR_TABLE_PATH, NO_TABLE
from sweep.model.threshold import PROCESSING_PREFIX, THRESHOLD_PATHS
from sweep.regular_files import RefusedFileError, open_regular_file
from sweep.safe_json import is_utf8_encodable
from sweep.scenes.scene_files import SceneError, read_csv_columns
from sweep.spec.figure_sections import GridFigure, SceneFigure
from sweep.spec.rules import (
    MISSING,
    RULE_ERROR_TYPE,
    Finding,
    FindingsError,
    Mistake,
    NumericRule,
    SpecError,
    SpecLocation,
    dotted_path,
    format_raw_value,
    single_finding_error,
    suggest_similar_name,
)
from sweep.spec.sections import parameter_rules

YAML_FILE_BYTES_MAX = 1_000_000
"""Largest size of a YAML file that is read [bytes]."""
NESTING_DEPTH_MAX = 30
"""Largest depth of nested mappings and lists in a spec."""
YAML_NODES_MAX = 200_000
"""Largest number of YAML nodes in a document; a node counts once more for each alias that repeats
it."""

_INSTRUMENT_LOCATION: SpecLocation = ("instrument",)
_EXAMPLE_INSTRUMENT = "settembrini_2026"
"""Name of the library's instrument that error messages give as an example."""
_ERROR_FLOOR_KEY = "error_floor"
"""Name of the section with the instrument's errors that do not decrease with signal strength."""
_INSTRUMENT_FILE_SECTIONS = frozenset(
    {
        "title",
        "source",
        "doi",
        "published",
        "assumed",
        "numbers",
        _ERROR_FLOOR_KEY,
        "instrument",
    }
)
"""Names of the sections of an instrument's file; a study uses only `error_floor` and
`instrument`."""
_INSTRUMENT_LIBRARY_FOLDER = Path(__file__).parents[1] / "instruments"
"""Folder of the library: the YAML files of the instruments that come with this package."""
_THRESHOLD_FIELDS = {way.removeprefix(PROCESSING_PREFIX) for way in THRESHOLD_PATHS}
"""Fields of ``instrument.processing`` that set the threshold; a spec has exactly one of them."""

_NUMBER_DIGITS_MAX = 4000
"""Largest number of characters of a number in YAML, and of bits of an integer in plain data.

Longer numbers in YAML are read as text. Python refuses integers of more than 4300 digits.
"""
_DECIMAL_PATTERN = re.compile(r"[+-]?(0|[1-9]\d*)(\.\d*)?([eE][+-]?\d{1,3})?")
"""Regular expression for a number in decimal notation."""
_FILE_PATH_REMEDY = "check the path, which is relative to the file that names it"
_SYNTAX_REMEDY = "look at the brackets, quotes, colons and indentation there and above"
_YAML_ERROR_REMEDIES = {
    "'\\t'": "indent with blanks, not with tabs",
    "mapping values are not allowed": "put a blank after each colon, quotes around text that holds "
    "': ', and the same number of blanks before fields of one section",
    "found character": "put quotes around the text that holds it",
    "undefined alias": "define it above as '&name', or put quotes around text that begins with *",
    "another document": "keep one of them: a file holds one document, without lines '---' in it",
    "unexpected end of stream": "close the quotes of the text that begins there",
}
"""Advice to the user on a YAML error, by a phrase in the parser's message."""
_STANDARD_TAGS = frozenset(
    f"tag:yaml.org,2002:{kind}"
    for kind in ("str", "int", "float", "bool", "null", "timestamp", "value", "map", "seq")
)
"""YAML tags that a spec may have; any other tag is a mistake."""
_MERGE_TAG = "tag:yaml.org,2002:merge"
_MERGE_KEY = "<<"
_ANCHOR_SECTION_PREFIX = "x-"
"""Prefix of the names of sections that hold only YAML anchors, for use in other sections."""


class InstrumentErrorFloor(NamedTuple):
    """Fields of a study's error floor that come from its instrument."""

    instrument_reference: str
    """Name of the instrument in the library, or the path of its file as written in the spec."""
    fields: dict[str, Any]
    """Values as written in the instrument's file, by field; only fields that the study does not
    state."""


@dataclass
class Document:
    """A spec as written: values, their files and lines, and mistakes in the YAML text."""

    content: dict[str, Any]
    """The spec as dicts with text keys, lists and scalars."""
    source_positions: dict[SpecLocation, tuple[str, int | None]] = field(default_factory=dict)
    """File and line of the value at each location; an empty file and None if the value is from no
    file."""
    findings: list[Finding] = field(default_factory=list)
    """Mistakes in the YAML text of the spec and of its instrument's file."""
    file: str = ""
    """Path of the spec's file; empty if the spec is not from a file."""
    n_nodes: int = 0
    """Number of YAML nodes read so far; a node counts once more for each alias that repeats it."""
    enclosing_mappings: list[yaml.Node] = field(default_factory=list)
    """Mappings around the YAML node that is being read, the outermost first."""
    instrument_error_floor: InstrumentErrorFloor | None = None
    """Fields of the section error_floor that come from the instrument; None if there are none."""

    @classmethod
    def from_plain_data(cls, content: dict[str, Any]) -> Document:
        """Return a `Document` of a dict that is not from a file, without files and lines."""
        return cls(content, dict.fromkeys(_iter_locations(content, ()), ("", None)))

    def read_node(self, node: yaml.Node, location: SpecLocation) -> Any:
        """Return the value of a YAML node; record positions and mistakes in this document.

        Parameters
        ----------
        node : yaml.Node
            Scalar, sequence or mapping.
        location : SpecLocation
            Keys and indices that lead to the node.

        Raises
        ------
        SpecError
            If the document has too many nodes or is nested too deeply.
        """
        self.n_nodes += 1
        line = node.start_mark.line + 1
        if (
            self.n_nodes > YAML_NODES_MAX
            or max(len(location), len(self.enclosing_mappings)) > NESTING_DEPTH_MAX
        ):
            path, problem = dotted_path(location)[:200], "holds too many values"
            raise SpecError(
                [Mistake(path, problem, "", "repeat less with aliases", line, self.file)]
            )
        self.source_positions.setdefault(location, (self.file, line))
        if node.tag not in _STANDARD_TAGS:
            problem = f"has the tag {node.tag}, and tags are not read"
            self.findings.append(Finding(location, problem, "leave it out"))
        if isinstance(node, yaml.MappingNode):
            return self._read_mapping(node, location)
        if isinstance(node, yaml.SequenceNode):
            return [self.read_node(child, (*location, i)) for i, child in enumerate(node.value)]
        return _read_scalar(node)

    def _read_mapping(self, node: yaml.MappingNode, location: SpecLocation) -> dict[str, Any]:
        """Return the dict of a YAML mapping; record positions and mistakes in this document.

        If a key occurs twice, its first value counts. A merge key, ``<<: *base``, adds the fields
        of another mapping that this mapping does not have.
        """
        values: dict[str, Any] = {}
        merged_nodes: list[yaml.Node] = []
        self.enclosing_mappings.append(node)
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                problem = "has a key that is no word"
                self.findings.append(Finding(location, problem, "begin it with a word"))
                continue
            key, line = key_node.value, key_node.start_mark.line + 1
            key_location, is_merge = (*location, key), key_node.tag == _MERGE_TAG
            if key in values or (is_merge and merged_nodes):
                problem = (
                    f"is given twice, on lines {self.source_positions[key_location][1]} and {line}"
                )
                remedy = "write '<<: [*first, *second]'" if is_merge else "keep one"
                self.findings.append(Finding(key_location, problem, remedy))
                continue
            self.source_positions[key_location] = (self.file, line)
            if is_merge:
                is_list = isinstance(value_node, yaml.SequenceNode)
                merged_nodes = value_node.value if is_list else [value_node]
            else:
                values[key] = self.read_node(value_node, key_location)
        fields: dict[str, Any] = {}
        for merged_node in reversed(merged_nodes):  # earlier mappings override later ones
            fields |= self._read_merged_fields(merged_node, location, values)
        self.enclosing_mappings.pop()
        return fields | values

    def _read_merged_fields(
        self, node: yaml.Node, location: SpecLocation, written_fields: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the fields of the mapping under a merge key; record the positions of their values.

        Fields named in `written_fields` override merged fields and keep their positions. Mistakes
        within the merged mapping are reported at its anchor and not here.
        """
        merge_location = (*location, _MERGE_KEY)
        if not isinstance(node, yaml.MappingNode):
            problem = "must name a mapping by its anchor, or a list of such"
            self.findings.append(Finding(merge_location, problem, "write e.g. '<<: *base'"))
            return {}
        if node in self.enclosing_mappings:
            self.findings.append(
                Finding(merge_location, "merges a mapping into itself", "leave it out")
            )
            return {}
        base_document = Document(
            {}, file=self.file, n_nodes=self.n_nodes, enclosing_mappings=self.enclosing_mappings
        )
        fields: dict[str, Any] = base_document.read_node(node, location)
        self.n_nodes, depth = base_document.n_nodes, len(location)
        for inner_location, position in base_document.source_positions.items():
            if len(inner_location) > depth and inner_location[depth] not in written_fields:
                self.source_positions[inner_location] = position
        return fields

    def mistake_from_finding(self, finding: Finding) -> Mistake:
        """Return a `Mistake`: a finding with the file and line of its location.

        If the location is not in a file, the line is that of the enclosing section.

        A file of the library has no mistakes by itself. A mistake in one of its values is therefore
        located at the user's field that contradicts the value.
        """
        location = finding.location
        while location and location not in self.source_positions:
            location = location[:-1]
        file, line = self.source_positions.get(location, (self.file, None))
        path, value, rule = (
            dotted_path(finding.location),
            format_raw_value(finding.raw_value),
            finding.problem,
        )
        if Path(file).parent == _INSTRUMENT_LIBRARY_FOLDER and file != self.file:
            library_value = _value_at_location(self.content, location)
            rule += (
                ""
                if isinstance(library_value, dict)
                else f" ({Path(file).stem} has {library_value})"
            )
            value = ""
            file, line = self._locate_cause(finding)
        return Mistake(path, rule, value, finding.suggestion, line, file)

    def _locate_cause(self, finding: Finding) -> tuple[str, int | None]:
        """Return file and line of the user's field that contradicts a value of the library.

        The result is the first of the following that is in the user's file: a field that the
        finding names by path or in words, a field in the finding's section, the name of the
        instrument. If the file has none of them, the line is None.
        """
        location, message = finding.location, f"{finding.problem} {finding.suggestion}"
        section = (
            location
            if isinstance(_value_at_location(self.content, location), dict)
            else location[:-1]
        )
        user_positions = {
            field_location: position
            for field_location, position in self.source_positions.items()
            if position[0] == self.file
        }
        user_fields = [
            field_location
            for field_location in user_positions
            if len(field_location) > 1 and field_location[1] != "like"
        ]
        user_fields.sort(
            key=lambda field_location: {"instrument": 0, "axes": 1}.get(str(field_location[0]), 2)
        )
        words_by_location = {
            field_location: str(field_location[-1]).rpartition(".")[2].replace("_", " ")
            for field_location in user_fields
        }
        candidates = [
            *(tuple(path.split(".")) for path in re.findall(r"[a-z_]\w*(?:\.\w+)+", message)),
            *(
                field_location
                for field_location, words in words_by_location.items()
                if re.search(rf"\b{re.escape(words)}\b", message)
            ),
            *(field_location for field_location in user_fields if field_location[:-1] == section),
            (*_INSTRUMENT_LOCATION, "like"),
            _INSTRUMENT_LOCATION,
        ]
        return next(
            (
                user_positions[field_location]
                for field_location in candidates
                if field_location in user_positions
            ),
            (self.file, None),
        )

    def mistakes_from_findings(self, findings: Iterable[Finding]) -> list[Mistake]:
        """Return findings as a list of `Mistake` without duplicates, sorted by file and line.

        Mistakes in the spec's file come first.
        """
        mistakes = dict.fromkeys(self.mistake_from_finding(finding) for finding in findings)
        return sorted(
            mistakes,
            key=lambda mistake: (mistake.file != self.file, mistake.file, mistake.line or 0),
        )


def _iter_locations(value: Any, location: SpecLocation) -> Iterator[SpecLocation]:
    """Yield the location of a value, and of every value within it if it is a dict or list."""
    yield location
    if isinstance(value, dict):
        for key, inner_value in value.items():
            yield from _iter_locations(inner_value, (*location, key))
    elif isinstance(value, list):
        for i, inner_value in enumerate(value):
            yield from _iter_locations(inner_value, (*location, i))


def _read_scalar(node: yaml.Node) -> Any:
    """Return the value of a YAML scalar: number in decimal notation, truth value, None or text."""
    tag = node.tag.rsplit(":", 1)[-1]
    if tag == "null":
        return None
    if tag == "bool":
        return node.value.lower() in ("yes", "true", "on")
    is_short = len(node.value) <= _NUMBER_DIGITS_MAX
    if is_short and tag in ("int", "float") and _DECIMAL_PATTERN.fullmatch(node.value):
        return int(node.value) if node.value.lstrip("+-").isdigit() else float(node.value)
    return node.value


def read_document(path: Path) -> Document:
    """Return the `Document` of a YAML file that holds a mapping.

    Parameters
    ----------
    path : Path
        YAML file.

    Returns
    -------
    Document
        Content with lines; its `findings` hold mistakes that do not prevent reading.

    Raises
    ------
    SpecError
        If the file is missing, too large or no YAML mapping.
    """
    return parse_document(_read_text(path), path)


def parse_document(text: str, path: Path) -> Document:
    """Return the `Document` of a YAML text that holds a mapping.

    Parameters
    ----------
    text : str
        YAML text.
    path : Path
        Path of the file that the text is from, for mistakes.

    Returns
    -------
    Document
        Content with lines; its `findings` hold mistakes that do not prevent reading.

    Raises
    ------
    SpecError
        If the text is no YAML mapping.
    """
    try:
        root = yaml.compose(text, Loader=_DepthLimitedLoader)
    except yaml.MarkedYAMLError as error:
        mark, context_mark = error.problem_mark or error.context_mark, error.context_mark
        yaml_problem = f"{error.problem or error.context}".replace("\t", "\\t")
        problem = f"is no valid YAML: {yaml_problem}"
        if mark and context_mark and context_mark.line < mark.line:
            problem += f" (in what begins on line {context_mark.line + 1})"
        remedy = next(
            (
                remedy_text
                for phrase, remedy_text in _YAML_ERROR_REMEDIES.items()
                if phrase in yaml_problem
            ),
            _SYNTAX_REMEDY,
        )
        raise _file_error(path, problem, remedy, mark.line + 1 if mark else None) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = f"is no valid YAML: {str(error).splitlines()[0]}"
        raise _file_error(path, problem, _SYNTAX_REMEDY) from None
    document = Document({}, file=str(path))
    if not isinstance(root, yaml.MappingNode):
        problem = "holds nothing" if root is None else "must hold a mapping of fields to values"
        raise _file_error(path, problem, "write e.g. 'title: A study', and a field on each line")
    document.content = drop_anchor_sections(document.read_node(root, ()))
    return document


def drop_anchor_sections(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a file's content as a dict without the sections ``x-...``, which hold only anchors."""
    return {
        name: value
        for name, value in content.items()
        if not name.startswith(_ANCHOR_SECTION_PREFIX)
    }


def _read_text(path: Path) -> str:
    """Return the text of a file; raise `SpecError` if it can't be read.

    Files of more than `YAML_FILE_BYTES_MAX` bytes are refused with the same error.
    """
    try:
        with open(open_regular_file(path), "rb") as file:
            content = file.read(YAML_FILE_BYTES_MAX + 1)
    except FileNotFoundError:
        raise _file_error(path, "does not exist", suggest_similar_file(path)) from None
    except IsADirectoryError:
        raise _file_error(path, "is a directory", "name a YAML file") from None
    except RefusedFileError as error:
        raise _file_error(path, error.strerror or "", "name a YAML file") from None
    except (OSError, ValueError) as error:
        problem = f"cannot be read: {getattr(error, 'strerror', '') or error}"
        raise _file_error(path, problem, _FILE_PATH_REMEDY) from None
    if len(content) > YAML_FILE_BYTES_MAX:
        problem = f"is larger than {YAML_FILE_BYTES_MAX} bytes"
        raise _file_error(path, problem, "give long axes as generators")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise _file_error(path, "is no UTF-8 text", "save it as UTF-8") from None


def _file_error(
    path: Path, problem: str, suggestion: str = "", line: int | None = None
) -> SpecError:
    """Return a `SpecError` with one mistake about a file, or about one of its lines."""
    return SpecError([Mistake("", problem, "", suggestion, line, str(path))])


def suggest_similar_file(path: Path, *, fallback: str = _FILE_PATH_REMEDY) -> str:
    """Return advice on a missing YAML file: the name of a similar file in its folder.

    Parameters
    ----------
    path : Path
        Missing file.
    fallback : str
        Result if no file resembles it.
    """
    try:
        names = {
            sibling.stem: sibling.name
            for sibling in path.parent.iterdir()
            if sibling.suffix in (".yaml", ".yml")
        }
    except OSError:
        return fallback
    suggestion = suggest_similar_name(path.stem, names)
    for stem, name in names.items():
        suggestion = suggestion.replace(repr(stem), repr(name))
    return suggestion or fallback


class _DepthLimitedLoader(yaml.SafeLoader):
    """Safe loader of YAML that refuses deep nesting before Python's recursion limit is reached."""

    depth = 0
    """Depth of the YAML node that is being read."""

    def compose_scalar_node(self, anchor: Any) -> Any:
        """Return the next scalar node; raise a YAML error for half a surrogate pair."""
        node = super().compose_scalar_node(anchor)  # type: ignore[no-untyped-call]
        if not is_utf8_encodable(node.value):
            problem = "an escape there is half of a surrogate pair, and no character"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return node

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next YAML node; raise a YAML error if it is nested too deeply."""
        self.depth += 1
        if self.depth > NESTING_DEPTH_MAX:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="it is nested too deeply", problem_mark=mark)
        node = super().compose_node(parent, index)  # type: ignore[no-untyped-call]
        self.depth -= 1
        return node


def resolve_instrument(document: Document, base: Path, *, takes_floor: bool = False) -> bool:
    """Replace the name or path of an instrument in a document by the instrument's fields, in place.

    Fields that the user states override those of the instrument.

    Parameters
    ----------
    document : Document
        Spec as read; changed by this function, which also adds findings to it.
    base : Path
        Folder that paths in the spec are relative to.
    takes_floor : bool
        True for a study with an error floor. The instrument's ``error_floor`` then supplies the
        fields that the study does not state.

    Returns
    -------
    bool
        False if the reference can't be resolved.
    """
    raw_instrument = document.content.get("instrument")
    reference, location = raw_instrument, _INSTRUMENT_LOCATION
    overrides: dict[str, Any] = {}
    if isinstance(raw_instrument, dict):
        _load_frequency_error_table(document, raw_instrument, base)
        if "like" in raw_instrument and "file" in raw_instrument:
            problem = "names another instrument, besides instrument.like"
            document.findings.append(Finding(("instrument", "file"), problem, "keep one of them"))
            return False
        key = next((key for key in ("like", "file") if key in raw_instrument), "")
        if not key:
            return True
        reference, location = raw_instrument[key], ("instrument", key)
        overrides = {name: value for name, value in raw_instrument.items() if name != key}
    elif not isinstance(raw_instrument, str):
        return True
    try:
        instrument_document = _read_instrument(reference, location, base)
    except FindingsError as error:
        document.findings += error.findings
        return False
    instrument_fields = instrument_document.content["instrument"]
    _load_frequency_error_table(document, instrument_fields, Path(instrument_document.file).parent)
    document.content["instrument"] = merge_mappings(
        _drop_overridden_threshold(instrument_fields, overrides), overrides
    )
    if takes_floor and _ERROR_FLOOR_KEY in instrument_document.content:
        _merge_error_floor(document, instrument_document.content[_ERROR_FLOOR_KEY], str(reference))
    kept_positions = {
        value_location: position
        for value_location, position in document.source_positions.items()
        if _is_leaf(document.content, value_location)
    }
    instrument_positions = {
        value_location: position
        for value_location, position in instrument_document.source_positions.items()
        if value_location[:1] in (_INSTRUMENT_LOCATION, (_ERROR_FLOOR_KEY,))
        and value_location != _INSTRUMENT_LOCATION
    }
    document.source_positions = document.source_positions | instrument_positions | kept_positions
    document.findings += instrument_document.findings
    return True


def _merge_error_floor(document: Document, instrument_floor: object, instrument_name: str) -> None:
    """Add to a document the fields of the instrument's error floor that the study does not state.

    Fields that are added are also noted in the document's `instrument_error_floor`.
    """
    study_floor = document.content.get(_ERROR_FLOOR_KEY, {})
    if not isinstance(study_floor, Mapping):  # validation reports this mistake
        return
    if not isinstance(instrument_floor, Mapping):
        document.content.setdefault(
            _ERROR_FLOOR_KEY, instrument_floor
        )  # mistakes in it are reported as the study's
        return
    document.content[_ERROR_FLOOR_KEY] = merge_mappings(instrument_floor, study_floor)
    if added_fields := {
        name: value for name, value in instrument_floor.items() if name not in study_floor
    }:
        document.instrument_error_floor = InstrumentErrorFloor(instrument_name, added_fields)


def _load_frequency_error_table(document: Document, instrument: dict[str, Any], base: Path) -> None:
    """Replace a CSV file's path by the file's rows in an instrument's fields, in place.

    The CSV file holds the sweep's frequency error over time. Mistakes in the file are added to the
    findings of `document`.
    """
    chirp, (*_, name) = instrument.get("chirp"), ERROR_TABLE_PATH.split(".")
    if not isinstance(chirp, dict) or not isinstance(chirp.get(name), str):
        return
    if (raw_path := chirp[name]) == NO_TABLE:
        return
    columns, example = {"time": "s", "error": "Hz"}, "time [us], error [kHz]"
    try:
        table = read_csv_columns(base / os.path.expanduser(raw_path), columns, columns, example)
    except SceneError as error:
        problem = f"names a file that {error.problem}"
        location = tuple(ERROR_TABLE_PATH.split("."))
        document.findings.append(Finding(location, problem, error.remedy, raw_path))
        chirp[name] = NO_TABLE
        return
    rows = zip(table["time"].tolist(), table["error"].tolist(), strict=True)
    chirp[name] = [[f"{time!r} s", f"{error!r} Hz"] for time, error in rows]


def _read_instrument(reference: object, location: SpecLocation, base: Path) -> Document:
    """Return the document of an instrument, with the sections of a file of the library.

    `reference` is the instrument's name in the library, or the path of a file. Raise
    `FindingsError` if it denotes no instrument.
    """
    if not isinstance(reference, str):
        if "file" in location:
            remedy = "write it relative to this file"
            raise single_finding_error(
                location, "must be the path of a YAML file", remedy, reference
            )
        problem = "must be the name of an instrument of the library"
        raise single_finding_error(
            location, problem, f"the library has {', '.join(library_instrument_files())}", reference
        )
    file, files_by_name = base / os.path.expanduser(reference), library_instrument_files()
    if "file" not in location and reference in files_by_name:
        return read_document(files_by_name[reference])
    is_plain_word = not re.search(r"[/\\]|\.ya?ml$", reference) and not os.path.exists(file)
    if "like" in location or (is_plain_word and "file" not in location):
        normalised_name = re.sub(r"\W+", "_", reference.strip().lower())
        remedy = suggest_similar_name(
            normalised_name, files_by_name, fallback=f"the library has {', '.join(files_by_name)}"
        )
        raise single_finding_error(location, "is no instrument of the library", remedy, reference)
    try:
        instrument_document = read_document(file)
    except SpecError as error:
        problem = f"names a file that {error.mistakes[0].problem}"
        raise single_finding_error(
            location, problem, error.mistakes[0].suggestion, reference
        ) from None
    return _normalise_instrument_file(instrument_document)


def _normalise_instrument_file(document: Document) -> Document:
    """Return the document of a user's instrument with the sections of a file of the library.

    The user's file may have these sections, or the instrument's fields at its root.
    """
    if "instrument" not in document.content:
        floor_section = (
            {_ERROR_FLOOR_KEY: document.content.pop(_ERROR_FLOOR_KEY)}
            if _ERROR_FLOOR_KEY in document.content
            else {}
        )

        def move_below_instrument(location: SpecLocation) -> SpecLocation:
            return (
                location
                if location[:1] == (_ERROR_FLOOR_KEY,)
                else (*_INSTRUMENT_LOCATION, *location)
            )

        source_positions = {
            move_below_instrument(location): position
            for location, position in document.source_positions.items()
        }
        findings = [
            replace(finding, location=move_below_instrument(finding.location))
            for finding in document.findings
        ]
        return Document(
            {"instrument": document.content, **floor_section},
            source_positions,
            findings,
            document.file,
        )
    findings, source_positions = list(document.findings), dict(document.source_positions)
    for name in sorted(document.content.keys() - _INSTRUMENT_FILE_SECTIONS):
        problem = "is no section of an instrument's file"
        remedy = suggest_similar_name(
            name, _INSTRUMENT_FILE_SECTIONS, fallback="leave it out of that file"
        )
        findings.append(Finding((*_INSTRUMENT_LOCATION, name), problem, remedy))
        source_positions[(*_INSTRUMENT_LOCATION, name)] = source_positions[(name,)]
    instrument_fields = document.content["instrument"]
    if not isinstance(instrument_fields, dict):
        problem = "must be a mapping of fields to values in an instrument's file"
        raise single_finding_error(
            _INSTRUMENT_LOCATION,
            problem,
            f"write them below 'instrument:' in {document.file}",
            instrument_fields,
        )
    return Document(document.content, source_positions, findings, document.file)


def library_instrument_files() -> dict[str, Path]:
    """Return the paths of the YAML files of the library's instruments, by the instrument's name.

    A file also names its publication, and published numbers that the instrument must reproduce.

    Examples
    --------
    >>> "settembrini_2026" in library_instrument_files()
    True
    """
    return {file.stem: file for file in sorted(_INSTRUMENT_LIBRARY_FOLDER.glob("*.yaml"))}


def _drop_overridden_threshold(instrument: Any, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return an instrument's fields; the threshold is left out if `overrides` sets a threshold."""
    base_processing, new_processing = instrument.get("processing"), overrides.get("processing")
    if not (
        isinstance(base_processing, Mapping)
        and isinstance(new_processing, Mapping)
        and _THRESHOLD_FIELDS & new_processing.keys()
    ):
        return dict(instrument)
    return instrument | {
        "processing": {k: v for k, v in base_processing.items() if k not in _THRESHOLD_FIELDS}
    }


def to_plain_data(data: Any, location: SpecLocation = ()) -> Any:
    """Return a copy of data as dicts with text keys, lists and scalars, as a YAML parser returns.

    Parameters
    ----------
    data : object
        Mappings, sequences and scalars.
    location : SpecLocation
        Location of `data` in the spec, for mistakes.

    Raises
    ------
    SpecError
        If the data is nested too deeply, or holds an integer with too many digits or invalid text.
    """
    if len(location) > NESTING_DEPTH_MAX:
        raise SpecError([Mistake(dotted_path(location), "is nested too deeply")])
    if isinstance(data, int) and data.bit_length() > _NUMBER_DIGITS_MAX:
        raise SpecError([Mistake(dotted_path(location), "is a number of too many digits")])
    if isinstance(data, Mapping) and not all(is_utf8_encodable(str(key)) for key in data):
        raise SpecError([Mistake(dotted_path(location), "has a key that is no text")])
    if isinstance(data, str) and not is_utf8_encodable(data):
        raise SpecError(
            [Mistake(dotted_path(location), "has half of a surrogate pair, and is no text")]
        )
    if isinstance(data, Mapping):
        return {
            str(key): to_plain_data(value, (*location, str(key))) for key, value in data.items()
        }
    if isinstance(data, list | tuple):
        return [to_plain_data(value, (*location, i)) for i, value in enumerate(data)]
    return data


def merge_mappings(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a dict of all entries of `base` and `overrides`; `overrides` wins.

    Two mappings under the same key are merged in the same way.
    """
    result = dict(base)
    for key, value in overrides.items():
        base_value = result.get(key)
        are_mappings = isinstance(base_value, Mapping) and isinstance(value, Mapping)
        result[key] = merge_mappings(base_value, value) if are_mappings else value  # type: ignore[arg-type]
    return result


def _value_at_location(value: Any, location: SpecLocation) -> Any:
    """Return the value at a location of nested data; '' if the location does not exist."""
    try:
        for key in location:
            value = value[key]
    except (KeyError, IndexError, TypeError):
        return ""
    return value


def _is_leaf(value: Any, location: SpecLocation) -> bool:
    """Return True if the value at a location of nested data is no dict, or does not exist."""
    for key in location:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            return True
    return not isinstance(value, dict)


# Findings from pydantic's errors

_PROBLEM_BY_ERROR_TYPE = {
    "model_type": "must be a mapping of fields to values",
    "model_attributes_type": "must be a mapping of fields to values",
    "dict_type": "must be a mapping",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "invalid_key": "must be a word",
}
"""Words of the error message for a pydantic error, by pydantic's name for the error's type."""
_SCENE_ONLY_REMEDY = "it is for studies with a scene, in place of a target"
"""Advice to a user whose spec of a flat target has a section that only a scene has."""
_REMEDY_BY_OTHER_SPEC_SECTION = {
    **dict.fromkeys(("scene", "target"), "a study has a scene or a target, not both"),
    **dict.fromkeys(
        ("platform", "scanners", "error_floor", "navigation", "interface"), _SCENE_ONLY_REMEDY
    ),
}
"""Advice for a section that only the other kind of spec has, by the section's name.

The kinds are specs of a flat target and specs of a scene.
"""

_REQUIRED_SECTION_BY_FIGURE_KIND = {
    spec_fields.kind_of_model(model): section_text
    for annotation, section_text in ((GridFigure, "a target"), (SceneFigure, "a scene"))
    for model in spec_fields.models_of_annotation(annotation)
}
"""Section that a study must have for a kind of figure: ``a target`` or ``a scene``, by the kind."""


def validation_findings(error: ValidationError, annotation: Any) -> list[Finding]:
    """Return the errors of a pydantic validation as a list of `Finding`.

    Parameters
    ----------
    error : pydantic.ValidationError
        Errors of one validation.
    annotation : type
        Model, or union of models, that the data was validated as.
    """
    return [
        _validation_finding(dict(detail), annotation) for detail in error.errors(include_url=False)
    ]


def _validation_finding(detail: dict[str, Any], annotation: Any) -> Finding:
    """Return one entry of `ValidationError.errors` as a `Finding`.

    `annotation` is the model, or union of models, that the data was validated as.
    """
    error_type, raw_value = detail["type"], detail["input"]
    model_location = spec_fields.translate_pydantic_location(detail["loc"], annotation)
    location = model_location.keys
    if error_type == RULE_ERROR_TYPE:
        context, path = detail["ctx"], dotted_path(location)
        if (
            isinstance(raw_value, list | dict)
            and path in parameter_rules()
            and path != ERROR_TABLE_PATH
        ):
            values = "[...]" if isinstance(raw_value, list) else "{linear: [...], number: ...}"
            remedy = f"put several under axes: '{path}: {values}'"
            return Finding(location, "takes one value", remedy, raw_value)
        shown_value = MISSING if isinstance(raw_value, dict) else raw_value
        return Finding(location, context["rule"], context["suggestion"], shown_value)
    if error_type == "missing":
        return Finding(location, "is missing", _missing_field_remedy(model_location))
    if error_type == "extra_forbidden":
        models_by_kind = {
            spec_fields.kind_of_model(model): model
            for model in spec_fields.models_of_annotation(annotation)
        }
        model = models_by_kind.get(detail["loc"][0], annotation)
        return Finding(location, "is no field", _suggest_field(model_location, model))
    if error_type == "union_tag_invalid":
        tag, kind_names = (
            detail["ctx"]["tag"],
            [spec_fields.kind_of_model(model) for model in model_location.value_models],
        )
        problem = f"must be one of {', '.join(kind_names)}"
        return Finding((*location, "kind"), problem, _suggest_kind(str(tag), kind_names), tag)
    if error_type == "union_tag_not_found":
        return Finding(
            location,
            "lacks its kind",
            f"write {_kind_hint(model_location.value_models)}",
            raw_value,
        )
    problem = _PROBLEM_BY_ERROR_TYPE.get(error_type, "has an invalid value")
    remedy = (
        _missing_field_remedy(model_location)
        if model_location.value_models
        else _list_remedy(model_location, error_type)
    )
    return Finding(location, problem, remedy, raw_value)


def _list_remedy(model_location: spec_fields.ModelLocation, error_type: str) -> str:
    """Return advice on a value that must be a list or a dict of sections; '' for other values."""
    if error_type in ("list_type", "tuple_type"):
        return "put it in brackets, [...], or on lines that begin with '- '"
    return (
        f"write '{model_location.keys[-1]}:' with a name and its fields below"
        if error_type == "dict_type"
        else ""
    )


def _kind_hint(models: spec_fields.ModelClasses) -> str:
    """Return words on what to write as ``kind``: the values that select one of `models`."""
    return f"kind: and one of {', '.join(map(spec_fields.kind_of_model, models))}"


def _suggest_kind(tag: str, kind_names: list[str]) -> str:
    """Return advice on an unknown value of ``kind``: a similar kind, or the studies that have it.

    `kind_names` are the valid values. The result is empty if none is similar.
    """
    if (
        tag in _REQUIRED_SECTION_BY_FIGURE_KIND
        and kind_names[0] in _REQUIRED_SECTION_BY_FIGURE_KIND
    ):
        return f"{tag} is for studies of {_REQUIRED_SECTION_BY_FIGURE_KIND[tag]}"
    return suggest_similar_name(tag, kind_names)


def _missing_field_remedy(model_location: spec_fields.ModelLocation) -> str:
    """Return advice on what to write for a missing field or section."""
    name, section = model_location.keys[-1], model_location.keys[:-1]
    if model_location.keys == _INSTRUMENT_LOCATION:
        return missing_instrument_remedy()
    field = (
        spec_fields.fields_by_name(model_location.enclosing_section_models[0]).get(str(name))
        if model_location.enclosing_section_models
        else None
    )
    rule = spec_fields.rule_of_field(field) if field is not None else None
    example = rule.example if rule is not None else ""
    if example:
        may_vary = (
            isinstance(rule, NumericRule) and dotted_path(model_location.keys) in parameter_rules()
        )
        return f"write e.g. '{name}: {example}'" + (", or put it on an axis" if may_vary else "")
    if isinstance(name, int) and model_location.value_models:
        has_kinds = len(model_location.value_models) > 1
        field_names = (
            _kind_hint(model_location.value_models)
            if has_kinds
            else ", ".join(spec_fields.fields_by_name(model_location.value_models[0]))
        )
        return f"write a mapping with {field_names}"
    if len(model_location.value_models) > 1:
        return f"write '{name}:' with {_kind_hint(model_location.value_models)}"
    if model_location.value_models:
        remedy = (
            f"write '{name}:' with "
            f"{', '.join(spec_fields.fields_by_name(model_location.value_models[0]))}"
        )
        like_remedy = f", or take all that is missing from another: 'like: {_EXAMPLE_INSTRUMENT}'"
        return remedy + (like_remedy if section == _INSTRUMENT_LOCATION else "")
    return f"write '{name}: ...'"


def missing_instrument_remedy() -> str:
    """Return advice on what to write in a spec that has no instrument."""
    return (
        f"write e.g. 'instrument: {{like: {_EXAMPLE_INSTRUMENT}}}' (the library has "
        f"{', '.join(library_instrument_files())}), "
        "or all of its sections"
    )


def _suggest_field(model_location: spec_fields.ModelLocation, root_model: type[BaseModel]) -> str:
    """Return advice on an unknown field: a similar field of its section, or of the whole spec.

    The advice lists the section's fields if no field is similar.
    """
    name = str(model_location.keys[-1])
    sibling_names = [
        field
        for model in model_location.enclosing_section_models
        for field in spec_fields.fields_by_name(model)
    ]
    if name in _REMEDY_BY_OTHER_SPEC_SECTION and model_location.enclosing_section_models == (
        root_model,
    ):
        return _REMEDY_BY_OTHER_SPEC_SECTION[name]
    known_paths = dict.fromkeys((*parameter_rules(), *spec_fields.rules_by_path(root_model, "")))
    if name[:1].isdigit():
        return "a comma begins another field here: write numbers with a point, such as 2.5"
    if name in known_paths:
        section, _, field = name.rpartition(".")
        return f"write '{field}: ...' in the section '{section}'"
    matching_paths = [path for path in known_paths if path.rsplit(".", 1)[-1] == name]
    if matching_paths:
        return f"did you mean '{matching_paths[0]}'?"
    if suggestion := suggest_similar_name(name, sibling_names):
        return suggestion
    return f"the fields here are {', '.join(sibling_names)}" if sibling_names else ""
