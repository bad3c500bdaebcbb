"""Compare the results of this version with those of an earlier one.

    python benchmarks/frozen_answers.py write FILE.npz     # with the version that is installed
    python benchmarks/frozen_answers.py compare FILE.npz   # what differs from it, and by how much

Points are drawn from every shipped study of a grid without draws and from random instruments whose
echoes lie near DC and Nyquist, under effects on the record. The tolerance is 1e-9, so that two
versions agree up to rounding wherever both are right. Effects whose laws have changed since are
left out. Only `sweep.load`, `run` and `open` are used, so that the script runs with any version.
`--points` sets the number of points of each study; names of studies restrict the comparison to
these. `make frozen` writes and compares.
"""

import argparse
import contextlib
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_helpers import experiment_mapping, load_mapping

import sweep

EXPERIMENTS = Path(sweep.__file__).parents[1] / "experiments"
"""Folder of the experiments of the installed version; specs name laws as their version does."""
TOLERANCE = 1e-9
SEED = 2029
REDEFINED_VARIABLES = ("effects", "effects_error", "pfa_shot", "log10_pfa_shot", "beamlets_error")
"""Variables whose meaning has changed: there are more effects, the false alarms are those of all
segments of a shot, and the error of a stated number of beamlets was 0 and is nan (not checked)."""
DIFFERENCE_ALLOWED = 1e-6
"""Largest difference of a point that does not count as a difference."""
CHANGED_EFFECTS = ("doppler_spread", "segment_motion", "lag", "fading", "overlap")
"""Effects that are new or whose laws have changed, and which are left out."""
WINDOWS = ("rectangular", "hann", "hamming", "blackman", "kaiser(8)")
BINS_FROM_END_MAX = 40.0
"""Largest distance of random echoes from DC or Nyquist [bins]."""
SPEED_OF_LIGHT = 299792458.0


