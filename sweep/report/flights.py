"""What came back along a flight, how it navigates, and the noise on its way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas
import plotly.graph_objects as go

from sweep.analysis import labels
from sweep.analysis.opening import NotAStoreError
from sweep.analysis.scenes.errors_over_altitude import Curve, curves, navigates
from sweep.analysis.scenes.eyepoints import eyepoints_of, read_eyepoints
from sweep.analysis.scenes.figures import SceneStudy
from sweep.analysis.scenes.quantities import KINDS, kinds, label, shown
from sweep.analysis.scenes.recording import Thinned
from sweep.model.effects.catalogue import names_of
from sweep.model.eyepoints import prepare_eyepoints
from sweep.report import looks, wording
from sweep.report.clouds import Seen
from sweep.report.page import Chart, Control, Table, when

SHOTS = ("pd_shot", "snr_up", "beam_range", "beam_radial_velocity", "pfa_up")
"""Quantities of shots that are shown over time."""

MOST_SHOTS = 12_000
"""Shots of all charts over time of a page together."""

BINS = 20
"""Bins of altitude that errors are told in."""

PLACES = 24
"""Shots of a flight at which the noise is told by source."""


def along(found: list[Seen]) -> Chart:
    """Quantities of shots over time."""
    traces, told = [], []
    quantities = [name for name in SHOTS if name in found[0].recording.dataset]
    thinned = [_thinned(seen, quantities, MOST_SHOTS // len(found)) for seen in found]
    for seen, rows in zip(found, thinned, strict=True):
        table = rows.rows()
        for name in quantities if table else ():
            values = shown(name, table[name])
            told.append(f"{label(name)}: {wording.spread(values)}" if seen is found[0] else "")
            for number, beam in enumerate(_beams(table)):
                own = slice(None) if beam < 0 else table["beam"] == beam
                traces.append(
                    go.Scatter(
                        x=table["time"][own].astype(np.float32),
                        y=values[own].astype(np.float32),
                        mode="markers",
                        marker={"size": 5, "symbol": number % 8},
                        name=f"beam {beam}" if beam >= 0 else "all beams",
                        meta=when(number, cloud=seen.words, quantity=label(name)),
                    )
                )
    every = max(rows.every for rows in thinned)
    return Chart(
        heading="Shots over time",
        alt=f"Marks of a quantity of each shot over time. {'; '.join(filter(None, told))}.",
        caption=wording.sentences(
            [f"One shot in {every} shown: reduced for this page" if every > 1 else ""]
        ),
        figure=go.Figure(
            traces, looks.layout(xaxis=looks.axis("time (s)"), yaxis=looks.upright(""))
        ),
        controls=[
            Control("cloud", "Shown for", [seen.words for seen in found]),
            Control(
                "quantity",
                "Quantity",
                [label(name) for name in quantities],
                {label(name): _side(label(name), chance=name == "pd_shot") for name in quantities},
            ),
        ],
    )


def _side(words: str, *, chance: bool) -> dict[str, Any]:
    """What a choice of a quantity changes of a chart: name and limits at its side."""
    return {"yaxis.title.text": looks.broken(words, 36)} | (looks.CHANCES if chance else {})


def _thinned(seen: Seen, names: list[str], most: int) -> Thinned:
    rows = Thinned(most)
    for part in seen.recording.stretches():
        table = {name: seen.recording.read(name, part) for name in (*names, "time", "beam")}
        known = np.isfinite(table["time"])
        rows.add({name: values[known] for name, values in table.items()})
    return rows


def _beams(table: dict[str, np.ndarray]) -> list[int]:
    """Beams to show apart; all together, as -1, where there are more than colours."""
    beams = np.unique(table["beam"])
    return [int(b) for b in beams] if beams.size <= len(looks.DASHES) else [-1]


def returns(found: list[Seen]) -> Table:
    """What came back to each scanner: shots, and points by kind, over all draws."""
    rows = []
    for seen in found:
        counts = dict.fromkeys(KINDS, 0)
        shots = 0
        for part in seen.recording.stretches():
            flags = np.asarray(seen.recording.dataset["flags"].isel(shot=part).values)
            shots += flags.shape[0] * flags.shape[1]
            number = np.bincount(kinds(flags).ravel() + 1, minlength=len(KINDS) + 1)[1:]
            counts = {name: counts[name] + int(n) for name, n in zip(KINDS, number, strict=True)}
        named = {labels.coordinate(name): number for name, number in counts.items()}
        rows.append({"what": seen.words or "all", "shots": shots} | named)
    return Table(
        "What came back",
        ["Shots times draws, and points by kind."],
        pandas.DataFrame(rows),
        "returns",
    )


def navigation(found: list[Seen]) -> Chart | None:
    """Errors of velocity and altitude over altitude; none where no scanner navigates."""
    traces: list[go.Scatter] = []
    able = [seen for seen in found if navigates(seen.recording)]
    options: list[str] = []
    for quantity in ("velocity", "altitude"):
        for number, seen in enumerate(able):
            for curve in curves([seen.recording], quantity=quantity, bins=BINS):
                for option, y, dash in _statistics(curve, quantity):
                    options.append(option)
                    stated = dash == "dot"
                    traces.append(
                        go.Scatter(
                            x=curve.middle,
                            y=y,
                            mode="lines+markers",
                            connectgaps=True,
                            name=f"{seen.words or 'measured'}{', as stated' if stated else ''}",
                            line={"dash": dash, "width": 2},
                            meta=when(number, statistic=option),
                        )
                    )
    if not traces:
        return None
    options = list(dict.fromkeys(options))
    return Chart(
        heading="Navigation",
        alt=f"Lines of navigation's errors over altitude: {', '.join(options)}.",
        caption=[f"In {BINS} bins of altitude, over all draws. As stated: the root of the mean "
                 "variance that solutions give for themselves."],
        figure=go.Figure(
            traces,
            looks.layout(xaxis=looks.axis("altitude above ground (m)"), yaxis=looks.upright("")),
        ),
        controls=[
            Control("statistic", "Shown", options,
                    {option: _side(option, chance="share" in option) for option in options})
        ],
    )  # fmt: skip


def _statistics(curve: Curve, quantity: str) -> Iterator[tuple[str, np.ndarray, str]]:
    """Statistics of a curve with the words of the option that shows them, and their dash."""
    units = "m/s" if quantity == "velocity" else "m"
    yield f"{quantity}: share of cycles solved", curve.tally.availability, "solid"
    error = f"{quantity}: root mean square error ({units})"
    yield error, curve.rmse[:, -1], "solid"
    yield error, curve.predicted[:, -1], "dot"
    components = "xyz" if quantity == "velocity" else [""]
    for k, component in enumerate(components):
        words = f"{quantity} {component}".strip()
        yield f"{words}: bias ({units})", curve.bias[:, k], "solid"


def noise_budget(study: SceneStudy, found: list[Seen]) -> Chart | None:
    """Share of each source in the noise along the flight; none where eyepoints are gone."""
    traces: list[go.Scatter] = []
    try:
        for seen in found:
            traces += _budget(study, seen)
    except NotAStoreError:
        return None
    if not traces:
        return None
    return Chart(
        heading="Noise by source",
        alt="Areas of the shares of noise sources in the noise variance at the ADC over time: "
        + ", ".join(f"{t.name} {t.y[0]:.3g} % at first" for t in traces
                    if t.meta["when"]["cloud"] == found[0].words) + ".",
        caption=["Shares of the variance at the ADC in shots spread over the flight, simulated for "
                 "this page with the effects that the study simulates."],
        figure=go.Figure(
            traces,
            looks.layout(
                xaxis=looks.axis("time (s)"), hovermode="x unified",
                yaxis=looks.upright("share of the noise variance (%)", range=[0, 100]),
            ),
        ),
        controls=[Control("cloud", "Shown for", [seen.words for seen in found])],
    )  # fmt: skip


def _budget(study: SceneStudy, seen: Seen) -> list[go.Scatter]:
    """An area for each source, from some of the shots that see something."""
    recording = seen.recording
    number = recording.shots
    shots = np.unique(np.linspace(0, number - 1, min(PLACES, number)).round().astype(int))
    eyepoints = read_eyepoints(eyepoints_of(study.path, recording.dataset), shots)
    place = np.flatnonzero(eyepoints.seen)
    flags = np.asarray(recording.dataset["effects"].isel(shot=shots[place]).values)
    budgets = []
    for i, flag in zip(place, flags, strict=True):
        prepared = prepare_eyepoints(
            eyepoints.some(np.array([i])), seen.at.parameters(study.spec), study.spec.surfaces(),
            names_of(int(flag)),
        )  # fmt: skip
        sources = {n: float(np.ravel(v)[0]) for n, v in prepared.noise_sources.items()}
        budgets.append({n.replace("_", " "): v for n, v in sources.items() if v > 0})
    names = list(dict.fromkeys(name for budget in budgets for name in budget))
    total = np.array([sum(budget.values()) for budget in budgets])
    return [
        go.Scatter(
            x=eyepoints.time[place],
            y=100 * np.array([budget.get(name, 0.0) for budget in budgets]) / total,
            name=name, stackgroup=seen.words or "all", mode="lines",
            hovertemplate="%{y:.3g} %", meta=when(k, cloud=seen.words),
        )
        for k, name in enumerate(names)
    ]  # fmt: skip
