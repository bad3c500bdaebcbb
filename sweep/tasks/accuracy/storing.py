"""What a study takes to be stored: the same, whatever its setting."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np

from sweep.tasks import store
from sweep.tasks.study import Study

#: Of each part; the first may import and open what the others find.
TRIALS = 3


def storing(study: Study) -> float:
    """Processor time that making a study's store and writing all of its blocks takes [s].

    Of blocks of zeros, which pack faster than results do: it is no more than what results take.
    """
    block = study.n_blocks // 2
    layouts = {layout.name: layout for layout in study.arrays()}
    results = {}
    for name, position in study.chunks(block).items():
        layout = layouts[name]
        sizes = zip(layout.shape, layout.chunks, position, strict=True)
        extent = [min(cut, n - cut * place) for n, cut, place in sizes]
        results[name] = np.zeros(extent, layout.dtype)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.zarr"
        made = _least(partial(_make_anew, path, study))
        written = _least(partial(store.Arrays(path, study).write, block, results))
    return made + study.n_blocks * written


def _make_anew(path: Path, study: Study) -> None:
    if path.exists():
        store.remove(path)
    store.create(path, study)


def _least(work: Callable[[], object]) -> float:
    """Least processor time of a work in some trials [s]."""
    spent = []
    for _ in range(TRIALS):
        begun = process_time()
        work()
        spent.append(process_time() - begun)
    return min(spent)
