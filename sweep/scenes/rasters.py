"""Heights from files: georeferenced rasters, NumPy arrays, grey images, and a sample survey."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from sweep.scenes.files import SceneError, existing
from sweep.scenes.terrain import Bounds, Terrain

MOST_CELLS = 50_000_000
"""Heights read at once at most: 100 million triangles."""

#: Rows that a digest is taken of at a time.
_ROWS = 256

#: For GDAL: it opens no address as a file, and its requests go to a port where nobody answers.
_NO_NETWORK = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "none", "GDAL_HTTP_PROXY": "127.0.0.1:1",
}  # fmt: skip

_SOURCE = re.compile(r"<Source(?:Filename|Dataset)([^>]*)>([^<]*)<")
_SUBDATASET = re.compile(r"[A-Z0-9_]{2,}:")
_LARGEST_VRT = 1 << 26

_METRES = dict.fromkeys(("", "m", "metre", "meter", "metres", "meters"), 1.0) | {
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "us survey foot": 1200 / 3937,
}  # fmt: skip

WGS84_RADIUS, WGS84_FLATTENING = 6_378_137.0, 1 / 298.257223563


def read_raster(
    path: str | Path,
    *,
    band: int = 1,
    window: Bounds | None = None,
    metres_per_degree: tuple[float, float] | None = None,
    pixel: float | None = None,
) -> Terrain:
    """Terrain of a georeferenced raster, such as a GeoTIFF, or of a window (W, S, E, N) of it.

    Nodes lie at the centres of the pixels; those without data are holes. The raster's own scale
    and offset are applied, and feet are turned into metres. One in degrees needs metres per
    degree, east and north; one without a scale the size of a pixel [m], its lower left corner
    being the world's origin.

    SceneError for a file that is missing, no raster, without scale, rotated, in degrees whose
    size is not stated, too large, or without any height; or a band or window that it does not
    have.
    """
    path = existing(path)
    with _opened(path) as data:
        if not 1 <= band <= data.count:
            raise SceneError(path, f"has {data.count} band(s), not a band {band}", "choose another")
        transform = _straight(path, data, pixel)
        east, north = _scale(path, data, metres_per_degree)
        view = _view(path, data, transform, window)
        heights = _heights(path, data, band, view)
    left = transform.c + (view.col_off + 0.5) * transform.a
    top = transform.f + (view.row_off + 0.5) * transform.e
    spacing = transform.a * east, transform.e * north
    return Terrain(heights, spacing, np.array([left * east, top * north, 0.0]))


def raster_digest(path: str | Path) -> str:
    """Digest of a raster's heights, spacing and frame, wherever they come from; or SceneError."""
    from rasterio.windows import Window as Pixels

    path = existing(path)
    with _opened(path) as data:
        frame = (data.shape, data.transform, data.crs and data.crs.to_wkt())
        digest = hashlib.blake2b(repr(frame).encode(), digest_size=16)
        for band in data.indexes:
            scale = data.scales[band - 1], data.offsets[band - 1], data.units[band - 1]
            digest.update(repr(scale).encode())
            for top in range(0, data.height, _ROWS):
                rows = Pixels(0, top, data.width, min(_ROWS, data.height - top))
                digest.update(_values(data, band, rows).tobytes())
    return digest.hexdigest()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Dataset of a raster. No source on another machine that it names is asked for anything."""
    import rasterio

    _look_for_sources(path, set())
    try:
        with rasterio.Env(**_NO_NETWORK), rasterio.open(path) as data:
            yield data
    except rasterio.errors.RasterioError as error:
        rule = f"is no raster that can be read ({error.__cause__ or error})"
        remedy = "convert it to a GeoTIFF; nothing is fetched over the network"
        raise SceneError(path, rule, remedy) from None


def _look_for_sources(path: Path, seen: set[Path]) -> None:
    """Refuse a .vrt with sources that are no files here: GDAL may take zeros for what is lost."""
    with path.open("rb") as file:
        content = file.read(_LARGEST_VRT) if b"<VRTDataset" in file.peek(1024)[:1024] else b""
    for attributes, name in _SOURCE.findall(content.decode(errors="replace")):
        if "://" in name or "/vsi" in name:
            rule = f"is no raster that can be read (its source is {name})"
            raise SceneError(path, rule, "fetch that: nothing is fetched over the network")
        source = path.parent / unescape(name) if '"1"' in attributes else Path(unescape(name))
        if source not in seen and not _SUBDATASET.match(name):
            _look_for_sources(existing(source), seen | {source})


def _straight(path: Path, data: Any, pixel: float | None) -> Any:
    """Geotransform of a raster whose rows run along x."""
    from rasterio import Affine

    transform = data.transform
    if data.crs is None and transform.is_identity:
        if pixel is None or not pixel > 0:
            remedy = "state the size of a pixel in metres, or read a grey picture as an image"
            raise SceneError(path, "states no scale", remedy)
        return Affine(pixel, 0.0, 0.0, 0.0, -pixel, data.height * pixel)
    if pixel is not None:
        raise SceneError(path, "states its own scale", "leave the size of a pixel out")
    size = max(abs(transform.a), abs(transform.e))
    if max(abs(transform.b), abs(transform.d)) > 1e-9 * size:
        raise SceneError(path, "is rotated against its map", "straighten it with gdalwarp")
    return transform


def _scale(path: Path, data: Any, stated: tuple[float, float] | None) -> tuple[float, float]:
    """Metres of a unit of the raster's coordinates, eastwards and northwards."""
    if data.crs is not None and data.crs.is_geographic:
        if stated is None:
            rule, sizes = "is in degrees, which have no fixed size in metres", _suggestion(data)
            remedy = f"state metres_per_degree, here {sizes}, or reproject it with gdalwarp"
            raise SceneError(path, rule, remedy)
        if not min(stated) > 0:
            raise SceneError(path, f"has a degree of {stated} m", "make both sizes positive")
        return stated
    if stated is not None:
        raise SceneError(path, "is not in degrees", "leave metres_per_degree out")
    factor = 1.0 if data.crs is None else float(data.crs.linear_units_factor[1])
    return factor, factor


