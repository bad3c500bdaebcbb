"""Ids of the experiments that come along: a change of code that changes one changes a study.

The version of the model is no part of them here.
"""

from pathlib import Path

import pytest

from sweep.spec import SceneSpec, SpecError, load
from sweep.spec.identity import digest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
IDS = {}
"""Of the study, and of the geometry of each scanner: the first digits."""


def test_every_experiment_has_its_golden_id():
    assert {file.stem for file in EXPERIMENTS.glob("*.yaml")} == set(IDS)


@pytest.mark.parametrize("name", IDS)
def test_an_experiment_keeps_its_id(name):
    try:
        study = load(EXPERIMENTS / f"{name}.yaml")
    except SpecError as error:
        if "gale_crater_hirise_1m.tif" not in str(error):
            raise
        pytest.skip("the terrain is no part of the repository")
    parts = [study.identity()]
    if isinstance(study, SceneSpec):
        parts += [study.geometry(scanner) for scanner in study.scanners]
    assert [digest(part | {"model": ""})[:8] for part in parts] == IDS[name].split()
