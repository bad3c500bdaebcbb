"""Measure what numbers of beamlets cost, and miss, in a flight over rough ground: docs/accuracy.md.

Run with `make accuracy-terrain`, some ten minutes. A flight passes over facets of 5 m with a wide
beam. `footprint.beamlets: auto` at some tolerances is compared with fixed numbers, and all of them
with very many beamlets. Settings take turns; times are processor times of whole runs, rays
included, the least of the rounds. Shots, draws and their random numbers are the same in all runs.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmark_helpers import DOCS, ROOT, load_mapping, markdown_table, replace_page_part
from plan_honesty import fractal_heights

PICTURE = "accuracy_rough_terrain.png"
CELL = 5.0
RMS_SLOPE = 0.2
REFERENCE_BEAMLETS = 60_001
FIXED_BEAMLETS = (1, 7, 19, 37, 127, 1_009, 4_009)
AUTO_TOLERANCES = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
FIXED_TOLERANCE = 1e-3
"""Tolerance of the effects, with a fixed number of beamlets."""

REFERENCE_TOLERANCE = 1e-6
TIME_RATIO_MAX = 1.1
"""Largest ratio of the time of auto to that of a fixed number that is as accurate."""

SPECKLES = {"none": "Without speckle", "developed": "In developed speckle"}


class Setting(NamedTuple):
    """One choice of beamlets and tolerance."""

    beamlets: int | str
    tolerance: float

    @property
    def name(self) -> str:
        """Name in tables."""
        if self.beamlets == "auto":
            return f"auto at {self.tolerance:g}"
        return f"{self.beamlets:,} beamlets"


class Shots(NamedTuple):
    """Results of the shots of a flight that are compared."""

    pd: np.ndarray
    """Probabilities of detection of up-, down-chirp and shot (3, shots)."""
    range: np.ndarray
    """Interpolated range of the strongest true return, in the mean over draws (shots,) [m]."""
    radial_velocity: np.ndarray
    """Interpolated radial velocity of that return, likewise (shots,) [m/s]."""
    amplitude: np.ndarray
    """Magnitude of the strongest bin of the up-chirp, over sigma of its noise (shots,)."""
    beamlets: np.ndarray
    """Beamlets of each shot (shots,)."""


class Measured(NamedTuple):
    """Time and errors of a setting."""

    setting: Setting
    seconds: float
    """Processor time of a shot [s]."""
    mean_beamlets: float
    pd_errors: np.ndarray
    """Largest error of a probability of detection in each shot (shots,)."""
    magnitude_errors: np.ndarray
    """Error of the strongest bin's magnitude over itself, or sigma if that is larger (shots,)."""
    range_errors: np.ndarray
    radial_velocity_errors: np.ndarray
    in_speckle: bool

    @property
    def largest_error(self) -> float:
        """Largest error over the shots of what the tolerance bounds: pd, or without speckle |X|."""
        pd_error = float(np.nanmax(self.pd_errors))
        return pd_error if self.in_speckle else max(pd_error, np.nanmax(self.magnitude_errors))


def flight_mapping(
    folder: Path, setting: Setting, speckle: str, columns: int, draws: int
) -> dict[str, Any]:
    """Return the spec of the flight as plain data."""
    return {
        "title": "Descent over rough ground with a wide beam",
        "instrument": {
            "like": "lander_ndl",
            "laser": {"beam_waist": "1.5 mm", "power": "0.5 W"},
        },
        "scene": {
            "origin": "ground",
            "objects": {
                "ground": {
                    "kind": "array", "file": str(folder / "rough.npy"), "reflectance": 0.1,
                    "spacing": [f"{CELL} m", f"{CELL} m"],
                }
            },
        },
        "platform": {
            "path": {
                "kind": "straight", "from": ["-50 m", "0 m", "2500 m"],
                "to": ["50 m", "0 m", "300 m"], "initial_speed": "40 m/s",
                "final_speed": "10 m/s",
            }
        },
        "scanners": {
            "raster": {
                "kind": "raster", "columns": columns, "rows": columns,
                "half_angles": ["20 deg", "20 deg"], "rate": "0.08 Hz",
            }
        },
        "footprint": {"beamlets": setting.beamlets, "speckle": speckle},
        "accuracy": {"tolerance": setting.tolerance},
        "draws": {"number": draws},
        "error_floor": {"range_noise": "0 m", "vibration": "0 m/s"},
        "seed": 1,
    }  # fmt: skip


