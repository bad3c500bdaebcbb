"""Joint tail probability of two correlated standard normal numbers [Owen, 1956].

Two neighbouring bins are taken to cross the threshold jointly as often as two such numbers, each
with the crossing probability of its bin (:func:`sweep.model.detection.echo_detection.pd_and_miss`).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit

_JOINT_TAIL_NODES, _JOINT_TAIL_WEIGHTS = np.polynomial.legendre.leggauss(4)


class JointTailQuadrature(NamedTuple):
    """Quadrature of the joint tail of two correlated standard normal numbers.

    Notes
    -----
    Two numbers S and T of the correlation rho exceed s and t with the probability P(S > s) P(T > t)
    plus [1]_

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du.

    References
    ----------
    .. [1] D. B. Owen, "Tables for computing bivariate normal probabilities," Ann. Math. Statist.
       27, 1956.
    """

    sine: np.ndarray
    """(k,): sin u at the quadrature nodes u in 0 .. asin(rho), with the correlation rho. k is 12,
    or 0 for independent numbers."""
    weight: np.ndarray
    """(k,): quadrature weights of the nodes u, divided by 2 pi."""
    exponent_factor: np.ndarray
    """(k,): factor 1 / (2 cos^2 u) of the integrand's exponent at the nodes u."""


@lru_cache(maxsize=64)
def joint_tail_quadrature(correlation: float) -> JointTailQuadrature:
    """Return the quadrature for two numbers with a given correlation, 0..1 (cached)."""
    if correlation == 0.0:
        return JointTailQuadrature(np.empty(0), np.empty(0), np.empty(0))
    node, weight = np.polynomial.legendre.leggauss(12)
    half_angle = 0.5 * math.asin(correlation)
    sine = np.sin(half_angle * (node + 1))
    return JointTailQuadrature(sine, half_angle * weight / (2 * math.pi), 0.5 / (1 - sine**2))


@njit(cache=True, error_model="numpy", borrows=True)
def joint_tail_excess(quantile, previous_quantile, quadrature):
    """Return P(S > s, T > t) - P(S > s) P(T > t) of correlated standard normal numbers S and T.

    Parameters
    ----------
    quantile, previous_quantile : float
        Limits s and t.
    quadrature : JointTailQuadrature
        Quadrature for the correlation of S and T.
    """
    excess = 0.0
    for k in range(quadrature.sine.size):
        quadratic_form = (
            quantile * quantile
            + previous_quantile * previous_quantile
            - 2.0 * quantile * previous_quantile * quadrature.sine[k]
        )
        excess += quadrature.weight[k] * math.exp(-quadratic_form * quadrature.exponent_factor[k])
    return excess


@njit(cache=True, error_model="numpy", borrows=True)
def joint_tail_excess_by_four_nodes(quantile, previous_quantile, correlation):
    """Return P(S > s, T > t) - P(S > s) P(T > t) with 4 quadrature nodes, for any correlation.

    The result is less precise than that of :func:`joint_tail_excess`, which has 12 nodes, and needs
    no :class:`JointTailQuadrature`.

    Parameters
    ----------
    quantile, previous_quantile : float
        Limits s and t.
    correlation : float
        Correlation coefficient of the standard normal numbers S and T.
    """
    excess, half_angle = 0.0, 0.5 * math.asin(correlation)
    for j in range(_JOINT_TAIL_NODES.size):
        sine = math.sin(half_angle * (_JOINT_TAIL_NODES[j] + 1.0))
        quadratic_form = (
            quantile * quantile
            + previous_quantile * previous_quantile
            - 2.0 * quantile * previous_quantile * sine
        )
        excess += _JOINT_TAIL_WEIGHTS[j] * math.exp(-quadratic_form / (2.0 * (1.0 - sine * sine)))
    return excess * (half_angle / (2.0 * math.pi))
