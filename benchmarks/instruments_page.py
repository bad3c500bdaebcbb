"""Write docs/instruments.md: published and simulated numbers of each instrument of the library.

Run with `make instruments`, a minute. Each number in an instrument's file is computed by the
function of its name; `tests/test_instruments.py` checks the same numbers against their limits.
"""

import math
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_helpers import markdown_table, replace_page_part

import sweep
from sweep.model import beam, evaluation
from sweep.spec import GridSpec
from sweep.spec.axes import remove_fields_on_axes
from sweep.spec.yaml_document import library_instrument_files, read_document

SPEED_OF_LIGHT = 299792458.0
DRAWS_PER_PLACE = 400
"""Shots drawn at each place between bins, for a standard deviation."""
N_PLACES = 64

InstrumentFields = Mapping[str, Any]


def instrument_file(name: str) -> dict[str, Any]:
    """Return the content of the file of an instrument of the library."""
    return read_document(library_instrument_files()[name]).content


def spec_before_target(instrument: Any, target: InstrumentFields, **sections: Any) -> GridSpec:
    """Return the spec of an instrument that looks at a target along its normal."""
    mapping = {"title": "Published numbers", "instrument": instrument,
               "target": {"grazing_angle": "90 deg"} | dict(target)}  # fmt: skip
    return GridSpec.from_mapping(remove_fields_on_axes(mapping | sections))


def run_study(spec: GridSpec) -> Any:
    """Run a study and return its dataset."""
    with tempfile.TemporaryDirectory() as folder:
        store_path = Path(folder) / "numbers.zarr"
        if not sweep.run(spec, store=store_path, scheduler="none", progress=False).complete:
            raise RuntimeError(f"{spec.title}: not complete")
        return sweep.open(store_path).load()


def random_place_axis(
    n_points: int, centre_range: float, bin_width: float, speed_max: float
) -> InstrumentFields:
    """Return an axis of random ranges within a bin [m] and radial velocities [m/s].

    The random numbers are the same in every run.
    """
    rng = np.random.default_rng(1)
    ranges = centre_range + bin_width * rng.uniform(-0.5, 0.5, n_points)
    velocities = rng.uniform(-speed_max, speed_max, n_points)
    return {"place": {"zip": {
        "target.range": [f"{value!r} m" for value in ranges.tolist()],
        "target.radial_velocity": [f"{value!r} m/s" for value in velocities.tolist()],
    }}}  # fmt: skip


# Settembrini 2026

WALL_TARGET = {"range": "7.2 m", "reflectance": 0.05}


def half_power_range(name: str) -> float:
    """Return the range at which half as much light mixes as at the lens [m]."""
    parameters = evaluation.PARAMETER_DEFAULTS | spec_before_target(name, WALL_TARGET).parameters()
    ranges = np.concatenate([[1e-3], np.linspace(1.0, 40.0, 39001)])
    mixed_power = beam.effective_collecting_area(parameters | {"target.range": ranges}) / ranges**2
    return float(ranges[mixed_power > mixed_power[0] / 2].max())


def noise_penalty(name: str) -> float:
    """Return the SNR over the SNR without the amplifier's noise [dB]."""
    without_amplifier_noise = {"like": name, "receiver": {"amplifier_noise_current": "0 A"}}
    snrs = [
        float(run_study(spec_before_target(instrument, WALL_TARGET)).snr_up)
        for instrument in (name, without_amplifier_noise)
    ]
    return 10 * math.log10(snrs[0] / snrs[1])


def pd_of_snr(name: str) -> float:
    """Return the largest difference of pd from the Rayleigh law for a threshold of 4 means."""
    axes = {"instrument.laser.power": {"log": ["10 uW", "1 W"], "number": 50},
            "target.range": {"linear": ["7.1875 m", "7.2125 m"], "number": 26}}  # fmt: skip
    results = run_study(spec_before_target(name, WALL_TARGET, axes=axes))
    rayleigh_pd = np.exp(-4 * np.pi / (1 + results.snr_up))
    decibels = 10 * np.log10(results.snr_up)
    if decibels.min() > -5 or decibels.max() < 30:
        raise ValueError("the SNR does not reach from -5 to 30 dB")
    return float(abs(results.pd_up - rayleigh_pd).max())


