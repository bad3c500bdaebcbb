"""Bounding volume hierarchy: the nearest triangles along bundles of rays, by a tree of boxes.

Each node of the tree has up to eight children. The hit of a ray depends only on the ray and the
mesh: it is the nearest triangle, or the first in the mesh of several equally near ones. The order
of the rays, their grouping and the shape of the tree change no bit of the result.

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

CHILDREN_PER_NODE = 8
"""Number of children of a tree node. The coordinates of their boxes fill one vector register of
float64 with AVX-512, or two with AVX2."""

LEAF_TRIANGLES_MAX = 2
"""Largest number of triangles in a leaf. It is below 8, so that a leaf's first triangle and its
number of triangles fit one integer (:attr:`BoxTree.children`)."""

_BOX_MARGIN_FRACTION = 2.0**-30
"""Distance by which boxes are widened, as a fraction of the mesh's largest coordinate. The fraction
is far above the rounding of a hit's position across the ray (some 1e-15 of the range, for ranges up
to 1e5 times the mesh's size), and below the resolution of float32."""

_EMPTY_BOX_BOUND = np.float32(3e38)
"""Lower bound of an empty box along each axis [m]. The box's upper bound is minus this value, so
that no ray enters the box."""

_TRIANGLES_PER_BATCH = 1 << 20
"""Number of triangles whose bounding boxes are computed in one step, which limits memory."""

_STACK_SIZE = 8 * 16
"""Number of entries of the stack that a traversal of the tree uses. The deepest tree needs seven
entries per level."""

_DIRECTION_COMPONENT_MIN = 1e-200
"""Modulus that replaces smaller components of a ray's direction before their reciprocals are
computed, so that reciprocals are finite."""

_EXIT_DISTANCE_FACTOR = 1.0 + 1e-14
"""Factor, slightly above 1, by which the distance at which a ray leaves a box is enlarged. It
covers the rounding error of this distance (5e-16)."""

_TIE_DISTANCE_FACTOR = 1.0 + 1e-12
"""Factor, slightly above 1, on the distance of the nearest hit. Boxes beyond the product are
skipped. Because of the factor, rounding skips no box that holds an equally near triangle."""

_BUNDLE_TRIANGLE_TESTS_MAX = np.int64(128)
"""Largest number of triangles that are tested against a whole bundle of rays. If more tests are
needed, each ray of the bundle traverses the tree alone."""
_UNLIMITED_TRIANGLE_TESTS = np.int64(1 << 62)
"""Limit on triangle tests, given to a traversal that has none; no traversal reaches it."""

_X, _Y, _Z = range(3)
"""Indices of the coordinate axes."""
_LOW_X, _LOW_Y, _LOW_Z, _HIGH_X, _HIGH_Y, _HIGH_Z = range(6)
"""Indices of a box's lower and upper bounds along x, y, z in :attr:`BoxTree.bounds`."""
_SHEAR_X, _SHEAR_Y, _RECIPROCAL = range(3)
"""Indices of the rows of :attr:`_Scratch.shears`."""
(
    _RECIPROCAL_HIGH, _RECIPROCAL_LOW, _NEAR_TERM_HIGH, _NEAR_TERM_LOW, _FAR_TERM_HIGH,
    _FAR_TERM_LOW,
) = range(6)  # fmt: skip
"""Indices of the rows of :attr:`_Scratch.box_test_constants`."""


class BoxTree(NamedTuple):
    """Tree of nested bounding boxes over the triangles of one mesh; the root is the last node."""

    bounds: np.ndarray
    """(nodes, 6, 8) float32 [m]: lower bounds x, y, z and upper bounds x, y, z of each child's box.
    """
    children: np.ndarray
    """(nodes, 8) int32: reference to each child. A child that is a node is stored as its index. A
    leaf is stored as -1 - (8 start + count), with the index ``start`` of its first triangle in
    ``faces`` and its number ``count`` of triangles."""
    faces: np.ndarray
    """(m, 3) int32: indices in ``vertices`` of each triangle's corners. The triangles are in the
    order of the leaves."""
    mesh_face_index: np.ndarray
    """(m,) int32: index in the original mesh of each triangle of ``faces``."""
    vertices: np.ndarray
    """(n, 3) float64 [m]: the mesh's vertices in the order in which `faces` first uses them."""


