"""Readers of terrain: georeferenced rasters, NumPy arrays, grey images, and a sample survey."""

from __future__ import annotations

import glob
import hashlib
import math
import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sweep.scenes.height_checks import cliff_warnings, set_missing_heights_to_nan
from sweep.scenes.map_frames import (
    UserStatedUnits,
    degree_lengths,
    make_map_frame,
    resolve_metres_per_height_unit,
)
from sweep.scenes.scene_files import SceneError, require_file, require_memory
from sweep.scenes.terrain import AreaBounds, Terrain

GRID_CELLS_MAX = 50_000_000
"""Largest number of heights of a terrain. Each height makes about two triangles."""

RASTER_FILE_CELLS_MAX = 1_000_000_000
"""Largest number of heights in a raster file. All are read to compute the file's digest."""

TRIANGULATION_BYTES_PER_CELL = 220
"""Memory per height for building triangles and their ray-casting tree, at most [bytes].

The value was measured.
"""

_READ_STRIP_CELLS = 1 << 22
"""Number of heights that are read from a raster file in one strip."""

_GDAL_OFFLINE_OPTIONS = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "none",
    "GDAL_HTTP_PROXY": "127.0.0.1:1",  # a port without a server
    "GDAL_HTTPS_PROXY": "127.0.0.1:1",
    "GDAL_HTTP_MAX_RETRY": "0",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_VRT_ENABLE_RAWRASTERBAND": "NO",
}
"""Options that keep GDAL from fetching or running anything that a raster file names."""

_GDAL_DRIVERS = (
    "GTiff", "AAIGrid", "GRASSASCIIGrid", "EHdr", "ENVI", "HFA", "PNG", "JPEG", "BMP", "SRTMHGT",
    "USGSDEM", "DTED", "GSAG", "GSBG", "GS7BG", "XYZ", "SAGA", "RST", "PDS", "ISIS2", "ISIS3",
    "VICAR", "JP2OpenJPEG", "netCDF",
)  # fmt: skip
"""Names of the GDAL drivers of raster formats that can be read.

Files of these formats are local, and refer to no other files.
"""

_IMAGE_FORMATS = ("PNG", "TIFF", "JPEG", "BMP", "PPM", "WEBP")
"""Formats of grey images that can be read.

Readers of other formats may run programs.
"""

_VRT_BYTES_MAX = 1 << 26
"""Largest permitted size of a virtual raster's file [bytes]."""
_VRT_NESTING_MAX = 8
"""Largest permitted depth to which virtual rasters are nested."""


