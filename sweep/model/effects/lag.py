"""Beams that part: the sent one and the local oscillator's are not in the same place at the target.

A scanner has turned on by omega 2R/c before the light is back, so that the receiver looks where it
no longer transmits. The parallax of a bistatic pair and a misalignment do the same. Of the light
that one mode collects exp(-2 d^2 / (w_T^2 + w_L^2)) is left, d the distance of the axes
(:mod:`sweep.model.beam`). If all light in the aperture mixes, nothing is lost.
"""

from dataclasses import replace

import numpy as np

from sweep.model import beam
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points, by_power
from sweep.model.preparation import Shots


def size(points: Points) -> Size | None:
    """Loss of the echo, and of its shot noise."""
    paths = beam.SCAN_RATE, beam.SEPARATION, beam.MISALIGNMENT
    if not (beam.is_single_mode(points.parameters) and points.has(*paths)):
        return None
    lost = 1 - beam.offset_loss(points.parameters, points.range)
    light = points.echo_noise
    return Size(
        magnitude=by_power(lost), noise=-lost * light / (1 + light), threshold_follows=False
    )


def part(shots: Shots, scene: Scene) -> Shots:
    """Echoes that the local oscillator misses in part."""
    if not beam.is_single_mode(scene.parameters):
        return shots
    left = beam.offset_loss(scene.parameters, shots.range)
    return replace(
        shots,
        echo_scale=shots.echo_scale * left,
        beat_scale=shots.beat_scale * np.sqrt(left),
    )


LAG = Effect(
    name="lag",
    about="a receiver that looks beside the sent beam: lag of a scan, parallax, misalignment",
    stage="light",
    size=size,
    act=part,
    parameters=(
        Parameter(
            path=beam.SCAN_RATE,
            about="Rate at which a scan turns the beams, in flights besides scanner and platform; "
            "single_mode only, as the two that follow, which add to its lag where signs agree",
            example="100 deg/s",
            limits=("-1e6 rad/s", "1e6 rad/s"),
        ),
        Parameter(
            path=beam.SEPARATION,
            about="Distance of the received beam's axis from the sent one's at the instrument",
            example="40 mm",
            limits=("-1 km", "1 km"),
            si_unit="m",
        ),
        Parameter(
            path=beam.MISALIGNMENT,
            about="Angle of the received beam's axis off the sent one's",
            example="5 urad",
            limits=("-10 deg", "10 deg"),
            si_unit="rad",
        ),
    ),
)
