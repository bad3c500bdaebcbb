"""Compare the time per point with that of an earlier commit: both versions take turns.

    python benchmarks/version_timing.py                        # all studies, some ten minutes
    python benchmarks/version_timing.py published rough_ground --rounds 9
    python benchmarks/version_timing.py --group speckle --earlier 7881fb1

`make side-by-side` does all of the first group. The group of speckle has smooth points, whose time
is to stay, flights of the library's instruments in developed speckle, and developed points against
smooth ones of this version: `make speckle-time`.

Each version runs in a process of its own, with its own compiled kernels and experiments, through
`sweep.load` and `sweep.run(scheduler="none")` alone. A study is run whole and as a small part of
itself; the processor's time for a point is the difference of the two over the points that the small
one lacks, so that what a run costs once (reading, ground, the store) does not count. The versions
change places each round. Others on the machine only ever add to a time, so that the ratio follows
from the least times of the whole and of the part over all rounds; those of single rounds are from
.. to.
"""

import argparse
import copy
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from benchmark_helpers import ROOT, experiment_mapping

EARLIER_COMMIT = "9b29f45"
WORK_DIR = ROOT / "results" / "side_by_side"
FLIGHT_RATIO_MAX = 1.3
"""Largest ratio of times for flights."""


class TimedStudy(NamedTuple):
    """An experiment to time, its overrides for the whole and for a small part, and the aim."""

    experiment: str | dict[str, Any]
    """Name of the experiment, or its spec as plain data."""
    ratio_max: float
    whole_overrides: dict[str, Any]
    part_overrides: dict[str, Any]
    against: str = ""
    """Study of this version to compare with; empty to compare with the earlier version."""


def timed_flight(experiment: str, scanner: str, rate: float, **overrides: Any) -> TimedStudy:
    """Return a flight to time at a scanner's `rate` [Hz], and at a tenth of it."""
    path = f"scanners.{scanner}.rate"
    return TimedStudy(
        experiment,
        FLIGHT_RATIO_MAX,
        overrides | {path: f"{rate} Hz"},
        overrides | {path: f"{rate / 10} Hz"},
    )


ROUGH_GROUND = {"footprint.phases": "incoherent", "footprint.beamlets": "auto"}
RANGE_AXIS = "axes.target.range"
FEW_DRAWS = {"draws.number": 10}
STUDIES = {
    "published": TimedStudy(
        "range_angle", 1.25, {}, {RANGE_AXIS: {"step": ["1 m", "1 km", "1 m"]}}
    ),
    "rough_ground": TimedStudy(
        "range_angle",
        1.0,
        ROUGH_GROUND | {RANGE_AXIS: {"step": ["1 m", "10 km", "5 m"]}},
        ROUGH_GROUND | {RANGE_AXIS: {"step": ["1 m", "1 km", "5 m"]}},
    ),
    "speckled_target": TimedStudy(
        "speckled_target", 1.0, {}, {RANGE_AXIS: {"step": ["1 km", "12 km", "2 km"]}}
    ),
    "morpheus_three_beam": timed_flight("morpheus_three_beam", "three", 500),
    "oblique_descent": timed_flight("oblique_descent", "corners", 200),
    "square_high_descent": timed_flight("square_high_descent", "corners", 200),
    "square_low_descent": timed_flight("square_low_descent", "corners", 200),
    "expanded_pattern": timed_flight("expanded_pattern", "squares", 200),
    "forest_scan": timed_flight("forest_scan", "sweep", 650),
    "scan_pattern_comparison": timed_flight("scan_pattern_comparison", "three", 200, **FEW_DRAWS),
}  # fmt: skip


DEVELOPED = 2.5
"""Largest ratio of the time of a point in developed speckle to that of a smooth one."""


def speckle_grid(rule: str, speckle: str, angle: int) -> dict[str, Any]:
    """Return the spec of points at one grazing angle [deg], whose echoes arrive in time."""
    return {
        "title": "Points in time",
        "instrument": {
            "like": "chester_2017_table_4_1",
            "processing": {"detection": rule, "acquisition_delay": "50 us"},
        },
        "target": {
            "reflectance": 0.1, "radial_velocity": "150 m/s", "grazing_angle": f"{angle} deg",
        },
        "footprint": {"speckle": speckle},
        "axes": {},
    }  # fmt: skip


