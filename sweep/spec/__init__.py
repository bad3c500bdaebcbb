"""Declarative specs of studies: YAML in, validated values or all mistakes out."""

from sweep.spec.axes import Axis, AxisParameter
from sweep.spec.cluster_config import (
    AnyClusterConfig,
    cluster_config_from_mapping,
    load_cluster_config,
)
from sweep.spec.differences import describe_differences
from sweep.spec.figure_sections import (
    FalseAlarmTable,
    GridFigure,
    SlicesFigure,
    SurfaceFigure,
    TableFigure,
    ThresholdTable,
)
from sweep.spec.rules import Mistake, SpecError
from sweep.spec.schema import json_schema
from sweep.spec.sections import Draws
from sweep.spec.specs import GridSpec, SceneSpec, from_stored, load

__all__ = [
    "AnyClusterConfig",
    "Axis",
    "AxisParameter",
    "Draws",
    "FalseAlarmTable",
    "GridFigure",
    "GridSpec",
    "Mistake",
    "SceneSpec",
    "SlicesFigure",
    "SpecError",
    "SurfaceFigure",
    "TableFigure",
    "ThresholdTable",
    "cluster_config_from_mapping",
    "describe_differences",
    "from_stored",
    "json_schema",
    "load",
    "load_cluster_config",
]  # fmt: skip
