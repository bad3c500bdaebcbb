"""Effects to be simulated in each tile: those that any of its points needs.

The change by leaving an effect out is estimated at each point, and is a tile's largest. The
smallest are left out as long as their sum is within the tolerance: a tighter one keeps all that a
looser one does.

With x = ln a, a and the threshold b over sigma, dQ_1/dx = a b I_1(a b) e^{-(a^2 + b^2)/2} is at
most sqrt(a b / (2 pi)) e^{-(a - b)^2 / 2}. This has one maximum, at a (a - b) = 1/2. It is taken
at its largest between the least and the largest a that all effects together may leave. An addition
to a magnitude counts by dQ_1/da <= 1/2 e^{-(a - b)^2 / 2}, noise that the threshold does not follow
by -dQ_1/d ln b <= b^2 e^{-(a - b)^2 / 2} / sqrt(1 + 2 a b), and

    |d log10 P^2| <= |d b^2| / ln 10

for the probability P^2 of a false alarm in a shot. If pd is 1 whatever happens bins still have
magnitudes: |X| counts by its change over itself, or over sigma where it is below that.

If segments report their strongest peak alone an echo has to exceed the largest noise too: b is
the level at which pd is steepest, of those between the threshold and that.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect, ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs

_LN_10 = math.log(10.0)
_CHANGE_MAX = 1e12
_BIN_MOVING_STAGES = ("lines", "record", "spectrum")
"""Stages of effects that move light from bins to others."""


class EffectPlan(NamedTuple):
    """Plan of the effects that are simulated in each tile."""

    effect_names: tuple[str, ...]
    """Effects in the order in which they act."""
    is_kept: np.ndarray
    """(effects, tiles) bool: whether it is simulated."""
    omission_error: np.ndarray
    """(effects, tiles): largest change that it may make, 0..1."""
    total_error: np.ndarray
    """(tiles,): sum of omissions' bounds, and :attr:`residual_error`; above the tolerance only by
    this, and by what is off."""
    residual_error: np.ndarray
    """(tiles,): change by what effects that are simulated leave out."""
    keeps_all_optional: np.ndarray
    """(tiles,) bool: whether nothing is left out that any mode leaves a choice about."""

    def select(self, tile_mask: np.ndarray) -> "EffectPlan":
        """Of some of the tiles, by a mask."""
        is_kept, omission_error = self.is_kept[:, tile_mask], self.omission_error[:, tile_mask]
        total_error, residual_error = self.total_error[tile_mask], self.residual_error[tile_mask]
        return EffectPlan(
            self.effect_names,
            is_kept,
            omission_error,
            total_error,
            residual_error,
            self.keeps_all_optional[tile_mask],
        )


def plan_effects(
    points: PlannerInputs,
    tile_max: Callable[[np.ndarray], np.ndarray],
    modes: Mapping[str, str] | None = None,
    tolerance: float = 0.0,
    effects: Sequence[Effect] = EFFECTS,
) -> EffectPlan:
    """Effects to be simulated in each tile of some points.

    ``tile_max`` gives the largest value in each tile, (tiles,), of values that broadcast over the
    points. ``modes`` are ``auto`` (by default), ``on`` or ``off`` by name. An effect that the scene
    has nothing of is left out, even if it is on. With one that is off go those that are within it;
    a ValueError where one of these is on. ``tolerance`` is on the sum of the changes by all that is
    left out, 0..1: of pd in the three segments together, of log10 of a false alarm's probability,
    of a relative magnitude.
    """
    effect_names = tuple(effect.name for effect in effects)
    forced_modes = _forced_modes(effects, modes or {})
    points.ignores_doppler = forced_modes.get("doppler") == "off"
    points.ignores_segment_motion = forced_modes.get("segment_motion") == "off"
    points.ignores_overlap = forced_modes.get("overlap") == "off"
    with np.errstate(all="ignore"):  # of what exceeds all numbers nothing is known: it is kept
        bounds = error_bounds(points, effects)
        moves_light = None
        if forced_modes.get("leakage") == "on" and "leakage" in bounds:
            moves_light = {effect.name: effect.stage in _BIN_MOVING_STAGES for effect in effects}
        errors_by_effect = {
            name: tile_max(omission_error)
            for name, omission_error in omission_errors(bounds, points, moves_light).items()
        }
        residuals_by_effect = {
            name: tile_max(omission_error)
            for name, omission_error in residual_errors(bounds, points).items()
        }
    is_present = np.array([name in errors_by_effect for name in effect_names])
    n_tiles = max((value.size for value in errors_by_effect.values()), default=1)
    omission_error = np.array(
        [errors_by_effect.get(name, np.zeros(n_tiles)) for name in effect_names]
    )
    is_kept = _select_effects(omission_error, is_present, effects, forced_modes, tolerance)
    total_error, residual_error = (
        np.where(is_kept, 0.0, omission_error).sum(axis=0),
        np.zeros(n_tiles),
    )
    for name, value in residuals_by_effect.items():
        residual_error = residual_error + np.where(is_kept[effect_names.index(name)], value, 0.0)
    is_optional = is_present & np.array([name not in forced_modes for name in effect_names])
    return EffectPlan(
        effect_names,
        is_kept,
        omission_error,
        total_error + residual_error,
        residual_error,
        is_kept[is_optional].all(axis=0),
    )


def error_bounds(
    points: PlannerInputs, effects: Sequence[Effect] = EFFECTS
) -> dict[str, ErrorBound]:
    """Sizes of the effects that some points have, by name."""
    phase_bounds = (
        (effect.name, effect.phase_error_bound(points))
        for effect in effects
        if effect.phase_error_bound
    )
    points.phase_error_bounds = {
        name: phase_bound for name, phase_bound in phase_bounds if phase_bound is not None
    }
    bounds = ((effect.name, effect.error_bound(points)) for effect in effects)
    return {name: bound for name, bound in bounds if bound is not None}


def _forced_modes(effects: Sequence[Effect], modes: Mapping[str, str]) -> dict[str, str]:
    """Effects that are on or off whatever their sizes, and what these take with them."""
    forced_modes = {name: mode for name, mode in modes.items() if mode != "auto"}
    for name, parent in _child_parent_pairs(effects):
        if forced_modes.get(parent) == "off":
            if forced_modes.get(name) == "on":
                raise ValueError(f"{name} cannot be on within {parent}, which is off")
            forced_modes[name] = "off"
    for name, parent in reversed(_child_parent_pairs(effects)):
        if forced_modes.get(name) == "on":
            forced_modes[parent] = "on"
    return forced_modes


def _child_parent_pairs(effects: Sequence[Effect]) -> list[tuple[str, str]]:
    """Effects that are part of others, and these, which stand before them in the list."""
    effect_names = {effect.name for effect in effects}
    return [(effect.name, effect.parent) for effect in effects if effect.parent in effect_names]


def _select_effects(
    omission_error: np.ndarray,
    is_present: np.ndarray,
    effects: Sequence[Effect],
    forced_modes: Mapping[str, str],
    tolerance: float,
) -> np.ndarray:
    """Choose the effects to keep, (effects, tiles) bool, of those that the scene has, `is_present`.

    The smallest are left out first, as long as their sum is within what the tolerance leaves; an
    effect never before those within it, last ones first where they are alike. Those that cost
    nothing, as a number added to the noise does, are never left out.
    """
    row_by_name = {effect.name: row for row, effect in enumerate(effects)}
    forced_mode = np.array([forced_modes.get(name, "") for name in row_by_name])
    is_free = np.array([effect.stage == "noise" for effect in effects])
    tolerance_left = np.maximum(tolerance - omission_error[forced_mode == "off"].sum(axis=0), 0.0)
    is_optional = is_present & (forced_mode == "")
    sort_key = omission_error.copy()
    for name, parent_name in reversed(_child_parent_pairs(effects)):
        child_row, parent_row = row_by_name[name], row_by_name[parent_name]
        if is_optional[child_row]:
            sort_key[parent_row] = np.maximum(sort_key[parent_row], sort_key[child_row])
    reversed_rows = np.flatnonzero(is_optional)[::-1]
    order = reversed_rows[np.argsort(sort_key[reversed_rows], axis=0, kind="stable")]
    cost = np.where(is_free[:, None], 0.0, omission_error)
    cumulative_cost = np.cumsum(np.take_along_axis(cost, order, axis=0), axis=0)
    is_kept = np.zeros(omission_error.shape, np.bool_)
    np.put_along_axis(is_kept, order, ~(cumulative_cost <= tolerance_left), axis=0)
    is_kept[is_optional & is_free] = True
    is_kept[forced_mode == "on"] = is_present[forced_mode == "on", None]
    for row, effect in enumerate(effects):
        for required_name in effect.required_effects:
            if required_name in row_by_name and forced_modes.get(required_name) != "off":
                is_kept[row_by_name[required_name]] |= (
                    is_kept[row] & is_present[row_by_name[required_name]]
                )
    return is_kept


def omission_errors(
    bounds: Mapping[str, ErrorBound],
    points: PlannerInputs,
    moves_light: Mapping[str, bool] | None = None,
) -> dict[str, np.ndarray]:
    """Change of pd, log10 pfa or |X| by each effect, whichever is most, 0..1, over the points.

    Of pd it is the sum of the changes in all segments, which bounds that of their product. If
    leakage is asked for, `moves_light` tells of each effect whether it moves light from bins to
    others.
    Bins that leak are then taken to be off by as many sigmas as the largest; that counts up to the
    leakage's own size.
    """
    signal_ratio_min, signal_ratio_max = signal_ratio_bounds(bounds, points)
    threshold = points.threshold_ratio
    if points.noise_peak_ratio is not None:  # which an echo has to exceed as well
        threshold = np.maximum(threshold, np.minimum(signal_ratio_max, points.noise_peak_ratio))
    b = points.looks.equivalent_threshold_ratio(threshold)
    steepest_signal = 0.5 * (b + np.sqrt(b * b + 2))
    signal = np.minimum(np.maximum(steepest_signal, signal_ratio_min), signal_ratio_max)
    near_threshold = np.exp(-0.5 * (signal - b) ** 2)
    b = points.looks.amplitude_gain_max * threshold
    slope, relative_weight = (
        np.sqrt(signal * b / (2 * math.pi)) * near_threshold,
        np.minimum(signal_ratio_max, 1.0),
    )
    errors_by_effect = {}
    for name, bound in bounds.items():
        pd_change, other_change = 0.0, np.maximum(bound.shift_bins, bound.log10_pfa_change)
        if _is_nonzero(bound.magnitude_change):
            relative_change = np.minimum(bound.magnitude_change, _CHANGE_MAX)
            pd_change, other_change = (
                pd_change + relative_change * slope,
                np.maximum(other_change, relative_change * relative_weight),
            )
        if _is_nonzero(bound.coherent_sum_change):
            added_signal = bound.coherent_sum_change * signal_ratio_max
            pd_change = pd_change + 0.5 * near_threshold * added_signal
            other_change = np.maximum(
                other_change, added_signal / np.maximum(signal_ratio_min, 1.0)
            )
        if _is_nonzero(bound.noise_variance_change):
            noise_change = np.abs(bound.noise_variance_change)
            pd_change = pd_change + 0.5 * noise_change * slope
            other_change = np.maximum(other_change, 0.5 * noise_change * relative_weight)
            if not bound.threshold_follows_noise:
                pd_change = pd_change + 0.5 * noise_change * b * b * near_threshold / np.sqrt(
                    1 + 2 * signal * b
                )
                other_change = np.maximum(other_change, b * b * noise_change / _LN_10)
        if moves_light and moves_light[name]:
            leaking_bin_change = (
                np.minimum(bound.magnitude_change, _CHANGE_MAX) + bound.coherent_sum_change
            ) * signal_ratio_max + bound.leaking_bin_change_sigma
            other_change = np.maximum(
                other_change, np.minimum(leaking_bin_change, bounds["leakage"].probability_change)
            )
        change = np.maximum(
            _sum_over_segments(pd_change, points), _max_over_segments(other_change, points)
        )
        errors_by_effect[name] = np.fmin(np.maximum(change, bound.probability_change), 1.0)
    return errors_by_effect


def residual_errors(
    bounds: Mapping[str, ErrorBound], points: PlannerInputs
) -> dict[str, np.ndarray]:
    """Bound the change of pd or |X| that each effect leaves where it is simulated."""
    residuals = {
        name: bound.residual_magnitude_change
        for name, bound in bounds.items()
        if _is_nonzero(bound.residual_magnitude_change)
    }
    if not residuals:
        return {}
    signal_ratio_min, signal_ratio_max = signal_ratio_bounds(bounds, points)
    b = points.looks.equivalent_threshold_ratio(points.threshold_ratio)
    signal = np.minimum(
        np.maximum(0.5 * (b + np.sqrt(b * b + 2)), signal_ratio_min), signal_ratio_max
    )
    slope = np.sqrt(
        signal * points.looks.amplitude_gain_max * points.threshold_ratio / (2 * math.pi)
    )
    near_threshold = np.exp(-0.5 * (signal - b) ** 2)
    errors_by_effect = {}
    for name, relative_change in residuals.items():
        # of itself, and of the magnitude that all lines make together in a whole record
        coherent_change = (
            bounds[name].residual_coherent_sum_change
            * points.line_signal_ratio
            * points.looks.amplitude_gain_max
        )
        pd_change = np.minimum(relative_change * slope, 0.5 * coherent_change) * near_threshold
        magnitude_change = np.minimum(
            relative_change * np.minimum(signal_ratio_max, 1.0),
            coherent_change / np.maximum(signal_ratio_min, 1.0),
        )
        errors_by_effect[name] = np.minimum(
            np.maximum(
                _sum_over_segments(pd_change, points), _max_over_segments(magnitude_change, points)
            ),
            1.0,
        )
    return errors_by_effect


def signal_ratio_bounds(
    bounds: Mapping[str, ErrorBound], points: PlannerInputs
) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest magnitude of the largest bin over sigma that all effects may leave."""
    signal_ratio_min = signal_ratio_max = points.peak_ratio * points.looks.amplitude_gain_max
    coherent_change: np.ndarray | float = 0.0
    for bound in bounds.values():
        if _is_nonzero(bound.magnitude_change):
            relative_change = np.minimum(bound.magnitude_change, _CHANGE_MAX)
            signal_ratio_min, signal_ratio_max = (
                signal_ratio_min * np.maximum(1 - relative_change, 0.0),
                signal_ratio_max * (1 + relative_change),
            )
        if _is_nonzero(bound.noise_variance_change):
            noise_factor = np.sqrt(1 + np.maximum(bound.noise_variance_change, -1 + 1e-9))
            signal_ratio_min, signal_ratio_max = (
                signal_ratio_min / np.maximum(noise_factor, 1.0),
                signal_ratio_max / np.minimum(noise_factor, 1.0),
            )
        coherent_change = coherent_change + bound.coherent_sum_change
    signal_ratio_max = np.minimum(signal_ratio_max, _CHANGE_MAX)
    return np.maximum(
        signal_ratio_min - signal_ratio_max * coherent_change, 0.0
    ), signal_ratio_max * (1 + coherent_change)


def _is_nonzero(value: np.ndarray | float) -> bool:
    return isinstance(value, np.ndarray) or value != 0.0


def _sum_over_segments(value: np.ndarray | float, points: PlannerInputs) -> np.ndarray | float:
    """Over the segments."""
    if np.ndim(value) <= points.ndim:
        return value * (len(points.existing_chirp_rates) if np.ndim(value) else 1)
    return np.asarray(value).sum(axis=0)


def _max_over_segments(value: np.ndarray | float, points: PlannerInputs) -> np.ndarray | float:
    """In any segment."""
    return np.asarray(value).max(axis=0) if np.ndim(value) > points.ndim else value
