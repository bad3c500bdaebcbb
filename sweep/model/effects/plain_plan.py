"""Plans in plain scenes: those of :func:`.planning.plan`, bit for bit, in one compiled pass.

Once for shots, whose footprints rays have found, and once for points on planes; from what the beams
meet on it is the same.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sweep.model.compiling import borrowing, owning
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import tile_geometry
from sweep.model.effects.catalogue import NAMES
from sweep.model.effects.footprint_fields import (
    APART,
    BESIDE,
    FIELDS,
    GAIN,
    OWN_RANGES,
    RANGES,
    VELOCITIES,
    WHOLE,
)
from sweep.model.effects.footprint_sum import put_at_points
from sweep.model.effects.leakage import unions
from sweep.model.effects.line_powers import put_amplitudes
from sweep.model.effects.plain_changes import (
    LEAKAGE,
    ROOM,
    SEGMENTS,
    Found,
    is_there,
    put_all_changes,
    put_tiles,
    tiles_for,
)
from sweep.model.effects.plain_scene import PLAIN, PlainScene, is_plain, light_over
from sweep.model.effects.plane_geometry import FIELDS as PLANE_FIELDS
from sweep.model.effects.plane_geometry import Beam, beam_of, put_planes
from sweep.model.effects.planning import Plan, Rules, choose
from sweep.model.effects.probability_bounds import CHANGE_FIELDS, changes_of, finish, put_all
from sweep.model.effects.span import Span
from sweep.model.effects.tile_geometry import OF_PLANES
from sweep.model.effects.tile_link import TileLink
from sweep.model.footprint import beamlets
from sweep.model.preparation import LASER, TELESCOPE
from sweep.model.reflectance import LAWS

VARYING = frozenset(
    (
        *OF_PLANES, "target.range", "target.reflectance", LASER + "power",
        TELESCOPE + "aperture", TELESCOPE + "optical_efficiency",
    )
)  # fmt: skip
"""Parameters that may differ within tiles of a plain scene's planes: all but the receiver's."""
DISTANCE, VELOCITY = FIELDS, FIELDS + 1
"""Rows of what is found of shots: after the fields of their footprints."""
_ROWS = np.array([NAMES.index(name) for name in PLAIN])


class PlainFlight(NamedTuple):
    """Plans of shots in a plain scene."""

    scene: PlainScene
    light: float
    """Echo [W] of 1/sr at 1 m."""

    @classmethod
    def of(cls, instrument: TileLink) -> "PlainFlight | None":
        """Of an instrument whose parameters are the same for all shots; None as of scenes."""
        scene = PlainScene.of(instrument)
        white = {**instrument.parameters, "target.reflectance": Span.of(1.0)}
        return None if scene is None else cls(scene, float(light_over(white).low))

    def plan(self, found: np.ndarray, edges: np.ndarray, rules: Rules, tolerance: float) -> Plan:
        """The plan of tiles of shots, as of :func:`.planning.plan`; Doppler must not be off.

        Parameters
        ----------
        found : (fields + 2, n) ndarray
            Of the shots' footprints; their ranges [m] and radial velocities [m/s].
        edges : (tiles + 1,) int ndarray
            Tile i holds the shots from ``edges[i]`` up to ``edges[i + 1]``, one at least.
        rules, tolerance
            Of modes; on the sum of what is left out.
        """
        spans = tile_geometry.over(found, edges)
        ends, made = (np.asarray(spans.low), np.asarray(spans.high)), _room(edges.size - 1)
        _plan_shots(ends, self.light, tuple(self.scene), _asked(rules, tolerance), made)
        return Plan(rules.names, *made)


class PlainPlanes(NamedTuple):
    """Plans of points on planes of a plain scene, of which some parameters vary within tiles."""

    scene: PlainScene
    law: int
    """Place of the reflectance law in :data:`sweep.model.reflectance.LAWS`."""
    beam: Beam
    pattern: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Of :func:`.footprint_sum.put_at_points`."""
    light: Span | None
    """Echo [W] of 1/sr at 1 m, where it is the same in all tiles."""

    @classmethod
    def of(cls, parameters: Mapping[str, Span | str]) -> "PlainPlanes | None":
        """Of some tiles' parameters, for all whose others than :data:`VARYING` are the same.

        None where there may be more than plain effects, or others vary.
        """
        for path, value in parameters.items():
            if isinstance(value, Span) and path not in VARYING and not _is_number(value):
                return None
        instrument = TileLink(parameters)
        if not is_plain(instrument, rotating=False):
            return None
        scene, light = PlainScene.of(instrument), light_over(parameters)
        number, pattern = instrument.beamlets
        (across, along), share = beamlets(number, pattern)
        return scene and cls(
            scene=scene,
            law=LAWS.index(instrument.word("target.reflectance_law")),
            beam=beam_of(number, pattern, instrument.architecture),
            pattern=(across, along, share),
            light=light if _is_number(light) else None,
        )

    def plan(
        self, parameters: Mapping[str, Span | str], size: int, rules: Rules, tolerance: float
    ) -> Plan:
        """The plan of some tiles, as of :func:`.planning.plan`; Doppler must not be off.

        Parameters
        ----------
        parameters : mapping
            As of :meth:`.block.Block.of_plane`.
        size : int
            Tiles.
        rules, tolerance
            Of modes; on the sum of what is left out.
        """
        spans = [parameters[path] for path in (*OF_PLANES, "target.range")]
        given, made = np.empty((12, size)), _room(size)
        light = self.light or light_over(parameters)
        for k, span in enumerate((*spans, light)):
            given[2 * k], given[2 * k + 1] = span.low, span.high  # type: ignore[union-attr]
        plane = self.law, self.beam, self.pattern
        _plan_points(given, plane, tuple(self.scene), _asked(rules, tolerance), made)
        return Plan(rules.names, *made)


