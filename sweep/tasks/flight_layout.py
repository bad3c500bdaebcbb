"""The arrays of a flight's store, scanner by scanner: how they are cut, which block writes what."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects.catalogue import flag_attributes
from sweep.model.outputs import (
    CYCLES,
    NAVIGATION,
    POINTS,
    SHOTS,
    SIMULATED,
    STATISTICS,
    Output,
)
from sweep.tasks.calling import EFFECTS
from sweep.tasks.eyepoint_study import SIZES, scene_array
from sweep.tasks.stretches import Part, Stretches
from sweep.tasks.study import ArrayLayout

if TYPE_CHECKING:
    from sweep.spec import SceneSpec


def arrays(spec: SceneSpec, stretches: Stretches) -> list[ArrayLayout]:
    """Every output of a scanner."""
    return [_array(spec, stretches, name) for name in _outputs(stretches)]


def chunks(stretches: Stretches, part: Part) -> dict[str, tuple[int, ...]]:
    """Chunks of a block: what has no draws goes with the first, and so does the geometry."""
    stretch = {"shot": part.cycles, "cycle": part.cycles, "draw": part.draws}
    return {
        f"{part.scanner}/{name}": (
            *(part.axes if is_radiometric(name) else ()),
            *(stretch.get(dim, 0) for dim in output.dims),
        )
        for name, output in _outputs(stretches).items()
        if belongs(name, part)
    }


def owners(stretches: Stretches, first: int) -> dict[str, np.ndarray]:
    """The blocks of a scanner, numbered from `first`, in the shape of every array's chunks."""
    blocks = first + np.arange(stretches.number).reshape(stretches.along)
    found = {}
    for name, output in _outputs(stretches).items():
        own = blocks if is_radiometric(name) else blocks[(0,) * len(stretches.axes)]
        found[f"{stretches.scanner}/{name}"] = _along(own, output.dims)
    return found


def is_radiometric(name: str) -> bool:
    """Whether an array has a study's axes before its own dimensions."""
    return name not in SHOTS and name not in CYCLES


def belongs(name: str, part: Part) -> bool:
    """Whether an array has a chunk that is this block's to write."""
    if name in POINTS or name in NAVIGATION:
        return True
    once = name in STATISTICS or name in SIMULATED
    return part.draws == 0 and (once or not any(part.axes))


def _outputs(stretches: Stretches) -> dict[str, Output]:
    own = SHOTS | CYCLES | STATISTICS | SIMULATED | POINTS
    return own | (NAVIGATION if stretches.navigates else {})


def _array(spec: SceneSpec, stretches: Stretches, name: str) -> ArrayLayout:
    output = _outputs(stretches)[name]
    axes = tuple(axis.name for axis in spec.axes) if is_radiometric(name) else ()
    sizes = SIZES | {
        "shot": stretches.total_cycles * stretches.shots_a_cycle,
        "cycle": stretches.total_cycles,
        "draw": stretches.draws,
        "return_number": int(spec.draws.returns),
    }
    cut = sizes | {
        "shot": stretches.block_cycles * stretches.shots_a_cycle,
        "cycle": stretches.block_cycles,
        "draw": stretches.block_draws,
    }
    layout = scene_array(
        name,
        output,
        (*stretches.axes[: len(axes)], *(sizes[dim] for dim in output.dims)),
        (*(1 for _ in axes), *(cut[dim] for dim in output.dims)),
        axes=axes,
    )
    return replace(layout, attributes=flag_attributes()) if name == EFFECTS else layout


def _along(blocks: np.ndarray, dims: tuple[str, ...]) -> np.ndarray:
    """Blocks (..., draws, cycles) along the dimensions of an array; those of the first draws where
    it has none.
    """
    rank = blocks.ndim - 2
    if "draw" not in dims:
        blocks = blocks[..., 0, :]
    elif dims.index("draw") > 0:
        blocks = np.swapaxes(blocks, -1, -2)
    cut = [dim in ("shot", "cycle", "draw") for dim in dims]
    shape = iter(blocks.shape[rank:])
    return blocks.reshape(*blocks.shape[:rank], *(next(shape) if is_cut else 1 for is_cut in cut))
