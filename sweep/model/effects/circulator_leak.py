"""Light that leaks from the transmitter to the detector, by circulator, splice or window.

A share 1 / I of the sent light P_tx (I the isolation) reaches the detector after a path d beyond
the local oscillator's, at the delay tau = d / c. It is there in every record:

- **A line.** It beats with the local oscillator as an echo does, with the photocurrent
  i = 2 M Re sqrt(eta P_lo P_tx / I), at S tau in the chirps and at 0 in the Doppler segment. With
  the window's transform W, and the receiver's transfer H

      L_k = i H / 2 (e^{j phi} W(k - nu) + e^{-j phi} W(k + nu)),   nu = S tau N / fs

  of a real record; a complex one has the first term alone, at -nu or nu by the chirp's sign. The
  phase phi drifts with the path's temperature and is taken to be uniform.
- **Shot noise** 2 q M^2 F Re P_tx / I B_e.
- **Intensity noise**. A balanced receiver rejects that of the light, and sees that of the beat in
  full: of variance RIN B_e ((M Re)^2 (2 P_lo P_l + P_l^2) / CMRR + i^2 / 2), P_l = P_tx / I.
- **Phase noise** of a Lorentzian laser of width v. The beat carries theta(t) - theta(t - tau), of
  density 4 v sin^2(pi f tau) / (pi f^2), 4 pi v tau^2 at all f << 1 / tau [Richter et al., IEEE J.
  Quantum Electron. 22, 2070, 1986], which a line makes a noise of i^2 / 2 times that. It is taken
  to be white within B_e, and no more than 2 pi v tau altogether.

The line is there from its own delay tau on, as an echo is (:mod:`sweep.model.effects.overlap`): a
path of a metre takes 3 ns of a record that begins with the chirp. Records that are taken as whole
have it whole.

The processing knows the line, as it is always there: bins in which it comes to
:data:`MASKED_FROM` of the threshold, at whatever phase, are **masked**. They raise no alarm, and an
echo whose largest bin is among them is not detected. In other bins the line's skirts, as powers
add, help an echo over the threshold. They help noise as well, which counts as leakage
(`p_leakage_up`, `p_leakage_down`): the mean over the phase, in which all bins share. An echo that
fades in developed speckle crosses with Q_1(L / s, Th / s), s^2 = sigma^2 + |X|^2 / 2.

Left out: saturation of the ADC by the line; the line's own image of I and Q; and the echo's and the
line's skirts raising one bin together. The spectrum of :func:`sweep.model.segments.spectrum` is
that of the echo alone.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.model import link
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size, noisier
from sweep.model.effects.points import Points
from sweep.model.looks import Looks
from sweep.model.preparation import LASER, RECEIVER, TELESCOPE, Shots, beat_current
from sweep.model.waveform import samples_before_echo
from sweep.model.window import Window, samples

MASKED_FROM = 0.5
"""Share of the threshold from which on a bin's line has it masked: less raises few alarms."""
PHASES = 16
"""Phases of the line over which alarms are averaged."""

PATH, ISOLATION = TELESCOPE + "leak_path", TELESCOPE + "isolation"


def _leaked(p: Mapping[str, np.ndarray], architecture: str) -> tuple[np.ndarray, np.ndarray]:
    """Leaked light [W], and amplitude of its beat's photocurrent [A]."""
    power = np.asarray(p[LASER + "power"] / p[ISOLATION])
    return power, beat_current(architecture, p, power)


def excess(p: Mapping[str, np.ndarray], architecture: str, shape: str) -> np.ndarray:
    """Compute the current variance [A^2] of the beat's noise; direct detection has no beat."""
    if architecture == "direct":
        return np.zeros(())
    light, current = _leaked(p, architecture)
    scale = p[RECEIVER + "apd_gain"] * p[RECEIVER + "responsivity"]
    band, delay = link.electrical_bandwidth(link.receiver_values(p)), p[PATH] / SPEED_OF_LIGHT
    half = np.square(current / scale) / 2
    common = (2 * p[RECEIVER + "local_oscillator_power"] + light) * light
    common = common / p[RECEIVER + "common_mode_rejection"]
    variance = p[LASER + "relative_intensity_noise"] * band * (common + half)
    if shape == "lorentzian":
        phase = 2 * np.pi * p[LASER + "line_width"] * delay * np.minimum(2 * delay * band, 1.0)
        variance = variance + half * phase
    return np.asarray(scale**2 * variance)


