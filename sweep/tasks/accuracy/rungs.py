"""Rungs: settings of a study that are tried against each other, as overrides of its spec."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from sweep.model.effects.catalogue import EFFECTS, NAMES
from sweep.model.effects.segment_motion import SEGMENT_MOTION
from sweep.model.ground import powers_add
from sweep.spec import SceneSpec, Spec
from sweep.spec.parts import OFF
from sweep.tasks.studies import Declared, changed

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

_TOLERANCE, _DRAWN, _LIMIT = "accuracy.tolerance", "draws.number", "draws.limit"
_BEAMLETS, _PATTERN, _LINE = "footprint.beamlets", "footprint.pattern", "line"
_EXACTLY = dict.fromkeys(
    ("accuracy.line_error", "accuracy.leakage_error", "accuracy.leakage_floor"), FINEST_TOLERANCE
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rung:
    """A setting of a study: values of fields of its spec by dotted path, as one would write them.

    ``thesis`` has the options of :func:`sweep.tasks.accuracy.bench.find_on_grid`, where that
    finds the peaks; ``rays_error`` is what a flight's rays may leave before there are more, 0
    where the spec says that.
    """

    name: str
    kind: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    thesis: Mapping[str, Any] = field(default_factory=dict)
    rays_error: float = 0.0

    @property
    def of_lines(self) -> bool:
        """True where nothing is simulated that the thesis's way lacks: effects in a record."""
        return self.kind in (CLOSED_FORM, THESIS, IMPROVED)

    @property
    def plans(self) -> bool:
        """True where effects are planned, and the time that this takes counts."""
        return not self.of_lines and self.kind not in (FIXED, ALL_ON, REFERENCE)

    @property
    def counts(self) -> bool:
        """True where pd is a share of detected draws, not the mean of their probabilities."""
        return self.kind in (COUNTED, IN_NOISE)

    def of(self, spec: Declared) -> Declared:
        """Return the spec with the overrides put onto it; SpecError where it is no study then."""
        return changed(spec, self.overrides) if self.overrides else spec


@dataclass(frozen=True)
class Ladder:
    """Rungs, the reference last, and what there is to say of them."""

    rungs: tuple[Rung, ...]
    about: str  # what the reference is
    notes: tuple[str, ...] = ()

    @property
    def reference(self) -> Rung:
        """The rung that the errors of all others are taken against."""
        return self.rungs[-1]


def ladder(spec: Declared) -> Ladder:
    """Return the rungs of a study, without those whose effects are fixed."""
    if isinstance(spec, Spec) and spec.draws.any:
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
    rungs.append(Rung(name="all effects on", kind=ALL_ON, overrides=every))
    finest, about, rays_error = every | _EXACTLY, "all effects on", 0.0
    if why:
        notes.append(f"the number of beamlets is left alone: {why}")
    elif isinstance(spec, SceneSpec):
        finest, rays_error = finest | {_BEAMLETS: FINEST_RAYS}, FINEST_RAYS_TOLERANCE
        about += f", {FINEST_RAYS} beamlets or more"
    else:
        finest |= follow | {_TOLERANCE: FINEST_TOLERANCE}
        about += f", beamlets as at {FINEST_TOLERANCE:g}"
    rungs += () if why else _numbers(isinstance(spec, SceneSpec))
    rungs += _thesis_rungs({} if why else {_BEAMLETS: OF_THESIS}, powers_add(spec.parameters()))
    rungs.append(Rung(name="reference", kind=REFERENCE, overrides=finest, rays_error=rays_error))
    return Ladder(tuple(rungs), about, tuple(notes))


def with_fixed(
    ladder: Ladder,
    spec: Declared,
    sets: Mapping[float, frozenset[str]],
    tolerances: Iterable[float] = (),
) -> Ladder:
    """Add rungs that simulate everywhere the effects that a tolerance needs anywhere.

    ``tolerances``: for lines and leakage, tried with each set; by default those of the sets.
    """
    as_at: dict[frozenset[str], float] = {}
    for tolerance, names in sets.items():
        as_at.setdefault(names, tolerance)
    further = [
        Rung(
            name=f"{len(names)} effects as at {first:g}, to {tolerance:g}",
            kind=FIXED,
            overrides={f"effects.{name}": "on" if name in names else "off" for name in NAMES}
            | _fixed_beamlets(spec, tolerance)
            | {_TOLERANCE: tolerance},
        )
        for names, first in as_at.items()
        for tolerance in tolerances or sets
    ]
    place = next(i for i, rung in enumerate(ladder.rungs) if rung.kind == ALL_ON)
    return replace(ladder, rungs=(*ladder.rungs[:place], *further, *ladder.rungs[place:]))


