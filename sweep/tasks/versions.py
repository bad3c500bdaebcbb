"""Versions and processor that the bits of a result depend on."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import version

#: Distributions whose version can change a result or how it is stored.
DISTRIBUTIONS = ("numba", "numpy", "scipy", "sweep", "zarr")


@cache
def _installed() -> tuple[tuple[str, str], ...]:
    return tuple((name, version(name)) for name in DISTRIBUTIONS)


def software() -> dict[str, str]:
    """Versions of the software that a result depends on, by name."""
    return dict(_installed())


def model() -> str:
    """Version of the physics."""
    from sweep.model import VERSION

    return VERSION


@cache
def processor() -> str:
    """Machine, processor and vector instructions that numpy dispatches to.

    numpy and LLVM choose their code by these, and with it the last bits of a result.
    """
    import llvmlite.binding
    import numpy as np

    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})  # type: ignore[call-overload]
    found = simd.get("found") or simd.get("baseline") or []
    name = llvmlite.binding.get_host_cpu_name()
    return f"{platform.machine()} {name} {' '.join(found)}".strip()


def differences(recorded: dict[str, str]) -> list[str]:
    """Lines that say where the software here differs from a recorded one."""
    here = software()
    return [
        f"{name}: {recorded.get(name, 'none')} in the store, {here.get(name, 'none')} here"
        for name in sorted(here.keys() | recorded.keys())
        if here.get(name) != recorded.get(name)
    ]
