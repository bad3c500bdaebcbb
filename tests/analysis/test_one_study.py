"""Answers from joined, reduced and changed datasets: a study's, a design's, or a refusal."""

import pickle

import numpy as np
import pytest
import xarray as xr
from stored_studies import spec_over_axes

import sweep
from sweep.spec import GridSpec

RANGES = {"target.range": ["1 km", "2 km", "4 km", "16 km"]}
POWERS = {"instrument.laser.power": ["1 W", "3 W"]}


def computed(directory, name, axes, **changes):
    """Path of the store of a study whose instrument has some fields set anew."""
    mapping = spec_over_axes(axes).to_yaml_mapping() | {"title": name}
    for path, value in changes.items():
        section, field = path.split("__")
        mapping["instrument"][section] = mapping["instrument"][section] | {field: value}
    path = directory / f"{name}.zarr"
    spec = GridSpec.from_mapping(mapping)
    sweep.run(spec, store=path, scheduler="none", progress=False)
    return path


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    directory = tmp_path_factory.mktemp("designs")
    return {
        "small": computed(directory, "small", RANGES | POWERS),
        "large": computed(
            directory, "large", RANGES, telescope__aperture="50 mm", processing__fft_size="2^15"
        ),
    }


@pytest.fixture(scope="module")
def small(stores):
    return sweep.open(stores["small"])


@pytest.fixture(scope="module")
def large(stores):
    return sweep.open(stores["large"])


def by_new_defaults(datasets, dim):
    with xr.set_options(use_new_combine_kwarg_defaults=True):
        return xr.concat(datasets, dim)


def with_variable(one, other, name):
    modified = one.copy()
    modified[name] = other[name]
    return modified


NEAR, FAR = {"range": slice(0, 2)}, {"range": slice(2, None)}
TOGETHER = {
    "concat": lambda one, other: xr.concat([one, other], "design"),
    "one of a concat": lambda one, other: xr.concat([one, other], "design").isel(design=1),
    "halves": lambda one, other: xr.concat([one.isel(NEAR), other.isel(FAR)], "range"),
    "nested": lambda one, other: xr.combine_nested([one, other], concat_dim="case"),
    "merge": lambda one, other: xr.merge([one[["pd_shot", "effects"]], other[["snr_up"]]]),
    "combine_first": lambda one, other: one.combine_first(other),
    "fillna": lambda one, other: one.fillna(other),
    "where": lambda one, other: one.where(one.pd_shot > 2, other),
    "difference": lambda one, other: one - other,
    "xarray's new defaults": lambda one, other: by_new_defaults([one, other], "design"),
    "halves by new defaults": lambda one, other: by_new_defaults(
        [one.isel(NEAR), other.isel(FAR)], "range"
    ),
    "one of a concat by new defaults": lambda one, other: by_new_defaults(
        [one, other], "design"
    ).isel(design=1),
    "one of a concat, without its name": lambda one, other: by_new_defaults(
        [one, other], "design"
    ).isel(design=1, drop=True),
    "halves, the first one's coordinates": lambda one, other: xr.concat(
        [one.isel(NEAR), other.isel(FAR)], "range", coords="minimal", compat="override"
    ),
    "halves by combine_nested": lambda one, other: xr.combine_nested(
        [one.isel(NEAR), other.isel(FAR)], "range", coords="minimal", compat="override"
    ),
    "halves by combine_by_coords": lambda one, other: xr.combine_by_coords(
        [one.isel(NEAR), other.isel(FAR)], coords="minimal", compat="override"
    ),
    "merge, the first one's coordinates": lambda one, other: xr.merge(
        [one[["pd_shot", "effects"]], other[["snr_up"]]], compat="override"
    ),
    "a variable assigned": lambda one, other: one.assign(snr_up=other.snr_up),
    "all variables assigned": lambda one, other: one.assign(dict(other.data_vars)),
    "a variable set": lambda one, other: with_variable(one, other, "effects"),
    "without the id": lambda one, other: one.assign(snr_up=other.snr_up).drop_vars("study_id"),
    "without attributes": lambda one, other: (one - other).drop_attrs(),
    "coordinates of the first": lambda one, other: xr.Dataset(
        {"snr_up": other.snr_up, **one.drop_vars("snr_up")}, coords=one.coords, attrs=one.attrs
    ),
}


