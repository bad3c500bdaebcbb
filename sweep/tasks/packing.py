"""A finished store as few large files: a copy, sharded, checked value by value as it is made."""

from __future__ import annotations

import math
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from sweep.storage import logs
from sweep.storage.locations import (
    JOURNAL,
    PACKED,
    Location,
    draft,
    files_below,
    in_words,
    located,
    put_whole,
    zarr_store,
)
from sweep.storage.logs import read_lines, sealed
from sweep.storage.opening import open_group
from sweep.tasks import store, studies
from sweep.tasks.journal import LOGS, RECIPE, committed
from sweep.tasks.progress import Progress, StoreError, chosen, told
from sweep.tasks.study import ArrayLayout, BlockGrid, Study

#: Bytes of a shard, before compression, as far as whole chunks allow; one a thread is in memory.
SHARD_BYTES = 64 << 20
THREADS = 4


def pack(
    path: str | Location, output: str | Location, *, progress: bool | Progress = True
) -> Location:
    """Copy a complete store into one of few files, each many chunks: whole, or not at all.

    StoreError where it is not complete, where something is in the way of the copy, or it can't
    be written or read back as it was.
    """
    path, output = located(path).absolute(), located(output).absolute()
    attributes, study = studies.read(path)
    left = study.n_blocks - int(np.count_nonzero(committed(path, study)))
    if attributes.get(PACKED) or left:
        why = "is packed already" if attributes.get(PACKED) else f"lacks {left:,} blocks: resume it"
        raise StoreError(f"{path} {why}")
    if output.exists():
        raise StoreError(f"{output} is there already: name another place")
    shown = chosen(progress)
    with told(f"{output} can't be made"):
        if isinstance(output, Path):
            with draft(output) as aside:
                aside.mkdir()
                _pack(path, aside, study, shown)
                store.sync(aside)  # else a power cut may leave the name without the values
        else:
            with store.making(output):
                _pack(path, output, study, shown)
    return output


def _pack(path: Location, output: Location, study: Study, shown: Progress) -> None:
    """Write a packed copy, the document of its group last."""
    attributes = {**studies.read(path)[0], PACKED: True}
    with tempfile.TemporaryDirectory() as directory:
        template = Path(directory) / "template"
        store.build(template, study, attributes, shards=shard_shape)
        root = (template / "zarr.json").read_bytes()
        for name in files_below(template).keys() - {"zarr.json", f"{JOURNAL}/{store.MANIFEST}"}:
            put_whole(output / name, (template / name).read_bytes())
    names, arrays = sorted(study.owners()), open_group(path)
    shown.begin(points=len(names), done=0, unit="arrays")
    try:
        for name in names:
            with in_words(path), in_words(output):
                _pack_array(arrays[name], output / name)
            shown.advance(points=1, failed=0)
    finally:
        shown.end()
    if studies.read(path)[0]["study_id"] != study.id:
        raise StoreError(f"{path} was extended or replaced while it was copied: try again")
    for name in (*LOGS, RECIPE):
        lines = read_lines(path / JOURNAL / name)
        # without the machine, as copies are given away
        told = [{k: v for k, v in line.items() if k not in ("host", "pid")} for line in lines]
        if content := b"".join(map(sealed, told)):
            put_whole(output / JOURNAL / name, content)
    names = [name for name in files_below(output) if not name.startswith(f"{JOURNAL}/")]
    digests = {name: logs.digest(output, [name]) for name in names}
    digests["zarr.json"] = logs.digest_of([("zarr.json", root)])
    store.list_objects(output, attributes, digests)
    put_whole(output / "zarr.json", root)


def _pack_array(source: Any, output: Location) -> None:
    """Copy an array, shard by shard, and read each back."""
    target = zarr.open_array(zarr_store(output), mode="r+").with_config(store.WRITTEN_WHOLE)
    dims = tuple(map(str, range(target.ndim)))
    files = BlockGrid(dims, target.shape, target.shards or target.chunks)
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in pool.map(lambda n: _copy(source, target, files.block(n)), range(files.n_blocks)):
            pass


def _copy(source: zarr.Array[Any], target: zarr.Array[Any], part: tuple[slice, ...]) -> None:
    values = np.asarray(source[part or ...])
    target[part or ...] = values
    back = np.asarray(target[part or ...])
    if back.tobytes() != values.tobytes():
        raise OSError(5, f"{target.path} does not read back as it was written")


def shard_shape(layout: ArrayLayout) -> tuple[int, ...] | None:
    """Whole chunks along each axis that make a file, the last axis filled first; or None."""
    if layout.values is not None:
        return None
    room = SHARD_BYTES // max(1, layout.bytes_of(layout.chunks))
    counts = [1] * len(layout.shape)
    for k in reversed(range(len(counts))):
        counts[k] = max(1, min(-(-layout.shape[k] // layout.chunks[k]), room))
        room //= counts[k]
    if math.prod(counts) == 1:
        return None
    return tuple(count * chunk for count, chunk in zip(counts, layout.chunks, strict=True))