def _suggestion(data: Any) -> str:
    """Size of a degree in the middle of a raster in degrees, on its own ellipsoid."""
    middle = (data.bounds.bottom + data.bounds.top) / 2
    described = data.crs.to_dict(projjson=True)
    datum = described.get("datum") or described.get("datum_ensemble") or {}
    ellipsoid = datum.get("ellipsoid", {})
    if "radius" in ellipsoid:
        sizes = degree_at(middle, radius=float(ellipsoid["radius"]), flattening=0.0)
    elif "inverse_flattening" in ellipsoid:
        radius, inverse = ellipsoid["semi_major_axis"], ellipsoid["inverse_flattening"]
        sizes = degree_at(middle, radius=float(radius), flattening=1 / float(inverse))
    else:
        sizes = degree_at(middle)
    return f"[{sizes[0]:.1f}, {sizes[1]:.1f}]"


def _view(path: Path, data: Any, transform: Any, window: Bounds | None) -> Any:
    """Rows and columns to read."""
    from rasterio.windows import Window as Pixels

    view = Pixels(0, 0, data.width, data.height)
    if window is not None:
        west, south, east, north = window
        columns = sorted((x - transform.c) / transform.a for x in (west, east))
        rows = sorted((y - transform.f) / transform.e for y in (south, north))
        left, right = (round(min(max(c, 0), data.width)) for c in columns)
        top, bottom = (round(min(max(r, 0), data.height)) for r in rows)
        if not (west < east and south < north and right - left > 1 and bottom - top > 1):
            covered = f"it covers {tuple(data.bounds)}"
            raise SceneError(path, f"has no ground within {window}", covered)
        view = Pixels(left, top, right - left, bottom - top)
    if view.width * view.height > MOST_CELLS:
        rule = f"has {view.width:.0f} x {view.height:.0f} heights, more than {MOST_CELLS:.0e}"
        raise SceneError(path, rule, f"give a window within {tuple(data.bounds)}")
    return view


def _values(data: Any, band: int, view: Any) -> np.ndarray:
    """Values of a band as they are stored, NaN where there are none."""
    values = data.read(band, window=view, masked=True)
    return np.asarray(np.ma.filled(values.astype(float), np.nan))


def _heights(path: Path, data: Any, band: int, view: Any) -> np.ndarray:
    """Heights [m], NaN where the raster has no data."""
    heights = _values(data, band, view)
    heights[~np.isfinite(heights)] = np.nan
    _require_heights(path, heights)
    unit = (data.units[band - 1] or "").strip().lower()
    if unit not in _METRES:
        raise SceneError(path, f"has heights in '{unit}'", "convert them to metres with gdal_calc")
    return (heights * data.scales[band - 1] + data.offsets[band - 1]) * _METRES[unit]


def _require_heights(path: Path, heights: np.ndarray) -> None:
    if min(heights.shape) < 2 or np.isfinite(heights).sum() < 3:
        raise SceneError(path, "has too few heights for a triangle", "check its no-data value")


