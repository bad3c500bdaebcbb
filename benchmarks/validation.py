"""Writes docs/validation.md: every table and figure of the thesis beside what our stores hold.

``make validation`` computes the stores that are missing first. Only facts and figures of the thesis
stand here: what its tables print, and what its text says of its pictures, in our words.
"""

import argparse
import math

import numpy as np
import shared
from shared import DOCS, EXPERIMENTS, ROOT

import sweep
from sweep.analysis import labels
from sweep.analysis.figures import Study
from sweep.analysis.shot_figure import chosen, simulated
from sweep.analysis.tables import false_alarms
from sweep.model import noise_only
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.spec import load

TABLE = ("shown", "experiment", "ours", "the thesis", "difference, and why")

# Where a verdict turns; each is made of the numbers beside it by one of these.
SEEN, LOST = 0.9, 0.5
"""pd from which on a target counts as seen, and below which as lost."""
GONE = 0.1
"""pd below which it counts as near zero."""
NEARLY_ALL, HARDLY_ANY = 0.95, 0.05
"""Shares of points or shots that the thesis's "nearly everywhere" and "hardly" are held against."""
HARDLY_FARTHER = 1.1
"""Growth of a reach up to which it is hardly more."""
RAPID = 0.5
"""Share of all losses that one kilometre must add to be called rapid."""
SLIP = 0.05
"""Relative difference from a tenth of a printed number that makes its power of ten a slip."""
ALIKE = 0.1
"""Differences that count as none, as a share of the whole spread."""
ONE_CYCLE = 1.0
"""Cycles by which a flight's number may be off: the thesis does not say how its last one ends."""

INTRODUCTION = """# Validation: the published study and ours

This page compares every table and figure with results of D. B. Chester, *A Parameterized Simulation
of Doppler Lidar*, Utah State University, 2017, with the results of `sweep`. `make validation`
writes it from the stores of `experiments/`. Pictures are published without numbers. For them the
page has the numbers of the thesis's text, or its words for more and less. If the thesis leaves a
parameter open (reflectance, terrain, speed), the experiment's comments state the choice. Verdicts
follow from the numbers in each row, by limits in `benchmarks/validation.py`.
"""

REMARK = """
"Ours" is the mean over the study's points beyond 5 m, of noise alone in all bins of the FFT; the
closed form is (1 - (1 - p)^N)^2. The last column of these tables adds the extra groups that the
signal's own sidelobes raise, which the thesis's tables cannot contain.
"""

LEFT_OUT = """
## What is not reproduced

- The figures of Chapter 2, and 3.1 to 3.7, explain the method; Figs. 4.1 and 5.2 show a program's
  window and a steerer's grid of angles: no results. Tables 4.1 and 5.1 are input, and stand in
  `experiments/instruments`.
- The noise that rises with the light collected (Tables 4.3 to 4.5, last column but one): the thesis
  gives no term for it, and nothing is tuned to it.
- The pictures of Chapter 5 show a terrain that is not published. Ours is another: numbers of shots,
  geometry and layers can be held against theirs, and places of points cannot.
"""


def results(name):
    """The store of an experiment."""
    return ROOT / "results" / f"{name}.zarr"


def agrees(condition):
    """The verdict in words."""
    return "agrees" if condition else "does not agree"


def table(heading, columns, rows):
    """A Markdown table under a heading."""
    return f"\n## {heading}\n\n{shared.table(columns, rows)}\n"


def thresholds():
    """Table 4.2."""
    study = Study.of(results("threshold"))
    (figure,) = [f for f in study.spec.figures if f.name == "table_4_2"]
    far = study.dataset.pfa_bin.sel(range=slice(5.1, None))
    pfa = far.mean(["range", "grazing_angle"]).compute()
    rows = []
    for tnr, printed in zip(pfa.tnr.values, figure.printed, strict=True):
        ours = float(pfa.sel(tnr=tnr))
        closed = noise_only.bin_probability(tnr)
        rows.append([
            f"{tnr:g}", f"{closed:.4g}", f"{ours:.4g}", f"{printed:g}",
            f"{100 * (printed / ours - 1):+.1f} %", why(float(tnr), float(printed), ours),
        ])  # fmt: skip
    columns = ("TNR", "closed form", "ours", "printed", "printed over ours", "why")
    return table("Table 4.2: false alarms of a bin (`threshold`)", columns, rows)


