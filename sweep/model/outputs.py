"""Output variables of grids, spectra, flights and scenes: units, meaning, dimensions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

NO_DOPPLER_NOTE = "nan without a Doppler segment, which direct detection never has"
"""Comment stored with output variables of the Doppler segment: where they are nan."""
NO_ECHO_NOTE = "nan where no light comes back"
"""Comment stored with output variables that need an echo: where they are nan."""
NO_FREE_BIN_NOTE = (
    "-inf where the detection occupies every bin, so that none is left to raise an alarm"
)
"""Comment that explains where a stored logarithm of a false-alarm probability is -inf."""
CLOSING_SIGN_NOTE = "positive when closing"
"""Comment stored with radial velocities that states which sign means closing."""

XYZ_DIM = "xyz"
"""Name of a store's dimension over the world's axes x, y, z."""
SECOND_XYZ_DIM = "xyz_again"
"""Name of a covariance matrix's second dimension over the world's axes x, y, z."""


@dataclass(frozen=True)
class OutputVariable:
    """Name, units and meaning of an output variable in a results store."""

    units: str
    """Physical units of the variable; "1" if it is dimensionless."""
    long_name: str
    """Name of the variable in words, for readers of the store."""
    comment: str = ""
    """Explanation of the variable in addition to `long_name`; empty if there is none."""
    dtype: str = "float64"
    """NumPy name of the data type, such as ``float64``."""
    dims: tuple[str, ...] = ()
    """Names of the variable's dimensions besides the study's axes. ``shot``, ``beamlet``,
    ``cycle``, ``draw`` and ``return_number`` count from 0; ``xyz`` are the axes of the world."""

    def empty_array(self, sizes: Mapping[str, int]) -> np.ndarray:
        """Return an array of the variable's data type and dimensions, with undefined values.

        `sizes` has the length of each dimension, by name.
        """
        return np.empty(tuple(sizes[dim] for dim in self.dims), self.dtype)


def _segment_variables(
    name_template: str,
    quantity_label: str,
    comment: str = "",
    *,
    separator: str = " ",
    shot_comment: str | None = "",
) -> dict[str, OutputVariable]:
    """Return output variables of one quantity by name: one for each segment, and one for the shot.

    Parameters
    ----------
    name_template
        Name of a variable, with ``{}`` in place of ``up``, ``down``, ``doppler`` or ``shot``.
    quantity_label
        Quantity in words.
    comment
        Comment on all variables.
    separator
        Text between `comment` and the additional comment of one variable.
    shot_comment
        Comment on the variable of the shot; None for no such variable.
    """
    segment_labels = {
        "up": "up-chirp",
        "down": "down-chirp",
        "doppler": "Doppler segment",
        "shot": "shot",
    }
    segment_comments = {"up": "", "down": "", "doppler": NO_DOPPLER_NOTE, "shot": shot_comment}
    return {
        name_template.format(key): OutputVariable(
            "1",
            f"{quantity_label}, {segment_labels[key]}",
            separator.join(filter(None, (comment, segment_comment))),
        )
        for key, segment_comment in segment_comments.items()
        if segment_comment is not None
    }


GRID_OUTPUTS: dict[str, OutputVariable] = {
    **_segment_variables(
        "pd_{}",
        "probability of detection",
        shot_comment="both chirps detected, or as shot_detection says",
    ),
    **_segment_variables("miss_{}", "probability of a miss", "1 - pd with its digits."),
    "pfa_bin": OutputVariable("1", "probability of false alarm in one bin, from noise alone"),
    "pfa_segment": OutputVariable(
        "1",
        "probability of at least one false alarm in the up-chirp segment, from noise alone",
        "over the bins counted less those that the detection occupies; leakage is apart",
    ),
    "pfa_both_chirps": OutputVariable(
        "1",
        "probability of a false alarm in the up- and in the down-chirp segment, from noise alone",
        "what Tables 4.3 to 4.5 of the thesis print",
    ),
    "pfa_shot": OutputVariable(
        "1",
        "probability of at least one false alarm in any segment of a shot, from noise alone",
        "the Doppler segment among them, where there is one",
    ),
    "log10_pfa_bin": OutputVariable("1", "log10 of pfa_bin", "finite where pfa_bin underflows"),
    "log10_pfa_segment": OutputVariable("1", "log10 of pfa_segment", NO_FREE_BIN_NOTE),
    "log10_pfa_both_chirps": OutputVariable("1", "log10 of pfa_both_chirps", NO_FREE_BIN_NOTE),
    "log10_pfa_shot": OutputVariable("1", "log10 of pfa_shot", NO_FREE_BIN_NOTE),
    "p_leakage_up": OutputVariable(
        "1",
        "probability that leaked signal raises a further group, up-chirp",
        "over noise alone",
    ),
    "p_leakage_down": OutputVariable(
        "1",
        "probability that leaked signal raises a further group, down-chirp",
        "over noise alone",
    ),
    **_segment_variables(
        "snr_{}",
        "signal-to-noise ratio",
        shot_comment=None,
        comment="mean power of the signal in the strongest bin over the mean noise power of a bin, "
        "after the FFT; the pedestal of a laser's phase noise under the line is signal.",
    ),
    "beamlets": OutputVariable("1", "number of beamlets that were simulated"),
    "beamlets_error": OutputVariable(
        "1",
        "largest change of a probability of detection by more beamlets",
        "summed over the segments; nan where it is not estimated: their number is given, or their "
        "amplitudes add",
    ),
    "noise_variance": OutputVariable(
        "V^2", "noise variance at the ADC, sigma_x^2", "of noise that is white within the bandwidth"
    ),
    "range_error": OutputVariable(
        "m",
        "reported less true range, without noise",
        f"peak bins of the segments resolved; {NO_ECHO_NOTE}",
    ),
    "radial_velocity_error": OutputVariable(
        "m s-1",
        "reported less true radial velocity, without noise",
        f"{CLOSING_SIGN_NOTE}; {NO_ECHO_NOTE}",
    ),
    "misread": OutputVariable(
        "1",
        "1 where the peaks are read as another range or velocity than the echo's, else 0",
        "without noise; beats beyond half the sample rate, or of another order than assumed. "
        f"What is detected then has a wrong range or velocity; {NO_ECHO_NOTE}",
    ),
}
"""Output variables of a grid study, by name. Each has one float for each point."""

STRONGEST_PEAK_OUTPUTS: dict[str, OutputVariable] = _segment_variables(
    "p_wrong_range_{}",
    "probability of a detection with a wrong range",
    "a peak that is not the echo's crosses the threshold and is the strongest",
    separator="; ",
    shot_comment="both chirps report a peak, and one of the echo not both; or both do and are "
    "misread",
)
"""Additional output variables, by name, of studies in which a segment reports only its strongest
peak. Each has one float for each point."""

NAN_WITHOUT_ECHO_OUTPUTS = tuple(
    name for name, output in GRID_OUTPUTS.items() if NO_ECHO_NOTE in output.comment
)
"""Names of those GRID_OUTPUTS that are nan if no light returns to the receiver."""

_SEGMENT_PHRASES = {
    "up": "the up-chirp segment",
    "down": "the down-chirp segment",
    "doppler": "the Doppler segment",
}
DRAW_BATCH_DIM = "batch"
"""Name of a store's dimension over batches of draws; draws are counted in each batch."""

