"""Speckle: random amplitudes that a rough surface sends back from each beamlet.

A patch whose heights scatter by more than lambda/(4 pi) about their mean returns the sum of many
waves of unrelated phase: a circular complex Gaussian amplitude [Goodman, Speckle Phenomena in
Optics, ch. 2]. A beamlet's patch here takes the factor

    g_b = sqrt(kappa) u_b + sqrt(1 - kappa) z_b,     z_b complex normal with E|z_b|^2 = 1,

whose mean power is 1. kappa = exp(-(4 pi sigma_h / lambda)^2) is the share of power that stays
coherent when the round trip has normal phases of deviation 4 pi sigma_h / lambda. Further, u_b is 1
where the footprint's phases follow its geometry, and a random phase where they do not. kappa = 0 is
a Swerling-1 target, any other a Rician one.

The three segments of a shot see the same heights, so one g_b serves all three. Amplitudes at
frequencies df apart have the correlation exp(-(4 pi sigma_h df / c)^2 / 2), 1 to 1e-6 for 1 GHz and
heights of 10 um. With the instrument moving across the beam the Doppler shifts differ over the
footprint, which turns the beamlets against each other from one segment to the next. Motion between
segments has that in the lines' phases. If it is left out it is done here, but for coherent
footprints with a share kappa left, whose segments are then more alike than they are.

It acts on the lines' amplitudes alone; the mean echo, and so its shot noise, stays.

**Fading**: developed speckle (kappa = 0) without draws, the default for surfaces. A sum of circular
complex Gaussian amplitudes is one itself, in every bin; its mean power is what beamlets make that
add as powers. A bin then crosses the threshold with Swerling's first probability, and two segments'
bins as two correlated ones do. Their correlation falls with the Doppler shifts and the ranges that
differ over the beam, by :mod:`sweep.model.speckle_correlation`. It is in
closed form, as beamlets that are enough for the power of a bin may be too few for it. It acts on
the detection, and on leakage: what an echo leaks fades with it, in closed form
(:mod:`sweep.model.leakage`) as where false peaks are drawn (:mod:`sweep.model.leaked_peaks`). Of
several looks it is a mean over the mean power of all.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Realisation, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.ground import Cast, Ground, Plane, Slopes
from sweep.model.preparation import Shots
from sweep.model.speckle_correlation import (
    NARROW,
    SEGMENT_PAIRS,
    LineSpread,
    SpeckleLines,
    bin_correlation,
    middle_moved,
    window_transform,
)

_ROUGHNESS = "target.roughness"
_LAW = "footprint.speckle"
_FURTHEST = 5.0
"""Bound on a bin's diffuse amplitude over its root mean square; exceeded in one of a million
draws."""


def coherent_share(*, roughness: ArrayLike, wavelength: ArrayLike) -> np.ndarray:
    """Return the fraction kappa of the mean echo power that keeps its phase, 0 .. 1.

    ``roughness`` [m] is the standard deviation of the surface's height along the line of sight: for
    a plane, that normal to it times the sine of the grazing angle; infinite for developed speckle.
    ``wavelength`` is in m.
    """
    phase = 4 * math.pi * np.asarray(roughness, float) / np.asarray(wavelength, float)
    return np.asarray(np.exp(-(phase**2)))


def factors(
    realisation: Realisation, *, beamlets: int, coherent_share: np.ndarray, random_phases: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the factors g_b on beamlet amplitudes: |g_b| and phase [cycles], (n, beamlets) each.

    Parameters
    ----------
    realisation
        Random keys and draw numbers of n points.
    beamlets
        Number of beamlets.
    coherent_share
        Fraction kappa, (n,) or scalar.
    random_phases
        True if u_b has a uniform phase; else it is 1.

    Notes
    -----
    A factor depends on key, draw and beamlet alone: pair b of ``STREAM_SPECKLE`` makes z_b, number
    b of ``STREAM_FOOTPRINT_PHASE`` the phase of u_b.
    """
    from sweep.model import philox

    share = np.asarray(coherent_share, float) + np.zeros(realisation.draw.size)
    keys, draw = realisation.keys, realisation.draw
    drawn = philox.uniforms(keys, draw, philox.STREAM_SPECKLE, 2 * beamlets)
    # In one piece each: bits do not depend on how many draws there are.
    chance, cycles = (np.ascontiguousarray(drawn[:, lane::2]) for lane in range(2))
    steady, diffuse = np.sqrt(share)[:, None], np.sqrt(1.0 - share)[:, None]
    radius = diffuse * np.sqrt(-np.log(chance))
    if not steady.any():
        return radius, cycles
    angle = np.zeros(())
    if random_phases:
        phases = philox.uniforms(keys, draw, philox.STREAM_FOOTPRINT_PHASE, beamlets)
        angle = 2.0 * np.pi * np.ascontiguousarray(phases)
    re = radius * np.cos(2.0 * np.pi * cycles) + steady * np.cos(angle)
    im = radius * np.sin(2.0 * np.pi * cycles) + steady * np.sin(angle)
    return (
        np.where(steady > 0, np.hypot(re, im), radius),
        np.where(steady > 0, np.arctan2(im, re) / (2.0 * np.pi), cycles),
    )


