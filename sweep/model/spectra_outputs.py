"""What sampling by whole spectra yields for each point: names, units, meaning."""

from sweep.model.outputs import NO_DOPPLER, OUTPUTS, Output

KEPT = ("snr_up", "snr_down", "snr_doppler", "beamlets", "beamlets_error", "noise_variance")
"""Of :data:`sweep.model.outputs.OUTPUTS`, what does not depend on the detector."""

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
