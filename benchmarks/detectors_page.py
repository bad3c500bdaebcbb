"""Measure false alarms, losses and masking of detectors, and errors of estimators.

Run with `make detectors`, a minute on one core. Writes the tables and figures of docs/detectors.md.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmark_helpers import DOCS, markdown_table, replace_page_part
from scipy.optimize import brentq

from sweep.analysis import canvas
from sweep.model.detection import estimators
from sweep.model.detection.detectors import (
    CA_CFAR,
    DETECTORS,
    GOCA_CFAR,
    OS_CFAR,
    SpectrumSettings,
    cached_window_samples,
    cfar_crossing_probability,
    cfar_factor,
)
from sweep.model.detection.estimators import ESTIMATORS
from sweep.model.window import get_window

CFAR_KINDS = (CA_CFAR, OS_CFAR, GOCA_CFAR)
RECORD_LENGTH, TRAINING_CELLS, GUARD_CELLS, PFA = 1024, 32, 4, 1e-3
N_RECORDS = 4000
WINDOWS_AND_PADDING = (
    ("rectangular", 1),
    ("rectangular", 2),
    ("hamming", 1),
    ("hann", 1),
    ("hann", 2),
    ("blackmanharris", 1),
)

STRONG_SNR_DB, WEAK_SNR_DB, WEAK_BIN, MASKING_DRAWS = 40.0, 18.0, 200.0, 500
"""SNR [dB] of two returns, place [bins] of the weaker one, draws of each separation."""

TONE_BIN, N_TONES, SNR_DB = 200, 500, np.arange(8, 61, 4.0)
"""Bin near which estimators are tried, tones of each SNR, SNR after the FFT [dB]."""


def detector_setting(name: str, fft_size: int, **changes: float) -> SpectrumSettings:
    """Return the settings of detectors and estimators in noise of variance 1."""
    w = get_window(name, RECORD_LENGTH)
    options = {
        "noise_power": w.energy,
        "training": TRAINING_CELLS,
        "guard": GUARD_CELLS,
        "rank": 3 * TRAINING_CELLS // 4,
        "pfa": PFA,
    } | changes
    threshold = float(np.sqrt(-options["noise_power"] * np.log(options["pfa"])))
    return SpectrumSettings(
        fft_size=fft_size, sample_rate=float(fft_size), window=w, threshold=threshold, **options
    )


def false_alarm_rows() -> Iterator[list[str]]:
    """Yield table rows with the ratio of measured to design pfa, by window and padding."""
    for name, padding in WINDOWS_AND_PADDING:
        s = detector_setting(name, padding * RECORD_LENGTH)
        noise = np.random.default_rng(1).standard_normal(
            (N_RECORDS, RECORD_LENGTH)
        ) * cached_window_samples(s.window)
        power = np.abs(np.fft.rfft(noise, s.fft_size)) ** 2
        cells = [name, f"{padding}"]
        for detect in DETECTORS.values():
            share = detect(power, s)[:, 1:-1].mean(axis=1) / PFA
            cells.append(f"{share.mean():.2f} ± {share.std() / np.sqrt(N_RECORDS):.2f}")
        yield cells


def loss_rows() -> Iterator[list[str]]:
    """Yield table rows with the CFAR loss of each detector, for a signal with speckle."""
    for training in (16, 32, 64):
        for pfa in (1e-4, 1e-6):
            yield [
                f"{training}",
                f"{pfa:g}",
                *(f"{cfar_loss_db(k, training, pfa):.2f}" for k in CFAR_KINDS),
            ]


def cfar_loss_db(kind: str, training: int, pfa: float, pd: float = 0.5) -> float:
    """Return the CFAR loss in closed form: the SNR beyond that for a known noise level [dB]."""
    rank = 3 * training // 4
    factor = cfar_factor(kind, training=training, rank=rank, pfa=pfa)

    def pd_shortfall(snr: float) -> float:
        return (
            cfar_crossing_probability(kind, factor / (1 + snr), training=training, rank=rank) - pd
        )

    return float(10 * np.log10(brentq(pd_shortfall, 1e-3, 1e9) / (np.log(pfa) / np.log(pd) - 1)))


def draw_masking(path: Path) -> None:
    """Draw the figure of pd of a weak return over its distance from a strong one."""
    separations = np.arange(2, 41)
    figure, axes = canvas.sheet_with_axes(10.0, 3.8, 1, 2, sharex=True, sharey=True)
    for axis, name in zip(axes, ("rectangular", "hann"), strict=True):
        detector = detector_setting(name, RECORD_LENGTH, pfa=1e-4)
        pd = np.array(
            [
                [flags.mean() for flags in masked_detections(detector, float(separation))]
                for separation in separations
            ]
        )
        for k, kind in enumerate(DETECTORS):
            axis.plot(
                separations,
                pd[:, k],
                canvas.DASH_STYLES[k],
                color=canvas.LINE_COLOURS[k],
                label=kind,
            )
        axis.set(title=f"{name} window", xlabel="distance of the stronger return (bins)")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("share of draws that\nfind the weak return")
    axes[0].legend()
    canvas.set_title(figure, "A second return")
    canvas.set_caption(
        figure,
        f"Returns of {WEAK_SNR_DB:g} and {STRONG_SNR_DB:g} dB after the FFT, the weak one on a "
        f"bin; {TRAINING_CELLS} "
        f"training and {GUARD_CELLS} guard cells, one false alarm in 10,000 bins by design.",
    )
    canvas.save_sheet(figure, path)


def masked_detections(detector: SpectrumSettings, separation: float) -> Iterator[np.ndarray]:
    """Yield the flags (draws,) of each detector in the weak return's bin.

    The strong return lies `separation` + 0.5 bins above the weak one.
    """
    rng, sample_numbers = np.random.default_rng(int(separation)), np.arange(RECORD_LENGTH)
    record = rng.standard_normal((MASKING_DRAWS, RECORD_LENGTH))
    for snr_db, line_bin in ((WEAK_SNR_DB, WEAK_BIN), (STRONG_SNR_DB, WEAK_BIN + separation + 0.5)):
        phase = rng.uniform(0, 2 * np.pi, (MASKING_DRAWS, 1))
        record += tone_amplitude(snr_db, detector) * np.cos(
            2 * np.pi * line_bin * sample_numbers / RECORD_LENGTH + phase
        )
    power = np.abs(np.fft.rfft(record * cached_window_samples(detector.window))) ** 2
    for detect in DETECTORS.values():
        yield detect(power, detector)[:, int(WEAK_BIN)]


def tone_amplitude(snr_db: float, detector: SpectrumSettings) -> float:
    """Return the amplitude of a tone of an SNR after the FFT [dB], in noise of variance 1."""
    cnr = estimators.carrier_to_noise_ratio(snr=10 ** (snr_db / 10), window=detector.window)
    return float(np.sqrt(2 * cnr))


def frequency_errors(name: str) -> dict[str, np.ndarray]:
    """Return the errors of each estimator (SNR, tones) for tones between bins [bins].

    `name` is that of the window.
    """
    detector, sample_numbers, rng = (
        detector_setting(name, RECORD_LENGTH),
        np.arange(RECORD_LENGTH),
        np.random.default_rng(3),
    )
    bin_offset = rng.uniform(-0.5, 0.5, N_TONES)
    tones = np.cos(2 * np.pi * np.outer(TONE_BIN + bin_offset, sample_numbers) / RECORD_LENGTH
                   + rng.uniform(0, 2 * np.pi, (N_TONES, 1)))  # fmt: skip
    noise = rng.standard_normal((N_TONES, RECORD_LENGTH))
    errors_by_estimator: dict[str, list[np.ndarray]] = {kind: [] for kind in ESTIMATORS}
    for snr_db in SNR_DB:
        record = tone_amplitude(snr_db, detector) * tones + noise
        spectrum = np.fft.rfft(record * cached_window_samples(detector.window))
        magnitudes_near_tone = np.abs(
            spectrum[:, TONE_BIN - 2 : TONE_BIN + 3]
        )  # given that the tone was detected
        peak = TONE_BIN - 2 + magnitudes_near_tone.argmax(axis=1)
        for kind, estimate in ESTIMATORS.items():
            errors_by_estimator[kind].append(
                estimate(spectrum, peak, detector) - TONE_BIN - bin_offset
            )
    return {kind: np.array(errors_by_snr) for kind, errors_by_snr in errors_by_estimator.items()}


def frequency_error_bounds(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the Cramer-Rao bound and that of the windowed spectrum's peak, (SNR,) [bins]."""
    w = get_window(name, RECORD_LENGTH)
    cnr = estimators.carrier_to_noise_ratio(snr=10 ** (SNR_DB / 10), window=w)
    sample_rate = float(RECORD_LENGTH)
    return (
        estimators.beat_frequency_cramer_rao_bound(
            cnr=cnr, n_samples=RECORD_LENGTH, sample_rate=sample_rate
        ),
        estimators.windowed_peak_frequency_deviation(cnr=cnr, window=w, sample_rate=sample_rate),
    )