DRAW_COUNT_OUTPUTS: dict[str, OutputVariable] = {
    f"n_{name}_{segment}": OutputVariable(
        "1", f"number of draws with a {event} in {segment_phrase}", dtype="int64"
    )
    for name, event, joint_name in (
        ("detected", "detection", "shot"),
        ("false_alarm", "false alarm", "both_chirps"),
    )
    for segment, segment_phrase in {**_SEGMENT_PHRASES, joint_name: "both chirp segments"}.items()
    if (name, segment) != ("false_alarm", "doppler")
}
"""Output variables, by name, that count draws with a detection or a false alarm."""

STANDARD_ERROR_OUTPUTS: dict[str, OutputVariable] = _segment_variables(
    "pd_{}_error",
    "standard error of the mean probability of detection",
    "over draws; 0 where nothing random is simulated, nan with a single draw",
    separator="; ",
)
"""Output variables, by name, of standard errors over draws. A name is that of the estimated output
with ``_error`` added. Each variable has one float for each point."""

PD_OUTPUT_NAMES = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
"""Names of the detection probabilities whose error over draws must be within a study's tolerance.
"""

ACCURACY_OUTPUTS: dict[str, OutputVariable] = {
    "n_draws": OutputVariable("1", "number of draws", dtype="int64"),
    **_segment_variables(
        "pd_{}_half_width",
        "half-width of the interval of the probability of detection",
        "pd plus and minus this holds the true one with the confidence promised: of the mean over "
        "draws where random effects are simulated; of the share of draws with a detection where "
        "noise alone is drawn; 0 where pd is exact",
        separator="; ",
    ),
    "accuracy_missed": OutputVariable(
        "1", "largest half-width less the tolerance", "0 where the tolerance is met"
    ),
}
"""Output variables, by name, that state the accuracy of estimates by random draws. Each has one
value for each point."""

