"""Shots of a flight to try rungs on: whole tiles, as effects are planned in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from time import thread_time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.effects.catalogue import flags_of, names_of
from sweep.tasks.accuracy.bench import (
    NOT_IN_TRUTH,
    Seen,
    Trial,
    look_of,
    of_lines,
    seen_in,
)
from sweep.tasks.accuracy.rungs import MEAN, WRITTEN, Rung
from sweep.tasks.accuracy.sample import spread
from sweep.tasks.calling import TILE_SHOTS, Called
from sweep.tasks.eyepoint_study import EyepointStudy, world_of
from sweep.tasks.finer_rays import FinerRays, refine
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.stretches import Part, Stretches

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
    from sweep.spec.world import World
    from sweep.tasks.accuracy.bench import Look

#: Places along the axes at which each scanner is looked at.
PLACES = 2


@dataclass(frozen=True, eq=False)
class Tiles:
    """Shots of one scanner, in whole tiles, at one place of the axes."""

    part: Part
    index: np.ndarray
    """Numbers of the shots, rising."""
    start: int
    """Place in the sample of the first of the stretch that they are of."""

    @property
    def tile(self) -> np.ndarray:
        """Number of each shot's tile."""
        return self.index // TILE_SHOTS

    def parts(self, number: int) -> list[np.ndarray]:
        """Places in the sample, in parts of so many tiles at the most."""
        places = np.arange(self.start, self.start + len(self.index))
        tiles = np.split(places, np.flatnonzero(np.diff(self.tile)) + 1)
        parts = np.array_split(np.arange(len(tiles)), -(-len(tiles) // number))
        return [np.concatenate([tiles[k] for k in part]) for part in parts]

    def around(self, rows: np.ndarray, number: int) -> np.ndarray:
        """Rows of whole tiles, those of some shots and what follows, round the end, rising.

        As many tiles as make so many shots, or all.
        """
        tiles, counts = np.unique(self.tile, return_counts=True)
        own = np.unique(self.tile[rows])
        order = np.roll(np.arange(tiles.size), -int(np.searchsorted(tiles, own[0])))
        enough = int(np.searchsorted(np.cumsum(counts[order]), number)) + 1
        chosen = np.union1d(own, tiles[order[:enough]])
        return np.flatnonzero(np.isin(self.tile, chosen))

    def some(self, rows: np.ndarray) -> Tiles:
        """Some of the shots."""
        return Tiles(self.part, self.index[rows], self.start)


class Cast(NamedTuple):
    """What shots see, and the time that casting their rays took [s]."""

    eyepoints: Eyepoints
    seconds: float


class _Caster(EyepointStudy):
    """Eyepoints of a geometry in a world that others share, as building one can take seconds."""

    def __init__(
        self, spec: SceneSpec, scanner: str, world: World, beamlets: int | None = None
    ) -> None:
        super().__init__(spec, scanner, beamlets)
        self._world = world

    @property
    def world(self) -> World:
        """The scene."""
        return self._world


class FlightBench:
    """A sample of the shots of a flight.

    What counts is rays, plans, spectra and probabilities; draws, points and navigation cost the
    same whatever the accuracy, and are left out.

    Parameters
    ----------
    spec
        The study.
    points
        Shots of the sample, rounded up to whole tiles.
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, points: int) -> None:
        self.spec = spec
        self._studies: dict[str, FlightStudy] = {}
        self._cast: dict[tuple[str, int, bytes], Cast] = {}
        self._geometry: dict[tuple[int, str], str] = {}
        self._casters: dict[str, _Caster] = {}
        self._finer: dict[int, FinerRays] = {}
        self._names: dict[str, frozenset[str]] = {}
        self._tiles = self._sample(points)

    @property
    def size(self) -> int:
        """Shots of the sample."""
        return sum(len(tiles.index) for tiles in self._tiles)

    @property
    def whole(self) -> int:
        """Shots of the flight, times places along the axes."""
        stretches = self._study(Rung(name="as written", kind=WRITTEN)).scanners.values()
        return sum(s.total_cycles * s.shots_a_cycle * math.prod(s.axes) for s in stretches)

    @property
    def least_parts(self) -> int:
        """One for each scanner and place along the axes."""
        return len(self._tiles)

    @property
    def most_times(self) -> int:
        """Shots of a block of the study, where the flight has as many.

        What costs the same for any number of shots, as planning mostly does, is shared by these.
        """
        return max(int(self.spec.storage.block_shots), TILE_SHOTS)

    def parts(self, points: int) -> list[np.ndarray]:
        """The sample in parts of about so many shots, from all scanners and places in turn."""
        number = max(1, round(points / TILE_SHOTS))
        turns = zip_longest(*(tiles.parts(number) for tiles in self._tiles))
        return [part for turn in turns for part in turn if part is not None]

    def effects(self, rung: Rung) -> frozenset[str]:
        """Effects that a rung calls for anywhere in the sample."""
        if rung.name not in self._names:
            study, found = self._study(rung), set()
            for tiles in self._tiles:
                called = _called(study, tiles, self._seen(study, tiles).eyepoints)
                found |= {name for flag in np.unique(called.flags) for name in names_of(int(flag))}
            self._names[rung.name] = frozenset(found)
        return self._names[rung.name]

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """A rung on a part of the sample, timed with its rays and the tiles beside it."""
        study, stretch = self._study(rung), self._of(int(part[0]))
        own = part - stretch.start
        rows = stretch.around(own, times)
        tiles = stretch.some(rows)
        cast = self._seen(study, tiles)
        called, planning = self._planned(rung, study, tiles, cast)
        begun = thread_time()
        seen = self._looked(rung, study, tiles, cast.eyepoints, called)
        spent = thread_time() - begun + cast.seconds + planning
        chosen = np.searchsorted(rows, own)
        of_part = Seen(*(values[chosen] for values in seen))
        return Trial(of_part, spent / len(rows), planning / len(rows))

    def forget(self) -> None:
        """Drop the rays that rungs of the same geometry share."""
        self._cast.clear()

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """A shot in the time domain, and as the rung has it without what the truth lacks."""
        from sweep.model import shot, truth

        study, stretch = self._study(rung), self._of(place)
        row = np.array([place - stretch.start])
        rows = stretch.around(row, 1)
        tiles = stretch.some(rows)
        cast = self._seen(study, tiles)
        called, _ = self._planned(rung, study, tiles, cast)
        one = np.searchsorted(rows, row)
        eyepoints = cast.eyepoints.some(one)
        if not eyepoints.seen.all():
            return _nothing(1), _nothing(1)
        every = names_of(int(called.flags[one[0]]))
        names = tuple(name for name in every if name not in NOT_IN_TRUTH)
        in_time, ordinary = (
            _look(study, tiles, names, look, False, eyepoints)[0]
            for look in (truth.find, shot.find)
        )
        return in_time, ordinary

    def coordinates(self) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
        """Scanner and number of each shot, and its place along the axes."""
        counts = [len(tiles.index) for tiles in self._tiles]
        scanners = np.repeat(np.array([t.part.scanner for t in self._tiles], object), counts)
        numbers = np.concatenate([tiles.index for tiles in self._tiles])
        found: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
            "scanner": (scanners, {"long_name": "scanner"}),
            "shot": (numbers, {"long_name": "number of the shot"}),
        }
        for k, axis in enumerate(self.spec.axes):
            along = np.repeat([tiles.part.axes[k] for tiles in self._tiles], counts)
            for member in axis.members:
                attributes = {"units": member.units, "path": member.path}
                found[member.name] = (np.asarray(member.display)[along], attributes)
        return found

    def _sample(self, points: int) -> list[Tiles]:
        """Tiles spread over scanners, axes and flight."""
        study = self._study(Rung(name="as written", kind=WRITTEN))
        found: list[Tiles] = []
        start, together = 0, self.most_times // TILE_SHOTS
        for name, stretches in study.scanners.items():
            axes = stretches.axes
            places = np.transpose(np.unravel_index(spread(axes, PLACES), axes)) if axes else [()]
            wanted = points / TILE_SHOTS / len(study.scanners) / len(places)
            for place in places:
                index = _spread_shots(stretches, max(together, math.ceil(wanted)))
                part = Part(name, tuple(int(i) for i in place), 0, 0)
                found.append(Tiles(part, index, start))
                start += len(index)
        return found

    def _of(self, place: int) -> Tiles:
        """The stretch that a place of the sample is in."""
        return next(tiles for tiles in reversed(self._tiles) if tiles.start <= place)

    def _study(self, rung: Rung) -> FlightStudy:
        if rung.name not in self._studies:
            spec = rung.of(self.spec)
            self._studies[rung.name] = FlightStudy(spec, Path("nowhere.zarr"))  # type: ignore[arg-type]
        return self._studies[rung.name]

    def _seen(self, study: FlightStudy, tiles: Tiles) -> Cast:
        """What shots see: rays are cast once for all rungs of the same geometry."""
        from sweep.scenes.eyepoint_arrays import from_arrays

        scanner = tiles.part.scanner
        geometry = self._geometry_of(study, scanner)
        if geometry not in self._casters:
            self._casters[geometry] = _Caster(study.spec, scanner, world_of(self.spec))
        which_shots = geometry, tiles.start, tiles.index.tobytes()
        if which_shots not in self._cast:
            caster = self._casters[geometry]
            begun = thread_time()
            eyepoints = from_arrays(caster.cast(tiles.index), caster.weight)
            self._cast[which_shots] = Cast(eyepoints, thread_time() - begun)
        return self._cast[which_shots]

    def _geometry_of(self, study: FlightStudy, scanner: str) -> str:
        if (id(study), scanner) not in self._geometry:
            self._geometry[id(study), scanner] = study.spec.geometry_id(scanner)
        return self._geometry[id(study), scanner]

    def _planned(
        self, rung: Rung, study: FlightStudy, tiles: Tiles, cast: Cast
    ) -> tuple[Called, float]:
        """What is simulated of shots, and the time [s] that it took to say."""
        if rung.of_lines:
            names = of_lines(self.effects(Rung(name="as written", kind=WRITTEN)))
            return _everywhere(frozenset(names), cast.eyepoints), 0.0
        begun = thread_time()
        called = _called(study, tiles, cast.eyepoints)
        return called, thread_time() - begun if rung.plans else 0.0

    def _looked(
        self, rung: Rung, study: FlightStudy, tiles: Tiles, eyepoints: Eyepoints, called: Called
    ) -> Seen:
        """Statistics of shots, of those that see anything; more rays are cast where they must."""
        whole = _nothing(len(called.flags))
        accuracy, rays = study.rays_accuracy, eyepoints.weight.size
        if rung.rays_error:
            accuracy = Accuracy(rung.rays_error, least_rays_tolerance=0.0)
        seen = np.flatnonzero(eyepoints.seen)
        for among, names, flags in called.some(seen).together():
            index = seen[among]
            look = partial(_look, study, tiles, names, look_of(rung), accuracy is not None)
            error = _put(whole, index, look(eyepoints.some(index), flags))
            if accuracy is not None:
                found = whole, index, flags, error
                self._refine(study, tiles, rays, found, accuracy, look)
        return whole

    def _refine(
        self,
        study: FlightStudy,
        tiles: Tiles,
        rays: int,
        found: tuple[Seen, np.ndarray, np.ndarray, np.ndarray],
        accuracy: Accuracy,
        look: Callable[[Eyepoints, np.ndarray], tuple[Seen, np.ndarray]],
    ) -> None:
        """As the study does where the tolerance says how many rays there are."""
        whole, index, flags, error = found
        if id(study) not in self._finer:
            make = partial(_Caster, world=world_of(self.spec))
            self._finer[id(study)] = FinerRays(study.spec, make)

        def again(places: np.ndarray, more: int) -> np.ndarray:
            some = index[places]
            seen = self._finer[id(study)].see(tiles.part.scanner, tiles.index[some], more)
            there, error = np.flatnonzero(seen.seen), np.zeros(len(some))
            own = flags[places][there]
            error[there] = _put(whole, some[there], look(seen.some(there), own))
            return error

        refine(rays, error, accuracy, again)


def _spread_shots(stretches: Stretches, tiles: int) -> np.ndarray:
    """Numbers of the shots, in whole cycles, of some tiles of a scanner."""
    cycle = stretches.shots_a_cycle
    total = stretches.total_cycles * cycle
    some = np.sort(spread((-(-total // TILE_SHOTS),), tiles))
    shots = (some[:, None] * TILE_SHOTS + np.arange(TILE_SHOTS)).ravel()
    cycles = np.unique(shots[shots < total] // cycle)
    return np.asarray((cycles[:, None] * cycle + np.arange(cycle)).ravel())


def _called(study: FlightStudy, tiles: Tiles, eyepoints: Eyepoints) -> Called:
    """What is simulated of shots, planned in their tiles."""
    number = len(tiles.index)
    planned = study.planned(tiles.part, eyepoints, tiles.tile)
    nothing = Called(np.zeros(number, np.uint32), np.zeros(number))
    return nothing if planned is None else planned.called(number)


def _everywhere(names: frozenset[str], eyepoints: Eyepoints) -> Called:
    """The same effects of every shot that sees anything."""
    from sweep.model.effects.catalogue import NAMES

    flag = flags_of(np.array([[name in names] for name in NAMES]))[0]
    seen = eyepoints.seen
    return Called(np.where(seen, flag, 0).astype(np.uint32), np.zeros(len(seen)))


def _put(whole: Seen, index: np.ndarray, found: tuple[Seen, np.ndarray]) -> np.ndarray:
    """Put statistics of some shots into those of all; what their rays leave."""
    seen, error = found
    for values, some in zip(whole, seen, strict=True):
        values[index] = some
    return error


def _look(
    study: FlightStudy,
    tiles: Tiles,
    names: tuple[str, ...],
    look: Look,
    estimates: bool,
    eyepoints: Eyepoints,
    flags: np.ndarray | None = None,
) -> tuple[Seen, np.ndarray]:
    """Statistics of shots that see something, from a way to look at their spectra.

    And what their rays leave, (n,), if that is asked for.
    """
    from sweep.model.eyepoints import seen_ground
    from sweep.model.ray_error import ray_error
    from sweep.model.shot import prepare_cast, statistics

    given, ground = seen_ground(eyepoints, study.parameters_at(tiles.part), study.surfaces)
    shots = prepare_cast(given, ground, names, flags)
    found = look(shots)
    rays = np.full(shots.size, float(eyepoints.weight.size))
    seen = seen_in(statistics(shots, found), MEAN, 0)._replace(beamlets=rays)
    error = np.zeros(shots.size)
    if estimates:
        bins = found[:, 3].T * (shots.fft_size / shots.sample_rate[:, None])
        error = ray_error(shots, ground.beamlets, bins, found[:, 2].T)
    return seen, error


def _nothing(shots: int) -> Seen:
    sizes = ((shots, 4), (shots, 2), (shots, 2), (shots, 3), shots, shots, shots)
    return Seen(*(np.full(size, np.nan) for size in sizes))
