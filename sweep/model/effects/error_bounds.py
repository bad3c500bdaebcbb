"""Records of bounds: of the change of results if an effect is left out, and of phase errors."""

from typing import NamedTuple

import numpy as np

ArrayOrFloat = np.ndarray | float


class ErrorBound(NamedTuple):
    """Upper bound on the change of results at each of n points if an effect is omitted.

    The fields bound changes of different quantities. Values are scalars, (n,), or (segments, n).
    """

    magnitude_change: ArrayOrFloat = 0.0
    """Relative change of |X| in the largest bin, if the effect is omitted. 1 or more means that
    nothing is known of |X|."""
    coherent_sum_change: ArrayOrFloat = 0.0
    """Change of |X| in the largest bin in addition to ``magnitude_change``. The unit is the sum of
    all amplitudes in phase. This field bounds sums of amplitudes that may cancel, because their
    relative change has no bound."""
    noise_variance_change: ArrayOrFloat = 0.0
    """Relative change of a bin's noise variance if the effect is omitted."""
    threshold_follows_noise: bool = True
    """True if the threshold is set on noise that includes the noise of this effect, which is then
    always present. False for noise that comes with the signal."""
    shift_bins: ArrayOrFloat = 0.0
    """Shift of measured frequencies [FFT bins] if the effect is omitted. One bin counts as much as
    a change of a probability by 1."""
    log10_pfa_change: ArrayOrFloat = 0.0
    """Change of log10 of a shot's false-alarm probability if the effect is omitted. Bins that the
    effect moves across the threshold cause this change."""
    leaking_bin_change_sigma: ArrayOrFloat = 0.0
    """Change of |X| that only bins with leaked signal (from sidelobes) have, in units of the noise
    per quadrature. The change that these bins share with the largest bin is not included."""
    probability_change: ArrayOrFloat = 0.0
    """Change of a probability (of detection or false alarm) if the effect is omitted, 0..1. Values
    by segment are summed."""
    residual_magnitude_change: ArrayOrFloat = 0.0
    """Relative error of |X| in the largest bin that remains although the effect is simulated."""
    residual_coherent_sum_change: ArrayOrFloat = 0.0
    """Error of |X| in the largest bin that remains although the effect is simulated. The unit is
    the |X| of the line on the beam's axis, if that line lay on a bin. The smaller of this error and
    ``residual_magnitude_change`` counts."""


class PhaseErrorBound(NamedTuple):
    """Upper bound on the phase error that an effect adds to lines over the record.

    The bound has a polynomial in the position x in the record, -1..1, a remainder, and a shift of
    frequencies. Values are by segment, or scalars.
    """

    coefficients: tuple[np.ndarray | float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Largest magnitudes of the phase's coefficients of x, x^2, x^3, x^4 [cycles]. x is the
    position in the record, -1..1."""
    non_polynomial_phase: np.ndarray | float = 0.0
    """Largest magnitude [cycles] of the part of the phase error beyond the polynomial of
    ``coefficients``."""
    mid_record_phase: np.ndarray | float = 0.0
    """Largest magnitude of the phase error in the record's middle [cycles]. Only lines near their
    images are affected by this phase."""
    extra_shift_window_bins: np.ndarray | float = 0.0
    """Shift of a line's light in frequency that is not due to the slopes of the polynomial.
    The unit is the sample rate over the number of samples in the record."""

    @property
    def shift_window_bins(self) -> np.ndarray | float:
        """Largest shift of a line's light in frequency by the phase error.

        The unit is the sample rate over the number of samples in the record.
        """
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
"""Phase-error bound of effects without a phase error: all fields are 0."""


def magnitude_change_from_power(power_change: np.ndarray) -> np.ndarray:
    """Return the relative decrease of a magnitude, given the relative decrease of its square.

    An equal relative increase of the square changes the magnitude by less.
    """
    return np.asarray(1 - np.sqrt(1 - np.minimum(power_change, 1.0)))
