"""Results of grids, of whole spectra, of flights and of scenes: units, meaning, dimensions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

NO_DOPPLER = "nan without a Doppler segment, which direct detection never has"
NO_ECHO = "nan where no light comes back"
NO_BIN = "-inf where the detection occupies every bin, so that none is left to raise an alarm"
CLOSING = "positive when closing"

XYZ, XYZ_AGAIN = "xyz", "xyz_again"


@dataclass(frozen=True)
class Output:
    """A quantity: its units ("1" where it has none), its name in words, a further comment.

    Floats are nan where there is nothing, signed integers -1, flags 0.
    """

    units: str
    long_name: str
    comment: str = ""
    dtype: str = "float64"
    dims: tuple[str, ...] = ()
    """Dimensions beside the study's axes: ``shot``, ``beamlet``, ``cycle``, ``draw`` and
    ``return_number`` count from 0; ``xyz`` are the world's axes."""

    def empty(self, sizes: Mapping[str, int]) -> np.ndarray:
        """Array to be filled, of these sizes by dimension."""
        return np.empty(tuple(sizes[dim] for dim in self.dims), self.dtype)


def _by_segment(
    name: str, quantity: str, comment: str = "", *, joint: str = " ", shot: str | None = ""
) -> dict[str, Output]:
    """Output of each segment and of the shot, with its own comment; None for none of the shot."""
    words = {"up": "up-chirp", "down": "down-chirp", "doppler": "Doppler segment", "shot": "shot"}
    own = {"up": "", "down": "", "doppler": NO_DOPPLER, "shot": shot}
    return {
        name.format(key): Output(
            "1", f"{quantity}, {words[key]}", joint.join(filter(None, (comment, further)))
        )
        for key, further in own.items()
        if further is not None
    }


OUTPUTS: dict[str, Output] = {
    **_by_segment(
        "pd_{}", "probability of detection", shot="both chirps detected, or as shot_detection says"
    ),
    **_by_segment("miss_{}", "probability of a miss", "1 - pd with its digits."),
    "pfa_bin": Output("1", "probability of false alarm in one bin, from noise alone"),
    "pfa_segment": Output(
        "1",
        "probability of at least one false alarm in the up-chirp segment, from noise alone",
        "over the bins counted less those that the detection occupies; leakage is apart",
    ),
    "pfa_both_chirps": Output(
        "1",
        "probability of a false alarm in the up- and in the down-chirp segment, from noise alone",
        "what Tables 4.3 to 4.5 of the thesis print",
    ),
    "pfa_shot": Output(
        "1",
        "probability of at least one false alarm in any segment of a shot, from noise alone",
        "the Doppler segment among them, where there is one",
    ),
    "log10_pfa_bin": Output("1", "log10 of pfa_bin", "finite where pfa_bin underflows"),
    "log10_pfa_segment": Output("1", "log10 of pfa_segment", NO_BIN),
    "log10_pfa_both_chirps": Output("1", "log10 of pfa_both_chirps", NO_BIN),
    "log10_pfa_shot": Output("1", "log10 of pfa_shot", NO_BIN),
    "p_leakage_up": Output(
        "1",
        "probability that leaked signal raises a further group, up-chirp",
        "over noise alone",
    ),
    "p_leakage_down": Output(
        "1",
        "probability that leaked signal raises a further group, down-chirp",
        "over noise alone",
    ),
    **_by_segment(
        "snr_{}", "signal-to-noise ratio", shot=None,
        comment="mean power of the signal in the strongest bin over the mean noise power of a bin, "
        "after the FFT; the pedestal of a laser's phase noise under the line is signal.",
    ),
    "beamlets": Output("1", "number of beamlets that were simulated"),
    "beamlets_error": Output(
        "1",
        "largest change of a probability of detection by more beamlets",
        "summed over the segments; nan where it is not estimated: their number is given, or their "
        "amplitudes add",
    ),
    "noise_variance": Output(
        "V^2", "noise variance at the ADC, sigma_x^2", "of noise that is white within the bandwidth"
    ),
    "range_error": Output(
        "m",
        "reported less true range, without noise",
        f"peak bins of the segments resolved; {NO_ECHO}",
    ),
    "radial_velocity_error": Output(
        "m s-1", "reported less true radial velocity, without noise", f"{CLOSING}; {NO_ECHO}"
    ),
    "misread": Output(
        "1",
        "1 where the peaks are read as another range or velocity than the echo's, else 0",
        "without noise; beats beyond half the sample rate, or of another order than assumed. "
        f"What is detected then has a wrong range or velocity; {NO_ECHO}",
    ),
}  # fmt: skip

