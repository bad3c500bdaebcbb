"""Whether a ray hits a triangle, without cracks between neighbours, in float64.

A triangle counts as hit where the three edge functions of the sheared triangle (Woop, Benthin
and Wald, JCGT 2 (1), 2013) have no opposite signs. Each is a difference of two products that the
neighbour across the edge forms with the sign reversed, and rounding is monotone, so a difference
can round to zero but not to the wrong sign: between triangles that share an edge or a vertex
there is no crack. This holds as long as no fused multiply-add contracts the difference, so there
is no fastmath here.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def larger(a, b):
    """Larger of two numbers: one instruction, where max() would also look for nan."""
    return a if a > b else b


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def smaller(a, b):
    """Smaller of two numbers, likewise."""
    return a if a < b else b


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def axes(d):
    """The three axes of space in cyclic order, the one of the largest component last."""
    x, y, z = abs(d[0]), abs(d[1]), abs(d[2])
    if x >= y and x >= z:
        return 1, 2, 0
    if y >= z:
        return 2, 0, 1
    return 0, 1, 2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def moved(vertices, v, o, kx, ky, kz):
    """Vertex relative to the ray's origin, the dominant axis last."""
    return vertices[v, kx] - o[kx], vertices[v, ky] - o[ky], vertices[v, kz] - o[kz]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def sheared_hit(ax, ay, az, bx, by, bz, cx, cy, cz, sx, sy, inverse):
    """Distance of the hit, inf where there is none.

    A weighted mean of the corners' depths: between them, however flat the ray lies.
    """
    pax, pay = ax - sx * az, ay - sy * az
    pbx, pby = bx - sx * bz, by - sy * bz
    pcx, pcy = cx - sx * cz, cy - sy * cz
    u = pcx * pby - pcy * pbx
    v = pax * pcy - pay * pcx
    w = pbx * pay - pby * pax
    least = smaller(u, smaller(v, w))
    most = larger(u, larger(v, w))
    t = (u * az + v * bz + w * cz) / (u + v + w) * inverse
    inside = (least >= 0.0) | (most <= 0.0)
    return t if inside & (t > 0.0) else np.inf
