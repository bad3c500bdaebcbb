"""A point cloud as a study: radiometry, draws and navigation on eyepoints that are there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.effects.flags import flag_attributes
from sweep.model.scene_outputs import (
    CYCLES,
    NAVIGATION,
    POINTS,
    SHOTS,
    SIMULATED,
    STATISTICS,
    SceneOutput,
)
from sweep.storage.locations import Location
from sweep.tasks.calling import EFFECTS, TILE_SHOTS, Called, ShotsPlan, plan_shots
from sweep.tasks.eyepoint_reader import EyepointReader
from sweep.tasks.eyepoint_study import (
    SIZES,
    EyepointStudy,
    eyepoints_path,
    scene_array,
    world_of,
)
from sweep.tasks.grid_study import coordinates
from sweep.tasks.stretches import Part, Stretches
from sweep.tasks.study import ArrayLayout, Results

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
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
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, path: Location) -> None:
        self.spec, self.path = spec, path
        self._stretches = [Stretches(spec, scanner) for scanner in spec.scanners]
        self._readers: dict[str, EyepointReader] = {}

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

    def _part(self, block: int) -> tuple[Stretches, Part]:
        if block < 0:
            raise IndexError(f"there is no block {block}")
        for stretches in self._stretches:
            if block < stretches.number:
                return stretches, stretches.part(block)
            block -= stretches.number
        raise IndexError(f"block is beyond the {self.n_blocks} of the study")

    def block_size(self, block: int) -> int:
        """Shots of a block, times draws."""
        stretches, part = self._part(block)
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
            "surfaces": [surface.name for surface in self.spec.surfaces()],
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
            own += [self._array(stretches, name) for name in self._outputs(stretches)]
            arrays += [layout.within(stretches.scanner) for layout in own]
        return arrays

    def _outputs(self, stretches: Stretches) -> dict[str, SceneOutput]:
        own = SHOTS | CYCLES | STATISTICS | SIMULATED | POINTS
        return own | (NAVIGATION if stretches.navigates else {})

    def _array(self, stretches: Stretches, name: str) -> ArrayLayout:
        output = self._outputs(stretches)[name]
        axes = tuple(axis.name for axis in self.spec.axes) if _is_radiometric(name) else ()
        sizes = SIZES | {
            "shot": stretches.total_cycles * stretches.shots_a_cycle,
            "cycle": stretches.total_cycles,
            "draw": stretches.draws,
            "return_number": int(self.spec.draws.returns),
        }
        cut = sizes | {
            "shot": stretches.block_cycles * stretches.shots_a_cycle,
            "cycle": stretches.block_cycles,
            "draw": stretches.block_draws,
        }
        layout = scene_array(
            name,
            output,
            (*stretches.axes[: len(axes)], *(sizes[dim] for dim in output.dims)),
            (*(1 for _ in axes), *(cut[dim] for dim in output.dims)),
            axes=axes,
        )
        return replace(layout, attributes=flag_attributes()) if name == EFFECTS else layout

    def chunks(self, block: int) -> dict[str, tuple[int, ...]]:
        """Chunks of a block: what has no draws goes with the first, and so does the geometry."""
        stretches, part = self._part(block)
        stretch = {"shot": part.cycles, "cycle": part.cycles, "draw": part.draws}
        return {
            f"{part.scanner}/{name}": (
                *(part.axes if _is_radiometric(name) else ()),
                *(stretch.get(dim, 0) for dim in output.dims),
            )
            for name, output in self._outputs(stretches).items()
            if _belongs(name, part)
        }

    def owners(self) -> dict[str, np.ndarray]:
        """The blocks along axes, draws and stretches, as far as an array has these dimensions."""
        found, first = {}, 0
        for stretches in self._stretches:
            blocks = first + np.arange(stretches.number).reshape(stretches.along)
            first += stretches.number
            for name, output in self._outputs(stretches).items():
                own = blocks if _is_radiometric(name) else blocks[(0,) * len(stretches.axes)]
                found[f"{stretches.scanner}/{name}"] = _along(own, output.dims)
        return found

    def evaluate(self, block: int) -> Results:
        """Point cloud, statistics and navigation of a block."""
        stretches, part = self._part(block)
        first, stop = stretches.shot_range(part)
        reader = self._reader(part.scanner)
        shots, eyepoints = reader.shots(first, stop)
        results = shots | reader.cycles(*stretches.cycle_range(part))
        called = self.called(block)
        results |= {"effects": called.flags, "effects_error": called.error}
        results |= self.look(part, shots, eyepoints, called, first=first)
        depth = len(part.axes)
        return {
            f"{part.scanner}/{name}": values.reshape((1,) * depth + values.shape)
            if _is_radiometric(name)
            else values
            for name, values in results.items()
            if _belongs(name, part)
        }

    def compile(self) -> None:
        """Compile the radiometry and the navigation, on the first cycle of each scanner."""
        for stretches in self._stretches:
            part = stretches.part(0)
            shots, eyepoints = self._reader(part.scanner).shots(0, stretches.shots_a_cycle)
            self.look(part, shots, eyepoints, self.call(part, eyepoints), first=0)

    def called(self, block: int) -> Called:
        """What is simulated of a block's shots, whatever the block: whole tiles are looked at."""
        stretches, part = self._part(block)
        first, stop = stretches.shot_range(part)
        total = stretches.total_cycles * stretches.shots_a_cycle
        begin = first // TILE_SHOTS * TILE_SHOTS
        end = min(-(-stop // TILE_SHOTS) * TILE_SHOTS, total)
        _, around = self._reader(part.scanner).shots(begin, end)
        called = self.call(part, around, first=begin)
        return called.some(np.arange(first - begin, stop - begin))

    def call(self, part: Part, eyepoints: Eyepoints, *, first: int = 0) -> Called:
        """What is simulated of shots, the first of this number."""
        number = len(eyepoints.time)
        planned = self.planned(part, eyepoints, (first + np.arange(number)) // TILE_SHOTS)
        nothing = Called(np.zeros(number, np.uint32), np.zeros(number))
        return nothing if planned is None else planned.called(number)

    def planned(self, part: Part, eyepoints: Eyepoints, tiles: np.ndarray) -> ShotsPlan | None:
        """Plans of shots whose tiles have these numbers, (n,), rising."""
        return plan_shots(
            eyepoints,
            self.parameters_at(part),
            self.spec.surfaces(),
            modes=self.spec.modes(),
            tiles=tiles,
            rotating=self.spec.rotating,
        )

    def look(
        self, part: Part, shots: Results, eyepoints: Eyepoints, called: Called, *, first: int
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
        first
            Number of the first.
        """
        from sweep.model.cycles import solve

        stretches = self.scanners[part.scanner]
        found = self._cloud(part, eyepoints, called, first)
        if not stretches.navigates:
            return found
        navigation = self.spec.navigation
        return found | solve(
            shots,
            found,
            shots_a_cycle=stretches.shots_a_cycle,
            test_level=navigation.test_level,
            ground_slope=navigation.ground_slope,
            relief=navigation.relief,
            jitter=self.spec.platform.jitter,
        )

    def _cloud(self, part: Part, eyepoints: Eyepoints, called: Called, first: int) -> Results:
        from sweep.model.clouds import cloud
        from sweep.model.philox import point_keys

        begin, end = self.scanners[part.scanner].draw_range(part)
        numbers = first + np.arange(called.flags.size)
        keys = point_keys(numbers[:, None].astype(float), domain=DOMAIN, seed=int(self.spec.seed))
        found: Results = {}
        for index, effects in called.groups():
            some = cloud(
                eyepoints.some(index),
                parameters=self.parameters_at(part),
                surfaces=self.spec.surfaces(),
                keys=keys[index],
                first_draw=begin,
                draws=end - begin,
                method=self.spec.draws.method,
                returns=int(self.spec.draws.returns),
                effects=effects,
            )
            for name, values in some.items():
                room = (called.flags.size, *values.shape[1:])
                found.setdefault(name, np.empty(room, values.dtype))[index] = values
        return found

    def parameters_at(self, part: Part) -> Mapping[str, Any]:
        """SI values of all parameters at a block's place along the axes."""
        parameters = dict(self.spec.parameters())
        for axis, index in zip(self.spec.axes, part.axes, strict=True):
            for member in axis.members:
                value = member.values[index]
                parameters[member.path] = value.item() if isinstance(value, np.generic) else value
        return parameters

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


def _along(blocks: np.ndarray, dims: tuple[str, ...]) -> np.ndarray:
    """Blocks (..., draws, cycles) along the dimensions of an array; those of the first draws where
    it has none.
    """
    rank = blocks.ndim - 2
    if "draw" not in dims:
        blocks = blocks[..., 0, :]
    elif dims.index("draw") > 0:
        blocks = np.swapaxes(blocks, -1, -2)
    cut = [dim in ("shot", "cycle", "draw") for dim in dims]
    shape = iter(blocks.shape[rank:])
    return blocks.reshape(*blocks.shape[:rank], *(next(shape) if is_cut else 1 for is_cut in cut))


def _is_radiometric(name: str) -> bool:
    return name not in SHOTS and name not in CYCLES


def _belongs(name: str, part: Part) -> bool:
    """Whether an array has a chunk that is this block's to write."""
    if name in POINTS or name in NAVIGATION:
        return True
    once = name in STATISTICS or name in SIMULATED
    return part.draws == 0 and (once or not any(part.axes))
