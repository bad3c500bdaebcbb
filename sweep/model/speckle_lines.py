"""Developed speckle of a footprint, drawn: complex amplitudes of bins in the segments of a shot.

The footprint is a grid of lines over the two coordinates of a Gaussian beam, in its standard
deviations. A line at (y, x) has the weight a^2 of a Gaussian rule and a circular complex Gaussian
amplitude z, which all segments of a shot see. In segment s it lies b_s . (y, x) bins off the middle
of the echo, and its phase is t_s . (y, x) against the first segment, by equation (1) of
:mod:`sweep.model.speckle_correlation`. A bin k then has

    A_s,k = sum a z e^(i t_s . (y, x)) G(k - middle_s - b_s . (y, x))                            (1)

with the window's transform G. Near DC and Nyquist of a real record the conjugate amplitudes of the
lines' images add to it (:mod:`sweep.model.quadratures`): at DC the sum is real. Bins of all
segments are jointly circular Gaussian, as sums of such numbers are. Their covariances are the
Gaussian means that the rule integrates, so that the peak bins of two segments have the correlation
mu of that module. Amplitudes are returned over their root mean squares: whoever draws gives a bin
the mean power that the spectrum has there.

Places wander with speckle. If the footprint spreads over less than a bin, (1) is to first order in
b the bin of a lone tone that lies

    w_s = b_s . Re(Y_s / A_s),    Y_s = sum a z e^(i t_s . (y, x)) (y, x)                        (2)

off the middle. A_s and Y_s are independent, as y and x have the mean 0. Of a peak with the power
q^2 in units of its mean, noise included, of which the echo has the share v, w_s is normal:

    var w_s = |b_s|^2 v / (2 q^2)                                                                (3)

This is the law of a ratio of two Gaussian numbers [Goodman, Speckle Phenomena in Optics, 2007,
ch. 2; of angles in radar it is known as glint: Kanter, IEEE Trans. AES-13, 1977]. Without the
threshold, which keeps q away from 0, it has no variance. :func:`wander_covariance` has the
covariance of two segments.

In footprints of half a bin and more the place is bounded by the bins that are looked at.
:func:`place_errors` bounds it so where the strongest bin alone detects.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import special

from sweep.kernel_cache import njit
from sweep.model import philox
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.footprint import gaussian_rule
from sweep.model.interpolation import interpolator, lone_tone, phasors, sub_bin
from sweep.model.speckle_correlation import (
    OVERSAMPLING,
    REACH,
    SpeckleLines,
    middle_moved,
    transform_table,
)
from sweep.model.window import Window, samples

if TYPE_CHECKING:
    from sweep.model.preparation import Shots

NODES = np.array([1, 3, 7, 15, 31, 63, 127, 255, 511])
"""Numbers of nodes of the Gaussian rules: lines along one coordinate of the beam."""

_RESOLVED = np.array([0.02, 0.6, 1.9, 3.8, 9.4, 23.0, 52.0, 109.0, np.inf])
"""Largest phase per standard deviation of the beam [rad] that each rule of NODES integrates to
1e-3."""

_LEAST_WEIGHT = 1e-6
"""Power fraction below which a line is left out."""

FIRST_LINE = 1 << 24
"""Random numbers reserved for a group: those of group g begin at (1 + g) FIRST_LINE."""

NEXT_LOOK = np.int64(1 << 48)
"""Offset in the draw number between successive looks, which makes their random numbers distinct."""


class LineFan(NamedTuple):
    """Grid of speckle lines of n points, as compiled code takes it."""

    spread: np.ndarray
    """(n, 3, 2): line shift per standard deviation of the beam [bins], positive towards higher
    bins."""
    turn: np.ndarray
    """(n, 3, 2): phase per standard deviation of the beam, relative to the up segment [rad]."""
    rule: np.ndarray
    """(n, 2) int64: index into :data:`NODES` for each coordinate."""
    reach: np.ndarray
    """(n,) int64: bins on either side of the strongest one in which the peak is searched."""
    node: np.ndarray
    """(rules, nodes): nodes of the Gaussian rules [standard deviations], padded with 0."""
    weight: np.ndarray
    """(rules, nodes): weights of the Gaussian rules; those of a rule sum to 1."""
    number: np.ndarray
    """(rules,) int64: number of nodes of each rule."""
    transform: np.ndarray
    """(m,): window transform G at 0, 1/steps, 2/steps .. bins."""
    steps: float
    """Samples of ``transform`` per bin of fs/N."""
    size: float
    """Distance from a line up to which bins receive light of it [bins of fs/N]."""
    half: int
    """N/2 of a real record whose bins near DC and Nyquist see the conjugate images of lines,
    else 0."""

    @classmethod
    def nothing(cls) -> "LineFan":
        """Return lines of no points."""
        none, numbers = np.zeros((0, 3, 2)), np.zeros(0, np.int64)
        table = np.zeros((0, 0))
        return cls(
            none, none, np.zeros((0, 2), np.int64), numbers, table, table, numbers, np.zeros(0),
            1.0, 0.0, 0,
        )  # fmt: skip

    def of(self, part: np.ndarray) -> "LineFan":
        """Select points by their indices."""
        if not self.spread.shape[0]:
            return self
        return self._replace(
            spread=self.spread[part], turn=self.turn[part], rule=self.rule[part],
            reach=self.reach[part],
        )  # fmt: skip


@lru_cache(maxsize=1)
def _rules() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of the Gaussian rules, (rules, nodes), padded with zeros."""
    node, weight = np.zeros((2, NODES.size, NODES[-1]))
    for row, number in enumerate(NODES.tolist()):
        node[row, :number], weight[row, :number] = gaussian_rule(number)
    return node, weight


