"""The table at the end of a run over a scene: what came back to each scanner."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from sweep.storage.locations import Location, located, read_array
from sweep.tasks import studies
from sweep.tasks.errors import StoreError
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.stretches import Stretches

#: Places along the axes that are told one by one.
MOST_PLACES = 12


@dataclass
class SceneRow:
    """What came back to a scanner at one place along the axes; blocks not computed are left out."""

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
    return [row for stretches in study.scanners.values() for row in _rows(path, study, stretches)]


def _rows(path: Location, study: FlightStudy, stretches: Stretches) -> Iterator[SceneRow]:
    places = list(product(*map(range, stretches.axes)))
    told = len(places) <= MOST_PLACES
    if not told:
        yield _row(path, stretches, stretches.scanner, places)
        return
    for place in places:
        words = [
            f"{member.name} {_shown(member.display[index])}{' ' * bool(member.units)}{member.units}"
            for axis, index in zip(study.spec.axes, place, strict=True)
            for member in axis.members
        ]
        yield _row(path, stretches, ", ".join([stretches.scanner, *words]), [place])


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _row(
    path: Location, stretches: Stretches, part: str, places: list[tuple[int, ...]]
) -> SceneRow:
    from sweep.model.navigation_screening import EXCLUDED
    from sweep.model.pairing import TRUE

    group = path / stretches.scanner
    flags, pd = (read_array(group / name) for name in ("flags", "pd_shot"))
    status = read_array(group / "velocity_status") if stretches.navigates else None
    row = SceneRow(part)
    for place, cycles, draws in _stretches(stretches, places):
        shots = slice(*(stretches.shots_a_cycle * edge for edge in (cycles.start, cycles.stop)))
        if flags.shards is None and not _is_there(group / "flags", stretches, place, cycles, draws):
            continue
        found = _read(flags, *place, shots, draws)
        row.shots += found[..., 0].size
        row.true += int(((found & TRUE) > 0).any(axis=-1).sum())
        row.false += int(((found > 0) & ((found & TRUE) == 0)).sum())
        if draws.start == 0:
            chance = _read(pd, *place, shots)
            row.chances.append(chance[np.isfinite(chance)])
        if status is not None:
            solved = _read(status, *place, cycles, draws)
            row.cycles += solved.size
            row.solved += int((solved <= EXCLUDED).sum())
    return row


def _read(array: Any, *index: int | slice[int, int, None]) -> np.ndarray:
    return np.asarray(array[index])


def _stretches(
    stretches: Stretches, places: list[tuple[int, ...]]
) -> Iterator[tuple[tuple[int, ...], slice[int, int, None], slice[int, int, None]]]:
    """Places and stretches of cycles and draws, chunk by chunk."""
    for place in places:
        for first in range(0, stretches.total_cycles, stretches.block_cycles):
            cycles = slice(first, min(first + stretches.block_cycles, stretches.total_cycles))
            for start in range(0, stretches.draws, stretches.block_draws):
                yield (
                    place,
                    cycles,
                    slice(start, min(start + stretches.block_draws, stretches.draws)),
                )


def _is_there(
    array: Location, stretches: Stretches, place: tuple[int, ...], cycles: slice, draws: slice
) -> bool:
    position = (
        *place, cycles.start // stretches.block_cycles, draws.start // stretches.block_draws, 0,
    )  # fmt: skip
    return (array / "/".join(["c", *map(str, position)])).exists()