def leak_size(points: Points) -> Size | None:
    """Return the leak's noise, exactly; its line may hide any echo, and always counts."""
    if not points.has(PATH):
        return None
    p, own = points.parameters, points.receiver
    noise = _leaked(p, points.architecture)[0] * own.per_watt
    shape = points.word(LASER + "line_shape")
    noise = noise + excess(p, points.architecture, shape) * own.per_ampere
    return Size(noise=noise / points.noise_variance, chance=1.0)


def add_leak(shots: Shots, scene: Scene) -> Shots:
    """Add the leaked light's noise and its line."""
    p = scene.parameters
    power, current = _leaked(p, shots.architecture)
    beat = excess(p, shots.architecture, str(p[LASER + "line_shape"])) * shots.noise_scale
    shots = noisier(shots, leak_shot=shots.shot_noise_scale * power, leak_excess=beat)
    return replace(
        shots,
        leak_amplitude=current * p[RECEIVER + "transimpedance"],
        leak_delay=p[PATH] / SPEED_OF_LIGHT,
    )


class Line(NamedTuple):
    """A line of amplitude 2 in bins 0..N/2 of a real record, 0..N - 1 of a complex one."""

    terms: np.ndarray
    """(2, bins) complex: at its frequency, and at the negative one."""
    most: np.ndarray
    """Its largest magnitude at any phase."""
    rms: np.ndarray
    """Root mean square of its magnitude over the phase."""


