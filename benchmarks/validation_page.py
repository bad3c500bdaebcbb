"""Write docs/validation.md: every table and figure of the thesis, compared with our stores.

``make validation`` computes the stores that are missing first. Only facts and figures of the thesis
stand here: what its tables print, and what its text says of its pictures, in our words.
"""

import argparse
import math

import benchmark_helpers
import numpy as np
from benchmark_helpers import DOCS, EXPERIMENTS, ROOT

import sweep
from sweep.analysis import labels
from sweep.analysis.shot_spectra import select_shot_parameters, simulate_shot
from sweep.analysis.study_figures import GridResults
from sweep.analysis.tables import false_alarm_records
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import noise_false_alarms
from sweep.spec import load

TABLE_COLUMNS = ("shown", "experiment", "ours", "the thesis", "difference, and why")

# Where a verdict turns; each is made of the numbers beside it by one of these.
SEEN_PD_MIN, LOST_PD_MAX = 0.9, 0.5
"""Least pd at which a target counts as seen, and pd below which it counts as lost."""
NEAR_ZERO_PD_MAX = 0.1
"""Value below which a pd counts as near zero."""
NEARLY_ALL_SHARE, HARDLY_ANY_SHARE = 0.95, 0.05
"""Least share of points or shots for "nearly everywhere", and largest share for "hardly"."""
HARDLY_FARTHER_RATIO = 1.1
"""Largest ratio of reaches that counts as hardly more."""
RAPID_LOSS_SHARE = 0.5
"""Least share of all losses in one kilometre that counts as rapid."""
PRINTING_SLIP_TOLERANCE = 0.05
"""Largest relative difference from a tenth of a printed number, at which it is a misprint."""
ALIKE_SHARE = 0.1
"""Largest difference that counts as none, as a share of the whole spread."""
CYCLE_TOLERANCE = 1.0
"""Allowed difference in a flight's number of cycles, as the thesis does not state how it ends."""

INTRODUCTION = """# Validation: the published study and ours

This page compares every table and figure with results of D. B. Chester, *A Parameterized Simulation
of Doppler Lidar*, Utah State University, 2017, with the results of `sweep`. `make validation`
writes it from the stores of `experiments/`. Pictures are published without numbers. For them the
page has the numbers of the thesis's text, or its words for more and less. If the thesis leaves a
parameter open (reflectance, terrain, speed), the experiment's comments state the choice. Verdicts
follow from the numbers in each row, by limits in `benchmarks/validation_page.py`.
"""

REMARK = """
"Ours" is the mean over the study's points beyond 5 m, of noise alone in all bins of the FFT; the
closed form is (1 - (1 - p)^N)^2. The last column of these tables adds the extra groups that the
signal's own sidelobes raise, which the thesis's tables cannot contain.
"""

NOT_REPRODUCED = """
## What is not reproduced

- The figures of Chapter 2, and 3.1 to 3.7, explain the method; Figs. 4.1 and 5.2 show a program's
  window and a steerer's grid of angles: no results. Tables 4.1 and 5.1 are input, and stand in
  `experiments/instruments`.
- The noise that rises with the light collected (Tables 4.3 to 4.5, last column but one): the thesis
  gives no term for it, and nothing is tuned to it.
- The pictures of Chapter 5 show a terrain that is not published. Ours is another: numbers of shots,
  geometry and layers can be held against theirs, and places of points cannot.
"""


def store_path(name):
    """Return the path of an experiment's store."""
    return ROOT / "results" / f"{name}.zarr"


def verdict_text(condition):
    """Return the verdict as text."""
    return "agrees" if condition else "does not agree"


def section_table(heading, columns, rows):
    """Return a Markdown table under a heading."""
    return f"\n## {heading}\n\n{benchmark_helpers.markdown_table(columns, rows)}\n"


