"""What scenes yield: the arrays of eyepoints and of point clouds, their units and meaning.

Every array has the dimensions named, in that order; those of radiometry have the study's axes
before them. ``shot``, ``beamlet``, ``cycle``, ``draw`` and ``return_number`` count from 0; ``xyz``
are the world's axes.
"""

from dataclasses import dataclass

XYZ, XYZ_AGAIN = "xyz", "xyz_again"


@dataclass(frozen=True)
class SceneOutput:
    """A quantity: its units ("1" where it has none), its name in words, type and dimensions.

    Floats are nan where there is nothing, signed integers -1, flags 0.
    """

    units: str
    long_name: str
    dims: tuple[str, ...]
    dtype: str = "float64"
    comment: str = ""


def _shot(units: str, long_name: str, *dims: str, dtype: str = "float64", comment: str = ""):  # type: ignore[no-untyped-def]
    return SceneOutput(units, long_name, ("shot", *dims), dtype, comment)


def _point(units: str, long_name: str, *dims: str, dtype: str = "float64", comment: str = ""):  # type: ignore[no-untyped-def]
    return SceneOutput(units, long_name, ("shot", "draw", "return_number", *dims), dtype, comment)


def _cycle(units: str, long_name: str, *dims: str, dtype: str = "float64", comment: str = ""):  # type: ignore[no-untyped-def]
    return SceneOutput(units, long_name, ("cycle", "draw", *dims), dtype, comment)


CLOSING = "positive when closing"

SHOTS: dict[str, SceneOutput] = {
    "time": _shot("s", "start of the measurement"),
    "beam": _shot("1", "number of the beam", dtype="int32"),
    "shot_cycle": _shot("1", "number of the measurement cycle", dtype="int32"),
    "platform_position": _shot("m", "position of the instrument", XYZ),
    "platform_velocity": _shot("m s-1", "velocity of the instrument", XYZ),
    "beam_direction": _shot(
        "1", "unit vector along the beam, as commanded", XYZ, comment="without pointing jitter"
    ),
    "beam_range": _shot("m", "true range of the reference beamlet", comment="inf: nothing is seen"),
    "beam_radial_velocity": _shot(
        "m s-1", "true radial velocity of the reference beamlet", comment=CLOSING
    ),
    "beam_surface": _shot("1", "surface that the reference beamlet hits", dtype="int16"),
}
"""Geometry of each shot, the same for all draws and all radiometry: the truth of a point cloud."""

CYCLES: dict[str, SceneOutput] = {
    "cycle_time": SceneOutput("s", "start of the measurement cycle", ("cycle",)),
    "true_velocity": SceneOutput(
        "m s-1", "velocity of the instrument, mean over the cycle's shots", ("cycle", XYZ)
    ),
    "true_altitude": SceneOutput(
        "m", "height of the instrument above the ground straight below it", ("cycle",), "float64",
        "at the cycle's start; inf where there is none",
    ),
}  # fmt: skip
"""Truth of each measurement cycle."""

BEAMLETS: dict[str, SceneOutput] = {
    "offset": _shot("m", "range less that of the reference beamlet", "beamlet"),
    "velocity_offset": _shot(
        "m s-1", "radial velocity less that of the reference beamlet", "beamlet", comment=CLOSING
    ),
    "cos_incidence": _shot("1", "cosine of the incidence angle", "beamlet"),
    "surface": _shot("1", "surface hit", "beamlet", dtype="int16"),
}
"""What an eyepoint store holds of each beamlet, beside SHOTS and CYCLES."""

WEIGHT = SceneOutput("1", "power fraction of the beamlet", ("beamlet",))

