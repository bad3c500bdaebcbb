"""Sheets of point clouds: the picture at the left, what its colours and marks mean at the right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas
from sweep.analysis.scenes.colours import Names, Scale

COLUMN = 1.75
"""Width of what stands at the right [inches]."""

HEAD, FOOT, LINE = 0.75, 0.55, 0.17
"""Heights of the title and of the small print's first line and of each further one [inches]."""


class Stage:
    """A sheet that a picture of a given size is put on.

    Parameters
    ----------
    width, height : float
        Size of the picture, its labels included [inches].
    title, note : str
        What stands over the sheet, and at its foot.
    """

    def __init__(self, width: float, height: float, *, title: str, note: str) -> None:
        self.width, self.height = width, height
        head = HEAD + 0.18 * title.count("\n")
        total = width + COLUMN
        foot = FOOT + LINE * (len(note) // int(15 * total))
        self.foot = foot
        self.sheet: Sheet = canvas.sheet(total, height + head + foot)
        self.sheet.set_layout_engine("none")
        canvas.title(self.sheet, title)
        canvas.caption(self.sheet, note)

    def rectangle(
        self, left: float, bottom: float, width: float, height: float
    ) -> tuple[float, float, float, float]:
        """A rectangle in inches from the picture's lower left corner, in shares of the sheet."""
        across, up = self.sheet.get_size_inches()
        return left / across, (self.foot + bottom) / up, width / across, height / up

    def explain(self, scale: Scale | Names, handles: Sequence[Artist]) -> None:
        """The colours' scale or names, and the marks' meaning."""
        if isinstance(scale, Scale):
            tall = min(0.72 * self.height, 4.2)
            at = self.rectangle(self.width + 0.15, (self.height - tall) * 0.62, 0.17, tall)
            scale.bar(self.sheet, self.sheet.add_axes(at))
        elif scale.names:
            self._legend(scale.handles(), 0.86 * self.height, scale.title, "upper left")
        if handles:
            self._legend(handles, 0.0, "", "lower left")

    def _legend(self, handles: Sequence[Artist], bottom: float, title: str, loc: Any) -> None:
        x, y, *_ = self.rectangle(self.width + 0.02, bottom, 0, 0)
        self.sheet.legend(
            handles=list(handles), title=title or None, loc=loc, bbox_to_anchor=(x, y),
            frameon=False, fontsize=8, handletextpad=0.5, borderaxespad=0.0,
        )  # fmt: skip

    def axes(self, *at: float, **options: Any) -> Axes:
        """Axes in a rectangle in inches from the picture's lower left corner."""
        return self.sheet.add_axes(self.rectangle(*at), **options)
