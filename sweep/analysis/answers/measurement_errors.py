"""Errors of range and radial velocity, and the Cramer-Rao bounds on unbiased estimates."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pandas
import xarray as xr
from scipy.interpolate import CubicSpline

from sweep.analysis.answers.dataset_lookup import (
    grid_spec_of_dataset,
    parameter_in_si,
    require_variables,
)
from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import estimators
from sweep.model.detection.looks import COMBINE_COHERENT
from sweep.model.effects.catalogue import (
    EFFECT_NAMES,
    EFFECTS,
    PARAMETER_DEFAULTS,
    unpack_effect_flags,
)
from sweep.model.evaluation import prepare_shots
from sweep.model.sampling.speckle_wander import mean_range_velocity_wander_variance
from sweep.model.waveform import SEGMENT_NAMES
from sweep.model.window import Window, direct_transform, get_window
from sweep.spec import GridSpec

_INSTRUMENT_PATH_PREFIX = "instrument."
"""Beginning of the dotted paths of all instrument parameters."""
_PATH_BY_PARAMETER = {
    "architecture": "receiver.architecture", "wavelength": "laser.wavelength",
    "bandwidth": "chirp.bandwidth", "start_frequency": "chirp.start_frequency",
    "duration": "chirp.duration", "segments": "chirp.segments", "gap": "chirp.gap",
    "doppler_slope": "chirp.doppler_slope", "down_slope": "chirp.down_slope",
    "sample_rate": "processing.sample_rate",
    "fft_size": "processing.fft_size", "window": "processing.window",
    "delay": "processing.acquisition_delay", "line_width": "laser.line_width",
    "line_shape": "laser.line_shape", "looks": "looks.number", "combine": "looks.combine",
}  # fmt: skip
"""Dotted paths, without `instrument.`, of the parameters on which Cramer-Rao bounds depend."""

_RANDOM_EFFECT_NAMES = {effect.name for effect in EFFECTS if effect.is_random}
"""Names of the effects that are simulated by random draws."""

_GROUPING_PARAMETERS = (
    "architecture",
    "segments",
    "window",
    "fft_size",
    "duration",
    "delay",
    "sample_rate",
)
"""Parameters that are equal at points whose Cramer-Rao bounds are computed together."""


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
    A peak in a whole bin has a standard deviation of a bin over sqrt(12). The range is half the sum
    of two peaks, which gives a bin over sqrt(24). Below the threshold, noise is mistaken for
    signal, and no estimate comes near the bound.

    References
    ----------
    The bound of each beat is that of Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591 (1974), as
    described in :mod:`sweep.model.detection.estimators`. The contribution of speckle is described
    in :mod:`sweep.model.sampling.speckle_wander`.
    """
    return _error_dataset(dataset, "range")


def velocity_error(dataset: xr.Dataset) -> xr.Dataset:
    """Return the error of the reported radial velocity, and the Cramer-Rao bound.

    Result and notes are those of :func:`range_error`, in m/s. The velocity is half the difference
    of two peaks.
    """
    return _error_dataset(dataset, "radial_velocity")


