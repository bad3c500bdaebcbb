"""Random instruments near DC and Nyquist whose lines are smeared over the record, each its own.

Drawn anew each time, under range walk, acceleration, a sweep that is not straight, line width and
jitter of the beam; held at each tolerance against all effects on at the tightest. What is kept is
what each point calls for by itself: no neighbour lends it an effect.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from shared import TABLE_4_1, loaded, table

from sweep.model.effects.catalogue import EFFECTS, flags_of, names_of
from sweep.model.effects.planning import plan
from sweep.model.effects.points import Points
from sweep.model.resolution import effects_tolerance
from sweep.model.shot import DEFAULTS
from sweep.tasks.grid_study import evaluate_points, select
from sweep.tasks.study import Grid

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
WINDOWS = ("rectangular", "hann", "hamming", "blackman", "kaiser(8)")
FOOTPRINTS = (("coherent", 1), ("incoherent", 1), ("coherent", 37), ("incoherent", 37))
TIGHTEST = 1e-9
NEAR, DRAWS = 40.0, 4
"""Bins from DC or Nyquist within which lines lie at the most; draws of what jitters."""
SAMPLE_RATE, LIGHT = 100e6, 299792458.0
KEPT = 0.999
"""Share of the points that shall keep a tolerance."""
WHAT = ("pd", "magnitude", "leakage")
SEEN = (
    "pd_up", "pd_doppler", "pd_down", "pd_shot", "snr_up", "snr_doppler", "snr_down",
    "p_leakage_up", "p_leakage_down",
)  # fmt: skip


class Off(NamedTuple):
    """Errors of points at a tolerance, (n,) each."""

    pd: np.ndarray
    """Of a segment or a shot."""
    magnitude: np.ndarray
    """|X| of the largest bins, relative to itself or to sigma; and so the root of snr."""
    leakage: np.ndarray
    """Of either chirp, where it is asked for; else nan."""
    told: np.ndarray
    """Bound on what effects that are left out may change."""


def studies(number: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Specs of about so many points together, by window, footprint, and what is asked for."""
    kinds = [
        (window, *footprint, asked)
        for window in WINDOWS
        for footprint in FOOTPRINTS
        for asked in ("nothing", "leakage", "jitter")
        if asked != "jitter" or footprint[1] == 1
    ]
    sizes = {window: f"2^{rng.integers(10, 15)}" for window in WINDOWS}
    for window, phases, beamlets, asked in kinds:
        size = 2 ** int(sizes[window].removeprefix("2^"))
        points = [_point(rng, asked, size) for _ in range(-(-number // len(kinds)))]
        yield {
            "title": f"{window} {phases} {beamlets} {asked}",
            "instrument": {
                "file": str(TABLE_4_1),
                "processing": {"window": window, "fft_size": sizes[window],
                               "sample_rate": f"{SAMPLE_RATE!r} Hz"},
            },
            "target": {"reflectance": 0.1},
            "footprint": {"phases": phases, "beamlets": beamlets},
            "effects": {"leakage": "on"} if asked == "leakage" else {},
            "axes": {"sample": {"zip": points}},
            **({"draws": {"number": DRAWS}, "seed": int(rng.integers(1 << 30))}
               if asked == "jitter" else {}),
        }  # fmt: skip


def _point(rng: np.random.Generator, asked: str, fft_size: int) -> dict[str, str]:
    """An instrument and a target; sizes of effects over many decades, some of them 0.

    Echoes arrive before the record, within it, or rarely after it.
    """

    def some(low: float, high: float) -> float:
        """Log-uniform between two powers of ten, of either sign, or 0."""
        return float(rng.choice([-1, 0, 1], p=(0.4, 0.2, 0.4)) * 10 ** rng.uniform(low, high))

    duration = 2**14 / SAMPLE_RATE * rng.uniform(1.0, 1.5)
    bandwidth, wavelength = 10 ** rng.uniform(8, 9.3), 1.55e-6
    slope, sign = bandwidth / duration, rng.choice([1, -1])
    velocity = some(-2, 1.5)
    edge = SAMPLE_RATE / 2 * rng.integers(0, 2)
    beat = abs(edge + rng.uniform(-1, 1) * NEAR * SAMPLE_RATE / 2**13)
    distance = (beat + sign * 2 * velocity / wavelength) * LIGHT / (2 * slope)
    distance = max(abs(float(distance)), 2.0)
    delay, record = 2 * distance / LIGHT, fft_size / SAMPLE_RATE
    late = record * rng.choice([0.0, 10 ** rng.uniform(-5, 0), rng.uniform(0, 1)])
    start = float(np.clip(delay - late, 0.0, duration - record))
    found = {
        "instrument.processing.acquisition_delay": f"{start!r} s",
        "instrument.chirp.bandwidth": f"{bandwidth!r} Hz",
        "instrument.chirp.duration": f"{duration!r} s",
        "instrument.laser.power": f"{10 ** rng.uniform(-4.5, 0)!r} W",
        "instrument.laser.line_width": f"{abs(some(0, 4.5))!r} Hz",
        "instrument.chirp.quadratic_error": f"{some(-6, 1) / delay!r} Hz",
        "instrument.chirp.cubic_error": f"{some(-6, 1) / delay!r} Hz",
        "instrument.chirp.sinusoidal_error": f"{some(-6, 0.5) / delay!r} Hz",
        "instrument.chirp.error_periods": f"{10 ** rng.uniform(-0.5, 1)!r}",
        "instrument.processing.tnr": f"{rng.uniform(2, 10)!r}",
        "target.range": f"{distance!r} m",
        "target.grazing_angle": f"{rng.uniform(30, 90)!r} deg",
        "target.radial_velocity": f"{velocity!r} m/s",
        "target.acceleration": f"{some(-1, 3)!r} m/s^2",
    }
    if asked == "jitter":
        found["target.pointing_jitter"] = f"{10 ** rng.uniform(-3, 2)!r} urad"
    return found


def off(written: dict[str, Any], tolerances: tuple[float, ...] = TOLERANCES) -> list[Off]:
    """Errors of a study's points at each tolerance."""
    spec = loaded(written)
    grid = Grid(spec)
    parameters = DEFAULTS | grid.parameters_at(np.arange(grid.points))
    points = Points(parameters)

    def each(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (grid.points,))

    def found(tolerance: float, flags: np.ndarray) -> dict[str, np.ndarray]:
        own = parameters | {"accuracy.tolerance": tolerance}
        out: dict[str, np.ndarray] = {}
        for flag in np.unique(flags):
            index = np.flatnonzero(flags == flag)
            part = evaluate_points(spec, select(own, index), index.size, names_of(int(flag)))
            for name in set(part) & set(SEEN):
                out.setdefault(name, np.empty(grid.points))[index] = part[name]
        return out

    number = int(parameters["footprint.beamlets"])
    every = np.array([not effect.is_random or spec.draws.any for effect in EFFECTS])
    absent = [effect.absent(parameters) | np.zeros(grid.points, bool) for effect in EFFECTS]
    there = ~np.array(absent)
    exact = found(TIGHTEST, flags_of(every[:, None] & there))
    rows = []
    for tolerance in tolerances:
        most = effects_tolerance(parameters | {"accuracy.tolerance": tolerance}, number)
        made = plan(points, each, spec.modes(), most)
        own = found(tolerance, flags_of(made.kept & there))
        told = made.error - made.left
        rows.append(_apart(own, exact, told, "leakage" in written["effects"]))
    return rows


def _apart(own: dict[str, Any], exact: dict[str, Any], told: np.ndarray, leaks: bool) -> Off:
    pd = [
        abs(own[f"pd_{name}"] - exact[f"pd_{name}"]) for name in ("up", "doppler", "down", "shot")
    ]
    apart = []
    for name in ("up", "doppler", "down"):
        # over sigma: snr is |X|^2 over 2 sigma^2
        one, other = (np.sqrt(2 * found[f"snr_{name}"]) for found in (own, exact))
        apart.append(abs(one - other) / np.maximum(other, 1.0))
    leaked = [abs(own[f"p_leakage_{name}"] - exact[f"p_leakage_{name}"]) for name in ("up", "down")]
    leakage = np.fmax.reduce(leaked) if leaks else np.full(told.shape, np.nan)
    return Off(np.fmax.reduce(pd), np.fmax.reduce(apart), leakage, told)


SECTION = """
## Instruments drawn at random

The test draws {number:,} new instruments each time. Their lines lie within {near:g} bins of DC or
Nyquist. Range walk, acceleration, a nonlinear sweep, line width and jitter smear them, each over
many decades. Every point is planned by itself. A cell has the share of the points within the
tolerance, and the worst error. The errors are those of pd, of |X| (and so of the root of `snr_*`)
over itself or sigma, and of leakage if the spec requests it.
"""


def section(number: int, rng: np.random.Generator) -> tuple[list[str], str]:
    """Tolerances that are not kept, in words; and the part of the page."""
    found = [off(written) for written in studies(number, rng)]
    missed, rows = [], []
    for k, tolerance in enumerate(TOLERANCES):
        together = Off(*map(np.concatenate, zip(*(each[k] for each in found), strict=True)))
        cells = []
        for what, errors in zip(WHAT, together, strict=False):
            there = errors[np.isfinite(errors)]
            share = float((there <= tolerance).mean())
            cells.append(f"{100 * share:.2f} %, {there.max():.1e}")
            if share < KEPT:
                missed.append(f"- random instruments at {tolerance:g}: {what} of {1 - share:.2%}")
        rows.append([f"{tolerance:g}", f"{together.pd.size:,}", *cells])
    head = SECTION.strip().format(number=number, near=NEAR)
    return missed, head + "\n\n" + table(["tolerance", "points", *WHAT], rows)
