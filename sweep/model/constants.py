"""Physical constants [SI, exact by definition] that more than one module needs."""

from scipy.constants import c as SPEED_OF_LIGHT
from scipy.constants import e as ELEMENTARY_CHARGE
from scipy.constants import h as PLANCK
from scipy.constants import k as BOLTZMANN

__all__ = ["BOLTZMANN", "ELEMENTARY_CHARGE", "PLANCK", "SPEED_OF_LIGHT"]
