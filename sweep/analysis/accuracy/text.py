"""Settings in tables and sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

import xarray as xr

from sweep.analysis.accuracy import settings as of
from sweep.analysis.accuracy.settings import Duel, Setting
from sweep.analysis.tabular import Block, Page

COLUMNS = ("setting", "us a point", "planning", "median", "90 %", "largest", "log10 pfa",
           "magnitude", "leakage", "front")  # fmt: skip
"""Time, its share of planning, and errors: three quantiles of pd's, the largest of the others."""


def rows(settings: Sequence[Setting]) -> list[list[str]]:
    """A row for each setting, by COLUMNS."""
    best = of.front(of.candidates(settings))
    return [
        [
            s.name,
            microseconds(s.seconds),
            microseconds(s.planning) if s.planning else "-",
            *(error(s.quantile(share)) for share in (0.5, 0.9, 1.0)),
            error(s.log10_pfa_error),
            error(s.magnitude_error),
            error(s.leakage_error),
            "*" if s in best else "",
        ]
        for s in settings
    ]


def cheapest_rows(settings: Sequence[Setting]) -> list[list[str]]:
    """The cheapest setting for each tolerance: tolerance, setting, its time, its error."""
    found = []
    for tolerance in of.TOLERANCES:
        best = of.cheapest(of.candidates(settings), tolerance)
        cells = [best.name, microseconds(best.seconds), error(best.error)] if best else ["none"]
        found.append([f"{tolerance:g}", *cells, *[""] * (3 - len(cells))])
    return found


STORING = "storing_seconds"
"""Attribute that stores of earlier versions lack."""

SHORT = ("setting", "time", "90 %", "largest", "log pfa", "peak", "leakage")


def short_rows(settings: Sequence[Setting]) -> list[list[str]]:
    """The same in few columns, by SHORT: those on the front have a star before their names."""
    best = of.front(of.candidates(settings))
    return [
        [
            f"{'*' if s in best else ' '} {s.name}",
            f"{microseconds(s.seconds)} us",
            *(error(s.quantile(share)) for share in (0.9, 1.0)),
            error(s.log10_pfa_error),
            error(s.magnitude_error),
            error(s.leakage_error),
        ]
        for s in settings
    ]


CHEAPEST = ("error allowed", "cheapest setting", "us a point", "its error")


def sentences(dataset: xr.Dataset, settings: Sequence[Setting]) -> list[str]:
    """What it comes to, in words."""
    attributes = dataset.attrs
    found = [_written(dataset, settings)]
    found += _fixed(of.against_fixed(settings), attributes)
    found += _thesis(settings, attributes["thesis_beamlets"]) + _like_for_like(settings)
    found.append(_reference(attributes))
    found += [note[0].upper() + note[1:] + "." for note in attributes["notes"]]
    found += [_partial(attributes)] if attributes["stopped"] else []
    return found


def page(dataset: xr.Dataset, settings: Sequence[Setting]) -> Page:
    """Tables and sentences under the study's title."""
    blocks = [
        Block("Settings", COLUMNS, rows(settings)),
        Block("Cheapest setting for each error", CHEAPEST, cheapest_rows(settings)),
    ]
    return Page(f"{dataset.attrs['title']}: accuracy", blocks, sentences(dataset, settings), [])


def _written(dataset: xr.Dataset, settings: Sequence[Setting]) -> str:
    (written,) = of.of_kinds(settings, of.WRITTEN)
    number, unit = dataset.attrs["study_points"], dataset.attrs["unit"]
    best = of.cheapest(of.candidates(settings), written.error)
    whole = f"all {number:,} {unit} take" if number > 1 else "that is"
    text = (
        f"As written: {microseconds(written.seconds)} us a point, error {error(written.error)}; "
        f"{whole} {_time(number * written.seconds)} on one core"
    )
    if (stored := dataset.attrs.get(STORING)) is not None:
        text += f", and at least {_time(stored)} to be stored, whatever the setting"
    if best is None or best is written or best.times_faster(written) < 1.05:
        return text + ". Nothing tried is faster and as accurate."
    return text + f". As accurate and {best.times_faster(written):.2g} times faster: {best.name}."


