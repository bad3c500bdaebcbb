"""Point clouds: what an instrument reports of a flight's eyepoints, shot by shot and draw by draw.

Every point comes with its position in the world, its standard errors and the truth: surface, range
and radial velocity of the beamlet that it has seen, and flags that say what it is.

A shot that sees nothing has noise alone in its record: its false alarms are the largest of all bins
that are counted, drawn like those of any other shot, from the same addresses. A shot sees the air
once: all its draws, and its probabilities, have the scintillation of its own key. Results of a shot
do not depend on the shots and draws that are computed with it.
"""

from collections.abc import Collection, Sequence

import numpy as np

from sweep.model.detectors import FIXED
from sweep.model.effects.catalogue import CORE, DEFAULTS
from sweep.model.effects.effect import Realisation, Scene
from sweep.model.estimators import DETECTOR
from sweep.model.eyepoints import Eyepoints, seen_ground
from sweep.model.geometry.mesh import Surface
from sweep.model.ground import Footprints
from sweep.model.groups import Groups, groups
from sweep.model.leaked_peaks import LeakedPeaks, groups_with_leaks, leaked_peaks
from sweep.model.marcum import at_least_one
from sweep.model.noisy_spectra import Methods
from sweep.model.outputs import POINTS, STATISTICS
from sweep.model.own_motion import MotionPriors, own_motion
from sweep.model.preparation import Parameters, Shots, as_arrays
from sweep.model.ray_error import ray_error
from sweep.model.realisations import random_effects
from sweep.model.returns import Returns, draw_returns
from sweep.model.sampling import SPECTRA
from sweep.model.shot import prepare_cast
from sweep.model.spectra_returns import spectra_returns
from sweep.model.unsupported import UnsupportedShot
from sweep.model.waveform import STRONGEST

STRETCH = 1 << 20
"""Numbers held at once beside the result: what a stretch of shots needs while it is computed."""

_NOWHERE = 1.0
"""Range [m] of a shot that sees nothing. No light comes back from there."""


