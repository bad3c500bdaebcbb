"""Random numbers by address: Philox4x64-10 [Salmon et al., SC 2011], compiled.

A random number is a function of the point (the key), the number of the draw, the physical cause
(the stream) and an index in the stream. It does not depend on the order of work, the size of blocks
or the number of workers. The 256-bit counter is

    word 0: block of four outputs    word 1: 0    word 2: draw    word 3: stream

The words are those of ``numpy.random.Philox`` for this key and counter, bit for bit.
"""

import hashlib
import math

import numpy as np

from sweep.kernel_cache import multiply_high, njit

# Streams, one per physical cause; causes that act in each segment have three: up, Doppler, down.
# Every stored draw depends on these numbers: add numbers, never change any.
STREAM_DETECTION = (1, 3, 2)
"""Streams of detections, by comparison with a probability; by segment."""
STREAM_FALSE_ALARM = (4, 6, 5)
"""Streams of false alarms of noise, compared with a probability, and of their bins; by segment."""
STREAM_NOISE = (7, 9, 8)
"""Streams of the noise of the bins of an echo and of leaked signal; by segment."""
STREAM_NOISE_MAXIMUM = (10, 12, 11)
"""Streams of the largest magnitude in bins of noise alone, and of its bin; by segment."""
STREAM_FOOTPRINT_PHASE = 13
"""Stream of phases of beamlets."""
STREAM_SPECKLE = 14
"""Stream of amplitudes of developed speckle."""
STREAM_POINTING_JITTER = 16
"""Stream of the pointing jitter of the beam."""
STREAM_SCINTILLATION = 17
"""Stream of scintillation by turbulence."""
STREAM_RECORD = (18, 20, 19)
"""Streams of the noise of the samples of a record; by segment."""
STREAM_LASER_PHASE = (21, 23, 22)
"""Streams of the random walk of the laser's phase; by segment."""
STREAM_ERROR_FLOOR = 24
"""Stream of errors of the instrument that do not depend on the echo."""
STREAM_LEAKAGE = (25, 27, 26)
"""Streams of false peaks by leaked signal; by segment."""

_MULTIPLIERS = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_M0, _M1 = (np.uint64(m) for m in _MULTIPLIERS)
_LOW0, _LOW1 = (np.uint64(m & 0xFFFFFFFF) for m in _MULTIPLIERS)
_HIGH0, _HIGH1 = (np.uint64(m >> 32) for m in _MULTIPLIERS)
_WEYL_0 = np.uint64(0x9E3779B97F4A7C15)
_WEYL_1 = np.uint64(0xBB67AE8584CAA73B)
_HALF_WORD = np.uint64(0xFFFFFFFF)

FIRST_BLOCK_NUMBER, DRAW_INCREMENTS, BLOCK_INCREMENTS = np.int64(0), (1, 0), (0, 1)
"""Arguments of :func:`fill_words` as constants: numba compiles anew for each literal in a call."""

_SHIFT_32, _SHIFT_12 = np.uint64(32), np.uint64(12)


@njit(cache=True)
def _round(x0, x1, x2, x3, key0, key1):
    """Return the counter after one of the ten rounds of Philox.

    High words of 128-bit products are computed from 32-bit halves, because vector registers lack
    such a product. The processor then computes several counters at once.
    """
    low, high = x0 & _HALF_WORD, x0 >> _SHIFT_32
    middle = _LOW0 * high + (_LOW0 * low >> _SHIFT_32)
    product0 = (
        _HIGH0 * high + (middle >> _SHIFT_32) + (_HIGH0 * low + (middle & _HALF_WORD) >> _SHIFT_32)
    )
    low, high = x2 & _HALF_WORD, x2 >> _SHIFT_32
    middle = _LOW1 * high + (_LOW1 * low >> _SHIFT_32)
    product1 = (
        _HIGH1 * high + (middle >> _SHIFT_32) + (_HIGH1 * low + (middle & _HALF_WORD) >> _SHIFT_32)
    )
    return product1 ^ x1 ^ key0, _M1 * x2, product0 ^ x3 ^ key1, _M0 * x0


@njit(cache=True)
def four_words(key0, key1, draw, stream, block):
    """Return the four random words (uint64) of indices 4 `block` to 4 `block` + 3 of a stream."""
    k0, k1 = np.uint64(key0), np.uint64(key1)
    x0, x1, x2, x3 = np.uint64(block), np.uint64(0), np.uint64(draw), np.uint64(stream)
    for _ in range(10):
        x0, x1, x2, x3 = (
            multiply_high(_M1, x2) ^ x1 ^ k0, _M1 * x2, multiply_high(_M0, x0) ^ x3 ^ k1, _M0 * x0,
        )  # fmt: skip
        k0, k1 = k0 + _WEYL_0, k1 + _WEYL_1
    return x0, x1, x2, x3


