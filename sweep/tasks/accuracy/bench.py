"""A sample of points that rungs are tried on, by the machinery of a run, or the thesis's way.

Of a grid these are points spread over all axes, of a flight whole tiles of shots, as effects are
planned in them.

[T 3.3.1] convolves the spectra with the window's transform "with much higher sampling rate in the
frequency domain than the FFT bin spacing", by an FFT "typically of size 2^11 or 2^12". The grid has
16 cells a bin around the beam's centre, and each beamlet's line goes into the nearest cell. One FFT
follows, a product with the transform of the window's own, and the way back. The improvements
`real`, `folded` and `degree` are those of docs/accuracy.md. Changes of lines within a record (range
walk, line width) are skipped, and leakage beyond the grid.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cache, cached_property, lru_cache, partial
from itertools import product, zip_longest
from pathlib import Path
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from scipy import fft
from scipy.stats import qmc

from sweep.kernels import njit
from sweep.model import shot, truth
from sweep.model import window as windows
from sweep.model.accuracy import Accuracy
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import detect_rows
from sweep.model.effects.catalogue import EFFECTS, NAMES, flags_of, names_of
from sweep.model.eyepoints import Eyepoints, seen_ground
from sweep.model.lines import BLOCK, IM, PLACE, RE, add_images, fold_lines, place_lines
from sweep.model.preparation import Shots
from sweep.model.ray_error import ray_error
from sweep.model.waveform import SEGMENTS
from sweep.scenes.eyepoint_arrays import from_arrays
from sweep.spec import Axis, SceneSpec, Spec
from sweep.tasks.accuracy.rungs import WRITTEN, Declared, Rung
from sweep.tasks.eyepoint_study import world_of
from sweep.tasks.flight_study import FlightStudy, Part
from sweep.tasks.grid_study import GridStudy, Selected, evaluate_points
from sweep.tasks.study import TILE_SHOTS, Grid, Results

Look = Callable[[Shots], np.ndarray]
"""A way to the largest bins of each segment's spectrum, as :func:`sweep.model.shot.find`."""

Coordinates = dict[str, tuple[np.ndarray, dict[str, Any]]]
"""Values of points and their attributes, by name."""


def _flags(names: Collection[str]) -> np.uint32:
    """Return the flags of some effects."""
    return np.uint32(sum(1 << NAMES.index(name) for name in names))


OF_LINES = _flags(
    [effect.name for effect in EFFECTS if effect.stage not in ("record", "detection", "draws")]
)
"""Flags of the effects that the thesis's way can have."""

IN_TRUTH = ~_flags(
    ["acceleration", "chirp_nonlinearity", "circulator_leak", "line_width", "leakage"]
    + [effect.name for effect in EFFECTS if effect.is_random]
)
"""Flags of the effects that the time-domain records know of."""

PLACES, MOST_TIMES = 12, 8192
"""Places of a part of a grid's sample at which stretches of a block are timed, and their length at
the most."""

FLIGHT_PLACES = 2
"""Places along the axes at which each scanner of a flight is looked at."""

TAKEN = ("number", "kind", "tolerance")
"""Names of parameters that the store has for itself: on an axis they go by their whole path."""

AS_WRITTEN = Rung(name="as written", kind=WRITTEN)


class Seen(NamedTuple):
    """Results of a rung at n points; nan for those that it lacks."""

    pd: np.ndarray  # (n, 4): probability of detection: up, Doppler, down, shot
    log10_pfa: np.ndarray  # (n, k): log10 of probabilities of false alarm
    leakage: np.ndarray  # (n, 2): probability of leakage in the chirps, up and down
    magnitude: np.ndarray  # (n, k): |X| of the peak bins, in a unit of all rungs
    standard_error: np.ndarray  # (n,): of the worst of pd, where it is a mean over draws
    sigma: np.ndarray  # (n,): noise of a bin, per quadrature, in the magnitudes' unit
    beamlets: np.ndarray
    """(n,): of each point; of a flight all rays that are cast, whatever is made of them."""


