"""Probabilities of detection with intervals, false-alarm rates, summaries, and ROC curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import dask
import dask.array
import numpy as np
import xarray as xr

from sweep.analysis.answers.dataset_lookup import (
    coordinate_in_si,
    grid_spec_of_dataset,
    parameter_in_si,
    parse_to_si,
    require_variables,
)
from sweep.model import waveform
from sweep.model.detection.looks import (
    LOOKS_COMBINE_PATH,
    LOOKS_NUMBER_PATH,
    LOOKS_VOTES_PATH,
    Looks,
)
from sweep.model.effects.catalogue import EFFECTS, effect_names_in_flags
from sweep.model.evaluation import evaluate
from sweep.model.sampling.philox import point_keys
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.threshold import THRESHOLD_PATHS, TNR_PATH, tnr_from_parameters
from sweep.spec import GridSpec

SEGMENTS_AND_SHOT = ("up", "doppler", "down", "shot")
"""Names of the segments (chirps), and of the shot. Each has a probability of detection."""


def segment_variable_name(quantity: str, segment: str) -> str:
    """Return the name of a segment's or shot's variable for a quantity, such as 'pd_up'.

    Raise ValueError for an unknown segment.
    """
    if segment not in SEGMENTS_AND_SHOT:
        raise ValueError(
            f"there is no segment '{segment}': take one of {', '.join(SEGMENTS_AND_SHOT)}"
        )
    return f"{quantity}_{segment}"


def pd_half_width(dataset: xr.Dataset, segment: str) -> xr.DataArray | None:
    """Return the half-width of pd's confidence interval as an array; None if pd has no draws."""
    return dataset.get(f"{segment_variable_name('pd', segment)}_half_width")


def detection_probability(dataset: xr.Dataset, segment: str = "shot") -> xr.Dataset:
    """Return the probability of detection with its confidence interval.

    Parameters
    ----------
    segment
        ``shot`` (up- and down-chirp), ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        `pd`, `low` and `high`, from 0 to 1, lazy if the arrays of the store are. The interval is pd
        plus and minus the stored half-width, clipped to 0..1. The attribute `confidence` of `low`
        and `high` is the confidence level. Without draws pd is a closed form, and the interval has
        no width. The interval does not include the possible error of skipped effects, which is the
        variable `effects_error` of the store.
    """
    require_variables(dataset, segment_variable_name("pd", segment))
    pd = dataset[segment_variable_name("pd", segment)]
    interval_half_width = pd_half_width(dataset, segment)
    low, high = (
        (pd, pd)
        if interval_half_width is None
        else ((pd - interval_half_width).clip(0, 1), (pd + interval_half_width).clip(0, 1))
    )
    result = xr.Dataset({"pd": pd, "low": low, "high": high}).assign_attrs(dataset.attrs)
    pd_long_name = pd.attrs.get("long_name", pd.name)
    for name, end_word in (("low", "lower"), ("high", "upper")):
        result[name].attrs = {
            "units": "1", "long_name": f"{end_word} end of the interval of {pd_long_name}",
            **confidence_level_attributes(dataset, interval_half_width),
        }  # fmt: skip
    return result


def confidence_level_attributes(
    dataset: xr.Dataset, interval_half_width: xr.DataArray | None
) -> dict[str, float]:
    """Return the confidence level of pd's intervals as the attribute `confidence` in a dict.

    The dict is empty if the level differs between points. Without draws the level is 1.
    """
    if interval_half_width is None:
        return {"confidence": 1.0}
    confidence_level = interval_half_width.attrs.get("confidence")
    if confidence_level is None and "confidence" not in dataset.coords:
        confidence_level = grid_spec_of_dataset(dataset).accuracy.confidence
    return {} if confidence_level is None else {"confidence": float(confidence_level)}


