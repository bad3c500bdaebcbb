"""One shot of a grid or of a scene: spectra with what is detected in them, drawn and told."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels
from sweep.analysis.selection import GRAZING_ANGLE
from sweep.analysis.tables import Block, Page
from sweep.model import shot as model
from sweep.model import waveform, window
from sweep.model.beam import DIVERGENCE, WAIST
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import CORE, EFFECTS
from sweep.model.eyepoints import Eyepoints
from sweep.model.returns import beamlet_lines
from sweep.model.segments import whole_spectrum
from sweep.model.shot import prepare
from sweep.model.threshold import WAYS
from sweep.spec import Spec, SpecError
from sweep.spec.rules import Mistake
from sweep.spec.sections import parameter_rules
from sweep.units import percent

Parameters = Mapping[str, float | int | str]

NAMES = ("up-chirp", "Doppler", "down-chirp")


@dataclass(frozen=True)
class Group:
    """Places of adjacent bins above the threshold: the first, the last, and the strongest."""

    first: int
    last: int
    peak: int


@dataclass(frozen=True)
class Segment:
    """Spectrum of a segment and what is found in it.

    Bins are in the order of their frequencies, those of a complex record with signs. Frequencies
    and carrier are in Hz; |X| of each bin in V, of the signal alone, and with noise
    where that is drawn. The SNR and the probability of detection are those of the strongest
    bin.
    """

    name: str
    slope: float
    bins: np.ndarray
    frequency: np.ndarray
    signal: np.ndarray
    magnitude: np.ndarray
    beat: float
    carrier: float
    groups: tuple[Group, ...]
    snr: float
    pd: float

    @property
    def peak(self) -> int:
        """Place of the strongest bin."""
        return int(np.argmax(self.magnitude))


@dataclass(frozen=True)
class Shot:
    """One shot: its parameters, levels, spectra, and what it reports."""

    label: str
    parameters: Parameters
    prepared: model.Shots
    outputs: dict[str, float]
    segments: tuple[Segment, ...]
    range: float
    radial_velocity: float

    @property
    def deviation(self) -> float:
        """Noise of a bin, per quadrature [V]."""
        return float(self.prepared.bin_deviation[0])

    @property
    def threshold(self) -> float:
        """Detection threshold on |X| [V]."""
        return float(self.prepared.threshold[0])

    @property
    def noise_level(self) -> float:
        """Root mean square of |X| in a bin of noise [V]."""
        return float(np.sqrt(2)) * self.deviation

    def dbv(self, magnitude: np.ndarray | float) -> np.ndarray:
        """|X| as the amplitude of a tone that would give it, in dB above 1 V."""
        with np.errstate(divide="ignore"):
            return 20 * np.log10(2 * np.asarray(magnitude) / self.prepared.window.sum)

    @property
    def detected(self) -> bool:
        """Tell whether the segments that detect a shot have a group."""
        if self.prepared.any_two:
            return sum(bool(segment.groups) for segment in self.segments) >= 2
        return all(segment.groups for segment in self.segments if segment.name != NAMES[1])


def simulated(
    parameters: Parameters,
    effects: Collection[str] = CORE,
    *,
    label: str = "",
    seed: int | None = None,
) -> Shot:
    """One shot on a flat plane."""
    ((_, prepared),) = prepare(parameters, effects)
    return simulated_shot(prepared, parameters, label=label, seed=seed)


def simulated_shot(
    prepared: model.Shots, parameters: Parameters, *, label: str = "", seed: int | None = None
) -> Shot:
    """One shot that is prepared already, whatever it looks at."""
    found = model.find(prepared)
    segments = tuple(
        _segment(prepared, found[k, :, 0], k, seed) for k in range(3) if prepared.segments[k]
    )
    seen = found.copy()
    for segment in segments:
        seen[NAMES.index(segment.name), 3, 0] = segment.frequency[segment.peak]
    reported = model.report(prepared, seen)
    return Shot(
        label=label,
        parameters=parameters,
        prepared=prepared,
        outputs={name: float(value[0]) for name, value in model.statistics(prepared).items()},
        segments=segments,
        range=float(reported.range[0]),
        radial_velocity=float(reported.radial_velocity[0]),
    )


def _segment(prepared: model.Shots, found: np.ndarray, k: int, seed: int | None) -> Segment:
    bins, signal = prepared.signed_bins, whole_spectrum(prepared, 0, k)
    magnitude, looks = np.abs(signal), prepared.looks
    if seed is not None:
        noise = np.array([
            drawn_noise(prepared, seed=seed, segment=k, look=look).take(bins, mode="wrap")
            for look in range(looks.number)
        ])  # fmt: skip
        noise = noise if looks.added == 1 else noise.mean(axis=0, keepdims=True)
        each = np.abs(signal + noise)
        magnitude = looks.shown(each) if looks.several else each[0]
    segment = prepared.waveform[k]
    carrier = np.asarray(segment.carrier).item()
    beat = waveform.beat_frequency(
        segment.slope,
        carrier=carrier,
        chirp_rate=np.asarray(prepared.chirp_rate),
        range=prepared.range[0] - np.ravel(segment.nearer)[0],
        radial_velocity=np.ravel(segment.beta)[0] * SPEED_OF_LIGHT / 2,
    )
    return Segment(
        name=NAMES[k],
        slope=segment.slope,
        bins=bins,
        frequency=bins * float(prepared.sample_rate[0]) / prepared.fft_size,
        signal=signal,
        magnitude=magnitude,
        beat=np.asarray(beat).item(),
        carrier=carrier,
        groups=groups(magnitude, float(prepared.threshold[0])),
        snr=float(prepared.snr(found[2])[0]),
        pd=float(found[0]),
    )


def drawn_noise(prepared: model.Shots, *, seed: int, segment: int, look: int = 0) -> np.ndarray:
    """Noise of a look's windowed record, spectrum (N/2 + 1,) [V]; (N,) of a complex record.

    It is added to the signal's |X|, whose phase from bin to bin is lost.
    """
    shape = prepared.window
    key = (segment, look) if look else (segment,)
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
    deviation = float(np.sqrt(prepared.noise_variance[0]))
    record = stream.normal(0.0, deviation, shape.length)
    taper = window.samples(shape.name, shape.length)
    if prepared.complex_record:
        quadrature = stream.normal(0.0, deviation, shape.length)
        return np.fft.fft((record + 1j * quadrature) / np.sqrt(2) * taper, prepared.fft_size)
    return np.fft.rfft(record * taper, prepared.fft_size)


def groups(magnitude: np.ndarray, threshold: float) -> tuple[Group, ...]:
    """Find runs of adjacent bins at or above the threshold."""
    above = np.flatnonzero(magnitude >= threshold)
    runs = np.split(above, np.flatnonzero(np.diff(above) > 1) + 1) if above.size else []
    return tuple(
        Group(int(run[0]), int(run[-1]), int(run[np.argmax(magnitude[run])])) for run in runs
    )


def quantity_at(shot: Shot, segment: Segment, frequency: np.ndarray) -> np.ndarray:
    """Range [m] or velocity [m/s] that a frequency seen in a segment stands for near its beat."""
    p = shot.prepared
    rate = float(p.sample_rate[0])
    fold = np.rint(segment.beat / rate) * rate
    turned = segment.beat < fold and not p.complex_record
    signed = fold + (-1.0 if turned else 1.0) * np.asarray(frequency)
    if segment.slope == 0:
        return signed * SPEED_OF_LIGHT / (2 * segment.carrier)
    beta = float(np.asarray(p.beta).flat[0])
    delay_beat = (segment.carrier * beta - signed) / segment.slope
    return delay_beat * SPEED_OF_LIGHT / (2 * np.asarray(p.chirp_rate).item() * (1 + beta))


SPECTRUM, THRESHOLD, NOISE, DETECTION = canvas.LINES[0], canvas.LINES[2], canvas.LINES[1], "black"
MARGIN_BELOW, MARGIN_ABOVE = 25.0, 12.0
"""Decibels shown below the noise level, and above the strongest bin."""

NARROWEST = 12
"""Least half-width of the view around the peak, in bins."""

ROOM = 8
"""Bins shown beside the outermost detections, at least."""

REACH = 0.05
"""Distance from the strongest peak up to which detections are in the same view, of the band."""


def spectra_sheet(
    shots: Sequence[Shot], *, title: str, note: str, detections: bool = False
) -> Sheet:
    """Spectra of shots side by side: a row a segment, the whole band and around the peak."""
    rows, columns = len(shots[0].segments), 2 * len(shots)
    width = 5.4 if len(shots) == 1 else 4.2
    sheet, axes = canvas.panels(width * columns, 3.1 * rows + 1.2, rows, columns)
    limits = _limits(shots)
    for j, shot in enumerate(shots):
        for i, segment in enumerate(shot.segments):
            whole, close = axes[i * columns + 2 * j], axes[i * columns + 2 * j + 1]
            _lines(whole, shot, segment, slice(None), 0.5)
            near = around_detections(segment) if detections else around_peak(segment.signal)
            _lines(close, shot, segment, near, 1.0)
            _explain(close, shot, segment)
            for panel in (whole, close):
                panel.set_ylim(*limits)
                panel.grid(True)
            if not segment.groups:
                whole.text(
                    0.02, 0.95, "no detection", transform=whole.transAxes, color=DETECTION,
                    va="top", size=9,
                )  # fmt: skip
            whole.set_title(", ".join(filter(None, [segment.name, shot.label])), size=10)
            if j == 0:
                whole.set_ylabel("amplitude (dB re 1 V)")
    axes[0].legend(fontsize=7.5, loc="upper right", framealpha=0.9, ncols=3)
    for panel in axes[(rows - 1) * columns :]:
        panel.set_xlabel("frequency (MHz)")
    canvas.title(sheet, title)
    canvas.caption(sheet, note)
    return sheet


def _limits(shots: Sequence[Shot]) -> tuple[float, float]:
    """Decibels that show all of the noise and of the peaks."""
    low = min(float(shot.dbv(shot.noise_level)) for shot in shots) - MARGIN_BELOW
    high = max(
        float(shot.dbv(max(segment.magnitude.max(), shot.threshold)))
        for shot in shots
        for segment in shot.segments
    )
    return low, high + MARGIN_ABOVE


def _lines(axes: Axes, shot: Shot, segment: Segment, chosen: slice, width: float) -> None:
    """Spectrum, threshold, noise level and detections."""
    mhz = segment.frequency[chosen] / 1e6
    level = np.maximum(shot.dbv(segment.magnitude[chosen]), -500.0)
    marker = "." if mhz.size <= 200 else ""
    axes.plot(mhz, level, color=SPECTRUM, linewidth=width, marker=marker, markersize=4)
    for value, colour, dash, words in (
        (shot.threshold, THRESHOLD, "--", "threshold"),
        (shot.noise_level, NOISE, "-.", "noise (rms)"),
    ):
        height = float(shot.dbv(value))
        axes.axhline(height, color=colour, linestyle=dash, linewidth=1.2, label=words)
    peaks = np.array([group.peak for group in segment.groups], dtype=int)
    axes.plot(
        segment.frequency[peaks] / 1e6, shot.dbv(segment.magnitude[peaks]), linestyle="",
        marker="v", markersize=7, color=DETECTION, markeredgecolor="white", label="detection",
    )  # fmt: skip
    axes.set_xlim(float(mhz[0]), float(mhz[-1]))


def _explain(axes: Axes, shot: Shot, segment: Segment) -> None:
    """Signal-to-noise ratio and pd in a corner, range or velocity of the frequencies on top."""
    told = [f"signal-to-noise {10 * np.log10(segment.snr):.1f} dB"] if segment.snr > 0 else []
    axes.text(
        0.98, 0.95, "\n".join([*told, f"pd {segment.pd:.4g}"]), transform=axes.transAxes,
        size=8, color=DETECTION, ha="right", va="top",
    )  # fmt: skip
    first, second = (float(q) for q in quantity_at(shot, segment, np.array([0.0, 1e6])))

    def meaning(mhz: Any) -> Any:
        return first + (second - first) * mhz

    def frequency(value: Any) -> Any:
        return (value - first) / (second - first)

    top = axes.secondary_xaxis("top", functions=(meaning, frequency))
    top.set_xlabel("range (m)" if segment.slope else "radial velocity (m/s)", size=8, labelpad=4)
    top.tick_params(labelsize=8)
    top.ticklabel_format(axis="x", useOffset=False)
    axes.ticklabel_format(axis="x", useOffset=False)


def around_peak(magnitude: np.ndarray) -> slice:
    """Bins that show the peak and what spreads around it, down to a tenth of its height."""
    peak = int(np.argmax(magnitude))
    strong = np.flatnonzero(magnitude >= 0.1 * magnitude[peak])
    near = strong[np.abs(strong - peak) < magnitude.size // 8]
    half = max(NARROWEST, int(1.5 * max(peak - near[0], near[-1] - peak)))
    return slice(max(peak - half, 0), min(peak + half + 1, magnitude.size))


def around_detections(segment: Segment) -> slice:
    """Bins that show all detections near to the strongest peak, and what spreads around it."""
    view, size = around_peak(segment.signal), segment.signal.size
    peak = int(np.argmax(segment.signal))
    near = [group for group in segment.groups if abs(group.peak - peak) <= REACH * size]
    if not near:
        return view
    first, last = min(g.first for g in near), max(g.last for g in near)
    room = max(ROOM, (last - first) // 6)
    return slice(max(min(view.start, first - room), 0), min(max(view.stop, last + room + 1), size))


def scene_shot_sheet(
    shot: Shot,
    eyepoints: Eyepoints,
    surfaces: Sequence[str],
    *,
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """Spectra of a shot of a scene, and where its beamlets' lines are."""
    notes = [*remarks, "marks at the foot: where the beamlets' own lines are, by surface"]
    sheet = spectra_sheet([shot], title=title, note=labels.joined(notes), detections=True)
    hit, lines = eyepoints.surface[0] >= 0, beamlet_lines(shot.prepared)[0]
    width = float(shot.prepared.sample_rate[0]) / shot.prepared.fft_size
    for i, segment in enumerate(shot.segments):
        places = lines[NAMES.index(segment.name), hit] * width / 1e6
        close = sheet.axes[2 * i + 1]
        marks = [
            close.plot(
                own, np.full(own.size, 0.02), "|", transform=close.get_xaxis_transform(),
                color=canvas.LINES[k % 8], markersize=9, scalex=False, scaley=False,
                label=surfaces[number],
            )[0]
            for k, number in enumerate(np.unique(eyepoints.surface[0, hit]))
            for own in [places[eyepoints.surface[0, hit] == number]]
        ]  # fmt: skip
        if i == 0:
            close.legend(handles=marks, fontsize=7.5, loc="upper left", framealpha=0.9)
    return sheet


