"""Time a point, side by side with an earlier commit: both check-outs take turns in one run.

    python benchmarks/side_by_side.py                        # all studies, some ten minutes
    python benchmarks/side_by_side.py published rough_ground --rounds 9

`make side-by-side` does all of it. Each version runs in a process of its own, with its own compiled
kernels and experiments, through `sweep.load` and `sweep.run(scheduler="none")` alone. A study is
run whole and as a small part of itself; the processor's time for a point is the difference of the
two over the points that the small one lacks, so that what a run costs once (reading, ground, the
store) does not count. The versions change places each round, and the ratio is the median over
rounds. Times drift with the machine; ratios hardly do.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from shared import ROOT, plain

EARLIER = "9b29f45"
FOLDER = ROOT / "results" / "side_by_side"
FLIGHT = 1.3
"""Ratio that flights may come to."""


class Study(NamedTuple):
    """An experiment, what is put onto it for the whole and for its small part, and the aim."""

    experiment: str
    aim: float
    whole: dict[str, Any]
    part: dict[str, Any]


def flight(experiment: str, scanner: str, rate: float, **more: Any) -> Study:
    """A flight measured at this rate [Hz], and at a tenth of it."""
    path = f"scanners.{scanner}.rate"
    return Study(experiment, FLIGHT, more | {path: f"{rate} Hz"}, more | {path: f"{rate / 10} Hz"})


ROUGH = {"footprint.phases": "incoherent", "footprint.beamlets": "auto"}
RANGES = "axes.target.range"
FEW_DRAWS = {"draws.number": 10}
STUDIES = {
    "published": Study(
        "range_angle", 1.25, {}, {RANGES: {"step": ["1 m", "1 km", "1 m"]}}
    ),
    "rough_ground": Study(
        "range_angle",
        1.0,
        ROUGH | {RANGES: {"step": ["1 m", "10 km", "5 m"]}},
        ROUGH | {RANGES: {"step": ["1 m", "1 km", "5 m"]}},
    ),
    "speckled_target": Study(
        "speckled_target", 1.0, {}, {RANGES: {"step": ["1 km", "12 km", "2 km"]}}
    ),
    "morpheus_three_beam": flight("morpheus_three_beam", "three", 500),
    "oblique_descent": flight("oblique_descent", "corners", 200),
    "square_high_descent": flight("square_high_descent", "corners", 200),
    "square_low_descent": flight("square_low_descent", "corners", 200),
    "expanded_pattern": flight("expanded_pattern", "squares", 200),
    "forest_scan": flight("forest_scan", "sweep", 650),
    "scan_pattern_comparison": flight("scan_pattern_comparison", "three", 200, **FEW_DRAWS),
}  # fmt: skip


def written(checkout: Path, study: Study, overrides: dict[str, Any]) -> dict[str, Any]:
    """The experiment of a check-out as plain data, with overrides."""
    spec = plain(checkout / "experiments", study.experiment)
    for path, value in overrides.items():
        section, _, rest = path.partition(".")
        sections, name = (
            ([], rest) if section == "axes" else (rest.split(".")[:-1], rest.rpartition(".")[2])
        )
        inner = spec.setdefault(section, {})
        for each in sections:
            inner = inner[each]
        inner[name] = value
    return spec


def serve() -> None:
    """Run the spec files named on standard input; answer with processor time [s] and points."""
    import sweep

    for line in sys.stdin:
        spec = sweep.load(line.strip())
        with tempfile.TemporaryDirectory() as folder:
            begun = time.process_time()
            outcome = sweep.run(spec, store=f"{folder}/side.zarr", scheduler="none", progress=False)
            spent = time.process_time() - begun
        if not outcome.complete:
            sys.exit(f"{line.strip()}: {outcome.stopped or outcome.failures}")
        print(json.dumps([spent, outcome.points]), flush=True)


class Version:
    """A process that runs studies by the check-out in a folder."""

    def __init__(self, name: str, checkout: Path) -> None:
        self.name, self._checkout = name, checkout
        apart = {
            "PYTHONPATH": str(checkout),
            "NUMBA_CACHE_DIR": str(FOLDER / f"kernels_{name}"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | apart,
            cwd=FOLDER,
        )

    def run(self, spec: Path) -> tuple[float, int]:
        """Processor time [s] of a study, and its points."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(spec, file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            sys.exit(f"{self.name} has ended: see above")
        spent, points = json.loads(answer)
        return spent, points

    def a_point(self, study: Study, folder: Path) -> float:
        """Processor time of a point [s] that the whole study has and its part lacks."""
        spent = []
        for name, overrides in (("whole", study.whole), ("part", study.part)):
            file = folder / f"{name}_{self.name}.yaml"
            spec = written(self._checkout, study, overrides)
            file.write_text(yaml.safe_dump(spec, sort_keys=False))
            spent.append(self.run(file))
        (all_, points), (few, fewer) = spent
        return (all_ - few) / (points - fewer)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def check_out(commit: str) -> Path:
    """The tree of a commit, made once."""
    checkout = FOLDER / commit
    if not checkout.exists():
        subprocess.run(
            ["git", "worktree", "add", "--detach", str(checkout), commit], check=True, cwd=ROOT
        )
    return checkout


def measured(versions: list[Version], study: Study, rounds: int) -> list[list[float]]:
    """Times of a point [s], (rounds, versions), after a round that may compile."""
    with tempfile.TemporaryDirectory() as folder:
        times = []
        for count in range(rounds + 1):
            order = versions if count % 2 else versions[::-1]
            spent = {version.name: version.a_point(study, Path(folder)) for version in order}
            times.append([spent[version.name] for version in versions])
        return times[1:]


def main() -> None:
    """Print a row for each study as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("studies", nargs="*", help="names of studies, default all")
    parser.add_argument("--earlier", default=EARLIER, help="commit to stand beside this one")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        return serve()
    if unknown := set(asked.studies) - set(STUDIES):
        parser.error(f"no such study: {', '.join(sorted(unknown))}; there are {', '.join(STUDIES)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    versions = [Version(asked.earlier, check_out(asked.earlier)), Version("now", ROOT)]
    print(f"{'study':24}{asked.earlier + ' [us]':>14}{'now [us]':>14}{'ratio':>8}{'from':>8}"
          f"{'to':>8}{'aim':>8}")  # fmt: skip
    for name in asked.studies or STUDIES:
        study = STUDIES[name]
        times = measured(versions, study, asked.rounds)
        earlier, now = (1e6 * statistics.median(column) for column in zip(*times, strict=True))
        ratios = sorted(after / before for before, after in times)
        ratio = statistics.median(ratios)
        missed = "" if ratio <= study.aim else "  missed"
        print(f"{name:24}{earlier:14.3g}{now:14.3g}{ratio:8.2f}{ratios[0]:8.2f}{ratios[-1]:8.2f}"
              f"{study.aim:8.2f}{missed}", flush=True)  # fmt: skip
    for version in versions:
        version.close()


if __name__ == "__main__":
    main()