RUNNING_SUMS_NAME = "running_sums"
"""Name of the output variable that stores sums over draws, so that later draws can be added."""

RUNNING_SUM_OUTPUTS: dict[str, OutputVariable] = {
    RUNNING_SUMS_NAME: OutputVariable(
        "1", "sums that further draws are added to", "of random effects; of use to sweep extend"
    ),
}
"""Output variable, by its name, that stores sums over draws of random effects, one row for each
point. Later draws can be added to these sums. It is the only entry."""

OUTPUT_IS_LOGARITHM = np.array([name.startswith("log10_") for name in GRID_OUTPUTS])
"""(outputs,) bool, in the order of GRID_OUTPUTS: True for outputs that are logarithms."""
OUTPUT_HAS_SQUARED_DEVIATIONS = OUTPUT_IS_LOGARITHM | np.array(
    [f"{name}_error" in STANDARD_ERROR_OUTPUTS for name in GRID_OUTPUTS]
)
"""(outputs,) bool, in the order of GRID_OUTPUTS: True for outputs whose squared deviations from the
mean are summed over draws."""

N_GROUP_SUM_COLUMNS = 3 * len(PD_OUTPUT_NAMES)
"""Number of columns of a row of running sums that describe groups of draws. For each of
PD_OUTPUT_NAMES they are the mean over groups, the sum of squared deviations, and the sum over the
unfinished group."""

RUNNING_SUMS_ROW_LENGTH = (
    len(GRID_OUTPUTS)
    + int(OUTPUT_HAS_SQUARED_DEVIATIONS.sum())
    + int(OUTPUT_IS_LOGARITHM.sum())
    + N_GROUP_SUM_COLUMNS
)
"""Number of columns of a row of running sums. The row contains numbers of values, sums of squared
deviations, largest logarithms and sums over groups of draws. With the stored means they are all
that later draws need to be added."""

DETECTOR_INDEPENDENT_OUTPUTS = (
    "snr_up", "snr_down", "snr_doppler", "beamlets", "beamlets_error", "noise_variance", "misread",
)  # fmt: skip
"""Names of those :data:`GRID_OUTPUTS` that do not depend on the detector."""

_FALSE_ALARM_GROUP_NOTE = "adjacent flagged bins, none of them among those that the signal occupies"


def _measurement_variables(
    quantity: str, quantity_label: str, units: str
) -> dict[str, OutputVariable]:
    """Return output variables by name for a measured quantity: its bias, errors and error bound.

    `quantity` is the beginning of the variables' names, `quantity_label` the quantity in words,
    `units` its units.
    """
    detection_note = "over draws in which every segment has a detection; nan with none"
    bound_note = (
        "Cramer-Rao bound for lone tones of the signal's power in the up- and the down-chirp "
        "segment, of which it is resolved, with what developed speckle adds on a slope; rms over "
        "draws"
    )
    return {
        f"{quantity}_bias": OutputVariable(
            units, f"mean of reported less true {quantity_label}", detection_note
        ),
        f"{quantity}_bias_error": OutputVariable(
            units, f"standard error of the bias of {quantity_label}", detection_note
        ),
        f"{quantity}_rmse": OutputVariable(
            units, f"root mean square of reported less true {quantity_label}", detection_note
        ),
        f"{quantity}_bound": OutputVariable(
            units, f"least standard deviation of {quantity_label}", bound_note
        ),
    }


