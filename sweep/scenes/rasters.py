"""Heights from files: georeferenced rasters, NumPy arrays, grey images, and a sample survey."""

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

from sweep.scenes.height_checks import cliff_warnings, mask_missing_heights
from sweep.scenes.map_frames import StatedUnits, degree_lengths, height_factor, make_map_frame
from sweep.scenes.scene_files import SceneError, require_file, require_memory
from sweep.scenes.terrain import AreaBounds, Terrain

GRID_CELLS_MAX = 50_000_000
"""Heights read at once at most: 100 million triangles."""

FILE_CELLS_MAX = 1_000_000_000
"""Heights of a raster's file at most: all of them are read for its digest."""

BYTES_PER_CELL = 220
"""Memory that a height takes at most while its triangles and their tree are built, measured."""

_STRIP_CELLS = 1 << 22
"""Heights that are read from a file at a time."""

_GDAL_OFFLINE_OPTIONS = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "none",
    "GDAL_HTTP_PROXY": "127.0.0.1:1",  # a port where nobody answers
    "GDAL_HTTPS_PROXY": "127.0.0.1:1",
    "GDAL_HTTP_MAX_RETRY": "0",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_VRT_ENABLE_RAWRASTERBAND": "NO",
}
"""Settings of GDAL by which nothing that a raster names is fetched or run."""

_GDAL_DRIVERS = (
    "GTiff", "AAIGrid", "GRASSASCIIGrid", "EHdr", "ENVI", "HFA", "PNG", "JPEG", "BMP", "SRTMHGT",
    "USGSDEM", "DTED", "GSAG", "GSBG", "GS7BG", "XYZ", "SAGA", "RST", "PDS", "ISIS2", "ISIS3",
    "VICAR", "JP2OpenJPEG", "netCDF",
)  # fmt: skip
"""Formats of rasters that are files of this machine and name no others."""

_IMAGE_FORMATS = ("PNG", "TIFF", "JPEG", "BMP", "PPM", "WEBP")
"""Formats of grey images. Others may run programs, or hold what is no picture."""

_VRT_BYTES_MAX = 1 << 26
_VRT_DEPTH_MAX = 8


