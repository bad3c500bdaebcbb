"""The declarative experiment: YAML in, checked values out, every mistake at once."""

from sweep.spec.axes import Axis, Member
from sweep.spec.experiment import Spec, load
from sweep.spec.figures import (
    FalseAlarmTable,
    Figure,
    Slices,
    Surface,
    Table,
    ThresholdTable,
)
from sweep.spec.identity import difference
from sweep.spec.instrument import Chirp, Instrument, Laser, Processing, Receiver, Telescope
from sweep.spec.mistakes import Mistake, SpecError
from sweep.spec.scene import Accuracy, Draws, Execution, Footprint, Storage, Target
from sweep.spec.schema import json_schema

__all__ = [
    "Accuracy",
    "Axis",
    "Chirp",
    "Draws",
    "Execution",
    "FalseAlarmTable",
    "Figure",
    "Footprint",
    "Instrument",
    "Laser",
    "Member",
    "Mistake",
    "Processing",
    "Receiver",
    "Slices",
    "Spec",
    "SpecError",
    "Storage",
    "Surface",
    "Table",
    "Target",
    "Telescope",
    "ThresholdTable",
    "difference",
    "json_schema",
    "load",
]
