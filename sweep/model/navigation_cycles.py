"""Measurement cycles as navigation takes them: one row each, checked, with a level frame."""

import numpy as np


def flat_cycles(
    direction: np.ndarray,
    value: np.ndarray,
    standard_error: np.ndarray,
    valid: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Directions (n, b, 3), values, errors and mask (n, b), and the shape that n stands for."""
    u, value, error = (np.asarray(a, float) for a in (direction, value, standard_error))
    if u.shape[-1:] != (3,):
        raise ValueError(f"directions have three components: (..., b, 3), not {u.shape}")
    mask = np.isfinite(value) if valid is None else np.asarray(valid, bool)
    shape = np.broadcast_shapes(u.shape[:-1], value.shape, error.shape, mask.shape)
    if not shape:
        raise ValueError("a cycle of beams has a dimension for them, the last: (..., b)")
    u = np.ascontiguousarray(np.broadcast_to(u, (*shape, 3))).reshape(-1, shape[-1], 3)
    value, error, mask = (
        np.ascontiguousarray(np.broadcast_to(a, shape)).reshape(-1, shape[-1])
        for a in (value, error, mask)
    )
    if not np.isfinite(value[mask]).all():
        raise ValueError("a valid beam has a value that is not finite")
    if not (np.isfinite(error[mask]) & (error[mask] > 0)).all():
        raise ValueError("a valid beam has a standard error that is not positive and finite")
    if not (np.abs(np.linalg.norm(u[mask], axis=-1) - 1) < 1e-6).all():
        raise ValueError("a valid beam has a direction whose length is not 1")
    return u, value, error, mask, shape[:-1]


def level_frame(up: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Two horizontal unit vectors and the vertical as rows, (..., 3, 3).

    x, y, z themselves for an upward z. Without a singular direction, after Duff et al. (2017),
    "Building an orthonormal basis, revisited".
    """
    z = np.asarray(up, float)
    if z.shape[-1:] != (3,) or not (np.abs(np.linalg.norm(z, axis=-1) - 1) < 1e-6).all():
        raise ValueError("the vertical is a unit vector (..., 3)")
    sign = np.copysign(1.0, z[..., 2])
    a = -1 / (sign + z[..., 2])
    b = z[..., 0] * z[..., 1] * a
    x = np.stack([1 + sign * z[..., 0] ** 2 * a, sign * b, -sign * z[..., 0]], axis=-1)
    y = np.stack([b, sign + z[..., 1] ** 2 * a, -z[..., 1]], axis=-1)
    return np.stack([x, y, z], axis=-2)
