"""A sample of points that rungs are tried on, by the machinery of a run, or the thesis's way.

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from scipy import fft
from scipy.stats import qmc

from sweep.model import shot, truth
from sweep.model import window as windows
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import detect_rows
from sweep.model.effects.catalogue import EFFECTS, flags_of, names_of
from sweep.model.lines import BLOCK, IM, PLACE, RE, place_lines
from sweep.model.preparation import Shots
from sweep.spec import Axis, Spec
from sweep.tasks.accuracy.rungs import WRITTEN, Declared, Rung
from sweep.tasks.grid_study import EffectSelection, Selected, evaluate_points
from sweep.tasks.study import Grid

Look = Callable[[Shots], np.ndarray]

SEGMENTS = ("up", "doppler", "down")

NOT_IN_TRUTH = frozenset({
    "acceleration", "chirp_nonlinearity", "circulator_leak", "line_width", "leakage"
})  # fmt: skip
"""Effects that the time-domain records know nothing of."""

AFTER_THE_LINES = frozenset({"record", "detection", "draws"})
"""Stages of effects that the thesis's way leaves out."""

PLACES, MOST_TIMES = 12, 8192
"""Places of a part of a grid's sample at which stretches of a block are timed, and their length at
the most."""

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


@dataclass(frozen=True)
class Trial:
    """A rung tried on a part of the sample."""

    seen: Seen
    seconds: float
    """Processor time of a point, planning included: what others use of the machine is no part."""
    planning: float  # a point


class Bench(ABC):
    """A sample of a study's points."""

    unit = "points"
    spec: Declared
    size: int  # points of the sample
    whole: int  # points of the study, each computed once: draws of a flight are none of their own
    least_parts: int  # parts of a sample, at the least: whole ones are kept where it is broken off
    most_times: int  # points of the longest stretch that may be timed

    def __init__(self) -> None:
        self._names: dict[str, frozenset[str]] = {}

    def effects(self, rung: Rung) -> frozenset[str]:
        """Effects that a rung simulates anywhere in the sample."""
        if rung.name not in self._names:
            flags = np.unique(self._flags(rung)).tolist()
            self._names[rung.name] = frozenset(name for flag in flags for name in names_of(flag))
        return self._names[rung.name]

    def of_lines(self) -> tuple[str, ...]:
        """Effects of the study that the thesis's way can have."""
        own = self.effects(AS_WRITTEN)
        return tuple(e.name for e in EFFECTS if e.name in own and e.stage not in AFTER_THE_LINES)

    @abstractmethod
    def _flags(self, rung: Rung) -> np.ndarray:
        """Effects that a rung calls for at each point of the sample."""

    def forget(self) -> None:  # noqa: B027
        """Drop what trials of one part share; its time counts for each of them."""


def spread(shape: tuple[int, ...], number: int) -> np.ndarray:
    """Numbers of points of a grid, in C order, spread evenly along every axis by Halton's sequence.

    Any first part of them is spread as well, so that a part of the sample stands for all.
    """
    total = math.prod(shape)
    if not shape or total <= 1:
        return np.zeros(min(total, number), np.int64)
    sequence = qmc.Halton(len(shape), scramble=False)
    sequence.fast_forward(1)  # the first point is the grid's corner
    found: dict[int, None] = {}
    for _ in range(64):
        index = np.floor(sequence.random(2 * number) * shape).astype(np.int64)
        found |= dict.fromkeys(np.ravel_multi_index(tuple(index.T), shape).tolist())
        if len(found) >= min(number, total):
            break
    else:  # some points of small grids are never met
        found |= dict.fromkeys(range(min(total, 2 * number)))
    return np.fromiter(found, np.int64)[:number]


def look_of(rung: Rung) -> Look:
    """Finder of a rung's peaks in the spectra."""
    return partial(find_on_grid, **rung.thesis) if rung.thesis else shot.find


def along_axes(
    axes: tuple[Axis, ...], index: tuple[np.ndarray, ...]
) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """Coordinates of points, by their places along each axis."""
    return {
        member.name: (
            np.asarray(member.display)[along],
            {"units": member.units, "path": member.path},
        )
        for axis, along in zip(axes, index, strict=True)
        for member in axis.members
    }


