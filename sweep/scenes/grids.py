"""Heights from NumPy arrays and from grey images, whose scale is stated beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sweep.scenes.errors import SceneError, existing
from sweep.scenes.raster import MOST_CELLS
from sweep.scenes.terrain import Terrain

Origin = Sequence[float]


def read_array(
    path: str | Path,
    *,
    spacing: tuple[float, float],
    origin: Origin = (0.0, 0.0, 0.0),
    name: str | None = None,
    no_data: float | None = None,
) -> Terrain:
    """Terrain of a NumPy file, ``.npy`` or ``.npz``.

    Parameters
    ----------
    path : str or Path
        The file.
    spacing : (dx, dy) of float
        Step from column to column and from row to row [m]; dy < 0 where row 0 is the northern one.
    origin : (3,) sequence of float
        World position of element (0, 0) at height 0 [m].
    name : str, optional
        Array of an ``.npz`` that holds the heights [m]; not needed where it holds only one grid.
    no_data : float, optional
        Value that stands for a missing height, beside NaN.

    Raises
    ------
    SceneError
        For a file that is missing or holds no grid of numbers.
    """
    path = existing(path)
    try:
        loaded = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise SceneError(path, f"is no NumPy file ({error})", "write it with numpy.save") from None
    if isinstance(loaded, np.ndarray):
        return grid(path, loaded, spacing=spacing, origin=origin, no_data=no_data)
    with loaded:
        return grid(
            path, _member(path, loaded, name), spacing=spacing, origin=origin, no_data=no_data
        )


def _member(path: Path, loaded: Any, name: str | None) -> np.ndarray:
    """The array of an archive that holds the heights."""
    if name is None:
        grids = [key for key in loaded.files if loaded[key].ndim == 2]
        if len(grids) != 1:
            raise SceneError(
                path, f"holds {len(grids)} grids", f"name one of: {', '.join(loaded.files)}"
            )
        name = grids[0]
    if name not in loaded.files:
        raise SceneError(path, f"holds no '{name}'", f"name one of: {', '.join(loaded.files)}")
    return np.asarray(loaded[name])


def grid(
    path: str | Path,
    values: np.ndarray,
    *,
    spacing: tuple[float, float],
    origin: Origin,
    no_data: float | None = None,
) -> Terrain:
    """Terrain of an array of heights.

    Raises
    ------
    SceneError
        For an array that is no grid of numbers, or steps or an origin that are none.
    """
    if values.ndim != 2 or min(values.shape) < 2 or values.dtype.kind not in "iuf":
        raise SceneError(
            path,
            f"holds {values.dtype} of shape {values.shape}",
            "heights are a two-dimensional array of numbers",
        )
    if values.size > MOST_CELLS:
        raise SceneError(path, f"holds more than {MOST_CELLS:.0e} heights", "cut a part out of it")
    heights = values.astype(float)
    if no_data is not None:
        heights[values == no_data] = np.nan
    heights[~np.isfinite(heights)] = np.nan
    if np.isfinite(heights).sum() < 3:
        raise SceneError(path, "has too few heights for a triangle", "check its no-data value")
    try:
        return Terrain(heights, (float(spacing[0]), float(spacing[1])), np.asarray(origin, float))
    except ValueError as error:
        raise SceneError(path, str(error), "state steps in metres") from None


def read_image(
    path: str | Path,
    *,
    pixel: float,
    black: float = 0.0,
    white: float,
    origin: Origin = (0.0, 0.0, 0.0),
) -> Terrain:
    """Terrain of a grey image: black is low, white is high, row 0 is the northern one.

    Heights come in steps of one grey level: smooth them before trusting slopes
    (`sweep.scenes.terrain.smooth`).

    Parameters
    ----------
    path : str or Path
        Image of 8 or 16 bits, one band.
    pixel : float
        Size of a pixel on the ground [m], > 0.
    black, white : float
        Heights of black and of full white [m].
    origin : (3,) sequence of float
        World position of the south-western pixel's centre at height 0 [m].

    Raises
    ------
    SceneError
        For a file that is missing, no image, in colour, or of another depth; or no scale.
    """
    path = existing(path)
    if not (pixel > 0 and np.isfinite([pixel, black, white]).all()):
        raise SceneError(path, f"has pixels of {pixel} m", "state a positive size and two heights")
    levels = _grey(path)
    heights = black + (white - black) * levels / np.iinfo(levels.dtype).max
    north = origin[1] + (levels.shape[0] - 1) * pixel
    corner = (origin[0], north, origin[2])
    return grid(path, heights, spacing=(pixel, -pixel), origin=corner)


def _grey(path: Path) -> np.ndarray:
    """Grey levels of an image, as stored."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            mode, levels = image.mode, np.asarray(image)
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
        raise SceneError(path, f"is no image that can be read ({error})", "use PNG") from None
    if mode == "RGB" and (levels[..., :1] == levels).all():
        return np.asarray(levels[..., 0])
    if mode != "L" and not mode.startswith("I;16"):
        raise SceneError(
            path, f"has pixels of mode {mode}", "save it in grey, 8 or 16 bits a pixel"
        )
    return np.asarray(levels, np.uint8 if mode == "L" else np.uint16)