def read_raster_terrain(
    path: str | Path,
    *,
    band: int = 1,
    window: AreaBounds | None = None,
    metres_per_degree: tuple[float, float] | None = None,
    metres_per_unit: tuple[float, float] | None = None,
    height_unit: str | None = None,
    no_data: float | None = None,
    pixel: float | None = None,
    has_height_scale: bool = False,
) -> Terrain:
    """Read a georeferenced raster, such as a GeoTIFF, or a window of it.

    Nodes of the terrain lie at the centres of the pixels. Pixels without data, or with the value
    `no_data`, are holes. The raster's own scale and offset are applied, and feet are converted to
    metres.

    Parameters
    ----------
    path : str or Path
        File of the raster.
    band : int
        Band with the heights, from 1.
    window : tuple of float, optional
        West, south, east and north of the part to read, in the raster's coordinates.
    metres_per_degree : (float, float), optional
        Metres per degree east and north; required for a raster in degrees.
    metres_per_unit : (float, float), optional
        Metres on the ground per unit of the map's coordinates, east and north; required if the
        map's scale differs from that of the ground (:mod:`sweep.scenes.map_frames`).
    height_unit : str, optional
        Unit of the heights, if the file does not state it.
    no_data : float, optional
        Value that stands for a missing height.
    pixel : float, optional
        Size of a pixel [m], for a raster without a scale. Its lower left corner is then the world's
        origin.
    has_height_scale : bool
        True if the spec has a factor for the heights, so that their unit is known.

    Returns
    -------
    Terrain
        Heights in metres, in the raster's coordinates converted to metres.

    Raises
    ------
    SceneError
        If the file is missing, no raster, without scale, rotated, too large or without heights; if
        the band or window does not exist; or if the size of a unit is unknown.
    """
    path = require_file(path)
    with open_raster(path) as raster:
        if not 1 <= band <= raster.count:
            raise SceneError(
                path, f"has {raster.count} band(s), not a band {band}", "choose another"
            )
        transform = _require_unrotated_geotransform(path, raster, pixel)
        pixel_window = _pixel_window(path, raster, transform, window)
        x, y = (
            sorted((first, first + step * number))
            for first, step, number in (
                (transform.c + pixel_window.col_off * transform.a, transform.a, pixel_window.width),
                (
                    transform.f + pixel_window.row_off * transform.e,
                    transform.e,
                    pixel_window.height,
                ),
            )
        )
        wkt = "" if raster.crs is None else _raster_crs_wkt(path, raster)
        cell_size = math.inf if pixel is not None else min(abs(transform.a), abs(transform.e))
        stated = UserStatedUnits(metres_per_degree, metres_per_unit, height_unit)
        map_frame = make_map_frame(path, wkt, (x[0], y[0], x[1], y[1]), cell_size, stated)
        metres_per_height = resolve_metres_per_height_unit(
            path, wkt, raster.units[band - 1] or "", height_unit, has_height_scale
        )
        heights = _read_band_window_in_strips(raster, band, pixel_window)
        no_data_warnings = set_missing_heights_to_nan(path, heights, no_data)
        heights *= raster.scales[band - 1]
        heights += raster.offsets[band - 1]
        heights *= metres_per_height
    first_x = transform.c + (pixel_window.col_off + 0.5) * transform.a
    first_y = transform.f + (pixel_window.row_off + 0.5) * transform.e
    east, north = map_frame.metres_per_unit
    spacing = transform.a * east, transform.e * north
    terrain = Terrain(
        heights, spacing, np.array([first_x * east, first_y * north, 0.0]), map_frame=map_frame
    )
    return _terrain_with_warnings(path, terrain, no_data_warnings)


def _raster_crs_wkt(path: Path, raster: Any) -> str:
    """Return the coordinate reference system of a raster as WKT (well-known text)."""
    from rasterio.errors import CRSError

    try:
        return str(raster.crs.to_wkt())
    except CRSError as error:
        problem = f"has a coordinate reference system that can not be written ({error})"
        raise SceneError(path, problem, "state it anew with gdal_edit -a_srs") from None


def _terrain_with_warnings(
    path: Path, terrain: Terrain, no_data_warnings: tuple[str, ...]
) -> Terrain:
    """Return a copy of a terrain with warnings about its scale, heights and cliffs added."""
    _require_enough_heights(path, terrain.heights)
    map_warnings = () if terrain.map_frame is None else terrain.map_frame.warnings
    cliff_texts = cliff_warnings(path, terrain.heights, terrain.spacing)
    return replace(terrain, warnings=(*map_warnings, *no_data_warnings, *cliff_texts))


def raster_digest(path: str | Path) -> str:
    """Return the digest of a raster's heights, grid and coordinate reference system.

    The digest of a virtual raster is that of the heights in its source files.

    Returns
    -------
    str
        BLAKE2b digest, 32 hexadecimal digits.

    Raises
    ------
    SceneError
        If the raster can't be read or has too many heights.
    """
    path = require_file(path)
    with open_raster(path) as raster:
        if raster.width * raster.height * raster.count > RASTER_FILE_CELLS_MAX:
            size_text = f"{raster.width:,} x {raster.height:,} heights in {raster.count} band(s)"
            problem = f"declares {size_text}, more than {RASTER_FILE_CELLS_MAX:.0e}"
            raise SceneError(path, problem, "cut a part out of it with gdal_translate -projwin")
        frame = (raster.shape, raster.transform, raster.crs and raster.crs.to_wkt())
        digest = hashlib.blake2b(repr(frame).encode(), digest_size=16)
        for band in raster.indexes:
            band_scaling = raster.scales[band - 1], raster.offsets[band - 1], raster.units[band - 1]
            digest.update(repr(band_scaling).encode())
            for strip in _iter_pixel_windows(raster.width, raster.height):
                digest.update(_read_band_window(raster, band, strip).tobytes())
    return digest.hexdigest()


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """Context manager: open a raster with rasterio, without access to the network.

    Raises
    ------
    SceneError
        If the file is no raster of a supported format, or refers to data on other machines.
    """
    import rasterio

    try:
        with _gdal_without_network():
            _check_vrt_sources(path, ())
            with _open_raster_file(path) as raster:
                _require_raster_block_memory(path, raster)
                yield raster
    except rasterio.errors.RasterioError as error:
        problem = f"is no raster that can be read ({error.__cause__ or error})"
        remedy = "convert it to a GeoTIFF; nothing is fetched over the network"
        raise SceneError(path, problem, remedy) from None


