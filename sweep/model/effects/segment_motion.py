"""Motion between segments: the target moves on from one to the next.

A segment that starts at t finds the target at R - u t - a t^2 / 2 and v_r + a t, with u the speed
at which the range along the beam falls. This is 7.5 cm nearer after 500 us at 150 m/s. [T] has all
segments begin at one range (``segment_motion: off``).

Two speeds (docs/physics.md, *The beam slides*). Doppler shifts are those of the scatterers in the
beam, v_r = V.d for the velocity V and the direction d. The range falls by u = (V + R d').n / d.n on
a plane of normal n, as the beam, which turns by d', slides over it. Likewise a = d(V.d)/dt is that
of the beam, V'.d + V.d'.

Beamlets keep their scatterers: their ranges differ by what their own velocities have made of it.

Up and down beat are those of R at the middle t_m of their starts, but for what they mix. Let t_d be
the time from up to down segment, negative if the down-chirp comes first. Their half sum is short of
2 v_r / lambda by the share S t_d / 2 of the optical frequency at mid-chirp. The acceleration
changes the range by a t_d f / (2 S): 0.55 m at 11 m/s^2 for Table 4.1. Range and velocity that are
interpolated are put right for the velocity that is measured with them (as they are for range walk),
by v_r t_m and by that share. Nothing in the beats tells of the acceleration, or of a beam that
slides over slanting ground.

In several looks (:mod:`sweep.model.looks`) segments start as those of the middle look do, to whose
time interpolated ranges are put right, and lines move on by the same number of bins from look to
look. Averaged powers are smeared by that; looks that are counted, added in amplitude or that fade
apart are not followed, and must lie within :data:`MOST_DRIFT`.
"""

import math
from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.doppler import moved_size
from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.looks import MOST_PLACES, NUMBER
from sweep.model.preparation import Shots, doppler_ratio
from sweep.model.unsupported import UnsupportedShot

MOST_DRIFT = 0.25
"""Bins of fs/L from the first look to the last that leave all of them alike: 1 % of the power."""


def size(points: Points) -> Size | None:
    """Change of the largest bin as its line moves, with the phases of lines that add up.

    A line meets its image at the phase of where it has come to. Beamlets with velocities of their
    own turn against each other. If it is off segments begin at one range, by
    the law of [T]: that is no error of the simulation.
    """
    if points.at_one_range or not any(
        np.any(v) for v in (points.radial_velocity, points.approach, points.acceleration)
    ):
        return None
    moved = points.bins_between
    made = moved_size(points, moved)
    if not points.adds_amplitudes:
        return made
    apart = points.velocity_spread.extreme * points.bin_width * points.starts
    turned = np.minimum(2 * np.pi * apart, 2.0) / points.lobe.worst
    cycles = 2 / SPEED_OF_LIGHT * points.carriers * points.metres_between
    imaged = points.image * np.minimum(4 * np.pi * cycles, 2.0)
    added = made.added + 2 * turned + imaged
    return made._replace(added=added)


def act(shots: Shots, scene: Scene) -> Shots:
    """Segments that start one after the other."""
    starts, looks = shots.schedule, shots.looks.number
    middle, half = (starts[2] + starts[0]) / 2, (starts[2] - starts[0]) / 2
    if looks > 1:
        late = 0.5 * (looks - 1) * shots.look_period
        starts, middle = tuple(start + late for start in starts), middle + late
    shots = replace(
        shots,
        starts=starts,
        walk=shots.walk + middle,
        slowing=shots.chirp_rate * half / (shots.carriers[0] + shots.bandwidth / 2),
    )
    return replace(shots, look_drift=drift(shots)) if looks > 1 else shots


def drift(shots: Shots) -> np.ndarray:
    """Bins by which lines of each segment move on from look to look, (segments, n).

    Raises
    ------
    UnsupportedShot
        Of looks that are not followed: they move too far.
    """
    faster = doppler_ratio(shots.acceleration)
    bins = np.zeros((len(shots.waveform), shots.size))
    for s in np.flatnonzero(shots.segments):
        each = shots.waveform[s]
        closing = shots.approach + shots.acceleration * each.start
        beat = each.carrier * faster + each.chirp_rate * (2 / SPEED_OF_LIGHT) * (
            closing * (1 + each.beta) - (shots.range - each.nearer) * faster
        )
        bins[s] = beat * shots.look_period * shots.fft_size / shots.sample_rate
    looks, last = shots.looks, shots.looks.number - 1
    most = float(np.abs(bins).max(initial=0.0)) * last * shots.window.length / shots.fft_size
    faded_apart = looks.independent and shots.architecture != "direct" and shots.incoherent
    limit = MOST_DRIFT if looks.averaged == 1 or faded_apart else math.inf
    if last >= MOST_PLACES:  # as few places stand for all
        limit = min(limit, MOST_PLACES / 2)
    turned = np.abs(shots.doppler).max(initial=0.0) * np.max(shots.carriers[0] * shots.look_period)
    if not shots.incoherent and shots.architecture != "direct" and turned * last > MOST_DRIFT:
        raise UnsupportedShot(
            f"{NUMBER} takes {last + 1} looks in which beamlets of coherent phases turn against "
            f"each other by {turned * last:.3g} cycles, and {MOST_DRIFT} leave them alike: take "
            "fewer, or footprint.phases: incoherent"
        )
    if most > limit:
        raise UnsupportedShot(
            f"{NUMBER} takes {last + 1} looks from the first to the last of which the target moves "
            f"the echo by {most:.3g} bins, and {limit:.3g} is the most that looks of this kind are "
            "followed by: take fewer, shorten instrument.chirp.duration, or take combine: power "
            "with speckle: common"
        )
    return bins


def looks_of(shots: Shots) -> list[Shots]:
    """Shots as each of their looks finds them; themselves where all are alike."""
    if not np.any(shots.look_drift):
        return [shots] * shots.looks.number
    late = np.arange(shots.looks.number) - (shots.looks.number - 1) / 2
    return [
        replace(
            shots, look_drift=0.0, starts=tuple(s + k * shots.look_period for s in shots.starts)
        )
        for k in late
    ]  # fmt: skip


SEGMENT_MOTION = Effect(
    name="segment_motion",
    about="range and velocity that change from segment to segment",
    stage="lines",
    size=size,
    act=act,
)
