"""Every hard case is as close to its reference as it says, and docs/stability.md lists them all."""

import re
from pathlib import Path

import pytest
from hard_cases import families
from write_stability_page import PAGE_HEAD, format_error

PAGE = Path(__file__).parents[2] / "docs" / "stability.md"
CASES = [(family, case) for family in families() for case in family.cases]


def _parameter(family, case):
    marks = [pytest.mark.slow] if case.is_slow else []
    if case.reference_file and not case.reference_file.exists():
        marks.append(pytest.mark.skip(reason="its reference values are not at hand"))
    return pytest.param(case, id=f"{family.title}: {case.difficulty}", marks=marks)


@pytest.mark.parametrize("case", [_parameter(*pair) for pair in CASES])
def test_a_hard_case_is_as_close_to_its_reference_as_it_says(case):
    assert case.worst_error() <= case.allowed


def test_no_two_cases_share_a_name():
    names = [(family.title, case.difficulty) for family, case in CASES]
    assert len(names) == len(set(names))


def _rows():
    """Rows of the page: title of the family and the cells."""
    title = ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            title = line.removeprefix("## ")
        elif line.startswith("| ") and not re.match(r"\| (---|case)", line):
            yield title, *(cell.strip() for cell in line.strip("|").split(" | "))


def test_the_page_lists_exactly_the_cases_that_there_are():
    expected = [
        (
            f.title,
            c.difficulty,
            c.reference,
            c.measure,
            format_error(c.allowed),
            format_error(c.limit),
            c.because,
        )
        for f, c in CASES
    ]
    assert [row[:4] + row[5:] for row in _rows()] == expected
    assert PAGE.read_text(encoding="utf-8").startswith(PAGE_HEAD)