def _fixed(duels: Sequence[Duel], attributes: dict) -> list[str]:
    """Statement on adaptive against fixed settings."""
    if not duels:
        return []
    worst = min(duels, key=lambda duel: duel.times_faster)
    if worst.other is None:
        return ["At equal error: no fixed setting is as accurate as any adaptive one."]
    kept = "kept" if worst.times_faster >= of.AS_FAST else _lost(worst, duels, attributes)
    several = [duel.times_faster for duel in duels if duel.other]
    return [
        f"At equal error, adaptive against the best single fixed setting: {_span(several)} times "
        f"as fast; least {worst.adaptive.name} against {worst.other.name}. "
        f"Never slower by more than 10 %: {kept}."
    ]


def _lost(worst: Duel, duels: Sequence[Duel], attributes: dict) -> str:
    """By how much an adaptive setting is slower, and what that is of all that the study takes.

    However few points a study has, its store is to be made, which is most of what it takes then.
    """
    points = attributes["study_points"]
    slower = worst.adaptive.seconds * (1 - worst.times_faster)
    lost, planning = (_time(points * each) for each in (slower, worst.adaptive.planning))
    told = f"NOT kept, by {lost} in all; planning takes {planning}"
    if (stored := attributes.get(STORING)) is None:
        return told
    whole = min(duel.with_besides(stored / points) for duel in duels)
    return f"{told}; with the study's store it is {whole:.2g} times as fast"


def _thesis(settings: Sequence[Setting], beamlets: int) -> list[str]:
    """Statement on adaptive settings against the thesis's way, as described and improved.

    What they are held to is against its own number of beamlets.
    """
    duels = of.against_thesis(settings)
    if not duels:
        return []
    kept = " and ".join(
        f"{'kept' if duel.times_faster >= of.TIMES_FASTER else 'NOT kept'} against {_name(duel)}"
        for duel in duels
    )
    least = f"At least {of.TIMES_FASTER:g} times as fast: {kept}."
    if beamlets != of.OF_THESIS:
        least = (
            f"With this scene's {beamlets} beamlets, that is, where the thesis has {of.OF_THESIS}."
        )
    told = [f"Against the thesis's way at the error that it has: {_told(duels)}. {least}"]
    if improved := of.against_thesis(settings, of.IMPROVED):
        told.append(f"Against what it can be improved to: {_told(improved)}.")
    return told


def _told(duels: Sequence[Duel]) -> str:
    return "; ".join(
        f"{duel.adaptive.name} is {duel.times_faster:.2g} times as fast as {_name(duel)} "
        f"(error {error(duel.other.error)})"
        for duel in duels
        if duel.other
    )


def _name(duel: Duel) -> str:
    return duel.other.name if duel.other else ""


def _like_for_like(settings: Sequence[Setting]) -> list[str]:
    """The same beamlets with the same effects: the closed form against the thesis's way."""
    told = [
        f"{closed.times_faster(thesis):.2g} times as fast as {thesis.name}"
        for closed in of.of_kinds(settings, of.CLOSED_FORM)
        for thesis in of.of_kinds(settings, of.THESIS, of.IMPROVED)
    ]
    if not told:
        return []
    return [
        "Like for like, the same beamlets and effects (none within a record, as range walk, and no "
        f"leakage), the closed form is {', '.join(told)}."
    ]


def _reference(attributes: dict) -> str:
    text = f"Reference: {attributes['reference']}"
    if not attributes["truth_points"]:
        return text + ", not held against the time domain."
    fewer = f", with {n} beamlets in both," if (n := attributes["truth_beamlets"]) else ""
    return text + (
        f"; at {attributes['truth_points']} {attributes['unit']}{fewer} it is within "
        f"{error(attributes['truth_pd_difference'])} of the time domain's pd, within "
        f"{error(attributes['truth_magnitude_difference'])} of its magnitudes."
    )


def _partial(attributes: dict) -> str:
    reason = attributes["stopped"]
    return f"Not the whole sample ({reason}): {attributes['points']} {attributes['unit']} of it."


def _span(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.2g}" if f"{low:.2g}" == f"{high:.2g}" else f"{low:.2g} to {high:.2g}"


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:,.0f} min" if seconds < 6000 else f"{seconds / 3600:,.0f} h"


def microseconds(seconds: float) -> str:
    """A time in microseconds, in three digits."""
    value = 1e6 * seconds
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def error(value: float) -> str:
    """An error in two digits; 0 below what counts, nothing for nan."""
    if math.isnan(value):
        return "-"
    return f"{value:.1e}" if value >= of.EXACT else f"<{of.EXACT:.0e}".replace("e-0", "e-")
