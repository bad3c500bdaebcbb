"""One shot of a study, drawn and reported."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sweep.analysis import canvas, labels, shot_drawing
from sweep.analysis.cuts import GRAZING_ANGLE
from sweep.analysis.shot_spectra import Parameters, Segment, Shot, simulated
from sweep.analysis.tabular import Block, Cell, Page, percent
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.threshold import WAYS
from sweep.spec import Spec
from sweep.spec.fields import parameter_rules


def blocks(shot: Shot) -> list[Block]:
    """Tables of a shot."""
    return [_noise(shot), _segments(shot), _report(shot), _false_alarms(shot)]


def _noise(shot: Shot) -> Block:
    """Noise at the ADC by source, in volts and shares of the variance."""
    sources = {
        name: float(np.asarray(value).item()) for name, value in shot.prepared.noise_sources.items()
    }
    total = sum(sources.values())
    rows: list[list[Cell]] = [
        [name.replace("_", " "), f"{math.sqrt(value):.4e}", percent(value / total, ".4g")]
        for name, value in sorted(sources.items(), key=lambda item: -item[1])
        if value > 0
    ]
    rows.append(["total", f"{math.sqrt(total):.4e}", percent(1.0, ".4g")])
    return Block("Noise at the ADC", ("source", "V rms", "share"), rows)


def _segments(shot: Shot) -> Block:
    columns = (
        "segment", "beat (MHz)", "seen at (MHz)", "peak bin", "level (dBV)", "SNR (dB)", "pd",
        "groups",
    )  # fmt: skip
    heading = (
        f"Segments (noise of a bin {shot.dbv(shot.noise_level):.1f} dBV rms, threshold "
        f"{shot.dbv(shot.threshold):.1f} dBV)"
    )
    return Block(heading, columns, [_segment_row(shot, segment) for segment in shot.segments])


def _segment_row(shot: Shot, segment: Segment) -> list[Cell]:
    peak = segment.peak
    return [
        segment.name,
        f"{segment.beat / 1e6:+.6f}",
        f"{segment.frequency[peak] / 1e6:.6f}",
        peak,
        f"{shot.dbv(segment.magnitude[peak]):.1f}",
        f"{10 * math.log10(segment.snr):.2f}" if segment.snr > 0 else "-",
        f"{segment.pd:.6g}",
        len(segment.groups),
    ]


def _report(shot: Shot) -> Block:
    """Range and radial velocity: true, reported, and the error in the units of a bin."""
    p = shot.prepared
    true = float(p.range[0]), float(p.radial_velocity[0])
    rows = [
        ["range (m)", f"{true[0]:.4f}", f"{shot.range:.4f}", f"{shot.range - true[0]:+.4f}"],
        [
            "radial velocity (m/s)", f"{true[1]:.5f}", f"{shot.radial_velocity:.5f}",
            f"{shot.radial_velocity - true[1]:+.5f}",
        ],
    ]  # fmt: skip
    verdict = "detected" if shot.detected else "NOT detected: read off the strongest bins"
    return Block(f"Report ({verdict})", ("", "true", "reported", "error"), rows)


def _false_alarms(shot: Shot) -> Block:
    o = shot.outputs
    rows = [
        ["one bin, noise", f"{o['pfa_bin']:.4e}"],
        ["up-chirp segment, noise", f"{o['pfa_segment']:.4e}"],
        ["both chirp segments, noise", f"{o['pfa_both_chirps']:.4e}"],
        ["any segment, noise", f"{o['pfa_shot']:.4e}"],
        ["up-chirp segment, leakage", f"{o['p_leakage_up']:.4e}"],
        ["down-chirp segment, leakage", f"{o['p_leakage_down']:.4e}"],
    ]
    return Block("False alarms", ("", "probability"), rows)


MOST_SHOTS = 3
"""Values of a study's only axis up to which each is drawn."""

_TOLD = (
    "target.range", "target.grazing_angle", "target.radial_velocity", "target.reflectance",
    "target.reflectance_law", "instrument.laser.power", "instrument.telescope.aperture",
    "instrument.laser.beam_divergence", "instrument.processing.fft_size",
    "instrument.processing.window", *WAYS,
)  # fmt: skip


