"""Random numbers by address: the counter-based generator Philox4x64-10 [1]_, compiled.

A random number is a function of its address: the random key of a point, the number of a draw, the
physical cause (the stream), and an index in the stream. It does not depend on the order of work,
the size of blocks or the number of workers. The generator turns a 256-bit counter into a block of
four 64-bit words. The four words of the counter are

    word 0: number of the block    word 1: 0    word 2: number of the draw    word 3: stream

The results are those of ``numpy.random.Philox`` for this key and counter, bit for bit.

References
----------
.. [1] Salmon, Moraes, Dror and Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011.
"""

import hashlib
import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import multiply_high, njit

# Streams, one for each physical cause. Causes that act in every segment have three: up, Doppler,
# down. Every stored draw depends on these numbers: add numbers, never change any.
STREAM_DETECTION = (1, 3, 2)
"""Stream numbers, for up, Doppler and down segment, of the random numbers that are compared with
probabilities of detection."""
STREAM_FALSE_ALARM = (4, 6, 5)
"""Stream numbers, for up, Doppler and down segment, of the random numbers for false alarms of
noise: whether one occurs, and in which bin."""
STREAM_NOISE = (7, 9, 8)
"""Stream numbers, for up, Doppler and down segment, of the random numbers for the noise in bins of
echoes and of leaked signal."""
STREAM_NOISE_MAXIMUM = (10, 12, 11)
"""Stream numbers, for up, Doppler and down segment, of the random numbers for the largest magnitude
in bins of noise alone, and for its bin."""
STREAM_FOOTPRINT_PHASE = 13
"""Stream number of the random phases of the beamlets' echoes."""
STREAM_SPECKLE = 14
"""Stream number of the random complex amplitudes of developed speckle."""
STREAM_POINTING_JITTER = 16
"""Stream number of the beam's random pointing jitter."""
STREAM_SCINTILLATION = 17
"""Stream number of the random intensity that turbulence gives the echo (scintillation)."""
STREAM_RECORD_NOISE = (18, 20, 19)
"""Stream numbers, for up, Doppler and down segment, of the noise in the samples of a record."""
STREAM_LASER_PHASE = (21, 23, 22)
"""Stream numbers, for up, Doppler and down segment, of the random walk of the laser's phase."""
STREAM_ERROR_FLOOR = 24
"""Stream number of an instrument's random errors that do not depend on the echo."""
STREAM_LEAKAGE = (25, 27, 26)
"""Stream numbers, for up, Doppler and down segment, of the random numbers for false peaks of leaked
signal."""
GROUP_STREAM_OFFSET = 1000
"""Number to add to the number of a stream, for the stream of random words that spread its numbers
evenly over a group of draws (:mod:`sweep.model.sampling.draw_groups`). The address of these words
has the number of the group in place of the number of the draw."""

_MULTIPLIERS = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_MULTIPLIER_0, _MULTIPLIER_1 = (np.uint64(m) for m in _MULTIPLIERS)
_MULTIPLIER_0_LOW, _MULTIPLIER_1_LOW = (np.uint64(m & 0xFFFFFFFF) for m in _MULTIPLIERS)
_MULTIPLIER_0_HIGH, _MULTIPLIER_1_HIGH = (np.uint64(m >> 32) for m in _MULTIPLIERS)
_WEYL_0 = np.uint64(0x9E3779B97F4A7C15)
_WEYL_1 = np.uint64(0xBB67AE8584CAA73B)
_LOW_HALF_MASK = np.uint64(0xFFFFFFFF)

_SHIFT_32, _SHIFT_12 = np.uint64(32), np.uint64(12)


class DrawAddress(NamedTuple):
    """Address of the random numbers of one draw of a point: random key and number of the draw."""

    key_0: np.uint64
    """First 64-bit word of the point's random key (:func:`point_keys`)."""
    key_1: np.uint64
    """Second 64-bit word of the point's random key (:func:`point_keys`)."""
    draw: np.int64
    """Number of the draw, from 0."""


class CounterIncrements(NamedTuple):
    """Differences between the generator's counters for successive columns in :func:`fill_words`.

    A counter contains the number of the draw and the number of the block (four random words).
    """

    draw: int
    """Number of the draw in the next column, minus the number of the draw in this column."""
    block: int
    """Number of the block (four random words) in the next column, minus the number in this column.
    """


# Arguments of `fill_words` as constants, because numba compiles anew for each literal in a call.
FIRST_BLOCK_NUMBER = np.int64(0)
"""Number of the first block (four random words) of a stream."""
DRAW_INCREMENTS = CounterIncrements(draw=1, block=0)
""":class:`CounterIncrements` for columns that hold the same block (four random words) of successive
draws."""
BLOCK_INCREMENTS = CounterIncrements(draw=0, block=1)
""":class:`CounterIncrements` for columns that hold successive blocks (four random words) of one
draw."""


