"""Detection of a shot from several looks: N records of each of its segments.

The waveform of a shot is repeated N times without a pause. In a bin, let a be |X| without noise and
b the threshold, both over the noise per quadrature of one record. Looks are combined in one of
three ways:

- ``power``: the N periodograms |X|^2 are averaged, and the root of the mean is compared with the
  threshold. The sum of powers is a noncentral chi-square variable of 2 N degrees of freedom. It
  crosses with ``Q_N(sqrt(N) a, sqrt(N) b)``, Marcum's Q of order N. Noise alone is a Gamma(N)
  variable and crosses with ``Q(N, N b^2 / 2)``, the regularised incomplete Gamma function [Marcum,
  IRE Trans. Inf. Theory 6, 59, 1960].
- ``binary``: each record is compared with the threshold, and M of them must cross in the bin.
- ``coherent``: records are added after the phase between them due to a steady velocity is removed.
  The sum counts as one record of N times less noise. :func:`coherent_amplitude_factor` gives its
  loss by an acceleration; a laser's phase noise adds to the loss.

An echo in developed speckle fades. All looks have the same speckle (``speckle: common``), or each
look has independent speckle, as when the beam moves by its width from look to look (``speckle:
independent``). With x = a^2 / 2 the mean SNR of one record and Y = N b^2 / 2, the mean of Q_N over
common speckle is Swerling's first case (Q and P are the regularised incomplete Gamma functions),

    Q(N-1, Y) + (1 + 1 / (N x))^(N-1) e^(-Y / (1 + N x)) P(N-1, Y / (1 + 1 / (N x))),

and over independent speckle his second, Q(N, Y / (1 + x)) [Swerling, IRE Trans. Inf. Theory 6, 269,
1960; Richards, Fundamentals of Radar Signal Processing, 2005, 6.3]. In between, the speckle of
looks is partially correlated by the motion from one to the next (``speckle: motion``):
:mod:`sweep.model.detection.look_speckle`.

Q_N is computed as scipy's noncentral chi square, with a relative error of 1e-11 in either tail down
to 1e-300.
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

N_DRIFT_POSITIONS_MAX = 64
"""Largest number of looks at which the position of a line that moves from look to look is
evaluated. More looks are represented by this number of looks."""

_CERTAIN_CROSSING_MARGIN_SIGMA = 40.0
"""Distance of a bin's |X| from the threshold beyond which a crossing counts as certain or
impossible, in units of the noise per quadrature."""
_BISECTION_STEPS = 60
_LOG_SPECKLE_POWER_GRID = -5.0, math.log(16.0), 64
"""Grid of the quadrature over the speckle's power (mean 1): ln(power) of the first and of the last
node, and number of nodes."""
_N_GAUSS_NODES = 24
"""Number of Gauss-Legendre nodes in each interval of the quadrature over the magnitude of
speckle."""


class PdAndMissArrays(NamedTuple):
    """Probabilities of detection and of a miss of bins or shots, arrays of one shape."""

    pd: np.ndarray
    """Probability that a bin or shot is detected, 0..1."""
    miss: np.ndarray
    """Probability that a bin or shot is missed, 1 - pd. It is precise where pd is near 1."""


class Looks(NamedTuple):
    """Number of records of each segment, and the rule by which they are combined.

    Examples
    --------
    >>> pd, miss = Looks(8).pd_and_miss_steady(np.array([1.5]), np.array([2.0]))
    >>> bool(pd > Looks(1).pd_and_miss_steady(np.array([1.5]), np.array([2.0])).pd)
    True
    """

    number: int = 1
    """Number N of records of each segment."""
    combine_kind: str = COMBINE_POWER
    """How the records of a segment are combined, one of :data:`COMBINE_KINDS`."""
    votes_needed: int = 1
    """Number of records that must cross the threshold in a bin for a detection. Only used if
    ``combine_kind`` is ``binary``."""
    has_independent_speckle: bool = False
    """True if the echo fades independently from record to record."""
    has_moving_speckle: bool = False
    """True if the correlation of the speckle between records follows from the target's motion."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "Looks":
        """Return the looks that a spec states; ``parameters`` maps dotted paths to values.

        The default is a single look.
        """
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
        """True if the powers or threshold crossings of several records are combined.

        False for a single record, and for records that are added as amplitudes.
        """
        return self.number > 1 and self.combine_kind != COMBINE_COHERENT

    @property
    def n_coherent(self) -> int:
        """Number of records that are added coherently; 1 if none are."""
        return self.number if self.combine_kind == COMBINE_COHERENT else 1

    @property
    def n_power_averaged(self) -> int:
        """Number of records whose powers are averaged; 1 if none are."""
        return self.number if self.combine_kind == COMBINE_POWER else 1

    @property
    def amplitude_gain_max(self) -> float:
        """Upper bound of the gain in amplitude over noise by combining the looks.

        The bound is sqrt(N) for N looks whose powers or crossings are combined, else 1.
        """
        return math.sqrt(self.number) if self.is_noncoherent else 1.0

    def equivalent_threshold_ratio(self, threshold_ratio: np.ndarray) -> np.ndarray:
        """Return the threshold at which a single equivalent record detects as often as the looks.

        Thresholds are over the noise per quadrature. The equivalent record has
        ``amplitude_gain_max`` times the amplitudes of one look.
        """
        scaled = np.asarray(self.amplitude_gain_max * threshold_ratio)
        if self.n_power_averaged == 1:
            return scaled
        return np.sqrt(np.maximum(np.square(scaled) - 2 * (self.number - 1), 0.0))

    def pd_and_miss_steady(
        self, signal: np.ndarray, threshold_ratio: np.ndarray, is_real: np.ndarray | bool = False
    ) -> PdAndMissArrays:
        """Return the probabilities that a bin with a steady signal is detected and is missed.

        Parameters
        ----------
        signal, threshold_ratio
            |X| without noise, and threshold, over the noise per quadrature of one record.
        is_real
            True if the noise is real: one quadrature has the noise power of both.

        Returns
        -------
        PdAndMissArrays
            Of the broadcast shape of the arguments.
        """
        from sweep.model.detection.marcum import marcum_q1

        signal, threshold_ratio, is_real = np.broadcast_arrays(signal, threshold_ratio, is_real)
        if not self.is_noncoherent or self.combine_kind == COMBINE_BINARY:
            pd, miss = marcum_q1(signal, threshold_ratio)
            if is_real.any():
                near, far = 0.5 * (threshold_ratio - signal), 0.5 * (threshold_ratio + signal)
                pd = np.where(is_real, 0.5 * (special.erfc(near) + special.erfc(far)), pd)
                miss = np.where(is_real, 0.5 * (special.erfc(-near) - special.erfc(far)), miss)
            if self.is_noncoherent:
                return self.vote_probabilities(pd, miss)
            return PdAndMissArrays(pd, miss)
        from scipy import stats  # slow to import, and not needed for one look

        a, b = (math.sqrt(self.number) * np.asarray(v, float) for v in (signal, threshold_ratio))
        pd, miss = np.where(a > b, 1.0, 0.0), np.where(a > b, 0.0, 1.0)
        near = np.asarray(
            (a - b < _CERTAIN_CROSSING_MARGIN_SIGMA)
            & (b - a < _CERTAIN_CROSSING_MARGIN_SIGMA + math.sqrt(2 * self.number))
        )
        degrees_of_freedom, noise_fraction = (
            np.where(is_real, n, 2 * n)[near] for n in (self.number, 1.0)
        )
        x, signal = 0.5 * noise_fraction * b[near] ** 2, 0.5 * noise_fraction * a[near] ** 2
        # The smaller tail is computed, and the other as its complement.
        is_upper_tail, tail = x > degrees_of_freedom + signal, np.empty(x.shape)
        for members, tail_law in ((is_upper_tail, stats.ncx2.sf), (~is_upper_tail, stats.ncx2.cdf)):
            tail[members] = tail_law(x[members], degrees_of_freedom[members], signal[members])
        pd[near], miss[near] = np.where(is_upper_tail, (tail, 1 - tail), (1 - tail, tail))
        return PdAndMissArrays(pd, miss)

    def pd_and_miss_in_speckle(
        self,
        signal: np.ndarray,
        threshold_ratio: np.ndarray,
        look_speckle: "LookSpeckle | None" = None,
    ) -> PdAndMissArrays:
        """Return the probabilities that a bin in developed speckle is detected and is missed.

        Parameters
        ----------
        signal, threshold_ratio
            Root mean square |X| without noise, and threshold, over the noise per quadrature of one
            record.
        look_speckle
            Correlation of the looks' speckle if it is partial, for signals (..., 3, n); else None.

        Returns
        -------
        PdAndMissArrays
            Of the broadcast shape of the arguments.
        """
        signal, threshold_ratio = np.broadcast_arrays(
            np.asarray(signal, float), np.asarray(threshold_ratio, float)
        )
        if look_speckle is not None and self.is_noncoherent:
            return self._pd_and_miss_in_moving_speckle(signal, threshold_ratio, look_speckle)
        y = np.square(threshold_ratio) / (2 + np.square(signal))
        if not self.is_noncoherent or (
            self.combine_kind == COMBINE_BINARY and self.has_independent_speckle
        ):
            pd, miss = np.exp(-y), -np.expm1(-y)
            if self.is_noncoherent:
                return self.vote_probabilities(pd, miss)
            return PdAndMissArrays(pd, miss)
        if self.has_independent_speckle:
            return PdAndMissArrays(
                special.gammaincc(self.number, self.number * y),
                special.gammainc(self.number, self.number * y),
            )
        if self.combine_kind == COMBINE_BINARY:
            magnitude, weight = self.speckle_magnitude_quadrature(threshold_ratio, signal)
            tails_given_speckle = self.pd_and_miss_steady(
                signal[..., None] * magnitude, threshold_ratio[..., None]
            )
            return PdAndMissArrays(
                *(np.minimum((v * weight).sum(axis=-1), 1.0) for v in tails_given_speckle)
            )
        n, gamma_threshold = self.number, 0.5 * self.number * np.square(threshold_ratio)
        total_snr = np.maximum(0.5 * self.number * np.square(signal), 1e-200)
        noise_tail = special.gammaincc(n - 1, gamma_threshold)
        # P of small arguments by its series: P underflows, and is multiplied by a large factor.
        z = gamma_threshold * (total_snr / (1 + total_snr))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            log_p_series = (n - 1) * np.log(z) - z - special.gammaln(n)
            log_p_series = log_p_series + np.log(special.hyp1f1(1.0, n, np.minimum(z, n)))
            log_p = np.where(z < n, log_p_series, np.log(special.gammainc(n - 1, z)))
        log_signal_tail = np.minimum(
            (n - 1) * np.log1p(1 / total_snr) - gamma_threshold / (1 + total_snr) + log_p, 0.0
        )
        pd = np.minimum(noise_tail + np.exp(log_signal_tail), 1.0)
        return PdAndMissArrays(pd, np.maximum(-np.expm1(log_signal_tail) - noise_tail, 0.0))

    def _pd_and_miss_in_moving_speckle(
        self, signal: np.ndarray, threshold_ratio: np.ndarray, look_speckle: "LookSpeckle"
    ) -> PdAndMissArrays:
        """Compute :meth:`pd_and_miss_in_speckle` for partially correlated speckle of the looks."""
        from sweep.model.detection.look_speckle import (
            mean_power_tails,
            vote_probability_given_speckle,
        )

        if self.combine_kind == COMBINE_POWER:
            snr, threshold = 0.5 * np.square(signal), 0.5 * self.number * np.square(threshold_ratio)
            return PdAndMissArrays(*mean_power_tails(look_speckle, self.number, snr, threshold))
        pd = np.empty(signal.shape)
        for segment, point in np.ndindex(signal.shape[-2:]):
            magnitude = self._correlated_magnitudes(look_speckle, segment, point)
            for lead in np.ndindex(signal.shape[:-2]):
                index = (*lead, segment, point)
                pd_given_speckle = vote_probability_given_speckle(
                    signal[index], threshold_ratio[index], self.votes_needed, magnitude
                )
                pd[index] = pd_given_speckle.mean()
        record_pd = np.exp(-np.square(threshold_ratio) / (2 + np.square(signal)))
        independent_pd = self.vote_probabilities(record_pd, 1 - record_pd).pd
        for index in np.ndindex(signal.shape):
            lattice_pd = vote_probability_given_speckle(
                signal[index], threshold_ratio[index], self.votes_needed, self._lattice_magnitudes()
            ).mean()
            independence = (look_speckle.n_effective_looks[index[-2:]] - 1) / (self.number - 1)
            pd[index] += independence * (independent_pd[index] - lattice_pd)
        pd = np.clip(pd, 0.0, 1.0)
        return PdAndMissArrays(pd, 1 - pd)

    def _lattice_magnitudes(self) -> np.ndarray:
        """Return speckle magnitudes of N looks of independent speckle, in fixed realisations.

        The shape is (realisations, N).
        """
        from sweep.model.detection.look_speckle import speckle_lattice_amplitudes

        return np.abs(speckle_lattice_amplitudes(self.number))

    def _correlated_magnitudes(
        self, look_speckle: "LookSpeckle", segment: int, point: int
    ) -> np.ndarray:
        """Return speckle magnitudes of the N looks of one segment of one point.

        Looks are correlated as in ``look_speckle``. The shape is (fixed realisations, N).
        """
        from sweep.model.detection.look_speckle import (
            correlated_speckle_magnitudes,
            speckle_lattice_amplitudes,
        )

        covariance_root = look_speckle.covariance_root(segment, point)
        return correlated_speckle_magnitudes(
            speckle_lattice_amplitudes(covariance_root.shape[1]), covariance_root
        )

    def pd_given_speckle(
        self,
        signals: Sequence[np.ndarray],
        threshold_ratio: np.ndarray,
        look_speckle: "LookSpeckle | None",
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Compute the probabilities of detection of segments, given the speckle of all looks.

        All segments have the same speckle.

        Parameters
        ----------
        signals
            (..., n) for each segment: root mean square |X| over the noise per quadrature.
        threshold_ratio
            (..., n): threshold over the noise per quadrature.
        look_speckle
            Correlation of the looks' speckle if it is partial, else None.

        Returns
        -------
        list
            Probability of detection (..., n, k) of each segment, in k realisations of the speckle.
        numpy.ndarray
            (..., k): weights of the realisations, of the sum 1.
        """
        if self.combine_kind == COMBINE_POWER or (
            look_speckle is None and not self.has_independent_speckle
        ):
            n_effective_looks = np.broadcast_to(
                self._n_effective_looks(look_speckle), threshold_ratio.shape
            )
            magnitude, weight = self.speckle_magnitude_quadrature(
                threshold_ratio, *signals, gamma_shape=n_effective_looks
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
                    signal[index], threshold_ratio[index], self.votes_needed, magnitude
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
        """Return the probability that two segments in developed speckle are both detected.

        Parameters
        ----------
        signal_first, signal_second
            (..., n): root mean square |X| of the segments' bins over the noise per quadrature.
        threshold_ratio
            (n,): threshold over the noise per quadrature.
        correlation
            (n,): modulus of the correlation of the segments' signal amplitudes.
        look_speckle
            Correlation of the looks' speckle if it is partial, else None.

        Returns
        -------
        numpy.ndarray
            (..., n): probability that both segments are detected.

        Notes
        -----
        If looks have independent speckle, the joint probability is an integral over the power of
        the first segment's looks. Given that power, the power of the second segment's looks is a
        noncentral chi-square variable.

        If all looks have common speckle, and the correlation of the segments is 1, the joint
        probability is the mean over the speckle of the product of both probabilities. With a
        smaller correlation the segments' covariance is a fraction of that at correlation 1. The
        fraction is that of two Rayleigh magnitudes with the same probabilities. Partially
        correlated looks are treated likewise (:mod:`sweep.model.detection.look_speckle`).
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
            mean_pd_first, mean_pd_second = (
                (conditional * weight).sum(axis=-1) for conditional in (pd_first, pd_second)
            )
            covariance = (pd_first * pd_second * weight).sum(
                axis=-1
            ) - mean_pd_first * mean_pd_second
            shared_fraction = self._shared_covariance_fraction(p, q, correlation, look_speckle)
            return np.where(
                is_defined,
                np.clip(p * q + shared_fraction * covariance, 0.0, np.minimum(p, q)),
                np.nan,
            )
        echo_fractions = (np.square(v) / (2 + np.square(v)) for v in (a, b))
        squared_correlation = np.minimum(
            np.square(correlation) * np.prod(list(echo_fractions), axis=0), 1 - 1e-9
        )
        y, z = (np.square(threshold_ratio) / (2 + np.square(v)) for v in (a, b))
        if self.combine_kind == COMBINE_BINARY:
            p_both = joint_pd_in_speckle(
                np.exp(-y), np.exp(-z), infinite_threshold, squared_correlation**0.5
            )
            return np.where(
                is_defined,
                p - self.p_enough_votes_in_first_bin_only(np.exp(-y), np.exp(-z), p_both),
                np.nan,
            )
        n, inverse_remainder = self.number, 1 / (1 - squared_correlation)
        with np.errstate(divide="ignore"):
            # Upper-tail probability of the first segment's power at which the mean of the second's
            # is at the threshold. The integrand is a step there if both are fully correlated.
            step_probability = special.gammaincc(
                n,
                np.maximum((n * z - n * (1 - squared_correlation)) / squared_correlation, 0.0),
            )
        node, weight = _gauss_nodes_in_intervals(
            np.stack([0 * p, np.minimum(step_probability, p), p], axis=-1)
        )
        conditional = (
            2 * inverse_remainder[..., None] * special.gammainccinv(n, np.maximum(node, 1e-300))
        )
        signal, threshold_ratio = (
            squared_correlation[..., None] * conditional,
            2 * (inverse_remainder * n * z)[..., None],
        )
        # The root of a noncentral chi square of a large signal is normal, within 1e-4.
        root_difference = np.sqrt(signal + 2 * n - 1) - np.sqrt(threshold_ratio)
        p_cross = special.ndtr(root_difference * np.sqrt((signal + 2 * n) / (signal + n)))
        is_small = signal < 1e4
        p_cross[is_small] = 1 - stats.ncx2.cdf(
            np.broadcast_to(threshold_ratio, is_small.shape)[is_small], 2 * n, signal[is_small]
        )
        return np.where(
            is_defined, np.minimum((p_cross * weight).sum(axis=-1), np.minimum(p, q)), np.nan
        )

    def _shared_covariance_fraction(
        self,
        p: np.ndarray,
        q: np.ndarray,
        correlation: np.ndarray,
        look_speckle: "LookSpeckle | None",
    ) -> np.ndarray:
        """Return the covariance of two segments' detections over its value for equal speckle.

        The result, 0..1, is 1 if both segments have the same speckle, and 0 if their speckle is
        independent.

        Parameters
        ----------
        p, q
            Probabilities of detection of the two segments.
        correlation
            Modulus of the correlation of the segments' signal amplitudes.
        look_speckle
            Correlation of the looks' speckle if it is partial, else None.
        """
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
        inverse_looks = 1 / self._n_effective_looks(look_speckle)
        return np.asarray(inverse_looks * fraction + (1 - inverse_looks) * np.square(correlation))

    def _n_effective_looks(self, look_speckle: "LookSpeckle | None") -> np.ndarray | float:
        """Return the number of looks of independent speckle that fade as much as these looks."""
        if look_speckle is not None:
            return np.asarray(look_speckle.n_effective_looks.mean(axis=0))
        return float(self.number if self.has_independent_speckle else 1)

    def pd_and_miss_any_two(
        self,
        signals: np.ndarray,
        threshold_ratio: np.ndarray,
        correlations: np.ndarray,
        pd: np.ndarray,
        look_speckle: "LookSpeckle | None" = None,
    ) -> PdAndMissArrays:
        """Return the probabilities that at least two of three segments are detected, or fewer.

        Parameters
        ----------
        signals
            (3, n): root mean square |X| of the segments' bins over the noise per quadrature.
        threshold_ratio
            (n,): threshold over the noise per quadrature.
        correlations
            (3, n): moduli of the correlations of up and Doppler, up and down, Doppler and down
            segment.
        pd
            (3, n): probability of detection of each segment.
        look_speckle
            Correlation of the looks' speckle if it is partial, else None.

        Returns
        -------
        PdAndMissArrays
            Both probabilities, (n,); nan where a segment's `pd` is not finite.

        Notes
        -----
        The result is the mean of two laws, with weights 1 - 1/M and 1/M for M effective looks. In
        the first law segment i has a common speckle with probability l_i, and else an independent
        one. l_i l_j is the fraction of covariance in :meth:`joint_pd_in_speckle`. Given the common
        speckle, segments are independent and detected with l_i P_i(speckle) + (1 - l_i) P_i. The
        second law is :func:`pd_and_miss_any_two_in_speckle` of three magnitudes with the same
        probabilities.
        """
        from sweep.model.detection.echo_detection import at_least_two_of_three_probability

        is_defined = np.isfinite(pd).all(axis=0)
        p = np.where(is_defined, pd, 0.0)
        a = list(np.where(is_defined, signals, 0.0))
        pd_by_signal, weight = self.pd_given_speckle(a, threshold_ratio, look_speckle)
        up_doppler, up_down, doppler_down = (
            np.maximum(
                self._shared_covariance_fraction(
                    p[i], p[j], np.minimum(correlations[k], 1.0), look_speckle
                ),
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
            (at_least_two_of_three_probability(pd_by_segment, 1 - pd_by_segment) * weight).sum(
                axis=-1
            ),
            0.0,
            1.0,
        )
        inverse_looks = 1 / self._n_effective_looks(look_speckle)
        pd_in_one_speckle = pd_and_miss_any_two_in_speckle(
            p, 1 - p, np.full(threshold_ratio.shape, 1e100), correlations
        ).pd
        p_any_two = inverse_looks * pd_in_one_speckle + (1 - inverse_looks) * p_any_two
        return PdAndMissArrays(
            np.where(is_defined, p_any_two, np.nan), np.where(is_defined, 1 - p_any_two, np.nan)
        )

    def log_pfa(self, threshold_ratio: np.ndarray) -> np.ndarray:
        """Return the natural logarithm of the probability that a bin of noise alone is detected.

        The logarithm is precise even where the probability itself underflows.

        Parameters
        ----------
        threshold_ratio
            Threshold over the noise per quadrature of one record.

        Examples
        --------
        >>> round(float(Looks(4).log_pfa(np.array(2.0))), 4)  # ln Q(4, 8)
        -3.1611
        """
        y, n = 0.5 * np.square(np.asarray(threshold_ratio, float)), self.number
        if not self.is_noncoherent:
            return np.asarray(-y)
        with np.errstate(divide="ignore"):
            if self.combine_kind == COMBINE_POWER:
                k, log_y = np.arange(n), np.log(n * y)[..., None]
                terms = np.where(k > 0, k * np.where(np.isneginf(log_y), -1e300, log_y), 0.0)
                log_tail = special.logsumexp(terms - special.gammaln(k + 1), axis=-1) - n * y
                return np.where(n * y < n, np.log1p(-special.gammainc(n, n * y)), log_tail)
            k, log_p_stay = np.arange(self.votes_needed, n + 1), np.log(-np.expm1(-y))[..., None]
            log_combinations = (
                special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1)
            )
            log_terms = (
                np.where(k < n, (n - k) * np.maximum(log_p_stay, -1e300), 0.0) - k * y[..., None]
            )
            return np.minimum(special.logsumexp(log_combinations + log_terms, axis=-1), 0.0)

    def threshold_ratio_from_log_pfa(self, log_pfa: np.ndarray) -> np.ndarray:
        """Return the threshold at which noise alone is detected with a given probability.

        ``log_pfa`` is the natural logarithm of that probability (:meth:`log_pfa`). The threshold is
        over the noise per quadrature of one record.
        """
        if self.is_noncoherent:
            return solve_threshold_ratio(np.asarray(log_pfa, float), self.log_pfa)
        return np.asarray(np.sqrt(-2 * np.asarray(log_pfa)))

    def decisive_magnitude(self, magnitudes: np.ndarray) -> np.ndarray:
        """Return the magnitude that reaches the threshold if and only if the looks detect the bin.

        The magnitude is the root of the mean power, or the M-th largest |X| for M votes.

        Parameters
        ----------
        magnitudes
            (N, ...): |X| in each record.
        """
        if self.combine_kind == COMBINE_BINARY:
            return np.asarray(np.sort(magnitudes, axis=0)[-self.votes_needed])
        return np.sqrt(np.mean(np.square(magnitudes), axis=0))

    def p_stay_given_neighbour_crosses(
        self, threshold_ratio: np.ndarray, correlation: float
    ) -> np.ndarray:
        """Return the probability that a noise bin is not detected, given that its neighbour is.

        Parameters
        ----------
        threshold_ratio
            Threshold b over the noise per quadrature of one record.
        correlation
            Correlation of the two bins' noise, 0..1.

        Notes
        -----
        Sums of powers have a bivariate Gamma distribution [1]_. With r = correlation^2 and
        Y = N b^2 / 2, both bins cross with

            sum_j C(N+j-1, j) (1-r)^N r^j Q(N+j, Y / (1-r))^2,

        with N looks, binomial coefficients C and the regularised incomplete Gamma function Q.

        References
        ----------
        .. [1] W. F. Kibble, "A two-variate gamma type distribution," Sankhya 5, 137, 1941.
        """
        from sweep.model.detection.marcum import marcum_q1

        y, r, n = 0.5 * np.square(np.asarray(threshold_ratio, float)), correlation**2, self.number
        if self.combine_kind == COMBINE_BINARY:
            scaled_threshold = threshold_ratio / math.sqrt(1 - r)
            p_first_only = marcum_q1(correlation * scaled_threshold, scaled_threshold).p
            p_first_only = (
                p_first_only - marcum_q1(scaled_threshold, correlation * scaled_threshold).p
            )
            p = np.exp(-y)
            p_enough_votes_in_first_bin_only = self.p_enough_votes_in_first_bin_only(
                p, p, p * np.maximum(1 - p_first_only, 0.0)
            )
            log_p_cross = self.log_pfa(threshold_ratio)
            return np.where(
                log_p_cross > -600,
                p_enough_votes_in_first_bin_only / np.exp(np.maximum(log_p_cross, -600)),
                1.0,
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

    def p_enough_votes_in_first_bin_only(
        self, p_first: np.ndarray, p_second: np.ndarray, p_both: np.ndarray
    ) -> np.ndarray:
        """Return the probability that enough records cross in the first bin, but not in the second.

        Parameters
        ----------
        p_first, p_second, p_both
            Probabilities that a record crosses in the first bin, in the second, and in both.
        """
        from scipy import stats

        n, binomial = self.number, stats.binom
        with np.errstate(divide="ignore", invalid="ignore"):
            p_second_if_first = np.clip(np.nan_to_num(p_both / p_first), 0.0, 1.0)
            p_second_if_not_first = np.clip(
                np.nan_to_num((p_second - p_both) / (1 - p_first)), 0.0, 1.0
            )
        probability = np.zeros(np.shape(p_first))
        for k in range(self.votes_needed, n + 1):
            p_too_few = sum(
                binomial.pmf(i, k, p_second_if_first)
                * binomial.cdf(self.votes_needed - 1 - i, n - k, p_second_if_not_first)
                for i in range(min(self.votes_needed - 1, k) + 1)
            )
            probability = probability + binomial.pmf(k, n, p_first) * p_too_few
        return probability

    def crossing_probability_added_by_signal(
        self, signal: np.ndarray, threshold_ratio: float
    ) -> np.ndarray:
        """Compute the probability that signal makes a bin cross where noise alone does not.

        Parameters
        ----------
        signal
            (m,): |X| without noise over the noise per quadrature of one record.
        threshold_ratio
            Threshold over the noise per quadrature of one record.

        Returns
        -------
        numpy.ndarray
            (m,): increase of the crossing probability by the signal, over the probability that
            noise alone does not cross. It is interpolated in a table, with a relative error of up
            to 1e-4.
        """
        log_signals, log_added = _added_crossing_table(self, float(threshold_ratio))
        with np.errstate(divide="ignore"):
            log_signal = np.log(np.asarray(signal, float))
        log_probability = np.interp(log_signal, log_signals, log_added, left=-np.inf)
        log_signal_min, log_added_min = log_signals[0], log_added[0]
        is_below_table = log_signal < log_signal_min  # proportional to the square of the signal
        return np.exp(
            np.where(
                is_below_table, log_added_min + 2 * (log_signal - log_signal_min), log_probability
            )
        )

    def negligible_signal_ratio(
        self, *, leakage_probability: np.ndarray, threshold_ratio: np.ndarray, n_bins: int
    ) -> np.ndarray:
        """Return the signal amplitude below which bins may count as noise alone.

        Parameters
        ----------
        leakage_probability : ndarray (n,)
            Tolerated error of the probability of a false peak due to leaked signal, summed over all
            bins that count as noise alone.
        threshold_ratio : ndarray (n,)
            Threshold over sigma, the noise of a bin of one record per quadrature.
        n_bins : int
            Number of bins of the spectrum.

        Returns
        -------
        ndarray (n,)
            Amplitude over sigma.
        """
        # At small signals the added probability is proportional to the signal's power.
        added_per_signal_power = (
            np.array(
                [
                    self.crossing_probability_added_by_signal(np.array([1e-3]), b)[0]
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

    def vote_probabilities(self, p_cross: np.ndarray, p_stay: np.ndarray) -> PdAndMissArrays:
        """Return the probabilities that ``votes_needed`` or more records cross, and that fewer do.

        Records cross the threshold independently of each other.

        Parameters
        ----------
        p_cross, p_stay : ndarray (...)
            Probabilities that one record crosses and does not, 0..1. They are separate arguments to
            keep precision in both tails.

        Returns
        -------
        PdAndMissArrays
            Both probabilities, (...).

        Notes
        -----
        The number of crossings is binomial. For M votes out of N records, at least M cross with the
        probability I_p(M, N - M + 1), and fewer with I_(1 - p)(N - M + 1, M). p is ``p_cross``, and
        I is the regularised incomplete beta function.
        """
        votes_needed, misses_needed = self.votes_needed, self.number - self.votes_needed + 1
        return PdAndMissArrays(
            special.betainc(votes_needed, misses_needed, p_cross),
            special.betainc(misses_needed, votes_needed, p_stay),
        )

    def speckle_power_quadrature(
        self, look_speckle: "LookSpeckle | None", segment: int, point: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return quadrature nodes and weights for a mean over the speckle power of a shot.

        The speckle power of a shot is the mean of that of its looks. It has the mean 1 and is
        treated as a gamma variable, whose shape is the effective number of looks of independent
        speckle. Nodes and weights are two arrays (k,); weights have the sum 1.

        Parameters
        ----------
        look_speckle
            Correlation of the looks' speckle if it is partial, else None.
        segment, point
            Indices in ``look_speckle``.
        """
        gamma_shape = float(self.number if self.has_independent_speckle else 1)
        if look_speckle is not None:
            gamma_shape = float(look_speckle.n_effective_looks[segment, point])
        log_power = np.linspace(*_LOG_SPECKLE_POWER_GRID)
        log_density = gamma_shape * (log_power - np.exp(log_power))
        weights = np.exp(log_density - log_density.max())
        return np.exp(log_power), weights / weights.sum()

    def speckle_magnitude_quadrature(
        self,
        threshold_ratio: np.ndarray,
        *signals: np.ndarray,
        gamma_shape: np.ndarray | float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return quadrature nodes and weights (..., k) for a mean over the magnitude of speckle.

        Nodes are dense where the signals cross the threshold.

        Parameters
        ----------
        threshold_ratio
            (...): threshold over the noise per quadrature.
        *signals
            (...): root mean square |X| of each segment over the noise per quadrature.
        gamma_shape
            Shape of the gamma distribution of the speckle's power, of mean 1; 1 is exponential.
        """
        squared_threshold, magnitude_max = (
            np.square(threshold_ratio),
            np.full(threshold_ratio.shape, 7.0),
        )
        interval_ends = [0 * magnitude_max, magnitude_max]
        # The vote's probability changes within a fraction of one record's transition width.
        n_pieces = 2 if self.combine_kind == COMBINE_POWER else 2 + math.isqrt(self.number)
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
        node, weight = _gauss_nodes_in_intervals(np.sort(np.stack(interval_ends, axis=-1), axis=-1))
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
"""Looks of a shot with a single record of each segment."""


def coherent_amplitude_factor(
    looks: Looks, *, acceleration: np.ndarray, carrier: np.ndarray, look_period: np.ndarray
) -> np.ndarray:
    """Return the factor by which acceleration reduces the amplitude of coherently added looks.

    The factor is the amplitude of the mean over all looks, relative to the amplitude of one look.

    Parameters
    ----------
    looks
        Number of coherent looks.
    acceleration
        Radial acceleration a [m/s^2].
    carrier
        Optical frequency f [Hz].
    look_period
        Time from one look to the next [s].

    Returns
    -------
    numpy.ndarray
        |mean exp(2 pi i f a t^2 / c)|, 0..1, with the looks' times t about their middle. The phase
        of a steady velocity is corrected. A laser's phase noise reduces the amplitude further, by
        the root of :func:`sweep.model.laser_line.pure_line_power_fraction`.
    """
    look_index = np.arange(looks.n_coherent) - (looks.n_coherent - 1) / 2
    cycles_per_square_index = np.asarray(
        carrier * acceleration * np.square(look_period) / SPEED_OF_LIGHT, float
    )
    return np.abs(
        np.exp(2j * np.pi * cycles_per_square_index[..., None] * look_index**2).mean(axis=-1)
    )


def solve_threshold_ratio(
    log_pfa: np.ndarray, log_pfa_of_threshold: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the threshold (n,) at which noise is detected with a given probability pfa.

    Parameters
    ----------
    log_pfa : ndarray (n,)
        ln(pfa) <= 0.
    log_pfa_of_threshold : callable
        Decreasing function. It takes thresholds (n,) over the noise per quadrature, and returns
        ln(pfa) of each, (n,).

    Returns
    -------
    ndarray (n,)
        Threshold over the noise per quadrature, 0 .. sqrt(2 (100 - ln(pfa))).

    Notes
    -----
    The threshold is found by bisection. A single bin of one record is detected with
    ln(pfa) = -b^2 / 2 at the threshold b. With n bins ln(pfa) is larger by at most ln(n). The upper
    end of the interval is thus high enough for e^100 bins.
    """
    # n bins raise an alarm at least as often as one, and at most n times as often.
    low, high = np.zeros_like(log_pfa), np.sqrt(2 * (100.0 - log_pfa))
    for _ in range(_BISECTION_STEPS):
        middle = 0.5 * (low + high)
        is_above = log_pfa_of_threshold(middle) > log_pfa
        low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
    return 0.5 * (low + high)


def pd_and_miss_any_two_in_speckle(
    pd: np.ndarray, miss: np.ndarray, threshold_ratio: np.ndarray, correlations: np.ndarray
) -> PdAndMissArrays:
    """Return the probabilities that at least two of three segments in speckle detect, or fewer.

    Parameters
    ----------
    pd, miss
        (3, n): probabilities of detection and of a miss of each segment.
    threshold_ratio
        (n,): threshold Th over the noise per quadrature.
    correlations
        (3, n): moduli of :class:`sweep.model.detection.echo_detection.SegmentCorrelations`.

    Returns
    -------
    PdAndMissArrays
        (n,): both probabilities; nan where the probability of detection of a segment is nan.

    Notes
    -----
    The amplitude of each segment, signal plus noise, is complex Gaussian: l_i z with an amplitude z
    common to all segments, plus an independent remainder. With A_i = Th^2 over the mean power, and
    u = |z|^2 exponential, segment i is detected given u with

        P_i(u) = Q_1(l_i sqrt(2 u / (1 - l_i^2)), sqrt(2 A_i / (1 - l_i^2))),

    independently of the others. From the correlations rho of signal plus noise follows
    l_i = sqrt(rho_ij rho_ik / rho_jk), which is exact for common and for independent speckle.

    If the speckle moves between segments, one l_k may exceed 1. It is then set to 1, so that z is
    the amplitude of that segment. The other two have a remaining covariance
    kappa = rho_ij - rho_ik rho_jk, which adds to their joint probability

        kappa P_i' P_j' / 2 + kappa^2 (U_i U_j + V_i V_j) / 16,
        U = P'' + P' / r,    V = P'' - P' / r.

    Primes are derivatives of P by r = l sqrt(u), the modulus of the mean amplitude given z. The sum
    is Mehler's series to its second term, within 0.002 of the result of drawn amplitudes.
    """
    from sweep.model.detection.echo_detection import at_least_two_of_three_probability
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
    node, weight = _gauss_nodes_in_intervals(np.sort(np.stack(interval_ends, axis=-1), axis=-1))
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
        (slope_i, slope_j), (plus_i, plus_j), (minus_i, minus_j) = _marcum_q1_derivatives(
            signal[pair_points], threshold[pair_points]
        )
        square_term = (plus_i * plus_j + minus_i * minus_j) * np.square(kappa[:, None]) / 16
        pair_excess = kappa[:, None] * slope_i * slope_j / 2 + square_term
        excess[points] = pair_excess * (p_stay[k, points] - p_cross[k, points])
    probabilities = (
        at_least_two_of_three_probability(p_cross, p_stay) + excess,
        at_least_two_of_three_probability(p_stay, p_cross) - excess,
    )
    p_cross, p_stay = (
        np.clip((values * weight).sum(axis=-1), 0.0, 1.0) for values in probabilities
    )
    total = p_cross + p_stay  # 1 but for the quadrature
    # A segment that is never detected has an infinite threshold, which was clipped above.
    is_possible = np.count_nonzero(pd > 0.0, axis=0) >= 2
    p_cross, p_stay = np.where(is_possible, [p_cross / total, p_stay / total], [[0.0], [1.0]])
    return PdAndMissArrays(
        np.where(is_defined, p_cross, np.nan), np.where(is_defined, p_stay, np.nan)
    )


def _marcum_q1_derivatives(
    signal_ratio: np.ndarray, threshold_ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Q_1', Q_1'' + Q_1' / a and Q_1'' - Q_1' / a of Marcum's Q_1(a, b).

    Primes are derivatives by the signal a. The threshold is b; both are over the noise per
    quadrature.
    """
    x = np.maximum(signal_ratio * threshold_ratio, 1e-12)
    # special.ive is nan from arguments of 1e9 on.
    scaled_i0, scaled_i1 = (
        threshold_ratio * np.exp(-0.5 * np.square(signal_ratio - threshold_ratio)) * bessel(x)
        for bessel in (special.i0e, special.i1e)
    )
    second_derivative = threshold_ratio * (scaled_i0 - scaled_i1 / x) - signal_ratio * scaled_i1
    slope_over_signal = threshold_ratio * scaled_i1 / x
    return scaled_i1, second_derivative + slope_over_signal, second_derivative - slope_over_signal


def _gauss_nodes_in_intervals(interval_ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes and weights of all intervals between successive ends.

    ``interval_ends`` are (..., k) in rising order.
    """
    node, weight = np.polynomial.legendre.leggauss(_N_GAUSS_NODES)
    half_width = 0.5 * np.diff(interval_ends, axis=-1)[..., None]
    position = interval_ends[..., :-1, None] + half_width * (node + 1)
    return position.reshape(*interval_ends.shape[:-1], -1), (half_width * weight).reshape(
        *interval_ends.shape[:-1], -1
    )


@lru_cache(maxsize=4096)
def _added_crossing_table(looks: Looks, threshold_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the table that :meth:`Looks.crossing_probability_added_by_signal` interpolates.

    The table holds ln(signal), and ln of the probability that the signal makes a bin cross where
    noise alone does not.
    """
    signal = np.geomspace(1e-3 / math.sqrt(looks.number), threshold_ratio + 1.0, 300)
    noise = looks.pd_and_miss_steady(np.zeros(1), np.array([threshold_ratio]))
    p_cross = looks.pd_and_miss_steady(signal, np.full(signal.shape, threshold_ratio)).pd
    added = np.maximum(p_cross - noise.pd, 1e-300) / np.maximum(noise.miss, 1e-300)
    return np.log(signal), np.log(added)
