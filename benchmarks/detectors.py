"""False alarms, losses and masking of the detectors, and errors of the estimators.

Run with `make detectors`, a minute on one core. Writes the tables and figures of docs/detectors.md.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from shared import DOCS, put, table

from sweep.analysis import canvas
from sweep.model import estimators
from sweep.model.detectors import (
    CA,
    DETECTORS,
    GOCA,
    OS,
    Setting,
    cfar_factor,
    crossing_probability,
    taper,
)
from sweep.model.estimators import ESTIMATORS
from sweep.model.window import window

CFAR = (CA, OS, GOCA)
LENGTH, TRAINING, GUARD, PFA = 1024, 32, 4, 1e-3
RECORDS = 4000
PADDED = (("rectangular", 1), ("rectangular", 2), ("hamming", 1), ("hann", 1), ("hann", 2),
          ("blackmanharris", 1))  # fmt: skip

STRONG, WEAK, PLACE, MASKING = 40.0, 18.0, 200.0, 500
"""SNR [dB] of two returns, place [bins] of the weaker one, draws of each separation."""

TONE, TONES, DECIBELS = 200, 500, np.arange(8, 61, 4.0)
"""Bin near which estimators are tried, tones of each SNR, SNR after the FFT [dB]."""


def setting(name: str, fft_size: int, **changes: float) -> Setting:
    """Settings of detectors and estimators in noise of variance 1."""
    w = window(name, LENGTH)
    given = {
        "noise_power": w.energy, "training": TRAINING, "guard": GUARD, "rank": 3 * TRAINING // 4,
        "pfa": PFA,
    } | changes  # fmt: skip
    level = float(np.sqrt(-given["noise_power"] * np.log(given["pfa"])))
    return Setting(
        fft_size=fft_size, sample_rate=float(fft_size), window=w, threshold=level, **given
    )


def false_alarms() -> Iterator[list[str]]:
    """Rows: false alarms a bin over those designed for, in windowed and padded noise."""
    for name, padding in PADDED:
        s = setting(name, padding * LENGTH)
        noise = np.random.default_rng(1).standard_normal((RECORDS, LENGTH)) * taper(s.window)
        power = np.abs(np.fft.rfft(noise, s.fft_size)) ** 2
        cells = [name, f"{padding}"]
        for detect in DETECTORS.values():
            share = detect(power, s)[:, 1:-1].mean(axis=1) / PFA
            cells.append(f"{share.mean():.2f} ± {share.std() / np.sqrt(RECORDS):.2f}")
        yield cells


def losses() -> Iterator[list[str]]:
    """Rows: SNR beyond that of a known noise level, for a signal that fluctuates as speckle."""
    for training in (16, 32, 64):
        for pfa in (1e-4, 1e-6):
            yield [f"{training}", f"{pfa:g}", *(f"{loss(k, training, pfa):.2f}" for k in CFAR)]


def loss(kind: str, training: int, pfa: float, pd: float = 0.5) -> float:
    """That loss [dB], in closed form."""
    rank = 3 * training // 4
    factor = cfar_factor(kind, training=training, rank=rank, pfa=pfa)

    def short(snr: float) -> float:
        return crossing_probability(kind, factor / (1 + snr), training=training, rank=rank) - pd

    return float(10 * np.log10(brentq(short, 1e-3, 1e9) / (np.log(pfa) / np.log(pd) - 1)))


def draw_masking(path: Path) -> None:
    """Detection of a weak return at some distance from a strong one."""
    apart = np.arange(2, 41)
    figure, axes = canvas.panels(10.0, 3.8, 1, 2, sharex=True, sharey=True)
    for axis, name in zip(axes, ("rectangular", "hann"), strict=True):
        s = setting(name, LENGTH, pfa=1e-4)
        pd = np.array([[found.mean() for found in masked(s, float(d))] for d in apart])
        for k, kind in enumerate(DETECTORS):
            axis.plot(apart, pd[:, k], canvas.DASHES[k], color=canvas.LINES[k], label=kind)
        axis.set(title=f"{name} window", xlabel="distance of the stronger return (bins)")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("share of draws that\nfind the weak return")
    axes[0].legend()
    canvas.title(figure, "A second return")
    canvas.caption(
        figure,
        f"Returns of {WEAK:g} and {STRONG:g} dB after the FFT, the weak one on a bin; {TRAINING} "
        f"training and {GUARD} guard cells, one false alarm in 10,000 bins by design.",
    )
    canvas.save(figure, path)


def masked(s: Setting, apart: float) -> Iterator[np.ndarray]:
    """Flags of each detector in the weak return's bin, draw by draw; it may lie on a null."""
    rng, n = np.random.default_rng(int(apart)), np.arange(LENGTH)
    record = rng.standard_normal((MASKING, LENGTH))
    for decibel, place in ((WEAK, PLACE), (STRONG, PLACE + apart + 0.5)):
        phase = rng.uniform(0, 2 * np.pi, (MASKING, 1))
        record += amplitude(decibel, s) * np.cos(2 * np.pi * place * n / LENGTH + phase)
    power = np.abs(np.fft.rfft(record * taper(s.window))) ** 2
    for detect in DETECTORS.values():
        yield detect(power, s)[:, int(PLACE)]


