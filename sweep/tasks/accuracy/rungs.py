"""Rungs: settings of a study that are tried against each other, as overrides of its spec."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

    Declared = Spec | SceneSpec

WRITTEN, ADAPTIVE, ALL_ON, FIXED, BEAMLETS, IN_A_LINE = (
    "as written", "adaptive", "all on", "fixed effects", "beamlets", "in a line"
)  # fmt: skip
CLOSED_FORM, THESIS, IMPROVED, REFERENCE = "closed form", "thesis", "thesis improved", "reference"
MEANS, COUNTED, IN_NOISE = "means of draws", "draws counted", "draws in noise"
"""Kinds of rungs."""

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

NUMBERS = (1, 7, 19, 37, 61, 109, 223, 1015, 4009)
"""Beamlets that a study might fix: full shells of a hexagonal lattice."""

NODES = (3, 9, 33, 163, 1234)
"""Beamlets in a line along the slope that a study over a plane might fix."""

FIXED_NODES = 163
"""Of these where effects are fixed too: enough for the widest footprints."""

OF_THESIS = 109
"""Beamlets of [T 3.3.1]."""

FINEST_RAYS, FINEST_RAYS_TOLERANCE = 8017, 3e-7
"""Rays of each shot of a flight's reference, and what they may leave: else shots have more."""

MOST_RAYS = 223
"""Rays that are tried as a fixed number, at the most: more cost as much as all else together."""

FEWEST_RAYS, RAYS_ERROR = 19, 0.1
"""Where effects are fixed too: rays at the least, and rays times tolerance, which leaves one shot
in a thousand over open ground that is off by more."""

FINEST_TOLERANCE = 1e-9
"""Tolerance of the reference: of lines, of leakage and, over a plane, of the number of beamlets."""

DRAW_NUMBERS = (10, 100, 1000)

LONG_RUN = 10
"""Draws of the reference over those of the longest rung."""

DRAWN_TOLERANCES = (1e-1, 3e-2, 1e-2)
"""Tolerances until which points are drawn."""

MEAN, COUNTS = "mean", "counts"
"""What is read off draws: the mean of each draw's probability, or how many were detected."""

_TOLERANCE = "accuracy.tolerance"
_BEAMLETS, _PATTERN = "footprint.beamlets", "footprint.pattern"
_LINE = "line"
_EXACTLY = dict.fromkeys(
    ("accuracy.line_error", "accuracy.leakage_error", "accuracy.leakage_floor"), FINEST_TOLERANCE
)

DRAWN = "draws.number"
"""Field that holds the number of draws."""

_LIMIT = "draws.limit"


@dataclass(frozen=True, kw_only=True)
class Rung:
    """A setting of a study.

    Parameters
    ----------
    name, kind
        What it is called; one of the kinds above.
    overrides
        Values of fields of the spec by dotted path, as one would write them.
    plans
        Whether effects are planned, and the time that this takes counts.
    of_lines
        Whether only what the thesis's way can have is simulated: no effects within a record, no
        leakage.
    cells, degree, real, folded
        Of the thesis's way, where the rung is that: cells of the grid, degree of the deposit,
        whether powers are transformed as real numbers, and whether it goes back to the bins alone
        (:mod:`sweep.tasks.accuracy.thesis_grid`); else 0.
    estimate
        What is read off draws.
    rays_error
        What the rays of a flight's shots may leave before they are cast with more; 0 where the
        spec says that.
    """

    name: str
    kind: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    plans: bool = True
    of_lines: bool = False
    cells: int = 0
    degree: int = 0
    real: bool = False
    folded: bool = False
    estimate: str = MEAN
    rays_error: float = 0.0

    def of(self, spec: Declared) -> Declared:
        """The spec with the overrides put onto it.

        Raises
        ------
        SpecError
            Where it then is no study any more.
        """
        if not self.overrides:
            return spec
        written = copy.deepcopy(spec.to_yaml_mapping())
        for path, value in self.overrides.items():
            *sections, name = path.split(".")
            place = written
            for section in sections:
                place = place.setdefault(section, {})
            place[name] = value
        return type(spec).from_mapping(written, base=getattr(spec, "base", "."))