def line_fan(shots: "Shots") -> LineFan:
    """Prepare the speckle lines of shots; of no points if the shots have no developed speckle."""
    lines = shots.speckle_lines
    value = transform_table(shots.window)[1]
    node, weight = _rules()
    size = 0 if lines is None else shots.size
    spread, turn = np.zeros((2, size, 3, 2)) if lines is None else lines
    padding = shots.fft_size / shots.window.length
    spread, turn = _turned_to_steepest(spread, turn, padding)
    # Two bins' transforms together turn by 2 pi at the most for each bin of fs/L.
    phases = np.abs(turn[:, :, None] - turn[:, None]).max(axis=(1, 2))
    phases = phases + np.pi * np.abs(spread).max(axis=1) / padding
    rule = np.searchsorted(_RESOLVED, phases)
    widest = np.sqrt((spread**2).sum(axis=-1)).max(axis=1)
    reach = np.ones(size, np.int64)
    if shots.detection == "any_bin":
        wide = widest > 0.02 * padding
        reach = np.where(wide, 1 + np.ceil(2.5 * widest), 1).astype(np.int64)
    return LineFan(
        np.ascontiguousarray(spread * directions(shots)[..., None][:size]),
        np.ascontiguousarray(turn), rule.astype(np.int64), reach, node, weight, NODES,
        value, OVERSAMPLING / padding, REACH * padding, shots.real_ends // 2,
    )  # fmt: skip


def _turned_to_steepest(
    spread: np.ndarray, turn: np.ndarray, padding: float
) -> tuple[np.ndarray, np.ndarray]:
    """Turn the beam's two coordinates until shifts and phases grow most along the first.

    The beam is round, so that the law is the same; few lines are then needed along the second.
    """
    slopes = np.concatenate([turn - turn[:, :1], spread * (np.pi / padding)], axis=1)
    y, x = slopes[..., 0], slopes[..., 1]
    angle = 0.5 * np.arctan2(2 * (y * x).sum(axis=1), (y * y - x * x).sum(axis=1))
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]

    def turned(vectors: np.ndarray) -> np.ndarray:
        along, across = vectors[..., 0], vectors[..., 1]
        return np.stack([cosine * along + sine * across, cosine * across - sine * along], axis=-1)

    return turned(spread), turned(turn)


def directions(shots: "Shots") -> np.ndarray:
    """Return the sign of d(bin) / d(beat) after folding, by segment: -1 or 1, (n, 3)."""
    found = np.ones((shots.size, 3))
    if shots.complex_record:
        return found
    for s, segment in enumerate(shots.waveform):
        delay = 2 / SPEED_OF_LIGHT * (shots.range - segment.nearer)
        beat = segment.carrier * segment.beta - segment.chirp_rate * delay * (1 + segment.beta)
        turns = beat / shots.sample_rate
        found[:, s] = np.where(turns - np.floor(turns + 0.5) < 0, -1.0, 1.0)
    return found