def false_alarms_per_second(
    dataset: xr.Dataset, rate: str | float | None = None, *, leakage: bool = False
) -> xr.DataArray:
    """Return the mean rate of shots whose up- and down-chirp both raise a false alarm.

    Parameters
    ----------
    rate
        Shots per second, ``"20 Hz"`` or a number. By default it is the highest rate possible, 1 /
        (looks * segments * (duration + gap)).
    leakage
        If true, false alarms due to leaked signal count in addition to those due to noise. A study
        that draws whole spectra always counts every false alarm of a shot, from both causes.

    Returns
    -------
    xarray.DataArray
        Rate [1/s], lazy.

    Raises
    ------
    ValueError
        The rate can't be read, or is not positive.
    """
    shots_per_second: xr.DataArray | float
    if rate is None:
        architecture, segment_order, duration, gap, looks = (
            parameter_in_si(dataset, f"instrument.{path}", grid_spec_of_dataset(dataset))
            for path in (
                "receiver.architecture", "chirp.segments", "chirp.duration", "chirp.gap",
                "looks.number",
            )
        )  # fmt: skip
        n_segments = xr.apply_ufunc(
            lambda a, names: len(waveform.existing_segments(str(a), str(names))),
            architecture,
            segment_order,
            vectorize=True,
            dask="parallelized",
            output_dtypes=[int],
        )
        shots_per_second = 1 / (looks * (n_segments * (duration + gap)))
    else:
        shots_per_second = parse_to_si(rate, si_unit="Hz", name="the rate of shots")
        if not shots_per_second > 0:
            raise ValueError("the rate of shots is a positive number")
    alarm_rate = (shots_per_second * false_alarms_per_shot(dataset, leakage)).rename(
        "false_alarms_per_second"
    )
    cause = "noise and leaked signal" if leakage else "noise alone"
    return alarm_rate.assign_attrs(
        units="s-1",
        long_name="false alarms a second",
        comment=f"shots with false alarms by {cause}",
    )


def false_alarms_per_flight_kilometre(
    dataset: xr.Dataset,
    speed: str | float,
    rate: str | float | None = None,
    *,
    leakage: bool = False,
) -> xr.DataArray:
    """Return the number of shots with false alarms in both chirps per kilometre of flight.

    Parameters
    ----------
    dataset, rate, leakage
        As in :func:`false_alarms_per_second`.
    speed
        Speed along the path, ``"50 m/s"`` or a number in m/s.

    Returns
    -------
    xarray.DataArray
        Number per distance [1/km], lazy: false alarms per second over the speed.

    Raises
    ------
    ValueError
        Speed or rate can't be read, or are not positive.
    """
    metres_per_second = parse_to_si(speed, si_unit="m/s", name="the speed")
    if not metres_per_second > 0:
        raise ValueError("the speed is a positive number")
    alarms_per_second = false_alarms_per_second(dataset, rate, leakage=leakage)
    alarms_per_kilometre = (alarms_per_second * (1000 / metres_per_second)).rename(
        "false_alarms_per_flight_kilometre"
    )
    return alarms_per_kilometre.assign_attrs(
        alarms_per_second.attrs, units="km-1", long_name="false alarms a kilometre"
    )


def false_alarms_per_shot(dataset: xr.Dataset, leakage: bool) -> xr.DataArray:
    """Return the probability that both chirps of a shot have a false alarm, as an array.

    With ``leakage``, false alarms due to leaked signal count in addition to those due to noise. For
    a study that draws whole spectra, the result is the mean number of false alarms of a shot.
    """
    if "pfa_both_chirps" not in dataset:
        # Drawn spectra: false alarms were counted in all segments, including those of leakage.
        draws_spectra = grid_spec_of_dataset(dataset).draws.draws_whole_spectra
        require_variables(dataset, "false_alarms" if draws_spectra else "pfa_both_chirps")
        return dataset["false_alarms"]
    pfa_noise = dataset["pfa_both_chirps"]
    if not leakage:
        return pfa_noise
    require_variables(dataset, "pfa_segment", "p_leakage_up", "p_leakage_down")
    p_leakage = (dataset["p_leakage_up"], dataset["p_leakage_down"])
    return pfa_both_chirps_with_leakage(dataset["pfa_segment"], pfa_noise, *p_leakage)


