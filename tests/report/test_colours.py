"""Colours of lines stay apart for every eye, and stand out from what they are drawn on."""

import numpy as np
import pytest
from colour_vision import (
    VISION_MATRICES,
    ciede2000,
    colour_differences,
    contrast_ratio,
    to_cielab,
    to_linear_srgb,
)

from sweep.analysis import canvas
from sweep.report import html_page

PALETTES = {
    "print": (
        canvas.LINE_COLOURS,
        "#ffffff",
        2.2,
    ),  # Okabe's orange and sky blue; dashes differ as well
    "light page": (html_page.PAGE_LINE_COLOURS["light"], "#ffffff", 4.5),
    "dark page": (html_page.PAGE_LINE_COLOURS["dark"], "#111417", 4.5),
}

AT_A_GLANCE, FIRST_FOUR = 10.0, 12.0
"""Least CIEDE2000 between two colours of lines, and between those that most charts end with."""

PUBLISHED = (
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, -1.0, 2.0), (50.0, 0.0, 0.0), 2.3669),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
)
"""Sharma, Wu and Dalal (2005), Table 1."""


@pytest.mark.parametrize("sight", VISION_MATRICES)
@pytest.mark.parametrize("palette", PALETTES)
def test_lines_stay_apart_and_stand_out(palette, sight):
    colours, paper, least = PALETTES[palette]
    differences = colour_differences(colours, sight)
    assert differences.min() >= AT_A_GLANCE
    assert differences[:4, :4].min() >= FIRST_FOUR
    assert colour_differences((*colours, paper), sight)[-1].min() >= 2 * AT_A_GLANCE
    assert min(contrast_ratio(colour, paper) for colour in colours) >= least


def test_differences_are_the_published_ones():
    for one, two, expected in PUBLISHED:
        assert ciede2000(one, two) == pytest.approx(expected, abs=1e-4)
        assert ciede2000(two, one) == pytest.approx(expected, abs=1e-4)
    assert to_cielab(to_linear_srgb(["white"])) == pytest.approx(
        np.array([[100.0, 0, 0]]), abs=1e-6
    )
    assert contrast_ratio("#ffffff", "#000000") == pytest.approx(21)


def test_each_sight_keeps_greys_and_loses_what_it_lacks():
    greys = np.array([[0.2] * 3, [0.7] * 3])
    for sight in VISION_MATRICES.values():
        assert greys @ sight.T == pytest.approx(greys, abs=1e-5)
    pairs = {"protanopia": ("#D55E00", "#8C6D31"), "tritanopia": ("#56B4E9", "#35D0A5")}
    for sight, pair in pairs.items():
        assert (
            colour_differences(pair, sight)[0, 1]
            < AT_A_GLANCE
            < 15
            < colour_differences(pair, "normal")[0, 1]
        )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_lines_differ_in_dashes_too_and_surfaces_stand_out(scheme):
    assert (
        len(set(html_page.PLOTLY_DASH_STYLES))
        == len(html_page.PLOTLY_DASH_STYLES)
        == len(html_page.PAGE_LINE_COLOURS[scheme])
    )
    _, paper, _ = PALETTES[f"{scheme} page"]
    ends = [stop[1] for stop in html_page.colour_themes()[scheme]["scale"]]
    assert min(contrast_ratio(colour, paper) for colour in ends) >= 2
