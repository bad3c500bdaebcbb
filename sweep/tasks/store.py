"""A study's Zarr store: a template made whole at once, then whole chunks written block by block.

No two blocks share a chunk of any array, so writers need no locks between them; a chunk is either
there, whole, or absent. Only `.sweep/`, the journal, knows hosts and times: every other byte
follows from the study.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.tasks import versions
from sweep.tasks.errors import StoreError
from sweep.tasks.evaluate import batch_sizes
from sweep.tasks.grid import Grid

if TYPE_CHECKING:
    import zarr
    from zarr.core.array_spec import ArrayConfigLike

    from sweep.spec import Axis, Member, Spec

#: Directory of the journal inside a store.
JOURNAL = ".sweep"

#: Version of the layout of stores.
LAYOUT = 1

#: Dimension of the batches of draws.
BATCH = "batch"

#: Fill of counts; a number of detections is never negative.
NO_COUNT = -1

WRITTEN_WHOLE: ArrayConfigLike = {
    "write_empty_chunks": True
}  # else a chunk equal to the fill looks undone


def output_names(spec: Spec) -> list[str]:
    """Names of the arrays that blocks write, sorted."""
    from sweep.model.outputs import DRAW_OUTPUTS, OUTPUTS

    return sorted([*OUTPUTS, *(DRAW_OUTPUTS if spec.draws.number else ())])


def create(path: str | Path, spec: Spec, grid: Grid) -> Path:
    """A new store without results: every array's metadata, coordinates and the spec.

    It is built beside its place and renamed into it, so that a creation cut short leaves nothing
    that looks like a store.

    Raises
    ------
    StoreError
        Where something is in its place, or the place can't be written.
    """
    path = Path(path)
    building = path.with_name(f".{path.name}.creating-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _build(building, spec, grid)
        os.rename(building, path)
    except OSError as error:
        raise StoreError(f"{path} can't be made: {error.strerror or error}") from error
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return path


def remove(path: Path) -> None:
    """Take a store away, out of its place in one step."""
    aside = path.with_name(f".{path.name}.removing-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    os.rename(path, aside)
    shutil.rmtree(aside)


def _build(path: Path, spec: Spec, grid: Grid) -> None:
    import zarr

    group = zarr.create_group(path, zarr_format=3, attributes=_attributes(spec, grid))
    for axis in spec.axes:
        for member in axis.members:
            _add_coordinate(group, axis, member)
    if spec.draws.number:
        _add_batches(group, np.array(batch_sizes(spec), dtype=np.int64))
    for name in output_names(spec):
        _add_output(group, name, spec, grid)
    (path / JOURNAL).mkdir()
    _consolidate(path)


def _attributes(spec: Spec, grid: Grid) -> dict[str, Any]:
    coordinates = [m.name for axis in spec.axes for m in axis.members]
    coordinates += ["batch_draws"] if spec.draws.number else []
    return {
        "title": spec.title,
        "question": spec.question,
        "spec": spec.to_json(),
        "study_id": spec.id,
        "model_version": versions.model(),
        "software": versions.software(),
        "processor": versions.processor(),
        "layout": LAYOUT,
        "block_shape": list(grid.block_shape),
        # xarray's way to tell coordinates that share a dimension from variables
        "coordinates": " ".join(coordinates),
    }


def _codecs() -> dict[str, Any]:
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return {"compressors": [ZstdCodec(level=1), Crc32cCodec()]}


def _add_coordinate(group: zarr.Group, axis: Axis, member: Member) -> None:
    values = np.asarray(member.display)
    text = values.dtype.kind in "UOT"
    array = group.create_array(
        member.name,
        shape=values.shape,
        chunks=values.shape,
        dtype="string" if text else values.dtype,
        dimension_names=(axis.name,),
        attributes={
            "units": member.units,
            "long_name": member.name.replace("_", " "),
            "path": member.path,
        },
        **_codecs(),
    )
    array[...] = values.astype(object) if text else values


def _add_batches(group: zarr.Group, sizes: np.ndarray) -> None:
    array = group.create_array(
        "batch_draws",
        shape=sizes.shape,
        chunks=sizes.shape,
        dtype=sizes.dtype,
        dimension_names=(BATCH,),
        attributes={"units": "1", "long_name": "draws in the batch"},
        **_codecs(),
    )
    array[...] = sizes


def _add_output(group: zarr.Group, name: str, spec: Spec, grid: Grid) -> None:
    from sweep.model.outputs import DRAW_OUTPUTS, OUTPUTS

    counted = name not in OUTPUTS
    output = DRAW_OUTPUTS[name] if counted else OUTPUTS[name]
    attributes = {"units": output.units, "long_name": output.long_name, "comment": output.comment}
    batches = (len(batch_sizes(spec)),) if counted else ()
    group.create_array(
        name,
        shape=grid.shape + batches,
        chunks=grid.block_shape + batches,
        dtype="int64" if counted else "float64",
        fill_value=NO_COUNT if counted else float("nan"),
        dimension_names=grid.dims + ((BATCH,) if counted else ()),
        attributes={key: text for key, text in attributes.items() if text},
        **_codecs(),
    )


def _consolidate(path: Path) -> None:
    """Put the metadata of all arrays in the group's own, as Zarr's Python library lays it out.

    Written by hand because the library warns on doing it. It can't go stale: neither shapes nor
    attributes change after creation.
    """
    documents = {
        child.name: json.loads((child / "zarr.json").read_text())
        for child in sorted(path.iterdir())
        if (child / "zarr.json").exists()
    }
    root = json.loads((path / "zarr.json").read_text())
    root["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": documents,
    }
    (path / "zarr.json").write_text(json.dumps(root, indent=2))


class Arrays:
    """Arrays of a store held open for writing blocks.

    Parameters
    ----------
    path
        The store.
    names
        Names of the arrays that every block writes.
    """

    def __init__(self, path: str | Path, names: list[str]) -> None:
        import zarr

        self.path = Path(path)
        self._arrays = {
            name: zarr.open_array(self.path / name, mode="r+").with_config(WRITTEN_WHOLE)
            for name in names
        }

    def write(self, grid: Grid, block: int, results: Mapping[str, np.ndarray]) -> str:
        """Write the chunks of one block, each whole.

        Returns
        -------
        str
            Digest of the bytes stored (`digest`).

        Raises
        ------
        ValueError
            Where the results are not exactly the block's: a missing or unknown name, or a shape
            that would fill its chunks in part.
        """
        if results.keys() != self._arrays.keys():
            odd = sorted(results.keys() ^ self._arrays.keys())
            raise ValueError(f"results don't match the store's arrays: {', '.join(odd)}")
        extent, slices = grid.extent(block), grid.block(block)
        for name, array in self._arrays.items():
            whole = extent + array.shape[len(extent) :]
            if results[name].shape != whole:
                raise ValueError(
                    f"{name} of block {block} has shape {results[name].shape}, its chunk {whole}: "
                    "blocks write whole chunks only"
                )
            array[slices or ...] = results[name]
        return digest(self.path, block_objects(grid, block, list(self._arrays)))


def block_objects(grid: Grid, block: int, names: list[str]) -> list[str]:
    """Paths, inside the store, of the chunks of one block."""
    key = "/".join(["c", *map(str, grid.position(block))])
    return [f"{name}/{key}" + ("/0" if _is_count(name) else "") for name in names]


def _is_count(name: str) -> bool:
    from sweep.model.outputs import DRAW_OUTPUTS

    return name in DRAW_OUTPUTS


def is_whole(path: Path, objects: list[str]) -> bool:
    """Whether every object of a block is there and has bytes."""
    try:
        return all(os.stat(path / name).st_size > 0 for name in objects)
    except (FileNotFoundError, NotADirectoryError):
        return False


def digest(path: Path, objects: list[str]) -> str:
    """blake2b-128 of names and bytes of stored objects, in hex."""
    sum_ = hashlib.blake2b(digest_size=16)
    for name in objects:
        content = (path / name).read_bytes()
        sum_.update(f"{name}\0{len(content)}\0".encode())
        sum_.update(content)
    return sum_.hexdigest()