def _fixed_beamlets(spec: Declared, tolerance: float) -> dict[str, Any]:
    """Beamlets that a study whose effects are fixed might have, if their number is not given."""
    if _beamlets_fixed(spec):
        return {}
    if not isinstance(spec, SceneSpec):
        return {_BEAMLETS: FIXED_NODES, _PATTERN: _LINE}
    least = max(FEWEST_RAYS, RAYS_ERROR / tolerance)
    return {_BEAMLETS: min(next((n for n in NUMBERS if n >= least), MOST_RAYS), MOST_RAYS)}


def _numbers(flight: bool) -> Iterator[Rung]:
    """Return fixed numbers of beamlets: in a lattice, and in a line over a plane."""
    for n in NUMBERS:
        if not flight or n <= MOST_RAYS:
            yield Rung(name=f"{n} beamlets", kind=BEAMLETS, overrides={_BEAMLETS: n})
    for n in () if flight else NODES:
        put = {_BEAMLETS: n, _PATTERN: _LINE}
        yield Rung(name=f"{n} in a line", kind=IN_A_LINE, overrides=put)


def _thesis_rungs(overrides: Mapping[str, Any], powers: bool) -> Iterator[Rung]:
    """Yield the same beamlets and effects in closed form, and by the thesis's way, improved too."""
    yield Rung(name="closed form, as thesis", kind=CLOSED_FORM, overrides=overrides)
    forms: list[tuple[str, str, int, dict[str, Any]]] = [
        *((THESIS, "", power, {}) for power in (11, 12)),
        *((IMPROVED, ", real", power, {"real": True}) for power in (11, 12) if powers),
        *((IMPROVED, ", folded", power, {"folded": True, "real": powers}) for power in (11, 12)),
        (IMPROVED, ", folded, degree 9", 12, {"folded": True, "real": powers, "degree": 9}),
    ]
    for kind, how, power, options in forms:
        thesis = {"size": 1 << power} | options
        yield Rung(name=f"thesis 2^{power}{how}", kind=kind, overrides=overrides, thesis=thesis)


def _drawn_ladder(spec: Spec) -> Ladder:
    """Numbers of draws and what is read off them, against a long run with other draws."""
    longest = LONG_RUN * DRAW_NUMBERS[-1]
    notes = ["errors are differences from a long run with other draws, so they are random too"]
    own: dict[str, Any] = {}
    for path, written in ((_DRAWN, spec.draws.number), (_LIMIT, spec.draws.limit)):
        if written > longest:
            own = {path: longest}
            notes.append(f"with {longest} of the {written} draws that are written")
    rungs = [Rung(name="as written", kind=WRITTEN, overrides=own)]
    for t in DRAWN_TOLERANCES:
        until = {_DRAWN: 0, _LIMIT: longest, _TOLERANCE: t}
        rungs.append(Rung(name=f"auto at {t:g}", kind=ADAPTIVE, overrides=until))
    for number in DRAW_NUMBERS:
        each = {_DRAWN: number, _LIMIT: 0}
        noise = each | {"draws.method": "noise"}
        rungs += [
            Rung(name=f"{number} draws, mean", kind=MEANS, overrides=each),
            Rung(name=f"{number} draws, counts", kind=COUNTED, overrides=each),
            Rung(name=f"{number} draws, noise", kind=IN_NOISE, overrides=noise),
        ]
    other = {_DRAWN: longest, "seed": int(spec.seed) ^ 1, _LIMIT: 0}
    rungs.append(Rung(name="reference", kind=REFERENCE, overrides=_every_effect(spec) | other))
    return Ladder(tuple(rungs), f"{longest} other draws, all effects on", tuple(notes))


def _every_effect(spec: Declared) -> dict[str, Any]:
    """All effects on; segments that all begin at one range are a law, which stays as written.

    Random ones where probabilities are means over draws: of a flight they are not.
    """
    law, is_drawn = SEGMENT_MOTION.name, isinstance(spec, Spec) and spec.draws.any
    every = {f"effects.{e.name}": "on" for e in EFFECTS if is_drawn or not e.is_random}
    if spec.modes()[law] == OFF:
        del every[f"effects.{law}"]
    return every


def _on_axis(spec: Declared, path: str) -> bool:
    return any(member.path == path for axis in spec.axes for member in axis.members)


def _beamlets_fixed(spec: Declared) -> str:
    """Why the number of beamlets is the scene's and not accuracy's; empty where it is."""
    if spec.parameters()["footprint.phases"] == "coherent":
        return "with coherent phases it is part of the scene, as the thesis has it"
    if spec.instrument.receiver.architecture == "direct":
        return "in direct detection beamlets add as amplitudes, and are part of the scene"
    if any(_on_axis(spec, path) for path in (_BEAMLETS, _PATTERN, "footprint.phases")):
        return "it is on an axis"
    return ""
