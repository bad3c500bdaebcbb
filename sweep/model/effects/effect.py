"""Interface of physical effects: stage, change of the shots, and error bound.

The parameters of an effect become fields of a spec. The planner evaluates the effect's error bound
at all points, and decides for each tile (a group of points) whether the effect is simulated.
:mod:`sweep.model.evaluation` applies it to these points; for others nothing of it is computed.
:mod:`sweep.model.effects.catalogue` lists all effects.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.effects.error_bounds import ErrorBound, PhaseErrorBound
from sweep.model.effects.requirements import ParameterRequirement
from sweep.model.ground import Ground
from sweep.model.preparation import Parameters, Shots

if TYPE_CHECKING:
    from sweep.model.effects.planner_inputs import PlannerInputs

EFFECT_MODES = ("auto", "on", "off")
"""Settings of an effect in a spec. ``auto`` simulates the effect where its error bound requires
that, ``on`` always, and ``off`` never."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """Field that an effect adds to a spec: a number with a unit, or one of several words."""

    path: str
    """Dotted path of the field in a spec."""
    description: str
    """Description of the field for users of specs."""
    default: float | int | str = 0.0
    """Value in SI units if the spec states none; 0 or ``none`` disables the effect."""
    example: str = ""
    """Example of a value with its unit, as a user would write it in a spec."""
    limits: tuple[str, str | None] = ("", None)
    """Smallest and largest allowed value with their units, as a user would write them in a spec.
    None if there is no largest value."""
    si_unit: str | None = None
    """SI unit of the value. None stands for the SI unit of the smallest value in ``limits``."""
    options: tuple[str, ...] = ()
    """Allowed words of a text field; empty if the field is a number."""
    is_table: bool = False
    """True if the value is a table over time, given as text
    (:mod:`sweep.model.effects.sweep_error_table`)."""
    can_cause_effect: bool = True
    """True if a value other than the default can make the effect present. The effect is absent if
    all parameters with this flag have their defaults."""
    is_category_key: bool = False
    """True if only points with an equal value can be computed together. This always holds for text
    fields, whatever the flag."""
    requirements: tuple[ParameterRequirement, ...] = ()
    """Requirements on other parameters of a spec. A spec that breaks one is refused unless the
    effect is off."""

    @property
    def unit(self) -> str:
        """SI unit of the value; empty for words and dimensionless numbers."""
        return self.limits[0].partition(" ")[2] if self.si_unit is None else self.si_unit

    @property
    def enables_effect(self) -> bool:
        """True if the default of this parameter disables the effect, and other values enable it.

        False if the parameter only modifies the effect.
        """
        return self.can_cause_effect and self.default in (
            (1.0,) if self.unit == "dB" else (0, "none")
        )


class EffectContext(NamedTuple):
    """Parameters and ground of n points, which an effect may use in addition to their shots."""

    parameters: Mapping[str, np.ndarray]
    """Values of the spec's parameters by dotted path, each (n,) or scalar."""
    ground: Ground
    """Ground that the beams of the points meet."""
    masks_by_effect: Mapping[str, np.ndarray] = MappingProxyType({})
    """Masks (n,), by name, of the effects that only some points have: 1.0 where the point has the
    effect, else 0.0."""

    def effect_mask(self, effect: str) -> np.ndarray | float:
        """Return the mask of a named effect, (n,): 1.0 for points with the effect, else 0.0.

        The result is the number 1.0 if all points have the effect.
        """
        return self.masks_by_effect.get(effect, 1.0)

    def select_beamlet_values(
        self, effect: str, row: np.ndarray, with_effect: np.ndarray, without_effect: np.ndarray
    ) -> np.ndarray:
        """Select values of beamlets by the presence of an effect.

        Parameters
        ----------
        effect : str
            Name of the effect.
        row : ndarray (n,)
            Row of each point's footprint in the values.
        with_effect, without_effect : ndarray (rows, beamlets)
            Values with and without the effect.

        Returns
        -------
        ndarray (rows, beamlets)
            `with_effect` in rows whose points have the effect, else `without_effect`.
        """
        if effect not in self.masks_by_effect:
            return with_effect
        has_effect = np.ones((len(with_effect), 1), np.bool_)
        has_effect[row, 0] = self.masks_by_effect[effect] > 0
        return np.where(has_effect, with_effect, without_effect)