STATISTICS: dict[str, SceneOutput] = {
    "pd_up": _shot("1", "probability of detection, up-chirp, strongest surface"),
    "pd_down": _shot("1", "probability of detection, down-chirp, strongest surface"),
    "pd_doppler": _shot("1", "probability of detection, Doppler segment, strongest surface"),
    "pd_shot": _shot("1", "probability that up- and down-chirp both detect the strongest surface"),
    "pfa_up": _shot("1", "probability of a false alarm, up-chirp, noise and leakage"),
    "pfa_down": _shot("1", "probability of a false alarm, down-chirp, noise and leakage"),
    "snr_up": _shot("1", "signal-to-noise ratio, up-chirp, strongest bin"),
    "surfaces_seen": _shot("1", "groups of bins above the threshold, up-chirp", dtype="int16"),
    "beamlets": _shot("1", "beamlets, each a ray that was cast", dtype="int32"),
    "beamlets_error": _shot(
        "1", "largest change by more beamlets",
        comment="of pd in all three segments, or of a relative magnitude, whichever is more; "
        "estimated from the shot's own rays, where accuracy.tolerance says how many they are; "
        "else 0",
    ),
}  # fmt: skip
"""Probabilities of each shot, before any draw.

Where nothing is seen false alarms are those of the noise alone, and all else is nan; so is
``pd_doppler`` of direct detection, which has no optical Doppler segment.
"""

SIMULATED: dict[str, SceneOutput] = {
    "effects": _shot("1", "effects that were simulated", dtype="uint32"),
    "effects_error": _shot(
        "1", "largest change by effects that were left out",
        comment="sum over them of what each may change: of pd in all three segments, of log10 of "
        "the probability of a false alarm, or of a relative magnitude, whichever is most",
    ),
}  # fmt: skip
"""What was simulated of each shot; none of the effects where nothing is seen."""

POINTS: dict[str, SceneOutput] = {
    "position": _point("m", "position of the point", XYZ, comment="from the interpolated range"),
    "range": _point("m", "range by whole bins"),
    "range_interpolated": _point("m", "range interpolated between bins"),
    "radial_velocity": _point("m s-1", "radial velocity by whole bins", comment=CLOSING),
    "radial_velocity_interpolated": _point(
        "m s-1", "radial velocity interpolated between bins", comment=CLOSING
    ),
    "range_standard_error": _point("m", "standard error of the range by whole bins"),
    "range_interpolated_standard_error": _point("m", "standard error of the interpolated range"),
    "radial_velocity_standard_error": _point(
        "m s-1", "standard error of the radial velocity by whole bins"
    ),
    "radial_velocity_interpolated_standard_error": _point(
        "m s-1", "standard error of the interpolated radial velocity"
    ),
    "snr": _point("1", "signal-to-noise ratio of the weaker of up and down peak"),
    "pd": _point("1", "probability that both peaks are detected", comment="nan for a false peak"),
    "surface": _point("1", "surface seen", dtype="int16", comment="-1: none, or no true return"),
    "flags": _point("1", "what the point is", dtype="uint8", comment="0: no point"),
    "true_range": _point("m", "true range of what the point has seen", comment="nan: a false one"),
    "true_radial_velocity": _point(
        "m s-1", "true radial velocity of what the point has seen", comment="nan: a false one"
    ),
}
"""Points of a cloud, up to a study's number of returns of each shot and draw."""

NAVIGATION: dict[str, SceneOutput] = {
    "velocity": _cycle("m s-1", "velocity vector of the instrument", XYZ),
    "velocity_covariance": _cycle("m2 s-2", "covariance of the velocity's error", XYZ, XYZ_AGAIN),
    "velocity_status": _cycle("1", "how the velocity was solved", dtype="int8"),
    "velocity_beams": _cycle("1", "beams in the velocity's solution", dtype="int16"),
    "altitude": _cycle("m", "height of the instrument above the ground"),
    "altitude_variance": _cycle("m2", "variance of the altitude's error"),
    "altitude_status": _cycle("1", "how the altitude was solved", dtype="int8"),
    "altitude_beams": _cycle("1", "beams in the altitude's solution", dtype="int16"),
}
"""Navigation from each measurement cycle and draw; only where a cycle has three shots or more."""
