"""What a detector and an estimator are told besides the spectra that they look at."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sweep.model.window import Window, samples


@lru_cache(maxsize=8)
def taper(window: Window) -> np.ndarray:
    """Samples (L,) of a window, made once; not to be written to."""
    values = samples(window.name, window.length)
    values.flags.writeable = False
    return values


@lru_cache(maxsize=8)
def main_lobe(window: Window) -> float:
    """Distance [bins of fs/L] of the first minimum of |W|, to 1/8 bin."""
    magnitude = np.abs(np.fft.rfft(taper(window), 8 * window.length))
    return float(np.argmax(np.diff(magnitude) > 0)) / 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Setting:
    """How spectra were made, and how they are to be looked at."""

    fft_size: int
    """Points N of the FFT; spectra have the bins 0..N/2."""
    sample_rate: float
    """[Hz]; a bin is ``sample_rate / fft_size`` wide."""
    window: Window
    """Its ``length`` L <= N is that of the record, which is padded with zeros to N."""
    noise_power: float
    """Mean |X|^2 of a bin of noise alone, by the receiver's noise budget [V^2]."""
    threshold: float
    """Fixed threshold on |X| [V]."""
    training: int
    """Training cells, half of them on either side; even."""
    guard: int
    """Guard cells on either side."""
    rank: int
    """Rank of the ordered statistic among the training cells, 1 for the least."""
    pfa: float
    """Design probability of a false alarm in a bin of noise alone."""

    @property
    def taper(self) -> np.ndarray:
        """Samples (L,) of the window."""
        return taper(self.window)