class _Scratch(NamedTuple):
    """Arrays that a traversal of the tree uses for intermediate results."""

    shears: np.ndarray
    """(3, b): constants of the triangle tests of each ray (:func:`_prepare_bundle_tests`)."""
    box_test_constants: np.ndarray
    """(6, 3): constants of the box tests of a bundle of rays, for each coordinate axis
    (:func:`_prepare_bundle_tests`)."""
    child_entry_distance: np.ndarray
    """(8,): smallest distance at which a ray of the bundle may enter each child's box, in units of
    the length of the direction vector; inf if no ray can."""
    node_stack: np.ndarray
    """(_STACK_SIZE,) int64: nodes and leaves that are still to be visited, with the encoding of
    :attr:`BoxTree.children`."""
    entry_distance_stack: np.ndarray
    """(_STACK_SIZE,): smallest distance at which a ray of the bundle may enter the box of each
    element of ``node_stack``, in units of the length of the direction vector."""


def build_tree(vertices: np.ndarray, faces: np.ndarray) -> BoxTree:
    """Build the tree of bounding boxes of a mesh.

    The triangles are halved recursively into leaves. The children of a node are eight boxes that
    are close in space.

    Parameters
    ----------
    vertices : ndarray (n, 3) float64
        Finite vertices [m], best centred about 0.
    faces : ndarray (m, 3) int
        Vertices of each triangle, m >= 1.

    Returns
    -------
    BoxTree
    """
    leaves = _order_into_leaves(_doubled_triangle_centres(vertices, faces))
    bounds, children = _build_nodes(vertices, faces, leaves)
    mesh_face_index = leaves[leaves < len(faces)]
    del leaves
    new_faces, vertex_order = _renumber_vertices_by_first_use(faces, mesh_face_index, len(vertices))
    return BoxTree(bounds, children, new_faces, mesh_face_index, vertices[vertex_order])