def pfa_both_chirps_with_leakage(
    pfa_segment: xr.DataArray,
    pfa_both_chirps: xr.DataArray,
    p_leakage_up: xr.DataArray,
    p_leakage_down: xr.DataArray,
) -> xr.DataArray:
    """Return the probability that both chirps have a false alarm, by noise or by leakage, 0..1.

    Parameters
    ----------
    pfa_segment
        Probability of a false alarm due to noise in the up-chirp.
    pfa_both_chirps
        Probability of a false alarm due to noise in both chirps.
    p_leakage_up, p_leakage_down
        Probability of a false alarm due to leakage in the up-chirp and in the down-chirp.

    Notes
    -----
    Noise and leakage are independent. A chirp with the probabilities p by noise and l by leakage
    has a false alarm with the probability p + l (1 - p). The result is the product over both
    chirps. In the down-chirp, p is `pfa_both_chirps` over `pfa_segment`, because the chirps may
    have different numbers of bins.
    """
    pfa_down = pfa_both_chirps / (pfa_segment + (pfa_segment == 0))  # 0 / 1 if pfa_segment is 0
    p_extra_up = pfa_segment + p_leakage_up * (1 - pfa_segment)
    return p_extra_up * (pfa_down + p_leakage_down * (1 - pfa_down))


SUMMARY_STATISTICS = ("mean", "least", "largest", "number")
"""Names of the statistics of :func:`summary`, in the order of its coordinate `statistic`."""


def summary(dataset: xr.Dataset) -> xr.Dataset:
    """Return the mean, the extremes and the number of finite values of every output.

    Returns
    -------
    xarray.Dataset
        Every floating-point variable, lazy, with `statistic` (`SUMMARY_STATISTICS`) as its only
        dimension. Statistics are nan if no value is finite. Each chunk of the store is read once,
        chunk by chunk.
    """
    result = xr.Dataset(coords={"statistic": list(SUMMARY_STATISTICS)}, attrs=dataset.attrs)
    for name, array in dataset.data_vars.items():
        if array.dtype.kind == "f":
            result[name] = xr.DataArray(
                _lazy_statistics(array), dims=["statistic"], attrs=array.attrs
            )
    return result


def _lazy_statistics(array: xr.DataArray) -> dask.array.Array:
    """Return the `SUMMARY_STATISTICS` of an array, as a lazy Dask array (4,)."""
    delayed_chunks = dask.array.asarray(array.chunk().data).to_delayed().ravel()
    delayed_statistics = [
        dask.delayed(_chunk_statistics)(delayed_chunk) for delayed_chunk in delayed_chunks
    ]
    return dask.array.from_delayed(
        dask.delayed(_combine_statistics)(delayed_statistics), (4,), float
    )


def _chunk_statistics(chunk: np.ndarray) -> np.ndarray:
    """Return sum, minimum, maximum and number of the finite values of a chunk, as an array (4,)."""
    finite_values = chunk[np.isfinite(chunk)]
    minimum, maximum = (
        (finite_values.min(), finite_values.max()) if finite_values.size else (np.inf, -np.inf)
    )
    return np.array([finite_values.sum(), minimum, maximum, finite_values.size])


def _combine_statistics(chunk_statistics: list[np.ndarray]) -> np.ndarray:
    """Return the `SUMMARY_STATISTICS` (4,) of an array from `_chunk_statistics` of its chunks."""
    sums, minima, maxima, counts = np.array(chunk_statistics).T
    if not counts.sum():
        return np.array([np.nan, np.nan, np.nan, 0.0])
    return np.array([sums.sum() / counts.sum(), minima.min(), maxima.max(), counts.sum()])


# Receiver operating characteristics. The magnitude of a segment's strongest bin does not depend on
# the threshold. If only the noise is random, a store therefore determines pd at any threshold. With
# the SNR of that bin, and b the threshold over the noise per quadrature,
#
#     pd = Q_1(sqrt(2 SNR), b),    pfa of a bin = exp(-b^2 / 2).
#
# This closed form is used at a point if no random effect was simulated there, and if it reproduces
# the stored pd at the study's threshold. (It does not if bins with lines have more noise than
# others, or if any bin of an echo can detect it.) All other points are simulated again at every
# threshold, with the same draws at each. The effects are always those that the study simulated for
# its own threshold. Far from this threshold, skipped effects may change pd by more than the study's
# tolerance.

ROC_POINTS_MAX = 20_000
"""Largest number of points that a study may have for :func:`roc` to compute curves."""
ROC_SIMULATED_POINTS_MAX = 200
"""Largest number of points without an exact closed form of pd that :func:`roc` simulates again."""

