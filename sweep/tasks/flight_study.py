"""A point cloud as a study: radiometry, draws and navigation on eyepoints that are there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.effects.catalogue import DEFAULTS, flag_attributes, flags_of
from sweep.model.effects.points import Points
from sweep.model.ground import of_rays
from sweep.model.outputs import (
    BEAMLETS,
    CYCLES,
    NAVIGATION,
    POINTS,
    SHOTS,
    SIMULATED,
    STATISTICS,
)
from sweep.model.resolution import by_tolerance, effects_tolerance
from sweep.spec.rules import Mistake, SpecError
from sweep.spec.scene import projection_of
from sweep.storage.locations import Location, eyepoints_path
from sweep.storage.opening import MAP
from sweep.storage.sound import open_arrays
from sweep.tasks.eyepoint_study import (
    SIZES,
    EyepointStudy,
    refine,
    scene_map,
    world_of,
)
from sweep.tasks.grid_study import EFFECTS, ERROR, Selected, coordinates
from sweep.tasks.study import (
    BLOCKS_MAX,
    TILE_SHOTS,
    ArrayLayout,
    BlockGrid,
    GrowingStudy,
    Lattice,
    Results,
)

if TYPE_CHECKING:
    from sweep.model.effects.planning import Plan
    from sweep.model.error_floor import ErrorFloor
    from sweep.model.eyepoints import Eyepoints
    from sweep.model.geometry.mesh import Surface
    from sweep.model.own_motion import MotionPriors
    from sweep.spec import SceneSpec
    from sweep.spec.scene import World

    Cloud = Callable[[tuple[str, ...], Eyepoints, np.ndarray, np.ndarray], Results]
    """Results of shots with some effects, by their eyepoints, numbers and flags."""

#: Domain of the keys of draws; a shot's key is its number, so that the draws of a flight are the
#: same along every axis and for every instrument.
DOMAIN = "sweep.flight"

#: Shots that a cycle must have for a velocity vector.
LEAST_BEAMS = 3

#: Geometry of shots and cycles, the same at every place along a study's axes.
GEOMETRY = SHOTS | CYCLES


@cache
def enumerated() -> dict[str, dict[str, Any]]:
    """Attributes of the arrays that hold flags or one of some values, as the CF conventions say."""
    from sweep.model.navigation import EXCLUDED, SOLVED, UNDETERMINED, WITHHELD
    from sweep.model.pairing import FLAGS

    status = {
        "flag_values": [SOLVED, EXCLUDED, WITHHELD, UNDETERMINED],
        "flag_meanings": "solved one_beam_excluded withheld undetermined",
    }
    points = {"flag_masks": list(FLAGS.values()), "flag_meanings": " ".join(FLAGS)}
    return {
        EFFECTS: flag_attributes(), "flags": points,
        "velocity_status": status, "altitude_status": status,
    }  # fmt: skip


class Part(NamedTuple):
    """The part of a flight that a block holds, at one place along the axes."""

    scanner: str
    axes: tuple[int, ...]
    draws: range
    cycles: range


class ScannerBlocks(Lattice, BlockGrid):
    """The blocks of one scanner: along the axes, draws and cycles, the last fastest."""

    def __init__(self, spec: SceneSpec, scanner: str) -> None:
        Lattice.__init__(self, spec)
        self.scanner, self.axes = scanner, self.shape
        self.total_cycles, self.shots_a_cycle = spec.cycles(scanner), spec.shots_a_cycle(scanner)
        self.draws = int(spec.draws.number)
        _refuse_too_many(spec, self.total_cycles * self.shots_a_cycle)
        fitting = max(1, int(spec.storage.block_shots) // self.shots_a_cycle)
        BlockGrid.__init__(
            self,
            (*(axis.name for axis in spec.axes), "draw", "cycle"),
            (*self.axes, self.draws, self.total_cycles),
            (
                *(1 for _ in self.axes),
                min(self.draws, int(spec.storage.block_draws)),
                min(self.total_cycles, fitting),
            ),
            group=scanner,
            finer="shot",
            each=self.shots_a_cycle,
        )
        if self.n_blocks > BLOCKS_MAX:
            rule = (
                f"cuts {self.draws:,} draws of {self.total_cycles:,} cycles of {scanner} into "
                f"{self.n_blocks:.3g} blocks, and a study has at most {BLOCKS_MAX:.0e}"
            )
            size = f"{spec.storage.block_draws}"
            remedy = "raise it or storage.block_shots, or take fewer draws"
            raise SpecError([Mistake("storage.block_draws", rule, size, remedy)])

    def values_along(self) -> list[dict[str, np.ndarray]]:
        """Values along each dimension, by what they are of; there may be very many."""
        of_draws = {"draw": np.arange(self.draws)}
        return [*self.values, of_draws, {"cycle": np.arange(self.total_cycles)}]

    @property
    def navigates(self) -> bool:
        """True if a cycle has the shots that a velocity vector takes."""
        return self.shots_a_cycle >= LEAST_BEAMS

    def part(self, number: int) -> Part:
        """Return a block of this scanner by its number."""
        *axes, draws, cycles = (range(s.start, s.stop) for s in self.block(number))
        return Part(self.scanner, tuple(along.start for along in axes), draws, cycles)

    def first_part(self, axes: tuple[int, ...]) -> Part:
        """Return the first block at a place along the axes."""
        return self.part(self.number((*axes, 0, 0)))


#: Shots of a scanner times draws and places along axes, at the most.
DRAWN_SHOTS_MAX = 10**10


def _refuse_too_many(spec: SceneSpec, shots: int) -> None:
    """Refuse a flight of more shots than can be handled, before any array of them is made."""
    draws = int(spec.draws.number)
    all_shots = shots * draws * math.prod(int(axis.size) for axis in spec.axes)
    if all_shots > DRAWN_SHOTS_MAX:
        rule = (
            f"makes {all_shots:.3g} shots in all draws and places along axes, and a study has at "
            f"most {DRAWN_SHOTS_MAX:.0e}"
        )
        raise SpecError([Mistake("draws.number", rule, f"{draws}", "take fewer draws")])


class KnownCloud(NamedTuple):
    """Results of a flight's block that are there before it is computed."""

    there: np.ndarray  # (shots, draws): which
    results: Results  # (shots or cycles, draws, ...) by name; (shots, ...) what no draw changes