STRONGEST_OUTPUTS: dict[str, Output] = _by_segment(
    "p_wrong_range_{}",
    "probability of a detection with a wrong range",
    "a peak that is not the echo's crosses the threshold and is the strongest",
    joint="; ",
    shot="both chirps report a peak, and one of the echo not both; or both do and are misread",
)
"""Floats, one a point, of studies that report the strongest peak of a segment alone."""

WITHOUT_ECHO = tuple(name for name, output in OUTPUTS.items() if NO_ECHO in output.comment)
"""Outputs without a value where no light comes back."""

_PLACES = {
    "up": "the up-chirp segment",
    "down": "the down-chirp segment",
    "doppler": "the Doppler segment",
}
DRAW_OUTPUTS: dict[str, Output] = {
    f"n_{name}_{segment}": Output("1", f"number of draws with a {event} in {place}", dtype="int64")
    for name, event, both in (
        ("detected", "detection", "shot"), ("false_alarm", "false alarm", "both_chirps"),
    )
    for segment, place in {**_PLACES, both: "both chirp segments"}.items()
    if (name, segment) != ("false_alarm", "doppler")
}  # fmt: skip

ERROR_OUTPUTS: dict[str, Output] = _by_segment(
    "pd_{}_error",
    "standard error of the mean probability of detection",
    "over draws; 0 where nothing random is simulated, nan with a single draw",
    joint="; ",
)
"""Floats, one a point, of studies with draws; each of the output that it is named after."""

PROMISED = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
"""Outputs of which the accuracy is promised."""

ACCURACY_OUTPUTS: dict[str, Output] = {
    "n_draws": Output("1", "number of draws", dtype="int64"),
    **_by_segment(
        "pd_{}_half_width",
        "half-width of the interval of the probability of detection",
        "pd plus and minus this holds the true one with the confidence promised: of the mean over "
        "draws where random effects are simulated; of the share of draws with a detection where "
        "noise alone is drawn; 0 where pd is exact",
        joint="; ",
    ),
    "accuracy_missed": Output(
        "1", "largest half-width less the tolerance", "0 where the tolerance is met"
    ),
}
"""Results of draws, point by point."""

RUNNING = "running_sums"

RUNNING_OUTPUTS: dict[str, Output] = {
    RUNNING: Output(
        "1", "sums that further draws are added to", "of random effects; of use to sweep extend"
    ),
}
"""Sums of draws of random effects for further ones, a row a point."""

LOGARITHMS = np.array([name.startswith("log10_") for name in OUTPUTS])
SPREAD_OF = LOGARITHMS | np.array([f"{name}_error" in ERROR_OUTPUTS for name in OUTPUTS])
"""Outputs whose spread shows in a result."""

RUNNING_COLUMNS = len(OUTPUTS) + int(SPREAD_OF.sum()) + int(LOGARITHMS.sum())
"""Numbers a point that further draws need besides the means: counts, spreads, logarithms."""

KEPT = (
    "snr_up", "snr_down", "snr_doppler", "beamlets", "beamlets_error", "noise_variance", "misread",
)  # fmt: skip
"""Of :data:`OUTPUTS`, what does not depend on the detector."""

_AT_FAULT = "adjacent flagged bins, none of them among those that the signal occupies"


def _resolved(quantity: str, name: str, units: str) -> dict[str, Output]:
    """Bias, its error, RMSE and bound of what is reported."""
    found = "over draws in which every segment has a detection; nan with none"
    bound = (
        "Cramer-Rao bound for lone tones of the signal's power in the up- and the down-chirp "
        "segment, of which it is resolved, with what developed speckle adds on a slope; rms over "
        "draws"
    )
    return {
        f"{quantity}_bias": Output(units, f"mean of reported less true {name}", found),
        f"{quantity}_bias_error": Output(units, f"standard error of the bias of {name}", found),
        f"{quantity}_rmse": Output(units, f"root mean square of reported less true {name}", found),
        f"{quantity}_bound": Output(units, f"least standard deviation of {name}", bound),
    }


