"""The sections of a scene study: the scene, draws, navigation, storage."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

import sweep.spec.quantities as of
from sweep.spec.instrument import Part
from sweep.spec.objects import AnyObject
from sweep.spec.rules import Choice, Numeric

WORLD = "world"
"""The origin of a scene whose coordinates are as they are."""

METHODS = ("probabilities", "noise")


class Scene(Part):
    """What the instrument flies over."""

    origin: Annotated[
        str, of.name("Ground whose middle is the zero of all positions, or 'world'")
    ] = WORLD  # fmt: skip
    objects: dict[str, AnyObject] = Field(description="What there is, by name")
    solar_irradiance: Annotated[
        float,
        Numeric(
            about="Spectral irradiance of sunlight on the scene",
            si_unit="W/m^3",
            example="0.5 W/m^2/nm",
            at_least="0 W/m^3",
            at_most="1e18 W/m^3",
        ),
    ] = 0.0


class SceneDraws(Part):
    """Random realisations of the flight's radiometry."""

    number: Annotated[int, of.count("Draws", "1000", at_most="1e9")] = 1
    method: Annotated[
        str,
        Choice(about="Draw against the probabilities, or add noise to the bins", options=METHODS),
    ] = "probabilities"
    returns: Annotated[int, of.count("Points kept of a shot at most", "4", at_most="64")] = 4


class Navigation(Part):
    """Velocity and altitude from each measurement cycle."""

    test_level: Annotated[
        float,
        of.number(
            "Chance that a test for faulty beams rejects a good cycle; 0 leaves it out",
            "0.001",
            at_least="0",
            at_most="0.5",
        ),
    ] = 0.0
    ground_slope: Annotated[
        float,
        of.number(
            "Standard deviation of the ground's slope, as far as it is known beforehand; 10 leaves "
            "the slope to the points, 0 says that the ground is level",
            "0.1",
            at_least="0",
            at_most="10",
        ),
    ] = 10.0
    relief: Annotated[
        float, of.length("Standard deviation of the ground's height", "1 m", at_least="0 m")
    ] = 0.0


class SceneStorage(Part):
    """How results are cut up in the store; part of a study's identity."""

    block_shots: Annotated[int, of.count("Shots that one block holds at most", "4096")] = 4096
    block_draws: Annotated[int, of.count("Draws that one block holds at most", "64")] = 64