def table_4_2():
    """Return the comparison with Table 4.2 as a section."""
    study = GridResults.from_store(store_path("threshold"))
    (figure,) = [f for f in study.spec.figures if f.name == "table_4_2"]
    pfa_beyond_5_m = study.dataset.pfa_bin.sel(range=slice(5.1, None))
    mean_pfa = pfa_beyond_5_m.mean(["range", "grazing_angle"]).compute()
    rows = []
    for tnr, printed_pfa in zip(mean_pfa.tnr.values, figure.printed, strict=True):
        our_pfa = float(mean_pfa.sel(tnr=tnr))
        closed_form = noise_false_alarms.bin_pfa(tnr)
        rows.append([
            f"{tnr:g}", f"{closed_form:.4g}", f"{our_pfa:.4g}", f"{printed_pfa:g}",
            f"{100 * (printed_pfa / our_pfa - 1):+.1f} "
            "%", explain_printed_alarm(float(tnr), float(printed_pfa), our_pfa),
        ])  # fmt: skip
    columns = ("TNR", "closed form", "ours", "printed", "printed over ours", "why")
    return section_table("Table 4.2: false alarms of a bin (`threshold`)", columns, rows)


def explain_printed_alarm(tnr, printed_pfa, our_pfa):
    """Explain the difference between a printed false-alarm probability of a bin and ours."""
    digits = len(f"{printed_pfa:e}".partition("e")[0].rstrip("0").replace(".", ""))
    if float(f"{our_pfa:.{digits - 1}e}") == printed_pfa:
        return (
            f"the same in {labels.number_with_noun(digits, 'digit')}, which is all that is printed"
        )
    if abs(printed_pfa / 10 / our_pfa - 1) < PRINTING_SLIP_TOLERANCE:
        percent_off = 100 * (printed_pfa / 10 / our_pfa - 1)
        return (
            f"a slip of the thesis: {printed_pfa / 10:g} is meant, {percent_off:+.1f} % from ours"
        )
    variance_excess_percent = 100 * noise_false_alarms.variance_excess_from_bin_pfa(
        printed_pfa, tnr
    )
    return f"its noise is {variance_excess_percent:.2f} % above what sets the threshold"


def shot_alarm_table(name, table_number):
    """Return the comparison with one of Tables 4.3 to 4.5 as a section."""
    study = GridResults.from_store(store_path(name))
    (figure,) = [f for f in study.spec.figures if f.kind == "false_alarm_table"]
    alarm_rows = false_alarm_records(study.points, study.spec, by=figure.by, printed=figure.printed)
    rows = [
        [
            alarm_row["setting"],
            alarm_row["cut"],
            f"{alarm_row['closed_form']:.3e}",
            f"{alarm_row['study_mean']:.3e}",
            f"{alarm_row['printed']:.3e}",
            f"{100 * (alarm_row['printed'] / alarm_row['study_mean'] - 1):+.1f} %",
            f"{100 * alarm_row['printed_variance_excess']:.2f} %",
            f"{alarm_row['shot_with_leakage_median']:.1e}, "
            f"{alarm_row['shot_with_leakage_mean']:.1e}",
        ]
        for alarm_row in alarm_rows
    ]
    columns = ("setting", "cut", "closed form", "ours", "printed", "printed over ours",
               "noise it implies above the threshold's", "with leakage: median, mean")  # fmt: skip
    return section_table(f"Table {table_number}: false alarms of a shot (`{name}`)", columns, rows)


def chapter_4_rows():
    """Return the rows on Figures 4.2 to 4.8."""
    return [
        figure_4_2_row(),
        figure_4_3_row(),
        *figure_4_4_rows(),
        *figure_4_5_rows(),
        *trade_off_rows(),
        divergence_row(),
    ]


def figure_4_2_row():
    """Return the row on Fig. 4.2."""
    spec = load(EXPERIMENTS / "single_shot_2000m.yaml")
    ((_, parameters),) = select_shot_parameters(spec, {})
    shot = simulate_shot(parameters)
    bin_size_by_unit = {"m": range_bin_width(parameters), "m/s": velocity_bin_width(parameters)}
    error_by_unit = {
        "m": shot.reported_range - parameters["target.range"],
        "m/s": shot.reported_radial_velocity - parameters["target.radial_velocity"],
    }
    verdict = verdict_text(
        all(abs(error_by_unit[unit]) <= bin_size for unit, bin_size in bin_size_by_unit.items())
    )
    return [
        "Fig. 4.2",
        "single_shot_2000m",
        f"reports {shot.reported_range:.3f} m, {shot.reported_radial_velocity:.4f} m/s",
        "a target at 2000 m, 150 m/s",
        f"{verdict} within a bin, {bin_size_by_unit['m']:.4f} m and "
        f"{1000 * bin_size_by_unit['m/s']:.2f} mm/s; its "
        "report's digits are in a picture",
    ]


