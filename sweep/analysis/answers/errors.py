"""Errors of range and radial velocity, and the Cramer-Rao bounds on any estimate of them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pandas
import xarray as xr
from scipy.interpolate import CubicSpline

from sweep.analysis.answers.physical import parameter, require_variables, spec_of
from sweep.model import estimators, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULTS, EFFECTS, NAMES, names_of
from sweep.model.looks import COHERENT
from sweep.model.shot import prepare
from sweep.model.wander import mean_wander
from sweep.model.window import Window, transform, window
from sweep.spec import Spec

_SEGMENTS = ("up", "doppler", "down")
_INSTRUMENT = "instrument."
_PARAMETERS = {
    "architecture": "receiver.architecture", "wavelength": "laser.wavelength",
    "bandwidth": "chirp.bandwidth", "start_frequency": "chirp.start_frequency",
    "duration": "chirp.duration", "segments": "chirp.segments", "gap": "chirp.gap",
    "doppler_slope": "chirp.doppler_slope", "down_slope": "chirp.down_slope",
    "sample_rate": "processing.sample_rate",
    "fft_size": "processing.fft_size", "window": "processing.window",
    "delay": "processing.acquisition_delay", "line_width": "laser.line_width",
    "line_shape": "laser.line_shape", "looks": "looks.number", "combine": "looks.combine",
}  # fmt: skip
_RANDOM = {effect.name for effect in EFFECTS if effect.is_random}
"""Effects whose draws do not change an echo's footprint."""

_ALIKE = ("architecture", "segments", "window", "fft_size", "duration", "delay", "sample_rate")
"""Parameters that points have in common whose bounds are worked out together."""


def range_error(dataset: xr.Dataset) -> xr.Dataset:
    """Error of the reported range, and the Cramer-Rao bound on any unbiased estimate of it.

    Returns
    -------
    xarray.Dataset
        [m], lazy. `reported` is the reported less the true range without noise, from whole bins.
        `resolution` is the mean spread that whole bins make: a bin over sqrt(24), because two
        peaks share the error. `bound` is the least standard deviation, that of a lone line with
        the stored SNR in the three segments together (:mod:`sweep.model.estimators`), with what
        developed speckle adds to echoes that are detected (:mod:`sweep.model.wander`). Below the
        threshold noise is taken for signal, and no estimate comes near the bound. A study that
        draws whole spectra has instead what it stores: `bias`, `rmse` and `bound`.
    """
    return _errors(dataset, "range")


def velocity_error(dataset: xr.Dataset) -> xr.Dataset:
    """Error of the reported radial velocity, and the Cramer-Rao bound.

    Parameters and results as of :func:`range_error`, in m/s.
    """
    return _errors(dataset, "radial_velocity")


def _errors(dataset: xr.Dataset, quantity: str) -> xr.Dataset:
    if f"{quantity}_rmse" in dataset:
        kinds = {kind: dataset[f"{quantity}_{kind}"] for kind in ("bias", "rmse", "bound")}
        return xr.Dataset(kinds).assign_attrs(dataset.attrs)
    spec = spec_of(dataset)
    snr_names = [f"snr_{name}" for name in _SEGMENTS]
    require_variables(dataset, *snr_names, "effects", f"{quantity}_error")
    values = {n: parameter(dataset, _INSTRUMENT + p, spec) for n, p in _PARAMETERS.items()}
    values |= {
        name: parameter(dataset, f"target.{name}", spec) for name in ("range", "radial_velocity")
    }
    marks = {"walks": "range_walk", "moves": "segment_motion", "late": "overlap"}
    for name, effect in marks.items():
        values[name] = (dataset["effects"] & (1 << NAMES.index(effect))) > 0
    snr = [dataset[name] for name in snr_names]

    def bound(*arrays: np.ndarray) -> np.ndarray:
        names = dict(zip(values, arrays[3:], strict=True))
        found: np.ndarray = getattr(_bounds(arrays[:3], names), quantity)
        return found

    bounds = xr.apply_ufunc(
        bound, *snr, *values.values(), dask="parallelized", output_dtypes=[float]
    ).transpose(*snr[0].dims)
    bounds = np.hypot(bounds, _wander(dataset, quantity, spec))
    width = values["sample_rate"] / values["fft_size"]
    bins = (
        SPEED_OF_LIGHT / 2 * values["duration"] / values["bandwidth"] * width
        if quantity == "range"
        else values["wavelength"] / 2 * width
    )
    # Half sum and half difference of two peaks, each off by a bin over sqrt(12).
    result = xr.Dataset({
        "reported": dataset[f"{quantity}_error"],
        "resolution": bins / np.sqrt(24.0) + xr.zeros_like(bounds),
        "bound": bounds,
    })  # fmt: skip
    units, words = str(result["reported"].attrs.get("units", "")), quantity.replace("_", " ")
    for name, text in (
        ("resolution", f"standard deviation that whole bins give to the {words}"),
        ("bound", f"Cramer-Rao bound on the standard deviation of the {words}"),
    ):
        result[name].attrs = {"units": units, "long_name": text}
    return result.assign_attrs(dataset.attrs)