@pytest.mark.parametrize("answer", ["range_error", "roc", "false_alarms_per_second",
                                    "maximum_range", "contour", "summary"])  # fmt: skip
@pytest.mark.parametrize("join_name", TOGETHER)
def test_datasets_of_two_studies_answer_nothing(small, large, join_name, answer):
    with pytest.raises(ValueError, match=r"stud(y|ies)"):
        getattr(TOGETHER[join_name](small.sel(power=1), large).sweep, answer)()


def test_parts_of_one_study_put_together_answer_as_the_whole(small):
    parts = [small.isel(range=[0, 1]), small.isel(range=[2, 3])]
    bound = xr.concat(parts, "range").sweep.range_error().bound
    np.testing.assert_array_equal(bound, small.sweep.range_error().bound)


@pytest.mark.parametrize("answer", ["range_error", "velocity_error", "roc",
                                    "false_alarms_per_second", "compare"])  # fmt: skip
@pytest.mark.parametrize(
    "reduce",
    [
        lambda ds: ds.isel(power=1, drop=True),
        lambda ds: ds.sel(power=3, drop=True),
        lambda ds: ds.isel(power=[1]).squeeze(drop=True),
        lambda ds: ds.isel(power=1).drop_vars("power"),
        lambda ds: ds.mean("power"),
        lambda ds: ds.max("range"),
        lambda ds: ds.isel(power=1).reset_coords("power"),
        lambda ds: ds.coarsen(range=2).mean(),
        lambda ds: ds.interp(range=1.5),
        lambda ds: ds.reindex(range=[1.0, 1.5]),
        lambda ds: ds.assign_coords(range=ds.range * 1000),
        lambda ds: ds.assign_coords(power=[2.0, 4.0]),
        lambda ds: ds.rolling(range=2).mean(),
        lambda ds: ds.pad(range=1),
        lambda ds: ds.expand_dims("again"),
        lambda ds: ds.drop_vars("study_id"),
        lambda ds: ds.drop_vars(f"study_{ds.study_id.item()[:16]}"),
        lambda ds: ds.drop_attrs(),
        lambda ds: ds.assign_attrs(spec=""),
    ],
)
def test_an_axis_dropped_or_changed_is_refused_in_words(small, reduce, answer):
    arguments = (small,) if answer == "compare" else ()
    with pytest.raises(ValueError, match=r"study|spec|flags"):
        getattr(reduce(small).sweep, answer)(*arguments)


def test_what_needs_no_parameter_is_answered_without_the_dropped_axis(small):
    unbroken_range = small.sweep.maximum_range(pd=0.5).unbroken
    dropped = small.isel(power=1, drop=True).sweep.maximum_range(pd=0.5).unbroken
    assert (
        float(dropped) == float(unbroken_range.isel(power=1)) != float(unbroken_range.isel(power=0))
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda ds: ds.isel(range=[3, 1]),
        lambda ds: ds.sel(range=[1.9, 5.8], method="nearest"),
        lambda ds: ds.sweep.sel(range=["2 km", "4 km"]),
        lambda ds: ds.rename(range="distance"),
        lambda ds: ds.stack(point=("range", "power")),
        lambda ds: ds.assign_coords(range=ds.range.values),
        lambda ds: ds.assign_coords(
            range=(ds.range * 1000).assign_attrs(units="m", path="target.range")
        ),
        lambda ds: pickle.loads(pickle.dumps(ds)),
        lambda ds: xr.Dataset.from_dict(ds.to_dict()),
        lambda ds: ds.chunk(range=1),
        lambda ds: ds.compute(),
    ],
)
def test_a_part_of_a_study_in_other_words_is_still_that_study(small, change):
    complete, part = (
        {
            (round(float(r) % 999, 6), float(p)): float(bound)
            for r, p, bound in range_error.bound.to_dataframe().reset_index()
            .rename(columns={"distance": "range"})[["range", "power", "bound"]]
            .itertuples(index=False)
        }
        for range_error in (ds.sweep.range_error() for ds in (small, change(small)))
    )  # fmt: skip
    assert part.items() <= complete.items() and len(part) >= 4