def size(points: Points) -> Size | None:
    """Upper bound on the output change if speckle is omitted, in all but 1e-6 of draws.

    A bin of magnitude |X| becomes sqrt(kappa) X + D with D complex normal of power (1 - kappa)
    |X|^2: between smooth and rough, 4 pi sigma_h << lambda, it lies within 1 +- 5 (4 pi sigma_h /
    lambda). In incoherent footprints the coherent part has random phases. If a sum of amplitudes
    may cancel, the bound is relative to the sum of powers.
    """
    if not points.has(_ROUGHNESS):
        return None
    kappa = coherent_share(
        roughness=points[_ROUGHNESS], wavelength=points["instrument.laser.wavelength"]
    )
    scattered = _FURTHEST * np.sqrt(1 - kappa)
    if not points.adds_amplitudes:
        near = points.near_image | (points.number > 1)
        return Size(magnitude=np.where(near & (kappa < 1), 1.0, 1 - np.sqrt(kappa) + scattered))
    cancelling = points.may_cancel
    return Size(
        magnitude=1 - np.sqrt(kappa) + np.where(cancelling, 0.0, scattered),
        added=np.where(cancelling, math.sqrt(2) * scattered / points.lobe.worst, 0.0),
    )


_SMOOTH = 1e-6
"""Coherent fraction kappa of coherent footprints below which segments' speckles are decorrelated
here."""
_SMALLEST = 1e-300


def draw(shots: Shots, scene: Scene, realisation: Realisation) -> Shots:
    """Give each point its own footprint with speckled beamlet amplitudes.

    Raises
    ------
    ValueError
        For direct detection, which sums the intensities of all speckles in the aperture: that is
        not a factor on each beamlet's echo.
    """
    if shots.architecture == "direct":
        raise ValueError(
            "speckle is simulated for homodyne and heterodyne receivers: what direct detection "
            "sees depends on how many speckles its aperture averages, of which nothing is known"
        )
    share = coherent_share(
        roughness=scene.parameters[_ROUGHNESS],
        wavelength=scene.parameters["instrument.laser.wavelength"],
    )
    magnitude, cycles = factors(
        realisation,
        beamlets=shots.amplitude.shape[1],
        coherent_share=share,
        random_phases=shots.incoherent and shots.amplitude.shape[1] > 1,
    )
    offset, doppler, steady = (v[shots.row] for v in (shots.offset, shots.doppler, shots.amplitude))
    amplitude = steady * magnitude
    # The steady share of a smooth shape is at the start of each segment what it is in the others.
    turning = shots.incoherent | (share < _SMOOTH)
    turning &= not shots.moves_on  # else their lines have it
    phase = np.empty((3, *cycles.shape))
    for s, (carrier, start) in enumerate(zip(shots.carriers, shots.schedule, strict=True)):
        turned = np.where(turning, np.asarray(carrier, float) * start, 0.0) + np.zeros(shots.size)
        np.add(cycles, turned[:, None] * doppler, out=phase[s])
    brighter = (amplitude**2).sum(axis=1) / np.maximum((steady**2).sum(axis=1), _SMALLEST)
    return replace(
        shots,
        row=np.arange(shots.size),
        offset=offset,
        doppler=doppler,
        amplitude=amplitude,
        phase=phase,
        incoherent=False,
        pedestal=shots.pedestal * brighter,
        pedestal_beside=shots.pedestal_beside * brighter,
    )


def fading_size(points: Points) -> Size | None:
    """Error in pd from using mean instead of fluctuating power (Swerling); None if inactive."""
    smooth = points.by_roots or points.architecture == "direct"
    return None if smooth or points.word(_LAW) == "none" else Size(magnitude=1.0)


