"""Developed speckle near DC and Nyquist in the draws of flights, by all methods."""

import numpy as np
import pytest
from test_drawn_speckle import PROCESSING, flown, scatterers_reported
from test_speckle_at_dc import BIN_WIDTH, HOVER, RANGE_BEAT, at_doppler
from test_speckle_on_slopes import with_signal_over_threshold

from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.pointcloud.pairing import UNCONFIRMED_FLAG

DRAWS = 8000
METHODS = ("probabilities", "noise", "spectra")


def hover(table_4_1, bins, *, ratio=1.6, **changes):
    """Parameters of a lidar above level ground whose Doppler frequency is so many bins."""
    high = {PROCESSING + "tnr": 10.0}  # no false alarms, of which methods list different numbers
    p = at_doppler(PARAMETER_DEFAULTS | table_4_1() | HOVER | high | changes, bins * BIN_WIDTH)
    return with_signal_over_threshold(p, ratio)


def shares(p, method, draws):
    """Shares of draws with a confirmed point, and with any point."""
    flags = flown(p, method, draws)["flags"][0, :, 0]
    return ((flags > 0) & (flags & UNCONFIRMED_FLAG == 0)).mean(), (flags > 0).mean()


@pytest.mark.parametrize("window", ["hamming", "hann"])
@pytest.mark.parametrize("bins", [0.0, 0.11, 0.42, 0.63, 1.06])
def test_a_hovering_flight_is_confirmed_as_often_as_by_scatterers(bins, window, table_4_1):
    p = hover(table_4_1, bins, **{PROCESSING + "window": window})
    detected = scatterers_reported(p, DRAWS, seed=5)[0].mean()
    for method in METHODS:
        # Whole spectra are detected by a neighbour of the strongest bin as well.
        draws, slack = (DRAWS, 0.0) if method != "spectra" else (400, 0.03)
        confirmed, _ = shares(p, method, draws)
        error = np.sqrt(detected * (1 - detected) * (1 / DRAWS + 1 / draws))
        assert abs(confirmed - detected) < 4 * error + slack, method


@pytest.mark.parametrize("bins", [0.0, 0.42])
def test_methods_agree_near_dc_where_any_bin_detects(bins, table_4_1):
    p = hover(table_4_1, bins, **{PROCESSING + "detection": "any_bin"})
    one = np.array(shares(p, "probabilities", DRAWS))
    for method, draws, slack in (("noise", DRAWS, 0.015), ("spectra", 400, 0.03)):
        other = np.array(shares(p, method, draws))
        error = np.sqrt(one * (1 - one) * (1 / DRAWS + 1 / draws))
        assert (np.abs(one - other) < 4 * error + slack).all(), (method, one, other)


def test_an_up_beat_at_dc_is_a_real_number_in_flights(table_4_1):
    """The Doppler frequency takes the range beat away: pairs are detected as grids say."""
    p = hover(table_4_1, RANGE_BEAT / BIN_WIDTH + 0.3)
    for method in ("probabilities", "noise"):
        points = flown(p, method, DRAWS)
        pair = float(points["pd_shot"][0])
        detected_share = (points["flags"][0, :, 0] > 0).mean()
        assert abs(detected_share - pair) < 0.01 + 4 * np.sqrt(pair * (1 - pair) / DRAWS), method
