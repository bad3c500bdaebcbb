"""Shots of a flight to try rungs on: whole tiles, as effects are planned in them."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.effects.flags import flags_of, names_of
from sweep.tasks.accuracy.bench import NOT_IN_TRUTH, SEGMENTS, Seen, Trial, look_of, of_lines
from sweep.tasks.accuracy.rungs import WRITTEN, Rung
from sweep.tasks.accuracy.sample import spread
from sweep.tasks.calling import TILE_SHOTS, Called
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.stretches import Part

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
    from sweep.tasks.study import Results

#: Tiles of the sample at the least, where the flight has them: one would stand for one moment.
LEAST_TILES = 4

_LEAST = 1e-300
"""Probability of a false alarm below which all are alike."""


class Tile(NamedTuple):
    """Whole cycles of one scanner that cover a tile of its shots, at one place along the axes."""

    part: Part
    first: int
    stop: int
    start: int
    """Place of its first shot in the sample."""

    @property
    def places(self) -> np.ndarray:
        """Places of its shots in the sample."""
        return np.arange(self.start, self.start + self.stop - self.first)


class Cast(NamedTuple):
    """What the shots of a tile see, and the time that casting its rays took [s]."""

    shots: Results
    eyepoints: Eyepoints
    seconds: float


class FlightBench:
    """A sample of the shots of a flight, each with one draw.

    Parameters
    ----------
    spec
        The study.
    points
        Shots of the sample, rounded up to whole tiles.
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, points: int) -> None:
        self.spec = Rung(name="", kind=WRITTEN, overrides={"draws.number": 1}).of(spec)
        self._studies: dict[str, FlightStudy] = {}
        self._cast: dict[tuple[str, Tile], Cast] = {}
        self._tiles = self._sample(points)

    @property
    def size(self) -> int:
        """Shots of the sample."""
        return self._tiles[-1].places[-1] + 1

    def parts(self, points: int) -> list[np.ndarray]:
        """The sample in parts of one tile each."""
        return [tile.places for tile in self._tiles]

    def effects(self, rung: Rung) -> frozenset[str]:
        """Effects that a rung calls for anywhere in the sample."""
        study = self._study(rung)
        found: set[str] = set()
        for tile in self._tiles:
            called = study.call(tile.part, self._seen(study, tile).eyepoints, first=tile.first)
            found |= {name for flag in np.unique(called.flags) for name in names_of(int(flag))}
        return frozenset(found)

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """A rung on a tile of the sample; its rays count, `times` does not."""
        study, tile = self._study(rung), self._tile(part)
        cast = self._seen(study, tile)
        called, planning = self._called(rung, study, tile, cast)
        begun = time.perf_counter()
        if rung.cells:
            seen = self._looked(rung, study, tile, cast.eyepoints, called)
        else:
            seen = _seen_in(
                study.look(tile.part, cast.shots, cast.eyepoints, called, first=tile.first)
            )
        spent = time.perf_counter() - begun + cast.seconds + planning
        return Trial(seen, spent / len(part), planning / len(part))

    def forget(self) -> None:
        """Drop the rays that rungs of the same geometry share."""
        self._cast.clear()

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """A shot in the time domain, and as the rung has it without what the truth lacks."""
        from sweep.model import shot, truth

        study = self._study(rung)
        tile = next(t for t in self._tiles if t.start <= place <= t.places[-1])
        cast = self._seen(study, tile)
        called, _ = self._called(rung, study, tile, cast)
        one = np.array([place - tile.start])
        names = [n for n in names_of(int(called.flags[one[0]])) if n not in NOT_IN_TRUTH]
        looks = truth.find, shot.find
        seen = (_found(study, tile, cast.eyepoints.some(one), names, look) for look in looks)
        in_time, ordinary = seen
        return in_time, ordinary

    def coordinates(self) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
        """Scanner and number of each shot, and its place along the axes."""
        counts = [tile.stop - tile.first for tile in self._tiles]
        scanners = np.repeat(np.array([t.part.scanner for t in self._tiles], object), counts)
        numbers = np.concatenate([np.arange(t.first, t.stop) for t in self._tiles])
        found: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
            "scanner": (scanners, {"long_name": "scanner"}),
            "shot": (numbers, {"long_name": "number of the shot"}),
        }
        for k, axis in enumerate(self.spec.axes):
            along = np.repeat([tile.part.axes[k] for tile in self._tiles], counts)
            for member in axis.members:
                attributes = {"units": member.units, "path": member.path}
                found[member.name] = (np.asarray(member.display)[along], attributes)
        return found

    def _sample(self, points: int) -> list[Tile]:
        """Tiles spread over scanners, flight and axes."""
        study = self._study(Rung(name="as written", kind=WRITTEN))
        tiles: list[Tile] = []
        number = max(LEAST_TILES, math.ceil(points / TILE_SHOTS / len(study.scanners)))
        start = 0
        for name, stretches in study.scanners.items():
            total = stretches.total_cycles * stretches.shots_a_cycle
            shape = (-(-total // TILE_SHOTS), *stretches.axes)
            for at in np.transpose(np.unravel_index(spread(shape, number), shape)).tolist():
                cycle = stretches.shots_a_cycle
                first = at[0] * TILE_SHOTS // cycle * cycle
                stop = min(-(-min((at[0] + 1) * TILE_SHOTS, total) // cycle) * cycle, total)
                tiles.append(Tile(Part(name, tuple(at[1:]), 0, 0), first, stop, start))
                start += stop - first
        return tiles

    def _tile(self, part: np.ndarray) -> Tile:
        return next(tile for tile in self._tiles if tile.start == part[0])

    def _study(self, rung: Rung) -> FlightStudy:
        if rung.name not in self._studies:
            spec = rung.of(self.spec)
            self._studies[rung.name] = FlightStudy(spec, Path("nowhere.zarr"))  # type: ignore[arg-type]
        return self._studies[rung.name]

    def _seen(self, study: FlightStudy, tile: Tile) -> Cast:
        """What a tile's shots see: rays are cast once for all rungs of the same geometry."""
        from sweep.scenes.eyepoint_arrays import from_arrays

        key = study.spec.geometry_id(tile.part.scanner), tile
        if key not in self._cast:
            caster = next(e for e in study.eyepoint_studies() if e.scanner == tile.part.scanner)
            _ = caster.world
            begun = time.perf_counter()
            shots = caster.see(np.arange(tile.first, tile.stop))
            eyepoints = from_arrays(shots, caster.weight)
            self._cast[key] = Cast(shots, eyepoints, time.perf_counter() - begun)
        return self._cast[key]

    def _called(
        self, rung: Rung, study: FlightStudy, tile: Tile, cast: Cast
    ) -> tuple[Called, float]:
        """What is simulated of a tile's shots, and the time [s] that it took to say."""
        if rung.cells:
            names = of_lines(self.effects(Rung(name="as written", kind=WRITTEN)))
            return _everywhere(frozenset(names), cast.eyepoints), 0.0
        begun = time.perf_counter()
        called = study.call(tile.part, cast.eyepoints, first=tile.first)
        return called, time.perf_counter() - begun if rung.plans else 0.0

    def _looked(
        self, rung: Rung, study: FlightStudy, tile: Tile, eyepoints: Eyepoints, called: Called
    ) -> Seen:
        """The thesis's way, of the shots that see anything."""
        whole = _nothing(len(called.flags))
        for flag in np.unique(called.flags):
            index = np.flatnonzero((called.flags == flag) & eyepoints.seen)
            if index.size:
                names = list(names_of(int(flag)))
                seen = _found(study, tile, eyepoints.some(index), names, look_of(rung))
                for values, some in zip(whole, seen, strict=True):
                    values[index] = some
        return whole


def _everywhere(names: frozenset[str], eyepoints: Eyepoints) -> Called:
    """The same effects of every shot that sees anything."""
    from sweep.model.effects.catalogue import NAMES

    flag = flags_of(np.array([[name in names] for name in NAMES]))[0]
    seen = eyepoints.seen
    return Called(np.where(seen, flag, 0).astype(np.uint32), np.zeros(len(seen)))


def _found(
    study: FlightStudy, tile: Tile, eyepoints: Eyepoints, names: list[str], look: Any
) -> Seen:
    """Statistics of shots that see something, from a way to look at their spectra."""
    from sweep.model.eyepoints import prepare_eyepoints

    shots = prepare_eyepoints(
        eyepoints, study.parameters_at(tile.part), study.spec.surfaces(), names
    )
    found = look(shots)
    pd = found[:, 0].T
    n = len(pd)
    snr = found[0, 2] / shots.bin_deviation
    seen = _nothing(n)
    return seen._replace(
        pd=np.column_stack([pd, pd[:, 0] * pd[:, 2]]), magnitude=snr[:, None] / math.sqrt(2)
    )


def _seen_in(outputs: Results) -> Seen:
    """What counts of the statistics of shots."""
    pd = np.stack([outputs[f"pd_{name}"] for name in (*SEGMENTS, "shot")], axis=1)
    alarms = np.stack([outputs["pfa_up"], outputs["pfa_down"]], axis=1)
    magnitude = np.sqrt(outputs["snr_up"])[:, None]
    return _nothing(len(pd))._replace(
        pd=pd, log10_pfa=np.log10(np.maximum(alarms, _LEAST)), magnitude=magnitude
    )


def _nothing(shots: int) -> Seen:
    return Seen(*(np.full(size, np.nan) for size in ((shots, 4), (shots, 2), (shots, 1), shots)))
