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
:mod:`sweep.model.detection.look_speckle`.

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
    from sweep.model.detection.look_speckle import LookSpeckle

COMBINE_POWER, COMBINE_BINARY, COMBINE_COHERENT = COMBINE_KINDS = ("power", "binary", "coherent")
SPECKLE_MOTION, SPECKLE_COMMON, SPECKLE_INDEPENDENT = SPECKLE_KINDS = (
    "motion",
    "common",
    "independent",
)
LOOKS_NUMBER_PATH, LOOKS_COMBINE_PATH, LOOKS_VOTES_PATH, LOOKS_SPECKLE_PATH = (
    f"instrument.looks.{name}" for name in ("number", "combine", "votes", "speckle")
)
LOOKS_DEFAULTS: dict[str, float | int | str | np.ndarray] = {
    LOOKS_NUMBER_PATH: 1,
    LOOKS_COMBINE_PATH: COMBINE_POWER,
    LOOKS_VOTES_PATH: 1,
    LOOKS_SPECKLE_PATH: SPECKLE_MOTION,
}

DRIFT_POSITIONS_MAX = 64
"""Places of a line that moves on from look to look."""

_CERTAIN_MARGIN_SIGMA = 40.0
"""Distance of magnitude and threshold over sigma from where on a tail is 0 to float64."""
_BISECTION_STEPS = 60
_LOG_POWER_GRID = -5.0, math.log(16.0), 64
"""Ends and number of the nodes of a mean over speckle, in ln(power)."""
_GAUSS_NODES = 24
"""Gauss points of each stretch of a mean over speckle."""


class DetectionArrays(NamedTuple):
    """Probabilities of detection and of a miss of many bins or shots, of one common shape."""

    pd: np.ndarray
    """Probability of detection, 0..1."""
    miss: np.ndarray
    """Probability of a miss, 1 - pd; keeps its digits where pd is near 1."""