@dataclass(frozen=True)
class Ladder:
    """Rungs, the reference last, and what there is to say of them."""

    rungs: tuple[Rung, ...]
    about: str
    """What the reference is."""
    notes: tuple[str, ...] = ()
    fixed: Callable[[float], dict[str, Any]] = lambda tolerance: {}
    """What else is fixed where effects are, to a tolerance."""

    @property
    def reference(self) -> Rung:
        """The rung that the errors of all others are taken against."""
        return self.rungs[-1]

    def with_fixed(
        self, sets: Mapping[float, frozenset[str]], tolerances: Iterable[float] = ()
    ) -> Ladder:
        """The ladder with rungs that simulate the same effects at every point.

        Each of them to several tolerances, which say how exactly lines and leakage are computed.

        Parameters
        ----------
        sets
            Effects that a tolerance calls for anywhere.
        tolerances
            For lines and leakage; those of the effects by default.
        """
        from sweep.model.effects.catalogue import EFFECTS

        as_at: dict[frozenset[str], float] = {}
        for tolerance, names in sets.items():
            as_at.setdefault(names, tolerance)
        further = []
        for names, first in as_at.items():
            modes = {
                f"effects.{effect.name}": "on" if effect.name in names else "off"
                for effect in EFFECTS
            }
            for tolerance in tolerances or sets:
                name = f"{len(names)} effects as at {first:g}, to {tolerance:g}"
                overrides = modes | self.fixed(tolerance) | {_TOLERANCE: tolerance}
                further.append(Rung(name=name, kind=FIXED, overrides=overrides, plans=False))
        place = next(i for i, rung in enumerate(self.rungs) if rung.kind == ALL_ON)
        return replace(self, rungs=(*self.rungs[:place], *further, *self.rungs[place:]))


def ladder(spec: Declared) -> Ladder:
    """The rungs of a study, without those whose effects are fixed."""
    from sweep.model.ground import powers_add

    if _draws(spec):
        return _drawn_ladder(spec)
    notes: list[str] = []
    rungs = [Rung(name="as written", kind=WRITTEN)]
    why = _beamlets_fixed(spec)
    follow: dict[str, Any] = {} if why else {_BEAMLETS: "auto"}
    if _on_axis(spec, _TOLERANCE):
        notes.append("accuracy.tolerance is on an axis: left as it is")
    else:
        rungs += [
            Rung(name=f"auto at {t:g}", kind=ADAPTIVE, overrides=follow | {_TOLERANCE: t})
            for t in TOLERANCES
        ]
    every = _every_effect(spec)
    rungs.append(Rung(name="all effects on", kind=ALL_ON, overrides=every, plans=False))
    finest, about, rays_error = every | _EXACTLY, "all effects on", 0.0
    if why:
        notes.append(f"the number of beamlets is left alone: {why}")
    elif _is_flight(spec):
        finest, rays_error = finest | {_BEAMLETS: FINEST_RAYS}, FINEST_RAYS_TOLERANCE
        about += f", {FINEST_RAYS} beamlets or more"
    else:
        finest |= follow | {_TOLERANCE: FINEST_TOLERANCE}
        about += f", beamlets as at {FINEST_TOLERANCE:g}"
    rungs += _numbers(spec) if not why else ()
    rungs += _thesis_rungs({} if why else {_BEAMLETS: OF_THESIS}, powers_add(spec.parameters()))
    reference = Rung(
        name="reference", kind=REFERENCE, overrides=finest, plans=False, rays_error=rays_error
    )
    fixed = partial(_fixed_beamlets, spec, bool(why))
    return Ladder((*rungs, reference), about, tuple(notes), fixed)


def _fixed_beamlets(spec: Declared, given: bool, tolerance: float) -> dict[str, Any]:
    """Beamlets that a study whose effects are fixed might have, if their number is not given."""
    if given:
        return {}
    if not _is_flight(spec):
        return {_BEAMLETS: FIXED_NODES, _PATTERN: _LINE}
    least = max(FEWEST_RAYS, RAYS_ERROR / tolerance)
    return {_BEAMLETS: min(next((n for n in NUMBERS if n >= least), MOST_RAYS), MOST_RAYS)}


def _numbers(spec: Declared) -> Iterator[Rung]:
    """Fixed numbers of beamlets: in a lattice, and in a line where the ground is a plane."""
    flight = _is_flight(spec)
    for n in NUMBERS:
        if not flight or n <= MOST_RAYS:
            yield Rung(name=f"{n} beamlets", kind=BEAMLETS, overrides={_BEAMLETS: n})
    for n in () if flight else NODES:
        put = {_BEAMLETS: n, _PATTERN: _LINE}
        yield Rung(name=f"{n} in a line", kind=IN_A_LINE, overrides=put)


