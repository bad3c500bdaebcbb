"""False peaks of leaked signal: their places, sizes and numbers by all three methods of drawing.

Whole spectra share no code with the others from the lines' spectrum on: they have noise in every
bin, and groups of flagged bins.
"""

import math
from functools import lru_cache, partial

import numpy as np
import pytest
from shot_helpers import make_point_keys, prepare_single_category
from small_scenes import level_plate, observe_shots, scene_parameters, straight_flight

from sweep.model import outputs
from sweep.model.detection.looks import SINGLE_LOOK
from sweep.model.detection.marcum import marcum_q1_excess, marcum_q1_tails
from sweep.model.detection.sub_bin_interpolation import interpolator
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.effects.circulator_leak import ISOLATION_PATH, LEAK_LENGTH_PATH
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.pointcloud import leaked_peaks as leaked
from sweep.model.pointcloud import returns
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.pairing import FALSE_ALARM_FLAG
from sweep.model.pointcloud.point_cloud import simulate_cloud
from sweep.model.sampling.philox import DrawAddress
from sweep.model.spectrum import permanent_line
from sweep.model.waveform import SEARCH_BAND_PATHS
from sweep.model.window import get_window

NUMBER = {"probabilities": 8000, "noise": 8000, "spectra": 1500}
"""Draws of a method in a scene.

Two samples of n and m independent draws have distributions whose largest difference exceeds
sqrt(ln(2 / p) (n + m) / (2 n m)) with a probability of p at the most [Dvoretzky, Kiefer and
Wolfowitz 1956; Wei and Dudley 2012]. Of one in a million that is 0.043 for 8,000 and 8,000, 0.076
for 8,000 and 1,500. Peaks in uniformly drawn bins differ by the share of draws that have one,
which is 0.15 here at the least.
"""
FALSE_SHARE = 0.15

SIZE, HEIGHT, ROOF = 2**12, 400.0, 12.0
RANGE_BIN = 299792458.0 * 600e6 / (4e12 * SIZE)
NEAR = 2.5
"""Bins up to which a point is the echo's own: noise moves peaks, and probabilities leave them."""

HAMMING = {"window": "hamming"}
RECORD = "instrument.receiver.record"
SKIRTS = {"instrument.chirp.sinusoidal_error": 2.5e5, "instrument.chirp.error_periods": 1500.0}
SCENES = {
    "strong ground and a dim roof": ({**HAMMING, "power": 200.0}, {}),
    "the same in "
    "speckle": ({**HAMMING, "power": 150.0, "effects": (*DEFAULT_EFFECTS, "fading")}, {}),
    "near ground": ({**HAMMING, "power": 0.8, "height": 60.0, "roof": False}, {}),
    "rectangular window and near ground": (
        {"window": "rectangular", "power": 0.4, "height": 30.0, "roof": False}, {},
    ),
    "rectangular window and near ground in speckle": (
        {"window": "rectangular", "power": 0.002, "height": 6.8, "roof": False,
         "effects": (*DEFAULT_EFFECTS, "fading")}, {},
    ),
    "complex record": (
        {**HAMMING, "power": 150.0, "effects": (*DEFAULT_EFFECTS, "fading")}, {RECORD: "complex"},
    ),
    "skirts of an uneven chirp": (
        {**HAMMING, "power": 3.0, "effects": (*DEFAULT_EFFECTS, "chirp_nonlinearity")}, SKIRTS,
    ),
}  # fmt: skip


def _allowed(n, m):
    return math.sqrt(math.log(2e6) * (n + m) / (2 * n * m))


