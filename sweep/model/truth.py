"""The slow, obviously right simulation: every beamlet, every sample, the whole FFT.

The beat of each beamlet follows from the exact delay tau(t) of PHYSICS section 2, sample by
sample; the records add up, are windowed and transformed. Every fast path is held against this.
It shares the link budget, the noise and the footprint with the fast path, and nothing of lines,
kernels or bins. Seconds a shot; its own floor, from rounding f t, is 1e-11 of the peak.

With the effect of overlap a beamlet has an echo in samples from its own delay tau(t) on, and until
the chirp ends.
"""

from fractions import Fraction

import numpy as np

from sweep.model import link, window
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import detect_rows
from sweep.model.effects.segment_motion import looks_of
from sweep.model.preparation import Shots
from sweep.model.waveform import SAMPLE_SLACK


def spectrum(
    shots: Shots,
    i: int,
    segment: int,
    *,
    range_walk: bool = True,
    acceleration: bool = False,
    laser_phase: np.ndarray | float = 0.0,
) -> np.ndarray:
    """|X[k]| of point i's segment, without noise, for k = 0..N/2, (N // 2 + 1,).

    Of a complex record for k = -N/2..N/2 - 1, (N,). With incoherent phases: the root of the mean of
    |X|^2 over independent uniform phases. ``range_walk`` keeps the terms of the phase in t^2, the
    frequency drift while the target moves; ``acceleration`` that of its velocity; ``laser_phase``
    (L,) is theta(t) - theta(t - tau) in each sample [rad].
    """
    w = window.samples(shots.window.name, shots.window.length)
    half, signed = shots.fft_size // 2 + 1, shots.complex_record
    total = np.zeros(shots.window.length, complex)
    power, image = np.zeros(shots.bins), _at(shots.image_gain, i)
    for beamlet in range(shots.offset.shape[1]):
        signal = analytic_record(
            shots, i, segment, beamlet, range_walk=range_walk, acceleration=acceleration
        )
        signal *= np.exp(1j * np.asarray(laser_phase))
        total += signal
        if shots.incoherent:
            spectrum = abs(np.fft.fft(w * signal, shots.fft_size) / 2) ** 2
            if signed:
                power += np.fft.fftshift(spectrum + image**2 * np.roll(spectrum[::-1], 1))
            else:
                power += spectrum[:half] + spectrum[-np.arange(half)]
    if shots.incoherent:
        return np.sqrt(power)
    if signed:
        record = w * (total + image * total.conj()) / 2
        return np.abs(np.fft.fftshift(np.fft.fft(record, shots.fft_size)))
    return np.abs(np.fft.rfft(w * total.real, shots.fft_size))


def find(shots: Shots, *, range_walk: bool = True) -> np.ndarray:
    """Evaluate each segment's spectrum as :func:`sweep.model.shot.find` does; no leakage.

    Range walk is the only change of lines within a record that is included.
    """
    found = np.full((3, 6, shots.size), np.nan)
    for i in range(shots.size):
        bins = shots.bins - 1, float(shots.sample_rate[i]) / shots.fft_size
        for segment in map(int, np.flatnonzero(shots.segments)):
            each = [
                spectrum(look, i, segment, range_walk=range_walk)
                for look in (looks_of(shots) if np.any(shots.look_drift) else [shots])
            ]
            magnitude, out = np.sqrt(np.mean(np.square(each), axis=0)), np.empty((6, 1))
            detect_rows(
                magnitude[None], np.zeros(1, np.int64), bins, shots.echo_rule, 
                shots.bin_levels[:, [i]], shots.speckle_table.at(segment, np.array([i])), out,
            )  # fmt: skip
            found[segment, :, i] = out[:, 0]
            if shots.complex_record:
                found[segment, 3, i] -= float(shots.sample_rate[i]) / 2
    if shots.looks.several:
        peak = np.rint(found[:, 3] / (shots.sample_rate / shots.fft_size))
        found[:, 0], found[:, 1] = shots.detected(found[:, 2], peak)
    return found


def analytic_record(
    shots: Shots,
    i: int,
    segment: int,
    beamlet: int,
    *,
    range_walk: bool = True,
    acceleration: bool = False,
) -> np.ndarray:
    """Voltage of one beamlet at the ADC as a complex record (L,); its real part is sampled.

    The ground that the beam meets comes nearer by ``approach``, its scatterers by their own radial
    velocity; both from the shot's start on. If the two differ the beam slides over the ground:
    scatterers take each other's place, and the beat has the delay of those that are there.
    """
    sign, carrier = shots.slopes[segment], float(_at(shots.carriers[segment], i))
    own, begun = float(shots.doppler[shots.row[i], beamlet]), float(_at(shots.starts[segment], i))
    closing, grows = float(_at(shots.approach, i)), float(_at(shots.acceleration, i))
    alpha = grows / SPEED_OF_LIGHT
    beta = float(_at(shots.beta, i)) + 2 * alpha * begun + own
    rate = float(_at(shots.chirp_rate, i))
    range_0 = float(shots.range[i])
    further = range_0 * float(shots.offset[shots.row[i], beamlet])
    further -= SPEED_OF_LIGHT / 2 * own * begun
    nearer = closing * begun + grows * begun**2 / 2
    t = float(_at(shots.acquisition_delay, i)) + np.arange(shots.window.length) / float(
        shots.sample_rate[i]
    )
    delay_0 = 2 * (range_0 - nearer + further) / SPEED_OF_LIGHT
    change = -beta * t - acceleration * alpha * t**2  # tau(t) - tau_0
    chirped = change * (2 * delay_0 + change) / 2 - t * (delay_0 + change)
    chirped += (closing - float(shots.radial_velocity[i])) / SPEED_OF_LIGHT * t**2
    if not range_walk:
        chirped = delay_0 * (change - t)
    cycles = -carrier * change + sign * rate * chirped
    start = _start_phase(sign, carrier, rate, range_0, further, nearer)
    beat = carrier * beta - sign * rate * delay_0 * (1 + beta)
    gain = link.transfer(
        np.array(beat),
        detector_bandwidth=_at(shots.detector_bandwidth, i),
        amplifier_bandwidth=_at(shots.amplifier_bandwidth, i),
    )
    amplitude = _at(shots.beat_scale, i) * shots.amplitude[shots.row[i], beamlet]
    amplitude = amplitude * shots.whitening[segment][i]
    record = amplitude * gain * np.exp(2j * np.pi * (cycles - np.rint(cycles) + start))
    if shots.first_sample is not None:
        arrived = t >= delay_0 + change - SAMPLE_SLACK / shots.sample_rate[i]
        record *= arrived & (t <= _at(shots.duration, i))
    return np.asarray(record)


def _start_phase(
    sign: float, carrier: float, rate: float, range_0: float, further: float, nearer: float
) -> float:
    """-f tau_0 + s S tau_0^2 / 2, the phase at t = 0 [cycles], in exact fractions."""
    delay = Fraction(range_0) + Fraction(further) - Fraction(nearer)
    delay = 2 * delay / Fraction(SPEED_OF_LIGHT)
    phase = -Fraction(carrier) * delay + Fraction(sign) * Fraction(rate) * delay**2 / 2
    return float(phase - round(phase))


def _at(column: np.ndarray | float, i: int) -> np.ndarray:
    """Point i of a column that may be one value for all."""
    column = np.asarray(column)
    return column[i] if column.ndim else column