def _thesis_rungs(overrides: Mapping[str, Any], powers: bool) -> Iterator[Rung]:
    """The thesis's way: in the nearest of 2^11 or 2^12 cells; and with what would improve it.

    Before them the same beamlets with the same effects in closed form, like for like. ``powers``:
    whether beamlets add as such, which then are transformed as real numbers.
    """
    like: dict[str, Any] = {"overrides": overrides, "plans": False, "of_lines": True}
    yield Rung(name="closed form, as thesis", kind=CLOSED_FORM, **like)
    for power in (11, 12):
        yield Rung(name=f"thesis 2^{power}", kind=THESIS, cells=1 << power, **like)
    improved = like | {"kind": IMPROVED, "real": powers}
    for power in (11, 12) if powers else ():
        yield Rung(name=f"thesis 2^{power}, real", cells=1 << power, **improved)
    for power, degree in ((11, 0), (12, 0), (12, 9)):
        how = f"folded, degree {degree}" if degree else "folded"
        yield Rung(
            name=f"thesis 2^{power}, {how}", cells=1 << power, degree=degree, folded=True,
            **improved,
        )  # fmt: skip


def _drawn_ladder(spec: Declared) -> Ladder:
    """Numbers of draws and what is read off them, against a long run with other draws."""
    longest = LONG_RUN * DRAW_NUMBERS[-1]
    notes = ["errors are differences from a long run with other draws, so they are random too"]
    own: dict[str, Any] = {}
    for path, written in ((DRAWN, spec.draws.number), (_LIMIT, getattr(spec.draws, "limit", 0))):
        if written > longest:
            own = {path: longest}
            notes.append(f"with {longest} of the {written} draws that are written")
    rungs = [Rung(name="as written", kind=WRITTEN, overrides=own)]
    may_stop = _may_stop(spec)
    if may_stop:
        rungs += [
            Rung(
                name=f"auto at {t:g}", kind=ADAPTIVE,
                overrides={DRAWN: 0, _LIMIT: longest, _TOLERANCE: t},
            )
            for t in DRAWN_TOLERANCES
        ]  # fmt: skip
    noise, to_the_end = {"draws.method": "noise"}, {_LIMIT: 0} if may_stop else {}
    for number in DRAW_NUMBERS:
        each = {DRAWN: number} | to_the_end
        rungs += [
            Rung(name=f"{number} draws, mean", kind=MEANS, overrides=each),
            Rung(name=f"{number} draws, counts", kind=COUNTED, overrides=each, estimate=COUNTS),
            Rung(
                name=f"{number} draws, noise", kind=IN_NOISE, overrides=each | noise,
                estimate=COUNTS,
            ),
        ]  # fmt: skip
    other = {DRAWN: longest, "seed": int(spec.seed) ^ 1} | to_the_end
    reference = Rung(
        name="reference", kind=REFERENCE, overrides=_every_effect(spec) | other, plans=False
    )
    about = f"{longest} other draws, all effects on"
    return Ladder((*rungs, reference), about, tuple(notes))


def _may_stop(spec: Declared) -> bool:
    """Whether points can be drawn until their tolerance is met."""
    return "limit" in type(spec.draws).model_fields


def _every_effect(spec: Declared) -> dict[str, Any]:
    """All effects on, each with the scene's own parameters."""
    from sweep.model.effects.catalogue import EFFECTS

    may = {e.name for e in EFFECTS if not e.is_random or (_draws(spec) and not _is_flight(spec))}
    return {f"effects.{effect.name}": "on" for effect in EFFECTS if effect.name in may}


def _is_flight(spec: Declared) -> bool:
    from sweep.spec import SceneSpec

    return isinstance(spec, SceneSpec)


def _draws(spec: Declared) -> bool:
    """Whether probabilities are means over draws: of a flight they are not."""
    if _is_flight(spec):
        return False
    return spec.draws.number > 0 or getattr(spec.draws, "limit", 0) > 0


def _on_axis(spec: Declared, path: str) -> bool:
    return any(member.path == path for axis in spec.axes for member in axis.members)


def _beamlets_fixed(spec: Declared) -> str:
    """Why the number of beamlets is the scene's and not accuracy's; empty where it is."""
    phases = spec.parameters()["footprint.phases"]
    if phases == "coherent":
        return "with coherent phases it is part of the scene, as the thesis has it"
    if spec.instrument.receiver.architecture == "direct":
        return "in direct detection beamlets add as amplitudes, and are part of the scene"
    if any(_on_axis(spec, path) for path in (_BEAMLETS, _PATTERN, "footprint.phases")):
        return "it is on an axis"
    return ""