def _flown(table_4_1, method, scene, *, draws=0, first=0):
    """Points of a shot on the edge of a dim roof over bright ground, or on the ground alone."""
    changes, further_options = SCENES[scene]
    changes = dict(changes)
    height, effects = changes.pop("height", HEIGHT), changes.pop("effects", DEFAULT_EFFECTS)
    roof = level_plate(x=(0.0, 30.0), surface=1, height=ROOF)
    bodies = [level_plate(x=(-1e3, 30.0)), *[roof] * changes.pop("roof", True)]
    path = straight_flight(position=(0.0, 0.0, height), velocity=(0.0, 0.0, -20.0))
    law = {"fft_size": SIZE, "detection": "any_bin", "noise_bins": "correlated"}
    table = scene_parameters(table_4_1, **law, **changes)
    speckle = "developed" if "fading" in effects else "none"
    starts = {"probabilities": 0, "noise": 10**6, "spectra": 2 * 10**6}
    cloud = simulate_cloud(
        observe_shots(path, bodies=bodies, number=7),
        parameters=PARAMETER_DEFAULTS | table | further_options | {"footprint.speckle": speckle},
        surfaces=[SurfaceMaterial("ground", 0.5), SurfaceMaterial("roof", 0.005)],
        keys=make_point_keys(1),
        effects=effects,
        method=method,
        draws=draws or NUMBER[method],
        first_draw=starts[method] + first,
    )
    return cloud, height


@pytest.fixture(scope="module")
def drawn_distances(table_4_1):
    """Distances and false points of the draws of a scene by a method, drawn once."""
    return lru_cache(partial(_distances, table_4_1))


def _distances(table_4_1, method, scene):
    """Of each draw the distance [bins] of its furthest point from any echo; and its false points.

    0 where all points are the echo's own, whole half bins elsewhere, as the ranges of up and down
    peaks are. Draws are independent of each other.
    """
    cloud, height = _flown(table_4_1, method, scene)
    distances, is_point = cloud["range"][0], cloud["flags"][0] > 0
    distance = np.minimum(np.abs(distances - height), np.abs(distances - height + ROOF)) / RANGE_BIN
    distance = np.where(is_point & (distance > NEAR), np.rint(2 * distance) / 2, 0.0)
    return distance.max(axis=1), (cloud["flags"][0] & FALSE_ALARM_FLAG > 0).any(axis=1)


def _difference(one, other):
    places = np.unique(np.concatenate([one, other]))
    shares = (np.searchsorted(np.sort(v), places, "right") / v.size for v in (one, other))
    return np.abs(np.subtract(*shares)).max()


@pytest.mark.parametrize("scene", list(SCENES))
@pytest.mark.parametrize("method", ["noise", "spectra"])
def test_points_are_as_far_from_the_echoes_as_in_drawn_noise(scene, method, drawn_distances):
    (by_chance, false), (in_noise, noisy) = (
        drawn_distances("probabilities", scene),
        drawn_distances(method, scene),
    )
    assert false.mean() > FALSE_SHARE
    allowed = _allowed(by_chance.size, in_noise.size)
    assert _difference(by_chance, in_noise) < allowed
    assert abs(false.mean() - noisy.mean()) < allowed


@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_any_split_of_draws_has_the_same_false_peaks(method, table_4_1):
    at_once, _ = _flown(table_4_1, method, "the same in speckle", draws=60)
    assert (at_once["flags"] & FALSE_ALARM_FLAG > 0).any()
    for first, number in ((0, 7), (7, 53)):
        part, _ = _flown(table_4_1, method, "the same in speckle", draws=number, first=first)
        for name in outputs.POINT_CLOUD_VARIABLES:
            assert part[name].tobytes() == at_once[name][:, first : first + number].tobytes(), name


# One segment


def _rate(amplitude, level):
    """-ln(1 - c) of a bin by Marcum's Q, without the tables of the module."""
    stays = -math.expm1(-0.5 * level * level)
    if amplitude < level:
        return -math.log1p(-marcum_q1_excess(amplitude, level) / stays)
    return -math.log(max(marcum_q1_tails(amplitude, level)[1], 1e-300) / stays)


