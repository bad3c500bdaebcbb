"""Probabilities of detection with their intervals, false alarms by time and way, summaries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import dask
import dask.array
import numpy as np
import xarray as xr

from sweep.analysis.answers.physical import (
    parameter,
    quantity,
    require_variables,
    si,
    spec_of,
)
from sweep.model import waveform
from sweep.model.effects.catalogue import EFFECTS, names_of
from sweep.model.looks import COMBINE, NUMBER, VOTES, Looks
from sweep.model.philox import point_keys
from sweep.model.sampling import simulate
from sweep.model.shot import evaluate
from sweep.model.threshold import TNR, WAYS, tnr_of
from sweep.spec import Spec

SEGMENTS = ("up", "doppler", "down", "shot")


def named(quantity: str, segment: str) -> str:
    """Name of a variable of a segment, or of a shot."""
    if segment not in SEGMENTS:
        raise ValueError(f"there is no segment '{segment}': take one of {', '.join(SEGMENTS)}")
    return f"{quantity}_{segment}"


def half_width(dataset: xr.Dataset, segment: str) -> xr.DataArray | None:
    """Half-widths of the intervals of pd; None where nothing is drawn."""
    return dataset.get(f"{named('pd', segment)}_half_width")


def detection_probability(dataset: xr.Dataset, segment: str = "shot") -> xr.Dataset:
    """Probability of detection, and the interval that holds the true one.

    Parameters
    ----------
    segment
        ``shot`` (up- and down-chirp both), ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        `pd`, `low` and `high`, 0..1, lazy as the store's arrays are. The interval is pd plus and
        minus the half-width that is stored, within 0..1; its attribute `confidence` says how sure
        it is. Without draws pd is a closed form, and the interval has no width. The change that
        skipped effects may make is apart, in `effects_error`.
    """
    require_variables(dataset, named("pd", segment))
    pd = dataset[named("pd", segment)]
    reach = half_width(dataset, segment)
    low, high = (pd, pd) if reach is None else ((pd - reach).clip(0, 1), (pd + reach).clip(0, 1))
    result = xr.Dataset({"pd": pd, "low": low, "high": high}).assign_attrs(dataset.attrs)
    of_pd = pd.attrs.get("long_name", pd.name)
    for name, words in (("low", "lower"), ("high", "upper")):
        result[name].attrs = {
            "units": "1", "long_name": f"{words} end of the interval of {of_pd}",
            **confidence(dataset, reach),
        }  # fmt: skip
    return result


def confidence(dataset: xr.Dataset, reach: xr.DataArray | None) -> dict[str, float]:
    """Confidence of an interval, if it is one number; 1 if nothing is drawn."""
    if reach is None:
        return {"confidence": 1.0}
    stored = reach.attrs.get("confidence")
    if stored is None and "confidence" not in dataset.coords:
        stored = spec_of(dataset).accuracy.confidence
    return {} if stored is None else {"confidence": float(stored)}


def false_alarms_per_second(
    dataset: xr.Dataset, rate: str | float | None = None, *, leakage: bool = False
) -> xr.DataArray:
    """Mean number of shots a second whose up- and down-chirp both raise a false alarm.

    Parameters
    ----------
    rate
        Shots a second, ``"20 Hz"`` or a number; by default as many as chirps leave time for,
        one after so many segments and as many gaps as it has in all its looks.
    leakage
        Whether extra groups that leaked signal raises count as well as noise. A study that draws
        whole spectra counts every false alarm of a shot, of either cause, whatever is asked.

    Returns
    -------
    xarray.DataArray
        [1/s], lazy.

    Raises
    ------
    ValueError
        The rate cannot be read, or is not positive.
    """
    shots: xr.DataArray | float
    if rate is None:
        architecture, order, duration, gap, looks = (
            parameter(dataset, f"instrument.{path}", spec_of(dataset))
            for path in (
                "receiver.architecture", "chirp.segments", "chirp.duration", "chirp.gap",
                "looks.number",
            )
        )  # fmt: skip
        segments = xr.apply_ufunc(
            lambda a, names: len(waveform.order_of(str(a), str(names))), architecture, order,
            vectorize=True, dask="parallelized", output_dtypes=[int],
        )  # fmt: skip
        shots = 1 / (looks * (segments * (duration + gap)))
    else:
        shots = quantity(rate, si_unit="Hz", name="the rate of shots")
        if not shots > 0:
            raise ValueError("the rate of shots is a positive number")
    alarms = (shots * of_a_shot(dataset, leakage)).rename("false_alarms_per_second")
    text = "noise and leaked signal" if leakage else "noise alone"
    return alarms.assign_attrs(
        units="s-1", long_name="false alarms a second", comment=f"shots with false alarms by {text}"
    )


def false_alarms_per_kilometre(
    dataset: xr.Dataset,
    speed: str | float,
    rate: str | float | None = None,
    *,
    leakage: bool = False,
) -> xr.DataArray:
    """Return the rate per kilometre of flight.

    Parameters
    ----------
    dataset, rate, leakage
        As of :func:`false_alarms_per_second`.
    speed
        Along the path, ``"50 m/s"`` or a number of m/s.

    Returns
    -------
    xarray.DataArray
        [1/km], lazy.

    Raises
    ------
    ValueError
        Speed or rate cannot be read, or are not positive.
    """
    metres_a_second = quantity(speed, si_unit="m/s", name="the speed")
    if not metres_a_second > 0:
        raise ValueError("the speed is a positive number")
    per_second = false_alarms_per_second(dataset, rate, leakage=leakage)
    per_kilometre = (per_second * (1000 / metres_a_second)).rename("false_alarms_per_kilometre")
    return per_kilometre.assign_attrs(
        per_second.attrs, units="km-1", long_name="false alarms a kilometre"
    )


def of_a_shot(dataset: xr.Dataset, leakage: bool) -> xr.DataArray:
    """Probability of a false alarm in both chirp segments; where spectra are drawn their number."""
    if "pfa_both_chirps" not in dataset:
        # whole spectra were drawn: counted false alarms of all segments, leaked signal's as well
        drawn = spec_of(dataset).draws.whole_spectra
        require_variables(dataset, "false_alarms" if drawn else "pfa_both_chirps")
        return dataset["false_alarms"]
    noise = dataset["pfa_both_chirps"]
    if not leakage:
        return noise
    require_variables(dataset, "pfa_segment", "p_leakage_up", "p_leakage_down")
    segments = (dataset["p_leakage_up"], dataset["p_leakage_down"])
    return shot_with_leakage(dataset["pfa_segment"], noise, *segments)


def shot_with_leakage(
    pfa_segment: xr.DataArray,
    pfa_both_chirps: xr.DataArray,
    p_leakage_up: xr.DataArray,
    p_leakage_down: xr.DataArray,
) -> xr.DataArray:
    """Probability that noise or leakage raises an extra group in both chirp segments, 0..1.

    Of noise alone in the up-chirp, and in both, a product, as the segments' numbers of bins
    differ; of leakage in each.
    """
    down = pfa_both_chirps / (pfa_segment + (pfa_segment == 0))  # both are 0 where one is
    up = pfa_segment + p_leakage_up * (1 - pfa_segment)
    return up * (down + p_leakage_down * (1 - down))


STATISTICS = ("mean", "least", "largest", "number")


def summary(dataset: xr.Dataset) -> xr.Dataset:
    """Mean, extremes and number of the computed points of every output.

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
    """Return the statistics of an array, (4,)."""
    blocks = dask.array.asarray(array.chunk().data).to_delayed().ravel()
    parts = [dask.delayed(_of_block)(block) for block in blocks]
    return dask.array.from_delayed(dask.delayed(_of_all)(parts), (4,), float)