SPECTRA_OUTPUTS: dict[str, Output] = {
    **{name: OUTPUTS[name] for name in KEPT},
    **_by_segment(
        "pd_{}", "probability of detection", shot="Both chirps detected, or as shot_detection says",
        comment="share of draws with a detection in a bin of the echo.",
    ),
    "pfa_bin": Output("1", "share of bins with a false alarm", f"those in groups of {_AT_FAULT}"),
    "pfa_bin_error": Output("1", "standard error of pfa_bin over draws"),
    "false_alarms": Output(
        "1", "mean number of false alarms in a shot", f"groups of {_AT_FAULT}, of all segments"
    ),
    "false_alarms_error": Output("1", "standard error of false_alarms over draws"),
    **_resolved("range", "range", "m"),
    **_resolved("radial_velocity", f"radial velocity, {CLOSING}", "m s-1"),
}  # fmt: skip
"""Floats, one a point; beside them stand ACCURACY_OUTPUTS and DRAW_OUTPUTS."""


def _over(dims: tuple[str, ...], outputs: dict[str, Output]) -> dict[str, Output]:
    """Put dimensions before those of outputs."""
    return {name: replace(each, dims=(*dims, *each.dims)) for name, each in outputs.items()}


_VECTOR = (XYZ,)

SHOTS: dict[str, Output] = _over(("shot",), {
    "time": Output(
        "s", "start of the measurement, from the attribute time_origin on",
        "which is the first time of the platform's table of waypoints, or 0",
    ),
    "beam": Output("1", "number of the beam", dtype="int32"),
    "shot_cycle": Output("1", "number of the measurement cycle", dtype="int32"),
    "platform_position": Output("m", "position of the instrument", dims=_VECTOR),
    "platform_velocity": Output("m s-1", "velocity of the instrument", dims=_VECTOR),
    "beam_direction": Output(
        "1", "unit vector along the beam, as commanded", "without pointing jitter", dims=_VECTOR
    ),
    "beam_range": Output("m", "true range of the reference beamlet", "inf: nothing is seen"),
    "beam_radial_velocity": Output(
        "m s-1", "true radial velocity of the reference beamlet", CLOSING
    ),
    "beam_acceleration": Output(
        "m s-2", "rate at which the radial velocity of the reference beamlet grows"
    ),
    "beam_approach": Output("m s-1", "speed at which the range of the reference beamlet falls"),
    "beam_turn_rate": Output(
        "rad s-1", "rate at which the direction of the reference beamlet turns"
    ),
    "beam_turning": Output(
        "s-1", "rate of change of beam_direction, by platform and scanner", dims=_VECTOR
    ),
    "platform_acceleration": Output("m s-2", "acceleration of the instrument", dims=_VECTOR),
    "beam_surface": Output("1", "surface that the reference beamlet hits", dtype="int16"),
})  # fmt: skip
"""Geometry of each shot, the same for all draws and all radiometry: the truth of a point cloud."""

CYCLES: dict[str, Output] = _over(("cycle",), {
    "cycle_time": Output("s", "start of the measurement cycle"),
    "true_velocity": Output(
        "m s-1", "velocity of the instrument, mean over the cycle's shots", dims=_VECTOR
    ),
    "true_altitude": Output(
        "m", "height of the instrument above the ground straight below it",
        "at the cycle's start; inf where there is none",
    ),
})  # fmt: skip
"""Truth of each measurement cycle."""

BEAMLETS: dict[str, Output] = _over(("shot", "beamlet"), {
    "offset": Output("m", "range less that of the reference beamlet"),
    "velocity_offset": Output(
        "m s-1", "radial velocity less that of the reference beamlet", CLOSING
    ),
    "cos_incidence": Output("1", "cosine of the incidence angle"),
    "surface": Output("1", "surface hit", dtype="int16"),
})  # fmt: skip
"""Arrays of an eyepoint store for each beamlet, besides SHOTS and CYCLES."""

WEIGHT = Output("1", "power fraction of the beamlet", dims=("beamlet",))

STATISTICS: dict[str, Output] = _over(("shot",), {
    "pd_up": Output("1", "probability of detection, up-chirp, strongest surface"),
    "pd_down": Output("1", "probability of detection, down-chirp, strongest surface"),
    "pd_doppler": Output("1", "probability of detection, Doppler segment, strongest surface"),
    "pd_shot": Output("1", "probability that up- and down-chirp both detect the strongest surface"),
    "pfa_up": Output("1", "probability of a false alarm, up-chirp, noise and leakage"),
    "pfa_down": Output("1", "probability of a false alarm, down-chirp, noise and leakage"),
    "snr_up": Output(
        "1", "signal-to-noise ratio, up-chirp, strongest bin",
        "as of a grid: with the pedestal of a laser's phase noise under the line",
    ),
    "surfaces_seen": Output("1", "groups of bins above the threshold, up-chirp", dtype="int16"),
    "beamlets": Output("1", "beamlets, each a ray that was cast", dtype="int32"),
    "beamlets_error": Output(
        "1", "largest change by more beamlets",
        "of pd in all three segments, or of a relative magnitude, whichever is more; "
        "estimated from the shot's own rays, where accuracy.tolerance says how many they are; "
        "else nan: not checked",
    ),
})  # fmt: skip
"""Probabilities of each shot, before any draw.

If spectra are held against another detector than the fixed threshold, or the strongest peak of a
segment is reported alone, probabilities are nan. If nothing is seen false alarms are those of the
noise alone, and all else is nan; so is ``pd_doppler`` without a Doppler segment.
"""

