"""Nearest triangles of bundles of rays: a tree of boxes, eight to a node, and its walk.

The hit of a ray is a property of the ray and the mesh alone: of the triangles hit the nearest
counts, and of equally near ones the first in the mesh. The order of the rays, their grouping and
the tree's shape change no bit of it.

A triangle counts as hit where the three edge functions of the sheared triangle (Woop, Benthin and
Wald, JCGT 2 (1), 2013) have no opposite signs. Each is a difference of two products that the
neighbour across the edge forms with the sign reversed, and rounding is monotone, so a difference
can round to zero but not to the wrong sign. Between triangles that share an edge or a vertex there
is no crack. This holds as long as no fused multiply-add contracts the difference, so there is no
fastmath here. The boxes are float32, rounded outwards and widened a little, so that no rounding of
that test can hit what its box missed; the triangles themselves stay float64.
"""

from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit

WIDTH = 8
"""Children of a node: one vector of float64 with AVX-512, two with AVX2."""

LEAF = 2
"""Triangles in a leaf at most; fewer than WIDTH, so that start and count share one integer."""

_SLACK = 2.0**-30
"""Widening of the boxes in units of the largest coordinate: far above what rounding moves a hit
sideways (some 1e-15 of the range, for ranges to 1e5 times the mesh's size), and below float32."""

_FAR = np.float32(3e38)
"""Begin of the empty box; it ends at minus this."""

_AT_ONCE = 1 << 20
"""Triangles whose boxes are made together."""

_STACK = 8 * 16
"""Entries that the deepest tree can leave behind: seven a level."""

_TINY = 1e-200
"""Direction components below this count as possibly zero, so that their reciprocal is finite."""

_ENTRY_SLACK = 1.0 + 1e-14
"""Above the rounding of a box's entry and exit, which is some 5e-16 of them."""

_TIE_SLACK = 1.0 + 1e-12
"""Above the rounding of a hit's distance: a box is left out only if it cannot hold a tie."""

_LARGEST_FRONT, _ENDLESS = np.array([128, 1 << 62])
"""Triangles tested against a whole bundle before its rays are better walked one by one."""


class Tree(NamedTuple):
    """Nested boxes over the triangles of one mesh, the root last."""

    bounds: np.ndarray
    """(nodes, 6, 8) float32 [m]: low x, y, z, high x, y, z of each child's box."""
    children: np.ndarray
    """(nodes, 8) int32: index of a node, or -1 - (8 start + count) for triangles of `faces`."""
    faces: np.ndarray
    """(m, 3) int32: vertices of each triangle, in the order of the leaves."""
    order: np.ndarray
    """(m,) int32: index in the mesh of each triangle of `faces`."""
    vertices: np.ndarray
    """(n, 3) float64 [m]: the mesh's vertices in the order in which `faces` first uses them."""


def build(vertices: np.ndarray, faces: np.ndarray) -> Tree:
    """Tree of a mesh: leaves along Hilbert's curve, eight neighbours to a node, level by level.

    Vertices (n, 3) float64 [m] are finite and best centred; faces (m, 3) int, m >= 1.
    """
    leaves = _in_leaves(_centres(vertices, faces))
    bounds, children = _nodes(vertices, faces, leaves)
    order = leaves[leaves < len(faces)]
    del leaves
    new_faces, by_use = _in_order_of_use(faces, order, len(vertices))
    return Tree(bounds, children, new_faces, order, vertices[by_use])


