"""Points that are drawn until a tolerance is met, against the exact means over all draws.

A footprint of one beamlet is one speckle: |g| multiplies all bins of a shot alike, and is Rice
distributed. So a segment is detected with Q_1(m / s, b / s), m the steady signal over sigma and
s^2 = 1 + P/2 with P the mean power of the diffuse one, and a shot, whose chirps see the same g,
with the mean of Q_1(|g| a_up, b) Q_1(|g| a_down, b), one integral. Nothing is drawn for it.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import thread_time
from typing import NamedTuple

import numpy as np
from scipy import stats
from shared import table

from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.speckle import coherent_share
from sweep.model.marcum import marcum_q1
from sweep.model.outputs import PROMISED
from sweep.model.shot import find, prepare
from sweep.spec import Spec, load
from sweep.tasks.accuracy.rungs import ADAPTIVE, Rung
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.study import Grid

SEEDS = {0.1: 11, 0.01: 11, 0.001: 2}
"""Times that all points are drawn anew at a tolerance."""
NODES, REACH = 400, 10.0
"""Nodes of the integral over |g|, out to so many standard deviations."""
UNTIL = {"draws.number": 0, "draws.limit": 10**7}
SIGMAS = 5.0

HEAD = """
## Points that are drawn

{name}: all of its {points} points, drawn until the tolerance is met, {seeds}, each with another
seed. They are compared with the exact means over endless draws. For segments this is a closed form,
for the shot an integral (on segments it is within {off:.0e} of the closed form). The promise is
that pd is `within` the tolerance, and within its own half-width, with {confidence:.0%} confidence.

The test counts the points where pd varies and is further than the tolerance from 0 and 1. Nearer to
0 and 1 intervals are surer than promised ([draws.md](draws.md)). The columns named after
probabilities have the share of these points that is within its half-width, and how many standard
deviations of such a share it is from {confidence:.0%}. At most {sigmas:g} are allowed.
"""
COLUMNS = (
    "tolerance", "points", "within", "draws decide", "within of these", *PROMISED, "draws", "us",
)  # fmt: skip


class Drawn(NamedTuple):
    """Results of a study's points at a tolerance, seeds one after the other."""

    tolerance: float
    error: np.ndarray
    """(4, n) |pd - exact|, by the names of PROMISED."""
    half_width: np.ndarray
    decided: np.ndarray
    """(4, n) bool: where draws decide."""
    draws: np.ndarray
    seconds: float
    """A point."""


def exact(spec: Spec) -> tuple[np.ndarray, float]:
    """Means of pd over all draws, (4, points) by PROMISED, and how far off the integral may be.

    Raises
    ------
    ValueError
        Of studies that draw anything but speckle, or more than one of a footprint.
    """
    grid = Grid(spec)
    parameters = grid.parameters_at(np.arange(grid.points))
    certain = [effect.name for effect in EFFECTS if not effect.is_random]
    means, off = np.full((4, grid.points), np.nan), 0.0
    for index, shots in prepare(parameters, certain):
        if shots.amplitude.shape[1] != 1 or np.any(shots.pedestal):
            raise ValueError("only of one beamlet, without a pedestal, the mean is known")
        signal = find(shots)[:, 2] / shots.line_deviation
        level = shots.threshold / shots.line_deviation
        kappa = np.broadcast_to(
            coherent_share(
                roughness=parameters["target.roughness"],
                wavelength=parameters["instrument.laser.wavelength"],
            ),
            (grid.points,),
        )[index]
        # Noise and diffuse light of the bin are one complex normal number.
        together = np.sqrt(1 + (1 - kappa) * signal**2 / 2)
        closed = marcum_q1(np.sqrt(kappa) * signal / together, level / together).q
        for i in range(index.size):
            factor, weight = rice(float(kappa[i]))
            each = marcum_q1(factor * signal[:, i, None], level[i]).q
            off = max(off, float(abs(each @ weight - closed[:, i]).max()))
            both = float((each[0] * each[2]) @ weight)
            values = dict(zip(("pd_up", "pd_doppler", "pd_down"), closed[:, i], strict=True))
            means[:, index[i]] = [(values | {"pd_shot": both})[name] for name in PROMISED]
    return means, off