SPECTRA_STUDY_OUTPUTS: dict[str, OutputVariable] = {
    **{name: GRID_OUTPUTS[name] for name in DETECTOR_INDEPENDENT_OUTPUTS},
    **_segment_variables(
        "pd_{}",
        "probability of detection",
        shot_comment="Both chirps detected, or as shot_detection says",
        comment="share of draws with a detection in a bin of the echo.",
    ),
    "pfa_bin": OutputVariable(
        "1", "share of bins with a false alarm", f"those in groups of {_FALSE_ALARM_GROUP_NOTE}"
    ),
    "pfa_bin_error": OutputVariable("1", "standard error of pfa_bin over draws"),
    "false_alarms": OutputVariable(
        "1",
        "mean number of false alarms in a shot",
        f"groups of {_FALSE_ALARM_GROUP_NOTE}, of all segments",
    ),
    "false_alarms_error": OutputVariable("1", "standard error of false_alarms over draws"),
    **_measurement_variables("range", "range", "m"),
    **_measurement_variables("radial_velocity", f"radial velocity, {CLOSING_SIGN_NOTE}", "m s-1"),
}
"""Output variables, by name, of studies that draw full spectra. Each has one float for each point.
Such studies also store ACCURACY_OUTPUTS and DRAW_COUNT_OUTPUTS."""


def _with_leading_dims(
    dims: tuple[str, ...], variables: dict[str, OutputVariable]
) -> dict[str, OutputVariable]:
    """Return copies of output variables with the dimensions `dims` placed before their own."""
    return {
        name: replace(variable, dims=(*dims, *variable.dims))
        for name, variable in variables.items()
    }


_VECTOR_DIMS = (XYZ_DIM,)

SHOT_GEOMETRY_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(
    ("shot",),
    {
        "time": OutputVariable(
            "s",
            "start of the measurement, from the attribute time_origin on",
            "which is the first time of the platform's table of waypoints, or 0",
        ),
        "beam": OutputVariable("1", "number of the beam", dtype="int32"),
        "shot_cycle": OutputVariable("1", "number of the measurement cycle", dtype="int32"),
        "platform_position": OutputVariable("m", "position of the instrument", dims=_VECTOR_DIMS),
        "platform_velocity": OutputVariable(
            "m s-1", "velocity of the instrument", dims=_VECTOR_DIMS
        ),
        "beam_direction": OutputVariable(
            "1",
            "unit vector along the beam, as commanded",
            "without pointing jitter",
            dims=_VECTOR_DIMS,
        ),
        "beam_range": OutputVariable(
            "m", "true range of the reference beamlet", "inf: nothing is seen"
        ),
        "beam_radial_velocity": OutputVariable(
            "m s-1", "true radial velocity of the reference beamlet", CLOSING_SIGN_NOTE
        ),
        "beam_acceleration": OutputVariable(
            "m s-2", "rate at which the radial velocity of the reference beamlet grows"
        ),
        "beam_approach": OutputVariable(
            "m s-1", "speed at which the range of the reference beamlet falls"
        ),
        "beam_turn_rate": OutputVariable(
            "rad s-1", "rate at which the direction of the reference beamlet turns"
        ),
        "beam_turning": OutputVariable(
            "s-1", "rate of change of beam_direction, by platform and scanner", dims=_VECTOR_DIMS
        ),
        "platform_acceleration": OutputVariable(
            "m s-2", "acceleration of the instrument", dims=_VECTOR_DIMS
        ),
        "beam_surface": OutputVariable(
            "1", "surface that the reference beamlet hits", dtype="int16"
        ),
    },
)
"""Output variables, by name, of the true geometry of each shot of a flight, which all draws share.
"""