@njit(cache=True)
def _philox_round(x0, x1, x2, x3, key0, key1):
    """Apply one of the ten rounds of Philox4x64 to the four words of a counter [1]_.

    With the constants M_0 and M_1, and the high and low 64 bits of a product, the new words are

        high(M_1 x2) ^ x1 ^ key0,    low(M_1 x2),    high(M_0 x0) ^ x3 ^ key1,    low(M_0 x0).

    Parameters
    ----------
    x0, x1, x2, x3 : uint64
        Words of the counter.
    key0, key1 : uint64
        Key of the round.

    Returns
    -------
    tuple of four uint64
        New words.

    Notes
    -----
    The high words of 128-bit products are computed from 32-bit halves, because vector registers
    lack such a product. The processor then computes several counters at once.

    References
    ----------
    .. [1] Salmon, Moraes, Dror and Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011.
    """
    low, high = x0 & _LOW_HALF_MASK, x0 >> _SHIFT_32
    middle = _MULTIPLIER_0_LOW * high + (_MULTIPLIER_0_LOW * low >> _SHIFT_32)
    product0 = (
        _MULTIPLIER_0_HIGH * high
        + (middle >> _SHIFT_32)
        + (_MULTIPLIER_0_HIGH * low + (middle & _LOW_HALF_MASK) >> _SHIFT_32)
    )
    low, high = x2 & _LOW_HALF_MASK, x2 >> _SHIFT_32
    middle = _MULTIPLIER_1_LOW * high + (_MULTIPLIER_1_LOW * low >> _SHIFT_32)
    product1 = (
        _MULTIPLIER_1_HIGH * high
        + (middle >> _SHIFT_32)
        + (_MULTIPLIER_1_HIGH * low + (middle & _LOW_HALF_MASK) >> _SHIFT_32)
    )
    return product1 ^ x1 ^ key0, _MULTIPLIER_1 * x2, product0 ^ x3 ^ key1, _MULTIPLIER_0 * x0


@njit(cache=True)
def four_words(key0, key1, draw, stream, block):
    """Return four random words of a stream.

    Parameters
    ----------
    key0, key1 : uint64
        Random key of a point.
    draw : int
        Number of the draw.
    stream : int
        Number of the stream, that is of the physical cause.
    block : int
        Number of the block of four words.

    Returns
    -------
    tuple of four uint64
        Random words.
    """
    k0, k1 = np.uint64(key0), np.uint64(key1)
    x0, x1, x2, x3 = np.uint64(block), np.uint64(0), np.uint64(draw), np.uint64(stream)
    for _ in range(10):
        x0, x1, x2, x3 = (
            multiply_high(_MULTIPLIER_1, x2) ^ x1 ^ k0, _MULTIPLIER_1 * x2,
            multiply_high(_MULTIPLIER_0, x0) ^ x3 ^ k1, _MULTIPLIER_0 * x0,
        )  # fmt: skip
        k0, k1 = k0 + _WEYL_0, k1 + _WEYL_1
    return x0, x1, x2, x3


@njit(cache=True)
def fill_words(address, stream, block, increments, count, words):
    """Fill the columns of an array with random words, one block (:func:`four_words`) a column.

    Parameters
    ----------
    address
        Key of the point, and draw of the first column (:class:`DrawAddress`).
    stream
        Number of the stream: the physical cause.
    block
        Block of the first column.
    increments
        Increments of draw and block from one column to the next (:class:`CounterIncrements`).
    count
        Number of columns to fill.
    words
        (4, >= count) uint64, in C order: output array.

    Notes
    -----
    Each round of the generator is applied to all columns before the next round. The processor
    vectorises this loop, which is about six times as fast.
    """
    key_0, key_1, first_draw = address
    k0, k1, draw = np.uint64(key_0), np.uint64(key_1), np.uint64(first_draw)
    x0, x1, x2, x3 = words[0], words[1], words[2], words[3]
    for i in range(count):
        x0[i], x1[i] = np.uint64(block) + np.uint64(increments.block * i), 0
        x2[i], x3[i] = draw + np.uint64(increments.draw * i), stream
    for _ in range(10):
        for i in range(count):
            x0[i], x1[i], x2[i], x3[i] = _philox_round(x0[i], x1[i], x2[i], x3[i], k0, k1)
        k0, k1 = k0 + _WEYL_0, k1 + _WEYL_1


@njit(cache=True)
def to_uniform(word):
    """Convert a random word to a uniform number in (0, 1).

    The number is the centre of one of 2^52 equal cells, so that it is never 0 or 1. Only the upper
    52 bits of the word are used, because with 53 the last centre would round to 1.
    """
    return (np.float64(word >> _SHIFT_12) + 0.5) * 2.0**-52


@njit(cache=True)
def to_normals(word0, word1):
    """Convert two random words to two independent standard normal numbers, by Box and Muller.

    With the uniform numbers u and w of the words (:func:`to_uniform`), the numbers are

        sqrt(-2 ln u) cos(2 pi w),    sqrt(-2 ln u) sin(2 pi w).

    The root of the sum of their squares is at most sqrt(2 ln 2^53) = 8.57.

    Parameters
    ----------
    word0, word1 : uint64
        Random words: the first gives the radius, the second the angle.

    Returns
    -------
    tuple of two float
        Normal numbers of mean 0 and variance 1.
    """
    radius, angle = math.sqrt(-2.0 * math.log(to_uniform(word0))), 2.0 * math.pi * to_uniform(word1)
    return radius * math.cos(angle), radius * math.sin(angle)


