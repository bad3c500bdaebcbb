"""Layouts of the model's output arrays, with attributes by the CF conventions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sweep.tasks.engine.blocks import ArrayLayout, BlockGrid

if TYPE_CHECKING:
    from sweep.model.outputs import OutputVariable

_CLOSING_VELOCITY_NAME = "radial_velocity_of_scatterers_toward_instrument"
CF_STANDARD_NAMES = {
    "altitude": "height",
    "true_altitude": "height",
    "beam_radial_velocity": _CLOSING_VELOCITY_NAME,
    "radial_velocity": _CLOSING_VELOCITY_NAME,
    "radial_velocity_interpolated": _CLOSING_VELOCITY_NAME,
    "true_radial_velocity": _CLOSING_VELOCITY_NAME,
    "sun_elevation": "solar_elevation_angle",
    "wavelength": "radiation_wavelength",
}
"""Standard names of the Climate and Forecast (CF) conventions, for arrays and coordinates.

They are from version 90 of the table of standard names.
"""


def cf_attributes(units: str, long_name: str, comment: str = "", name: str = "") -> dict[str, Any]:
    """Return the non-empty attributes of an array or coordinate by the CF conventions."""
    attributes = {"units": units, "long_name": long_name}
    optional = {"comment": comment, "standard_name": CF_STANDARD_NAMES.get(name, "")}
    return attributes | {key: value for key, value in optional.items() if value}


def make_output_layout(
    grid: BlockGrid,
    name: str,
    output: OutputVariable,
    dims: tuple[str, ...],
    sizes: Mapping[str, int],
    attributes: Mapping[str, Any] | None = None,
) -> ArrayLayout:
    """Return the layout of an output of the model, cut into chunks by a grid of blocks.

    `sizes` has the sizes of the dimensions that do not follow the grid. `attributes` are added to
    those of the CF conventions.
    """
    all_attributes = cf_attributes(output.units, output.long_name, output.comment, name)
    all_attributes |= attributes or {}
    return grid.make_output_layout(name, output.dtype, dims, sizes, all_attributes)