@njit(cache=True, error_model="numpy", borrows=True)
def transform_at(distance, fan):
    """Interpolate the window transform G at a distance from the line [bins of fs/N]."""
    place = abs(distance) * fan.steps
    k = int(place)
    if k >= fan.transform.size - 1:
        return 0.0
    return fan.transform[k] + (place - k) * (fan.transform[k + 1] - fan.transform[k])


@njit(cache=True, error_model="numpy")
def image_of(place, half):
    """Place [bins] of the nearer image of a line of a real record, about DC or Nyquist."""
    return -place if place < 0.5 * half else 2.0 * half - place


@njit(cache=True, error_model="numpy", borrows=True)
def line_powers(fan, i, middle, first, power, pseudo):
    """Mean powers (3, bins) of bins by lines of a total power of 1, into ``power``.

    ``middle`` (3,) is the echo's middle in each segment, nan for none, and ``first`` (3,) the first
    of the bins, in the same numbers. ``pseudo`` takes the pseudo-variances over these powers, which
    images of lines make (:mod:`sweep.model.quadratures`). Returns true if there are any.
    """
    power[:] = 0.0
    pseudo[:] = 0.0
    imaged = False
    along, across = fan.rule[i]
    for s in range(3):
        if np.isnan(middle[s]):
            continue
        for a in range(fan.number[along]):
            for c in range(fan.number[across]):
                weight = fan.weight[along, a] * fan.weight[across, c]
                if weight < _LEAST_WEIGHT:
                    continue
                place = middle[s] + fan.spread[i, s, 0] * fan.node[along, a]
                place += fan.spread[i, s, 1] * fan.node[across, c] - first[s]
                low = max(0, math.ceil(place - fan.size))
                for k in range(low, min(power.shape[1], math.floor(place + fan.size) + 1)):
                    at = transform_at(k - place, fan)
                    power[s, k] += weight * at * at
                if fan.half == 0:
                    continue
                image = image_of(place + first[s], fan.half) - first[s]
                low = max(0, math.ceil(image - fan.size))
                for k in range(low, min(power.shape[1], math.floor(image + fan.size) + 1)):
                    at = transform_at(k - image, fan)
                    power[s, k] += weight * at * at
                    pseudo[s, k] += 2.0 * weight * at * transform_at(k - place, fan)
                    imaged = True
        for k in range(power.shape[1]):
            pseudo[s, k] /= max(power[s, k], 1e-300)
    return imaged


@njit(cache=True, error_model="numpy", borrows=True)
def draw_lines(address, group, fan, i, middle, first, power, out):
    """Draw complex speckle amplitudes of bins, of mean power 1, into ``out`` (3, bins).

    Amplitudes are those of the transform about the record's middle.

    Parameters
    ----------
    address
        Key of the point (two uint64) and number of the draw.
    group
        Number of the echo, which has random numbers of its own.
    fan, i
        Speckle lines (:class:`LineFan`), and the point.
    middle, first
        As of :func:`line_powers`.
    power
        (3, bins): result of :func:`line_powers` for the same bins.

    Notes
    -----
    Equation (1) of the module, over the root of ``power``. All segments see the same amplitudes z.
    Bins that no line reaches stay 0.
    """
    out[:] = 0.0
    along, across = fan.rule[i]
    half, number = math.sqrt(0.5), FIRST_LINE * (1 + group)
    for a in range(fan.number[along]):
        for c in range(fan.number[across]):
            weight = fan.weight[along, a] * fan.weight[across, c]
            if weight < _LEAST_WEIGHT:
                continue
            re, im = philox.normal_pair(
                address[0], address[1], address[2], philox.STREAM_SPECKLE, number
            )
            number += 1
            drawn = complex(re, im) * (half * math.sqrt(weight))
            y, x = fan.node[along, a], fan.node[across, c]
            for s in range(3):
                if np.isnan(middle[s]):
                    continue
                phase = fan.turn[i, s, 0] * y + fan.turn[i, s, 1] * x
                turned = drawn
                if phase != 0.0:
                    turned = drawn * complex(math.cos(phase), math.sin(phase))
                place = middle[s] + fan.spread[i, s, 0] * y + fan.spread[i, s, 1] * x - first[s]
                low = max(0, math.ceil(place - fan.size))
                for k in range(low, min(out.shape[1], math.floor(place + fan.size) + 1)):
                    out[s, k] += turned * transform_at(k - place, fan)
                if fan.half == 0:
                    continue
                image = image_of(place + first[s], fan.half) - first[s]
                low = max(0, math.ceil(image - fan.size))
                for k in range(low, min(out.shape[1], math.floor(image + fan.size) + 1)):
                    out[s, k] += turned.conjugate() * transform_at(k - image, fan)
    for s in range(3):
        for k in range(out.shape[1]):
            if power[s, k] > 0.0:
                out[s, k] /= math.sqrt(power[s, k])


