"""How far apart colours look, to eyes of each kind.

Deficient sight after Machado, Oliveira and Fernandes, IEEE Trans. Vis. Comput. Graph. 15, 1291
(2009), at full severity, in linear sRGB; differences by CIEDE2000 (Sharma, Wu and Dalal, Color Res.
Appl. 30, 21, 2005). A just noticeable one is about 1; 10 tells colours apart at a glance.
"""

import numpy as np
from matplotlib.colors import to_rgb

SIGHT = {
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

_XYZ = np.array([
    [0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
    [0.0193339, 0.1191920, 0.9503041],
])  # fmt: skip


def linear(colours):
    """Linear sRGB (n, 3) of colours as matplotlib knows them."""
    rgb = np.array([to_rgb(colour) for colour in colours])
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """CIELAB (n, 3) of linear sRGB, under D65."""
    xyz = rgb @ _XYZ.T / _XYZ.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1
    )


def difference(one, two):
    """CIEDE2000 of CIELAB (..., 3)."""
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(np.asarray(c, float), -1, 0) for c in (one, two))
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1 + 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25.0**7)))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    hue = np.where(grey, h1 + h2, (h1 + turn / 2) % 360)
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    t = (
        1 - 0.17 * np.cos(np.radians(hue - 30)) + 0.24 * np.cos(np.radians(2 * hue))
        + 0.32 * np.cos(np.radians(3 * hue + 6)) - 0.20 * np.cos(np.radians(4 * hue - 63))
    )  # fmt: skip
    off = (lightness - 50) ** 2
    s_l, s_c = 1 + 0.015 * off / np.sqrt(20 + off), 1 + 0.045 * chroma
    s_h = 1 + 0.015 * chroma * t
    rotation = (
        -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
        * np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    )  # fmt: skip
    dl, dc = (l2 - l1) / s_l, (c2 - c1) / s_c
    dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / s_h
    return np.sqrt(dl**2 + dc**2 + dh**2 + rotation * dc * dh)


def apart(colours, sight):
    """Differences (n, n) of colours from each other; of each from itself infinite."""
    seen = lab(np.clip(linear(colours) @ SIGHT[sight].T, 0, 1))
    found = difference(seen[:, None], seen[None])
    np.fill_diagonal(found, np.inf)
    return found


def contrast(colour, page):
    """Contrast ratio of WCAG 2."""
    one, two = sorted(linear([colour, page]) @ np.array([0.2126, 0.7152, 0.0722]))
    return (two + 0.05) / (one + 0.05)
