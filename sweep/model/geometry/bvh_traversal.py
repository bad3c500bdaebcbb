"""Nearest triangles of rays and of bundles of rays, in float64, by walking the hierarchy.

What a ray hits is a property of the ray and the mesh alone: of the triangles hit
(:mod:`sweep.model.geometry.ray_triangle`) the nearest counts, and of equally near ones the first
in the mesh. The order of the rays, their grouping and the tree's shape change no bit of it.

A bundle, rays from one origin in neighbouring directions, walks the tree once: a box is entered
where the interval of the directions may reach it, and a leaf's triangles are tested against all
rays together.
"""

import numpy as np
from numba import njit

from sweep.model.geometry.bvh import WIDTH
from sweep.model.geometry.ray_triangle import axes, larger, moved, sheared_hit, smaller

_STACK = 8 * 64
"""Entries that the deepest tree can leave behind: seven a level."""

_TINY = 1e-200
"""Direction components below this count as possibly zero, so that their reciprocal is finite."""

_SLACK = 1.0 + 1e-14
"""Above the rounding of a box's entry and exit, which is some 5e-16 of them."""

_TIE_SLACK = 1.0 + 1e-12
"""Above the rounding of a hit's distance: a box is left out only if it cannot hold a tie."""

_LARGEST_FRONT = 128
"""Triangles tested against a whole bundle before its rays are better walked one by one."""


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_of_rays(tree, origins, directions, distance, face):
    """Nearest triangle of each ray that lies nearer than what is known.

    Parameters
    ----------
    tree : Tree
    origins, directions : (n, 3) float64
        In the tree's frame [m], [1]. A ray is what lies at distance > 0.
    distance : (n,) float64
        Nearest distance known before (inf: none), in lengths of the direction; replaced where a
        triangle is nearer.
    face : (n,) int64
        Triangle's index in the mesh where `distance` was replaced, else left as it is.
    """
    stack, entry, entered = _workspace()
    ray = np.empty((2, 3))
    for i in range(origins.shape[0]):
        for k in range(3):
            ray[0, k] = origins[i, k]
            ray[1, k] = directions[i, k]
        distance[i], face[i] = _walk_ray(tree, ray, distance[i], face[i], stack, entry, entered)


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_of_bundles(tree, origins, directions, distance, face):
    """Nearest triangle of each ray of each bundle: what `nearest_of_rays` gives, bit for bit.

    Parameters
    ----------
    tree : Tree
    origins : (n, 3) float64
    directions : (n, b, 3) float64
    distance, face : (n, b)
        As in `nearest_of_rays`.
    """
    stack, entry, entered = _workspace()
    shears = np.empty((3, directions.shape[1]))
    ray = np.empty((2, 3))
    for i in range(origins.shape[0]):
        axis = _common_axis(directions, i)
        if axis < 0 or not _walk_bundle(
            tree, origins, directions, i, axis, distance[i], face[i],
            shears, stack, entry, entered,
        ):  # fmt: skip
            for b in range(directions.shape[1]):
                for k in range(3):
                    ray[0, k] = origins[i, k]
                    ray[1, k] = directions[i, b, k]
                distance[i, b], face[i, b] = _walk_ray(
                    tree, ray, distance[i, b], face[i, b], stack, entry, entered
                )


@njit(cache=True, nogil=True)
def _workspace():
    """The stack's nodes and entries; a node's children's entries."""
    return np.empty(_STACK, dtype=np.int64), np.empty(_STACK), np.empty(WIDTH)


