"""Thousands of random specs, valid and spoilt: `make fuzz`, or `make fuzz SEED=7`.

Every failure is saved, made as small as it goes, with the spec that makes it:
`python tests/fuzz/campaign.py --replay results/fuzz/FILE.yaml` runs one again.
"""

from __future__ import annotations

import argparse
import re
import resource
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hypothesis
import yaml
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from judging import Verdict, judge
from judging_commands import judge_command
from judging_flights import judge_flight
from random_flights import flights, write_files
from random_studies import studies
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from smaller import shrunk, swiftly
from spoilt_specs import Spoilt, dumped, spoilt

FOLDER = Path("results/fuzz")
SLOWEST, KINDS = 5, 25
MOST_MEMORY = 8 << 30
"""Address space of a campaign [bytes]."""


@dataclass
class Tally:
    """What a campaign has come to."""

    number: int = 0
    done: int = 0
    refused: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    failures: dict[str, list[Any]] = field(default_factory=dict)
    times: list[tuple[float, str]] = field(default_factory=list)

    def slow(self, seconds: float, text: str) -> None:
        """Note how long a spec took, if it is among the slowest."""
        self.times = sorted([*self.times, (seconds, text)], reverse=True)[:SLOWEST]


def signature(error: BaseException) -> str:
    """A failure by its kind, its words without numbers, and the line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/sweep/" in f.filename or "/fuzz/judging" in f.filename]
    words = re.sub(r"\S*\d\S*", "#", str(error).splitlines()[0] if str(error) else "")
    at = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "nowhere"
    return f"{type(error).__name__} at {at}: {words[:80]}"


def campaign(
    specs: st.SearchStrategy[Any],
    look: Callable[[Any], Verdict],
    text_of: Callable[[Any], str],
    *,
    number: int,
    seed: int,
    name: str,
) -> Tally:
    """So many random specs looked at, their failures counted and none raised."""
    tally = Tally()
    columns = TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, TextColumn("{task.fields[failed]} failures")) as bar:
        task = bar.add_task(name, total=number, failed=0)

        @hypothesis.seed(seed)
        @settings(
            max_examples=number,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
            database=None,
            deadline=None,
        )
        @hypothesis.given(specs)
        def run(spec: Any) -> None:
            begun = time.perf_counter()
            tally.number += 1
            try:
                verdict = look(spec)
                tally.refused += bool(verdict.refusals)
                tally.done += not verdict.refusals
                tally.kinds.update(set(verdict.refusals))
            except Exception as error:
                kind = signature(error)
                known = tally.failures.setdefault(kind, [0, spec, traceback.format_exc()])
                known[0] += 1
                if len(text_of(spec)) < len(text_of(known[1])):
                    known[1:] = [spec, traceback.format_exc()]
            tally.slow(time.perf_counter() - begun, text_of(spec))
            bar.update(task, advance=1, failed=len(tally.failures))

        run()
    return tally


def report(name: str, tally: Tally, folder: Path) -> None:
    """Print a summary, and write failures and the slowest to the folder."""
    print(
        f"{name}: {tally.number:,} specs, {tally.done:,} computed, {tally.refused:,} refused, "
        f"{sum(known[0] for known in tally.failures.values()):,} failed"
    )
    for kind, count in tally.kinds.most_common(KINDS):
        print(f"  {count:6,}  {kind}")
    for i, (_, text) in enumerate(tally.times):
        (folder / f"{name}_slow_{i}.yaml").write_text(text, encoding="utf-8", errors="replace")
    slowest = ", ".join(f"{seconds:.1f}" for seconds, _ in tally.times)
    print(f"  slowest: {slowest} s ({folder}/{name}_slow_*.yaml)")
    for kind, (count, _, _) in tally.failures.items():
        print(f"  FAILED {count} times: {kind}")


def looked_at(folder: Path, written: dict[str, Any]) -> Verdict:
    """A valid spec, of whichever kind, looked at."""
    file = folder / "now.yaml"
    file.write_text(dumped(written), encoding="utf-8")
    return (judge_flight if "scene" in written else judge)(file)


def save(name: str, tally: Tally, folder: Path) -> None:
    """Write each kind of failure to a file that can be replayed, shrunk if it was a valid spec."""
    for i, (kind, (_, spec, trace)) in enumerate(tally.failures.items()):
        text = spec.text if isinstance(spec, Spoilt) else ""
        if not isinstance(spec, Spoilt):

            def fails_alike(written: dict[str, Any], kind: str = kind) -> bool:
                try:
                    looked_at(folder, written)
                except Exception as error:
                    return signature(error) == kind
                return False

            text = dumped(shrunk(spec, fails_alike))
        file = folder / f"{name}_{i}.yaml"
        file.write_text(text, encoding="utf-8", errors="replace")
        file.with_suffix(".txt").write_text(f"{spec}\n\n{kind}\n\n{trace}", errors="replace")
        print(f"  {file}: {kind}")


def replay(file: Path) -> None:
    """Look at a saved spec again; what it raises is raised."""
    write_files(file.parent)
    text = file.read_text()
    try:
        written = yaml.safe_load(text)
    except yaml.YAMLError:
        written = None
    if file.name.startswith("valid") and isinstance(written, dict):
        print(looked_at(file.parent, written))
    else:
        print(judge_command(file.parent / "now.yaml", Spoilt(text, "replayed")))


def main() -> None:
    """Both campaigns, or one spec again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=10_000, help="specs of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=["valid", "invalid"])
    parser.add_argument("--replay", type=Path)
    asked = parser.parse_args()
    # A spec that asks for more memory than this has failed, and takes no machine down with it.
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    with swiftly():
        if asked.replay:
            return replay(asked.replay)
        FOLDER.mkdir(parents=True, exist_ok=True)
        write_files(FOLDER)
        valid = st.one_of(studies(), studies(), flights(FOLDER))
        tallies: dict[str, Tally] = {}
        common = {"number": asked.number, "seed": asked.seed}
        if asked.only != "invalid":
            tallies["valid"] = campaign(
                valid, lambda spec: looked_at(FOLDER, spec), dumped, name="valid", **common
            )
        if asked.only != "valid":
            tallies["invalid"] = campaign(
                spoilt(valid), lambda spec: judge_command(FOLDER / "spoilt.yaml", spec),
                lambda spec: spec.text, name="invalid", **common,
            )  # fmt: skip
        for name, tally in tallies.items():
            report(name, tally, FOLDER)
            save(name, tally, FOLDER)
    sys.exit(any(tally.failures for tally in tallies.values()))


if __name__ == "__main__":
    main()
