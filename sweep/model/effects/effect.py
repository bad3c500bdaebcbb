"""Interface of physical effects: stage, change of the shots, and error bound.

The parameters of an effect become fields of a spec. The planner evaluates its error bound at the
points of each tile. :mod:`sweep.model.evaluation` applies it where a point needs it; otherwise
nothing of it is computed. :mod:`sweep.model.effects.catalogue` lists all effects.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.effects.error_bounds import ErrorBound, PhaseErrorBound
from sweep.model.ground import Ground
from sweep.model.preparation import Parameters, Shots

if TYPE_CHECKING:
    from sweep.model.effects.planner_inputs import PlannerInputs

EFFECT_MODES = ("auto", "on", "off")
"""Settings of an effect in a spec: planned by its error bound, always on, or off."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """Field that an effect adds to a spec: a number with a unit, or one of several words."""

    path: str
    """Dotted path."""
    description: str
    """Description for users."""
    default: float | int | str = 0.0
    """Default value, in SI units; 0 or ``none`` disables the effect."""
    example: str = ""
    """Example of a value, as a user would write it."""
    limits: tuple[str, str | None] = ("", None)
    """Smallest and largest value, as a user would write them."""
    si_unit: str | None = None
    """SI unit; by default the unit of the smallest value."""
    options: tuple[str, ...] = ()
    """Possible words; empty for a number."""
    is_table: bool = False
    """True for a table over time, given as text (:mod:`sweep.model.effects.sweep_error_table`)."""
    is_sole_cause: bool = True
    """True if the effect is absent unless this parameter, or another with this flag, differs from
    its default."""
    is_category_key: bool = False
    """True if points must share the value to be computed together; words always are shared."""

    @property
    def unit(self) -> str:
        """SI unit; empty for words and dimensionless numbers."""
        return self.limits[0].partition(" ")[2] if self.si_unit is None else self.si_unit

    @property
    def enables_effect(self) -> bool:
        """True if the default disables the effect and other values enable it.

        False if the parameter only modifies the effect.
        """
        return self.is_sole_cause and self.default in ((1.0,) if self.unit == "dB" else (0, "none"))


class EffectContext(NamedTuple):
    """Parameters and ground that an effect may use in addition to the shots."""

    parameters: Mapping[str, np.ndarray]
    """Parameters by dotted path, (n,) or scalar."""
    ground: Ground
    """Ground that the beams meet."""
    presence: Mapping[str, np.ndarray] = MappingProxyType({})
    """Masks (n,) of effects that not all points have: 1.0 where enabled, else 0.0."""

    def presence_factor(self, effect: str) -> np.ndarray | float:
        """Return 1 for points that have an effect and 0 for others: (n,), or one number for all."""
        return self.presence.get(effect, 1.0)

    def select_beamlets(
        self, effect: str, row: np.ndarray, with_effect: np.ndarray, without_effect: np.ndarray
    ) -> np.ndarray:
        """Select values of beamlets by the presence of an effect.

        Parameters
        ----------
        effect : str
            Name of the effect.
        row : ndarray (n,)
            Row of each point.
        with_effect, without_effect : ndarray (rows, beamlets)
            Values with and without the effect.

        Returns
        -------
        ndarray (rows, beamlets)
            `with_effect` in rows whose points have the effect, else `without_effect`.
        """
        if effect not in self.presence:
            return with_effect
        has_effect = np.ones((len(with_effect), 1), np.bool_)
        has_effect[row, 0] = self.presence[effect] > 0
        return np.where(has_effect, with_effect, without_effect)


class DrawAddresses(NamedTuple):
    """Addresses of the random numbers of points: each point has its own key."""

    point_keys: np.ndarray
    """(n, 2) uint64: random key of each point."""
    draw_numbers: np.ndarray
    """(n,) int64: number of each point's draw."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """Physical effect, with its error bound and its change of the shots; compared by identity.

    An effect has `apply`, or for draws one of `perturb_parameters` and `perturb_shots`. An effect
    of the scene alone has none of them.
    """

    name: str
    """Name in specs and stores."""
    description: str
    """Description in a few words, for tables and help."""
    stage: str
    """Stage of application, in this order: ``lines`` of a footprint; returning ``light``;
    ``noise``; ``record`` and its phases; ``spectrum``; ``detection``; and ``draws``, random changes
    of any of these."""
    error_bound: "Callable[[PlannerInputs], ErrorBound | None]"
    """Function of :class:`~sweep.model.effects.planner_inputs.PlannerInputs` of n points. It
    returns the upper bound on the output change if the effect is omitted, or None if the effect is
    absent."""
    phase_error_bound: "Callable[[PlannerInputs], PhaseErrorBound | None] | None" = None
    """Function of :class:`~sweep.model.effects.planner_inputs.PlannerInputs` of n points. It
    returns the bound of the phase error over the record, or None. All phase-error bounds are known
    before any `error_bound` is evaluated."""
    apply: Callable[[Shots, EffectContext], Shots] | None = None
    """Function of prepared shots and their :class:`EffectContext` that returns the changed shots.
    """
    perturb_parameters: (
        Callable[[dict[str, np.ndarray], DrawAddresses], dict[str, np.ndarray]] | None
    ) = None
    """Function of parameters by path and :class:`DrawAddresses` that returns randomly changed
    parameters, before shots are prepared."""
    perturb_shots: Callable[[Shots, EffectContext, DrawAddresses], Shots] | None = None
    """Function of shots, :class:`EffectContext` and :class:`DrawAddresses` that returns randomly
    changed shots, after all other effects except spectrum and detection."""
    parameters: tuple[Parameter, ...] = ()
    """Fields that the effect adds to a spec."""
    parent: str = ""
    """Name of the effect that this one is part of. The parent is kept wherever this effect is, and
    this effect is off where the parent is."""
    needs_separate_batches: bool = True
    """True if points with and without the effect are computed separately. If False, `apply` uses
    :attr:`EffectContext.presence` and leaves the bits of points without the effect unchanged."""
    uses_beamlet_velocities: bool = False
    """True if `apply` reads the radial velocities of single beamlets, which are computed only then.
    """
    defines_scene_if_off: bool = False
    """True if ``off`` is a rule of the scene, such as "all segments begin at one range", and not
    the omission of something that is there: it then counts as no error."""
    required_effects: tuple[str, ...] = ()
    """Names of effects that are simulated with this one, however small their own change is."""

    @property
    def is_random(self) -> bool:
        """True if the effect is simulated by draws."""
        return self.perturb_parameters is not None or self.perturb_shots is not None

    def is_absent(self, parameters: Parameters) -> np.ndarray:
        """Return True for points whose parameters disable the effect; (n,) or scalar."""
        enabling_parameters = [
            parameter for parameter in self.parameters if parameter.enables_effect
        ]
        is_absent = np.asarray(bool(enabling_parameters))
        for parameter in enabling_parameters:
            is_absent = is_absent & np.equal(parameters[parameter.path], parameter.default)
        return is_absent


def add_noise_sources(shots: Shots, **variances: np.ndarray) -> Shots:
    """Return shots with additional noise sources: variances at the ADC [V^2] by source."""
    return replace(shots, noise=shots.noise.with_sources(**variances))
