"""Output variables of grids, spectra, flights and scenes: units, meaning, dimensions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

NO_DOPPLER_NOTE = "nan without a Doppler segment, which direct detection never has"
"""Comment stored with outputs of the Doppler segment."""
NO_ECHO_NOTE = "nan where no light comes back"
"""Comment stored with outputs that need an echo."""
NO_FREE_BIN_NOTE = (
    "-inf where the detection occupies every bin, so that none is left to raise an alarm"
)
"""Comment stored with logarithms of false-alarm probabilities."""
CLOSING_SIGN_NOTE = "positive when closing"
"""Comment stored with radial velocities; it states their sign."""

XYZ_DIM = "xyz"
"""Name of the store dimension of the world's axes x, y, z."""
SECOND_XYZ_DIM = "xyz_again"
"""Name of the second dimension of the world's axes in covariance matrices."""


@dataclass(frozen=True)
class OutputVariable:
    """Name, units and meaning of an output variable in a results store."""

    units: str
    """Physical units of the variable; "1" if it is dimensionless."""
    long_name: str
    """Name of the variable in words, for readers of the store."""
    comment: str = ""
    """Further explanation of the variable in words; empty if there is none."""
    dtype: str = "float64"
    """NumPy name of the data type, such as ``float64``."""
    dims: tuple[str, ...] = ()
    """Names of dimensions in addition to the study's axes. ``shot``, ``beamlet``, ``cycle``,
    ``draw`` and ``return_number`` count from 0; ``xyz`` are the axes of the world.
    """

    def empty_array(self, sizes: Mapping[str, int]) -> np.ndarray:
        """Return an uninitialised array for the variable.

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
    """Return an output variable for each segment and one for the shot, by name.

    Parameters
    ----------
    name_template
        Name with ``{}`` in the place of ``up``, ``down``, ``doppler`` or ``shot``.
    quantity_label
        Quantity in words.
    comment
        Comment on all variables.
    separator
        Text between this comment and that of a single variable.
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
"""Output variables of a grid study, by name; one float for each point."""

STRONGEST_PEAK_OUTPUTS: dict[str, OutputVariable] = _segment_variables(
    "p_wrong_range_{}",
    "probability of a detection with a wrong range",
    "a peak that is not the echo's crosses the threshold and is the strongest",
    separator="; ",
    shot_comment="both chirps report a peak, and one of the echo not both; or both do and are "
    "misread",
)
"""Additional output variables of studies in which a segment reports only its strongest peak. Keys
are names; each variable has one float for each point."""

NAN_WITHOUT_ECHO_OUTPUTS = tuple(
    name for name, output in GRID_OUTPUTS.items() if NO_ECHO_NOTE in output.comment
)
"""Names of outputs that are nan if no light returns to the receiver."""

_SEGMENT_PHRASES = {
    "up": "the up-chirp segment",
    "down": "the down-chirp segment",
    "doppler": "the Doppler segment",
}
DRAW_BATCH_DIM = "batch"
"""Name of the array dimension in a store along which draws are counted in batches."""

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
"""Numbers of draws with a detection or a false alarm: output variables by name."""

STANDARD_ERROR_OUTPUTS: dict[str, OutputVariable] = _segment_variables(
    "pd_{}_error",
    "standard error of the mean probability of detection",
    "over draws; 0 where nothing random is simulated, nan with a single draw",
    separator="; ",
)
"""Standard errors of outputs in studies with draws: output variables by name. The name is that of
the output with ``_error``. Each has one float for each point."""

PD_OUTPUT_NAMES = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
"""Names of the detection probabilities that a study's tolerance applies to when draws are made."""

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
"""Accuracy of estimates by random draws: output variables by name, one value for each point."""

RUNNING_SUMS_NAME = "running_sums"
"""Name of the output with the sums over draws, to which later draws can be added."""

RUNNING_SUM_OUTPUTS: dict[str, OutputVariable] = {
    RUNNING_SUMS_NAME: OutputVariable(
        "1", "sums that further draws are added to", "of random effects; of use to sweep extend"
    ),
}
"""The one output variable, by its name, that stores sums over draws of random effects. It has one
row for each point, and later draws can be added to these sums."""

OUTPUT_IS_LOGARITHM = np.array([name.startswith("log10_") for name in GRID_OUTPUTS])
"""(outputs,) bool: True for those of GRID_OUTPUTS that are logarithms."""
OUTPUT_HAS_SQUARED_DEVIATIONS = OUTPUT_IS_LOGARITHM | np.array(
    [f"{name}_error" in STANDARD_ERROR_OUTPUTS for name in GRID_OUTPUTS]
)
"""(outputs,) bool: True for those of GRID_OUTPUTS whose squared deviations from the mean are summed
over draws."""

N_GROUP_SUMS = 3 * len(PD_OUTPUT_NAMES)
"""Number of columns of a row of running sums that describe the means of groups of draws: mean, sum
of squared deviations, and sum over the unfinished group, of each probability of detection."""