class FlightStudy(GrowingStudy):
    """The point clouds of a flight, a group of arrays for each scanner."""

    unit = "shots"

    def __init__(self, spec: SceneSpec, path: Location, world: World | None = None) -> None:
        super().__init__(spec)
        self.path = path
        self.caster = cache(partial(EyepointStudy, spec, world=world))
        self.scanners = {scanner: ScannerBlocks(spec, scanner) for scanner in spec.scanners}
        self._eyepoints = cache(self._open_eyepoints)

    @property
    def grids(self) -> list[ScannerBlocks]:
        """Blocks of each scanner."""
        return list(self.scanners.values())

    def follows_tolerance(self, block: int) -> np.ndarray | bool:
        """Tell whether a tighter tolerance computes shots more closely, effects apart."""
        return bool(self.spec.rays_by_tolerance or by_tolerance(self.spec.parameters()))

    def part(self, block: int) -> tuple[ScannerBlocks, Part]:
        """Return the blocks of a block's scanner, and its number; IndexError if there is none."""
        grid, number = self.find(block)
        blocks = self.scanners[grid.group]
        return blocks, blocks.part(number)

    def home(self, block: int) -> int:
        """Block of the first draws of the same shots, with all that no draw changes."""
        grid, number = self.find(block)
        *axes, _, cycles = grid.position(number)
        return block - number + grid.number((*axes, 0, cycles))

    def attributes(self) -> dict[str, Any]:
        """Title, question, spec, meaning of the numbers of scanners and surfaces, and origins.

        ``projection`` is the WKT of the coordinates in the scene's files, or empty. ``origin`` [m]
        and ``time_origin`` [s], a decimal with all its digits, are where these files have the zero
        of positions and times in the store.
        """
        return {
            "kind": "scene",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "surfaces": [surface.name for surface in self.surfaces],
            "scanners": list(self.spec.scanners),
            "origin": np.asarray(world_of(self.spec).origin, float).tolist(),
            "projection": projection_of(self.spec.scene, self.spec.files),
            "time_origin": f"{self.spec.files.time_origin.normalize():f}",
        }

    def groups(self) -> dict[str, dict[str, Any]]:
        """Return a group for each scanner, and one of the map, whose cells are none of theirs."""
        names = " ".join(member.name for axis in self.spec.axes for member in axis.members)
        return {
            name: {
                "shots_a_cycle": blocks.shots_a_cycle,
                "geometry_id": self.spec.geometry_id(name),
                "coordinates": names,
            }
            for name, blocks in self.scanners.items()
        } | {MAP: {}}

    def known_arrays(self) -> list[ArrayLayout]:
        """Return the map of the scene, and every scanner's coordinates."""
        return scene_map(self.spec) + [
            replace(layout, name=f"{scanner}/{layout.name}")
            for scanner in self.scanners
            for layout in coordinates(self.spec.axes)
        ]

    def outputs(self) -> list[ArrayLayout]:
        """Geometry, statistics, points and navigation of each scanner."""
        axes = tuple(axis.name for axis in self.spec.axes)
        sizes = SIZES | {"return_number": int(self.spec.draws.returns)}
        found = []
        for blocks in self.grids:
            named = GEOMETRY | STATISTICS | SIMULATED | POINTS
            named = named | NAVIGATION if blocks.navigates else named
            for name, output in named.items():
                dims = output.dims if name in GEOMETRY else axes + output.dims
                found.append(blocks.array(name, output, dims, sizes, enumerated().get(name)))
        return found

    def evaluate(self, block: int) -> Results:
        """Point cloud, statistics and navigation of a block; effects are chosen by whole tiles."""
        blocks, part = self.part(block)
        first, stop = (i * blocks.shots_a_cycle for i in (part.cycles.start, part.cycles.stop))
        begin, end = first // TILE_SHOTS * TILE_SHOTS, -(-stop // TILE_SHOTS) * TILE_SHOTS
        end = min(end, blocks.total_cycles * blocks.shots_a_cycle)
        shots, eyepoints = self._seen(part.scanner, range(begin, end))
        own, numbers = slice(first - begin, stop - begin), np.arange(first, stop)
        selected = self.select(part, eyepoints, np.arange(begin, end)).some(own)
        shots = {name: values[own] for name, values in shots.items()}
        eyepoints = eyepoints.some(own)
        results = shots | self._read(part.scanner, CYCLES, part.cycles)
        results |= {EFFECTS: selected.flags, ERROR: selected.error}
        known = self._known(block, selected) if self.earlier else None
        results |= self.look(part, shots, eyepoints, selected, numbers, known)
        found = {}
        for name in self.chunks(block):
            values, rank = results[name.rpartition("/")[2]], len(self.layouts[name].shape)
            found[name] = values.reshape((1,) * (rank - values.ndim) + values.shape)
        return found

    def compile(self) -> None:
        """Compile the radiometry and the navigation, on the first cycle of each scanner."""
        for blocks in self.grids:
            part = blocks.part(0)._replace(draws=range(1))
            cycle = range(blocks.shots_a_cycle)
            shots, eyepoints = self._seen(part.scanner, cycle)
            numbers = np.array(cycle)
            selected = self.select(part, eyepoints, numbers)
            self.look(part, shots, eyepoints, selected, numbers)

    def select(self, part: Part, eyepoints: Eyepoints, numbers: np.ndarray) -> Selected:
        """Effects simulated at shots of these numbers, rising."""
        number = len(numbers)
        planned = self.planned(part, eyepoints, numbers // TILE_SHOTS)
        nothing = Selected(np.zeros(number, np.uint32), np.zeros(number))
        return nothing if planned is None else planned.selected(number)

    def planned(self, part: Part, eyepoints: Eyepoints, tiles: np.ndarray) -> ShotsPlan | None:
        """Plans of shots whose tiles have these numbers, (n,), rising."""
        return plan_shots(
            eyepoints,
            tiles,
            self.parameters_at(part),
            self.surfaces,
            modes=self.spec.modes(),
            rotating=self.spec.rotating,
            rays_by_tolerance=self.spec.rays_by_tolerance,
        )

    def look(
        self,
        part: Part,
        shots: Results,
        eyepoints: Eyepoints,
        selected: Selected,
        numbers: np.ndarray,
        known: KnownCloud | None = None,
    ) -> Results:
        """Radiometry, draws and navigation of shots in whole cycles, but for what is ``known``."""
        blocks = self.scanners[part.scanner]
        draws, each = len(part.draws), blocks.shots_a_cycle
        there, results = known or self._nothing_known(blocks, selected.flags.size, draws)
        for rows, some in _gaps(~there):
            cloud = partial(self._cloud, part, some)
            for index, found in self.clouds(
                part.scanner, eyepoints, selected, numbers, rows, cloud
            ):
                _put(results, index, some, found)
        if blocks.navigates:
            lacking = (~there).reshape(-1, each, draws).any(axis=1)
            for cycles, some in _gaps(np.asarray(lacking)):
                rows = (cycles[:, None] * each + np.arange(each)).ravel()
                found = self._solved(each, shots, results, rows, some)
                _put(results, cycles, some, found)
        return results

    def _nothing_known(self, blocks: ScannerBlocks, shots: int, draws: int) -> KnownCloud:
        """Room for the results of some shots."""
        named = STATISTICS | POINTS | (NAVIGATION if blocks.navigates else {})
        sizes = SIZES | {
            "shot": shots, "cycle": shots // blocks.shots_a_cycle, "draw": draws,
            "return_number": int(self.spec.draws.returns),
        }  # fmt: skip
        results = {name: output.empty(sizes) for name, output in named.items()}
        return KnownCloud(np.zeros((shots, draws), bool), results)

    def clouds(
        self,
        scanner: str,
        eyepoints: Eyepoints,
        selected: Selected,
        numbers: np.ndarray,
        rows: np.ndarray,
        cloud: Cloud,
    ) -> Iterator[tuple[np.ndarray, Results]]:
        """Results of some shots, those together that need much the same; with more rays if so."""
        for index, effects, flags in selected.some(rows).together():
            some, look = rows[index], partial(cloud, effects)
            results = look(eyepoints.some(some), numbers[some], flags)
            if self.rays_accuracy is not None:
                rays = eyepoints.weight.size
                self._refine(scanner, rays, numbers[some], flags, results, look)
            yield some, results

    def _cloud(
        self,
        part: Part,
        draws: slice,
        effects: tuple[str, ...],
        eyepoints: Eyepoints,
        numbers: np.ndarray,
        flags: np.ndarray,
    ) -> Results:
        """Points of eyepoints, of shots with these numbers and flags."""
        from sweep.model.clouds import cloud
        from sweep.model.error_floor import stray
        from sweep.model.philox import point_keys
        from sweep.tasks.user_code import methods

        spectra = self.spec.draws.whole_spectra
        looks = {"methods": methods(self.parameters_at(part))} if spectra else {}
        seed, first = int(self.spec.seed), part.draws.start + draws.start
        keys = point_keys(numbers[:, None].astype(float), domain=DOMAIN, seed=seed)
        found = cloud(
            eyepoints,
            parameters=self.parameters_at(part),
            surfaces=self.surfaces,
            keys=keys,
            first_draw=first,
            draws=draws.stop - draws.start,
            method=self.spec.draws.method,
            **looks,
            returns=int(self.spec.draws.returns),
            effects=effects,
            flags=flags,
            estimates_rays=self.rays_accuracy is not None,
            priors=self.motion_priors,
        )
        if not any(self.error_floor):
            return found
        return stray(found, eyepoints, self.error_floor, keys=keys, seed=seed, first_draw=first)

    def _refine(
        self,
        scanner: str,
        rays: int,
        numbers: np.ndarray,
        flags: np.ndarray,
        results: Results,
        cloud: Callable[[Eyepoints, np.ndarray, np.ndarray], Results],
    ) -> None:
        """Put points of shots that need more rays in the place of their results."""
        assert self.rays_accuracy is not None

        def again(places: np.ndarray, more: int) -> np.ndarray:
            some = numbers[places]
            finer = cloud(self.caster(scanner, more).observe(some), some, flags[places])
            for name, values in finer.items():
                results[name][places] = values
            return finer["beamlets_error"]

        refine(rays, results["beamlets_error"], self.rays_accuracy, again)

    def _solved(
        self, each: int, shots: Results, found: Results, rows: np.ndarray, draws: slice
    ) -> Results:
        """Navigation of cycles, of so many shots each, from the points of these in some draws."""
        from sweep.model.navigation import solve

        some = slice(None) if rows.size == len(found["flags"]) else rows
        return solve(
            {name: values[some] for name, values in shots.items() if name in SHOTS},
            {name: found[name][some, draws] for name in POINTS},
            shots_a_cycle=each,
            test_level=self.spec.navigation.test_level,
            ground_slope=self.spec.navigation.ground_slope,
            relief=self.spec.navigation.relief,
            jitter=self.spec.platform.jitter,
            floor=self.error_floor,
            priors=self.motion_priors,
        )

    def _known(self, block: int, selected: Selected) -> KnownCloud:
        """Results of a block that a smaller study has, of shots with the same effects."""
        assert self.earlier is not None
        reuse, (blocks, part) = self.earlier, self.part(block)
        each = blocks.shots_a_cycle
        there, results = known = self._nothing_known(blocks, selected.flags.size, len(part.draws))
        for share in reuse.shares(block):
            home, own = (reuse.read(b) for b in (reuse.older.home(share.block), share.block))
            if home is None or own is None:
                continue
            named = {name.rpartition("/")[2]: values for name, values in (home | own).items()}
            older = {
                name: values.reshape(values.shape[len(reuse.older.spec.axes) :])
                for name, values in named.items()
                if name not in GEOMETRY
            }
            (draw, cycle), (old_draw, old_cycle) = (
                np.divmod(share.points, len(part.cycles)),
                np.divmod(share.place, len(older["flags"]) // each),
            )
            rows, old = (c[:, None] * each + np.arange(each) for c in (cycle, old_cycle))
            drawn, old_drawn = draw[:, None], old_draw[:, None]
            there[rows, drawn] = older[EFFECTS][old] == selected.flags[rows]
            found = {name: older[name][old] for name in STATISTICS}
            found |= {name: older[name][old, old_drawn] for name in POINTS}
            _put(results, rows, drawn, found)
            if blocks.navigates:
                found = {name: older[name][old_cycle, old_draw] for name in NAVIGATION}
                _put(results, cycle, draw, found)
        reuse.taken[block] = int(there.sum())
        return known

    def parameters_at(self, part: Part) -> Mapping[str, Any]:
        """SI values of all parameters at a block's place along the axes."""
        blocks = self.scanners[part.scanner]
        return blocks.fixed | {
            path: along[index].item()
            for values, index in zip(blocks.values, part.axes, strict=True)
            for path, along in values.items()
        }

    @cached_property
    def error_floor(self) -> ErrorFloor:
        """Errors of the instrument that no echo lowers."""
        from sweep.model.error_floor import ErrorFloor

        floor = self.spec.error_floor
        return ErrorFloor(
            floor.pointing_error, floor.clock_error, floor.wavelength_error, floor.vibration,
            floor.range_noise,
        )  # fmt: skip

    @cached_property
    def motion_priors(self) -> MotionPriors:
        """Deviations of motion that the instrument does not measure, as the spec states them."""
        from sweep.model.own_motion import MotionPriors

        stated = self.spec.navigation
        return MotionPriors(stated.terrain_slope, stated.target_speed, stated.target_acceleration)

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """Surfaces by their numbers."""
        return tuple(self.spec.surfaces())

    @cached_property
    def rays_accuracy(self) -> Accuracy | None:
        """Says how many rays a shot needs; None where their number is given."""
        return Accuracy.of(self.spec.parameters()) if self.spec.rays_by_tolerance else None

    def _open_eyepoints(self, scanner: str) -> Mapping[str, Any]:
        """Arrays of a scanner's eyepoints by name, opened once; their weights read."""
        group = open_arrays(eyepoints_path(self.path, self.spec.geometry_id(scanner)))
        arrays: dict[str, Any] = {name: group[name] for name in SHOTS | BEAMLETS | CYCLES}
        return arrays | {"weight": np.asarray(group["weight"][...])}  # type: ignore[index]

    def _read(self, scanner: str, names: Mapping[str, Any], some: range) -> Results:
        """Arrays of a scanner's eyepoints, of some shots or cycles."""
        arrays = self._eyepoints(scanner)
        return {name: np.asarray(arrays[name][some.start : some.stop]) for name in names}

    def _seen(self, scanner: str, some: range) -> tuple[Results, Eyepoints]:
        """Arrays of some shots, and their eyepoints."""
        from sweep.scenes.eyepoint_arrays import from_arrays

        shots = self._read(scanner, SHOTS, some)
        beamlets = self._read(scanner, BEAMLETS, some)
        return shots, from_arrays(shots | beamlets, self._eyepoints(scanner)["weight"])

    def eyepoint_studies(self) -> list[EyepointStudy]:
        """Return the studies that this one looks with."""
        return [self.caster(scanner) for scanner in self.scanners]


def _gaps(lacking: np.ndarray) -> Iterator[tuple[np.ndarray, slice]]:
    """Rows and stretches of draws that are lacking; rows that lack the same come together."""
    patterns, which = np.unique(lacking, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == number)
        edges = np.flatnonzero(np.diff(pattern, prepend=False, append=False))
        for first, stop in edges.reshape(-1, 2).tolist():
            yield rows, slice(first, stop)


def _put(results: Results, rows: np.ndarray, draws: slice | np.ndarray, found: Results) -> None:
    """Put results of some rows and draws into those of all."""
    for name, values in found.items():
        results[name][rows if name in STATISTICS else (rows, draws)] = values


class ShotsPlan(NamedTuple):
    """Plans of shots of a flight."""

    shots: np.ndarray  # places of the shots that see something
    tile: np.ndarray  # index of the tile of each of these
    plan: Plan  # Of the tiles

    def selected(self, number: int) -> Selected:
        """Effects simulated at that many shots; none where nothing is seen."""
        selected = Selected(np.zeros(number, np.uint32), np.zeros(number))
        selected.flags[self.shots] = flags_of(self.plan.kept)[self.tile]
        selected.error[self.shots] = self.plan.error[self.tile]
        return selected


def plan_shots(
    eyepoints: Eyepoints,
    tiles: np.ndarray,
    parameters: Mapping[str, Any],
    surfaces: Sequence[Surface],
    *,
    modes: Mapping[str, str],
    rotating: bool,
    rays_by_tolerance: bool = False,
) -> ShotsPlan | None:
    """Plans of a flight's shots at one place along its axes; None where none sees anything.

    ``tiles``: the number of the tile of each shot, rising.
    """
    from sweep.model.effects.planning import plan
    from sweep.model.eyepoints import seen_ground

    seen = eyepoints.seen.nonzero()[0]
    if not seen.size:
        return None
    some = eyepoints if seen.size == len(tiles) else eyepoints.some(seen)
    edges, tile = _stretches(tiles[seen])
    shots, ground = seen_ground(some, DEFAULTS | dict(parameters), surfaces)
    points = Points(shots, of_rays(ground), rotating=rotating)

    def of_tiles(values: np.ndarray) -> np.ndarray:
        return np.maximum.reduceat(np.broadcast_to(values, some.time.shape), edges[:-1])

    rays = 0 if rays_by_tolerance else some.offset.shape[1]
    planned = plan(points, of_tiles, modes, effects_tolerance(parameters, rays))
    return ShotsPlan(seen, tile, planned)


def _stretches(tiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of stretches of the same tile among some, one at least; index of each one's stretch."""
    new = np.diff(tiles) != 0
    edges = np.concatenate([[0], np.flatnonzero(new) + 1, [tiles.size]])
    return edges, np.concatenate([[0], np.cumsum(new)])