CYCLE_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(("cycle",), {
    "cycle_time": OutputVariable("s", "start of the measurement cycle"),
    "true_velocity": OutputVariable(
        "m s-1", "velocity of the instrument, mean over the cycle's shots", dims=_VECTOR_DIMS
    ),
    "true_altitude": OutputVariable(
        "m", "height of the instrument above the ground straight below it",
        "at the cycle's start; inf where there is none",
    ),
})  # fmt: skip
"""Output variables, by name, of the instrument's true motion in each measurement cycle."""

BEAMLET_GEOMETRY_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(("shot", "beamlet"), {
    "offset": OutputVariable("m", "range less that of the reference beamlet"),
    "velocity_offset": OutputVariable(
        "m s-1", "radial velocity less that of the reference beamlet", CLOSING_SIGN_NOTE
    ),
    "cos_incidence": OutputVariable("1", "cosine of the incidence angle"),
    "surface": OutputVariable("1", "surface hit", dtype="int16"),
})  # fmt: skip
"""Output variables, by name, of the geometry of each beamlet of each shot. They are stored in an
eyepoint store, the ray-traced geometry of a flight's shots, beside SHOT_GEOMETRY_VARIABLES and
CYCLE_VARIABLES."""

BEAMLET_WEIGHT_VARIABLE = OutputVariable("1", "power fraction of the beamlet", dims=("beamlet",))
"""Output variable of each beamlet's power fraction. It is stored in an eyepoint store, the
ray-traced geometry of a flight's shots."""

SHOT_STATISTIC_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(
    ("shot",),
    {
        "pd_up": OutputVariable("1", "probability of detection, up-chirp, strongest surface"),
        "pd_down": OutputVariable("1", "probability of detection, down-chirp, strongest surface"),
        "pd_doppler": OutputVariable(
            "1", "probability of detection, Doppler segment, strongest surface"
        ),
        "pd_shot": OutputVariable(
            "1", "probability that up- and down-chirp both detect the strongest surface"
        ),
        "pfa_up": OutputVariable("1", "probability of a false alarm, up-chirp, noise and leakage"),
        "pfa_down": OutputVariable(
            "1", "probability of a false alarm, down-chirp, noise and leakage"
        ),
        "snr_up": OutputVariable(
            "1",
            "signal-to-noise ratio, up-chirp, strongest bin",
            "as of a grid: with the pedestal of a laser's phase noise under the line",
        ),
        "surfaces_seen": OutputVariable(
            "1", "groups of bins above the threshold, up-chirp", dtype="int16"
        ),
        "beamlets": OutputVariable("1", "beamlets, each a ray that was cast", dtype="int32"),
        "beamlets_error": OutputVariable(
            "1",
            "largest change by more beamlets",
            "of pd in all three segments or, without speckle, of a relative magnitude, whichever "
            "is more; estimated from the shot's own rays, where accuracy.tolerance says how many "
            "they are; else nan: not checked",
        ),
    },
)
"""Output variables, by name, of each shot's probabilities and other statistics that do not depend
on draws.

They are nan with a detector other than the fixed threshold, or if only the strongest peak of a
segment is reported. If a shot's rays hit nothing, false-alarm probabilities are those of noise
alone, and the other variables are nan. ``pd_doppler`` is nan without a Doppler segment."""

EFFECT_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(("shot",), {
    "effects": OutputVariable("1", "effects that were simulated", dtype="uint32"),
    "effects_error": OutputVariable(
        "1", "largest change by effects that were left out",
        "sum over them of what each may change: of pd in all three segments, of log10 of "
        "the probability of a false alarm, or of a relative magnitude, whichever is most; and what "
        "overlap leaves of beamlets farther and nearer than the beam's axis",
    ),
})  # fmt: skip
"""Output variables, by name, that state which effects were simulated in each shot. A shot whose
rays hit nothing has no effects."""

_NAN_FOR_FALSE_POINT_NOTE = "nan: a false one"

