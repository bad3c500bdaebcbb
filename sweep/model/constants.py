"""Physical constants shared by several modules, exact by definition of the SI since 2019."""

SPEED_OF_LIGHT = 299_792_458.0
"""Speed of light in vacuum c [m/s]."""
ELEMENTARY_CHARGE = 1.602176634e-19
"""Charge of the electron, as a magnitude, q [C]."""
PLANCK = 6.62607015e-34
"""Planck constant h [J s]."""
BOLTZMANN = 1.380649e-23
"""Boltzmann constant k [J/K]."""
