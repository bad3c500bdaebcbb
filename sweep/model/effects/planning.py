"""Planning: choice of the effects that are simulated in each tile (a group of points).

A tile has the effects that any of its points needs.

The change if an effect is omitted is bounded at each point; a tile has the largest of its points.
The effects with the smallest changes are omitted, as long as the sum of their changes is within the
tolerance. A tighter tolerance keeps all effects that a looser one keeps.

A bin is detected with Marcum's Q_1(a, b), with the signal a and the threshold b over the noise per
quadrature sigma. Its derivative by x = ln a, dQ_1/dx = a b I_1(a b) e^{-(a^2 + b^2)/2}, is at most
sqrt(a b / (2 pi)) e^{-(a - b)^2 / 2}. This has one maximum, at a (a - b) = 1/2. It is
evaluated at its largest value between the smallest and the largest a that all effects together may
leave. An absolute change of a magnitude counts by dQ_1/da <= 1/2 e^{-(a - b)^2 / 2}. Noise that the
threshold does not follow counts by -dQ_1/d ln b <= b^2 e^{-(a - b)^2 / 2} / sqrt(1 + 2 a b), and

    |d log10 P^2| <= |d b^2| / ln 10

for the probability P^2 of a false alarm in a shot. If pd is 1 in any case, bins still have
magnitudes: |X| counts by its relative change, or by its change over sigma if it is below sigma.

If segments report only their strongest peak, an echo also has to exceed the largest noise. Then b
is the level at which pd is steepest, between the threshold and that noise.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs

_LN_10 = math.log(10.0)
_RELATIVE_CHANGE_MAX = 1e12
"""Value to which relative changes, and ratios of signal to noise, are limited to avoid overflow."""
_RELATIVE_LOSS_MAX = 1.0 - 1e-12
"""Value to which relative losses of magnitude are limited, so that log(1 - loss) stays finite."""
_LIGHT_MOVING_STAGES = ("lines", "record", "spectrum")
"""Stages whose effects move light from bin to bin of the spectrum."""


class EffectPlan(NamedTuple):
    """Effects that are simulated in each tile (group of points), and the error of the omissions."""

    effect_names: tuple[str, ...]
    """Names of the effects, in the order of their application."""
    is_kept: np.ndarray
    """(effects, tiles) bool: True if the effect is simulated."""
    omission_error: np.ndarray
    """(effects, tiles): error if the effect is omitted, 0..1. It is the largest change of pd, log10
    pfa or relative |X| at any point of the tile (:func:`omission_errors`)."""
    total_error: np.ndarray
    """(tiles,): sum of the changes due to omitted effects, plus :attr:`residual_error`. Only the
    residual error, and effects that are off, can make the sum exceed the tolerance."""
    residual_error: np.ndarray
    """(tiles,): error, 0..1, of pd or the relative |X| due to what simulated effects neglect."""
    keeps_all_optional_effects: np.ndarray
    """(tiles,) bool: True if every effect is kept that is not forced on or off."""

    def select(self, tile_mask: np.ndarray) -> "EffectPlan":
        """Return the plan of the tiles (groups of points) that a mask selects."""
        is_kept, omission_error = self.is_kept[:, tile_mask], self.omission_error[:, tile_mask]
        total_error, residual_error = self.total_error[tile_mask], self.residual_error[tile_mask]
        return EffectPlan(
            self.effect_names,
            is_kept,
            omission_error,
            total_error,
            residual_error,
            self.keeps_all_optional_effects[tile_mask],
        )


def plan_effects(
    points: PlannerInputs,
    tile_max: Callable[[np.ndarray], np.ndarray],
    modes: Mapping[str, str] | None = None,
    tolerance: float = 0.0,
    effects: Sequence[Effect] = EFFECTS,
) -> EffectPlan:
    """Choose the effects to simulate in each tile.

    Parameters
    ----------
    points : PlannerInputs
        Points of all tiles.
    tile_max : callable
        Function that returns the largest value in each tile, (tiles,), of values that broadcast
        over the points.
    modes : mapping, optional
        ``auto`` (default), ``on`` or ``off`` by name of the effect. An effect that is absent from
        the scene is omitted even if it is on. An effect that is off switches off the effects that
        are part of it.
    tolerance : float
        Tolerated sum of the changes due to all omitted effects, 0..1: of pd in the three segments
        together, of log10 of a probability of false alarm, or of a relative magnitude.
    effects : sequence of Effect
        Effects to choose from.

    Returns
    -------
    EffectPlan

    Raises
    ------
    ValueError
        If an effect is on that is part of one that is off.
    """
    effect_names = tuple(effect.name for effect in effects)
    forced_modes = _forced_modes(effects, modes or {})
    points.effects_off = {name for name, mode in forced_modes.items() if mode == "off"}
    with np.errstate(all="ignore"):  # an effect whose bound overflows is kept
        bounds = error_bounds(points, effects)
        moves_light = None
        if forced_modes.get("leakage") == "on" and "leakage" in bounds:
            moves_light = {effect.name: effect.stage in _LIGHT_MOVING_STAGES for effect in effects}
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
    """Return the error bounds of the effects that are present, by name.

    Bounds of phase errors come first, then those of noise, on which other bounds depend.

    Parameters
    ----------
    points : PlannerInputs
        Points of all tiles (:class:`sweep.model.effects.planner_inputs.PlannerInputs`). Their
        `phase_error_bounds` and `noise_bounds` are set here.
    effects : sequence of Effect
        Effects whose bounds are computed (:class:`sweep.model.effects.effect.Effect`).

    Returns
    -------
    dict of str to ErrorBound
        Bounds (:class:`sweep.model.effects.error_bounds.ErrorBound`). An effect is left out if it
        is absent, or if it is off and ``off`` is a rule of the scene.
    """
    points.phase_error_bounds = {
        effect.name: phase_bound
        for effect in effects
        if effect.phase_error_bound is not None
        and (phase_bound := effect.phase_error_bound(points)) is not None
    }
    noise_effects = [effect for effect in effects if effect.stage == "noise"]
    points.noise_bounds = {
        effect.name: bound
        for effect in noise_effects
        if (bound := effect.error_bound(points)) is not None
    }
    bounds = (
        (
            effect.name,
            points.noise_bounds.get(effect.name)
            if effect.stage == "noise"
            else effect.error_bound(points),
        )
        for effect in effects
        if not (effect.defines_scene_if_off and effect.name in points.effects_off)
    )
    return {name: bound for name, bound in bounds if bound is not None}


def _forced_modes(effects: Sequence[Effect], modes: Mapping[str, str]) -> dict[str, str]:
    """Return ``on`` or ``off`` by name of each effect that is not planned by its error bound.

    The mode is stated in the spec for the effect, or follows from that of its parent or child. A
    child is an effect that is part of its parent. Effects that are planned have no entry.
    """
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
    """Return pairs (child, parent) of names of effects, in the order of ``effects``.

    A child is an effect that is part of its parent. A parent precedes its children.
    """
    effect_names = {effect.name for effect in effects}
    return [(effect.name, effect.parent) for effect in effects if effect.parent in effect_names]


def _select_effects(
    omission_error: np.ndarray,
    is_present: np.ndarray,
    effects: Sequence[Effect],
    forced_modes: Mapping[str, str],
    tolerance: float,
) -> np.ndarray:
    """Choose which of the present effects to keep, (effects, tiles) bool.

    The effects with the smallest changes are omitted first, as long as the sum is within the
    remaining tolerance. Children are omitted before their parents, and equal changes in reverse
    order of the catalogue. Effects without cost, such as a number added to the noise, are never
    omitted.
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
    """Compute the change of pd, log10 pfa or |X| if an effect is omitted, whichever is largest.

    Parameters
    ----------
    bounds : mapping
        Error bounds by name of the effect.
    points : PlannerInputs
        Points of all tiles.
    moves_light : mapping, optional
        True for effects that move light from bin to bin; given if leakage is simulated.

    Returns
    -------
    dict of str to ndarray
        Change 0..1 over the points, by name.

    Notes
    -----
    The change of pd is the sum over all segments, which is a bound on the change of the segments'
    product. If `moves_light` is given, bins with leaked signal change by as many sigmas as the
    largest bin. This change counts at most as much as the error if leakage is omitted.
    """
    signal_ratio_min, signal_ratio_max = signal_ratio_bounds(bounds, points)
    threshold = points.threshold_ratio
    if points.noise_maximum_over_sigma is not None:  # an echo has to exceed the noise as well
        threshold = np.maximum(
            threshold, np.minimum(signal_ratio_max, points.noise_maximum_over_sigma)
        )
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
        if _is_array_or_nonzero(bound.magnitude_change):
            relative_change = np.minimum(bound.magnitude_change, _RELATIVE_CHANGE_MAX)
            # The slope is that over ln |X|, which falls by -ln(1 - d) where |X| falls by d.
            log_change = np.maximum(
                relative_change, -np.log1p(-np.minimum(relative_change, _RELATIVE_LOSS_MAX))
            )
            pd_change, other_change = (
                pd_change + log_change * slope,
                np.maximum(other_change, relative_change * relative_weight),
            )
        if _is_array_or_nonzero(bound.coherent_sum_change):
            added_signal = bound.coherent_sum_change * signal_ratio_max
            pd_change = pd_change + 0.5 * near_threshold * added_signal
            other_change = np.maximum(
                other_change, added_signal / np.maximum(signal_ratio_min, 1.0)
            )
        if _is_array_or_nonzero(bound.noise_variance_change):
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
                np.minimum(bound.magnitude_change, _RELATIVE_CHANGE_MAX) + bound.coherent_sum_change
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
    """Return bounds on the error of pd or relative |X| that simulated effects leave, by name.

    pd is the probability of detection. Effects without such an error are left out.

    Parameters
    ----------
    bounds : mapping
        Error bounds by name of the effect (:class:`sweep.model.effects.error_bounds.ErrorBound`).
    points : PlannerInputs
        Points of all tiles (:class:`sweep.model.effects.planner_inputs.PlannerInputs`).

    Returns
    -------
    dict of str to ndarray
        Error over the points, 0..1, by name of the effect: the larger of those of pd and of |X|.

    Notes
    -----
    Let m be the residual error of |X| relative to |X|. Let r be that relative to the line on the
    beam's axis, if that line lay on a bin. With the signal a of that line and the threshold b, pd
    changes in a segment by at most

        min(m sqrt(x b / (2 pi)), r a / 2) e^{-(x - b)^2 / 2}

    at the signal x where pd is steepest, between the bounds of :func:`signal_ratio_bounds`. All
    signals are over the noise per quadrature. The changes of all segments are summed. The error of
    |X| is relative to |X|, or to sigma where |X| is smaller, and the largest of all segments
    counts. Several looks count as one record with a gain and a threshold of its own
    (:meth:`sweep.model.detection.looks.Looks.equivalent_threshold_ratio`).
    """
    residuals = {
        name: bound.residual_magnitude_change
        for name, bound in bounds.items()
        if _is_array_or_nonzero(bound.residual_magnitude_change)
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
        # Relative to the magnitude itself, and to that of all lines together in a full record.
        coherent_change = (
            bounds[name].residual_coherent_sum_change
            * points.line_magnitude_over_sigma
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
    """Return a lower and an upper bound of |X| in the largest bin over the noise per quadrature.

    The bounds hold whichever of the effects are simulated.

    Parameters
    ----------
    bounds : mapping
        Error bounds by name of the effect (:class:`sweep.model.effects.error_bounds.ErrorBound`).
    points : PlannerInputs
        Points of all tiles (:class:`sweep.model.effects.planner_inputs.PlannerInputs`).

    Returns
    -------
    ratio_min, ratio_max : ndarray (segments, ...)
        Bounds >= 0, by segment and point.

    Notes
    -----
    Effect i changes |X| by at most the fraction m_i of |X|, and by the fraction c_i of
    the sum of all amplitudes in phase. Effect i changes the noise variance by the fraction v_i. Let
    x be |X| over the noise per quadrature of the line on the beam's axis, times the gain of
    combining looks. With C = sum_i c_i,

        high = x prod_i (1 + m_i) / min(sqrt(1 + v_i), 1),  at most 1e12
        low = x prod_i max(1 - m_i, 0) / max(sqrt(1 + v_i), 1)
        ratio_max = high (1 + C)
        ratio_min = max(low - C high, 0)
    """
    signal_ratio_min = signal_ratio_max = (
        points.peak_magnitude_over_sigma * points.looks.amplitude_gain_max
    )
    coherent_change: np.ndarray | float = 0.0
    for bound in bounds.values():
        if _is_array_or_nonzero(bound.magnitude_change):
            relative_change = np.minimum(bound.magnitude_change, _RELATIVE_CHANGE_MAX)
            signal_ratio_min, signal_ratio_max = (
                signal_ratio_min * np.maximum(1 - relative_change, 0.0),
                signal_ratio_max * (1 + relative_change),
            )
        if _is_array_or_nonzero(bound.noise_variance_change):
            noise_factor = np.sqrt(1 + np.maximum(bound.noise_variance_change, -1 + 1e-9))
            signal_ratio_min, signal_ratio_max = (
                signal_ratio_min / np.maximum(noise_factor, 1.0),
                signal_ratio_max / np.minimum(noise_factor, 1.0),
            )
        coherent_change = coherent_change + bound.coherent_sum_change
    signal_ratio_max = np.minimum(signal_ratio_max, _RELATIVE_CHANGE_MAX)
    return np.maximum(
        signal_ratio_min - signal_ratio_max * coherent_change, 0.0
    ), signal_ratio_max * (1 + coherent_change)


def _is_array_or_nonzero(value: np.ndarray | float) -> bool:
    """Return False for the number 0, and True for any other number and for any array."""
    return isinstance(value, np.ndarray) or value != 0.0


def _sum_over_segments(value: np.ndarray | float, points: PlannerInputs) -> np.ndarray | float:
    """Return the sum of a value over the segments.

    A value (segments, ...) is summed over its first axis. An array without an axis of segments is
    multiplied by the number of segments. A number is returned as it is.
    """
    if np.ndim(value) <= points.ndim:
        return value * (len(points.existing_chirp_slopes) if np.ndim(value) else 1)
    return np.asarray(value).sum(axis=0)


def _max_over_segments(value: np.ndarray | float, points: PlannerInputs) -> np.ndarray | float:
    """Return the largest value of any segment; a value without an axis of segments is unchanged."""
    return np.asarray(value).max(axis=0) if np.ndim(value) > points.ndim else value
