"""No signal, next to no light, a full ADC, lines of any width."""

import math
from collections.abc import Iterator

import mpmath as mp
import numpy as np
from hard_cases import EPS, Family
from table_4_1_shots import prepare_shot, table_4_1_parameters

from sweep.model.effects.catalogue import DEFAULT_EFFECTS, EFFECTS
from sweep.model.effects.saturation import clipping_gains
from sweep.model.evaluation import evaluate
from sweep.model.laser_line import (
    gaussian_frequency_shifts,
    pedestal_density_under_line,
    pedestal_power_under_line,
    pure_line_power_fraction,
)
from sweep.model.spectrum.segment_spectra import segment_spectrum as segment_spectrum
from sweep.model.window import get_window, window_samples

FAMILY = Family(
    "Radiometry and noise",
    "Cases with a vanishing denominator, or with a small difference of large numbers. Powers and "
    "noise are products of ten factors or so; probabilities magnify what is wrong with a "
    "threshold over noise b by b^2.",
)
CERTAIN_EFFECTS = tuple(effect.name for effect in EFFECTS if not effect.is_random)
BETA_SQUARED = (4 - math.pi) / 2
"""(threshold / sigma)^2 for a TNR of 1."""


def rayleigh_false_alarm(tnr: float) -> mp.mpf:
    """Chance that a bin of noise alone crosses: exp(-(4 - pi) / 4 TNR^2)."""
    return mp.exp(-(4 - mp.pi) / 4 * mp.mpf(tnr) ** 2)


@FAMILY.case(
    "no reflectance: every architecture, every effect, TNR 1e-3 to 37",
    reference="exp(-(4 - pi) / 4 TNR^2), 30 digits",
    measure="probabilities of detection",
    allowed=1e-12,
    limit=BETA_SQUARED * 37**2 * 2 * EPS,
    because="the threshold over noise, rounded, squared and exponentiated",
)
def no_reflectance() -> float:
    worst = 0.0
    with mp.workdps(30):
        for architecture in ("homodyne", "heterodyne", "direct"):
            for effects in ((), DEFAULT_EFFECTS, CERTAIN_EFFECTS):
                for tnr in (1e-3, 1.0, 10.0, 37.0):
                    statistics = statistics_without_reflectance(architecture, tnr, effects)
                    for name in ("pd_up", "pd_down"):
                        worst = max(
                            worst, float(abs(statistics[name][0] / rayleigh_false_alarm(tnr) - 1))
                        )
                    assert statistics["snr_up"][0] == 0.0
                    assert statistics["p_leakage_up"][0] < 1e-48  # light that leaks, at 300 dB
    return worst


