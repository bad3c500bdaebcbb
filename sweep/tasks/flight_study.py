"""A point cloud as a study: radiometry, draws and navigation on eyepoints that are there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from itertools import takewhile
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.storage.locations import Location
from sweep.tasks import flight_layout
from sweep.tasks.calling import TILE_SHOTS, Called, ShotsCalling, ShotsPlan
from sweep.tasks.earlier import Earlier
from sweep.tasks.eyepoint_reader import EyepointReader
from sweep.tasks.eyepoint_study import EyepointStudy, eyepoints_path, world_of
from sweep.tasks.finer_rays import FinerRays, refine
from sweep.tasks.flight_navigation import solved
from sweep.tasks.grid_study import coordinates
from sweep.tasks.patches import KnownCloud, Patch, completed
from sweep.tasks.stretches import Part, Stretches
from sweep.tasks.study import ArrayLayout, Results

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.model.geometry.mesh import Surface
    from sweep.spec import SceneSpec

#: Domain of the keys of draws; a shot's key is its number, so that the draws of a flight are the
#: same along every axis and for every instrument.
DOMAIN = "sweep.flight"


class FlightStudy:
    """The point clouds of a flight, a group of arrays for each scanner.

    Parameters
    ----------
    spec
        The study.
    path
        Its store, beside which the eyepoints are.
    look_up
        Finds where some of its results are already; asked as the first block is computed.
    """

    unit = "shots"

    def __init__(
        self,
        spec: SceneSpec,
        path: Location,
        look_up: Callable[[FlightStudy], Earlier[KnownCloud] | None] | None = None,
    ) -> None:
        self.spec, self.path, self._look_up = spec, path, look_up
        self._stretches = [Stretches(spec, scanner) for scanner in spec.scanners]
        self._readers: dict[str, EyepointReader] = {}
        self._parameters: dict[tuple[int, ...], Mapping[str, Any]] = {}
        self._calling: dict[tuple[int, ...], ShotsCalling] = {}

    @cached_property
    def earlier(self) -> Earlier[KnownCloud] | None:
        """Where some of its results are already, if anywhere."""
        return self._look_up(self) if self._look_up else None

    @property
    def id(self) -> str:
        """Hash of the spec's identity."""
        return self.spec.id

    @property
    def scanners(self) -> dict[str, Stretches]:
        """Blocks of each scanner."""
        return {stretches.scanner: stretches for stretches in self._stretches}

    @property
    def points(self) -> int:
        """Shots of all scanners, times draws, times places along the axes."""
        return sum(
            s.total_cycles * s.shots_a_cycle * s.draws * math.prod(s.axes) for s in self._stretches
        )

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return sum(stretches.number for stretches in self._stretches)

    def part(self, block: int) -> tuple[Stretches, Part]:
        """What a block is, and the blocks of its scanner.

        Raises
        ------
        IndexError
            Where there is no such block.
        """
        if block < 0:
            raise IndexError(f"there is no block {block}")
        for stretches in self._stretches:
            if block < stretches.number:
                return stretches, stretches.part(block)
            block -= stretches.number
        raise IndexError(f"block is beyond the {self.n_blocks} of the study")

    def block(self, part: Part) -> int:
        """Number of a block."""
        before = takewhile(lambda stretches: stretches.scanner != part.scanner, self._stretches)
        return sum(each.number for each in before) + self.scanners[part.scanner].block(part)

    def block_size(self, block: int) -> int:
        """Shots of a block, times draws."""
        stretches, part = self.part(block)
        return stretches.points(part)

    def points_in(self, blocks: np.ndarray) -> int:
        """Shots in the blocks that are marked in an ndarray of bool (blocks,), times draws."""
        numbers = [stretches.number for stretches in self._stretches]
        parts = np.split(np.asarray(blocks, bool), np.cumsum(numbers)[:-1])
        return sum(s.points_in(part) for s, part in zip(self._stretches, parts, strict=True))

    def attributes(self) -> dict[str, Any]:
        """Title, question, spec, and what the numbers of scanners and surfaces mean."""
        return {
            "kind": "scene",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "surfaces": [surface.name for surface in self.surfaces],
            "scanners": list(self.spec.scanners),
            "eyepoints": {name: self.spec.geometry_id(name) for name in self.spec.scanners},
            "origin": self._map.origin.tolist(),
        }

    def groups(self) -> dict[str, dict[str, Any]]:
        """A group for each scanner."""
        names = " ".join(member.name for axis in self.spec.axes for member in axis.members)
        return {
            s.scanner: {
                "shots_a_cycle": s.shots_a_cycle,
                "geometry_id": self.spec.geometry_id(s.scanner),
                "coordinates": names,
            }
            for s in self._stretches
        }

    def arrays(self) -> list[ArrayLayout]:
        """The map of the scene, and every scanner's coordinates and outputs."""
        arrays = list(self._map.arrays())
        for stretches in self._stretches:
            own = coordinates(self.spec.axes)
            own += flight_layout.arrays(self.spec, stretches)
            arrays += [layout.within(stretches.scanner) for layout in own]
        return arrays

    def chunks(self, block: int) -> dict[str, tuple[int, ...]]:
        """Chunks of a block: what has no draws goes with the first, and so does the geometry."""
        return flight_layout.chunks(*self.part(block))

    def owners(self) -> dict[str, np.ndarray]:
        """The blocks along axes, draws and stretches, as far as an array has these dimensions."""
        found: dict[str, np.ndarray] = {}
        first = 0
        for stretches in self._stretches:
            found |= flight_layout.owners(stretches, first)
            first += stretches.number
        return found

    def evaluate(self, block: int) -> Results:
        """Point cloud, statistics and navigation of a block."""
        stretches, part = self.part(block)
        begin, own, shots, around = self._in_tiles(stretches, part)
        called = self.call(part, around, begin + np.arange(len(around.time))).some(own)
        shots = {name: values[own] for name, values in shots.items()}
        results = shots | self._reader(part.scanner).cycles(*stretches.cycle_range(part))
        results |= {"effects": called.flags, "effects_error": called.error}
        known = self.earlier.known(block, called) if self.earlier else KnownCloud()
        numbers = np.arange(begin + own.start, begin + own.stop)
        results |= self.look(part, shots, around.some(own), called, numbers, known)
        depth = len(part.axes)
        return {
            f"{part.scanner}/{name}": values.reshape((1,) * depth + values.shape)
            if flight_layout.is_radiometric(name)
            else values
            for name, values in results.items()
            if flight_layout.belongs(name, part)
        }

    def compile(self) -> None:
        """Compile the radiometry and the navigation, on the first cycle of each scanner."""
        for stretches in self._stretches:
            part = stretches.part(0)
            shots, eyepoints = self._reader(part.scanner).shots(0, stretches.shots_a_cycle)
            numbers = np.arange(stretches.shots_a_cycle)
            called = self.call(part, eyepoints, numbers)
            self.look(part, shots, eyepoints, called, numbers)

    def called(self, block: int) -> Called:
        """What is simulated of a block's shots, whatever the block: whole tiles are looked at."""
        stretches, part = self.part(block)
        begin, own, _, around = self._in_tiles(stretches, part)
        return self.call(part, around, begin + np.arange(len(around.time))).some(own)

    def _in_tiles(self, stretches: Stretches, part: Part) -> tuple[int, slice, Results, Eyepoints]:
        """Number of the first shot of a block's tiles, its own among these, and what they see."""
        first, stop = stretches.shot_range(part)
        total = stretches.total_cycles * stretches.shots_a_cycle
        begin = first // TILE_SHOTS * TILE_SHOTS
        end = min(-(-stop // TILE_SHOTS) * TILE_SHOTS, total)
        shots, eyepoints = self._reader(part.scanner).shots(begin, end)
        return begin, slice(first - begin, stop - begin), shots, eyepoints

    def call(self, part: Part, eyepoints: Eyepoints, numbers: np.ndarray) -> Called:
        """Effects simulated at shots of these numbers, rising."""
        number = len(numbers)
        planned = self.planned(part, eyepoints, numbers // TILE_SHOTS)
        nothing = Called(np.zeros(number, np.uint32), np.zeros(number))
        return nothing if planned is None else planned.called(number)

    def planned(self, part: Part, eyepoints: Eyepoints, tiles: np.ndarray) -> ShotsPlan | None:
        """Plans of shots whose tiles have these numbers, (n,), rising."""
        if part.axes not in self._calling:
            self._calling[part.axes] = ShotsCalling(
                self.parameters_at(part),
                self.surfaces,
                modes=self._modes,
                rotating=self._rotating,
                rays_by_tolerance=self.rays_accuracy is not None,
            )
        return self._calling[part.axes].plans(eyepoints, tiles)

    def look(
        self,
        part: Part,
        shots: Results,
        eyepoints: Eyepoints,
        called: Called,
        numbers: np.ndarray,
        known: KnownCloud = KnownCloud(),  # noqa: B008
    ) -> Results:
        """Radiometry, draws and navigation of some shots.

        Parameters
        ----------
        part
            Scanner, place along the axes and stretch of draws.
        shots, eyepoints
            Whole cycles of them.
        called
            What is simulated of each.
        numbers
            Of the shots, counted from the flight's first.
        known
            What need not be computed.
        """
        stretches = self.scanners[part.scanner]
        begin, end = stretches.draw_range(part)
        number, draws = called.flags.size, end - begin
        clouds = partial(self._clouds, part, eyepoints, called, numbers)
        found = completed(known.points, (number, draws), clouds)
        if not stretches.navigates:
            return found
        solutions = partial(solved, self.spec, stretches, shots, found)
        cycles = number // stretches.shots_a_cycle
        return found | completed(known.navigation, (cycles, draws), solutions)

    def _clouds(
        self,
        part: Part,
        eyepoints: Eyepoints,
        called: Called,
        numbers: np.ndarray,
        rows: np.ndarray,
        draws: slice,
    ) -> Iterator[Patch]:
        """Points of some of the shots, those together that call for much the same."""
        for index, effects, flags in called.some(rows).together():
            some = rows[index]
            cloud = self._cloud(part, draws, effects)
            results = cloud(eyepoints.some(some), numbers[some], flags)
            if (accuracy := self.rays_accuracy) is not None:
                own = numbers[some], flags, eyepoints.weight.size
                self._refine(part.scanner, own, accuracy, results, cloud)
            yield Patch(some, draws, results)

    def _cloud(
        self, part: Part, draws: slice, effects: tuple[str, ...]
    ) -> Callable[[Eyepoints, np.ndarray, np.ndarray], Results]:
        """What makes points of eyepoints, the shots' numbers and flags."""
        from sweep.model.clouds import cloud
        from sweep.model.philox import point_keys

        begin, _ = self.scanners[part.scanner].draw_range(part)
        make = partial(
            cloud,
            parameters=self.parameters_at(part),
            surfaces=self.surfaces,
            first_draw=begin + draws.start,
            draws=draws.stop - draws.start,
            method=self.spec.draws.method,
            returns=int(self.spec.draws.returns),
            effects=effects,
            estimates_rays=self.rays_accuracy is not None,
        )
        keys = partial(point_keys, domain=DOMAIN, seed=int(self.spec.seed))
        return lambda seen, numbers, flags: make(
            seen, keys=keys(numbers[:, None].astype(float)), flags=flags
        )

    def _refine(
        self,
        scanner: str,
        own: tuple[np.ndarray, np.ndarray, int],
        accuracy: Accuracy,
        results: Results,
        cloud: Callable[[Eyepoints, np.ndarray, np.ndarray], Results],
    ) -> None:
        """Put points of shots that need more rays in the place of their results.

        ``own``: the shots' numbers, flags, and how many rays they had.
        """
        numbers, flags, rays = own

        def again(places: np.ndarray, more: int) -> np.ndarray:
            some = numbers[places]
            finer = cloud(self._finer_rays.see(scanner, some, more), some, flags[places])
            for name, values in finer.items():
                results[name][places] = values
            return finer["beamlets_error"]

        refine(rays, results["beamlets_error"], accuracy, again)

    def parameters_at(self, part: Part) -> Mapping[str, Any]:
        """SI values of all parameters at a block's place along the axes, which is asked often."""
        if part.axes not in self._parameters:
            parameters: dict[str, Any] = dict(self.spec.parameters())
            for axis, index in zip(self.spec.axes, part.axes, strict=True):
                for member in axis.members:
                    value = member.values[index]
                    scalar = value.item() if isinstance(value, np.generic) else value
                    parameters[member.path] = scalar
            self._parameters[part.axes] = MappingProxyType(parameters)
        return self._parameters[part.axes]

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """What surface numbers mean."""
        return self.spec.surfaces()

    @cached_property
    def rays_accuracy(self) -> Accuracy | None:
        """Says how many rays a shot needs; None where their number is given."""
        return Accuracy.of(self.spec.parameters()) if self.spec.rays_by_tolerance else None

    @cached_property
    def _modes(self) -> Mapping[str, str]:
        return self.spec.modes()

    @cached_property
    def _rotating(self) -> bool:
        return self.spec.rotating

    @cached_property
    def _finer_rays(self) -> FinerRays:
        return FinerRays(self.spec)

    def _reader(self, scanner: str) -> EyepointReader:
        if scanner not in self._readers:
            path = eyepoints_path(self.path, self.spec.geometry_id(scanner))
            self._readers[scanner] = EyepointReader(path)
        return self._readers[scanner]

    def eyepoint_studies(self) -> Iterator[EyepointStudy]:
        """The studies that this one looks with."""
        for stretches in self._stretches:
            yield EyepointStudy(self.spec, stretches.scanner)

    @property
    def reports(self) -> tuple[str, ...]:
        """What loading the scene found and mended, a line an object."""
        return tuple(world_of(self.spec).reports)

    @cached_property
    def _map(self) -> Any:
        from sweep.tasks.scene_map import SceneMap

        return SceneMap.of(self.spec)