def _leakage_by_quadrature(amplitudes, level):
    """Mean over developed speckle of 1 - exp(-R), by 1,920 Gauss points in ln(power)."""
    node, weight = np.polynomial.legendre.leggauss(32)
    edges = np.linspace(-20.0, 4.0, 61)
    half = 0.5 * np.diff(edges)[:, None]
    log_power = edges[:-1, None] + half * (node + 1)
    mean = 0.0
    for t, w in zip(log_power.ravel(), (half * weight).ravel(), strict=True):
        total_rate = sum(n * _rate(a * math.exp(0.5 * t), level) for a, n in amplitudes.items())
        mean -= w * math.exp(t - math.exp(t)) * math.expm1(-total_rate)
    return mean


@pytest.mark.parametrize("level", [0.5, 2.0, 3.93, 6.65, 8.0, 10.0])
@pytest.mark.parametrize(
    "amplitudes",
    [
        {0.15: 40},
        {0.15: 40, 0.4: 7, 1.3: 2},
        {0.3: 5, 2.5: 1},
        {"half": 1},
        {"half": 3000},
        {"level": 2},
        {"beyond": 1},
        {"far": 1, 0.2: 30},
    ],
)
def test_mean_leakage_is_that_of_a_fine_quadrature(amplitudes, level):
    places = {"half": level / 2, "level": level, "beyond": level + 11.9, "far": 1e4 * level}
    signal = {places.get(a, a): n for a, n in amplitudes.items()}
    bins = np.repeat(list(signal), list(signal.values()))
    levels, law = leaked._distinct_thresholds(np.full(2, level))
    table = leaked._tabulate_log_crossing_rates(SINGLE_LOOK, float(levels[0]))
    ends = np.zeros((2, 3), np.int64)
    ends[1, 2] = bins.size  # the other point and segments have none
    leaks = leaked.LeakageBins.empty(2)._replace(
        bins_end=ends,
        bins=np.arange(bins.size),
        log_amplitude=np.log(bins),
        fading_group=np.zeros(bins.size, np.int64),
        exempt_neighbour_magnitude_ratio=np.zeros(bins.size),
        threshold_index=law,
        log_crossing_rates=table.log_crossing_rates[None],
        first_log_amplitude=np.array([table.first_log_amplitude]),
        log_amplitude_step=np.array([table.log_amplitude_step]),
        threshold_ratio=levels,
        crossing_rate_sum_bound_at_mean=np.full(
            (2, 3), sum(n * _rate(a, level) for a, n in signal.items())
        ),
    )
    means = leaks.mean_leakage_probability()
    within = {"rel": 1e-6, "abs": 1e-6 * leaked.LEAKAGE_PROBABILITY_MIN}
    assert means[1, 2] == pytest.approx(_leakage_by_quadrature(signal, level), **within)
    assert np.count_nonzero(means) == 1
    # Echoes fade each for itself.
    separate = leaks._replace(fading_group=np.arange(bins.size) % 2).mean_leakage_probability()[
        1, 2
    ]
    halves = [dict(zip(*np.unique(half, return_counts=True), strict=True))
              for half in (bins[::2], bins[1::2])]  # fmt: skip
    stays = [1 - _leakage_by_quadrature(half, level) for half in halves]
    assert separate == pytest.approx(1 - stays[0] * stays[1], **within)


def _raised(leaks, level, draws, *, fading=None, size=3):
    """Bins and sizes of the peaks raised in the up-chirp, a list for each draw."""
    peak_bins = []
    bins, ratios = np.empty(size, np.int64), np.empty(size)
    (key,), tables = make_point_keys(1), interpolator(get_window("hamming", SIZE), SIZE)
    for d in range(draws):
        ratios[:] = 0.0
        factors = np.ones((1, 3)) if fading is None else np.full((1, 3), fading[d])
        number = leaked.draw_leaked_peaks(
            DrawAddress(*key, d), 0, 0, leaks, factors, level, 1, tables, bins, ratios
        )
        peak_bins.append((bins[:number].copy(), ratios[:number].copy()))
    return peak_bins


