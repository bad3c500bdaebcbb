"""Windows: textbook figures, sums against samples, transforms against sums in many digits."""

import mpmath
import numpy as np
import pytest
from scipy import signal

from sweep.model.window import (
    COSINE_SUM_COEFFICIENTS,
    canonical_window_name,
    centred_transform,
    direct_transform,
    get_window,
    window_samples,
)

OTHERS = (
    "kaiser(8.6)", "kaiser(0.5)", "chebwin(100)", "chebwin(45)", "dpss(3)", "gaussian(40)",
    "tukey(0.3)", "bartlett", "parzen", "bohman", "cosine", "barthann", "lanczos",
)  # fmt: skip


@pytest.mark.parametrize("name", [*COSINE_SUM_COEFFICIENTS, "boxcar"])
def test_cosine_sums_have_the_very_bits_of_scipys(name):
    for length in (1, 2, 3, 37, 64, 1000, 2**17, 300_000):
        expected = signal.get_window("boxcar" if name == "rectangular" else name, length)
        assert window_samples(name, length).tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    "name, scalloping, bandwidth",
    [("rectangular", 3.92, 1.00), ("hann", 1.42, 1.50), ("hamming", 1.75, 1.36)],
)
@pytest.mark.parametrize("length", [4096, 131072])
def test_scalloping_and_noise_bandwidth_are_the_textbook_figures(
    name, scalloping, bandwidth, length
):
    """PHYSICS section 5, after Harris (1978), to the printed digits."""
    shape = get_window(name, length)
    loss = -20 * np.log10(abs(direct_transform(shape, np.array([0.5]))[0]) / shape.sum)
    assert loss == pytest.approx(scalloping, abs=0.0055)
    assert shape.equivalent_noise_bandwidth == pytest.approx(bandwidth, abs=0.0051)


@pytest.mark.parametrize("name", [*COSINE_SUM_COEFFICIENTS, *OTHERS])
@pytest.mark.parametrize("length", [40, 64, 65, 777, 4096])
def test_sum_and_energy_are_those_of_the_samples(name, length):
    w, shape = window_samples(name, length), get_window(name, length)
    assert w.shape == (length,)
    assert shape.sum == pytest.approx(w.sum(), rel=1e-13)
    assert shape.energy == pytest.approx((w**2).sum(), rel=1e-13)
    assert shape.first_value == pytest.approx(w[0], abs=1e-15)
    assert shape.length == length


@pytest.mark.parametrize("name", [*COSINE_SUM_COEFFICIENTS, "kaiser(8.6)"])
@pytest.mark.parametrize("length", [40, 64, 65, 1000, 4097])
@pytest.mark.parametrize("squared", [False, True])
def test_a_transform_about_the_middle_is_the_sum_over_the_samples(name, length, squared):
    """Rounding of the sum, which has the square root of L terms' worth, bounds the difference."""
    y = np.concatenate([np.arange(0, 770) / 64, [-3.3, -0.5, 17.25]])
    w = window_samples(name, length) ** (2 if squared else 1)
    position = np.arange(length) / length - 0.5
    expected = [(w * np.exp(-2j * np.pi * f * position)).sum() for f in y]
    transform = centred_transform(get_window(name, length), y, squared=squared)
    assert np.abs(transform - expected).max() < 1e-13 * np.abs(w).sum()


@pytest.mark.parametrize(
    "name, same",
    [("hanning", "hann"), (" Boxcar", "rectangular"), ("rect", "rectangular"),
     ("Kaiser( 8.6 )", "kaiser(8.6)")],
)  # fmt: skip
def test_aliases_and_spellings_are_one_window(name, same):
    assert canonical_window_name(name) == same
    assert get_window(name, 128) is get_window(same, 128) or get_window(name, 128).name == same


@pytest.mark.parametrize("name", ["hammig", "kaiser", "kaiser(one)", "hann(", "blackmann", ""])
def test_a_window_that_scipy_does_not_know_is_refused(name):
    with pytest.raises(ValueError):
        window_samples(name, 64)


def test_parameters_of_a_window_reach_scipy():
    assert np.array_equal(window_samples("kaiser(8.6)", 99), signal.get_window(("kaiser", 8.6), 99))
    assert np.array_equal(
        window_samples("general_gaussian(1.5,7)", 99),
        signal.get_window(("general_gaussian", 1.5, 7), 99),
    )


def exact_transform(texts, length, y):
    """W(y) of a cosine sum by adding its samples in 40 digits."""
    with mpmath.workdps(40):
        c = [mpmath.mpf(text) for text in texts]
        step = 2 * mpmath.pi / length
        return mpmath.fsum(
            mpmath.fsum((-1) ** m * x * mpmath.cos(m * n * step) for m, x in enumerate(c))
            * mpmath.expj(-step * n * mpmath.mpf(y))
            for n in range(length)
        )


@pytest.mark.parametrize("name", ["rectangular", "hann", "hamming", "flattop"])
def test_the_direct_sum_is_the_sum_in_many_digits(name):
    y = np.array([0.0, 0.5, 1.0, 2.75, -30.5, 64.0])
    exact = [complex(exact_transform(COSINE_SUM_COEFFICIENTS[name], 128, float(x))) for x in y]
    assert np.abs(direct_transform(get_window(name, 128), y) - exact).max() < 1e-13 * 128


# The transform


@pytest.mark.parametrize("name", [*COSINE_SUM_COEFFICIENTS, *OTHERS])
@pytest.mark.parametrize("length", [100, 257, 1500])
def test_the_envelope_bounds_every_sidelobe_beyond_its_reach(name, length):
    shape = get_window(name, length)
    rng = np.random.default_rng(length)
    dense = np.concatenate([np.arange(0.125, 60, 1 / 32), rng.uniform(0.2, length / 2, 600)])
    y = np.sort(dense[(dense >= shape.envelope_distances[0]) & (dense <= length / 2)])
    magnitude = np.abs(direct_transform(shape, y)) / shape.sum
    bound = shape.sidelobe_envelope[np.searchsorted(shape.envelope_distances, y, side="right") - 1]
    assert (np.diff(shape.sidelobe_envelope) <= 0).all() and (
        np.diff(shape.envelope_distances) > 0
    ).all()
    # Rounding of the direct sum: 1e-16 a sample.
    assert (magnitude <= bound * (1 + 1e-9) + 1e-13).all()
