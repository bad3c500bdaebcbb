"""An ADC, sample by sample."""

import numpy as np


def truth_quantise(voltage: np.ndarray, *, full_scale: float, bits: int) -> np.ndarray:
    """Record as the ADC gives it: 2^bits levels, each in the middle of its step, the ends held."""
    lsb = 2 * full_scale / 2**bits
    code = np.clip(np.floor(voltage / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return (code + 0.5) * lsb