N_RUNNING_SUMS = (
    len(GRID_OUTPUTS)
    + int(OUTPUT_HAS_SQUARED_DEVIATIONS.sum())
    + int(OUTPUT_IS_LOGARITHM.sum())
    + N_GROUP_SUMS
)
"""Number of values in a row of running sums. The row contains what further draws need in addition
to the stored means: numbers of values, sums of squared deviations, the largest logarithms, and the
sums over groups of draws."""

DETECTOR_INDEPENDENT_OUTPUTS = (
    "snr_up", "snr_down", "snr_doppler", "beamlets", "beamlets_error", "noise_variance", "misread",
)  # fmt: skip
"""Names of those :data:`GRID_OUTPUTS` that do not depend on the detector."""

_FALSE_ALARM_GROUP_NOTE = "adjacent flagged bins, none of them among those that the signal occupies"


def _measurement_variables(
    quantity: str, quantity_label: str, units: str
) -> dict[str, OutputVariable]:
    """Return a measured quantity's output variables by name: bias, its error, RMSE, bound.

    `quantity` is the beginning of their names, `quantity_label` the quantity in words, `units` its
    units.
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
"""Outputs of studies that draw full spectra: output variables by name, one float for each point.
ACCURACY_OUTPUTS and DRAW_COUNT_OUTPUTS are stored as well."""


def _with_dims(
    dims: tuple[str, ...], variables: dict[str, OutputVariable]
) -> dict[str, OutputVariable]:
    """Return output variables with the dimensions `dims` placed before their own."""
    return {
        name: replace(variable, dims=(*dims, *variable.dims))
        for name, variable in variables.items()
    }


_VECTOR_DIMS = (XYZ_DIM,)

SHOT_GEOMETRY_VARIABLES: dict[str, OutputVariable] = _with_dims(
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
"""True geometry of each shot of a flight: output variables by name. All draws share it."""

CYCLE_VARIABLES: dict[str, OutputVariable] = _with_dims(("cycle",), {
    "cycle_time": OutputVariable("s", "start of the measurement cycle"),
    "true_velocity": OutputVariable(
        "m s-1", "velocity of the instrument, mean over the cycle's shots", dims=_VECTOR_DIMS
    ),
    "true_altitude": OutputVariable(
        "m", "height of the instrument above the ground straight below it",
        "at the cycle's start; inf where there is none",
    ),
})  # fmt: skip
"""True motion of the instrument in each measurement cycle: output variables by name."""

BEAMLET_GEOMETRY_VARIABLES: dict[str, OutputVariable] = _with_dims(("shot", "beamlet"), {
    "offset": OutputVariable("m", "range less that of the reference beamlet"),
    "velocity_offset": OutputVariable(
        "m s-1", "radial velocity less that of the reference beamlet", CLOSING_SIGN_NOTE
    ),
    "cos_incidence": OutputVariable("1", "cosine of the incidence angle"),
    "surface": OutputVariable("1", "surface hit", dtype="int16"),
})  # fmt: skip
"""Geometry of each beamlet of each shot: output variables by name. They belong to an eyepoint
store, which holds the ray-traced geometry of a flight's shots, and also SHOT_GEOMETRY_VARIABLES and
CYCLE_VARIABLES."""

BEAMLET_WEIGHT_VARIABLE = OutputVariable("1", "power fraction of the beamlet", dims=("beamlet",))
"""Power fraction of each beamlet, an output variable of an eyepoint store. Such a store holds the
ray-traced geometry of a flight's shots."""

SHOT_STATISTIC_VARIABLES: dict[str, OutputVariable] = _with_dims(
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
"""Probabilities and other statistics of each shot that do not depend on draws, by name.

They are nan with a detector other than the fixed threshold, or if only the strongest peak of a
segment is reported. If nothing is hit, false alarms are those of noise alone and all else is nan.
``pd_doppler`` is nan without a Doppler segment.
"""

EFFECT_VARIABLES: dict[str, OutputVariable] = _with_dims(("shot",), {
    "effects": OutputVariable("1", "effects that were simulated", dtype="uint32"),
    "effects_error": OutputVariable(
        "1", "largest change by effects that were left out",
        "sum over them of what each may change: of pd in all three segments, of log10 of "
        "the probability of a false alarm, or of a relative magnitude, whichever is most; and what "
        "overlap leaves of beamlets farther and nearer than the beam's axis",
    ),
})  # fmt: skip
"""Effects that were simulated in each shot, by name. A shot whose rays hit nothing has no effects.
"""

_NAN_FOR_FALSE_POINT_NOTE = "nan: a false one"

POINT_CLOUD_VARIABLES: dict[str, OutputVariable] = _with_dims(
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
"""Points of a point cloud: output variables by name. Each shot and draw has at most as many points
as the study's number of returns."""

NAVIGATION_VARIABLES: dict[str, OutputVariable] = _with_dims(("cycle", "draw"), {
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
"""Velocity and altitude of each measurement cycle and draw: output variables by name. They are
stored if a cycle has three shots or more."""

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
"""Names of all output variables that the store of a grid may have."""