def run_flight(mapping: dict[str, Any]) -> tuple[float, Shots]:
    """Compute a flight. Return the processor time of the run [s], and the shots."""
    import sweep

    spec = load_mapping(mapping)
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "flight.zarr"
        start = time.process_time()
        sweep.run(spec, store=store, scheduler="none", progress=False)
        seconds = time.process_time() - start
        flight = sweep.open_scene(store)["raster"].load()
        pds = np.array([flight[name].values for name in ("pd_up", "pd_down", "pd_shot")])
        is_true = flight["surface"].values == 0
        strongest = np.argmax(np.where(is_true, flight["snr"].values, -1.0), axis=-1)[..., None]
        range_and_velocity: list[np.ndarray] = []
        for name in ("range_interpolated", "radial_velocity_interpolated"):
            values = np.where(is_true, flight[name].values, np.nan)
            values = np.take_along_axis(values, strongest, axis=-1)[..., 0]
            has_all = np.isfinite(values).all(axis=1)
            mean = np.where(np.isfinite(values), values, 0.0).mean(axis=1)
            range_and_velocity.append(np.where(has_all, mean, np.nan))
        return seconds, Shots(
            pds,
            range_and_velocity[0],
            range_and_velocity[1],
            np.sqrt(2 * np.asarray(flight["snr_up"].values)),
            flight["beamlets"].values,
        )


class Extent(NamedTuple):
    """Sizes of a measurement."""

    columns: int
    """Beams of a cycle in either direction, of the flight whose shots are compared."""
    columns_max: int
    """Largest number of them in the flight that is timed."""
    timed_seconds: float
    """Processor time that the timed flight is to take [s]: fast settings have more shots."""
    draws: int
    rounds: int
    reference_beamlets: int


FULL = Extent(6, 20, 4.0, 8, 2, REFERENCE_BEAMLETS)


def measure_settings(folder: Path, speckle: str, extent: Extent) -> tuple[list[Measured], int]:
    """Measure all settings in turns. Return them, and the number of shots that are compared."""
    settings = [Setting("auto", tolerance) for tolerance in AUTO_TOLERANCES]
    settings += [Setting(beamlets, FIXED_TOLERANCE) for beamlets in FIXED_BEAMLETS]

    def run(setting: Setting, columns: int) -> tuple[float, Shots]:
        seconds, shots = run_flight(
            flight_mapping(folder, setting, speckle, columns, extent.draws)
        )  # fmt: skip
        print(speckle, setting.name, columns, f"{seconds:.2f} s", file=sys.stderr, flush=True)
        return seconds, shots

    run(settings[0], 1)  # which loads the kernels
    reference = run(Setting(extent.reference_beamlets, REFERENCE_TOLERANCE), extent.columns)[1]
    compared: dict[Setting, Shots] = {}
    columns: dict[Setting, int] = {}
    seconds: dict[Setting, float] = {}
    for setting in settings:
        first_seconds, compared[setting] = run(setting, extent.columns)
        ratio = math.sqrt(max(1.0, extent.timed_seconds / first_seconds))
        columns[setting] = min(extent.columns_max, int(extent.columns * ratio))
        seconds[setting] = math.inf
    for round_number in range(extent.rounds):
        for setting in settings[:: -1 if round_number % 2 else 1]:
            cpu_seconds, shots = run(setting, columns[setting])
            seconds[setting] = min(seconds[setting], cpu_seconds / shots.beamlets.size)
    scale = np.maximum(reference.amplitude, 1.0)
    measured = [
        Measured(
            setting, seconds[setting], float(np.mean(shots.beamlets)),
            np.nanmax(np.abs(shots.pd - reference.pd), axis=0),
            np.abs(shots.amplitude - reference.amplitude) / scale,
            np.abs(shots.range - reference.range),
            np.abs(shots.radial_velocity - reference.radial_velocity),
            speckle == "developed",
        )
        for setting, shots in compared.items()
    ]  # fmt: skip
    return measured, reference.beamlets.size


def fastest_within(settings: Sequence[Measured], error: float) -> Measured | None:
    """Return the fastest of some settings whose largest error of pd is no larger."""
    accurate = [measured for measured in settings if measured.largest_error <= error]
    return min(accurate, key=lambda measured: measured.seconds, default=None)


def is_auto(measured: Measured) -> bool:
    """Return True for settings that choose the number of beamlets shot by shot."""
    return measured.setting.beamlets == "auto"


HEAD = [
    "setting", "mean beamlets", "time over auto at 0.001", "pd: median", "99 %", "largest",
    "magnitude: largest", "range: 90 % [mm]", "99 %", "velocity: 90 % [mm/s]", "99 %",
]  # fmt: skip


def setting_rows(settings: Sequence[Measured]) -> list[list[str]]:
    """Return a row of the table for each setting."""
    base = next(m.seconds for m in settings if m.setting == Setting("auto", 1e-3))
    return [
        [
            measured.setting.name, f"{measured.mean_beamlets:,.0f}",
            f"{measured.seconds / base:.3f}",
            *(format_error(np.nanquantile(measured.pd_errors, q)) for q in (0.5, 0.99, 1.0)),
            format_error(np.nanmax(measured.magnitude_errors)),
            *(f"{1e3 * np.nanquantile(measured.range_errors, q):.2g}" for q in (0.9, 0.99)),
            *(
                f"{1e3 * np.nanquantile(measured.radial_velocity_errors, q):.2g}"
                for q in (0.9, 0.99)
            ),
        ]
        for measured in settings
    ]  # fmt: skip


