"""Writes docs/instruments.md: what is published of each instrument of the library, and simulated.

`make instruments`, a minute. Every number that an instrument's file names is computed here, by the
function of its name; `tests/test_instruments.py` holds the same numbers to their limits.
"""

import math
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from shared import put, table

import sweep
from sweep.model import beam, shot
from sweep.spec import Spec
from sweep.spec.axes import without_fields_on_axes
from sweep.spec.reading import library, read_document

LIGHT = 299792458.0
DRAWS = 400
"""Shots of each of the places between bins that a standard deviation is drawn at."""
PLACES = 64

Values = Mapping[str, Any]


def written(name: str) -> dict[str, Any]:
    """Content of the file of an instrument."""
    return read_document(library()[name]).value


def study(instrument: Any, target: Values, **sections: Any) -> Spec:
    """A study of an instrument straight before a target."""
    mapping = {"title": "Published numbers", "instrument": instrument,
               "target": {"grazing_angle": "90 deg"} | dict(target)}  # fmt: skip
    return Spec.from_mapping(without_fields_on_axes(mapping | sections))


def computed(spec: Spec) -> Any:
    """Results of a study."""
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "numbers.zarr"
        if not sweep.run(spec, store=store, scheduler="none", progress=False).complete:
            raise RuntimeError(f"{spec.title}: not complete")
        return sweep.open(store).load()


def points(number: int, middle: float, bin_width: float, fastest: float) -> Values:
    """An axis of ranges within a bin [m] and radial velocities [m/s], drawn anew but the same."""
    rng = np.random.default_rng(1)
    places = middle + bin_width * rng.uniform(-0.5, 0.5, number)
    velocities = rng.uniform(-fastest, fastest, number)
    return {"place": {"zip": {
        "target.range": [f"{x!r} m" for x in places.tolist()],
        "target.radial_velocity": [f"{x!r} m/s" for x in velocities.tolist()],
    }}}  # fmt: skip


# Settembrini 2026

WALL = {"range": "7.2 m", "reflectance": 0.05}


def half_power_range(name: str) -> float:
    """Range [m] at which the light that mixes is half of that at the lens."""
    parameters = shot.DEFAULTS | study(name, WALL).parameters()
    far = np.concatenate([[1e-3], np.linspace(1.0, 40.0, 39001)])
    mixed = beam.collecting_area(parameters | {"target.range": far}) / far**2
    return float(far[mixed > mixed[0] / 2].max())


def noise_penalty(name: str) -> float:
    """SNR over the SNR without the amplifier's noise [dB]."""
    quiet = {"like": name, "receiver": {"amplifier_noise_current": "0 A"}}
    both = [float(computed(study(each, WALL)).snr_up) for each in (name, quiet)]
    return 10 * math.log10(both[0] / both[1])


def pd_of_snr(name: str) -> float:
    """Largest departure of pd from the law of a Rayleigh magnitude and 4 times the mean."""
    axes = {"instrument.laser.power": {"log": ["10 uW", "1 W"], "number": 50},
            "target.range": {"linear": ["7.1875 m", "7.2125 m"], "number": 26}}  # fmt: skip
    found = computed(study(name, WALL, axes=axes))
    law = np.exp(-4 * np.pi / (1 + found.snr_up))
    decibels = 10 * np.log10(found.snr_up)
    if decibels.min() > -5 or decibels.max() < 30:
        raise ValueError("the SNR does not reach from -5 to 30 dB")
    return float(abs(found.pd_up - law).max())


def sigmas(name: str, draws: int = DRAWS) -> dict[str, float]:
    """Standard deviations of range [mm] and radial velocity [mm/s] of shots that are detected.

    Of a parabola through the peak, anywhere between bins; and of the bounds their ratio [s].
    """
    one = {"like": name, "processing": {"estimator": {"kind": "parabolic"}}}
    axes = points(PLACES, 7.2, LIGHT / 12e9, 0.5)
    found = computed(
        study(one, WALL, axes=axes, draws={"method": "spectra", "number": draws}, seed=1)
    )
    seen = found.n_detected_shot

    def together(quantity: str) -> float:
        return 1e3 * math.sqrt(float((found[f"{quantity}_rmse"] ** 2 * seen).sum() / seen.sum()))

    ratio = found.range_bound / found.radial_velocity_bound
    return {
        "sigma_range": together("range"),
        "sigma_velocity": together("radial_velocity"),
        "sigma_ratio": float(ratio.mean()),
    }


# Chester 2017


def pfa_bin(name: str, tnr: int) -> float:
    """Chance of a false alarm in a bin."""
    one = {"like": name, "processing": {"tnr": tnr}}
    return 10 ** float(computed(study(one, THESIS)).log10_pfa_bin)


THESIS = {"range": "3500 m", "reflectance": 0.1, "radial_velocity": "150 m/s"}


def pfa_both_chirps(name: str) -> float:
    """Chance of a false alarm in both chirps, all bins counted."""
    one = {"like": name, "processing": {"bins_counted": "all"}}
    return 10 ** float(computed(study(one, THESIS)).log10_pfa_both_chirps)


def power_over_table_4_1(name: str) -> float:
    """SNR over that of Table 4.1 [dB]."""
    both = [float(computed(study(n, THESIS)).snr_up) for n in (name, "chester_2017_table_4_1")]
    return 10 * math.log10(both[0] / both[1])


# Rogers 2021, a lander, a car


