"""Random numbers of the things that a scene draws."""

from __future__ import annotations

import numpy as np

_STREAMS = ("relief", "hills", "craters", "boulders", "trees")


def generator(use: str, seed: int) -> np.random.Generator:
    """Random numbers of one use: the same seed gives craters and boulders unlike places."""
    key = (_STREAMS.index(use),)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))
