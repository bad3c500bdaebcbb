"""Plain scenes: those with nothing of any effect but of those that every scene may have.

These are its lines, where they lie and how they add, their images, and the echo's own noise. A plan
is a few formulas then, and to go from one to the next takes longer than they do: so
:mod:`.plain_plan` takes them one after the other in compiled code.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sweep.model import link
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.leakage import far_steps
from sweep.model.effects.line_spread import sizes_of
from sweep.model.effects.lobes import lobe
from sweep.model.effects.phase_bounds import means, of_window, record_powers
from sweep.model.effects.phase_formulas import IMAGE
from sweep.model.effects.sidelobes import sidelobes
from sweep.model.effects.span import Span, monotone
from sweep.model.effects.tile_link import TileLink
from sweep.model.preparation import LASER, PROCESSING, RECEIVER, TELESCOPE

PLAIN = (
    "footprint", "footprint_phase", "several_returns", "doppler", "doppler_spread",
    "signal_shot_noise", "range_walk", "image", "leakage",
)  # fmt: skip
"""Effects that a plain scene may have, in the order of the catalogue."""

_SUN = ("target.solar_irradiance", "target.sun_distance")
_OTHERS = tuple(
    parameter
    for effect in EFFECTS
    if effect.name not in (*PLAIN, "solar_background")
    for parameter in effect.parameters
)


def is_plain(instrument: TileLink, rotating: bool) -> bool:
    """Whether a scene is plain: what other effects bring is as it comes, which means none.

    Parameters
    ----------
    instrument : TileLink
        Of parameters that are the same for all shots.
    rotating : bool
        Whether any body turns.
    """
    if rotating or instrument.architecture == "direct" or instrument.has(*_SUN):
        return False
    return all(_is_default(instrument.parameters[p.path], p.default) for p in _OTHERS)


def _is_default(value: Span | str, default: float | int | str) -> bool:
    if isinstance(value, str):
        return value == default
    return bool(value.low == default and value.high == default)


class PlainScene(NamedTuple):
    """What plans take of an instrument whose parameters are the same for all shots."""

    link: tuple[float, ...]
    """Local oscillator [W]; beat [A] over the root of it and the echo; transimpedance; sum of the
    window; sigma; noise of 1 W of light, and that of the receiver."""
    ends: np.ndarray
    """:attr:`.tile_link.TileLink.instrument_ends`."""
    turns: np.ndarray
    """:attr:`.tile_link.TileLink.most_turns`, (3, 1)."""
    turn_of_bin: float
    threshold: float
    """Over sigma."""
    rate: float
    """Chirp rate [Hz/s]."""
    middle: float
    """Of the record [s]."""
    beamlets: int
    fft_size: int
    record: tuple[int, int, float]
    """As of :func:`.phase_formulas.put_peaks`."""
    tables: tuple[np.ndarray, np.ndarray]
    """The main lobe: largest and least."""
    lobe: tuple[float, float, float, float]
    """Slope, curvature, margin and energy of it."""
    tails: tuple[np.ndarray, np.ndarray]
    """Distances, and the largest magnitude beyond."""
    worst: float
    """Least magnitude of the bin nearest to a line."""
    window: tuple[Any, ...]
    """As of :func:`.phase_formulas.put_error_changes`."""
    times: np.ndarray
    """(15,): :func:`.phase_bounds.record_powers`."""
    sidelobes: tuple[np.ndarray, ...]
    far: tuple[np.ndarray, ...]
    bins: tuple[float, float, float]
    """What :func:`.leakage.unions` takes besides: sidelobes, those further out, sizes."""
    amplitudes: bool
    """Whether beamlets add as amplitudes."""
    counts: bool
    """Whether images may change how many bins raise false alarms."""

    @classmethod
    def of(cls, instrument: TileLink) -> "PlainScene | None":
        """The same of an instrument; None where there is no noise to divide by."""
        window, size = instrument.window, instrument.fft_size
        form, table = lobe(window.name, window.length, size), sidelobes(window.name, window.length)
        budget = _budget(instrument)
        if not all(value > 0 for value in (budget[-3], budget[-1])):
            return None
        tables, sizes = sizes_of(form)
        amplitudes = instrument.word("footprint.phases") == "coherent"
        times = record_powers(instrument.start, instrument.record_duration)
        return cls(
            link=budget,
            ends=instrument.instrument_ends,
            turns=np.array(np.broadcast_to(instrument.most_turns, (3, 1))),
            turn_of_bin=float(np.ravel(instrument.turn_of_bin)[0]),
            threshold=_number(instrument.threshold),
            rate=_number(instrument.chirp_rate),
            middle=_number(instrument.start + 0.5 * instrument.record_duration),
            beamlets=instrument.beamlets[0],
            fft_size=size,
            record=(size, window.length, IMAGE if amplitudes else 1.0),
            tables=(tables[0], tables[1]),
            lobe=(sizes[0], sizes[1], sizes[2], sizes[3]),
            tails=(form.reach, form.envelope),
            worst=form.worst,
            window=(*of_window(window), means(window).steady),
            times=np.array([float(np.ravel(value)[0]) for value in times]),
            sidelobes=(table.highest, table.lowest, table.steepest),
            far=far_steps(window.name, window.length, size),
            bins=(window.length / size, size / 2, window.equivalent_noise_bandwidth),
            amplitudes=amplitudes,
            counts=instrument.word(PROCESSING + "bins_counted") != "all",
        )


def light_over(parameters: Mapping[str, Span | str]) -> Span:
    """Echo [W] of a backscatter of 1/sr at 1 m: all of the link budget but for the range."""
    names = {
        "power": LASER + "power", "aperture": TELESCOPE + "aperture",
        "optical_efficiency": TELESCOPE + "optical_efficiency",
        "reflectance": "target.reflectance",
    }  # fmt: skip
    spans = {name: parameters[path] for name, path in names.items()}
    numbers = {name: span for name, span in spans.items() if isinstance(span, Span)}
    return monotone(link.echo_power_scale, range=1.0, **numbers)


def _budget(instrument: TileLink) -> tuple[float, ...]:
    """Numbers of :attr:`PlainScene.link`."""
    gain, responsivity, efficiency, oscillator, transimpedance = (
        _number(instrument[RECEIVER + name])
        for name in (
            "apd_gain", "responsivity", "mixing_efficiency", "local_oscillator_power",
            "transimpedance",
        )
    )  # fmt: skip
    return (
        oscillator, 2 * gain * responsivity * efficiency, transimpedance,
        float(instrument.window.sum), _number(instrument.deviation),
        _number(instrument.shot_noise_scale), _number(instrument.noise_variance),
    )  # fmt: skip


def _number(span: Span) -> float:
    return float(np.ravel(span.low)[0])