def _largest(bins, magnitudes, level):
    """Strongest bin of each draw (n,) and its |X| / sigma, of magnitudes (n, bins); -1 for none."""
    best = magnitudes.argmax(axis=1)
    size = magnitudes.max(axis=1)
    return np.where(size >= level, bins[best], -1), np.where(size >= level, size, 0.0)


def _one_shot(table_4_1, effects=DEFAULT_EFFECTS, further_parameters=(), **changes):
    law = {"fft_size": SIZE, "beamlets": 1, "radial_velocity": 20.0, "window": "hamming"}
    parameters = (
        PARAMETER_DEFAULTS
        | table_4_1(**law | {"range": 400.0} | changes)
        | dict(further_parameters)
    )
    return prepare_single_category(parameters, effects)


@pytest.mark.parametrize("fades", [False, True])
def test_raised_peaks_are_where_and_as_large_as_signal_in_noise(fades, table_4_1):
    """Rice's law by simulation, with the speckle of an echo common to its bins."""
    draws, random = 6000, np.random.default_rng(8)
    effects = (*DEFAULT_EFFECTS, "fading") if fades else DEFAULT_EFFECTS
    speckle = {"footprint.speckle": "developed" if fades else "none"}
    shots = _one_shot(table_4_1, effects, speckle, phases="incoherent", power=420.0)
    groups = list_bin_groups(shots)
    ((_, leaks),) = leaked.iter_leakage_bins(shots, groups, np.zeros(1, np.int64))
    level = float(shots.threshold[0] / shots.bin_noise_sigma[0])
    stretch = slice(leaks.bins_begin[0, 0], leaks.bins_end[0, 0])
    bins, signal = leaks.bins[stretch], np.exp(leaks.log_amplitude[stretch])
    loud = signal > 0.5  # the rest crosses once in 1e15
    bins, signal = bins[loud], signal[loud]
    power = random.exponential(size=draws) if fades else np.ones(draws)
    noise = random.standard_normal((draws, 2 * bins.size)).view(complex)
    places, sizes = _largest(bins, np.abs(np.sqrt(power)[:, None] * signal + noise), level)
    factors = np.sqrt(np.random.default_rng(9).exponential(size=draws)) if fades else None
    peaks = _raised(leaks, level, draws, fading=factors)
    first_bins = np.array([b[0] if b.size else -1 for b, _ in peaks])
    own_size = np.array([r[0] if r.size else 0.0 for _, r in peaks])
    share = (places >= 0).mean()
    assert 0.1 < share < 0.9
    assert _difference(places, first_bins) < _allowed(draws, draws)
    assert _difference(sizes, own_size) < _allowed(draws, draws)
    # The mean over speckle, or the closed form of a steady echo, is their share.
    expected = leaks.mean_leakage_probability()[0, 0] if fades else groups.leakage_probability[0, 0]
    assert share == pytest.approx(expected, abs=5 * math.sqrt(0.25 / draws))