def _of_block(block: np.ndarray) -> np.ndarray:
    """Sum, extremes and number of the finite values of a block, (4,)."""
    known = block[np.isfinite(block)]
    least, largest = (known.min(), known.max()) if known.size else (np.inf, -np.inf)
    return np.array([known.sum(), least, largest, known.size])


def _of_all(parts: list[np.ndarray]) -> np.ndarray:
    """Return the statistics of all blocks together."""
    total, least, largest, number = np.array(parts).T
    if not number.sum():
        return np.array([np.nan, np.nan, np.nan, 0.0])
    return np.array([total.sum() / number.sum(), least.min(), largest.max(), number.sum()])


# Receiver operating characteristics. The magnitude of a segment's strongest bin does not depend on
# the threshold. Where nothing is random but the noise, a store therefore holds all thresholds: with
# the SNR of that bin and b the threshold over the noise per quadrature,
#
#     pd = Q_1(sqrt(2 SNR), b),    pfa of a bin = exp(-b^2 / 2).
#
# A point tells whether this is so: no random effect was simulated there, and the closed form gives
# back the stored pd at the study's own threshold. (It does not where bins that hold lines have more
# noise than others, nor where any bin of an echo detects.) All other points are simulated anew at
# every threshold, with the same draws at each. Either way the effects are those that were simulated
# in the study, for its own threshold: far from it, what was left out may change pd by more than the
# study's tolerance.

MOST_POINTS = 20_000
MOST_SIMULATED = 200
"""Points whose curves are made at once, and of these such as have to be simulated anew."""