@njit(cache=True)
def uniform(key0, key1, draw, stream, index):
    """Return one uniform random number of a stream in a draw.

    The number is between 2^-53 and 1 - 2^-53. If it is compared with the probability of an event,
    an event of probability below 2^-53 = 1.1e-16 never happens.

    Parameters
    ----------
    key0, key1 : uint64
        Random key of a point.
    draw : int
        Number of the draw.
    stream : int
        Number of the stream, that is of the physical cause.
    index : int
        Index of the number in the stream.
    """
    return to_uniform(four_words(key0, key1, draw, stream, index >> 2)[index & 3])


@njit(cache=True)
def normal_pair(key0, key1, draw, stream, index):
    """Return two standard normal random numbers of a stream in a draw.

    The two numbers are made from the uniform numbers ``2 index`` and ``2 index + 1``.

    Parameters
    ----------
    key0, key1 : uint64
        Random key of a point.
    draw : int
        Number of the draw.
    stream : int
        Number of the stream, that is of the physical cause.
    index : int
        Index of the pair in the stream.
    """
    words = four_words(key0, key1, draw, stream, index >> 1)
    return to_normals(words[2], words[3]) if index & 1 else to_normals(words[0], words[1])


def uniforms(keys: np.ndarray, draws: np.ndarray, stream: int, count: int) -> np.ndarray:
    """Return the first uniform numbers of a stream in each of m draws, (m, count).

    Parameters
    ----------
    keys
        (m, 2) uint64: random key of each row.
    draws
        (m,) int64: number of the draw of each row.
    stream
        Number of the stream: the physical cause.
    count
        Number of uniform numbers in a row.
    """
    out = np.empty((draws.size, (count + 3) // 4 * 4))
    _fill_uniforms(np.ascontiguousarray(keys), np.asarray(draws, np.int64), stream, out)
    return out[:, :count]


@njit(cache=True, nogil=True)
def _fill_uniforms(keys, draws, stream, out):
    """Fill the rows of ``out`` (m, count) with the first uniform numbers of a stream.

    The arguments are those of :func:`uniforms`. ``count`` is a multiple of 4.
    """
    words = np.empty((4, out.shape[1] // 4), np.uint64)
    for i in range(draws.size):
        address = DrawAddress(keys[i, 0], keys[i, 1], draws[i])
        fill_words(address, stream, FIRST_BLOCK_NUMBER, BLOCK_INCREMENTS, words.shape[1], words)
        for block in range(words.shape[1]):
            for lane in range(4):
                out[i, 4 * block + lane] = to_uniform(words[lane, block])


def to_normals_by_row(uniform_numbers: np.ndarray) -> np.ndarray:
    """Convert uniform numbers (m, k), with even k, to standard normal numbers (m, k).

    Columns 2 i and 2 i + 1 hold pair i, which equals the result of :func:`normal_pair` for the
    index i up to the last bit.
    """
    # Contiguous copies, so that bits do not depend on the number of rows.
    first, second = (np.ascontiguousarray(uniform_numbers[:, lane::2]) for lane in range(2))
    radius, angle = np.sqrt(-2.0 * np.log(first)), 2.0 * np.pi * second
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(
        len(uniform_numbers), -1
    )


def point_keys(parameter_rows: np.ndarray, *, domain: str, seed: int) -> np.ndarray:
    """Return the random keys (n, 2) uint64 of points, which follow from their parameters alone.

    Parameters
    ----------
    parameter_rows
        (n, m): parameters of each point, without nan.
    domain
        Text that states the meaning of the rows, such as names and order of the columns, so that
        equal numbers of different meaning give different keys.
    seed
        Seed of the study, not negative.

    Notes
    -----
    A key is the BLAKE2b-128 hash of domain, seed and row. Points of equal parameters have equal
    keys, wherever they are in a grid, and points of different parameters have different keys.
    """
    table = np.asarray(parameter_rows, dtype="<f8")
    if table.ndim != 2:
        raise ValueError("rows of parameters form an array of shape (n, m)")
    if np.isnan(table).any():
        raise ValueError("a parameter is nan, which no point can be known by")
    if seed < 0:
        raise ValueError("a seed is not negative")
    prefix_hash = hashlib.blake2b(digest_size=16)
    for encoded in (domain.encode(), str(int(seed)).encode()):
        prefix_hash.update(len(encoded).to_bytes(8, "little"))
        prefix_hash.update(encoded)
    digests = []
    for row in np.ascontiguousarray(table + 0.0):  # -0.0 + 0.0 is 0.0
        row_hash = prefix_hash.copy()
        row_hash.update(row.tobytes())
        digests.append(row_hash.digest())
    return np.frombuffer(b"".join(digests), dtype="<u8").reshape(-1, 2).astype(np.uint64)
