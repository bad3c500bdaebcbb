"""What is kept of rays and of what they hit, besides ranges: compiled passes over many of them."""

from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def are_units(directions, tolerance):
    """Whether all vectors (n, 3) have length 1 within a tolerance; nan has not."""
    for i in range(directions.shape[0]):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        if not abs(x * x + y * y + z * z - 1.0) < 2.0 * tolerance:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def take_nearer(found, number, face, body):
    """Put a body's triangles where it was found nearer than those before, (n,); -1 for not."""
    for i in range(found.size):
        if found[i] >= 0:
            face[i], body[i] = found[i], number


@njit(cache=True, nogil=True, error_model="numpy")
def first_hits(face, first):
    """First beamlet (n,) of each bundle that hits anything; -1 where all miss."""
    for i in range(face.shape[0]):
        first[i] = -1
        for b in range(face.shape[1]):
            if face[i, b] >= 0:
                first[i] = b
                break


@njit(cache=True, nogil=True, error_model="numpy")
def put_surfaces(surfaces, number, face, body, result):
    """Put surfaces in, by triangle of one body, where this is what is hit, (n,)."""
    for i in range(face.size):
        if body[i] == number:
            result[i] = surfaces[face[i]]