@njit(cache=True)
def fill_words(address, stream, block, increments, count, words):
    """Fill columns of an array with the words of :func:`four_words`.

    Parameters
    ----------
    address
        Key (two uint64) and draw of the first column.
    stream
        Stream.
    block
        Block of the first column.
    increments
        Increments of draw and block from one column to the next.
    count
        Number of columns to fill.
    words
        (4, >= count) uint64, in C order; the result.

    Notes
    -----
    All columns pass one round before any passes the next, which the processor vectorises: about six
    times as fast.
    """
    k0, k1, draw = np.uint64(address[0]), np.uint64(address[1]), np.uint64(address[2])
    x0, x1, x2, x3 = words[0], words[1], words[2], words[3]
    for i in range(count):
        x0[i], x1[i] = np.uint64(block) + np.uint64(increments[1] * i), 0
        x2[i], x3[i] = draw + np.uint64(increments[0] * i), stream
    for _ in range(10):
        for i in range(count):
            x0[i], x1[i], x2[i], x3[i] = _round(x0[i], x1[i], x2[i], x3[i], k0, k1)
        k0, k1 = k0 + _WEYL_0, k1 + _WEYL_1


@njit(cache=True)
def to_uniform(word):
    """Return a uniform number in (0, 1) from a word: the centre of one of 2^52 equal cells.

    Only the upper 52 bits are used, because with 53 the last centre would round to 1. So 0 and 1
    are impossible. u and 1 - u are both exact and equally likely.
    """
    return (np.float64(word >> _SHIFT_12) + 0.5) * 2.0**-52


@njit(cache=True)
def to_normals(word0, word1):
    """Return two independent standard normal numbers from two words, by the Box-Muller transform.

    Sigma times the pair is one bin's noise, real and imaginary part (sigma per quadrature). The
    magnitude of the pair is at most sqrt(2 ln 2^53) = 8.57.
    """
    radius, angle = math.sqrt(-2.0 * math.log(to_uniform(word0))), 2.0 * math.pi * to_uniform(word1)
    return radius * math.cos(angle), radius * math.sin(angle)


@njit(cache=True)
def uniform(key0, key1, draw, stream, index):
    """Return uniform number `index` of a stream in a draw, 2^-53 .. 1 - 2^-53.

    So comparison with a uniform number cannot realise a probability below 1.1e-16.
    """
    return to_uniform(four_words(key0, key1, draw, stream, index >> 2)[index & 3])


@njit(cache=True)
def normal_pair(key0, key1, draw, stream, index):
    """Return pair `index` of normal numbers, made from uniforms ``2 index`` and ``2 index + 1``."""
    words = four_words(key0, key1, draw, stream, index >> 1)
    return to_normals(words[2], words[3]) if index & 1 else to_normals(words[0], words[1])


def uniforms(keys: np.ndarray, draws: np.ndarray, stream: int, count: int) -> np.ndarray:
    """Return the first ``count`` uniform numbers of a stream in each of m draws, (m, count).

    Parameters
    ----------
    keys
        (m, 2) uint64: random key of each row.
    draws
        (m,) int64: number of the draw of each row.
    stream
        Stream.
    count
        Number of uniform numbers in a row.
    """
    out = np.empty((draws.size, (count + 3) // 4 * 4))
    _fill_uniforms(np.ascontiguousarray(keys), np.asarray(draws, np.int64), stream, out)
    return out[:, :count]


@njit(cache=True, nogil=True)
def _fill_uniforms(keys, draws, stream, out):
    """Fill rows of `out` with the uniform numbers of a stream, in blocks of four."""
    words = np.empty((4, out.shape[1] // 4), np.uint64)
    for i in range(draws.size):
        address = keys[i, 0], keys[i, 1], draws[i]
        fill_words(address, stream, FIRST_BLOCK_NUMBER, BLOCK_INCREMENTS, words.shape[1], words)
        for block in range(words.shape[1]):
            for lane in range(4):
                out[i, 4 * block + lane] = to_uniform(words[lane, block])


def to_normals_by_row(uniform_numbers: np.ndarray) -> np.ndarray:
    """Return independent standard normal numbers, (m, k) with even k, from as many uniform numbers.

    Each pair is that of `normal_pair`, up to the last bit.
    """
    # Contiguous copies, so that bits do not depend on the number of rows.
    first, second = (np.ascontiguousarray(uniform_numbers[:, lane::2]) for lane in range(2))
    radius, angle = np.sqrt(-2.0 * np.log(first)), 2.0 * np.pi * second
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(
        len(uniform_numbers), -1
    )


def point_keys(parameter_rows: np.ndarray, *, domain: str, seed: int) -> np.ndarray:
    """Return the Philox keys (n, 2) of points, which follow from their parameters alone.

    Parameters
    ----------
    parameter_rows
        (n, m): parameters of each point, without nan.
    domain
        Meaning of the rows, such as names and order of the columns, so that equal numbers of
        different meaning give different keys.
    seed
        Seed, not negative.

    Notes
    -----
    A key is the BLAKE2b-128 hash of domain, seed and row. Equal rows have equal keys and different
    rows different ones, wherever a point is in a grid.
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