def draw_estimators(errors_by_window: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Draw the figure of RMSE and bias of the estimators over SNR, with a column per window."""
    figure, axes = canvas.sheet_with_axes(
        12.5, 7.0, 2, len(errors_by_window), sharex=True, sharey="row"
    )
    for column, (name, errors_by_estimator) in enumerate(errors_by_window.items()):
        rmse_axis, bias_axis = axes[column], axes[len(errors_by_window) + column]
        cramer_rao, spectrum_peak_bound = frequency_error_bounds(name)
        rmse_axis.semilogy(SNR_DB, cramer_rao, color="0.6", lw=5, label="Cramer-Rao bound")
        rmse_axis.semilogy(
            SNR_DB, spectrum_peak_bound, color="0.8", lw=3, label="largest of windowed spectrum"
        )
        for k, (kind, error) in enumerate(errors_by_estimator.items()):
            line_style = {"color": canvas.LINE_COLOURS[k], "linestyle": canvas.DASH_STYLES[k]}
            rmse_axis.semilogy(SNR_DB, np.sqrt(np.mean(error**2, axis=1)), **line_style, label=kind)
            # by the side of the bin that the tone stands on: over all of it bias cancels
            bias_axis.semilogy(SNR_DB, bias_in_upper_half(error), **line_style)
        rmse_axis.set(title=f"{name} window", ylabel="RMSE (bins)" if not column else "")
        bias_axis.set(xlabel="SNR after the FFT (dB)", ylabel="" if column else "|bias| (bins)")
        rmse_axis.grid(alpha=0.3)
        bias_axis.grid(alpha=0.3)
    legend_entries = axes[len(errors_by_window) - 1].get_legend_handles_labels()
    figure.legend(*legend_entries, loc="outside right upper", frameon=False, fontsize=8)
    canvas.set_title(figure, "Frequency between bins")
    canvas.set_caption(
        figure,
        f"{N_TONES} tones anywhere between bins of {RECORD_LENGTH}; bias where they stand in the "
        "upper half "
        "of their bin, down to what so many draws can tell.",
    )
    canvas.save_sheet(figure, path)


def bias_in_upper_half(error: np.ndarray) -> np.ndarray:
    """Return the |mean error| of tones in the upper half of their bin, (SNR,) [bins]."""
    bin_offset = np.random.default_rng(3).uniform(-0.5, 0.5, N_TONES)
    return np.abs(error[:, bin_offset > 0].mean(axis=1))


def rmse_ratio_rows(errors_by_window: dict[str, dict[str, np.ndarray]]) -> Iterator[list[str]]:
    """Yield table rows with the ratio of RMSE to the Cramer-Rao bound at three SNR."""
    for kind in ESTIMATORS:
        cells = [f"`{kind}`"]
        for name, errors_by_estimator in errors_by_window.items():
            ratio = (
                np.sqrt(np.mean(errors_by_estimator[kind] ** 2, axis=1))
                / frequency_error_bounds(name)[0]
            )
            cells += [f"{ratio[snr_db == SNR_DB][0]:.2f}" for snr_db in (16, 24, 40)]
        yield cells


def main() -> None:
    """Write the tables into docs/detectors.md, and the figures into docs/."""
    errors_by_window = {name: frequency_errors(name) for name in ("rectangular", "hamming")}
    estimator_heads = [
        "",
        *(f"{name}, {snr_db} dB" for name in errors_by_window for snr_db in (16, 24, 40)),
    ]
    for name, head, rows in (
        ("false alarms", ["window", "padding", *DETECTORS], false_alarm_rows()),
        ("losses", ["training cells", "pfa", *CFAR_KINDS], loss_rows()),
        ("estimators", estimator_heads, rmse_ratio_rows(errors_by_window)),
    ):
        replace_page_part("detectors.md", name, markdown_table(head, rows))
    draw_masking(DOCS / "detectors_masking.png")
    draw_estimators(errors_by_window, DOCS / "detectors_estimators.png")


if __name__ == "__main__":
    main()
