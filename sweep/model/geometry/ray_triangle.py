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
    """Distance of the hit, inf where there is none; and whether it is off all edges.

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
    return t if inside & (t > 0.0) else np.inf, (least > 0.0) | (most < 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def check_guesses(vertices, faces, guess, origins, directions, distance, face):
    """Accept guessed triangles (n,) that the ray hits off all edges; the rays left to walk.

    Parameters
    ----------
    vertices, faces
        The mesh's.
    guess : (n,) int
        Triangle that each ray may hit nearest, -1 for none.
    origins, directions, distance, face
        As in :func:`sweep.model.geometry.bvh_traversal.nearest_of_rays`.

    Returns
    -------
    (k,) int64
        Rays without a guess, or for which it is not hit or hit on an edge, where another may tie.
    """
    pending = np.empty(guess.size, dtype=np.int64)
    number = 0
    for i in range(guess.size):
        j = guess[i]
        t, is_off_edges = np.inf, False
        if j >= 0:
            o, d = origins[i], directions[i]
            kx, ky, kz = axes(d)
            ax, ay, az = moved(vertices, faces[j, 0], o, kx, ky, kz)
            bx, by, bz = moved(vertices, faces[j, 1], o, kx, ky, kz)
            cx, cy, cz = moved(vertices, faces[j, 2], o, kx, ky, kz)
            inverse = 1.0 / d[kz]
            t, is_off_edges = sheared_hit(
                ax, ay, az, bx, by, bz, cx, cy, cz, d[kx] * inverse, d[ky] * inverse, inverse
            )
        if not (is_off_edges and t < np.inf):
            pending[number] = i
            number += 1
        elif t < distance[i]:
            distance[i], face[i] = t, j
    return pending[:number]
