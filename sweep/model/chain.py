"""The chain of a simulation: bare shots, then the effects that are called for, one by one.

A graph of this many nodes is all that a block of points is: what no scene calls for is in no node.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace

import numpy as np

from sweep.model.effects.catalogue import CORE, DEFAULTS, EFFECTS, NAMES, PARAMETERS
from sweep.model.effects.effect import Effect, Scene
from sweep.model.ground import Cast, Ground, Plane
from sweep.model.preparation import Parameters, Shots, as_arrays, bare
from sweep.model.resolution import resolved_categories

SHARED = tuple(parameter.path for parameter in PARAMETERS if parameter.category)
"""Numbers of effects that points must share to be prepared together."""


def nodes(effects: Collection[str]) -> tuple[Effect, ...]:
    """Effects by name in the order in which they act.

    Raises
    ------
    ValueError
        No effect has such a name.
    """
    if unknown := sorted(set(effects) - set(NAMES)):
        raise ValueError(f"no effect {', '.join(unknown)}: choose from {', '.join(NAMES)}")
    return tuple(effect for effect in EFFECTS if effect.name in effects)


def prepare(
    parameters: Parameters, effects: Collection[str] = CORE
) -> Iterator[tuple[np.ndarray, Shots]]:
    """Shots on a flat plane, split by category: (indices, :class:`Shots`) for each.

    Parameters
    ----------
    parameters : mapping
        Dotted path to SI scalar, string or (n,) array, for every parameter of instrument, target,
        footprint and accuracy, and for those of effects that are not at their defaults.
    effects : collection of str
        Names of the effects that are simulated.
    """
    for index, p in resolved_categories(DEFAULTS | dict(parameters), effects, SHARED):
        plane = Plane(p, index.size, moving="doppler_spread" in effects)
        shots = assembled(p, index.size, plane, effects)
        yield index, replace(shots, alike=True)


def prepare_cast(
    parameters: Parameters,
    ground: Cast,
    effects: Collection[str] = CORE,
    flags: np.ndarray | None = None,
) -> Shots:
    """Shots whose footprints are given, all of one category.

    Parameters
    ----------
    parameters, effects
        As of :func:`prepare`. Ranges and radial velocities are those of the beam's centre;
        grazing angle and law are not looked at.
    ground : Cast
        The footprints.
    flags : (n,) uint32 ndarray, optional
        Of the effects that each shot has, where that are not all of them; they may differ in
        those that are not computed :attr:`~sweep.model.effects.effect.Effect.apart`.
    """
    p = as_arrays(DEFAULTS | dict(parameters))
    return assembled(p, ground.beamlets.row.size, ground, effects, flags)


def assembled(
    p: Mapping[str, np.ndarray],
    size: int,
    ground: Ground,
    effects: Collection[str],
    flags: np.ndarray | None = None,
) -> Shots:
    """Bare shots with the effects put to them, but for random ones."""
    scene = Scene(p, ground, {} if flags is None else _where(effects, flags))
    shots = bare(p, size, ground)
    for effect in nodes(effects):
        if effect.act is not None:
            shots = effect.act(shots, scene)
    return shots


def _where(effects: Collection[str], flags: np.ndarray) -> dict[str, np.ndarray]:
    """Of effects that not all points have: 1.0 for those that do, else 0.0."""
    lacking = int(np.bitwise_or.reduce(~flags)) if flags.size else 0
    return {
        effect.name: (flags >> k & 1).astype(float)
        for k, effect in enumerate(EFFECTS)
        if effect.name in effects and not effect.apart and lacking >> k & 1
    }
