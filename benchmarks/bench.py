"""One table in one run: the fast path against the truth, its rate, and what the engine adds.

Run with `make bench`. Times are this machine's and drift; quote the ratios.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import sweep
from sweep.model import shot, truth
from sweep.model.eyepoints import observe, prepare_eyepoints
from sweep.model.segments import spectrum as segment_spectrum
from sweep.model.shot import prepare
from sweep.spec import SceneSpec, Spec
from sweep.spec.reading import read_document

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
REPEATS = 3


def best(function, *arguments) -> float:
    """Shortest wall time [s] of a few calls, after one that may compile."""
    function(*arguments)
    times = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        function(*arguments)
        times.append(time.perf_counter() - begun)
    return min(times)


def study() -> Spec:
    """The published range-angle study at four powers: a minute on two cores."""
    mapping = read_document(EXPERIMENTS / "range_angle.yaml").value
    mapping["axes"]["instrument.laser.power"] = ["1 W", "2 W", "3 W", "5 W"]
    return Spec.from_mapping(mapping, base=EXPERIMENTS)


def against_truth(table: Table, parameters: dict) -> None:
    """Time and error of the fast path beside the time-domain record, shot by shot."""
    for range_, grazing in ((200.0, 85.0), (2000.0, 45.0), (5000.0, 15.0), (10000.0, 2.0)):
        point = parameters | {"target.range": range_, "target.grazing_angle": np.radians(grazing)}
        ((_, shots),) = prepare(point)
        begun = time.perf_counter()
        exact = [truth.spectrum(shots, 0, s, range_walk=False) for s in range(3)]
        slow = time.perf_counter() - begun
        error = max(
            np.abs(segment_spectrum(shots, 0, s)[1] - exact[s]).max() / exact[s].max()
            for s in range(3)
        )
        many = point | {"target.range": np.full(2000, range_)}
        fast = best(shot.evaluate, many) / 2000
        table.add_row(
            f"truth / fast, one shot at {range_:.0f} m, {grazing:.0f} deg",
            f"{slow / fast:,.0f} x",
            f"{slow:.2f} s against {fast * 1e6:.1f} us; |X| within {error:.0e} of the peak",
        )


def rate(table: Table, parameters: dict) -> None:
    """Points a second of one core, over the grid of the published study."""
    generator = np.random.default_rng(1)
    points = parameters | {
        "target.range": generator.integers(1, 10_001, 20_000).astype(float),
        "target.grazing_angle": np.radians(generator.integers(1, 91, 20_000).astype(float)),
    }
    seconds = best(shot.evaluate, points)
    table.add_row(
        "points a second, one core",
        f"{20_000 / seconds:,.0f}",
        f"{seconds / 20_000 * 1e6:.1f} us a point of three segments and 109 beamlets",
    )


def descent() -> SceneSpec:
    """Four beams from 2000 m down to 10 m over 100,352 triangles; 10,000 shots."""
    mapping = read_document(EXPERIMENTS / "square_high_descent.yaml").value
    path = {"from": ["0 m", "0 m", "2000 m"], "to": ["0 m", "0 m", "10 m"]}
    speeds = {"initial_speed": "38 m/s", "final_speed": "1.8 m/s"}
    ground = {
        "kind": "relief", "size": "3 km", "spacing": "13.393 m", "hurst": 0.8,
        "rms_slope": 0.1, "baseline": "13 m", "seed": 5, "reflectance": 0.1,
    }  # fmt: skip
    mapping |= {
        "scene": {"origin": "ground", "objects": {"ground": ground}},
        "platform": {"path": {"kind": "straight"} | path | speeds},
        "scanners": {"four": {"kind": "corners", "angle": "22.5 deg", "rate": "25 Hz"}},
        "footprint": {"beamlets": 19},
        "axes": {},
        "figures": [],
    }
    return SceneSpec.from_mapping(mapping, base=EXPERIMENTS)


def scenes(table: Table) -> None:
    """Beams a second of one core."""
    spec = descent()
    world, flight, scan = spec.world(), spec.flight(), spec.scan("four")
    (mesh,), parameters = world.caster.meshes, spec.parameters()
    index = np.arange(spec.cycles("four") * spec.shots_a_cycle("four"))
    divergence = float(parameters["instrument.laser.beam_divergence"])
    number = int(parameters["footprint.beamlets"])

    def look():
        return observe(
            index, flight=flight, scanner=scan, caster=world.caster, bodies=world.bodies,
            beam_divergence=divergence, number=number, pattern=spec.pattern,
        )  # fmt: skip

    seen = look()
    assert seen.seen.all()

    def detect():
        return shot.statistics(prepare_eyepoints(seen, parameters, world.surfaces))

    casting, detecting = best(look), best(detect)
    table.add_row(
        f"eyepoints, {len(mesh.faces):,} triangles, {number} beamlets",
        f"{casting / index.size * 1e6:.2f} us a beam",
        "one core",
    )
    table.add_row(
        "eyepoints to pd, three segments",
        f"{index.size / (casting + detecting):,.0f} beams a second",
        "one core",
    )


def engine(table: Table, console: Console) -> None:
    """Share of the wall time that is not kernel, for a study of a minute on all cores."""
    spec = study()
    with tempfile.TemporaryDirectory() as directory:
        begun = time.perf_counter()
        outcome = sweep.run(spec, store=Path(directory) / "bench.zarr")
        wall = time.perf_counter() - begun
    workers = workers_started()
    kernel = (outcome.work_seconds - outcome.write_seconds) / workers
    table.add_row(
        f"wall time that is not kernel, {outcome.points:,} points, {workers} workers",
        f"{1 - kernel / wall:.1%}",
        f"{wall:.1f} s in all; kernels {kernel:.1f} s, "
        f"writing {outcome.write_seconds / workers:.1f} s a worker; start-up is in it",
    )
    table.add_row(
        "points a second, all cores, stored",
        f"{outcome.points / wall:,.0f}",
        "from the call to the finished store",
    )
    console.print(f"{outcome.points_done:,} points stored")


def workers_started() -> int:
    """Workers that `sweep.run` starts: one a core."""
    from sweep.tasks.cluster import cores

    return cores()


def main() -> None:
    """Measure and print."""
    console = Console(width=130)
    table = Table("what", "figure", "how")
    parameters = sweep.load(EXPERIMENTS / "range_angle.yaml").parameters()
    against_truth(table, parameters)
    rate(table, parameters)
    scenes(table)
    engine(table, console)
    console.print(table)


if __name__ == "__main__":
    main()