def why(tnr, printed, ours):
    """Explanation of a printed false-alarm probability of a bin."""
    digits = len(f"{printed:e}".partition("e")[0].rstrip("0").replace(".", ""))
    if float(f"{ours:.{digits - 1}e}") == printed:
        return f"the same in {labels.counted(digits, 'digit')}, which is all that is printed"
    if abs(printed / 10 / ours - 1) < SLIP:
        off = 100 * (printed / 10 / ours - 1)
        return f"a slip of the thesis: {printed / 10:g} is meant, {off:+.1f} % from ours"
    excess = 100 * noise_only.variance_excess_of_bin(printed, tnr)
    return f"its noise is {excess:.2f} % above what sets the threshold"


def alarms(name, number):
    """One of Tables 4.3 to 4.5."""
    study = Study.of(results(name))
    (figure,) = [f for f in study.spec.figures if f.kind == "false_alarm_table"]
    found = false_alarms(study.points, study.spec, by=figure.by, printed=figure.printed)
    rows = [
        [r["setting"], r["cut"], f"{r['closed_form']:.3e}", f"{r['study_mean']:.3e}",
         f"{r['printed']:.3e}", f"{100 * (r['printed'] / r['study_mean'] - 1):+.1f} %",
         f"{100 * r['printed_variance_excess']:.2f} %",
         f"{r['shot_with_leakage_median']:.1e}, {r['shot_with_leakage_mean']:.1e}"]
        for r in found
    ]  # fmt: skip
    columns = ("setting", "cut", "closed form", "ours", "printed", "printed over ours",
               "noise it implies above the threshold's", "with leakage: median, mean")  # fmt: skip
    return table(f"Table {number}: false alarms of a shot (`{name}`)", columns, rows)


def chapter_4():
    """Figures 4.2 to 4.8."""
    return [shot_4_2(), shot_4_3(), *surfaces(), *thresholds_seen(), *trade_offs(), divergence()]


def shot_4_2():
    """Fig. 4.2."""
    spec = load(EXPERIMENTS / "single_shot_2000m.yaml")
    ((_, parameters),) = chosen(spec, {})
    shot = simulated(parameters)
    bins = {"m": range_bin(parameters), "m/s": velocity_bin(parameters)}
    off = {
        "m": shot.range - parameters["target.range"],
        "m/s": shot.radial_velocity - parameters["target.radial_velocity"],
    }
    verdict = agrees(all(abs(off[unit]) <= size for unit, size in bins.items()))
    return [
        "Fig. 4.2",
        "single_shot_2000m",
        f"reports {shot.range:.3f} m, {shot.radial_velocity:.4f} m/s",
        "a target at 2000 m, 150 m/s",
        f"{verdict} within a bin, {bins['m']:.4f} m and {1000 * bins['m/s']:.2f} mm/s; its "
        "report's digits are in a picture",
    ]


def range_bin(parameters):
    """Range [m] that a bin of the FFT is wide."""
    chirp_rate = parameters["instrument.chirp.bandwidth"] / parameters["instrument.chirp.duration"]
    return bin_width(parameters) * SPEED_OF_LIGHT / (2 * chirp_rate)


def velocity_bin(parameters):
    """Radial velocity [m/s] that a bin of the FFT is wide."""
    return bin_width(parameters) * parameters["instrument.laser.wavelength"] / 2


def bin_width(parameters):
    """Width of a bin [Hz]."""
    rate = parameters["instrument.processing.sample_rate"]
    return rate / parameters["instrument.processing.fft_size"]