def _require_raster_block_memory(path: Path, raster: Any) -> None:
    """Raise `SceneError` if a block of a raster file does not fit into the free memory.

    A block is a part of the raster that is decompressed as one.
    """
    for (rows, columns), dtype in zip(raster.block_shapes, raster.dtypes, strict=True):
        bytes_needed = 2 * rows * columns * np.dtype(dtype).itemsize
        require_memory(path, bytes_needed, "write it anew with gdal_translate -co TILED=YES")


def _open_raster_file(path: Path) -> Any:
    """Open a raster file with rasterio; raise `SceneError` if its format is not supported."""
    from rasterio.io import DatasetReader

    for sidecar in path.parent.glob(f"{glob.escape(path.stem)}.*"):
        if not (sidecar.is_file() or sidecar.is_dir()) and sidecar.exists():
            problem = f"stands beside {sidecar.name}, which is a pipe or a device"
            raise SceneError(path, problem, "remove that: it would be read as a part of the raster")
    # DatasetReader takes several drivers, unlike rasterio.open; an absolute path is never taken for
    # a URL.
    drivers = ["VRT"] if _is_virtual_raster(path) else list(_GDAL_DRIVERS)
    return DatasetReader(str(path.absolute()), driver=drivers)


@contextmanager
def _gdal_without_network() -> Iterator[None]:
    """Context manager: keep GDAL off the network, whatever the environment's proxy settings."""
    import rasterio

    proxy_exemptions = {
        name: os.environ.pop(name) for name in ("NO_PROXY", "no_proxy") if name in os.environ
    }
    try:
        with rasterio.Env(**_GDAL_OFFLINE_OPTIONS):
            yield
    finally:
        os.environ.update(proxy_exemptions)


def _is_virtual_raster(path: Path) -> bool:
    """Return True if a file begins as a virtual raster (VRT) of GDAL does."""
    with path.open("rb") as file:
        return b"<vrtdataset" in file.read(1 << 16).lower()


def _check_vrt_sources(path: Path, enclosing_files: tuple[Path, ...]) -> None:
    """Raise `SceneError` if a source file of a virtual raster is no raster on this machine.

    GDAL would read zeros for a missing source, and would fetch a remote source. `enclosing_files`
    are the virtual rasters in which the one at `path` is nested.
    """
    if not _is_virtual_raster(path):
        return
    if len(enclosing_files) > _VRT_NESTING_MAX or path in enclosing_files:
        raise SceneError(path, "is a virtual raster over itself", "name the rasters below it")
    for source in _read_vrt_source_paths(path):
        _check_vrt_sources(source, (*enclosing_files, path))
        _require_supported_format(source)


def _read_vrt_source_paths(path: Path) -> list[Path]:
    """Return the paths of the source files that a virtual raster names, without duplicates.

    `SceneError` is raised if a source file does not exist.
    """
    if path.stat().st_size > _VRT_BYTES_MAX:
        raise SceneError(path, "is no raster that can be read (too large)", "make it a GeoTIFF")
    content = path.read_bytes()
    sources: dict[Path, None] = {}
    try:
        if b"<!" in content.replace(b"<!--", b"").replace(b"<![CDATA[", b""):
            raise ElementTree.ParseError("it declares entities or a document type")
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, RecursionError, ValueError) as error:
        problem = f"is no raster that can be read ({error})"
        raise SceneError(path, problem, "make it anew with gdalbuildvrt") from None
    for element in root.iter():
        tag = str(element.tag).rpartition("}")[2].lower()  # GDAL ignores case
        if tag not in ("sourcefilename", "sourcedataset"):
            continue
        name = (element.text or "").strip()
        attributes = {key.lower(): value for key, value in element.attrib.items()}
        if "://" in name or "/vsi" in name.lower():
            problem = f"is no raster that can be read (its source is {name})"
            raise SceneError(path, problem, "fetch that: nothing is fetched over the network")
        is_relative = attributes.get("relativetovrt", "0").strip() not in ("", "0")
        sources[require_file(path.parent / name if is_relative else Path(name))] = None
    return list(sources)


