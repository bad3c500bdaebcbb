"""The receiver's noise at the ADC, worked out once for a receiver that all points share."""

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model import noise, receiver

_CURRENTS = (
    "local_oscillator_power", "apd_gain", "excess_noise_factor", "responsivity",
    "noise_equivalent_power", "amplifier_noise_current", "load_resistance", "temperature",
)  # fmt: skip

NOISY = (
    *_CURRENTS, "detector_bandwidth", "amplifier_bandwidth", "noise_figure", "transimpedance",
)  # fmt: skip
"""Parameters of the receiver that its noise follows from."""


class ReceiverNoise(NamedTuple):
    """Variances at the ADC [V^2]."""

    per_ampere: np.ndarray
    """Of 1 A^2 of current."""
    per_watt: np.ndarray
    """Of the shot noise of 1 W of light."""
    sources: dict[str, np.ndarray]
    """Of the receiver's own, by source."""


def receiver_noise(architecture: str, values: Mapping[str, np.ndarray]) -> ReceiverNoise:
    """Noise of receivers of an architecture, from :data:`NOISY`, (n,) or scalars."""
    if any(value.ndim for value in values.values()):
        return _noise(architecture, values)
    known = _of_one(architecture, *(values[name].item() for name in NOISY))
    return known._replace(sources=dict(known.sources))


@lru_cache(maxsize=64, typed=True)
def _of_one(architecture: str, *values: float) -> ReceiverNoise:
    given = {name: np.asarray(value) for name, value in zip(NOISY, values, strict=True)}
    return _noise(architecture, given)


def _noise(architecture: str, values: Mapping[str, np.ndarray]) -> ReceiverNoise:
    def some(*names: str) -> dict[str, np.ndarray]:
        return {name: values[name] for name in names}

    bandwidth = receiver.electrical_bandwidth(**some("detector_bandwidth", "amplifier_bandwidth"))
    scale = (
        noise.current_scale(architecture, noise_figure=values["noise_figure"])
        * values["transimpedance"] ** 2
    )
    per_watt = noise.shot_noise(
        power=1.0,
        electrical_bandwidth=bandwidth,
        **some("apd_gain", "excess_noise_factor", "responsivity"),
    )
    currents = noise.receiver_currents(
        architecture, electrical_bandwidth=bandwidth, **some(*_CURRENTS)
    )
    sources = {source: np.asarray(value * scale) for source, value in currents.items()}
    return ReceiverNoise(np.asarray(scale), np.asarray(per_watt * scale), sources)
