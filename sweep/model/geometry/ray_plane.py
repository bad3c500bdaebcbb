"""Range of a facet's plane along a ray in twice float64's precision.

A micrometre of wavelength at kilometres of range asks for the last bits of float64, and grazing
incidence divides them away. So the facet's normal, the ray's origin relative to a corner and
their products are carried as two float64 each (high + low, Dekker's and Knuth's exact sums and
products); what remains is the rounding of the range itself, half a unit in its last place.

A pair is a tuple of two arrays. Vectors have their three components along the first axis.
"""

import numpy as np

Pair = tuple[np.ndarray, np.ndarray]

_HALVES = 2.0**27 + 1
"""Factor that parts a float64 into two of half as many digits."""

_FLAT = 1e-6
"""Sine of the angle to a facet under which its plane may run through it within rounding."""


def exact(values: np.ndarray) -> Pair:
    """Pair of numbers that float64 holds."""
    return values, np.zeros_like(values)


def _two_sum(a: np.ndarray, b: np.ndarray) -> Pair:
    """Sum and what its rounding left."""
    s = a + b
    part = s - a
    return s, (a - (s - part)) + (b - part)


def _quick_two_sum(a: np.ndarray, b: np.ndarray) -> Pair:
    """Sum and what its rounding left, for abs(a) >= abs(b)."""
    s = a + b
    return s, b - (s - a)


def _halves(a: np.ndarray) -> Pair:
    wide = a * _HALVES
    high = wide - (wide - a)
    return high, a - high


def product(a: Pair, b: Pair) -> Pair:
    """Product of two pairs."""
    p = a[0] * b[0]
    (ah, al), (bh, bl) = _halves(a[0]), _halves(b[0])
    rest = ((ah * bh - p) + ah * bl + al * bh) + al * bl
    return _quick_two_sum(p, rest + (a[0] * b[1] + a[1] * b[0]))


def add(a: Pair, b: Pair) -> Pair:
    """Sum of two pairs, accurate also where the high parts cancel."""
    s, e = _two_sum(a[0], b[0])
    t, f = _two_sum(a[1], b[1])
    s, e = _quick_two_sum(s, e + t)
    return _quick_two_sum(s, e + f)


def less(a: Pair, b: Pair) -> Pair:
    """Difference of two pairs."""
    return add(a, (-b[0], -b[1]))


def dot(a: Pair, b: Pair) -> Pair:
    """Scalar product of two vectors; of a vector (3, 1, n) and a matrix (3, 3, n), a vector."""
    x, y, z = zip(*product(a, b), strict=True)
    return add(add(x, y), z)


def _cross(a: Pair, b: Pair) -> Pair:
    """Vector product."""
    (ay, az), (by, bz) = (
        [(v[0][turn], v[1][turn]) for turn in ([1, 2, 0], [2, 0, 1])] for v in (a, b)
    )
    return less(product(ay, bz), product(az, by))


def normals(corners: np.ndarray) -> Pair:
    """Normals (3, n) of facets, of twice their areas' lengths, by their winding.

    Parameters
    ----------
    corners : (3, 3, n) float64
        First, second and third corner; their x, y, z.
    """
    a, b, c = (exact(corner) for corner in corners)
    return _cross(less(b, a), less(c, a))


def distances(corners: np.ndarray, normal: Pair, height: Pair, o: Pair, d: Pair) -> Pair:
    """Distances of facets' planes along rays, in lengths of `d`.

    A plane seen so flatly that it runs through the facet within rounding is met somewhere
    on the facet: the distance stays between those of its corners.

    Parameters
    ----------
    corners, normal
        As of :func:`normals`.
    height : Pair
        Products (n,) of the normals with a corner less the origin.
    o, d : Pair
        Origins and directions (3, n) of the rays.
    """
    along = dot(normal, d)
    with np.errstate(all="ignore"):  # parallel to a plane
        high = height[0] / along[0]
        rest, low = less(height, product(exact(high), along))
        high, low = _quick_two_sum(high, (rest + low) / along[0])
    x, y, z = np.abs(normal[0])
    flat = np.flatnonzero(~(np.abs(along[0]) > _FLAT * (x + y + z)))
    if flat.size:
        origin, ray = (o[0][:, flat], o[1][:, flat]), d[0][:, flat]
        length = ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2
        reach = []
        for corner in corners[:, :, flat]:
            x, y, z = less(exact(corner), origin)[0] * ray
            reach.append((x + y + z) / length)
        nearest, farthest = np.min(reach, axis=0), np.max(reach, axis=0)
        outside = ~((high[flat] >= nearest) & (high[flat] <= farthest))
        low[flat[outside]] = 0.0
        high[flat] = np.where(
            outside, np.where(high[flat] < nearest, nearest, farthest), high[flat]
        )
    return high, low
