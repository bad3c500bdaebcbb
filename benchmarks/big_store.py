"""Reduce a store larger than memory in bounded memory: ``python benchmarks/big_store.py``.

A store of 10 GB (uncompressed), in sweep's layout, is filled with invented results that follow a
closed form, and then summarised by another process. The script prints times and the largest
resident size of that process. ``--gigabytes`` sets the size, ``--directory`` the place of the
store.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from benchmark_helpers import experiment_spec
from scipy.special import ndtr

N_ANGLES, BLOCK_POINTS = 90, 65_536
BYTES_PER_POINT = 8 * 27 + 4
"""Uncompressed bytes of a point: 27 arrays of 8-byte floats, and one of 4-byte flags."""


def spec_of_size(gigabytes, block_points=BLOCK_POINTS, powers=100, figures=()):
    """Return the spec of a grid whose results take about `gigabytes` GB uncompressed."""
    ranges = max(2, round(gigabytes * 1e9 / BYTES_PER_POINT / N_ANGLES / powers))
    return experiment_spec(
        "range_angle_coarse",
        title="Made up",
        axes={
            "instrument.laser.power": {"log": ["1 W", "10 W"], "number": powers},
            "target.range": {"linear": ["100 m", "20 km"], "number": ranges},
            "target.grazing_angle": {"linear": ["20 deg", "90 deg"], "number": N_ANGLES},
        },
        storage={"block_points": block_points},
        figures=list(figures),
    )


def make_store(path, spec):
    """Write a store with pd from `pd_deviate`; return its uncompressed size [bytes]."""
    from sweep.tasks.engine import study_store
    from sweep.tasks.studies.grid_study import GridStudy

    study = GridStudy(spec)
    study_store.create_store(path, study)
    arrays, receipts = study_store.BlockWriter(path, study), []
    for block in range(study.n_blocks):
        extent, parameters = (
            study.grid.actual_block_shape(block),
            study.grid.parameters_of_block(block),
        )
        deviates = pd_deviate(
            parameters["target.range"],
            parameters["target.grazing_angle"],
            parameters["instrument.laser.power"],
        )
        deviates = deviates.reshape(extent)
        # What is only summarised packs well, to spare the disk.
        results = dict.fromkeys(study.chunk_positions_of_block(block), np.round(deviates))
        results |= {
            "pd_shot": ndtr(deviates),
            "miss_shot": ndtr(-deviates),
            "effects": np.zeros(extent, "u4"),
        }
        arrays.write(block, results)
        receipt = {"block": block, "points": study.count_block_points(block), "time": 0.0}
        receipts.append(json.dumps(receipt) + "\n")
    (Path(path) / ".sweep" / "receipts.jsonl").write_text("".join(receipts))
    return study.n_points * BYTES_PER_POINT


def pd_deviate(distance, grazing_angle, power):
    """Return the normal deviate of the invented pd, which is z(0.9) at `range_at_pd_90`."""
    return 1.2815515655446004 + 8 * (1 - distance / range_at_pd_90(grazing_angle, power))


def range_at_pd_90(grazing_angle, power):
    """Return the range at which the invented pd is 0.9 [m]."""
    return 6000 * np.sqrt(power) * np.sin(grazing_angle) ** 0.5


def peak_memory_mb():
    """Return the largest resident size of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def reduce_store(path):
    """Compute summary and maximum range of a store; return their time, memory and error by name."""
    import dask.array  # noqa: F401
    import zarr  # noqa: F401

    import sweep
    import sweep.analysis.datasets

    idle_memory_mb, start = peak_memory_mb(), time.perf_counter()
    dataset = sweep.open(path)
    summary = dataset.sweep.summary().compute()
    maximum_range = dataset.sweep.maximum_range().unbroken.compute()
    seconds = time.perf_counter() - start
    exact_range = range_at_pd_90(np.deg2rad(maximum_range.grazing_angle), maximum_range.power)
    has_range = maximum_range.notnull()
    assert has_range.any()
    return {
        "seconds": seconds,
        "points": int(summary.pd_shot.sel(statistic="number")),
        "error": float(abs(maximum_range - exact_range).where(has_range).max()),
        "idle_mb": idle_memory_mb,
        "peak_mb": peak_memory_mb(),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=10.0)
    parser.add_argument("--directory", type=Path, default=None)
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read:
        print(json.dumps(reduce_store(options.read)))
        return
    with tempfile.TemporaryDirectory(dir=options.directory) as directory:
        path = Path(directory) / "big.zarr"
        start = time.perf_counter()
        uncompressed_bytes = make_store(path, spec_of_size(options.gigabytes))
        on_disk = sum(f.stat().st_size for f in path.rglob("*") if f.is_file())
        print(
            f"{uncompressed_bytes / 1e9:.2f} GB of results made in "
            f"{time.perf_counter() - start:.0f} s, "
            f"{on_disk / 1e9:.2f} GB on disk"
        )
        command = [sys.executable, __file__, "--read", str(path)]
        reduction = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    print(f"{reduction['points']:,} points: summary, maximum range: {reduction['seconds']:.0f} s")
    print(f"largest resident size {reduction['peak_mb']:.0f} MB "
          f"({reduction['idle_mb']:.0f} MB of it with nothing read)")  # fmt: skip
    print(f"largest error of the maximum range {reduction['error']:.2g} m")


if __name__ == "__main__":
    main()