FACTORED_ROWS_MAX = 48
"""Bins of all segments together of which the covariance is factored; of more, lines are drawn."""

_LEAST_RESIDUAL = 1e-8
"""Share of a bin's mean power that a factor may leave out."""


@njit(cache=True, error_model="numpy")
def factor_bins(fan, i, middle, first, power, factor):
    """Factor the covariance of bins by :func:`draw_lines`, and return its rank.

    Parameters
    ----------
    middle, first, power
        As of :func:`draw_lines`.
    factor
        (rows, 3, bins) complex, with as many rows as there are bins in all, for the result: the
        amplitudes of the bins are sums of its first rows with independent circular Gaussian numbers
        of mean power 2.

    Notes
    -----
    Lines that lie close together make much the same amplitudes: of a footprint within a bin two or
    three numbers tell those of nine bins. By Cholesky's factorisation with pivots, until no bin
    lacks more than 1e-8 of its mean power.
    """
    along, across = fan.rule[i]
    segments, bins = power.shape
    weight = np.empty(fan.number[along] * fan.number[across])
    lines = np.zeros((segments, bins, weight.size), np.complex128)
    number = 0
    for a in range(fan.number[along]):
        for c in range(fan.number[across]):
            share = fan.weight[along, a] * fan.weight[across, c]
            if share < _LEAST_WEIGHT:
                continue
            y, x = fan.node[along, a], fan.node[across, c]
            for s in range(segments):
                if np.isnan(middle[s]):
                    continue
                phase = fan.turn[i, s, 0] * y + fan.turn[i, s, 1] * x
                turned = complex(math.sqrt(share), 0.0)
                if phase != 0.0:
                    turned = turned.real * complex(math.cos(phase), math.sin(phase))
                place = middle[s] + fan.spread[i, s, 0] * y + fan.spread[i, s, 1] * x - first[s]
                for k in range(bins):
                    if power[s, k] > 0.0 and abs(k - place) <= fan.size:
                        at = transform_at(k - place, fan) / math.sqrt(power[s, k])
                        lines[s, k, number] = turned * at
            number += 1
    residual = np.where(power > 0.0, 1.0, 0.0)
    for rank in range(factor.shape[0]):
        pivot, most = (0, 0), _LEAST_RESIDUAL
        for s in range(segments):
            for k in range(bins):
                if residual[s, k] > most:
                    pivot, most = (s, k), residual[s, k]
        if most == _LEAST_RESIDUAL:
            return rank
        own, scale = lines[pivot[0], pivot[1]], 1.0 / math.sqrt(most)
        for s in range(segments):
            for k in range(bins):
                if not residual[s, k] > 0.0:
                    factor[rank, s, k] = 0.0
                    continue
                shared = complex(0.0, 0.0)
                for line in range(number):
                    shared += lines[s, k, line] * own[line].conjugate()
                for r in range(rank):
                    shared -= factor[r, s, k] * factor[r, pivot[0], pivot[1]].conjugate() * 2.0
                factor[rank, s, k] = shared * (scale * math.sqrt(0.5))
        for s in range(segments):
            for k in range(bins):
                residual[s, k] -= 2.0 * abs(factor[rank, s, k]) ** 2
        residual[pivot] = 0.0
    return factor.shape[0]