def read_array(
    path: str | Path,
    *,
    spacing: tuple[float, float],
    name: str | None = None,
    no_data: float | None = None,
) -> Terrain:
    """Terrain of a NumPy file, ``.npy`` or ``.npz``, whose first height is at the world's origin.

    Steps from column to column and from row to row [m]; dy < 0 where row 0 is the northern one.
    An ``.npz`` of several grids needs the name of one; a value may stand for missing heights,
    as NaN does. SceneError for a file that is missing or holds no grid of numbers.
    """
    path = existing(path)
    try:
        loaded: Any = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise SceneError(path, f"is no NumPy file ({error})", "write it with numpy.save") from None
    if isinstance(loaded, np.ndarray):
        return _grid(path, loaded, spacing, no_data)
    with loaded:
        return _grid(path, _member(path, loaded, name), spacing, no_data)


def _member(path: Path, loaded: Any, name: str | None) -> np.ndarray:
    """Return the array of an archive that holds the heights."""
    choose = f"name one of: {', '.join(loaded.files)}"
    if name is None:
        grids = [key for key in loaded.files if loaded[key].ndim == 2]
        if len(grids) != 1:
            raise SceneError(path, f"holds {len(grids)} grids", choose)
        name = grids[0]
    if name not in loaded.files:
        raise SceneError(path, f"holds no '{name}'", choose)
    return np.asarray(loaded[name])


def _grid(
    path: Path, values: np.ndarray, spacing: tuple[float, float], no_data: float | None = None
) -> Terrain:
    """Terrain of an array of heights."""
    if values.ndim != 2 or min(values.shape) < 2 or values.dtype.kind not in "iuf":
        rule = f"holds {values.dtype} of shape {values.shape}"
        raise SceneError(path, rule, "heights are a two-dimensional array of numbers")
    if values.size > MOST_CELLS:
        raise SceneError(path, f"holds more than {MOST_CELLS:.0e} heights", "cut a part out of it")
    heights = values.astype(float)
    heights[~np.isfinite(heights) | (values == no_data)] = np.nan
    _require_heights(path, heights)
    try:
        return Terrain(heights, spacing, np.zeros(3))
    except ValueError as error:
        raise SceneError(path, str(error), "state steps in metres") from None


def read_image(path: str | Path, *, pixel: float, black: float = 0.0, white: float) -> Terrain:
    """Terrain of a grey image: row 0 is the northern one, its first pixel at the world's origin.

    Heights [m] are from that of black to that of full white, in steps of one grey level: smooth
    them before trusting slopes. SceneError for a file that is missing, no image, in colour, or
    of another depth than 8 or 16 bits.
    """
    levels = _grey(existing(path))
    heights = black + (white - black) * levels / np.iinfo(levels.dtype).max
    return _grid(Path(path), heights, (pixel, -pixel))


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
        remedy = "save it in grey, 8 or 16 bits a pixel"
        raise SceneError(path, f"has pixels of mode {mode}", remedy)
    return np.asarray(levels, np.uint8 if mode == "L" else np.uint16)


def degree_at(
    latitude: float, *, radius: float = WGS84_RADIUS, flattening: float = WGS84_FLATTENING
) -> tuple[float, float]:
    """Metres of a degree of longitude and of latitude at a geodetic latitude [deg].

    Over a grid of h degrees the east-west scale is off by up to ``tan(latitude) h/2`` at its
    edges.
    """
    square = flattening * (2 - flattening)
    phi = math.radians(latitude)
    shrink = 1 - square * math.sin(phi) ** 2
    across = radius / math.sqrt(shrink)
    along = radius * (1 - square) / shrink**1.5
    return math.radians(across * math.cos(phi)), math.radians(along)


def jacksboro() -> Terrain:
    """Heights of the Jacksboro fault, Tennessee, that come with matplotlib: 30 km by 32 km.

    From a survey at 3 arc seconds (USGS). World coordinates are metres from its middle; heights
    are above sea level.
    """
    from matplotlib.cbook import get_sample_data

    sample: Any = get_sample_data("jacksboro_fault_dem.npz")
    with sample as data:
        heights = data["elevation"].astype(float)
        dx, dy = float(data["dx"]), float(data["dy"])
        # The sample names its northern edge ymin; the grid's middle is the same either way.
        middle = (float(data["ymin"]) + float(data["ymax"])) / 2
    east, north = degree_at(middle)
    spacing = dx * east, -dy * north
    rows, columns = heights.shape
    west, top = -(columns - 1) / 2 * spacing[0], -(rows - 1) / 2 * spacing[1]
    return Terrain(heights, spacing, np.array([west, top, 0.0]))
