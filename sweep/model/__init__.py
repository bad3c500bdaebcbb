"""Physics of FMCW Doppler lidars: functions from arrays to arrays, in SI units and radians.

Compiled code keeps the order of floating-point sums: neither reassociation nor contraction is
allowed. The number of optimisation passes depends on what was compiled before and on what came from
a cache. With reassociation, the last bits of results would depend on it too, for a gain in speed of
5 %.

In docstrings [T] is D. B. Chester, *A Parameterized Simulation of Doppler Lidar*, Utah State
University, 2017. Points of one category share all settings that are words or sizes
(:func:`sweep.model.preparation.split_by_category`). Sigma is the noise of a bin per quadrature.
"""

MODEL_VERSION = "52"
"""Version of the physics model. It is part of a study's identity and is raised when any result can
change."""
