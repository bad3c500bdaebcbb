"""Nearest triangles of bundles of rays: an eight-way tree of boxes and its traversal.

The hit of a ray depends only on the ray and the mesh. The nearest of the triangles hit counts; of
equally near ones, the first in the mesh. The order of the rays, their grouping and the shape of the
tree change no bit of it.

A triangle counts as hit if the three edge functions of the sheared triangle [1]_ have no opposite
signs. Each edge function is a difference of two products. The neighbour across the edge computes
the same difference with reversed sign. Rounding is monotone, so the difference can round to zero
but not to the wrong sign. Between triangles that share an edge or a vertex there is no gap. This
holds only without contraction to fused multiply-add, so fastmath is not used here. The boxes are
float32, rounded outwards and widened slightly, so that no rounding of the test can hit a triangle
whose box is missed. The triangles themselves are float64.

References
----------
.. [1] Woop, Benthin and Wald, JCGT 2 (1), 2013.
"""

from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit

NODE_WIDTH = 8
"""Children of a node: one vector of float64 with AVX-512, two with AVX2."""

LEAF_TRIANGLES_MAX = 2
"""Largest number of triangles in a leaf; below NODE_WIDTH, so that start and count share one
integer."""

_BOX_SLACK = 2.0**-30
"""Widening of the boxes in units of the largest coordinate. It is far above the sideways rounding
of a hit (some 1e-15 of the range, for ranges to 1e5 times the mesh's size), and below float32."""

_EMPTY_BOX_BOUND = np.float32(3e38)
"""Lower bound of the empty box; its upper bound is minus this."""

_TRIANGLES_PER_BATCH = 1 << 20
"""Number of triangles whose boxes are computed together."""

_STACK_SIZE = 8 * 16
"""Entries that the deepest tree can leave on the stack: seven a level."""

_DIRECTION_MIN = 1e-200
"""Direction components below this count as possibly zero, so that their reciprocal is finite."""

_ENTRY_SLACK = 1.0 + 1e-14
"""Factor above the rounding of a box's entry and exit, which is some 5e-16 of them."""

_TIE_SLACK = 1.0 + 1e-12
"""Factor above the rounding of a hit's distance: a box is skipped only if it cannot hold a tie."""

_BUNDLE_TESTS_MAX, _UNLIMITED_TESTS = np.array([128, 1 << 62])
"""Number of triangles tested against a full bundle before its rays are traversed one by one, and a
number that is never reached."""


class BoxTree(NamedTuple):
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


def build_tree(vertices: np.ndarray, faces: np.ndarray) -> BoxTree:
    """Build the tree of a mesh: leaves by recursive halving, eight neighbours a node.

    Parameters
    ----------
    vertices : ndarray (n, 3) float64
        Finite vertices [m], best centred about 0.
    faces : ndarray (m, 3) int
        Vertices of each triangle, m >= 1.
    """
    leaves = _fill_leaves(_triangle_centres(vertices, faces))
    bounds, children = _build_nodes(vertices, faces, leaves)
    order = leaves[leaves < len(faces)]
    del leaves
    new_faces, vertex_order = _renumber_by_first_use(faces, order, len(vertices))
    return BoxTree(bounds, children, new_faces, order, vertices[vertex_order])