def speckle_flight(
    instrument: str, heights: tuple[int, int], draws: int, method: str
) -> TimedStudy:
    """Return a descent between two heights [m] of a raster of 64 beams over a plane."""
    spec: dict[str, Any] = {
        "title": "Descent in time",
        "instrument": {"like": instrument},
        "scene": {"objects": {"g": {"kind": "plane", "size": "20 km", "reflectance": 0.1}}},
        "platform": {
            "path": {
                "kind": "straight", "from": ["0 m", "0 m", f"{heights[0]} m"],
                "to": ["50 m", "0 m", f"{heights[1]} m"],
                "initial_speed": f"{heights[0] / 25} m/s",
            },
            "attitude": {"kind": "nadir"},
        },
        "scanners": {
            "b": {"kind": "raster", "columns": 8, "rows": 8, "half_angles": ["25 deg", "25 deg"]}
        },
        "draws": {"number": draws, "method": method},
        "footprint": {"beamlets": 19},
    }  # fmt: skip
    rates = ({"scanners.b.rate": f"{rate} Hz"} for rate in (4.0, 0.4))
    return TimedStudy(spec, FLIGHT_RATIO_MAX, *rates)


def speckle_studies() -> dict[str, TimedStudy]:
    """Return the studies of points and flights with and without speckle, by name."""
    studies = {}
    for rule in ("any_bin", "peak_bin"):
        for angle in (90, 30, 5):
            for speckle in ("none", "developed"):
                ranges = (
                    {RANGE_AXIS: {"linear": ["500 m", "6 km"], "number": number}}
                    for number in (60_000, 6_000)
                )
                study = TimedStudy(speckle_grid(rule, speckle, angle), 1.0, *ranges)
                if speckle == "developed":
                    study = study._replace(ratio_max=DEVELOPED, against=f"{rule}_{angle}_none")
                studies[f"{rule}_{angle}_{speckle}"] = study
    for instrument, heights in (("lander_ndl", (1500, 1000)), ("automotive_fmcw", (150, 100))):
        for method in ("probabilities", "noise"):
            for draws in (1, 10, 100):
                name = f"{instrument}_{method}_{draws}"
                studies[name] = speckle_flight(instrument, heights, draws, method)
    return studies


GROUPS = {"experiments": STUDIES, "speckle": speckle_studies()}


def experiment_with_overrides(
    checkout: Path, study: TimedStudy, overrides: dict[str, Any]
) -> dict[str, Any]:
    """Return the experiment of a check-out as plain data, with overrides."""
    if isinstance(study.experiment, str):
        spec = experiment_mapping(checkout / "experiments", study.experiment)
    else:
        spec = copy.deepcopy(study.experiment)
    for path, value in overrides.items():
        section, _, field_path = path.partition(".")
        sections, name = (
            ([], field_path)
            if section == "axes"
            else (field_path.split(".")[:-1], field_path.rpartition(".")[2])
        )
        inner = spec.setdefault(section, {})
        for section_name in sections:
            inner = inner[section_name]
        inner[name] = value
    return spec


def serve_runs() -> None:
    """Run the spec files named on standard input; print processor time [s] and points of each."""
    import sweep

    for line in sys.stdin:
        spec = sweep.load(line.strip())
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            outcome = sweep.run(spec, store=f"{folder}/side.zarr", scheduler="none", progress=False)
            cpu_seconds = time.process_time() - start
        if not outcome.complete:
            sys.exit(f"{line.strip()}: {outcome.stop_reason or outcome.failures}")
        print(json.dumps([cpu_seconds, outcome.points]), flush=True)


class SecondsAndPoints(NamedTuple):
    """Processor times of a whole study and of its part, and how many points more the whole has."""

    whole_seconds: float
    part_seconds: float
    n_points_more: int

    @property
    def per_point(self) -> float:
        """Processor time of a point that only the whole study has [s]."""
        return (self.whole_seconds - self.part_seconds) / self.n_points_more


def least_of_rounds(rounds: Sequence[SecondsAndPoints]) -> SecondsAndPoints:
    """Return the least whole time and the least part time, each over all rounds of one study.

    The two may come from different rounds.
    """
    return SecondsAndPoints(
        min(times.whole_seconds for times in rounds),
        min(times.part_seconds for times in rounds),
        rounds[0].n_points_more,
    )


