"""Pointing jitter over a plane: a random turn of the beam, draw by draw.

The beam is thrown off by two independent normal angles of deviation sigma, a in the plane of
incidence (towards grazing) and b across it. From the same height over the same plane it then
meets

    sin(grazing') = sin(grazing) cos(t) - a cos(grazing) sin(t)/t,     t^2 = a^2 + b^2
    range' = range sin(grazing) / sin(grazing'),

to first order range (1 + a cot(grazing)); along the normal, range (1 + t^2/2). The instrument
knows nothing of it: its reports are of the turned beam.

It acts before everything else, on the geometry of a draw, from which echo, lines and noise follow
as ever; the footprint turns with its axis. Where phases follow the geometry, the footprint of
every draw fades anew.

Of the velocity, a plane's target gives what lies along the beam. What lies across may be given
too; the turned beam sees v_r cos(t) + (v_a a + v_b b) sin(t)/t.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Parameter, Realisation
from sweep.model.effects.span import Span
from sweep.model.philox import STREAM_POINTING_JITTER, normal_pair

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

RARE = 1e-6
"""Chance of a draw whose beam is further off than :func:`turned_change` takes it to be."""


_JITTER = "target.pointing_jitter"


class Turned(NamedTuple):
    """What a turned beam meets, each of the broadcast shape; nan where it misses the plane."""

    range: np.ndarray
    """[m]"""
    grazing_angle: np.ndarray
    """[rad]"""
    radial_velocity: np.ndarray
    """[m/s], positive when closing."""


def angles(realisation: Realisation, sigma: np.ndarray) -> np.ndarray:
    """Angles (a, b) by which beams of this standard deviation are off, (n, 2) [rad]."""
    values = np.empty((realisation.draw.size, 2))
    _draw(realisation.keys, realisation.draw, STREAM_POINTING_JITTER, values)
    return values * np.asarray(sigma, float)[..., None]


@njit(cache=True, nogil=True)
def _draw(keys, draw, stream, out):
    """One pair of standard normal numbers for each point's draw."""
    for i in range(draw.size):
        out[i, 0], out[i, 1] = normal_pair(keys[i, 0], keys[i, 1], draw[i], stream, 0)


def turned(
    *,
    range: ArrayLike,
    grazing_angle: ArrayLike,
    radial_velocity: ArrayLike,
    angles: np.ndarray,
    velocity_across: ArrayLike = (0.0, 0.0),
) -> Turned:
    """Geometry of beams that are off by some angles.

    Parameters
    ----------
    range, grazing_angle, radial_velocity : array_like
        Of the beam's axis as aimed [m, rad, m/s]; broadcast against the angles' leading axes.
    angles : (..., 2) ndarray
        a, positive towards grazing (upwards), and b [rad].
    velocity_across : (..., 2) array_like
        The instrument's velocity along the directions of a and b [m/s].
    """
    aimed, off = np.asarray(grazing_angle, float), np.asarray(angles, float)
    angle = np.hypot(off[..., 0], off[..., 1])
    ratio, cosine = np.sinc(angle / math.pi), np.cos(angle)
    sine = np.sin(aimed) * cosine - off[..., 0] * np.cos(aimed) * ratio
    ahead = np.cos(aimed) * cosine + off[..., 0] * np.sin(aimed) * ratio
    grazing = np.arctan2(sine, np.hypot(ahead, off[..., 1] * ratio))
    across = (np.asarray(velocity_across, float) * off).sum(axis=-1) * ratio
    hits = sine > 0
    far = np.asarray(range, float) * np.sin(aimed) / np.where(hits, sine, 1.0)
    return Turned(
        np.where(hits, far, np.nan),
        np.where(hits, grazing, np.nan),
        np.asarray(radial_velocity, float) * cosine + across,
    )


