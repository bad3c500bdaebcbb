"""A shot's spectrum in as many digits as wanted: exact delays, phases and window transforms."""

from collections.abc import Iterable

import mpmath as mp
import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.preparation import Shots
from sweep.model.waveform import SIGNS
from sweep.model.window import COSINE_SUMS, samples


def dirichlet(z: mp.mpf, length: int) -> mp.mpc:
    """Sum of exp(-2 pi i n z / L) over n = 0 .. L - 1, z bins."""
    turns = z / length
    if mp.almosteq(turns, mp.nint(turns), rel_eps=0, abs_eps=mp.mpf(10) ** (8 - mp.mp.dps)):
        return mp.mpc(length)
    half = mp.expjpi(-z + turns)
    return half * mp.sinpi(z) / mp.sinpi(turns)


def transform(name: str, length: int, y: mp.mpf) -> mp.mpc:
    """W(y) of a cosine sum of `length` samples, y bins of fs/L, as a sum of such kernels."""
    total = mp.mpc(0)
    for m, text in enumerate(COSINE_SUMS[name]):
        for z in (y - m, y + m):
            total += (-1) ** m * mp.mpf(text) / 2 * dirichlet(z, length)
    return total


def summed(weights: np.ndarray, y: mp.mpf) -> mp.mpc:
    """W(y) of any window by its samples, phases exact."""
    length = len(weights)
    return mp.fsum(mp.mpf(float(w)) * mp.expjpi(-2 * n * y / length) for n, w in enumerate(weights))


class Line:
    """One beamlet's beat in one segment of a shot: place [bins], weight at t_0."""

    def __init__(self, shots: Shots, i: int, segment: int, beamlet: int) -> None:
        row, sign = shots.row[i], SIGNS[segment]
        rate, carrier = of(shots.chirp_rate, i), of(shots.carriers[segment], i)
        metres = of(shots.range, i) * (1 + mp.mpf(float(shots.offset[row, beamlet])))
        delay = 2 * metres / mp.mpf(SPEED_OF_LIGHT)
        beta = of(shots.beta, i) + mp.mpf(float(shots.doppler[row, beamlet]))
        self.beat = carrier * beta - sign * rate * delay * (1 + beta)
        self.bins = self.beat * shots.fft_size / of(shots.sample_rate, i)
        start = self.beat * of(shots.acquisition_delay, i)
        self.phase = -carrier * delay + sign * rate * delay**2 / 2 + start
        poles = 1 + 1j * self.beat / of(shots.detector_bandwidth, i)
        poles *= 1 + 1j * self.beat / of(shots.amplifier_bandwidth, i)
        scale = of(shots.beat_scale, i) * mp.mpf(float(shots.amplitude[row, beamlet]))
        self.weight = scale / 2 / poles * mp.expjpi(2 * self.phase)


def of(column: np.ndarray | float, i: int) -> mp.mpf:
    """Point i of a column that may be one value for all, as it stands."""
    column = np.asarray(column)
    return mp.mpf(float(column[i] if column.ndim else column))


def magnitudes(
    shots: Shots, i: int, segment: int, bins: Iterable[int], *, image: bool = True
) -> list[mp.mpf]:
    """|X[k]| of some bins: lines, and images if wanted, as amplitudes or as powers."""
    window, found = shots.window, []
    lines = [Line(shots, i, segment, b) for b in range(shots.offset.shape[1])]
    weights = None if window.name in COSINE_SUMS else samples(window.name, window.length)

    def at(distance: mp.mpf) -> mp.mpc:
        y = distance * window.length / shots.fft_size
        return transform(window.name, window.length, y) if weights is None else summed(weights, y)

    for k in bins:
        pairs = [
            (
                line.weight * at(k - line.bins),
                mp.conj(line.weight) * at(k + line.bins) if image else mp.mpf(0),
            )
            for line in lines
        ]
        if shots.incoherent:
            found.append(mp.sqrt(mp.fsum(abs(x) ** 2 for pair in pairs for x in pair)))
        else:
            found.append(abs(mp.fsum(x for pair in pairs for x in pair)))
    return found


def peak(shots: Shots, i: int, segment: int) -> float:
    """Height on a bin of a line with the weight of all lines of a segment."""
    lines = (Line(shots, i, segment, b) for b in range(shots.offset.shape[1]))
    return float(mp.fsum(abs(line.weight) for line in lines)) * shots.window.sum


def departure_of(shots: Shots, segment: int, bins: list[int], found: Iterable[float]) -> float:
    """Largest error of |X| in some bins of a shot, over the peak."""
    with mp.workdps(40):
        exact = magnitudes(shots, 0, segment, bins)
        errors = [abs(mp.mpf(float(x)) - right) for x, right in zip(found, exact, strict=True)]
        return float(max(errors)) / peak(shots, 0, segment)
