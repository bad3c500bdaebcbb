"""Time that `sweep plan` predicts and takes, and the time of the run: a table for some flights.

Each command is a process of its own, so that start and loading count. The first plan of a large
scene builds and caches it: it is planned once before, which the last columns show.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from benchmark_helpers import EXPERIMENTS, ROOT

NAMES = (
    "descent",
    "gale_crater_descent",
    "speckled_descent",
    "forest_scan",
    "scan_pattern_comparison",
)
FACTOR_MAX = 2.0

#: Study of a flight over a large elevation model of rough ground, whose steps are 5 m.
ROUGH_DESCENT = """\
title: Descent over rough ground
instrument: chester_2017_table_5_1
scene:
  origin: ground
  objects:
    ground: {kind: array, file: rough.npy, spacing: [5 m, 5 m], reflectance: 0.1}
platform:
  path: {kind: straight, from: [0 m, 0 m, 3000 m], to: [500 m, 0 m, 500 m],
         initial_speed: 60 m/s, final_speed: 25 m/s}
scanners:
  three: {kind: cone, beams: 3, half_angle: 22.5 deg, rate: 15 Hz}
"""

PLAN = """
import json, sys
from pathlib import Path
from sweep.cli import main
from sweep.cli import terminal
from sweep.tasks.studies import study_plan
plan_study = study_plan.plan_study
def noted(*positional, **named):
    plan = plan_study(*positional, **named)
    numbers = {"clock": plan.wall_seconds, "cpu": plan.cpu_seconds}
    numbers["parts"] = [(part.name, part.cpu_seconds) for part in plan.time_parts]
    Path(sys.argv.pop()).write_text(json.dumps(numbers))
    return plan
study_plan.plan_study = noted
sys.exit(main(["plan", sys.argv[1]]))
"""
RUN = "import sys; from sweep.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"


def fractal_heights(n: int, rms_slope: float, step: float) -> np.ndarray:
    """Return heights (n, n) [m] of fractal ground with a given root mean square slope."""
    generator = np.random.default_rng(1)
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n))
    frequency[0, 0] = np.inf
    spectrum = frequency**-1.8 * (generator.normal(size=(2, *frequency.shape)).T @ [1, 1j]).T
    heights = np.fft.irfft2(spectrum, s=(n, n))
    slope = np.sqrt(np.mean(np.diff(heights, axis=1) ** 2)) / step
    return (heights * (rms_slope / slope)).astype(np.float32)


def time_command(code: str, *arguments: str) -> tuple[float, float]:
    """Run Python code in a process of its own. Return its wall and processor time [s]."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    outcome = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True
    )
    wall_seconds = time.perf_counter() - start
    if outcome.returncode:
        sys.exit(outcome.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall_seconds, cpu_seconds


def measure(spec: Path, folder: Path) -> str:
    """Return a row of the table for a spec."""
    numbers_file, store = folder / "plan.json", folder / spec.stem / "store.zarr"
    first_plan = time_command(PLAN, str(spec), str(numbers_file))
    plan = time_command(PLAN, str(spec), str(numbers_file))
    predicted = json.loads(numbers_file.read_text())
    store.parent.mkdir()
    actual = time_command(RUN, str(spec), "--store", str(store))
    ratios = predicted["clock"] / actual[0], predicted["cpu"] / actual[1]
    is_met = all(1 / FACTOR_MAX <= ratio <= FACTOR_MAX for ratio in ratios)
    print({name: round(seconds, 2) for name, seconds in predicted["parts"]}, file=sys.stderr)
    cells = [predicted["clock"], actual[0], predicted["cpu"], actual[1]]
    cells += [*first_plan, *plan]
    return (
        f"| {spec.stem} | "
        + " | ".join(f"{seconds:.1f}" for seconds in cells)
        + f" | {'yes' if is_met else 'no'} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("specs", nargs="*", type=Path, help="specs of flights [built-in list]")
    specs = parser.parse_args().specs
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if not specs:
            np.save(folder / "rough.npy", fractal_heights(2000, 0.2, 5.0))
            specs = [EXPERIMENTS / f"{experiment}.yaml" for experiment in NAMES]
            for beamlets in ("auto", "37"):
                specs.append(folder / f"rough_descent_{beamlets}.yaml")
                specs[-1].write_text(ROUGH_DESCENT + f"footprint: {{beamlets: {beamlets}}}\n")
        columns = ["predicted clock [s]", "clock", "predicted cpu", "cpu"]
        columns += ["first plan: clock", "cpu", "plan: clock", "cpu", "within 2"]
        print("| flight | " + " | ".join(columns) + " |")
        print("|" + " --- |" * (len(columns) + 1))
        for spec in specs:
            if not spec.exists():
                sys.exit(f"there is no {spec}")
            print(measure(spec.absolute(), folder), flush=True)


if __name__ == "__main__":
    main()
