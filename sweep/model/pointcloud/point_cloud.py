"""Point clouds: the points that an instrument reports for a flight's eyepoints, by shot and draw.

Every point has a position in the world, standard errors and the truth: surface, range and radial
velocity of the beamlet that it measures, and flags
(:data:`sweep.model.pointcloud.pairing.FLAG_BITS`).

A shot that hits nothing has noise alone in its record. Its false alarms are drawn as those of any
other shot, with the same random numbers. The air does not change from draw to draw: all draws of a
shot, and its probabilities, have the same scintillation, which follows from the shot's random key.
Results of a shot do not depend on the shots and draws that are computed with it.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from sweep.model.detection.detection_probability import joint_detection_probability
from sweep.model.detection.detectors import FIXED_THRESHOLD_KIND
from sweep.model.detection.estimators import DETECTOR_PREFIX
from sweep.model.detection.marcum import at_least_one_probability
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.effects.effect import DrawAddresses, EffectContext
from sweep.model.evaluation import prepare_ray_traced_shots
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.ground import BeamletTable
from sweep.model.outputs import POINT_CLOUD_VARIABLES, SHOT_STATISTIC_VARIABLES
from sweep.model.pointcloud.bin_groups import BinGroups, list_bin_groups
from sweep.model.pointcloud.ego_motion import MotionPriors, ego_motion_of_eyepoints
from sweep.model.pointcloud.eyepoints import Eyepoints, parameters_and_ground_of_eyepoints
from sweep.model.pointcloud.leaked_peaks import (
    LeakageBins,
    find_groups_and_leakage_bins,
    iter_leakage_bins,
)
from sweep.model.pointcloud.ray_error import estimate_ray_error
from sweep.model.pointcloud.returns import Returns, draw_returns
from sweep.model.pointcloud.spectra_returns import draw_spectra_returns
from sweep.model.preparation import Parameters, Shots, parameters_as_arrays
from sweep.model.sampling.noisy_spectra import SpectrumMethods
from sweep.model.sampling.realisations import random_effects
from sweep.model.sampling.samplers import SPECTRA_METHOD
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import STRONGEST_PEAK

VALUES_PER_BATCH = 1 << 20
"""Largest number of array elements, without the results, in memory for shots that are computed
together."""

_EMPTY_SHOT_RANGE = 1.0
"""Range [m] that is set for a shot that hits nothing, so that it can be simulated. Its echo has no
power."""


def simulate_cloud(
    eyepoints: Eyepoints,
    *,
    parameters: Parameters,
    surfaces: Sequence[SurfaceMaterial],
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int = 1,
    method: str = "probabilities",
    methods: SpectrumMethods = SpectrumMethods(),  # noqa: B008  # a tuple
    returns_max: int = 4,
    effects: Collection[str] = DEFAULT_EFFECTS,
    effect_flags: np.ndarray | None = None,
    estimates_ray_error: bool = False,
    motion_priors: MotionPriors = MotionPriors(),  # noqa: B008  # a tuple
) -> dict[str, np.ndarray]:
    """Simulate n shots of a flight: return detection probabilities and measured points.

    Parameters
    ----------
    eyepoints
        Geometry of the n shots.
    parameters
        Parameters that `eyepoints` does not hold, by dotted path, scalars.
    surfaces
        Materials by the surface numbers of `eyepoints`.
    keys
        (n, 2) uint64: random key of each shot.
    first_draw, draws
        Number of the first draw, and count of draws.
    method
        Method of drawing: ``probabilities``, ``noise`` or ``spectra``.
    methods
        Detectors and estimators for ``spectra``.
    returns_max
        Largest number of groups (runs of adjacent bins above the threshold) in a segment, and of
        points in a shot and draw. ``surfaces_seen`` is at most this number.
    effects, effect_flags
        Names of effects, and bit masks, as for
        :func:`sweep.model.evaluation.prepare_ray_traced_shots`.
    estimates_ray_error
        True to estimate ``beamlets_error``, the error of probabilities and peaks due to too few
        rays. For this the beamlets must add in power. If False, it is nan.
    motion_priors
        Prior standard deviations of motion that the instrument does not measure; standard errors
        include them.

    Returns
    -------
    dict of str to ndarray
        :data:`sweep.model.outputs.SHOT_STATISTIC_VARIABLES`, (n,), and
        :data:`sweep.model.outputs.POINT_CLOUD_VARIABLES`, (n, draws, returns[, 3]). ``surface``,
        ``true_range`` and ``true_radial_velocity`` are those of the beamlet that a true or a
        misread point measures, so that the error of a misread point shows.
    """
    n_shots = len(eyepoints.time)
    sizes = {"shot": n_shots, "draw": draws, "return_number": returns_max, "xyz": 3}
    results = {
        name: output.empty_array(sizes)
        for name, output in (SHOT_STATISTIC_VARIABLES | POINT_CLOUD_VARIABLES).items()
    }
    step = max(1, VALUES_PER_BATCH // (12 * draws * returns_max + 12 * eyepoints.weight.size))
    for first in range(0, n_shots, step):
        shot_slice = slice(first, first + step)
        part_eyepoints = eyepoints.select(shot_slice)
        part_flags = None if effect_flags is None else effect_flags[shot_slice]
        effect_arguments = effects, part_flags, keys[shot_slice]
        try:
            shots, beamlet_table, bin_groups, known_leakage_bins = _prepare_batch(
                part_eyepoints, parameters, surfaces, returns_max, *effect_arguments
            )
        except UnsupportedShotError as error:
            if error.point_index is None:
                raise
            time = float(part_eyepoints.time[error.point_index])
            shot_index = first + error.point_index
            raise UnsupportedShotError(
                f"the shot at time {time:.6g} s: {error}", shot_index
            ) from None
        draw_arguments = {"first_draw": first_draw, "draws": draws}
        if method == SPECTRA_METHOD:
            if (
                shots.detection_settings.reported_peaks_option == STRONGEST_PEAK
                or parameters.get(DETECTOR_PREFIX + "kind", FIXED_THRESHOLD_KIND)
                != FIXED_THRESHOLD_KIND
            ):
                # Probabilities are those of crossing the fixed threshold.
                bin_groups = bin_groups._replace(
                    pd=bin_groups.pd * np.nan,
                    leakage_probability=bin_groups.leakage_probability * np.nan,
                )
            part_returns = draw_spectra_returns(
                shots,
                bin_groups,
                keys=keys[shot_slice],
                parameters=parameters,
                methods=methods,
                motion=ego_motion_of_eyepoints(part_eyepoints, motion_priors),
                **draw_arguments,
            )
        else:
            part_returns = draw_returns(
                shots,
                bin_groups,
                keys=keys[shot_slice],
                method=method,
                motion=ego_motion_of_eyepoints(part_eyepoints, motion_priors),
                known_leakage_bins=known_leakage_bins,
                **draw_arguments,
            )
        rays_error = np.full(shots.size, np.nan)
        if estimates_ray_error:
            rays_error = estimate_ray_error(
                shots,
                beamlet_table,
                bin_groups.strongest_bin[:, :, 0],
                bin_groups.magnitude[:, :, 0],
            )
        part_results = _closed_form_statistics(shots, bin_groups) | _point_cloud_arrays(
            part_eyepoints, part_returns, shots.footprint.n_beamlets
        )
        part_results["beamlets_error"] = np.where(part_eyepoints.has_target, rays_error, np.nan)
        part_results["beamlets"] = np.full(shots.size, part_eyepoints.weight.size)
        for name, values in part_results.items():
            results[name][shot_slice] = values
    return results


class _PreparedBatch(NamedTuple):
    """Prepared shots of a batch, with their footprints and noiseless echoes."""

    shots: Shots
    """Prepared shots, with all simulated effects."""
    beamlet_table: BeamletTable
    """Footprints of the shots, by beamlets (rays that sample the beam)."""
    bin_groups: BinGroups
    """Runs of adjacent bins above the threshold in the noiseless spectra. A shot without a target
    has none."""
    leakage_bins: list[tuple[np.ndarray, LeakageBins]] | None
    """List of pairs: indices of shots, and the bins in which leaked signal may raise false peaks in
    these shots. It is None if the bins were not listed, or are too many to keep."""


def _prepare_batch(
    eyepoints: Eyepoints,
    parameters: Parameters,
    surfaces: Sequence[SurfaceMaterial],
    groups_max: int,
    effects: Collection[str],
    effect_flags: np.ndarray | None,
    keys: np.ndarray,
) -> _PreparedBatch:
    """Prepare a batch of shots, and find echoes and leaked signal in their noiseless spectra.

    The arguments are those of :func:`simulate_cloud`; `groups_max` is its `returns_max`.
    """
    has_target = eyepoints.has_target
    placed_eyepoints = eyepoints._replace(
        range=np.where(has_target, eyepoints.range, _EMPTY_SHOT_RANGE),
        radial_velocity=np.where(has_target, eyepoints.radial_velocity, 0.0),
        acceleration=np.where(has_target, eyepoints.acceleration, 0.0),
        approach_speed=np.where(has_target, eyepoints.approach_speed, 0.0),
    )
    shot_parameters, ground = parameters_and_ground_of_eyepoints(
        placed_eyepoints, parameters, surfaces
    )
    shots = prepare_ray_traced_shots(shot_parameters, ground, effects, effect_flags)
    context = EffectContext(
        parameters_as_arrays(PARAMETER_DEFAULTS | dict(shot_parameters)), ground
    )
    for effect in random_effects(effects):
        if effect.perturb_shots is not None:
            shots = effect.perturb_shots(
                shots, context, DrawAddresses(keys, np.zeros(shots.size, np.int64))
            )
    leaks_in_speckle = shots.speckle.segment_correlations is not None and bool(
        shots.detection_settings.leakage_raises_false_alarms
    )
    known_leakage_bins: list[tuple[np.ndarray, LeakageBins]] | None = None
    finds_groups_with_leakage = (
        leaks_in_speckle
        and shots.permanent_line is None
        and shots.detection_settings.search_band is None
    )
    if finds_groups_with_leakage:
        bin_groups, known_leakage_bins = find_groups_and_leakage_bins(shots, groups_max)
    else:
        bin_groups = list_bin_groups(
            shots, groups_max=groups_max, with_leakage=not leaks_in_speckle
        )
    if not has_target.all():
        without_target = ~has_target
        for bins in (bin_groups.strongest_bin, bin_groups.first_bin, bin_groups.last_bin):
            bins[without_target] = -1
        bin_groups.peak_and_neighbour_magnitudes[without_target] = bin_groups.pd[without_target] = (
            np.nan
        )
        bin_groups.n_exempt_bins[without_target] = bin_groups.leakage_probability[
            without_target
        ] = 0.0
    if leaks_in_speckle and not finds_groups_with_leakage:
        known_leakage_bins = (
            [] if shots.permanent_line is None else None
        )  # the leak of a circulator has too many bins to keep
        for indices, leakage_bins in iter_leakage_bins(
            shots, bin_groups, np.flatnonzero(has_target)
        ):
            bin_groups.leakage_probability[indices] = leakage_bins.mean_leakage_probability()
            if known_leakage_bins is not None:
                known_leakage_bins.append((indices, leakage_bins))
    return _PreparedBatch(shots, ground.beamlet_table, bin_groups, known_leakage_bins)


def _closed_form_statistics(shots: Shots, bin_groups: BinGroups) -> dict[str, np.ndarray]:
    """Return statistics (n,) of shots that need no draws, by name.

    The names are those of :data:`sweep.model.outputs.SHOT_STATISTIC_VARIABLES`.
    """
    pd_up, pd_doppler, pd_down = bin_groups.pd[:, :, 0].T
    pd_both = joint_detection_probability(
        shots, pd_up, pd_down, (bin_groups.magnitude[:, 0, 0], bin_groups.magnitude[:, 2, 0])
    )
    pfa_bin = np.exp(shots.looks.log_pfa(shots.threshold / shots.bin_noise_sigma))[:, None]
    pfa_noise = at_least_one_probability(
        pfa_bin, shots.n_alarm_equivalent_bins(bin_groups.n_exempt_bins.T).T[:, [0, 2]]
    )
    p_leakage = bin_groups.leakage_probability[:, [0, 2]]
    pfa = p_leakage + pfa_noise * (1 - p_leakage)
    is_above_threshold = (bin_groups.strongest_bin[:, 0] >= 0) & (
        bin_groups.magnitude[:, 0] >= shots.threshold[:, None]
    )
    return {
        "pd_up": pd_up,
        "pd_down": pd_down,
        "pd_doppler": pd_doppler,
        "pd_shot": pd_both,
        "pfa_up": pfa[:, 0],
        "pfa_down": pfa[:, 1],
        "snr_up": shots.snr(bin_groups.magnitude[:, 0, 0]),
        "surfaces_seen": is_above_threshold.sum(axis=1),
    }


def _point_cloud_arrays(
    eyepoints: Eyepoints, shot_returns: Returns, n_lines: int
) -> dict[str, np.ndarray]:
    """Return measured points and their true values, as a mapping of arrays.

    The keys are the names in :data:`sweep.model.outputs.POINT_CLOUD_VARIABLES`, and the arrays are
    (n, draws, returns) or (n, draws, returns, 3). ``n_lines`` is the number of lines of a shot in
    ``shot_returns``. It is 1 if the effect of the footprint is skipped, else the number of
    beamlets.
    """
    has_beamlet = shot_returns.beamlet >= 0
    shot = np.arange(len(has_beamlet))[:, None, None]
    shot_and_beamlet = shot, np.maximum(shot_returns.beamlet, 0)
    if n_lines < eyepoints.weight.size:  # without a footprint the only line is the axis's
        shot_and_beamlet = (
            shot,
            np.broadcast_to(eyepoints.reference_beamlet[:, None, None], has_beamlet.shape),
        )
    true_range = eyepoints.range[:, None, None] + eyepoints.offset[shot_and_beamlet]
    true_velocity = (
        eyepoints.radial_velocity[:, None, None] + eyepoints.velocity_offset[shot_and_beamlet]
    )
    displacement = shot_returns.range_interpolated[..., None] * eyepoints.direction[:, None, None]
    reported = {
        name: getattr(shot_returns, name)
        for name in POINT_CLOUD_VARIABLES
        if name in Returns._fields
    }
    return reported | {
        "position": eyepoints.position[:, None, None] + displacement,
        "radial_velocity_compensated": shot_returns.radial_velocity_interpolated
        - eyepoints.platform_radial_velocity[:, None, None],
        "surface": np.where(has_beamlet, eyepoints.surface[shot_and_beamlet], -1),
        "true_range": np.where(has_beamlet, true_range, np.nan),
        "true_radial_velocity": np.where(has_beamlet, true_velocity, np.nan),
    }
