"""Small scenes in stores, to look at: a slope with a block on it, seen by a square and a line."""

import shutil

import numpy as np
import rasterio
from stored_studies import INSTRUMENT

from sweep.model.outputs import CYCLE_VARIABLES, SHOT_GEOMETRY_VARIABLES
from sweep.spec import SceneSpec
from sweep.spec.axes import remove_fields_on_axes
from sweep.tasks import driver

GROUND_CENTRE = (500_000.0, 4_000_000.0, 1200.0)
"""World coordinates of the middle of the ground [m]."""

GROUND_SLOPE = 0.05
"""Rise of the ground along x."""

SCENE_MAPPING = {
    "title": "A block on a slope",
    "instrument": INSTRUMENT
    | {
        "laser": INSTRUMENT["laser"] | {"beam_divergence": "4 mrad"},
        "processing": INSTRUMENT["processing"] | {"fft_size": "2^15", "tnr": 8},
    },
    "scene": {
        "origin": "ground",
        "objects": {
            "ground": {"kind": "raster", "file": "slope.tif", "reflectance": 0.1},
            "block": {
                "kind": "box",
                "size": ["40 m", "30 m", "40 m"],
                "position": ["20 m", "0 m", "0 m"],
                "reflectance": 0.4,
            },
        },
    },
    "platform": {
        "path": {
            "kind": "straight",
            "from": ["-60 m", "5 m", "420 m"],
            "to": ["40 m", "5 m", "120 m"],
            "initial_speed": "60 m/s",
            "final_speed": "20 m/s",
        },
        "attitude": {"kind": "nadir"},
    },
    "scanners": {
        "square": {"kind": "corners", "angle": "7.5 deg", "rate": "10 Hz"},
        "pair": {
            "kind": "line",
            "half_angle": "6 deg",
            "line_rate": "2 Hz",
            "rate": "20 Hz",
            "along": ["2 deg", "-2 deg"],
        },
    },
    "footprint": {"beamlets": 19, "speckle": "none"},
    "draws": {"number": 3, "returns": 3},
    "navigation": {"ground_slope": 0.1, "test_level": 0},
    "storage": {"block_shots": 128, "block_draws": 2},
    "axes": {"instrument.laser.power": ["0.3 mW", "1 W"]},
    "seed": 11,
}


def small_scene_spec(directory, **sections) -> SceneSpec:
    """The study, with some of its sections replaced; its ground is a file in the directory."""
    x = np.arange(-1000.0, 1001.0, 50.0)
    heights = np.broadcast_to(GROUND_CENTRE[2] + GROUND_SLOPE * x, (1, x.size, x.size))
    transform = rasterio.Affine(50, 0, GROUND_CENTRE[0] - 1025, 0, -50, GROUND_CENTRE[1] + 1025)
    raster_shape = {"height": x.size, "width": x.size, "count": 1, "dtype": "float64"}
    with rasterio.open(
        directory / "slope.tif",
        "w",
        driver="GTiff",
        crs="EPSG:32633",
        transform=transform,
        **raster_shape,
    ) as raster:
        raster.write(heights)
    return SceneSpec.from_mapping(remove_fields_on_axes(SCENE_MAPPING | sections), base=directory)


def run_flight_into_store(directory, **sections):
    """Path of the store of the study, computed by the plain loop."""
    path = directory / "scene.zarr"
    spec = small_scene_spec(directory, **sections)
    outcome = driver.run(spec, store=path, scheduler="none", progress=False)
    assert outcome.complete, outcome.failures
    return path


def copy_without_last_cycles(path, directory, *, with_geometry=True):
    """A copy of a store without the last stretch of cycles of every array: as if not computed.

    Geometry may stay: it is stored with the study's first place, whatever becomes of others.
    """
    import zarr

    copy = shutil.copytree(path, directory / "short.zarr")
    (copy / ".sweep" / "receipts.jsonl").unlink()  # what is committed has to be there
    for name, group in zarr.open_group(copy, mode="r").groups():
        for array in (array for _, array in group.arrays()):
            dims = array.metadata.dimension_names
            cut_axes = [i for i, dim in enumerate(dims) if dim in ("shot", "cycle")]
            if cut_axes and (
                with_geometry or array.basename not in SHOT_GEOMETRY_VARIABLES | CYCLE_VARIABLES
            ):
                last_chunk = -(-array.shape[cut_axes[0]] // array.chunks[cut_axes[0]]) - 1
                for chunk in (copy / name / array.basename / "c").rglob("*"):
                    chunk_position = chunk.relative_to(copy / name / array.basename / "c").parts
                    if chunk.is_file() and chunk_position[cut_axes[0]] == str(last_chunk):
                        chunk.unlink()
    return copy
