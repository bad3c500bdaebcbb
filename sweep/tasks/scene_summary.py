"""The table at the end of a run over a scene: what came back to each scanner."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from sweep.storage.locations import Location, located
from sweep.storage.opening import open_group
from sweep.tasks import studies
from sweep.tasks.errors import StoreError
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.journal import receipted
from sweep.tasks.stretches import Part, Stretches

#: Places along the axes that are told one by one.
MOST_PLACES = 12


@dataclass
class SceneRow:
    """What came back to a scanner at one place along the axes, in the blocks that are committed."""

    part: str
    shots: int = 0  # times draws
    true: int = 0  # of these, with at least one true return
    false: int = 0  # points that are no true return
    cycles: int = 0  # times draws; 0 where a cycle has too few shots
    solved: int = 0  # of these, with a velocity vector
    chances: list[np.ndarray] = field(default_factory=list, repr=False)

    @property
    def pd(self) -> float:
        """Mean probability of detection of shots that see something; nan where none does."""
        seen = np.concatenate([*self.chances, np.empty(0)])
        return float(seen.mean()) if seen.size else float("nan")


def scene_summary(store: str | Location) -> list[SceneRow]:
    """A row for each scanner and each place along the axes, or for each scanner where there are
    many.

    Raises
    ------
    StoreError
        Where there is no store of a scene.
    """
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, FlightStudy):
        raise StoreError(f"{path} holds no study of a scene")
    done = receipted(path, study)
    rows: list[SceneRow] = []
    first = 0
    for stretches in study.scanners.values():
        numbers = np.flatnonzero(done[first : first + stretches.number])
        parts = [stretches.part(int(number)) for number in numbers]
        rows += _rows(path, study, stretches, parts)
        first += stretches.number
    return rows


def _rows(
    path: Location, study: FlightStudy, stretches: Stretches, done: list[Part]
) -> Iterator[SceneRow]:
    places = list(product(*map(range, stretches.axes)))
    if len(places) > MOST_PLACES:
        yield _row(path, stretches, stretches.scanner, done)
        return
    for place in places:
        words = [
            f"{member.name} {_shown(member.display[index])}{' ' * bool(member.units)}{member.units}"
            for axis, index in zip(study.spec.axes, place, strict=True)
            for member in axis.members
        ]
        part = ", ".join([stretches.scanner, *words])
        yield _row(path, stretches, part, [each for each in done if each.axes == place])


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _row(path: Location, stretches: Stretches, part: str, done: list[Part]) -> SceneRow:
    from sweep.model.navigation_screening import EXCLUDED
    from sweep.model.pairing import TRUE

    arrays: Any = open_group(path)[stretches.scanner]
    flags, pd = arrays["flags"], arrays["pd_shot"]
    status = arrays["velocity_status"] if stretches.navigates else None
    row = SceneRow(part)
    for block in done:
        shots, cycles, draws = (
            slice(*edges(block))
            for edges in (stretches.shot_range, stretches.cycle_range, stretches.draw_range)
        )
        found = np.asarray(flags[*block.axes, shots, draws])
        row.shots += found[..., 0].size
        row.true += int(((found & TRUE) > 0).any(axis=-1).sum())
        row.false += int(((found > 0) & ((found & TRUE) == 0)).sum())
        if block.draws == 0:
            chance = np.asarray(pd[*block.axes, shots])
            row.chances.append(chance[np.isfinite(chance)])
        if status is not None:
            solved = np.asarray(status[*block.axes, cycles, draws])
            row.cycles += solved.size
            row.solved += int((solved <= EXCLUDED).sum())
    return row