SAME = 1e-9
"""Difference of pd up to which the closed form gives back what is stored."""

CURVE_TNR = "curve_tnr"
"""Not `tnr`, which is the study's own where that is on an axis."""

DOMAIN = "sweep.analysis.roc"
_RANDOM = sum(1 << k for k, effect in enumerate(EFFECTS) if effect.is_random)
"""Flags of the effects that are random."""

_SEGMENTS = {"up": ("up",), "doppler": ("doppler",), "down": ("down",), "shot": ("up", "down")}


def roc(
    dataset: xr.Dataset,
    pfa: Sequence[float] | np.ndarray | None = None,
    *,
    segment: str = "shot",
    draws: int = 1000,
) -> xr.Dataset:
    """Probability of detection over the probability of a false alarm in a bin of noise.

    Parameters
    ----------
    pfa
        Probabilities of a false alarm in one bin, 0 < pfa < 1; by default 1e-16 to 0.1.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.
    draws
        Draws of each point that has to be simulated anew and has random effects.

    Returns
    -------
    xarray.Dataset
        `pd`, with a further dimension `pfa_bin`; `curve_tnr`, the threshold to noise ratio that
        makes each pfa_bin at each point; `simulated`, whether the point was simulated anew. With
        draws, `half_width` with the study's confidence; 0 where pd is exact.

    Raises
    ------
    ValueError
        Too many points, a probability that is none, a study of whole spectra, or one whose looks
        vary.
    """
    if spec_of(dataset).draws.whole_spectra:
        raise ValueError(
            "a study that draws whole spectra has no closed form: put the detector's threshold or "
            "design pfa on an axis, and read pd over pfa_bin"
        )
    chances = np.logspace(-16, -1, 61) if pfa is None else np.atleast_1d(np.asarray(pfa, float))
    if not ((chances > 0) & (chances < 1)).all():
        raise ValueError("probabilities of a false alarm lie between 0 and 1")
    needed = [f"{kind}_{s}" for s in _SEGMENTS[segment] for kind in ("snr", "pd")]
    needed += [named("pd", segment), "log10_pfa_bin", "effects"]
    require_variables(dataset, *needed)
    number = dataset[named("pd", segment)].size
    if number > MOST_POINTS:
        raise ValueError(
            f"{number:,} points make too many curves (at most {MOST_POINTS:,}): select some"
        )
    looks = _looks_of(spec_of(dataset))
    rule, peaks = (
        parameter(dataset, path, spec_of(dataset))
        for path in (waveform.SHOT_DETECTION, waveform.PEAKS)
    )
    dataset = dataset[list(dict.fromkeys(needed))].compute()
    level = xr.DataArray(looks.level(np.log(chances)), dims=["pfa_bin"])
    pd, exact = _closed(dataset, segment, level, looks)
    if segment == "shot":  # else of two segments out of three
        exact = exact & (rule == waveform.BOTH_CHIRPS)
    exact = exact & (peaks == waveform.ALL)
    tnr = level * _own_tnr(dataset) / _own_level(dataset, looks)
    result = xr.Dataset(
        {"pd": pd, CURVE_TNR: tnr, "simulated": ~exact, "half_width": xr.zeros_like(pd)},
        {"pfa_bin": ("pfa_bin", chances)},
    )
    result = result.transpose("pfa_bin", *dataset[named("pd", segment)].dims)
    if not exact.all():
        _simulate(dataset, result, segment, draws)
    return _described(result, dataset, segment)


def _looks_of(spec: Spec) -> Looks:
    """Return the looks of all points."""
    on_axes = (member.path for axis in spec.axes for member in axis.members)
    if varying := sorted({NUMBER, COMBINE, VOTES} & set(on_axes)):
        raise ValueError(
            f"{', '.join(varying)} varies, and with it the threshold that a chance of false alarms "
            "makes: put the design pfa on an axis, and read pd over it"
        )
    return Looks.of(spec.parameters())


