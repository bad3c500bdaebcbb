"""The report of one shot in words: noise by source, segments, range and velocity."""

from __future__ import annotations

import math

import numpy as np

from sweep.analysis.shot_spectra import Segment, Shot
from sweep.analysis.tabular import Block, Cell, percent


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
        ["both chirp segments, noise", f"{o['pfa_shot']:.4e}"],
        ["up-chirp segment, leakage", f"{o['p_leakage_up']:.4e}"],
        ["down-chirp segment, leakage", f"{o['p_leakage_down']:.4e}"],
    ]
    return Block("False alarms", ("", "probability"), rows)