POINT_CLOUD_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(
    ("shot", "draw", "return_number"),
    {
        "position": OutputVariable(
            "m", "position of the point", "from the interpolated range", dims=_VECTOR_DIMS
        ),
        "range": OutputVariable("m", "range by whole bins"),
        "range_interpolated": OutputVariable("m", "range interpolated between bins"),
        "radial_velocity": OutputVariable(
            "m s-1", "radial velocity by whole bins", CLOSING_SIGN_NOTE
        ),
        "radial_velocity_interpolated": OutputVariable(
            "m s-1", "radial velocity interpolated between bins", CLOSING_SIGN_NOTE
        ),
        "range_standard_error": OutputVariable("m", "standard error of the range by whole bins"),
        "range_interpolated_standard_error": OutputVariable(
            "m", "standard error of the interpolated range"
        ),
        "radial_velocity_standard_error": OutputVariable(
            "m s-1", "standard error of the radial velocity by whole bins"
        ),
        "radial_velocity_interpolated_standard_error": OutputVariable(
            "m s-1", "standard error of the interpolated radial velocity"
        ),
        "radial_velocity_compensated": OutputVariable(
            "m s-1",
            "interpolated radial velocity less the platform's own along the beam",
            "platform_velocity on beam_direction; of what is at rest its error, of what moves its "
            "own, "
            f"{CLOSING_SIGN_NOTE}",
        ),
        "range_per_slip": OutputVariable(
            "s",
            "change of the interpolated range by slip",
            "slip: radial velocity less the speed at which the range falls; the range is corrected "
            "for "
            "that of level ground",
        ),
        "radial_velocity_per_slip": OutputVariable(
            "1", "change of the interpolated radial velocity by slip", "as of range_per_slip"
        ),
        "snr": OutputVariable("1", "signal-to-noise ratio of the weaker of up and down peak"),
        "pd": OutputVariable(
            "1", "probability that both peaks are detected", "nan for a false peak"
        ),
        "surface": OutputVariable("1", "surface seen", "-1: none, or no true return", "int16"),
        "flags": OutputVariable("1", "what the point is", "0: no point", "uint8"),
        "true_range": OutputVariable(
            "m", "true range of what the point has seen", _NAN_FOR_FALSE_POINT_NOTE
        ),
        "true_radial_velocity": OutputVariable(
            "m s-1", "true radial velocity of what the point has seen", _NAN_FOR_FALSE_POINT_NOTE
        ),
    },
)
"""Output variables, by name, of the points of a point cloud. Each shot and draw has at most as many
points as the study's number of returns."""

NAVIGATION_VARIABLES: dict[str, OutputVariable] = _with_leading_dims(("cycle", "draw"), {
    "velocity": OutputVariable("m s-1", "velocity vector of the instrument", dims=_VECTOR_DIMS),
    "velocity_covariance": OutputVariable(
        "m2 s-2", "covariance of the velocity's error", dims=(XYZ_DIM, SECOND_XYZ_DIM)
    ),
    "velocity_status": OutputVariable("1", "how the velocity was solved", dtype="int8"),
    "velocity_beams": OutputVariable("1", "beams in the velocity's solution", dtype="int16"),
    "altitude": OutputVariable("m", "height of the instrument above the ground"),
    "altitude_variance": OutputVariable("m2", "variance of the altitude's error"),
    "altitude_status": OutputVariable("1", "how the altitude was solved", dtype="int8"),
    "altitude_beams": OutputVariable("1", "beams in the altitude's solution", dtype="int16"),
})  # fmt: skip
"""Output variables, by name, of the velocity and altitude estimated in each measurement cycle and
draw. They are stored if a cycle has three shots or more."""

GRID_VARIABLE_NAMES = frozenset().union(
    GRID_OUTPUTS,
    STRONGEST_PEAK_OUTPUTS,
    DRAW_COUNT_OUTPUTS,
    STANDARD_ERROR_OUTPUTS,
    ACCURACY_OUTPUTS,
    RUNNING_SUM_OUTPUTS,
    SPECTRA_STUDY_OUTPUTS,
    EFFECT_VARIABLES,
)
"""Names of all output variables that a grid's store may contain."""