def format_error(error: float) -> str:
    """Return an error with two digits."""
    return f"{error:.1e}" if error >= 1e-9 else "<1e-9"


def comparison_sentence(auto: Measured, rival: Measured | None) -> str:
    """Return how fast auto is compared with a fixed number."""
    if rival is None:
        return "no fixed number is as accurate"
    ratio = rival.seconds / auto.seconds
    if abs(ratio - 1) < 0.05:
        speed = "is as fast as"
    elif ratio > 1:
        speed = f"is {ratio:.2g} times as fast as"
    else:
        speed = f"takes {1 / ratio:.2g} times the time of"
    return f"it {speed} {rival.setting.name} (error {format_error(rival.largest_error)})"


def conclusion(settings: Sequence[Measured]) -> str:
    """Return a list that compares auto with the fastest fixed number, at two kinds of error."""
    fixed = [measured for measured in settings if not is_auto(measured)]
    lines, is_met = [], True
    for auto in filter(is_auto, settings):
        rival = fastest_within(fixed, auto.largest_error)
        is_met &= rival is None or auto.seconds <= TIME_RATIO_MAX * rival.seconds
        at_error = comparison_sentence(auto, rival)
        at_tolerance = comparison_sentence(auto, fastest_within(fixed, auto.setting.tolerance))
        lines.append(
            f"- Auto at {auto.setting.tolerance:g} has the error "
            f"{format_error(auto.largest_error)}. At that error {at_error}. At its tolerance "
            f"{at_tolerance}."
        )
    keeps = all(auto.largest_error <= auto.setting.tolerance for auto in filter(is_auto, settings))
    lines.append(
        "- Requirement, never slower than a fixed number by more than 10 % at equal error: "
        f"{'met' if is_met else 'not met'}. Tolerances of auto: {'kept' if keeps else 'not kept'}."
    )
    return "\n".join(lines)


def draw_picture(settings_by_speckle: dict[str, list[Measured]]) -> None:
    """Draw the largest error over time for both kinds of echo."""
    from matplotlib.figure import Figure

    from sweep.analysis import canvas

    figure = Figure(figsize=(10, 4.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for panel, (speckle, settings) in zip(axes, settings_by_speckle.items(), strict=True):
        for label, marker, group in (
            ("auto, by tolerance", "o", [m for m in settings if is_auto(m)]),
            ("fixed numbers of beamlets", "s", [m for m in settings if not is_auto(m)]),
        ):
            times = [1e6 * measured.seconds for measured in group]
            errors = [measured.largest_error for measured in group]
            (line,) = panel.plot(times, errors, marker=marker, label=label)
            for measured, x, y in zip(group, times, errors, strict=True):
                is_left = not is_auto(measured)
                text = (
                    f"{measured.setting.tolerance:g}"
                    if is_auto(measured)
                    else f"{measured.setting.beamlets:,}"
                )
                panel.annotate(
                    text, (x, y), xytext=(-6 if is_left else 6, -4 if is_left else 4),
                    ha="right" if is_left else "left", textcoords="offset points", fontsize=8,
                    color=line.get_color(),
                )  # fmt: skip
        panel.set(xscale="log", yscale="log", title=SPECKLES[speckle])
        panel.set_xlabel("processor time of a shot [us]")
        panel.grid(visible=True, which="major", alpha=0.3)
        panel.margins(0.12)
    axes[0].set_ylabel("largest error: of pd, without speckle also of |X|")
    axes[1].legend(fontsize=8)
    canvas.save_sheet(figure, DOCS / PICTURE)


def main() -> None:
    """Measure, draw the picture and write the section into docs/accuracy.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a look; the page stays as it is")
    quick = parser.parse_args().quick
    extent = Extent(4, 6, 1.0, 2, 1, 10_009) if quick else FULL
    settings_by_speckle, parts = {}, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.save(folder / "rough.npy", fractal_heights(600, RMS_SLOPE, CELL))
        for speckle, heading in SPECKLES.items():
            settings, n_shots = measure_settings(folder, speckle, extent)
            settings_by_speckle[speckle] = settings
            base = next(m.seconds for m in settings if m.setting == Setting("auto", 1e-3))
            parts += [
                f"### {heading}",
                conclusion(settings),
                f"{n_shots:,} shots. Auto at 0.001 takes {1e6 * base:,.0f} us a shot.",
                markdown_table(HEAD, setting_rows(settings)),
            ]
    text = "\n\n".join(parts)
    print(text)
    if not quick:
        draw_picture(settings_by_speckle)
        replace_page_part("accuracy.md", "rough_terrain", text)


if __name__ == "__main__":
    if os.environ.get("PYTHONPATH") != str(ROOT):  # sweep is that of this check-out
        os.execve(
            sys.executable, [sys.executable, *sys.argv], os.environ | {"PYTHONPATH": str(ROOT)}
        )
    main()
