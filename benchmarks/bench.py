"""One table in one run: the fast path against the truth, its rate, and what the engine adds.

Run with `make bench`. Times are this machine's and drift; quote the ratios.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from shared import EXPERIMENTS, experiment, show

import sweep
from sweep.model import shot, truth
from sweep.model.eyepoints import observe, prepare_eyepoints
from sweep.model.segments import spectrum as segment_spectrum
from sweep.tasks.cluster import cores

REPEATS = 3
Row = tuple[str, str, str]


def best(function, *arguments) -> float:
    """Shortest wall time [s] of a few calls, after one that may compile."""
    function(*arguments)
    times = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        function(*arguments)
        times.append(time.perf_counter() - begun)
    return min(times)


def against_truth(parameters: dict) -> Iterator[Row]:
    """Time and error of the fast path beside the time-domain record, shot by shot."""
    for range_, grazing in ((200.0, 85.0), (2000.0, 45.0), (5000.0, 15.0), (10000.0, 2.0)):
        point = parameters | {"target.range": range_, "target.grazing_angle": np.radians(grazing)}
        ((_, shots),) = shot.prepare(point)
        begun = time.perf_counter()
        exact = [truth.spectrum(shots, 0, s, range_walk=False) for s in range(3)]
        slow = time.perf_counter() - begun
        error = max(
            np.abs(segment_spectrum(shots, 0, s)[1] - exact[s]).max() / exact[s].max()
            for s in range(3)
        )
        fast = best(shot.evaluate, point | {"target.range": np.full(2000, range_)}) / 2000
        yield (
            f"truth / fast, one shot at {range_:.0f} m, {grazing:.0f} deg",
            f"{slow / fast:,.0f} x",
            f"{slow:.2f} s against {fast * 1e6:.1f} us; |X| within {error:.0e} of the peak",
        )


def rate(parameters: dict) -> Iterator[Row]:
    """Points a second of one core, over the grid of the published study."""
    generator = np.random.default_rng(1)
    seconds = best(shot.evaluate, parameters | {
        "target.range": generator.integers(1, 10_001, 20_000).astype(float),
        "target.grazing_angle": np.radians(generator.integers(1, 91, 20_000).astype(float)),
    })  # fmt: skip
    yield (
        "points a second, one core",
        f"{20_000 / seconds:,.0f}",
        f"{seconds / 20_000 * 1e6:.1f} us a point of three segments and 109 beamlets",
    )


def scenes() -> Iterator[Row]:
    """Beams a second of one core: four from 2000 m down to 10 m over 100,352 triangles."""
    ground = {
        "kind": "relief", "size": "3 km", "spacing": "13.393 m", "hurst": 0.8,
        "rms_slope": 0.1, "baseline": "13 m", "seed": 5, "reflectance": 0.1,
    }  # fmt: skip
    path = {"kind": "straight", "from": ["0 m", "0 m", "2000 m"], "to": ["0 m", "0 m", "10 m"],
            "initial_speed": "38 m/s", "final_speed": "1.8 m/s"}  # fmt: skip
    spec = experiment(
        "square_high_descent",
        scene={"origin": "ground", "objects": {"ground": ground}},
        platform={"path": path},
        scanners={"four": {"kind": "corners", "angle": "22.5 deg", "rate": "25 Hz"}},
        footprint={"beamlets": 19},
        axes={},
    )
    world, parameters = spec.world(), spec.parameters()
    index = np.arange(spec.cycles("four") * spec.shots_a_cycle("four"))
    number = int(parameters["footprint.beamlets"])

    def look():
        return observe(
            index, flight=spec.flight(), scanner=spec.scan("four"), caster=world.caster,
            bodies=world.bodies, number=number, pattern=spec.pattern,
            beam_divergence=float(parameters["instrument.laser.beam_divergence"]),
        )  # fmt: skip

    seen = look()
    assert seen.seen.all()
    casting = best(look)
    detecting = best(
        lambda: shot.statistics(prepare_eyepoints(seen, parameters, world.surfaces))
    )  # fmt: skip
    (mesh,) = world.caster.meshes
    yield (
        f"eyepoints, {len(mesh.faces):,} triangles, {number} beamlets",
        f"{casting / index.size * 1e6:.2f} us a beam",
        "one core",
    )
    yield (
        "eyepoints to pd, three segments",
        f"{index.size / (casting + detecting):,.0f} beams a second",
        "one core",
    )


def engine() -> Iterator[Row]:
    """Share of the wall time that is not kernel, for a study of a minute on all cores."""
    spec = experiment("range_angle")
    axes = spec.to_yaml_mapping()["axes"] | {"instrument.laser.power": ["1 W", "2 W", "3 W", "5 W"]}
    spec, workers = experiment("range_angle", axes=axes), cores()
    with tempfile.TemporaryDirectory() as directory:
        begun = time.perf_counter()
        outcome = sweep.run(spec, store=Path(directory) / "bench.zarr")
        wall = time.perf_counter() - begun
    kernel = (outcome.work_seconds - outcome.write_seconds) / workers
    yield (
        f"wall time that is not kernel, {outcome.points:,} points, {workers} workers",
        f"{1 - kernel / wall:.1%}",
        f"{wall:.1f} s in all; kernels {kernel:.1f} s, "
        f"writing {outcome.write_seconds / workers:.1f} s a worker; start-up is in it",
    )
    yield (
        "points a second, all cores, stored",
        f"{outcome.points / wall:,.0f}",
        "from the call to the finished store",
    )


if __name__ == "__main__":
    table_4_1 = sweep.load(EXPERIMENTS / "range_angle.yaml").parameters()
    rows = [*against_truth(table_4_1), *rate(table_4_1), *scenes(), *engine()]
    show(["what", "figure", "how"], rows)