def drawn_standard_deviations(name: str, draws: int = DRAWS_PER_PLACE) -> dict[str, float]:
    """Return standard deviations of range [mm] and radial velocity [mm/s] of detected shots.

    Peaks lie anywhere between bins and are estimated by a parabola. The result also has the ratio
    of the bounds of range and velocity [s].
    """
    instrument = {"like": name, "processing": {"estimator": {"kind": "parabolic"}}}
    axes = random_place_axis(N_PLACES, 7.2, SPEED_OF_LIGHT / 12e9, 0.5)
    results = run_study(
        spec_before_target(
            instrument, WALL_TARGET, axes=axes, draws={"method": "spectra", "number": draws}, seed=1
        )
    )
    n_detected = results.n_detected_shot

    def pooled_deviation(quantity: str) -> float:
        return 1e3 * math.sqrt(
            float((results[f"{quantity}_rmse"] ** 2 * n_detected).sum() / n_detected.sum())
        )

    ratio = results.range_bound / results.radial_velocity_bound
    return {
        "sigma_range": pooled_deviation("range"),
        "sigma_velocity": pooled_deviation("radial_velocity"),
        "sigma_ratio": float(ratio.mean()),
    }


# Chester 2017


def pfa_bin(name: str, tnr: int) -> float:
    """Return the probability of a false alarm in a bin."""
    instrument = {"like": name, "processing": {"tnr": tnr}}
    return 10 ** float(run_study(spec_before_target(instrument, THESIS_TARGET)).log10_pfa_bin)


THESIS_TARGET = {"range": "3500 m", "reflectance": 0.1, "radial_velocity": "150 m/s"}


def pfa_both_chirps(name: str) -> float:
    """Return the probability of a false alarm in both chirps, all bins counted."""
    instrument = {"like": name, "processing": {"bins_counted": "all"}}
    return 10 ** float(
        run_study(spec_before_target(instrument, THESIS_TARGET)).log10_pfa_both_chirps
    )


def power_over_table_4_1(name: str) -> float:
    """Return the SNR over that of the instrument of Table 4.1 [dB]."""
    snrs = [
        float(run_study(spec_before_target(instrument, THESIS_TARGET)).snr_up)
        for instrument in (name, "chester_2017_table_4_1")
    ]
    return 10 * math.log10(snrs[0] / snrs[1])


# Rogers 2021, a lander, a car


def range_bound(name: str) -> float:
    """Return the bound of the standard deviation of range, for a target of 30 % at 75 m [mm]."""
    target = {"range": "75 m", "reflectance": 0.3}
    results = run_study(spec_before_target(name, target, draws={"method": "spectra", "number": 1}))
    return 1e3 * float(results.range_bound)


def shot_noise_share(name: str) -> float:
    """Return the local oscillator's shot noise over all noise, as a ratio of variances."""
    without_amplifier_noise = {"like": name, "receiver": {"amplifier_noise_current": "0 A"}}
    target = {"range": "75 m", "reflectance": 0.3}
    shot_noise, all_noise = (
        float(run_study(spec_before_target(instrument, target)).noise_variance)
        for instrument in (without_amplifier_noise, name)
    )
    return shot_noise / all_noise


def lander_at_5_km(name: str) -> dict[str, float]:
    """Return pd on ground of 10 %, and rms errors of quantised range [m] and velocity [cm/s]."""
    results = run_study(
        spec_before_target(
            name, {"reflectance": 0.1}, axes=random_place_axis(N_PLACES, 5000.0, 0.3, 100.0)
        )
    )
    return {
        "pd": float(results.pd_shot.mean()),
        "range_error": math.sqrt(float((results.range_error**2).mean())),
        "velocity_error": 1e2 * math.sqrt(float((results.radial_velocity_error**2).mean())),
    }


def car_on_a_road(name: str) -> dict[str, float]:
    """Return pd of a target of 10 % at 200 m, range step [mm] and least range for 60 m/s [m]."""
    target = {"reflectance": 0.1}
    results_at_200_m = run_study(
        spec_before_target(name, target, axes=random_place_axis(N_PLACES, 200.0, 0.1, 30.0))
    )
    fine_axis = {"target.range": {"step": ["150 m", "151 m", "1 mm"]}}
    fine_results = run_study(spec_before_target(name, target, axes=fine_axis))
    measured_ranges = np.unique(np.round(fine_results.range + fine_results.range_error, 6))
    near_axis = {"target.range": {"step": ["28 m", "30 m", "10 mm"]}}
    fast_results = run_study(
        spec_before_target(name, target | {"radial_velocity": "60 m/s"}, axes=near_axis)
    )
    is_misread = (
        abs(fast_results.radial_velocity_error) > 0.5
    )  # at the limit itself both readings agree
    return {
        "pd": float(results_at_200_m.pd_shot.mean()),
        "range_bin": 1e3 * float(np.diff(measured_ranges).mean()),
        "nearest_at_60": float(fast_results.range[is_misread].max()),
    }


