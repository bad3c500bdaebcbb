"""What maximum likelihood makes of drawn records, against the bounds that it is to reach."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from sweep.model import cramer_rao, waveform

RATE, SIZE = 1e6, 256
DURATION, BANDWIDTH, CARRIER = 300e-6, 40e6, 1.9e14
CHIRP_RATE = BANDWIDTH / DURATION
CARRIERS = (CARRIER, CARRIER, CARRIER + BANDWIDTH)
DISTANCE, VELOCITY = 213.7, 0.171
TIME = np.arange(SIZE) / RATE


def beats(distance=DISTANCE, velocity=VELOCITY):
    return [
        waveform.beat_frequency(
            sign, carrier=carrier, chirp_rate=CHIRP_RATE, range=distance, radial_velocity=velocity
        )
        for sign, carrier in zip(waveform.SIGNS, CARRIERS, strict=True)
    ]


def most_likely(record, near):
    """Frequency of a lone tone: the largest value of the periodogram between bins."""
    width = RATE / SIZE

    def less(f):
        return -np.abs((record * np.exp(-2j * np.pi * f * TIME)).sum())

    ends = (near - width / 2, near + width / 2)
    return minimize_scalar(less, bounds=ends, method="bounded", options={"xatol": 1e-2}).x


def test_range_and_velocity_by_maximum_likelihood_reach_the_bounds_and_do_not_pass_them():
    draws, deviation = 300, 0.5
    rng = np.random.default_rng(17)
    truth = beats()
    slopes = np.array([
        [(b - a) / h for a, b in zip(beats(), beats(*moved), strict=True)]
        for h, moved in ((1e-2, (DISTANCE + 1e-2, VELOCITY)), (1e-5, (DISTANCE, VELOCITY + 1e-5)))
    ]).T  # fmt: skip
    errors = np.empty((draws, 2))
    for i in range(draws):
        records = [
            np.cos(2 * np.pi * (abs(f) * TIME + rng.random())) + rng.normal(0, deviation, SIZE)
            for f in truth
        ]
        found = [np.sign(f) * most_likely(x, abs(f)) for f, x in zip(truth, records, strict=True)]
        errors[i] = np.linalg.lstsq(slopes, np.subtract(found, truth), rcond=None)[0]
    beat = cramer_rao.beat_deviation(cnr=1 / (2 * deviation**2), samples=SIZE, sample_rate=RATE)
    bound = cramer_rao.resolved_deviation(
        up=beat, doppler=beat, down=beat, carriers=CARRIERS, chirp_rate=CHIRP_RATE, range=DISTANCE,
        radial_velocity=VELOCITY,
    )  # fmt: skip
    ratio = (errors**2).mean(axis=0) / np.square([bound.range, bound.radial_velocity])
    # five standard errors of a mean square, and 2 % for the tone's own image
    assert ratio == pytest.approx(1.0, abs=5 * np.sqrt(2 / draws) + 0.02)