def shot_4_3():
    """Fig. 4.3."""
    ds = sweep.open(results("single_shot_45deg")).compute()
    loss = {
        n: 10 * np.log10(float(ds[f"snr_{n}"][0] / ds[f"snr_{n}"][1]))
        for n in ("up", "down", "doppler")
    }
    ours = ", ".join(f"{n} {-value:.1f} dB" for n, value in loss.items())
    fall = agrees(min(loss.values()) > 0)
    most = agrees(loss["doppler"] > max(loss["up"], loss["down"]))
    return [
        "Fig. 4.3",
        "single_shot_45deg",
        f"from 90 to 45 deg the peaks change by {ours}",
        "all fall clearly, Doppler slightly more than the chirps",
        f"that all fall {fall}; that Doppler falls most {most}. Where the fringes of a smooth "
        "footprint stand hangs on the range to a fraction of the wavelength",
    ]


def surfaces():
    """Fig. 4.4."""
    ds = sweep.open(results("range_angle"))[["pd_shot", "pd_up", "pd_doppler"]].compute()
    steep, flat = (lost_by_kilometre(ds.pd_shot, *angles) for angles in ((45, 90), (1, 10)))
    most = np.diff(steep).max()
    high, low = max(steep[:4]) < HARDLY_ANY, max(flat[:3]) < HARDLY_ANY < flat[5]
    told, told_flat = (", ".join(f"{100 * v:.0f}" for v in part) for part in (steep, flat))
    yield [
        "Fig. 4.4(a)",
        "range_angle",
        f"% of points with pd < {LOST:g} in each kilometre from 0 to 10, above 45 deg: {told}; "
        f"to 10 deg: {told_flat}",
        "high up to about 4000 m, rapid dips beyond; dropouts at low angles that rise with range",
        f"high up to 4000 m: {agrees(high)}, narrow dips take {100 * steep[3]:.0f} % of the fourth "
        "kilometre, which a picture may not show; rapid beyond: "
        f"{agrees(most > RAPID * steep[-1])}, no kilometre adds more than {100 * most:.0f} %; "
        f"low angles: {agrees(low)}",
    ]
    doppler, up, shot = (float((ds[n] >= SEEN).mean()) for n in ("pd_doppler", "pd_up", "pd_shot"))
    than = "either segment" if shot < min(up, doppler) else "not every segment"
    yield [
        "Fig. 4.4(b)",
        "range_angle",
        f"pd >= {SEEN:g} in the Doppler segment at {100 * doppler:.1f} % of the points, in the "
        f"up-chirp at {100 * up:.1f} %, in both chirps at {100 * shot:.1f} %",
        "more intermittent than the chirps, dashed curves of low pd",
        f"{agrees(doppler < up)} for a segment against a segment; a shot, which needs two chirps, "
        f"is lost more often than {than}",
    ]


def lost_by_kilometre(pd, lowest, highest):
    """Share of points that are lost between two angles [deg], in each of ten kilometres."""
    lost = (pd.sel(grazing_angle=slice(lowest, highest)) < LOST).mean("grazing_angle")
    return lost.groupby_bins("range", np.arange(0, 10_001, 1000)).mean().values


def thresholds_seen():
    """Fig. 4.5."""
    ds = sweep.open(results("threshold"))[["pd_shot"]].compute()
    said = {1: "high nearly everywhere", 15: "the largest area near zero, the deepest dips"}
    before = -1.0
    for tnr, letter in zip((1, 5, 10, 15), "abcd", strict=True):
        part = ds.pd_shot.sel(tnr=tnr)
        lost, seen = float((part < GONE).mean()), float((part >= SEEN).mean())
        yield [
            f"Fig. 4.5({letter})",
            "threshold",
            f"TNR {tnr}: pd >= {SEEN:g} at {100 * seen:.1f} %, < {GONE:g} at {100 * lost:.1f} %",
            said.get(tnr, "the area near zero and the dips grow with TNR"),
            agrees(seen > NEARLY_ALL if tnr == 1 else lost > before),
        ]
        before = lost


