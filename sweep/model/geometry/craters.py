"""Simple impact craters, carved into a grid of heights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sweep.model.geometry.frequency import Law, scatter
from sweep.model.geometry.terrain import Terrain

REACH = 4.0
"""Radius, in crater radii, at which the ejecta are cut off: 1/64 of their height at the rim."""


class Craters(NamedTuple):
    """Craters of a piece of ground.

    Parameters
    ----------
    x, y : (n,) ndarray
        World position of the centres [m].
    diameter : (n,) ndarray
        From rim crest to rim crest [m].
    freshness : (n,) ndarray
        Depth and rim height as a share of a fresh crater's, 0..1.
    """

    x: np.ndarray
    y: np.ndarray
    diameter: np.ndarray
    freshness: np.ndarray


def fresh_depth(diameter: np.ndarray) -> np.ndarray:
    """Depth of a fresh simple crater below its rim crest [m].

    ``0.196 D^1.010`` in km (Pike, in Impact and Explosion Cratering, 489, 1977): lunar craters
    up to 15 km; about a fifth of the diameter.
    """
    return np.asarray(1e3 * 0.196 * (np.asarray(diameter, float) / 1e3) ** 1.010)


def fresh_rim_height(diameter: np.ndarray) -> np.ndarray:
    """Height of a fresh simple crater's rim crest above the ground before it [m].

    ``0.036 D^1.014`` in km (Pike, 1977, as for `fresh_depth`).
    """
    return np.asarray(1e3 * 0.036 * (np.asarray(diameter, float) / 1e3) ** 1.014)


def profile(radius: np.ndarray, *, diameter: np.ndarray, freshness: np.ndarray) -> np.ndarray:
    """Height above the ground before the crater, at a distance from its centre [m].

    A paraboloid from floor to rim crest; outside, ejecta that thin with the third power of the
    distance (McGetchin, Settle and Head, Earth Planet. Sci. Lett. 20, 226, 1973), lowered so that
    they end, without a step, at `REACH` radii.

    Parameters
    ----------
    radius : ndarray
        Distance from the centre [m].
    diameter, freshness : ndarray
        As in `Craters`.
    """
    depth, rim = fresh_depth(diameter), fresh_rim_height(diameter)
    s = 2 * np.asarray(radius, float) / diameter
    bowl = rim - depth * (1 - s**2)
    ejecta = rim * (np.maximum(s, 1.0) ** -3 - REACH**-3) / (1 - REACH**-3)
    return np.asarray(freshness * np.where(s < 1, bowl, np.maximum(ejecta, 0.0)))


def draw_craters(
    generator: np.random.Generator,
    law: Law,
    *,
    bounds: tuple[float, float, float, float],
    smallest: float,
    largest: float,
    least_fresh: float = 0.1,
) -> Craters:
    """Craters that reach into a rectangle, largest first.

    Ground in equilibrium holds craters of every state from fresh to all but gone. Their freshness
    is drawn evenly: a simplification, as wear by diffusion leaves more of the shallow ones.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of randomness.
    law : Law
        Size-frequency law, such as `frequency.lunar_craters`.
    bounds : (x least, y least, x largest, y largest) of float
        The rectangle [m]; craters centred outside whose ejecta reach in are drawn too.
    smallest, largest : float
        Diameters within which the law is drawn [m].
    least_fresh : float
        Freshness is uniform from here to 1; 1 makes all fresh.

    Raises
    ------
    ValueError
        For a freshness outside 0..1, and as `frequency.scatter`.
    """
    if not 0 <= least_fresh <= 1:
        raise ValueError(f"the least freshness must lie within 0 and 1, not {least_fresh}")
    margin = REACH * largest / 2
    wider = bounds[0] - margin, bounds[1] - margin, bounds[2] + margin, bounds[3] + margin
    x, y, diameter = scatter(generator, law, bounds=wider, smallest=smallest, largest=largest)
    freshness = generator.uniform(least_fresh, 1.0, len(x))
    reach = REACH * diameter / 2
    west, south, east, north = bounds
    near = (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)
    return Craters(x[near], y[near], diameter[near], freshness[near])


def carve(terrain: Terrain, craters: Craters) -> Terrain:
    """Terrain with craters added to it, one on top of the other.

    Raises
    ------
    ValueError
        Where a crater is under three grid steps across: the grid can not hold it.
    """
    step = max(abs(d) for d in terrain.spacing)
    if len(craters.x) and craters.diameter.min() < 3 * step:
        raise ValueError(
            f"a crater of {craters.diameter.min():g} m is under three grid steps of {step:g} m; "
            "make the grid finer or the smallest crater larger"
        )
    heights = terrain.heights.copy()
    for x, y, diameter, freshness in zip(*craters, strict=True):
        reach = REACH * diameter / 2
        rows, row_y = _window(y - terrain.origin[1], reach, terrain.spacing[1], heights.shape[0])
        cols, col_x = _window(x - terrain.origin[0], reach, terrain.spacing[0], heights.shape[1])
        radius = np.hypot(row_y[:, None], col_x)
        heights[rows, cols] += profile(radius, diameter=diameter, freshness=freshness)
    return Terrain(heights, terrain.spacing, terrain.origin)


def _window(centre: float, reach: float, step: float, number: int) -> tuple[slice, np.ndarray]:
    """Nodes of one axis within reach of a centre, and their distances from it [m]."""
    first, last = sorted(((centre - reach) / step, (centre + reach) / step))
    start = min(max(int(np.ceil(first)), 0), number)
    stop = max(min(int(np.floor(last)) + 1, number), start)
    return slice(start, stop), np.arange(start, stop) * step - centre