class DrawAddresses(NamedTuple):
    """Keys and draw numbers from which the random numbers of n points follow."""

    point_keys: np.ndarray
    """(n, 2) uint64: key of each point's own random stream."""
    draw_numbers: np.ndarray
    """(n,) int64: number of each point's draw (realisation of everything random)."""
    draws_are_grouped: bool = False
    """True if consecutive draws of a point form groups over which random numbers are spread evenly
    (:mod:`sweep.model.sampling.draw_groups`); False for independent draws."""

    def uniforms(self, stream: int, count: int, *, are_polar: bool = False) -> np.ndarray:
        """Return the first ``count`` uniform random numbers of a stream, for each draw.

        Parameters
        ----------
        stream : int
            Number of the random stream; each physical cause has its own.
        count : int
            Number of uniform numbers.
        are_polar : bool
            True if the second number of each pair is an angle [cycles].

        Returns
        -------
        ndarray (n, count)
            Uniform numbers, 0..1, of the n points.
        """
        from sweep.model.sampling.draw_groups import grouped_uniforms
        from sweep.model.sampling.philox import uniforms

        if not self.draws_are_grouped:
            return uniforms(self.point_keys, self.draw_numbers, stream, count)
        return grouped_uniforms(
            self.point_keys, self.draw_numbers, stream, count, are_polar=are_polar
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Effect:
    """Physical effect, with its error bound and its change of the shots; compared by identity.

    A deterministic effect has `apply`. A random one has `perturb_parameters` or `perturb_shots`,
    which change each draw (random realisation). Effects of the scene alone have no such function.
    """

    name: str
    """Name of the effect in specs and stores."""
    description: str
    """Description of the effect in a few words, for tables and help."""
    stage: str
    """Stage of application, in this order: ``lines`` of a footprint; returning ``light``;
    ``noise``; ``record`` and its phases; ``spectrum``; ``detection``; and ``draws``, random changes
    of any of these."""
    error_bound: "Callable[[PlannerInputs], ErrorBound | None]"
    """Function that bounds the change of results at n points if the effect is omitted. The argument
    is the :class:`~sweep.model.effects.planner_inputs.PlannerInputs` of the points. The result is
    None where the effect is absent."""
    phase_error_bound: "Callable[[PlannerInputs], PhaseErrorBound | None] | None" = None
    """Function that bounds the phase error that the effect adds over the record, at n points. The
    argument is the :class:`~sweep.model.effects.planner_inputs.PlannerInputs` of the points. The
    result may be None. The function is evaluated for all effects before any `error_bound`."""
    apply: Callable[[Shots, EffectContext], Shots] | None = None
    """Function that simulates the effect. The arguments are prepared shots and the shots'
    :class:`EffectContext`, and the result is the changed shots."""
    perturb_parameters: (
        Callable[[dict[str, np.ndarray], DrawAddresses], dict[str, np.ndarray]] | None
    ) = None
    """Function of parameters by path and :class:`DrawAddresses` that returns randomly changed
    parameters, before shots are prepared."""
    perturb_shots: Callable[[Shots, EffectContext, DrawAddresses], Shots] | None = None
    """Function of shots, :class:`EffectContext` and :class:`DrawAddresses` that returns randomly
    changed shots, after all other effects except spectrum and detection."""
    parameters: tuple[Parameter, ...] = ()
    """Parameters of the effect, which become fields of a spec."""
    parent: str = ""
    """Name of the effect that this one is part of; empty if there is none. The parent is simulated
    wherever this effect is. This effect is off wherever the parent is off."""
    needs_separate_batches: bool = True
    """True if points with and without the effect are computed separately. If False, `apply` uses
    :attr:`EffectContext.masks_by_effect` and leaves the bits of points without the effect
    unchanged."""
    uses_beamlet_velocities: bool = False
    """True if `apply` reads the radial velocities of single beamlets. The velocities are computed
    only if a simulated effect has this flag."""
    defines_scene_if_off: bool = False
    """True if ``off`` states a rule of the scene, such as "all segments begin at one range". Mode
    ``off`` then counts as no error. False if ``off`` omits something that is present."""
    is_in_time_domain_truth: bool = True
    """False if :func:`sweep.model.time_domain_truth.evaluate_segments_in_time_domain` leaves the
    effect out. Comparisons with that function leave such an effect out as well."""
    required_effects: tuple[str, ...] = ()
    """Names of effects that are simulated wherever this one is, even if their own change is
    negligible."""

    @property
    def is_random(self) -> bool:
        """True if the effect changes parameters or shots at random, draw by draw."""
        return self.perturb_parameters is not None or self.perturb_shots is not None

    def is_absent(self, parameters: Parameters) -> np.ndarray:
        """Return bool, (n,) or scalar: True for points whose parameters disable the effect."""
        enabling_parameters = [
            parameter for parameter in self.parameters if parameter.enables_effect
        ]
        is_absent = np.asarray(bool(enabling_parameters))
        for parameter in enabling_parameters:
            is_absent = is_absent & np.equal(parameters[parameter.path], parameter.default)
        return is_absent


def add_noise_sources(shots: Shots, **variances: np.ndarray) -> Shots:
    """Return a copy of shots with additional noise sources.

    ``variances`` are noise variances at the ADC [V^2], by name of the source.
    """
    return replace(shots, noise=shots.noise.with_sources(**variances))
