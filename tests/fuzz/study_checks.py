"""What must hold of every study, however odd: sane numbers, or a refusal in words."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.model.beamlet_counts import BEAMLETS_PATH, beamlets_converge
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.outputs import (
    DRAW_COUNT_OUTPUTS,
    GRID_OUTPUTS,
    NAN_WITHOUT_ECHO_OUTPUTS,
    NO_FREE_BIN_NOTE,
    STANDARD_ERROR_OUTPUTS,
    STRONGEST_PEAK_OUTPUTS,
)
from sweep.model.preparation import split_by_category
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import SEARCH_BAND_PATHS
from sweep.spec import GridSpec, Mistake, SpecError, from_stored, load
from sweep.tasks.engine.blocks import Results
from sweep.tasks.studies import study_plan as planning
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import unsupported_reason
from sweep.tasks.studies.study_plan import effects_table

PROBABILITY_ROUNDING = 1e-9
"""What sums of probabilities may be off: 1e-12 seen, and no effect is as small."""

PROBABILITY_PREFIXES = ("pd_", "miss_", "pfa_", "p_leakage_", "p_wrong_range_")
FINITE_OUTPUTS = tuple(name for name in GRID_OUTPUTS if not name.endswith("_doppler"))
OUTPUTS_WITHOUT_BINS = tuple(
    name for name, output in GRID_OUTPUTS.items() if output.comment == NO_FREE_BIN_NOTE
)


class Verdict(NamedTuple):
    """What has come of a study: why it was refused; empty where it was computed."""

    refusals: tuple[str, ...] = ()


@contextmanager
def warnings_as_errors() -> Iterator[None]:
    """Context in which every warning is an error, whoever gives it."""
    with warnings.catch_warnings(), np.errstate(divide="warn", over="warn", invalid="warn"):
        warnings.simplefilter("error")
        yield


def check_study(file: Path) -> Verdict:
    """A spec of a flat target read from its file, planned, evaluated in a plain loop, looked at.

    Raises
    ------
    AssertionError
        For numbers that can not be.
    Exception
        Whatever else goes wrong: a spec is computed, or refused by a `SpecError`.
    """
    with warnings_as_errors():
        try:
            spec = load(file)
        except SpecError as error:
            for mistake in error.mistakes:
                check_mistake(mistake)
            return Verdict(
                tuple(f"{mistake_kind(each_mistake)}" for each_mistake in error.mistakes)
            )
        assert isinstance(spec, GridSpec)
        assert from_stored(spec.to_json()).id == spec.id, "a stored spec is another"
        try:
            study_plan = planning.plan_study(spec)
            study = GridStudy(spec)
            effects_table(study, costs=False)
            for block in range(study.n_blocks):
                results = study.evaluate(block)
                if (unsupported_points := np.flatnonzero(np.isnan(results["pd_shot"]))).size:
                    raise UnsupportedShotError(
                        unsupported_reason(study, block, unsupported_points[:1])
                    )
                check_results(spec, study, results, block)
        except UnsupportedShotError as error:
            assert "instrument." in str(error) and ": " in str(error)
            return Verdict((str(error)[:50],))
        assert study_plan.n_points == study.n_points > 0 and study_plan.wall_seconds > 0
    return Verdict()


def mistake_kind(mistake: Mistake) -> str:
    """A mistake without its numbers."""
    words = [
        word
        for word in mistake.problem.split()
        if not any(character.isdigit() for character in word)
    ]
    return f"{mistake.path.split('[')[0]}: {' '.join(words)[:60]}"


def check_mistake(mistake: Mistake) -> None:
    """A mistake names its field, the rule, and what to do: said by the rule itself or beside it."""
    assert mistake.path or mistake.file, "a mistake without a place"
    assert mistake.problem.strip(), "a mistake without a rule"
    says_what_to_do = mistake.problem.startswith(("must ", "needs ", "takes ", "can not be made: "))
    assert says_what_to_do or mistake.suggestion, f"no remedy: {mistake}"


def check_results(spec: GridSpec, study: GridStudy, results: Results, block: int) -> None:
    """Results of a block: all there, of the right shape, and numbers that can be."""
    extent = study.grid.actual_block_shape(block)
    assert set(results) == set(study.chunk_positions_of_block(block)), (
        "outputs are missing, or too many"
    )
    parameters = study.grid.parameters_of_block(block)
    no_doppler = np.asarray(parameters["instrument.receiver.architecture"]) == "direct"
    no_doppler = no_doppler | (np.char.find(parameters["instrument.chirp.segments"], "doppler") < 0)
    no_doppler = np.broadcast_to(no_doppler, (study.grid.count_block_points(block),)).reshape(
        extent
    )
    for name, values in results.items():
        assert values.shape[: len(extent)] == extent, f"{name} has the shape {values.shape}"
        if name.startswith(PROBABILITY_PREFIXES):
            _check_probability(name, values)
        if name == "beamlets_error":
            _check_beamlets_error(parameters, values)
        elif name in FINITE_OUTPUTS:
            present_values = values[values != -np.inf] if name in OUTPUTS_WITHOUT_BINS else values
            if name in NAN_WITHOUT_ECHO_OUTPUTS:  # told by all segments together
                snr = np.stack([results[f"snr_{segment}"] for segment in ("up", "doppler", "down")])
                present_values = values[np.where(np.isnan(snr), 1.0, snr).min(axis=0) > 0]
            if (
                name in NAN_WITHOUT_ECHO_OUTPUTS and SEARCH_BAND_PATHS[0] in parameters
            ):  # nothing is told of echoes outside
                present_values = present_values[~np.isnan(present_values)]
            assert np.isfinite(present_values).all(), f"{name} is not finite"
        elif name in GRID_OUTPUTS:
            assert np.array_equal(np.isnan(values), no_doppler), f"{name} is nan for no reason"
    if spec.draws.draws_whole_spectra:
        _check_whole_spectra(results)
    else:
        _check_signal_and_noise(results, '"any_two"' in spec.to_json())
    if spec.draws.number:
        _check_draws(spec, results, no_doppler)


def _check_probability(name: str, values: np.ndarray) -> None:
    present_values = values[~np.isnan(values)]
    assert ((present_values >= 0) & (present_values <= 1)).all(), (
        f"{name} is no probability: {present_values}"
    )


def _check_beamlets_error(parameters: Mapping[str, Any], values: np.ndarray) -> None:
    """Estimated where the tolerance sets the number of beamlets and their powers add, else nan."""
    for index, category in split_by_category(PARAMETER_DEFAULTS | dict(parameters)):
        errors = values.ravel()[index]
        if int(category[BEAMLETS_PATH]) > 0:
            assert np.isnan(errors).all(), "the error of a given number of beamlets is not checked"
        elif beamlets_converge(category):
            assert ((errors >= 0) & (errors <= 1)).all(), f"beamlets_error is {errors}"
        else:  # a lone beamlet, where no footprint is simulated, has no error
            assert (np.isnan(errors) | (errors == 0)).all(), f"beamlets_error is {errors}"


def _check_signal_and_noise(results: Results, any_two: bool) -> None:
    """What every point keeps, with draws or without."""
    for segment in ("up", "down", "doppler", "shot"):
        total = results[f"pd_{segment}"] + results[f"miss_{segment}"]
        assert not (np.abs(total - 1) > PROBABILITY_ROUNDING).any(), segment
    pd_bound = np.minimum(results["pd_up"], results["pd_down"])
    if any_two:  # of three segments half the sum is the most; nan without a Doppler segment
        pd_bound = np.fmax(
            pd_bound, (results["pd_up"] + results["pd_down"] + results["pd_doppler"]) / 2
        )
    assert (results["pd_shot"] <= pd_bound + PROBABILITY_ROUNDING).all(), (
        "a shot is likelier than its segments"
    )
    for name in STRONGEST_PEAK_OUTPUTS.keys() & results.keys():
        total = results[name] + results[name.replace("p_wrong_range", "pd")]
        assert not (total > 1 + PROBABILITY_ROUNDING).any(), (
            f"{name} and what is right are more than all"
        )
    assert (results["noise_variance"] > 0).all(), "no noise"
    for name in ("snr_up", "snr_down", "snr_doppler"):
        assert not (results[name] < 0).any(), name
    for name in ("bin", "segment", "shot"):
        pfa, log10 = results[f"pfa_{name}"], results[f"log10_pfa_{name}"]
        assert (log10 <= 0).all(), f"log10_pfa_{name}"
        # A logarithm of 1e4 keeps 12 digits: those of the probability are its last four.
        likely = log10 > -300
        is_close = np.isclose(np.log10(pfa[likely]), log10[likely], rtol=1e-9, atol=1e-9)
        assert is_close.all() and (pfa[~likely] < 1e-299).all(), f"log10_pfa_{name}"


def _check_whole_spectra(results: Results) -> None:
    """What every point keeps that is looked at by a detector and an estimator."""
    assert (results["pd_shot"] <= np.minimum(results["pd_up"], results["pd_down"])).all()
    assert (results["noise_variance"] > 0).all() and (results["false_alarms"] >= 0).all()
    for name in ("range", "radial_velocity"):
        bias, rmse = np.abs(results[f"{name}_bias"]), results[f"{name}_rmse"]
        assert not (bias > rmse * (1 + PROBABILITY_ROUNDING)).any(), f"{name}: more bias than error"
        assert (np.isnan(bias) == np.isnan(rmse)).all(), name
        bound = results[f"{name}_bound"]  # of any two segments nan where no draw is detected
        assert ((bound >= 0) | (np.isnan(bound) & np.isnan(bias))).all(), name


def _check_draws(spec: GridSpec, results: Results, no_doppler: np.ndarray) -> None:
    """Counts of draws between none and all, and errors of means of none or several draws."""
    (batches,) = (
        array.known_values
        for array in GridStudy(spec).array_layouts()
        if array.name == "batch_draws"
    )
    for name in DRAW_COUNT_OUTPUTS:
        assert (results[name] <= batches).all(), f"{name} has more than all"
        if name != "n_detected_doppler":
            assert (results[name] >= 0).all(), name
    for event, joint in (("detected", "shot"), ("false_alarm", "both_chirps")):
        chirp_bound = np.minimum(results[f"n_{event}_up"], results[f"n_{event}_down"])
        assert (results[f"n_{event}_{joint}"] <= chirp_bound).all(), f"n_{event}_{joint}"
    for name in STANDARD_ERROR_OUTPUTS if not spec.draws.draws_whole_spectra else ():
        nan = np.isnan(results[name])
        assert (results[name][~nan] >= 0).all(), name
        may_be_nan = (no_doppler & ("doppler" in name)) | (spec.draws.number == 1)
        assert not (nan & ~may_be_nan).any(), f"{name} is nan for no reason"