def _error_dataset(dataset: xr.Dataset, quantity: str) -> xr.Dataset:
    """Return the dataset of :func:`range_error` or :func:`velocity_error`.

    `quantity` is ``range`` or ``radial_velocity``.
    """
    if f"{quantity}_rmse" in dataset:
        statistics = {kind: dataset[f"{quantity}_{kind}"] for kind in ("bias", "rmse", "bound")}
        return xr.Dataset(statistics).assign_attrs(dataset.attrs)
    spec = grid_spec_of_dataset(dataset)
    snr_names = [f"snr_{name}" for name in SEGMENT_NAMES]
    require_variables(dataset, *snr_names, "effects", f"{quantity}_error")
    parameters = {
        n: parameter_in_si(dataset, _INSTRUMENT_PATH_PREFIX + p, spec)
        for n, p in _PATH_BY_PARAMETER.items()
    }
    parameters |= {
        name: parameter_in_si(dataset, f"target.{name}", spec)
        for name in ("range", "radial_velocity")
    }
    effect_by_flag = {"walks": "range_walk", "moves": "segment_motion", "late": "overlap"}
    for name, effect in effect_by_flag.items():
        parameters[name] = (dataset["effects"] & (1 << EFFECT_NAMES.index(effect))) > 0
    snr = [dataset[name] for name in snr_names]

    def point_bounds(
        up: np.ndarray, doppler: np.ndarray, down: np.ndarray, *parameter_values: np.ndarray
    ) -> np.ndarray:
        point_parameters = dict(zip(parameters, parameter_values, strict=True))
        quantity_bound: np.ndarray = getattr(
            _cramer_rao_bounds((up, doppler, down), point_parameters), quantity
        )
        return quantity_bound

    bounds = xr.apply_ufunc(
        point_bounds, *snr, *parameters.values(), dask="parallelized", output_dtypes=[float]
    ).transpose(*snr[0].dims)
    bounds = np.hypot(bounds, _speckle_standard_deviation(dataset, quantity, spec))
    bin_frequency = parameters["sample_rate"] / parameters["fft_size"]
    bin_size = (
        SPEED_OF_LIGHT / 2 * parameters["duration"] / parameters["bandwidth"] * bin_frequency
        if quantity == "range"
        else parameters["wavelength"] / 2 * bin_frequency
    )
    # Range and velocity are half the sum and half the difference of two peak positions. Each
    # position has a standard deviation of a bin over sqrt(12).
    result = xr.Dataset({
        "reported": dataset[f"{quantity}_error"],
        "resolution": bin_size / np.sqrt(24.0) + xr.zeros_like(bounds),
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
    """Return the standard deviation that speckle adds to an estimate [m or m/s]; 0 without fading.

    `quantity` is ``range`` or ``radial_velocity``.
    """
    is_fading = (dataset["effects"] & (1 << EFFECT_NAMES.index("fading"))) > 0
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
                for name in unpack_effect_flags(int(flag_bits))
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


def _cramer_rao_bounds(
    snr: tuple[np.ndarray, ...], parameters: dict[str, np.ndarray]
) -> estimators.RangeVelocityDeviation:
    """Return the Cramer-Rao bounds of range and radial velocity at each point.

    Parameters
    ----------
    snr
        Signal-to-noise ratios of the three segments.
    parameters
        SI values at each point of the parameters in `_PATH_BY_PARAMETER` and of the target. Also
        three flags of simulated effects: ``walks`` (range walk), ``moves`` (motion between
        segments) and ``late`` (echoes after the start of their record).
    """
    shape = np.broadcast_shapes(*(np.shape(a) for a in (*snr, *parameters.values())))
    flat_parameters = {name: np.broadcast_to(a, shape).ravel() for name, a in parameters.items()}
    flat_snr = [np.broadcast_to(a, shape).ravel() for a in snr]
    grouping_frame = pandas.DataFrame(
        {name: flat_parameters[name] for name in _GROUPING_PARAMETERS}
    )
    deviations = np.empty((2, len(grouping_frame)))
    for rows in grouping_frame.groupby(
        list(grouping_frame), sort=False, dropna=False
    ).indices.values():
        group_parameters = {name: a[rows] for name, a in flat_parameters.items()}
        deviations[:, rows] = _cramer_rao_bounds_of_group(
            [s[rows] for s in flat_snr], group_parameters
        )
    return estimators.RangeVelocityDeviation(*deviations.reshape(2, *shape))


def _cramer_rao_bounds_of_group(
    snr: list[np.ndarray], parameters: dict[str, np.ndarray]
) -> estimators.RangeVelocityDeviation:
    """Return the Cramer-Rao bounds of points that share all parameters in `_GROUPING_PARAMETERS`.

    The CNR of each segment follows from the stored SNR, after removal of the scalloping loss and of
    the loss of a late echo. The CNR gives the bound of the beat frequency, to which the laser's
    phase noise is added in quadrature. The bounds of the three beat frequencies combine to those of
    range and radial velocity.
    """
    fft_size, sample_rate = int(parameters["fft_size"][0]), float(parameters["sample_rate"][0])
    record_parameters = {
        "fft_size": fft_size,
        "sample_rate": sample_rate,
        "acquisition_delay": parameters["delay"][0],
    }
    record_parameters = {
        f"instrument.processing.{name}": value for name, value in record_parameters.items()
    }
    record_length = int(
        waveform.n_record_samples(
            record_parameters | {"instrument.chirp.duration": parameters["duration"][0]}
        )
    )
    taper = get_window(str(parameters["window"][0]), record_length)
    slopes = (
        np.ones_like(parameters["down_slope"]),
        parameters["doppler_slope"],
        parameters["down_slope"],
    )
    carriers = waveform.carrier_frequencies(
        str(parameters["architecture"][0]),
        wavelength=parameters["wavelength"],
        start_frequency=parameters["start_frequency"],
        bandwidth=parameters["bandwidth"],
        chirp_rate_ratios=slopes,
    )
    chirp_rate = parameters["bandwidth"] / parameters["duration"]
    deviations = []
    segment_order = waveform.existing_segments(
        str(parameters["architecture"][0]), str(parameters["segments"][0])
    )
    segment_starts = waveform.segment_starts(
        segment_order, duration=parameters["duration"], gap=parameters["gap"]
    )
    middle_look_time = (
        0.5
        * (parameters["looks"] - 1)
        * len(segment_order)
        * (parameters["duration"] + parameters["gap"])
    )
    for segment, slope in enumerate(slopes):
        carrier, segment_snr = carriers[segment], snr[segment]
        distance_moved = np.where(
            parameters["moves"],
            (segment_starts[segment] + middle_look_time) * parameters["radial_velocity"],
            0.0,
        )
        beat_frequency = waveform.beat_frequency(
            slope,
            carrier=carrier,
            chirp_rate=chirp_rate,
            range=parameters["range"] - distance_moved,
            radial_velocity=parameters["radial_velocity"],
        )
        # The beat frequency drifts at a rate of 2 s S beta: up to the middle of the record it
        # shifts by the rate times half the record's duration.
        walk_frequency = (
            slope
            * chirp_rate
            * (2 * parameters["radial_velocity"] / SPEED_OF_LIGHT)
            * record_length
            / sample_rate
        )
        beat_frequency = np.where(
            parameters["walks"], beat_frequency + walk_frequency, beat_frequency
        )
        beat_bin = (
            waveform.fold_frequency(beat_frequency, parameters["sample_rate"])
            / sample_rate
            * fft_size
        )
        # Offsets are in bins of fs/L, because a zero-padded FFT has finer bins than the window.
        missing_samples = waveform.count_samples_before_echo(
            delay=2 / SPEED_OF_LIGHT * (parameters["range"] - distance_moved),
            doppler_ratio=0.0,
            record_start=parameters["delay"],
            sample_rate=parameters["sample_rate"],
            length=record_length,
        )
        remaining_samples = record_length - np.where(
            parameters["late"], missing_samples, 0
        )  # samples of the record that contain the echo
        remaining_sum, relative_width = window_tail_sums_and_widths(taper)
        bin_offset = (
            (beat_bin - np.rint(beat_bin))
            * relative_width[remaining_samples]
            * record_length
            / fft_size
        )
        # A late echo fills only a part of the window: its line is lower, while the noise is that
        # of the whole window.
        amplitude_loss = (
            main_lobe_spline(taper.name, record_length)(np.abs(bin_offset))
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
            line_width=np.where(
                parameters["line_shape"] == "lorentzian", parameters["line_width"], 0.0
            ),
            delay=2 * parameters["range"] / SPEED_OF_LIGHT,
            duration=np.maximum(remaining_samples, 1) / sample_rate,
        )
        # The stored SNR is that of the coherent sum of looks, or otherwise that of a single look.
        deviation = deviation / np.sqrt(
            np.where(parameters["combine"] == COMBINE_COHERENT, 1.0, parameters["looks"])
        )
        deviation = np.hypot(deviation, phase_noise_beat_deviation / np.sqrt(parameters["looks"]))
        deviations.append(np.where(np.isnan(deviation), np.inf, deviation))
    up, doppler, down = deviations
    resolved = estimators.range_velocity_deviation(
        up=up, doppler=doppler, down=down, carriers=carriers, chirp_rate=chirp_rate,
        range=parameters["range"], radial_velocity=parameters["radial_velocity"], slopes=slopes,
    )  # fmt: skip
    has_no_echo = np.isnan(snr[0]) | np.isnan(snr[2])
    return estimators.RangeVelocityDeviation(*(np.where(has_no_echo, np.nan, b) for b in resolved))


@lru_cache(maxsize=8)
def window_tail_sums_and_widths(taper: Window) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum and the width of the last n samples of a window, for every n.

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
    """Return a spline of a window's main lobe, relative to its peak, accurate to 1e-8.

    The main lobe is the magnitude of the window's Fourier transform near its peak. The argument is
    the distance from the peak, 0 to 1/2, in bins of sample rate over window length.
    """
    taper, bin_offsets = get_window(window_name, length), np.linspace(0.0, 0.5, 33)
    return CubicSpline(bin_offsets, np.abs(direct_transform(taper, bin_offsets)) / taper.sum)