TRADES = (
    ("transmit_power", "power", "4.6", "farther, dips fewer, lower angles with more power"),
    ("aperture", "aperture", "4.7", "farther, dips fewer, lower angles with a larger aperture"),
    ("fft_size", "fft_size", "4.8", "frequent dips at 2^16, milder with size; reach hardly more"),
)  # fmt: skip


def trade_offs():
    """Figs. 4.6 to 4.8."""
    for name, by, number, said in TRADES:
        ds = sweep.open(results(name))[["pd_shot", "miss_shot"]].compute()
        units = Study.of(results(name)).spec.member(by).units
        names = [labels.quantity(v.item(), units) for v in ds[by].values]
        for letter, angle in (("a", "15 deg"), ("b", "85 deg")):
            part = once(ds.sweep.sel(grazing_angle=angle), "range")
            yield [f"Fig. {number}({letter})", name, *along_range(part, by, names, said)]
        part = once(ds.sweep.sel(range="3500 m"), "grazing_angle")
        yield [f"Fig. {number}(c)", name, *along_angle(part, names, said)]


def along_range(part, by, names, said):
    """Findings along a range, the thesis's words, and the verdict."""
    reach = [typical_reach(part.isel({by: i})) for i in range(len(names))]
    lost = (part.pd_shot < LOST).mean("cut").values
    told = "; ".join(
        f"{n}: {kilometres(r)}, {100 * x:.1f} %" for n, r, x in zip(names, reach, lost, strict=True)
    )
    fewer = agrees((lost[1:] < lost[:-1]).all())
    verdict = f"dips: {fewer}; reach: {agrees(reach == sorted(reach) and reach[0] < reach[1])}"
    if by == "fft_size":
        gain = reach[1] / reach[0], reach[2] / reach[1]
        verdict = (
            f"dips: {fewer}; that reach is hardly more {agrees(max(gain) <= HARDLY_FARTHER)}: it "
            f"grows by {gain[0]:.2f} and {gain[1]:.2f} a doubling, which doubles the SNR"
        )
    ours = (
        f"range to which the median pd of 100 m is >= {SEEN:g}, and points below {LOST:g}: {told}"
    )
    return ours, said, verdict


def along_angle(part, names, said):
    """The same along the angle."""
    least = part.sweep.minimum_grazing_angle(SEEN)
    lost = (part.pd_shot < SEEN).sum("cut").values
    angles = [
        "1 deg or less" if int(reason) == 2 else f"{float(angle):.1f} deg"
        for angle, reason in zip(least.farthest, least.farthest_reason, strict=True)
    ]
    told = "; ".join(
        f"{n}: {angle}, {x} of {part.sizes['cut']}"
        for n, angle, x in zip(names, angles, lost, strict=True)
    )
    verdict = agrees((lost[1:] <= lost[:-1]).all())
    all_but = 100 * lost[-1] / part.sizes["cut"]
    return (
        f"least angle with pd >= {SEEN:g}, and angles below {SEEN:g}: {told}",
        said,
        f"{verdict}; how low hangs on the reflectance, which was chosen: at best "
        f"{all_but:.0f} % of the angles are missed at 3500 m",
    )