def _noise(shot: Shot) -> Block:
    """Noise at the ADC by source, in volts and shares of the variance."""
    sources = {n: float(np.asarray(v).item()) for n, v in shot.prepared.noise_sources.items()}
    total = sum(sources.values())
    rows = [
        (name.replace("_", " "), f"{math.sqrt(value):.4e}", percent(value / total, ".4g"))
        for name, value in sorted(sources.items(), key=lambda item: -item[1])
        if value > 0
    ]
    rows.append(("total", f"{math.sqrt(total):.4e}", percent(1.0, ".4g")))
    return Block("Noise at the ADC", ("source", "V rms", "share"), rows)


def _segments(shot: Shot) -> Block:
    columns = (
        "segment", "beat (MHz)", "seen (MHz)", "peak bin", "level (dBV)", "SNR (dB)", "pd",
        "groups",
    )  # fmt: skip
    heading = (
        f"Segments (noise of a bin {shot.dbv(shot.noise_level):.1f} dBV rms, threshold "
        f"{shot.dbv(shot.threshold):.1f} dBV)"
    )
    rows = [
        (
            segment.name, f"{segment.beat / 1e6:+.6f}",
            f"{segment.frequency[segment.peak] / 1e6:.6f}", int(segment.bins[segment.peak]),
            f"{shot.dbv(segment.magnitude[segment.peak]):.1f}",
            f"{10 * math.log10(segment.snr):.2f}" if segment.snr > 0 else "-",
            f"{segment.pd:.6g}", len(segment.groups),
        )
        for segment in shot.segments
    ]  # fmt: skip
    return Block(heading, columns, rows)