def turned_change(
    *,
    sigma: ArrayLike,
    range: ArrayLike,
    grazing_angle: ArrayLike,
    radial_velocity: ArrayLike,
    wavelength: ArrayLike,
    beam_divergence: ArrayLike,
    chirp_rate: ArrayLike,
    sample_rate: ArrayLike,
    fft_size: ArrayLike,
    bandwidths: tuple[ArrayLike, ArrayLike],
    signal_shot_share: ArrayLike,
    reach: float,
    single: bool,
    coherent: bool,
    direct: bool = False,
    speed_across: ArrayLike = 0.0,
    record: ArrayLike = 1.0,
    spread: ArrayLike = 0.0,
    edge: ArrayLike = np.inf,
    tail: Callable[[np.ndarray], np.ndarray] = np.zeros_like,
) -> Change:
    """What jitter can change in the detecting bin and its noise, in all draws but few.

    A draw is off by more than t = sigma sqrt(2 ln(1/RARE)) in a share ``RARE`` of all draws. Down
    to the footprint's lowest beamlet, t changes

    - echo powers by the cube of the ratio of sines (1/R^2 and at most Lambert's cosine);
    - beats by D bins, out of footprints F bins long. As |W|^2 is band-limited and within 0..1 (of
      its peak), its slope is at most pi L/N a bin (Bernstein). The strongest bin of a footprint
      holds at least c of all power: 4/pi^2 of what comes nearest to it, or what a rectangular
      window, which falls fastest, leaves half the footprint and half a bin away. So its power
      moves by a factor within 1 +- pi D (L/N) / c, and c to 1/c;
    - the receiver's transfer by no more than a beat's shift by its poles.

    Near DC and Nyquist images may double powers. A footprint whose phases follow its geometry may
    fade altogether, or not any more, and so may lines with their images: of those, nothing is
    promised.

    All rises with sigma, range, speeds, divergence and chirp rate and falls with the grazing
    angle, sample rate, wavelength and poles, so that one end of each serves a whole tile.

    Parameters
    ----------
    sigma : array_like
        [rad]
    range, grazing_angle, radial_velocity, wavelength, beam_divergence : array_like
        [m, rad, m/s, m, rad]
    chirp_rate, sample_rate, fft_size : array_like
        [Hz/s, Hz, 1]
    bandwidths : (array_like, array_like)
        Poles of detector and amplifier [Hz].
    signal_shot_share : array_like
        Share of the echo's own shot noise in the noise variance, 0..1.
    reach : float
        Farthest beamlet from the axis in the beam's standard deviations.
    single : bool
        Whether there is but one beamlet.
    coherent : bool
        Whether beamlets add as amplitudes.
    direct : bool
        Direct detection, whose beat follows the echo's power and not its root.
    speed_across : array_like
        Speed across the beam [m/s].
    record : array_like
        L/N.
    spread, edge : array_like
        Bins over which lines are spread besides, and from the axis's line to DC or Nyquist.
    tail : callable
        Largest magnitude of a bin at least so many from a line, over the least in the nearest.
    """
    off = np.asarray(sigma, float) * math.sqrt(2 * math.log(1 / RARE))
    aimed, record = np.asarray(grazing_angle, float), np.asarray(record, float)
    rim = reach * np.asarray(beam_divergence, float) / 4
    sure = aimed - rim > off  # no beamlet passes over the horizon
    lowest = np.where(sure, aimed - rim, 1.0)
    lower, higher = lowest - np.where(sure, off, 0.0), np.minimum(lowest + off, math.pi / 2)
    highest = np.minimum(lowest + 2 * rim, math.pi / 2)
    per_metre = np.asarray(chirp_rate, float) * 2 / SPEED_OF_LIGHT
    slope = per_metre * np.asarray(range, float) * np.sin(aimed)
    doppler = np.abs(radial_velocity) * off**2 / 2 + np.asarray(speed_across, float) * off
    shift = slope * (1 / np.sin(lower) - 1 / np.sin(lowest))
    shift = shift + 2 * doppler / np.asarray(wavelength, float)
    bins = np.asarray(fft_size, float) / np.asarray(sample_rate, float)
    length = slope * (1 / np.sin(lowest) - 1 / np.sin(highest)) * bins + spread
    transfer = np.exp(-shift * sum(1 / np.asarray(pole, float) for pole in bandwidths))
    weak, strong = ((np.sin(v) / np.sin(lowest)) ** 3 for v in (lower, higher))
    kept, kept_after = (_kept(v, record) for v in (length, length + 2 * shift * bins))
    moved = math.pi * record * shift * bins / kept
    power = 1.0 if direct else 0.5
    image = np.minimum(tail(2 * (np.asarray(edge) - length - shift * bins) - 1), 1.0)
    least, most = (1 - image, 1 + image) if coherent else (1.0, np.sqrt(1 + image**2))
    low = (weak * transfer * np.maximum(1 - moved, kept_after)) ** power * least / most
    with np.errstate(divide="ignore"):
        high = (strong / transfer * np.minimum(1 + moved, 1 / kept)) ** power * most / least
    known = sure & (not coherent or single)
    share = np.asarray(signal_shot_share, float)
    loudest = np.where(sure, 1 + share * (strong - 1), np.where(share > 0, np.inf, 1.0))
    return Change(
        signal=(np.where(known, low, 0.0), np.where(known, high, np.inf)),
        noise=(np.where(sure, 1 + share * (weak - 1), 1 - share), loudest),
        threshold_follows=False,
    )


