"""What a rung is tried on: a sample of points, by the machinery that computes all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from sweep.tasks.accuracy.rungs import COUNTS, Rung

if TYPE_CHECKING:
    from sweep.model.preparation import Shots
    from sweep.tasks.accuracy.rungs import Declared

    Look = Callable[[Shots], np.ndarray]

SEGMENTS = ("up", "doppler", "down")

NOT_IN_TRUTH = frozenset({"acceleration", "chirp_nonlinearity", "line_width", "leakage"})
"""Effects that the time-domain records know nothing of."""

AFTER_THE_LINES = frozenset({"record", "detection", "draws"})
"""Stages of effects that the thesis's way leaves out."""


class Seen(NamedTuple):
    """What a rung finds at n points; nan for what there is not."""

    pd: np.ndarray
    """(n, 4): probability of detection: up, Doppler, down, shot."""
    log10_pfa: np.ndarray
    """(n, k): log10 of probabilities of false alarm."""
    leakage: np.ndarray
    """(n, 2): probability of leakage in the chirps, up and down."""
    magnitude: np.ndarray
    """(n, k): |X| of the peak bins, in a unit of all rungs."""
    standard_error: np.ndarray
    """(n,): of the worst of pd, where it is a mean over draws."""
    sigma: np.ndarray
    """(n,): noise of a bin, per quadrature, in the magnitudes' unit."""
    beamlets: np.ndarray
    """(n,): of each point; of a flight all rays that are cast, whatever is made of them."""


@dataclass(frozen=True)
class Trial:
    """A rung tried on a part of the sample."""

    seen: Seen
    seconds: float
    """Processor time of a point, planning included: what others use of the machine is no part."""
    planning: float
    """A point."""


class Bench(Protocol):
    """A sample of a study's points."""

    unit: str

    @property
    def most_times(self) -> int:
        """Points of the longest stretch that may be timed."""

    @property
    def spec(self) -> Declared:
        """The study, as rungs are put onto it."""

    @property
    def size(self) -> int:
        """Points of the sample."""

    @property
    def least_parts(self) -> int:
        """Parts of a sample, at the least: whole ones are kept where it is broken off."""

    @property
    def whole(self) -> int:
        """Points of the study, each computed once: draws of a flight are none of their own."""

    def parts(self, points: int) -> list[np.ndarray]:
        """The sample in parts of about so many points: places in it."""

    def effects(self, rung: Rung) -> frozenset[str]:
        """Effects that a rung calls for anywhere in the sample."""

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """A rung on a part of the sample, timed on stretches of so many points, if it can be."""

    def forget(self) -> None:
        """Drop what trials of one part share; its time counts for each of them."""

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """A point in the time domain, and as the rung has it without what the truth lacks."""

    def coordinates(self) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
        """Where the sample's points are: values and attributes by name."""


def look_of(rung: Rung) -> Look:
    """What finds a rung's peaks in the spectra."""
    from sweep.model import shot
    from sweep.tasks.accuracy import thesis_grid

    if not rung.cells:
        return shot.find
    return partial(
        thesis_grid.find, degree=rung.degree, size=rung.cells, real=rung.real, folded=rung.folded
    )


def of_lines(names: frozenset[str]) -> tuple[str, ...]:
    """Those of the effects that the thesis's way can have."""
    from sweep.model.effects.catalogue import EFFECTS

    return tuple(e.name for e in EFFECTS if e.name in names and e.stage not in AFTER_THE_LINES)


def seen_in(outputs: Mapping[str, np.ndarray], estimate: str, draws: int) -> Seen:
    """What counts of the outputs of points of a grid."""
    names = [f"pd_{name}" for name in (*SEGMENTS, "shot")]
    if estimate == COUNTS:
        counts = [outputs[f"n_detected_{name}"].sum(axis=1) for name in (*SEGMENTS, "shot")]
        pd = np.stack(counts, axis=1) / draws
        nothing = np.full((len(pd), 3), np.nan)
        error = np.sqrt(np.maximum(pd * (1 - pd), 0.0) / draws)
        unknown = nothing[:, :2], nothing[:, :2], nothing
        return Seen(pd, *unknown, error.max(axis=1), *nothing[:, :2].T)
    pd = np.stack([outputs[name] for name in names], axis=1)
    alarms = [outputs[f"log10_pfa_{name}"] for name in ("segment", "shot")]
    magnitude = [np.sqrt(outputs[f"snr_{n}"] * outputs["noise_variance"]) for n in SEGMENTS]
    errors = [outputs[f"{name}_error"] for name in names if f"{name}_error" in outputs]
    return Seen(
        pd,
        np.stack(alarms, axis=1),
        np.stack([outputs[f"p_leakage_{name}"] for name in ("up", "down")], axis=1),
        np.stack(magnitude, axis=1),
        np.fmax.reduce(errors) if errors else np.full(len(pd), np.nan),
        np.sqrt(outputs["noise_variance"] / 2),
        outputs["beamlets"],
    )