def fade(shots: Shots, scene: Scene) -> Shots:
    """Set up detection in developed speckle, if the spec asks for it and beamlets add as powers."""
    from sweep.model.detection import Fading

    law = str(scene.parameters[_LAW])
    if law == "none" or shots.architecture == "direct" or not shots.incoherent:
        return shots
    ground = _ground_spread(shots, scene.ground)
    spread = _line_deviation(shots, ground.moments)
    correlations = [
        ground.correlation(shots, pair, phase)
        for pair, phase in zip(SEGMENT_PAIRS, segment_phases(shots), strict=True)
    ]
    drawn_lines = _speckle_lines(shots, scene.ground)
    shots = replace(
        shots, fading=Fading(*correlations), line_spread=spread, speckle_lines=drawn_lines
    )
    return shots if shots.looks.number == 1 else _fade_in_looks(shots, ground)


def _line_deviation(shots: Shots, moments: "BeamletMoments") -> np.ndarray:
    """Return the standard deviation of the beamlets' lines [bins of fs/N], (segments, n)."""
    bins = shots.fft_size / shots.sample_rate
    delay = 2 * shots.range / SPEED_OF_LIGHT
    weights = np.array(
        [
            [bins * segment.carrier + 0 * delay, -bins * segment.chirp_rate * delay]
            for segment in shots.waveform
        ]
    )
    variance = np.einsum("sin,ijn,sjn->sn", weights, moments.covariance, weights)
    return np.sqrt(np.maximum(variance, 0.0))


_NODES, _DEVIATIONS_MAX = 81, 4.0
"""Lines of a footprint, evenly spaced: few would be a comb where they spread over bins."""
_ALIKE = 1e-9
"""Loss of correlation between looks below which all looks share one speckle."""


def _fade_in_looks(shots: Shots, ground: "GroundSpread") -> Shots:
    """Set the correlation of the speckle between the looks of a shot, from the motion between them.

    Looks that are added coherently get a smaller amplitude (``beat_scale``) instead.
    """
    looks = shots.looks
    number, size = looks.number, shots.size
    frequencies, _ = _echo_frequencies(shots)
    turns = [np.broadcast_to(f * shots.look_period, size) for f in frequencies]
    if looks.several:
        shots = replace(shots, look_turns=np.stack(turns) * shots.beta)
    if not looks.moving:
        return shots
    nothing = np.zeros(size)
    by_lag = np.ones((3, size, number), complex)
    for segment in map(int, np.flatnonzero(shots.segments)):
        for lag in range(1, number):
            phase = PhaseDifference(turns[segment] * lag, nothing)
            by_lag[segment, :, lag] = ground.correlation(shots, (segment, segment), phase)
    if looks.added > 1:
        # Added amplitudes of speckles that differ are, on the mean, a smaller amplitude.
        lags = np.arange(1, number)
        steady = np.exp(-1j * np.angle(by_lag[0, :, 1]))[:, None] ** lags
        shared = (2 * (number - lags) * (by_lag[0, :, 1:] * steady).real).sum(axis=1)
        gain = np.sqrt(np.maximum(number + shared, 0.0)) / number
        return replace(shots, beat_scale=shots.beat_scale * gain)
    power = _power_of_looks(shots, ground.slopes)
    if np.abs(by_lag - 1).max() < _ALIKE and np.abs(power - 1).max() < _ALIKE:
        return shots
    between = np.abs(np.array(shots.fading))
    weight = number - np.abs(np.arange(1 - number, number))
    strength = [
        (weight * np.abs(np.concatenate([by_lag[s, :, :0:-1], by_lag[s]], axis=1)) ** 2).sum(axis=1)
        for s in range(3)
    ]
    for k, (pair, phase) in enumerate(zip(SEGMENT_PAIRS, segment_phases(shots), strict=True)):
        if not shots.segments[list(pair)].all() or (k != 1 and not shots.any_two):
            continue
        shared = nothing
        for lag in range(1 - number, number):
            turned = PhaseDifference(phase.turn + lag * turns[pair[1]], phase.delay_cycles)
            of_lag = np.abs(ground.correlation(shots, pair, turned)) ** 2
            shared = shared + (number - abs(lag)) * of_lag
        between[k] = np.sqrt(shared) / (strength[pair[0]] * strength[pair[1]]) ** 0.25
    from sweep.model.look_speckle import LookSpeckle  # kernels, which specs need not

    speckle = LookSpeckle.of(by_lag, power, np.minimum(between, 1.0))
    return replace(shots, look_speckle=speckle)


