"""Two studies, or two flights, compared where they meet: differences, table, figure, verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers import provenance
from sweep.analysis.answers.physical import STUDY_ID, markers, parameter, si, study_of
from sweep.analysis.charts import LOG, Axis, Chart, Line, Panel
from sweep.model.accuracy import clopper_pearson
from sweep.model.accuracy import half_width as half_width_of
from sweep.model.outputs import OUTPUTS, PROMISED, SPECTRA_OUTPUTS, STATISTICS
from sweep.model.pairing import TRUE

ROUNDING = 1e-12
"""Change of a probability by another processor's last digits, at the most."""

_DIGITS = 12

ONE_OF_EACH = "a grid of points and a flight have nothing to match: compare two of a kind"


def compare(ours: xr.Dataset, other: xr.Dataset) -> xr.Dataset:
    """Differences, other less ours, at the points that both studies have.

    Parameters
    ----------
    ours, other
        As `sweep.open` gives them, or parts of them. Points are matched by the values of their
        coordinates, whatever these are written in. A parameter on an axis of one study only takes
        the value of the other, if it is there; else the axis stays.

    Returns
    -------
    xarray.Dataset
        Lazy, over the axes of `ours` and those of `other` that stay. It has the difference of every
        output by its name. For each probability of detection it also has `pd_.._allowed` and
        `pd_.._agrees`. The first is the difference that the half-widths of draws and the errors of
        skipped effects and few beamlets allow. The second is true if the difference is no larger,
        and false where either is not computed.

    Raises
    ------
    ValueError
        No point is in both, or the other is a flight.
    """
    if not isinstance(other, xr.Dataset):
        raise ValueError(ONE_OF_EACH)
    ours, other = (provenance.proven(dataset, every_axis=True) for dataset in (ours, other))
    names = [n for n in {**OUTPUTS, **SPECTRA_OUTPUTS} if n in ours and n in other]
    return differences(ours, other, names, bounded=PROMISED)


def differences(
    ours: xr.Dataset, other: xr.Dataset, names: Sequence[str], *, bounded: Sequence[str]
) -> xr.Dataset:
    """Differences of variables where they meet; of those that are bounded, whether they agree."""
    left, right = _matched(ours, other)
    result = xr.Dataset(attrs={"ours": titled(ours), "other": titled(other)})
    for name in names:
        result[name] = (right[name] - left[name]).assign_attrs(
            left[name].attrs, long_name=f"difference of {left[name].attrs.get('long_name', name)}"
        )
    for name in (name for name in bounded if name in names):
        allowed = _unknown(left, name) + _unknown(right, name) + ROUNDING
        result[f"{name}_allowed"] = allowed.assign_attrs(
            units="1", long_name=f"largest difference of {name} within what is known of both"
        )
        result[f"{name}_agrees"] = (abs(result[name]) <= allowed).assign_attrs(
            units="1", long_name=f"whether {name} agrees within what is known of both"
        )
    return result


def titled(store: xr.Dataset | xr.DataTree) -> str:
    """Title and number of a study."""
    return f"{store.attrs.get('title', '')} ({str(store.attrs.get('study_id', ''))[:8]})"