def read_raster(
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
    """Terrain of a georeferenced raster, such as a GeoTIFF, or of a window (W, S, E, N) of it.

    Nodes lie at the centres of the pixels; those without data are holes, and so are those that
    hold the value `no_data`. The raster's own scale and offset are applied, and feet are turned
    into metres. One in degrees needs metres per degree, east and north. One on a map whose
    unit is another length on the ground needs metres per unit (:mod:`sweep.scenes.map_frames`). One
    without a scale needs the size of a pixel [m]; its lower left corner is the world's origin.
    `scaled`: a factor is to be applied to the heights, so that their unit is known.

    SceneError for a file that is missing, no raster, without scale, rotated, too large, or without
    any height. Likewise for a unit whose size is not known, and a missing band or window.
    """
    path = require_file(path)
    with open_raster(path) as raster:
        if not 1 <= band <= raster.count:
            raise SceneError(
                path, f"has {raster.count} band(s), not a band {band}", "choose another"
            )
        transform = _unrotated_transform(path, raster, pixel)
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
        wkt = "" if raster.crs is None else _crs_wkt(path, raster)
        cell_size = math.inf if pixel is not None else min(abs(transform.a), abs(transform.e))
        stated = StatedUnits(metres_per_degree, metres_per_unit, height_unit)
        map_frame = make_map_frame(path, wkt, (x[0], y[0], x[1], y[1]), cell_size, stated)
        metres_per_height = height_factor(
            path, wkt, raster.units[band - 1] or "", height_unit, has_height_scale
        )
        heights = _read_band(raster, band, pixel_window)
        no_data_warnings = mask_missing_heights(path, heights, no_data)
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
    return _add_warnings(path, terrain, no_data_warnings)


def _crs_wkt(path: Path, raster: Any) -> str:
    """Coordinate reference system of a raster as WKT."""
    from rasterio.errors import CRSError

    try:
        return str(raster.crs.to_wkt())
    except CRSError as error:
        problem = f"has a coordinate reference system that can not be written ({error})"
        raise SceneError(path, problem, "state it anew with gdal_edit -a_srs") from None


def _add_warnings(path: Path, terrain: Terrain, no_data_warnings: tuple[str, ...]) -> Terrain:
    """Terrain with warnings: of its map, the doubts given, and its cliffs."""
    _require_heights(path, terrain.heights)
    map_warnings = () if terrain.map_frame is None else terrain.map_frame.warnings
    cliff_texts = cliff_warnings(path, terrain.heights, terrain.spacing)
    return replace(terrain, warnings=(*map_warnings, *no_data_warnings, *cliff_texts))


def raster_digest(path: str | Path) -> str:
    """Digest of a raster's heights, spacing and frame, wherever they come from; or SceneError."""
    path = require_file(path)
    with open_raster(path) as raster:
        if raster.width * raster.height * raster.count > FILE_CELLS_MAX:
            size_text = f"{raster.width:,} x {raster.height:,} heights in {raster.count} band(s)"
            problem = f"declares {size_text}, more than {FILE_CELLS_MAX:.0e}"
            raise SceneError(path, problem, "cut a part out of it with gdal_translate -projwin")
        frame = (raster.shape, raster.transform, raster.crs and raster.crs.to_wkt())
        digest = hashlib.blake2b(repr(frame).encode(), digest_size=16)
        for band in raster.indexes:
            band_scaling = raster.scales[band - 1], raster.offsets[band - 1], raster.units[band - 1]
            digest.update(repr(band_scaling).encode())
            for strip in _iter_strips(raster.width, raster.height):
                digest.update(_read_window(raster, band, strip).tobytes())
    return digest.hexdigest()


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """Dataset of a raster. No source on another machine that it names is asked for anything."""
    import rasterio

    try:
        with _gdal_offline():
            _check_vrt_sources(path, ())
            with _open_dataset(path) as raster:
                _require_block_memory(path, raster)
                yield raster
    except rasterio.errors.RasterioError as error:
        problem = f"is no raster that can be read ({error.__cause__ or error})"
        remedy = "convert it to a GeoTIFF; nothing is fetched over the network"
        raise SceneError(path, problem, remedy) from None


def _require_block_memory(path: Path, raster: Any) -> None:
    """Refuse a raster whose blocks, each of which is unpacked whole, do not fit into memory."""
    for (rows, columns), dtype in zip(raster.block_shapes, raster.dtypes, strict=True):
        bytes_needed = 2 * rows * columns * np.dtype(dtype).itemsize
        require_memory(path, bytes_needed, "write it anew with gdal_translate -co TILED=YES")


def _open_dataset(path: Path) -> Any:
    """Open a raster of a format that is read, and of no other."""
    from rasterio.io import DatasetReader

    for sidecar in path.parent.glob(f"{glob.escape(path.stem)}.*"):
        if not (sidecar.is_file() or sidecar.is_dir()) and sidecar.exists():
            problem = f"stands beside {sidecar.name}, which is a pipe or a device"
            raise SceneError(path, problem, "remove that: it would be read as a part of the raster")
    # An absolute path is no address; rasterio.open would take one driver alone.
    drivers = ["VRT"] if _is_vrt(path) else list(_GDAL_DRIVERS)
    return DatasetReader(str(path.absolute()), driver=drivers)


@contextmanager
def _gdal_offline() -> Iterator[None]:
    """Environment in which GDAL fetches nothing, whatever hosts the user exempts from proxies."""
    import rasterio

    proxy_exemptions = {
        name: os.environ.pop(name) for name in ("NO_PROXY", "no_proxy") if name in os.environ
    }
    try:
        with rasterio.Env(**_GDAL_OFFLINE_OPTIONS):
            yield
    finally:
        os.environ.update(proxy_exemptions)


def _is_vrt(path: Path) -> bool:
    """Return true if GDAL would take a file for a virtual raster, by its beginning."""
    with path.open("rb") as file:
        return b"<vrtdataset" in file.read(1 << 16).lower()


def _check_vrt_sources(path: Path, enclosing_files: tuple[Path, ...]) -> None:
    """Refuse a virtual raster over what is no raster of this machine.

    GDAL may take zeros for a source that is lost, and opens sources of any format, hosts among
    them.
    """
    if not _is_vrt(path):
        return
    if len(enclosing_files) > _VRT_DEPTH_MAX or path in enclosing_files:
        raise SceneError(path, "is a virtual raster over itself", "name the rasters below it")
    for source in _vrt_sources(path):
        _check_vrt_sources(source, (*enclosing_files, path))
        _require_raster(source)


def _vrt_sources(path: Path) -> list[Path]:
    """Files that a virtual raster names, each once and existing."""
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
        tag = str(element.tag).rpartition("}")[2].lower()  # GDAL passes over their case
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


def _require_raster(path: Path) -> None:
    """Refuse a source of a virtual raster that is of no format that is read."""
    import rasterio

    try:
        with _open_dataset(path):
            pass
    except rasterio.errors.RasterioError as error:
        problem = f"is no raster that can be read ({error.__cause__ or error})"
        raise SceneError(path, problem, "convert it to a GeoTIFF") from None


def _unrotated_transform(path: Path, raster: Any, pixel: float | None) -> Any:
    """Geotransform of a raster whose rows run along x."""
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
    """Rows and columns to read."""
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
    require_grid_size(path, int(pixel_window.height), int(pixel_window.width), remedy)
    return pixel_window


def _iter_strips(width: int, height: int) -> Iterator[Any]:
    """Windows of some rows each, or of parts of a row, that make up a raster."""
    from rasterio.windows import Window as PixelWindow

    rows, columns = max(_STRIP_CELLS // width, 1), min(width, _STRIP_CELLS)
    for top in range(0, height, rows):
        for left in range(0, width, columns):
            yield PixelWindow(left, top, min(columns, width - left), min(rows, height - top))


def _read_window(raster: Any, band: int, window: Any) -> np.ndarray:
    """Values of a band in a window as they are stored, NaN where there are none."""
    values = raster.read(band, window=window, masked=True)
    return np.asarray(np.ma.filled(values.astype(float), np.nan))


def _read_band(raster: Any, band: int, pixel_window: Any) -> np.ndarray:
    """Values of a view, strip by strip, as the masks of all at once would take much memory."""
    from rasterio.windows import Window as PixelWindow

    values = np.empty((int(pixel_window.height), int(pixel_window.width)))
    for strip in _iter_strips(int(pixel_window.width), int(pixel_window.height)):
        window = PixelWindow(
            pixel_window.col_off + strip.col_off,
            pixel_window.row_off + strip.row_off,
            strip.width,
            strip.height,
        )
        rows = slice(strip.row_off, strip.row_off + strip.height)
        columns = slice(strip.col_off, strip.col_off + strip.width)
        values[rows, columns] = _read_window(raster, band, window)
    return values


def _require_heights(path: Path, heights: np.ndarray) -> None:
    if min(heights.shape) < 2 or np.isfinite(heights).sum() < 3:
        raise SceneError(path, "has too few heights for a triangle", "check its no-data value")


def require_grid_size(path: Path, rows: int, columns: int, remedy: str) -> None:
    """Refuse a grid of more heights than a scene takes, or than the memory holds."""
    if rows * columns > GRID_CELLS_MAX:
        problem = f"has {columns:,} x {rows:,} heights, more than {GRID_CELLS_MAX:.0e}"
        raise SceneError(path, problem, remedy)
    require_memory(path, BYTES_PER_CELL * rows * columns, f"{remedy}, or coarsen it")


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
    path = require_file(path)
    try:
        with path.open("rb") as file:
            values = _read_npy_or_npz(path, file, path.stat().st_size, name)
    except SceneError:
        raise
    except Exception as error:  # archives and headers fail in as many ways
        raise SceneError(path, f"is no NumPy file ({error})", "write it with numpy.save") from None
    return _terrain_of_heights(path, values, spacing, no_data)


def _read_npy_or_npz(path: Path, file: Any, size: int, name: str | None) -> np.ndarray:
    """Heights of a file of one array, or of an archive of several."""
    if not zipfile.is_zipfile(file):
        file.seek(0)
        return _read_array_data(path, file, size)
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
                    if len(_read_array_header(stream)[0]) == 2:
                        grid_names.append(key)
            if len(grid_names) != 1:
                raise SceneError(path, f"holds {len(grid_names)} grids", remedy)
            name = grid_names[0]
        if name not in entries:
            raise SceneError(path, f"holds no '{name}'", remedy)
        with archive.open(entries[name]) as stream:
            return _read_array_data(path, stream, entries[name].file_size)


def _read_array_header(file: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array in NumPy's format, by its header alone."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        read_header = np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    return shape, dtype


def _read_array_data(path: Path, file: Any, size: int) -> np.ndarray:
    """Array in NumPy's format of a file of so many bytes, whose header is looked at first."""
    shape, dtype = _read_array_header(file)
    if len(shape) != 2 or dtype.kind not in "iuf":
        problem = f"holds {dtype} of shape {shape}"
        raise SceneError(path, problem, "heights are a two-dimensional array of numbers")
    require_grid_size(path, *shape, "cut a part out of it")
    if file.tell() + math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"its header tells of shape {shape}, and {size:,} bytes are too few")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _terrain_of_heights(
    path: Path, values: np.ndarray, spacing: tuple[float, float], no_data: float | None = None
) -> Terrain:
    """Terrain of an array of heights."""
    if min(values.shape) < 2:
        problem = f"holds {values.dtype} of shape {values.shape}"
        raise SceneError(path, problem, "heights are a two-dimensional array of numbers")
    heights = values.astype(float)
    no_data_warnings = mask_missing_heights(path, heights, no_data)
    _require_heights(path, heights)
    try:
        terrain = Terrain(heights, spacing, np.zeros(3))
    except ValueError as error:
        raise SceneError(path, str(error), "state steps in metres") from None
    return _add_warnings(path, terrain, no_data_warnings)


def read_image(path: str | Path, *, pixel: float, black: float = 0.0, white: float) -> Terrain:
    """Terrain of a grey image: row 0 is the northern one, its first pixel at the world's origin.

    Heights [m] are from that of black to that of full white, in steps of one grey level: smooth
    them before trusting slopes. SceneError for a file that is missing, no image, in colour, or
    of another depth than 8 or 16 bits.
    """
    levels = _read_grey_levels(require_file(path))
    heights = black + (white - black) * levels / np.iinfo(levels.dtype).max
    return _terrain_of_heights(Path(path), heights, (pixel, -pixel))


def _read_grey_levels(path: Path) -> np.ndarray:
    """Grey levels of an image, as stored."""
    from PIL import Image

    try:
        with warnings.catch_warnings():  # what is too large is told below
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_IMAGE_FORMATS) as image:
                require_grid_size(path, image.height, image.width, "cut a part out of it")
                mode, levels = image.mode, np.asarray(image)
    except SceneError:
        raise
    except Exception as error:  # readers of pictures fail in as many ways
        raise SceneError(path, f"is no image that can be read ({error})", "use PNG") from None
    if mode == "RGB" and (levels[..., :1] == levels).all():
        return np.asarray(levels[..., 0])
    if mode != "L" and not mode.startswith("I;16"):
        remedy = "save it in grey, 8 or 16 bits a pixel"
        raise SceneError(path, f"has pixels of mode {mode}", remedy)
    return np.asarray(levels, np.uint8 if mode == "L" else np.uint16)


def read_jacksboro() -> Terrain:
    """Heights of the Jacksboro fault, Tennessee, that come with matplotlib: 30 km by 32 km.

    From a survey at 3 arc seconds (USGS). World coordinates are metres from its middle; heights
    are above sea level.
    """
    from matplotlib.cbook import get_sample_data

    sample: Any = get_sample_data("jacksboro_fault_dem.npz")
    with sample as survey:
        heights = survey["elevation"].astype(float)
        dx, dy = float(survey["dx"]), float(survey["dy"])
        # The sample names its northern edge ymin; the grid's middle is the same either way.
        middle_latitude = (float(survey["ymin"]) + float(survey["ymax"])) / 2
    east, north = degree_lengths(middle_latitude)
    spacing = dx * east, -dy * north
    rows, columns = heights.shape
    west, top = -(columns - 1) / 2 * spacing[0], -(rows - 1) / 2 * spacing[1]
    return Terrain(heights, spacing, np.array([west, top, 0.0]))
