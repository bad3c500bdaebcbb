"""Spectra of single shots of a scene against the store's statistics and the beamlets' beats."""

import numpy as np
import pytest
import xarray as xr

from sweep.analysis import shot_spectra
from sweep.analysis.datasets import open_scene_tree
from sweep.analysis.scene_results.recordings import (
    find_axis_position,
    find_multi_surface_shot,
    read_eyepoints,
)
from sweep.analysis.selection import parameters_at
from sweep.analysis.shot_spectra import BinGroup, DisplayedSegment, simulate_prepared_shot
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import effect_names_in_flags
from sweep.model.pointcloud.eyepoints import prepare_eyepoint_shots
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG


@pytest.fixture(scope="module")
def recording(scene_store, spec):
    return find_axis_position(spec, {"power": "1 W"}).open_recording(
        open_scene_tree(scene_store), "pair"
    )


@pytest.fixture(scope="module")
def arrays(scene_store):
    return xr.open_zarr(scene_store, group="pair", chunks=None).isel(power=1).load()


def one(scene_store, spec, recording, number, seed=None):
    eyepoints = read_eyepoints(scene_store, recording.dataset, np.array([number]))
    parameters = parameters_at(spec, find_axis_position(spec, {"power": "1 W"}).axis_indices)
    effects = effect_names_in_flags(
        int(recording.read_array("effects", slice(number, number + 1))[0])
    )
    prepared = prepare_eyepoint_shots(eyepoints, parameters, spec.surface_materials(), effects)
    return eyepoints, simulate_prepared_shot(prepared, parameters, seed=seed)


def test_the_shot_of_several_surfaces_is_the_first_with_true_points_of_two(recording, arrays):
    for draw in range(2):
        first = next(
            shot
            for shot in range(arrays.sizes["shot"])
            if len(
                {
                    int(surface)
                    for surface, flags in zip(
                        arrays.surface.values[shot, draw], arrays.flags.values[shot, draw],
                        strict=True,
                    )
                    if flags & TRUE_RETURN_FLAG
                }
            ) == 2
        )  # fmt: skip
        assert find_multi_surface_shot(recording, draw) == first


def test_without_true_points_of_two_surfaces_several_groups_will_do(scene_store, spec):
    square = find_axis_position(spec, {"power": "1 W"}).open_recording(
        open_scene_tree(scene_store), "square"
    )
    values = square.dataset.load()
    without_surfaces = square.dataset.assign(surface=xr.zeros_like(values.surface))
    shot_view = type(square)("square", without_surfaces)
    expected = int(np.flatnonzero(values.surfaces_seen.values >= 2)[0])
    assert find_multi_surface_shot(shot_view) == expected
    none = without_surfaces.assign(surfaces_seen=xr.zeros_like(values.surfaces_seen))
    assert find_multi_surface_shot(type(square)("square", none)) is None


@pytest.mark.parametrize("number", [5, 120, 250])
def test_a_shot_drawn_again_has_the_statistics_that_the_store_holds(
    scene_store, spec, recording, arrays, number
):
    _, shot = one(scene_store, spec, recording, number)
    for name in ("pd_up", "pd_down", "pd_doppler", "snr_up"):
        assert shot.outputs[name] == pytest.approx(float(arrays[name][number]), rel=1e-12)


def test_two_surfaces_have_a_peak_each_where_their_own_range_beats(scene_store, spec, recording):
    number = find_multi_surface_shot(recording)
    eyepoints, shot = one(scene_store, spec, recording, number)
    sheet = shot_spectra.draw_scene_shot_sheet(
        shot, eyepoints, ["ground", "block"], title="T", remarks=["told"]
    )
    up, close = shot.segments[0], sheet.axes[1]
    marks = {line.get_label(): line for line in close.lines if line.get_marker() == "|"}
    assert set(marks) == {"ground", "block"}
    bin_ = 600e6 / 2**15
    peaks = [up.frequency[group.peak_index] for group in up.bin_groups]
    hit = eyepoints.surface[0] >= 0
    for surface, name in enumerate(("ground", "block")):
        on_surface = hit & (eyepoints.surface[0] == surface)
        # the up-chirp's beat: 2 v / lambda less 2 R S / c, to the millionth of the range's part
        beat = (
            2 * (eyepoints.radial_velocity[0] + eyepoints.velocity_offset[0]) / 1550e-9
            - 2 * (eyepoints.range[0] + eyepoints.offset[0]) * (1e9 / 500e-6) / SPEED_OF_LIGHT
        )[on_surface]
        peak_frequencies = 1e6 * np.sort(marks[name].get_xdata())
        assert peak_frequencies == pytest.approx(np.sort(np.abs(beat)), abs=0.01 * bin_)
        assert min(abs(peak - f) for peak in peaks for f in peak_frequencies) < 1.5 * bin_
    low, high = close.get_xlim()
    assert all(low < 1e-6 * peak < high for peak in peaks)
    assert "told" in sheet.get_supxlabel().lower()


def test_views_reach_over_all_detections_but_not_to_those_far_away():

    signal = np.full(4000, 1e-9)
    signal[1000] = 1.0
    groups = tuple(BinGroup(k, k, k) for k in (950, 1000, 1140, 3900))
    segment = DisplayedSegment(
        "up-chirp",
        1,
        np.arange(4000),
        np.arange(4000.0),
        signal,
        signal,
        0.0,
        0.0,
        groups,
        1.0,
        1.0,
    )
    view = shot_spectra.detection_bin_slice(segment)
    assert 900 < view.start < 950 and 1140 < view.stop < 1200
