"""Physical effects to the rest of the model: where each acts, what it changes, what it does.

Its parameters become fields of a spec. The planner asks for its size at the points of each tile;
:mod:`sweep.model.evaluation` applies it where some point needs it, and nothing of it is computed
elsewhere. All effects are listed in :mod:`sweep.model.effects.catalogue`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.ground import Ground
from sweep.model.preparation import Parameters, Shots

if TYPE_CHECKING:
    from sweep.model.effects.planner_inputs import PhaseErrorBound, PlannerInputs

EFFECT_MODES = ("auto", "on", "off")


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A field that an effect brings into a spec: a number with a unit, or one of several words."""

    path: str
    description: str
    default: float | int | str = 0.0
    """In SI; 0 or ``none`` means that there is nothing of the effect."""
    example: str = ""
    limits: tuple[str, str | None] = ("", None)
    """Least and largest value, as a user would write them."""
    si_unit: str | None = None
    """By default that of the least value."""
    options: tuple[str, ...] = ()
    is_table: bool = False
    """True for a table over time, given as text (:mod:`sweep.model.effects.sweep_error_table`)."""
    is_sole_cause: bool = True
    """Tell whether nothing else can bring the effect."""
    is_category_key: bool = False
    """True where points are computed together only if they share it; words always are."""

    @property
    def unit(self) -> str:
        """SI unit, empty for words and plain numbers."""
        return self.limits[0].partition(" ")[2] if self.si_unit is None else self.si_unit

    @property
    def enables_effect(self) -> bool:
        """True if other values than the default bring the effect; else it says how it acts."""
        return self.is_sole_cause and self.default in ((1.0,) if self.unit == "dB" else (0, "none"))


class EffectContext(NamedTuple):
    """Parameters and ground that an effect may use besides the shots."""

    parameters: Mapping[str, np.ndarray]
    """By dotted path, (n,) or scalar."""
    ground: Ground
    presence: Mapping[str, np.ndarray] = MappingProxyType({})
    """Of effects that not all points have: 1.0 for those that do, else 0.0; (n,)."""

    def presence_factor(self, effect: str) -> np.ndarray | float:
        """1 for points that have an effect, 0 for others: (n,), or one number for all."""
        return self.presence.get(effect, 1.0)

    def select_beamlets(
        self, effect: str, row: np.ndarray, with_effect: np.ndarray, without_effect: np.ndarray
    ) -> np.ndarray:
        """Numbers of beamlets, (rows, beamlets), by whether the rows' points have an effect."""
        if effect not in self.presence:
            return with_effect
        has_effect = np.ones((len(with_effect), 1), np.bool_)
        has_effect[row, 0] = self.presence[effect] > 0
        return np.where(has_effect, with_effect, without_effect)


class DrawAddresses(NamedTuple):
    """Random draws of some points: point i has those of its own key."""

    point_keys: np.ndarray
    """(n, 2) uint64: random key of each point."""
    draw_numbers: np.ndarray
    """(n,) int64: number of each point's draw."""


ArrayOrFloat = np.ndarray | float


class ErrorBound(NamedTuple):
    """Changes by leaving an effect out at each point, by segment or alike in all."""

    magnitude_change: ArrayOrFloat = 0.0
    """Relative change of the largest bin's magnitude; from 1 on nothing is known of it."""
    coherent_sum_change: ArrayOrFloat = 0.0
    """Besides, what is added to that magnitude or taken from it, as a share of what all amplitudes
    make in phase: sums that may cancel have no relative change."""
    noise_variance_change: ArrayOrFloat = 0.0
    """Relative change of a bin's noise variance."""
    threshold_follows_noise: bool = True
    """True where the threshold is set on the changed noise, as for noise that is always there; else
    it stays where it was, as for noise that comes with the signal."""
    shift_bins: ArrayOrFloat = 0.0
    """Bins by which what is measured moves; they count as a change of a probability does."""
    log10_pfa_change: ArrayOrFloat = 0.0
    """Change of log10 of a shot's probability of a false alarm, by bins that cross the level."""
    leaking_bin_change_sigma: ArrayOrFloat = 0.0
    """Sigmas by which bins that leak move, besides what the largest moves by."""
    probability_change: ArrayOrFloat = 0.0
    """Change of a probability itself, summed over the segments where there is one of each."""
    residual_magnitude_change: ArrayOrFloat = 0.0
    """Relative change of the largest bin's magnitude that remains where the effect is simulated."""
    residual_coherent_sum_change: ArrayOrFloat = 0.0
    """The same as a share of what all amplitudes make in phase; the less of both counts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """A physical effect, the same as no other."""

    name: str
    description: str
    """Description in a few words, for tables and help."""
    stage: str
    """Stage at which it acts, in this order: on the ``lines`` of a footprint; on the ``light`` that
    comes back; on the ``noise``; on the ``record`` and its phases; on the ``spectrum``; on the
    ``detection``; and, in ``draws``, on all of these at random."""
    error_bound: "Callable[[PlannerInputs], ErrorBound | None]"
    """Change at each point by leaving it out. None: the scene has nothing of it."""
    phase_error_bound: "Callable[[PlannerInputs], PhaseErrorBound | None] | None" = None
    """Change of lines over the record; all smears are known before any size is asked for."""
    apply: Callable[[Shots, EffectContext], Shots] | None = None
    """Change of shots, once."""
    perturb_parameters: (
        Callable[[dict[str, np.ndarray], DrawAddresses], dict[str, np.ndarray]] | None
    ) = None
    """Random change of parameters, before any shot is prepared."""
    perturb_shots: Callable[[Shots, EffectContext, DrawAddresses], Shots] | None = None
    """Random change of shots, after all else but spectrum and detection."""
    parameters: tuple[Parameter, ...] = ()
    parent: str = ""
    """An effect that this is part of: kept wherever this is; where it is off, so is this."""
    needs_own_batch: bool = True
    """True if points that have it are computed apart from those that don't. If not, `apply` looks
    at :attr:`EffectContext.presence`, and leaves the bits of other points as they would be without
    it."""
    required_effects: tuple[str, ...] = ()
    """Effects that this one is simulated with, however little they change by themselves."""

    @property
    def is_random(self) -> bool:
        """True if it is simulated by draws."""
        return self.perturb_parameters is not None or self.perturb_shots is not None

    def is_absent(self, parameters: Parameters) -> np.ndarray:
        """Return true for points without it, by the parameters that bring it; (n,) or scalar."""
        enabling_parameters = [
            parameter for parameter in self.parameters if parameter.enables_effect
        ]
        is_absent = np.asarray(bool(enabling_parameters))
        for parameter in enabling_parameters:
            is_absent = is_absent & np.equal(parameters[parameter.path], parameter.default)
        return is_absent


def add_noise_sources(shots: Shots, **variances: np.ndarray) -> Shots:
    """Shots with further sources of noise: variances at the ADC [V^2] by source."""
    return replace(shots, noise_variances=shots.noise_variances | variances)