def test_a_line_of_leaked_light_raises_peaks_in_its_own_bins(table_4_1, monkeypatch):
    """Records of the line at a uniform phase, in noise; the echo itself leaks nothing."""
    monkeypatch.setattr(permanent_line, "MASK_THRESHOLD_FRACTION", 0.8)  # for many alarms
    draws, random = 4000, np.random.default_rng(4)
    further_parameters = {LEAK_LENGTH_PATH: 40.0, ISOLATION_PATH: 1e5}
    shots = _one_shot(
        table_4_1,
        (*DEFAULT_EFFECTS, "circulator_leak"),
        further_parameters,
        range=1500.0,
        power=1.0,
    )
    groups = list_bin_groups(shots)
    ((_, leaks),) = leaked.iter_leakage_bins(shots, groups, np.zeros(1, np.int64))
    level = float(shots.threshold[0] / shots.bin_noise_sigma[0])
    scale, line = permanent_line.permanent_line_of_point(shots, 0, 0)
    bins = leaks.permanent_line_bins[
        leaks.permanent_line_begin[0, 0] : leaks.permanent_line_end[0, 0]
    ]
    one, other = (
        scale / shots.bin_noise_sigma[0] * transform[bins]
        for transform in (line.transform, line.image_transform)
    )
    turn = np.exp(2j * np.pi * random.random(draws))[:, None]
    noise = random.standard_normal((draws, 2 * bins.size)).view(complex)
    places, _ = _largest(bins, np.abs(one * turn + other * turn.conj() + noise), level)
    peaks = _raised(leaks, level, draws)
    first_bins = np.array([b[0] if b.size else -1 for b, _ in peaks])
    assert (places >= 0).mean() > 0.1
    assert _difference(places, first_bins) < _allowed(draws, draws)
    # Noise alone raises nothing where the line is masked.
    hidden = leaks.no_noise_peak_bins[
        leaks.no_noise_peak_begin[0, 0] : leaks.no_noise_peak_end[0, 0]
    ]
    assert (scale * line.magnitude_max[hidden] >= 0.8 * shots.threshold[0]).all() and hidden.size
    assert not set(hidden) & set(bins)


def _faint_shots(table_4_1, power, record="real"):
    """Shots in developed speckle at several ranges, of little leakage."""
    law = table_4_1(
        fft_size=SIZE, beamlets=1, radial_velocity=20.0, window="hamming", power=power,
        phases="incoherent", range=np.linspace(300.0, 500.0, 7),
    )  # fmt: skip
    further_parameters = {"footprint.speckle": "developed", RECORD: record}
    return prepare_single_category(
        PARAMETER_DEFAULTS | law | further_parameters, (*DEFAULT_EFFECTS, "fading")
    )


@pytest.mark.parametrize(
    "scene", ["strong ground and a dim roof", "near ground", "skirts of an uneven chirp"]
)
def test_segments_without_a_raised_bin_need_no_list_of_bins(scene, table_4_1, monkeypatch):
    find, marked = leaked.find_segments_with_raised_bins, []

    def record_marked(*arguments):
        marked.append(find(*arguments))
        return marked[-1]

    monkeypatch.setattr(returns, "find_segments_with_raised_bins", record_marked)
    clouds = [_flown(table_4_1, "probabilities", scene, draws=1, first=n)[0] for n in range(60)]
    is_marked = np.concatenate(marked)
    assert 0.05 < is_marked.mean() < 0.95
    monkeypatch.setattr(
        returns, "find_segments_with_raised_bins", lambda groups, points, keys, *_: keys[:, :1] >= 0
    )
    for n, cloud in enumerate(clouds):
        with_all_bins, _ = _flown(table_4_1, "probabilities", scene, draws=1, first=n)
        for name, values in cloud.items():
            np.testing.assert_array_equal(values, with_all_bins[name], err_msg=name)


@pytest.mark.parametrize("window", ["hann", "hamming", "rectangular"])
@pytest.mark.parametrize("bins_beyond_echo", [None, 1.0, 3.0])
@pytest.mark.parametrize("fft_size", [512, SIZE, 2**17])
@pytest.mark.parametrize("tolerance", [1e-3, 0.1])
def test_bounds_on_raised_bins_are_probabilities_no_smaller_than_leakage(
    window, bins_beyond_echo, fft_size, tolerance, table_4_1
):
    """Bright and dim echoes, in the searched band or short of it, at fine and coarse tolerances."""
    ranges = np.array([30.0, 60.0, 100.0, 101.3, 300.0])
    parameters = table_4_1(
        fft_size=fft_size, beamlets=1, radial_velocity=0.0, window=window, noise_bins="correlated",
        power=np.array([1e5, 1e3, 10.0, 1.0, 0.1]), range=ranges, detection="any_bin",
    )  # fmt: skip
    parameters = PARAMETER_DEFAULTS | parameters | {"accuracy.tolerance": tolerance}
    if bins_beyond_echo is not None:
        nearest = ranges + bins_beyond_echo * RANGE_BIN * SIZE / fft_size
        band = (nearest, nearest + 10.0 * RANGE_BIN, -1e-3, 1e-3)
        parameters |= dict(zip(SEARCH_BAND_PATHS, band, strict=True))
    groups = list_bin_groups(prepare_single_category(parameters))
    bound = groups.raised_bin_probability_max
    assert ((bound >= 0) & (bound <= 1)).all()
    assert (bound >= groups.leakage_probability * (1 - 1e-9)).all()
    assert (groups.leakage_probability > 1e-3).any()


