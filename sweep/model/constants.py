"""Physical constants that more than one module needs, exact by definition of the SI since 2019."""

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s]"""
ELEMENTARY_CHARGE = 1.602176634e-19
"""[C]"""
PLANCK = 6.62607015e-34
"""[J s]"""
BOLTZMANN = 1.380649e-23
"""[J/K]"""
