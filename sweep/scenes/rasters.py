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

from sweep.scenes.files import SceneError, existing, require_memory
from sweep.scenes.heights import cliff_warnings, without_data
from sweep.scenes.maps import Stated, degree_at, height_factor, map_frame_of
from sweep.scenes.terrain import Bounds, Terrain

MOST_CELLS = 50_000_000
"""Heights read at once at most: 100 million triangles."""

FILE_CELLS_MAX = 1_000_000_000
"""Heights of a raster's file at most: all of them are read for its digest."""

BYTES_A_CELL = 220
"""Memory that a height takes at most while its triangles and their tree are built, measured."""

_STRIP_CELLS = 1 << 22
"""Heights that are read from a file at a time."""

_NO_NETWORK = {
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "none",
    "GDAL_HTTP_PROXY": "127.0.0.1:1",  # a port where nobody answers
    "GDAL_HTTPS_PROXY": "127.0.0.1:1",
    "GDAL_HTTP_MAX_RETRY": "0",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_VRT_ENABLE_RAWRASTERBAND": "NO",
}
"""Settings of GDAL by which nothing that a raster names is fetched or run."""

_DRIVERS = (
    "GTiff", "AAIGrid", "GRASSASCIIGrid", "EHdr", "ENVI", "HFA", "PNG", "JPEG", "BMP", "SRTMHGT",
    "USGSDEM", "DTED", "GSAG", "GSBG", "GS7BG", "XYZ", "SAGA", "RST", "PDS", "ISIS2", "ISIS3",
    "VICAR", "JP2OpenJPEG", "netCDF",
)  # fmt: skip
"""Formats of rasters that are files of this machine and name no others."""

_PICTURES = ("PNG", "TIFF", "JPEG", "BMP", "PPM", "WEBP")
"""Formats of grey images. Others may run programs, or hold what is no picture."""

_VRT_BYTES_MAX = 1 << 26
_VRT_DEPTH_MAX = 8


def read_raster(
    path: str | Path,
    *,
    band: int = 1,
    window: Bounds | None = None,
    metres_per_degree: tuple[float, float] | None = None,
    metres_per_unit: tuple[float, float] | None = None,
    height_unit: str | None = None,
    no_data: float | None = None,
    pixel: float | None = None,
    scaled: bool = False,
) -> Terrain:
    """Terrain of a georeferenced raster, such as a GeoTIFF, or of a window (W, S, E, N) of it.

    Nodes lie at the centres of the pixels; those without data are holes, and so are those that
    hold the value `no_data`. The raster's own scale and offset are applied, and feet are turned
    into metres. One in degrees needs metres per degree, east and north. One on a map whose
    unit is another length on the ground needs metres per unit (:mod:`sweep.scenes.maps`). One
    without a scale needs the size of a pixel [m]; its lower left corner is the world's origin.
    `scaled`: a factor is to be applied to the heights, so that their unit is known.

    SceneError for a file that is missing, no raster, without scale, rotated, too large, or without
    any height. Likewise for a unit whose size is not known, and a missing band or window.
    """
    path = existing(path)
    with _opened(path) as data:
        if not 1 <= band <= data.count:
            raise SceneError(path, f"has {data.count} band(s), not a band {band}", "choose another")
        transform = _straight(path, data, pixel)
        view = _view(path, data, transform, window)
        x, y = (
            sorted((first, first + step * number))
            for first, step, number in (
                (transform.c + view.col_off * transform.a, transform.a, view.width),
                (transform.f + view.row_off * transform.e, transform.e, view.height),
            )
        )
        wkt = "" if data.crs is None else _wkt(path, data)
        cell = math.inf if pixel is not None else min(abs(transform.a), abs(transform.e))
        stated = Stated(metres_per_degree, metres_per_unit, height_unit)
        map_frame = map_frame_of(path, wkt, (x[0], y[0], x[1], y[1]), cell, stated)
        unit = height_factor(path, wkt, data.units[band - 1] or "", height_unit, scaled)
        raw = _values(data, band, view)
        doubts = without_data(path, raw, no_data)
        raw *= data.scales[band - 1]
        raw += data.offsets[band - 1]
        raw *= unit
    left = transform.c + (view.col_off + 0.5) * transform.a
    top = transform.f + (view.row_off + 0.5) * transform.e
    east, north = map_frame.factors
    spacing = transform.a * east, transform.e * north
    terrain = Terrain(raw, spacing, np.array([left * east, top * north, 0.0]), map_frame=map_frame)
    return _checked(path, terrain, doubts)


def _wkt(path: Path, data: Any) -> str:
    """Coordinate reference system of a raster as WKT."""
    from rasterio.errors import CRSError

    try:
        return str(data.crs.to_wkt())
    except CRSError as error:
        rule = f"has a coordinate reference system that can not be written ({error})"
        raise SceneError(path, rule, "state it anew with gdal_edit -a_srs") from None