PD_MATCH_TOLERANCE = 1e-9
"""Largest difference from the stored pd up to which the closed form of pd counts as exact."""

CURVE_TNR_VARIABLE = "curve_tnr"
"""Name of the variable with the threshold-to-noise ratio along a ROC curve.

The name is not `tnr`, because a coordinate of the study may have that name.
"""

ROC_RANDOM_KEY_DOMAIN = "sweep.analysis.roc"
"""Text in the key of the random numbers of ROC curves, which no other simulation has."""

_RANDOM_EFFECTS_MASK = sum(1 << k for k, effect in enumerate(EFFECTS) if effect.is_random)
"""Bit mask of the random effects in the variable `effects`."""

_SEGMENTS_THAT_MUST_DETECT = {
    "up": ("up",),
    "doppler": ("doppler",),
    "down": ("down",),
    "shot": ("up", "down"),
}
"""Segments (chirps) that must all exceed the threshold for a detection in a segment or shot."""


def roc(
    dataset: xr.Dataset,
    pfa: Sequence[float] | np.ndarray | None = None,
    *,
    segment: str = "shot",
    draws: int = 1000,
) -> xr.Dataset:
    """Return the probability of detection over the false-alarm probability of a noise bin.

    Parameters
    ----------
    pfa
        Probabilities of a false alarm in one bin, 0 < pfa < 1; by default from 1e-16 to 0.1.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.
    draws
        Number of draws at each point that is simulated again and has random effects.

    Returns
    -------
    xarray.Dataset
        Computed dataset with:

        - `pd`, over the dimensions of the points and `pfa_bin`;
        - `curve_tnr`: threshold-to-noise ratio for each pfa_bin at each point;
        - `simulated`: true if the point was simulated again;
        - `half_width`: half-width of pd's interval with the study's confidence; 0 if pd is exact.

    Raises
    ------
    ValueError
        There are too many points, a pfa is not between 0 and 1, the study draws whole spectra, or
        its looks vary.

    Notes
    -----
    Without random effects, pd = Q_1(sqrt(2 SNR), b) and pfa = exp(-b^2 / 2), where SNR is that of
    the strongest bin, b the threshold over the noise per quadrature, and Q_1 the Marcum function.
    Points at which this pd differs from the stored pd are simulated again at each threshold.
    """
    if grid_spec_of_dataset(dataset).draws.draws_whole_spectra:
        raise ValueError(
            "a study that draws whole spectra has no closed form: put the detector's threshold or "
            "design pfa on an axis, and read pd over pfa_bin"
        )
    pfas = np.logspace(-16, -1, 61) if pfa is None else np.atleast_1d(np.asarray(pfa, float))
    if not ((pfas > 0) & (pfas < 1)).all():
        raise ValueError("probabilities of a false alarm lie between 0 and 1")
    variables = [
        f"{kind}_{s}" for s in _SEGMENTS_THAT_MUST_DETECT[segment] for kind in ("snr", "pd")
    ]
    variables += [segment_variable_name("pd", segment), "log10_pfa_bin", "effects"]
    require_variables(dataset, *variables)
    n_points = dataset[segment_variable_name("pd", segment)].size
    if n_points > ROC_POINTS_MAX:
        raise ValueError(
            f"{n_points:,} points make too many curves (at most {ROC_POINTS_MAX:,}): select some"
        )
    looks = _looks_of_study(grid_spec_of_dataset(dataset))
    detection_rule, peak_rule = (
        parameter_in_si(dataset, path, grid_spec_of_dataset(dataset))
        for path in (waveform.SHOT_DETECTION_PATH, waveform.REPORTED_PEAKS_PATH)
    )
    dataset = dataset[list(dict.fromkeys(variables))].compute()
    threshold_ratio = xr.DataArray(
        looks.threshold_ratio_from_log_pfa(np.log(pfas)), dims=["pfa_bin"]
    )
    pd, is_exact = _closed_form_pd(dataset, segment, threshold_ratio, looks)
    if segment == "shot":  # the product is exact only if both chirps must detect
        is_exact = is_exact & (detection_rule == waveform.BOTH_CHIRPS)
    is_exact = is_exact & (peak_rule == waveform.ALL_PEAKS)
    tnr = threshold_ratio * _study_tnr(dataset) / _study_threshold_ratio(dataset, looks)
    result = xr.Dataset(
        {
            "pd": pd,
            CURVE_TNR_VARIABLE: tnr,
            "simulated": ~is_exact,
            "half_width": xr.zeros_like(pd),
        },
        {"pfa_bin": ("pfa_bin", pfas)},
    )
    result = result.transpose("pfa_bin", *dataset[segment_variable_name("pd", segment)].dims)
    if not is_exact.all():
        _replace_curves_by_simulation(dataset, result, segment, draws)
    return _set_roc_attributes(result, dataset, segment)


