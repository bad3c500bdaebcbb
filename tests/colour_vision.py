"""How far apart colours look, to eyes of each kind.

Deficient sight after Machado, Oliveira and Fernandes, IEEE Trans. Vis. Comput. Graph. 15, 1291
(2009), at full severity, in linear sRGB; differences by CIEDE2000 (Sharma, Wu and Dalal, Color Res.
Appl. 30, 21, 2005). A just noticeable one is about 1; 10 tells colours apart at a glance.
"""

import numpy as np
from matplotlib.colors import to_rgb

VISION_MATRICES = {
    "normal": np.eye(3),
    "protanopia": np.array([
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ]),
    "deuteranopia": np.array([
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ]),
    "tritanopia": np.array([
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ]),
}  # fmt: skip

_XYZ_FROM_SRGB = np.array([
    [0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
    [0.0193339, 0.1191920, 0.9503041],
])  # fmt: skip


def to_linear_srgb(colours):
    """Linear sRGB (n, 3) of colours as matplotlib knows them."""
    rgb = np.array([to_rgb(colour) for colour in colours])
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def to_cielab(rgb):
    """CIELAB (n, 3) of linear sRGB, under D65."""
    xyz = rgb @ _XYZ_FROM_SRGB.T / _XYZ_FROM_SRGB.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1
    )


def ciede2000(first, second):
    """CIEDE2000 of CIELAB (..., 3)."""
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(np.asarray(c, float), -1, 0) for c in (first, second))
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    a_scale = 1 + 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25.0**7)))
    c1, c2 = np.hypot(a_scale * a1, b1), np.hypot(a_scale * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a_scale * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    is_grey = c1 * c2 == 0
    hue_difference = np.where(is_grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    hue = np.where(is_grey, h1 + h2, (h1 + hue_difference / 2) % 360)
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    t = (
        1 - 0.17 * np.cos(np.radians(hue - 30)) + 0.24 * np.cos(np.radians(2 * hue))
        + 0.32 * np.cos(np.radians(3 * hue + 6)) - 0.20 * np.cos(np.radians(4 * hue - 63))
    )  # fmt: skip
    lightness_offset_squared = (lightness - 50) ** 2
    s_l, s_c = (
        1 + 0.015 * lightness_offset_squared / np.sqrt(20 + lightness_offset_squared),
        1 + 0.045 * chroma,
    )
    s_h = 1 + 0.015 * chroma * t
    rotation = (
        -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
        * np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    )  # fmt: skip
    dl, dc = (l2 - l1) / s_l, (c2 - c1) / s_c
    dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(hue_difference / 2)) / s_h
    return np.sqrt(dl**2 + dc**2 + dh**2 + rotation * dc * dh)


def colour_differences(colours, vision):
    """Differences (n, n) of colours from each other; of each from itself infinite."""
    perceived = to_cielab(np.clip(to_linear_srgb(colours) @ VISION_MATRICES[vision].T, 0, 1))
    differences = ciede2000(perceived[:, None], perceived[None])
    np.fill_diagonal(differences, np.inf)
    return differences


def contrast_ratio(colour, background):
    """Contrast ratio of WCAG 2."""
    darker, lighter = sorted(
        to_linear_srgb([colour, background]) @ np.array([0.2126, 0.7152, 0.0722])
    )
    return (lighter + 0.05) / (darker + 0.05)
