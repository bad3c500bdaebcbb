"""Errors of range and radial velocity, and the Cramer-Rao bounds on unbiased estimates."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import NamedTuple, TypeVar

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

from sweep.analysis.answers.dataset_lookup import (
    grid_spec_of_dataset,
    parameter_in_si,
    require_variables,
)
from sweep.model import waveform
from sweep.model.detection import estimators
from sweep.model.detection.looks import LOOKS_COMBINE_PATH, LOOKS_NUMBER_PATH, Looks
from sweep.model.effects.catalogue import (
    EFFECT_NAMES,
    EFFECTS,
    PARAMETER_DEFAULTS,
    effect_names_in_flags,
)
from sweep.model.evaluation import prepare_shots
from sweep.model.preparation import split_by_category
from sweep.model.sampling.speckle_wander import mean_range_velocity_wander_variance
from sweep.model.shot_settings import (
    CHIRP_PREFIX,
    LASER_PREFIX,
    PROCESSING_PREFIX,
    RECEIVER_PREFIX,
    LineMotion,
    RecordSettings,
    TargetState,
    WaveformSettings,
)
from sweep.model.waveform import SEGMENT_NAMES
from sweep.model.window import Window, direct_transform, get_window
from sweep.spec import GridSpec

_FlagArray = TypeVar("_FlagArray", np.ndarray, xr.DataArray)

_CRAMER_RAO_PARAMETER_PATHS = (
    RECEIVER_PREFIX + "architecture",
    LASER_PREFIX + "wavelength",
    LASER_PREFIX + "line_width",
    LASER_PREFIX + "line_shape",
    CHIRP_PREFIX + "bandwidth",
    CHIRP_PREFIX + "start_frequency",
    CHIRP_PREFIX + "duration",
    waveform.SEGMENT_ORDER_PATH,
    waveform.SEGMENT_GAP_PATH,
    waveform.DOPPLER_CHIRP_RATE_RATIO_PATH,
    waveform.DOWN_CHIRP_RATE_RATIO_PATH,
    PROCESSING_PREFIX + "sample_rate",
    PROCESSING_PREFIX + "fft_size",
    PROCESSING_PREFIX + "window",
    PROCESSING_PREFIX + "acquisition_delay",
    LOOKS_NUMBER_PATH,
    LOOKS_COMBINE_PATH,
    "target.range",
    "target.radial_velocity",
)
"""Dotted paths of the parameters on which the Cramer-Rao bounds depend."""

_RANDOM_EFFECT_NAMES = {effect.name for effect in EFFECTS if effect.is_random}
"""Names of the effects that are simulated by random draws."""


class _LineEffectMasks(NamedTuple):
    """Masks (n,) of points at which effects are simulated that change the bound for a given SNR.

    Fields have the names of the effects.
    """

    range_walk: np.ndarray
    """Mask (n,) of points whose beats drift within the record."""
    segment_motion: np.ndarray
    """Mask (n,) of points whose target moves between segments."""
    overlap: np.ndarray
    """Mask (n,) of points whose echoes lack the samples that precede their arrival."""


def range_error(dataset: xr.Dataset) -> xr.Dataset:
    """Return the error of the reported range, and the Cramer-Rao bound of unbiased estimates.

    Returns
    -------
    xarray.Dataset
        Lazy dataset [m]:

        - `reported`: the noise-free range reported from whole bins, minus the true range;
        - `resolution`: the standard deviation caused by whole bins, averaged over positions within
          a bin;
        - `bound`: the least standard deviation of an unbiased estimate, for a single line with the
          stored SNR in all three segments together, plus in quadrature the contribution of
          developed speckle to detected echoes.

        A study that draws whole spectra has instead its stored `bias`, `rmse` and `bound`.

    Notes
    -----
    A peak in a whole bin has a standard deviation of a bin over sqrt(12). With equal and opposite
    chirps the range is half the sum of two peaks, which gives a bin over sqrt(24). With other chirp
    rates it is a fit to all peaks, here of equal weight; weights by power lower the deviation by up
    to 10 %. Below the threshold, noise is mistaken for signal, and no estimate comes near the
    bound.

    References
    ----------
    The bound of each beat is that of Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591 (1974), as
    described in :mod:`sweep.model.detection.estimators`. The contribution of speckle is described
    in :mod:`sweep.model.sampling.speckle_wander`.
    """
    return _error_dataset(dataset, "range")


def velocity_error(dataset: xr.Dataset) -> xr.Dataset:
    """Return the error of the reported radial velocity, and the Cramer-Rao bound.

    Result and notes are those of :func:`range_error`, with m/s in place of m. The velocity is half
    the difference of two peaks.
    """
    return _error_dataset(dataset, "radial_velocity")


def _error_dataset(dataset: xr.Dataset, quantity: str) -> xr.Dataset:
    """Return the dataset of :func:`range_error` or :func:`velocity_error`, as `quantity` says.

    `quantity` is ``range`` or ``radial_velocity``.
    """
    if f"{quantity}_rmse" in dataset:
        statistics = {kind: dataset[f"{quantity}_{kind}"] for kind in ("bias", "rmse", "bound")}
        return xr.Dataset(statistics).assign_attrs(dataset.attrs)
    spec = grid_spec_of_dataset(dataset)
    snr_names = [f"snr_{name}" for name in SEGMENT_NAMES]
    require_variables(dataset, *snr_names, "effects", f"{quantity}_error")
    parameters = {
        path: parameter_in_si(dataset, path, spec) for path in _CRAMER_RAO_PARAMETER_PATHS
    }
    snr = [dataset[name] for name in snr_names]

    def point_bounds(
        up: np.ndarray,
        doppler: np.ndarray,
        down: np.ndarray,
        effect_flags: np.ndarray,
        *parameter_values: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        line_effects = _LineEffectMasks(
            *(_simulated_mask(effect, effect_flags) for effect in _LineEffectMasks._fields)
        )
        point_parameters = dict(zip(parameters, parameter_values, strict=True))
        deviations = _point_deviations((up, doppler, down), line_effects, point_parameters)
        return getattr(deviations.bound, quantity), getattr(deviations.whole_bins, quantity)

    bounds, resolution = xr.apply_ufunc(
        point_bounds,
        *snr,
        dataset["effects"],
        *parameters.values(),
        dask="parallelized",
        output_core_dims=[[], []],
        output_dtypes=[float, float],
    )
    bounds = np.hypot(
        bounds.transpose(*snr[0].dims), _speckle_standard_deviation(dataset, quantity, spec)
    )
    result = xr.Dataset({
        "reported": dataset[f"{quantity}_error"],
        "resolution": resolution.transpose(*snr[0].dims),
        "bound": bounds,
    })  # fmt: skip
    units, quantity_words = (
        str(result["reported"].attrs.get("units", "")),
        quantity.replace("_", " "),
    )
    for name, long_name in (
        ("resolution", f"standard deviation that whole bins give to the {quantity_words}"),
        ("bound", f"Cramer-Rao bound on the standard deviation of the {quantity_words}"),
    ):
        result[name].attrs = {"units": units, "long_name": long_name}
    return result.assign_attrs(dataset.attrs)


def _speckle_standard_deviation(dataset: xr.Dataset, quantity: str, spec: GridSpec) -> xr.DataArray:
    """Return the standard deviation [m or m/s] that speckle adds to estimates of a quantity.

    `quantity` is ``range`` or ``radial_velocity``. The result is 0 at points without fading.
    """
    is_fading = _simulated_mask("fading", dataset["effects"])
    if (
        spec.effect_modes()["fading"] == "off"
        or spec.parameters()["footprint.speckle"] != "developed"
    ):
        return xr.zeros_like(is_fading, float)
    fixed_parameters = PARAMETER_DEFAULTS | spec.parameters()
    varying_parameters = {
        axis_parameter.path: parameter_in_si(dataset, axis_parameter.path, spec)
        for axis in spec.axes
        for axis_parameter in axis.parameters
    }
    pd_names, snr_names = ([f"{kind}_{name}" for name in SEGMENT_NAMES] for kind in ("pd", "snr"))
    arguments = {
        "effects": dataset["effects"],
        **{name: dataset[name] for name in (*pd_names, *snr_names)},
        **varying_parameters,
    }

    def point_deviation(*arrays: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
        columns = {
            name: np.broadcast_to(array, shape).ravel()
            for name, array in zip(arguments, arrays, strict=True)
        }
        flags = columns["effects"]
        variance = np.zeros(flags.size)
        for flag_bits in np.unique(flags):
            rows = np.flatnonzero(flags == flag_bits)
            effects = [
                name
                for name in effect_names_in_flags(int(flag_bits))
                if name not in _RANDOM_EFFECT_NAMES
            ]
            if "fading" not in effects:
                continue
            varying_values = {path: columns[path][rows] for path in varying_parameters}
            pd, snr = (
                np.array([columns[name][rows] for name in names]) for names in (pd_names, snr_names)
            )
            for batch_rows, shots in prepare_shots(fixed_parameters | varying_values, effects):
                estimate_errors = mean_range_velocity_wander_variance(
                    shots, pd[:, batch_rows], snr[:, batch_rows]
                )
                variance[rows[batch_rows]] = getattr(estimate_errors, quantity)
        return np.sqrt(variance).reshape(shape)

    return xr.apply_ufunc(
        point_deviation, *arguments.values(), dask="parallelized", output_dtypes=[float]
    )


def _simulated_mask(effect: str, effect_flags: _FlagArray) -> _FlagArray:
    """Return a mask of the points at which an effect is simulated, from their flags of effects."""
    return (effect_flags & (1 << EFFECT_NAMES.index(effect))) > 0


class _PointDeviations(NamedTuple):
    """Standard deviations of range and radial velocity at points, by their cause."""

    bound: estimators.RangeVelocityDeviation
    """Cramer-Rao bounds; nan without an echo."""
    whole_bins: estimators.RangeVelocityDeviation
    """Deviations of values that are read from whole bins of equal weight."""


def _point_deviations(
    snr: tuple[np.ndarray, ...], effects: _LineEffectMasks, parameters: dict[str, np.ndarray]
) -> _PointDeviations:
    """Return the Cramer-Rao bounds and the deviations by whole bins at each point.

    Parameters
    ----------
    snr
        Signal-to-noise ratios of the three segments.
    effects
        Masks of the points at which effects that change lines are simulated.
    parameters
        SI values at each point of the parameters in `_CRAMER_RAO_PARAMETER_PATHS`.
    """
    shape = np.broadcast_shapes(
        *(np.shape(values) for values in (*snr, *effects, *parameters.values()))
    )
    flat_snr, flat_effects, flat_parameters = (
        [np.broadcast_to(values, shape).ravel() for values in arrays]
        for arrays in (snr, effects, parameters.values())
    )
    deviations = np.empty((2, 2, math.prod(shape)))
    categories = (
        split_by_category(dict(zip(parameters, flat_parameters, strict=True)))
        if deviations.size
        else ()
    )
    for rows, category_parameters in categories:
        deviations[:, :, rows] = _deviations_of_category(
            [values[rows] for values in flat_snr],
            _LineEffectMasks(*(flags[rows] for flags in flat_effects)),
            category_parameters,
        )
    return _PointDeviations(
        *(
            estimators.RangeVelocityDeviation(*by_cause.reshape(2, *shape))
            for by_cause in deviations
        )
    )


def _deviations_of_category(
    snr: list[np.ndarray], effects: _LineEffectMasks, parameters: dict[str, np.ndarray]
) -> _PointDeviations:
    """Return the deviations of points that share text parameters and sizes.

    The CNR of each segment follows from the stored SNR, after removal of the scalloping loss and of
    the loss of a late echo. The CNR gives the bound of the beat frequency, to which the laser's
    phase noise is added in quadrature. The bounds of the three beat frequencies combine to those of
    range and radial velocity. For the scalloping loss the target has a constant speed along the
    beam: its acceleration and the slip of the beam over sloping ground are neglected.
    """
    waveform_settings = WaveformSettings.from_parameters(parameters)
    record = RecordSettings.from_parameters(parameters)
    looks = Looks.from_parameters(parameters)
    taper, sample_rate = record.window, record.sample_rate
    radial_velocity = parameters["target.radial_velocity"]
    target = TargetState(
        range=parameters["target.range"],
        radial_velocity=radial_velocity,
        acceleration=np.zeros(()),
        approach_speed=radial_velocity,
    )
    motion = LineMotion(
        segment_starts=tuple(
            np.where(effects.segment_motion, start, 0.0)
            for start in waveform_settings.middle_look_starts(looks)
        )
    )
    line_width = (
        parameters[LASER_PREFIX + "line_width"]
        if str(parameters[LASER_PREFIX + "line_shape"]) == "lorentzian"
        else 0.0
    )
    remaining_sum, relative_width = window_tail_sums_and_widths(taper)
    deviations = []
    for segment, segment_snr in zip(waveform_settings.segments(target, motion), snr, strict=True):
        beat_frequency = waveform.beat_frequency(
            segment.chirp_rate_ratio,
            carrier=segment.carrier,
            chirp_rate=waveform_settings.chirp_rate,
            range=target.range - segment.range_decrease_since_shot_start,
            radial_velocity=target.radial_velocity,
        )
        # The beat frequency drifts at a rate of 2 s S beta: up to the middle of the record it
        # shifts by the rate times half the record's duration.
        walk_frequency = segment.chirp_rate * target.doppler_ratio * record.duration
        beat_frequency = np.where(
            effects.range_walk, beat_frequency + walk_frequency, beat_frequency
        )
        beat_bin = (
            waveform.fold_frequency(beat_frequency, sample_rate) / sample_rate * record.fft_size
        )
        remaining_samples = taper.length - np.where(
            effects.overlap, record.count_samples_before_echo(segment, target.range), 0
        )  # samples of the record that contain the echo
        # Offsets are in bins of fs/L, because a zero-padded FFT has finer bins than the window.
        bin_offset = (
            (beat_bin - np.rint(beat_bin))
            * relative_width[remaining_samples]
            * taper.length
            / record.fft_size
        )
        # A late echo fills only a part of the window: its line is lower, while the noise is that
        # of the whole window.
        amplitude_loss = (
            main_lobe_spline(taper.name, taper.length)(np.abs(bin_offset))
            * remaining_sum[remaining_samples]
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            cnr = estimators.carrier_to_noise_ratio(
                snr=segment_snr / amplitude_loss**2, window=taper
            )
            deviation = estimators.beat_frequency_cramer_rao_bound(
                cnr=cnr, n_samples=remaining_samples, sample_rate=sample_rate
            )
        phase_noise_beat_deviation = estimators.phase_noise_beat_deviation(
            line_width=line_width,
            delay=waveform.round_trip_delay(target.range),
            duration=np.maximum(remaining_samples, 1) / sample_rate,
        )
        # The stored SNR is that of the coherent sum of looks, or otherwise that of a single look.
        deviation = deviation / np.sqrt(looks.number / looks.n_coherent)
        deviation = np.hypot(deviation, phase_noise_beat_deviation / np.sqrt(looks.number))
        deviations.append(np.where(np.isnan(deviation), np.inf, deviation))
    up, doppler, down = deviations
    resolve = partial(
        estimators.range_velocity_deviation,
        carriers=waveform_settings.carriers,
        chirp_rate=waveform_settings.chirp_rate,
        range=target.range,
        radial_velocity=target.radial_velocity,
        slopes=waveform_settings.chirp_rate_ratios,
    )
    bound = resolve(up=up, doppler=doppler, down=down)
    # A place within a bin is uniform: its standard deviation is a bin over the root of 12.
    whole_bin_deviation = sample_rate / record.fft_size / np.sqrt(12.0)
    # Without equal and opposite chirps the Doppler peak takes part in a fit.
    _, doppler_ratio, down_ratio = waveform_settings.chirp_rate_ratios
    is_fitted = (np.not_equal(doppler_ratio, 0.0) | np.not_equal(down_ratio, -1.0)) & np.isfinite(
        doppler
    )
    doppler_deviation = np.where(is_fitted, whole_bin_deviation, np.inf)
    has_no_echo = np.isnan(snr[0]) | np.isnan(snr[2])
    return _PointDeviations(
        estimators.RangeVelocityDeviation(*(np.where(has_no_echo, np.nan, b) for b in bound)),
        resolve(up=whole_bin_deviation, doppler=doppler_deviation, down=whole_bin_deviation),
    )


@lru_cache(maxsize=8)
def window_tail_sums_and_widths(taper: Window) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum and the width of the last n samples of a window, for every n from 0.

    Parameters
    ----------
    taper
        Window of L samples.

    Returns
    -------
    tuple of numpy.ndarray
        Sums and widths for n = 0 to L, (L + 1,) each, relative to those of all L samples. The width
        is the standard deviation of the samples' times, weighted by the window. The main lobe's
        width in the spectrum is inversely proportional to it.
    """
    samples, times = taper.samples()[::-1], np.arange(taper.length) / taper.length
    cumulative_sum, first_moment, second_moment = (
        np.append(0.0, np.cumsum(samples * times**k)) for k in range(3)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        width = np.sqrt(
            np.maximum(second_moment / cumulative_sum - (first_moment / cumulative_sum) ** 2, 0.0)
        )
    width = np.where(np.isfinite(width), width, 0.0)
    return cumulative_sum / cumulative_sum[-1], np.minimum(width / width[-1], 1.0)


@lru_cache(maxsize=32)
def main_lobe_spline(window_name: str, length: int) -> CubicSpline:
    """Return a spline of the main lobe of a window's spectrum, accurate to 1e-8.

    The spline gives the magnitude of the window's Fourier transform, relative to its peak. The
    argument is the distance from the peak, 0 to 1/2, in bins of sample rate over window length.
    """
    taper, bin_offsets = get_window(window_name, length), np.linspace(0.0, 0.5, 33)
    return CubicSpline(bin_offsets, np.abs(direct_transform(taper, bin_offsets)) / taper.sum)