def seen_in(outputs: Results, counted: int = 0) -> Seen:
    """Results in the outputs of points; ``counted``: in so many draws, 0 for means of them."""
    every = (*SEGMENTS, "shot")

    def of_each(form: str, names: Iterable[str] = SEGMENTS) -> np.ndarray:
        return np.stack([outputs[form.format(name)] for name in names], axis=1)

    if counted:
        counts = [outputs[f"n_detected_{name}"].sum(axis=1) for name in every]
        pd = np.stack(counts, axis=1) / counted
        error = np.sqrt(np.maximum(pd * (1 - pd), 0.0) / counted)
        return nothing(len(pd))._replace(pd=pd, standard_error=error.max(axis=1))
    pd, variance = of_each("pd_{}", every), outputs["noise_variance"]
    errors = [outputs[f"pd_{name}_error"] for name in every if f"pd_{name}_error" in outputs]
    return Seen(
        pd,
        of_each("log10_pfa_{}", ("segment", "shot")),
        of_each("p_leakage_{}", ("up", "down")),
        np.sqrt(of_each("snr_{}") * np.reshape(variance, (-1, 1))),
        np.fmax.reduce(errors) if errors else np.full(len(pd), np.nan),
        np.sqrt(variance / 2),
        outputs["beamlets"],
    )


def nothing(points: int) -> Seen:
    """Results of points of which nothing is known."""
    sizes = ((points, 4), (points, 2), (points, 2), (points, 3), points, points, points)
    return Seen(*(np.full(size, np.nan) for size in sizes))


class Trial(NamedTuple):
    """A rung tried on some points."""

    seen: Seen
    seconds: float
    """Processor time of a point, planning included: what others use of the machine is no part."""
    planning: float  # a point


def together(trials: Sequence[Trial]) -> Trial:
    """Trials of a rung on several parts of a sample as one."""
    share = np.array([trial.seen.sigma.size for trial in trials], float)
    share /= share.sum()
    return Trial(
        Seen(*map(np.concatenate, zip(*(trial.seen for trial in trials), strict=True))),
        float(share @ [trial.seconds for trial in trials]),
        float(share @ [trial.planning for trial in trials]),
    )


