"""Stores extended to larger studies: the bytes of these run at once, and nothing computed twice."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small import STUDY, copied, everything, quiet, receipts, small, tree

from sweep.tasks import evaluate, succession
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.errors import StoreError
from sweep.tasks.lock import Lock
from sweep.tasks.verify import verify

AXES = STUDY["axes"]
POWER, RANGE, ANGLE = AXES
REFLECTANCE = "target.reflectance"


@pytest.fixture
def computed(monkeypatch):
    """Points that the model is given, call by call; not those that compile it."""
    calls: list[int] = []
    real = evaluate.evaluate_points

    def counted(spec, parameters, count, *rest):
        calls.append(count)
        return real(spec, parameters, count, *rest)

    monkeypatch.setattr(evaluate, "evaluate_points", counted)
    monkeypatch.setattr("sweep.tasks.grid_study.compile_kernels", lambda spec, grid: None)
    return calls


def larger(store, spec, **options):
    """A store extended as a plain loop, without progress."""
    return extend(store, spec, progress=False, scheduler="none", **options)


def at_once(spec, tmp_path):
    """Files of a study that is run at once."""
    return tree(quiet(spec, tmp_path / "at_once.zarr").store)


MORE = {
    "appended": ({**AXES, POWER: ["1 W", "3 W", "5 W"]}, 36),
    "prepended": ({**AXES, POWER: ["0.2 W", "1 W", "3 W"]}, 36),
    "in between": ({**AXES, ANGLE: ["20 deg", "35 deg", "50 deg", "80 deg", "90 deg"]}, 48),
    "on two axes": ({**AXES, POWER: ["1 W", "2 W", "3 W"], ANGLE: ["20 deg", "50 deg", "90 deg", "9 deg"]}, 72),
    "new axis": ({**AXES, REFLECTANCE: [0.01, 0.02]}, 72),
    "new axis and values": (
        {REFLECTANCE: [0.01, 0.02], **AXES, POWER: ["1 W", "2 W", "3 W"]},
        144,
    ),
    "in another order": (dict(reversed(AXES.items())), 0),
    "axes zipped with a new one": (
        {RANGE: AXES[RANGE], ANGLE: AXES[ANGLE],
         "bright": {"zip": {POWER: ["1 W", "3 W", "5 W"], REFLECTANCE: [0.02, 0.02, 0.5]}}},
        36,
    ),
}  # fmt: skip


@pytest.mark.parametrize("axes, new", MORE.values(), ids=MORE)
def test_more_values_and_axes_end_as_the_larger_study_run_at_once(
    undisturbed, tmp_path, computed, axes, new
):
    store, spec = copied(undisturbed, tmp_path), small(axes=axes)
    outcome = larger(store, spec)
    assert outcome.complete and outcome.store == store and sum(computed) == new
    assert not [file.name for file in tmp_path.iterdir() if file.name != store.name]
    assert not (store / ".sweep" / "recipe.json").exists()
    assert tree(store) == at_once(spec, tmp_path)
    assert all(report.sound and report.complete for report in verify(store))


few = st.lists(st.sampled_from([0.05, 0.25, 0.5, 0.75, 1.0]), min_size=1, max_size=3, unique=True)


@st.composite
def studies(draw):
    """Axes of a study and of a larger one, and points of a block of each."""
    paths = {POWER: "W", RANGE: "km", "target.radial_velocity": "m/s", REFLECTANCE: ""}
    names = draw(st.permutations(list(paths)))
    ours = draw(st.integers(0, 3))
    older = {path: draw(few) for path in names[:ours]}
    wanted = {}
    for path in draw(st.permutations(names[: draw(st.integers(ours, 4))])):
        kept = older.get(path, [FIXED[path]])
        more = [value for value in draw(few) if value not in kept]
        wanted[path] = draw(st.permutations(kept + more))

    def written(axes):
        return {p: [f"{v} {paths[p]}".strip() for v in values] for p, values in axes.items()}

    blocks = st.integers(1, 40)
    return (written(older), draw(blocks)), (written(wanted), draw(blocks))


FIXED = {POWER: 1.0, RANGE: 2.0, "target.radial_velocity": 3.0, REFLECTANCE: 0.5}
"""Values that parameters have where no axis has them, in the units of the test."""


def of(axes, block_points, **changes):
    """The small study with its fixed values, other axes and blocks."""
    target = STUDY["target"] | {
        "range": "2.0 km",
        "radial_velocity": "3.0 m/s",
        "reflectance": 0.15,
    }
    return small(axes=axes, target=target, storage={"block_points": block_points}, **changes)


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(pair=studies())
def test_any_grid_extended_to_any_larger_one(tmp_path_factory, pair):
    here = tmp_path_factory.mktemp("any")
    older, spec = (of(*each) for each in pair)
    store = quiet(older, here / "store.zarr").store
    assert larger(store, spec).complete
    assert tree(store) == at_once(spec, here)
    shutil.rmtree(here)


#: Effects on demand: which ones a point is simulated with depends on the points around it.
ON_DEMAND = {
    "footprint": {},
    "axes": {
        RANGE: {"linear": ["100 m", "9 km"], "number": 40},
        ANGLE: {"linear": ["2 deg", "90 deg"], "number": 30},
    },
    "storage": {"block_points": 500},
}


def test_points_whose_effects_are_others_in_the_larger_grid_are_computed_anew(tmp_path, computed):
    store = quiet(small(**ON_DEMAND), tmp_path / "store.zarr").store
    axes = {**ON_DEMAND["axes"], ANGLE: {"linear": ["2 deg", "178/2 deg"], "number": 30}}
    axes[RANGE] = {"linear": ["100 m", "17.9 km"], "number": 79}
    axes[ANGLE] = ON_DEMAND["axes"][ANGLE]
    spec = small(**ON_DEMAND | {"axes": axes})
    computed.clear()
    assert larger(store, spec).complete
    new = sum(computed)
    assert 39 * 30 <= new < 79 * 30
    assert tree(store) == at_once(spec, tmp_path)