def _looks_of_study(spec: GridSpec) -> Looks:
    """Return the settings of a study's looks; raise ValueError if they differ between points."""
    axis_paths = (axis_parameter.path for axis in spec.axes for axis_parameter in axis.parameters)
    if varying_paths := sorted(
        {LOOKS_NUMBER_PATH, LOOKS_COMBINE_PATH, LOOKS_VOTES_PATH} & set(axis_paths)
    ):
        raise ValueError(
            f"{', '.join(varying_paths)} varies, and with it the threshold that a chance of false "
            "alarms "
            "makes: put the design pfa on an axis, and read pd over it"
        )
    return Looks.from_parameters(spec.parameters())


def _closed_form_pd(
    dataset: xr.Dataset, segment: str, threshold_ratio: xr.DataArray, looks: Looks
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return pd in closed form at each threshold, and where it is exact.

    Returns
    -------
    pd : xarray.DataArray
        Probability of detection, over the points and `pfa_bin`.
    is_exact : xarray.DataArray
        Mask of the points at which the closed form gives the stored pd.
    """
    study_ratio = _study_threshold_ratio(dataset, looks)
    pd = xr.ones_like(threshold_ratio)
    is_exact = (dataset["effects"] & _RANDOM_EFFECTS_MASK) == 0
    for segment_name in _SEGMENTS_THAT_MUST_DETECT[segment]:
        stored_pd = dataset[f"pd_{segment_name}"]
        signal_ratio = (2 * dataset[f"snr_{segment_name}"]) ** 0.5
        pd = pd * xr.apply_ufunc(
            _threshold_crossing_probability, signal_ratio, threshold_ratio, kwargs={"looks": looks}
        )
        recomputed_pd = xr.apply_ufunc(
            _threshold_crossing_probability, signal_ratio, study_ratio, kwargs={"looks": looks}
        )
        is_exact = is_exact & (
            (abs(recomputed_pd - stored_pd) <= PD_MATCH_TOLERANCE) | stored_pd.isnull()
        )
    return pd, is_exact


def _study_threshold_ratio(dataset: xr.Dataset, looks: Looks) -> xr.DataArray:
    """Return the study's threshold divided by the noise per quadrature, at each point."""
    if looks.is_noncoherent:
        return xr.apply_ufunc(
            looks.threshold_ratio_from_log_pfa, np.log(10) * dataset["log10_pfa_bin"]
        )
    return (-2 * np.log(10) * dataset["log10_pfa_bin"]) ** 0.5


def _study_tnr(dataset: xr.Dataset) -> xr.DataArray:
    """Return the study's threshold-to-noise ratio at each point."""
    spec, template = grid_spec_of_dataset(dataset), dataset["log10_pfa_bin"]
    if TNR_PATH in spec.parameters():
        return parameter_in_si(dataset, TNR_PATH, spec)
    indices = [
        dict(zip(template.dims, point_index, strict=True))
        for point_index in np.ndindex(template.shape)
    ]
    tnrs = [
        tnr_from_parameters(_point_parameters(template.isel(point_index).coords, spec))
        for point_index in indices
    ]
    return template.copy(data=np.reshape(np.array(tnrs, float), template.shape))


def _point_parameters(coordinates: Mapping[Any, xr.DataArray], spec: GridSpec) -> dict[str, Any]:
    """Return the SI values of all parameters at one point by dotted path.

    `coordinates` are the coordinates of the point. Parameters without a coordinate have the value
    in the spec.
    """
    values = {str(c.attrs["path"]): c for c in coordinates.values() if "path" in c.attrs}
    return spec.parameters() | {
        path: coordinate_in_si(value).values.item() for path, value in values.items()
    }


def _threshold_crossing_probability(
    signal_ratio: np.ndarray, threshold_ratio: np.ndarray, looks: Looks
) -> np.ndarray:
    """Return the probability that a bin with a steady signal exceeds the threshold.

    It is the Marcum function Q_1, or its equivalent for several looks. The magnitudes of signal and
    threshold are divided by the noise per quadrature. The result is nan where either is not finite.
    """
    is_finite = np.isfinite(signal_ratio) & np.isfinite(threshold_ratio)
    probability = looks.pd_and_miss_steady(
        np.where(is_finite, signal_ratio, 0), np.where(is_finite, threshold_ratio, 0)
    ).pd
    return np.where(is_finite, probability, np.nan)


def _replace_curves_by_simulation(
    dataset: xr.Dataset, result: xr.Dataset, segment: str, draws: int
) -> None:
    """Simulate the points without a closed form; write pd and half-width into `result`."""
    spec = grid_spec_of_dataset(dataset)
    point_indices = np.argwhere(np.asarray(result["simulated"].values))
    if len(point_indices) > ROC_SIMULATED_POINTS_MAX:
        raise ValueError(
            f"{len(point_indices):,} points have to be simulated anew (at most "
            f"{ROC_SIMULATED_POINTS_MAX}): select "
            "fewer"
        )
    dims = dataset[segment_variable_name("pd", segment)].dims
    pd, half_widths = result["pd"].values.copy(), result["half_width"].values.copy()
    for point_index in point_indices:
        index_by_dim = dict(zip(dims, map(int, point_index), strict=True))
        point = dataset.isel(index_by_dim)
        tnr = result[CURVE_TNR_VARIABLE].isel(index_by_dim).values
        curve_index = (slice(None), *point_index)
        pd[curve_index], half_widths[curve_index] = _simulate_roc_curve(
            spec, point, tnr, segment, draws
        )
    result["pd"] = result["pd"].copy(data=pd)
    result["half_width"] = result["half_width"].copy(data=half_widths)


def _simulate_roc_curve(
    spec: GridSpec, point: xr.Dataset, tnr: np.ndarray, segment: str, draws: int
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate one point at n threshold-to-noise ratios; return pd and half-widths, (n,) each."""
    parameters = _point_parameters(point.coords, spec)
    is_finite = np.isfinite(tnr)
    if not is_finite.all():
        return np.full(tnr.size, np.nan), np.full(tnr.size, np.nan)
    flags = int(point["effects"])
    effects = effect_names_in_flags(flags)
    pd_name = segment_variable_name("pd", segment)
    parameter_arrays = {
        p: np.full(tnr.size, value) for p, value in parameters.items() if p not in THRESHOLD_PATHS
    }
    parameter_arrays[TNR_PATH] = tnr
    if flags & _RANDOM_EFFECTS_MASK:
        # All thresholds have one key and thus the same draws, so that curves are monotonic.
        key_parameters = {p: v for p, v in sorted(parameters.items()) if p not in THRESHOLD_PATHS}
        key_values = [[v for v in key_parameters.values() if not isinstance(v, str)]]
        keys = np.repeat(
            point_keys(np.array(key_values, float), domain=ROC_RANDOM_KEY_DOMAIN, seed=spec.seed),
            tnr.size,
            0,
        )
        outputs = simulate_draws(
            parameter_arrays, effects, keys=keys, batch_sizes=[draws], method="probabilities"
        )
        return outputs[pd_name], outputs[f"{pd_name}_half_width"]
    return evaluate(parameter_arrays, effects)[pd_name], np.zeros(tnr.size)


def _set_roc_attributes(result: xr.Dataset, dataset: xr.Dataset, segment: str) -> xr.Dataset:
    """Return a ROC dataset with units and long names set, and with `dataset`'s attributes."""
    long_names = {
        "pd": f"probability of detection, {segment}",
        CURVE_TNR_VARIABLE: "threshold to noise ratio",
        "simulated": "whether the point was simulated anew at every threshold",
        "half_width": f"half-width of the interval of the probability of detection, {segment}",
        "pfa_bin": "probability of false alarm in one bin, from noise alone",
    }
    for name, long_name in long_names.items():
        result[name].attrs = {"units": "1", "long_name": long_name}
    return result.assign_attrs(dataset.attrs)
