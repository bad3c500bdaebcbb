"""Ranges, incidence and normals of rays whose nearest facets are known."""

import math

from numba import njit

from sweep.model.geometry.ray_plane import (
    body_origin,
    facet_normal,
    plane_distance,
    plane_height,
    turned_back,
)


@njit(cache=True, nogil=True, error_model="numpy")
def to_body(origins, shift, rotation, position, anchor, fixed, result):
    """Origins (n, 3) in a mesh's frame, rounded to float64; frames as in `body_origin`.

    `rotation` and `position` are (1, ...) where one pose holds for all, else (n, ...).
    """
    step = 0 if rotation.shape[0] == 1 else 1
    for i in range(origins.shape[0]):
        o = body_origin(origins, i, shift, rotation, position, i * step, anchor, fixed)
        result[i, 0], result[i, 1], result[i, 2] = o[0], o[2], o[4]


@njit(cache=True, nogil=True, error_model="numpy")
def turn_to_body(directions, rotation, result):
    """Directions (n, b, 3) turned into a moving body's frame, rounded to float64."""
    step = 0 if rotation.shape[0] == 1 else 1
    for i in range(directions.shape[0]):
        for b in range(directions.shape[1]):
            d = _body_direction(directions, i, b, rotation, i * step, False)
            result[i, b, 0], result[i, b, 1], result[i, b, 2] = d[0], d[2], d[4]


@njit(cache=True, nogil=True, error_model="numpy")
def _body_direction(directions, i, b, rotation, p, fixed):
    """Direction (i, b) in a body's frame, as a vector of pairs."""
    d = (directions[i, b, 0], 0.0, directions[i, b, 1], 0.0, directions[i, b, 2], 0.0)
    if fixed:
        return d
    return turned_back(d, rotation, p)


@njit(cache=True, nogil=True, error_model="numpy")
def _world_normal(n, rotation, p, fixed):
    """Unit normal in the world's frame, rounded to float64."""
    x, y, z = n[0], n[2], n[4]
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    if fixed:
        return x, y, z
    r = rotation
    return (
        r[p, 0, 0] * x + r[p, 0, 1] * y + r[p, 0, 2] * z,
        r[p, 1, 0] * x + r[p, 1, 1] * y + r[p, 1, 2] * z,
        r[p, 2, 0] * x + r[p, 2, 1] * y + r[p, 2, 2] * z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def finish_rays(mesh, frame, rays, beamlet, origins, directions, face, result):
    """Ranges, cosines and normals of the rays that hit one body.

    Parameters
    ----------
    mesh : (vertices, faces)
    frame : (shift, rotation, position, anchor, fixed)
        As in `to_body`.
    rays : (k,) int64
        The rays that hit this body.
    beamlet : (n,) int64
        Which direction of each ray's bundle it takes.
    origins, directions : (n, 3), (n, b, 3) float64
        In the world's frame.
    face : (n,) int64
    result : ((n,), (n,), (n,), (n, 3))
        Range (high, low) [m], cosine of incidence, normal towards the ray's origin: filled in
        for `rays`.
    """
    vertices, faces = mesh
    shift, rotation, position, anchor, fixed = frame
    high, low, cosine, normal = result
    step = 0 if rotation.shape[0] == 1 else 1
    for i in rays:
        p, b = i * step, beamlet[i]
        o = body_origin(origins, i, shift, rotation, position, p, anchor, fixed)
        d = _body_direction(directions, i, b, rotation, p, fixed)
        n = facet_normal(vertices, faces, face[i])
        away = plane_height(vertices, faces, face[i], n, o)
        high[i], low[i] = plane_distance(vertices, faces, face[i], n, away, o, d)
        x, y, z = _world_normal(n, rotation, p, fixed)
        along = x * directions[i, b, 0] + y * directions[i, b, 1] + z * directions[i, b, 2]
        sign = -1.0 if along > 0.0 else 1.0
        normal[i, 0], normal[i, 1], normal[i, 2] = sign * x, sign * y, sign * z
        cosine[i] = abs(along)


@njit(cache=True, nogil=True, error_model="numpy")
def finish_bundles(mesh, frame, number, origins, directions, hit, centre, result):
    """Relative ranges and cosines of the beamlets that hit one body.

    Parameters
    ----------
    mesh, frame
        As in `finish_rays`.
    number : int
        This body's number.
    origins, directions : (n, 3), (n, b, 3) float64
        In the world's frame.
    hit : ((n, b), (n, b))
        Face and body that each beamlet hits.
    centre : ((n,), (n,), (n,), (n, 3))
        Beamlet that each bundle's ranges are relative to, its range (high, low) and normal.
    result : ((n, b), (n, b))
        Range less the centre's [m], cosine of incidence: filled in where `body` is `number`.
    """
    vertices, faces = mesh
    shift, rotation, position, anchor, fixed = frame
    face, body = hit
    reference, high, low, normal = centre
    offset, cosine = result
    step = 0 if rotation.shape[0] == 1 else 1
    for i in range(face.shape[0]):
        p, r, known = i * step, reference[i], -1
        for b in range(face.shape[1]):
            if body[i, b] != number:
                continue
            if body[i, r] == number and face[i, r] == face[i, b]:
                along, across = _slopes(directions, i, r, b, normal)
                offset[i, b], cosine[i, b] = -high[i] * across / along, abs(along)
                continue
            if face[i, b] != known:  # the beamlet before may have met the same facet
                known = face[i, b]
                o = body_origin(origins, i, shift, rotation, position, p, anchor, fixed)
                n = facet_normal(vertices, faces, known)
                away = plane_height(vertices, faces, known, n, o)
                x, y, z = _world_normal(n, rotation, p, fixed)
            d = _body_direction(directions, i, b, rotation, p, fixed)
            t_high, t_low = plane_distance(vertices, faces, known, n, away, o, d)
            offset[i, b] = (t_high - high[i]) + (t_low - low[i])
            cosine[i, b] = abs(
                x * directions[i, b, 0] + y * directions[i, b, 1] + z * directions[i, b, 2]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(directions, i, r, b, normal):
    """Products of bundle i's normal with beamlet b's direction, and with that less r's."""
    along, across = 0.0, 0.0
    for k in range(3):
        along += normal[i, k] * directions[i, b, k]
        across += normal[i, k] * (directions[i, b, k] - directions[i, r, k])
    return along, across