@pytest.mark.parametrize("record", ["real", "complex"])
def test_one_search_finds_the_groups_and_leaks_that_two_searches_find(record, table_4_1):
    shots = _faint_shots(table_4_1, 200.0, record)
    groups, listed = leaked.find_groups_and_leakage_bins(shots, 4)
    groups_without = list_bin_groups(shots, with_leakage=False)
    for name, values in groups._asdict().items():
        if name != "leakage_probability":
            np.testing.assert_allclose(
                values, getattr(groups_without, name), rtol=1e-12, err_msg=name
            )
    number = 0
    for (part, leaks), (same, other_leaks) in zip(
        listed, leaked.iter_leakage_bins(shots, groups_without, np.arange(shots.size)), strict=True
    ):
        assert (part == same).all()
        for name in ("bins_begin", "bins_end", "bins"):
            assert (getattr(leaks, name) == getattr(other_leaks, name)).all()
        assert (leaks.fading_group == other_leaks.fading_group).all() and (
            leaks.side_of_adjacent_echo_bin == other_leaks.side_of_adjacent_echo_bin
        ).all()
        np.testing.assert_allclose(leaks.log_amplitude, other_leaks.log_amplitude, rtol=1e-9)
        np.testing.assert_allclose(
            groups.leakage_probability[part], other_leaks.mean_leakage_probability(), rtol=1e-9
        )
        number += leaks.bins.size
    assert number > 50


def test_faint_leakage_is_what_the_average_over_all_bins_together_gives(table_4_1):
    shots = _faint_shots(table_4_1, 1.0)
    ((_, leaks),) = leaked.iter_leakage_bins(shots, list_bin_groups(shots), np.arange(shots.size))
    means = leaks.mean_leakage_probability()
    together = leaks._replace(
        mean_crossing_probability_sum=leaks.mean_crossing_probability_sum * np.nan
    ).mean_leakage_probability()
    faint = (together > leaked.LEAKAGE_PROBABILITY_MIN) & (
        together < 0.9 * leaked.FAINT_LEAKAGE_PROBABILITY_MAX
    )
    assert faint.sum() > 3
    np.testing.assert_array_equal(means[faint], leaks.mean_crossing_probability_sum[faint])
    np.testing.assert_allclose(means[faint], together[faint], rtol=5e-3)


def test_rates_stay_below_their_bounds_at_every_octave_of_speckle(table_4_1):
    shots = _faint_shots(table_4_1, 20.0)
    ((_, leaks),) = leaked.iter_leakage_bins(shots, list_bin_groups(shots), np.arange(shots.size))
    for octave in range(leaked.N_RATE_BOUND_SPECKLE_POWERS):
        for j, s in np.ndindex(leaks.crossing_rate_sum_bound_at_mean.shape):
            bins = slice(leaks.bins_begin[j, s], leaks.bins_end[j, s])
            amplitudes = leaks.log_amplitude[bins] + 0.5 * octave * math.log(2.0)
            law = leaks.threshold_index[j]
            table = leaked.CrossingRateTable(
                leaks.log_crossing_rates[law],
                leaks.first_log_amplitude[law],
                leaks.log_amplitude_step[law],
            )
            total_rate = sum(leaked._crossing_rate(a, table) for a in amplitudes)
            assert total_rate <= leaks.crossing_rate_sum_bounds[j, s, octave] <= 1.3 * total_rate
