"""Recordings of scanners: quantities of shots and points, read part by part; clouds of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.opening import chunk, read_attributes, stretches
from sweep.analysis.selection import is_any
from sweep.model.eyepoints import Eyepoints
from sweep.model.outputs import BEAMLETS, CYCLES, POINTS, SHOTS, STATISTICS, XYZ
from sweep.model.pairing import FLAGS, TRUE
from sweep.scenes.eyepoint_arrays import from_arrays
from sweep.spec import Mistake, SpecError
from sweep.spec.rules import near_miss
from sweep.storage.locations import PACKED, Location, eyepoints_path, located
from sweep.storage.opening import CHECKED, NotAStoreError
from sweep.storage.sound import readable
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.spec import SceneSpec


AXES = ("x", "y", "z")

QUANTISED, INTERPOLATED = "quantised", "interpolated"

_BY_RANGES = {
    f"{name}{error}": f"{name}_interpolated{error}"
    for name in ("range", "radial_velocity")
    for error in ("", "_standard_error")
}


def by_ranges(name: str, ranges: str) -> str:
    """Name of the array of a quantity: between bins, where that is asked for and there is one."""
    return _BY_RANGES.get(name, name) if ranges == INTERPOLATED else name


CATEGORIES = ("beam", "surface", "flags")
"""Quantities whose values are names rather than amounts."""

SIGNED = ("radial_velocity", "beam_radial_velocity", "true_radial_velocity")
"""Velocities, whose sign is shown."""

DECIBELS = ("snr", "snr_up")
"""Ratios of powers, which are shown in decibels."""

WIDE = ("pfa_up", "pfa_down")
"""Quantities that go over orders of magnitude, and are above 0."""

KINDS = {name: bit for name, bit in FLAGS.items() if name != "unconfirmed"}
"""Flags of which a point has exactly one."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of each shot or of each point."""

    words: str
    units: str
    of_points: bool


def _listed() -> dict[str, Quantity]:
    found = {}
    for table, of_points in ((SHOTS, False), (STATISTICS, False), (POINTS, True)):
        for name, output in table.items():
            if XYZ not in output.dims:
                found[name] = Quantity(output.long_name, output.units, of_points)
    plain = {
        "range": "range", "radial_velocity": "radial velocity", "snr": "signal-to-noise ratio",
        "pd": "probability of detection", "time": "time", "beam": "beam", "surface": "surface",
    }  # fmt: skip
    for name, words in plain.items():
        found[name] = replace(found[name], words=words)
    altitude = CYCLES["true_altitude"]
    found["altitude"] = Quantity("altitude above ground", altitude.units, False)
    found |= {axis: Quantity(axis, "m", True) for axis in AXES}
    return found | {"shot": Quantity("number of the shot", "1", False)}


QUANTITIES = _listed()
"""Every quantity by its name."""


def label(name: str) -> str:
    """Return a quantity in words with the units in which it is shown."""
    about = QUANTITIES[name]
    return labels.with_units(about.words, "dB" if name in DECIBELS else about.units)


def shown(name: str, values: np.ndarray) -> np.ndarray:
    """Values as they are shown: decibels of ratios, and of flags which kind of point they say."""
    values = np.asarray(values)
    if name == "flags":
        return np.asarray(kinds(values.astype(int)), float)
    if name in DECIBELS:
        known = values > 0
        return np.where(known, 10 * np.log10(np.where(known, values, 1.0)), np.nan)
    return values.astype(float)


def kinds(flags: np.ndarray) -> np.ndarray:
    """Index of each point's kind in KINDS, from its flags; -1 where there is no point."""
    found = np.full(np.shape(flags), -1)
    for i, bit in enumerate(KINDS.values()):
        found[(flags & bit) > 0] = i
    return found


Table = dict[str, np.ndarray]


Limits = tuple[float, ...]
"""Lowest and highest value of a quantity."""

UNLIMITED: Limits = (-np.inf, np.inf)


def within(table: Table, limits: Mapping[str, Limits]) -> np.ndarray:
    """Mask of the rows in which all quantities that have limits lie within them; nan does not."""
    inside = [(table[n] >= low) & (table[n] <= high) for n, (low, high) in limits.items()]
    return np.asarray(np.logical_and.reduce(inside))