def amplitude(decibel: float, s: Setting) -> float:
    """Of a tone of some SNR after the FFT, in noise of variance 1."""
    cnr = estimators.carrier_to_noise_ratio(snr=10 ** (decibel / 10), window=s.window)
    return float(np.sqrt(2 * cnr))


def errors(name: str) -> dict[str, np.ndarray]:
    """Errors [bins] of every estimator, (SNR, tones), of tones anywhere between bins."""
    s, n, rng = setting(name, LENGTH), np.arange(LENGTH), np.random.default_rng(3)
    delta = rng.uniform(-0.5, 0.5, TONES)
    tones = np.cos(2 * np.pi * np.outer(TONE + delta, n) / LENGTH
                   + rng.uniform(0, 2 * np.pi, (TONES, 1)))  # fmt: skip
    noise = rng.standard_normal((TONES, LENGTH))
    found: dict[str, list[np.ndarray]] = {kind: [] for kind in ESTIMATORS}
    for decibel in DECIBELS:
        record = amplitude(decibel, s) * tones + noise
        spectrum = np.fft.rfft(record * taper(s.window))
        near = np.abs(spectrum[:, TONE - 2 : TONE + 3])  # given that the tone was detected
        peak = TONE - 2 + near.argmax(axis=1)
        for kind, estimate in ESTIMATORS.items():
            found[kind].append(estimate(spectrum, peak, s) - TONE - delta)
    return {kind: np.array(each) for kind, each in found.items()}


def bounds(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Cramer-Rao bound, and what the largest value of the windowed spectrum reaches [bins]."""
    w = window(name, LENGTH)
    cnr = estimators.carrier_to_noise_ratio(snr=10 ** (DECIBELS / 10), window=w)
    rate = float(LENGTH)
    return (
        estimators.beat_deviation(cnr=cnr, samples=LENGTH, sample_rate=rate),
        estimators.windowed_deviation(cnr=cnr, window=w, sample_rate=rate),
    )


def draw_estimators(found: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """RMSE and bias over SNR, a column for each window."""
    figure, axes = canvas.panels(12.5, 7.0, 2, len(found), sharex=True, sharey="row")
    for column, (name, every) in enumerate(found.items()):
        top, low = axes[column], axes[len(found) + column]
        least, windowed = bounds(name)
        top.semilogy(DECIBELS, least, color="0.6", lw=5, label="Cramer-Rao bound")
        top.semilogy(DECIBELS, windowed, color="0.8", lw=3, label="largest of windowed spectrum")
        for k, (kind, error) in enumerate(every.items()):
            look = {"color": canvas.LINES[k], "linestyle": canvas.DASHES[k]}
            top.semilogy(DECIBELS, np.sqrt(np.mean(error**2, axis=1)), **look, label=kind)
            # by the side of the bin that the tone stands on: over all of it bias cancels
            low.semilogy(DECIBELS, side_bias(error), **look)
        top.set(title=f"{name} window", ylabel="RMSE (bins)" if not column else "")
        low.set(xlabel="SNR after the FFT (dB)", ylabel="" if column else "|bias| (bins)")
        top.grid(alpha=0.3)
        low.grid(alpha=0.3)
    named = axes[len(found) - 1].get_legend_handles_labels()
    figure.legend(*named, loc="outside right upper", frameon=False, fontsize=8)
    canvas.title(figure, "Frequency between bins")
    canvas.caption(
        figure,
        f"{TONES} tones anywhere between bins of {LENGTH}; bias where they stand in the upper half "
        "of their bin, down to what so many draws can tell.",
    )
    canvas.save(figure, path)


def side_bias(error: np.ndarray) -> np.ndarray:
    """|Mean error| of tones in the upper half of their bin, (SNR,)."""
    delta = np.random.default_rng(3).uniform(-0.5, 0.5, TONES)
    return np.abs(error[:, delta > 0].mean(axis=1))


def ratios(found: dict[str, dict[str, np.ndarray]]) -> Iterator[list[str]]:
    """Rows: RMSE over the Cramer-Rao bound at three SNR."""
    for kind in ESTIMATORS:
        cells = [f"`{kind}`"]
        for name, every in found.items():
            ratio = np.sqrt(np.mean(every[kind] ** 2, axis=1)) / bounds(name)[0]
            cells += [f"{ratio[d == DECIBELS][0]:.2f}" for d in (16, 24, 40)]
        yield cells


def main() -> None:
    """Tables and figures, in their page and beside it."""
    found = {name: errors(name) for name in ("rectangular", "hamming")}
    heads = ["", *(f"{name}, {d} dB" for name in found for d in (16, 24, 40))]
    for name, head, rows in (
        ("false alarms", ["window", "padding", *DETECTORS], false_alarms()),
        ("losses", ["training cells", "pfa", *CFAR], losses()),
        ("estimators", heads, ratios(found)),
    ):
        put("detectors.md", name, table(head, rows))
    draw_masking(DOCS / "detectors_masking.png")
    draw_estimators(found, DOCS / "detectors_estimators.png")


if __name__ == "__main__":
    main()
