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
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.footprint import beamlets as pattern_of
from sweep.model.philox import STREAM_POINTING_JITTER, normal_pair
from sweep.model.shot import Parameters, evaluate

RARE = 1e-6
"""Chance of a draw whose beam is further off than :func:`bound` takes it to be."""

STRETCH = 4096
"""Turned shots that are evaluated at once."""

PROBABILITIES = ("pd_up", "pd_doppler", "pd_down", "pd_shot")


class Turned(NamedTuple):
    """What a turned beam meets, each of the broadcast shape; nan where it misses the plane."""

    range: np.ndarray
    """[m]"""
    grazing_angle: np.ndarray
    """[rad]"""
    radial_velocity: np.ndarray
    """[m/s], positive when closing."""


def angles(*, keys: np.ndarray, first_draw: int, draws: int, sigma: ArrayLike) -> np.ndarray:
    """Angles (a, b) by which beams are off, (n, draws, 2) [rad].

    Parameters
    ----------
    keys : (n, 2) uint64
        Random key of each point.
    first_draw, draws : int
        Angles depend on key and number of the draw (stream ``STREAM_POINTING_JITTER``), on
        nothing else.
    sigma : array_like
        Standard deviation of each angle [rad], (n,) or a scalar.
    """
    keys = np.asarray(keys, np.uint64)
    values = np.empty((len(keys), draws, 2))
    _draw(keys, first_draw, STREAM_POINTING_JITTER, values)
    return values * np.broadcast_to(np.asarray(sigma, float), len(keys))[:, None, None]


@njit(cache=True, nogil=True)
def _draw(keys, first_draw, stream, out):
    """One pair of standard normal numbers for each point and draw."""
    for i in range(out.shape[0]):
        for d in range(out.shape[1]):
            pair = normal_pair(keys[i, 0], keys[i, 1], first_draw + d, stream, 0)
            out[i, d, 0], out[i, d, 1] = pair


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


def conditional_detection(
    parameters: Parameters,
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
    sigma: ArrayLike,
    velocity_across: ArrayLike = (0.0, 0.0),
    names: Iterable[str] = PROBABILITIES,
) -> dict[str, np.ndarray]:
    """Probabilities over the noise of each draw of the beam's direction.

    Parameters
    ----------
    parameters : mapping
        As for :func:`sweep.model.shot.evaluate`, of n points.
    keys, first_draw, draws, sigma
        As for :func:`angles`.
    velocity_across : (2,) or (n, 2) array_like
        As for :func:`turned`.
    names : iterable of str
        Which of :data:`sweep.model.outputs.OUTPUTS`. Errors of range and velocity are against
        the turned beam's own; 0 for a probability where the beam misses the plane, nan else.

    Returns
    -------
    dict of (n, draws) ndarray
        The names asked for, and ``range``, ``grazing_angle`` and ``radial_velocity`` of the draw.
    """
    n, names = len(keys), tuple(names)
    aimed = {
        name: np.broadcast_to(np.asarray(parameters[f"target.{name}"], float), n)[:, None]
        for name in Turned._fields
    }
    across = np.broadcast_to(np.asarray(velocity_across, float), (n, 2))[:, None]
    off = angles(keys=keys, first_draw=first_draw, draws=draws, sigma=sigma)
    seen = turned(**aimed, angles=off, velocity_across=across)
    results = {name: np.empty((n, draws)) for name in names}
    step = max(1, STRETCH // n)
    for start in range(0, draws, step):
        part = slice(start, start + step)
        found = _evaluated(parameters, Turned(*(values[:, part] for values in seen)), names)
        for name, values in found.items():
            results[name][:, part] = values
    return results | seen._asdict()


def _evaluated(
    parameters: Parameters, seen: Turned, names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Outputs (n, draws) of turned shots."""
    shape = seen.range.shape
    hits = np.isfinite(seen.range)
    repeated = {
        path: np.repeat(np.asarray(value), shape[1]) if np.ndim(value) else value
        for path, value in parameters.items()
    }
    geometry = {
        "target.range": np.where(hits, seen.range, 1.0),
        "target.grazing_angle": np.where(hits, seen.grazing_angle, 0.5 * math.pi),
        "target.radial_velocity": seen.radial_velocity,
    }
    outputs = evaluate(repeated | {path: values.ravel() for path, values in geometry.items()})
    missed = {name: 0.0 if name in PROBABILITIES else np.nan for name in names}
    return {name: np.where(hits, outputs[name].reshape(shape), missed[name]) for name in names}


def bound(
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
    beamlets: int,
    coherent: bool,
    direct: bool = False,
    speed_across: ArrayLike = 0.0,
    record: ArrayLike = 1.0,
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

    Beats are taken to be clear of DC and Nyquist: what sidelobes of their images add is left out.
    A footprint whose phases follow its geometry may fade altogether, or not any more: of those,
    nothing is promised.

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
    beamlets : int
        Their number.
    coherent : bool
        Whether beamlets add as amplitudes.
    direct : bool
        Direct detection, whose beat follows the echo's power and not its root.
    speed_across : array_like
        Speed across the beam [m/s].
    record : array_like
        L/N.
    """
    off = np.asarray(sigma, float) * math.sqrt(2 * math.log(1 / RARE))
    aimed, record = np.asarray(grazing_angle, float), np.asarray(record, float)
    reach = np.hypot(*pattern_of(beamlets)[0]).max() * np.asarray(beam_divergence, float) / 4
    sure = aimed - reach > off  # no beamlet passes over the horizon
    lowest = np.where(sure, aimed - reach, 1.0)
    lower, higher = lowest - np.where(sure, off, 0.0), np.minimum(lowest + off, math.pi / 2)
    highest = np.minimum(lowest + 2 * reach, math.pi / 2)
    per_metre = np.asarray(chirp_rate, float) * 2 / SPEED_OF_LIGHT
    slope = per_metre * np.asarray(range, float) * np.sin(aimed)
    doppler = np.abs(radial_velocity) * off**2 / 2 + np.asarray(speed_across, float) * off
    shift = slope * (1 / np.sin(lower) - 1 / np.sin(lowest))
    shift = shift + 2 * doppler / np.asarray(wavelength, float)
    bins = np.asarray(fft_size, float) / np.asarray(sample_rate, float)
    length = slope * (1 / np.sin(lowest) - 1 / np.sin(highest)) * bins
    transfer = np.exp(-shift * sum(1 / np.asarray(pole, float) for pole in bandwidths))
    weak, strong = ((np.sin(v) / np.sin(lowest)) ** 3 for v in (lower, higher))
    kept, kept_after = (_kept(v, record) for v in (length, length + 2 * shift * bins))
    moved = math.pi * record * shift * bins / kept
    power = 1.0 if direct else 0.5
    low = (weak * transfer * np.maximum(1 - moved, kept_after)) ** power
    high = (strong / transfer * np.minimum(1 + moved, 1 / kept)) ** power
    known = sure & (not coherent or beamlets == 1)
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
