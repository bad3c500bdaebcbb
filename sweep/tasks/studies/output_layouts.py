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
"""CF standard names, by the name of the array or coordinate.

CF are the Climate and Forecast conventions; the names are from version 90 of their table.
"""


def cf_attributes(units: str, long_name: str, comment: str = "", name: str = "") -> dict[str, Any]:
    """Return the attributes of an array or coordinate by the Climate and Forecast (CF) conventions.

    Empty attributes are left out. `name` is the name of the array, which may have a standard name.
    """
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
    """Return the layout of the array of an output variable, with one chunk per block of a grid.

    `sizes` maps dimensions that do not follow the grid to their sizes. `attributes` are added to
    those of the CF conventions.
    """
    all_attributes = cf_attributes(output.units, output.long_name, output.comment, name)
    all_attributes |= attributes or {}
    return grid.make_output_layout(name, output.dtype, dims, sizes, all_attributes)
