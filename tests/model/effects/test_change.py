"""What a change of bins makes of the probability of detection."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pd_changes import pd_change

from sweep.model.effects.change import Change
from sweep.model.effects.probability_bounds import within_changes
from sweep.model.effects.span import Span
from sweep.model.marcum import marcum_q1

positive = st.floats(0.0, 30.0)
factor = st.floats(0.2, 5.0)


@given(a=positive, b=positive, ends=st.tuples(factor, factor), noise=st.tuples(factor, factor))
@pytest.mark.parametrize("follows", [True, False])
def test_no_change_within_the_intervals_moves_pd_further(follows, a, b, ends, noise):
    ends, noise = sorted(ends), sorted(noise)
    change = Change(signal=tuple(ends), noise=tuple(noise), threshold_follows=follows)
    bound = pd_change(change, amplitude=a, threshold=b)
    without = marcum_q1(a, b).q
    share = np.linspace(0.0, 1.0, 7)
    signal = (ends[0] + share * (ends[1] - ends[0]))[:, None]
    deviation = np.sqrt(noise[0] + share * (noise[1] - noise[0]))
    level = b if follows else b / deviation
    found = marcum_q1(a * signal / deviation, np.broadcast_to(level, (7, 7)).copy()).q
    assert np.all(np.abs(found - without) <= bound + 1e-12)


def test_no_change_is_none_and_no_signal_stays_none():
    assert pd_change(Change(), amplitude=[0.0, 3.0], threshold=4.0).tolist() == [0.0, 0.0]
    boundless = Change(signal=(0.0, np.inf))
    np.testing.assert_array_equal(pd_change(boundless, amplitude=0.0, threshold=4.0), 0.0)
    assert pd_change(boundless, amplitude=3.0, threshold=4.0) > 0.8


def test_an_effect_that_leaves_no_noise_leaves_finite_magnitudes():
    """As where all is far beyond full scale."""
    nothing = Change(signal=(0.0, 0.0), noise=(0.0, 0.0))
    one = np.ones((3, 1))
    found, threshold = within_changes(
        [nothing], amplitude=Span(one, 2 * one), threshold=Span(3.0, 4.0)
    )
    assert (found.low == 0).all() and (found.high >= 2).all() and (found.high < np.inf).all()
    assert (threshold.low <= 3).all() and (threshold.high >= 4).all()
    assert (threshold.high < np.inf).all()
