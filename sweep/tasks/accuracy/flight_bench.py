"""Shots of a flight to try rungs on: whole tiles, as effects are planned in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from sweep.model import shot, truth
from sweep.model.accuracy import Accuracy
from sweep.model.effects.catalogue import NAMES, flags_of, names_of
from sweep.model.eyepoints import Eyepoints, seen_ground
from sweep.model.ray_error import ray_error
from sweep.scenes.eyepoint_arrays import from_arrays
from sweep.spec import SceneSpec
from sweep.tasks.accuracy.bench import (
    AS_WRITTEN,
    NOT_IN_TRUTH,
    Bench,
    Look,
    Seen,
    Trial,
    along_axes,
    look_of,
    nothing,
    seen_in,
    spread,
)
from sweep.tasks.accuracy.rungs import Rung
from sweep.tasks.eyepoint_study import world_of
from sweep.tasks.flight_study import FlightStudy, Part
from sweep.tasks.grid_study import Selected
from sweep.tasks.study import TILE_SHOTS, Results

#: Places along the axes at which each scanner is looked at.
PLACES = 2


@dataclass(frozen=True, eq=False)
class Tiles:
    """Shots of one scanner, in whole tiles, at one place of the axes."""

    part: Part
    index: np.ndarray  # numbers of the shots, rising
    start: int  # place in the sample of the first of the stretch that they are of

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
        """Rows of whole tiles of so many shots: those of some and what follows, round the end."""
        tiles, counts = np.unique(self.tile, return_counts=True)
        own = np.unique(self.tile[rows])
        order = np.roll(np.arange(tiles.size), -int(np.searchsorted(tiles, own[0])))
        enough = int(np.searchsorted(np.cumsum(counts[order]), number)) + 1
        return np.flatnonzero(np.isin(self.tile, [*own, *tiles[order[:enough]]]))


class FlightBench(Bench):
    """A sample of the shots of a flight: whole tiles, as effects are planned in them.

    The time counts rays, plans, spectra and probabilities; draws, points and navigation cost
    the same whatever the accuracy.
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, points: int) -> None:
        super().__init__()
        self.spec = spec
        self._studies: dict[str, FlightStudy] = {}
        self._cast: dict[tuple[str, int, bytes], tuple[Eyepoints, float]] = {}
        # What costs the same for any number of shots, as planning mostly does, a block shares.
        self.most_times = max(int(spec.storage.block_shots), TILE_SHOTS)
        self._tiles = self._sample(points)
        self.least_parts = len(self._tiles)  # one for each scanner and place along the axes
        self.size = sum(len(tiles.index) for tiles in self._tiles)
        stretches = self._study(AS_WRITTEN).scanners.values()
        self.whole = sum(s.total_cycles * s.shots_a_cycle * math.prod(s.axes) for s in stretches)

    def parts(self, points: int) -> list[np.ndarray]:
        """Cut the sample into parts of about so many shots, from all scanners and places."""
        number = max(1, round(points / TILE_SHOTS))
        turns = zip_longest(*(tiles.parts(number) for tiles in self._tiles))
        return [part for turn in turns for part in turn if part is not None]

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """Compute a rung on a part of the sample, timed with its rays and neighbouring tiles."""
        tiles, own = self._around(part, times)
        eyepoints, casting = self._see(rung, tiles)
        selected, planning = self._selected(rung, tiles, eyepoints)
        study, whole = self._study(rung), nothing(len(tiles.index))
        cloud = partial(_statistics, study, tiles.part, look_of(rung))
        begun = thread_time()
        for rows, found in study.clouds(
            tiles.part.scanner, eyepoints, selected, tiles.index, eyepoints.seen.nonzero()[0], cloud
        ):
            for values, some in zip(whole, seen_in(found), strict=True):
                values[rows] = some
        spent = thread_time() - begun + casting + planning
        number = len(tiles.index)
        return Trial(Seen(*(values[own] for values in whole)), spent / number, planning / number)

    def forget(self) -> None:
        """Drop the rays that rungs of the same geometry share."""
        self._cast.clear()

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """Compute a shot in the time domain, and with the rung's effects that the truth has."""
        tiles, one = self._around(np.array([place]), 1)
        every, _ = self._see(rung, tiles)
        flags = self._selected(rung, tiles, every)[0].flags[one]
        eyepoints = every.some(one)
        if not eyepoints.seen.all():
            return nothing(1), nothing(1)
        names = tuple(name for name in names_of(int(flags[0])) if name not in NOT_IN_TRUTH)
        in_time, ordinary = (
            _statistics(self._study(rung), tiles.part, look, names, eyepoints, one, flags)
            for look in (truth.find, shot.find)
        )
        return seen_in(in_time), seen_in(ordinary)

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
                tiles = max(self.most_times // TILE_SHOTS, wanted)
                index = self._study(AS_WRITTEN).caster(stretches.scanner).spread(tiles)
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
            spec: Any = rung.of(self.spec)
            # in a world that all share, as building one can take seconds
            study = FlightStudy(spec, Path("nowhere.zarr"), world_of(self.spec))
            if rung.rays_error:
                study.rays_accuracy = Accuracy(rung.rays_error, least_rays_tolerance=0.0)
            self._studies[rung.name] = study
        return self._studies[rung.name]

    def _see(self, rung: Rung, tiles: Tiles) -> tuple[Eyepoints, float]:
        """Eyepoints of shots, cast once for rungs of a geometry, and the time that it took [s]."""
        caster = self._study(rung).caster(tiles.part.scanner)
        which_shots = caster.id, tiles.start, tiles.index.tobytes()
        if which_shots not in self._cast:
            begun = thread_time()
            eyepoints = from_arrays(caster.cast(tiles.index), caster.weight)
            self._cast[which_shots] = eyepoints, thread_time() - begun
        return self._cast[which_shots]

    def _flags(self, rung: Rung) -> np.ndarray:
        selected = [
            self._selected(rung, tiles, self._see(rung, tiles)[0])[0] for tiles in self._tiles
        ]
        return np.concatenate([each.flags for each in selected])

    def _selected(self, rung: Rung, tiles: Tiles, eyepoints: Eyepoints) -> tuple[Selected, float]:
        """Effects simulated at shots, planned in their tiles, and the time that this took [s]."""
        if rung.of_lines:
            flag = flags_of(np.array([[name in self.of_lines()] for name in NAMES]))[0]
            flags = np.where(eyepoints.seen, flag, 0).astype(np.uint32)
            return Selected(flags, np.zeros(flags.size)), 0.0
        begun = thread_time()
        selected = self._study(rung).select(tiles.part, eyepoints, tiles.index)
        return selected, thread_time() - begun if rung.plans else 0.0


def _statistics(
    study: FlightStudy,
    part: Part,
    look: Look,
    effects: tuple[str, ...],
    eyepoints: Eyepoints,
    numbers: np.ndarray,
    flags: np.ndarray,
) -> Results:
    """Statistics of shots by a way to look at their spectra; nan of those that see nothing."""
    there, rays = eyepoints.seen.nonzero()[0], eyepoints.weight.size
    given, ground = seen_ground(eyepoints.some(there), study.parameters_at(part), study.surfaces)
    shots = shot.prepare_cast(given, ground, effects, flags[there])
    found = look(shots)
    results = shot.statistics(shots, found) | {"beamlets": np.full(shots.size, rays)}
    if study.rays_accuracy is not None:
        bins = found[:, 3].T * (shots.fft_size / shots.sample_rate[:, None])
        results["beamlets_error"] = ray_error(shots, ground.beamlets, bins, found[:, 2].T)
    whole = {name: np.full(numbers.size, np.nan) for name in results}
    for name, values in results.items():
        whole[name][there] = values
    return whole
