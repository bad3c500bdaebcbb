"""The physics of FMCW Doppler lidar: arrays in, arrays out; SI and radians throughout.

Compiled code takes no liberties with the order of sums (no reassociation, no contraction). The
number of optimisation passes depends on what was compiled before and what came from a cache; with
liberties, so would its last bits. They would buy 5 % of speed.
"""

VERSION = "45"
"""Version of the physics: part of a study's identity, raised when any result can change."""
