"""A study with nothing odd in it, to be changed field by field."""

import copy
from typing import Any

INSTRUMENT = {
    "laser": {"wavelength": "1550 nm", "power": "50 mW", "beam_divergence": "2 mrad"},
    "chirp": {"bandwidth": "1 GHz", "start_frequency": "5.5 GHz", "duration": "500 us"},
    "telescope": {"aperture": "25 mm", "coupling": "aperture"},
    "receiver": {
        "responsivity": "1.1 A/W", "detector_bandwidth": "400 MHz", "optical_passband": "25 nm",
        "noise_equivalent_power": "5 pW/rtHz", "transimpedance": "7 kohm",
        "amplifier_bandwidth": "400 MHz", "amplifier_noise_current": "25 nA",
    },
    "processing": {
        "sample_rate": "600 MHz", "fft_size": "2^12", "tnr": 8,
        "acquisition_delay": "13.4 us",  # the echo of 2 km is there from 13.34 us on
    },
}  # fmt: skip


def base_study_mapping(changes: dict[str, Any] | None = None, **sections: Any) -> dict[str, Any]:
    """A study of one point with changes by dotted path, and sections added."""
    target = {"range": "2 km", "grazing_angle": "60 deg", "reflectance": 0.1}
    footprint = {"beamlets": 7, "speckle": "none"}
    base = {"title": "Plain", "instrument": INSTRUMENT, "target": target, "footprint": footprint}
    mapping = copy.deepcopy(base | sections)
    for path, value in (changes or {}).items():
        *parents, name = path.split(".")
        parent_section = mapping
        for parent in parents:
            parent_section = parent_section.setdefault(parent, {})
        parent_section[name] = value
    return mapping
