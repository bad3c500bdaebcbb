"""A store larger than memory, reduced in bounded memory: ``python benchmarks/big_store.py``.

A store of 10 GB (uncompressed), laid out as sweep lays it out, is filled with made-up results that
follow a closed form, and then summarised. Prints times and the largest resident size of the process
that reads, which is a process of its own. ``--gigabytes`` and ``--directory``: how much, and where.
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
from scipy.special import ndtr
from shared import experiment

ANGLES, CHUNK = 90, 65_536
BYTES_A_POINT = 8 * 27 + 4
"""27 arrays of floats and one of flags."""


def spec_of(gigabytes, block_points=CHUNK, powers=100, figures=()):
    """A study of about so many GB of results."""
    ranges = max(2, round(gigabytes * 1e9 / BYTES_A_POINT / ANGLES / powers))
    return experiment(
        "range_angle_coarse",
        title="Made up",
        axes={
            "instrument.laser.power": {"log": ["1 W", "10 W"], "number": powers},
            "target.range": {"linear": ["100 m", "20 km"], "number": ranges},
            "target.grazing_angle": {"linear": ["20 deg", "90 deg"], "number": ANGLES},
        },
        storage={"block_points": block_points},
        figures=list(figures),
    )


def make(path, spec):
    """The store, every block written with the closed form of `deviate`; its size [B]."""
    from sweep.tasks import store
    from sweep.tasks.grid_study import GridStudy

    study = GridStudy(spec)
    store.create(path, study)
    arrays, receipts = store.Arrays(path, study), []
    for block in range(study.n_blocks):
        extent, p = study.grid.extent(block), study.grid.parameters(block)
        z = deviate(p["target.range"], p["target.grazing_angle"], p["instrument.laser.power"])
        z = z.reshape(extent)
        # What is only summarised packs well, to spare the disk.
        results = dict.fromkeys(study.chunks(block), np.round(z))
        results |= {"pd_shot": ndtr(z), "miss_shot": ndtr(-z), "effects": np.zeros(extent, "u4")}
        arrays.write(block, results)
        receipt = {"block": block, "points": study.block_size(block), "time": 0.0}
        receipts.append(json.dumps(receipt) + "\n")
    (Path(path) / ".sweep" / "receipts.jsonl").write_text("".join(receipts))
    return study.points * BYTES_A_POINT


def deviate(distance, grazing_angle, power):
    """Normal deviate of the made-up pd: z(0.9) at :func:`farthest`."""
    return 1.2815515655446004 + 8 * (1 - distance / farthest(grazing_angle, power))


def farthest(grazing_angle, power):
    """Range [m] at which the made-up pd is 0.9."""
    return 6000 * np.sqrt(power) * np.sin(grazing_angle) ** 0.5


def peak_mb():
    """Largest resident size of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def reduce(path):
    """Summary and maximum range of a store; seconds, and the largest error of the range [m]."""
    import dask.array  # noqa: F401
    import zarr  # noqa: F401

    import sweep
    import sweep.analysis.opening

    idle, begun = peak_mb(), time.perf_counter()
    dataset = sweep.open(path)
    whole = dataset.sweep.summary().compute()
    limit = dataset.sweep.maximum_range().unbroken.compute()
    taken = time.perf_counter() - begun
    exact = farthest(np.deg2rad(limit.grazing_angle), limit.power)
    inside = limit.notnull()
    assert inside.any()
    return {
        "seconds": taken,
        "points": int(whole.pd_shot.sel(statistic="number")),
        "error": float(abs(limit - exact).where(inside).max()),
        "idle_mb": idle,
        "peak_mb": peak_mb(),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=10.0)
    parser.add_argument("--directory", type=Path, default=None)
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read:
        print(json.dumps(reduce(options.read)))
        return
    with tempfile.TemporaryDirectory(dir=options.directory) as directory:
        path = Path(directory) / "big.zarr"
        begun = time.perf_counter()
        size = make(path, spec_of(options.gigabytes))
        on_disk = sum(f.stat().st_size for f in path.rglob("*") if f.is_file())
        print(f"{size / 1e9:.2f} GB of results made in {time.perf_counter() - begun:.0f} s, "
              f"{on_disk / 1e9:.2f} GB on disk")  # fmt: skip
        command = [sys.executable, __file__, "--read", str(path)]
        found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    print(f"{found['points']:,} points: summary, maximum range: {found['seconds']:.0f} s")
    print(f"largest resident size {found['peak_mb']:.0f} MB "
          f"({found['idle_mb']:.0f} MB of it with nothing read)")  # fmt: skip
    print(f"largest error of the maximum range {found['error']:.2g} m")


if __name__ == "__main__":
    main()
