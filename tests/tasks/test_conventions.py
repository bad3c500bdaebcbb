"""Attributes of stores follow the CF conventions: what cf-xarray and pint-xarray read of them."""

import numpy as np
import pytest
from small_flights import small_scene_spec
from small_studies import small_spec

import sweep
from sweep.tasks.engine import study_store
from sweep.tasks.studies.study_loading import make_study

STUDIES = {
    "grid": lambda: small_spec(),
    "draws": lambda: small_spec(draws={"number": 10}),
    "spectra": lambda: small_spec(draws={"number": 10, "method": "spectra"}),
    "limit": lambda: small_spec(draws={"limit": 100}),
    "noise density": lambda: small_spec(
        axes={"instrument.receiver.noise_equivalent_power": ["5 pW/rtHz", "6 pW/rtHz"]}
    ),
    "flight": small_scene_spec,
}


@pytest.fixture(scope="module", params=STUDIES)
def datasets(request, tmp_path_factory):
    """Datasets of a store without results; not to be changed."""
    spec, path = STUDIES[request.param](), tmp_path_factory.mktemp("conventions") / "a.zarr"
    study_store.create_store(path, make_study(spec, path))
    if request.param == "flight":
        return [node.to_dataset() for node in sweep.open_scene(path).subtree]
    return [sweep.open(path)]


def test_the_root_names_the_conventions(datasets):
    assert datasets[0].attrs["Conventions"].startswith("CF-1.")


def test_every_variable_has_units_and_a_name_in_words(datasets):
    for dataset in datasets:
        for name, variable in dataset.variables.items():
            if variable.dtype.kind in "fiu" and name != "batch":
                assert {"units", "long_name"} <= variable.attrs.keys(), name


def test_every_flag_has_masks_or_values_and_as_many_meanings(datasets):
    flags = {}
    for dataset in datasets:
        for name, variable in dataset.variables.items():
            if name in ("effects", "flags") or name.endswith("_status"):
                kind = "flag_values" if name.endswith("_status") else "flag_masks"
                bits = variable.attrs[kind]
                meanings = variable.attrs["flag_meanings"].split()
                assert len(set(bits)) == len(set(meanings)) == len(bits), name
                assert np.array(bits).astype(variable.dtype).tolist() == list(bits), name
                if kind == "flag_masks":
                    assert [bin(bit).count("1") for bit in bits] == [1] * len(bits), name
                flags[name] = meanings
    assert "effects" in flags
    if len(datasets) > 1:
        assert flags.keys() == {"effects", "flags", "velocity_status", "altitude_status"}
        assert flags["flags"][0] == "true" and flags["velocity_status"][0] == "solved"


def test_pint_reads_the_units_of_every_variable(datasets):
    units = pytest.importorskip("cf_xarray.units").units
    pytest.importorskip("pint_xarray")
    for dataset in datasets:
        numeric_dataset = dataset.drop_vars(
            [n for n, v in dataset.variables.items() if v.dtype.kind in "OTU"]
        )
        assert numeric_dataset.pint.quantify(unit_registry=units).sizes == numeric_dataset.sizes
        for name, variable in numeric_dataset.variables.items():
            if name in ("radial_velocity", "radial_velocity_error"):
                assert units.Unit(variable.attrs["units"]) == units.Unit("m / s")


def test_cf_xarray_finds_flags_and_standard_names(datasets):
    pytest.importorskip("cf_xarray")
    names = set()
    for dataset in datasets:
        if "effects" in dataset:
            flags = dataset.effects.cf.flags
            assert {"footprint", "doppler", "leakage"} <= set(flags.data_vars)
        names |= set(dataset.cf.standard_names)
    if len(datasets) > 1:
        velocity = "radial_velocity_of_scatterers_toward_instrument"
        assert names == {velocity, "height"}
        assert "true_altitude" in datasets[1].cf.standard_names["height"]
