"""The physics of FMCW Doppler lidar: arrays in, arrays out; SI and radians throughout."""

VERSION = "2"
"""Version of the physics: part of a study's identity, raised when any result can change."""
