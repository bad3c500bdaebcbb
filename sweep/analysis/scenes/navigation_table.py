"""Navigation's errors over altitude as a table."""

from __future__ import annotations

from collections.abc import Sequence

from sweep.analysis import labels
from sweep.analysis.scenes.errors_over_altitude import Curve
from sweep.analysis.scenes.navigation_figure import AVAILABILITY, BIAS, COMPONENTS, RMSE, UNITS
from sweep.analysis.tabular import Block, Cell, Page

LENGTH = "vector"


def page(
    curves: Sequence[Curve], *, quantity: str, show: str, title: str, remarks: Sequence[str]
) -> Page:
    """A block for each scanner, a row for each bin of altitude.

    Parameters
    ----------
    curves
        Errors of each scanner.
    quantity, show
        ``velocity`` or ``altitude``; ``availability``, ``bias``, ``rmse`` or ``all``.
    title, remarks
        What stands over the page and under it.
    """
    shown = (AVAILABILITY, BIAS, RMSE) if show == "all" else (show,)
    blocks, records = [], []
    for curve in curves:
        own = [_record(curve, i, quantity, shown) for i in range(curve.edges.size - 1)]
        columns = [name for name in own[0] if name != "scanner"]
        rows = [[record[name] for name in columns] for record in own]
        blocks.append(Block(f"{labels.coordinate(curve.scanner)}: {quantity}", columns, rows))
        records += own
    notes = [
        "from, to: true altitude above ground [m]; cycles: measurement cycles times draws.",
        f"bias, rmse, stated: in {UNITS[quantity]}; stated: root of the mean variance that",
        "  solutions give for themselves; error of bias: its standard error.",
        *remarks,
    ]
    return Page(title, blocks, notes, records)


def _record(curve: Curve, i: int, quantity: str, shown: Sequence[str]) -> dict[str, Cell]:
    """One line of the CSV file."""
    record: dict[str, Cell] = {
        "scanner": curve.scanner,
        "from": float(curve.edges[i]),
        "to": float(curve.edges[i + 1]),
        "cycles": int(curve.tally.attempts[i]),
        "solved": int(curve.tally.count[i]),
    }
    names = COMPONENTS[quantity]
    if AVAILABILITY in shown:
        record["available"] = float(curve.tally.availability[i])
    if BIAS in shown:
        for k, name in enumerate(names):
            record[f"bias {name}".strip()] = float(curve.bias[i, k])
            record[f"error of bias {name}".strip()] = float(curve.bias_error[i, k])
    if RMSE in shown:
        for k, name in enumerate((*names, LENGTH) if len(names) > 1 else names):
            record[f"rmse {name}".strip()] = float(curve.rmse[i, k])
            record[f"stated {name}".strip()] = float(curve.predicted[i, k])
    return record