def report(
    spec: Spec,
    at: Mapping[str, str],
    directory: str | Path,
    *,
    noise: bool = False,
    seed: int = 0,
    form: str = "png",
) -> tuple[str, list[Path]]:
    """Spectra, threshold, noise level and detections of one shot, and what it reports.

    Parameters
    ----------
    spec
        The study. Parameters on an axis take its first value; a study with a single axis of few
        values is drawn at each of them.
    at
        Values to take instead, written with their units, by coordinate or dotted path.
    directory
        Where to put the figure and the text.
    noise, seed
        Whether to add noise to the spectra, and its seed.
    form
        ``png``, ``pdf`` or ``svg``.

    Returns
    -------
    text : str
        Noise budget, segments, range and velocity, false alarms.
    files : list of Path
        The figure and the text.

    Raises
    ------
    SpecError
        For names and values in `at` that cannot be read.
    """
    modes = spec.modes()
    effects = [e.name for e in EFFECTS if not e.is_random and modes[e.name] != "off"]
    shots = [
        simulated(parameters, effects, label=label, seed=seed if noise else None)
        for label, parameters in chosen(spec, at)
    ]
    directory, stem = Path(directory), _stem(at)
    remark = f"noise drawn with seed {seed}" if noise else "the signal alone, no noise drawn"
    with canvas.style():
        sheet = shot_drawing.draw(
            shots, title=spec.title, note=labels.joined([remark, _held(shots)])
        )
        files = [canvas.save(sheet, directory / f"{stem}.{form}"), directory / f"{stem}.txt"]
    page = Page(spec.title, _blocks(shots), [f"Spectra: {remark}."], [])
    files[1].write_text(page.text(), encoding="utf-8")
    return page.text(), files


def chosen(spec: Spec, at: Mapping[str, str]) -> list[tuple[str, Parameters]]:
    """Parameters of the shots to draw, each with its label.

    Raises
    ------
    SpecError
        For names and values in `at` that cannot be read.
    """
    written = {_path(spec, name): value for name, value in at.items()}
    if at or len(spec.axes) != 1 or spec.axes[0].size > MOST_SHOTS:
        return [("", spec.parameters_at(_position(spec, [0] * len(spec.axes)) | written))]
    axis = spec.axes[0]
    return [
        (
            ", ".join(
                f"{labels.coordinate(m.name)} {labels.quantity(m.display[i], m.units)}"
                for m in axis.members
            ),
            spec.parameters_at(_position(spec, [i])),
        )
        for i in range(axis.size)
    ]


def _path(spec: Spec, name: str) -> str:
    """Dotted path of a coordinate; what is none is left for the spec to refuse."""
    try:
        return spec.member(name).path
    except KeyError:
        return name


def _position(spec: Spec, index: list[int]) -> dict[str, object]:
    """Values at a position on the axes, as one would write them."""
    return {
        member.path: parameter_rules()[member.path].written(member.values[i])
        for axis, i in zip(spec.axes, index, strict=True)
        for member in axis.members
    }


def _stem(at: Mapping[str, str]) -> str:
    """Name of the files: `shot`, and what was asked for."""
    words = [re.sub(r"[^A-Za-z0-9.+-]+", "", f"{name.split('.')[-1]}{v}") for name, v in at.items()]
    return "_".join(["shot", *words])[:120]


def _told(shot: Shot, paths: tuple[str, ...]) -> list[tuple[str, str]]:
    """Parameters as a user would write them, by name."""
    rules = parameter_rules()
    told = []
    for path in paths:
        value = shot.parameters.get(path)
        if value is None:  # the threshold is set otherwise
            continue
        if isinstance(value, str):
            text = value
        elif path == GRAZING_ANGLE:
            text = labels.quantity(math.degrees(value), "deg")
        else:
            text = labels.prefixed(value, rules[path].units)
        told.append((labels.coordinate(path.rsplit(".", 1)[-1]), text))
    return told


def _held(shots: list[Shot]) -> str:
    """Parameters that all shots share, in a line."""
    every = [_told(shot, _TOLD) for shot in shots]
    return ", ".join(
        f"{name} {text}" for name, text in every[0] if all((name, text) in e for e in every)
    )


def _blocks(shots: list[Shot]) -> list[Block]:
    """Tables of all shots, each under its label."""
    found = []
    for shot in shots:
        prefix = f"{shot.label}: " if shot.label else ""
        parameters = Block(f"{prefix}Shot", ("parameter", "value"), _told(shot, _TOLD))
        found += [parameters]
        found += [Block(prefix + b.heading, b.columns, b.rows) for b in blocks(shot)]
    return found