def _centres(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return twice the middles of triangles' boxes, (m, 3) float32: they only order the tree."""
    centres = np.empty((len(faces), 3), np.float32)
    for begin in range(0, len(faces), _AT_ONCE):  # the corners of all at once take much memory
        part = slice(begin, begin + _AT_ONCE)
        corners = vertices[faces[part]]
        centres[part] = corners.min(axis=1) + corners.max(axis=1)
    return centres


def _leaf_boxes(vertices: np.ndarray, faces: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """Return the boxes (low, -high) of leaves, (n, 6) float32."""
    slack = _SLACK * float(max(vertices.max(), -vertices.min()))
    boxes = np.empty((leaves.size // LEAF, 6), np.float32)
    for begin in range(0, leaves.size, _AT_ONCE):
        triangles = leaves[begin : begin + _AT_ONCE]
        is_triangle = triangles < len(faces)
        corners = vertices[faces[np.where(is_triangle, triangles, 0)]]
        of_triangles = np.empty((len(triangles), 6), np.float32)
        low, high = corners.min(axis=1) - slack, corners.max(axis=1) + slack
        of_triangles[:, :3] = np.nextafter(low.astype(np.float32), -_FAR)
        of_triangles[:, 3:] = -np.nextafter(high.astype(np.float32), _FAR)
        of_triangles[~is_triangle] = _FAR
        part = slice(begin // LEAF, (begin + _AT_ONCE) // LEAF)
        boxes[part] = of_triangles.reshape(-1, LEAF, 6).min(axis=1)
    return boxes


def _nodes(
    vertices: np.ndarray, faces: np.ndarray, leaves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds and children of all nodes, level by level above the leaves, the root last."""
    boxes = _leaf_boxes(vertices, faces, leaves)
    count = (leaves < len(faces)).reshape(-1, LEAF).sum(axis=1, dtype=np.int32)
    links = -1 - (8 * (np.cumsum(count, dtype=np.int32) - count) + count)
    numbers = [-(-len(boxes) // WIDTH)]
    while numbers[-1] > 1:
        numbers.append(-(-numbers[-1] // WIDTH))
    bounds = np.empty((sum(numbers), 6, WIDTH), np.float32)
    children = np.empty((sum(numbers), WIDTH), np.int32)
    before = 0
    for number in numbers:
        if lacking := number * WIDTH - len(boxes):  # leaves without triangles
            boxes = np.append(boxes, np.full((lacking, 6), _FAR), axis=0)
            links = np.append(links, np.full(lacking, -1, np.int32))
        wide = boxes.reshape(number, WIDTH, 6)
        level = slice(before, before + number)
        bounds[level] = wide.swapaxes(1, 2)
        np.negative(bounds[level, 3:], out=bounds[level, 3:])
        children[level] = links.reshape(number, WIDTH)
        boxes, links = wide.min(axis=1), np.arange(before, before + number, dtype=np.int32)
        before += number
    return bounds, children


def _in_leaves(centre: np.ndarray) -> np.ndarray:
    """Triangles in the order of full leaves, as many as a power of two, int32; m for none."""
    m, size = len(centre), LEAF
    while size < m:
        size *= 2
    which = (np.arange(size) * m // size).astype(np.int32)
    order = np.arange(size, dtype=np.int32)
    _halve(centre[which], order)
    which[1:][which[1:] == which[:-1]] = m  # a place too many, beside the triangle before
    return np.asarray(which[order])


@njit(cache=True, nogil=True, error_model="numpy")
def _in_order_of_use(faces, order, n_vertices):
    """Faces in an order, with vertices renumbered as they are first used; old numbers of these.

    A leaf's triangles then lie together in memory.
    """
    new_faces = np.empty((order.size, 3), np.int32)
    new, by_use = np.full(n_vertices, -1, np.int32), np.empty(n_vertices, np.int32)
    n_used = 0
    for i in range(order.size):
        for k in range(3):
            vertex = faces[order[i], k]
            if new[vertex] < 0:
                new[vertex], by_use[n_used] = n_used, vertex
                n_used += 1
            new_faces[i, k] = new[vertex]
    for vertex in range(n_vertices):
        if new[vertex] < 0:
            by_use[n_used] = vertex
            n_used += 1
    return new_faces, by_use


@njit(cache=True, nogil=True, error_model="numpy")
def _halve(points, order):
    """Sort `order` of points (n, 3) so that each half is on one side, and each half of that."""
    size = order.size
    while size > LEAF:
        for start in range(0, order.size, size):
            axis, widest = 0, -1.0
            for k in range(3):
                least = most = points[order[start], k]
                for i in range(start + 1, start + size):
                    least = min(least, points[order[i], k])
                    most = max(most, points[order[i], k])
                if most - least > widest:
                    axis, widest = k, most - least
            first, last, middle = start, start + size - 1, start + size // 2
            while first < last:  # Hoare's selection: all before the middle are no larger
                pivot = points[order[(first + last) // 2], axis]
                i, j = first, last
                while i <= j:
                    while points[order[i], axis] < pivot:
                        i += 1
                    while points[order[j], axis] > pivot:
                        j -= 1
                    if i <= j:
                        order[i], order[j] = order[j], order[i]
                        i, j = i + 1, j - 1
                if middle <= j:
                    last = j
                elif middle >= i:
                    first = i
                else:
                    break
        size //= 2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _larger(a, b):
    """Larger of two numbers: one instruction, where max() would also look for nan."""
    return a if a > b else b


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _smaller(a, b):
    """Smaller of two numbers, likewise."""
    return a if a < b else b


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(tree, origins, directions, distance, face, least_distance=0.0):
    """Nearest triangle of each ray of each bundle that lies nearer than what is known.

    A bundle, rays from one origin in neighbouring directions, walks the tree once. A box is entered
    where the interval of the directions may reach it. A leaf's triangles are tested against all
    rays together. If they spread too far, each ray walks alone.

    Origins (n, 3) [m] are in the tree's frame, directions (n, b, 3). `distance` (n, b), in lengths
    of the direction, is the nearest known before (inf: none), and is replaced where a triangle is
    nearer; so is `face` (n, b), by the triangle's index in the mesh. A ray lies at distances above
    `least_distance`, which is 0 or more: what is nearer is passed through.
    """
    room = np.empty((3, directions.shape[1])), np.empty((6, 3)), np.empty(WIDTH)
    stack = np.empty(_STACK, np.int64), np.empty(_STACK)
    for i in range(origins.shape[0]):
        o, d = origins[i], directions[i]
        limits = _LARGEST_FRONT, least_distance
        if not _walk(tree, o, d, distance[i], face[i], room, stack, limits):
            for b in range(d.shape[0]):
                one = slice(b, b + 1)
                limits = _ENDLESS, least_distance
                _walk(tree, o, d[one], distance[i, one], face[i, one], room, stack, limits)


@njit(cache=True, nogil=True, error_model="numpy")
def _walk(tree, o, d, distance, face, room, stack, limits):
    """Nearest triangles of all rays of a bundle in one walk; False where it was given up.

    Given up with all triangles tested so far accounted for, so that single walks may go on.
    `limits` are the number of triangles that may be tested, and the least distance of a hit.
    """
    bounds, children, faces, order, vertices = tree
    shears, planes, entered = room
    waiting, entry = stack
    budget, least_distance = limits
    axis = _set_up(d, shears, planes)
    if axis < 0:
        return False
    kx, ky = (axis + 1) % 3, (axis + 2) % 3
    ox, oy, oz = o[kx], o[ky], o[axis]
    waiting[0], entry[0], top = children.shape[0] - 1, 0.0, 1
    farthest, is_known = 0.0, False
    while top > 0:
        if not is_known:
            farthest, is_known = distance[0], True
            for i in range(1, distance.size):
                farthest = _larger(farthest, distance[i])
            farthest *= _TIE_SLACK
        top -= 1
        node = waiting[top]
        if entry[top] > farthest:
            continue
        if node >= 0:
            _enter(bounds, node, o[0], o[1], o[2], planes, farthest, entered)
            base = top
            for c in range(WIDTH):  # those that may be entered, the nearest last
                if entered[c] < np.inf:
                    k = top
                    while k > base and entry[k - 1] < entered[c]:
                        waiting[k], entry[k] = waiting[k - 1], entry[k - 1]
                        k -= 1
                    waiting[k], entry[k] = children[node, c], entered[c]
                    top += 1
            continue
        start, count = (-1 - node) >> 3, (-1 - node) & 7
        for j in range(start, start + count):
            p, q, r = faces[j, 0], faces[j, 1], faces[j, 2]
            _test(
                (vertices[p, kx] - ox, vertices[p, ky] - oy, vertices[p, axis] - oz),
                (vertices[q, kx] - ox, vertices[q, ky] - oy, vertices[q, axis] - oz),
                (vertices[r, kx] - ox, vertices[r, ky] - oy, vertices[r, axis] - oz),
                order[j], shears, least_distance, distance, face,
            )  # fmt: skip
        is_known = False
        budget -= count
        if budget < 0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _set_up(d, shears, planes):
    """Axis of the largest component of all directions (b, 3), -1 where they differ; what it makes.

    `shears` (3, >= b): directions over that component, the other two axes in cyclic order, and 1
    over it. `planes` (6, 3): constants of the box test across each axis for directions between
    `low` and `high` along it. The rays o + t d can reach between the box's lower and upper plane
    only if  t high >= lower - o  and  t low <= upper - o: each bounds t from below or from above,
    by the sign of its factor. They are the factors' reciprocals, and what is added to make the two
    bounds idle from below, and from above.
    """
    axis = -1
    for b in range(d.shape[0]):
        x, y, z = abs(d[b, 0]), abs(d[b, 1]), abs(d[b, 2])
        own = 0 if x >= y and x >= z else (1 if y >= z else 2)
        if b > 0 and own != axis:
            return -1
        axis = own
    for b in range(d.shape[0]):
        inverse = 1.0 / d[b, axis]
        shears[0, b] = d[b, (axis + 1) % 3] * inverse
        shears[1, b] = d[b, (axis + 2) % 3] * inverse
        shears[2, b] = inverse
    for k in range(3):
        low = high = d[0, k]
        for b in range(1, d.shape[0]):
            low, high = _smaller(low, d[b, k]), _larger(high, d[b, k])
        least = -_TINY if abs(low) < _TINY else low
        most = _TINY if abs(high) < _TINY else high
        planes[0, k], planes[1, k] = 1.0 / most, 1.0 / least
        planes[2, k] = 0.0 if most > 0.0 else -np.inf
        planes[3, k] = 0.0 if least < 0.0 else -np.inf
        planes[4, k] = 0.0 if most < 0.0 else np.inf
        planes[5, k] = 0.0 if least > 0.0 else np.inf
    return axis


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(bounds, node, ox, oy, oz, planes, limit, entry):
    """Least distance at which the rays may enter each child's box; inf where they cannot."""
    # Numbers, not an array: the compiler could not know that `entry` is no part of it.
    rx, ry, rz = planes[0, 0], planes[0, 1], planes[0, 2]
    sx, sy, sz = planes[1, 0], planes[1, 1], planes[1, 2]
    bx, by, bz = planes[2, 0], planes[2, 1], planes[2, 2]
    cx, cy, cz = planes[3, 0], planes[3, 1], planes[3, 2]
    fx, fy, fz = planes[4, 0], planes[4, 1], planes[4, 2]
    gx, gy, gz = planes[5, 0], planes[5, 1], planes[5, 2]
    for c in range(entry.size):  # a number known when compiling would not be vectorised
        x0, x1 = (bounds[node, 0, c] - ox) * rx, (bounds[node, 3, c] - ox) * sx
        y0, y1 = (bounds[node, 1, c] - oy) * ry, (bounds[node, 4, c] - oy) * sy
        z0, z1 = (bounds[node, 2, c] - oz) * rz, (bounds[node, 5, c] - oz) * sz
        near_x, far_x = _larger(x0 + bx, x1 + cx), _smaller(x0 + fx, x1 + gx)
        near_y, far_y = _larger(y0 + by, y1 + cy), _smaller(y0 + fy, y1 + gy)
        near_z, far_z = _larger(z0 + bz, z1 + cz), _smaller(z0 + fz, z1 + gz)
        near = _larger(_larger(near_x, near_y), _larger(near_z, 0.0))
        far = _smaller(_smaller(far_x, far_y), far_z) * _ENTRY_SLACK
        entry[c] = near if near <= _smaller(far, limit) else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _test(a, b, c, index, shears, least_distance, distance, face):
    """Test one triangle against all rays of a bundle; keeps the nearer hits.

    A hit's distance is a weighted mean of the corners' depths: between them, however flat the
    ray lies.
    """
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    for i in range(distance.size):
        sx, sy, inverse = shears[0, i], shears[1, i], shears[2, i]
        pax, pay = ax - sx * az, ay - sy * az
        pbx, pby = bx - sx * bz, by - sy * bz
        pcx, pcy = cx - sx * cz, cy - sy * cz
        u = pcx * pby - pcy * pbx
        v = pax * pcy - pay * pcx
        w = pbx * pay - pby * pax
        least = _smaller(u, _smaller(v, w))
        most = _larger(u, _larger(v, w))
        t = (u * az + v * bz + w * cz) / (u + v + w) * inverse
        t = t if ((least >= 0.0) | (most <= 0.0)) & (t > least_distance) else np.inf
        closer = (t < distance[i]) | ((t == distance[i]) & (index < face[i]))
        distance[i] = t if closer else distance[i]
        face[i] = index if closer else face[i]
