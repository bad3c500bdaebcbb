"""Compare points that are drawn until a tolerance is met with exact means over all draws.

A footprint of one beamlet has one speckle amplitude |g|. It multiplies all bins of a shot and is
Rice distributed. The pd of a segment is therefore Q_1(m / s, b / s). Here m is the steady signal
over sigma, and s^2 = 1 + P/2 with the mean power P of the diffuse signal. Both chirps of a shot
have the same g, so that pd_shot is the mean of Q_1(|g| a_up, b) Q_1(|g| a_down, b), a single
integral. No draws are needed for it.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import thread_time
from typing import NamedTuple

import numpy as np
from benchmark_helpers import markdown_table
from scipy import stats

from sweep.model.detection.marcum import marcum_q1
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.speckle import coherent_echo_fraction
from sweep.model.evaluation import evaluate_segments, prepare_shots
from sweep.model.outputs import PD_OUTPUT_NAMES
from sweep.spec import GridSpec, load
from sweep.storage.accuracy_setting_kinds import ADAPTIVE_KIND
from sweep.tasks.accuracy.settings import AccuracySetting
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.parameter_grid import ParameterBlockGrid

SEEDS_BY_TOLERANCE = {0.1: 11, 0.01: 11, 0.001: 2}
"""Number of seeds with which all points are drawn, by tolerance."""
N_QUADRATURE_NODES, QUADRATURE_REACH_SIGMA = 400, 10.0
"""Number of nodes of the integral over |g|, and its limits in standard deviations."""
DRAW_UNTIL_MET = {"draws.number": 0, "draws.limit": 10**7}
ALLOWED_SIGMAS = 5.0

SECTION_HEAD = """
## Points that are drawn

{name}: all of its {points} points, drawn until the tolerance is met, {seeds}, each with another
seed. They are compared with the exact means over endless draws. For segments this is a closed form,
for the shot an integral (on segments it is within {off:.0e} of the closed form). The promise is
that pd is `within` the tolerance, and within its own half-width, with {confidence:.0%} confidence.

The test counts the points where pd varies and is further than the tolerance from 0 and 1. Nearer to
0 and 1 intervals are surer than promised ([draws.md](draws.md)). The columns named after
probabilities have the share of these points that is within its half-width, and how many standard
deviations of such a share it is from {confidence:.0%}. It may be {sigmas:g} below. Intervals are
surer where what so many draws may have missed decides, and not the variance.
"""
COLUMNS = (
    "tolerance", "points", "within", "draws decide", "within of these", *PD_OUTPUT_NAMES,
    "draws", "us",
)  # fmt: skip


class DrawnResults(NamedTuple):
    """Results of a study's points at a tolerance; n counts all points with each seed."""

    tolerance: float
    error: np.ndarray
    """Differences |pd - exact| (4, n), in the order of `PD_OUTPUT_NAMES`."""
    half_width: np.ndarray
    is_decided_by_draws: np.ndarray
    """Mask (4, n) of values that depend on draws: pd varies, and is not close to 0 or 1."""
    draws: np.ndarray
    seconds_per_point: float
    """Processor time per point [s]."""


def exact_means(spec: GridSpec) -> tuple[np.ndarray, float]:
    """Return the exact means of pd (4, points), and the error of their integral.

    The order is that of `PD_OUTPUT_NAMES`.

    Raises
    ------
    ValueError
        If the study draws anything but one speckle amplitude per footprint.
    """
    grid = ParameterBlockGrid(spec)
    parameters = grid.parameters_at(np.arange(grid.n_points))
    certain_effects = [effect.name for effect in EFFECTS if not effect.is_random]
    means, integral_error = np.full((4, grid.n_points), np.nan), 0.0
    for index, shots in prepare_shots(parameters, certain_effects):
        if shots.footprint.n_beamlets != 1 or np.any(shots.laser_line.pedestal_variance_under_line):
            raise ValueError("only of one beamlet, without a pedestal, the mean is known")
        signal = evaluate_segments(shots).magnitude / shots.line_noise_sigma
        level = shots.threshold / shots.line_noise_sigma
        kappa = np.broadcast_to(
            coherent_echo_fraction(
                roughness=parameters["target.roughness"],
                wavelength=parameters["instrument.laser.wavelength"],
            ),
            (grid.n_points,),
        )[index]
        # Noise and diffuse light of the bin are one complex normal number.
        total_deviation = np.sqrt(1 + (1 - kappa) * signal**2 / 2)
        closed_form = marcum_q1(
            np.sqrt(kappa) * signal / total_deviation, level / total_deviation
        ).q
        for i in range(index.size):
            amplitude_factor, weight = rice_quadrature(float(kappa[i]))
            pd_by_node = marcum_q1(amplitude_factor * signal[:, i, None], level[i]).q
            integral_error = max(
                integral_error, float(abs(pd_by_node @ weight - closed_form[:, i]).max())
            )
            pd_shot = float((pd_by_node[0] * pd_by_node[2]) @ weight)
            values = dict(zip(("pd_up", "pd_doppler", "pd_down"), closed_form[:, i], strict=True))
            means[:, index[i]] = [(values | {"pd_shot": pd_shot})[name] for name in PD_OUTPUT_NAMES]
    return means, integral_error