def rice(kappa: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes |g| and weights of the mean over a speckle with the coherent share kappa."""
    if kappa == 1:
        return np.ones(1), np.ones(1)
    sigma = np.sqrt((1 - kappa) / 2)
    middle = np.sqrt(kappa)
    low, high = max(middle - REACH * sigma, 0.0), middle + REACH * sigma
    x, w = np.polynomial.legendre.leggauss(NODES)
    nodes = low + (high - low) * (x + 1) / 2
    density = stats.rice.pdf(nodes, middle / sigma, scale=sigma)
    return nodes, density * w * (high - low) / 2


def drawn(path: Path, spec: Spec) -> tuple[list[Drawn], float]:
    """A study at its tolerances, and how far off the integral may be."""
    means, off = exact(spec)
    rows = []
    for tolerance, seeds in SEEDS.items():
        again = [(path, tolerance, int(spec.seed) + i) for i in range(seeds)]
        with ProcessPoolExecutor(min(os.cpu_count() or 1, seeds)) as pool:
            found = list(pool.map(_once, again))
        pd, width, error, draws = (
            np.concatenate([each[k] for each in found], axis=-1) for k in range(4)
        )
        true = np.tile(means, seeds)
        decided = (np.abs(true - 0.5) < 0.5 - tolerance) & (error > 1e-9)
        seconds = sum(f[4] for f in found) / seeds / means.shape[1]
        rows.append(Drawn(tolerance, np.abs(pd - true), width, decided, draws, seconds))
    return rows, off


def _once(
    asked: tuple[Path, float, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """All points drawn with a seed: pd, half-widths, standard errors, draws; and the time."""
    path, tolerance, seed = asked
    overrides = UNTIL | {"accuracy.tolerance": tolerance, "seed": seed}
    study = GridStudy(Rung(name="", kind=ADAPTIVE, overrides=overrides).of(load(path)))
    study.compile()
    names = [f"{name}{tail}" for tail in ("", "_half_width", "_error") for name in PROMISED]
    values = np.empty((len(names) + 1, *study.grid.shape))
    begun = thread_time()
    for block in range(study.grid.n_blocks):
        found = study.evaluate(block)
        for place, name in zip(values, [*names, "n_draws"], strict=True):
            place[study.grid.block(block)] = found[name]
    spent = thread_time() - begun
    pd, width, error = values[:-1].reshape(3, len(PROMISED), -1)
    return pd, width, error, values[-1].ravel(), spent


def verdicts(name: str, rows: Sequence[Drawn], confidence: float) -> Iterator[str]:
    """Tolerances that are not kept, in words."""
    for row in rows:
        within = (row.error <= row.tolerance).all(axis=0).mean()
        if within < confidence:
            yield f"- {name} at {row.tolerance:g}: {within:.1%} of the points are within it"
        for quantity, sigmas in zip(PROMISED, covered(row, confidence)[1], strict=True):
            if abs(sigmas) > SIGMAS:
                yield f"- {name} at {row.tolerance:g}: {quantity} covered {sigmas:+.1f} sigma off"


def covered(row: Drawn, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Shares of points within their half-width where draws decide, and sigmas off, (4,) each."""
    number = row.decided.sum(axis=1)
    share = ((row.error <= row.half_width) & row.decided).sum(axis=1) / number
    return share, (share - confidence) / np.sqrt(confidence * (1 - confidence) / number)


def rows_of(rows: Sequence[Drawn], confidence: float) -> Iterator[list[str]]:
    """Rows of the table."""
    for row in rows:
        shares, sigmas = covered(row, confidence)
        within = (row.error <= row.tolerance).all(axis=0)
        told = [f"{share:.1%} ({s:+.1f})" for share, s in zip(shares, sigmas, strict=True)]
        some = row.decided.any(axis=0)
        yield [
            f"{row.tolerance:g}", f"{within.size:,}", f"{within.mean():.2%}", f"{some.sum():,}",
            f"{within[some].mean():.2%}", *told, f"{row.draws.mean():,.0f}",
            f"{1e6 * row.seconds:,.0f}",
        ]  # fmt: skip


def section(name: str, rows: Sequence[Drawn], off: float, spec: Spec) -> str:
    """A study's part of the page."""
    points = rows[0].error.shape[1] // SEEDS[rows[0].tolerance]
    seeds = ", ".join(f"{n} times at {t:g}" for t, n in SEEDS.items())
    confidence = float(spec.accuracy.confidence)
    head = HEAD.format(
        name=name.capitalize(), points=points, seeds=seeds, nodes=NODES, off=off,
        confidence=confidence, sigmas=SIGMAS,
    )  # fmt: skip
    return head.strip() + "\n\n" + table(COLUMNS, rows_of(rows, confidence))