@dataclass(frozen=True)
class Recording:
    """Shots and points of one scanner, at one place along the axes; chunks of its flags' folder."""

    scanner: str
    dataset: xr.Dataset
    chunks: Location | None = None

    @property
    def shots(self) -> int:
        """Number of shots."""
        return int(self.dataset.sizes["shot"])

    def stretches(self, time: Limits = UNLIMITED) -> Iterator[slice]:
        """Ranges of shots, without those that are not computed or lie outside of limits."""
        for part in stretches(self.dataset["flags"], "shot"):
            if within({"time": self.read("time", part)}, {"time": time}).any():
                yield part

    def computed(self, part: slice, draw: int = 0) -> np.ndarray:
        """Mask (k,) of the shots of a range of which the points of a draw are computed.

        Geometry is stored with a study's first place and draw, and no point looks like none
        found: only the chunk tells.
        """
        known = np.isfinite(self.read("time", part))
        if self.chunks is None:
            return known
        shots, draws = (chunk(self.dataset["flags"], dim) for dim in ("shot", "draw"))
        stored = [
            (self.chunks / f"{number}" / f"{draw // draws}" / "0").exists()
            for number in range(part.start // shots, (part.stop - 1) // shots + 1)
        ]
        at = np.arange(part.start, part.stop) // shots - part.start // shots
        return known & np.array(stored)[at]

    def read(self, name: str, part: slice, draw: int | None = None) -> np.ndarray:
        """Return an array's values over a range of shots, of one draw if it has any."""
        array = self.dataset[name].isel(shot=part)
        return np.asarray((array if draw is None else array.isel(draw=draw)).values)

    def points(
        self, names: Sequence[str], part: slice, draw: int = 0, ranges: str = QUANTISED
    ) -> Table:
        """Quantities of every point of a range of shots, (m,) each, in order.

        Names are those of :data:`QUANTITIES`, ``return_number``, and ``returns`` (points of
        the same shot).
        """
        present = self.read("flags", part, draw) > 0
        shot, place = np.nonzero(present)
        table: Table = {}
        for name in names:
            if name in ("x", "y", "z"):
                if name not in table:
                    where = self._positions(part, present, shot, draw, ranges)
                    table |= dict(zip("xyz", where.T, strict=True))
            elif name == "return_number":
                table[name] = place
            elif name == "returns":
                table[name] = present.sum(axis=1)[shot]
            elif QUANTITIES[name].of_points:
                table[name] = self.read(by_ranges(name, ranges), part, draw)[present]
            else:
                table[name] = self.of_shots(name, part)[shot]
        return {name: table[name] for name in names}

    def rows(
        self,
        names: Sequence[str],
        most: int,
        *,
        draw: int = 0,
        ranges: str = QUANTISED,
        time: Limits | None = None,
    ) -> Thinned:
        """Quantities of every point, or of every computed shot if all are a shot's; thinned."""
        of_points = any(QUANTITIES[name].of_points for name in names)
        limits = {"time": time} if time else {}
        found = Thinned(most)
        for part in self.stretches(time or UNLIMITED):
            if of_points:
                every = list(dict.fromkeys([*names, "flags", "time"]))
                table = self.points(every, part, draw, ranges)
            else:
                known = self.computed(part)
                every = list(dict.fromkeys([*names, "time"]))
                table = {name: self.of_shots(name, part)[known] for name in every}
            found.add(confined(table, limits))
        return found

    def _positions(
        self, part: slice, present: np.ndarray, shot: np.ndarray, draw: int, ranges: str
    ) -> np.ndarray:
        """World positions of points, (m, 3)."""
        position = self.read("position", part, draw)[present]
        if ranges == QUANTISED:
            change = self.read("range", part, draw) - self.read("range_interpolated", part, draw)
            position = position + change[present][:, None] * self.read("beam_direction", part)[shot]
        return position

    def of_shots(self, name: str, part: slice) -> np.ndarray:
        """Return a quantity of every shot of a range, (k,)."""
        if name == "shot":
            return np.arange(part.start, part.stop)
        if name == "altitude":
            cycle = np.arange(part.start, part.stop) // int(self.dataset.attrs["shots_a_cycle"])
            heights = self.dataset["true_altitude"].isel(cycle=slice(cycle[0], cycle[-1] + 1))
            return np.asarray(heights.values)[cycle - cycle[0]]
        return self.read(name, part)

    def aims(self, part: slice) -> np.ndarray:
        """World positions that beams truly point at, (k, 3); nan where a beam meets nothing."""
        reach = self.read("beam_range", part)
        reach = np.where(np.isfinite(reach), reach, np.nan)[:, None]
        return self.read("platform_position", part) + reach * self.read("beam_direction", part)


def several_surfaces(recording: Recording, draw: int = 0) -> int | None:
    """Return the number of the first shot with true points of two surfaces in a draw.

    Else the first with two groups of bins above the threshold; or None.
    """
    fallback = None
    for part in recording.stretches():
        seen = np.where(
            (recording.read("flags", part, draw) & TRUE) > 0,
            recording.read("surface", part, draw).astype(float), np.nan,
        )  # fmt: skip
        low = np.where(np.isnan(seen), np.inf, seen).min(axis=1)
        high = np.where(np.isnan(seen), -np.inf, seen).max(axis=1)
        apart = np.flatnonzero(high > low)
        if apart.size:
            return part.start + int(apart[0])
        if fallback is None:
            groups = np.flatnonzero(recording.read("surfaces_seen", part) >= 2)
            fallback = part.start + int(groups[0]) if groups.size else None
    return fallback


def confined(table: Table, limits: Mapping[str, Limits]) -> Table:
    """Rows of a table that lie within limits."""
    if not limits:
        return table
    inside = within(table, limits)
    return {name: values[inside] for name, values in table.items()}


class Thinned:
    """Rows of tables in order: all, then every second, every fourth, ... until few enough."""

    def __init__(self, most: int) -> None:
        self.most, self.every, self.total = most, 1, 0
        self._parts: list[Table] = []

    def add(self, table: Table) -> None:
        """Rows that follow."""
        first = -self.total % self.every
        self.total += len(next(iter(table.values())))
        self._parts.append({n: values[first :: self.every].copy() for n, values in table.items()})
        while self.total > self.most * self.every:
            self.every *= 2
            self._parts = [{n: values[::2].copy() for n, values in self.rows().items()}]

    def counted(self, thing: str, what: str = "") -> str:
        """Return the number of all rows in words, and how many of them are kept."""
        kept = f", one in {self.every} of them shown" if self.every > 1 else ""
        return labels.counted(self.total, thing) + what + kept

    def rows(self) -> Table:
        """Return the rows kept; empty where none were added."""
        if not self._parts:
            return {}
        return {n: np.concatenate([part[n] for part in self._parts]) for n in self._parts[0]}


@dataclass(frozen=True)
class Place:
    """A place along the axes of a study: the number of the value along each, and words.

    Axes left open have other values that would do as well.
    """

    index: dict[str, int]
    words: str
    left_open: tuple[str, ...]

    def recording(self, tree: xr.DataTree, scanner: str) -> Recording:
        """Return the recording of a scanner there."""
        group = tree.children[scanner].to_dataset(inherit=False)
        if PACKED in tree.attrs:
            return Recording(scanner, group.isel(self.index))
        points = located(str(tree.encoding["source"])) / scanner / "flags" / "c"
        return Recording(
            scanner, group.isel(self.index), points.joinpath(*map(str, self.index.values()))
        )


def place(spec: SceneSpec, where: Mapping[str, object]) -> Place:
    """Return the first place at which coordinates have the values asked for.

    Values are written as in a spec, one or several of each coordinate; of an axis with a name
    of its own, the number along it. SpecError tells of all that are no coordinate or value of
    it.
    """
    fits = {axis.name: np.ones(axis.size, bool) for axis in spec.axes}
    mistakes = []
    for name, written in where.items():
        several = list(written) if isinstance(written, tuple | list) else [written]
        try:
            axis, found, there = _fitting(spec, name, several)
            fits[axis] &= found
            if not fits[axis].any():
                raise QuantityError("is no value of this study", there)
        except QuantityError as error:
            mistakes.append(Mistake(f"where.{name}", error.rule, f"{written}", error.suggestion))
    if mistakes:
        raise SpecError(mistakes)
    index = {name: int(np.argmax(found)) for name, found in fits.items()}
    left_open = tuple(name for name, found in fits.items() if found.sum() > 1)
    return Place(index, _words(spec, index), left_open)


def place_at(spec: SceneSpec, numbers: Sequence[int]) -> Place:
    """Return the place at some numbers along the axes."""
    index = {axis.name: number for axis, number in zip(spec.axes, numbers, strict=True)}
    return Place(index, _words(spec, index), ())


def _fitting(spec: SceneSpec, name: str, several: list[object]) -> tuple[str, np.ndarray, str]:
    """Return the axis of a coordinate, which of its values are asked for, and them in words."""
    for axis in spec.axes:
        for member in axis.members:
            if name == member.name:
                wanted: list[object] = [spec.coordinate_value(name, value) for value in several]
                shown = [labels.quantity(value, member.units) for value in member.display[:8]]
                there = f"it has {', '.join(shown)}" + (", ..." if axis.size > 8 else "")
                return axis.name, is_any(np.asarray(member.display), wanted), there
        if name == axis.name:
            numbers = np.isin(np.arange(axis.size), [int(str(v)) for v in several])
            return axis.name, numbers, f"they are numbered 0 to {axis.size - 1}"
    known = [member.name for axis in spec.axes for member in axis.members]
    otherwise = f"the coordinates are {', '.join(known)}" if known else "it has no axes"
    raise QuantityError(
        "is no coordinate of this study", near_miss(name, known, otherwise=otherwise)
    )


def _words(spec: SceneSpec, index: Mapping[str, int]) -> str:
    return ", ".join(
        labels.valued(member.name, member.display[index[axis.name]], member.units)
        for axis in spec.axes
        if axis.size > 1
        for member in axis.members
    )


MOST_POINTS, MOST_DROPOUTS, MOST_PATH = 120_000, 20_000, 2000
"""Most points, dropouts and places of the path in a picture; more is thinned."""

MARGIN = 0.04
"""Room around the points, as a share of the longest side of the box that holds them."""

Box = dict[str, tuple[float, float]]
"""Lowest and highest value of x, y and z [m]."""


@dataclass(frozen=True)
class Cloud:
    """Points of a picture, and what else is in it.

    Of the rows within the limits, false points `outside` of the box of the picture [m] are left
    out. Lost are shots without a point, and dropouts what they aimed at.
    """

    points: Table
    path: Table
    rows: Thinned
    lost: Thinned
    outside: int
    box: Box

    @property
    def dropouts(self) -> Table:
        """Places that shots without a point aimed at; empty where none were looked for."""
        return self.lost.rows()

    @property
    def true(self) -> np.ndarray:
        """Mask of the true points."""
        return np.asarray((self.points["flags"] & TRUE) > 0)

    @property
    def remarks(self) -> list[str]:
        """Numbers of points, dropouts and false points outside, and how many of them are shown."""
        said = [self.rows.counted("point")]
        if self.dropouts:
            said.append(self.lost.counted("shot", " without a point"))
        if self.outside:
            said.append(f"{labels.counted(self.outside, 'false point')} outside of the picture")
        return said


def gathered(
    recording: Recording,
    names: Sequence[str],
    *,
    ranges: str,
    draw: int = 0,
    crops: Mapping[str, Limits] | None = None,
    dropouts: bool = False,
    path: bool = False,
    most: int = MOST_POINTS,
) -> Cloud | None:
    """Points within limits; none where there is none."""
    crops = dict(crops or {})
    places = {name: crop for name, crop in crops.items() if name in AXES}
    kept = list(dict.fromkeys([*AXES, "flags", *names]))
    found, lost, track = Thinned(most), Thinned(MOST_DROPOUTS), Thinned(MOST_PATH)
    asked = crops.get("time", UNLIMITED)
    for part in recording.stretches(asked):
        every = recording.points(list(dict.fromkeys([*kept, *crops])), part, draw, ranges)
        inside = confined(every, crops)
        found.add({name: inside[name] for name in kept})
        time = recording.read("time", part)
        chosen = within({"time": time}, {"time": asked})
        if dropouts:
            none = ~(recording.read("flags", part, draw) > 0).any(axis=-1)
            none &= recording.computed(part, draw) & (chosen | ("time" not in crops))
            aims = recording.aims(part)[none]
            aims = aims[np.isfinite(aims[:, 0])]
            lost.add(confined(dict(zip(AXES, aims.T, strict=True)), places))
        if path:
            position = recording.read("platform_position", part)[chosen]
            track.add(dict(zip(AXES, position.T, strict=True)))
    if not found.total:
        return None
    rows = found.rows()
    box = _box(rows, lost.rows(), track.rows(), places)
    inside_box = within(rows, box)
    return Cloud(
        points={name: values[inside_box] for name, values in rows.items()},
        path=track.rows(),
        rows=found,
        lost=lost,
        outside=int((~inside_box).sum()) * found.every,
        box=box,
    )


def _box(rows: Table, lost: Table, track: Table, places: Mapping[str, Limits]) -> Box:
    """Box around what a figure shows: asked limits, else true points, dropouts and the path."""
    true = (rows["flags"] & TRUE) > 0
    box: Box = {}
    for axis in AXES:
        values = rows[axis][true] if true.any() else rows[axis]
        every = [values, *(t[axis] for t in (lost, track) if t)]
        lowest, highest = places.get(axis, UNLIMITED)
        low = min(float(v.min()) for v in every if v.size)
        high = max(float(v.max()) for v in every if v.size)
        box[axis] = (max(low, lowest), min(high, highest))
    room = MARGIN * max(max(high - low for low, high in box.values()), 1.0)
    return {axis: (low - room, high + room) for axis, (low, high) in box.items()}


def read_eyepoints(store_path: Location, scanner: xr.Dataset, index: np.ndarray) -> Eyepoints:
    """Eyepoints of some shots that a scanner's clouds in a store were made of."""
    path = eyepoints_path(store_path, str(scanner.attrs["geometry_id"]))
    if not path.exists():
        raise NotAStoreError(
            f"the eyepoints of the study are not at {path}: they are kept beside its store; "
            "running the study again casts them anew"
        )
    study_id = read_attributes(path, "eyepoints")["study_id"]
    dataset = xr.open_zarr(readable(path, study_id), chunks=None, **CHECKED)
    chosen = dataset.isel(shot=np.asarray(index))
    arrays = {name: np.asarray(chosen[name].values) for name in (*SHOTS, *BEAMLETS)}
    return from_arrays(arrays, np.asarray(dataset["weight"].values))