def range_bin_width(parameters):
    """Return the width of a bin of the FFT as a range [m]."""
    chirp_rate = parameters["instrument.chirp.bandwidth"] / parameters["instrument.chirp.duration"]
    return bin_width(parameters) * SPEED_OF_LIGHT / (2 * chirp_rate)


def velocity_bin_width(parameters):
    """Return the width of a bin of the FFT as a radial velocity [m/s]."""
    return bin_width(parameters) * parameters["instrument.laser.wavelength"] / 2


def bin_width(parameters):
    """Return the width of a bin of the FFT [Hz]."""
    rate = parameters["instrument.processing.sample_rate"]
    return rate / parameters["instrument.processing.fft_size"]


def figure_4_3_row():
    """Return the row on Fig. 4.3."""
    ds = sweep.open(store_path("single_shot_45deg")).compute()
    loss_db = {
        segment: 10 * np.log10(float(ds[f"snr_{segment}"][0] / ds[f"snr_{segment}"][1]))
        for segment in ("up", "down", "doppler")
    }
    loss_text = ", ".join(f"{segment} {-value:.1f} dB" for segment, value in loss_db.items())
    falls_verdict = verdict_text(min(loss_db.values()) > 0)
    doppler_verdict = verdict_text(loss_db["doppler"] > max(loss_db["up"], loss_db["down"]))
    return [
        "Fig. 4.3",
        "single_shot_45deg",
        f"from 90 to 45 deg the peaks change by {loss_text}",
        "all fall clearly, Doppler slightly more than the chirps",
        f"that all fall {falls_verdict}; that Doppler falls most {doppler_verdict}. Where the "
        "fringes of a smooth "
        "footprint stand hangs on the range to a fraction of the wavelength",
    ]


def figure_4_4_rows():
    """Yield the rows on Fig. 4.4."""
    ds = sweep.open(store_path("range_angle"))[["pd_shot", "pd_up", "pd_doppler"]].compute()
    lost_above_45_deg, lost_to_10_deg = (
        lost_share_by_kilometre(ds.pd_shot, *angles) for angles in ((45, 90), (1, 10))
    )
    largest_step = np.diff(lost_above_45_deg).max()
    is_high_near, is_low_at_low_angles = (
        max(lost_above_45_deg[:4]) < HARDLY_ANY_SHARE,
        max(lost_to_10_deg[:3]) < HARDLY_ANY_SHARE < lost_to_10_deg[5],
    )
    steep_text, flat_text = (
        ", ".join(f"{100 * share:.0f}" for share in shares)
        for shares in (lost_above_45_deg, lost_to_10_deg)
    )
    yield [
        "Fig. 4.4(a)",
        "range_angle",
        f"% of points with pd < {LOST_PD_MAX:g} in each kilometre from 0 to 10, above 45 deg: "
        f"{steep_text}; "
        f"to 10 deg: {flat_text}",
        "high up to about 4000 m, rapid dips beyond; dropouts at low angles that rise with range",
        f"high up to 4000 m: {verdict_text(is_high_near)}, narrow dips take "
        f"{100 * lost_above_45_deg[3]:.0f} % of the fourth "
        "kilometre, which a picture may not show; rapid beyond: "
        f"{verdict_text(largest_step > RAPID_LOSS_SHARE * lost_above_45_deg[-1])}, no kilometre "
        f"adds more than {100 * largest_step:.0f} %; "
        f"low angles: {verdict_text(is_low_at_low_angles)}",
    ]
    doppler, up, shot = (
        float((ds[segment] >= SEEN_PD_MIN).mean()) for segment in ("pd_doppler", "pd_up", "pd_shot")
    )
    comparison_text = "either segment" if shot < min(up, doppler) else "not every segment"
    yield [
        "Fig. 4.4(b)",
        "range_angle",
        f"pd >= {SEEN_PD_MIN:g} in the Doppler segment at {100 * doppler:.1f} % of the points, in "
        "the "
        f"up-chirp at {100 * up:.1f} %, in both chirps at {100 * shot:.1f} %",
        "more intermittent than the chirps, dashed curves of low pd",
        f"{verdict_text(doppler < up)} for a segment against a segment; a shot, which needs two "
        "chirps, "
        f"is lost more often than {comparison_text}",
    ]


