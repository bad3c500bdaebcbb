"""Small studies and instruments for watching how they are computed."""

import hashlib
import json
import os
import shutil
import time
from contextlib import contextmanager
from pathlib import Path

from sweep.spec import GridSpec
from sweep.spec.axes import remove_fields_on_axes
from sweep.tasks.driver import run
from sweep.tasks.engine.progress import Progress

STUDY_MAPPING = {
    "title": "Small",
    "question": "Does it compute?",
    "instrument": {
        "laser": {"wavelength": "1550 nm", "power": "1 W", "beam_divergence": "50 urad"},
        "chirp": {"bandwidth": "1 GHz", "start_frequency": "5.5 GHz", "duration": "500 us"},
        "telescope": {"aperture": "25 mm", "coupling": "aperture"},
        "receiver": {
            "responsivity": "1.1 A/W",
            "detector_bandwidth": "400 MHz",
            "optical_passband": "25 nm",
            "noise_equivalent_power": "5 pW/Hz^0.5",
            "transimpedance": "7 kohm",
            "amplifier_bandwidth": "400 MHz",
            "amplifier_noise_current": "25 nA",
        },
        "processing": {"sample_rate": "600 MHz", "fft_size": "2^14", "tnr": 8},
    },
    "target": {
        "range": "2 km",
        "grazing_angle": "60 deg",
        "radial_velocity": "20 m/s",
        "reflectance": 0.02,
    },
    "footprint": {"beamlets": 9, "speckle": "none"},
    "axes": {
        "instrument.laser.power": ["1 W", "3 W"],
        "target.range": {"linear": ["10 m", "5 km"], "number": 12},
        "target.grazing_angle": ["20 deg", "50 deg", "90 deg"],
    },
    "seed": 3,
    "storage": {"block_points": 8},
}


def small_mapping(**changes) -> dict[str, object]:
    """The small study as a file has it."""
    return remove_fields_on_axes({**STUDY_MAPPING, **changes})


def small_spec(**changes) -> GridSpec:
    """The small study, 72 points, with some of its sections replaced."""
    return GridSpec.from_mapping(small_mapping(**changes), base=Path("."))


class RecordingProgress(Progress, list):
    """Progress that keeps what is said."""

    def say(self, text):
        self.append(text)


def run_serially(spec, store, **cluster_options):
    """A run without progress, as a plain loop unless said otherwise."""
    return run(spec, store=store, progress=False, **(cluster_options or {"scheduler": "none"}))


@contextmanager
def thread_cluster_client(workers: int, *, threads_per_worker: int = 1):
    """A client of a cluster whose workers are threads of this process."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=threads_per_worker,
            processes=False,
            dashboard_address=None,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def copy_store(store: Path, directory: Path) -> Path:
    """A copy of a store that a test may damage."""
    return shutil.copytree(store, directory / "copy.zarr")


def file_digests(store: Path) -> dict[str, str]:
    """Digest of every file of a store but the journal's."""
    return {
        str(file.relative_to(store)): hashlib.blake2b(file.read_bytes()).hexdigest()
        for file in sorted(store.rglob("*"))
        if file.is_file() and ".sweep" not in file.relative_to(store).parts
    }


def file_contents(store: Path) -> dict[str, bytes]:
    """Every file of a directory, the journal's too."""
    return {
        str(file.relative_to(store)): file.read_bytes()
        for file in store.rglob("*")
        if file.is_file()
    }


def receipt_blocks(store: Path) -> list[int]:
    """Blocks with a whole receipt, in the order of the log."""
    log = store / ".sweep" / "receipts.jsonl"
    if not log.exists():
        return []
    lines = log.read_text().splitlines(keepends=True)
    return [json.loads(line)["block"] for line in lines if line.endswith("\n")]


def make_logging_evaluate(log: Path, delay: float = 0.0):
    """The model, with every block noted in a file before it is computed, and slowed down.

    A nested function, so that it travels to workers by value.
    """

    def evaluate(study, block):
        with open(log, "a") as lines:
            lines.write(f"{block} {os.getpid()}\n")
        time.sleep(delay)
        return study.evaluate(block)

    return evaluate


def logged_blocks(log: Path) -> list[int]:
    """Blocks noted by `make_logging_evaluate`, in order."""
    return [int(line.split()[0]) for line in log.read_text().splitlines()] if log.exists() else []


def make_failing_evaluate(blocks: set[int], log: Path):
    """The model, with an error in some blocks."""

    def evaluate(study, block):
        with open(log, "a") as lines:
            lines.write(f"{block} {os.getpid()}\n")
        if block in blocks:
            raise ValueError(f"nothing good comes of block {block}")
        return study.evaluate(block)

    return evaluate


def make_killing_evaluate(blocks: set[int]):
    """The model, with blocks that kill the process that computes them."""

    def evaluate(study, block):
        if block in blocks:
            os.kill(os.getpid(), 9)
        return study.evaluate(block)

    return evaluate
