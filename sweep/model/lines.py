"""The spectral lines of one segment: where each beamlet's beat lies, how strong, in what phase."""

import math

from numba import njit

from sweep.model.compiling import borrowing
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.elementary import (
    fraction_of_cycle,
    product_fraction,
    quotient,
    sincos_cycles,
)


@borrowing()
def folded_origin(centre, fft_size):
    """Bin nearest to where a line at ``centre`` bins appears, and what folding made of it.

    Returns
    -------
    origin : int
        0..N/2.
    turns : float
        Whole FFT lengths to take off before the sign.
    sign : float
        -1 where the image is what appears, and the phase is conjugated; else +1.
    """
    turns = math.floor(centre / fft_size + 0.5) * fft_size
    sign = -1.0 if centre - turns < 0.0 else 1.0
    return math.floor(sign * (centre - turns) + 0.5), turns, sign


@borrowing()
def segment_lines(
    segment, chirp, optics, record, offset, doppler, amplitude, phases, delta, re, im, power=False
):  # fmt: skip
    """Lines of a segment: positions and complex weights C_b of :mod:`sweep.model.spectrum`.

    Parameters
    ----------
    segment : (float, float)
        Chirp sign s and carrier f_seg [Hz].
    chirp : (float, float, float, float)
        Chirp rate S [Hz/s]; range R_0 [m] and Doppler ratio beta_0 = 2 v_r / c on the beam's
        axis; beat amplitude for a relative amplitude of 1 [V, before the receiver's poles].
    optics : (float, float)
        Poles of the receiver [Hz].
    record : (float, int, int, float)
        Sample rate [Hz], FFT size N, window length L, acquisition delay t_0 [s].
    offset, doppler, amplitude : (n,) float64
        (R_b - R_0)/R_0, beta_b - beta_0 and relative amplitude of each beamlet.
    phases : (n,) or (0,) float64
        Phases [cycles] that beamlets have besides; or none.
    delta, re, im : (>= n,) float64
        Result: bins from the returned origin, and C_b.
    power : bool
        |C_b|^2 and 0 instead, which takes no phases.

    Returns
    -------
    int
        Origin: the bin nearest to the beam's centre, 0..N/2.
    """
    sign, carrier = segment
    rate, range_0, beta, scale = chirp
    sample_rate, fft_size, length, start = record
    bins = fft_size / sample_rate
    per_metre, centre_frequency = _axis(segment, chirp)
    centre = centre_frequency * bins
    origin, turns, fold = folded_origin(centre, fft_size)
    delta_0 = fold * (centre - turns) - origin
    poles = 1.0 / (optics[0] * optics[1]), 1.0 / optics[0] + 1.0 / optics[1]
    centre_line = centre_frequency, delta_0, fold, bins
    motion = carrier, per_metre, range_0, beta
    if power:
        _powers(motion, centre_line, poles, scale, offset, doppler, amplitude, delta, re, im)
        return origin
    high, low = quotient(2.0 * carrier, SPEED_OF_LIGHT)
    phase_0 = -product_fraction(high, low, range_0) + fraction_of_cycle(centre_frequency * start)
    half_ratio = 0.5 * (length / fft_size)
    turn_0 = (length * origin % (2 * fft_size)) / (2.0 * fft_size)
    square = 0.5 * sign * rate
    for b in range(offset.size):
        beat = _beat(motion, offset[b], doppler[b])
        further = range_0 * offset[b]
        delay = (range_0 + further) * (2.0 / SPEED_OF_LIGHT)
        phase = phase_0 - product_fraction(high, low, further)
        phase += fraction_of_cycle(square * delay * delay) + beat * start
        if phases.size:
            phase += phases[b]
        delta[b] = delta_0 + fold * beat * bins
        sine, cosine = sincos_cycles(fold * phase + turn_0 + half_ratio * delta[b])
        frequency = centre_frequency + beat
        p = 1.0 - frequency * frequency * poles[0]
        q = fold * frequency * poles[1]
        weight = 0.5 * scale * amplitude[b] / (p * p + q * q)
        re[b] = weight * (cosine * p + sine * q)
        im[b] = weight * (sine * p - cosine * q)
    return origin


@borrowing()
def folding(segment, chirp, record):
    """-1 where the lines of a segment are seen as their images, else +1; see `segment_lines`."""
    _, centre_frequency = _axis(segment, chirp)
    return folded_origin(centre_frequency * (record[1] / record[0]), record[1])[2]


@njit(inline="always")
def _axis(segment, chirp):
    """Change of the beat with range [Hz/m]; beat on the beam's axis [Hz]."""
    sign, carrier = segment
    rate, range_0, beta, _ = chirp
    per_metre = sign * rate * (2.0 / SPEED_OF_LIGHT)
    return per_metre, carrier * beta - per_metre * (1.0 + beta) * range_0


@njit(inline="always")
def _beat(motion, offset, doppler):
    """Beat of a beamlet less that of the beam's centre [Hz]."""
    carrier, per_metre, range_0, beta = motion
    further = range_0 * offset
    shift = (1.0 + beta) * further + (range_0 + further) * doppler
    return carrier * doppler - per_metre * shift


@borrowing()
def _powers(motion, centre_line, poles, scale, offset, doppler, amplitude, delta, re, im):
    """Positions of the lines and |C_b|^2."""
    centre_frequency, delta_0, fold, bins = centre_line
    for b in range(offset.size):
        beat = _beat(motion, offset[b], doppler[b])
        delta[b] = delta_0 + fold * beat * bins
        frequency = centre_frequency + beat
        p = 1.0 - frequency * frequency * poles[0]
        q = frequency * poles[1]
        weight = 0.5 * scale * amplitude[b]
        re[b] = weight * weight / (p * p + q * q)
        im[b] = 0.0
