"""A shot's spectrum in as many digits as wanted: exact delays, phases and window transforms."""

from collections.abc import Iterable

import mpmath as mp
import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.preparation import Shots
from sweep.model.waveform import DEFAULT_CHIRP_RATE_RATIOS
from sweep.model.window import COSINE_SUM_COEFFICIENTS, window_samples


def dirichlet(bins: mp.mpf, length: int) -> mp.mpc:
    """Sum of exp(-2 pi i n z / L) over n = 0 .. L - 1, z bins."""
    turns = bins / length
    if mp.almosteq(turns, mp.nint(turns), rel_eps=0, abs_eps=mp.mpf(10) ** (8 - mp.mp.dps)):
        return mp.mpc(length)
    phase_factor = mp.expjpi(-bins + turns)
    return phase_factor * mp.sinpi(bins) / mp.sinpi(turns)


def window_transform(window_name: str, length: int, bins: mp.mpf) -> mp.mpc:
    """W(y) of a cosine sum of `length` samples, y bins of fs/L, as a sum of such kernels."""
    total = mp.mpc(0)
    for m, text in enumerate(COSINE_SUM_COEFFICIENTS[window_name]):
        for shifted_bins in (bins - m, bins + m):
            total += (-1) ** m * mp.mpf(text) / 2 * dirichlet(shifted_bins, length)
    return total


def window_transform_from_samples(weights: np.ndarray, bins: mp.mpf) -> mp.mpc:
    """W(y) of any window by its samples, phases exact."""
    length = len(weights)
    return mp.fsum(
        mp.mpf(float(w)) * mp.expjpi(-2 * n * bins / length) for n, w in enumerate(weights)
    )


class ExactLine:
    """One beamlet's beat in one segment of a shot: place [bins], weight at t_0."""

    def __init__(self, shots: Shots, point: int, segment: int, beamlet: int) -> None:
        row, sign = shots.footprint.row_of_point[point], DEFAULT_CHIRP_RATE_RATIOS[segment]
        rate, carrier = (
            point_value(shots.waveform.chirp_rate, point),
            point_value(shots.waveform.carriers[segment], point),
        )
        range_m = point_value(shots.range, point) * (
            1 + mp.mpf(float(shots.footprint.relative_range_offset[row, beamlet]))
        )
        delay = 2 * range_m / mp.mpf(SPEED_OF_LIGHT)
        beta = point_value(shots.motion.doppler_ratio, point) + mp.mpf(
            float(shots.footprint.doppler_ratio_offset[row, beamlet])
        )
        self.beat = carrier * beta - sign * rate * delay * (1 + beta)
        self.bins = self.beat * shots.fft_size / point_value(shots.sample_rate, point)
        start = self.beat * point_value(shots.record.acquisition_delay, point)
        self.phase = -carrier * delay + sign * rate * delay**2 / 2 + start
        poles = 1 + 1j * self.beat / point_value(shots.receiver_filter.detector_bandwidth, point)
        poles *= 1 + 1j * self.beat / point_value(shots.receiver_filter.amplifier_bandwidth, point)
        scale = point_value(shots.echo_scales.beat_amplitude_scale, point) * mp.mpf(
            float(shots.footprint.relative_amplitude[row, beamlet])
        )
        self.weight = scale / 2 / poles * mp.expjpi(2 * self.phase)


def point_value(column: np.ndarray | float, point: int) -> mp.mpf:
    """Point i of a column that may be one value for all, as it stands."""
    column = np.asarray(column)
    return mp.mpf(float(column[point] if column.ndim else column))


def exact_magnitudes(
    shots: Shots, point: int, segment: int, bins: Iterable[int], *, image: bool = True
) -> list[mp.mpf]:
    """|X[k]| of some bins: lines, and images if wanted, as amplitudes or as powers."""
    window, result = shots.window, []
    lines = [ExactLine(shots, point, segment, b) for b in range(shots.footprint.n_beamlets)]
    weights = (
        None
        if window.name in COSINE_SUM_COEFFICIENTS
        else window_samples(window.name, window.length)
    )

    def transform_at(distance: mp.mpf) -> mp.mpc:
        bins_of_record = distance * window.length / shots.fft_size
        return (
            window_transform(window.name, window.length, bins_of_record)
            if weights is None
            else window_transform_from_samples(weights, bins_of_record)
        )

    for k in bins:
        pairs = [
            (
                line.weight * transform_at(k - line.bins),
                mp.conj(line.weight) * transform_at(k + line.bins) if image else mp.mpf(0),
            )
            for line in lines
        ]
        if shots.footprint.adds_powers:
            result.append(mp.sqrt(mp.fsum(abs(x) ** 2 for pair in pairs for x in pair)))
        else:
            result.append(abs(mp.fsum(x for pair in pairs for x in pair)))
    return result


def peak_magnitude(shots: Shots, point: int, segment: int) -> float:
    """Height on a bin of a line with the weight of all lines of a segment."""
    lines = (ExactLine(shots, point, segment, b) for b in range(shots.footprint.n_beamlets))
    return float(mp.fsum(abs(line.weight) for line in lines)) * shots.window.sum


def error_over_peak(
    shots: Shots, segment: int, bins: list[int], fast_magnitudes: Iterable[float]
) -> float:
    """Largest error of |X| in some bins of a shot, over the peak."""
    with mp.workdps(40):
        exact = exact_magnitudes(shots, 0, segment, bins)
        errors = [
            abs(mp.mpf(float(x)) - exact_magnitude)
            for x, exact_magnitude in zip(fast_magnitudes, exact, strict=True)
        ]
        return float(max(errors)) / peak_magnitude(shots, 0, segment)