class Looks(NamedTuple):
    """Records of each segment, and how a bin is detected from them.

    Examples
    --------
    >>> pd, miss = Looks(8).pd_and_miss_steady(np.array([1.5]), np.array([2.0]))
    >>> bool(pd > Looks(1).pd_and_miss_steady(np.array([1.5]), np.array([2.0])).pd)
    True
    """

    number: int = 1
    combine: str = COMBINE_POWER
    votes: int = 1
    has_independent_speckle: bool = False
    has_moving_speckle: bool = False
    """Speckle changes from look to look as the motion between them makes it."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "Looks":
        """Return the looks that points share, by dotted path; a single look by default."""
        number, combine_kind, votes, speckle = (
            np.asarray(parameters.get(path, value)).flat[0]
            for path, value in LOOKS_DEFAULTS.items()
        )
        speckle_kind = str(speckle)
        return cls(
            int(number),
            str(combine_kind),
            int(votes),
            speckle_kind == SPECKLE_INDEPENDENT,
            speckle_kind == SPECKLE_MOTION,
        )

    @property
    def is_noncoherent(self) -> bool:
        """True where a bin is detected by another law than that of one record."""
        return self.number > 1 and self.combine != COMBINE_COHERENT

    @property
    def n_coherent(self) -> int:
        """Records that are added in amplitude, 1 where none are."""
        return self.number if self.combine == COMBINE_COHERENT else 1

    @property
    def n_power_averaged(self) -> int:
        """Records whose powers are averaged, 1 where none are."""
        return self.number if self.combine == COMBINE_POWER else 1

    @property
    def amplitude_gain_max(self) -> float:
        """Factor on magnitude over sigma by which one record would be as sure, at the most."""
        return math.sqrt(self.number) if self.is_noncoherent else 1.0

    def equivalent_threshold_ratio(self, threshold_ratio: np.ndarray) -> np.ndarray:
        """Threshold over sigma of a record as sure as these, at which it detects as often."""
        scaled = np.asarray(self.amplitude_gain_max * threshold_ratio)
        if self.n_power_averaged == 1:
            return scaled
        return np.sqrt(np.maximum(np.square(scaled) - 2 * (self.number - 1), 0.0))

    def pd_and_miss_steady(
        self, signal: np.ndarray, threshold_ratio: np.ndarray, is_real: np.ndarray | bool = False
    ) -> DetectionArrays:
        """Return the probabilities that a bin of a steady signal is detected and missed.

        |X| (``signal``) and threshold are over the noise per quadrature of one record. If the noise
        ``is_real``, it has the power of both quadratures in one. The results have the shape of the
        broadcast arguments.
        """
        from sweep.model.detection.marcum import marcum_q1

        signal, threshold_ratio, is_real = np.broadcast_arrays(signal, threshold_ratio, is_real)
        if not self.is_noncoherent or self.combine == COMBINE_BINARY:
            pd, miss = marcum_q1(signal, threshold_ratio)
            if is_real.any():
                near, far = 0.5 * (threshold_ratio - signal), 0.5 * (threshold_ratio + signal)
                pd = np.where(is_real, 0.5 * (special.erfc(near) + special.erfc(far)), pd)
                miss = np.where(is_real, 0.5 * (special.erfc(-near) - special.erfc(far)), miss)
            if self.is_noncoherent:
                return self.vote_probabilities(pd, miss)
            return DetectionArrays(pd, miss)
        from scipy import stats  # which takes a second, and one look has no need of

        a, b = (math.sqrt(self.number) * np.asarray(v, float) for v in (signal, threshold_ratio))
        pd, miss = np.where(a > b, 1.0, 0.0), np.where(a > b, 0.0, 1.0)
        near = np.asarray(
            (a - b < _CERTAIN_MARGIN_SIGMA)
            & (b - a < _CERTAIN_MARGIN_SIGMA + math.sqrt(2 * self.number))
        )
        degrees_of_freedom, noise_fraction = (
            np.where(is_real, n, 2 * n)[near] for n in (self.number, 1.0)
        )
        x, signal = 0.5 * noise_fraction * b[near] ** 2, 0.5 * noise_fraction * a[near] ** 2
        # The tail that is small, and its complement.
        is_upper_tail, tail = x > degrees_of_freedom + signal, np.empty(x.shape)
        for members, tail_law in ((is_upper_tail, stats.ncx2.sf), (~is_upper_tail, stats.ncx2.cdf)):
            tail[members] = tail_law(x[members], degrees_of_freedom[members], signal[members])
        pd[near], miss[near] = np.where(is_upper_tail, (tail, 1 - tail), (1 - tail, tail))
        return DetectionArrays(pd, miss)

    def pd_and_miss_in_speckle(
        self,
        signal: np.ndarray,
        threshold_ratio: np.ndarray,
        look_speckle: "LookSpeckle | None" = None,
    ) -> DetectionArrays:
        """Compute pd and 1 - pd for a signal in developed speckle, of mean power signal^2.

        ``look_speckle`` is that of looks which share it in part; signals are (..., 3, n) then.
        """
        signal, threshold_ratio = np.broadcast_arrays(
            np.asarray(signal, float), np.asarray(threshold_ratio, float)
        )
        if look_speckle is not None and self.is_noncoherent:
            return self._pd_and_miss_in_moving_speckle(signal, threshold_ratio, look_speckle)
        y = np.square(threshold_ratio) / (2 + np.square(signal))
        if not self.is_noncoherent or (
            self.combine == COMBINE_BINARY and self.has_independent_speckle
        ):
            pd, miss = np.exp(-y), -np.expm1(-y)
            if self.is_noncoherent:
                return self.vote_probabilities(pd, miss)
            return DetectionArrays(pd, miss)
        if self.has_independent_speckle:
            return DetectionArrays(
                special.gammaincc(self.number, self.number * y),
                special.gammainc(self.number, self.number * y),
            )
        if self.combine == COMBINE_BINARY:
            magnitude, weight = self.speckle_quadrature(threshold_ratio, signal)
            tails_given_speckle = self.pd_and_miss_steady(
                signal[..., None] * magnitude, threshold_ratio[..., None]
            )
            return DetectionArrays(
                *(np.minimum((v * weight).sum(axis=-1), 1.0) for v in tails_given_speckle)
            )
        n, gamma_threshold = self.number, 0.5 * self.number * np.square(threshold_ratio)
        total_snr = np.maximum(0.5 * self.number * np.square(signal), 1e-200)
        noise_tail = special.gammaincc(n - 1, gamma_threshold)
        # P of small arguments by its series, as it leaves float64's range and is multiplied again.
        z = gamma_threshold * (total_snr / (1 + total_snr))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            log_p_series = (n - 1) * np.log(z) - z - special.gammaln(n)
            log_p_series = log_p_series + np.log(special.hyp1f1(1.0, n, np.minimum(z, n)))
            log_p = np.where(z < n, log_p_series, np.log(special.gammainc(n - 1, z)))
        log_signal_tail = np.minimum(
            (n - 1) * np.log1p(1 / total_snr) - gamma_threshold / (1 + total_snr) + log_p, 0.0
        )
        pd = np.minimum(noise_tail + np.exp(log_signal_tail), 1.0)
        return DetectionArrays(pd, np.maximum(-np.expm1(log_signal_tail) - noise_tail, 0.0))

    def _pd_and_miss_in_moving_speckle(
        self, signal: np.ndarray, threshold_ratio: np.ndarray, look_speckle: "LookSpeckle"
    ) -> DetectionArrays:
        """Compute :meth:`pd_and_miss_in_speckle` for looks that share their speckle in part."""
        from sweep.model.detection.look_speckle import (
            mean_power_tails,
            vote_probability_given_speckle,
        )

        if self.combine == COMBINE_POWER:
            snr, threshold = 0.5 * np.square(signal), 0.5 * self.number * np.square(threshold_ratio)
            return DetectionArrays(*mean_power_tails(look_speckle, self.number, snr, threshold))
        pd = np.empty(signal.shape)
        for segment, point in np.ndindex(signal.shape[-2:]):
            magnitude = self._correlated_magnitudes(look_speckle, segment, point)
            for lead in np.ndindex(signal.shape[:-2]):
                index = (*lead, segment, point)
                pd_given_speckle = vote_probability_given_speckle(
                    signal[index], threshold_ratio[index], self.votes, magnitude
                )
                pd[index] = pd_given_speckle.mean()
        record_pd = np.exp(-np.square(threshold_ratio) / (2 + np.square(signal)))
        independent_pd = self.vote_probabilities(record_pd, 1 - record_pd).pd
        for index in np.ndindex(signal.shape):
            lattice_pd = vote_probability_given_speckle(
                signal[index], threshold_ratio[index], self.votes, self._lattice_magnitudes()
            ).mean()
            independence = (look_speckle.effective_looks[index[-2:]] - 1) / (self.number - 1)
            pd[index] += independence * (independent_pd[index] - lattice_pd)
        pd = np.clip(pd, 0.0, 1.0)
        return DetectionArrays(pd, 1 - pd)

    def _lattice_magnitudes(self) -> np.ndarray:
        """Magnitudes (nodes, N) of independent speckles."""
        from sweep.model.detection.look_speckle import speckle_lattice

        return np.abs(speckle_lattice(self.number))

    def _correlated_magnitudes(
        self, look_speckle: "LookSpeckle", segment: int, point: int
    ) -> np.ndarray:
        """Magnitudes (nodes, N) of the speckle of a segment's looks."""
        from sweep.model.detection.look_speckle import (
            correlated_speckle_magnitudes,
            speckle_lattice,
        )

        covariance_root = look_speckle.covariance_root(segment, point)
        return correlated_speckle_magnitudes(
            speckle_lattice(covariance_root.shape[1]), covariance_root
        )

    def pd_given_speckle(
        self,
        signals: Sequence[np.ndarray],
        threshold_ratio: np.ndarray,
        look_speckle: "LookSpeckle | None",
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Compute detection given the speckle of all looks, if segments share all of it.

        Returns
        -------
        list
            Of each signal (..., n) the probability (..., n, k) in k speckles.
        numpy.ndarray
            Weights of the speckles, which add to 1.
        """
        if self.combine == COMBINE_POWER or (
            look_speckle is None and not self.has_independent_speckle
        ):
            effective_looks = np.broadcast_to(
                self._effective_looks(look_speckle), threshold_ratio.shape
            )
            magnitude, weight = self.speckle_quadrature(
                threshold_ratio, *signals, gamma_shape=effective_looks
            )
            pd_by_signal = [
                self.pd_and_miss_steady(v[..., None] * magnitude, threshold_ratio[..., None]).pd
                for v in signals
            ]
            return pd_by_signal, weight
        from sweep.model.detection.look_speckle import (
            SPECKLE_LATTICE_SIZE,
            vote_probability_given_speckle,
        )

        pd_by_signal = [np.empty((*threshold_ratio.shape, SPECKLE_LATTICE_SIZE)) for _ in signals]
        for index in np.ndindex(threshold_ratio.shape):
            magnitude = (
                self._lattice_magnitudes()
                if look_speckle is None
                else self._correlated_magnitudes(look_speckle, 0, index[-1])
            )
            for values, signal in zip(pd_by_signal, signals, strict=True):
                values[index] = vote_probability_given_speckle(
                    signal[index], threshold_ratio[index], self.votes, magnitude
                )
        return pd_by_signal, np.full(SPECKLE_LATTICE_SIZE, 1 / SPECKLE_LATTICE_SIZE)

    def joint_pd_in_speckle(
        self,
        signal_first: np.ndarray,
        signal_second: np.ndarray,
        threshold_ratio: np.ndarray,
        correlation: np.ndarray,
        look_speckle: "LookSpeckle | None" = None,
    ) -> np.ndarray:
        """Probability that up and down segment in developed speckle are both detected.

        By |X| of their bins and threshold over the noise per quadrature, and the size of the
        correlation of their signals' amplitudes (``correlation``). Looks of their own speckle are
        summed
        over that of the first segment: given it, the second's are a noncentral chi square. In one
        speckle of all, both segments see it: the mean over it of the product. If they share but a
        part of it, what they have in common is that share of it which two Rayleigh magnitudes of
        the same probabilities have. Looks that share their speckle in part (``look_speckle``) are
        treated likewise, as :mod:`sweep.model.detection.look_speckle` has it.
        """
        from scipy import stats

        from sweep.model.detection.echo_detection import joint_pd_in_speckle

        signal_first, signal_second, threshold_ratio, correlation = np.broadcast_arrays(
            signal_first, signal_second, threshold_ratio, correlation
        )
        infinite_threshold = np.full(threshold_ratio.shape, 1e100)
        is_defined = np.isfinite(signal_first) & np.isfinite(signal_second)
        a, b = (np.where(is_defined, v, 0.0) for v in (signal_first, signal_second))
        if look_speckle is not None:
            signals = np.stack([a, 0 * a, b], axis=-2)
            p, _, q = np.moveaxis(
                self.pd_and_miss_in_speckle(
                    signals, threshold_ratio[..., None, :], look_speckle
                ).pd,
                -2,
                0,
            )
        else:
            p, q = (
                self.pd_and_miss_in_speckle(a, threshold_ratio).pd,
                self.pd_and_miss_in_speckle(b, threshold_ratio).pd,
            )
        if look_speckle is not None or not self.has_independent_speckle:
            (pd_first, pd_second), weight = self.pd_given_speckle(
                (a, b), threshold_ratio, look_speckle
            )
            mean_pds = [
                (conditional * weight).sum(axis=-1) for conditional in (pd_first, pd_second)
            ]
            shared = (pd_first * pd_second * weight).sum(axis=-1) - mean_pds[0] * mean_pds[1]
            shared_fraction = self._shared_fraction(p, q, correlation, look_speckle)
            return np.where(
                is_defined, np.clip(p * q + shared_fraction * shared, 0.0, np.minimum(p, q)), np.nan
            )
        echo_fractions = (np.square(v) / (2 + np.square(v)) for v in (a, b))
        shared = np.minimum(
            np.square(correlation) * np.prod(list(echo_fractions), axis=0), 1 - 1e-9
        )
        y, z = (np.square(threshold_ratio) / (2 + np.square(v)) for v in (a, b))
        if self.combine == COMBINE_BINARY:
            p_both = joint_pd_in_speckle(np.exp(-y), np.exp(-z), infinite_threshold, shared**0.5)
            return np.where(
                is_defined, p - self.p_votes_first_only(np.exp(-y), np.exp(-z), p_both), np.nan
            )
        n, inverse_remainder = self.number, 1 / (1 - shared)
        with np.errstate(divide="ignore"):
            # Chance of the first at which the second's mean is at its threshold: a step if alike.
            step_probability = special.gammaincc(
                n, np.maximum((n * z - n * (1 - shared)) / shared, 0.0)
            )
        node, weight = _gauss_in_intervals(
            np.stack([0 * p, np.minimum(step_probability, p), p], axis=-1)
        )
        conditional = (
            2 * inverse_remainder[..., None] * special.gammainccinv(n, np.maximum(node, 1e-300))
        )
        signal, threshold_ratio = (
            shared[..., None] * conditional,
            2 * (inverse_remainder * n * z)[..., None],
        )
        # Of a large signal the root is normal, within 1e-4.
        root_difference = np.sqrt(signal + 2 * n - 1) - np.sqrt(threshold_ratio)
        p_cross = special.ndtr(root_difference * np.sqrt((signal + 2 * n) / (signal + n)))
        is_small = signal < 1e4
        p_cross[is_small] = 1 - stats.ncx2.cdf(
            np.broadcast_to(threshold_ratio, is_small.shape)[is_small], 2 * n, signal[is_small]
        )
        return np.where(
            is_defined, np.minimum((p_cross * weight).sum(axis=-1), np.minimum(p, q)), np.nan
        )

    def _shared_fraction(
        self,
        p: np.ndarray,
        q: np.ndarray,
        correlation: np.ndarray,
        look_speckle: "LookSpeckle | None",
    ) -> np.ndarray:
        """Part that two segments have of the covariance which they would have in one speckle."""
        from sweep.model.detection.echo_detection import joint_pd_in_speckle

        infinite_threshold = np.full(np.shape(p), 1e100)
        with np.errstate(divide="ignore", invalid="ignore"):
            fraction = (
                joint_pd_in_speckle(
                    p, q, infinite_threshold, np.broadcast_to(correlation, infinite_threshold.shape)
                )
                - p * q
            )
            fraction = fraction / (np.minimum(p, q) - p * q)
        fraction = np.where(correlation > 1 - 1e-9, 1.0, np.clip(np.nan_to_num(fraction), 0.0, 1.0))
        inverse_looks = 1 / self._effective_looks(look_speckle)
        return np.asarray(inverse_looks * fraction + (1 - inverse_looks) * np.square(correlation))

    def _effective_looks(self, look_speckle: "LookSpeckle | None") -> np.ndarray | float:
        """Return M, the number of looks of independent speckle that these are worth."""
        if look_speckle is not None:
            return np.asarray(look_speckle.effective_looks.mean(axis=0))
        return float(self.number if self.has_independent_speckle else 1)

    def pd_and_miss_any_two(
        self,
        signals: np.ndarray,
        threshold_ratio: np.ndarray,
        correlations: np.ndarray,
        pd: np.ndarray,
        look_speckle: "LookSpeckle | None" = None,
    ) -> DetectionArrays:
        """Return the probabilities that at least two of three segments, or fewer, are detected.

        Parameters
        ----------
        signals
            |X| of their bins over the noise per quadrature, (3, n).
        threshold_ratio
            Threshold over the same, (n,).
        correlations
            Correlations of up and Doppler, up and down, Doppler and down segment, (3, n).
        pd
            Of the segments, (3, n).

        Notes
        -----
        Segment i shares a common speckle in a part l_i of cases and else has its own, with
        l_i l_j the part that :meth:`joint_pd_in_speckle` gives two segments. Given that speckle
        segments
        are independent, with probabilities l_i P_i(speckle) + (1 - l_i) P_i. If all looks have one
        speckle, segments are detected as :func:`pd_and_miss_any_two_in_speckle` has it of three
        magnitudes with the
        same probabilities. The result is the mean of both, with weights 1 - 1/M and 1/M.
        """
        from sweep.model.detection.echo_detection import at_least_two_of_three

        is_defined = np.isfinite(pd).all(axis=0)
        p = np.where(is_defined, pd, 0.0)
        a = list(np.where(is_defined, signals, 0.0))
        pd_by_signal, weight = self.pd_given_speckle(a, threshold_ratio, look_speckle)
        up_doppler, up_down, doppler_down = (
            np.maximum(
                self._shared_fraction(p[i], p[j], np.minimum(correlations[k], 1.0), look_speckle),
                1e-12,
            )
            for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)))
        )
        shared_fraction = np.sqrt(
            [
                up_doppler * up_down / doppler_down,
                up_doppler * doppler_down / up_down,
                up_down * doppler_down / up_doppler,
            ]
        )
        shared_fraction = np.minimum(shared_fraction, 1.0)[..., None]
        pd_by_segment = (
            shared_fraction * np.array(pd_by_signal) + (1 - shared_fraction) * p[..., None]
        )
        p_any_two = np.clip(
            (at_least_two_of_three(pd_by_segment, 1 - pd_by_segment) * weight).sum(axis=-1),
            0.0,
            1.0,
        )
        inverse_looks = 1 / self._effective_looks(look_speckle)
        pd_in_one_speckle = pd_and_miss_any_two_in_speckle(
            p, 1 - p, np.full(threshold_ratio.shape, 1e100), correlations
        ).pd
        p_any_two = inverse_looks * pd_in_one_speckle + (1 - inverse_looks) * p_any_two
        return DetectionArrays(
            np.where(is_defined, p_any_two, np.nan), np.where(is_defined, 1 - p_any_two, np.nan)
        )

    def log_pfa(self, threshold_ratio: np.ndarray) -> np.ndarray:
        """Natural logarithm of the probability that a bin of noise alone is detected.

        It keeps its digits where the probability itself leaves float64's range.

        >>> round(float(Looks(4).log_pfa(np.array(2.0))), 4)  # ln Q(4, 8)
        -3.1611
        """
        y, n = 0.5 * np.square(np.asarray(threshold_ratio, float)), self.number
        if not self.is_noncoherent:
            return np.asarray(-y)
        with np.errstate(divide="ignore"):
            if self.combine == COMBINE_POWER:
                k, log_y = np.arange(n), np.log(n * y)[..., None]
                terms = np.where(k > 0, k * np.where(np.isneginf(log_y), -1e300, log_y), 0.0)
                log_tail = special.logsumexp(terms - special.gammaln(k + 1), axis=-1) - n * y
                return np.where(n * y < n, np.log1p(-special.gammainc(n, n * y)), log_tail)
            k, log_p_stay = np.arange(self.votes, n + 1), np.log(-np.expm1(-y))[..., None]
            log_combinations = (
                special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1)
            )
            log_terms = (
                np.where(k < n, (n - k) * np.maximum(log_p_stay, -1e300), 0.0) - k * y[..., None]
            )
            return np.minimum(special.logsumexp(log_combinations + log_terms, axis=-1), 0.0)

    def threshold_ratio_from_log_pfa(self, log_pfa: np.ndarray) -> np.ndarray:
        """Return the threshold over sigma at which :meth:`log_pfa` equals ``log_pfa``."""
        if self.is_noncoherent:
            return solve_threshold_ratio(np.asarray(log_pfa, float), self.log_pfa)
        return np.asarray(np.sqrt(-2 * np.asarray(log_pfa)))

    def decisive_magnitude(self, magnitudes: np.ndarray) -> np.ndarray:
        """Of |X| of each record (N, ...) that which is at or above the threshold if it detects.

        The root of the mean power, or the least of the largest that are enough.
        """
        if self.combine == COMBINE_BINARY:
            return np.asarray(np.sort(magnitudes, axis=0)[-self.votes])
        return np.sqrt(np.mean(np.square(magnitudes), axis=0))

    def p_stay_given_neighbour_crosses(
        self, threshold_ratio: np.ndarray, correlation: float
    ) -> np.ndarray:
        """Probability that a bin of noise is not detected where its neighbour is, by the threshold.

        ``correlation`` is that of their noise, 0..1. Of sums of powers by the Gamma distribution of
        two variables [Kibble, Sankhya 5, 137, 1941]: with r = correlation^2, both cross with

            sum_j C(N+j-1, j) (1-r)^N r^j Q(N+j, Y / (1-r))^2.
        """
        from sweep.model.detection.marcum import marcum_q1

        y, r, n = 0.5 * np.square(np.asarray(threshold_ratio, float)), correlation**2, self.number
        if self.combine == COMBINE_BINARY:
            scaled_threshold = threshold_ratio / math.sqrt(1 - r)
            p_first_only = marcum_q1(correlation * scaled_threshold, scaled_threshold).p
            p_first_only = (
                p_first_only - marcum_q1(scaled_threshold, correlation * scaled_threshold).p
            )
            p = np.exp(-y)
            p_votes_first_only = self.p_votes_first_only(
                p, p, p * np.maximum(1 - p_first_only, 0.0)
            )
            log_p_cross = self.log_pfa(threshold_ratio)
            return np.where(
                log_p_cross > -600, p_votes_first_only / np.exp(np.maximum(log_p_cross, -600)), 1.0
            )
        p, gamma_threshold = np.exp(self.log_pfa(threshold_ratio)), n * y / (1 - r)
        p_both, j, is_unfinished = np.zeros_like(y), np.arange(256), np.ones(y.shape, bool)
        while True:
            log_weight = special.gammaln(n + j) - special.gammaln(j + 1) - special.gammaln(n)
            weight = np.exp(log_weight + n * math.log1p(-r) + j * math.log(r))
            new_terms = (weight * special.gammaincc(n + j, gamma_threshold[..., None]) ** 2).sum(
                axis=-1
            )
            p_both = np.where(is_unfinished, p_both + new_terms, p_both)
            is_past_peak = n + j[-1] > gamma_threshold + n * r / (1 - r)
            is_unfinished &= (~is_past_peak | (new_terms > 1e-14 * p_both + 1e-300)) & np.isfinite(
                gamma_threshold
            )
            if not is_unfinished.any():
                return np.clip(1 - p_both / np.maximum(p, 1e-300), 0.0, 1.0)
            j = j + j.size

    def p_votes_first_only(
        self, p_first: np.ndarray, p_second: np.ndarray, p_both: np.ndarray
    ) -> np.ndarray:
        """Probability that the first of two bins has enough records, and the second has not.

        ``p_first``, ``p_second`` and ``p_both`` are the probabilities that a record crosses in the
        first, in the second and in both.
        """
        from scipy import stats

        n, binomial = self.number, stats.binom
        with np.errstate(divide="ignore", invalid="ignore"):
            p_second_if_first = np.clip(np.nan_to_num(p_both / p_first), 0.0, 1.0)
            p_second_if_not_first = np.clip(
                np.nan_to_num((p_second - p_both) / (1 - p_first)), 0.0, 1.0
            )
        probability = np.zeros(np.shape(p_first))
        for k in range(self.votes, n + 1):
            p_too_few = sum(
                binomial.pmf(i, k, p_second_if_first)
                * binomial.cdf(self.votes - 1 - i, n - k, p_second_if_not_first)
                for i in range(min(self.votes - 1, k) + 1)
            )
            probability = probability + binomial.pmf(k, n, p_first) * p_too_few
        return probability

    def added_crossing_probability(self, signal: np.ndarray, threshold_ratio: float) -> np.ndarray:
        """Compute the crossing probability that bins' signals add, over noise's of not crossing.

        ``signal`` (m,) over the noise per quadrature of one record, at one level. By a table over
        the signal, within 1e-4 of it.
        """
        log_signals, log_added = _added_crossing_table(self, float(threshold_ratio))
        with np.errstate(divide="ignore"):
            log_signal = np.log(np.asarray(signal, float))
        log_probability = np.interp(log_signal, log_signals, log_added, left=-np.inf)
        is_below_table = log_signal < log_signals[0]  # as the square of the signal
        return np.exp(
            np.where(
                is_below_table, log_added[0] + 2 * (log_signal - log_signals[0]), log_probability
            )
        )

    def negligible_signal_ratio(
        self, *, leakage_probability: np.ndarray, threshold_ratio: np.ndarray, n_bins: int
    ) -> np.ndarray:
        """|X| over sigma below which a bin of several records counts as noise alone."""
        # Where tables begin chances rise as the signal's square.
        added_per_signal_power = (
            np.array(
                [
                    self.added_crossing_probability(np.array([1e-3]), b)[0]
                    for b in np.ravel(threshold_ratio)
                ]
            )
            / 1e-6
        )
        with np.errstate(divide="ignore"):
            signal_max = np.sqrt(
                leakage_probability
                / (
                    n_bins
                    * math.exp(1 / 8)
                    * added_per_signal_power.reshape(np.shape(threshold_ratio))
                )
            )
        return np.asarray(np.minimum(signal_max, 1 / (self.number * threshold_ratio)))

    def vote_probabilities(self, p_cross: np.ndarray, p_stay: np.ndarray) -> DetectionArrays:
        """Return the probabilities that enough records cross, and that they do not.

        ``p_cross`` and ``p_stay`` are the probabilities that one record crosses and does not.
        """
        votes_needed, misses_needed = self.votes, self.number - self.votes + 1
        return DetectionArrays(
            special.betainc(votes_needed, misses_needed, p_cross),
            special.betainc(misses_needed, votes_needed, p_stay),
        )

    def speckle_power_quadrature(
        self, look_speckle: "LookSpeckle | None", segment: int, point: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Powers of the speckle of all looks together, of mean 1, and weights, which add to 1.

        Their mean power is taken to be a gamma variable, of the shape M of as many independent
        looks. ``look_speckle`` is that of looks which share it in part.
        """
        gamma_shape = float(self.number if self.has_independent_speckle else 1)
        if look_speckle is not None:
            gamma_shape = float(look_speckle.effective_looks[segment, point])
        log_power = np.linspace(*_LOG_POWER_GRID)
        log_density = gamma_shape * (log_power - np.exp(log_power))
        weights = np.exp(log_density - log_density.max())
        return np.exp(log_power), weights / weights.sum()

    def speckle_quadrature(
        self,
        threshold_ratio: np.ndarray,
        *signals: np.ndarray,
        gamma_shape: np.ndarray | float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Magnitudes of speckle (..., k), of mean power 1, and weights; close about thresholds.

        Its power is a gamma variable of a ``gamma_shape`` (...), exponential for 1.
        """
        squared_threshold, magnitude_max = (
            np.square(threshold_ratio),
            np.full(threshold_ratio.shape, 7.0),
        )
        interval_ends = [0 * magnitude_max, magnitude_max]
        # Enough votes come and go within a part of what one record takes.
        n_pieces = 2 if self.combine == COMBINE_POWER else 2 + math.isqrt(self.number)
        snr_at_threshold = np.maximum(squared_threshold - 2, 0.0)
        width = 16 * np.sqrt((snr_at_threshold + 1) / self.n_power_averaged)
        for signal in signals:
            a = np.maximum(np.square(signal), 1e-30)
            for d in np.linspace(-1, 1, n_pieces):
                interval_ends.append(
                    np.minimum(
                        np.sqrt(np.maximum(snr_at_threshold + d * width, 0.0) / a), magnitude_max
                    )
                )
        if np.any(gamma_shape != 1.0):  # a narrow peak about 1
            width = 4 / np.sqrt(gamma_shape)
            interval_ends += [np.clip(1 + d * width, 0.0, magnitude_max) for d in (-1.0, 0.0, 1.0)]
        node, weight = _gauss_in_intervals(np.sort(np.stack(interval_ends, axis=-1), axis=-1))
        if np.all(gamma_shape == 1.0):
            return node, weight * 2 * node * np.exp(-np.square(node))
        gamma_shape, power = (
            np.broadcast_to(gamma_shape, threshold_ratio.shape)[..., None],
            np.square(node),
        )
        log_density = gamma_shape * (np.log(gamma_shape) - power) - special.gammaln(gamma_shape)
        log_density = log_density + (2 * gamma_shape - 1) * np.log(np.maximum(node, 1e-300))
        return node, weight * 2 * np.exp(log_density)


SINGLE_LOOK = Looks()
"""A record of each segment."""


def coherent_gain(
    looks: Looks, *, acceleration: np.ndarray, carrier: np.ndarray, look_period: np.ndarray
) -> np.ndarray:
    """Amplitude of the mean of records over that of one, by the acceleration from look to look.

    |mean exp(2 pi i f a t^2 / c)|, t the looks' times about their middle: what a velocity that is
    put right leaves. A laser's walking phase leaves the root of
    :func:`sweep.model.effects.laser_line.pure_line_power_fraction` besides.
    """
    look_index = np.arange(looks.n_coherent) - (looks.n_coherent - 1) / 2
    cycles_per_square_index = np.asarray(
        carrier * acceleration * np.square(look_period) / SPEED_OF_LIGHT, float
    )
    return np.abs(
        np.exp(2j * np.pi * cycles_per_square_index[..., None] * look_index**2).mean(axis=-1)
    )


def solve_threshold_ratio(
    log_pfa: np.ndarray, log_pfa_law: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Find the threshold over sigma (n,) at which ``log_pfa_law``, falling, is a given ln(pfa)."""
    # A bin alone alarms less often than n of them, and these no oftener than n each for itself.
    low, high = np.zeros_like(log_pfa), np.sqrt(2 * (100.0 - log_pfa))
    for _ in range(_BISECTION_STEPS):
        middle = 0.5 * (low + high)
        is_above = log_pfa_law(middle) > log_pfa
        low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
    return 0.5 * (low + high)


def pd_and_miss_any_two_in_speckle(
    pd: np.ndarray, miss: np.ndarray, threshold_ratio: np.ndarray, correlations: np.ndarray
) -> DetectionArrays:
    """Return the probabilities that two or more of three segments in speckle are detected, or not.

    The amplitude of each segment, signal and noise, is normal, of the part l_i z of one common
    amplitude z and a rest of its own. With A_i = Th^2 over the mean power, u = |z|^2 exponential,

        P_i(u) = Q_1(l_i sqrt(2 u / (1 - l_i^2)), sqrt(2 A_i / (1 - l_i^2)))

    and given u the segments are independent. The correlations, those of
    :func:`sweep.model.detection.echo_detection.joint_pd_in_speckle` by
    :class:`sweep.model.detection.echo_detection.SegmentCorrelations`, give l_i
    = sqrt(rho_ij rho_ik / rho_jk): exact for segments that share their speckle, or each have their
    own. If speckle moves on between them one l_k may come out above 1. It is then 1, z is that
    segment's own amplitude, and of the others a covariance kappa = rho_ij - rho_ik rho_jk is left,
    which adds to the probability of both

        kappa P_i' P_j' / 2 + kappa^2 (A_i A_j + B_i B_j) / 16,    A, B = P'' +- P' / r

    with derivatives by r, the mean given z: Mehler's series to its second term, within 0.002 of
    drawn amplitudes.
    """
    from sweep.model.detection.echo_detection import at_least_two_of_three
    from sweep.model.detection.marcum import marcum_q1

    is_defined = np.isfinite(pd).all(axis=0)
    with np.errstate(divide="ignore"):
        a = np.where(
            pd < 0.5, -np.log(np.where(is_defined, pd, 1.0)), -np.log1p(-np.minimum(miss, 0.5))
        )
    a = np.clip(a, 1e-300, 700.0)
    echo_fractions = np.maximum(1 - a / (0.5 * np.square(threshold_ratio)), 1e-9)
    rho = np.minimum(correlations, 1.0) * np.sqrt(
        echo_fractions[[0, 0, 1]] * echo_fractions[[1, 2, 2]]
    )
    up_doppler, up_down, doppler_down = rho
    with np.errstate(divide="ignore", invalid="ignore"):
        squared_loading = np.array(
            [
                up_doppler * up_down / doppler_down,
                up_doppler * doppler_down / up_down,
                up_down * doppler_down / up_doppler,
            ]
        )
    squared_loading = np.nan_to_num(squared_loading, posinf=2.0)
    pairs = (
        (1, 2, up_doppler, up_down),
        (0, 2, up_doppler, doppler_down),
        (0, 1, up_down, doppler_down),
    )
    exceeds_one = squared_loading > 1  # one of them at most
    for k, (i, j, correlation_first, correlation_second) in enumerate(pairs):
        squared_loading[i], squared_loading[j] = np.where(
            exceeds_one[k], (correlation_first**2, correlation_second**2), squared_loading[[i, j]]
        )
    squared_loading = np.minimum(squared_loading, 1 - 1e-9)
    remainder = 1 - squared_loading
    threshold_magnitude = np.sqrt(a / np.maximum(squared_loading, 1e-12))
    width = 6 * np.sqrt(remainder / np.maximum(2 * squared_loading, 1e-12))
    magnitude_max = np.sqrt(a.max(axis=0)) + 7.0
    interval_ends = [
        0 * magnitude_max,
        magnitude_max,
        *np.clip(
            [threshold_magnitude - width, threshold_magnitude, threshold_magnitude + width],
            0.0,
            magnitude_max,
        ).reshape(9, -1),
    ]
    node, weight = _gauss_in_intervals(np.sort(np.stack(interval_ends, axis=-1), axis=-1))
    weight = weight * 2 * node * np.exp(-np.square(node))
    signal = np.sqrt(2 * squared_loading / remainder)[..., None] * node
    threshold = np.sqrt(2 * a / remainder)[..., None] + 0 * node
    p_cross, p_stay = marcum_q1(signal, threshold)
    excess = np.zeros(node.shape)
    for k, (i, j, correlation_first, correlation_second) in enumerate(pairs):
        points = np.flatnonzero(exceeds_one[k])
        pair_points = np.ix_(np.array([i, j]), points)
        kappa = (
            (rho[[2, 1, 0]][k] - correlation_first * correlation_second)[points]
            * 2
            / np.sqrt(remainder[i] * remainder[j])[points]
        )
        slope, plus, minus = _marcum_q1_derivatives(signal[pair_points], threshold[pair_points])
        square_term = (plus[0] * plus[1] + minus[0] * minus[1]) * np.square(kappa[:, None]) / 16
        pair_excess = kappa[:, None] * slope[0] * slope[1] / 2 + square_term
        excess[points] = pair_excess * (p_stay[k, points] - p_cross[k, points])
    probabilities = (
        at_least_two_of_three(p_cross, p_stay) + excess,
        at_least_two_of_three(p_stay, p_cross) - excess,
    )
    p_cross, p_stay = (
        np.clip((values * weight).sum(axis=-1), 0.0, 1.0) for values in probabilities
    )
    total = p_cross + p_stay  # 1 but for the quadrature
    # A segment that is never detected has no threshold: what stands for it above is too low.
    is_possible = np.count_nonzero(pd > 0.0, axis=0) >= 2
    p_cross, p_stay = np.where(is_possible, [p_cross / total, p_stay / total], [[0.0], [1.0]])
    return DetectionArrays(
        np.where(is_defined, p_cross, np.nan), np.where(is_defined, p_stay, np.nan)
    )


def _marcum_q1_derivatives(
    signal_ratio: np.ndarray, threshold_ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Q_1' and Q_1'' +- Q_1' / a by the signal a, at the threshold b."""
    x = np.maximum(signal_ratio * threshold_ratio, 1e-12)
    # special.ive is nan from arguments of 1e9 on.
    scaled_i0, scaled_i1 = (
        threshold_ratio * np.exp(-0.5 * np.square(signal_ratio - threshold_ratio)) * bessel(x)
        for bessel in (special.i0e, special.i1e)
    )
    second_derivative = threshold_ratio * (scaled_i0 - scaled_i1 / x) - signal_ratio * scaled_i1
    slope_over_signal = threshold_ratio * scaled_i1 / x
    return scaled_i1, second_derivative + slope_over_signal, second_derivative - slope_over_signal


def _gauss_in_intervals(interval_ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points and weights of the stretches between ends (..., k), all behind one another."""
    node, weight = np.polynomial.legendre.leggauss(_GAUSS_NODES)
    half_width = 0.5 * np.diff(interval_ends, axis=-1)[..., None]
    position = interval_ends[..., :-1, None] + half_width * (node + 1)
    return position.reshape(*interval_ends.shape[:-1], -1), (half_width * weight).reshape(
        *interval_ends.shape[:-1], -1
    )


@lru_cache(maxsize=4096)
def _added_crossing_table(looks: Looks, threshold_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of signals and of what :meth:`Looks.added_crossing_probability` has for them."""
    signal = np.geomspace(1e-3 / math.sqrt(looks.number), threshold_ratio + 1.0, 300)
    noise = looks.pd_and_miss_steady(np.zeros(1), np.array([threshold_ratio]))
    p_cross = looks.pd_and_miss_steady(signal, np.full(signal.shape, threshold_ratio)).pd
    added = np.maximum(p_cross - noise.pd, 1e-300) / np.maximum(noise.miss, 1e-300)
    return np.log(signal), np.log(added)