def _require_supported_format(path: Path) -> None:
    """Raise `SceneError` if the format of a raster file is not supported."""
    import rasterio

    try:
        with _open_raster_file(path):
            pass
    except rasterio.errors.RasterioError as error:
        problem = f"is no raster that can be read ({error.__cause__ or error})"
        raise SceneError(path, problem, "convert it to a GeoTIFF") from None


def _require_unrotated_geotransform(path: Path, raster: Any, pixel: float | None) -> Any:
    """Return the transform from the pixels of a raster to map coordinates.

    `SceneError` is raised if the raster is rotated against its map, or has no scale. `pixel` is the
    pixel size [m] that the user states for a raster without a scale.
    """
    from rasterio import Affine

    transform = raster.transform
    if raster.crs is None and transform.is_identity:
        if pixel is None or not pixel > 0:
            remedy = "state the size of a pixel in metres, or read a grey picture as an image"
            raise SceneError(path, "states no scale", remedy)
        return Affine(pixel, 0.0, 0.0, 0.0, -pixel, raster.height * pixel)
    if pixel is not None:
        raise SceneError(path, "states its own scale", "leave the size of a pixel out")
    size = max(abs(transform.a), abs(transform.e))
    if max(abs(transform.b), abs(transform.d)) > 1e-9 * size:
        raise SceneError(path, "is rotated against its map", "straighten it with gdalwarp")
    return transform


def _pixel_window(path: Path, raster: Any, transform: Any, window: AreaBounds | None) -> Any:
    """Return the window of a raster's pixels that covers a window in map coordinates.

    If `window` is None, the result covers all of the raster. `SceneError` is raised if the result
    has too few pixels for ground, or too many.
    """
    from rasterio.windows import Window as PixelWindow

    pixel_window = PixelWindow(0, 0, raster.width, raster.height)
    if window is not None:
        west, south, east, north = window
        columns = sorted((x - transform.c) / transform.a for x in (west, east))
        rows = sorted((y - transform.f) / transform.e for y in (south, north))
        left, right = (round(min(max(c, 0), raster.width)) for c in columns)
        top, bottom = (round(min(max(r, 0), raster.height)) for r in rows)
        if not (west < east and south < north and right - left > 1 and bottom - top > 1):
            coverage_text = f"it covers {tuple(raster.bounds)}"
            raise SceneError(path, f"has no ground within {window}", coverage_text)
        pixel_window = PixelWindow(left, top, right - left, bottom - top)
    remedy = f"give a window within {tuple(raster.bounds)}"
    refuse_too_large_grid(path, int(pixel_window.height), int(pixel_window.width), remedy)
    return pixel_window