@njit(cache=True, nogil=True, error_model="numpy")
def _planes(low, high):
    """Constants of the box test across one axis for directions between `low` and `high` along it.

    The rays o + t d with low <= d <= high can reach between the box's lower and upper plane
    only if  t high >= lower - o  and  t low <= upper - o: each bounds t from below or from above,
    by the sign of its factor. The factors' reciprocals, and what is added to make the two bounds
    idle from below, and from above.
    """
    least = -_TINY if abs(low) < _TINY else low
    most = _TINY if abs(high) < _TINY else high
    return (
        1.0 / most,
        1.0 / least,
        0.0 if most > 0.0 else -np.inf,
        0.0 if least < 0.0 else -np.inf,
        0.0 if most < 0.0 else np.inf,
        0.0 if least > 0.0 else np.inf,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(bounds, node, ox, oy, oz, planes, limit, entry):
    """Least distance at which the rays may enter each child's box; inf where they cannot."""
    # Numbers, not an array: the compiler could not know that `entry` is no part of it.
    rx, sx, bx, cx, fx, gx = planes[0]
    ry, sy, by, cy, fy, gy = planes[1]
    rz, sz, bz, cz, fz, gz = planes[2]
    for c in range(entry.size):  # a number known when compiling would not be vectorised
        x0, x1 = (bounds[node, 0, c] - ox) * rx, (bounds[node, 3, c] - ox) * sx
        y0, y1 = (bounds[node, 1, c] - oy) * ry, (bounds[node, 4, c] - oy) * sy
        z0, z1 = (bounds[node, 2, c] - oz) * rz, (bounds[node, 5, c] - oz) * sz
        near_x, far_x = larger(x0 + bx, x1 + cx), smaller(x0 + fx, x1 + gx)
        near_y, far_y = larger(y0 + by, y1 + cy), smaller(y0 + fy, y1 + gy)
        near_z, far_z = larger(z0 + bz, z1 + cz), smaller(z0 + fz, z1 + gz)
        near = larger(larger(near_x, near_y), larger(near_z, 0.0))
        far = smaller(smaller(far_x, far_y), far_z) * _SLACK
        entry[c] = near if near <= smaller(far, limit) else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _push(children, node, number, entered, stack, entry, top):
    """Push the children that may be entered, the nearest last; the stack's new height."""
    base = top
    for c in range(number[node]):
        near = entered[c]
        if near < np.inf:
            k = top
            while k > base and entry[k - 1] < near:
                stack[k] = stack[k - 1]
                entry[k] = entry[k - 1]
                k -= 1
            stack[k] = children[node, c]
            entry[k] = near
            top += 1
    return top


@njit(cache=True, nogil=True, error_model="numpy")
def _walk_ray(tree, ray, distance, face, stack, entry, entered):
    """(distance, face) of the nearest triangle; what was known where none is nearer."""
    bounds, children, number, faces, order, vertices = tree
    o, d = ray[0], ray[1]
    planes = _planes(d[0], d[0]), _planes(d[1], d[1]), _planes(d[2], d[2])
    kx, ky, kz = axes(d)
    inverse = 1.0 / d[kz]
    sx, sy = d[kx] * inverse, d[ky] * inverse
    stack[0], entry[0] = 0, 0.0
    top = 1
    while top > 0:
        top -= 1
        if entry[top] > distance * _TIE_SLACK:
            continue
        node = stack[top]
        if node >= 0:
            _enter(bounds, node, o[0], o[1], o[2], planes, distance * _TIE_SLACK, entered)
            top = _push(children, node, number, entered, stack, entry, top)
        else:
            start, count = (-1 - node) >> 3, (-1 - node) & 7
            for j in range(start, start + count):
                ax, ay, az = moved(vertices, faces[j, 0], o, kx, ky, kz)
                bx, by, bz = moved(vertices, faces[j, 1], o, kx, ky, kz)
                cx, cy, cz = moved(vertices, faces[j, 2], o, kx, ky, kz)
                t = sheared_hit(ax, ay, az, bx, by, bz, cx, cy, cz, sx, sy, inverse)
                if t < distance or (t == distance and order[j] < face):
                    distance, face = t, np.int64(order[j])
    return distance, face


@njit(cache=True, nogil=True, error_model="numpy")
def _common_axis(directions, i):
    """Dominant axis of all rays of bundle `i`, or -1 where they differ."""
    axis = axes(directions[i, 0])[2]
    for b in range(1, directions.shape[1]):
        if axes(directions[i, b])[2] != axis:
            return -1
    return axis


@njit(cache=True, nogil=True, error_model="numpy")
def _walk_bundle(tree, origins, directions, i, axis, distance, face, shears, stack, entry, entered):
    """Nearest triangles of all rays of bundle `i` in one walk; False where it was given up.

    Given up with all triangles tested so far accounted for, so that single walks may go on.
    """
    bounds, children, number, faces, order, vertices = tree
    o = origins[i]
    kx, ky = (axis + 1) % 3, (axis + 2) % 3
    _set_shears(directions, i, kx, ky, axis, shears)
    planes = (
        _common_planes(directions, i, 0),
        _common_planes(directions, i, 1),
        _common_planes(directions, i, 2),
    )
    budget = _LARGEST_FRONT
    farthest = distance.max() * _TIE_SLACK
    stack[0], entry[0] = 0, 0.0
    top = 1
    while top > 0:
        top -= 1
        if entry[top] > farthest:
            continue
        node = stack[top]
        if node >= 0:
            _enter(bounds, node, o[0], o[1], o[2], planes, farthest, entered)
            top = _push(children, node, number, entered, stack, entry, top)
        else:
            start, count = (-1 - node) >> 3, (-1 - node) & 7
            for j in range(start, start + count):
                _test_bundle(
                    moved(vertices, faces[j, 0], o, kx, ky, axis),
                    moved(vertices, faces[j, 1], o, kx, ky, axis),
                    moved(vertices, faces[j, 2], o, kx, ky, axis),
                    order[j], shears, distance, face,
                )  # fmt: skip
            budget -= count
            farthest = distance.max() * _TIE_SLACK
            if budget < 0:
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _set_shears(directions, i, kx, ky, kz, shears):
    """Shears of the rays of bundle `i`."""
    for b in range(directions.shape[1]):
        inverse = 1.0 / directions[i, b, kz]
        shears[0, b] = directions[i, b, kx] * inverse
        shears[1, b] = directions[i, b, ky] * inverse
        shears[2, b] = inverse


@njit(cache=True, nogil=True, error_model="numpy")
def _common_planes(directions, i, k):
    """Constants of the box test across axis `k` for all rays of bundle `i`."""
    low = high = directions[i, 0, k]
    for b in range(1, directions.shape[1]):
        low = smaller(low, directions[i, b, k])
        high = larger(high, directions[i, b, k])
    return _planes(low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _test_bundle(a, b, c, index, shears, distance, face):
    """Test one triangle against all rays of a bundle; keeps the nearer hits."""
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    for i in range(distance.size):
        t = sheared_hit(
            ax, ay, az, bx, by, bz, cx, cy, cz, shears[0, i], shears[1, i], shears[2, i]
        )
        closer = (t < distance[i]) | ((t == distance[i]) & (index < face[i]))
        distance[i] = t if closer else distance[i]
        face[i] = index if closer else face[i]
