"""Two flights side by side: their shots matched by when, whence and where to they look."""

from __future__ import annotations

import numpy as np
import pandas
import xarray as xr

from sweep.analysis.answers.comparison import differences, titled
from sweep.analysis.answers.physical import study_of
from sweep.model.accuracy import clopper_pearson, half_width
from sweep.model.outputs import PROMISED, STATISTICS
from sweep.model.pairing import TRUE

SAME_TIME = 1e-9
"""Difference [s] up to which shots of a beam are at the same time."""

SAME_PLACE = 1e-6
"""Distance [m] up to which they are from the same place."""

SAME_DIRECTION = 1e-9
"""Angle [rad] up to which they have the same direction."""

DETECTED = "detected"
"""Share of the draws in which a shot has a true point."""

ERRORS = ("effects_error", "beamlets_error")
"""What is known of how far a shot's probabilities may be off."""

COMPARED = tuple(
    name for name, output in STATISTICS.items() if output.dtype == "float64" and name not in ERRORS
)


def compare(ours: xr.DataTree, other: xr.DataTree) -> xr.DataTree:
    """Differences, other less ours, at the shots that both flights have.

    Parameters
    ----------
    ours, other
        As `sweep.open_scene` gives them. Scanners are matched by name; shots by time, beam,
        position and direction of the beam, to :data:`SAME_TIME`, :data:`SAME_PLACE` and
        :data:`SAME_DIRECTION`; places along axes as :func:`.comparison.compare` matches points.

    Returns
    -------
    xarray.DataTree
        A group for each scanner that both have, with dimensions axes and `shot`: differences of
        the probabilities and SNRs of a shot; where both stores are complete also of `detected`,
        the share of draws in which the shot has a true point; `.._allowed` and `.._agrees` of
        probabilities of detection and `detected`, as :func:`.comparison.compare` has them. Of
        `detected` the intervals are those of Clopper and Pearson with each study's confidence.
        A group's attributes `shots` and `other_shots` tell how many each flight has.

    Raises
    ------
    ValueError
        The flights have no scanner in common, or no shot of a scanner.
    """
    scanners = [name for name in ours.attrs["scanners"] if name in other.attrs["scanners"]]
    if not scanners:
        has = (", ".join(tree.attrs["scanners"]) for tree in (ours, other))
        raise ValueError("the flights have no scanner in common: {}; and {}".format(*has))
    parts = {name: _scanner(ours, other, name) for name in scanners}
    whole = xr.Dataset(attrs={"ours": titled(ours), "other": titled(other)})
    return xr.DataTree.from_dict({"/": whole, **parts})


def _scanner(ours: xr.DataTree, other: xr.DataTree, scanner: str) -> xr.Dataset:
    """Differences at the shots of a scanner."""
    left, right = (tree.children[scanner].to_dataset(inherit=False) for tree in (ours, other))
    shots, matching = _pairs(left, right, scanner)
    when = {name: left[name].isel(shot=shots).compute() for name in ("time", "beam")}
    drawn = all(_complete(tree) for tree in (ours, other))
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


def _complete(tree: xr.DataTree) -> bool:
    """Whether no draw is left to compute, which a point that is not there would not tell."""
    return bool(tree.attrs["points_committed"] >= tree.attrs["points"])


def _quantities(group: xr.Dataset, tree: xr.DataTree, *, drawn: bool) -> xr.Dataset:
    """What is compared of a group's shots, over its axes and shots."""
    there = [name for name in (*COMPARED, *ERRORS) if name in group]
    found = group[there].assign_attrs(tree.attrs)
    if not drawn:
        return found
    confidence, draws = study_of(found).accuracy.confidence, group.sizes["draw"]
    count = ((group["flags"] & TRUE) > 0).any("return_number").sum("draw")

    def reach(successes: np.ndarray) -> np.ndarray:
        interval = clopper_pearson(successes=successes, trials=draws, confidence=confidence)
        return half_width(successes / draws, interval)

    width = xr.apply_ufunc(reach, count, dask="parallelized", output_dtypes=[float])
    known = found["pd_shot"].notnull()
    share = (count / draws).where(known)
    share.attrs = {"units": "1", "long_name": "share of draws in which the shot has a true point"}
    return found.assign({DETECTED: share, f"{DETECTED}_half_width": width.where(known)})