def sampled_mapping(
    mapping: dict[str, Any], points: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Return a study of `points` points of a grid, drawn with replacement, along one axis."""
    axes = mapping.get("axes", {})
    if not axes:
        return mapping
    spec = load_mapping(mapping)
    zip_pieces = [
        {
            member.path: value_text(member, int(index))
            for axis in spec.axes
            for index in [rng.integers(axis.size)]
            for member in (axis.parameters if hasattr(axis, "parameters") else axis.members)
        }
        for _ in range(points)
    ]
    return mapping | {"axes": {"sample": {"zip": zip_pieces}}}


def value_text(member: Any, index: int) -> str:
    """Return a value of an axis as a spec states it."""
    values = member.display_values if hasattr(member, "display_values") else member.display
    value = values[index]
    return str(value) if isinstance(value, str) else f"{float(value)!r} {member.units}".strip()


def iter_experiments(points: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and content of each experiment on a grid without draws, with fewer points."""
    for file in sorted(EXPERIMENTS.glob("*.yaml")):
        mapping = experiment_mapping(EXPERIMENTS, file.stem)
        if "draws" in mapping or "scene" in mapping:  # other random numbers and footprints since
            continue
        if "file" not in mapping["instrument"]:  # an instrument that the earlier version lacks
            continue
        mapping["accuracy"] = {"tolerance": TOLERANCE}
        mapping["effects"] = mapping.get("effects", {}) | changed_effects_off()
        mapping.pop("storage", None)
        yield file.stem, sampled_mapping(mapping, points, np.random.default_rng(SEED))


def iter_random_instruments(points: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield studies of random instruments with echoes near DC or Nyquist, by window and phases."""
    rng = np.random.default_rng(SEED)
    for window in WINDOWS:
        for phases, beamlets in (("coherent", 1), ("coherent", 37), ("incoherent", 37)):
            name = f"random_{window}_{phases}_{beamlets}"
            zip_pieces = [random_instrument(rng) for _ in range(points // (3 * len(WINDOWS)))]
            yield (
                name,
                {
                    "title": name,
                    "instrument": {
                        "file": str(EXPERIMENTS / "instruments" / "table_4_1.yaml"),
                        "processing": {
                            "window": window,
                            "fft_size": "2^12",
                            "sample_rate": "100 MHz",
                        },
                    },
                    "target": {"reflectance": 0.1},
                    "footprint": {"phases": phases, "beamlets": beamlets},
                    "accuracy": {"tolerance": TOLERANCE},
                    "effects": {"image": "on", "leakage": "on", "footprint": "on"}
                    | changed_effects_off(),
                    "axes": {"sample": {"zip": zip_pieces}},
                },
            )


def random_instrument(rng: np.random.Generator) -> dict[str, str]:
    """Return a random instrument and target, as values by path."""
    duration, bandwidth, wavelength = 2**12 / 100e6, rng.uniform(0.2e9, 1e9), 1.55e-6
    bins = rng.uniform(-BINS_FROM_END_MAX, BINS_FROM_END_MAX) + (2**11 if rng.random() < 0.5 else 0)
    velocity, beat_frequency = rng.uniform(2, 30), abs(bins) / duration
    target_range = (
        (beat_frequency + 2 * velocity / wavelength) * SPEED_OF_LIGHT * duration / (2 * bandwidth)
    )
    return {
        "instrument.chirp.bandwidth": f"{bandwidth!r} Hz",
        "instrument.chirp.duration": f"{duration!r} s",
        "instrument.laser.power": f"{10 ** rng.uniform(-3, 0)!r} W",
        "instrument.laser.line_width": f"{10 ** rng.uniform(1, 4)!r} Hz",
        "instrument.chirp.quadratic_error": f"{rng.uniform(-2e5, 2e5)!r} Hz",
        "instrument.processing.tnr": f"{rng.uniform(2, 10)!r}",
        "target.range": f"{target_range!r} m",
        "target.grazing_angle": f"{rng.uniform(30, 90)!r} deg",
        "target.radial_velocity": f"{velocity!r} m/s",
        "target.acceleration": f"{rng.uniform(-100, 100)!r} m/s^2",
    }


def changed_effects_off() -> dict[str, str]:
    """Return the mode ``off`` of each changed effect that the installed version has."""
    from sweep.model.effects.catalogue import EFFECT_NAMES

    return {name: "off" for name in CHANGED_EFFECTS if name in EFFECT_NAMES}


def study_answers(name: str, mapping: dict[str, Any]) -> dict[str, np.ndarray]:
    """Run a study and return the stored variables that mean the same in both versions."""
    with tempfile.TemporaryDirectory() as folder:
        store_path = Path(folder) / "frozen.zarr"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # effects are off, and random instruments fold
            outcome = sweep.run(
                load_mapping(mapping), store=str(store_path), scheduler="none", progress=False
            )
        if not outcome.complete:
            sys.exit(f"{name}: {outcome.stop_reason or outcome.failures}")
        return {
            f"{name}/{key}": values
            for key, variable in sweep.open(store_path).data_vars.items()
            if (values := variable.values).dtype.kind in "fiu" and key not in REDEFINED_VARIABLES
        }


def relative_differences(frozen: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Return differences, relative to values above 1; inf where only one value is nan."""
    with np.errstate(invalid="ignore"):
        difference = np.abs(current - frozen) / np.maximum(1.0, np.abs(frozen))
    difference = np.where(frozen == current, 0.0, difference)  # infinities
    nan_in_one = np.isnan(frozen) != np.isnan(current)
    return np.where(nan_in_one, np.inf, np.nan_to_num(difference, nan=0.0, posinf=np.inf))


def print_differences(frozen: dict[str, np.ndarray], current: dict[str, np.ndarray]) -> int:
    """Print the variables that differ by more than is allowed; return their number."""
    count = 0
    for key in sorted(frozen):
        if key not in current or frozen[key].shape != current[key].shape:
            print(f"{key}: {'is of another shape' if key in current else 'is gone'}")
            count += 1
            continue
        difference = relative_differences(
            frozen[key].astype(float), current[key].astype(float)
        ).ravel()
        if difference.size and difference.max() > DIFFERENCE_ALLOWED:
            n_beyond, worst_index = (
                int(np.count_nonzero(difference > DIFFERENCE_ALLOWED)),
                int(difference.argmax()),
            )
            old, new = frozen[key].ravel()[worst_index], current[key].ravel()[worst_index]
            print(
                f"{key}: {n_beyond} of {difference.size} beyond {DIFFERENCE_ALLOWED:g}, most "
                f"{difference.max():.1e} "
                f"at {worst_index}: {old:.9g} -> {new:.9g}"
            )
            count += 1
    return count


def main() -> int:
    """Write or compare results; return 1 if something differs, else 0."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("studies", nargs="*", help="names of studies, default all")
    parser.add_argument("--points", type=int, default=1000)
    arguments = parser.parse_args()
    answers_now: dict[str, np.ndarray] = {}
    for name, mapping in (
        *iter_experiments(arguments.points),
        *iter_random_instruments(2 * arguments.points),
    ):
        if arguments.studies and name not in arguments.studies:
            continue
        with contextlib.suppress(BrokenPipeError):
            print(f"{name} ...", file=sys.stderr, flush=True)
        answers_now |= study_answers(name, mapping)
    if arguments.what == "write":
        np.savez_compressed(arguments.file, **answers_now)
        print(
            f"{len(answers_now)} arrays, {sum(values.size for values in answers_now.values())} "
            "numbers"
        )
        return 0
    frozen = {
        key: values
        for key, values in np.load(arguments.file).items()
        if key.rpartition("/")[2] not in REDEFINED_VARIABLES
    }
    if arguments.studies:
        frozen = {key: v for key, v in frozen.items() if key.partition("/")[0] in arguments.studies}
    frozen_studies = {key.partition("/")[0] for key in frozen}
    for study in sorted(frozen_studies - {key.partition("/")[0] for key in answers_now}):
        print(f"{study}: not compared, as it is another study since")
        frozen = {key: v for key, v in frozen.items() if key.partition("/")[0] != study}
    n_differing = print_differences(frozen, answers_now)
    print(f"{len(frozen)} arrays held against {arguments.file.name}: {n_differing} differ")
    return int(n_differing > 0)


if __name__ == "__main__":
    sys.exit(main())