def _unknown(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """Known bound on the error of a probability."""
    parts = [dataset[n] for n in (f"{name}_half_width", "effects_error", "beamlets_error")
             if n in dataset]  # fmt: skip
    return sum((part.fillna(0.0) for part in parts), xr.zeros_like(dataset[name]))


def _matched(ours: xr.Dataset, other: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Both datasets at the points that they share, along dimensions of the same names."""
    other = _at_fixed(other, ours)
    ours = _at_fixed(ours, other)
    for dim in [d for d in ours.dims if d in other.dims]:
        left, right = _places(ours, str(dim)), _places(other, str(dim))
        shared = left.intersection(right, sort=False)
        if not shared.size:
            raise ValueError(f"along {dim} the two studies have no value in common")
        ours = ours.isel({dim: left.get_indexer(shared)})
        other = other.isel({dim: right.get_indexer(shared)})
        # the coordinates of ours stand for both, so that xarray takes no offence at last digits
        other = other.drop_vars([n for n, c in other.coords.items() if dim in c.dims])
        other = other.assign_coords({n: c for n, c in ours.coords.items() if c.dims == (dim,)})
    scalars = [n for n, c in other.coords.items() if not c.dims]
    ours = ours.drop_vars([STUDY_ID, *markers(ours)], errors="ignore")
    return ours, other.drop_vars(scalars)


def _at_fixed(dataset: xr.Dataset, reference: xr.Dataset) -> xr.Dataset:
    """Return a dataset at the values of the parameters that the reference has off its axes."""
    paths = {c.attrs.get("path") for c in reference.coords.values() if c.dims}
    study = study_of(reference)
    for array in list(dataset.coords.values()):
        path = array.attrs.get("path", "")
        if not array.dims or path in paths or array.name not in dataset.dims:
            continue
        value = parameter(reference, path, study).values.item()
        values = si(array).values
        same = values == value if isinstance(value, str) else np.isclose(values, value, 1e-9, 0.0)
        if same.any():
            dataset = dataset.isel({array.name: int(np.argmax(same))})
    return dataset


def _places(dataset: xr.Dataset, dim: str) -> pandas.Index:
    """SI values along a dimension, to 12 digits; of several coordinates together."""
    arrays = [c for c in dataset.coords.values() if c.dims == (dim,)]
    if not arrays:
        return pandas.RangeIndex(dataset.sizes[dim])
    columns = [_rounded(np.asarray(si(c).values)) for c in
               sorted(arrays, key=lambda c: str(c.attrs.get("path", c.name)))]  # fmt: skip
    index = columns[0] if len(columns) == 1 else pandas.MultiIndex.from_arrays(columns)
    index = pandas.Index(index)
    if index.has_duplicates:
        # A point that stands twice along a zipped axis is matched once, with the first of them.
        unique = index.to_frame(index=False)
        unique["again"] = unique.groupby(list(unique.columns)).cumcount()
        index = pandas.MultiIndex.from_frame(unique)
    return index


def _rounded(values: np.ndarray) -> np.ndarray:
    """Numbers to 12 significant digits."""
    if values.dtype.kind not in "fiu":
        return values
    values = values.astype(float)
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(np.abs(np.where(values, values, 1.0)))))
    return np.rint(values * scale) / scale


SAME_TIME = 1e-9
"""Difference [s] up to which shots of a beam are at the same time."""

SAME_PLACE = 1e-6
"""Distance [m] up to which they are from the same place."""

SAME_DIRECTION = 1e-9
"""Angle [rad] up to which they have the same direction."""

DETECTED = "detected"
"""Share of the draws in which a shot has a true point."""

ERRORS = ("effects_error", "beamlets_error")
"""Known bounds on the errors of a shot's probabilities."""

COMPARED = tuple(
    name for name, output in STATISTICS.items() if output.dtype == "float64" and name not in ERRORS
)


def compare_flights(ours: xr.DataTree, other: xr.DataTree) -> xr.DataTree:
    """Differences, other less ours, at the shots that both flights have.

    Parameters
    ----------
    ours, other
        As `sweep.open_scene` gives them. Scanners are matched by name; shots by time, beam,
        position and direction of the beam, to :data:`SAME_TIME`, :data:`SAME_PLACE` and
        :data:`SAME_DIRECTION`; places along axes as :func:`compare` matches points.

    Returns
    -------
    xarray.DataTree
        A group for each scanner that both have, with dimensions axes and `shot`. It has the
        differences of the probabilities and SNRs of a shot. If both stores are complete, it also
        has the difference of `detected`, the share of draws in which the shot has a true point.
        `.._allowed` and `.._agrees` belong to probabilities of detection and to `detected`, as in
        :func:`compare`. The intervals of `detected` are those of Clopper and Pearson with each
        study's confidence. The attributes `shots` and `other_shots` are the numbers of shots.

    Raises
    ------
    ValueError
        The flights have no scanner in common, or no shot of a scanner; the other is a grid.
    """
    if not isinstance(other, xr.DataTree):
        raise ValueError(ONE_OF_EACH)
    scanners = [name for name in scanner_names(ours) if name in scanner_names(other)]
    if not scanners:
        has = (", ".join(scanner_names(tree)) for tree in (ours, other))
        raise ValueError("the flights have no scanner in common: {}; and {}".format(*has))
    parts = {name: _scanner(ours, other, name) for name in scanners}
    whole = xr.Dataset(attrs={"ours": titled(ours), "other": titled(other)})
    return xr.DataTree.from_dict({"/": whole, **parts})


def scanner_names(tree: xr.DataTree) -> list[str]:
    """Return the names of a flight's scanners; netCDF makes a word of a list of one."""
    names = tree.attrs["scanners"]
    return [names] if isinstance(names, str) else [str(name) for name in names]


def _scanner(ours: xr.DataTree, other: xr.DataTree, scanner: str) -> xr.Dataset:
    """Differences at the shots of a scanner."""
    left, right = (
        provenance.proven(
            tree.children[scanner].to_dataset(inherit=False).assign_attrs(tree.attrs),
            every_axis=True,
        )
        for tree in (ours, other)
    )
    shots, matching = _pairs(left, right, scanner)
    when = {name: left[name].isel(shot=shots).compute() for name in ("time", "beam")}
    # a store is complete where no draw is left to compute; a missing point would not tell
    drawn = all(t.attrs["points_committed"] >= t.attrs["points"] for t in (ours, other))
    sides = [
        _quantities(group.isel(shot=index), tree, drawn=drawn)
        for group, tree, index in ((left, ours, shots), (right, other, matching))
    ]
    names = [name for name in (*COMPARED, DETECTED) if all(name in side for side in sides)]
    found = differences(sides[0], sides[1], names, bounded=(*PROMISED, DETECTED))
    return found.assign_coords(when).assign_attrs(
        ours=titled(ours), other=titled(other), scanner=scanner,
        shots=left.sizes["shot"], other_shots=right.sizes["shot"],
    )  # fmt: skip


def _pairs(ours: xr.Dataset, other: xr.Dataset, scanner: str) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the shots that both groups have, those of ours rising; none are computed: none."""
    left, right = _known(ours), _known(other)
    if left.empty or right.empty:
        return np.empty(0, int), np.empty(0, int)
    both = pandas.merge_asof(
        left, right, on="time", by="beam", direction="nearest", tolerance=SAME_TIME
    ).dropna()
    if both.empty:
        raise ValueError(
            f"scanner {scanner}: no shot of one flight is at the time of one of the other"
        )
    shots, matching = both["number_x"].to_numpy(int), both["number_y"].to_numpy(int)
    apart, chord = (
        np.linalg.norm(ours[name].values[shots] - other[name].values[matching], axis=1)
        for name in ("platform_position", "beam_direction")
    )
    turned = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    same = (apart <= SAME_PLACE) & (turned <= SAME_DIRECTION)
    if not same.any():
        raise ValueError(
            f"scanner {scanner}: the flights look from other places, or elsewhere: at one time "
            f"they are {apart.min():.3g} m apart at the least, their beams "
            f"{np.degrees(turned.min()):.3g} deg; compare flights of one path, attitude and scanner"
        )
    order = np.argsort(shots[same])
    return shots[same][order], matching[same][order]


def _known(group: xr.Dataset) -> pandas.DataFrame:
    """Time, beam and number of the shots that are computed, by time."""
    frame = pandas.DataFrame({name: group[name].values for name in ("time", "beam")})
    return frame.assign(number=frame.index).dropna().sort_values("time")


def _quantities(group: xr.Dataset, tree: xr.DataTree, *, drawn: bool) -> xr.Dataset:
    """Quantities of a group's shots that are compared, over its axes and shots."""
    there = [name for name in (*COMPARED, *ERRORS) if name in group]
    found = group[there].assign_attrs(tree.attrs)
    if not drawn:
        return found
    confidence, draws = study_of(found).accuracy.confidence, group.sizes["draw"]
    count = ((group["flags"] & TRUE) > 0).any("return_number").sum("draw")

    def reach(successes: np.ndarray) -> np.ndarray:
        interval = clopper_pearson(successes=successes, trials=draws, confidence=confidence)
        return half_width_of(successes / draws, interval)

    width = xr.apply_ufunc(reach, count, dask="parallelized", output_dtypes=[float])
    known = found["pd_shot"].notnull()
    share = (count / draws).where(known)
    share.attrs = {"units": "1", "long_name": "share of draws in which the shot has a true point"}
    return found.assign({DETECTED: share, f"{DETECTED}_half_width": width.where(known)})


COLUMNS = ("quantity", "differ", "median", "largest", "agree", "largest at")

Store = xr.Dataset | xr.DataTree

SHOWN = (
    *PROMISED, "log10_pfa_bin", "log10_pfa_segment", "log10_pfa_both_chirps",
    "log10_pfa_shot", "p_leakage_up", "p_leakage_down", "snr_up", "snr_doppler", "snr_down",
    "noise_variance", "range_error", "radial_velocity_error", "false_alarms", "range_rmse",
    "radial_velocity_rmse", "pfa_up", "pfa_down", DETECTED,
)  # fmt: skip


def compared(ours: Store, other: Store) -> dict[str, xr.Dataset]:
    """Differences of what a table shows, computed: by scanner, or of a grid under no name."""
    found = ours.sweep.compare(other)
    one = isinstance(found, xr.Dataset)
    parts = {"": found} if one else {n: group.to_dataset() for n, group in found.children.items()}
    shown = {f"{name}{end}" for name in SHOWN for end in ("", "_allowed", "_agrees")}
    return {n: own[[v for v in own if v in shown]].compute() for n, own in parts.items()}


def rows(found: xr.Dataset) -> list[list[str]]:
    """Return a row for each quantity with points, in the order of `COLUMNS`."""
    return [_row(found, name) for name in SHOWN if name in found and found[name].notnull().any()]


def _row(found: xr.Dataset, name: str) -> list[str]:
    array = found[name]
    known = np.isfinite(array.values)
    size = np.where(known, np.abs(array.values), -1.0)
    worst = np.unravel_index(int(np.argmax(size)), size.shape)
    share = "-"
    if f"{name}_agrees" in found:
        agrees = (found[f"{name}_agrees"].values & known).sum() / known.sum()
        # rounded down: nothing but all is 100 %
        share = f"{np.floor(1e4 * agrees) / 100:g} %"
    different = int((size > 0).sum())
    return [
        labels.with_units(name, str(array.attrs.get("units", ""))),
        f"{different:,}",
        f"{np.median(size[known]):.2g}",
        f"{array.values[worst]:+.3g}" if different else "0",
        share,
        _where(array, worst) if different else "-",
    ]


def _where(array: xr.DataArray, index: tuple[np.intp, ...]) -> str:
    """Coordinates of a point, in the order of the axes."""
    point = array.isel(dict(zip(array.dims, map(int, index), strict=True)))
    return ", ".join(_told(c) for c in point.coords.values())


def _told(coordinate: xr.DataArray) -> str:
    """Return a coordinate's value; with its name where no unit tells what it is."""
    units = str(coordinate.attrs.get("units", ""))
    value = labels.quantity(coordinate.values.item(), units)
    return value if units not in ("", "1") else f"{labels.coordinate(str(coordinate.name))} {value}"


def met(found: xr.Dataset) -> str:
    """Return the number of the shots that two flights share, in words."""
    number, ours, other = found.sizes["shot"], found.attrs["shots"], found.attrs["other_shots"]
    if number == ours == other:
        return f"all {labels.counted(number, 'shot')}"
    return f"{labels.counted(number, 'shot')} that both have, of {ours:,} and {other:,}"


def verdict(parts: Iterable[xr.Dataset]) -> tuple[str, str]:
    """Return ``same``, ``different`` or ``nothing``, and a sentence that says so."""
    number, apart, thing, counted = 0, 0, "point", ""
    for found in parts:
        if "shot" in found.dims:
            several = any(n > 1 for dim, n in found.sizes.items() if dim != "shot")
            thing, counted = "shot", ", counted at each place along the axes" * several
        pairs = [(found[n], found[f"{n}_agrees"]) for n in PROMISED if n in found]
        number += max((int(array.notnull().sum()) for array, _ in pairs), default=0)
        apart += max((int((array.notnull() & ~agrees).sum()) for array, agrees in pairs), default=0)
    if not number:
        return "nothing", "Nothing that both stores have is computed yet."
    if not apart:
        told = f"agree at {labels.counted(number, thing)}"
        return "same", f"Probabilities of detection {told}{counted}."
    told = f"differ at {apart:,} of {labels.counted(number, thing)}"
    return "different", f"Probabilities of detection {told}{counted}."


LEAST = 1e-16
"""Differences below it stand at the left edge of a figure."""


def save_figure(found: Mapping[str, xr.Dataset], path: Path) -> Path:
    """Draw the shares of points that differ by more than some amount, a colour a scanner."""
    from sweep.analysis import canvas

    with canvas.style():
        chart = figure(found)
        if chart is None:
            return canvas.save(canvas.empty("Nothing that both stores have is computed yet"), path)
        return canvas.save(canvas.sheet_of(chart, chart.heading, ""), path)


def figure(found: Mapping[str, xr.Dataset]) -> Chart | None:
    """Return the chart of the differences, or None if no common point is computed."""
    parts = list(found.values())
    names = [n for n in PROMISED if any(n in part and part[n].notnull().any() for part in parts)]
    if not names:
        return None
    thing = "shot" if any("shot" in part.dims for part in parts) else "point"
    number = sum(int(part[names[0]].notnull().sum()) for part in parts)
    up = Axis(f"share of {thing}s beyond (%)", limits=(-3, 103))
    across = Axis("difference of pd, either way", LOG, (LEAST, 1.0))
    return Chart(
        f"{parts[0].attrs['other']}\nless {parts[0].attrs['ours']}",
        f"Shares of {thing}s that differ by more than some amount, of {', '.join(names)}.",
        [f"{number:,} {thing}s that both studies have"],
        [
            Panel({"probability": name}, across, up, [
                line for i, (scanner, part) in enumerate(found.items())
                for line in _shares(part, name, scanner, i)
            ])
            for name in names
        ],
        rows=[2] * (len(names) // 2) + [1] * (len(names) % 2),
    )  # fmt: skip


def _shares(found: xr.Dataset, name: str, scanner: str, number: int) -> list[Line]:
    """Shares of points beyond each difference that is, and beyond each that is allowed."""
    known = np.isfinite(found[name].values)
    lines = []
    for values, words, look in (
        (np.abs(found[name].values), "found", "line"),
        (found[f"{name}_allowed"].values, "allowed", "stated"),
    ):
        ordered = np.sort(np.maximum(np.broadcast_to(values, known.shape)[known], LEAST))
        share = 100 * (1 - np.arange(ordered.size + 1) / max(ordered.size, 1))
        x = np.repeat([LEAST, *ordered, 1.0], 2)[1:-1]
        y = np.repeat(share, 2)
        lines.append(Line(x, y, f"{scanner} {words}".strip(), number, look=look))
    return lines if known.any() else []