@pytest.mark.parametrize(
    "name",
    ["range_error", "velocity_error", "maximum_range", "summary", "false_alarms_per_second",
     "roc", "detection_probability"],
)  # fmt: skip
def test_a_join_answers_each_design_by_its_own_spec(stores, small, large, name):
    joined = sweep.open([stores["small"], stores["large"]], dim="design")
    assert joined.design.values.tolist() == ["small", "large"] and joined.sizes["power"] == 2
    answer = getattr(joined.sweep, name)()
    assert answer.study_id.values.tolist() == [small.study_id.item(), large.study_id.item()]
    for design, dataset in (("small", small), ("large", large)):
        expected = getattr(dataset.sweep, name)()
        design_answer = answer.sel(design=design)
        if isinstance(expected, xr.DataArray):
            design_answer, expected = (
                design_answer.to_dataset(name="value"),
                expected.to_dataset(name="value"),
            )
        if design == "large" and "power" in design_answer.dims:
            design_answer = design_answer.sel(power=1)
        for variable in expected.data_vars:
            dims = expected[variable].dims
            np.testing.assert_allclose(
                design_answer[variable].transpose(*dims),
                expected[variable],
                rtol=1e-12,
                err_msg=variable,
            )


def test_one_design_of_a_join_is_that_study(stores, large):
    joined = sweep.open({"25 mm": stores["small"], "50 mm": stores["large"]}, dim="aperture_case")
    chosen = joined.sel(aperture_case="50 mm")
    assert chosen.sweep.spec == large.sweep.spec
    np.testing.assert_array_equal(
        chosen.sweep.range_error().bound.squeeze(), large.sweep.range_error().bound
    )
    limit = pickle.loads(pickle.dumps(joined)).sweep.maximum_range(pd=0.5)
    xr.testing.assert_identical(limit.compute(), joined.sweep.maximum_range(pd=0.5).compute())
    for refused in (
        lambda: joined.sweep.spec,
        lambda: large.sweep.compare(joined),
        lambda: joined.mean("aperture_case").sweep.maximum_range(),
        lambda: joined.isel(aperture_case=0, drop=True).sweep.maximum_range(),
        lambda: chosen.assign(snr_up=large.snr_up).sweep.maximum_range(),
        lambda: xr.merge([chosen, large], compat="override").sweep.maximum_range(),
        lambda: by_new_defaults([large, chosen], "again").isel(again=1).sweep.maximum_range(),
    ):
        with pytest.raises(ValueError, match=r"stud(y|ies)"):
            refused()


def test_designs_in_other_units_and_on_other_values_are_joined_by_value(tmp_path, stores, small):
    other = computed(
        tmp_path, "other", {"target.range": ["2000 m", "3000 m"]}, telescope__aperture="40 mm"
    )
    joined = sweep.open([stores["small"], other])
    assert joined.range.values.tolist() == [1, 2, 3, 4, 16] and joined.range.attrs["units"] == "km"
    reach = joined.sweep.maximum_range(pd=0.5)
    limit = sweep.open(other).sweep.maximum_range(pd=0.5)
    assert reach.unbroken_reason.sel(design="other", power=1) == limit.unbroken_reason
    np.testing.assert_allclose(
        reach.unbroken.sel(design="small"), small.sweep.maximum_range(pd=0.5).unbroken
    )
    curves = joined.sel(power=1).isel(range=[1]).sweep.roc(pfa=[1e-6])
    assert np.isfinite(curves.pd).all()


@pytest.mark.parametrize(
    ("combine", "message"),
    [
        (lambda s: sweep.open([s["small"], s["small"]]), "twice"),
        (lambda s: sweep.open({"a": s["small"], "b": s["small"]}), "the same study"),
        (lambda s: sweep.open([]), "empty"),
        (lambda s: sweep.open({}), "empty"),
        (lambda s: sweep.open([s["small"], s["large"]], dim="range"), "'range' can't name"),
        (lambda s: sweep.open([s["small"], s["large"]], dim="pd_shot"), "'pd_shot' can't name"),
    ],
)
def test_joins_that_cannot_be_are_refused_in_words(stores, combine, message):
    with pytest.raises(ValueError, match=message):
        combine(stores)


