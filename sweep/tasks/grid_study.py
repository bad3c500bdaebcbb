"""A study over a grid of parameters: what its store holds and which block writes what."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.tasks.calling import EFFECTS, ERROR, Calling, layouts
from sweep.tasks.earlier import Earlier
from sweep.tasks.evaluate import batch_sizes, compile_kernels, evaluate_block
from sweep.tasks.grid import NO_COUNT, Grid
from sweep.tasks.study import ArrayLayout, Known, Results, Stop

if TYPE_CHECKING:
    from sweep.model.outputs import Output
    from sweep.spec import Axis, Member, Spec

#: Dimension of the batches of draws.
BATCH = "batch"


def outputs_of(spec: Spec) -> dict[str, Output]:
    """What the model yields for each point of a study, by name."""
    from sweep.model.outputs import (
        ACCURACY_OUTPUTS,
        DRAW_OUTPUTS,
        ERROR_OUTPUTS,
        OUTPUTS,
        RUNNING_OUTPUTS,
        SPECTRA_OUTPUTS,
    )

    if not spec.draws.any:
        return dict(OUTPUTS)
    drawn = ACCURACY_OUTPUTS | DRAW_OUTPUTS
    if spec.draws.whole_spectra:
        return SPECTRA_OUTPUTS | drawn
    return OUTPUTS | ERROR_OUTPUTS | drawn | (RUNNING_OUTPUTS if spec.has_random_effects else {})


def output_names(spec: Spec) -> list[str]:
    """Names of the arrays that blocks write, sorted."""
    return sorted([*outputs_of(spec), EFFECTS, ERROR])


def further_dims(spec: Spec) -> dict[str, tuple[str, int]]:
    """Outputs that have a dimension besides the axes, with its name and size."""
    from sweep.model.outputs import DRAW_OUTPUTS, RUNNING
    from sweep.model.realisations import RUNNING_COLUMNS

    batches = (BATCH, len(batch_sizes(spec)))
    found = {} if spec.draws.adaptive else dict.fromkeys(DRAW_OUTPUTS, batches)
    return found | {RUNNING: ("sum", RUNNING_COLUMNS)}


class GridStudy:
    """A study over a grid of parameters.

    Parameters
    ----------
    spec
        The study.
    look_up
        Finds where some of its results are already; asked as the first block is computed.
    """

    unit = "points"

    def __init__(
        self, spec: Spec, look_up: Callable[[GridStudy], Earlier[Known] | None] | None = None
    ) -> None:
        self.spec = spec
        self._look_up = look_up
        self.grid = Grid(spec)
        self.calling = Calling(spec, self.grid)
        self._names, self._further = output_names(spec), further_dims(spec)

    @cached_property
    def earlier(self) -> Earlier[Known] | None:
        """Where some of its results are already, if anywhere."""
        return self._look_up(self) if self._look_up else None

    @property
    def id(self) -> str:
        """Hash of the spec's identity."""
        return self.spec.id

    @property
    def points(self) -> int:
        """Number of points of the whole grid."""
        return self.grid.points

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return self.grid.n_blocks

    def block_size(self, block: int) -> int:
        """Points of a block."""
        return self.grid.block_size(block)

    def points_in(self, blocks: np.ndarray) -> int:
        """Points in the blocks that are marked in an ndarray of bool (blocks,)."""
        return self.grid.points_in(blocks)

    def attributes(self) -> dict[str, Any]:
        """Title, question, spec and the blocks' shape."""
        coordinates = [member.name for axis in self.spec.axes for member in axis.members]
        coordinates += ["batch_draws"] if batch_sizes(self.spec) else []
        return {
            "kind": "grid",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "block_shape": list(self.grid.block_shape),
            # xarray's way to tell coordinates that share a dimension from variables
            "coordinates": " ".join(coordinates),
        }

    def groups(self) -> dict[str, dict[str, Any]]:
        """None."""
        return {}

    def arrays(self) -> list[ArrayLayout]:
        """Coordinates, the sizes of batches, and an array for each output."""
        arrays = coordinates(self.spec.axes)
        if sizes := batch_sizes(self.spec):
            arrays.append(_batches(np.array(sizes, dtype=np.int64)))
        arrays += layouts(self.grid.shape, self.grid.block_shape, self.grid.dims)
        return arrays + [self._output(n) for n in self._names if n not in (EFFECTS, ERROR)]

    def _output(self, name: str) -> ArrayLayout:
        from sweep.model.outputs import ACCURACY_OUTPUTS

        output = outputs_of(self.spec)[name]
        further, whole = self._further.get(name), output.dtype == "int64"
        promise = self._promise() if name in ACCURACY_OUTPUTS and not whole else {}
        return ArrayLayout(
            name=name,
            shape=self.grid.shape + ((further[1],) if further else ()),
            chunks=self.grid.block_shape + ((further[1],) if further else ()),
            dims=self.grid.dims + ((further[0],) if further else ()),
            dtype=output.dtype,
            fill=NO_COUNT if whole else float("nan"),
            attributes=described(output.units, output.long_name, output.comment) | promise,
        )

    def _promise(self) -> dict[str, float]:
        """Tolerance and confidence that half-widths are held against, but for those on axes."""
        promised = {f"accuracy.{name}": name for name in ("tolerance", "confidence")}
        off_axes = self.spec.parameters_off_axes()
        return {n: float(off_axes[path]) for path, n in promised.items() if path in off_axes}

    def chunks(self, block: int) -> dict[str, tuple[int, ...]]:
        """The block's chunk of every output."""
        position = self.grid.position(block)
        return {name: position + ((0,) if name in self._further else ()) for name in self._names}

    def owners(self) -> dict[str, np.ndarray]:
        """The blocks as they lie along the axes, for every output."""
        blocks = np.arange(self.n_blocks).reshape(self.grid.blocks_along)
        return {
            name: blocks[..., None] if name in self._further else blocks for name in self._names
        }

    def evaluate(
        self,
        block: int,
        begun: Known = Known(),  # noqa: B008
        stop: Stop | None = None,
    ) -> Results:
        """Outputs of a block; `begun` and `stop` are those of :func:`evaluate_block`."""
        called = self.calling.of_block(block)
        known = self.earlier.known(block, called) if self.earlier else Known()
        results = evaluate_block(self.spec, self.grid, block, called, known, begun, stop)
        for layout in map(self._output, set(self._names) - set(results)):
            # all of its points are beyond the model
            room = self.grid.extent(block) + layout.shape[len(self.grid.shape) :]
            results[layout.name] = np.full(room, layout.fill, layout.dtype)
        return results

    def compile(self) -> None:
        """Compile the model's kernels."""
        compile_kernels(self.spec, self.grid)


def coordinates(axes: tuple[Axis, ...]) -> list[ArrayLayout]:
    """Arrays of the values along axes, in the units that they were written in."""
    return [_coordinate(axis, member) for axis in axes for member in axis.members]


def _coordinate(axis: Axis, member: Member) -> ArrayLayout:
    values = np.asarray(member.display)
    text = values.dtype.kind in "UOT"
    long_name = member.name.replace("_", " ")
    return ArrayLayout(
        name=member.name,
        shape=values.shape,
        chunks=values.shape,
        dims=(axis.name,),
        dtype="string" if text else str(values.dtype),
        attributes={**described(member.units, long_name, ""), "path": member.path},
        values=values.astype(object) if text else values,
    )


def described(units: str, long_name: str, comment: str) -> dict[str, str]:
    """Attributes that say what an array holds."""
    attributes = {"units": units, "long_name": long_name}
    return attributes | ({"comment": comment} if comment else {})


def _batches(sizes: np.ndarray) -> ArrayLayout:
    return ArrayLayout(
        name="batch_draws",
        shape=sizes.shape,
        chunks=sizes.shape,
        dims=(BATCH,),
        dtype="int64",
        attributes=described("1", "draws in the batch", ""),
        values=sizes,
    )