def _power_of_looks(shots: Shots, slopes: Slopes) -> np.ndarray:
    """Return each look's power in the strongest bin over the mean of looks, (3, n, looks).

    It differs between looks because lines drift out of the bin.
    """
    number = shots.looks.number
    power = np.ones((3, shots.size, number))
    if not np.any(shots.look_drift):
        return power
    nothing = PhaseDifference(np.zeros(shots.size), np.zeros(shots.size))
    padding = shots.fft_size / shots.window.length
    late = np.arange(number) - (number - 1) / 2
    node = np.linspace(-_DEVIATIONS_MAX, _DEVIATIONS_MAX, _NODES)
    weight = np.exp(-0.5 * node * node)
    drift = np.broadcast_to(shots.look_drift, (len(shots.waveform), shots.size)) / padding
    for segment in map(int, np.flatnonzero(shots.segments)):
        lines = _line_spread(shots, (segment, segment), nothing, slopes)
        place = lines.distance[0][:, None] - drift[segment][:, None] * late
        apart = place[..., None] - lines.spread[0][:, None, None] * node
        power[segment] = (window_transform(shots.window, apart) ** 2 * weight).sum(axis=-1)
    return power / np.maximum(power.mean(axis=-1, keepdims=True), _SMALLEST)


class GroundSpread(NamedTuple):
    """Spread of ranges and Doppler ratios over the beam on the ground."""

    slopes: Slopes
    plane: Plane | None
    """The plane; None for ray-traced ground."""
    moments: "BeamletMoments"

    def correlation(
        self, shots: Shots, pair: tuple[int, int], phase: "PhaseDifference"
    ) -> np.ndarray:
        """Return the correlation of the speckle in two records, (n,) complex.

        ``pair``: segments of the two records; ``phase``: phase difference between the records.
        """
        if self.plane is not None:
            found = self.plane.mean_phasor(*phase).astype(complex)
            across = np.zeros(shots.size)
        else:
            (mean,), (variance,) = _phase_moments(self.moments, [phase])
            found = np.exp(1j * mean - 0.5 * variance)
            across = np.maximum(variance - phase.along(self.slopes) ** 2, 0.0)
        lines = _line_spread(shots, pair, phase, self.slopes)
        wide = np.flatnonzero(lines.widest > NARROW)
        if wide.size:
            of_bins = bin_correlation(shots.window, lines.at(wide))
            found[wide] = of_bins * np.exp(-0.5 * across[wide])
        return found


def _ground_spread(shots: Shots, ground: Ground) -> GroundSpread:
    """Return the spread over the beam, of a plane or of ray-traced beamlets."""
    moments = _beamlet_moments(shots, ground)
    if isinstance(ground, Plane):
        return GroundSpread(ground.slopes, ground, moments)
    return GroundSpread(_cast_slopes(moments), None, moments)


def _speckle_lines(shots: Shots, ground: Plane | Cast) -> SpeckleLines:
    """Return gradients of line position and phase across the beam, along the slope and across it.

    Across the slope only Doppler ratios change. The gradients are set even where the effects of the
    footprint are too small to change probabilities, because peak positions wander with them.
    """
    if isinstance(ground, Plane):
        slopes, across = ground.slopes, np.zeros(shots.size)
    else:
        row, offset, doppler, echo = ground.beamlets
        moments = _moments_by_surface(echo, np.array([doppler, offset]), ground.beside, row)
        slopes = _cast_slopes(moments)
        left = moments.covariance[0, 0] - slopes.beta**2
        across = np.sqrt(np.maximum(left, 0.0))
    width = shots.sample_rate / shots.fft_size
    spread = np.zeros((3, 2, shots.size))
    for s, segment in enumerate(shots.waveform):
        delay = 2 / SPEED_OF_LIGHT * (shots.range - segment.nearer)
        moved = segment.carrier * slopes.beta - segment.chirp_rate * delay * slopes.range
        spread[s] = moved / width, segment.carrier * across / width
    turn = np.zeros((3, 2, shots.size))
    for (_, second), phase in zip(SEGMENT_PAIRS[:2], segment_phases(shots)[:2], strict=True):
        turn[second] = phase.along(slopes), 2 * np.pi * phase.turn * across
    return SpeckleLines(np.moveaxis(spread, -1, 0), np.moveaxis(turn, -1, 0))


