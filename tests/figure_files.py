"""Files of figures and tables looked at: an empty frame or a blank page is none."""

from pathlib import Path

import matplotlib.image
import numpy as np


def has_content(file: Path) -> bool:
    """A picture has marks in colour, a table numbers; frames, words and grey are not enough."""
    if file.suffix != ".png":
        return any(character.isdigit() for character in file.read_text())
    colours = matplotlib.image.imread(file)[..., :3]
    return bool((np.ptp(colours, axis=2) > 0.2).mean() > 5e-4)
