"""Compare sweep with drawn records by NumPy, and measure how both grow: docs/peers.md.

Run with `make peers-physics`, some ten minutes. --quick takes one or two, for a look.

Both compute the same probabilities of detection. Sweep does so within its tolerance. A script of
NumPy (`benchmarks/numpy_record.py`) draws noise, and speckle, until the standard error of its share
is that tolerance. They take turns in one process. Growth is measured in processes of their own,
which tell their largest memory. All times are processor times, the least of some rounds.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmark_helpers import ROOT, load_mapping, markdown_table, replace_page_part
from numpy_record import Lidar, PlaneRecords

PAGE = "peers.md"
SEED = 1
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
"""Environment of all measuring processes: NumPy's matrix products run on one core, and sweep is
that of this check-out."""


class Case(NamedTuple):
    """A plane whose probabilities of detection both compute, over an axis of ranges."""

    name: str
    lidar: Lidar
    is_in_speckle: bool
    n_scatterers: int
    ranges: tuple[float, float]
    """First and last range [m]."""
    standard_error: float
    """Standard error of the shares of drawn records that are compared with sweep."""


SLOPE = Lidar(laser_power=0.4, grazing_angle=math.radians(15), beam_divergence=4e-3)
CASES = (
    Case("steady echo", Lidar(), False, 1, (150.0, 350.0), 1e-3),
    Case("speckle", Lidar(), True, 1, (150.0, 350.0), 2e-3),
    Case("speckle on a slope", SLOPE, True, 65, (150.0, 350.0), 2e-3),
)


class Extent(NamedTuple):
    """Sizes of one run of this script."""

    compared_ranges: int
    """Ranges at which drawn records are compared with sweep."""
    standard_error_factor: float
    """Factor on the standard errors of the cases."""
    rounds: int
    growth_rounds: int
    grid_points: int
    fft_exponents: tuple[int, ...]
    beamlets: tuple[int, ...]
    facets: tuple[int, ...]
    shots: tuple[int, ...]


FULL = Extent(
    5, 1.0, 3, 2, 50_000,
    (10, 12, 14, 16, 18, 20),
    (1, 10, 100, 1_000, 10_000),
    (10_000, 100_000, 1_000_000, 10_000_000),
    (1_000, 10_000, 100_000),
)  # fmt: skip
QUICK = Extent(3, 10.0, 2, 1, 5_000, (10, 14), (1, 100), (10_000, 100_000), (1_000, 10_000))


# Sweep's study of the same plane


def grid_mapping(
    lidar: Lidar,
    range_axis: dict[str, Any],
    *,
    is_in_speckle: bool,
    tolerance: float,
    beamlets: int | str = "auto",
) -> dict[str, Any]:
    """Return a spec of sweep for the numbers of a lidar, as plain data."""
    return {
        "title": "Plane that peers detect",
        "instrument": {
            "laser": {
                "wavelength": f"{lidar.wavelength} m",
                "power": f"{lidar.laser_power} W",
                "beam_divergence": f"{lidar.beam_divergence} rad",
            },
            "chirp": {
                "bandwidth": f"{lidar.bandwidth} Hz",
                "start_frequency": "0 Hz",
                "duration": f"{lidar.chirp_duration!r} s",
                "segments": "up down",
            },
            "telescope": {
                "aperture": f"{lidar.aperture} m",
                "optical_efficiency": lidar.optical_efficiency,
                "coupling": "aperture",
            },
            "receiver": {
                "local_oscillator_power": f"{lidar.local_oscillator_power} W",
                "responsivity": f"{lidar.responsivity} A/W",
                "detector_bandwidth": f"{lidar.receiver_bandwidth} Hz",
                "amplifier_bandwidth": f"{lidar.receiver_bandwidth} Hz",
                "optical_passband": "25 nm",
                "noise_equivalent_power": f"{lidar.noise_equivalent_power} W/Hz^0.5",
                "transimpedance": f"{lidar.transimpedance} ohm",
                "amplifier_noise_current": f"{lidar.amplifier_noise_current} A",
                "noise_shape": "white",
            },
            "processing": {
                "sample_rate": f"{lidar.sample_rate} Hz",
                "fft_size": lidar.fft_size,
                "window": "hamming",
                "acquisition_delay": f"{lidar.acquisition_delay} s",
                "tnr": lidar.threshold_to_noise,
                "detection": "peak_bin",
                "two_beats": "far",
            },
        },
        "target": {
            "grazing_angle": f"{lidar.grazing_angle!r} rad",
            "reflectance": lidar.reflectance,
            "radial_velocity": f"{lidar.radial_velocity} m/s",
        },
        "footprint": {
            "beamlets": beamlets,
            "speckle": "developed" if is_in_speckle else "none",
        },
        "accuracy": {"tolerance": tolerance},
        "axes": {"target.range": range_axis},
    }


def linear_axis(ranges: tuple[float, float], number: int) -> dict[str, Any]:
    """Return an axis of evenly spaced ranges, as a spec has it."""
    return {"linear": [f"{ranges[0]} m", f"{ranges[1]} m"], "number": number}


def run_study(spec: Any) -> Any:
    """Compute a study into a temporary store and return its dataset, read into memory."""
    import sweep

    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "study.zarr"
        sweep.run(spec, store=store, scheduler="none", progress=False)
        return sweep.open(store).load()


def cpu_seconds(function: Callable[[], Any]) -> float:
    """Return the processor time of a call [s]."""
    start = time.process_time()
    function()
    return time.process_time() - start


# Points a second at equal error


class CaseComparison(NamedTuple):
    """Both ways on one case: rows of the two tables."""

    rate_rows: list[list[str]]
    agreement_rows: list[list[str]]


def drawn_shots(pd: np.ndarray, standard_error: float) -> np.ndarray:
    """Return the number of shots whose share has a given standard error."""
    return np.maximum(1, np.ceil(pd * (1 - pd) / standard_error**2)).astype(np.int64)


def compare_case(case: Case, extent: Extent) -> CaseComparison:
    """Time both ways in turns, and compare probabilities of detection."""
    tolerances = (1e-2, 1e-3, 1e-4)
    specs = [
        load_mapping(
            grid_mapping(
                case.lidar, linear_axis(case.ranges, extent.grid_points),
                is_in_speckle=case.is_in_speckle, tolerance=tolerance,
            )
        )
        for tolerance in tolerances
    ]  # fmt: skip
    pd_of_grid = run_study(specs[0]).pd_shot.values  # which also loads the kernels
    records = PlaneRecords(case.lidar, float(np.mean(case.ranges)), case.n_scatterers)
    generator, timed_shots = np.random.default_rng(SEED), 4_000
    sweep_seconds = dict.fromkeys(tolerances, math.inf)
    shot_seconds = math.inf
    for _ in range(extent.rounds):
        for tolerance, spec in zip(tolerances, specs, strict=True):
            seconds = cpu_seconds(partial(run_study, spec)) / extent.grid_points
            sweep_seconds[tolerance] = min(sweep_seconds[tolerance], seconds)
        seconds = cpu_seconds(
            lambda: records.count_detections(
                timed_shots, generator, is_in_speckle=case.is_in_speckle
            )
        )
        shot_seconds = min(shot_seconds, seconds / timed_shots)
    rate_rows = []
    for tolerance in tolerances:
        n_draws = float(np.mean(drawn_shots(pd_of_grid, tolerance)))
        numpy_rate = 1 / (n_draws * shot_seconds)
        rate_rows.append([
            case.name, f"{tolerance:g}", f"{n_draws:,.0f}", format_rate(numpy_rate),
            format_rate(1 / sweep_seconds[tolerance]),
            format_ratio(1 / (sweep_seconds[tolerance] * numpy_rate)),
        ])  # fmt: skip
    return CaseComparison(rate_rows, agreement_rows(case, extent))


def agreement_rows(case: Case, extent: Extent) -> list[list[str]]:
    """Draw records at some ranges; return what both ways say of pd, and how far they differ."""
    spec = load_mapping(
        grid_mapping(
            case.lidar, linear_axis(case.ranges, extent.compared_ranges),
            is_in_speckle=case.is_in_speckle, tolerance=1e-4,
        )
    )  # fmt: skip
    study = run_study(spec)
    standard_error = case.standard_error * extent.standard_error_factor
    generator = np.random.default_rng(SEED)
    rows = []
    for target_range, snr, *pds in zip(
        *(study[name].values for name in ("range", "snr_up", "pd_up", "pd_down", "pd_shot")),
        strict=True,
    ):
        n_shots = int(max(drawn_shots(np.array(pds), standard_error).max(), 1 / standard_error))
        records = PlaneRecords(case.lidar, float(target_range), case.n_scatterers)
        counts = records.count_detections(n_shots, generator, is_in_speckle=case.is_in_speckle)
        shares = np.array(counts) / n_shots
        errors = np.sqrt(np.array(pds) * (1 - np.array(pds)) / n_shots)
        deviations = (np.array(pds) - shares) / np.maximum(errors, 1 / n_shots)
        rows.append([
            case.name, f"{target_range:.0f} m", f"{n_shots:,}",
            *(f"{pd:.4f} / {share:.4f}" for pd, share in zip(pds, shares, strict=True)),
            " / ".join(f"{deviation:+.1f}" for deviation in deviations),
            f"{records.snr[0] / snr - 1:+.0e}",
        ])  # fmt: skip
    return rows


# Growth, each row in processes of its own


def measure_grid(request: dict[str, Any]) -> float:
    """Return the processor time of a point of sweep's study [s]."""
    lidar = Lidar(**request["lidar"])
    points = request["points"]
    spec = load_mapping(
        grid_mapping(
            lidar, linear_axis(tuple(request["ranges"]), points),
            is_in_speckle=request["is_in_speckle"], tolerance=1e-3, beamlets=request["beamlets"],
        )
    )  # fmt: skip
    run_study(spec)
    return min(cpu_seconds(lambda: run_study(spec)) for _ in range(request["rounds"])) / points