class Bench(ABC):
    """A sample of a study's points."""

    unit = "points"
    spec: Declared
    study: Callable[[Rung], Any]  # the study with a rung's settings
    numbers: np.ndarray  # (size,): of the sample's points, by which they are computed
    whole: int  # points of the study, each computed once: draws of a flight are none of their own
    most_times: int  # points of the longest stretch that may be timed

    @property
    def size(self) -> int:
        """Points of the sample."""
        return self.numbers.size

    @abstractmethod
    def parts(self, points: int) -> list[np.ndarray]:
        """Return the sample in parts of about so many points."""

    @abstractmethod
    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """Compute a rung on a part of the sample, timed on so many points or on the part."""

    @abstractmethod
    def coordinates(self) -> Coordinates:
        """Return what tells the points of the sample apart."""

    def effects(self, rung: Rung) -> frozenset[str]:
        """Effects that a rung simulates anywhere in the sample."""
        parts = (self.numbers[part] for part in self.parts(self.size))
        flags = [np.bitwise_or.reduce(self._planned(rung, numbers)[0]) for numbers in parts]
        return frozenset(names_of(int(np.bitwise_or.reduce(flags))))

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """Compute a point in the time domain, and with the rung's effects that the truth has."""
        number = self.numbers[[place]]
        flags = self._planned(rung, number)[0] & IN_TRUTH
        # Records walk by themselves, whatever effects are named.
        in_time, ordinary = (
            self._seen(rung, 1, self._computed(rung, number, flags, look))
            for look in (truth.find, shot.find)
        )
        return in_time, ordinary

    def forget(self) -> None:  # noqa: B027
        """Drop what trials of one part share; its time counts for each of them."""

    @abstractmethod
    def _planned(self, rung: Rung, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        """Return flags of points (n,), and the time that planning takes one, its share."""

    @abstractmethod
    def _computed(
        self, rung: Rung, numbers: np.ndarray, flags: np.ndarray, look: Look | None
    ) -> Iterator[tuple[np.ndarray, Results]]:
        """Places of some of the points, and their outputs; a ``look`` finds peaks in its way."""

    @cached_property
    def _of_lines(self) -> np.uint32:
        """Flags of the study's effects that the thesis's way can have."""
        return _flags(self.effects(AS_WRITTEN)) & OF_LINES

    def _run(self, rung: Rung, numbers: np.ndarray) -> Trial:
        """Plan and compute points."""
        flags, planning = self._planned(rung, numbers)
        look = partial(find_on_grid, **rung.thesis) if rung.thesis else None
        begun = thread_time()
        found = list(self._computed(rung, numbers, flags, look))
        spent = thread_time() - begun
        seen = self._seen(rung, numbers.size, found)
        return Trial(seen, spent / numbers.size + planning, planning)

    def _seen(self, rung: Rung, size: int, found: Iterable[tuple[np.ndarray, Results]]) -> Seen:
        """Results of points in their places."""
        counted = int(self.study(rung).spec.draws.number) if rung.counts else 0
        seen = nothing(size)
        for places, outputs in found:
            for values, some in zip(seen, seen_in(outputs, counted), strict=True):
                values[places] = some
        return seen


def spread(shape: tuple[int, ...], number: int) -> np.ndarray:
    """Numbers of points of a grid, in C order, spread evenly along every axis by Halton's sequence.

    Any first part of them is spread as well, so that a part of the sample stands for all.
    """
    total = math.prod(shape)
    if not shape or total <= 1:
        return np.zeros(min(total, number), np.int64)
    # The sequence's first point is the grid's corner.
    points = qmc.Halton(len(shape), scramble=False).random(128 * number + 1)[1:]
    index = np.floor(points * shape).astype(np.int64)
    found = dict.fromkeys(np.ravel_multi_index(tuple(index.T), shape).tolist())
    found |= dict.fromkeys(range(min(total, 2 * number)))  # some of small grids are never met
    return np.fromiter(found, np.int64)[:number]


def along_axes(axes: tuple[Axis, ...], index: tuple[np.ndarray, ...]) -> Coordinates:
    """Coordinates of points, by their places along each axis."""
    found: Coordinates = {}
    for axis, along in zip(axes, index, strict=True):
        for member in axis.members:
            name = member.path.replace(".", "_") if member.name in TAKEN else member.name
            about = {"units": member.units, "path": member.path}
            found[name] = np.asarray(member.display)[along], about
    return found


class GridBench(Bench):
    """A sample of the points of a grid, spread evenly, or of these numbers.

    Points are timed with those that the block computes next, which share intermediate results.
    """

    def __init__(self, spec: Spec, points: int, numbers: np.ndarray | None = None) -> None:
        self.spec = spec
        self.study = cache(lambda rung: GridStudy(rung.of(spec)))
        self._grid: Grid = self.study(AS_WRITTEN).grid
        self.numbers = spread(self._grid.shape, points) if numbers is None else numbers
        self.whole = self._grid.points
        self._block_points = math.prod(self._grid.block_shape)
        self.most_times = min(MOST_TIMES, self._block_points)

    def parts(self, points: int) -> list[np.ndarray]:
        """Parts of the sample, each spread as evenly as all of it."""
        return np.array_split(np.arange(self.size), max(1, round(self.size / points)))

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """Compute the part by itself; its time is that of more points of the same blocks."""
        numbers = self.numbers[part]
        trial = self._run(rung, numbers)
        if times == 1:
            return trial
        some = numbers[:: -(-part.size // PLACES)].tolist()
        stretches = np.concatenate([self._beside(rung, number, times) for number in some])
        # As many points together as a block has: what a call costs is shared by these alone.
        blocks = np.array_split(stretches, -(-stretches.size // self._block_points))
        return together([self._run(rung, block) for block in blocks])._replace(seen=trial.seen)

    def coordinates(self) -> Coordinates:
        """Return the number of each point in C order, and its place along each axis."""
        index = np.unravel_index(self.numbers, self._grid.shape) if self._grid.shape else ()
        number = self.numbers, {"long_name": "number of the point of the study"}
        return {"number": number} | along_axes(self.spec.axes, index)

    def _planned(self, rung: Rung, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        if rung.of_lines:
            return np.full(numbers.size, self._of_lines), 0.0
        selection = self.study(rung).selection
        met, where = np.unique(selection.tiles.locate(numbers)[0], return_inverse=True)
        flags = np.empty(met.size, np.uint32)
        begun = thread_time()
        for chosen, plan in selection.plans(met):
            flags[chosen] = flags_of(plan.kept)
        spent = thread_time() - begun if rung.plans else 0.0
        return flags[where], spent / sum(map(selection.tiles.block_size, met.tolist()))

    def _computed(
        self, rung: Rung, numbers: np.ndarray, flags: np.ndarray, look: Look | None
    ) -> Iterator[tuple[np.ndarray, Results]]:
        study = self.study(rung)
        for places, effects in Selected(flags, np.zeros(flags.size)).groups():
            parameters = study.grid.parameters_at(numbers[places])
            if look is None:
                yield places, evaluate_points(study.spec, parameters, places.size, effects)
            else:
                yield places, shot.evaluate(parameters, effects, look=look)

    def _beside(self, rung: Rung, number: int, times: int) -> np.ndarray:
        """Return a point and those that its block computes after it, round the block's end."""
        grid = self.study(rung).grid
        (block,), (own,) = (each.tolist() for each in grid.locate(np.array([number])))
        order = grid.geometry_order(block)
        follows = np.flatnonzero(order == own) + np.arange(times)
        return grid.numbers(block, order.take(follows, mode="wrap"))


class FlightBench(Bench):
    """A sample of the shots of a flight: whole tiles, as effects are planned in them.

    The time counts rays, plans, spectra and probabilities; draws, points and navigation cost
    the same whatever the accuracy. Shots are computed by their places in the sample.
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, points: int) -> None:
        self.spec = spec
        self.study = cache(self._study)
        self._cast: dict[tuple[str, bytes], tuple[Eyepoints, float]] = {}
        # What costs the same for any number of shots, as planning mostly does, a block shares.
        self.most_times = max(int(spec.storage.block_shots), TILE_SHOTS)
        self._parts, shots = zip(*self._sample(points), strict=True)
        self._shots = np.concatenate(shots)
        self._part = np.repeat(np.arange(len(shots)), [each.size for each in shots])
        self.numbers = np.arange(self._shots.size)
        self.whole = sum(each.points // each.draws for each in self.study(AS_WRITTEN).grids)

    def parts(self, points: int) -> list[np.ndarray]:
        """Whole tiles of one scanner at a place along the axes, from all of these in turn."""
        number, found = max(1, round(points / TILE_SHOTS)), []
        for own in (np.flatnonzero(self._part == k) for k in range(len(self._parts))):
            tile = self._shots[own] // TILE_SHOTS
            tiles = np.unique(tile)
            cut = np.array_split(tiles, -(-tiles.size // number))
            found.append([own[np.isin(tile, some)] for some in cut])
        return [part for turn in zip_longest(*found) for part in turn if part is not None]

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """Compute the part and neighbouring tiles of so many shots, timed with their rays."""
        numbers = self.around(part, times)
        trial = self._run(rung, numbers)
        own = np.searchsorted(numbers, part)
        _, casting = self._see(rung, *self.shots(numbers))
        seen = Seen(*(values[own] for values in trial.seen))
        return Trial(seen, trial.seconds + casting / numbers.size, trial.planning)

    def coordinates(self) -> Coordinates:
        """Scanner and number of each shot, and its place along the axes."""
        index = np.reshape([part.axes for part in self._parts], (len(self._parts), -1))
        scanners = np.array([part.scanner for part in self._parts], object)
        return {
            "scanner": (scanners[self._part], {"long_name": "scanner"}),
            "shot": (self._shots, {"long_name": "number of the shot"}),
        } | along_axes(self.spec.axes, tuple(index[self._part].T))

    def forget(self) -> None:
        """Drop the rays that rungs of the same geometry share."""
        self._cast.clear()

    def around(self, numbers: np.ndarray, times: int) -> np.ndarray:
        """Whole tiles of some of the sample, and so many shots with those that follow."""
        own = np.flatnonzero(self._part == self._part[numbers[0]])
        return own[whole_tiles(self._shots[own] // TILE_SHOTS, numbers - own[0], times)]

    def shots(self, numbers: np.ndarray) -> tuple[Part, np.ndarray]:
        """Scanner and place along the axes of some of the sample, and their numbers there."""
        return self._parts[self._part[numbers[0]]], self._shots[numbers]

    def _planned(self, rung: Rung, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        tiles = self.around(numbers, 1)
        part, shots = self.shots(tiles)
        eyepoints, _ = self._see(rung, part, shots)
        begun = thread_time()
        if rung.of_lines:
            flags = np.where(eyepoints.seen, self._of_lines, 0)
        else:
            flags = self.study(rung).select(part, eyepoints, shots).flags
        spent = thread_time() - begun if rung.plans else 0.0
        return flags[np.searchsorted(tiles, numbers)], spent / tiles.size

    def _computed(
        self, rung: Rung, numbers: np.ndarray, flags: np.ndarray, look: Look | None
    ) -> Iterator[tuple[np.ndarray, Results]]:
        study, (part, shots) = self.study(rung), self.shots(numbers)
        eyepoints, _ = self._see(rung, part, shots)
        selected, rows = Selected(flags, np.zeros(flags.size)), np.flatnonzero(eyepoints.seen)
        cloud = partial(_statistics, study, part, look or shot.find)
        yield from study.clouds(part.scanner, eyepoints, selected, shots, rows, cloud)

    def _sample(self, points: int) -> Iterator[tuple[Part, np.ndarray]]:
        """Scanners at places along the axes, and shots of each, spread over the flight."""
        study = self.study(AS_WRITTEN)
        for scanner, blocks in study.scanners.items():
            places = spread(blocks.axes, FLIGHT_PLACES)
            wanted = math.ceil(points / TILE_SHOTS / len(study.scanners) / len(places))
            shots = study.caster(scanner).spread(max(self.most_times // TILE_SHOTS, wanted))
            for place in places:
                axes = np.unravel_index(place, blocks.axes) if blocks.axes else ()
                yield blocks.first_part(tuple(map(int, axes))), shots

    def _study(self, rung: Rung) -> FlightStudy:
        spec: Any = rung.of(self.spec)
        # in a world that all share, as building one can take seconds
        study = FlightStudy(spec, Path("nowhere.zarr"), world_of(self.spec))
        if rung.rays_error:
            study.rays_accuracy = Accuracy(rung.rays_error, least_rays_tolerance=0.0)
        return study

    def _see(self, rung: Rung, part: Part, shots: np.ndarray) -> tuple[Eyepoints, float]:
        """Eyepoints of shots, cast once for rungs of a geometry, and the time that it took [s]."""
        caster = self.study(rung).caster(part.scanner)
        which_shots = caster.id, shots.tobytes()
        if which_shots not in self._cast:
            begun = thread_time()
            eyepoints = from_arrays(caster.cast(shots), caster.weight)
            self._cast[which_shots] = eyepoints, thread_time() - begun
        return self._cast[which_shots]


def whole_tiles(tile: np.ndarray, rows: np.ndarray, number: int) -> np.ndarray:
    """Rows of the whole tiles of so many shots: those of some and what follows, round the end.

    ``tile`` (n,) has the number of each row's tile, rising.
    """
    tiles, counts = np.unique(tile, return_counts=True)
    own = np.unique(tile[rows])
    order = np.roll(np.arange(tiles.size), -int(np.searchsorted(tiles, own[0])))
    enough = int(np.searchsorted(np.cumsum(counts[order]), number)) + 1
    return np.flatnonzero(np.isin(tile, [*own, *tiles[order[:enough]]]))


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


CELLS = 16
"""Cells of the grid in a bin of the FFT."""

SIZE = 1 << 12
"""Cells of the grid, where the footprint's lines leave enough room beside them."""

ROOM = 16
"""Bins beside the lines that must be free of what comes round the grid's ends."""

_ROWS = 32
"""Spectra that are transformed together: as many as the processor's cache holds."""


def find_on_grid(
    shots: Shots, *, degree: int = 0, size: int = SIZE, real: bool = False, folded: bool = False
) -> np.ndarray:
    """Largest bins of each segment's spectrum, (3, 6, n) as of :func:`sweep.model.shot.find`.

    A line is shared out by a polynomial of a ``degree`` of 0, to the nearest cell, or 9, among
    ten. A grid has ``size`` cells at the least, a power of two, and more where a point's lines
    spread farther. ``real`` transforms powers as real numbers; ``folded`` goes back to the bins
    alone. There is no leakage.
    """
    found = np.full((3, 6, shots.size), np.nan)
    table, sizes, how = shots.point_table(), grid_sizes(shots, size), (degree, real, folded)
    bins = shots.fft_size // 2, 1.0 / shots.fft_size
    segments = np.flatnonzero(shots.segments).tolist()
    for cells, segment in product(np.unique(sizes).tolist(), segments):
        members = np.flatnonzero(sizes == cells)
        for index in np.split(members, range(_ROWS, members.size, _ROWS)):
            low, magnitude = magnitudes(shots, table, index, segment, cells, how)
            out = np.empty((6, index.size))
            levels = shots.bin_levels[:, index]
            speckle = shots.speckle_table.at(segment, index)
            detect_rows(magnitude, low, bins, shots.echo_rule, levels, speckle, out)
            out[3] *= table[6, index]
            found[segment][:, index] = out
    return found


def grid_sizes(shots: Shots, least: int = SIZE) -> np.ndarray:
    """Cells of each point's grid, (n,) int64: the lines in its middle, and room on both sides."""
    per_ratio = 2 * np.abs(shots.chirp_rate) * shots.range / SPEED_OF_LIGHT
    carrier = np.max([np.max(c) for c in shots.carriers])
    offset = np.abs(shots.offset).max(axis=1)[shots.row]
    doppler = np.abs(shots.doppler).max(axis=1)[shots.row]
    spread = per_ratio * (offset + doppler) + carrier * doppler
    bins = spread * shots.fft_size / shots.sample_rate
    needed = np.ceil(np.log2(4 * CELLS * (bins + ROOM)))
    return np.maximum(least, 2 ** needed.astype(np.int64))


def magnitudes(
    shots: Shots,
    table: np.ndarray,
    index: np.ndarray,
    segment: int,
    cells: int,
    how: tuple[int, bool, bool],
) -> tuple[np.ndarray, np.ndarray]:
    """First bin (m,) and |X| (m, cells / CELLS) of some points' spectra around their lines.

    ``how``: `degree`, `real` and `folded` of :func:`find_on_grid`.
    """
    degree, real, folded = how
    power, length = shots.incoherent, shots.window.length
    real = real and power
    grid = np.zeros((index.size, cells), float if real else complex)
    origin, node = np.empty(index.size, np.int64), np.arange(degree + 1.0)
    _deposit(
        np.ascontiguousarray(table[:, index]), shots.row[index], shots.footprint, segment,
        np.array([shots.fft_size, length, 0, 0, power, 0]), shots.image,
        np.array([1 / np.prod(np.delete(own - node, j)) for j, own in enumerate(node)]), origin,
        grid.view(float).reshape(index.size, cells, -1),
    )  # fmt: skip
    kernel = _kernel(shots.window.name, length, shots.fft_size, cells, power, real)
    convolved = _convolved(grid, kernel, real, folded)
    # Rounding takes a sum of squares that is all but nothing below it.
    magnitude = np.sqrt(np.maximum(convolved.real, 0.0)) if power else np.abs(convolved)
    return origin - cells // (2 * CELLS), magnitude


def _convolved(grid: np.ndarray, kernel: np.ndarray, real: bool, folded: bool) -> np.ndarray:
    """Return the convolution of powers or amplitudes, (rows, cells), at every sixteenth cell."""
    bins = grid.shape[1] // CELLS
    forth, back = (fft.rfft, fft.irfft) if real else (fft.fft, fft.ifft)
    transform = forth(grid, axis=1, overwrite_x=True)
    transform *= kernel
    if not folded:
        return np.asarray(back(transform, grid.shape[1], axis=1, overwrite_x=True)[:, ::CELLS])
    if real:  # the upper half is the lower one's conjugate
        above = transform[:, :-1].reshape(-1, CELLS // 2, bins)[:, :, : bins // 2 + 1]
        below = transform[:, 1:].reshape(-1, CELLS // 2, bins)[:, :, : bins // 2 - 2 : -1]
        transform = above.sum(axis=1) + below.sum(axis=1).conj()
    else:
        transform = transform.reshape(-1, CELLS, bins).sum(axis=1)
    return np.asarray(back(transform, bins, axis=1, overwrite_x=True)) / CELLS


@lru_cache(maxsize=32)
def _kernel(
    name: str, length: int, fft_size: int, cells: int, power: bool, real: bool
) -> np.ndarray:
    """Transform of the window's own, of mid-record, on a grid of cells; no closed form is used."""
    place = np.concatenate([np.arange(cells // 2), np.arange(-cells // 2, 0)])
    transform = fft.fft(windows.samples(name, length), CELLS * fft_size)[place]
    transform *= np.exp(1j * np.pi * place * (length / fft_size / CELLS))
    if power:
        transform = np.abs(transform) ** 2
    return np.asarray(fft.rfft(transform) if real else fft.fft(transform))


@njit(cache=True, error_model="numpy")
def _deposit(p, row, footprint, segment, sizes, image, weights, origin, grid):
    """Lines of m points, each shared out among as many cells of its grid, (m, cells, 2 or 1).

    They are seen at 0 .. N/2, and their images about DC or Nyquist, whichever is nearer.
    """
    n, cells = footprint.shape[2], grid.shape[1]
    count = 2 * n if image else n
    room, share = np.empty((BLOCK + 1, count)), np.empty(weights.size)
    low, high = (-0.5, cells - 1.0) if weights.size == 1 else (5.0, cells - 6.0)
    for i in range(row.size):
        first = place_lines(p[:, i].copy(), segment, footprint, row[i], sizes, room)
        origin[i] = abs(first)
        if first < 0:
            for b in range(n):
                room[PLACE, b], room[IM, b] = -room[PLACE, b], -room[IM, b]
        if image:
            add_images(room, n, origin[i], 1.0, sizes[4] != 0)
            fold_lines(room[:, n:], n, sizes)
        for b in range(n):
            for k in range(b, count, n):
                at = cells // 2 + CELLS * room[PLACE, k]
                if low < at < high:
                    _share_out(grid[i], at, room[RE, k], room[IM, k], weights, share)


@njit(cache=True, error_model="numpy")
def _share_out(cells, at, re, im, weights, share):
    """Add a line to the nearest cell, or to ten cells by Lagrange's polynomial."""
    first = int(np.rint(at)) if weights.size == 1 else int(np.floor(at)) - 4
    t, total = at - first, 0.0
    for j in range(weights.size):
        if t == j or weights.size == 1:
            share[:] = 0.0
            share[j] = total = 1.0
            break
        share[j] = weights[j] / (t - j)
        total += share[j]
    for j in range(weights.size):
        cells[first + j, 0] += re * share[j] / total
        if cells.shape[1] > 1:
            cells[first + j, 1] += im * share[j] / total