def typical_reach(part):
    """First range [m] at which the median pd of 100 m is below `SEEN`; inf where it never is."""
    order = np.argsort(part.range.values)
    pd, ranges = part.pd_shot.values[order], part.range.values[order]
    below = np.median(pd[: pd.size // 100 * 100].reshape(-1, 100), axis=1) < SEEN
    return float(ranges[100 * int(np.argmax(below))]) if below.any() else math.inf


def once(dataset, name):
    """The points of a cut, each value of the coordinate once."""
    _, first = np.unique(dataset[name].values, return_index=True)
    return dataset.isel(cut=np.sort(first))


def kilometres(value):
    """A range in words."""
    return "over 10 km" if math.isinf(value) else f"{value / 1000:.1f} km"


def divergence():
    """The study that the thesis announces and does not have."""
    ds = sweep.open(results("beam_divergence"))[["pd_shot"]].compute()
    lost = (ds.pd_shot < LOST).mean("cut")
    told = "; ".join(
        f"{v:g} urad: {100 * float(lost[i]):.1f} %" for i, v in enumerate(ds.beam_divergence.values)
    )
    said = "announced among its aims, not published"
    return ["(none)", "beam_divergence", f"points below pd {LOST:g}: {told}", said, "new"]


FLIGHTS = (
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


def flights():
    """Figs. 3.8 and 5.1 to 5.7."""
    yield from leaves()
    for shown, name, scanner, seconds, rate, beams, said in FLIGHTS:
        ds = sweep.open_scene(results(name))[scanner].ds
        bright = "optical_efficiency" in ds.pd_shot.dims
        pd = ds.pd_shot.sel(optical_efficiency=1) if bright else ds.pd_shot
        expected = "" if seconds is None else f"; {seconds * rate:.1f} cycles by its speeds"
        found, each = 1 / float(np.diff(ds.cycle_time).mean()), ds.attrs["shots_a_cycle"]
        alike = agrees(each == beams and np.isclose(found, rate))
        cycles = (
            "speeds are ours" if seconds is None
            else f"cycles: {agrees(abs(ds.sizes['cycle'] - seconds * rate) <= ONE_CYCLE)}"
        )  # fmt: skip
        yield [
            shown,
            name,
            f"{ds.sizes['shot']:,} shots in {ds.sizes['cycle']:,} cycles of {each} at "
            f"{found:.4g} Hz, mean pd {float(pd.mean()):.4f}",
            said + expected,
            f"beams and rate: {alike}; {cycles}; the terrain is ours",
        ]
        if name == "square_high_descent":
            yield dropouts(ds)
        if name == "square_low_descent":
            yield layers(ds, "Fig. 5.4(d)", name)
        if name == "oblique_descent":
            yield three_speeds(ds)


def leaves():
    """Fig. 3.8."""
    ds = sweep.open_scene(results("forest_scan"))["sweep"].ds.compute()
    speed = ds.radial_velocity.where((ds.flags.astype(int) & 1) > 0)
    fore, aft = (
        float(speed.isel(shot=np.flatnonzero(ds.beam.values % 2 == b)).median()) for b in (0, 1)
    )
    several = float((np.isfinite(ds.range).sum("return_number") > 1).mean())
    apart, slip = (spread_in_shots(ds, name) for name in ("range", "radial_velocity"))
    parameters = open_spec("forest_scan").parameters()
    two = apart > range_bin(parameters) and slip <= velocity_bin(parameters)
    yield [
        "Fig. 3.8(a)",
        "forest_scan",
        f"{100 * several:.1f} % of shots have several returns; between the first two of them "
        f"{apart:.2f} m and {1000 * slip:.2f} mm/s (medians)",
        "two peaks of range where leaf and ground share a footprint, one of velocity",
        f"{agrees(several > 0 and two)}: more than a bin of range, no more than one of velocity; "
        "how often depends on the trees",
    ]
    yield layers(ds, "Fig. 3.8(b)", "forest_scan")
    yield [
        "Fig. 3.8(c)",
        "forest_scan",
        f"median velocities {fore:+.4f} and {aft:+.4f} m/s fore and aft",
        "small and positive fore, small and negative aft",
        f"{agrees(fore > 0 > aft)}; the speed is ours",
    ]


def spread_in_shots(ds, name):
    """Median difference of a quantity between the first two true returns of a shot."""
    true = (ds.flags.astype(int) & 1) > 0
    first, second = (ds[name].where(true).isel(return_number=i) for i in (0, 1))
    return float(abs(second - first).median())


def open_spec(name):
    """The study of an experiment."""
    return load(EXPERIMENTS / f"{name}.yaml")


def layers(ds, shown, name):
    """Ranges in layers of whole bins."""
    true = np.isfinite(ds.range.values) & (ds.flags.values.astype(int) & 1 > 0)
    gaps = np.diff(np.unique(ds.range.values[true]))
    size = range_bin(open_spec(name).parameters())
    step = np.median(gaps[(gaps > ALIKE * size) & (gaps < 1.5 * size)])
    distinct = abs(step - size / 2) < ALIKE * size / 2
    return [
        shown,
        name,
        f"layers {step:.4f} m apart (median)",
        "distinct layers, of whole bins",
        f"{agrees(distinct)}; a bin is {size:.4f} m, and up and down peak tell half of one each",
    ]


def dropouts(ds):
    """Fig. 5.3(d)."""
    none = ~np.isfinite(ds.range).any("return_number").compute()
    lost = none.mean(["shot", "draw"])
    told = "; ".join(
        f"{100 * e:g} % of the light: {100 * float(lost.sel(optical_efficiency=e)):.1f} % lost"
        for e in ds.optical_efficiency.values
    )
    height = ds.platform_position.isel(xyz=2).compute()
    dim = none.sel(optical_efficiency=none.optical_efficiency.min()).any("draw")
    high, usual = float(height.where(dim).median()), float(height.median())
    full = float(lost.sel(optical_efficiency=1))
    fewer = "hardly any" if full < HARDLY_ANY else f"{100 * full:.0f} %"
    return [
        "Fig. 5.3(d)",
        "square_high_descent",
        f"{told}; the median height of those lost is {high:.0f} m, of all {usual:.0f} m",
        "some detections drop out at high altitude",
        f"{agrees(bool(dim.any()) and high > usual)} in dim light; {fewer} in full light with the "
        "reflectance chosen, as the thesis's is not given",
    ]


def three_speeds(ds):
    """Fig. 5.5(c)."""
    speed, beams = ds.true_radial_velocity.compute(), ds.beam.values
    medians = sorted(
        float(speed.isel(shot=np.flatnonzero(beams == b)).median()) for b in np.unique(beams)
    )
    alike = medians[2] - medians[1] < ALIKE * (medians[3] - medians[0])
    told = ", ".join(f"{m:.2f}" for m in medians)
    return [
        "Fig. 5.5(c)",
        "oblique_descent",
        f"median velocities of the four beams {told} m/s",
        "three groups: one beam fore, one aft, two alike",
        agrees(len(medians) == 4 and alike),
    ]


PICTURE = """\
![Probability of detection over range and grazing angle at four thresholds](threshold.png)

*Fig. 4.5 by `experiments/threshold.yaml`: probability of detection at threshold-to-noise ratios of
1, 5, 10 and 15. The footprint has fixed phases, as in the thesis, which makes fringes.*

"""


def page():
    """The whole page."""
    tables = (("transmit_power", "4.3"), ("aperture", "4.4"), ("fft_size", "4.5"))
    return "".join([
        INTRODUCTION,
        table("Figures of Chapter 4", TABLE, chapter_4()),
        PICTURE,
        thresholds(),
        *(alarms(name, number) for name, number in tables),
        REMARK,
        table("Point clouds: Figs. 3.8 and 5.1 to 5.7", TABLE, flights()),
        LEFT_OUT,
    ])  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missing", action="store_true", help="list experiments without a store")
    options = parser.parse_args()
    names = ["range_angle", "threshold", "beam_divergence", "single_shot_45deg", "forest_scan"]
    names += [trade[0] for trade in TRADES] + [flight[1] for flight in FLIGHTS]
    missing = [name for name in names if not results(name).exists()]
    if options.missing:
        print(*missing)
        return
    if missing:
        raise SystemExit(f"there is no store of {', '.join(missing)}: `make validation` makes them")
    (DOCS / "validation.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
