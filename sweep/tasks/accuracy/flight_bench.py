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
from sweep.model.effects.catalogue import NAMES, flags_of, names_of
from sweep.tasks.accuracy.bench import (
    AS_WRITTEN,
    NOT_IN_TRUTH,
    Bench,
    Seen,
    Trial,
    along_axes,
    look_of,
    nothing,
    seen_in,
    spread,
)
from sweep.tasks.accuracy.rungs import Rung
from sweep.tasks.effect_selection import TILE_SHOTS, Selected
from sweep.tasks.eyepoint_study import EyepointStudy, FinerRays, refine, world_of
from sweep.tasks.flight_study import FlightStudy, Part, ScannerBlocks

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
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
        return np.flatnonzero(np.isin(self.tile, [*own, *tiles[order[:enough]]]))


class Cast(NamedTuple):
    """Eyepoints of shots, and the time that casting their rays took [s]."""

    eyepoints: Eyepoints
    seconds: float


class FlightBench(Bench):
    """A sample of the shots of a flight: whole tiles, as effects are planned in them.

    What counts is rays, plans, spectra and probabilities; draws, points and navigation cost the
    same whatever the accuracy, and are left out.
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, points: int) -> None:
        super().__init__()
        self.spec = spec
        self._studies: dict[str, FlightStudy] = {}
        self._casters: dict[str, EyepointStudy] = {}
        self._cast: dict[tuple[str, int, bytes], Cast] = {}
        self._finer: dict[str, FinerRays] = {}
        self._geometries: dict[tuple[str, str], str] = {}
        # What costs the same for any number of shots, as planning mostly does, a block shares.
        self.most_times = max(int(spec.storage.block_shots), TILE_SHOTS)
        self._tiles = self._sample(points)
        self.least_parts = len(self._tiles)  # one for each scanner and place along the axes
        self.size = sum(len(tiles.index) for tiles in self._tiles)
        stretches = self._study(AS_WRITTEN).scanners.values()
        self.whole = sum(s.total_cycles * s.shots_a_cycle * math.prod(s.axes) for s in stretches)

    def parts(self, points: int) -> list[np.ndarray]:
        """The sample in parts of about so many shots, from all scanners and places in turn."""
        number = max(1, round(points / TILE_SHOTS))
        turns = zip_longest(*(tiles.parts(number) for tiles in self._tiles))
        return [part for turn in turns for part in turn if part is not None]

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """A rung on a part of the sample, timed with its rays and the tiles beside it."""
        tiles, own = self._around(part, times)
        cast = self._see(rung, tiles)
        selected, planning = self._selected(rung, tiles, cast.eyepoints)
        begun = thread_time()
        seen = self._look(rung, tiles, cast.eyepoints, selected)
        spent = thread_time() - begun + cast.seconds + planning
        number = len(tiles.index)
        return Trial(Seen(*(values[own] for values in seen)), spent / number, planning / number)

    def forget(self) -> None:
        """Drop the rays that rungs of the same geometry share."""
        self._cast.clear()

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """A shot in the time domain, and as the rung has it without what the truth lacks."""
        from sweep.model import shot, truth

        tiles, one = self._around(np.array([place]), 1)
        cast = self._see(rung, tiles)
        selected, _ = self._selected(rung, tiles, cast.eyepoints)
        eyepoints = cast.eyepoints.some(one)
        if not eyepoints.seen.all():
            return nothing(1), nothing(1)
        every = names_of(int(selected.flags[one[0]]))
        names = tuple(name for name in every if name not in NOT_IN_TRUTH)
        study = self._study(rung)
        in_time, ordinary = (
            _statistics(study, tiles.part, names, look, eyepoints)[0]
            for look in (truth.find, shot.find)
        )
        return in_time, ordinary

    def coordinates(self) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
        """Scanner and number of each shot, and its place along the axes."""
        counts = [len(tiles.index) for tiles in self._tiles]
        scanners = np.repeat(np.array([t.part.scanner for t in self._tiles], object), counts)
        numbers = np.concatenate([tiles.index for tiles in self._tiles])
        index = [
            np.repeat([tiles.part.axes[k] for tiles in self._tiles], counts)
            for k in range(len(self.spec.axes))
        ]
        return {
            "scanner": (scanners, {"long_name": "scanner"}),
            "shot": (numbers, {"long_name": "number of the shot"}),
            **along_axes(self.spec.axes, tuple(index)),
        }

    def _sample(self, points: int) -> list[Tiles]:
        """Tiles spread over scanners, axes and flight."""
        found: list[Tiles] = []
        start, scanners = 0, self._study(AS_WRITTEN).scanners
        for stretches in scanners.values():
            axes = stretches.axes
            places = np.transpose(np.unravel_index(spread(axes, PLACES), axes)) if axes else [()]
            wanted = math.ceil(points / TILE_SHOTS / len(scanners) / len(places))
            for place in places:
                index = _spread_shots(stretches, max(self.most_times // TILE_SHOTS, wanted))
                part = stretches.first_part(tuple(int(i) for i in place))
                found.append(Tiles(part, index, start))
                start += len(index)
        return found

    def _around(self, part: np.ndarray, times: int) -> tuple[Tiles, np.ndarray]:
        """Whole tiles with a part of the sample, of so many shots, and where it is among them."""
        stretch = next(tiles for tiles in reversed(self._tiles) if tiles.start <= part[0])
        own = part - stretch.start
        rows = stretch.around(own, times)
        tiles = Tiles(stretch.part, stretch.index[rows], stretch.start)
        return tiles, np.searchsorted(rows, own)

    def _study(self, rung: Rung) -> FlightStudy:
        if rung.name not in self._studies:
            spec = rung.of(self.spec)
            self._studies[rung.name] = FlightStudy(spec, Path("nowhere.zarr"))  # type: ignore[arg-type]
        return self._studies[rung.name]

    def _see(self, rung: Rung, tiles: Tiles) -> Cast:
        """Eyepoints of shots: rays are cast once for all rungs of the same geometry."""
        from sweep.scenes.eyepoint_arrays import from_arrays

        spec, scanner = self._study(rung).spec, tiles.part.scanner
        if (rung.name, scanner) not in self._geometries:
            self._geometries[rung.name, scanner] = spec.geometry_id(scanner)
        geometry = self._geometries[rung.name, scanner]
        if geometry not in self._casters:
            # in a world that all share, as building one can take seconds
            self._casters[geometry] = EyepointStudy(spec, scanner, world=world_of(self.spec))
        which_shots = geometry, tiles.start, tiles.index.tobytes()
        if which_shots not in self._cast:
            caster = self._casters[geometry]
            begun = thread_time()
            eyepoints = from_arrays(caster.cast(tiles.index), caster.weight)
            self._cast[which_shots] = Cast(eyepoints, thread_time() - begun)
        return self._cast[which_shots]

    def _flags(self, rung: Rung) -> np.ndarray:
        selected = [
            self._selected(rung, tiles, self._see(rung, tiles).eyepoints) for tiles in self._tiles
        ]
        return np.concatenate([each.flags for each, _ in selected])

    def _selected(self, rung: Rung, tiles: Tiles, eyepoints: Eyepoints) -> tuple[Selected, float]:
        """Effects simulated at shots, planned in their tiles, and the time that this took [s]."""
        if rung.of_lines:
            flag = flags_of(np.array([[name in self.of_lines()] for name in NAMES]))[0]
            flags = np.where(eyepoints.seen, flag, 0).astype(np.uint32)
            return Selected(flags, np.zeros(flags.size)), 0.0
        begun = thread_time()
        selected = self._study(rung).select(tiles.part, eyepoints, tiles.index)
        return selected, thread_time() - begun if rung.plans else 0.0

    def _look(self, rung: Rung, tiles: Tiles, eyepoints: Eyepoints, selected: Selected) -> Seen:
        """Statistics of shots, of those that see anything; more rays are cast where they must."""
        whole, study = nothing(len(selected.flags)), self._study(rung)
        accuracy = study.rays_accuracy
        if rung.rays_error:
            accuracy = Accuracy(rung.rays_error, least_rays_tolerance=0.0)
        seen = np.flatnonzero(eyepoints.seen)
        for among, names, flags in selected.some(seen).together():
            look = partial(_statistics, study, tiles.part, names, look_of(rung))
            group = _Group(
                whole=whole,
                index=seen[among],
                numbers=tiles.index[seen[among]],
                flags=flags,
                look=partial(look, estimates=accuracy is not None),
                cast=partial(self._finer_rays(rung).see, tiles.part.scanner),
            )
            error = group.put(np.arange(among.size), eyepoints.some(group.index))
            if accuracy is not None:
                refine(eyepoints.weight.size, error, accuracy, group.cast_again)
        return whole

    def _finer_rays(self, rung: Rung) -> FinerRays:
        if rung.name not in self._finer:
            self._finer[rung.name] = FinerRays(self._study(rung).spec, world_of(self.spec))
        return self._finer[rung.name]


def _spread_shots(stretches: ScannerBlocks, tiles: int) -> np.ndarray:
    """Numbers of the shots, in whole cycles, of some tiles of a scanner."""
    cycle = stretches.shots_a_cycle
    total = stretches.total_cycles * cycle
    some = np.sort(spread((-(-total // TILE_SHOTS),), tiles))
    shots = (some[:, None] * TILE_SHOTS + np.arange(TILE_SHOTS)).ravel()
    cycles = np.unique(shots[shots < total] // cycle)
    return np.asarray((cycles[:, None] * cycle + np.arange(cycle)).ravel())


def _statistics(
    study: FlightStudy,
    part: Part,
    names: tuple[str, ...],
    look: Look,
    eyepoints: Eyepoints,
    flags: np.ndarray | None = None,
    estimates: bool = False,
) -> tuple[Seen, np.ndarray]:
    """Statistics of shots that see something, from a way to look at their spectra.

    And what their rays leave, (n,), if that is asked for.
    """
    from sweep.model.eyepoints import seen_ground
    from sweep.model.ray_error import ray_error
    from sweep.model.shot import prepare_cast, statistics

    given, ground = seen_ground(eyepoints, study.parameters_at(part), study.surfaces)
    shots = prepare_cast(given, ground, names, flags)
    found = look(shots)
    rays = np.full(shots.size, float(eyepoints.weight.size))
    seen = seen_in(statistics(shots, found))._replace(beamlets=rays)
    if not estimates:
        return seen, np.zeros(shots.size)
    bins = found[:, 3].T * (shots.fft_size / shots.sample_rate[:, None])
    return seen, ray_error(shots, ground.beamlets, bins, found[:, 2].T)


@dataclass(frozen=True, kw_only=True)
class _Group:
    """Shots that are computed together, and where their statistics go."""

    whole: Seen
    """Statistics of all shots."""
    index: np.ndarray
    """Places of the group among them."""
    numbers: np.ndarray
    flags: np.ndarray
    look: Callable[[Eyepoints, np.ndarray], tuple[Seen, np.ndarray]]
    cast: Callable[[np.ndarray, int], Eyepoints]

    def put(self, places: np.ndarray, eyepoints: Eyepoints) -> np.ndarray:
        """Put statistics of some of the group into those of all; what their rays leave."""
        seen, error = self.look(eyepoints, self.flags[places])
        for values, some in zip(self.whole, seen, strict=True):
            values[self.index[places]] = some
        return error

    def cast_again(self, places: np.ndarray, rays: int) -> np.ndarray:
        """The same with more rays, of those that then see anything."""
        eyepoints = self.cast(self.numbers[places], rays)
        there, error = np.flatnonzero(eyepoints.seen), np.zeros(len(places))
        error[there] = self.put(places[there], eyepoints.some(there))
        return error
