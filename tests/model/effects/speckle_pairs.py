"""Speckle in two bins at once, in closed form."""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.marcum import marcum_q1


def joint_detection(
    *,
    powers: tuple[ArrayLike, ArrayLike],
    covariance: ArrayLike,
    bin_deviation: ArrayLike,
    threshold: ArrayLike,
) -> np.ndarray:
    """Mean chance that two given bins of different segments both cross, all signal diffuse, 0..1.

    Both are circular complex normal with the total powers T_1, T_2 (signal and noise), their
    noises independent. With u_i = Th^2 / T_i, r^2 = |covariance|^2 / (T_1 T_2), s = 1 - r^2,
    the bivariate Rayleigh distribution [Simon and Alouini, Digital Communication over Fading
    Channels, 6.1] gives

        e^{-u_1} [1 - Q_1(sqrt(2 u_2/s), r sqrt(2 u_1/s))] + e^{-u_2} Q_1(r sqrt(2 u_2/s),
        sqrt(2 u_1/s))

    Parameters
    ----------
    powers : (array_like, array_like)
        Mean |X|^2 of the diffuse signal in each bin.
    covariance : array_like
        |E X_1 X_2*| of the signals.
    bin_deviation, threshold : array_like
        sigma and Th, the same in both.
    """
    noise = 2 * np.asarray(bin_deviation, float) ** 2
    first, second = (np.asarray(power, float) + noise for power in powers)
    square = np.asarray(threshold, float) ** 2
    u, v = square / first, square / second
    r2 = np.abs(covariance) ** 2 / (first * second)
    far_u, far_v, r = np.sqrt(2 * u / (1 - r2)), np.sqrt(2 * v / (1 - r2)), np.sqrt(r2)
    return np.asarray(
        np.exp(-u) * marcum_q1(far_v, r * far_u).p + np.exp(-v) * marcum_q1(r * far_v, far_u).q
    )
