"""Effects as flags: how a store says, point by point, what was simulated."""

from typing import Any

import numpy as np

from sweep.model.effects.catalogue import EFFECTS, NAMES


def flags_of(kept: np.ndarray) -> np.ndarray:
    """Flags (m,) uint32 of effects that are kept, (effects, m) bool in the catalogue's order."""
    masks = np.uint32(1) << np.arange(kept.shape[0], dtype=np.uint32)
    return np.bitwise_or.reduce(np.where(kept, masks[:, None], np.uint32(0)), axis=0)


def flags_apart() -> np.uint32:
    """Flags of effects that points with and without them are computed apart by."""
    return np.uint32(sum(1 << k for k, effect in enumerate(EFFECTS) if effect.apart))


def names_of(flags: int) -> tuple[str, ...]:
    """Names of the effects that flags stand for."""
    return tuple(name for k, name in enumerate(NAMES) if flags >> k & 1)


def flag_attributes() -> dict[str, Any]:
    """What the flags mean, in the words of the CF conventions."""
    return {
        "units": "1",
        "long_name": "effects that were simulated",
        "flag_masks": [1 << k for k in range(len(NAMES))],
        "flag_meanings": " ".join(NAMES),
    }