def test_zipped_axes_join_where_they_are_the_same(tmp_path):
    cut = {"zip": {"target.range": ["1 km", "2 km"], "target.grazing_angle": ["20 deg", "40 deg"]}}
    other = {
        "zip": {"target.range": ["1 km", "3 km"], "target.grazing_angle": ["20 deg", "40 deg"]}
    }
    one = computed(tmp_path, "one", {"cut": cut})
    two = computed(tmp_path, "two", {"cut": cut}, telescope__aperture="50 mm")
    three = computed(tmp_path, "three", {"cut": other}, telescope__aperture="50 mm")
    bounds = sweep.open([one, two]).sweep.range_error().bound
    for name, store in (("one", one), ("two", two)):
        range_error = sweep.open(store).sweep.range_error().bound
        np.testing.assert_array_equal(bounds.sel(design=name), range_error)
    with pytest.raises(ValueError, match="zipped axis 'cut'"):
        sweep.open([one, three])


def test_contours_of_designs_are_distinguished(tmp_path):
    axes = {
        "target.range": {"step": ["1 km", "8 km", "1 km"]},
        "target.grazing_angle": {"step": ["10 deg", "90 deg", "20 deg"]},
    }
    paths = [computed(tmp_path, "weak", axes, laser__power="1 W"),
             computed(tmp_path, "strong", axes, laser__power="3 W")]  # fmt: skip
    contour = sweep.open(paths).sweep.contour(pd=0.5)
    for name, path in zip(("weak", "strong"), paths, strict=True):
        single_contour = sweep.open(path).sweep.contour(pd=0.5)
        np.testing.assert_array_equal(contour.range[contour.design == name], single_contour.range)


def test_studies_whose_intervals_one_lacks_keep_their_own_variables(tmp_path, stores, small):
    mapping = spec_over_axes(RANGES).to_yaml_mapping() | {"title": "drawn", "draws": {"number": 50}}
    drawn = tmp_path / "drawn.zarr"
    spec = GridSpec.from_mapping(mapping)
    sweep.run(spec, store=drawn, scheduler="none", progress=False)
    joined = sweep.open([stores["small"], drawn])
    pd = joined.sel(power=1).sweep.detection_probability()
    probability = sweep.open(drawn).sweep.detection_probability()
    for name in ("pd", "low", "high"):
        np.testing.assert_array_equal(pd[name].sel(design="drawn"), probability[name])
    assert (pd.low == pd.pd).sel(design="small").all()
    assert joined.n_draws.dtype.kind == "i" and (joined.n_draws.sel(design="small") == -1).all()


@pytest.mark.parametrize("reduction", ["max", "min"])
def test_extremes_of_detection_and_of_misses_are_no_study(small, reduction):
    reduced = getattr(small, reduction)("power", keep_attrs=True)
    with pytest.raises(ValueError, match="answer first") as refused:
        reduced.sweep.maximum_range(pd=0.5).compute()
    assert "unbroken_reason" in str(refused.value) and ".max('power')" not in str(refused.value)
    answer = small.sweep.maximum_range(pd=0.5)
    assert (answer.unbroken.isnull() == (answer.unbroken_reason != 0)).all()


@pytest.mark.parametrize(
    ("answer", "selection", "missing"),
    [
        ("range_error", ["pd_shot", "snr_up"], "snr_doppler, snr_down, effects, range_error"),
        ("roc", ["pd_shot"], "snr_up, pd_up"),
        ("maximum_range", ["pd_up"], "pd_shot"),
        ("detection_probability", ["snr_up"], "pd_shot"),
        ("false_alarms_per_second", ["pd_shot"], "pfa_both_chirps"),
    ],
)
def test_variables_left_out_are_named(small, answer, selection, missing):
    with pytest.raises(ValueError, match=f"the dataset lacks {missing}"):
        getattr(small[selection].sweep, answer)()