def seen_in(outputs: Mapping[str, np.ndarray], counted: int = 0) -> Seen:
    """Results in the outputs of points; ``counted``: in so many draws, 0 for means of them."""
    names = [f"pd_{name}" for name in (*SEGMENTS, "shot")]
    if counted:
        counts = [outputs[f"n_detected_{name}"].sum(axis=1) for name in (*SEGMENTS, "shot")]
        pd = np.stack(counts, axis=1) / counted
        error = np.sqrt(np.maximum(pd * (1 - pd), 0.0) / counted)
        return nothing(len(pd))._replace(pd=pd, standard_error=error.max(axis=1))
    pd = np.stack([outputs[name] for name in names], axis=1)
    alarms = [outputs[f"log10_pfa_{name}"] for name in ("segment", "shot")]
    magnitude = [np.sqrt(outputs[f"snr_{n}"] * outputs["noise_variance"]) for n in SEGMENTS]
    errors = [outputs[f"{name}_error"] for name in names if f"{name}_error" in outputs]
    return Seen(
        pd,
        np.stack(alarms, axis=1),
        np.stack([outputs[f"p_leakage_{name}"] for name in ("up", "down")], axis=1),
        np.stack(magnitude, axis=1),
        np.fmax.reduce(errors) if errors else np.full(len(pd), np.nan),
        np.sqrt(outputs["noise_variance"] / 2),
        outputs["beamlets"],
    )


def nothing(points: int) -> Seen:
    """Results of points of which nothing is known."""
    sizes = ((points, 4), (points, 2), (points, 2), (points, 3), points, points, points)
    return Seen(*(np.full(size, np.nan) for size in sizes))