def rice_quadrature(kappa: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes |g| and weights of the mean over speckle of coherent power fraction `kappa`."""
    if kappa == 1:
        return np.ones(1), np.ones(1)
    sigma = np.sqrt((1 - kappa) / 2)
    mean_amplitude = np.sqrt(kappa)
    lower, upper = (
        max(mean_amplitude - QUADRATURE_REACH_SIGMA * sigma, 0.0),
        mean_amplitude + QUADRATURE_REACH_SIGMA * sigma,
    )
    legendre_nodes, legendre_weights = np.polynomial.legendre.leggauss(N_QUADRATURE_NODES)
    nodes = lower + (upper - lower) * (legendre_nodes + 1) / 2
    density = stats.rice.pdf(nodes, mean_amplitude / sigma, scale=sigma)
    return nodes, density * legendre_weights * (upper - lower) / 2


def draw_at_tolerances(path: Path, spec: GridSpec) -> tuple[list[DrawnResults], float]:
    """Draw a study at each tolerance; return the results, and the error of the exact integral."""
    means, integral_error = exact_means(spec)
    rows = []
    for tolerance, seeds in SEEDS_BY_TOLERANCE.items():
        runs = [(path, tolerance, int(spec.seed) + i) for i in range(seeds)]
        with ProcessPoolExecutor(min(os.cpu_count() or 1, seeds)) as pool:
            run_results = list(pool.map(_draw_with_seed, runs))
        pd, half_width, error, draws = (
            np.concatenate([result[field] for result in run_results], axis=-1) for field in range(4)
        )
        exact_pd = np.tile(means, seeds)
        is_decided_by_draws = (np.abs(exact_pd - 0.5) < 0.5 - tolerance) & (error > 1e-9)
        seconds = sum(f[4] for f in run_results) / seeds / means.shape[1]
        rows.append(
            DrawnResults(
                tolerance, np.abs(pd - exact_pd), half_width, is_decided_by_draws, draws, seconds
            )
        )
    return rows, integral_error


def _draw_with_seed(
    run: tuple[Path, float, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Draw all points with a seed; return pd, half-widths, standard errors, draws and time [s]."""
    path, tolerance, seed = run
    overrides = DRAW_UNTIL_MET | {"accuracy.tolerance": tolerance, "seed": seed}
    study = GridStudy(
        AccuracySetting(name="", kind=ADAPTIVE_KIND, overrides=overrides).apply_to(load(path))
    )
    study.compile_kernels()
    names = [
        f"{name}{suffix}" for suffix in ("", "_half_width", "_error") for name in PD_OUTPUT_NAMES
    ]
    values = np.empty((len(names) + 1, *study.grid.shape))
    start = thread_time()
    for block in range(study.grid.n_blocks):
        results = study.evaluate(block)
        for target, name in zip(values, [*names, "n_draws"], strict=True):
            target[study.grid.block_slices(block)] = results[name]
    cpu_seconds = thread_time() - start
    pd, half_width, error = values[:-1].reshape(3, len(PD_OUTPUT_NAMES), -1)
    return pd, half_width, error, values[-1].ravel(), cpu_seconds


def missed_tolerances(name: str, rows: Sequence[DrawnResults], confidence: float) -> Iterator[str]:
    """Yield a line of text for each tolerance that is not kept."""
    for row in rows:
        within = (row.error <= row.tolerance).all(axis=0).mean()
        if within < confidence:
            yield f"- {name} at {row.tolerance:g}: {within:.1%} of the points are within it"
        for quantity, sigmas in zip(PD_OUTPUT_NAMES, coverage(row, confidence)[1], strict=True):
            if sigmas < -ALLOWED_SIGMAS:
                yield f"- {name} at {row.tolerance:g}: {quantity} covered {sigmas:+.1f} sigma off"


def coverage(row: DrawnResults, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares of drawn points within their half-width (4,).

    Also return their differences from the confidence, in standard deviations (4,).
    """
    number = row.is_decided_by_draws.sum(axis=1)
    share = ((row.error <= row.half_width) & row.is_decided_by_draws).sum(axis=1) / number
    return share, (share - confidence) / np.sqrt(confidence * (1 - confidence) / number)


def table_rows(rows: Sequence[DrawnResults], confidence: float) -> Iterator[list[str]]:
    """Yield the rows of the table."""
    for row in rows:
        shares, sigmas = coverage(row, confidence)
        within = (row.error <= row.tolerance).all(axis=0)
        coverage_cells = [
            f"{share:.1%} ({sigma:+.1f})" for share, sigma in zip(shares, sigmas, strict=True)
        ]
        any_decided = row.is_decided_by_draws.any(axis=0)
        yield [
            f"{row.tolerance:g}",
            f"{within.size:,}",
            f"{within.mean():.2%}",
            f"{any_decided.sum():,}",
            f"{within[any_decided].mean():.2%}",
            *coverage_cells,
            f"{row.draws.mean():,.0f}",
            f"{1e6 * row.seconds_per_point:,.0f}",
        ]


def study_section(
    name: str, rows: Sequence[DrawnResults], integral_error: float, spec: GridSpec
) -> str:
    """Return a study's section of the page."""
    points = rows[0].error.shape[1] // SEEDS_BY_TOLERANCE[rows[0].tolerance]
    seeds = ", ".join(
        f"{number} times at {tolerance:g}" for tolerance, number in SEEDS_BY_TOLERANCE.items()
    )
    confidence = float(spec.accuracy.confidence)
    head = SECTION_HEAD.format(
        name=name.capitalize(),
        points=points,
        seeds=seeds,
        nodes=N_QUADRATURE_NODES,
        off=integral_error,
        confidence=confidence,
        sigmas=ALLOWED_SIGMAS,
    )
    return head.strip() + "\n\n" + markdown_table(COLUMNS, table_rows(rows, confidence))