@njit(cache=True, error_model="numpy", borrows=True)
def draw_factored(address, group, factor, rank, out):
    """Draw amplitudes (3, bins) into ``out`` by the rows of :func:`factor_bins`.

    ``address`` and ``group`` are those of :func:`draw_lines`.
    """
    out[:] = 0.0
    first = FIRST_LINE * (1 + group)
    for pair in range(0, rank, 2):
        words = philox.words4(
            address[0], address[1], address[2], philox.STREAM_SPECKLE, (first + pair) >> 1
        )
        one = complex(*philox.to_normals(words[0], words[1]))
        if pair + 1 == rank:
            for s in range(out.shape[0]):
                for k in range(out.shape[1]):
                    out[s, k] += one * factor[pair, s, k]
            return
        other = complex(*philox.to_normals(words[2], words[3]))
        for s in range(out.shape[0]):
            for k in range(out.shape[1]):
                out[s, k] = (out[s, k] + one * factor[pair, s, k]) + other * factor[pair + 1, s, k]


def drawn_speckle(
    fan: LineFan,
    i: int,
    middle: np.ndarray,
    bins: tuple[int, int],
    *,
    key: np.ndarray,
    draws: np.ndarray,
    group: int = 0,
) -> np.ndarray:
    """Draw speckle amplitudes of mean power 1 in adjacent bins of one segment of point i.

    Parameters
    ----------
    middle
        (3,): centre of the echo in the segment that is drawn [bins], nan in the other two.
    bins
        First bin, and number of bins.
    key
        (2,) uint64: random key of the point.
    draws
        (m,) int64: numbers of the draws.
    group
        Number of the echo.

    Returns
    -------
    numpy.ndarray
        (m, bins) complex.
    """
    (segment,) = np.flatnonzero(np.isfinite(middle))
    first = np.full(3, bins[0])
    power = np.empty((3, bins[1]))
    line_powers(fan, i, middle, first, power, np.empty((3, bins[1])))
    out = np.zeros((3, bins[1]), complex)
    found = np.empty((draws.size, bins[1]), complex)
    for row, draw in enumerate(draws):
        draw_lines((key[0], key[1], draw), group, fan, i, middle, first, power, out)
        found[row] = out[segment]
    return found


RECORD_SPREAD_MAX = 1.0
"""Deviation of a footprint's lines [bins of fs/L] up to which :class:`FootprintRecord` is used."""


class FootprintRecord(NamedTuple):
    """Windowed record of a footprint's speckle lines: a lone tone at their middle times a series.

    The series is the sum over lines of ``a z e^(i t . (y, x)) e^(2 pi i b . (y, x) (n - middle) /
    N)`` by Chebyshev polynomials in the number n of the sample.
    """

    phasor: np.ndarray
    """(lines, k) complex: coefficients of the series by line, for z of 1."""
    samples: np.ndarray
    """(L,): samples' places in the series, -1 .. 1 over the samples that the echo has."""
    tone: np.ndarray
    """(L,) complex: windowed record of the lone tone, of amplitude 1."""
    power: np.ndarray
    """(N,): mean power of the transform of the record by bin."""

    @classmethod
    def of(
        cls, fan: LineFan, i: int, segment: int, place: float, window: Window, begun: int,
        fft_size: int,
    ) -> "FootprintRecord":  # fmt: skip
        """Prepare the record of point i in a segment.

        Parameters
        ----------
        place
            Frequency of the lone tone [bins].
        window, begun
            Window of the record, and the number of samples before the echo.

        Notes
        -----
        The mean power of all bins is the transform of the window's autocorrelation times the mean
        phasor of the lines, by the distance of two samples.
        """
        offset, phase, weight = _lines_of(fan, i, segment)
        length = window.length
        half = max(0.5 * (length - 1 - begun), 0.5)
        turns = 2 * np.pi * offset / fft_size
        middle = 0.5 * length + float(middle_moved(window)[begun])
        at, to_series = _chebyshev(_degree(np.abs(turns).max() * half))
        phasor = np.exp(1j * (phase[:, None] + turns[:, None] * (begun + half * (1 + at) - middle)))
        phasor = np.sqrt(0.5 * weight)[:, None] * phasor
        # Sums, not products of matrices, whose order depends on the number of threads.
        phasor = (phasor[:, None] * to_series).sum(axis=2)
        tone = samples(window.name, length) * phasors(-place / fft_size, length)
        tone[:begun] = 0.0
        at, to_series = _chebyshev(_degree(np.abs(turns).max() * length))
        mean = (weight[:, None] * np.exp(0.5j * turns[:, None] * length * (1 + at))).sum(axis=0)
        folded, lag = np.zeros(fft_size, complex), np.arange(length)
        folded[:length] = _autocorrelation(window, begun) * phasors(-place / fft_size, length)
        _times_series((mean * to_series).sum(axis=1), 2 * lag / length - 1, folded)
        folded[0] *= 0.5
        power = 2 * np.fft.fft(folded).real
        power = np.maximum(power, _LEAST_POWER * power.max())
        return cls(phasor, (lag - begun) / half - 1, tone, power)

    def draw(self, key: np.ndarray, draw: int, group: int) -> np.ndarray:
        """Draw the record (L,) of a group's speckle, by the numbers of :func:`draw_lines`."""
        amplitude = np.empty(len(self.phasor), complex)
        _draw_amplitudes((key[0], key[1], np.int64(draw)), FIRST_LINE * (1 + group), amplitude)
        record = self.tone.copy()
        _times_series((amplitude[:, None] * self.phasor).sum(axis=0), self.samples, record)
        return record