def measure_record(request: dict[str, Any]) -> float:
    """Return the processor time of a shot of drawn records by NumPy [s]."""
    records = PlaneRecords(Lidar(**request["lidar"]), 250.0, request["scatterers"])
    generator, n_shots = np.random.default_rng(SEED), request["shots"]
    return (
        min(
            cpu_seconds(
                lambda: records.count_detections(
                    n_shots, generator, is_in_speckle=request["is_in_speckle"]
                )
            )
            for _ in range(request["rounds"])
        )
        / n_shots
    )


def measure_flight(request: dict[str, Any]) -> float:
    """Return the processor time of a flight [s]; its rays are cast anew."""
    run_flight(load_mapping(request["rehearsal"]))  # which loads the kernels
    spec = load_mapping(request["mapping"])
    return cpu_seconds(lambda: run_flight(spec))


def run_flight(spec: Any) -> None:
    """Compute a flight into a temporary folder."""
    import sweep

    with tempfile.TemporaryDirectory() as folder:
        sweep.run(spec, store=Path(folder) / "flight.zarr", scheduler="none", progress=False)


MEASUREMENTS = {"grid": measure_grid, "record": measure_record, "flight": measure_flight}


def largest_memory() -> float:
    """Return the largest memory that this process has had [bytes].

    Linux counts the parent's memory in `ru_maxrss` of a process that it starts, so the mark of the
    process itself is read where there is one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0


class Usage(NamedTuple):
    """Processor time and memory of a measurement."""

    seconds: float
    megabytes: float
    """Largest memory of the process, libraries and kernels included [MB]."""


def measure_in_process(kind: str, **request: Any) -> Usage:
    """Measure in a new process; return the time and the largest memory of that process."""
    process = subprocess.run(
        [sys.executable, __file__, "--measure", json.dumps({"kind": kind} | request)],
        stdout=subprocess.PIPE, text=True, check=True, env=os.environ | ENVIRONMENT,
    )  # fmt: skip
    return Usage(*json.loads(process.stdout.splitlines()[-1]))


def lidar_of_fft_size(fft_size: int) -> dict[str, Any]:
    """Return numbers of a lidar at rest whose laser is weaker the longer its chirps are."""
    default = Lidar()
    return {
        "fft_size": fft_size,
        "laser_power": default.laser_power * default.fft_size / fft_size,
        "radial_velocity": 0.0,
    }


def fft_size_rows(extent: Extent) -> list[list[str]]:
    """Return the table of growth with the FFT size."""
    rows = []
    for exponent in extent.fft_exponents:
        lidar = lidar_of_fft_size(2**exponent)
        grid_cost = measure_in_process(
            "grid", lidar=lidar, ranges=(150.0, 350.0), points=extent.grid_points,
            is_in_speckle=False, beamlets=1, rounds=extent.growth_rounds,
        )  # fmt: skip
        record_cost = measure_in_process(
            "record", lidar=lidar, scatterers=1, is_in_speckle=False,
            shots=max(4, 2**22 >> exponent), rounds=extent.growth_rounds,
        )  # fmt: skip
        rows.append([
            f"2^{exponent}", f"{grid_cost.seconds * 1e6:.1f}", f"{grid_cost.megabytes:,.0f}",
            f"{record_cost.seconds * 1e6:,.0f}", f"{record_cost.megabytes:,.0f}",
        ])  # fmt: skip
    return rows


def beamlet_rows(extent: Extent) -> list[list[str]]:
    """Return the table of growth with the number of beamlets on a slope."""
    rows = []
    lidar = {
        "laser_power": SLOPE.laser_power,
        "grazing_angle": SLOPE.grazing_angle,
        "beam_divergence": SLOPE.beam_divergence,
    }
    for beamlets in (None, *extent.beamlets):
        points = extent.grid_points // 2
        if beamlets is not None:
            points = max(points // 12, min(points, 200 * points // beamlets))
        grid_cost = measure_in_process(
            "grid", lidar=lidar, ranges=(150.0, 350.0), points=points,
            is_in_speckle=True, beamlets=beamlets or "auto", rounds=extent.growth_rounds,
        )  # fmt: skip
        cells = [f"{grid_cost.seconds * 1e6:,.1f}", f"{grid_cost.megabytes:,.0f}"]
        if beamlets is None:
            rows.append(["auto", *cells, "-", "-"])
            continue
        record_cost = measure_in_process(
            "record", lidar=lidar, scatterers=beamlets, is_in_speckle=True,
            shots=max(64, 2**18 // beamlets), rounds=extent.growth_rounds,
        )  # fmt: skip
        rows.append(
            [
                f"{beamlets:,}",
                *cells,
                f"{record_cost.seconds * 1e6:,.0f}",
                f"{record_cost.megabytes:,.0f}",
            ]
        )
    return rows


def flight_mapping(
    heights_file: Path, cell_size: float, *, cycles: int, columns: int = 32
) -> dict[str, Any]:
    """Return the spec of a flight over a square of rough ground, as plain data."""
    duration = 20.0
    return {
        "title": "Flight over rough ground",
        "instrument": {"like": "lander_ndl", "processing": {"two_beats": "far"}},
        "scene": {
            "origin": "ground",
            "objects": {
                "ground": {
                    "kind": "array", "file": str(heights_file), "reflectance": 0.1,
                    "spacing": [f"{cell_size} m", f"{cell_size} m"],
                }
            },
        },
        "platform": {
            "path": {
                "kind": "straight", "from": ["-50 m", "0 m", "600 m"],
                "to": ["50 m", "0 m", "600 m"], "initial_speed": f"{100 / duration} m/s",
                "final_speed": f"{100 / duration} m/s",
            }
        },
        "scanners": {
            "raster": {
                "kind": "raster", "columns": columns, "rows": columns,
                "half_angles": ["20 deg", "20 deg"], "rate": f"{cycles / duration} Hz",
            }
        },
        "footprint": {"beamlets": 19},
        "seed": SEED,
    }  # fmt: skip


GROUND_SIZE = 1_000.0
"""Side of the square of ground [m]."""


def write_heights(folder: Path, n: int) -> Path:
    """Write heights of fractal ground, whose offset is new in each run: no cache has the scene."""
    from plan_honesty import fractal_heights

    heights = fractal_heights(n + n % 2, 0.2, GROUND_SIZE / n)[:n, :n]
    path = folder / f"heights_{n}.npy"
    np.save(path, heights + np.float32(time.time() % 1))
    return path


def rehearsal_mapping(folder: Path) -> dict[str, Any]:
    """Return the spec of a short flight over few facets, which loads all that others need."""
    heights = write_heights(folder, 32)
    return flight_mapping(heights, GROUND_SIZE / 31, cycles=1, columns=8)


def facet_rows(extent: Extent, folder: Path) -> list[list[str]]:
    """Return the table of growth with the facets of a scene."""
    rows = []
    rehearsal = rehearsal_mapping(folder)
    for facets in extent.facets:
        n = round(math.sqrt(facets / 2)) + 1
        heights = write_heights(folder, n)
        mapping = flight_mapping(heights, GROUND_SIZE / (n - 1), cycles=10)
        first = measure_in_process("flight", mapping=mapping, rehearsal=rehearsal)
        second = measure_in_process("flight", mapping=mapping, rehearsal=rehearsal)
        heights.unlink()
        rows.append([
            f"{2 * (n - 1) ** 2:,}", f"{first.seconds:.1f}", f"{first.megabytes:,.0f}",
            f"{second.seconds:.1f}", f"{second.megabytes:,.0f}",
        ])  # fmt: skip
    return rows


def shot_rows(extent: Extent, folder: Path) -> list[list[str]]:
    """Return the table of growth with the shots of a flight."""
    rows = []
    rehearsal = rehearsal_mapping(folder)
    heights = write_heights(folder, 225)
    for shots in extent.shots:
        cycles = max(1, round(shots / 1024))
        mapping = flight_mapping(heights, GROUND_SIZE / 224, cycles=cycles)
        usage = measure_in_process("flight", mapping=mapping, rehearsal=rehearsal)
        n_shots = cycles * 1024
        rows.append([
            f"{n_shots:,}", f"{usage.seconds:.1f}", f"{usage.seconds / n_shots * 1e6:,.0f}",
            f"{usage.megabytes:,.0f}",
        ])  # fmt: skip
    return rows


# Page


def format_rate(rate: float) -> str:
    """Return a rate with two digits."""
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def format_ratio(ratio: float) -> str:
    """Return a ratio with two digits."""
    digits = 1 - math.floor(math.log10(ratio))
    return f"{round(ratio, digits):,.0f}" if ratio >= 10 else f"{ratio:.1f}"


class Table(NamedTuple):
    """Table of the page."""

    head: list[str]
    rows: list[list[str]]


RATE_HEAD = ["case", "error of pd", "draws a point", "NumPy, points/s", "sweep, points/s", "ratio"]
AGREEMENT_HEAD = [
    "case", "range", "draws", "pd up, sweep / NumPy", "pd down", "pd shot", "in standard errors",
    "SNR up, NumPy's over sweep's, less 1",
]  # fmt: skip
FFT_HEAD = ["FFT size", "sweep, us a point", "MB", "NumPy, us a shot", "MB"]
BEAMLET_HEAD = ["beamlets", "sweep, us a point", "MB", "NumPy, us a shot", "MB"]
FACET_HEAD = ["facets", "first run, s", "MB", "next run, s", "MB"]
SHOT_HEAD = ["shots", "s", "us a shot", "MB"]


def comparison_tables(extent: Extent, folder: Path) -> dict[str, Table]:
    """Return the tables of points a second and of agreement."""
    comparisons = [compare_case(case, extent) for case in CASES]
    return {
        "rates": Table(
            RATE_HEAD, [row for comparison in comparisons for row in comparison.rate_rows]
        ),
        "agreement": Table(
            AGREEMENT_HEAD, [row for comparison in comparisons for row in comparison.agreement_rows]
        ),
    }


PARTS: dict[str, Callable[[Extent, Path], dict[str, Table]]] = {
    "comparison": comparison_tables,
    "fft_sizes": lambda extent, folder: {"fft_sizes": Table(FFT_HEAD, fft_size_rows(extent))},
    "beamlets": lambda extent, folder: {"beamlets": Table(BEAMLET_HEAD, beamlet_rows(extent))},
    "facets": lambda extent, folder: {"facets": Table(FACET_HEAD, facet_rows(extent, folder))},
    "shots": lambda extent, folder: {"shots": Table(SHOT_HEAD, shot_rows(extent, folder))},
}
"""Parts of the page by name, each of which measures and returns tables by the names of marks."""


def main() -> None:
    """Measure, print the tables and write them into docs/peers.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="parts to measure [all]")
    parser.add_argument("--quick", action="store_true", help="a look; the page stays as it is")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        request = json.loads(arguments.measure)
        seconds = MEASUREMENTS[request.pop("kind")](request)
        print(json.dumps([seconds, largest_memory() / 1e6]))
        return
    with tempfile.TemporaryDirectory() as folder:
        for part in arguments.parts or PARTS:
            start = time.perf_counter()
            tables = PARTS[part](QUICK if arguments.quick else FULL, Path(folder))
            for name, table in tables.items():
                text = markdown_table(table.head, table.rows)
                print(f"\n{text}", flush=True)
                if not arguments.quick:
                    replace_page_part(PAGE, name, text)
            print(f"{part}: {time.perf_counter() - start:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    if not ENVIRONMENT.items() <= os.environ.items():  # before NumPy is imported
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ENVIRONMENT)
    main()
