"""Small scenes in stores, to look at: a slope with a block on it, seen by a square and a line."""

import shutil

import numpy as np
import rasterio
from drawn_studies import INSTRUMENT

from sweep.model.outputs import CYCLES, SHOTS
from sweep.spec import SceneSpec
from sweep.spec.axes import without_fields_on_axes
from sweep.tasks import driver

FAR = (500_000.0, 4_000_000.0, 1200.0)
"""World coordinates of the middle of the ground [m]."""

SLOPE = 0.05
"""Rise of the ground along x."""

MAPPING = {
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


def scene(directory, **sections) -> SceneSpec:
    """The study, with some of its sections replaced; its ground is a file in the directory."""
    x = np.arange(-1000.0, 1001.0, 50.0)
    heights = np.broadcast_to(FAR[2] + SLOPE * x, (1, x.size, x.size))
    corner = rasterio.Affine(50, 0, FAR[0] - 1025, 0, -50, FAR[1] + 1025)
    shape = {"height": x.size, "width": x.size, "count": 1, "dtype": "float64"}
    with rasterio.open(
        directory / "slope.tif", "w", driver="GTiff", crs="EPSG:32633", transform=corner, **shape
    ) as raster:
        raster.write(heights)
    return SceneSpec.from_mapping(without_fields_on_axes(MAPPING | sections), base=directory)


def flown(directory, **sections):
    """Path of the store of the study, computed by the plain loop."""
    path = directory / "scene.zarr"
    study = scene(directory, **sections)
    outcome = driver.run(study, store=path, scheduler="none", progress=False)
    assert outcome.complete, outcome.failures
    return path


def cut_short(path, directory, *, geometry=True):
    """A copy of a store without the last stretch of cycles of every array: as if not computed.

    Geometry may stay: it is stored with the study's first place, whatever becomes of others.
    """
    import zarr

    copy = shutil.copytree(path, directory / "short.zarr")
    (copy / ".sweep" / "receipts.jsonl").unlink()  # what is committed has to be there
    for name, group in zarr.open_group(copy, mode="r").groups():
        for array in (array for _, array in group.arrays()):
            dims = array.metadata.dimension_names
            along = [i for i, dim in enumerate(dims) if dim in ("shot", "cycle")]
            if along and (geometry or array.basename not in SHOTS | CYCLES):
                last = -(-array.shape[along[0]] // array.chunks[along[0]]) - 1
                for chunk in (copy / name / array.basename / "c").rglob("*"):
                    place = chunk.relative_to(copy / name / array.basename / "c").parts
                    if chunk.is_file() and place[along[0]] == str(last):
                        chunk.unlink()
    return copy