def _iter_pixel_windows(width: int, height: int) -> Iterator[Any]:
    """Yield pixel windows that together cover a raster of `width` x `height` pixels.

    A window has several rows, or a part of one row.
    """
    from rasterio.windows import Window as PixelWindow

    rows, columns = max(_READ_STRIP_CELLS // width, 1), min(width, _READ_STRIP_CELLS)
    for top in range(0, height, rows):
        for left in range(0, width, columns):
            yield PixelWindow(left, top, min(columns, width - left), min(rows, height - top))


def _read_band_window(raster: Any, band: int, window: Any) -> np.ndarray:
    """Return the stored values (rows, columns) of a band in a window of pixels; NaN if missing."""
    values = raster.read(band, window=window, masked=True)
    return np.asarray(np.ma.filled(values.astype(float), np.nan))


def _read_band_window_in_strips(raster: Any, band: int, pixel_window: Any) -> np.ndarray:
    """Return the stored values (rows, columns) of a band in a window of pixels; NaN if missing.

    The values are read strip by strip, to save memory.
    """
    from rasterio.windows import Window as PixelWindow

    values = np.empty((int(pixel_window.height), int(pixel_window.width)))
    for strip in _iter_pixel_windows(int(pixel_window.width), int(pixel_window.height)):
        window = PixelWindow(
            pixel_window.col_off + strip.col_off,
            pixel_window.row_off + strip.row_off,
            strip.width,
            strip.height,
        )
        rows = slice(strip.row_off, strip.row_off + strip.height)
        columns = slice(strip.col_off, strip.col_off + strip.width)
        values[rows, columns] = _read_band_window(raster, band, window)
    return values


def _require_enough_heights(path: Path, heights: np.ndarray) -> None:
    """Raise `SceneError` if a grid of heights has too few of them for a triangle."""
    if min(heights.shape) < 2 or np.isfinite(heights).sum() < 3:
        raise SceneError(path, "has too few heights for a triangle", "check its no-data value")


def refuse_too_large_grid(path: Path, rows: int, columns: int, remedy: str) -> None:
    """Raise `SceneError` if a grid has too many heights for a scene or for the free memory.

    `remedy` is the advice in the error.
    """
    if rows * columns > GRID_CELLS_MAX:
        problem = f"has {columns:,} x {rows:,} heights, more than {GRID_CELLS_MAX:.0e}"
        raise SceneError(path, problem, remedy)
    require_memory(path, TRIANGULATION_BYTES_PER_CELL * rows * columns, f"{remedy}, or coarsen it")


def read_numpy_terrain(
    path: str | Path,
    *,
    spacing: tuple[float, float],
    name: str | None = None,
    no_data: float | None = None,
) -> Terrain:
    """Read the heights of a NumPy file as a terrain with its first node at the world's origin.

    Parameters
    ----------
    path : str or Path
        ``.npy`` or ``.npz`` file.
    spacing : (float, float)
        Steps from column to column and from row to row [m]; the second is negative if row 0 is the
        northern one.
    name : str, optional
        Array of an ``.npz`` file that holds several grids.
    no_data : float, optional
        Value that stands for a missing height, in addition to NaN.

    Raises
    ------
    SceneError
        If the file is missing or holds no two-dimensional array of numbers.
    """
    path = require_file(path)
    try:
        with path.open("rb") as file:
            values = _read_npy_or_npz(path, file, path.stat().st_size, name)
    except SceneError:
        raise
    except Exception as error:  # archives and headers raise many types of errors
        raise SceneError(path, f"is no NumPy file ({error})", "write it with numpy.save") from None
    return _terrain_from_heights(path, values, spacing, no_data)


def _read_npy_or_npz(path: Path, file: Any, size: int, name: str | None) -> np.ndarray:
    """Return the heights of an ``.npy`` file, or of one array of an ``.npz`` file.

    `size` is the size of the file [bytes]. `name` is the name of the array, or None for the only
    two-dimensional one.
    """
    if not zipfile.is_zipfile(file):
        file.seek(0)
        return _read_npy_data(path, file, size)
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        entries = {
            entry.filename.removesuffix(".npy"): entry
            for entry in archive.infolist()
            if entry.filename.endswith(".npy")
        }
        remedy = f"name one of: {', '.join(entries)}"
        if name is None:
            grid_names = []
            for key, entry in entries.items():
                with archive.open(entry) as stream:
                    if len(_read_npy_header(stream)[0]) == 2:
                        grid_names.append(key)
            if len(grid_names) != 1:
                raise SceneError(path, f"holds {len(grid_names)} grids", remedy)
            name = grid_names[0]
        if name not in entries:
            raise SceneError(path, f"holds no '{name}'", remedy)
        with archive.open(entries[name]) as stream:
            return _read_npy_data(path, stream, entries[name].file_size)


def _read_npy_header(file: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the header of a NumPy file; return the shape and data type of its array."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        read_header = np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    return shape, dtype


def _read_npy_data(path: Path, file: Any, size: int) -> np.ndarray:
    """Return the array of an open NumPy file of `size` bytes.

    The shape and size in the file's header are checked first.
    """
    shape, dtype = _read_npy_header(file)
    if len(shape) != 2 or dtype.kind not in "iuf":
        problem = f"holds {dtype} of shape {shape}"
        raise SceneError(path, problem, "heights are a two-dimensional array of numbers")
    refuse_too_large_grid(path, *shape, "cut a part out of it")
    if file.tell() + math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"its header tells of shape {shape}, and {size:,} bytes are too few")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _terrain_from_heights(
    path: Path, values: np.ndarray, spacing: tuple[float, float], no_data: float | None = None
) -> Terrain:
    """Return a terrain with given heights, and with its first node at the world's origin."""
    if min(values.shape) < 2:
        problem = f"holds {values.dtype} of shape {values.shape}"
        raise SceneError(path, problem, "heights are a two-dimensional array of numbers")
    heights = values.astype(float)
    no_data_warnings = set_missing_heights_to_nan(path, heights, no_data)
    _require_enough_heights(path, heights)
    try:
        terrain = Terrain(heights, spacing, np.zeros(3))
    except ValueError as error:
        raise SceneError(path, str(error), "state steps in metres") from None
    return _terrain_with_warnings(path, terrain, no_data_warnings)


def read_image_terrain(
    path: str | Path, *, pixel: float, black: float = 0.0, white: float
) -> Terrain:
    """Read a grey image of 8 or 16 bits as a terrain.

    The first pixel lies at the world's origin. Row 0 is the northernmost row. Heights are linear in
    the grey level, and therefore have steps: smooth them before using slopes.

    Parameters
    ----------
    path : str or Path
        File of the image.
    pixel : float
        Size of a pixel [m].
    black, white : float
        Heights of black and of full white [m].

    Raises
    ------
    SceneError
        If the file is missing, no image, in colour, or of another depth than 8 or 16 bits.
    """
    levels = _read_grey_levels(require_file(path))
    heights = black + (white - black) * levels / np.iinfo(levels.dtype).max
    return _terrain_from_heights(Path(path), heights, (pixel, -pixel))


def _read_grey_levels(path: Path) -> np.ndarray:
    """Return the stored grey levels (rows, columns) of an image, as uint8 or uint16."""
    from PIL import Image

    try:
        with warnings.catch_warnings():  # refuse_too_large_grid refuses images that are too large
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_IMAGE_FORMATS) as image:
                refuse_too_large_grid(path, image.height, image.width, "cut a part out of it")
                mode, levels = image.mode, np.asarray(image)
    except SceneError:
        raise
    except Exception as error:  # image readers raise many types of errors
        raise SceneError(path, f"is no image that can be read ({error})", "use PNG") from None
    if mode == "RGB" and (levels[..., :1] == levels).all():
        return np.asarray(levels[..., 0])
    if mode != "L" and not mode.startswith("I;16"):
        remedy = "save it in grey, 8 or 16 bits a pixel"
        raise SceneError(path, f"has pixels of mode {mode}", remedy)
    return np.asarray(levels, np.uint8 if mode == "L" else np.uint16)


def read_jacksboro_terrain() -> Terrain:
    """Return the terrain around the Jacksboro fault in Tennessee, 30 km x 32 km.

    Matplotlib's sample data contain this USGS survey with a grid step of 3 arc seconds. World x and
    y are measured from the survey's centre [m], heights from sea level.
    """
    from matplotlib.cbook import get_sample_data

    sample: Any = get_sample_data("jacksboro_fault_dem.npz")
    with sample as survey:
        heights = survey["elevation"].astype(float)
        dx, dy = float(survey["dx"]), float(survey["dy"])
        # The sample calls its northern edge ymin, which does not change the middle latitude.
        middle_latitude = (float(survey["ymin"]) + float(survey["ymax"])) / 2
    east, north = degree_lengths(middle_latitude)
    spacing = dx * east, -dy * north
    rows, columns = heights.shape
    west, top = -(columns - 1) / 2 * spacing[0], -(rows - 1) / 2 * spacing[1]
    return Terrain(heights, spacing, np.array([west, top, 0.0]))