def _kept(length: np.ndarray, record: np.ndarray) -> np.ndarray:
    """Least share of all power in the strongest bin of a footprint so many bins long."""
    nearest = (2 / math.pi) ** 2 / (np.floor(length) + 2)
    together = np.minimum((0.5 + 0.5 * length) * record, 1.0)
    return np.asarray(np.maximum(nearest, np.sinc(together) ** 2))


def bound(block: "Block") -> Change | None:
    """What leaving jitter out can change in all draws but few, (3, tiles) by segment."""
    if not block.has(_JITTER):
        return None
    echo = block.shot_noise_scale * block.echo_scale * block.echo * Span.hull(1.0, block.echo_ratio)
    own, lobe = (echo / block.noise_variance).high, block.lines.lobe
    rates = np.outer([1.0, 0.0, 1.0], np.broadcast_to(block.chirp_rate.high, block.size))
    return turned_change(
        sigma=block[_JITTER].high,
        range=block.range.high,
        grazing_angle=block.grazing_angle.low,
        radial_velocity=block.radial_velocity.magnitude,
        wavelength=SPEED_OF_LIGHT / block.carriers[2].high,
        beam_divergence=block["instrument.laser.beam_divergence"].high,
        chirp_rate=rates,
        sample_rate=block.sample_rate.low,
        fft_size=block.fft_size,
        bandwidths=(
            block["instrument.receiver.detector_bandwidth"].low,
            block["instrument.receiver.amplifier_bandwidth"].low,
        ),
        signal_shot_share=own / (1 + own),
        reach=block.reach,
        single=block.number == 1,
        coherent=block.adds_amplitudes or block.has("target.roughness"),
        direct=block.architecture == "direct",
        speed_across=block["target.transverse_velocity"].magnitude,
        record=block.window.length / block.fft_size,
        spread=2 * np.asarray(block.spreads.velocities.extreme),
        edge=block.lines.edge,
        tail=lambda bins: lobe.tail(bins) / lobe.worst,
    )


def turn(p: dict[str, np.ndarray], realisation: Realisation) -> dict[str, np.ndarray]:
    """Range, grazing angle and velocities of beams that are off; no echo where they miss."""
    angles_off = angles(realisation, p[_JITTER])
    across = np.zeros_like(angles_off)
    across[:, 0] = -p["target.transverse_velocity"]  # towards the near side is off grazing
    seen = turned(
        range=p["target.range"],
        grazing_angle=p["target.grazing_angle"],
        radial_velocity=p["target.radial_velocity"],
        angles=angles_off,
        velocity_across=across,
    )
    hits = np.isfinite(seen.range)
    return p | {
        "target.range": np.where(hits, seen.range, 1.0),
        "target.grazing_angle": np.where(hits, seen.grazing_angle, math.pi / 2),
        "target.radial_velocity": seen.radial_velocity,
        "target.reflectance": np.where(hits, p["target.reflectance"], 0.0),
    }


EFFECT = Effect(
    name="pointing_jitter",
    about="a beam that wanders from shot to shot",
    stage="draws",
    bound=bound,
    turn=turn,
    parameters=(
        Parameter(
            path=_JITTER,
            about="Standard deviation of the beam's direction, on each axis, from shot to shot",
            si_unit="rad",
            default=0.0,
            example="20 urad",
            at_least="0 rad",
            at_most="10 deg",
        ),
    ),
)