def statistics_without_reflectance(
    architecture: str, tnr: float, effects: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Statistics of a shot at a target that reflects nothing."""
    scene = table_4_1_parameters(
        reflectance=0.0, architecture=architecture, tnr=tnr, fft_size=1024, beamlets=7,
        full_scale=1.0, bits=12.0, line_width=1e4, extinction=1e-4, transverse_velocity=30.0,
        acquisition_delay=14e-6,  # when an echo from 2 km would be there
    )  # fmt: skip
    return evaluate(scene, effects)


@FAMILY.case(
    "transmitters of 1e-300 W to 1e-30 W beside ordinary noise",
    reference="exp(-(4 - pi) / 4 TNR^2), 30 digits",
    measure="probabilities of detection",
    allowed=1e-13,
    limit=BETA_SQUARED * 10**2 * 2 * EPS,
    because="the threshold over noise, rounded, squared and exponentiated",
)
def next_to_no_signal() -> float:
    worst = 0.0
    with mp.workdps(30):
        for power in (1e-300, 1e-150, 1e-30):
            statistics = evaluate(table_4_1_parameters(power=power, fft_size=1024))
            worst = max(worst, float(abs(statistics["pd_up"][0] / rayleigh_false_alarm(10.0) - 1)))
    return worst


@FAMILY.case(
    "local oscillators of 1e-200 W to 1e100 W and no other noise",
    reference="shot-limited SNR: Re P T / q over the window's ENBW, 30 digits",
    measure="signal-to-noise ratio",
    allowed=1e-14,
    limit=20 * EPS,
    because="powers and roots of twenty factors, rounded",
)
def shot_noise_limit() -> float:
    """On a bin, without poles in the receiver, at normal incidence of a single line."""
    worst = 0.0
    for local_oscillator_power in (1e-200, 1e-30, 1e-3, 1.0, 1e100):
        shot_parameters = table_4_1_parameters(
            local_oscillator_power=local_oscillator_power,
            noise_equivalent_power=0.0,
            amplifier_noise_current=0.0,
            detector_bandwidth=3e8,
            amplifier_bandwidth=3e8,
            fft_size=1024,
            window="hann",
            radial_velocity=0.0,
            range=1e-3,
        )
        statistics = evaluate(shot_parameters, ())
        worst = max(worst, abs(statistics["snr_doppler"][0] / shot_limited_snr(1e-3) - 1))
    return worst


def shot_limited_snr(range_m: float) -> float:
    """SNR of a line at DC, on its image: (a sum w)^2 / (2 E_w sigma^2).

    With a^2 = 4 Re^2 P P_lo and sigma^2 = 2 q Re P_lo B.
    """
    with mp.workdps(30):
        echo = mp.mpf(0.1) * mp.pi * mp.mpf(0.0125) ** 2 / (2 * mp.pi * mp.mpf(range_m) ** 2)
        charge = mp.mpf("1.602176634e-19")
        enbw = mp.mpf("1.5")
        return float(mp.mpf(1.1) * echo / (2 * charge * mp.mpf(3e8)) * 1024 / enbw)


@FAMILY.case(
    "thresholds of TNR 1e-6 to 1e6, by their logarithm",
    reference="the plain formula in 700 digits; ln p + ln n below",
    measure="log10 of a false alarm, in a bin and in a segment",
    allowed=1e-14,
    limit=8 * EPS,
    because="a threshold over noise, rounded and squared; where few noise bins stay below it, "
    "an exponent of up to 300",
)
def false_alarms_by_logarithm() -> float:
    worst = 0.0
    with mp.workdps(700):
        for tnr in (1e-6, 1e-3, 0.5, 5.0, 10.0, 45.0, 1e3, 1e6):
            statistics = evaluate(table_4_1_parameters(reflectance=0.0, tnr=tnr, fft_size=1024), ())
            log = -(4 - mp.pi) / 4 * mp.mpf(tnr) ** 2
            n_bins = int(
                prepare_shot((), reflectance=0.0, fft_size=1024).n_alarm_equivalent_bins(
                    np.array([0])
                )[0]
            )
            p = mp.exp(log) if log > -600 else None
            bin_counts = [n_bins - n_exempt for n_exempt in (2, 3)]
            segment = [
                mp.log(1 - (1 - p) ** n) if p is not None else log + mp.log(n) for n in bin_counts
            ]
            log_pfas = statistics["log10_pfa_bin"][0], statistics["log10_pfa_segment"][0]
            worst = max(worst, float(abs(log_pfas[0] * mp.log(10) / log - 1)))
            if abs(segment[1]) > 1e-300:
                worst = max(
                    worst,
                    min(
                        float(abs(log_pfas[1] * mp.log(10) / exact_log - 1))
                        for exact_log in segment
                    ),
                )
    return worst


# Saturation


def clipping_gains_exactly(
    amplitude: float, deviation: float, full_scale: float
) -> tuple[mp.mpf, mp.mpf]:
    """Gains of line and noise: the mean and variance of clipped noise over the sine's phase."""
    amplitude, deviation, full_scale = mp.mpf(amplitude), mp.mpf(deviation), mp.mpf(full_scale)

    def moments(beat: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        high, low = (full_scale - beat) / deviation, (-full_scale - beat) / deviation
        above, below = mp.erfc(high / mp.sqrt(2)) / 2, mp.erfc(-low / mp.sqrt(2)) / 2
        densities = [mp.exp(-z * z / 2) / mp.sqrt(2 * mp.pi) for z in (high, low)]
        inside = mp.erf(high / mp.sqrt(2)) / 2 - mp.erf(low / mp.sqrt(2)) / 2
        mean = high * above + low * below + densities[1] - densities[0]
        second_moment = (
            high**2 * above + low**2 * below + inside + low * densities[1] - high * densities[0]
        )
        return beat + deviation * mean, deviation * deviation * (second_moment - mean**2)

    clipping_phases = [
        mp.asin(min(max((full_scale + c * deviation) / amplitude, 0), 1))
        for c in (-12, -6, -3, -1, 0, 1, 3, 6, 12)
    ]
    edges = sorted({mp.mpf(0), *clipping_phases, mp.pi / 2})
    line = mp.quad(lambda t: moments(amplitude * mp.sin(t))[0] * mp.sin(t), edges)
    noise = mp.quad(lambda t: moments(amplitude * mp.sin(t))[1], edges)
    return 4 / mp.pi * line / amplitude, 2 / mp.pi * noise / deviation**2


def clipping_error(*scenes: tuple[float, float, float]) -> float:
    """Worst relative error of both gains."""
    worst = 0.0
    with mp.workdps(30):
        for scene in scenes:
            amplitude, deviation, full_scale = scene
            gains = clipping_gains(amplitude=amplitude, deviation=deviation, full_scale=full_scale)
            line, noise = clipping_gains_exactly(amplitude, deviation, full_scale)
            worst = max(worst, float(abs(float(gains.signal_gain) / line - 1)))
            worst = max(worst, float(abs(float(gains.noise_gain) / noise - 1)))
    return worst


CLIPPING_CASE = {
    "reference": "clipped moments integrated, 30 digits",
    "measure": "gain of line, of noise",
}


@FAMILY.case(
    "clipping from none to hard, noise of 0.01 to 1 of the beat",
    allowed=1e-14,
    limit=10 * EPS,
    because="differences of normal integrals near 1",
    **CLIPPING_CASE,
)
def clipping_moderate() -> float:
    return clipping_error((1, 0.1, 2), (1, 0.1, 0.9), (1, 1, 0.7), (1, 0.01, 0.5), (0.01, 1, 3))


@FAMILY.case(
    "a beat far below the noise, which clips",
    allowed=1e-11, limit=EPS / 1e-5,
    because="a loss of 1e-5 of the noise off a beat that small", **CLIPPING_CASE,
)  # fmt: skip
def clipping_faint() -> float:
    return clipping_error((1e-3, 1, 1), (1e-5, 1, 0.3))


@FAMILY.case(
    "a beat of 100 to 1e4 times full scale",
    allowed=1e-11, limit=1e4 * EPS,
    because="one less what is lost, which is all but 1e-4", is_slow=True, **CLIPPING_CASE,
)  # fmt: skip
def clipping_hard() -> float:
    return clipping_error((100, 0.1, 1), (1e4, 1, 1))


# Line widths


@FAMILY.case(
    "a line of no width, and of 5e-324 Hz",
    reference="the same shot without the effect",
    measure="abs(X), of itself",
    allowed=0.0,
    limit=0.0,
    because="there is nothing to compute",
)
def no_width() -> float:
    scene = {"fft_size": 1024, "window": "hann"}
    spectrum_without_width = segment_spectrum(prepare_shot(**scene), 0, 0)[1]
    worst = 0.0
    for shape in ("gaussian", "lorentzian"):
        for width in (0.0, 5e-324):
            single_shot = prepare_shot(
                (*DEFAULT_EFFECTS, "line_width"), **scene, line_width=width, line_shape=shape
            )
            magnitude = segment_spectrum(single_shot, 0, 0)[1]
            worst = max(worst, float(np.abs(magnitude / spectrum_without_width - 1).max()))
    return worst


@FAMILY.case(
    "a Gaussian line four times as wide as the band",
    reference="power spread evenly: sum w^2 of line and image",
    measure="rms abs(X) of every bin",
    allowed=1e-11,
    limit=1e-12,
    because="the trapezium rule is meant to 1e-12 of the peak's power, 1e-3 of which is here",
)
def wider_than_the_band() -> float:
    single_shot = prepare_shot(
        (*DEFAULT_EFFECTS, "line_width"),
        fft_size=256,
        window="hann",
        line_width=2.4e9,
        detector_bandwidth=1e30,
        amplifier_bandwidth=1e30,
    )
    _, magnitude = segment_spectrum(single_shot, 0, 1)
    half_amplitude = (
        float(
            single_shot.echo_scales.beat_amplitude_scale
            * single_shot.footprint.relative_amplitude[0, 0]
        )
        / 2
    )
    even_magnitude = half_amplitude * math.sqrt(2 * float((window_samples("hann", 256) ** 2).sum()))
    return float(np.abs(magnitude[3:-3] / even_magnitude - 1).max())


def widths_and_delays() -> Iterator[tuple[float, float]]:
    """Widths [Hz] and delays [s] from hardly any phase noise to nothing else."""
    yield from ((line_width, 1e-5) for line_width in (1e-9, 1.0, 1e3, 1e5, 1e7, 1e10))


@FAMILY.case(
    "the density of a pedestal of 1e-13 of the power to all of it",
    reference="2 (1 - e^-g (1 + g)) / Gamma written out, 60 digits",
    measure="density",
    allowed=1e-14,
    limit=4 * EPS,
    because="a difference of second order, by its series where it is below 1e-4 of its terms",
)
def pedestal_density() -> float:
    worst = 0.0
    with mp.workdps(60):
        for width, delay in widths_and_delays():
            gamma = 2 * mp.pi * mp.mpf(width)
            exact_density = 2 / gamma * (1 - mp.exp(-gamma * delay) * (1 + gamma * delay))
            density = pedestal_density_under_line(line_width=np.array(width), delay=np.array(delay))
            worst = max(worst, float(abs(float(density) / exact_density - 1)))
    return worst


@FAMILY.case(
    "noise under a Lorentzian line, from 1e-11 of the power to all of it, 1 uHz to 100 THz",
    reference="sum over every lag of the record, exactly rounded",
    measure="mean power of the line's bin",
    allowed=1e-6,
    limit=1e-12,
    because="sums over lags; the integral over the lag is meant to 2e-5",
)
def noise_under_line() -> float:
    length, rate = 2048, 600e6
    w = window_samples("hann", length)
    window_correlation = np.correlate(w, w, "full")[length - 1 :]
    lags, worst = np.arange(length), 0.0
    for width in (1e-6, 1e3, 1e5, 1e6, 9.5e6, 9.6e6, 1e8, 1e10, 1e14):
        delay, duration = 1.5e-6, length / rate
        gamma, delay_beyond_lag = 2 * math.pi * width, np.maximum(delay - lags / rate, 0.0)
        lag_terms = (
            np.exp(-gamma * lags / rate) * -np.expm1(-gamma * delay_beyond_lag) * window_correlation
        )
        exact = 2 * math.fsum(lag_terms) - lag_terms[0]
        power = pedestal_power_under_line(
            line_width=np.array([width]), delay=np.array([delay]),
            duration=np.array([duration]), window=get_window("hann", length),
        )  # fmt: skip
        worst = max(worst, abs(float(power[0]) / exact - 1))
    return worst


@FAMILY.case(
    "what is left of a line whose laser is as wide as the band",
    reference="exp(-2 pi dnu tau), 30 digits",
    measure="share of the line",
    allowed=2e-13,
    limit=628 * EPS,
    because="an exponent of up to 628, rounded",
)
def share_of_the_line() -> float:
    worst = 0.0
    with mp.workdps(30):
        for width, delay in ((1e-9, 1e-5), (1e4, 1e-5), (1e7, 1e-5), (1e11, 1e-9)):
            share = pure_line_power_fraction(
                line_width=np.array(width), delay=np.array(delay), duration=np.array(1.0)
            )
            exact_share = mp.exp(-2 * mp.pi * mp.mpf(width) * mp.mpf(delay))
            worst = max(worst, float(abs(float(share) / exact_share - 1)))
    return worst


@FAMILY.case(
    "shifts of a Gaussian line, from 1e-6 of a bin to 500 bins wide",
    reference="moments of the normal distribution",
    measure="sum, variance and fourth moment of the weights",
    allowed=3e-9,
    limit=1e-9,
    because="tails cut where they hold 1e-12, and 1e-9 of the fourth moment",
)
def gaussian_line_shifts() -> float:
    worst = 0.0
    for width in (1e-6, 1e-3, 1.0, 30.0, 500.0):
        line_shifts = gaussian_frequency_shifts(
            fwhm=np.array([width * 2.3548200450309493]), duration=np.ones(1)
        )
        for order, moment in ((0, 1.0), (2, width**2), (4, 3 * width**4)):
            weighted_moment = math.fsum(
                (line_shifts.weight * line_shifts.shift_window_bins**order)[0]
            )
            worst = max(worst, abs(weighted_moment / moment - 1))
    return worst


# Air


@FAMILY.case(
    "air that lets 1 to 1e-300 of the light through, and none",
    reference="exp(-2 alpha R), 30 digits",
    measure="echo power",
    allowed=2e-13,
    limit=2 * 345 * EPS,
    because="an exponent of up to 690, rounded",
)
def extinction_of_air() -> float:
    worst = 0.0
    clear_power = float(prepare_shot(()).echo_power[0])
    with mp.workdps(30):
        for extinction in (1e-12, 1e-4, 0.01, 0.17, 10.0):
            single_shot = prepare_shot(
                ("extinction",), profile="layer", extinction=extinction, depth=1e5,
            )  # fmt: skip
            exact_power = clear_power * mp.exp(-2 * mp.mpf(extinction) * 2000)
            if exact_power > mp.mpf("1e-300"):
                worst = max(worst, float(abs(float(single_shot.echo_power[0]) / exact_power - 1)))
            statistics = evaluate(
                table_4_1_parameters(profile="layer", extinction=extinction, depth=1e5),
                (*DEFAULT_EFFECTS, "extinction"),
            )
            if extinction > 1:
                worst = max(
                    worst, float(abs(statistics["pd_up"][0] / rayleigh_false_alarm(10.0) - 1))
                )
    return worst
