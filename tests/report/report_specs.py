"""Small studies to report."""

from pathlib import Path

EXPERIMENTS = Path(__file__).parents[2] / "experiments"

GRID_SPEC = {
    "title": "Power </script><b>& slant</b>",
    "question": "How far does more power reach?",
    "instrument": "instruments/table_4_1.yaml",
    "target": {"radial_velocity": "150 m/s", "reflectance": 0.1},
    "footprint": {"beamlets": 9, "speckle": "none"},
    "axes": {
        "instrument.laser.power": ["1 W", "3 W"],
        "target.range": {"linear": ["20 m", "12 km"], "number": 1201},
        "target.grazing_angle": ["20 deg", "50 deg", "80 deg"],
    },
    "figures": [
        {"kind": "surface", "variable": "pd_shot", "x": "range", "y": "grazing_angle"},
        {"kind": "slices", "variable": "pd_shot", "x": "range", "by": "power",
         "where": {"grazing_angle": "20 deg"}},
        {"kind": "false_alarm_table", "by": "power", "title": "False alarms of a shot"},
    ],
}  # fmt: skip

SCENE_SPEC = {
    "title": "A small descent",
    "instrument": "instruments/table_5_1.yaml",
    "scene": {
        "origin": "ground",
        "objects": {
            "ground": {"kind": "hills", "size": "600 m", "spacing": "20 m", "rms_height": "4 m",
                       "correlation_length": "80 m", "seed": 3, "reflectance": 0.1},
        },
    },
    "platform": {
        "path": {"kind": "straight", "from": ["0 m", "0 m", "400 m"], "to": ["40 m", "0 m", "60 m"],
                 "initial_speed": "60 m/s", "final_speed": "20 m/s"},
    },
    "scanners": {"four": {"kind": "corners", "angle": "22.5 deg", "rate": "8 Hz"}},
    "footprint": {"beamlets": 7, "speckle": "none"},
    "draws": {"number": 2},
    "error_floor": {"clock_error": 1e-6, "vibration": "1 cm/s"},
    "axes": {"instrument.telescope.optical_efficiency": [1, 0.01]},
}  # fmt: skip