class PhaseDifference(NamedTuple):
    """Coefficients of a scatterer's phase difference between two segments, (n,) each."""

    turn: np.ndarray
    """Cycles per unit of the Doppler ratio beta."""
    delay_cycles: np.ndarray
    """Cycles per unit of relative range, with the sign reversed."""

    def along(self, slopes: Slopes) -> np.ndarray:
        """Return the phase difference per standard deviation of the beam [rad], (n,)."""
        return 2 * np.pi * (self.turn * slopes.beta - self.delay_cycles * slopes.range)


def segment_phases(shots: Shots) -> list[PhaseDifference]:
    """Return the phase differences of the pairs in SEGMENT_PAIRS, second segment less first.

    Equation (1) of :mod:`sweep.model.speckle_correlation`.
    """
    echo_frequency, middles = _echo_frequencies(shots)
    delay = 2 * shots.range / SPEED_OF_LIGHT
    turned = [
        frequency * (start + middle)
        for frequency, start, middle in zip(echo_frequency, shots.schedule, middles, strict=True)
    ]
    return [
        PhaseDifference(
            np.broadcast_to(turned[second] - turned[first], shots.size),
            delay * (echo_frequency[second] - echo_frequency[first]),
        )
        for first, second in SEGMENT_PAIRS
    ]


def _echo_frequencies(shots: Shots) -> tuple[list[np.ndarray], np.ndarray]:
    """Optical frequencies F of the echo in the middle of each segment's record, and its times.

    That is the centroid of the window over the samples that the echo has: there the phase of a bin
    is that of the line, to first order in their distance.
    """
    delay = 2 * shots.range / SPEED_OF_LIGHT
    later = 0.0 if shots.first_sample is None else middle_moved(shots.window)[shots.first_sample]
    later = np.broadcast_to(later, (len(shots.carriers), shots.size)) / shots.sample_rate
    middles = shots.acquisition_delay + shots.record_duration / 2 + later
    return [
        carrier + slope * shots.chirp_rate * (middle - delay)
        for carrier, slope, middle in zip(shots.carriers, shots.slopes, middles, strict=True)
    ], middles


def _line_spread(
    shots: Shots, pair: tuple[int, int], phase: PhaseDifference, slopes: Slopes
) -> LineSpread:
    """Return the gradients of two segments' lines, and the distance of their strongest bins."""
    bin_width = shots.sample_rate / shots.window.length
    padding = shots.fft_size / shots.window.length
    distances, spreads = [], []
    for segment in (shots.waveform[s] for s in pair):
        delay = 2 / SPEED_OF_LIGHT * (shots.range - segment.nearer)
        beat = segment.carrier * segment.beta - segment.chirp_rate * delay * (1 + segment.beta)
        place = beat / bin_width * padding
        # Any bins of two echoes may detect them: of these the middles stand for all.
        moved = segment.carrier * slopes.beta - segment.chirp_rate * delay * slopes.range
        spreads.append(np.broadcast_to(moved / bin_width, shots.size))
        place = np.broadcast_to(place, shots.size)
        nearest = place
        if shots.detection == "peak_bin":
            nearest = _strongest_bins(shots, place, spreads[-1] * padding)
        distances.append((nearest - place) / padding)
    return LineSpread(
        (distances[0], distances[1]), (spreads[0], spreads[1]), phase.along(slopes),
        np.broadcast_to(slopes.echo, shots.size),
    )  # fmt: skip


_END_REACH = 2.0
"""Distance from DC or Nyquist [bins], and deviations of lines, within which the image of an echo
may make another bin the strongest."""