def _report(shot: Shot) -> Block:
    """Range and radial velocity: true, reported, and the error in the units of a bin."""
    p = shot.prepared
    rows = [
        (name, f"{true:.{digits}f}", f"{found:.{digits}f}", f"{found - true:+.{digits}f}")
        for name, digits, true, found in (
            ("range (m)", 4, float(p.range[0]), shot.range),
            ("radial velocity (m/s)", 5, float(p.radial_velocity[0]), shot.radial_velocity),
        )
    ]
    verdict = "detected" if shot.detected else "NOT detected: read off the strongest bins"
    return Block(f"Report ({verdict})", ("", "true", "reported", "error"), rows)


def _false_alarms(shot: Shot) -> Block:
    words = {
        "pfa_bin": "one bin, noise", "pfa_segment": "up-chirp segment, noise",
        "pfa_both_chirps": "both chirp segments, noise", "pfa_shot": "any segment, noise",
        "p_leakage_up": "up-chirp segment, leakage",
        "p_leakage_down": "down-chirp segment, leakage",
    }  # fmt: skip
    rows = [(told, f"{shot.outputs[name]:.4e}") for name, told in words.items()]
    return Block("False alarms", ("", "probability"), rows)


MOST_SHOTS = 3
"""Values of a study's only axis up to which each is drawn."""