def lost_share_by_kilometre(pd, lowest, highest):
    """Return the share of lost points between two angles [deg], for each of ten kilometres."""
    lost = (pd.sel(grazing_angle=slice(lowest, highest)) < LOST_PD_MAX).mean("grazing_angle")
    return lost.groupby_bins("range", np.arange(0, 10_001, 1000)).mean().values


def figure_4_5_rows():
    """Yield the rows on Fig. 4.5."""
    ds = sweep.open(store_path("threshold"))[["pd_shot"]].compute()
    thesis_words = {1: "high nearly everywhere", 15: "the largest area near zero, the deepest dips"}
    lost_before = -1.0
    for tnr, panel in zip((1, 5, 10, 15), "abcd", strict=True):
        pd_at_tnr = ds.pd_shot.sel(tnr=tnr)
        near_zero_share, seen_share = (
            float((pd_at_tnr < NEAR_ZERO_PD_MAX).mean()),
            float((pd_at_tnr >= SEEN_PD_MIN).mean()),
        )
        yield [
            f"Fig. 4.5({panel})",
            "threshold",
            f"TNR {tnr}: pd >= {SEEN_PD_MIN:g} at {100 * seen_share:.1f} %, < {NEAR_ZERO_PD_MAX:g} "
            f"at {100 * near_zero_share:.1f} %",
            thesis_words.get(tnr, "the area near zero and the dips grow with TNR"),
            verdict_text(
                seen_share > NEARLY_ALL_SHARE if tnr == 1 else near_zero_share > lost_before
            ),
        ]
        lost_before = near_zero_share


TRADE_OFFS = (
    ("transmit_power", "power", "4.6", "farther, dips fewer, lower angles with more power"),
    ("aperture", "aperture", "4.7", "farther, dips fewer, lower angles with a larger aperture"),
    ("fft_size", "fft_size", "4.8", "frequent dips at 2^16, milder with size; reach hardly more"),
)  # fmt: skip


def trade_off_rows():
    """Yield the rows on Figs. 4.6 to 4.8."""
    for name, coordinate, figure_number, thesis_words in TRADE_OFFS:
        ds = sweep.open(store_path(name))[["pd_shot", "miss_shot"]].compute()
        units = GridResults.from_store(store_path(name)).spec.axis_parameter(coordinate).units
        names = [labels.format_quantity(value.item(), units) for value in ds[coordinate].values]
        for panel, angle in (("a", "15 deg"), ("b", "85 deg")):
            cut = without_repeated_values(ds.sweep.sel(grazing_angle=angle), "range")
            yield [
                f"Fig. {figure_number}({panel})",
                name,
                *range_finding(cut, coordinate, names, thesis_words),
            ]
        cut = without_repeated_values(ds.sweep.sel(range="3500 m"), "grazing_angle")
        yield [f"Fig. {figure_number}(c)", name, *angle_finding(cut, names, thesis_words)]


def range_finding(cut, coordinate, names, thesis_words):
    """Return our numbers along the range, the thesis's words, and the verdict."""
    reaches = [typical_reach(cut.isel({coordinate: i})) for i in range(len(names))]
    lost_shares = (cut.pd_shot < LOST_PD_MAX).mean("cut").values
    reach_text = "; ".join(
        f"{label}: {range_text(reach_m)}, {100 * share:.1f} %"
        for label, reach_m, share in zip(names, reaches, lost_shares, strict=True)
    )
    dips_verdict = verdict_text((lost_shares[1:] < lost_shares[:-1]).all())
    verdict = (
        f"dips: {dips_verdict}; reach: "
        f"{verdict_text(reaches == sorted(reaches) and reaches[0] < reaches[1])}"
    )
    if coordinate == "fft_size":
        reach_ratios = reaches[1] / reaches[0], reaches[2] / reaches[1]
        verdict = (
            f"dips: {dips_verdict}; that reach is hardly more "
            f"{verdict_text(max(reach_ratios) <= HARDLY_FARTHER_RATIO)}: it "
            f"grows by {reach_ratios[0]:.2f} and {reach_ratios[1]:.2f} a doubling, which doubles "
            "the SNR"
        )
    our_text = (
        f"range to which the median pd of 100 m is >= {SEEN_PD_MIN:g}, and points below "
        f"{LOST_PD_MAX:g}: {reach_text}"
    )
    return our_text, thesis_words, verdict