def _wander(dataset: xr.Dataset, quantity: str, spec: Spec) -> xr.DataArray:
    """Return the deviation that developed speckle adds to an estimate; 0 where nothing fades."""
    fades = (dataset["effects"] & (1 << NAMES.index("fading"))) > 0
    if spec.modes()["fading"] == "off" or spec.parameters()["footprint.speckle"] != "developed":
        return xr.zeros_like(fades, float)
    fixed = DEFAULTS | spec.parameters()
    varying = {
        member.path: parameter(dataset, member.path, spec)
        for axis in spec.axes
        for member in axis.members
    }
    probabilities, ratios = (
        [dataset[f"{kind}_{name}"] for name in _SEGMENTS] for kind in ("pd", "snr")
    )

    def deviation(flags: np.ndarray, *arrays: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(flags.shape, *(array.shape for array in arrays))
        columns = [np.broadcast_to(array, shape).ravel() for array in (flags, *arrays)]
        square = np.zeros(columns[0].size)
        for value in np.unique(columns[0]):
            index = np.flatnonzero(columns[0] == value)
            effects = [name for name in names_of(int(value)) if name not in _RANDOM]
            if "fading" not in effects:
                continue
            own = dict(zip(varying, (column[index] for column in columns[7:]), strict=True))
            pd, snr = (np.array([c[index] for c in columns[k : k + 3]]) for k in (1, 4))
            for part, shots in prepare(fixed | own, effects):
                kind = mean_wander(shots, pd[:, part], snr[:, part])
                square[index[part]] = kind[0 if quantity == "range" else 1]
        return np.sqrt(square).reshape(shape)

    return xr.apply_ufunc(
        deviation, dataset["effects"], *probabilities, *ratios, *varying.values(),
        dask="parallelized", output_dtypes=[float],
    )  # fmt: skip


def _bounds(snr: tuple[np.ndarray, ...], p: dict[str, np.ndarray]) -> estimators.Deviation:
    """Bounds of points that share no more than their order; words and sizes one by one."""
    shape = np.broadcast_shapes(*(np.shape(a) for a in (*snr, *p.values())))
    flat = {name: np.broadcast_to(a, shape).ravel() for name, a in p.items()}
    seen = [np.broadcast_to(a, shape).ravel() for a in snr]
    kinds = pandas.DataFrame({name: flat[name] for name in _ALIKE})
    spread = np.empty((2, len(kinds)))
    for places in kinds.groupby(list(kinds), sort=False, dropna=False).indices.values():
        part = {name: a[places] for name, a in flat.items()}
        spread[:, places] = _alike([s[places] for s in seen], part)
    return estimators.Deviation(*spread.reshape(2, *shape))


def _alike(snr: list[np.ndarray], p: dict[str, np.ndarray]) -> estimators.Deviation:
    """Bounds of points of one architecture, waveform, window and record."""
    size, rate = int(p["fft_size"][0]), float(p["sample_rate"][0])
    record = {"fft_size": size, "sample_rate": rate, "acquisition_delay": p["delay"][0]}
    record = {f"instrument.processing.{name}": value for name, value in record.items()}
    length = int(waveform.record_length(record | {"instrument.chirp.duration": p["duration"][0]}))
    shape = window(str(p["window"][0]), length)
    slopes = np.ones_like(p["down_slope"]), p["doppler_slope"], p["down_slope"]
    carriers = waveform.carrier_frequencies(
        str(p["architecture"][0]), wavelength=p["wavelength"],
        start_frequency=p["start_frequency"], bandwidth=p["bandwidth"], slopes=slopes,
    )  # fmt: skip
    chirp_rate = p["bandwidth"] / p["duration"]
    deviations = []
    order = waveform.order_of(str(p["architecture"][0]), str(p["segments"][0]))
    starts = waveform.segment_starts(order, duration=p["duration"], gap=p["gap"])
    middle_look = 0.5 * (p["looks"] - 1) * len(order) * (p["duration"] + p["gap"])
    for segment, slope in enumerate(slopes):
        carrier, seen = carriers[segment], snr[segment]
        moved = np.where(p["moves"], (starts[segment] + middle_look) * p["radial_velocity"], 0.0)
        beat = waveform.beat_frequency(
            slope, carrier=carrier, chirp_rate=chirp_rate, range=p["range"] - moved,
            radial_velocity=p["radial_velocity"],
        )  # fmt: skip
        # the frequency drifts by 2 s S beta a second: by half of that by the record's middle
        walk = slope * chirp_rate * (2 * p["radial_velocity"] / SPEED_OF_LIGHT) * length / rate
        beat = np.where(p["walks"], beat + walk, beat)
        place = waveform.fold(beat, p["sample_rate"]) / rate * size
        # in bins of fs/L: a padded FFT's bins are finer than the window's
        first = waveform.samples_before_echo(
            delay=2 / SPEED_OF_LIGHT * (p["range"] - moved), beta=0.0, start=p["delay"],
            sample_rate=p["sample_rate"], length=length,
        )  # fmt: skip
        left = length - np.where(p["late"], first, 0)  # samples that the echo has
        weight, narrowness = last_samples(shape)
        offset = (place - np.rint(place)) * narrowness[left] * length / size
        # of less of the window the line stands lower, over the noise of all of it
        lower = main_lobe(shape.name, length)(np.abs(offset)) * weight[left]
        with np.errstate(divide="ignore", invalid="ignore"):
            cnr = estimators.carrier_to_noise_ratio(snr=seen / lower**2, window=shape)
            deviation = estimators.beat_deviation(cnr=cnr, samples=left, sample_rate=rate)
        walked = estimators.phase_deviation(
            line_width=np.where(p["line_shape"] == "lorentzian", p["line_width"], 0.0),
            delay=2 * p["range"] / SPEED_OF_LIGHT, duration=np.maximum(left, 1) / rate,
        )  # fmt: skip
        # The stored SNR is that of a sum of looks, or of each of those that tell by themselves.
        deviation = deviation / np.sqrt(np.where(p["combine"] == COHERENT, 1.0, p["looks"]))
        deviation = np.hypot(deviation, walked / np.sqrt(p["looks"]))
        deviations.append(np.where(np.isnan(deviation), np.inf, deviation))
    up, doppler, down = deviations
    found = estimators.resolved_deviation(
        up=up, doppler=doppler, down=down, carriers=carriers, chirp_rate=chirp_rate,
        range=p["range"], radial_velocity=p["radial_velocity"], slopes=slopes,
    )  # fmt: skip
    dark = np.isnan(snr[0]) | np.isnan(snr[2])
    return estimators.Deviation(*(np.where(dark, np.nan, b) for b in found))


@lru_cache(maxsize=8)
def last_samples(shape: Window) -> tuple[np.ndarray, np.ndarray]:
    """Sum, and width in time, of a window's last samples over those of all, (L + 1,) each.

    By the number of samples. The width is the standard deviation of the places under the window,
    by which its main lobe is narrow.
    """
    w, place = shape.samples()[::-1], np.arange(shape.length) / shape.length
    total, first, second = (np.append(0.0, np.cumsum(w * place**k)) for k in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        width = np.sqrt(np.maximum(second / total - (first / total) ** 2, 0.0))
    width = np.where(np.isfinite(width), width, 0.0)
    return total / total[-1], np.minimum(width / width[-1], 1.0)


@lru_cache(maxsize=32)
def main_lobe(name: str, length: int) -> CubicSpline:
    """|W(delta)| / W(0) over delta from 0 to half a bin of fs/L, to 1e-8."""
    shape, places = window(name, length), np.linspace(0.0, 0.5, 33)
    return CubicSpline(places, np.abs(transform(shape, places)) / shape.sum)
