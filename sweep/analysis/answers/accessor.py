"""`ds.sweep` and `tree.sweep`: answers from what `sweep.open` and `sweep.open_scene` gave."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import dask.array
import numpy as np
import xarray as xr
from contourpy import contour_generator
from scipy.interpolate import CubicSpline
from scipy.special import ndtri

from sweep.analysis.answers import (
    alarms,
    comparison,
    flight_comparison,
    limits,
    physical,
    probability,
    roc,
)
from sweep.analysis.answers.limits import deviate
from sweep.analysis.answers.physical import coordinate, parameter, spec_of
from sweep.analysis.answers.probability import named
from sweep.model import estimators, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.window import transform, window
from sweep.spec import SceneSpec, Spec

_NAMES = ("up", "doppler", "down")
_INSTRUMENT = "instrument."
_PARAMETERS = {
    "architecture": "receiver.architecture", "wavelength": "laser.wavelength",
    "bandwidth": "chirp.bandwidth", "start_frequency": "chirp.start_frequency",
    "duration": "chirp.duration", "sample_rate": "processing.sample_rate",
    "fft_size": "processing.fft_size", "window": "processing.window",
    "delay": "processing.acquisition_delay", "line_width": "laser.line_width",
    "line_shape": "laser.line_shape",
}  # fmt: skip


def range_error(dataset: xr.Dataset) -> xr.Dataset:
    """Error of the reported range, and the Cramer-Rao bound on any unbiased estimate of it.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.

    Returns
    -------
    xarray.Dataset
        [m], lazy: `reported`, reported less true range without noise, from whole bins;
        `resolution`, the spread that whole bins make on the average, a bin over sqrt(24) as
        two peaks tell of it; `bound`, the least standard deviation, of a lone line of the stored
        SNR in the three segments together (:mod:`sweep.model.estimators`). Where noise is
        taken for signal, below the threshold, no estimate comes near it.
        Of a study that draws whole spectra instead what it stores: `bias`, `rmse` and `bound`.
    """
    return _errors(dataset, "range", "range_error", lambda found: found.range)


def velocity_error(dataset: xr.Dataset) -> xr.Dataset:
    """Error of the reported radial velocity, and the Cramer-Rao bound.

    Parameters and results as of :func:`range_error`, in m/s.
    """
    return _errors(
        dataset, "radial velocity", "radial_velocity_error", lambda found: found.radial_velocity
    )


def _errors(
    dataset: xr.Dataset,
    words: str,
    stored: str,
    which: Callable[[estimators.Deviation], np.ndarray],
) -> xr.Dataset:
    quantity = stored.removesuffix("_error")
    if f"{quantity}_rmse" in dataset:
        kinds = {kind: dataset[f"{quantity}_{kind}"] for kind in ("bias", "rmse", "bound")}
        return xr.Dataset(kinds).assign_attrs(dataset.attrs)
    spec = spec_of(dataset)
    values = {n: parameter(dataset, _INSTRUMENT + p, spec) for n, p in _PARAMETERS.items()}
    values |= {
        name: parameter(dataset, f"target.{name}", spec) for name in ("range", "radial_velocity")
    }
    values["walks"] = _simulates(dataset, "range_walk")
    values["moves"] = _simulates(dataset, "segment_motion")
    snr = [dataset[f"snr_{name}"] for name in _NAMES]

    def bound(*arrays: np.ndarray) -> np.ndarray:
        names = dict(zip(values, arrays[3:], strict=True))
        return which(_bounds(arrays[:3], names))

    bounds = xr.apply_ufunc(
        bound, *snr, *values.values(), dask="parallelized", output_dtypes=[float]
    ).transpose(*snr[0].dims)
    width = values["sample_rate"] / values["fft_size"]
    bins = (
        SPEED_OF_LIGHT / 2 * values["duration"] / values["bandwidth"] * width
        if stored == "range_error"
        else values["wavelength"] / 2 * width
    )
    # Half sum and half difference of two peaks, each off by a bin over sqrt(12).
    result = xr.Dataset({
        "reported": dataset[stored],
        "resolution": bins / np.sqrt(24.0) + xr.zeros_like(bounds),
        "bound": bounds,
    })  # fmt: skip
    units = str(dataset[stored].attrs.get("units", ""))
    for name, text in (
        ("resolution", f"standard deviation that whole bins give to the {words}"),
        ("bound", f"Cramer-Rao bound on the standard deviation of the {words}"),
    ):
        result[name].attrs = {"units": units, "long_name": text}
    return result.assign_attrs(dataset.attrs)


def _simulates(dataset: xr.Dataset, effect: str) -> xr.DataArray:
    """Mask of points at which an effect is simulated, as those that move peaks off their beats."""
    attributes = dataset["effects"].attrs
    masks = dict(zip(attributes["flag_meanings"].split(), attributes["flag_masks"], strict=True))
    return (dataset["effects"] & int(masks[effect])) > 0


def _bounds(snr: tuple[np.ndarray, ...], p: dict[str, np.ndarray]) -> estimators.Deviation:
    """Bounds of points that share no more than their order; words and sizes one by one."""
    shape = np.broadcast_shapes(*(np.shape(a) for a in (*snr, *p.values())))
    flat = {name: np.broadcast_to(a, shape).ravel() for name, a in p.items()}
    seen = [np.broadcast_to(a, shape).ravel() for a in snr]
    kinds = list(zip(flat["architecture"], flat["window"], flat["fft_size"], flat["duration"],
                     flat["delay"], flat["sample_rate"], strict=True))  # fmt: skip
    spread = np.empty((2, len(kinds)))
    for kind in dict.fromkeys(kinds):
        mask = np.fromiter((other == kind for other in kinds), bool, len(kinds))
        part = {name: a[mask] for name, a in flat.items()}
        spread[:, mask] = _alike([s[mask] for s in seen], part)
    return estimators.Deviation(*spread.reshape(2, *shape))


def _alike(snr: list[np.ndarray], p: dict[str, np.ndarray]) -> estimators.Deviation:
    """Bounds of points of one architecture, window and record."""
    size, rate = int(p["fft_size"][0]), float(p["sample_rate"][0])
    length = int(waveform.record_length(
        fft_size=p["fft_size"][:1], duration=p["duration"][:1], acquisition_delay=p["delay"][:1],
        sample_rate=p["sample_rate"][:1],
    )[0])  # fmt: skip
    shape = window(str(p["window"][0]), length)
    carriers = waveform.carrier_frequencies(
        str(p["architecture"][0]), wavelength=p["wavelength"],
        start_frequency=p["start_frequency"], bandwidth=p["bandwidth"],
    )  # fmt: skip
    chirp_rate = p["bandwidth"] / p["duration"]
    deviations = []
    for segment, sign in enumerate(waveform.SIGNS):
        carrier, seen = carriers[segment], snr[segment]
        moved = np.where(p["moves"], segment * p["radial_velocity"] * p["duration"], 0.0)
        beat = waveform.beat_frequency(
            sign, carrier=carrier, chirp_rate=chirp_rate, range=p["range"] - moved,
            radial_velocity=p["radial_velocity"],
        )  # fmt: skip
        # the frequency drifts by 2 s S beta a second: by half of that by the record's middle
        walk = sign * chirp_rate * (2 * p["radial_velocity"] / SPEED_OF_LIGHT) * length / rate
        beat = np.where(p["walks"], beat + walk, beat)
        place = waveform.fold(beat, p["sample_rate"]) / rate * size
        # in bins of fs/L: a padded FFT's bins are finer than the window's
        offset = (place - np.rint(place)) * length / size
        cnr = estimators.carrier_to_noise_ratio(
            snr=seen / main_lobe(shape.name, length)(np.abs(offset)) ** 2, window=shape
        )
        deviation = estimators.beat_deviation(cnr=cnr, samples=length, sample_rate=rate)
        walked = estimators.phase_deviation(
            line_width=np.where(p["line_shape"] == "lorentzian", p["line_width"], 0.0),
            delay=2 * p["range"] / SPEED_OF_LIGHT, duration=length / rate,
        )  # fmt: skip
        deviation = np.hypot(deviation, walked)
        deviations.append(np.where(np.isnan(deviation), np.inf, deviation))
    up, doppler, down = deviations
    found = estimators.resolved_deviation(
        up=up, doppler=doppler, down=down, carriers=carriers, chirp_rate=chirp_rate,
        range=p["range"], radial_velocity=p["radial_velocity"],
    )  # fmt: skip
    dark = np.isnan(snr[0]) | np.isnan(snr[2])
    return estimators.Deviation(*(np.where(dark, np.nan, b) for b in found))


@lru_cache(maxsize=32)
def main_lobe(name: str, length: int) -> CubicSpline:
    """|W(delta)| / W(0) over delta from 0 to half a bin of fs/L, to 1e-8."""
    shape, places = window(name, length), np.linspace(0.0, 0.5, 33)
    return CubicSpline(places, np.abs(transform(shape, places)) / shape.sum)


STATISTICS = ("mean", "least", "largest", "number")


def summarised(dataset: xr.Dataset) -> xr.Dataset:
    """Mean, extremes and number of the computed points of every output.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.

    Returns
    -------
    xarray.Dataset
        Every variable of floats over `statistic`, lazy; nan where no point is finite. The store
        goes through memory chunk by chunk, each chunk once.
    """
    result = xr.Dataset(coords={"statistic": list(STATISTICS)}, attrs=dataset.attrs)
    for name, array in dataset.data_vars.items():
        if array.dtype.kind == "f":
            result[name] = xr.DataArray(_reduced(array), dims=["statistic"], attrs=array.attrs)
    return result


def _reduced(array: xr.DataArray) -> dask.array.Array:
    """The statistics of an array, (4,)."""
    data = array.chunk().data if array.chunks is None else array.data
    axis = data.ndim
    parts = data.map_blocks(
        _of_block, dtype=float, new_axis=axis, chunks=(*((1,) * n for n in data.numblocks), (4,))
    )
    return parts.reshape(-1, 4).rechunk(-1).map_blocks(
        _of_all, dtype=float, drop_axis=0, chunks=((4,),)
    )  # fmt: skip


def _of_block(block: np.ndarray) -> np.ndarray:
    """Sum, extremes and number of the finite values of a block, (1, .., 1, 4)."""
    known = block[np.isfinite(block)]
    least, largest = (known.min(), known.max()) if known.size else (np.inf, -np.inf)
    return np.array([known.sum(), least, largest, known.size]).reshape((1,) * block.ndim + (4,))


def _of_all(parts: np.ndarray) -> np.ndarray:
    """The statistics of all blocks together, from (blocks, 4)."""
    number = parts[:, 3].sum()
    if not number:
        return np.array([np.nan, np.nan, np.nan, 0.0])
    return np.array([parts[:, 0].sum() / number, parts[:, 1].min(), parts[:, 2].max(), number])


def contour(
    dataset: xr.Dataset,
    pd: float = 0.9,
    *,
    x: str = "range",
    y: str = "grazing_angle",
    segment: str = "shot",
) -> xr.Dataset:
    """Lines along which the probability of detection is at a level.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it; of any dimension other than the two one value selected.
    pd
        The level, 0 < pd < 1.
    x, y
        Coordinates, each with a dimension of its own.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        Over `vertex`: the two coordinates in their units, and `line`, the number of the line that
        the vertex is of, in order along it; none where pd is nowhere at the level. Between the
        grid's points, places are interpolated as :mod:`sweep.analysis.answers.limits` does.

    Raises
    ------
    ValueError
        A coordinate that is not there, or further dimensions.
    """
    if not 0 < pd < 1:
        raise ValueError(f"a level of pd lies between 0 and 1, and {pd!r} does not")
    across, up = coordinate(dataset, x), coordinate(dataset, y)
    array = dataset[named("pd", segment)]
    if set(array.dims) != {across.name, up.name}:
        others = ", ".join(str(d) for d in array.dims if d not in (across.name, up.name))
        raise ValueError(
            f"a contour goes over {across.name} and {up.name} as dimensions: "
            + (f"select one value along {others}" if others else "they share one, or lack it")
        )
    z = deviate(array, dataset.get(named("miss", segment))).transpose(up.name, across.name)
    found = contour_generator(
        across.values, up.values, np.ma.masked_invalid(z.values)
    ).lines(float(ndtri(pd)))  # fmt: skip
    lines = [np.asarray(line) for line in found]
    vertices = np.concatenate(lines) if lines else np.empty((0, 2))
    numbers = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    return xr.Dataset(
        {
            str(across.name): ("vertex", vertices[:, 0], across.attrs),
            str(up.name): ("vertex", vertices[:, 1], up.attrs),
            "line": ("vertex", numbers, {"units": "1", "long_name": "number of the line"}),
        },
        attrs=dataset.attrs,
    )


ONE_OF_EACH = "a grid of points and a flight have nothing to match: compare two of a kind"


@xr.register_dataset_accessor("sweep")
class SweepAccessor:
    """Answers from a store. All but `roc` and `contour` are lazy: `.compute()` works them out.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    @property
    def spec(self) -> Spec:
        """The study."""
        return physical.spec_of(self._dataset)

    def sel(self, *, method: str | None = None, **coordinates: Any) -> xr.Dataset:
        """Points by physical value: ``ds.sweep.sel(range="2 km", grazing_angle="20 deg")``.

        Parameters
        ----------
        method
            ``nearest``, or none: the value must be on the grid.
        **coordinates
            A value with its unit, a list of them, or a slice (:func:`.physical.select`).

        Raises
        ------
        ValueError
            No such coordinate, a value that cannot be read, or one that is not on the grid.
        """
        return physical.select(self._dataset, coordinates, method=method)

    def detection_probability(self, segment: str = "shot") -> xr.Dataset:
        """Pd with its interval: :func:`.probability.detection_probability`."""
        return probability.detection_probability(self._dataset, segment)

    def roc(
        self,
        pfa: Sequence[float] | np.ndarray | None = None,
        *,
        segment: str = "shot",
        draws: int = 1000,
    ) -> xr.Dataset:
        """Pd over the probability of a false alarm in a bin: :func:`.roc.roc`."""
        return roc.roc(self._dataset, pfa, segment=segment, draws=draws)

    def limit(
        self, along: str, pd: float = 0.9, *, segment: str = "shot", from_highest: bool = False
    ) -> xr.Dataset:
        """How far along any coordinate pd keeps to a level: :func:`.limits.limit`."""
        return limits.limit(self._dataset, along, pd=pd, segment=segment, from_highest=from_highest)

    def maximum_range(self, pd: float = 0.9, *, segment: str = "shot") -> xr.Dataset:
        """Range up to which pd keeps to a level, unbroken and at all: :func:`.limits.limit`."""
        return self.limit("target.range", pd, segment=segment)

    def minimum_grazing_angle(self, pd: float = 0.9, *, segment: str = "shot") -> xr.Dataset:
        """Least grazing angle down to which pd keeps to a level: :func:`.limits.limit`."""
        return self.limit("target.grazing_angle", pd, segment=segment, from_highest=True)

    def contour(
        self, pd: float = 0.9, *, x: str = "range", y: str = "grazing_angle", segment: str = "shot"
    ) -> xr.Dataset:
        """Lines of constant pd over two coordinates: :func:`contour`."""
        return contour(self._dataset, pd, x=x, y=y, segment=segment)

    def false_alarms_per_second(
        self, rate: str | float | None = None, *, leakage: bool = False
    ) -> xr.DataArray:
        """False alarms a second: :func:`.alarms.false_alarms_per_second`."""
        return alarms.false_alarms_per_second(self._dataset, rate, leakage=leakage)

    def false_alarms_per_kilometre(
        self, speed: str | float, rate: str | float | None = None, *, leakage: bool = False
    ) -> xr.DataArray:
        """False alarms a kilometre of flight: :func:`.alarms.false_alarms_per_kilometre`."""
        return alarms.false_alarms_per_kilometre(self._dataset, speed, rate, leakage=leakage)

    def range_error(self) -> xr.Dataset:
        """Error of range beside its Cramer-Rao bound: :func:`range_error`."""
        return range_error(self._dataset)

    def velocity_error(self) -> xr.Dataset:
        """Error of radial velocity beside its Cramer-Rao bound: :func:`velocity_error`."""
        return velocity_error(self._dataset)

    def compare(self, other: xr.Dataset) -> xr.Dataset:
        """Differences from another study: :func:`.comparison.compare`.

        Raises
        ------
        ValueError
            No point is in both; or the other is a flight.
        """
        if not isinstance(other, xr.Dataset):
            raise ValueError(ONE_OF_EACH)
        return comparison.compare(self._dataset, other)

    def summary(self) -> xr.Dataset:
        """Mean, extremes and number of every output: :func:`summarised`."""
        return summarised(self._dataset)


@xr.register_datatree_accessor("sweep")
class FlightAccessor:
    """Answers from a flight's store, lazy but for the matching of shots.

    Parameters
    ----------
    tree
        As `sweep.open_scene` gives it.
    """

    def __init__(self, tree: xr.DataTree) -> None:
        self._tree = tree

    @property
    def spec(self) -> Spec | SceneSpec:
        """The study."""
        return physical.study_of(self._tree)

    def compare(self, other: xr.DataTree) -> xr.DataTree:
        """Differences from another flight, shot by shot: :func:`.flight_comparison.compare`.

        Raises
        ------
        ValueError
            No shot is in both; or the other is a grid.
        """
        if not isinstance(other, xr.DataTree):
            raise ValueError(ONE_OF_EACH)
        return flight_comparison.compare(self._tree, other)
