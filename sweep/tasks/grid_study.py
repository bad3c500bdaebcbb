"""A study over a grid of parameters: arrays of its store, and results of a block."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.effects.catalogue import flag_attributes, names_of
from sweep.model.resolution import by_tolerance
from sweep.model.unsupported import UnsupportedShot
from sweep.tasks.effect_selection import EFFECTS, ERROR, EffectSelection, Selected
from sweep.tasks.evaluate import (
    batch_sizes,
    evaluate_points,
    evaluated,
    no_sums,
    with_few_draws,
)
from sweep.tasks.grid import Grid
from sweep.tasks.reuse import DAMAGED, GrowingStudy
from sweep.tasks.study import (
    ArrayLayout,
    Found,
    Known,
    Results,
    Stop,
    described,
    together,
)

if TYPE_CHECKING:
    from sweep.model.outputs import Output
    from sweep.spec import Axis, Spec

#: Dimension of the batches of draws.
BATCH = "batch"


def outputs_of(spec: Spec) -> dict[str, Output]:
    """Arrays that blocks of a study write, sorted by name, with dimensions besides the axes."""
    from sweep.model.outputs import (
        ACCURACY_OUTPUTS,
        DRAW_OUTPUTS,
        ERROR_OUTPUTS,
        OUTPUTS,
        RUNNING,
        RUNNING_OUTPUTS,
        SIMULATED,
        SPECTRA_OUTPUTS,
    )

    error = replace(
        SIMULATED[ERROR],
        comment="sum over the effects left out of what each may change: of pd in all three "
        "segments, of log10 of the probability of a false alarm, or of a relative magnitude, "
        "whichever is most",
    )
    found = {EFFECTS: replace(SIMULATED[EFFECTS], dims=()), ERROR: replace(error, dims=())}
    drawn = ACCURACY_OUTPUTS | DRAW_OUTPUTS
    if not spec.draws.any:
        found |= OUTPUTS
    elif spec.draws.whole_spectra:
        found |= SPECTRA_OUTPUTS | drawn
    else:
        sums = RUNNING_OUTPUTS if spec.has_random_effects else {}
        found |= OUTPUTS | ERROR_OUTPUTS | drawn | sums
    further = {RUNNING: ("sum",)}
    if not spec.draws.adaptive:
        further |= dict.fromkeys(DRAW_OUTPUTS, (BATCH,))
    return {name: replace(found[name], dims=further.get(name, ())) for name in sorted(found)}


class GridStudy(GrowingStudy):
    """A study over a grid of parameters."""

    def __init__(self, spec: Spec) -> None:
        super().__init__(spec)
        self.grid = Grid(spec)
        self.selection = EffectSelection(spec, self.grid)

    @property
    def grids(self) -> tuple[Grid]:
        """Its points."""
        return (self.grid,)

    def follows_tolerance(self, block: int) -> np.ndarray | bool:
        """Mark the points of a block that a tighter tolerance computes more closely, (points,)."""
        return by_tolerance(self.grid.parameters(block))

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

    def known_arrays(self) -> list[ArrayLayout]:
        """Coordinates, and the sizes of batches."""
        arrays = coordinates(self.spec.axes)
        if sizes := batch_sizes(self.spec):
            about = described("1", "draws in the batch")
            arrays.append(
                ArrayLayout.known("batch_draws", (BATCH,), np.array(sizes, np.int64), about)
            )
        return arrays

    def outputs(self) -> list[ArrayLayout]:
        """An array for each output of the model, and those that say what was simulated."""
        from sweep.model.outputs import ACCURACY_OUTPUTS
        from sweep.model.realisations import RUNNING_COLUMNS

        sizes = {BATCH: len(batch_sizes(self.spec)), "sum": RUNNING_COLUMNS}
        found = []
        for name, output in outputs_of(self.spec).items():
            layout = self.grid.array(name, output, self.grid.dims + output.dims, sizes)
            about = dict(layout.attributes)
            if name == EFFECTS:
                about = flag_attributes()
            elif name in ACCURACY_OUTPUTS and output.dtype != "int64":
                about |= self._promise()
            found.append(replace(layout, attributes=about))
        return found

    def _promise(self) -> dict[str, float]:
        """Tolerance and confidence that half-widths are held against, but for those on axes."""
        promised = {f"accuracy.{name}": name for name in ("tolerance", "confidence")}
        off_axes = self.spec.parameters_off_axes()
        return {n: float(off_axes[path]) for path, n in promised.items() if path in off_axes}

    def evaluate(
        self,
        block: int,
        begun: Known = Known(),  # noqa: B008
        stop: Stop | None = None,
    ) -> Results:
        """Outputs of a block; fills, where all of a point is beyond the model.

        `begun` and `stop` are those of :func:`sweep.tasks.evaluate.evaluated`.
        """
        selected = self.selection.of_block(block)
        known = self._known(block, selected)
        extent, size = self.grid.extent(block), self.grid.block_size(block)
        results = {
            name: np.full((size, *layout.shape[len(extent) :]), layout.fill, layout.dtype)
            for name, layout in self.layouts.items()
        }
        results |= {EFFECTS: selected.flags, ERROR: selected.error}
        computed = evaluated(self.spec, self.grid, block, selected, known, begun, stop or Stop())
        for points, found in (known.done, begun.done, *computed):
            for name in results.keys() & found.keys():  # some are of use to later draws alone
                results[name][points] = found[name]
        return {name: values.reshape(extent + values.shape[1:]) for name, values in results.items()}

    def _known(self, block: int, selected: Selected) -> Known:
        """Points of a block that a smaller study has: whole, or their first draws."""
        if (reuse := self.earlier) is None:
            return Known()
        found = []
        for share in reuse.shares(block):
            if (older := reuse.read(share.block)) is None:
                continue
            rank, size = len(reuse.older.grids[0].shape), reuse.older.block_size(share.block)
            same = older[EFFECTS].ravel()[share.place] == selected.flags[share.points]
            results = {
                name: values.reshape(size, *values.shape[rank:])[share.place[same]]
                for name, values in older.items()
                if name not in (EFFECTS, ERROR)
            }
            found.append(Found(share.points[same], results))
        points, results = together(found)
        there = Found(points, no_sums(self.spec, points.size) | results)
        reuse.taken[block] = points.size if reuse.is_whole else 0
        return Known(done=there) if reuse.is_whole else Known(begun=there)

    def there(self, block: int) -> int:
        """Points of a block that the smaller study has, with the same effects."""
        if (reuse := self.earlier) is None:
            return 0
        selected, number = self.selection.of_block(block), 0
        for share in reuse.shares(block):
            with suppress(*DAMAGED):
                flags = reuse.chunk(EFFECTS, share.block).ravel()
                number += int(np.sum(flags[share.place] == selected.flags[share.points]))
        return number

    def compile(self) -> None:
        """Compile what the model compiles, once, before workers find it on disk.

        One draw of a point with every effect that may be called for, and one with none. Random
        effects are not for every instrument: of these, only what the point itself calls for.
        """
        from sweep.model.effects.catalogue import EFFECTS as ALL

        modes, once = self.spec.modes(), with_few_draws(self.spec, 1)
        may_be = [e.name for e in ALL if modes[e.name] != "off" and not e.is_random]
        own = names_of(int(self.selection.of_block(0).flags[0]))
        for effects in ({*may_be, *own}, ()):
            with suppress(UnsupportedShot):
                evaluate_points(once, self.grid.parameters_at(np.zeros(1, np.int64)), 1, effects)


def coordinates(axes: tuple[Axis, ...]) -> list[ArrayLayout]:
    """Arrays of the values along axes, in the units that they were written in."""
    return [
        ArrayLayout.known(
            member.name,
            (axis.name,),
            np.asarray(member.display),
            {**described(member.units, member.name.replace("_", " ")), "path": member.path},
        )
        for axis in axes
        for member in axis.members
    ]
