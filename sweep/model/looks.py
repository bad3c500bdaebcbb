"""Looks: a shot's detection from several records of each of its segments.

A shot is its waveform N times over, without a pause. Of a bin, with a and the threshold b over the
noise per quadrature of one record,

- ``power``: the N periodograms |X|^2 are averaged, and their root is held against the threshold.
  The sum of powers is a noncentral chi square of 2 N degrees of freedom. It crosses with
  ``Q_N(sqrt(N) a, sqrt(N) b)``, Marcum's Q of order N, and noise alone, a Gamma(N), with
  ``Q(N, N b^2 / 2)``, the regularised incomplete Gamma function [Marcum, IRE Trans. Inf. Theory 6,
  59, 1960].
- ``binary``: each record is held against the threshold, and M of them must cross in the bin.
- ``coherent``: records are added, with the phase between them that a steady velocity makes taken
  off, and are then one record of N times less noise. The part of their sum that a laser's walking
  phase and an acceleration leave is in :func:`coherent_gain`.

An echo in developed speckle fades. All looks have one speckle (``speckle: common``), or each has
its own, as the beam moves on by its own width from look to look (``speckle: independent``). The
mean of Q_N over speckle is Swerling's first case, with x = a^2 / 2 the mean SNR of one record and
Y = N b^2 / 2,

    Q(N-1, Y) + (1 + 1 / (N x))^(N-1) e^(-Y / (1 + N x)) P(N-1, Y / (1 + 1 / (N x))),

or, where looks fade apart, his second: Q(N, Y / (1 + x)) [Swerling, IRE Trans. Inf. Theory 6, 269,
1960; Richards, Fundamentals of Radar Signal Processing, 2005, 6.3]. Between these two, looks share
their speckle in part, by the motion from one to the next (``speckle: motion``):
:mod:`sweep.model.look_speckle`.

Q_N is that of scipy's noncentral chi square, whose error is 1e-11 of either tail down to 1e-300.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import special

from sweep.model.constants import SPEED_OF_LIGHT

# Kernels are imported where they are called: the rules of specs read this module without them.
if TYPE_CHECKING:
    from sweep.model.look_speckle import LookSpeckle

POWER, BINARY, COHERENT = COMBINED = ("power", "binary", "coherent")
MOTION, COMMON, INDEPENDENT = SPECKLES = ("motion", "common", "independent")
NUMBER, COMBINE, VOTES, SPECKLE = (
    f"instrument.looks.{name}" for name in ("number", "combine", "votes", "speckle")
)
DEFAULTS: dict[str, float | int | str | np.ndarray] = {
    NUMBER: 1, COMBINE: POWER, VOTES: 1, SPECKLE: MOTION,
}  # fmt: skip

MOST_PLACES = 64
"""Places of a line that moves on from look to look."""

_SURE = 40.0
"""Distance of magnitude and threshold over sigma from where on a tail is 0 to float64."""
_HALVINGS = 60
_LOG_POWERS = -5.0, math.log(16.0), 64
"""Ends and number of the nodes of a mean over speckle, in ln(power)."""
_NODES = 24
"""Gauss points of each stretch of a mean over speckle."""


class Looks(NamedTuple):
    """Records of each segment, and how a bin is detected from them.

    Examples
    --------
    >>> pd, miss = Looks(8).steady(np.array([1.5]), np.array([2.0]))
    >>> bool(pd > Looks(1).steady(np.array([1.5]), np.array([2.0]))[0])
    True
    """

    number: int = 1
    combine: str = POWER
    votes: int = 1
    independent: bool = False
    moving: bool = False
    """Speckle changes from look to look as the motion between them makes it."""

    @classmethod
    def of(cls, p: Mapping[str, Any]) -> "Looks":
        """Return the looks that points share, by dotted path; a single look by default."""
        number, combine, votes, speckle = (
            np.asarray(p.get(path, value)).flat[0] for path, value in DEFAULTS.items()
        )
        law = str(speckle)
        return cls(int(number), str(combine), int(votes), law == INDEPENDENT, law == MOTION)

    @property
    def several(self) -> bool:
        """True where a bin is detected by another law than that of one record."""
        return self.number > 1 and self.combine != COHERENT

    @property
    def added(self) -> int:
        """Records that are added in amplitude, 1 where none are."""
        return self.number if self.combine == COHERENT else 1

    @property
    def averaged(self) -> int:
        """Records whose powers are averaged, 1 where none are."""
        return self.number if self.combine == POWER else 1

    @property
    def sharper(self) -> float:
        """Factor on magnitude over sigma by which one record would be as sure, at the most."""
        return math.sqrt(self.number) if self.several else 1.0

    def scaled(self, level: np.ndarray) -> np.ndarray:
        """Threshold over sigma of a record as sure as these, at which it detects as often."""
        scaled = np.asarray(self.sharper * level)
        if self.averaged == 1:
            return scaled
        return np.sqrt(np.maximum(np.square(scaled) - 2 * (self.number - 1), 0.0))

    def steady(
        self, signal: np.ndarray, level: np.ndarray, real: np.ndarray | bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities that a bin of a steady signal is detected, and that it is not.

        |X| and threshold are over the noise per quadrature of one record. If the noise is ``real``
        it has the power of both quadratures in one.
        """
        from sweep.model.marcum import marcum_q1

        signal, level, real = np.broadcast_arrays(signal, level, real)
        if not self.several or self.combine == BINARY:
            found, missed = marcum_q1(signal, level)
            if real.any():
                near, far = 0.5 * (level - signal), 0.5 * (level + signal)
                found = np.where(real, 0.5 * (special.erfc(near) + special.erfc(far)), found)
                missed = np.where(real, 0.5 * (special.erfc(-near) - special.erfc(far)), missed)
            return self.votes_of(found, missed) if self.several else (found, missed)
        from scipy import stats  # which takes a second, and one look has no need of

        a, b = (math.sqrt(self.number) * np.asarray(v, float) for v in (signal, level))
        found, missed = np.where(a > b, 1.0, 0.0), np.where(a > b, 0.0, 1.0)
        near = np.asarray((a - b < _SURE) & (b - a < _SURE + math.sqrt(2 * self.number)))
        degrees, share = (np.where(real, n, 2 * n)[near] for n in (self.number, 1.0))
        x, signal = 0.5 * share * b[near] ** 2, 0.5 * share * a[near] ** 2
        # The tail that is small, and its complement.
        rare, tail = x > degrees + signal, np.empty(x.shape)
        for side, law in ((rare, stats.ncx2.sf), (~rare, stats.ncx2.cdf)):
            tail[side] = law(x[side], degrees[side], signal[side])
        found[near], missed[near] = np.where(rare, (tail, 1 - tail), (1 - tail, tail))
        return found, missed

    def faded(
        self, signal: np.ndarray, level: np.ndarray, speckle: "LookSpeckle | None" = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute :meth:`steady` for a signal in developed speckle, of mean power signal^2.

        ``speckle`` is that of looks which share it in part; signals are (..., 3, n) then.
        """
        signal, level = np.broadcast_arrays(np.asarray(signal, float), np.asarray(level, float))
        if speckle is not None and self.several:
            return self._faded_in_part(signal, level, speckle)
        y = np.square(level) / (2 + np.square(signal))
        if not self.several or (self.combine == BINARY and self.independent):
            found, missed = np.exp(-y), -np.expm1(-y)
            return self.votes_of(found, missed) if self.several else (found, missed)
        if self.independent:
            return special.gammaincc(self.number, self.number * y), special.gammainc(
                self.number, self.number * y
            )
        if self.combine == BINARY:
            magnitude, weight = self.speckle_nodes(level, signal)
            each = self.steady(signal[..., None] * magnitude, level[..., None])
            found, missed = (np.minimum((v * weight).sum(axis=-1), 1.0) for v in each)
            return found, missed
        n, least = self.number, 0.5 * self.number * np.square(level)
        whole = np.maximum(0.5 * self.number * np.square(signal), 1e-200)
        first = special.gammaincc(n - 1, least)
        # P of small arguments by its series, as it leaves float64's range and is multiplied again.
        z = least * (whole / (1 + whole))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            by_series = (n - 1) * np.log(z) - z - special.gammaln(n)
            by_series = by_series + np.log(special.hyp1f1(1.0, n, np.minimum(z, n)))
            log_p = np.where(z < n, by_series, np.log(special.gammainc(n - 1, z)))
        log_rest = np.minimum((n - 1) * np.log1p(1 / whole) - least / (1 + whole) + log_p, 0.0)
        found = np.minimum(first + np.exp(log_rest), 1.0)
        return found, np.maximum(-np.expm1(log_rest) - first, 0.0)

    def _faded_in_part(
        self, signal: np.ndarray, level: np.ndarray, speckle: "LookSpeckle"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute :meth:`faded` for looks that share their speckle in part."""
        from sweep.model.look_speckle import mean_power_tails, votes_given_speckle

        if self.combine == POWER:
            snr, threshold = 0.5 * np.square(signal), 0.5 * self.number * np.square(level)
            return mean_power_tails(speckle, self.number, snr, threshold)
        found = np.empty(signal.shape)
        for segment, point in np.ndindex(signal.shape[-2:]):
            magnitude = self._speckle_nodes(speckle, segment, point)
            for lead in np.ndindex(signal.shape[:-2]):
                at = (*lead, segment, point)
                given = votes_given_speckle(signal[at], level[at], self.votes, magnitude)
                found[at] = given.mean()
        lone = np.exp(-np.square(level) / (2 + np.square(signal)))
        apart = self.votes_of(lone, 1 - lone)[0]
        for at in np.ndindex(signal.shape):
            of_lattice = votes_given_speckle(
                signal[at], level[at], self.votes, self._lattice()
            ).mean()
            share = (speckle.shape[at[-2:]] - 1) / (self.number - 1)
            found[at] += share * (apart[at] - of_lattice)
        found = np.clip(found, 0.0, 1.0)
        return found, 1 - found

    def _lattice(self) -> np.ndarray:
        """Magnitudes (nodes, N) of independent speckles."""
        from sweep.model.look_speckle import independent_speckles

        return np.abs(independent_speckles(self.number))

    def _speckle_nodes(self, speckle: "LookSpeckle", segment: int, point: int) -> np.ndarray:
        """Magnitudes (nodes, N) of the speckle of a segment's looks."""
        from sweep.model.look_speckle import correlated_magnitudes, independent_speckles

        root = speckle.root(segment, point)
        return correlated_magnitudes(independent_speckles(root.shape[1]), root)

    def given_speckle(
        self, signals: Sequence[np.ndarray], level: np.ndarray, speckle: "LookSpeckle | None"
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Compute detection given the speckle of all looks, if segments share all of it.

        Returns
        -------
        list
            Of each signal (..., n) the probability (..., n, k) in k speckles.
        numpy.ndarray
            Weights of the speckles, which add to 1.
        """
        if self.combine == POWER or (speckle is None and not self.independent):
            shape = np.broadcast_to(self._effective_number(speckle), level.shape)
            magnitude, weight = self.speckle_nodes(level, *signals, shape=shape)
            given = [self.steady(v[..., None] * magnitude, level[..., None])[0] for v in signals]
            return given, weight
        from sweep.model.look_speckle import NODES, votes_given_speckle

        given = [np.empty((*level.shape, NODES)) for _ in signals]
        for at in np.ndindex(level.shape):
            magnitude = (
                self._lattice() if speckle is None else self._speckle_nodes(speckle, 0, at[-1])
            )
            for values, signal in zip(given, signals, strict=True):
                values[at] = votes_given_speckle(signal[at], level[at], self.votes, magnitude)
        return given, np.full(NODES, 1 / NODES)

    def faded_together(
        self, one: np.ndarray, other: np.ndarray, level: np.ndarray, alike: np.ndarray,
        speckle: "LookSpeckle | None" = None,
    ) -> np.ndarray:  # fmt: skip
        """Probability that up and down segment in developed speckle are both detected.

        By |X| of their bins and threshold over the noise per quadrature, and the size of the
        correlation of their signals' amplitudes (``alike``). Looks of their own speckle are summed
        over that of the first segment: given it, the second's are a noncentral chi square. In one
        speckle of all, both segments see it: the mean over it of the product. If they share but a
        part of it, what they have in common is that share of it which two Rayleigh magnitudes of
        the same probabilities have. Looks that share their speckle in part (``speckle``) are
        treated likewise, as :mod:`sweep.model.look_speckle` has it.
        """
        from scipy import stats

        from sweep.model.detection import fading_together

        one, other, level, alike = np.broadcast_arrays(one, other, level, alike)
        far = np.full(level.shape, 1e100)
        there = np.isfinite(one) & np.isfinite(other)
        a, b = (np.where(there, v, 0.0) for v in (one, other))
        if speckle is not None:
            signals = np.stack([a, 0 * a, b], axis=-2)
            p, _, q = np.moveaxis(self.faded(signals, level[..., None, :], speckle)[0], -2, 0)
        else:
            p, q = self.faded(a, level)[0], self.faded(b, level)[0]
        if speckle is not None or not self.independent:
            (first, second), weight = self.given_speckle((a, b), level, speckle)
            mean = [(given * weight).sum(axis=-1) for given in (first, second)]
            shared = (first * second * weight).sum(axis=-1) - mean[0] * mean[1]
            part = self._shared_part(p, q, alike, speckle)
            return np.where(there, np.clip(p * q + part * shared, 0.0, np.minimum(p, q)), np.nan)
        means = (np.square(v) / (2 + np.square(v)) for v in (a, b))
        shared = np.minimum(np.square(alike) * np.prod(list(means), axis=0), 1 - 1e-9)
        y, z = (np.square(level) / (2 + np.square(v)) for v in (a, b))
        if self.combine == BINARY:
            both = fading_together(np.exp(-y), np.exp(-z), far, shared**0.5)
            return np.where(there, p - self.votes_of_one(np.exp(-y), np.exp(-z), both), np.nan)
        n, rest = self.number, 1 / (1 - shared)
        with np.errstate(divide="ignore"):
            # Chance of the first at which the second's mean is at its threshold: a step if alike.
            step = special.gammaincc(n, np.maximum((n * z - n * (1 - shared)) / shared, 0.0))
        node, weight = _gauss(np.stack([0 * p, np.minimum(step, p), p], axis=-1))
        given = 2 * rest[..., None] * special.gammainccinv(n, np.maximum(node, 1e-300))
        signal, level = shared[..., None] * given, 2 * (rest * n * z)[..., None]
        # Of a large signal the root is normal, within 1e-4.
        apart = np.sqrt(signal + 2 * n - 1) - np.sqrt(level)
        crosses = special.ndtr(apart * np.sqrt((signal + 2 * n) / (signal + n)))
        few = signal < 1e4
        crosses[few] = 1 - stats.ncx2.cdf(
            np.broadcast_to(level, few.shape)[few], 2 * n, signal[few]
        )
        return np.where(
            there, np.minimum((crosses * weight).sum(axis=-1), np.minimum(p, q)), np.nan
        )

    def _shared_part(
        self, p: np.ndarray, q: np.ndarray, alike: np.ndarray, speckle: "LookSpeckle | None"
    ) -> np.ndarray:
        """Part that two segments have of the covariance which they would have in one speckle."""
        from sweep.model.detection import fading_together

        far = np.full(np.shape(p), 1e100)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = fading_together(p, q, far, np.broadcast_to(alike, far.shape)) - p * q
            part = part / (np.minimum(p, q) - p * q)
        part = np.where(alike > 1 - 1e-9, 1.0, np.clip(np.nan_to_num(part), 0.0, 1.0))
        lone = 1 / self._effective_number(speckle)
        return np.asarray(lone * part + (1 - lone) * np.square(alike))

    def _effective_number(self, speckle: "LookSpeckle | None") -> np.ndarray | float:
        """Return M, the number of looks of independent speckle that these are worth."""
        if speckle is not None:
            return np.asarray(speckle.shape.mean(axis=0))
        return float(self.number if self.independent else 1)

    def faded_any_two(
        self, signals: np.ndarray, level: np.ndarray, alike: np.ndarray, pd: np.ndarray,
        speckle: "LookSpeckle | None" = None,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Probabilities that at least two of three segments are detected, and that they are not.

        Parameters
        ----------
        signals
            |X| of their bins over the noise per quadrature, (3, n).
        level
            Threshold over the same, (n,).
        alike
            Correlations of up and Doppler, up and down, Doppler and down segment, (3, n).
        pd
            Of the segments, (3, n).

        Notes
        -----
        Segment i shares a common speckle in a part l_i of cases and else has its own, with
        l_i l_j the part that :meth:`faded_together` gives two segments. Given that speckle segments
        are independent, with probabilities l_i P_i(speckle) + (1 - l_i) P_i. If all looks have one
        speckle, segments are detected as :func:`fading_any_two` has it of three magnitudes with the
        same probabilities. The result is the mean of both, with weights 1 - 1/M and 1/M.
        """
        from sweep.model.detection import any_two

        there = np.isfinite(pd).all(axis=0)
        p = np.where(there, pd, 0.0)
        a = list(np.where(there, signals, 0.0))
        given, weight = self.given_speckle(a, level, speckle)
        near, over, last = (
            np.maximum(self._shared_part(p[i], p[j], np.minimum(alike[k], 1.0), speckle), 1e-12)
            for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)))
        )
        share = np.sqrt([near * over / last, near * last / over, over * last / near])
        share = np.minimum(share, 1.0)[..., None]
        found = share * np.array(given) + (1 - share) * p[..., None]
        chance = np.clip((any_two(found, 1 - found) * weight).sum(axis=-1), 0.0, 1.0)
        lone = 1 / self._effective_number(speckle)
        one_speckle = fading_any_two(p, 1 - p, np.full(level.shape, 1e100), alike)[0]
        chance = lone * one_speckle + (1 - lone) * chance
        return np.where(there, chance, np.nan), np.where(there, 1 - chance, np.nan)

    def log_alarm(self, level: np.ndarray) -> np.ndarray:
        """Natural logarithm of the probability that a bin of noise alone is detected.

        It keeps its digits where the probability itself leaves float64's range.

        >>> round(float(Looks(4).log_alarm(np.array(2.0))), 4)  # ln Q(4, 8)
        -3.1611
        """
        y, n = 0.5 * np.square(np.asarray(level, float)), self.number
        if not self.several:
            return np.asarray(-y)
        with np.errstate(divide="ignore"):
            if self.combine == POWER:
                k, log_y = np.arange(n), np.log(n * y)[..., None]
                terms = np.where(k > 0, k * np.where(np.isneginf(log_y), -1e300, log_y), 0.0)
                rare = special.logsumexp(terms - special.gammaln(k + 1), axis=-1) - n * y
                return np.where(n * y < n, np.log1p(-special.gammainc(n, n * y)), rare)
            k, rest = np.arange(self.votes, n + 1), np.log(-np.expm1(-y))[..., None]
            ways = special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1)
            each = np.where(k < n, (n - k) * np.maximum(rest, -1e300), 0.0) - k * y[..., None]
            return np.minimum(special.logsumexp(ways + each, axis=-1), 0.0)

    def level(self, log_alarm: np.ndarray) -> np.ndarray:
        """Threshold over sigma at which :meth:`log_alarm` is so much."""
        if self.several:
            return level_of(np.asarray(log_alarm, float), self.log_alarm)
        return np.asarray(np.sqrt(-2 * np.asarray(log_alarm)))

    def shown(self, magnitudes: np.ndarray) -> np.ndarray:
        """Of |X| of each record (N, ...) that which is at or above the threshold if it detects.

        The root of the mean power, or the least of the largest that are enough.
        """
        if self.combine == BINARY:
            return np.asarray(np.sort(magnitudes, axis=0)[-self.votes])
        return np.sqrt(np.mean(np.square(magnitudes), axis=0))

    def fresh(self, level: np.ndarray, correlation: float) -> np.ndarray:
        """Probability that a bin of noise is not detected where its neighbour is, by the threshold.

        ``correlation`` is that of their noise, 0..1. Of sums of powers by the Gamma distribution of
        two variables [Kibble, Sankhya 5, 137, 1941]: with r = correlation^2, both cross with

            sum_j C(N+j-1, j) (1-r)^N r^j Q(N+j, Y / (1-r))^2.
        """
        from sweep.model.marcum import marcum_q1

        y, r, n = 0.5 * np.square(np.asarray(level, float)), correlation**2, self.number
        if self.combine == BINARY:
            scaled = level / math.sqrt(1 - r)
            apart = marcum_q1(correlation * scaled, scaled).p
            apart = apart - marcum_q1(scaled, correlation * scaled).p
            p = np.exp(-y)
            found = self.votes_of_one(p, p, p * np.maximum(1 - apart, 0.0))
            log_p = self.log_alarm(level)
            return np.where(log_p > -600, found / np.exp(np.maximum(log_p, -600)), 1.0)
        p, least = np.exp(self.log_alarm(level)), n * y / (1 - r)
        both, j, goes_on = np.zeros_like(y), np.arange(256), np.ones(y.shape, bool)
        while True:
            log_weight = special.gammaln(n + j) - special.gammaln(j + 1) - special.gammaln(n)
            weight = np.exp(log_weight + n * math.log1p(-r) + j * math.log(r))
            more = (weight * special.gammaincc(n + j, least[..., None]) ** 2).sum(axis=-1)
            both = np.where(goes_on, both + more, both)
            past = n + j[-1] > least + n * r / (1 - r)
            goes_on &= (~past | (more > 1e-14 * both + 1e-300)) & np.isfinite(least)
            if not goes_on.any():
                return np.clip(1 - both / np.maximum(p, 1e-300), 0.0, 1.0)
            j = j + j.size

    def votes_of_one(self, p: np.ndarray, q: np.ndarray, both: np.ndarray) -> np.ndarray:
        """Probability that the first of two bins has enough records, and the second has not.

        ``p``, ``q`` and ``both`` are the probabilities that a record crosses in the first, in the
        second and in both.
        """
        from scipy import stats

        n, binomial = self.number, stats.binom
        with np.errstate(divide="ignore", invalid="ignore"):
            then = np.clip(np.nan_to_num(both / p), 0.0, 1.0)
            else_ = np.clip(np.nan_to_num((q - both) / (1 - p)), 0.0, 1.0)
        found = np.zeros(np.shape(p))
        for k in range(self.votes, n + 1):
            too_few = sum(
                binomial.pmf(i, k, then) * binomial.cdf(self.votes - 1 - i, n - k, else_)
                for i in range(min(self.votes - 1, k) + 1)
            )
            found = found + binomial.pmf(k, n, p) * too_few
        return found

    def excess(self, signal: np.ndarray, level: float) -> np.ndarray:
        """Compute the crossing probability that bins' signals add, over noise's of not crossing.

        ``signal`` (m,) over the noise per quadrature of one record, at one level. By a table over
        the signal, within 1e-4 of it.
        """
        nodes, excess = _excess_table(self, float(level))
        with np.errstate(divide="ignore"):
            place = np.log(np.asarray(signal, float))
        found = np.interp(place, nodes, excess, left=-np.inf)
        below = place < nodes[0]  # as the square of the signal
        return np.exp(np.where(below, excess[0] + 2 * (place - nodes[0]), found))

    def quiet_below(self, *, chance: np.ndarray, level: np.ndarray, bins: int) -> np.ndarray:
        """As of :func:`sweep.model.detection.quiet_below`, for several records."""
        # Where tables begin chances rise as the signal's square.
        least = np.array([self.excess(np.array([1e-3]), b)[0] for b in np.ravel(level)]) / 1e-6
        with np.errstate(divide="ignore"):
            quiet = np.sqrt(chance / (bins * math.exp(1 / 8) * least.reshape(np.shape(level))))
        return np.asarray(np.minimum(quiet, 1 / (self.number * level)))

    def votes_of(self, crosses: np.ndarray, stays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities that enough records cross, and that they do not."""
        enough, rest = self.votes, self.number - self.votes + 1
        return special.betainc(enough, rest, crosses), special.betainc(rest, enough, stays)

    def speckle_powers(
        self, speckle: "LookSpeckle | None", segment: int, point: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Powers of the speckle of all looks together, of mean 1, and weights, which add to 1.

        Their mean power is taken to be a gamma variable, of the shape M of as many independent
        looks. ``speckle`` is that of looks which share it in part.
        """
        shape = float(self.number if self.independent else 1)
        if speckle is not None:
            shape = float(speckle.shape[segment, point])
        log_power = np.linspace(*_LOG_POWERS)
        density = shape * (log_power - np.exp(log_power))
        weights = np.exp(density - density.max())
        return np.exp(log_power), weights / weights.sum()

    def speckle_nodes(
        self, level: np.ndarray, *signals: np.ndarray, shape: np.ndarray | float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Magnitudes of speckle (..., k), of mean power 1, and weights; close about thresholds.

        Its power is a gamma variable of a ``shape`` (...), exponential for 1.
        """
        square, most = np.square(level), np.full(level.shape, 7.0)
        ends = [0 * most, most]
        # Enough votes come and go within a part of what one record takes.
        pieces = 2 if self.combine == POWER else 2 + math.isqrt(self.number)
        at = np.maximum(square - 2, 0.0)
        wide = 16 * np.sqrt((at + 1) / self.averaged)
        for signal in signals:
            a = np.maximum(np.square(signal), 1e-30)
            for d in np.linspace(-1, 1, pieces):
                ends.append(np.minimum(np.sqrt(np.maximum(at + d * wide, 0.0) / a), most))
        if np.any(shape != 1.0):  # a narrow peak about 1
            wide = 4 / np.sqrt(shape)
            ends += [np.clip(1 + d * wide, 0.0, most) for d in (-1.0, 0.0, 1.0)]
        node, weight = _gauss(np.sort(np.stack(ends, axis=-1), axis=-1))
        if np.all(shape == 1.0):
            return node, weight * 2 * node * np.exp(-np.square(node))
        shape, power = np.broadcast_to(shape, level.shape)[..., None], np.square(node)
        log_density = shape * (np.log(shape) - power) - special.gammaln(shape)
        log_density = log_density + (2 * shape - 1) * np.log(np.maximum(node, 1e-300))
        return node, weight * 2 * np.exp(log_density)


ONE = Looks()
"""A record of each segment."""


def coherent_gain(
    looks: Looks, *, acceleration: np.ndarray, carrier: np.ndarray, period: np.ndarray
) -> np.ndarray:
    """Amplitude of the mean of records over that of one, by the acceleration from look to look.

    |mean exp(2 pi i f a t^2 / c)|, t the looks' times about their middle: what a velocity that is
    put right leaves. A laser's walking phase leaves the root of
    :func:`sweep.model.effects.line_width.coherent_share` besides.
    """
    place = np.arange(looks.added) - (looks.added - 1) / 2
    turn = np.asarray(carrier * acceleration * np.square(period) / SPEED_OF_LIGHT, float)
    return np.abs(np.exp(2j * np.pi * turn[..., None] * place**2).mean(axis=-1))


def level_of(log_pfa: np.ndarray, law: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Threshold over sigma, (n,), at which ``law``, falling from 0 on, is a logarithm of pfa."""
    # A bin alone alarms less often than n of them, and these no oftener than n each for itself.
    low, high = np.zeros_like(log_pfa), np.sqrt(2 * (100.0 - log_pfa))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        above = law(middle) > log_pfa
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return 0.5 * (low + high)


def fading_any_two(
    pd: np.ndarray, miss: np.ndarray, level: np.ndarray, alike: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities that at least two of three segments in developed speckle are detected, and not.

    The amplitude of each segment, signal and noise, is normal, of the part l_i z of one common
    amplitude z and a rest of its own. With A_i = Th^2 over the mean power, u = |z|^2 exponential,

        P_i(u) = Q_1(l_i sqrt(2 u / (1 - l_i^2)), sqrt(2 A_i / (1 - l_i^2)))

    and given u the segments are independent. The correlations, those of
    :func:`sweep.model.detection.fading_together` by :class:`sweep.model.detection.Fading`, give l_i
    = sqrt(rho_ij rho_ik / rho_jk): exact for segments that share their speckle, or each have their
    own. If speckle moves on between them one l_k may come out above 1. It is then 1, z is that
    segment's own amplitude, and of the others a covariance kappa = rho_ij - rho_ik rho_jk is left,
    which adds to the probability of both

        kappa P_i' P_j' / 2 + kappa^2 (A_i A_j + B_i B_j) / 16,    A, B = P'' +- P' / r

    with derivatives by r, the mean given z: Mehler's series to its second term, within 0.002 of
    drawn amplitudes.
    """
    from sweep.model.detection import any_two
    from sweep.model.marcum import marcum_q1

    there = np.isfinite(pd).all(axis=0)
    with np.errstate(divide="ignore"):
        a = np.where(pd < 0.5, -np.log(np.where(there, pd, 1.0)), -np.log1p(-np.minimum(miss, 0.5)))
    a = np.clip(a, 1e-300, 700.0)
    share = np.maximum(1 - a / (0.5 * np.square(level)), 1e-9)
    rho = np.minimum(alike, 1.0) * np.sqrt(share[[0, 0, 1]] * share[[1, 2, 2]])
    near, over, last = rho
    with np.errstate(divide="ignore", invalid="ignore"):
        square = np.array([near * over / last, near * last / over, over * last / near])
    square = np.nan_to_num(square, posinf=2.0)
    pairs = ((1, 2, near, over), (0, 2, near, last), (0, 1, over, last))
    above = square > 1  # one of them at most
    for k, (i, j, one, other) in enumerate(pairs):
        square[i], square[j] = np.where(above[k], (one**2, other**2), square[[i, j]])
    square = np.minimum(square, 1 - 1e-9)
    rest = 1 - square
    place = np.sqrt(a / np.maximum(square, 1e-12))
    wide = 6 * np.sqrt(rest / np.maximum(2 * square, 1e-12))
    most = np.sqrt(a.max(axis=0)) + 7.0
    ends = [0 * most, most, *np.clip([place - wide, place, place + wide], 0.0, most).reshape(9, -1)]
    node, weight = _gauss(np.sort(np.stack(ends, axis=-1), axis=-1))
    weight = weight * 2 * node * np.exp(-np.square(node))
    signal = np.sqrt(2 * square / rest)[..., None] * node
    threshold = np.sqrt(2 * a / rest)[..., None] + 0 * node
    found, missed = marcum_q1(signal, threshold)
    more = np.zeros(node.shape)
    for k, (i, j, one, other) in enumerate(pairs):
        some = np.flatnonzero(above[k])
        two = np.ix_(np.array([i, j]), some)
        kappa = (rho[[2, 1, 0]][k] - one * other)[some] * 2 / np.sqrt(rest[i] * rest[j])[some]
        slope, plus, minus = _bends(signal[two], threshold[two])
        square_term = (plus[0] * plus[1] + minus[0] * minus[1]) * np.square(kappa[:, None]) / 16
        both = kappa[:, None] * slope[0] * slope[1] / 2 + square_term
        more[some] = both * (missed[k, some] - found[k, some])
    chances = any_two(found, missed) + more, any_two(missed, found) - more
    found, missed = (np.clip((each * weight).sum(axis=-1), 0.0, 1.0) for each in chances)
    whole = found + missed  # 1 but for the quadrature
    # A segment that is never detected has no threshold: what stands for it above is too low.
    is_possible = np.count_nonzero(pd > 0.0, axis=0) >= 2
    found, missed = np.where(is_possible, [found / whole, missed / whole], [[0.0], [1.0]])
    return np.where(there, found, np.nan), np.where(there, missed, np.nan)


def _bends(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Q_1' and Q_1'' +- Q_1' / a by the signal a, at the threshold b."""
    x = np.maximum(a * b, 1e-12)
    # special.ive is nan from arguments of 1e9 on.
    zero, one = (b * np.exp(-0.5 * np.square(a - b)) * of(x) for of in (special.i0e, special.i1e))
    second = b * (zero - one / x) - a * one
    over = b * one / x
    return one, second + over, second - over


def _gauss(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights of the stretches between ends (..., k), all behind one another."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    half = 0.5 * np.diff(ends, axis=-1)[..., None]
    place = ends[..., :-1, None] + half * (node + 1)
    return place.reshape(*ends.shape[:-1], -1), (half * weight).reshape(*ends.shape[:-1], -1)


@lru_cache(maxsize=4096)
def _excess_table(looks: Looks, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of signals and of what :meth:`Looks.excess` has for them."""
    signal = np.geomspace(1e-3 / math.sqrt(looks.number), level + 1.0, 300)
    quiet, stays = looks.steady(np.zeros(1), np.array([level]))
    crosses = looks.steady(signal, np.full(signal.shape, level))[0]
    added = np.maximum(crosses - quiet, 1e-300) / np.maximum(stays, 1e-300)
    return np.log(signal), np.log(added)
