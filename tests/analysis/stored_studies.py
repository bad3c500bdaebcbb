"""Small studies in stores, to look at."""

from sweep.spec import GridSpec
from sweep.spec.axes import remove_fields_on_axes
from sweep.tasks import driver

INSTRUMENT = {
    "laser": {"wavelength": "1550 nm", "power": "1 W", "beam_divergence": "50 urad"},
    "chirp": {"bandwidth": "1 GHz", "start_frequency": "5.5 GHz", "duration": "500 us"},
    "telescope": {"aperture": "25 mm", "coupling": "aperture"},
    "receiver": {
        "responsivity": "1.1 A/W",
        "detector_bandwidth": "400 MHz",
        "optical_passband": "25 nm",
        "noise_equivalent_power": "5 pW/rtHz",
        "transimpedance": "7 kohm",
        "amplifier_bandwidth": "400 MHz",
        "amplifier_noise_current": "25 nA",
        "noise_shape": "white",
    },
    "processing": {
        "sample_rate": "600 MHz",
        "fft_size": "2^17",
        "tnr": 10,
        "bins_counted": "all",
        "noise_bins": "independent",
        "detection": "peak_bin",
    },
}
TARGET = {
    "range": "2 km",
    "grazing_angle": "60 deg",
    "radial_velocity": "150 m/s",
    "reflectance": 0.1,
    "reflectance_law": "thesis",
}
RANGE_VALUES = ["5 m", {"step": ["500 m", "9 km", "500 m"]}]
CUT_AXIS = {
    "zip": [
        {"target.range": RANGE_VALUES, "target.grazing_angle": "15 deg"},
        {"target.range": RANGE_VALUES, "target.grazing_angle": "85 deg"},
        {"target.range": "3500 m", "target.grazing_angle": {"step": ["5 deg", "90 deg", "5 deg"]}},
    ]
}
POWER_AND_CUT_AXES = {"instrument.laser.power": ["1 W", "3 W", "5 W"], "cut": CUT_AXIS}
SURFACE_AXES = {
    "target.range": {"linear": ["10 m", "9 km"], "number": 24},
    "target.grazing_angle": {"step": ["10 deg", "90 deg", "10 deg"]},
}


def spec_over_axes(axes, **sections) -> GridSpec:
    """A study of Table 4.1's instrument over some axes."""
    mapping = {
        "title": "Small",
        "instrument": INSTRUMENT,
        "target": TARGET,
        "footprint": {"beamlets": 9, "speckle": "none"},
        "axes": axes,
    }
    return GridSpec.from_mapping(remove_fields_on_axes(mapping | sections))


def run_into_store(directory, axes, **sections):
    """Path of the store of a study, computed by the plain loop."""
    path = directory / "study.zarr"
    driver.run(spec_over_axes(axes, **sections), store=path, scheduler="none", progress=False)
    return path
