"""Points over the whole reachable range, with what the effects' bounds take, and the measure."""

from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import line_spread
from sweep.model.footprint import beamlets as pattern_of
from sweep.model.preparation import prepare
from sweep.model.shot import find

SIZES = (2**12, 2**13, 2**14, 2**15, 2**16, 2**17, 2**18)
WINDOWS = ("hamming", "hann", "rectangular", "blackman", "flattop", "kaiser(8.6)")


def drawn(table, number, seed, **fixed):
    """Random points of one category: (shots, parameters)."""
    rng = np.random.default_rng((71, seed))
    values = {
        "range": 10 ** rng.uniform(0, 4, number),
        "grazing_angle": np.radians(rng.choice([1, 90], number) * 1.0),
        "beam_divergence": 10 ** rng.uniform(-5, np.log10(2e-3), number),
        "radial_velocity": rng.choice([-1, 1], number) * 10 ** rng.uniform(-3, 3, number),
        "power": 10 ** rng.uniform(-4, 1, number),
        "tnr": rng.uniform(2, 12, number),
        "fft_size": int(rng.choice(SIZES)),
        "window": str(rng.choice(WINDOWS)),
        "reflectance_law": str(rng.choice(["thesis", "lambert", "lommel_seeliger"])),
        "phases": "incoherent",
        "beamlets": int(rng.choice([3, 7, 19, 61, 109])),
        "duration": float(rng.choice([500e-6, 200e-6])),
    }
    slanted = rng.random(number) < 0.8
    values["grazing_angle"] = np.where(
        slanted, np.radians(rng.uniform(1, 90, number)), values["grazing_angle"]
    )
    values |= fixed
    parameters = table(**values)
    ((_, shots),) = prepare(parameters)
    return shots, values


def own_rows(shots):
    """The same points with a row of the geometry each."""
    return replace(
        shots,
        row=np.arange(shots.range.size),
        **{name: getattr(shots, name)[shots.row] for name in ("offset", "doppler", "amplitude")},
    )


def pattern(values):
    return "hexagonal" if values["phases"] == "incoherent" else "sunflower"


def moving_across(shots, values, across, along=0.0):
    """The same points with the beamlets' differences of velocity, from their directions."""
    (x, y), _ = pattern_of(values["beamlets"], pattern(values))
    angle = np.random.default_rng(5).uniform(0, 2 * np.pi, shots.range.size)[:, None]
    sigma = np.broadcast_to(values["beam_divergence"], shots.range.shape)[:, None] / 4
    size = np.sqrt(1 + (x * x + y * y) * sigma**2)
    sideways = (x * np.cos(angle) + y * np.sin(angle)) * sigma / size
    velocity = np.asarray(across)[:, None] * sideways + np.asarray(along)[..., None] * (
        1 / size - 1
    )
    return replace(own_rows(shots), doppler=2 * velocity / SPEED_OF_LIGHT)


def range_moments(shots, values, segment):
    """Bins by which a plane's ranges put lines off the axis's."""
    plane = line_spread.plane_range_moments(
        grazing_angle=values["grazing_angle"],
        beam_divergence=values["beam_divergence"],
        number=values["beamlets"],
        pattern=pattern(values),
    )
    if segment == 1:
        return line_spread.NO_SPREAD
    return plane.scaled(
        line_spread.range_to_bins(
            range=shots.range,
            beta=shots.beta,
            chirp_rate=shots.chirp_rate,
            bin_width=shots.sample_rate / shots.fft_size,
        )
    )


def velocity_moments(shots, values, segment, across, along=0.0):
    """Bins by which a velocity across the beam puts lines off the axis's."""
    plane = line_spread.plane_velocity_moments(
        across=across,
        along=along,
        grazing_angle=values["grazing_angle"],
        beam_divergence=values["beam_divergence"],
        number=values["beamlets"],
        pattern=pattern(values),
    )
    return plane.scaled(
        line_spread.velocity_to_bins(
            range=shots.range,
            carrier=shots.carriers[segment],
            chirp_rate=shots.chirp_rate,
            bin_width=shots.sample_rate / shots.fft_size,
        )
    )


def magnitudes(shots):
    """Largest bin's |X| of each segment, (3, n)."""
    return find(shots)[:, 2]


ROUNDING = 1e-9
"""Of a magnitude: the spectrum's own 1e-12, and the phase of lines 1e8 wavelengths away."""


def held(change, with_effect, without):
    """Whether the true factor lies within the interval, (n,), and interval / change in logs."""
    low, high = np.broadcast_arrays(*change.signal)
    low, high = np.broadcast_to(low, without.shape), np.broadcast_to(high, without.shape)
    factor = with_effect / without
    inside = (factor >= low * (1 - ROUNDING)) & (factor <= high * (1 + ROUNDING))
    with np.errstate(divide="ignore"):
        length = np.log(high) - np.log(low)
        moved = abs(np.log(factor))
    noticed = moved > 1e-7
    return inside, (length[noticed] / moved[noticed])