def cloud(
    eyepoints: Eyepoints,
    *,
    parameters: Parameters,
    surfaces: Sequence[Surface],
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int = 1,
    method: str = "probabilities",
    methods: Methods = Methods(),  # noqa: B008  # a tuple
    returns: int = 4,
    effects: Collection[str] = CORE,
    flags: np.ndarray | None = None,
    estimates_rays: bool = False,
    priors: MotionPriors = MotionPriors(),  # noqa: B008  # a tuple
) -> dict[str, np.ndarray]:
    """Statistics and points of n shots, whether they see anything or not.

    Arrays are those of :data:`sweep.model.outputs.STATISTICS`, (n,), and
    :data:`sweep.model.outputs.POINTS`, (n, draws, returns[, 3]). `keys` (n, 2) are random, `method`
    is ``probabilities``, ``noise`` or ``spectra``. `returns` is the number of groups that are
    looked at in a segment, and of points of a shot and draw; ``surfaces_seen`` counts no more.
    `effects` and `flags` are as of :func:`sweep.model.shot.prepare_cast`. `estimates_rays` asks for
    ``beamlets_error``, which needs powers that add and is else nan. ``surface``, ``true_range`` and
    ``true_radial_velocity`` are those of the beamlet that a true or a misread point has seen: the
    error of a misread one shows. `priors` are what the instrument knows beforehand of motion that
    it does not measure; standard errors have it.
    """
    n = len(eyepoints.time)
    sizes = {"shot": n, "draw": draws, "return_number": returns, "xyz": 3}
    results = {name: output.empty(sizes) for name, output in (STATISTICS | POINTS).items()}
    step = max(1, STRETCH // (12 * draws * returns + 12 * eyepoints.weight.size))
    for first in range(0, n, step):
        part = slice(first, first + step)
        seen = eyepoints.some(part)
        own = None if flags is None else flags[part]
        called = effects, own, keys[part]
        try:
            shots, rays, found, leaks = _groups(seen, parameters, surfaces, returns, called)
        except UnsupportedShot as error:
            if error.point is None:
                raise
            time = float(seen.time[error.point])
            at = first + error.point
            raise UnsupportedShot(f"the shot at time {time:.6g} s: {error}", at) from None
        numbers = {"first_draw": first_draw, "draws": draws}
        if method == SPECTRA:
            if shots.peaks == STRONGEST or parameters.get(DETECTOR + "kind", FIXED) != FIXED:
                # Probabilities are those of crossing the fixed threshold.
                found = found._replace(pd=found.pd * np.nan, leakage=found.leakage * np.nan)
            drawn = spectra_returns(
                shots,
                found,
                keys=keys[part],
                parameters=parameters,
                methods=methods,
                motion=own_motion(seen, priors),
                **numbers,
            )
        else:
            drawn = draw_returns(
                shots,
                found,
                keys=keys[part],
                method=method,
                motion=own_motion(seen, priors),
                leaks=leaks,
                **numbers,
            )
        left = np.full(shots.size, np.nan)
        if estimates_rays:
            left = ray_error(shots, rays, found.bin[:, :, 0], found.magnitude[:, :, 0])
        computed = _statistics(shots, found) | _points(seen, drawn, shots.offset.shape[1])
        computed["beamlets_error"] = np.where(seen.seen, left, np.nan)
        computed["beamlets"] = np.full(shots.size, seen.weight.size)
        for name, values in computed.items():
            results[name][part] = values
    return results


def _groups(
    eyepoints: Eyepoints,
    parameters: Parameters,
    surfaces: Sequence[Surface],
    most: int,
    called: tuple[Collection[str], np.ndarray | None, np.ndarray],
) -> tuple[Shots, Footprints, Groups, list[tuple[np.ndarray, LeakedPeaks]] | None]:
    """Return prepared shots, footprints, and groups in their spectra; no groups without a target.

    And their leaked peaks, where these had to be listed and are few. `called`: names of effects,
    flags of each shot, and the shots' keys.
    """
    (effects, flags, keys), seen = called, eyepoints.seen
    somewhere = eyepoints._replace(
        range=np.where(seen, eyepoints.range, _NOWHERE),
        radial_velocity=np.where(seen, eyepoints.radial_velocity, 0.0),
        acceleration=np.where(seen, eyepoints.acceleration, 0.0),
        approach=np.where(seen, eyepoints.approach, 0.0),
    )
    given, ground = seen_ground(somewhere, parameters, surfaces)
    shots = prepare_cast(given, ground, effects, flags)
    scene = Scene(as_arrays(DEFAULTS | dict(given)), ground)
    for effect in random_effects(effects):
        if effect.draw is not None:
            shots = effect.draw(shots, scene, Realisation(keys, np.zeros(shots.size, np.int64)))
    fades = shots.fading is not None and bool(shots.leakage)
    listed: list[tuple[np.ndarray, LeakedPeaks]] | None = None
    at_once = fades and shots.leak_amplitude is None and shots.band is None
    if at_once:
        found, listed = groups_with_leaks(shots, most)
    else:
        found = groups(shots, most=most, leakage=not fades)
    if not seen.all():
        blind = ~seen
        for bins in found[:3]:
            bins[blind] = -1
        found.neighbours[blind] = found.pd[blind] = np.nan
        found.exempted[blind] = found.leakage[blind] = 0.0
    if fades and not at_once:
        listed = [] if shots.leak_amplitude is None else None  # a line has a great many bins
        for part, leaks in leaked_peaks(shots, found, np.flatnonzero(seen)):
            found.leakage[part] = leaks.mean_leakage()
            if listed is not None:
                listed.append((part, leaks))
    return shots, ground.beamlets, found, listed


def _statistics(shots: Shots, found: Groups) -> dict[str, np.ndarray]:
    """Probabilities before any draw, (n,) each."""
    up, doppler, down = found.pd[:, :, 0].T
    both = shots.both(up, down, (found.magnitude[:, 0, 0], found.magnitude[:, 2, 0]))
    one = np.exp(shots.looks.log_alarm(shots.threshold / shots.bin_deviation))[:, None]
    noise = at_least_one(one, shots.counted_bins(found.exempted.T).T[:, [0, 2]])
    leakage = found.leakage[:, [0, 2]]
    alarm = leakage + noise * (1 - leakage)
    above = (found.bin[:, 0] >= 0) & (found.magnitude[:, 0] >= shots.threshold[:, None])
    return {
        "pd_up": up,
        "pd_down": down,
        "pd_doppler": doppler,
        "pd_shot": both,
        "pfa_up": alarm[:, 0],
        "pfa_down": alarm[:, 1],
        "snr_up": shots.snr(found.magnitude[:, 0, 0]),
        "surfaces_seen": above.sum(axis=1),
    }


def _points(eyepoints: Eyepoints, drawn: Returns, beamlets: int) -> dict[str, np.ndarray]:
    """Points and their truth, (n, draws, returns[, 3]) each."""
    known = drawn.beamlet >= 0
    shot = np.arange(len(known))[:, None, None]
    at = shot, np.maximum(drawn.beamlet, 0)
    if beamlets < eyepoints.weight.size:  # the footprint is left out: its one line is the axis's
        at = shot, np.broadcast_to(eyepoints.reference[:, None, None], known.shape)
    far = eyepoints.range[:, None, None] + eyepoints.offset[at]
    closing = eyepoints.radial_velocity[:, None, None] + eyepoints.velocity_offset[at]
    along = drawn.range_interpolated[..., None] * eyepoints.direction[:, None, None]
    reported = {name: getattr(drawn, name) for name in POINTS if name in Returns._fields}
    return reported | {
        "position": eyepoints.position[:, None, None] + along,
        "radial_velocity_compensated": drawn.radial_velocity_interpolated
        - eyepoints.own_velocity[:, None, None],
        "surface": np.where(known, eyepoints.surface[at], -1),
        "true_range": np.where(known, far, np.nan),
        "true_radial_velocity": np.where(known, closing, np.nan),
    }
