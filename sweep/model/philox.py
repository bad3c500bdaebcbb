"""Random numbers by address: Philox4x64-10 [Salmon et al., SC 2011], compiled.

A draw is a function of the point (the key), the number of the draw, the physical cause (the
stream) and an index within it, and of nothing else: not of the order of work, the size of blocks
or the number of workers. The 256-bit counter is

    word 0: block of four outputs    word 1: 0    word 2: draw    word 3: stream

and the function of (key, counter) is that of ``numpy.random.Philox``, bit for bit.
"""

import hashlib
import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

# Streams, one per physical cause. The numbers are part of every stored draw: add, never change.
STREAM_DETECTION_UP = 1
STREAM_DETECTION_DOWN = 2
STREAM_DETECTION_DOPPLER = 3
STREAM_FALSE_ALARM_UP = 4
STREAM_FALSE_ALARM_DOWN = 5
STREAM_FALSE_ALARM_DOPPLER = 6
STREAM_NOISE_UP = 7
STREAM_NOISE_DOWN = 8
STREAM_NOISE_DOPPLER = 9
STREAM_NOISE_MAXIMUM_UP = 10
STREAM_NOISE_MAXIMUM_DOWN = 11
STREAM_NOISE_MAXIMUM_DOPPLER = 12
STREAM_FOOTPRINT_PHASE = 13
STREAM_SPECKLE = 14
STREAM_LASER_PHASE = 15
STREAM_POINTING_JITTER = 16
STREAM_SCINTILLATION = 17
STREAM_RECORD_UP = 18
STREAM_RECORD_DOWN = 19
STREAM_RECORD_DOPPLER = 20

_MULTIPLIER_0 = np.uint64(0xD2E7470EE14C6C93)
_MULTIPLIER_1 = np.uint64(0xCA5A826395121157)
_WEYL_0 = np.uint64(0x9E3779B97F4A7C15)
_WEYL_1 = np.uint64(0xBB67AE8584CAA73B)
_SHIFT = np.uint64(12)


@intrinsic
def _multiply_wide(typingctx, a, b):  # type: ignore[no-untyped-def]  # a numba intrinsic
    """(high, low) words of the 128-bit product of two uint64: one machine instruction."""
    signature = types.UniTuple(types.uint64, 2)(types.uint64, types.uint64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        wide, word = ir.IntType(128), ir.IntType(64)
        product = builder.mul(builder.zext(args[0], wide), builder.zext(args[1], wide))
        high = builder.trunc(builder.lshr(product, ir.Constant(wide, 64)), word)
        words = (high, builder.trunc(product, word))
        return context.make_tuple(builder, sig.return_type, words)

    return signature, codegen


@njit(cache=True)
def philox4x64(key0, key1, c0, c1, c2, c3):
    """Four uint64 of Philox4x64-10 for a key of two and a counter of four 64-bit words.

    ``numpy.random.Philox(key=key, counter=c)`` adds 1 to its counter before its first output, so
    its first four raw outputs are this function at ``c + 1``.
    """
    k0, k1 = np.uint64(key0), np.uint64(key1)
    x0, x1, x2, x3 = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    for _ in range(10):
        high0, low0 = _multiply_wide(_MULTIPLIER_0, x0)
        high1, low1 = _multiply_wide(_MULTIPLIER_1, x2)
        x0, x1, x2, x3 = high1 ^ x1 ^ k0, low1, high0 ^ x3 ^ k1, low0
        k0, k1 = k0 + _WEYL_0, k1 + _WEYL_1
    return x0, x1, x2, x3


@njit(cache=True)
def _open_unit(bits):
    """Centre of one of 2^52 equal cells of (0, 1), by the upper 52 bits of a uint64.

    With 53 bits the last centre would round to 1; so 0 and 1 are both impossible, and u and
    1-u, both exact, are equally likely.
    """
    return (np.float64(bits >> _SHIFT) + 0.5) * 2.0**-52


@njit(cache=True)
def uniform4(key0, key1, draw, stream, block):
    """The four uniforms in (0, 1) of indices 4 block .. 4 block + 3, for the price of one."""
    r0, r1, r2, r3 = philox4x64(key0, key1, block, 0, draw, stream)
    return _open_unit(r0), _open_unit(r1), _open_unit(r2), _open_unit(r3)


@njit(cache=True)
def uniform(key0, key1, draw, stream, index):
    """Uniform number in (0, 1), a multiple of 2^-53: number `index` of a stream of a draw.

    Parameters
    ----------
    key0, key1 : uint64
        The point's key, from `point_keys`.
    draw : int
        Number of the draw, >= 0.
    stream : int
        Physical cause, one of the ``STREAM_*`` numbers.
    index : int
        Position within the stream, >= 0; one block of four costs one evaluation.

    Returns
    -------
    float
        Within [2^-53, 1 - 2^-53]: a chance below 1.1e-16 can not be drawn by comparison.
    """
    place = np.uint64(index)
    u0, u1, u2, u3 = uniform4(key0, key1, draw, stream, place >> np.uint64(2))
    lane = place & np.uint64(3)
    if lane < np.uint64(2):
        return u0 if lane == np.uint64(0) else u1
    return u2 if lane == np.uint64(2) else u3


@njit(cache=True)
def normal_pair(key0, key1, draw, stream, index):
    """Two independent standard normal numbers, pair number `index` of a stream of a draw.

    Box and Muller's transform of uniforms ``2 index`` and ``2 index + 1`` of the same stream; as
    real and imaginary part, sigma times this pair is one bin's noise (sigma per quadrature).
    Their magnitude reaches sqrt(2 ln 2^53) = 8.57 at most. Parameters as of `uniform`.
    """
    place = np.uint64(index)
    u0, u1, u2, u3 = uniform4(key0, key1, draw, stream, place >> np.uint64(1))
    if place & np.uint64(1):
        u0, u1 = u2, u3
    radius = math.sqrt(-2.0 * math.log(u0))
    angle = 2.0 * math.pi * u1
    return radius * math.cos(angle), radius * math.sin(angle)


def point_keys(rows: np.ndarray, *, domain: str, seed: int) -> np.ndarray:
    """Philox keys of points, from what the points are and not from where they stand in a grid.

    Parameters
    ----------
    rows : (n, m) array_like
        One row of float64 parameters (SI) per point, in a fixed order. -0.0 counts as 0.0.
    domain : str
        What the rows mean (names and order of the columns, say), so that equal numbers of
        different meaning give different keys.
    seed : int
        The study's seed, >= 0.

    Returns
    -------
    (n, 2) uint64 ndarray
        BLAKE2b-128 of domain, seed and row: equal rows have equal keys, others different ones.

    Raises
    ------
    ValueError
        `rows` has not two dimensions or holds a nan, or `seed` is negative.
    """
    table = np.asarray(rows, dtype="<f8")
    if table.ndim != 2:
        raise ValueError("rows of parameters form an array of shape (n, m)")
    if np.isnan(table).any():
        raise ValueError("a parameter is nan, which no point can be known by")
    if seed < 0:
        raise ValueError("a seed is not negative")
    start = hashlib.blake2b(digest_size=16)
    for text in (domain.encode(), str(int(seed)).encode()):
        start.update(len(text).to_bytes(8, "little"))
        start.update(text)
    digests = []
    for row in np.ascontiguousarray(table + 0.0):  # -0.0 + 0.0 is 0.0
        point = start.copy()
        point.update(row.tobytes())
        digests.append(point.digest())
    return np.frombuffer(b"".join(digests), dtype="<u8").reshape(-1, 2).astype(np.uint64)