def _is_number(span: Span) -> bool:
    return isinstance(span.low, float) and bool(span.low == span.high)


def _room(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Room for what is kept, what it changes, and what is left out."""
    change = np.zeros((len(NAMES), size))
    return np.zeros(change.shape, np.bool_), change, np.empty(size)


def _asked(rules: Rules, tolerance: float) -> tuple[Any, ...]:
    """What is asked for, in plain tuples, whose types are told at once."""
    return rules.asks_for_leakage, rules.spreading, tuple(rules.choice), tolerance


@owning(nogil=True)
def _plan_shots(ends, light, scene, asked, made):
    """Plans of tiles of shots."""
    (low, high), scene, number = ends, PlainScene(*scene), ends[0].shape[1]
    room = np.empty((ROOM, SEGMENTS * number))
    moments, given, ratio = np.empty((9, number)), np.empty((10, number)), np.ones((2, number))
    for t in range(number):
        for k in range(3):
            moments[k, t], moments[3 + k, t] = high[RANGES + k, t], high[OWN_RANGES + k, t]
            moments[6 + k, t] = high[VELOCITIES + k, t] * (SPEED_OF_LIGHT / 2)
        given[0, t], given[1, t] = low[DISTANCE, t], high[DISTANCE, t]
        given[2, t], given[3, t] = low[VELOCITY, t], high[VELOCITY, t]
        given[4, t], given[5, t] = light, light
        given[6, t], given[7, t] = low[WHOLE, t], high[WHOLE, t]
        given[8, t], given[9, t] = low[GAIN, t], high[GAIN, t]
    found = Found(
        given[:2], given[2:4], given[4:6], given[6:8], ratio, given[8:], moments, high[BESIDE],
        high[APART],
    )  # fmt: skip
    tiles = tiles_for(found)
    put_tiles(tiles, scene, room)
    _plan(tiles, scene, room, asked, made)


@owning(nogil=True)
def _plan_points(given, plane, scene, asked, made):
    """Plans of tiles of points on planes.

    ``given``: ends of what :func:`.plane_geometry.put_planes` takes, of ranges, and of the light.
    """
    (law, beam, pattern), scene, number = plane, PlainScene(*scene), given.shape[1]
    room, none = np.empty((ROOM, SEGMENTS * number)), np.zeros(number)
    fields, moments = np.empty((PLANE_FIELDS, number)), np.empty((9, number))
    put_planes(given[:8], law, beam, fields)
    for t in range(number):
        for k in range(3):
            moments[k, t], moments[3 + k, t] = fields[6 + k, t], fields[6 + k, t]
            moments[6 + k, t] = fields[9 + k, t]
    found = Found(
        given[8:10], given[4:6], given[10:], fields[:2], fields[2:4], fields[4:6], moments, none,
        none,
    )  # fmt: skip
    tiles = tiles_for(found)
    put_tiles(tiles, scene, room)
    if scene.amplitudes and scene.beamlets > 1:
        _tell_sums(given, law, pattern, tiles, scene)
    _plan(tiles, scene, room, asked, made)


@owning()
def _tell_sums(given, law, pattern, tiles, scene):
    """What amplitudes add up to in tiles of one point: :func:`.footprint_sum.footprint_sum`."""
    number = given.shape[1]
    point, sums = np.empty((15, 1)), np.empty((2, SEGMENTS, 1))
    for t in range(number):
        if not _is_point(given[:, t]):
            continue
        for k in range(5):
            point[k, 0] = given[2 * k, t]
        point[5, 0], point[6, 0], point[7, 0] = scene.rate, scene.middle, scene.ends[6, 0, 0]
        point[8, 0] = given[4, t] * 2 / SPEED_OF_LIGHT
        for s in range(SEGMENTS):
            point[9 + s, 0] = scene.ends[s, 0, 0]
            point[12 + s, 0] = tiles.axis[5, s * number + t]
        put_at_points(point, pattern, law, sums)
        alone = np.sqrt(np.maximum(tiles.found.ratio[1, t], 1.0))
        for s in range(SEGMENTS):
            i = s * number + t
            tiles.most[i] = np.minimum(tiles.most[i], np.maximum(sums[0, s, 0], alone))
            tiles.lean[i] = np.minimum(tiles.lean[i], sums[1, s, 0])


@borrowing()
def _is_point(given):
    """Whether a tile's points all lie at one place of a plane, and move alike."""
    found = True
    for k in range(0, 10, 2):
        found &= given[k] == given[k + 1]
    return found


@owning()
def _plan(tiles, scene, room, asked, made):
    """Mark what is kept, say what it changes, (effects, tiles), and what is left out, (tiles,)."""
    (kept, change, error), (wanted, spreading, choice, tolerance) = made, asked
    number, there = len(error), np.zeros(len(change), np.bool_)
    flat = np.empty((LEAKAGE, CHANGE_FIELDS, SEGMENTS * number))
    put_all_changes(tiles, scene, room, flat)
    finish(flat)
    table = flat.reshape(LEAKAGE, CHANGE_FIELDS, SEGMENTS, number)
    without, leaking = np.empty((2, 2, SEGMENTS, number)), np.zeros((LEAKAGE, number))
    _put_without(tiles, scene, room, without)
    leaked = _leaked(table, without, tiles, scene)
    for k in range(LEAKAGE):
        there[_ROWS[k]] = is_there(k, tiles, scene)
        for t in range(number):
            leaking[k, t] = leaked[t] if wanted and spreading[_ROWS[k]] else 0.0
    told = changes_of(table, without, leaking)
    there[_ROWS[LEAKAGE]] = True
    for t in range(number):
        for k in range(LEAKAGE):
            change[_ROWS[k], t] = np.minimum(told[k, t], 1.0)
        change[_ROWS[LEAKAGE], t] = np.minimum(leaked[t], 1.0)
    choose(change, there, choice, tolerance, kept, error)


@borrowing()
def _put_without(tiles, scene, room, out):
    """Ends of amplitude and threshold over sigma, (2, 2, 3, tiles): :attr:`.Block.amplitude`."""
    number, cells, given = tiles.found.beside.size, tiles.axis.shape[1], room[:6]
    for i in range(cells):
        given[0, i], given[1, i] = tiles.peak[0, i % number], tiles.peak[1, i % number]
        given[2, i], given[3, i] = tiles.axis[0, i], tiles.axis[1, i]
        given[4, i], given[5, i] = tiles.axis[3, i], tiles.axis[4, i]
        out[1, 0, i // number, i % number] = scene.threshold
        out[1, 1, i // number, i % number] = scene.threshold
    highest, lowest = scene.tables
    put_amplitudes(given, highest, lowest, out[0].reshape(2, cells))


@owning()
def _leaked(changes, without, tiles, scene):
    """What leakage may change, (tiles,): :func:`.leakage.bound`."""
    number, cells = tiles.found.beside.size, tiles.axis.shape[1]
    left, given, found = np.empty(without.shape), np.empty((7, cells)), np.zeros(number)
    put_all(changes, without, left)
    for i in range(cells):
        s, t = i // number, i % number
        given[0, i], given[1, i], given[2, i] = tiles.in_phase[i], tiles.most[i], tiles.lean[i]
        given[3, i], given[4, i] = tiles.peak[1, t], left[0, 0, s, t]
        given[5, i], given[6, i] = left[1, 0, s, t], left[1, 1, s, t]
    cell = unions(
        tiles.axis, given, scene.tails, scene.sidelobes, scene.far, scene.bins, not scene.amplitudes
    )
    for i in range(cells):
        found[i % number] += cell[i]
    return found