def _strongest_bins(shots: Shots, place: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the strongest bins of echoes at a place, with its sign and folds [bins], (n,).

    That is the nearest one, unless a line near DC or Nyquist of a real record has its image there:
    of bins 0 and 1 that at DC then has the light of both. ``spread`` is that of the lines [bins].
    """
    nearest = np.rint(place)
    if not shots.real_ends or not shots.image:
        return nearest
    half = shots.fft_size // 2
    end = np.rint(place / half) * half
    padding = shots.fft_size / shots.window.length
    near = np.flatnonzero(np.abs(place - end) < _END_REACH * (padding + np.abs(spread)))
    if not near.size:
        return nearest
    place, end = place[near, None], end[near]
    node = np.linspace(-_DEVIATIONS_MAX, _DEVIATIONS_MAX, _NODES)
    weight, lines = np.exp(-0.5 * node * node), place + spread[near, None] * node
    side = np.where(place[:, 0] < end, -1.0, 1.0)
    first = np.maximum(side * (nearest[near] - end) - 1, 0.0)
    power = []
    for further in range(3):  # the nearest bin and those beside it, on this side of the end
        bin_ = (end + side * (first + further))[:, None]
        line = window_transform(shots.window, (bin_ - lines) / padding)
        image = window_transform(shots.window, (bin_ - 2 * end[:, None] + lines) / padding)
        power.append(((line**2 + image**2) * weight).sum(axis=-1))
    nearest[near] = end + side * (first + np.argmax(power, axis=0))
    return nearest


class BeamletMoments(NamedTuple):
    """Power-weighted moments of the beamlets' (Doppler ratio, relative range)."""

    mean: np.ndarray
    """(2, n): means."""
    covariance: np.ndarray
    """(2, 2, n): covariance matrix, about each surface's own mean."""


def _beamlet_moments(shots: Shots, ground: Ground) -> BeamletMoments:
    """Return the beamlets' moments of Doppler ratio and relative range.

    The covariance is about the mean of each surface: surfaces at different ranges, as a roof and
    the ground below, are echoes of their own, each of which fades as a whole.
    """
    values = np.array([shots.doppler, shots.offset])
    return _moments_by_surface(shots.amplitude**2, values, ground.beside, shots.row)


def _moments_by_surface(
    power: np.ndarray, values: np.ndarray, beside: np.ndarray | None, row: np.ndarray
) -> BeamletMoments:
    """Return power-weighted moments of values (2, rows, beamlets), for points with the given rows.

    ``beside`` (rows, beamlets) bool marks beamlets on another surface than the axis's, or is None.
    """
    share = power / np.maximum(power.sum(axis=1), _SMALLEST)[:, None]
    mean = (share * values).sum(axis=-1)
    centred = values - mean[:, :, None]
    if beside is not None and beside.any():
        for surface in (beside, ~beside):
            weight = np.where(surface, share, 0.0)
            whole = np.maximum(weight.sum(axis=1), _SMALLEST)
            own_mean = (weight * values).sum(axis=-1) / whole
            centred = np.where(surface, values - own_mean[:, :, None], centred)
    covariance = (share * centred[:, None] * centred[None]).sum(axis=-1)
    return BeamletMoments(mean[:, row], covariance[:, :, row])


def _phase_moments(
    moments: BeamletMoments, phases: list[PhaseDifference]
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [rad] and variance [rad^2] of the phase differences over ray-traced beamlets.

    (len(phases), n) each. Ranges and Doppler ratios change linearly across a Gaussian beam, so that
    the phase is normal. A sum of phasors over few rays would recur where their phases are whole
    cycles apart.
    """
    weights = 2 * np.pi * np.array([[phase.turn, -phase.delay_cycles] for phase in phases])
    variance = np.einsum("pin,ijn,pjn->pn", weights, moments.covariance, weights)
    return (weights * moments.mean).sum(axis=1), variance


def _cast_slopes(moments: BeamletMoments) -> Slopes:
    """Return the gradients of ray-traced ground along its steepest range, (n,) each."""
    deviation = np.sqrt(moments.covariance[1, 1])
    along = moments.covariance[0, 1] / np.maximum(deviation, _SMALLEST)
    return Slopes(along, deviation, np.zeros(deviation.shape))


FADING = Effect(
    name="fading",
    about="developed speckle of a rough surface, in closed form",
    stage="detection",
    size=fading_size,
    act=fade,
    needs=("footprint", "doppler_spread"),
    parameters=(
        Parameter(
            path=_LAW,
            about="Echo of surfaces that are rough against the wavelength: developed, it fades as "
            "speckle does, or none, it has its mean power. Coherent phases are those of a smooth "
            "surface and do not fade; where target.roughness says how rough, take none",
            default="developed",
            options=("developed", "none"),
        ),
    ),
)


SPECKLE = Effect(
    name="speckle",
    about="amplitudes of a rough surface, at random",
    stage="draws",
    size=size,
    draw=draw,
    needs=("footprint", "doppler_spread"),  # by them the segments' speckles differ
    parameters=(
        Parameter(
            path=_ROUGHNESS,
            about="Standard deviation of the surface's height along the line of sight",
            example="10 um",
            limits=("0 m", "1 km"),
        ),
    ),
)
