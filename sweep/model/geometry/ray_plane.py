"""Range of a facet's plane along a ray in twice float64's precision, and the frames of bodies.

A micrometre of wavelength at kilometres of range asks for the last bits of float64, and grazing
incidence divides them away. So the facet's normal, the ray's origin relative to a corner and
their products are carried as two float64 each (high + low, Dekker's and Knuth's exact sums and
products); what remains is the rounding of the range itself, half a unit in its last place.

Beamlets' ranges relative to another ray's are differences of such pairs, or, on one facet, the
equivalent  t_b - t_0 = -t_0 n.delta / (n.d_b),  delta = d_b - d_0, which subtracts nothing.
"""

import numpy as np
from numba import njit

from sweep.model.elementary import fma


@njit(cache=True, nogil=True, error_model="numpy")
def _two_sum(a, b):
    """Sum and what its rounding left."""
    s = a + b
    part = s - a
    return s, (a - (s - part)) + (b - part)


@njit(cache=True, nogil=True, error_model="numpy")
def _quick_two_sum(a, b):
    """Sum and what its rounding left, for abs(a) >= abs(b)."""
    s = a + b
    return s, b - (s - a)


@njit(cache=True, nogil=True, error_model="numpy")
def _product(ah, al, bh, bl):
    """Product of two pairs."""
    p = ah * bh
    return _quick_two_sum(p, fma(ah, bh, -p) + (ah * bl + al * bh))


@njit(cache=True, nogil=True, error_model="numpy")
def _sum(ah, al, bh, bl):
    """Sum of two pairs, accurate also where the high parts cancel."""
    s, e = _two_sum(ah, bh)
    t, f = _two_sum(al, bl)
    s, e = _quick_two_sum(s, e + t)
    return _quick_two_sum(s, e + f)


@njit(cache=True, nogil=True, error_model="numpy")
def _minor(ah, al, bh, bl, ch, cl, dh, dl):
    """Difference a b - c d of pairs: one component of a cross product."""
    ph, pl = _product(ah, al, bh, bl)
    qh, ql = _product(ch, cl, dh, dl)
    return _sum(ph, pl, -qh, -ql)


@njit(cache=True, nogil=True, error_model="numpy")
def _dot(a, b):
    """Scalar product of two vectors of pairs (xh, xl, yh, yl, zh, zl)."""
    xh, xl = _product(a[0], a[1], b[0], b[1])
    yh, yl = _product(a[2], a[3], b[2], b[3])
    zh, zl = _product(a[4], a[5], b[4], b[5])
    sh, sl = _sum(xh, xl, yh, yl)
    return _sum(sh, sl, zh, zl)


@njit(cache=True, nogil=True, error_model="numpy")
def _less(a, b):
    """Difference of two vectors of pairs."""
    xh, xl = _sum(a[0], a[1], -b[0], -b[1])
    yh, yl = _sum(a[2], a[3], -b[2], -b[3])
    zh, zl = _sum(a[4], a[5], -b[4], -b[5])
    return xh, xl, yh, yl, zh, zl


@njit(cache=True, nogil=True, error_model="numpy")
def _vertex(vertices, v):
    """A vertex as a vector of pairs."""
    return vertices[v, 0], 0.0, vertices[v, 1], 0.0, vertices[v, 2], 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def facet_normal(vertices, faces, face):
    """Normal of a facet as a vector of pairs, of twice its area's length, by its winding."""
    a = _vertex(vertices, faces[face, 0])
    b = _less(_vertex(vertices, faces[face, 1]), a)
    c = _less(_vertex(vertices, faces[face, 2]), a)
    xh, xl = _minor(b[2], b[3], c[4], c[5], b[4], b[5], c[2], c[3])
    yh, yl = _minor(b[4], b[5], c[0], c[1], b[0], b[1], c[4], c[5])
    zh, zl = _minor(b[0], b[1], c[2], c[3], b[2], b[3], c[0], c[1])
    return xh, xl, yh, yl, zh, zl


@njit(cache=True, nogil=True, error_model="numpy")
def plane_height(vertices, faces, face, normal, o):
    """Product (high, low) of a facet's normal with a corner less the origin `o`."""
    return _dot(normal, _less(_vertex(vertices, faces[face, 0]), o))


