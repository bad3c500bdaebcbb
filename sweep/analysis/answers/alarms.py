"""How often a lidar is wrong: false alarms a second, and a kilometre of flight."""

from __future__ import annotations

import xarray as xr

from sweep.analysis import noise_only
from sweep.analysis.answers.physical import parameter, quantity, spec_of

SEGMENTS_OF_A_SHOT = 3
"""Up-chirp, Doppler segment and down-chirp follow each other without a pause."""


def false_alarms_per_second(
    dataset: xr.Dataset, rate: str | float | None = None, *, leakage: bool = False
) -> xr.DataArray:
    """Mean number of shots a second whose up- and down-chirp both raise a false alarm.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.
    rate
        Shots a second, ``"20 Hz"`` or a number; by default as many as chirps leave time for,
        1 / (3 T), 3 being the segments.
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
        duration = parameter(dataset, "instrument.chirp.duration", spec_of(dataset))
        shots = 1 / (SEGMENTS_OF_A_SHOT * duration)
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
    """The same for a kilometre of flight.

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
    """Probability of a false alarm in both chirp segments; where spectra are drawn their number.

    Parameters
    ----------
    dataset, leakage
        As of :func:`false_alarms_per_second`.
    """
    if "pfa_both_chirps" not in dataset:
        # whole spectra were drawn: counted false alarms of all segments, leaked signal's as well
        return dataset["false_alarms"]
    noise = dataset["pfa_both_chirps"]
    if not leakage:
        return noise
    segments = (dataset["p_leakage_up"], dataset["p_leakage_down"])
    return noise_only.shot_with_leakage(dataset["pfa_segment"], noise, *segments)
