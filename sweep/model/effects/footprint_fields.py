"""What a tile needs of each of its shots' footprints, in numbers that do not count beamlets.

Shots are looked at some at a time: as they lie behind one another in memory, all that is done ray
by ray is done to the rays of them all at once, however few each has, which the machine's vectors
take; and sums, whose order holds these up, are taken of four shots beside each other.
"""

import math

from sweep.model.compiling import inlined

WHOLE, GAIN, RANGES, OWN_RANGES, VELOCITIES, BESIDE, APART = 0, 1, 2, 5, 8, 11, 12
FIELDS = 13
"""Rows of what is found in footprints; moments have three each."""

ROOM = 4
"""Rows of as many numbers as shots that are looked at together have rays, to work in."""


@inlined(nogil=True)
def set_fields(seen, number, by_roots, room, out):
    """Fields of a number of footprints, of which some may lie on several surfaces."""
    offset, doppler, echo, others = seen
    rays = echo.size
    share, one, two, whole = room[0, :rays], room[1, :rays], room[2, :rays], room[3, :rays]
    _put_sums(echo, number, out[WHOLE])
    _divide(echo, number, out[WHOLE], whole, share)
    for k in range(number):
        out[GAIN, k], out[BESIDE, k], out[APART, k] = 1.0, 0.0, 0.0
    if by_roots:
        for j in range(rays):
            one[j] = math.sqrt(share[j])
        _put_sums(one, number, out[GAIN])
        for k in range(number):
            out[GAIN, k] = max(out[GAIN, k], 1.0)
    _put_moments(offset, share, number, out[RANGES:])
    _put_moments(doppler, share, number, out[VELOCITIES:])
    for j in range(rays):
        one[j] = share[j] if others[j] else 0.0
        two[j] = abs(offset[j]) if one[j] > 0.0 else 0.0
    _put_sums(one, number, out[BESIDE])
    _put_largest(two, number, out[APART])
    for j in range(rays):
        one[j] = 0.0 if others[j] else echo[j]
    _put_sums(one, number, out[OWN_RANGES])
    _divide(one, number, out[OWN_RANGES], whole, share)
    _put_moments(offset, share, number, out[OWN_RANGES:])


@inlined(nogil=True)
def _divide(echo, number, sums, whole, share):
    """Shares of their sums; of nothing they are 0."""
    beamlets = echo.size // number
    for k in range(number):
        divisor = sums[k] if sums[k] > 0.0 else 1.0
        for b in range(beamlets):
            whole[k * beamlets + b] = divisor
    for j in range(echo.size):
        share[j] = echo[j] / whole[j]


@inlined(nogil=True)
def _put_moments(values, weight, number, out):
    """Magnitudes of means, rms, and largest magnitudes of what has any weight."""
    beamlets = values.size // number
    k = 0
    while k + 4 <= number:
        at = k * beamlets
        a = b = c = d = (0.0, 0.0, 0.0)
        for j in range(at, at + beamlets):
            a = _and(a, values[j], weight[j])
            b = _and(b, values[j + beamlets], weight[j + beamlets])
            c = _and(c, values[j + 2 * beamlets], weight[j + 2 * beamlets])
            d = _and(d, values[j + 3 * beamlets], weight[j + 3 * beamlets])
        for m in range(3):
            out[m, k], out[m, k + 1], out[m, k + 2], out[m, k + 3] = a[m], b[m], c[m], d[m]
        k += 4
    while k < number:
        a = (0.0, 0.0, 0.0)
        for j in range(k * beamlets, (k + 1) * beamlets):
            a = _and(a, values[j], weight[j])
        out[0, k], out[1, k], out[2, k] = a
        k += 1
    for k in range(number):
        out[0, k], out[1, k] = abs(out[0, k]), math.sqrt(out[1, k])


@inlined(nogil=True)
def _and(found, value, weight):
    """Weighted sum, that of squares and largest magnitude, with one value more."""
    once = weight * value
    size = abs(value) if weight > 0.0 else 0.0
    return found[0] + once, found[1] + once * value, _larger(found[2], size)


@inlined(nogil=True)
def _put_sums(values, number, out):
    """Sums over each shot's rays, in order."""
    beamlets = values.size // number
    k = 0
    while k + 4 <= number:
        at, a, b, c, d = k * beamlets, 0.0, 0.0, 0.0, 0.0
        for j in range(at, at + beamlets):
            a += values[j]
            b += values[j + beamlets]
            c += values[j + 2 * beamlets]
            d += values[j + 3 * beamlets]
        out[k], out[k + 1], out[k + 2], out[k + 3] = a, b, c, d
        k += 4
    while k < number:
        a = 0.0
        for j in range(k * beamlets, (k + 1) * beamlets):
            a += values[j]
        out[k] = a
        k += 1


@inlined(nogil=True)
def _put_largest(values, number, out):
    """Largest of each shot's rays, of numbers that are not negative."""
    beamlets = values.size // number
    k = 0
    while k + 4 <= number:
        at, a, b, c, d = k * beamlets, 0.0, 0.0, 0.0, 0.0
        for j in range(at, at + beamlets):
            a, b = _larger(a, values[j]), _larger(b, values[j + beamlets])
            c = _larger(c, values[j + 2 * beamlets])
            d = _larger(d, values[j + 3 * beamlets])
        out[k], out[k + 1], out[k + 2], out[k + 3] = a, b, c, d
        k += 4
    while k < number:
        a = 0.0
        for j in range(k * beamlets, (k + 1) * beamlets):
            a = _larger(a, values[j])
        out[k] = a
        k += 1


@inlined(nogil=True)
def _larger(one, other):
    return other if other > one else one
