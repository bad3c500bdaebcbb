"""The declarative experiment: YAML in, checked values out, every mistake at once."""

from sweep.spec.axes import Axis, Member
from sweep.spec.clusters import AnyCluster, cluster_of, load_cluster
from sweep.spec.figures import FalseAlarmTable, Figure, Slices, Surface, Table, ThresholdTable
from sweep.spec.identity import difference
from sweep.spec.rules import Mistake, SpecError
from sweep.spec.schema import json_schema
from sweep.spec.sections import Draws
from sweep.spec.study import SceneSpec, Spec, from_stored, load

__all__ = [
    "AnyCluster", "Axis", "Draws", "FalseAlarmTable", "Figure", "Member", "Mistake", "SceneSpec",
    "Slices", "Spec", "SpecError", "Surface", "Table", "ThresholdTable", "cluster_of",
    "difference", "from_stored", "json_schema", "load", "load_cluster",
]  # fmt: skip