def simulate_numbers(name: str, draws: int = DRAWS_PER_PLACE) -> dict[str, float]:
    """Compute all numbers in an instrument's file, by their keys."""
    function_by_key: dict[str, Callable[[str], float]]
    match name:
        case "settembrini_2026":
            function_by_key = {
                function.__name__: function
                for function in (half_power_range, noise_penalty, pd_of_snr)
            }
            return {
                key: function(name) for key, function in function_by_key.items()
            } | drawn_standard_deviations(name, draws)
        case "chester_2017_table_4_1":
            alarms = {f"pfa_bin_tnr_{tnr}": pfa_bin(name, tnr) for tnr in (1, 5, 10, 15)}
            return alarms | {"pfa_both_chirps": pfa_both_chirps(name)}
        case "chester_2017_table_5_1":
            function_by_key = {
                function.__name__: function for function in (pfa_both_chirps, power_over_table_4_1)
            }
        case "rogers_2021":
            function_by_key = {
                function.__name__: function for function in (range_bound, shot_noise_share)
            }
        case "lander_ndl":
            return lander_at_5_km(name)
        case "automotive_fmcw":
            return car_on_a_road(name)
        case _:
            raise KeyError(f"nothing simulates the numbers of {name}")
    return {key: function(name) for key, function in function_by_key.items()}


def is_within_allowed(number: InstrumentFields, simulated: float) -> bool:
    """Return True if a simulated number lies within the limits in the instrument's file."""
    match number:
        case {"within": within}:
            return bool(abs(simulated - number["published"]) <= within)
        case {"factor": factor}:
            return bool(1 / factor <= simulated / number["published"] <= factor)
        case {"at_least": lower_bound}:
            return bool(simulated >= lower_bound)
        case {"at_most": upper_bound}:
            return bool(simulated <= upper_bound)
    raise ValueError("a number has one of within, factor, at_least and at_most")


def allowed_text(number: InstrumentFields) -> str:
    """Return the allowed difference of a number as text."""
    words = {"within": "+- {}", "factor": "factor {}", "at_least": ">= {}", "at_most": "<= {}"}
    ((key, value),) = [(key, number[key]) for key in words if key in number]
    return words[key].format(value)


def instrument_section(name: str, simulated_by_key: InstrumentFields) -> str:
    """Return the section of the page on one instrument."""
    description = instrument_file(name)
    doi = (
        f"[{description['doi']}](https://doi.org/{description['doi']})"
        if description["doi"]
        else "none"
    )
    rows = []
    for key, number in description["numbers"].items():
        simulated_text = f"{simulated_by_key[key]:.3g} {number['unit']}".strip()
        published_text = (
            f"{number['published']} {number['unit'] * is_published_number(number)}".strip()
        )
        verdict = "yes" if is_within_allowed(number, simulated_by_key[key]) else "NO"
        rows.append([number["about"], published_text, simulated_text, allowed_text(number), verdict,
                     number.get("why", "")])  # fmt: skip
    head = ["number", "published", "simulated", "allowed", "agrees", "difference"]
    lists = [
        f"{label}:\n\n"
        + "\n".join(f"- {statement}" for statement in description[key] or ["nothing"])
        for label, key in (("Published", "published"), ("Assumed", "assumed"))
    ]
    heading = f"## {name}\n\n{description['title']}. {description['source']}. DOI: {doi}."
    return "\n\n".join([heading, markdown_table(head, rows), *lists])


def is_published_number(number: InstrumentFields) -> bool:
    """Return True if the published value is a number, to which its unit is added."""
    return isinstance(number["published"], int | float)


if __name__ == "__main__":
    replace_page_part(
        "instruments.md",
        "instruments",
        "\n\n".join(
            instrument_section(name, simulate_numbers(name)) for name in library_instrument_files()
        ),
    )