def _closed(
    dataset: xr.Dataset, segment: str, level: xr.DataArray, looks: Looks
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the closed form of pd at each level, and where it holds."""
    own = _own_level(dataset, looks)
    pd = xr.ones_like(level)
    exact = (dataset["effects"] & _RANDOM) == 0
    for name in _SEGMENTS[segment]:
        stored = dataset[f"pd_{name}"]
        amplitude = (2 * dataset[f"snr_{name}"]) ** 0.5
        pd = pd * xr.apply_ufunc(_crossing, amplitude, level, kwargs={"looks": looks})
        again = xr.apply_ufunc(_crossing, amplitude, own, kwargs={"looks": looks})
        exact = exact & ((abs(again - stored) <= SAME) | stored.isnull())
    return pd, exact


def _own_level(dataset: xr.Dataset, looks: Looks) -> xr.DataArray:
    """Return the study's own threshold over the noise per quadrature."""
    if looks.several:
        return xr.apply_ufunc(looks.level, np.log(10) * dataset["log10_pfa_bin"])
    return (-2 * np.log(10) * dataset["log10_pfa_bin"]) ** 0.5


def _own_tnr(dataset: xr.Dataset) -> xr.DataArray:
    """Return the study's own threshold-to-noise ratio at each point."""
    spec, like = spec_of(dataset), dataset["log10_pfa_bin"]
    if TNR in spec.parameters():
        return parameter(dataset, TNR, spec)
    places = [dict(zip(like.dims, at, strict=True)) for at in np.ndindex(like.shape)]
    found = [tnr_of(_parameters_of(like.isel(at).coords, spec)) for at in places]
    return like.copy(data=np.reshape(np.array(found, float), like.shape))


def _parameters_of(coords: Mapping[Any, xr.DataArray], spec: Spec) -> dict[str, Any]:
    """SI values of all parameters at a point, which has these coordinates."""
    values = {str(c.attrs["path"]): c for c in coords.values() if "path" in c.attrs}
    return spec.parameters() | {path: si(value).values.item() for path, value in values.items()}


def _crossing(amplitude: np.ndarray, level: np.ndarray, looks: Looks) -> np.ndarray:
    """Q_1, or its like in several looks; nan where the amplitude or the level is."""
    known = np.isfinite(amplitude) & np.isfinite(level)
    found = looks.steady(np.where(known, amplitude, 0), np.where(known, level, 0))[0]
    return np.where(known, found, np.nan)


def _simulate(dataset: xr.Dataset, result: xr.Dataset, segment: str, draws: int) -> None:
    """Put simulated curves in the place of those that the closed form does not give."""
    spec = spec_of(dataset)
    places = np.argwhere(np.asarray(result["simulated"].values))
    if len(places) > MOST_SIMULATED:
        raise ValueError(
            f"{len(places):,} points have to be simulated anew (at most {MOST_SIMULATED}): select "
            "fewer"
        )
    dims = dataset[named("pd", segment)].dims
    pd, width = result["pd"].values.copy(), result["half_width"].values.copy()
    for place in places:
        at = dict(zip(dims, map(int, place), strict=True))
        point = dataset.isel(at)
        tnr = result[CURVE_TNR].isel(at).values
        index = (slice(None), *place)
        pd[index], width[index] = _curve(spec, point, tnr, segment, draws)
    result["pd"] = result["pd"].copy(data=pd)
    result["half_width"] = result["half_width"].copy(data=width)


def _curve(
    spec: Spec, point: xr.Dataset, tnr: np.ndarray, segment: str, draws: int
) -> tuple[np.ndarray, np.ndarray]:
    """Chance of detection, and its half-width, at some threshold to noise ratios of a point."""
    parameters = _parameters_of(point.coords, spec)
    known = np.isfinite(tnr)
    if not known.all():
        return np.full(tnr.size, np.nan), np.full(tnr.size, np.nan)
    flags = int(point["effects"])
    effects = names_of(flags)
    name = named("pd", segment)
    arrays = {p: np.full(tnr.size, value) for p, value in parameters.items() if p not in WAYS}
    arrays[TNR] = tnr
    if flags & _RANDOM:
        # One key for all thresholds: the same draws, so that curves fall without noise.
        others = {p: v for p, v in sorted(parameters.items()) if p not in WAYS}
        row = [[v for v in others.values() if not isinstance(v, str)]]
        keys = np.repeat(
            point_keys(np.array(row, float), domain=DOMAIN, seed=spec.seed), tnr.size, 0
        )
        found = simulate(arrays, effects, keys=keys, batch_sizes=[draws], method="probabilities")
        return found[name], found[f"{name}_half_width"]
    return evaluate(arrays, effects)[name], np.zeros(tnr.size)


def _described(result: xr.Dataset, dataset: xr.Dataset, segment: str) -> xr.Dataset:
    """Units and words."""
    words = {
        "pd": f"probability of detection, {segment}",
        CURVE_TNR: "threshold to noise ratio",
        "simulated": "whether the point was simulated anew at every threshold",
        "half_width": f"half-width of the interval of the probability of detection, {segment}",
        "pfa_bin": "probability of false alarm in one bin, from noise alone",
    }
    for name, long_name in words.items():
        result[name].attrs = {"units": "1", "long_name": long_name}
    return result.assign_attrs(dataset.attrs)