_TOLD = (
    "target.range", "target.grazing_angle", "target.radial_velocity", "target.reflectance",
    "target.reflectance_law", "instrument.laser.power", "instrument.telescope.aperture",
    DIVERGENCE, WAIST, "instrument.processing.fft_size", "instrument.processing.window", *WAYS,
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
    """Spectra, threshold, noise level and detections of one shot: text, and the files written.

    Parameters on an axis take the values in `at`, written with their units, or the first; a
    study with a single axis of few values is drawn at each of them. SpecError for what can't be
    read.
    """
    modes = spec.modes()
    effects = [e.name for e in EFFECTS if not e.is_random and modes[e.name] != "off"]
    shots = [
        simulated(parameters, effects, label=label, seed=seed if noise else None)
        for label, parameters in chosen(spec, at)
    ]
    asked = [re.sub(r"[^A-Za-z0-9.+-]+", "", f"{name.split('.')[-1]}{v}") for name, v in at.items()]
    directory, stem = Path(directory), "_".join(["shot", *asked])[:120]
    remark = f"noise drawn with seed {seed}" if noise else "the signal alone, no noise drawn"
    with canvas.style():
        sheet = spectra_sheet(shots, title=spec.title, note=labels.joined([remark, _held(shots)]))
        files = [canvas.save(sheet, directory / f"{stem}.{form}"), directory / f"{stem}.txt"]
    page = Page(spec.title, _blocks(shots), [f"Spectra: {remark}."], [])
    files[1].write_text(page.text(), encoding="utf-8")
    return page.text(), files


def chosen(spec: Spec, at: Mapping[str, str]) -> list[tuple[str, Parameters]]:
    """Parameters of the shots to draw, each with its label."""
    members = [member for axis in spec.axes for member in axis.members]
    paths, rules = {m.name: m.path for m in members}, parameter_rules()
    names_by_path: dict[str, str] = {}
    for name in at:
        path = paths.get(name, name)
        if path in names_by_path:
            rule = f"is given twice, as {names_by_path[path]} and as {name}"
            raise SpecError([Mistake(path, rule, suggestion="keep one of them")])
        names_by_path[path] = name
    several = not at and len(spec.axes) == 1 and spec.axes[0].size <= MOST_SHOTS
    found: list[tuple[str, Parameters]] = []
    for i in range(spec.axes[0].size if several else 1):
        written: dict[str, object] = {m.path: rules[m.path].written(m.values[i]) for m in members}
        # what is no coordinate is left for the spec to read, or to refuse
        written |= {paths.get(name, name): value for name, value in at.items()}
        label = ", ".join(labels.valued(m.name, m.display[i], m.units) for m in members)
        found.append((label if several else "", spec.parameters_at(written)))
    return found


def _told(shot: Shot, paths: tuple[str, ...]) -> list[tuple[str, str]]:
    """Parameters as a user would write them, by name."""
    rules = parameter_rules()
    told = []
    for path in paths:
        value = shot.parameters.get(path)
        if value is None:  # the threshold is set otherwise
            continue
        if path in (DIVERGENCE, WAIST) and value == 0:  # the beam is stated by the other one
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
        every = [_noise(shot), _segments(shot), _report(shot), _false_alarms(shot)]
        found += [parameters, *(Block(prefix + b.heading, b.columns, b.rows) for b in every)]
    return found