@lru_cache(maxsize=16)
def _line(window: Window, fft_size: int, place: float, signed: bool, late: int = 0) -> Line:
    """Return the line at a place [bins] that lacks the first samples of the record."""
    turns = place * np.arange(window.length) / fft_size
    record = samples(window.name, window.length) * np.exp(2j * np.pi * (turns - np.rint(turns)))
    record[:late] = 0.0
    spectrum = np.fft.fft(record, fft_size)
    half = np.arange(fft_size // 2 + 1)
    both = [spectrum, 0 * spectrum] if signed else [spectrum[half], spectrum[-half].conj()]
    terms = np.array(both)
    return Line(terms, np.abs(terms).sum(axis=0), np.hypot(*np.abs(terms)))


def line_of(shots: Shots, i: int, segment: int, at: float | None = None) -> tuple[float, Line]:
    """Return half of the amplitude [V] of point i's line in a segment, and that line.

    The amplitude is over the noise at the line; or at a frequency ``at`` [Hz], for skirts there.
    """
    columns = (
        shots.leak_amplitude, shots.leak_delay, shots.chirp_rate, shots.sample_rate,
        shots.detector_bandwidth, shots.amplifier_bandwidth, shots.acquisition_delay,
    )  # fmt: skip
    assert shots.leak_amplitude is not None
    amplitude, delay, rate, sampled, detector, amplifier, start = (
        float(np.broadcast_to(np.asarray(column), shots.size)[i]) for column in columns
    )
    beat = -shots.waveform[segment].slope * rate * delay
    gain = link.transfer(
        np.array(beat),
        detector_bandwidth=np.array(detector),
        amplifier_bandwidth=np.array(amplifier),
    )
    whitened = shots.whitened(np.array(beat), None if at is None else np.array(at))
    own = float(np.broadcast_to(whitened, shots.size)[i])
    scale = 0.5 * amplitude * abs(complex(gain)) * own
    place = beat * shots.fft_size / sampled
    late = 0
    if shots.first_sample is not None:
        late = int(samples_before_echo(
            delay=np.array(delay), beta=0.0, start=np.array(start), sample_rate=np.array(sampled),
            length=shots.window.length,
        ))  # fmt: skip
    return scale, _line(shots.window, shots.fft_size, place, shots.complex_record, late)


def alarm(looks: Looks, line: Line, bins: np.ndarray, *, scale: float, level: float) -> float:
    """Probability that a line raises an alarm in some of its bins where noise alone does not.

    ``scale`` and ``level`` are half of the line's amplitude and the threshold, over the noise.
    """
    one, other = scale * line.terms[:, bins]
    phases = np.pi * (np.arange(PHASES) + 0.5) / PHASES  # its magnitude has this period
    quiet = [
        np.log1p(-np.minimum(looks.excess(np.abs(one * t + other * t.conjugate()), level), 1.0))
        for t in np.exp(1j * phases)
    ]
    return float(-np.expm1(np.sum(quiet, axis=1)).mean())


def bins_of_line(
    shots: Shots, i: int, line: Line, *, scale: float, echo: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tell which bins of a segment of point i a line masks, and in which it raises alarms.

    ``scale`` is half of the line's amplitude [V], ``echo`` the bins of the echo. Results are bool,
    (bins,): bins that are masked; bins that are searched for alarms, masked or not; bins in which
    the line may raise one.
    """
    deviation, level, floor = (
        float(np.broadcast_to(v, shots.size)[i])
        for v in (shots.bin_deviation, shots.threshold, shots.floor)
    )
    most = scale * line.most
    masked, searched = most >= MASKED_FROM * level, np.ones(line.most.size, bool)
    if not shots.complex_record:
        first = shots.searched_from
        searched[:first] = searched[searched.size - first :] = False
    searched[echo % shots.fft_size if shots.complex_record else echo] = False
    return masked, searched, searched & ~masked & (most >= floor * deviation)


def raised(
    own: np.ndarray, line: np.ndarray, *, deviation: float, level: float, fades: bool
) -> np.ndarray:
    """|X| of an echo's bins that cross as often as those with the line in them do, (m,).

    ``own`` is |X| of the echo, the root mean square of one that ``fades``; ``line`` the root mean
    square of the line's [V]; ``deviation`` and ``level`` noise per quadrature and threshold [V].
    """
    from sweep.model.marcum import marcum_q1  # needs the compiler, too

    if not fades:
        return np.hypot(own, line)
    deep = np.sqrt(deviation**2 + own**2 / 2)
    crosses, stays = marcum_q1(line / deep, level / deep)
    with np.errstate(divide="ignore"):
        power = level**2 / -np.where(stays < 0.5, np.log1p(-stays), np.log(crosses))
    return np.where(line > 1e-6 * deviation, np.sqrt(np.maximum(power - 2 * deviation**2, 0)), own)


def beside_leak(shots: Shots, runs: Any) -> Any:
    """Put the line to :class:`sweep.model.segments.Runs`: it masks bins, and raises others."""
    from sweep.model.detection import (  # needs the compiler, which reading specs does not
        found_pair,
        levels_of,
        speckle_of,
    )

    magnitudes = runs.magnitudes.copy()
    pd, miss, exempted, leakage = (
        v.copy() for v in (runs.pd, runs.miss, runs.exempted, runs.leakage)
    )
    deviation, under, level = (
        np.broadcast_to(v, shots.size)[runs.part]
        for v in (shots.bin_deviation, shots.line_deviation, shots.threshold)
    )
    size, rule, speckle = shots.fft_size, shots.echo_rule, shots.speckle_table
    for s, i in np.argwhere(runs.bins > 0):
        stretch = slice(runs.start[s, i], runs.start[s, i] + runs.bins[s, i])
        at = runs.low[s, i] + np.arange(runs.bins[s, i])
        at = at % size if shots.complex_record else at
        (scale, line), peak = line_of(shots, int(runs.part[i]), s), runs.peak[s, i]
        echo = runs.exempt[stretch]
        masked, searched, alarms = bins_of_line(
            shots, int(runs.part[i]), line, scale=scale, echo=at[echo]
        )
        echoes = float(
            at[peak] / size * np.broadcast_to(shots.sample_rate, shots.size)[runs.part[i]]
        )
        beside, _ = line_of(shots, int(runs.part[i]), s, echoes)
        skirts = np.where(masked[at], 0.0, beside * line.rms[at])
        seen = raised(
            runs.magnitudes[stretch], skirts, deviation=under[i], level=level[i],
            fades=shots.fading is not None,
        )  # fmt: skip
        seen[masked[at]] = 0.0
        magnitudes[stretch] = seen
        if masked[at[peak]]:
            pd[s, i], miss[s, i] = 0.0, 1.0
        else:
            pd[s, i], miss[s, i] = found_pair(
                seen, echo, peak, runs.low[s, i], rule,
                levels_of(shots.bin_levels, runs.part[i]),
                speckle_of(speckle, s, runs.part[i]),
            )  # fmt: skip
        exempted[s, i] += np.count_nonzero(masked & searched)
        if shots.waveform[s].leaks:
            chance = alarm(
                shots.looks, line, np.flatnonzero(alarms), scale=scale / deviation[i],
                level=level[i] / deviation[i],
            )  # fmt: skip
            leakage[s, i] += (1 - leakage[s, i]) * chance
    return runs._replace(
        magnitudes=magnitudes, pd=pd, miss=miss, exempted=exempted, leakage=leakage
    )


CIRCULATOR_LEAK = Effect(
    name="circulator_leak",
    about="light that leaks to the detector: a line near DC, and its noise",
    stage="noise",
    size=leak_size,
    act=add_leak,
    parameters=(
        Parameter(
            path=PATH,
            about="Optical path of the light that leaks past circulator and window (isolation) "
            "beyond the local oscillator's, in all; 0 for no such light. Its line stands at the "
            "range of half this path; bins in which it alone reaches the threshold are masked, and "
            "hide echoes",
            example="2 m",
            limits=("0 m", "1 km"),
        ),
    ),
)