_LEAST_POWER = 1e-14
"""Mean power of a bin, over the largest, below which it is not known to float64."""


def _lines_of(fan: LineFan, i: int, segment: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets [bins], phases [rad] and weights of lines, in the order of draw_lines."""
    along, across = fan.rule[i]
    y, x = (fan.node[rule, : fan.number[rule]] for rule in (along, across))
    weight = fan.weight[along, : y.size, None] * fan.weight[across, : x.size]
    slopes = [of[i, segment, 0] * y[:, None] + of[i, segment, 1] * x for of in fan[:2]]
    used = weight >= _LEAST_WEIGHT
    return slopes[0][used], slopes[1][used], weight[used]


@njit(cache=True, error_model="numpy")
def _draw_amplitudes(address, number, out):
    """Draw circular complex Gaussian numbers of mean power 2, of the stream of speckle."""
    for k in range(out.size):
        re, im = philox.normal_pair(
            address[0], address[1], address[2], philox.STREAM_SPECKLE, number + k
        )
        out[k] = complex(re, im)


def _degree(phase: float) -> int:
    """Return the degree of a Chebyshev series that has exponentials up to a phase to 1e-7."""
    return 9 + math.ceil(1.5 * phase)


@lru_cache(maxsize=64)
def _chebyshev(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (number,) of a Chebyshev series, and what makes its coefficients of values there.

    The matrix (number, number) has a row for each coefficient.
    """
    angle = np.pi * (np.arange(number) + 0.5) / number
    to_series = np.cos(np.arange(number)[:, None] * angle) * (2.0 / number)
    to_series[0] *= 0.5
    return np.cos(angle), to_series


_SAMPLES_AT_ONCE = 128
"""Samples that a series is evaluated at together, in vector registers."""


@njit(cache=True, error_model="numpy")
def _times_series(series, place, out):
    """Multiply numbers in place by a Chebyshev series at places -1 .. 1 (Clenshaw's algorithm)."""
    last_re, last_im = np.empty(_SAMPLES_AT_ONCE), np.empty(_SAMPLES_AT_ONCE)
    before_re, before_im = np.empty(_SAMPLES_AT_ONCE), np.empty(_SAMPLES_AT_ONCE)
    x = np.empty(_SAMPLES_AT_ONCE)
    for first in range(0, place.size, _SAMPLES_AT_ONCE):
        number = min(_SAMPLES_AT_ONCE, place.size - first)
        for n in range(number):
            x[n] = 2.0 * place[first + n]
            last_re[n] = last_im[n] = before_re[n] = before_im[n] = 0.0
        for k in range(series.size - 1, 0, -1):
            re, im = series[k].real, series[k].imag
            for n in range(number):
                value = re + x[n] * last_re[n] - before_re[n]
                before_re[n], last_re[n] = last_re[n], value
            for n in range(number):
                value = im + x[n] * last_im[n] - before_im[n]
                before_im[n], last_im[n] = last_im[n], value
        for n in range(number):
            re = series[0].real + 0.5 * x[n] * last_re[n] - before_re[n]
            im = series[0].imag + 0.5 * x[n] * last_im[n] - before_im[n]
            out[first + n] *= complex(re, im)


@lru_cache(maxsize=16)
def _autocorrelation(window: Window, begun: int) -> np.ndarray:
    """Return the autocorrelation (L,) of a window without its first samples, by lag."""
    w = samples(window.name, window.length).copy()
    w[:begun] = 0.0
    spectrum = np.fft.rfft(w, 2 * w.size)
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, 2 * w.size)[: w.size])


