"""Receiver transfer: detector, transimpedance amplifier and further stages as one H(f)."""

import numpy as np


def transfer(
    frequency: np.ndarray,
    *,
    detector_bandwidth: np.ndarray,
    amplifier_bandwidth: np.ndarray,
    transimpedance: np.ndarray,
) -> np.ndarray:
    """Complex transfer from photocurrent to ADC voltage [ohm] at a signed frequency [Hz].

    Two single-pole low-passes, each 3 dB down at its stated bandwidth, and the transimpedance.
    Lines are taken at the frequency they have before the ADC folds them.
    """
    poles = (1 + 1j * frequency / detector_bandwidth) * (1 + 1j * frequency / amplifier_bandwidth)
    return transimpedance / poles


def electrical_bandwidth(
    *, detector_bandwidth: np.ndarray, amplifier_bandwidth: np.ndarray
) -> np.ndarray:
    """Bandwidth B_e [Hz] over which noise is counted: the narrower of the two stages.

    [T] states one figure for both and uses it as the noise bandwidth; so does this.
    """
    return np.minimum(detector_bandwidth, amplifier_bandwidth)