class GridBench(Bench):
    """A sample of the points of a grid, spread evenly, or of these numbers."""

    least_parts = 2

    def __init__(self, spec: Spec, points: int, numbers: np.ndarray | None = None) -> None:
        super().__init__()
        self.spec = spec
        self._grid = Grid(spec)
        self._numbers = spread(self._grid.shape, points) if numbers is None else numbers
        self._calling: dict[str, EffectSelection] = {}
        self._block_points = math.prod(self._grid.block_shape)
        self.size, self.whole = len(self._numbers), self._grid.points
        self.most_times = min(MOST_TIMES, self._block_points)

    def parts(self, points: int) -> list[np.ndarray]:
        """Return the sample in parts of about so many points."""
        return np.array_split(np.arange(self.size), max(1, round(self.size / points)))

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """Compute a rung on a part of the sample, timed on so many points or on the part.

        Points are timed with those that the block computes next, which share intermediate
        results.
        """
        numbers = self._numbers[part]
        outputs, spent, planning = self._run(rung, numbers)
        timed = len(part)
        if times > 1:
            some = numbers[:: -(-len(part) // PLACES)].tolist()
            stretches = np.concatenate([self._beside(rung, number, times) for number in some])
            # As many points together as a block has: what a call costs is shared by these alone.
            together = np.array_split(stretches, -(-stretches.size // self._block_points))
            runs = [self._run(rung, each)[1:] for each in together]
            spent, planning = (sum(each) for each in zip(*runs, strict=True))
            timed, planning = stretches.size, planning / len(runs)
        planning = planning if rung.plans else 0.0
        draws = int(self._selection_of(rung).tiles.grid.spec.draws.number)
        seen = seen_in(outputs, draws if rung.counts else 0)
        return Trial(seen, spent / timed + planning, planning)

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """Compute a point in the time domain, and with the rung's effects that the truth has."""
        lacking = NOT_IN_TRUTH | {effect.name for effect in EFFECTS if effect.is_random}
        number = self._numbers[[place]]
        flags, _ = self._planned(rung, number)
        effects = [n for n in names_of(int(flags[0])) if n not in lacking]
        parameters = self._selection_of(rung).tiles.grid.parameters_at(number)
        # Records walk by themselves, whatever effects are named.
        in_time = shot.evaluate(parameters, effects, look=truth.find)
        return seen_in(in_time), seen_in(shot.evaluate(parameters, effects))

    def coordinates(self) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
        """Return the number of each point in C order, and its place along each axis."""
        found = {"number": (self._numbers, {"long_name": "number of the point of the study"})}
        index = np.unravel_index(self._numbers, self._grid.shape) if self._grid.shape else ()
        return found | along_axes(self.spec.axes, index)

    def _flags(self, rung: Rung) -> np.ndarray:
        return self._planned(rung, self._numbers)[0]

    def _selection_of(self, rung: Rung) -> EffectSelection:
        if rung.name not in self._calling:
            spec = rung.of(self.spec)
            self._calling[rung.name] = EffectSelection(spec, Grid(spec))  # type: ignore[arg-type]
        return self._calling[rung.name]

    def _run(self, rung: Rung, numbers: np.ndarray) -> tuple[dict[str, np.ndarray], float, float]:
        """Compute points: outputs, the time of all, and that of planning one of them."""
        grid = self._selection_of(rung).tiles.grid
        flags, planning = self._planned(rung, numbers)
        selected = Selected(flags, np.zeros(flags.size)).groups()
        outputs: dict[str, np.ndarray] = {}
        spent = 0.0
        for members, effects in (
            [(np.arange(len(flags)), self.of_lines())] if rung.of_lines else selected
        ):
            parameters = grid.parameters_at(numbers[members])
            begun = thread_time()
            if rung.thesis:
                found = shot.evaluate(parameters, effects, look=look_of(rung))
            else:
                found = evaluate_points(grid.spec, parameters, len(members), effects)
            spent += thread_time() - begun
            for name, values in found.items():
                room = (len(numbers), *values.shape[1:])
                outputs.setdefault(name, np.empty(room, values.dtype))[members] = values
        return outputs, spent, planning

    def _beside(self, rung: Rung, number: int, times: int) -> np.ndarray:
        """Return a point and those that its block computes after it, round the block's end."""
        grid = self._selection_of(rung).tiles.grid
        (block,), (own,) = (each.tolist() for each in grid.locate(np.array([number])))
        order = grid.geometry_order(block)
        follows = np.flatnonzero(order == own) + np.arange(times)
        return grid.numbers(block, order.take(follows, mode="wrap"))

    def _planned(self, rung: Rung, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        """Return flags of points (n,), and the time that planning takes one, its share."""
        tiles = self._selection_of(rung).tiles
        own, _ = tiles.locate(numbers)
        met, where = np.unique(own, return_inverse=True)
        flags = np.empty(len(met), np.uint32)
        begun = thread_time()
        for chosen, plan in self._selection_of(rung).plans(met):
            flags[chosen] = flags_of(plan.kept)
        spent = thread_time() - begun
        served = sum(tiles.block_size(int(tile)) for tile in met)
        return flags[where], spent / served


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
    table, sizes = shots.point_table(), grid_sizes(shots, size)
    for cells in np.unique(sizes):
        for segment in np.flatnonzero(shots.segments):
            members = np.flatnonzero(sizes == cells)
            for index in np.split(members, range(_ROWS, members.size, _ROWS)):
                low, magnitude = magnitudes(
                    shots, table, index, int(segment), int(cells), (degree, real, folded)
                )
                out = np.empty((6, index.size))
                bins = shots.fft_size // 2, 1.0 / shots.fft_size
                levels = table[13, index], table[11, index]
                detect_rows(magnitude, low, bins, shots.echo_rule, *levels, out)
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
    origin = np.empty(index.size, np.int64)
    _deposit(
        np.ascontiguousarray(table[:, index]), shots.row[index], shots.footprint, segment,
        np.array([shots.fft_size, length, 0, 0, power, 0]), shots.image, _weights(degree), origin,
        grid.view(float).reshape(index.size, cells, -1),
    )  # fmt: skip
    kernel = _kernel(shots.window.name, length, shots.fft_size, cells, power, real)
    convolved = (_real_bins if real else _complex_bins)(grid, kernel, folded)
    # Rounding takes a sum of squares that is all but nothing below it.
    magnitude = np.sqrt(np.maximum(convolved.real, 0.0)) if power else np.abs(convolved)
    return origin - cells // (2 * CELLS), magnitude


def _complex_bins(grid: np.ndarray, kernel: np.ndarray, folded: bool) -> np.ndarray:
    """Return the convolution of amplitudes at every sixteenth cell."""
    transform = fft.fft(grid, axis=1, overwrite_x=True)
    transform *= kernel
    if not folded:
        return np.asarray(fft.ifft(transform, axis=1, overwrite_x=True)[:, ::CELLS])
    transform = transform.reshape(len(grid), CELLS, -1).sum(axis=1)
    return np.asarray(fft.ifft(transform, axis=1, overwrite_x=True)) / CELLS


def _real_bins(grid: np.ndarray, kernel: np.ndarray, folded: bool) -> np.ndarray:
    """Convolve powers, by half of their transforms."""
    half = fft.rfft(grid, axis=1)
    half *= kernel
    if not folded:
        return np.asarray(fft.irfft(half, grid.shape[1], axis=1, overwrite_x=True)[:, ::CELLS])
    rows, bins = len(grid), grid.shape[1] // CELLS
    above = half[:, :-1].reshape(rows, CELLS // 2, bins)[:, :, : bins // 2 + 1].sum(axis=1)
    below = half[:, 1:].reshape(rows, CELLS // 2, bins)[:, :, : bins // 2 - 2 : -1].sum(axis=1)
    return np.asarray(fft.irfft(above + below.conj(), bins, axis=1)) / CELLS


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


def _weights(degree: int) -> np.ndarray:
    """Barycentric weights of degree + 1 cells in a row."""
    node = np.arange(degree + 1.0)
    return np.array([1 / np.prod(np.delete(node[j] - node, j)) for j in range(node.size)])


@njit(cache=True, error_model="numpy")
def _lines(i, p, row, footprint, segment, sizes, room):
    """Lines of one point's segment where they are seen, at 0 .. N/2; their origin."""
    origin = place_lines(p[:, i].copy(), segment, footprint, row[i], sizes, room)
    if origin < 0:
        for b in range(footprint.shape[2]):
            room[PLACE, b], room[IM, b] = -room[PLACE, b], -room[IM, b]
    return abs(origin)


@njit(cache=True, error_model="numpy")
def _image(origin, delta, re, im, sizes, centre):
    """Cell and weight of a line's image about DC or Nyquist, whichever is nearer."""
    place, sign = -2.0 * origin - delta, 1.0
    if 4 * origin > sizes[0]:
        place += sizes[0]
        sign = -1.0 if sizes[1] & 1 else 1.0
    return centre + CELLS * place, sign * re, -sign * im


@njit(cache=True, error_model="numpy")
def _deposit(p, row, footprint, segment, sizes, image, weights, origin, grid):
    """Lines of m points, each shared out among as many cells of its grid, (m, cells, 2 or 1)."""
    n, cells, power = footprint.shape[2], grid.shape[1], sizes[4] != 0
    room = np.empty((BLOCK + 1, n))
    delta, re, im = room[PLACE], room[RE], room[IM]
    centre, share = cells // 2, np.empty(weights.size)
    low, high = (-0.5, cells - 1.0) if weights.size == 1 else (5.0, cells - 6.0)
    for i in range(row.size):
        origin[i] = _lines(i, p, row, footprint, segment, sizes, room)
        for b in range(n):
            _share_out(grid, i, centre + CELLS * delta[b], re[b], im[b], weights, share)
            if image:
                at, a, c = _image(origin[i], delta[b], re[b], im[b], sizes, centre)
                if low < at < high:
                    _share_out(grid, i, at, abs(a) if power else a, c, weights, share)


@njit(cache=True, error_model="numpy")
def _share_out(grid, i, at, re, im, weights, share):
    """Add a line to the nearest cell, or to ten cells by Lagrange's polynomial."""
    if weights.size == 1:
        _add(grid, i, int(np.rint(at)), re, im)
        return
    first = int(np.floor(at)) - 4
    t = at - first
    total = 0.0
    for j in range(weights.size):
        if t == j:
            _add(grid, i, first + j, re, im)
            return
        share[j] = weights[j] / (t - j)
        total += share[j]
    for j in range(weights.size):
        _add(grid, i, first + j, re * share[j] / total, im * share[j] / total)


@njit(inline="always")
def _add(grid, i, cell, re, im):
    grid[i, cell, 0] += re
    if grid.shape[2] > 1:
        grid[i, cell, 1] += im