def wander_covariance(
    lines: SpeckleLines, pair: tuple[int, int], power: np.ndarray, share: np.ndarray
) -> np.ndarray:
    """Covariance [bins^2] of the places of two segments' peaks by speckle, of m peaks of points.

    Parameters
    ----------
    lines
        Footprints of the m peaks.
    pair
        Numbers of the two segments.
    power
        (2, m): power q^2 of the two peaks in units of its mean, noise included.
    share
        (2, m): share of the echo in that mean.

    Returns
    -------
    numpy.ndarray
        (m,), signed as the beats.

    Notes
    -----
    With t the difference of the two turns and rho = exp(-t.t / 2) (v_1 v_2)^(1/2) the correlation
    of the amplitudes A_1 and A_2, the means of Y_1 and Y_2 given both amplitudes are

        E[Y_1] = -i t rho k (A_2 - rho A_1),   E[Y_2] = i t rho k (A_1 - rho A_2),
        k = 1 / (1 - rho^2),

    and what is left has the covariance rho (1 - k t t'). An instrument knows the amplitudes' sizes.
    Given these their phases differ by an angle of von Mises' distribution of the concentration
    K = 2 k rho q_1 q_2, with the means I_1(K) / I_0(K) of its cosine and I_1(K) / (K I_0(K)) of its
    squared sine. Hence

        (b_1.t) (b_2.t) (rho k)^2 E[sin^2] + rho (b_1.b_2 - k (b_1.t) (b_2.t)) E[cos] / (2 q_1 q_2).
    """
    first, second = pair
    b, c = lines.spread[:, first], lines.spread[:, second]
    t = lines.turn[:, second] - lines.turn[:, first]
    square = (t * t).sum(axis=-1)
    rho = np.exp(-0.5 * square) * np.sqrt(share[0] * share[1])
    left = np.maximum(1 - rho * rho, 1e-12)
    size = np.sqrt(power[0] * power[1])
    # The ratio is that of its limits beyond, to float64.
    concentration = np.clip(2 * rho * size / left, 1e-12, 1e7)
    cosine = special.i1e(concentration) / special.i0e(concentration)
    along = (b * t).sum(axis=-1) * (c * t).sum(axis=-1) / left
    common = (b * c).sum(axis=-1) - along
    squared_sine = cosine / np.maximum(2 * rho * size / left, 1e-12)
    return np.asarray(along * rho * rho / left * squared_sine + rho * common * cosine / (2 * size))


class Peaks(NamedTuple):
    """Detected peaks of m echoes in developed speckle, (m, 3) by segment; nan for none."""

    delta: np.ndarray
    """Interpolated position, relative to the bin about which it was estimated [bins]."""
    direction: np.ndarray
    """-1 where the segment's bin falls as its beat rises (:func:`directions`), else 1."""
    power: np.ndarray
    """Power q^2 of the peak bin over its mean, echo and noise."""
    share: np.ndarray
    """Fraction v of that mean that is echo, 0 .. 1."""


FARTHEST = 1.5
"""Bound on the wander of a peak [bins] where only the strongest bin is tested (``peak_bin``)."""


ALL_PAIRS = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
"""All pairs of segments (0 up, 1 Doppler, 2 down), each segment with itself included."""
CHIRPS = (0, 0), (0, 2), (2, 2)
"""Pairs among the up and the down segment alone."""