SIMULATED: dict[str, Output] = _over(("shot",), {
    "effects": Output("1", "effects that were simulated", dtype="uint32"),
    "effects_error": Output(
        "1", "largest change by effects that were left out",
        "sum over them of what each may change: of pd in all three segments, of log10 of "
        "the probability of a false alarm, or of a relative magnitude, whichever is most; and what "
        "overlap leaves of beamlets farther and nearer than the beam's axis",
    ),
})  # fmt: skip
"""Effects that were simulated of each shot; none of the effects where nothing is seen."""

_FALSE = "nan: a false one"

POINTS: dict[str, Output] = _over(("shot", "draw", "return_number"), {
    "position": Output(
        "m", "position of the point", "from the interpolated range", dims=_VECTOR
    ),
    "range": Output("m", "range by whole bins"),
    "range_interpolated": Output("m", "range interpolated between bins"),
    "radial_velocity": Output("m s-1", "radial velocity by whole bins", CLOSING),
    "radial_velocity_interpolated": Output(
        "m s-1", "radial velocity interpolated between bins", CLOSING
    ),
    "range_standard_error": Output("m", "standard error of the range by whole bins"),
    "range_interpolated_standard_error": Output("m", "standard error of the interpolated range"),
    "radial_velocity_standard_error": Output(
        "m s-1", "standard error of the radial velocity by whole bins"
    ),
    "radial_velocity_interpolated_standard_error": Output(
        "m s-1", "standard error of the interpolated radial velocity"
    ),
    "radial_velocity_compensated": Output(
        "m s-1", "interpolated radial velocity less the platform's own along the beam",
        "platform_velocity on beam_direction; of what is at rest its error, of what moves its own, "
        f"{CLOSING}",
    ),
    "range_per_slip": Output(
        "s", "change of the interpolated range by slip",
        "slip: radial velocity less the speed at which the range falls; the range is corrected for "
        "that of level ground",
    ),
    "radial_velocity_per_slip": Output(
        "1", "change of the interpolated radial velocity by slip", "as of range_per_slip"
    ),
    "snr": Output("1", "signal-to-noise ratio of the weaker of up and down peak"),
    "pd": Output("1", "probability that both peaks are detected", "nan for a false peak"),
    "surface": Output("1", "surface seen", "-1: none, or no true return", "int16"),
    "flags": Output("1", "what the point is", "0: no point", "uint8"),
    "true_range": Output("m", "true range of what the point has seen", _FALSE),
    "true_radial_velocity": Output(
        "m s-1", "true radial velocity of what the point has seen", _FALSE
    ),
})  # fmt: skip
"""Points of a cloud, up to a study's number of returns of each shot and draw."""

NAVIGATION: dict[str, Output] = _over(("cycle", "draw"), {
    "velocity": Output("m s-1", "velocity vector of the instrument", dims=_VECTOR),
    "velocity_covariance": Output(
        "m2 s-2", "covariance of the velocity's error", dims=(XYZ, XYZ_AGAIN)
    ),
    "velocity_status": Output("1", "how the velocity was solved", dtype="int8"),
    "velocity_beams": Output("1", "beams in the velocity's solution", dtype="int16"),
    "altitude": Output("m", "height of the instrument above the ground"),
    "altitude_variance": Output("m2", "variance of the altitude's error"),
    "altitude_status": Output("1", "how the altitude was solved", dtype="int8"),
    "altitude_beams": Output("1", "beams in the altitude's solution", dtype="int16"),
})  # fmt: skip
"""Navigation from each measurement cycle and draw; only where a cycle has three shots or more."""

GRID_VARIABLES = frozenset().union(
    OUTPUTS, STRONGEST_OUTPUTS, DRAW_OUTPUTS, ERROR_OUTPUTS, ACCURACY_OUTPUTS, RUNNING_OUTPUTS,
    SPECTRA_OUTPUTS, SIMULATED,
)  # fmt: skip
"""Names of all variables that the store of a grid may have."""
