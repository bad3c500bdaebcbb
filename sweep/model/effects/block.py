"""What the effects' bounds look at: the scene of some tiles at once, as spans over their points.

A tile is a stretch of a study's points that is planned as a whole. Its block knows, for each
tile, the least and the largest value of every parameter (:class:`~sweep.model.effects.span.Span`)
and of what :func:`sweep.model.preparation.bare` would compute from them anywhere between, by the
same formulas at the ends. Nothing is computed before it is asked for.
"""

from functools import cached_property

import numpy as np

from sweep.model.effects import line_spread, tile_geometry
from sweep.model.effects.columns import columns
from sweep.model.effects.line_powers import put_amplitudes
from sweep.model.effects.line_spread import Line, Moments, Spreads
from sweep.model.effects.span import Span, monotone
from sweep.model.effects.tile_geometry import Geometry
from sweep.model.effects.tile_link import Parameters, TileLink
from sweep.model.preparation import relative_amplitude


class Block(TileLink):
    """Some tiles whose points are all of one category: of :meth:`of_plane`, or of shots.

    Spans have one entry a tile, or are scalars where all tiles share them.
    """

    def __init__(
        self,
        parameters: Parameters,
        size: int,
        geometry: Geometry,
        *,
        at_rest: bool = False,
        instrument: TileLink | None = None,
    ) -> None:
        super().__init__(parameters, instrument)
        self.size, self.geometry = size, geometry
        self._at_rest = at_rest
        self.number, self.pattern = self.beamlets
        self.coherent = self.word("footprint.phases") == "coherent"
        self.segment_exists = (True, self.architecture != "direct", True)
        self.adds_amplitudes = self.coherent or self.architecture == "direct"
        self.grazing_angle, self.echo, self.echo_ratio, self.gain = (
            geometry.grazing_angle, geometry.echo, geometry.echo_ratio, geometry.gain,
        )  # fmt: skip
        self.ranges, self.velocities = geometry.ranges, geometry.velocities
        self.beside_share, self.beside_apart = geometry.beside_share, geometry.beside_apart
        self.rotating = geometry.rotating

    @classmethod
    def of_plane(cls, parameters: Parameters) -> "Block":
        """Tiles of points on a flat plane.

        Parameters
        ----------
        parameters : mapping
            Dotted path to a span over each tile, or to the word that all share: every parameter,
            those that effects bring among them.
        """
        spans = [value for value in parameters.values() if isinstance(value, Span)]
        ends = (end for span in spans for end in (span.low, span.high))
        sizes = {end.size for end in ends if isinstance(end, np.ndarray) and end.ndim} - {1}
        if len(sizes) > 1:
            raise ValueError(f"spans over different numbers of tiles: {sizes}")
        geometry = tile_geometry.plane(parameters, *TileLink(parameters).beamlets)
        return cls(parameters, max(sizes, default=1), geometry)

    @property
    def reach(self) -> float:
        """Farthest beamlet from the axis in the beam's standard deviations."""
        return line_spread.reach_of(self.number, self.pattern)

    def at_rest(self) -> "Block":
        """The same tiles without the Doppler effect."""
        return Block(self.parameters, self.size, self.geometry, at_rest=True, instrument=self)

    @cached_property
    def lines(self) -> Line:
        """The line on the beam's axis, (3, tiles) by segment.

        Where the Doppler effect moves it so little that it may be left out, with and without it.
        """
        if self._at_rest:
            return self.resting_lines
        return self._lines(line_spread.with_and_without(self._ends, self.doppler_shift))

    @cached_property
    def resting_lines(self) -> Line:
        """The same at no radial velocity."""
        return self._lines(self._axis_ends(Span.of(0.0)))

    @cached_property
    def doppler_shift(self) -> np.ndarray:
        """Bins by which the Doppler effect moves lines at the most, >= 0 (unfolded), (3, tiles)."""
        return line_spread.doppler_shifts(self._ends)

    @cached_property
    def _ends(self) -> np.ndarray:
        return self._axis_ends(self.beta)

    def _axis_ends(self, beta: Span) -> np.ndarray:
        return line_spread.axis_ends(self.size, self.instrument_ends, range=self.range, beta=beta)

    def _lines(self, ends: np.ndarray) -> Line:
        return line_spread.axis_lines(ends, window=self.window, fft_size=self.fft_size)

    @cached_property
    def beat(self) -> Span:
        """Magnitude of the largest bin, had the bare line unit transfer and lay on a bin [V]."""
        relative = monotone(
            lambda echo: relative_amplitude(self.architecture, np.asarray(echo)), echo=self.echo
        )
        return self.beat_scale.times(0.5, relative, self.window.sum)

    @cached_property
    def peak(self) -> Span:
        """The same over sigma."""
        return self.beat / self.deviation

    @cached_property
    def amplitude(self) -> Span:
        """Magnitude of the largest bin of the bare line, moving, over sigma, (3, tiles).

        No image is in it. In direct detection's Doppler segment, which does not exist, it is 0.
        """
        line, peak = self.lines, self.peak
        table, shape = columns(
            peak.low, peak.high, line.bin_offset, line.bin_offset_least, line.transfer,
            line.transfer_least,
        )  # fmt: skip
        found = np.empty((2, *shape))
        put_amplitudes(table, line.lobe.highest, line.lobe.lowest, found.reshape(2, -1))
        if self.architecture == "direct":
            found[:, 1] = 0.0
        return Span(found[0], found[1])

    @cached_property
    def spreads(self) -> Spreads:
        """Bins by which ranges and velocities put the lines off the axis's, (3, tiles)."""
        return self._spreads(self.geometry.own_ranges)

    def of_ranges(self, ranges: Moments) -> Moments:
        """Moments of relative ranges in bins, (3, tiles)."""
        return self._spreads(ranges).own_ranges

    def _spreads(self, own_ranges: Moments) -> Spreads:
        return line_spread.spreads(
            self._ends, ranges=self.ranges, own_ranges=own_ranges, velocities=self.velocities
        )

    @property
    def spread(self) -> Moments:
        """Those of ranges and velocities together."""
        return self.spreads.both

    @cached_property
    def axis(self) -> np.ndarray:
        """Fields of :attr:`lines` and :attr:`spread` as rows, (9, segments x tiles)."""
        return np.concatenate((*self.lines[:-1], *self.spread)).reshape(9, -1)