@njit(cache=True, nogil=True, error_model="numpy")
def plane_distance(vertices, faces, face, normal, height, o, d):
    """Distance (high, low) of a facet's plane along a ray of pairs, in lengths of `d`.

    `height` is :func:`plane_height`, which all rays from one origin share.
    A plane seen so flatly that it runs through the facet within rounding is met somewhere
    on the facet: the distance stays between those of its corners.
    """
    nh, nl = height
    dh, dl = _dot(normal, d)
    high = nh / dh
    p, e = _product(high, 0.0, dh, dl)
    rest, low = _sum(nh, nl, -p, -e)
    high, low = _quick_two_sum(high, (rest + low) / dh)
    size = abs(normal[0]) + abs(normal[2]) + abs(normal[4])
    if abs(dh) > 1e-6 * size:
        return high, low
    nearest, farthest = _reach(vertices, faces, face, o, d)
    if high >= nearest and high <= farthest:
        return high, low
    return (nearest if high < nearest else farthest), 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _reach(vertices, faces, face, o, d):
    """Least and largest distance of a facet's corners along a ray."""
    nearest, farthest = np.inf, -np.inf
    for k in range(3):
        a = _less(_vertex(vertices, faces[face, k]), o)
        t = (a[0] * d[0] + a[2] * d[2] + a[4] * d[4]) / (d[0] ** 2 + d[2] ** 2 + d[4] ** 2)
        nearest, farthest = min(nearest, t), max(farthest, t)
    return nearest, farthest


@njit(cache=True, nogil=True, error_model="numpy")
def body_origin(origins, i, shift, rotation, position, p, anchor, fixed):
    """Origin of ray `i` in a mesh's frame, as a vector of pairs.

    Parameters
    ----------
    origins : (n, 3) float64
        Origins [m], relative to `shift`.
    shift : (3,) float64
        What is added to `origins` to give world coordinates [m].
    rotation, position : (k, 3, 3), (k, 3) float64
        Poses x_world = rotation x_body + position, of which `p` holds; idle where `fixed`.
    anchor : (3,) float64
        The mesh's own origin in the body's frame [m].
    fixed : bool
        The body's frame is the world's.
    """
    if fixed:
        xh, xl = _moved(origins[i, 0], shift[0], anchor[0])
        yh, yl = _moved(origins[i, 1], shift[1], anchor[1])
        zh, zl = _moved(origins[i, 2], shift[2], anchor[2])
        return xh, xl, yh, yl, zh, zl
    xh, xl = _moved(origins[i, 0], shift[0], position[p, 0])
    yh, yl = _moved(origins[i, 1], shift[1], position[p, 1])
    zh, zl = _moved(origins[i, 2], shift[2], position[p, 2])
    at = (anchor[0], 0.0, anchor[1], 0.0, anchor[2], 0.0)
    return _less(turned_back((xh, xl, yh, yl, zh, zl), rotation, p), at)


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(x, shift, away):
    """Pair x + shift - away."""
    high, low = _two_sum(shift, -away)
    return _sum(x, 0.0, high, low)


@njit(cache=True, nogil=True, error_model="numpy")
def turned_back(v, r, p):
    """Transpose of rotation matrix `p` of r (k, 3, 3) times a vector of pairs."""
    xh, xl = _dot(v, (r[p, 0, 0], 0.0, r[p, 1, 0], 0.0, r[p, 2, 0], 0.0))
    yh, yl = _dot(v, (r[p, 0, 1], 0.0, r[p, 1, 1], 0.0, r[p, 2, 1], 0.0))
    zh, zl = _dot(v, (r[p, 0, 2], 0.0, r[p, 1, 2], 0.0, r[p, 2, 2], 0.0))
    return xh, xl, yh, yl, zh, zl


@njit(cache=True, nogil=True, error_model="numpy")
def areas_vanish(vertices, faces):
    """Whether each face (m, 3) has no area: a corner repeated, or three in one line."""
    result = np.empty(faces.shape[0], dtype=np.bool_)
    for i in range(faces.shape[0]):
        n = facet_normal(vertices, faces, i)
        result[i] = n[0] == 0.0 and n[2] == 0.0 and n[4] == 0.0
    return result
