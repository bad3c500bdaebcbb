"""What an evaluation yields for each point, and sampling by whole spectra: units and meaning."""

from dataclasses import dataclass

NO_DOPPLER = "nan for direct detection, which has no optical Doppler segment"
NO_ECHO = "nan where no light comes back"
NO_BIN = "-inf where the detection occupies every bin, so that none is left to raise an alarm"


@dataclass(frozen=True)
class Output:
    """A quantity: its units ("1" where it has none), its name in words, a further comment."""

    units: str
    long_name: str
    comment: str = ""
    whole: bool = False
    """Whether it is counted: an integer."""


def _pd(segment: str, comment: str = "") -> Output:
    return Output("1", f"probability of detection, {segment}", comment)


def _miss(segment: str, comment: str = "") -> Output:
    return Output("1", f"probability of a miss, {segment}", f"1 - pd with its digits. {comment}")


def _snr(segment: str, comment: str = "") -> Output:
    text = "power of the strongest bin over the mean noise power of a bin, after the FFT"
    return Output("1", f"signal-to-noise ratio, {segment}", f"{text}. {comment}".strip())


OUTPUTS: dict[str, Output] = {
    "pd_up": _pd("up-chirp"),
    "pd_down": _pd("down-chirp"),
    "pd_doppler": _pd("Doppler segment", NO_DOPPLER),
    "pd_shot": _pd("shot", "up- and down-chirp both detected"),
    "miss_up": _miss("up-chirp"),
    "miss_down": _miss("down-chirp"),
    "miss_doppler": _miss("Doppler segment", NO_DOPPLER),
    "miss_shot": _miss("shot"),
    "pfa_bin": Output("1", "probability of false alarm in one bin, from noise alone"),
    "pfa_segment": Output(
        "1",
        "probability of at least one false alarm in the up-chirp segment, from noise alone",
        "over the bins counted less those that the detection occupies; leakage is apart",
    ),
    "pfa_shot": Output(
        "1",
        "probability of a false alarm in the up- and in the down-chirp segment, from noise alone",
        "what Tables 4.3 to 4.5 of the thesis print",
    ),
    "log10_pfa_bin": Output("1", "log10 of pfa_bin", "finite where pfa_bin underflows"),
    "log10_pfa_segment": Output("1", "log10 of pfa_segment", NO_BIN),
    "log10_pfa_shot": Output("1", "log10 of pfa_shot", NO_BIN),
    "p_leakage_up": Output(
        "1", "probability that leaked signal raises a further group, up-chirp", "over noise alone"
    ),
    "p_leakage_down": Output(
        "1", "probability that leaked signal raises a further group, down-chirp", "over noise alone"
    ),
    "snr_up": _snr("up-chirp"),
    "snr_down": _snr("down-chirp"),
    "snr_doppler": _snr("Doppler segment", NO_DOPPLER),
    "beamlets": Output("1", "number of beamlets that were simulated"),
    "beamlets_error": Output(
        "1",
        "largest change of a probability of detection by more beamlets",
        "summed over the segments; 0 where their number is given, and so part of what is asked",
    ),
    "noise_variance": Output("V^2", "noise variance at the ADC, sigma_x^2"),
    "range_error": Output(
        "m",
        "reported less true range, without noise",
        f"peak bins of the three segments resolved; {NO_ECHO}",
    ),
    "radial_velocity_error": Output(
        "m s-1",
        "reported less true radial velocity, without noise",
        f"positive when closing; {NO_ECHO}",
    ),
}

WITHOUT_ECHO = tuple(name for name, output in OUTPUTS.items() if NO_ECHO in output.comment)
"""What has no value where no light comes back."""


def _count(what: str) -> Output:
    return Output("1", f"number of draws with {what}", whole=True)


DRAW_OUTPUTS: dict[str, Output] = {
    "n_detected_up": _count("a detection in the up-chirp segment"),
    "n_detected_down": _count("a detection in the down-chirp segment"),
    "n_detected_doppler": _count("a detection in the Doppler segment"),
    "n_detected_shot": _count("a detection in both chirp segments"),
    "n_false_alarm_up": _count("a false alarm in the up-chirp segment"),
    "n_false_alarm_down": _count("a false alarm in the down-chirp segment"),
    "n_false_alarm_shot": _count("a false alarm in both chirp segments"),
}