def place_errors(
    lines: SpeckleLines,
    peaks: Peaks,
    shots: "Shots",
    pairs: tuple[tuple[int, int], ...] = ALL_PAIRS,
) -> np.ndarray:
    """Return second moments E[e_i e_j] [bins^2] of the errors that speckle makes in peak positions.

    Parameters
    ----------
    lines
        Gradients of the lines of the m echoes (:class:`SpeckleLines`).
    peaks
        Their peaks, (m, 3).
    shots
        Window, FFT size, rule of detection and looks.
    pairs
        Pairs of segments (i, j) that are computed.

    Returns
    -------
    numpy.ndarray
        (m, 3, 3) by segment, signed as the beats; 0 for pairs without both peaks, or not asked for.

    Notes
    -----
    The sum of the wander, equation (3) and :func:`wander_covariance`, and of the errors by the
    shape of the peak (:class:`ShapeErrors`). Re V has the mean b^2 and the variance b^4 (v / q^2 +
    v^2 / q^4), with the peak's power q^2 and its echo fraction v. Where only the strongest bin is
    tested the wander's deviation is divided by sqrt(1 + variance / FARTHEST^2). The mean over L
    looks of independent speckle has 1 / L of the variance.
    """
    spread = (lines.spread**2).sum(axis=-1)
    there = np.isfinite(peaks.power) & np.isfinite(peaks.delta)
    power = np.where(there, np.maximum(peaks.power, 1e-12), 1.0)
    share = np.where(there, peaks.share, 0.0)
    variance = spread * share / (2 * power)
    shape = ShapeErrors.at(np.where(there, peaks.delta, 0.0), variance, shots)
    widening = peaks.direction * shape.widening * spread * (share > 0)
    mean = peaks.direction * shape.twist + widening
    further = np.sqrt((share / power) * (1 + share / power)) * widening
    bound = np.ones(variance.shape)
    if shots.detection == "peak_bin":
        bound = 1 / np.sqrt(1 + variance / FARTHEST**2)
    looks = shots.looks.number if shots.looks.several and shots.looks.independent else 1
    found = np.zeros((*power.shape, 3))
    for first, second in pairs:
        both = there[:, first] & there[:, second]
        if first == second:
            value, alike = variance[:, first], 1.0
        else:
            pair = [first, second]
            value = wander_covariance(lines, (first, second), power[:, pair].T, share[:, pair].T)
            turn = lines.turn[:, second] - lines.turn[:, first]
            alike = np.exp(-0.5 * (turn * turn).sum(axis=-1))
        value = value + further[:, first] * further[:, second] * alike
        value = value * bound[:, first] * bound[:, second] / looks
        value = np.where(both, value + mean[:, first] * mean[:, second], 0.0)
        found[:, first, second] = found[:, second, first] = value
    return found


_STEP = 0.05
"""Test displacement [bins]: imaginary shift, and root of the variance, of the numerical
derivatives."""


class ShapeErrors(NamedTuple):
    """Position errors of peaks that speckle has deformed, to second order in the lines' spread."""

    twist: np.ndarray
    """Error [bins] by the imaginary part of the tone's complex shift, for its given variance."""
    widening: np.ndarray
    """Error [bins] per bin^2 of Re V, V the complex variance of the lines."""

    @classmethod
    def at(cls, delta: np.ndarray, variance: np.ndarray, shots: "Shots") -> "ShapeErrors":
        """Return the errors of tones ``delta`` [bins] from the strongest bin.

        To second order in the spread b the bin at x is A (G - s G' + (V + s^2) G'' / 2), with the
        complex shift s, whose real and imaginary parts each have the ``variance`` [bins^2], and

            V = sum a z b^2 y^2 / A - s^2.

        The real part of s is the wander. Its imaginary part, and V, make the magnitudes of three
        bins differ from those of any tone: the estimate errs in proportion to (Im s)^2 and to Re V.
        """
        place, twist, widening = _shape_table(shots.window, shots.fft_size)
        side, past = np.sign(delta), np.abs(delta)
        return cls(
            side * np.interp(past, place, twist) * variance, side * np.interp(past, place, widening)
        )


@lru_cache(maxsize=16)
def _shape_table(window: Window, fft_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tabulate place 0 .. 1 [bins], error / (Im shift)^2 [1/bins] and error / Re V [1/bins]."""
    tables, tone = interpolator(window, fft_size), lone_tone(window, fft_size)
    place = np.linspace(0.0, 1.0, 65)
    bins = np.array([[-1.0], [0.0], [1.0]]) - place
    twisted, widened = tone(bins - 1j * _STEP), 0.5 * (tone(bins + _STEP) + tone(bins - _STEP))
    errors = [
        (np.array([sub_bin(*three, tables) for three in np.abs(values).T]) - place) / _STEP**2
        for values in (twisted, widened)
    ]
    return place, errors[0], errors[1]
