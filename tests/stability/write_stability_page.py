"""Writes docs/stability.md, every hard case and the worst error found: `make stability`."""

import sys
import textwrap
import time
from pathlib import Path

from hard_cases import Case, Family, families

PAGE = Path(__file__).parents[2] / "docs" / "stability.md"
PAGE_HEAD = """# Numerical stability, case by case

Written by `make stability` from the cases in `tests/stability`. The tests have the same limits
(`make test` all but the longest, `make test-all` those too). Each case is named for its difficulty,
and compared with a reference of higher precision or of another kind. `worst` is the largest error
found, in the measure of `error in`, and `allowed` the limit of the tests. `float64` estimates the
error that double precision alone must be expected to make there, for the reason that follows. An
error of that size is as good as any computation in doubles from the same numbers.
"""
COLUMNS = (
    "case", "against", "error in", "worst", "allowed", "float64", "because of",
)  # fmt: skip


def format_error(value: float) -> str:
    """An error to two digits."""
    return f"{value:.1e}" if value else "0"


def case_row(case: Case) -> str:
    """A case's row of the table."""
    if case.reference_file and not case.reference_file.exists():
        sys.exit(f"the page would lack a figure without {case.reference_file}")
    start = time.perf_counter()
    worst = case.worst_error()
    seconds = time.perf_counter() - start
    missed_text = "" if worst <= case.allowed else "  MISSED"
    print(
        f"{seconds:7.2f} s  {format_error(worst):>8} of {format_error(case.allowed)}: "
        f"{case.difficulty}{missed_text}",
        flush=True,
    )
    cells = (
        case.difficulty,
        case.reference,
        case.measure,
        format_error(worst),
        format_error(case.allowed),
        format_error(case.limit),
        case.because,
    )
    return "| " + " | ".join(cells) + " |"


def family_section(family: Family) -> str:
    """A family's part of the page."""
    print(family.title, flush=True)
    head = ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * len(COLUMNS)]
    return "\n".join(
        [
            f"## {family.title}",
            "",
            textwrap.fill(family.description, 100),
            "",
            *head,
            *map(case_row, family.cases),
            "",
        ]
    )


def main() -> None:
    """The whole page; of the families named alone, nothing is written."""
    chosen_families = [f for f in families() if not sys.argv[1:] or f.title in sys.argv[1:]]
    sections = [family_section(family) for family in chosen_families]
    if not sys.argv[1:]:
        PAGE.write_text(PAGE_HEAD + "\n" + "\n".join(sections), encoding="utf-8")


if __name__ == "__main__":
    main()
