"""Every experiment in the repository, end to end on a tiny grid: spec, store, figures."""

from pathlib import Path

import numpy as np
import pytest
from figure_files import has_content

import sweep
from sweep.analysis.selection import matches_any_value
from sweep.analysis.study_figures import draw_figures
from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_COUNT_OUTPUTS,
    GRID_OUTPUTS,
    SPECTRA_STUDY_OUTPUTS,
    STANDARD_ERROR_OUTPUTS,
)
from sweep.spec import GridSpec, SceneSpec
from sweep.spec.yaml_document import read_document

EXPERIMENTS = sorted((Path(__file__).parents[1] / "experiments").glob("*.yaml"))
SCENES = [path for path in EXPERIMENTS if "scene" in read_document(path).content]
GRIDS = [path for path in EXPERIMENTS if path not in SCENES]
OF_EACH_KIND = "quickstart", "range_angle_coarse", "speckled_target", "cfar", "morpheus_three_beam"
"""Run each time; `make test-all` has all."""

KEPT = 4
"""Values kept of a plain axis, and those that figures hold it at; zipped axes keep the first of
every run of equal grazing angle."""


def _shown(paths):
    return [
        pytest.param(
            path, id=path.stem, marks=[] if path.stem in OF_EACH_KIND else [pytest.mark.slow]
        )
        for path in paths
    ]


def _written(member, indices):
    values = np.asarray(member.display_values)[indices].tolist()
    return [f"{value!r} {member.units}".strip() if member.units else value for value in values]


def _held(spec, axis):
    """Places of the values of a plain axis at which figures hold it."""
    axis_values = [figure.where[axis.name] for figure in spec.figures
               if axis.name in getattr(figure, "where", {})]  # fmt: skip
    held = [spec.read_coordinate_value(axis.name, value) for several in axis_values
            for value in (several if isinstance(several, list | tuple) else [several])]  # fmt: skip
    return np.flatnonzero(matches_any_value(np.asarray(axis.parameters[0].display_values), held))


def _kept(spec, axis):
    if not axis.is_zipped:
        spread = np.linspace(0, axis.size - 1, min(KEPT, axis.size)).round().astype(int)
        return np.union1d(spread, _held(spec, axis))
    angles = np.concatenate([m.values for m in axis.parameters if m.path.endswith("grazing_angle")])
    starts = np.flatnonzero(np.diff(angles, prepend=np.nan))[:4]
    return np.unique([*starts, *(starts + 2), axis.size - 1])


def _thinned(spec):
    """The same study with a few values left on every axis."""
    mapping, axes = spec.to_yaml_mapping(), {}
    for axis in spec.axes:
        thinned_values = {m.path: _written(m, _kept(spec, axis)) for m in axis.parameters}
        axes |= {axis.name: {"zip": [thinned_values]}} if axis.is_zipped else thinned_values
    if isinstance(spec, GridSpec) and spec.draws.draws_whole_spectra:
        mapping["draws"] |= {"number": 5}
    return GridSpec.from_mapping(mapping | {"axes": axes})


@pytest.mark.parametrize("path", _shown(GRIDS))
def test_experiment_runs_to_store_and_figures(path, tmp_path):
    spec = sweep.load(path)
    assert spec.question
    if path.stem != "quickstart":  # an instrument of another source than the thesis
        assert spec.target.reflectance * spec.instrument.telescope.optical_efficiency == 0.1
    store = tmp_path / "tiny.zarr"
    assert sweep.run(_thinned(spec), store=store, scheduler="none", progress=False).complete
    dataset = sweep.open(store)
    extra_outputs = (
        {*STANDARD_ERROR_OUTPUTS, *ACCURACY_OUTPUTS, *DRAW_COUNT_OUTPUTS}
        if spec.draws.has_draws
        else set()
    )
    stored = {*GRID_OUTPUTS, *extra_outputs}
    if spec.draws.draws_whole_spectra:
        stored = {*SPECTRA_STUDY_OUTPUTS, *ACCURACY_OUTPUTS, *DRAW_COUNT_OUTPUTS}
    assert set(dataset.data_vars) == {*stored, "effects", "effects_error"}
    is_detected = dataset.pd_doppler > 0.2  # else there may be no draw to average over
    footprint = spec.footprint
    is_checked = footprint.beamlets == 0 and footprint.phases == "incoherent"
    for name, variable in dataset.data_vars.items():
        resolved = spec.draws.draws_whole_spectra and name.startswith(("range_", "radial_"))
        if name == "beamlets_error" and not is_checked:
            assert np.isnan(variable).all()
        else:
            assert np.isfinite(variable.where(is_detected, 0.0) if resolved else variable).all(), (
                name
            )
        if name.startswith(("pd_", "miss_", "pfa_", "p_leakage_")):
            assert ((variable >= 0) & (variable <= 1)).all(), name
    if "miss_shot" in dataset:
        np.testing.assert_allclose(dataset.pd_shot + dataset.miss_shot, 1, atol=1e-14)
    files = draw_figures(store, tmp_path / "figures")
    assert len(files) >= len(spec.figures) and all(map(has_content, files))


def _lightened(path):
    """The same study of a scene with fewer beamlets and draws; skipped without its files."""
    document = read_document(path).content
    files = [thing.get("file") for thing in document["scene"]["objects"].values()]
    for file in filter(None, files):
        if not (path.parent / file).exists():
            pytest.skip(f"{file} is not here")
    mapping = sweep.load(path).to_yaml_mapping()
    few = {"footprint": mapping["footprint"] | {"beamlets": 7}}
    few["draws"] = mapping["draws"] | {"number": min(2, mapping["draws"]["number"])}
    return SceneSpec.from_mapping(mapping | few, base=path.parent)


@pytest.mark.parametrize("path", _shown(SCENES))
def test_experiment_over_a_scene_runs_to_store_and_figures(path, tmp_path):
    spec = _lightened(path)
    assert spec.question and spec.figures
    store = tmp_path / "light.zarr"
    assert sweep.run(spec, store=store, scheduler="none", progress=False).complete
    tree = sweep.open_scene(store)
    for scanner in spec.scanners:
        cloud = tree[scanner].ds
        is_seen = np.isfinite(cloud.beam_range.values)
        assert is_seen.mean() > 0.99
        assert (np.isfinite(cloud.pd_shot.values) == is_seen).all()
        points = cloud.flags.values > 0
        assert (np.isfinite(cloud.range.values) == points).all()
        assert points.any()
    files = draw_figures(store, tmp_path / "figures")
    assert len(files) >= len(spec.figures) and all(map(has_content, files))
