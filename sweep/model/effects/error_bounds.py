"""Bounds of the change of outputs if an effect is left out, and of its phase errors."""

from typing import NamedTuple

import numpy as np

ArrayOrFloat = np.ndarray | float


class ErrorBound(NamedTuple):
    """Upper bound on the output change at each point if an effect is omitted.

    Values are scalars, (n,), or (segments, n).
    """

    magnitude_change: ArrayOrFloat = 0.0
    """Relative change of the largest bin's magnitude; 1 or more means no knowledge of it."""
    coherent_sum_change: ArrayOrFloat = 0.0
    """Additional absolute change of the largest bin's magnitude, as a fraction of the sum of all
    amplitudes in phase. Sums that may cancel have no relative change."""
    noise_variance_change: ArrayOrFloat = 0.0
    """Relative change of a bin's noise variance."""
    threshold_follows_noise: bool = True
    """True if the threshold is set on the changed noise, as for noise that is always present; False
    for noise that comes with the signal."""
    shift_bins: ArrayOrFloat = 0.0
    """Shift of measured frequencies [bins]; it counts like a change of a probability."""
    log10_pfa_change: ArrayOrFloat = 0.0
    """Change of log10 of a shot's probability of a false alarm, due to bins that cross the
    threshold."""
    leaking_bin_change_sigma: ArrayOrFloat = 0.0
    """Change of bins with leaked signal [sigma], in addition to their share of the largest bin's
    change."""
    probability_change: ArrayOrFloat = 0.0
    """Change of a probability itself, summed over the segments if there is one for each."""
    residual_magnitude_change: ArrayOrFloat = 0.0
    """Relative change of the largest bin's magnitude that remains when the effect is simulated."""
    residual_coherent_sum_change: ArrayOrFloat = 0.0
    """Residual change as a fraction of the sum of all amplitudes in phase; the smaller of the two
    residuals counts."""


class PhaseErrorBound(NamedTuple):
    """Bound of an effect's change of lines over the record: a phase, or a shift of positions.

    Values are by segment, or scalars. Coefficients are those of powers of the position x in the
    record, -1..1, in cycles.
    """

    coefficients: tuple[np.ndarray | float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Magnitudes of the coefficients of x, x^2, x^3, x^4 [cycles]."""
    non_polynomial: np.ndarray | float = 0.0
    """Largest magnitude of the phase that is no polynomial [cycles]."""
    constant: np.ndarray | float = 0.0
    """Magnitude of the phase in the record's middle [cycles], which matters to lines near their
    images."""
    extra_shift_window_bins: np.ndarray | float = 0.0
    """Shift of light in addition to the slopes of the polynomial [bins of fs/L]."""

    @property
    def shift_window_bins(self) -> np.ndarray | float:
        """Largest shift of light [bins of fs/L]."""
        slope_window_bins = sum(2 * (k + 1) * value for k, value in enumerate(self.coefficients))
        return slope_window_bins + self.extra_shift_window_bins

    def plus(self, other: "PhaseErrorBound") -> "PhaseErrorBound":
        """Return the bound for the sum of two phase errors."""
        coefficients = tuple(
            a + b for a, b in zip(self.coefficients, other.coefficients, strict=True)
        )
        return PhaseErrorBound(
            coefficients, *(a + b for a, b in zip(self[1:], other[1:], strict=True))
        )


NO_PHASE_ERROR = PhaseErrorBound()
"""Bound of no phase error."""


def magnitude_change_from_power(power_change: np.ndarray) -> np.ndarray:
    """Return the relative decrease of a magnitude for one of its power, larger than an increase."""
    return np.asarray(1 - np.sqrt(1 - np.minimum(power_change, 1.0)))