def _checked(path: Path, terrain: Terrain, doubts: tuple[str, ...]) -> Terrain:
    """Terrain with warnings: of its map, the doubts given, and its cliffs."""
    _require_heights(path, terrain.heights)
    of_map = () if terrain.map_frame is None else terrain.map_frame.warnings
    cliffs = cliff_warnings(path, terrain.heights, terrain.spacing)
    return replace(terrain, warnings=(*of_map, *doubts, *cliffs))


def raster_digest(path: str | Path) -> str:
    """Digest of a raster's heights, spacing and frame, wherever they come from; or SceneError."""
    path = existing(path)
    with _opened(path) as data:
        if data.width * data.height * data.count > FILE_CELLS_MAX:
            size = f"{data.width:,} x {data.height:,} heights in {data.count} band(s)"
            rule = f"declares {size}, more than {FILE_CELLS_MAX:.0e}"
            raise SceneError(path, rule, "cut a part out of it with gdal_translate -projwin")
        frame = (data.shape, data.transform, data.crs and data.crs.to_wkt())
        digest = hashlib.blake2b(repr(frame).encode(), digest_size=16)
        for band in data.indexes:
            scale = data.scales[band - 1], data.offsets[band - 1], data.units[band - 1]
            digest.update(repr(scale).encode())
            for strip in _strips(data.width, data.height):
                digest.update(_read(data, band, strip).tobytes())
    return digest.hexdigest()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Dataset of a raster. No source on another machine that it names is asked for anything."""
    import rasterio

    try:
        with _offline():
            _check_sources(path, ())
            with _dataset(path) as data:
                _require_blocks(path, data)
                yield data
    except rasterio.errors.RasterioError as error:
        rule = f"is no raster that can be read ({error.__cause__ or error})"
        remedy = "convert it to a GeoTIFF; nothing is fetched over the network"
        raise SceneError(path, rule, remedy) from None


def _require_blocks(path: Path, data: Any) -> None:
    """Refuse a raster whose blocks, each of which is unpacked whole, do not fit into memory."""
    for (rows, columns), kind in zip(data.block_shapes, data.dtypes, strict=True):
        needed = 2 * rows * columns * np.dtype(kind).itemsize
        require_memory(path, needed, "write it anew with gdal_translate -co TILED=YES")


def _dataset(path: Path) -> Any:
    """Open a raster of a format that is read, and of no other."""
    from rasterio.io import DatasetReader

    for sidecar in path.parent.glob(f"{glob.escape(path.stem)}.*"):
        if not (sidecar.is_file() or sidecar.is_dir()) and sidecar.exists():
            rule = f"stands beside {sidecar.name}, which is a pipe or a device"
            raise SceneError(path, rule, "remove that: it would be read as a part of the raster")
    # An absolute path is no address; rasterio.open would take one driver alone.
    drivers = ["VRT"] if _is_vrt(path) else list(_DRIVERS)
    return DatasetReader(str(path.absolute()), driver=drivers)


@contextmanager
def _offline() -> Iterator[None]:
    """Environment in which GDAL fetches nothing, whatever hosts the user exempts from proxies."""
    import rasterio

    exempt = {name: os.environ.pop(name) for name in ("NO_PROXY", "no_proxy") if name in os.environ}
    try:
        with rasterio.Env(**_NO_NETWORK):
            yield
    finally:
        os.environ.update(exempt)


def _is_vrt(path: Path) -> bool:
    """Return true if GDAL would take a file for a virtual raster, by its beginning."""
    with path.open("rb") as file:
        return b"<vrtdataset" in file.read(1 << 16).lower()


def _check_sources(path: Path, within: tuple[Path, ...]) -> None:
    """Refuse a virtual raster over what is no raster of this machine.

    GDAL may take zeros for a source that is lost, and opens sources of any format, hosts among
    them.
    """
    if not _is_vrt(path):
        return
    if len(within) > _VRT_DEPTH_MAX or path in within:
        raise SceneError(path, "is a virtual raster over itself", "name the rasters below it")
    for source in _sources(path):
        _check_sources(source, (*within, path))
        _require_raster(source)


def _sources(path: Path) -> list[Path]:
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
        rule = f"is no raster that can be read ({error})"
        raise SceneError(path, rule, "make it anew with gdalbuildvrt") from None
    for element in root.iter():
        tag = str(element.tag).rpartition("}")[2].lower()  # GDAL passes over their case
        if tag not in ("sourcefilename", "sourcedataset"):
            continue
        name = (element.text or "").strip()
        attributes = {key.lower(): value for key, value in element.attrib.items()}
        if "://" in name or "/vsi" in name.lower():
            rule = f"is no raster that can be read (its source is {name})"
            raise SceneError(path, rule, "fetch that: nothing is fetched over the network")
        is_relative = attributes.get("relativetovrt", "0").strip() not in ("", "0")
        sources[existing(path.parent / name if is_relative else Path(name))] = None
    return list(sources)


def _require_raster(path: Path) -> None:
    """Refuse a source of a virtual raster that is of no format that is read."""
    import rasterio

    try:
        with _dataset(path):
            pass
    except rasterio.errors.RasterioError as error:
        rule = f"is no raster that can be read ({error.__cause__ or error})"
        raise SceneError(path, rule, "convert it to a GeoTIFF") from None


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
    remedy = f"give a window within {tuple(data.bounds)}"
    require_cells(path, int(view.height), int(view.width), remedy)
    return view


def _strips(width: int, height: int) -> Iterator[Any]:
    """Windows of some rows each, or of parts of a row, that make up a raster."""
    from rasterio.windows import Window as Pixels

    rows, columns = max(_STRIP_CELLS // width, 1), min(width, _STRIP_CELLS)
    for top in range(0, height, rows):
        for left in range(0, width, columns):
            yield Pixels(left, top, min(columns, width - left), min(rows, height - top))


def _read(data: Any, band: int, window: Any) -> np.ndarray:
    """Values of a band in a window as they are stored, NaN where there are none."""
    values = data.read(band, window=window, masked=True)
    return np.asarray(np.ma.filled(values.astype(float), np.nan))


def _values(data: Any, band: int, view: Any) -> np.ndarray:
    """Values of a view, strip by strip, as the masks of all at once would take much memory."""
    from rasterio.windows import Window as Pixels

    values = np.empty((int(view.height), int(view.width)))
    for strip in _strips(int(view.width), int(view.height)):
        window = Pixels(
            view.col_off + strip.col_off, view.row_off + strip.row_off, strip.width, strip.height
        )
        rows = slice(strip.row_off, strip.row_off + strip.height)
        columns = slice(strip.col_off, strip.col_off + strip.width)
        values[rows, columns] = _read(data, band, window)
    return values


def _require_heights(path: Path, heights: np.ndarray) -> None:
    if min(heights.shape) < 2 or np.isfinite(heights).sum() < 3:
        raise SceneError(path, "has too few heights for a triangle", "check its no-data value")


def require_cells(path: Path, rows: int, columns: int, remedy: str) -> None:
    """Refuse a grid of more heights than a scene takes, or than the memory holds."""
    if rows * columns > MOST_CELLS:
        rule = f"has {columns:,} x {rows:,} heights, more than {MOST_CELLS:.0e}"
        raise SceneError(path, rule, remedy)
    require_memory(path, BYTES_A_CELL * rows * columns, f"{remedy}, or coarsen it")


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
        with path.open("rb") as file:
            values = _array_of(path, file, path.stat().st_size, name)
    except SceneError:
        raise
    except Exception as error:  # archives and headers fail in as many ways
        raise SceneError(path, f"is no NumPy file ({error})", "write it with numpy.save") from None
    return _grid(path, values, spacing, no_data)


def _array_of(path: Path, file: Any, size: int, name: str | None) -> np.ndarray:
    """Heights of a file of one array, or of an archive of several."""
    if not zipfile.is_zipfile(file):
        file.seek(0)
        return _stored_array(path, file, size)
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        entries = {
            entry.filename.removesuffix(".npy"): entry
            for entry in archive.infolist()
            if entry.filename.endswith(".npy")
        }
        choose = f"name one of: {', '.join(entries)}"
        if name is None:
            grids = []
            for key, entry in entries.items():
                with archive.open(entry) as member:
                    if len(_header_of(member)[0]) == 2:
                        grids.append(key)
            if len(grids) != 1:
                raise SceneError(path, f"holds {len(grids)} grids", choose)
            name = grids[0]
        if name not in entries:
            raise SceneError(path, f"holds no '{name}'", choose)
        with archive.open(entries[name]) as member:
            return _stored_array(path, member, entries[name].file_size)


def _header_of(file: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array in NumPy's format, by its header alone."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        read = np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype


def _stored_array(path: Path, file: Any, size: int) -> np.ndarray:
    """Array in NumPy's format of a file of so many bytes, whose header is looked at first."""
    shape, dtype = _header_of(file)
    if len(shape) != 2 or dtype.kind not in "iuf":
        rule = f"holds {dtype} of shape {shape}"
        raise SceneError(path, rule, "heights are a two-dimensional array of numbers")
    require_cells(path, *shape, "cut a part out of it")
    if file.tell() + math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"its header tells of shape {shape}, and {size:,} bytes are too few")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _grid(
    path: Path, values: np.ndarray, spacing: tuple[float, float], no_data: float | None = None
) -> Terrain:
    """Terrain of an array of heights."""
    if min(values.shape) < 2:
        rule = f"holds {values.dtype} of shape {values.shape}"
        raise SceneError(path, rule, "heights are a two-dimensional array of numbers")
    heights = values.astype(float)
    doubts = without_data(path, heights, no_data)
    _require_heights(path, heights)
    try:
        terrain = Terrain(heights, spacing, np.zeros(3))
    except ValueError as error:
        raise SceneError(path, str(error), "state steps in metres") from None
    return _checked(path, terrain, doubts)


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
    from PIL import Image

    try:
        with warnings.catch_warnings():  # what is too large is told below
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_PICTURES) as image:
                require_cells(path, image.height, image.width, "cut a part out of it")
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