def _error(segment: str, comment: str = "") -> Output:
    text = "over draws; 0 where nothing random is simulated, nan with a single draw"
    name = f"standard error of the mean probability of detection, {segment}"
    return Output("1", name, "; ".join(filter(None, (text, comment))))


ERROR_OUTPUTS: dict[str, Output] = {
    "pd_up_error": _error("up-chirp"),
    "pd_down_error": _error("down-chirp"),
    "pd_doppler_error": _error("Doppler segment", NO_DOPPLER),
    "pd_shot_error": _error("shot"),
}
"""Floats, one a point, of studies with draws; each of the output that it is named after."""

PROMISED = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
"""Outputs of which the accuracy is promised."""


def _half_width(segment: str, comment: str = "") -> Output:
    text = (
        "pd plus and minus this holds the true one with the confidence promised: of the mean over "
        "draws where random effects are simulated; of the share of draws with a detection where "
        "noise alone is drawn; 0 where pd is exact"
    )
    name = f"half-width of the interval of the probability of detection, {segment}"
    return Output("1", name, "; ".join(filter(None, (text, comment))))


ACCURACY_OUTPUTS: dict[str, Output] = {
    "n_draws": Output("1", "number of draws", whole=True),
    "pd_up_half_width": _half_width("up-chirp"),
    "pd_down_half_width": _half_width("down-chirp"),
    "pd_doppler_half_width": _half_width("Doppler segment", NO_DOPPLER),
    "pd_shot_half_width": _half_width("shot"),
    "accuracy_missed": Output(
        "1", "largest half-width less the tolerance", "0 where the tolerance is met"
    ),
}
"""What draws have come to, point by point."""

RUNNING = "running_sums"

RUNNING_OUTPUTS: dict[str, Output] = {
    RUNNING: Output(
        "1", "sums that further draws are added to", "of random effects; of use to sweep extend"
    ),
}
"""What draws of random effects leave for further ones, a row a point."""

KEPT = ("snr_up", "snr_down", "snr_doppler", "beamlets", "beamlets_error", "noise_variance")
"""Of :data:`OUTPUTS`, what does not depend on the detector."""

_FOUND = "over draws in which every segment has a detection; nan with none"
_AT_FAULT = "adjacent flagged bins, none of them among those that the signal occupies"


def _share(segment: str, comment: str = "") -> Output:
    what = "share of draws with a detection at the strongest bin or beside it"
    return Output("1", f"probability of detection, {segment}", f"{what}. {comment}".strip())


def _mean(units: str, name: str) -> Output:
    return Output(units, name, _FOUND)


def _resolved(quantity: str, name: str, units: str) -> dict[str, Output]:
    """Bias, its error, RMSE and bound of what is reported."""
    bound = (
        "Cramer-Rao bound for lone tones of the signal's power in the up- and the down-chirp "
        "segment, of which it is resolved; rms over draws where random effects are simulated"
    )
    return {
        f"{quantity}_bias": _mean(units, f"mean of reported less true {name}"),
        f"{quantity}_bias_error": _mean(units, f"standard error of the bias of {name}"),
        f"{quantity}_rmse": _mean(units, f"root mean square of reported less true {name}"),
        f"{quantity}_bound": Output(units, f"least standard deviation of {name}", bound),
    }


SPECTRA_OUTPUTS: dict[str, Output] = {
    **{name: OUTPUTS[name] for name in KEPT},
    "pd_up": _share("up-chirp"),
    "pd_down": _share("down-chirp"),
    "pd_doppler": _share("Doppler segment", NO_DOPPLER),
    "pd_shot": _share("shot", "Up- and down-chirp both detected"),
    "pfa_bin": Output("1", "share of bins with a false alarm", f"those in groups of {_AT_FAULT}"),
    "pfa_bin_error": Output("1", "standard error of pfa_bin over draws"),
    "false_alarms": Output(
        "1", "mean number of false alarms in a shot", f"groups of {_AT_FAULT}, of all segments"
    ),
    "false_alarms_error": Output("1", "standard error of false_alarms over draws"),
    **_resolved("range", "range", "m"),
    **_resolved("radial_velocity", "radial velocity, positive when closing", "m s-1"),
}
"""Floats, one a point; beside them stand ACCURACY_OUTPUTS and DRAW_OUTPUTS."""
