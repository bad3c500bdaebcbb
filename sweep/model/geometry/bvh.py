"""Bounding volume hierarchy: triangles sorted into nested boxes, eight to a node.

The boxes are float32, rounded outwards and widened a little, so that no rounding of a ray's test
against a triangle can hit what its box missed; the triangles themselves stay float64. The build
(surface area heuristic over bins of the centroids) uses no threads and no randomness: the same
mesh gives the same tree on any machine. Traversal is in
:mod:`sweep.model.geometry.bvh_traversal`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

WIDTH = 8
"""Children of a node: one vector of float64 with AVX-512, two with AVX2."""

LARGEST_LEAF = 4
"""Triangles in a leaf at most; fewer than WIDTH, so that start and count share one integer."""

_BINS = 16
_SLACK = 2.0**-30
"""Widening of the boxes in units of the largest coordinate: far above what rounding moves a hit
sideways (some 1e-15 of the range, for ranges to 1e5 times the mesh's size), and below float32."""


class Tree(NamedTuple):
    """Wide bounding volume hierarchy over the triangles of one mesh."""

    bounds: np.ndarray
    """(nodes, 6, 8) float32 [m]: low x, y, z, high x, y, z of each child's box."""
    children: np.ndarray
    """(nodes, 8) int32: index of a node, or -1 - (8 start + count) for triangles of `faces`."""
    number: np.ndarray
    """(nodes,) int32: children of the node, 1..8."""
    faces: np.ndarray
    """(m, 3) int32: vertices of each triangle, in the order of the leaves."""
    order: np.ndarray
    """(m,) int32: index in the mesh of each triangle of `faces`."""
    vertices: np.ndarray
    """(n, 3) float64 [m]: the mesh's vertices in the order in which `faces` first uses them."""


def build(vertices: np.ndarray, faces: np.ndarray) -> Tree:
    """Bounding volume hierarchy of a mesh.

    Parameters
    ----------
    vertices : (n, 3) float64
        Coordinates [m], finite, within float32's range; best centred.
    faces : (m, 3) int
        Vertices of each triangle, m >= 1.

    Raises
    ------
    ValueError
        There is no triangle.
    """
    if len(faces) == 0:
        raise ValueError("a mesh without triangles has no hierarchy: no ray could hit it")
    slack = _SLACK * float(np.abs(vertices).max())
    boxes = _triangle_boxes(vertices, faces, slack)
    order = np.arange(len(faces), dtype=np.int32)
    bounds, children, number = _build_nodes(boxes, order)
    leaf_vertices, leaf_faces = _in_order_of_use(vertices, faces, order)
    return Tree(bounds, children, number, leaf_faces, order, leaf_vertices)


def _in_order_of_use(
    vertices: np.ndarray, faces: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces renumbered so that a leaf's triangles lie together in memory."""
    leaf_faces = np.ascontiguousarray(faces[order], dtype=np.int32)
    kept = _renumber(leaf_faces, len(vertices))
    return np.ascontiguousarray(vertices[kept], dtype=np.float64), leaf_faces


@njit(cache=True, nogil=True)
def _renumber(faces, n_vertices):
    """Vertices in the order of first use; `faces` is rewritten to index them."""
    new = np.full(n_vertices, -1, dtype=np.int32)
    kept = np.empty(n_vertices, dtype=np.int32)
    used = 0
    for i in range(faces.shape[0]):
        for k in range(3):
            old = faces[i, k]
            if new[old] < 0:
                new[old] = used
                kept[used] = old
                used += 1
            faces[i, k] = new[old]
    return kept[:used]


@njit(cache=True, nogil=True, error_model="numpy")
def _triangle_boxes(vertices, faces, slack):
    """Boxes (m, 6) of the triangles, float32, widened by `slack` and rounded outwards."""
    boxes = np.empty((faces.shape[0], 6), dtype=np.float32)
    below, above = np.float32(-np.inf), np.float32(np.inf)
    for i in range(faces.shape[0]):
        for k in range(3):
            a, b, c = vertices[faces[i, 0], k], vertices[faces[i, 1], k], vertices[faces[i, 2], k]
            boxes[i, k] = np.nextafter(np.float32(min(a, b, c) - slack), below)
            boxes[i, k + 3] = np.nextafter(np.float32(max(a, b, c) + slack), above)
    return boxes


@njit(cache=True, nogil=True, error_model="numpy")
def _build_nodes(boxes, order):
    """Nodes over all triangles, the root first; sorts `order` into leaves."""
    most = max(1, boxes.shape[0])
    bounds = np.empty((most, 6, WIDTH), dtype=np.float32)
    children = np.full((most, WIDTH), -1, dtype=np.int32)
    number = np.zeros(most, dtype=np.int32)
    starts, ends = np.empty(WIDTH, dtype=np.int64), np.empty(WIDTH, dtype=np.int64)
    box = np.empty((WIDTH, 6), dtype=np.float32)
    stack = [(0, 0, boxes.shape[0])]
    used = 1
    while len(stack) > 0:
        node, start, end = stack.pop()
        n = _divide(boxes, order, start, end, starts, ends, box)
        number[node] = n
        for c in range(n):
            for k in range(6):
                bounds[node, k, c] = box[c, k]
            count = ends[c] - starts[c]
            if count <= LARGEST_LEAF:
                children[node, c] = -1 - (8 * starts[c] + count)
            else:
                children[node, c] = used
                stack.append((used, starts[c], ends[c]))
                used += 1
        for c in range(n, WIDTH):
            for k in range(3):
                bounds[node, k, c] = 3e38
                bounds[node, k + 3, c] = -3e38
    return bounds[:used].copy(), children[:used].copy(), number[:used].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _divide(boxes, order, start, end, starts, ends, box):
    """Up to WIDTH ranges of triangles, the largest box split first; the number of ranges."""
    starts[0], ends[0] = start, end
    _enclose(boxes, order, start, end, box[0])
    n = 1
    while n < WIDTH:
        largest, area = -1, np.float32(-1.0)
        for c in range(n):
            if ends[c] - starts[c] > LARGEST_LEAF and _half_area(box[c]) > area:
                largest, area = c, _half_area(box[c])
        if largest < 0:
            break
        middle = _split(boxes, order, starts[largest], ends[largest])
        starts[n], ends[n] = middle, ends[largest]
        ends[largest] = middle
        _enclose(boxes, order, starts[largest], middle, box[largest])
        _enclose(boxes, order, middle, ends[n], box[n])
        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _enclose(boxes, order, start, end, result):
    """Smallest box around a range of triangles."""
    _empty(result)
    for i in range(start, end):
        _widen(result, boxes[order[i]])


@njit(cache=True, nogil=True, error_model="numpy")
def _empty(box):
    for k in range(3):
        box[k] = np.float32(np.inf)
        box[k + 3] = np.float32(-np.inf)


@njit(cache=True, nogil=True, error_model="numpy")
def _widen(box, other):
    for k in range(3):
        box[k] = min(box[k], other[k])
        box[k + 3] = max(box[k + 3], other[k + 3])


@njit(cache=True, nogil=True, error_model="numpy")
def _half_area(box):
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@njit(cache=True, nogil=True, error_model="numpy")
def _split(boxes, order, start, end):
    """Where the range is best divided; sorts `order` about it, each half non-empty."""
    low, scale = np.empty(3), np.empty(3)
    for k in range(3):
        least, most = np.inf, -np.inf
        for i in range(start, end):
            centre = _centre(boxes, order[i], k)
            least, most = min(least, centre), max(most, centre)
        low[k] = least
        scale[k] = _BINS * (1.0 - 1e-6) / (most - least) if most > least else 0.0
    axis, cut = _cheapest_cut(boxes, order, start, end, low, scale)
    if axis < 0:
        return (start + end) // 2
    i, j = start, end - 1
    while i <= j:
        if int((_centre(boxes, order[i], axis) - low[axis]) * scale[axis]) < cut:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@njit(cache=True, nogil=True, error_model="numpy")
def _centre(boxes, i, k):
    return 0.5 * (np.float64(boxes[i, k]) + np.float64(boxes[i, k + 3]))


@njit(cache=True, nogil=True, error_model="numpy")
def _cheapest_cut(boxes, order, start, end, low, scale):
    """Axis and bin before which to cut; axis -1 where all centroids coincide."""
    count = np.zeros((3, _BINS), dtype=np.int64)
    box = np.empty((3, _BINS, 6), dtype=np.float32)
    for k in range(3):
        for b in range(_BINS):
            _empty(box[k, b])
    for i in range(start, end):
        p = order[i]
        for k in range(3):
            b = int((_centre(boxes, p, k) - low[k]) * scale[k])
            count[k, b] += 1
            _widen(box[k, b], boxes[p])
    best_axis, best_cut, best_cost = -1, 0, np.inf
    above = np.empty(_BINS)
    for k in range(3):
        if scale[k] > 0.0:
            _costs(count[k, ::-1], box[k, ::-1], above)
            below_costs = np.empty(_BINS)
            _costs(count[k], box[k], below_costs)
            for cut in range(1, _BINS):
                cost = below_costs[cut - 1] + above[_BINS - 1 - cut]
                if cost < best_cost:
                    best_axis, best_cut, best_cost = k, cut, cost
    return best_axis, best_cut


@njit(cache=True, nogil=True, error_model="numpy")
def _costs(count, box, costs):
    """Triangles times half area of bins 0..b, for each b; inf while there is no triangle."""
    total = 0
    around = np.empty(6, dtype=np.float32)
    _empty(around)
    for b in range(_BINS):
        total += count[b]
        if count[b] > 0:
            _widen(around, box[b])
        costs[b] = total * np.float64(_half_area(around)) if total > 0 else np.inf