def angle_finding(cut, names, thesis_words):
    """Return our numbers along the grazing angle, the thesis's words, and the verdict."""
    angle_limits = cut.sweep.minimum_grazing_angle(SEEN_PD_MIN)
    n_below_seen = (cut.pd_shot < SEEN_PD_MIN).sum("cut").values
    angles = [
        "1 deg or less" if int(reason) == 2 else f"{float(angle):.1f} deg"
        for angle, reason in zip(angle_limits.farthest, angle_limits.farthest_reason, strict=True)
    ]
    angle_text = "; ".join(
        f"{label}: {angle}, {n_below} of {cut.sizes['cut']}"
        for label, angle, n_below in zip(names, angles, n_below_seen, strict=True)
    )
    verdict = verdict_text((n_below_seen[1:] <= n_below_seen[:-1]).all())
    missed_percent = 100 * n_below_seen[-1] / cut.sizes["cut"]
    return (
        f"least angle with pd >= {SEEN_PD_MIN:g}, and angles below {SEEN_PD_MIN:g}: {angle_text}",
        thesis_words,
        f"{verdict}; how low hangs on the reflectance, which was chosen: at best "
        f"{missed_percent:.0f} % of the angles are missed at 3500 m",
    )


def typical_reach(cut):
    """Return the first range at which the median pd of 100 m is below `SEEN_PD_MIN` [m], or inf."""
    order = np.argsort(cut.range.values)
    pd, ranges = cut.pd_shot.values[order], cut.range.values[order]
    is_below = np.median(pd[: pd.size // 100 * 100].reshape(-1, 100), axis=1) < SEEN_PD_MIN
    return float(ranges[100 * int(np.argmax(is_below))]) if is_below.any() else math.inf


def without_repeated_values(dataset, name):
    """Return the points of a cut with each value of a coordinate once."""
    _, first_index = np.unique(dataset[name].values, return_index=True)
    return dataset.isel(cut=np.sort(first_index))


def range_text(value):
    """Return a range [m] as text."""
    return "over 10 km" if math.isinf(value) else f"{value / 1000:.1f} km"


def divergence_row():
    """Return the row on the study that the thesis announces and does not contain."""
    ds = sweep.open(store_path("beam_divergence"))[["pd_shot"]].compute()
    lost_share = (ds.pd_shot < LOST_PD_MAX).mean("cut")
    lost_text = "; ".join(
        f"{urad:g} urad: {100 * float(lost_share[i]):.1f} %"
        for i, urad in enumerate(ds.beam_divergence.values)
    )
    thesis_words = "announced among its aims, not published"
    return [
        "(none)",
        "beam_divergence",
        f"points below pd {LOST_PD_MAX:g}: {lost_text}",
        thesis_words,
        "new",
    ]


PUBLISHED_FLIGHTS = (
    ("Fig. 5.1", "morpheus_three_beam", "three", 400 / 65, 1, 3,
     "three beams, 500 to 100 m, 100 to 30 m/s, 1 Hz"),
    ("Fig. 5.3(a-c)", "square_high_descent", "corners", 1500 / 66, 20, 4,
     "four beams, 2000 to 500 m, 100 to 32 m/s, 20 Hz"),
    ("Fig. 5.4(a-c)", "square_low_descent", "corners", None, 20, 4,
     "four beams, 500 to 10 m, 20 Hz; speeds are not given"),
    ("Fig. 5.5", "oblique_descent", "corners", None, 20, 4,
     "four beams, 400 m along 45 deg from 500 m; speeds are not given"),
    ("Figs. 5.6, 5.7", "expanded_pattern", "squares", 1990 / 75, 20, 4,
     "sixteen angles in squares of four, 2000 to 10 m, 100 to 50 m/s, 20 Hz"),
)  # fmt: skip


def flight_rows():
    """Return the rows on Figs. 3.8 and 5.1 to 5.7."""
    yield from figure_3_8_rows()
    for (
        figure_label,
        name,
        scanner,
        seconds,
        expected_rate,
        expected_beams,
        thesis_words,
    ) in PUBLISHED_FLIGHTS:
        ds = sweep.open_scene(store_path(name))[scanner].ds
        has_light_axis = "optical_efficiency" in ds.pd_shot.dims
        pd = ds.pd_shot.sel(optical_efficiency=1) if has_light_axis else ds.pd_shot
        expected_text = (
            "" if seconds is None else f"; {seconds * expected_rate:.1f} cycles by its speeds"
        )
        cycle_rate, beams_per_cycle = (
            1 / float(np.diff(ds.cycle_time).mean()),
            ds.attrs["shots_a_cycle"],
        )
        geometry_verdict = verdict_text(
            beams_per_cycle == expected_beams and np.isclose(cycle_rate, expected_rate)
        )
        cycles_verdict = "speeds are ours"
        if seconds is not None:
            cycles_difference = abs(ds.sizes["cycle"] - seconds * expected_rate)
            cycles_verdict = f"cycles: {verdict_text(cycles_difference <= CYCLE_TOLERANCE)}"
        yield [
            figure_label,
            name,
            f"{ds.sizes['shot']:,} shots in {ds.sizes['cycle']:,} cycles of {beams_per_cycle} at "
            f"{cycle_rate:.4g} Hz, mean pd {float(pd.mean()):.4f}",
            thesis_words + expected_text,
            f"beams and rate: {geometry_verdict}; {cycles_verdict}; the terrain is ours",
        ]
        if name == "square_high_descent":
            yield figure_5_3_d_row(ds)
        if name == "square_low_descent":
            yield range_layer_row(ds, "Fig. 5.4(d)", name)
        if name == "oblique_descent":
            yield figure_5_5_c_row(ds)


def figure_3_8_rows():
    """Return the rows on Fig. 3.8."""
    ds = sweep.open_scene(store_path("forest_scan"))["sweep"].ds.compute()
    speed = ds.radial_velocity.where((ds.flags.astype(int) & 1) > 0)
    fore_speed, aft_speed = (
        float(speed.isel(shot=np.flatnonzero(ds.beam.values % 2 == beam_parity)).median())
        for beam_parity in (0, 1)
    )
    several_returns_share = float((np.isfinite(ds.range).sum("return_number") > 1).mean())
    range_difference, velocity_difference = (
        difference_of_first_returns(ds, name) for name in ("range", "radial_velocity")
    )
    parameters = load_experiment("forest_scan").parameters()
    is_two_ranges_one_velocity = range_difference > range_bin_width(
        parameters
    ) and velocity_difference <= velocity_bin_width(parameters)
    yield [
        "Fig. 3.8(a)",
        "forest_scan",
        f"{100 * several_returns_share:.1f} % of shots have several returns; between the first two "
        "of them "
        f"{range_difference:.2f} m and {1000 * velocity_difference:.2f} mm/s (medians)",
        "two peaks of range where leaf and ground share a footprint, one of velocity",
        f"{verdict_text(several_returns_share > 0 and is_two_ranges_one_velocity)}: more than a "
        "bin of range, no more than one of velocity; "
        "how often depends on the trees",
    ]
    yield range_layer_row(ds, "Fig. 3.8(b)", "forest_scan")
    yield [
        "Fig. 3.8(c)",
        "forest_scan",
        f"median velocities {fore_speed:+.4f} and {aft_speed:+.4f} m/s fore and aft",
        "small and positive fore, small and negative aft",
        f"{verdict_text(fore_speed > 0 > aft_speed)}; the speed is ours",
    ]


def difference_of_first_returns(ds, name):
    """Return the median difference of a quantity between the first two true returns of a shot."""
    is_true_point = (ds.flags.astype(int) & 1) > 0
    first, second = (ds[name].where(is_true_point).isel(return_number=i) for i in (0, 1))
    return float(abs(second - first).median())


def load_experiment(name):
    """Load the spec of an experiment."""
    return load(EXPERIMENTS / f"{name}.yaml")


def range_layer_row(ds, figure_label, name):
    """Return the row on ranges in layers of whole bins."""
    is_true_point = np.isfinite(ds.range.values) & (ds.flags.values.astype(int) & 1 > 0)
    gaps = np.diff(np.unique(ds.range.values[is_true_point]))
    range_bin_m = range_bin_width(load_experiment(name).parameters())
    layer_step = np.median(gaps[(gaps > ALIKE_SHARE * range_bin_m) & (gaps < 1.5 * range_bin_m)])
    is_distinct = abs(layer_step - range_bin_m / 2) < ALIKE_SHARE * range_bin_m / 2
    return [
        figure_label,
        name,
        f"layers {layer_step:.4f} m apart (median)",
        "distinct layers, of whole bins",
        f"{verdict_text(is_distinct)}; a bin is {range_bin_m:.4f} m, and up and down peak tell "
        "half of one each",
    ]


def figure_5_3_d_row(ds):
    """Return the row on Fig. 5.3(d)."""
    is_lost = ~np.isfinite(ds.range).any("return_number").compute()
    lost_share = is_lost.mean(["shot", "draw"])
    lost_text = "; ".join(
        f"{100 * efficiency:g} % of the light: "
        f"{100 * float(lost_share.sel(optical_efficiency=efficiency)):.1f} % lost"
        for efficiency in ds.optical_efficiency.values
    )
    height = ds.platform_position.isel(xyz=2).compute()
    is_lost_in_dim_light = is_lost.sel(optical_efficiency=is_lost.optical_efficiency.min()).any(
        "draw"
    )
    height_of_lost, median_height = (
        float(height.where(is_lost_in_dim_light).median()),
        float(height.median()),
    )
    lost_share_in_full_light = float(lost_share.sel(optical_efficiency=1))
    lost_in_full_light_text = (
        "hardly any"
        if lost_share_in_full_light < HARDLY_ANY_SHARE
        else f"{100 * lost_share_in_full_light:.0f} %"
    )
    return [
        "Fig. 5.3(d)",
        "square_high_descent",
        f"{lost_text}; the median height of those lost is {height_of_lost:.0f} m, of all "
        f"{median_height:.0f} m",
        "some detections drop out at high altitude",
        f"{verdict_text(bool(is_lost_in_dim_light.any()) and height_of_lost > median_height)} in "
        f"dim light; {lost_in_full_light_text} in full light with the "
        "reflectance chosen, as the thesis's is not given",
    ]


def figure_5_5_c_row(ds):
    """Return the row on Fig. 5.5(c)."""
    speed, beams = ds.true_radial_velocity.compute(), ds.beam.values
    medians = sorted(
        float(speed.isel(shot=np.flatnonzero(beams == beam)).median()) for beam in np.unique(beams)
    )
    are_two_alike = medians[2] - medians[1] < ALIKE_SHARE * (medians[3] - medians[0])
    speeds_text = ", ".join(f"{median:.2f}" for median in medians)
    return [
        "Fig. 5.5(c)",
        "oblique_descent",
        f"median velocities of the four beams {speeds_text} m/s",
        "three groups: one beam fore, one aft, two alike",
        verdict_text(len(medians) == 4 and are_two_alike),
    ]


THRESHOLD_PICTURE = """\
![Probability of detection over range and grazing angle at four thresholds](threshold.png)

*Fig. 4.5 by `experiments/threshold.yaml`: probability of detection at threshold-to-noise ratios of
1, 5, 10 and 15. The footprint has fixed phases, as in the thesis, which makes fringes.*

"""


def page_text():
    """Return the text of the page."""
    alarm_tables = (("transmit_power", "4.3"), ("aperture", "4.4"), ("fft_size", "4.5"))
    return "".join([
        INTRODUCTION,
        section_table("Figures of Chapter 4", TABLE_COLUMNS, chapter_4_rows()),
        THRESHOLD_PICTURE,
        table_4_2(),
        *(shot_alarm_table(name, table_number) for name, table_number in alarm_tables),
        REMARK,
        section_table("Point clouds: Figs. 3.8 and 5.1 to 5.7", TABLE_COLUMNS, flight_rows()),
        NOT_REPRODUCED,
    ])  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missing", action="store_true", help="list experiments without a store")
    options = parser.parse_args()
    names = ["range_angle", "threshold", "beam_divergence", "single_shot_45deg", "forest_scan"]
    names += [trade[0] for trade in TRADE_OFFS] + [flight[1] for flight in PUBLISHED_FLIGHTS]
    missing = [name for name in names if not store_path(name).exists()]
    if options.missing:
        print(*missing)
        return
    if missing:
        raise SystemExit(f"there is no store of {', '.join(missing)}: `make validation` makes them")
    (DOCS / "validation.md").write_text(page_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
