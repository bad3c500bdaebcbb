"""Which points of a study stand for all of it: fixed by its shape alone, or by a seed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import qmc


def spread(shape: tuple[int, ...], number: int) -> np.ndarray:
    """Numbers of points of a grid, in C order over it, spread evenly along every axis.

    Any stretch from the first is spread as well, so that a part of the sample stands for all.
    They follow Halton's sequence.

    Parameters
    ----------
    shape
        Points along each axis.
    number
        Points wanted; all where there are fewer.

    Returns
    -------
    (n,) ndarray of int64
        Without repetition.
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


def by_chance(shape: tuple[int, ...], number: int, seed: int) -> np.ndarray:
    """Numbers of points of a grid, drawn without repetition, each as likely; rising.

    Parameters
    ----------
    shape, number
        As of :func:`spread`.
    seed
        Of the draw.
    """
    total = math.prod(shape)
    chosen = np.random.default_rng(seed).choice(total, min(number, total), replace=False)
    return np.sort(chosen)


def neighbours(
    point: tuple[int, ...],
    box: tuple[slice, ...],
    shape: tuple[int, ...],
    number: int,
    order: Sequence[int],
) -> np.ndarray:
    """Numbers of a point of a grid and of those that follow it in a box, round the box's end.

    Parameters
    ----------
    point
        Place along each axis.
    box, shape
        Slices of the box along each axis; points of the whole grid along each axis.
    number
        Points wanted, the first of them `point` itself; repeated where the box has fewer.
    order
        The axes, that along which points follow each other last.
    """
    if not shape:
        return np.zeros(number, np.int64)
    first = np.array([s.start for s in box])
    extent = np.array([s.stop - s.start for s in box])
    turned = list(order)
    own = np.ravel_multi_index((np.array(point) - first)[turned], extent[turned])
    places = np.unravel_index((own + np.arange(number)) % extent.prod(), extent[turned])
    along = np.empty((len(shape), number), np.int64)
    along[turned] = places
    return np.asarray(np.ravel_multi_index(tuple(along + first[:, None]), shape))
