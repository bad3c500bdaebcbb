"""Joint tail probability of two correlated standard normal numbers [Owen, 1956].

The joint probability that two neighbouring bins cross the threshold is taken to be that of such
numbers with the same probabilities (:func:`sweep.model.detection.echo_detection.pd_and_miss`).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit

_JOINT_TAIL_NODES, _JOINT_TAIL_WEIGHTS = np.polynomial.legendre.leggauss(4)


class JointTailRule(NamedTuple):
    """Quadrature of the joint tail of two correlated standard normal numbers.

    Notes
    -----
    Two numbers of the correlation rho exceed s and t with the product of the two probabilities plus
    [1]_

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du.

    References
    ----------
    .. [1] D. B. Owen, "Tables for computing bivariate normal probabilities," Ann. Math. Statist.
       27, 1956.
    """

    sine: np.ndarray
    """(k,): sin u at the nodes u in 0 .. asin(rho); k is 12, or 0 for independent numbers."""
    weight: np.ndarray
    """(k,): weights of the nodes, over 2 pi."""
    exponent: np.ndarray
    """(k,): 1 / (2 cos^2 u)."""


@lru_cache(maxsize=64)
def joint_tail_rule(correlation: float) -> JointTailRule:
    """Return the quadrature for two numbers with a given correlation, 0..1 (cached)."""
    if correlation == 0.0:
        return JointTailRule(np.empty(0), np.empty(0), np.empty(0))
    node, weight = np.polynomial.legendre.leggauss(12)
    half_angle = 0.5 * math.asin(correlation)
    sine = np.sin(half_angle * (node + 1))
    return JointTailRule(sine, half_angle * weight / (2 * math.pi), 0.5 / (1 - sine**2))


@njit(cache=True, error_model="numpy", borrows=True)
def joint_tail_excess(deviate, previous_deviate, joint_tail_rule):
    """Return P(S > s, T > t) - P(S > s) P(T > t) of two correlated standard normal numbers.

    ``deviate`` is s and ``previous_deviate`` t; ``joint_tail_rule`` is the
    :class:`JointTailRule` of their correlation.
    """
    excess = 0.0
    for k in range(joint_tail_rule.sine.size):
        quadratic_form = (
            deviate * deviate
            + previous_deviate * previous_deviate
            - 2.0 * deviate * previous_deviate * joint_tail_rule.sine[k]
        )
        excess += joint_tail_rule.weight[k] * math.exp(
            -quadratic_form * joint_tail_rule.exponent[k]
        )
    return excess


@njit(cache=True, error_model="numpy", borrows=True)
def joint_tail_excess_by_four_nodes(deviate, previous_deviate, correlation):
    """Compute :func:`joint_tail_excess` for any ``correlation``, by 4 nodes in place of 12."""
    excess, half_angle = 0.0, 0.5 * math.asin(correlation)
    for j in range(_JOINT_TAIL_NODES.size):
        sine = math.sin(half_angle * (_JOINT_TAIL_NODES[j] + 1.0))
        quadratic_form = (
            deviate * deviate
            + previous_deviate * previous_deviate
            - 2.0 * deviate * previous_deviate * sine
        )
        excess += _JOINT_TAIL_WEIGHTS[j] * math.exp(-quadratic_form / (2.0 * (1.0 - sine * sine)))
    return excess * (half_angle / (2.0 * math.pi))