def _triangle_centres(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return twice the centres of triangles' boxes, (m, 3) float32; they only order the tree."""
    centres = np.empty((len(faces), 3), np.float32)
    for begin in range(0, len(faces), _TRIANGLES_PER_BATCH):  # in batches, to save memory
        rows = slice(begin, begin + _TRIANGLES_PER_BATCH)
        corners = vertices[faces[rows]]
        centres[rows] = corners.min(axis=1) + corners.max(axis=1)
    return centres


def _leaf_boxes(vertices: np.ndarray, faces: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """Return the boxes (low, -high) of leaves, (n, 6) float32."""
    slack = _BOX_SLACK * float(max(vertices.max(), -vertices.min()))
    boxes = np.empty((leaves.size // LEAF_TRIANGLES_MAX, 6), np.float32)
    for begin in range(0, leaves.size, _TRIANGLES_PER_BATCH):
        batch_triangles = leaves[begin : begin + _TRIANGLES_PER_BATCH]
        is_triangle = batch_triangles < len(faces)
        corners = vertices[faces[np.where(is_triangle, batch_triangles, 0)]]
        triangle_boxes = np.empty((len(batch_triangles), 6), np.float32)
        low, high = corners.min(axis=1) - slack, corners.max(axis=1) + slack
        triangle_boxes[:, :3] = np.nextafter(low.astype(np.float32), -_EMPTY_BOX_BOUND)
        triangle_boxes[:, 3:] = -np.nextafter(high.astype(np.float32), _EMPTY_BOX_BOUND)
        triangle_boxes[~is_triangle] = _EMPTY_BOX_BOUND
        leaf_rows = slice(
            begin // LEAF_TRIANGLES_MAX, (begin + _TRIANGLES_PER_BATCH) // LEAF_TRIANGLES_MAX
        )
        boxes[leaf_rows] = triangle_boxes.reshape(-1, LEAF_TRIANGLES_MAX, 6).min(axis=1)
    return boxes


def _build_nodes(
    vertices: np.ndarray, faces: np.ndarray, leaves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds and children of all nodes, level by level above the leaves, the root last."""
    boxes = _leaf_boxes(vertices, faces, leaves)
    triangle_count = (
        (leaves < len(faces)).reshape(-1, LEAF_TRIANGLES_MAX).sum(axis=1, dtype=np.int32)
    )
    child_links = -1 - (
        8 * (np.cumsum(triangle_count, dtype=np.int32) - triangle_count) + triangle_count
    )
    nodes_per_level = [-(-len(boxes) // NODE_WIDTH)]
    while nodes_per_level[-1] > 1:
        nodes_per_level.append(-(-nodes_per_level[-1] // NODE_WIDTH))
    bounds = np.empty((sum(nodes_per_level), 6, NODE_WIDTH), np.float32)
    children = np.empty((sum(nodes_per_level), NODE_WIDTH), np.int32)
    n_nodes_before = 0
    for n_nodes in nodes_per_level:
        if n_missing_leaves := n_nodes * NODE_WIDTH - len(boxes):  # leaves without triangles
            boxes = np.append(boxes, np.full((n_missing_leaves, 6), _EMPTY_BOX_BOUND), axis=0)
            child_links = np.append(child_links, np.full(n_missing_leaves, -1, np.int32))
        boxes_by_node = boxes.reshape(n_nodes, NODE_WIDTH, 6)
        level_rows = slice(n_nodes_before, n_nodes_before + n_nodes)
        bounds[level_rows] = boxes_by_node.swapaxes(1, 2)
        np.negative(bounds[level_rows, 3:], out=bounds[level_rows, 3:])
        children[level_rows] = child_links.reshape(n_nodes, NODE_WIDTH)
        boxes, child_links = (
            boxes_by_node.min(axis=1),
            np.arange(n_nodes_before, n_nodes_before + n_nodes, dtype=np.int32),
        )
        n_nodes_before += n_nodes
    return bounds, children


def _fill_leaves(centres: np.ndarray) -> np.ndarray:
    """Return the triangles in the order of the leaves, int32, in a power of two of slots.

    An empty slot has the number m of triangles.
    """
    n_triangles, n_slots = len(centres), LEAF_TRIANGLES_MAX
    while n_slots < n_triangles:
        n_slots *= 2
    triangle_of_slot = (np.arange(n_slots) * n_triangles // n_slots).astype(np.int32)
    slot_order = np.arange(n_slots, dtype=np.int32)
    _sort_into_halves(centres[triangle_of_slot], slot_order)
    triangle_of_slot[1:][triangle_of_slot[1:] == triangle_of_slot[:-1]] = (
        n_triangles  # an empty slot
    )
    return np.asarray(triangle_of_slot[slot_order])


@njit(cache=True, nogil=True, error_model="numpy")
def _renumber_by_first_use(faces, triangle_order, n_vertices):
    """Return faces in a given order with vertices renumbered by first use, and their old numbers.

    The data of a leaf's triangles then lie together in memory.
    """
    new_faces = np.empty((triangle_order.size, 3), np.int32)
    new_number, vertex_order = np.full(n_vertices, -1, np.int32), np.empty(n_vertices, np.int32)
    n_used = 0
    for i in range(triangle_order.size):
        for k in range(3):
            vertex = faces[triangle_order[i], k]
            if new_number[vertex] < 0:
                new_number[vertex], vertex_order[n_used] = n_used, vertex
                n_used += 1
            new_faces[i, k] = new_number[vertex]
    for vertex in range(n_vertices):
        if new_number[vertex] < 0:
            vertex_order[n_used] = vertex
            n_used += 1
    return new_faces, vertex_order


@njit(cache=True, nogil=True, error_model="numpy")
def _sort_into_halves(points, order):
    """Sort `order` of points (n, 3) so that its halves are separated in space, recursively."""
    part_size = order.size
    while part_size > LEAF_TRIANGLES_MAX:
        for start in range(0, order.size, part_size):
            axis, extent_max = 0, -1.0
            for component in range(3):
                low = high = points[order[start], component]
                for i in range(start + 1, start + part_size):
                    low = min(low, points[order[i], component])
                    high = max(high, points[order[i], component])
                if high - low > extent_max:
                    axis, extent_max = component, high - low
            first, last, middle = start, start + part_size - 1, start + part_size // 2
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
        part_size //= 2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _larger(a, b):
    """Return the larger of two numbers: one instruction, where max() would also check for nan."""
    return a if a > b else b


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _smaller(a, b):
    """Return the smaller of two numbers: one instruction, where min() would also check for nan."""
    return a if a < b else b


@njit(cache=True, nogil=True, error_model="numpy")
def find_nearest_triangles(tree, origins, directions, distance, face_index, distance_min=0.0):
    """Find the nearest triangle of each ray of each bundle, if nearer than the known distance.

    Parameters
    ----------
    tree : BoxTree
        Tree of a mesh.
    origins : ndarray (n, 3)
        Origins of bundles in the tree's frame [m].
    directions : ndarray (n, b, 3)
        Directions of the rays of each bundle.
    distance : ndarray (n, b)
        Nearest known distance, in lengths of the direction (inf: none); it is replaced if a
        triangle is nearer.
    face_index : ndarray (n, b)
        Index in the mesh of the nearest triangle; it is replaced with `distance`.
    distance_min : float
        Rays pass through triangles up to this distance, >= 0.

    Notes
    -----
    A bundle, rays from one origin in neighbouring directions, traverses the tree once. A box is
    entered if the interval of the directions may reach it. A leaf's triangles are tested against
    all rays together. If the rays spread too far, each ray traverses the tree alone.
    """
    scratch = np.empty((3, directions.shape[1])), np.empty((6, 3)), np.empty(NODE_WIDTH)
    stack_arrays = np.empty(_STACK_SIZE, np.int64), np.empty(_STACK_SIZE)
    for i in range(origins.shape[0]):
        origin, bundle_directions = origins[i], directions[i]
        walk_limits = _BUNDLE_TESTS_MAX, distance_min
        if not _walk_tree(
            tree,
            origin,
            bundle_directions,
            distance[i],
            face_index[i],
            scratch,
            stack_arrays,
            walk_limits,
        ):
            for beamlet in range(bundle_directions.shape[0]):
                ray_slice = slice(beamlet, beamlet + 1)
                walk_limits = _UNLIMITED_TESTS, distance_min
                _walk_tree(
                    tree,
                    origin,
                    bundle_directions[ray_slice],
                    distance[i, ray_slice],
                    face_index[i, ray_slice],
                    scratch,
                    stack_arrays,
                    walk_limits,
                )


@njit(cache=True, nogil=True, error_model="numpy")
def _walk_tree(tree, origin, directions, distance, face_index, scratch, stack_arrays, walk_limits):
    """Find the nearest triangles of all rays of a bundle in one traversal; return False if aborted.

    After an abort, the results include all triangles tested so far, so that single rays can
    continue. `walk_limits` are the number of triangles that may be tested, and the least distance
    of a hit.
    """
    bounds, children, tree_faces, triangle_order, vertices = tree
    shears, planes, child_entry = scratch
    node_stack, entry_stack = stack_arrays
    tests_left, distance_min = walk_limits
    axis = _prepare_bundle(directions, shears, planes)
    if axis < 0:
        return False
    kx, ky = (axis + 1) % 3, (axis + 2) % 3
    ox, oy, oz = origin[kx], origin[ky], origin[axis]
    node_stack[0], entry_stack[0], top = children.shape[0] - 1, 0.0, 1
    farthest_hit, is_known = 0.0, False
    while top > 0:
        if not is_known:
            farthest_hit, is_known = distance[0], True
            for i in range(1, distance.size):
                farthest_hit = _larger(farthest_hit, distance[i])
            farthest_hit *= _TIE_SLACK
        top -= 1
        node = node_stack[top]
        if entry_stack[top] > farthest_hit:
            continue
        if node >= 0:
            _box_entry_distances(
                bounds, node, origin[0], origin[1], origin[2], planes, farthest_hit, child_entry
            )
            stack_base = top
            for child in range(NODE_WIDTH):  # push the boxes that may be entered, the nearest last
                if child_entry[child] < np.inf:
                    slot = top
                    while slot > stack_base and entry_stack[slot - 1] < child_entry[child]:
                        node_stack[slot], entry_stack[slot] = (
                            node_stack[slot - 1],
                            entry_stack[slot - 1],
                        )
                        slot -= 1
                    node_stack[slot], entry_stack[slot] = children[node, child], child_entry[child]
                    top += 1
            continue
        start, count = (-1 - node) >> 3, (-1 - node) & 7
        for triangle in range(start, start + count):
            p, q, r = tree_faces[triangle, 0], tree_faces[triangle, 1], tree_faces[triangle, 2]
            _test_triangle(
                (vertices[p, kx] - ox, vertices[p, ky] - oy, vertices[p, axis] - oz),
                (vertices[q, kx] - ox, vertices[q, ky] - oy, vertices[q, axis] - oz),
                (vertices[r, kx] - ox, vertices[r, ky] - oy, vertices[r, axis] - oz),
                triangle_order[triangle], shears, distance_min, distance, face_index,
            )  # fmt: skip
        is_known = False
        tests_left -= count
        if tests_left < 0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _prepare_bundle(directions, shears, planes):
    """Return the axis of the largest component of all directions, -1 if they differ; fill tables.

    Parameters
    ----------
    directions : ndarray (b, 3)
        Directions of the rays.
    shears : ndarray (3, >= b)
        Filled with the directions' other two components, in cyclic order, over the largest, and 1
        over the largest.
    planes : ndarray (6, 3)
        Filled with the constants of the box test for each axis, for directions between `low` and
        `high` along it.

    Notes
    -----
    The rays o + t d can lie between the box's lower and upper plane only if t high >= lower - o and
    t low <= upper - o. Each condition bounds t from below or from above, by the sign of its factor.
    The first two rows of `planes` are the reciprocals of the factors. The others are added to make
    the two bounds idle, from below and from above.
    """
    axis = -1
    for beamlet in range(directions.shape[0]):
        x, y, z = (
            abs(directions[beamlet, 0]),
            abs(directions[beamlet, 1]),
            abs(directions[beamlet, 2]),
        )
        largest_component = 0 if x >= y and x >= z else (1 if y >= z else 2)
        if beamlet > 0 and largest_component != axis:
            return -1
        axis = largest_component
    for beamlet in range(directions.shape[0]):
        reciprocal = 1.0 / directions[beamlet, axis]
        shears[0, beamlet] = directions[beamlet, (axis + 1) % 3] * reciprocal
        shears[1, beamlet] = directions[beamlet, (axis + 2) % 3] * reciprocal
        shears[2, beamlet] = reciprocal
    for component in range(3):
        low = high = directions[0, component]
        for beamlet in range(1, directions.shape[0]):
            low, high = (
                _smaller(low, directions[beamlet, component]),
                _larger(high, directions[beamlet, component]),
            )
        low_nonzero = -_DIRECTION_MIN if abs(low) < _DIRECTION_MIN else low
        high_nonzero = _DIRECTION_MIN if abs(high) < _DIRECTION_MIN else high
        planes[0, component], planes[1, component] = 1.0 / high_nonzero, 1.0 / low_nonzero
        planes[2, component] = 0.0 if high_nonzero > 0.0 else -np.inf
        planes[3, component] = 0.0 if low_nonzero < 0.0 else -np.inf
        planes[4, component] = 0.0 if high_nonzero < 0.0 else np.inf
        planes[5, component] = 0.0 if low_nonzero > 0.0 else np.inf
    return axis


@njit(cache=True, nogil=True, error_model="numpy")
def _box_entry_distances(bounds, node, ox, oy, oz, planes, distance_max, child_entry):
    """Compute the smallest distance at which rays may enter each child's box; inf if none can."""
    # Scalars, not an array: the compiler could not exclude that `child_entry` overlaps with it.
    rx, ry, rz = planes[0, 0], planes[0, 1], planes[0, 2]
    sx, sy, sz = planes[1, 0], planes[1, 1], planes[1, 2]
    bx, by, bz = planes[2, 0], planes[2, 1], planes[2, 2]
    cx, cy, cz = planes[3, 0], planes[3, 1], planes[3, 2]
    fx, fy, fz = planes[4, 0], planes[4, 1], planes[4, 2]
    gx, gy, gz = planes[5, 0], planes[5, 1], planes[5, 2]
    for child in range(child_entry.size):  # a constant bound would not be vectorised
        x0, x1 = (bounds[node, 0, child] - ox) * rx, (bounds[node, 3, child] - ox) * sx
        y0, y1 = (bounds[node, 1, child] - oy) * ry, (bounds[node, 4, child] - oy) * sy
        z0, z1 = (bounds[node, 2, child] - oz) * rz, (bounds[node, 5, child] - oz) * sz
        near_x, far_x = _larger(x0 + bx, x1 + cx), _smaller(x0 + fx, x1 + gx)
        near_y, far_y = _larger(y0 + by, y1 + cy), _smaller(y0 + fy, y1 + gy)
        near_z, far_z = _larger(z0 + bz, z1 + cz), _smaller(z0 + fz, z1 + gz)
        near = _larger(_larger(near_x, near_y), _larger(near_z, 0.0))
        far = _smaller(_smaller(far_x, far_y), far_z) * _ENTRY_SLACK
        child_entry[child] = near if near <= _smaller(far, distance_max) else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _test_triangle(a, b, c, index, shears, distance_min, distance, face_index):
    """Test one triangle against all rays of a bundle, and keep nearer hits.

    A hit's distance is a weighted mean of the corners' depths, and so lies between them at any
    incidence.
    """
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    for i in range(distance.size):
        sx, sy, reciprocal = shears[0, i], shears[1, i], shears[2, i]
        pax, pay = ax - sx * az, ay - sy * az
        pbx, pby = bx - sx * bz, by - sy * bz
        pcx, pcy = cx - sx * cz, cy - sy * cz
        u = pcx * pby - pcy * pbx
        v = pax * pcy - pay * pcx
        w = pbx * pay - pby * pax
        edge_min = _smaller(u, _smaller(v, w))
        edge_max = _larger(u, _larger(v, w))
        ray_distance = (u * az + v * bz + w * cz) / (u + v + w) * reciprocal
        ray_distance = (
            ray_distance
            if ((edge_min >= 0.0) | (edge_max <= 0.0)) & (ray_distance > distance_min)
            else np.inf
        )
        is_closer = (ray_distance < distance[i]) | (
            (ray_distance == distance[i]) & (index < face_index[i])
        )
        distance[i] = ray_distance if is_closer else distance[i]
        face_index[i] = index if is_closer else face_index[i]