class Version:
    """A process that runs studies with the version in a check-out's folder."""

    def __init__(self, name: str, checkout: Path) -> None:
        self.name, self._checkout = name, checkout
        environment = {
            "PYTHONPATH": str(checkout),
            "NUMBA_CACHE_DIR": str(WORK_DIR / f"kernels_{name}"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | environment,
            cwd=WORK_DIR,
        )

    def run(self, spec: Path) -> tuple[float, int]:
        """Run a study; return processor time [s] and number of points."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(spec, file=self._process.stdin, flush=True)
        answer_line = self._process.stdout.readline()
        if not answer_line:
            sys.exit(f"{self.name} has ended: see above")
        cpu_seconds, points = json.loads(answer_line)
        return cpu_seconds, points

    def seconds_of_whole_and_part(self, study: TimedStudy, folder: Path) -> SecondsAndPoints:
        """Run the whole study and its part; return processor times [s] and numbers of points."""
        results = []
        for name, overrides in (("whole", study.whole_overrides), ("part", study.part_overrides)):
            file = folder / f"{name}_{self.name}.yaml"
            spec = experiment_with_overrides(self._checkout, study, overrides)
            file.write_text(yaml.safe_dump(spec, sort_keys=False))
            results.append(self.run(file))
        (whole_seconds, whole_points), (part_seconds, part_points) = results
        return SecondsAndPoints(whole_seconds, part_seconds, whole_points - part_points)

    def close(self) -> None:
        """Stop the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def check_out_commit(commit: str) -> Path:
    """Check out a commit into a worktree, unless it exists; return the folder."""
    checkout = WORK_DIR / commit
    if not checkout.exists():
        subprocess.run(
            ["git", "worktree", "add", "--detach", str(checkout), commit], check=True, cwd=ROOT
        )
    return checkout


def measure_versions(
    versions: list[Version], study: TimedStudy, rounds: int
) -> list[list[SecondsAndPoints]]:
    """Return the times of each version by round, without a first round that may compile."""
    with tempfile.TemporaryDirectory() as folder:
        times_by_version: dict[str, list[SecondsAndPoints]] = {v.name: [] for v in versions}
        for count in range(rounds + 1):
            for version in versions if count % 2 else versions[::-1]:
                times_by_version[version.name].append(
                    version.seconds_of_whole_and_part(study, Path(folder))
                )
        return [times[1:] for times in times_by_version.values()]


def show_row(
    name: str, before: float, after: float, ratio: float, low: float, high: float, aim: float,
    against: str = "",
) -> None:  # fmt: skip
    """Print times [us] and their ratio, and whether the ratio exceeds the aim.

    A study that is compared with another one of this version has no aim against the earlier one.
    """
    goal = f"{'':8}" if against else f"{aim:8.2f}"
    missed = "" if against or ratio <= aim else "  missed"
    print(f"{name:32}{before:14.3g}{after:14.3g}{ratio:8.2f}{low:8.2f}{high:8.2f}{goal}{missed}",
          flush=True)  # fmt: skip


def main() -> None:
    """Print a row for each study as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("studies", nargs="*", help="names of studies, default all")
    parser.add_argument("--group", choices=GROUPS, default="experiments")
    parser.add_argument("--earlier", default=EARLIER_COMMIT, help="commit to stand beside this one")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        return serve_runs()
    group = GROUPS[arguments.group]
    if unknown := set(arguments.studies) - set(group):
        parser.error(f"no such study: {', '.join(sorted(unknown))}; there are {', '.join(group)}")
    WORK_DIR.mkdir(parents=True, exist_ok=True)
    versions = [
        Version(arguments.earlier, check_out_commit(arguments.earlier)),
        Version("now", ROOT),
    ]
    print(f"{'study':32}{arguments.earlier + ' [us]':>14}{'now [us]':>14}{'ratio':>8}{'from':>8}"
          f"{'to':>8}{'aim':>8}")  # fmt: skip
    least: dict[str, float] = {}
    for name in arguments.studies or group:
        study = group[name]
        times_by_version = measure_versions(versions, study, arguments.rounds)
        earlier, now = (1e6 * least_of_rounds(times).per_point for times in times_by_version)
        least[name] = now
        ratios = sorted(
            after.per_point / before.per_point
            for before, after in zip(*times_by_version, strict=True)
        )
        show_row(
            name, earlier, now, now / earlier, ratios[0], ratios[-1], study.ratio_max, study.against
        )
        if study.against in least:
            ratio = now / least[study.against]
            show_row(f"  / {study.against}", least[study.against], now, ratio, ratio, ratio,
                     study.ratio_max)  # fmt: skip
    for version in versions:
        version.close()


if __name__ == "__main__":
    main()
