"""What all tests share: the thesis's Table 4.1, and hypothesis without deadlines."""

import os
import shutil
import signal
import sys
from math import pi
from pathlib import Path

import pytest
from dask.system import CPU_COUNT
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent / "tasks"))  # small studies, for other tests too

# Stores are many small files, which memory makes and removes several times as fast as disks.
SHARED_MEMORY_DIR, SHARED_MEMORY_BYTES_MIN = Path("/dev/shm"), 8 << 30
if (
    SHARED_MEMORY_DIR.is_dir()
    and os.access(SHARED_MEMORY_DIR, os.W_OK)
    and shutil.disk_usage(SHARED_MEMORY_DIR).free > SHARED_MEMORY_BYTES_MIN
):
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(SHARED_MEMORY_DIR))

# What starts tests in the background may have Ctrl-C ignored, which all processes would take over.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_approx = pytest.approx


def approx(expected, rel=None, abs=None, nan_ok=False):
    """Relative tolerance alone, unless an absolute one is stated: pytest's 1e-12 is no tolerance.

    Densities, currents and chances of false alarms lie far below it.
    """
    if abs is None:
        rel, abs = 1e-6 if rel is None else rel, 0.0
    return _approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)


pytest.approx = approx

# The first call of a compiled kernel may compile it, which no deadline should count.
settings.register_profile("sweep", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("anew", deadline=None, print_blob=True)  # other draws: `make test-all`
settings.load_profile("sweep")


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores, since some tests wait for processes of their own."""
    return CPU_COUNT + 1


TABLE_4_1 = {
    "instrument.laser.wavelength": 1550e-9,
    "instrument.laser.power": 1.0,
    "instrument.laser.beam_divergence": 50e-6,
    "instrument.chirp.bandwidth": 1e9,
    "instrument.chirp.start_frequency": 5.5e9,
    "instrument.chirp.duration": 500e-6,
    "instrument.telescope.aperture": 25e-3,
    "instrument.telescope.optical_efficiency": 1.0,
    "instrument.telescope.coupling": "aperture",
    "instrument.receiver.architecture": "homodyne",
    "instrument.receiver.local_oscillator_power": 1e-3,
    "instrument.receiver.mixing_efficiency": 1.0,
    "instrument.receiver.apd_gain": 1.0,
    "instrument.receiver.excess_noise_factor": 1.0,
    "instrument.receiver.responsivity": 1.1,
    "instrument.receiver.detector_bandwidth": 400e6,
    "instrument.receiver.optical_passband": 25e-9,
    "instrument.receiver.noise_equivalent_power": 5e-12,
    "instrument.receiver.transimpedance": 7e3,
    "instrument.receiver.amplifier_bandwidth": 400e6,
    "instrument.receiver.amplifier_noise_current": 25e-9,
    "instrument.receiver.noise_figure": 1.0,
    "instrument.receiver.noise_shape": "white",
    "instrument.receiver.modulation_index": 1.0,
    "instrument.receiver.load_resistance": 50.0,
    "instrument.receiver.temperature": 290.0,
    "instrument.processing.sample_rate": 600e6,
    "instrument.processing.fft_size": 2**17,
    "instrument.processing.window": "hamming",
    "instrument.processing.tnr": 10.0,
    "instrument.processing.acquisition_delay": 0.0,
    "instrument.processing.bins_counted": "half",
    "instrument.processing.noise_bins": "independent",
    "instrument.processing.detection": "peak_bin",
    "target.range": 2000.0,
    "target.grazing_angle": pi / 2,
    "target.radial_velocity": 150.0,
    "target.reflectance": 0.1,
    "target.reflectance_law": "thesis",
    "target.solar_irradiance": 0.0,
    "footprint.beamlets": 109,
    "footprint.phases": "coherent",
    "accuracy.tolerance": 0.0,
    "accuracy.line_error": -1.0,
    "accuracy.leakage_error": -1.0,
    "accuracy.leakage_floor": 0.1,
}
"""The instrument of [T] Table 4.1 with the target that PHYSICS section 3 reads into its figures."""

_PATH_BY_NAME = {path.rsplit(".", 1)[1]: path for path in TABLE_4_1}


@pytest.fixture(scope="session")
def table_4_1():
    """Parameters of Table 4.1, any of them replaced: ``table_4_1(range=3500.0, power=3.0)``."""

    def parameters(**changes):
        return TABLE_4_1 | {_PATH_BY_NAME[name]: value for name, value in changes.items()}

    return parameters


@pytest.fixture(scope="session")
def serial_store(tmp_path_factory):
    """The store of the small study, run as a plain loop; not to be changed."""
    from small_studies import run_serially, small_spec

    outcome = run_serially(small_spec(), tmp_path_factory.mktemp("undisturbed") / "small.zarr")
    assert outcome.complete
    return outcome.store