def _doubled_triangle_centres(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the doubled centres of triangles' bounding boxes, (m, 3) float32 [m].

    Triangles are sorted into leaves by their centres.
    """
    centres = np.empty((len(faces), 3), np.float32)
    for begin in range(0, len(faces), _TRIANGLES_PER_BATCH):  # in batches, to save memory
        rows = slice(begin, begin + _TRIANGLES_PER_BATCH)
        corners = vertices[faces[rows]]
        centres[rows] = corners.min(axis=1) + corners.max(axis=1)
    return centres


def _leaf_boxes(vertices: np.ndarray, faces: np.ndarray, leaves: np.ndarray) -> np.ndarray:
    """Return the bounding box of each leaf, (n, 6) float32 [m].

    A row holds the lower bounds of the box along x, y, z, and the negative of its upper bounds.
    ``leaves`` is the result of :func:`_order_into_leaves`.
    """
    slack = _BOX_MARGIN_FRACTION * float(max(vertices.max(), -vertices.min()))
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
    """Build all nodes of the tree; return :attr:`BoxTree.bounds` and :attr:`BoxTree.children`.

    Nodes are in the order of their levels: first the parents of leaves, last the root. ``leaves``
    is the result of :func:`_order_into_leaves`.
    """
    boxes = _leaf_boxes(vertices, faces, leaves)
    triangle_count = (
        (leaves < len(faces)).reshape(-1, LEAF_TRIANGLES_MAX).sum(axis=1, dtype=np.int32)
    )
    child_links = -1 - (
        8 * (np.cumsum(triangle_count, dtype=np.int32) - triangle_count) + triangle_count
    )
    nodes_per_level = [-(-len(boxes) // CHILDREN_PER_NODE)]
    while nodes_per_level[-1] > 1:
        nodes_per_level.append(-(-nodes_per_level[-1] // CHILDREN_PER_NODE))
    bounds = np.empty((sum(nodes_per_level), 6, CHILDREN_PER_NODE), np.float32)
    children = np.empty((sum(nodes_per_level), CHILDREN_PER_NODE), np.int32)
    n_nodes_before = 0
    for n_nodes in nodes_per_level:
        if n_missing_leaves := n_nodes * CHILDREN_PER_NODE - len(boxes):  # leaves without triangles
            boxes = np.append(boxes, np.full((n_missing_leaves, 6), _EMPTY_BOX_BOUND), axis=0)
            child_links = np.append(child_links, np.full(n_missing_leaves, -1, np.int32))
        boxes_by_node = boxes.reshape(n_nodes, CHILDREN_PER_NODE, 6)
        level_rows = slice(n_nodes_before, n_nodes_before + n_nodes)
        bounds[level_rows] = boxes_by_node.swapaxes(1, 2)
        np.negative(bounds[level_rows, 3:], out=bounds[level_rows, 3:])
        children[level_rows] = child_links.reshape(n_nodes, CHILDREN_PER_NODE)
        boxes, child_links = (
            boxes_by_node.min(axis=1),
            np.arange(n_nodes_before, n_nodes_before + n_nodes, dtype=np.int32),
        )
        n_nodes_before += n_nodes
    return bounds, children


def _order_into_leaves(centres: np.ndarray) -> np.ndarray:
    """Sort triangles into leaves of the tree; return the triangle number of each slot, int32.

    A slot is a place for a triangle in a leaf, and a leaf holds triangles that are close in space.
    The number of slots is a power of two. An empty slot has the value m, the number of triangles.
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
def _renumber_vertices_by_first_use(faces, triangle_order, n_vertices):
    """Reorder triangles, and renumber vertices in the order in which the triangles use them.

    The data of a leaf's triangles then lie together in memory.

    Parameters
    ----------
    faces : ndarray (m, 3) int
        Vertices of each triangle.
    triangle_order : ndarray (m,) int
        Index of each triangle in the new order.
    n_vertices : int
        Number of vertices.

    Returns
    -------
    new_faces : ndarray (m, 3) int32
        New numbers of the vertices of each triangle, in the new order.
    vertex_order : ndarray (n_vertices,) int32
        Old number of each vertex; unused vertices come last.
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
    """Sort indices of points so that each half, and each half of a half, is compact in space.

    Parameters
    ----------
    points : ndarray (n, 3)
        Points.
    order : ndarray (n,) int32
        Indices of the points; it is sorted in place.

    Notes
    -----
    Each part is halved along the axis of its largest extent.
    """
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
def _larger_of_two(a, b):
    """Return the larger of two numbers: one instruction, where max() would also check for nan."""
    return a if a > b else b


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _smaller_of_two(a, b):
    """Return the smaller of two numbers: one instruction, where min() would also check for nan."""
    return a if a < b else b


@njit(cache=True, nogil=True, error_model="numpy")
def find_nearest_triangles(tree, origins, directions, distance, face_index, distance_min=0.0):
    """Find the nearest triangle that each ray hits within its known distance, in place.

    Rays come in bundles of one origin.

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
        Index in the mesh of the nearest triangle; replaced together with `distance`.
    distance_min : float
        Rays pass through triangles up to this distance, >= 0.

    Notes
    -----
    A bundle, rays from one origin in neighbouring directions, traverses the tree once. A box is
    entered if the interval of the directions may reach it. A leaf's triangles are tested against
    all rays together. If the rays spread too far, each ray traverses the tree alone.
    """
    scratch = _Scratch(
        np.empty((3, directions.shape[1])),
        np.empty((6, 3)),
        np.empty(CHILDREN_PER_NODE),
        np.empty(_STACK_SIZE, np.int64),
        np.empty(_STACK_SIZE),
    )
    for i in range(origins.shape[0]):
        origin, bundle_directions = origins[i], directions[i]
        if not _traverse_tree(
            tree,
            origin,
            bundle_directions,
            distance[i],
            face_index[i],
            scratch,
            _BUNDLE_TRIANGLE_TESTS_MAX,
            distance_min,
        ):
            for beamlet in range(bundle_directions.shape[0]):
                ray_slice = slice(beamlet, beamlet + 1)
                _traverse_tree(
                    tree,
                    origin,
                    bundle_directions[ray_slice],
                    distance[i, ray_slice],
                    face_index[i, ray_slice],
                    scratch,
                    _UNLIMITED_TRIANGLE_TESTS,
                    distance_min,
                )


@njit(cache=True, nogil=True, error_model="numpy")
def _traverse_tree(
    tree, origin, directions, distance, face_index, scratch, tests_max, distance_min
):
    """Find the nearest triangles that a bundle of rays hits, in place; return False if aborted.

    All rays traverse the tree together.

    Parameters
    ----------
    tree : BoxTree
        Tree of a mesh.
    origin : ndarray (3,)
        Origin of the bundle in the tree's frame [m].
    directions : ndarray (b, 3)
        Directions of the rays.
    distance, face_index : ndarray (b,)
        Nearest known distance and triangle of each ray; they are replaced if a triangle is nearer.
        After an abort they include all triangles tested so far, so that single rays can continue.
    scratch : _Scratch
        Arrays to work in.
    tests_max : int
        Number of triangles after which the traversal is aborted.
    distance_min : float
        Smallest distance of a hit, in lengths of the direction.

    Returns
    -------
    bool
        True if all boxes that a ray may enter have been visited. False after an abort, or without
        an axis that all directions share (:func:`_prepare_bundle_tests`).
    """
    bounds, children, tree_faces, vertices = tree.bounds, tree.children, tree.faces, tree.vertices
    shears, child_entry_distance = scratch.shears, scratch.child_entry_distance
    node_stack, entry_distance_stack = scratch.node_stack, scratch.entry_distance_stack
    tests_left = tests_max
    axis = _prepare_bundle_tests(directions, shears, scratch.box_test_constants)
    if axis < 0:
        return False
    kx, ky = (axis + 1) % 3, (axis + 2) % 3
    ox, oy, oz = origin[kx], origin[ky], origin[axis]
    node_stack[0], entry_distance_stack[0], top = children.shape[0] - 1, 0.0, 1
    farthest_hit, is_known = 0.0, False
    while top > 0:
        if not is_known:
            farthest_hit, is_known = distance[0], True
            for i in range(1, distance.size):
                farthest_hit = _larger_of_two(farthest_hit, distance[i])
            farthest_hit *= _TIE_DISTANCE_FACTOR
        top -= 1
        node = node_stack[top]
        if entry_distance_stack[top] > farthest_hit:
            continue
        if node >= 0:
            _box_entry_distances(
                bounds, node, origin[_X], origin[_Y], origin[_Z], scratch.box_test_constants,
                    farthest_hit, child_entry_distance,
            )  # fmt: skip
            stack_base = top
            for child in range(
                CHILDREN_PER_NODE
            ):  # push the boxes that may be entered, the nearest last
                if child_entry_distance[child] < np.inf:
                    slot = top
                    while (
                        slot > stack_base
                        and entry_distance_stack[slot - 1] < child_entry_distance[child]
                    ):
                        node_stack[slot], entry_distance_stack[slot] = (
                            node_stack[slot - 1],
                            entry_distance_stack[slot - 1],
                        )
                        slot -= 1
                    node_stack[slot], entry_distance_stack[slot] = (
                        children[node, child],
                        child_entry_distance[child],
                    )
                    top += 1
            continue
        start, count = (-1 - node) >> 3, (-1 - node) & 7
        for triangle in range(start, start + count):
            p, q, r = tree_faces[triangle, 0], tree_faces[triangle, 1], tree_faces[triangle, 2]
            _intersect_triangle(
                (vertices[p, kx] - ox, vertices[p, ky] - oy, vertices[p, axis] - oz),
                (vertices[q, kx] - ox, vertices[q, ky] - oy, vertices[q, axis] - oz),
                (vertices[r, kx] - ox, vertices[r, ky] - oy, vertices[r, axis] - oz),
                tree.mesh_face_index[triangle], shears, distance_min, distance, face_index,
            )  # fmt: skip
        is_known = False
        tests_left -= count
        if tests_left < 0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _prepare_bundle_tests(directions, shears, box_test_constants):
    """Compute constants of a bundle's box and triangle tests; return the index of its main axis.

    The main axis is that along which the component of every direction is largest.

    Parameters
    ----------
    directions : ndarray (b, 3)
        Directions of the rays.
    shears : ndarray (3, >= b)
        The result for triangles: the directions' other two components, in cyclic order, over the
        largest, and 1 over the largest.
    box_test_constants : ndarray (6, 3)
        The result for boxes: constants for each coordinate axis, for all directions between `low`
        and `high` along it.

    Returns
    -------
    int
        Index of the main axis, 0, 1 or 2 for x, y or z; -1 if it differs between directions.

    Notes
    -----
    The rays o + t d can lie between the box's lower and upper plane only if t high >= lower - o and
    t low <= upper - o. Each condition bounds t from below or from above, by the sign of its factor.
    The first two rows of `box_test_constants` are the reciprocals 1 / high and 1 / low. The other
    rows are 0, or infinite. They are added to the two quotients, so that a condition that does not
    bound t from below (rows 3 and 4), or from above (rows 5 and 6), has no effect there.
    """
    axis = -1
    for beamlet in range(directions.shape[0]):
        x, y, z = (
            abs(directions[beamlet, _X]),
            abs(directions[beamlet, _Y]),
            abs(directions[beamlet, _Z]),
        )
        largest_component = _X if x >= y and x >= z else (_Y if y >= z else _Z)
        if beamlet > 0 and largest_component != axis:
            return -1
        axis = largest_component
    for beamlet in range(directions.shape[0]):
        reciprocal = 1.0 / directions[beamlet, axis]
        shears[_SHEAR_X, beamlet] = directions[beamlet, (axis + 1) % 3] * reciprocal
        shears[_SHEAR_Y, beamlet] = directions[beamlet, (axis + 2) % 3] * reciprocal
        shears[_RECIPROCAL, beamlet] = reciprocal
    for component in range(3):
        low = high = directions[0, component]
        for beamlet in range(1, directions.shape[0]):
            low, high = (
                _smaller_of_two(low, directions[beamlet, component]),
                _larger_of_two(high, directions[beamlet, component]),
            )
        low_nonzero = -_DIRECTION_COMPONENT_MIN if abs(low) < _DIRECTION_COMPONENT_MIN else low
        high_nonzero = _DIRECTION_COMPONENT_MIN if abs(high) < _DIRECTION_COMPONENT_MIN else high
        box_test_constants[_RECIPROCAL_HIGH, component] = 1.0 / high_nonzero
        box_test_constants[_RECIPROCAL_LOW, component] = 1.0 / low_nonzero
        box_test_constants[_NEAR_TERM_HIGH, component] = 0.0 if high_nonzero > 0.0 else -np.inf
        box_test_constants[_NEAR_TERM_LOW, component] = 0.0 if low_nonzero < 0.0 else -np.inf
        box_test_constants[_FAR_TERM_HIGH, component] = 0.0 if high_nonzero < 0.0 else np.inf
        box_test_constants[_FAR_TERM_LOW, component] = 0.0 if low_nonzero > 0.0 else np.inf
    return axis


@njit(cache=True, nogil=True, error_model="numpy")
def _box_entry_distances(
    bounds, node, ox, oy, oz, box_test_constants, distance_max, child_entry_distance
):
    """Compute the smallest distance at which rays of a bundle may enter each box of a node.

    Parameters
    ----------
    bounds : ndarray (nodes, 6, 8)
        Field of :class:`BoxTree`.
    node : int
        Node whose children are tested.
    ox, oy, oz : float
        Origin of the rays [m].
    box_test_constants : ndarray (6, 3)
        Result of :func:`_prepare_bundle_tests`.
    distance_max : float
        Boxes at larger distances are not entered.
    child_entry_distance : ndarray (8,)
        The result: distances in lengths of the direction, inf for a box that no ray can enter.
    """
    # Scalars: the compiler could not exclude that an array overlaps with `child_entry_distance`.
    high_x, high_y, high_z = (
        box_test_constants[_RECIPROCAL_HIGH, _X],
        box_test_constants[_RECIPROCAL_HIGH, _Y],
        box_test_constants[_RECIPROCAL_HIGH, _Z],
    )
    low_x, low_y, low_z = (
        box_test_constants[_RECIPROCAL_LOW, _X],
        box_test_constants[_RECIPROCAL_LOW, _Y],
        box_test_constants[_RECIPROCAL_LOW, _Z],
    )
    near_high_x, near_high_y, near_high_z = (
        box_test_constants[_NEAR_TERM_HIGH, _X],
        box_test_constants[_NEAR_TERM_HIGH, _Y],
        box_test_constants[_NEAR_TERM_HIGH, _Z],
    )
    near_low_x, near_low_y, near_low_z = (
        box_test_constants[_NEAR_TERM_LOW, _X],
        box_test_constants[_NEAR_TERM_LOW, _Y],
        box_test_constants[_NEAR_TERM_LOW, _Z],
    )
    far_high_x, far_high_y, far_high_z = (
        box_test_constants[_FAR_TERM_HIGH, _X],
        box_test_constants[_FAR_TERM_HIGH, _Y],
        box_test_constants[_FAR_TERM_HIGH, _Z],
    )
    far_low_x, far_low_y, far_low_z = (
        box_test_constants[_FAR_TERM_LOW, _X],
        box_test_constants[_FAR_TERM_LOW, _Y],
        box_test_constants[_FAR_TERM_LOW, _Z],
    )
    for child in range(child_entry_distance.size):  # a constant bound would not be vectorised
        lower_x = (bounds[node, _LOW_X, child] - ox) * high_x
        upper_x = (bounds[node, _HIGH_X, child] - ox) * low_x
        lower_y = (bounds[node, _LOW_Y, child] - oy) * high_y
        upper_y = (bounds[node, _HIGH_Y, child] - oy) * low_y
        lower_z = (bounds[node, _LOW_Z, child] - oz) * high_z
        upper_z = (bounds[node, _HIGH_Z, child] - oz) * low_z
        near_x = _larger_of_two(lower_x + near_high_x, upper_x + near_low_x)
        far_x = _smaller_of_two(lower_x + far_high_x, upper_x + far_low_x)
        near_y = _larger_of_two(lower_y + near_high_y, upper_y + near_low_y)
        far_y = _smaller_of_two(lower_y + far_high_y, upper_y + far_low_y)
        near_z = _larger_of_two(lower_z + near_high_z, upper_z + near_low_z)
        far_z = _smaller_of_two(lower_z + far_high_z, upper_z + far_low_z)
        near = _larger_of_two(_larger_of_two(near_x, near_y), _larger_of_two(near_z, 0.0))
        far = _smaller_of_two(_smaller_of_two(far_x, far_y), far_z) * _EXIT_DISTANCE_FACTOR
        child_entry_distance[child] = near if near <= _smaller_of_two(far, distance_max) else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect_triangle(a, b, c, index, shears, distance_min, distance, face_index):
    """Intersect one triangle with all rays of a bundle; replace known hits by nearer ones.

    Parameters
    ----------
    a, b, c : tuple of float
        Corners relative to the rays' origin [m], in the axes of the shears: the two across, then
        the axis of the bundle.
    index : int
        Index of the triangle in the mesh.
    shears : ndarray (3, b)
        Result of :func:`_prepare_bundle_tests`.
    distance_min : float
        Smallest distance of a hit.
    distance, face_index : ndarray (b,)
        Nearest distance and triangle of each ray; they are replaced by a nearer hit.

    Notes
    -----
    A hit's distance is a weighted mean of the corners' depths along the axis, so it lies between
    these depths at any incidence.
    """
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    for i in range(distance.size):
        sx, sy, reciprocal = shears[_SHEAR_X, i], shears[_SHEAR_Y, i], shears[_RECIPROCAL, i]
        pax, pay = ax - sx * az, ay - sy * az
        pbx, pby = bx - sx * bz, by - sy * bz
        pcx, pcy = cx - sx * cz, cy - sy * cz
        u = pcx * pby - pcy * pbx
        v = pax * pcy - pay * pcx
        w = pbx * pay - pby * pax
        edge_min = _smaller_of_two(u, _smaller_of_two(v, w))
        edge_max = _larger_of_two(u, _larger_of_two(v, w))
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