def range_bound(name: str) -> float:
    """Least standard deviation of range [mm], target of 30 % at 75 m; of the mean echo."""
    target = {"range": "75 m", "reflectance": 0.3}
    found = computed(study(name, target, draws={"method": "spectra", "number": 1}))
    return 1e3 * float(found.range_bound)


def shot_noise_share(name: str) -> float:
    """Shot noise of the local oscillator over all noise."""
    dark = {"like": name, "receiver": {"amplifier_noise_current": "0 A"}}
    target = {"range": "75 m", "reflectance": 0.3}
    quiet, whole = (float(computed(study(n, target)).noise_variance) for n in (dark, name))
    return quiet / whole


def from_5_km(name: str) -> dict[str, float]:
    """Detection of ground of 10 %, and errors of range [m] and velocity [cm/s] by whole bins."""
    found = computed(study(name, {"reflectance": 0.1}, axes=points(PLACES, 5000.0, 0.3, 100.0)))
    return {
        "pd": float(found.pd_shot.mean()),
        "range_error": math.sqrt(float((found.range_error**2).mean())),
        "velocity_error": 1e2 * math.sqrt(float((found.radial_velocity_error**2).mean())),
    }


def on_a_road(name: str) -> dict[str, float]:
    """Detection of 10 % at 200 m; the step of ranges [mm]; from where 60 m/s are read right [m]."""
    target = {"reflectance": 0.1}
    far = computed(study(name, target, axes=points(PLACES, 200.0, 0.1, 30.0)))
    fine = {"target.range": {"step": ["150 m", "151 m", "1 mm"]}}
    steps = computed(study(name, target, axes=fine))
    told = np.unique(np.round(steps.range + steps.range_error, 6))
    near = {"target.range": {"step": ["28 m", "30 m", "10 mm"]}}
    fast = computed(study(name, target | {"radial_velocity": "60 m/s"}, axes=near))
    wrong = abs(fast.radial_velocity_error) > 0.5  # at the limit itself both readings agree
    return {
        "pd": float(far.pd_shot.mean()),
        "range_bin": 1e3 * float(np.diff(told).mean()),
        "nearest_at_60": float(fast.range[wrong].max()),
    }


def simulated(name: str, draws: int = DRAWS) -> dict[str, float]:
    """Every number of an instrument, by its key."""
    one: dict[str, Callable[[str], float]]
    match name:
        case "settembrini_2026":
            one = {f.__name__: f for f in (half_power_range, noise_penalty, pd_of_snr)}
            return {key: f(name) for key, f in one.items()} | sigmas(name, draws)
        case "chester_2017_table_4_1":
            alarms = {f"pfa_bin_tnr_{tnr}": pfa_bin(name, tnr) for tnr in (1, 5, 10, 15)}
            return alarms | {"pfa_both_chirps": pfa_both_chirps(name)}
        case "chester_2017_table_5_1":
            one = {f.__name__: f for f in (pfa_both_chirps, power_over_table_4_1)}
        case "rogers_2021":
            one = {f.__name__: f for f in (range_bound, shot_noise_share)}
        case "lander_ndl":
            return from_5_km(name)
        case "automotive_fmcw":
            return on_a_road(name)
        case _:
            raise KeyError(f"nothing simulates the numbers of {name}")
    return {key: f(name) for key, f in one.items()}


def agrees(number: Values, found: float) -> bool:
    """True where a number simulated lies within what its file allows."""
    match number:
        case {"within": within}:
            return bool(abs(found - number["published"]) <= within)
        case {"factor": factor}:
            return bool(1 / factor <= found / number["published"] <= factor)
        case {"at_least": least}:
            return bool(found >= least)
        case {"at_most": most}:
            return bool(found <= most)
    raise ValueError("a number has one of within, factor, at_least and at_most")


def allowed(number: Values) -> str:
    """Allowed difference of a number, in words."""
    words = {"within": "+- {}", "factor": "factor {}", "at_least": ">= {}", "at_most": "<= {}"}
    ((key, value),) = [(key, number[key]) for key in words if key in number]
    return words[key].format(value)


def section(name: str, found: Values) -> str:
    """Part of the page on one instrument."""
    own = written(name)
    doi = f"[{own['doi']}](https://doi.org/{own['doi']})" if own["doi"] else "none"
    rows = []
    for key, number in own["numbers"].items():
        value = f"{found[key]:.3g} {number['unit']}".strip()
        published = f"{number['published']} {number['unit'] * is_number(number)}".strip()
        verdict = "yes" if agrees(number, found[key]) else "NO"
        rows.append([number["about"], published, value, allowed(number), verdict,
                     number.get("why", "")])  # fmt: skip
    head = ["number", "published", "simulated", "allowed", "agrees", "difference"]
    lists = [
        f"{what}:\n\n" + "\n".join(f"- {each}" for each in own[key] or ["nothing"])
        for what, key in (("Published", "published"), ("Assumed", "assumed"))
    ]
    about = f"## {name}\n\n{own['title']}. {own['source']}. DOI: {doi}."
    return "\n\n".join([about, table(head, rows), *lists])


def is_number(number: Values) -> bool:
    """True where what is published is a number, which its unit follows."""
    return isinstance(number["published"], int | float)


if __name__ == "__main__":
    put(
        "instruments.md", "instruments",
        "\n\n".join(section(name, simulated(name)) for name in library()),
    )  # fmt: skip
