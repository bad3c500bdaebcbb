"""Code and pages use one word for one meaning: those of the glossary, and none that it retires."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]

GLOSSARY = REPOSITORY / "docs" / "glossary.md"

ORDINARY_WORDS = {
    *("act", "acts", "alike", "anew", "barred", "each", "fades", "flying", "looked", "much"),
    *("partly", "room", "stray"),
}
"""Words that names may not use and that are plain English in a sentence."""

PAGES = [
    *sorted((REPOSITORY / "docs").glob("*.md")),
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
]
"""Pages without retired words; the glossary names them in its table alone."""

RETIRED_NAMES_OF_TESTS = {
    *("asked", "caught", "found", "given", "got", "here", "made", "mine", "most", "own", "said"),
    *("seen", "theirs", "there", "told", "undisturbed", "whole"),
}
"""Names that say nothing of a value's kind: results, messages, stores have their nouns."""


def words_of_code(text):
    """Words of code in the glossary's table: (word, meaning, retired words)."""
    rows = [re.split(r"(?<!\\)\|", line) for line in text.split("\n") if line.startswith("| `")]
    return [
        (word, meaning.strip(), re.findall(r"`([^`]+)`", retired))
        for _, words, meaning, retired, _ in rows
        for word in re.findall(r"`([^`]+)`", words)
    ]


def identifier_parts(name):
    """Words of an identifier: those between underscores, and those that capitals begin."""
    return re.findall(r"[a-z0-9]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower())


def identifiers(source):
    """Names that a source defines, with their lines: functions, classes, arguments, variables."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno


def lines_of_identifier_parts(folder):
    """Where each word stands in identifiers: word -> ["file:line name"]."""
    lines = defaultdict(list)
    for path in sorted(Path(folder).rglob("*.py")):
        for name, line in identifiers(path.read_text()):
            for part in set(identifier_parts(name)):
                lines[part].append(f"{path.relative_to(REPOSITORY)}:{line} {name}")
    return lines


@pytest.fixture(scope="module")
def table():
    rows = words_of_code(GLOSSARY.read_text())
    assert len(rows) > 30
    return rows


def test_no_word_of_code_has_two_entries(table):
    words = [word for word, _, _ in table]
    assert len(set(words)) == len(words)
    retired = [
        word for _, words_of_row in {(m, tuple(r)) for _, m, r in table} for word in words_of_row
    ]
    assert len(set(retired)) == len(retired)
    assert not set(retired) & set(words)


def test_code_uses_the_words_of_the_glossary(table):
    lines = lines_of_identifier_parts(REPOSITORY / "sweep")
    for word, _, _ in table:
        for part in identifier_parts(word):
            assert lines[part], f"no name in sweep/ has the glossary's word {part!r} of {word!r}"


def test_no_name_uses_a_word_that_the_glossary_retires(table):
    lines = lines_of_identifier_parts(REPOSITORY / "sweep")
    uses = {
        f"{retired} (say {word})": lines[retired]
        for word, _, retired_words in table
        for retired in retired_words
        if lines[retired]
    }
    assert not uses, "\n".join(f"{word}: {places}" for word, places in uses.items())


def unambiguous_retired_words(table):
    """Words that the glossary retires and that no sentence needs: retired word -> word."""
    return {
        retired: word
        for word, _, retired_words in table
        for retired in retired_words
        if retired not in ORDINARY_WORDS
    }


def page_words(path):
    """Words of a page with their lines, without rows of the glossary's table."""
    for number, line in enumerate(path.read_text().split("\n"), 1):
        if path != GLOSSARY or not line.startswith("| `"):
            for word in re.findall(r"[a-z]+", line.lower()):
                yield word, number


def test_no_page_uses_a_word_that_the_glossary_retires(table):
    retired = unambiguous_retired_words(table)
    assert {"knob", "rung", "doubt", "told", "smears"} <= set(retired)
    retired |= {f"{word}s": instead for word, instead in retired.items()}
    uses = [
        f"{path.relative_to(REPOSITORY)}:{line} {word} (say {retired[word]})"
        for path in PAGES
        for word, line in page_words(path)
        if word in retired
    ]
    assert not uses, "\n".join(uses)


@pytest.mark.parametrize("folder", ["tests", "benchmarks"])
def test_no_name_of_tests_and_benchmarks_is_a_retired_word(table, folder):
    retired = unambiguous_retired_words(table)
    paths = sorted((REPOSITORY / folder).rglob("*.py"))
    assert paths
    uses = [
        f"{path.relative_to(REPOSITORY)}:{line} {name}"
        for path in paths
        for name, line in identifiers(path.read_text())
        if name in RETIRED_NAMES_OF_TESTS or set(identifier_parts(name)) & set(retired)
    ]
    assert not uses, "\n".join(uses)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("joint_pd_in_speckle", ["joint", "pd", "in", "speckle"]),
        ("BinSpans", ["bin", "spans"]),
        ("_PATH2", ["path2"]),
    ],
)
def test_an_identifier_is_split_into_its_words(name, parts):
    assert identifier_parts(name) == parts
