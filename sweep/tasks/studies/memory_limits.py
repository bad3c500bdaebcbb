"""Check that a study's memory fits its workers, before anything is computed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sweep.messages import option_text
from sweep.spec import SceneSpec
from sweep.spec.rules import Mistake, SpecError

if TYPE_CHECKING:
    from sweep.spec import GridSpec
    from sweep.tasks.engine.block_study import BlockStudy
    from sweep.tasks.engine.worker_memory import WorkerMemory
    from sweep.tasks.studies.flight_study import FlightStudy
    from sweep.tasks.studies.grid_study import GridStudy

FFT_SIZE_PARAMETER = "instrument.processing.fft_size"
"""Dotted path of the FFT size (number of samples)."""

PEAK_MEMORY_BYTES_PER_FFT_POINT = 250
"""Peak memory of computing one grid point without whole spectra, per sample of its FFT [bytes].

It was measured with FFTs of 2^20 and 2^22 samples.
"""
PEAK_MEMORY_BYTES_PER_FFT_POINT_OF_SPECTRA = 300
"""Peak memory of drawing whole spectra of one grid point, per sample of its FFT [bytes].

It was measured with FFTs of 2^20 and 2^22 samples.
"""


def fft_size_max(spec: GridSpec | SceneSpec) -> int:
    """Return the largest FFT size (number of samples) at any point of a study."""
    sizes = [
        member.values
        for axis in spec.axes
        for member in axis.parameters
        if member.path == FFT_SIZE_PARAMETER
    ]
    return int(np.max(sizes[0])) if sizes else int(spec.parameters()[FFT_SIZE_PARAMETER])


def point_memory_bytes(spec: GridSpec | SceneSpec) -> int:
    """Return the peak memory of computing one grid point, or one shot of a flight [bytes]."""
    draws_spectra = getattr(spec.draws, "draws_whole_spectra", False)
    return fft_size_max(spec) * (
        PEAK_MEMORY_BYTES_PER_FFT_POINT_OF_SPECTRA
        if draws_spectra
        else PEAK_MEMORY_BYTES_PER_FFT_POINT
    )


def block_peak_memory_bytes(study: GridStudy | FlightStudy) -> int:
    """Return the peak memory of a thread that computes and writes one block [bytes]."""
    return point_memory_bytes(study.spec) + 2 * study.largest_block_nbytes


def scene_memory_bytes(spec: SceneSpec) -> int:
    """Return the size of a scene's triangles and search trees [bytes].

    Each process has a copy of them.
    """
    from sweep.tasks.studies.eyepoint_study import get_built_scene

    return get_built_scene(spec).caster.nbytes


def refuse_too_large_point(spec: GridSpec | SceneSpec, worker_memory: WorkerMemory) -> None:
    """Raise a SpecError if one point needs more memory than a process has."""
    bytes_needed = point_memory_bytes(spec)
    if not worker_memory.suffices_for(bytes_needed):
        rule = (
            f"makes a point take about {_gigabytes_text(bytes_needed)} of memory, "
            f"{_available_memory_phrase(worker_memory)}"
        )
        size = f"{fft_size_max(spec):,} points"
        remedy = f"take fewer points of the FFT{_fewer_workers_remedy(worker_memory, bytes_needed)}"
        raise SpecError([Mistake(FFT_SIZE_PARAMETER, rule, size, remedy)])


def refuse_too_large_study(study: GridStudy | FlightStudy, worker_memory: WorkerMemory) -> None:
    """Raise a SpecError if a point, a block or the scene needs more memory than a process has."""
    refuse_too_large_point(study.spec, worker_memory)
    refuse_too_large_blocks(study, worker_memory)
    if isinstance(study.spec, SceneSpec):
        refuse_too_large_scene(study.spec, worker_memory)


def refuse_too_large_scene(spec: SceneSpec, worker_memory: WorkerMemory) -> None:
    """Raise a SpecError if a scene and one point need more memory than a process has."""
    bytes_needed = point_memory_bytes(spec) + scene_memory_bytes(spec)
    if not worker_memory.suffices_for(bytes_needed):
        rule = (
            f"takes about {_gigabytes_text(bytes_needed)} of memory in each process that computes, "
            f"{_available_memory_phrase(worker_memory)}"
        )
        remedy = (
            f"take coarser grounds and meshes{_fewer_workers_remedy(worker_memory, bytes_needed)}"
        )
        raise SpecError([Mistake("scene.objects", rule, "", remedy)])


def refuse_too_large_blocks(study: BlockStudy, worker_memory: WorkerMemory) -> None:
    """Raise a SpecError if the results of one block need more memory than a process has."""
    bytes_needed = 2 * study.largest_block_nbytes  # the results, and their encoded copy
    if not worker_memory.suffices_for(bytes_needed):
        rule = (
            f"makes a block take about {_gigabytes_text(bytes_needed)} of memory, "
            f"{_available_memory_phrase(worker_memory)}"
        )
        raise SpecError([Mistake("storage", rule, "", "lower the number that a block holds")])


def _available_memory_phrase(worker_memory: WorkerMemory) -> str:
    """Return the available memory as a phrase, such as 'and a worker has 8.0 GB'."""
    return f"and {worker_memory.process_name} has {_gigabytes_text(worker_memory.bytes_max)}"


def _fewer_workers_remedy(worker_memory: WorkerMemory, bytes_needed: float) -> str:
    """Return a remedy such as ', or --workers 4' if a smaller number of workers would suffice.

    The result is '' if no number would suffice. `bytes_needed` is the memory that a worker needs.
    """
    n_workers = int(worker_memory.bytes_max * worker_memory.n_workers_sharing_memory / bytes_needed)
    return (
        f", or {option_text('workers', n_workers)}"
        if 1 <= n_workers < worker_memory.n_workers_sharing_memory
        else ""
    )


def _gigabytes_text(n_bytes: float) -> str:
    """Return a size in GB as text."""
    return f"{n_bytes / 1e9:,.1f} GB"
