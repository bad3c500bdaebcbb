"""Returns of footprints with several surfaces, draw by draw.

:func:`draw_returns` draws which groups of bins (:mod:`sweep.model.groups`) are detected, adds false
peaks, pairs the peaks (:mod:`sweep.model.pairing`) and reports range and radial velocity, by whole
bins and interpolated between them.

The two ways to draw are those of :mod:`sweep.model.draws`, with the same random numbers: the
strongest group is detected in the very draws that are counted there, and so are false alarms of
noise.
Against ``probabilities`` peaks stay in their noiseless bins, and the interpolated position has a
normal error of the standard error that is reported. ``noise`` is added to ``peak_bin`` and its two
neighbours, so that another may be the largest, or to all bins of a group's echo.

Ranges and velocities are those at the shot's start, the instant of the truth. Range walk moves the
interpolated range by v_r (T_w + 2 t_0), and motion between segments moves both. The velocity that
is measured with them corrects both. Nothing in the beats tells of the acceleration, or of ground
that slides under the beam: the instrument's own motion, where it is known, corrects the points for
them as far as it can (:mod:`sweep.model.own_motion`). Of segments with slopes other than 1, 0 and
-1 a return is the fit of all its peaks.

Echoes in developed speckle have the amplitudes that the lines of their footprint make in a draw, in
the bins about a group's strongest of all three segments (:mod:`sweep.model.speckle_lines`). Their
places wander with it. By either method noise is added, and the peak is what the bins then show. Of
``noise`` the bins detect by themselves; against ``probabilities`` the strongest bin's amplitude is
held against the level that it exceeds with the group's probability. All three segments are so drawn
together, by the same law as grids' closed forms. Draws of grids have other speckle.

Standard errors are those of noise and, in quadrature, what the lines in a group make by their
spread (:func:`interpolation.spread_error`), or of echoes in developed speckle by their speckle
(:func:`sweep.model.speckle_lines.place_errors`). That moves the beats of both chirps with the range
where both see the same speckle, and velocities little.

Of noise alone a segment and draw has one false peak at most, the largest, in any of the bins
searched outside the listed groups, uniformly. False peaks of leaked signal lie in their own bins,
the strongest of them where there are many: by their noise, or against probabilities by the bins'
own (:mod:`sweep.model.leaked_peaks`). Groups beyond the ``most`` strongest are neither detected nor
false alarms.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model import philox, waveform
from sweep.model.alarms import TAPS, noise_filter
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import echo_of, is_end, levels_of, pedestal_of_bins
from sweep.model.draws import (
    ECHO,
    Seen,
    down_given_up,
    draw_noise,
    draw_noise_by_root,
    echo_filter,
    fading_amplitudes,
    largest_of,
    noise_levels,
    noise_root,
    seen_spectra,
)
from sweep.model.estimators import Deviation, resolved_deviation
from sweep.model.groups import BIN, FIRST, LAST, Groups
from sweep.model.hoyt import bin_share, hoyt_pair
from sweep.model.interpolation import (
    drift_error,
    interpolator,
    late_echo,
    spread_error,
    sub_bin,
    sub_bin_error,
)
from sweep.model.leaked_peaks import (
    LeakedPeaks,
    draw_leaked,
    leaked_peaks,
    leaking_points,
    list_peak,
    peaks_in_noise,
)
from sweep.model.looks import BINARY
from sweep.model.marcum import at_least_one
from sweep.model.own_motion import OwnMotion
from sweep.model.pairing import (
    ABSENT,
    FALSE,
    MISREAD,
    TOLERANCE,
    TRUE,
    UNCONFIRMED,
    judge,
    pair_peaks,
)
from sweep.model.preparation import Shots
from sweep.model.quadratures import noise_quadratures
from sweep.model.search import beamlet_lines, columns
from sweep.model.shot import fit
from sweep.model.speckle_lines import (
    ALL_PAIRS,
    CHIRPS,
    FACTORED_ROWS_MAX,
    NEXT_LOOK,
    LineFan,
    Peaks,
    directions,
    draw_factored,
    draw_lines,
    factor_bins,
    line_fan,
    line_powers,
    place_errors,
    transform_at,
)

WHOLE, FINE, ERROR, RATIO = range(4)
"""Fields of a peak: bin; position between bins and its standard error by noise [bins]; |X| / sigma.
"""


FADED_BINS_MAX = 32.0
"""Largest number of independent bins of an echo in developed speckle that are drawn."""

MIXED_LOOKS_MAX = 32
"""Number of looks up to which speckle that they share in part is drawn; of more, one amplitude is
held against the probability of detection."""


class Returns(NamedTuple):
    """Up to ``most`` returns of each shot and draw, each (n, draws, most); nan where there is none.

    Confirmed returns come before unconfirmed ones, stronger up peaks before weaker ones, a false
    up peak last. Units are those of :data:`sweep.model.outputs.POINTS`. ``_interpolated`` goes with
    peaks placed between bins; their errors are those of noise, with what the spread of the groups'
    own lines adds. No suffix goes with whole bins; rounding (1/sqrt(12) bin) adds to their errors.
    """

    range: np.ndarray
    range_interpolated: np.ndarray
    radial_velocity: np.ndarray
    radial_velocity_interpolated: np.ndarray
    range_standard_error: np.ndarray
    range_interpolated_standard_error: np.ndarray
    radial_velocity_standard_error: np.ndarray
    radial_velocity_interpolated_standard_error: np.ndarray
    snr: np.ndarray
    """Power of the weaker of up and down peak as found over the mean noise power of a bin."""
    pd: np.ndarray
    """Probability that up and down peak are both detected; nan with a false peak."""
    flags: np.ndarray
    """uint8: bits of :data:`sweep.model.pairing.FLAGS`; 0 where there is no return."""
    beamlet: np.ndarray
    """int32: beamlet that a true or misread return has seen, -1 otherwise."""
    group: np.ndarray
    """(n, draws, most, 3) int8: number of the up, Doppler and down group; -1 none or false."""
    range_per_slip: np.ndarray
    """Change of the interpolated range [m] for 1 m/s of slip (:mod:`sweep.model.own_motion`)."""
    radial_velocity_per_slip: np.ndarray
    """Change of the interpolated radial velocity [m/s] for 1 m/s of slip."""


def draw_returns(
    shots: Shots,
    found: Groups,
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int = 1,
    method: str = "probabilities",
    motion: OwnMotion | None = None,
    leaks: Sequence[tuple[np.ndarray, LeakedPeaks]] | None = None,
) -> Returns:
    """Draw returns of n prepared shots by their :func:`groups` and keys (n, 2), draw by draw.

    ``method`` is ``probabilities`` or ``noise``; any range of draws can be computed alone.
    ``motion`` is what the instrument knows of its own, by which it corrects range and velocity.
    ``leaks`` are the :func:`leaked_peaks` of all points that may leak, if they are known already.
    """
    noisy = method == "noise"
    known, drawn = known_of(shots, found, motion), Drawn.nothing(found, draws)
    one = np.exp(shots.looks.log_alarm(known.levels[:, 1:2]))
    how, tables = How.of(shots, first_draw, noisy), interpolator(shots.window, shots.fft_size)
    around = int(2 * known.fan.reach.max(initial=0) + 1)
    roots: dict[int, np.ndarray] = {}
    for part, seen, of_signal in _spectra(shots, found, noisy, leaks):
        of_part = known.of(part)
        of_part = of_part._replace(alarm=at_least_one(one[part], seen.others))
        own = Drawn(*(column[part] for column in drawn))
        rule = echo_filter(shots, seen, 0 if noisy else around)
        size = rule[0].shape[0]
        if size not in roots:
            roots[size] = noise_root(rule)
        filtered = how._replace(rule=rule, root=roots[size])
        if shots.real_ends and shots.fading is not None and (shots.speckle_table.row > 0).any():
            quadratures = noise_quadratures(shots.window, shots.fft_size)
            near = 1 + int(np.flatnonzero(np.abs(quadratures) > _ALIKE)[-1])
            bins = 2 * (near + around + int(seen.bins.max(initial=0)))
            end_rule = *noise_filter(shots.window, shots.fft_size, bins), shots.real_ends
            filtered = filtered._replace(
                end_rule=end_rule, noise_quadratures=np.ascontiguousarray(quadratures[:near])
            )
        bins = max(around, filtered.end_rule[0].shape[0], int(seen.bins.max(initial=0)))
        work = Workspace.of(bins, found.bin.shape[2])
        _draw(keys[part], filtered, of_part, seen, of_signal, tables, work, own)
        for column, values in zip(drawn, own, strict=True):
            column[part] = values
    return measured(shots, known, drawn, motion)


_ALIKE = 1e-3
"""Pseudo-variance of a bin's noise over its power below which its quadratures are alike."""


def _spectra(
    shots: Shots,
    found: Groups,
    noisy: bool,
    known: Sequence[tuple[np.ndarray, LeakedPeaks]] | None,
) -> Iterator[tuple[np.ndarray, Seen, LeakedPeaks]]:
    """Yield some points at a time, with their spectra and the bins of their leaked signal."""
    if noisy:
        for part, seen in seen_spectra(shots):
            yield part, seen, peaks_in_noise(shots, found, part, seen)
        return
    counted = np.nan_to_num(shots.counted_bins(found.exempted.T).T)
    leaking = leaking_points(shots, found)
    listed: Iterable[tuple[np.ndarray, LeakedPeaks]] = leaked_peaks(shots, found, leaking)
    if known is not None:
        listed = (
            (part[some], leaks.of(some))
            for part, leaks in known
            if (some := np.isin(part, leaking)).any()
        )
    for part, leaks in listed:
        yield part, Seen.nothing(part.size)._replace(others=counted[part]), leaks
    quiet = np.setdiff1d(np.arange(shots.size), leaking)
    nothing = Seen.nothing(quiet.size)._replace(others=counted[quiet])
    yield quiet, nothing, LeakedPeaks.nothing(quiet.size)


class How(NamedTuple):
    """Way in which draws are taken."""

    first_draw: int
    noisy: bool
    powers: bool
    """Lines add as powers."""
    doppler: bool
    """There is a Doppler segment."""
    half: int
    """N/2."""
    signed: float
    """Of a complex record, of bins -N/2 .. N/2 - 1: 1 where the down beat rises against the up beat
    as the range does, else -1. 0 of a real one, of bins 1 .. N/2."""
    alone: int
    """Reading of up and down peak without a Doppler segment."""
    ends: int
    """N where noise at DC and Nyquist is real, else 0."""
    beside: int
    """Half of a main lobe [bins] where any bin of an echo detects, else 0."""
    rule: tuple[np.ndarray, np.ndarray, int]
    """:func:`sweep.model.draws.echo_filter`"""
    root: np.ndarray
    """:func:`sweep.model.draws.noise_root` of it."""
    end_rule: tuple[np.ndarray, np.ndarray, int]
    """Filter likewise of bins from DC or Nyquist on; of no bins where no echo in developed speckle
    lies near."""
    noise_quadratures: np.ndarray
    """(bins,): of :func:`sweep.model.quadratures.noise_quadratures`, from DC or Nyquist on, as far
    as the noise's quadratures differ; none where no echo in developed speckle lies near."""
    looks: int
    """Records whose powers are averaged."""
    apart: bool
    """Each has its own speckle, or a mixture of its own."""
    votes: int
    """Of them that have to detect, 0 where their mean power does; -1 where they are held against
    the probability, as more than MIXED_LOOKS_MAX share their speckle in part."""

    @classmethod
    def of(cls, shots: Shots, first_draw: int, noisy: bool) -> "How":
        """Draw some shots from a draw on."""
        alone = waveform.FAST if shots.two_beats == waveform.FAST_TARGET else waveform.FAR
        signed = 0.0
        if shots.complex_record:
            alone, signed = waveform.SIGNED, math.copysign(1.0, 1.0 - shots.slopes[2])
        votes = shots.looks.votes if shots.looks.combine == BINARY else 0
        if shots.look_speckle is not None and shots.looks.number > MIXED_LOOKS_MAX:
            votes = -1
        return cls(
            int(first_draw), noisy, shots.incoherent, bool(shots.segments[1]), shots.fft_size // 2,
            signed, alone, shots.real_ends, shots.echo_rule[1], echo_filter(shots, Seen.nothing(0)),
            np.zeros((0, 0)), echo_filter(shots, Seen.nothing(0)), np.empty(0),
            shots.looks.number if shots.looks.several else 1,
            shots.looks.independent or (shots.look_speckle is not None and votes >= 0), votes,
        )  # fmt: skip


class Known(NamedTuple):
    """Knowledge of n points, by segment, before any draw."""

    bins: np.ndarray
    """(n, 3, 3, most) int64: BIN, FIRST and LAST of the groups; -1 for none."""
    pd: np.ndarray
    """(n, 3, most)"""
    magnitude: np.ndarray
    """(n, 3, most, 3): of the strongest bin and its neighbours [V]."""
    spread: np.ndarray
    """(n, 3, most): standard deviation [bins] of the lines in a group, weighted by power."""
    lines: np.ndarray
    """(n, 3, beamlets): place of each beamlet's line [bins, 0..N/2]; with signs, as near to the
    strongest group as whole FFT lengths bring it."""
    amplitude: np.ndarray
    """(n, beamlets)"""
    levels: np.ndarray
    """(n, 3): sigma [V]; over it, the threshold and the noise of bins that hold lines."""
    of_bins: np.ndarray
    """(n, 7): of :class:`sweep.model.detection.BinLevels` [V]."""
    alarm: np.ndarray
    """(n, 3): probability of a false alarm by noise alone."""
    third: np.ndarray
    """(n, 3): as of :func:`sweep.model.pairing.confirm`."""
    beside: np.ndarray
    """(n, 2, most): probability of a group in the down segment, where the up segment's of the same
    number is missed, or detected."""
    searched: np.ndarray
    """(n, 3, 2) int64: first and last of the bins that false peaks may lie in."""
    fan: LineFan
    """Lines of footprints in developed speckle, of n points; or of none."""
    middle: np.ndarray
    """(n, 3, most): middle of the lines in a group [bins]."""
    share: np.ndarray
    """(n, 3, most): share of the echo in the mean power by which a group is detected."""
    wander: np.ndarray
    """(n, 3, most): standard deviation of its place by speckle [bins], at |X| of one sigma; 0
    without speckle."""
    number: np.ndarray
    """(n, 3, most): number of independent bins as which a group in developed speckle counts."""
    mixing: np.ndarray
    """(n, 6): of :meth:`sweep.model.detection.Fading.mixing`, 0 without speckle."""
    look_root: np.ndarray
    """(n, 3, looks, sets) complex: speckles of the looks by independent ones, where looks share
    them in part; of no sets otherwise."""

    def of(self, part: np.ndarray) -> "Known":
        """Knowledge of some points by their numbers."""
        return Known(
            *(v.of(part) if isinstance(v, LineFan) else v[part] for v in self)  # type: ignore[arg-type]
        )


class Workspace(NamedTuple):
    """Arrays that kernels write to within a draw, made once for all draws."""

    noise: np.ndarray
    """(4, bins + TAPS): noise of an echo's bins, and what it is made of."""
    power: np.ndarray
    """(bins,): power of an echo's bins over sigma^2."""
    pedestal: np.ndarray
    """(bins,): power of the pedestal in an echo's bins, over that of noise."""
    is_echo: np.ndarray
    """(bins,) bool: true."""
    false_bin: np.ndarray
    """(most + 1,) int64: bins of a segment's false peaks."""
    false_ratio: np.ndarray
    """(most + 1,): their |X| / sigma."""
    centre: np.ndarray
    """(3,): positions of a return's peaks [bins]."""

    @classmethod
    def of(cls, bins: int, most: int) -> "Workspace":
        """Make room for echoes of so many bins, and for ``most`` groups of a segment."""
        return cls(
            np.empty((4, bins + TAPS)), np.empty(bins), np.empty(bins), np.ones(bins, np.bool_),
            np.empty(most + 1, np.int64), np.empty(most + 1), np.empty(3),
        )  # fmt: skip


class Drawn(NamedTuple):
    """Results of the draws of n points."""

    peaks: np.ndarray
    """(n, draws, most, 3, 4): up, Doppler and down peak of each return; nan for none."""
    code: np.ndarray
    """(n, draws, most) int64: reading of the default slopes; -1 where there is no return."""
    group: np.ndarray
    """(n, draws, most, 3) int8: group of the up, Doppler and down peak, FALSE or ABSENT."""
    flags: np.ndarray
    beamlet: np.ndarray

    @classmethod
    def nothing(cls, found: Groups, draws: int) -> "Drawn":
        """No returns of shots with these groups."""
        n, _, most = found.bin.shape
        return cls(
            np.full((n, draws, most, 3, 4), np.nan), np.full((n, draws, most), -1),
            np.full((n, draws, most, 3), ABSENT, np.int8),
            np.zeros((n, draws, most), np.uint8), np.full((n, draws, most), -1, np.int32),
        )  # fmt: skip


def known_of(shots: Shots, found: Groups, motion: OwnMotion | None = None) -> Known:
    """Return what is known of shots and their groups before any draw.

    ``motion`` is as of :func:`draw_returns`.
    """
    lines, amplitude = beamlet_lines(shots), shots.amplitude[shots.row]
    if shots.complex_record:
        apart = (lines - found.bin[:, :, :1]) / shots.fft_size
        lines = lines - shots.fft_size * np.floor(apart + 0.5)
    bins = np.stack([found.bin, found.first, found.last], axis=2)
    apart = lines[:, :, None] - found.bin[..., None]
    inside = (lines[:, :, None] >= found.first[..., None] - 1) & (
        lines[:, :, None] <= found.last[..., None] + 1
    )
    weight = np.where(inside, amplitude[:, None, None] ** 2, 0.0)
    total = weight.sum(axis=-1)
    total[total == 0] = 1.0
    up, down = found.pd[:, 0], found.pd[:, 2]
    both = shots.both(up.T, down.T, (found.magnitude[:, 0].T, found.magnitude[:, 2].T)).T
    beside = down_given_up(up, down, both)
    mean = (weight * apart).sum(axis=-1) / total
    square = (weight * apart**2).sum(axis=-1) / total
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    if shots.fading is not None:  # drawn lines have it
        spread *= 0.0
    return Known(
        bins, found.pd, found.neighbours, spread, lines, amplitude,
        np.stack([shots.bin_deviation, *noise_levels(shots)], axis=1),
        np.ascontiguousarray(shots.bin_levels.T),
        np.zeros(found.leakage.shape),
        np.stack([np.broadcast_to(part, shots.size) for part in _third(shots, motion)], axis=1),
        np.ascontiguousarray(np.moveaxis(beside, 0, 1)), _searched(shots),
        line_fan(shots), np.where(found.bin < 0, np.nan, found.bin + mean),
        *_speckle_shares(shots, found), _speckle_mixing(shots), _look_roots(shots),
    )  # fmt: skip


def _speckle_mixing(shots: Shots) -> np.ndarray:
    """Return what mixes the speckle of the three segments, as of Known."""
    if shots.fading is None:
        return np.zeros((shots.size, 6))
    mixing = np.broadcast_to(shots.fading.mixing(), (6, shots.size))
    return np.ascontiguousarray(mixing.T)


def _look_roots(shots: Shots) -> np.ndarray:
    """Return what mixes the speckle of looks, as of Known."""
    number = shots.looks.number
    if shots.look_speckle is None or number > MIXED_LOOKS_MAX:
        return np.zeros((shots.size, 3, 1, 0), complex)
    return np.ascontiguousarray(np.moveaxis(shots.look_speckle.roots(), 0, 1))


def _independent_bins(shots: Shots, found: Groups, near_end: np.ndarray) -> np.ndarray:
    """Return the number of independent bins as which each group counts, (n, 3, most).

    That of :meth:`sweep.model.preparation.Shots.both` for the chirps; 1 near DC and Nyquist.
    """
    number = np.ones(found.pd.shape)
    if shots.detection == "peak_bin":
        return number
    for segments in ((0, 2), (1,)):
        chances = tuple(found.pd[:, s].T for s in segments)
        magnitudes = tuple(found.magnitude[:, s].T for s in segments)
        alike = np.asarray(shots.independent_bins(chances, magnitudes)).T
        for s in segments:
            number[:, s] = alike
    return np.where(near_end, 1.0, np.clip(number, 1.0, FADED_BINS_MAX))


def _speckle_shares(shots: Shots, found: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of the echo in the power that detects a group, its wander, and number, as of Known."""
    sigma, line, level = (
        np.broadcast_to(v, shots.size)[:, None, None]
        for v in (shots.bin_deviation, shots.line_deviation, shots.threshold)
    )
    if shots.speckle_lines is None:
        return np.zeros(found.pd.shape), np.zeros(found.pd.shape), np.ones(found.pd.shape)
    near_end = (shots.speckle_table.row.T > 0)[:, :, None] & (shots.real_ends > 0)
    number = _independent_bins(shots, found, near_end)
    with np.errstate(divide="ignore", invalid="ignore"):
        # As if one bin were detected as often: fading_together has the same share.
        single = -np.expm1(np.log1p(-found.pd) / number)
        share = 1 + np.log(np.where(number > 1, single, found.pd)) * 2 * (line / level) ** 2
        signal = np.square(found.magnitude / line)
        share = np.where(near_end, signal / (2 + signal), share)
    widest = np.sqrt((shots.speckle_lines.spread**2).sum(axis=-1))
    looks = shots.looks.number if shots.looks.several and shots.looks.independent else 1
    wander = widest[..., None] * found.magnitude / sigma / math.sqrt(2 * looks)
    return np.clip(np.nan_to_num(share), 0.0, 1.0), np.nan_to_num(wander), number


def _third(
    shots: Shots, motion: OwnMotion | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of the up and of the down beat in the Doppler segment's, which these two tell.

    And the bins by which that is off for the motion that the instrument knows.
    """
    _, doppler, down = shots.slopes
    up_carrier, at_doppler, at_down = (np.asarray(carrier) for carrier in shots.carriers)
    whole = at_down - down * up_carrier
    up_share = (doppler * at_down - down * at_doppler) / whole
    down_share = (at_doppler - doppler * up_carrier) / whole
    if motion is None:
        return up_share, down_share, np.zeros(())
    moved_by = (motion.acceleration, motion.slip_at(shots.range))
    off = sum(
        abs((up_share * beats[0] + down_share * beats[2] - beats[1]) * moved)
        for beats, moved in zip(_beats_by_motion(shots), moved_by, strict=True)
    )
    return up_share, down_share, np.asarray(off * shots.fft_size / shots.sample_rate)


def _searched(shots: Shots) -> np.ndarray:
    """First and last bin searched for alarms, as of :class:`Known`.

    Of a complex record 0..N - 1. Of a real one those whose noise is circular, which are all but a
    few next to DC and Nyquist; 1..N/2 where noise is taken to be so in all.
    """
    least, half = shots.searched_from, shots.fft_size // 2
    last = half - least if shots.real_ends else half
    found = np.empty((shots.size, 3, 2), np.int64)
    found[:] = (0, shots.fft_size - 1) if shots.complex_record else (least, last)
    if shots.band is not None:
        first, number = shots.band[:, 0].T, shots.band[:, 1].T
        if shots.complex_record:
            found[..., 0], found[..., 1] = first, first + number - 1
        else:
            found[..., 0] = np.maximum(first, least)
            found[..., 1] = np.minimum(first + number - 1, half - least)
    return found


class Told(NamedTuple):
    """Range [m] and radial velocity [m/s] of returns by WHOLE and FINE peaks, (n, draws, most, 2).

    And their standard errors by noise, and what half a bin of the chirps is worth, (n, 1, 1).
    """

    range: np.ndarray
    velocity: np.ndarray
    range_error: np.ndarray
    velocity_error: np.ndarray
    metre: np.ndarray
    speed: np.ndarray
    pulled: np.ndarray | float
    """Excess of the range told over that at the shot's start [m], (n, 1, 1)."""


def measured(
    shots: Shots,
    known: Known,
    drawn: Drawn,
    motion: OwnMotion | None = None,
    *,
    from_three_bins: bool = True,
) -> Returns:
    """Compute returns from pairs of peaks; flag those that misread their common beamlet.

    ``motion`` is as of :func:`draw_returns`. ``from_three_bins``: places between bins are those of
    :mod:`sweep.model.interpolation`, and not another estimator's.
    """
    fitted = shots.slopes != waveform.SIGNS
    drawn = _with_drift(shots, drawn, motion)
    read = _fitted if fitted else _read
    if from_three_bins and shots.first_sample is not None:  # errors by noise
        drawn = _with_late_echo(shots, drawn, read(shots, drawn, None))
    wander = _wander(shots, known, drawn)
    if wander is not None:
        peaks = drawn.peaks.copy()
        alone = np.diagonal(wander, axis1=-2, axis2=-1)
        peaks[..., ERROR] = np.sqrt(peaks[..., ERROR] ** 2 + alone)
        drawn = drawn._replace(peaks=peaks)
    told = read(shots, drawn, wander)
    point, group = np.arange(shots.size)[:, None, None], np.maximum(drawn.group, 0)
    sizes = (known.bins[:, :, LAST] - known.bins[:, :, FIRST])[
        point[..., None], np.arange(3), group
    ]
    reach = 2 * (4 + np.where(drawn.group >= 0, sizes, 0).sum(axis=-1))  # of half bins
    offset, doppler = shots.offset[shots.row], SPEED_OF_LIGHT / 2 * shots.doppler[shots.row]
    truth = columns(shots, shots.radial_velocity) + doppler
    deepest, seen = columns(shots, shots.range, 2), np.maximum(drawn.beamlet, 0)
    off = told.range[..., FINE] - told.pulled - deepest * (1 + offset[point, seen])
    right = abs(off) <= reach * told.metre
    right &= abs(told.velocity[..., FINE] - truth[point, seen]) <= reach * told.speed
    signal = (drawn.group[..., ::2] >= 0).all(axis=-1) & (drawn.group[..., 1] != FALSE)
    pd = known.pd[point, 0, group[..., 0]] * known.beside[point, 1, group[..., 2]]
    misread = (drawn.flags & TRUE > 0) & ~right
    uncorrected = told.range[..., FINE].copy(), told.velocity[..., FINE].copy()
    if not fitted:  # what the ground came nearer by within the shot: the measured velocity tells
        told.velocity[..., FINE] *= 1 + columns(shots, shots.slowing, 2)
        told.range[..., FINE] += told.velocity[..., FINE] * columns(shots, shots.walk, 2)
    per_slip: tuple[np.ndarray | float, np.ndarray | float] = 0.0, 0.0
    if motion is not None:
        per_slip = _correct_motion(shots, drawn, told, motion)
    for values, errors, before in zip(
        (told.range, told.velocity),
        (told.range_error, told.velocity_error),
        uncorrected,
        strict=True,
    ):  # whole bins stay uncorrected: their errors say so
        errors[..., WHOLE] = np.hypot(errors[..., WHOLE], values[..., FINE] - before)
    return Returns(
        told.range[..., WHOLE], told.range[..., FINE],
        told.velocity[..., WHOLE], told.velocity[..., FINE],
        told.range_error[..., WHOLE], told.range_error[..., FINE],
        told.velocity_error[..., WHOLE], told.velocity_error[..., FINE],
        drawn.peaks[..., ::2, RATIO].min(axis=-1) ** 2 / 2, np.where(signal, pd, np.nan),
        np.where(misread, drawn.flags ^ (TRUE | MISREAD), drawn.flags), drawn.beamlet,
        np.maximum(drawn.group, FALSE),
        *(np.where(drawn.flags > 0, change, np.nan) for change in per_slip),
    )  # fmt: skip


def _wander(shots: Shots, known: Known, drawn: Drawn) -> np.ndarray | None:
    """Mean products [bins^2] of the errors of each return's peaks by speckle.

    (n, draws, most, 3, 3) by segment, signed as the beats; None of shots that do not fade.
    """
    lines = shots.speckle_lines
    if lines is None:
        return None
    found = np.zeros((*drawn.group.shape, 3))
    point, draw, number = np.nonzero((drawn.group >= 0).any(axis=-1))
    group, peaks = drawn.group[point, draw, number], drawn.peaks[point, draw, number]
    segment, at = np.arange(3), point[:, None]
    echo = np.where(group >= 0, 1.0, np.nan)
    numbers = np.maximum(group, 0)
    sigma, line = (
        np.broadcast_to(v, shots.size)[at] for v in (shots.bin_deviation, shots.line_deviation)
    )
    signal = (known.magnitude[at, segment, numbers, 1] / sigma) ** 2
    mean = signal + 2 * (line / sigma) ** 2
    delta = peaks[..., FINE] - peaks[..., WHOLE]
    if shots.detection == "peak_bin":  # placed by the bins about that one
        moved = peaks[..., WHOLE] - known.bins[at, segment, BIN, numbers]
        if shots.complex_record:
            moved = moved - shots.fft_size * np.rint(moved / shots.fft_size)
        delta = delta + np.where(np.abs(moved) <= 1, moved, 0.0)
    power = echo * peaks[..., RATIO] ** 2 / mean
    of_echoes = Peaks(delta, directions(shots)[point], power, signal / mean)
    pairs = CHIRPS if shots.slopes == waveform.SIGNS else ALL_PAIRS
    found[point, draw, number] = place_errors(lines.of(point), of_echoes, shots, pairs)
    return found


def _with_drift(shots: Shots, drawn: Drawn, motion: OwnMotion | None) -> Drawn:
    """Add to the peaks' errors what the drift of their lines within the record makes.

    It is that by the motion that the instrument knows, if there is one.
    """
    if motion is not None:
        shots = replace(
            shots, acceleration=motion.acceleration, approach=motion.approach_at(shots.range)
        )
    bins = shots.record_duration * shots.fft_size / shots.sample_rate
    drift = np.array([np.broadcast_to(abs(rate) * bins, shots.size) for rate in shots.drift_rates])
    peaks = drawn.peaks.copy()
    delta = peaks[..., FINE] - peaks[..., WHOLE]
    wide = drift_error(delta, drift.T[:, None, None], shots.window, shots.fft_size)
    peaks[..., ERROR] = np.hypot(peaks[..., ERROR], wide)
    return drawn._replace(peaks=peaks)


_HALF_A_BIN = 0.5


def _with_late_echo(shots: Shots, drawn: Drawn, told: Told) -> Drawn:
    """Correct places between bins for the samples that lack before the echo arrives.

    The instrument knows them by the range that whole bins tell. No error is larger than half a bin,
    as a place is always within one.
    """
    column = partial(columns, shots, dims=2)
    delay = 2 / SPEED_OF_LIGHT * np.nan_to_num(told.range[..., WHOLE])
    beta = 2 / SPEED_OF_LIGHT * np.nan_to_num(told.velocity[..., WHOLE])
    lacking = waveform.samples_before_echo(
        delay=delay, beta=beta, start=column(shots.acquisition_delay),
        sample_rate=column(shots.sample_rate), length=shots.window.length,
    )  # fmt: skip
    peaks = drawn.peaks.copy()
    delta = np.nan_to_num(peaks[..., FINE] - peaks[..., WHOLE])
    late = late_echo(delta, lacking[..., None], shots.window, shots.fft_size)
    peaks[..., FINE] += late.shift
    wider = np.minimum(peaks[..., ERROR] * late.wider, _HALF_A_BIN)
    peaks[..., ERROR] = np.where(late.wider > 1, np.maximum(wider, peaks[..., ERROR]), wider)
    return drawn._replace(peaks=peaks)


def _correct_motion(
    shots: Shots, drawn: Drawn, told: Told, motion: OwnMotion
) -> tuple[np.ndarray, np.ndarray]:
    """Correct range and velocity between bins for the motion that the instrument knows, in place.

    The standard deviation of what it does not know goes into the standard errors
    (:mod:`sweep.model.own_motion`). Returns what range [s] and velocity change by 1 m/s of slip.
    """
    acceleration, slip = _moved_by_motion(shots, drawn)
    known_slip = motion.slip_at(told.range[..., FINE])
    grows, error = (
        columns(shots, values, 2) for values in (motion.acceleration, motion.acceleration_error)
    )
    values_by = zip((told.range, told.velocity), slip, acceleration, strict=True)
    for values, by_slip, by_acceleration in values_by:
        values[..., FINE] -= by_slip * known_slip + by_acceleration * grows
    slip_error = motion.slip_error(told.range[..., FINE])
    errors_by = zip((told.range_error, told.velocity_error), slip, acceleration, strict=True)
    for errors, by_slip, by_acceleration in errors_by:
        unknown = np.hypot(by_slip * slip_error, by_acceleration * error)
        errors[:] = np.hypot(errors, unknown[..., None])
    return slip


def _moved_by_motion(
    shots: Shots, drawn: Drawn
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Range [m] and velocity [m/s] that beats gain by 1 m/s^2 of acceleration, and 1 m/s of slip.

    The slip is the radial velocity less the speed at which the range falls. All broadcast with the
    returns (n, draws, most).
    """
    carriers, rates = shots.beats_by_motion
    by_acceleration, by_slip = _beats_by_motion(shots)
    if shots.slopes == waveform.SIGNS:  # half sum and half difference of up and down beat
        point: np.ndarray | slice = slice(None)
        weights, shape = np.array([[1.0], [0.0], [1.0]]) + 0 * rates, (shots.size, 1, 1)
    else:
        shape = drawn.flags.shape
        point = np.repeat(np.arange(shots.size), shape[1] * shape[2])
        peaks = np.moveaxis(drawn.peaks[..., ERROR], 3, 0).reshape(3, point.size)
        weights = np.where(np.isfinite(peaks), 1 / peaks**2, 0.0)
    acceleration, slip = (
        tuple(
            moved.reshape(shape)
            for moved in waveform.response(
                beats[:, point], weights=weights, carriers=carriers[:, point], rates=rates[:, point]
            )
        )
        for beats in (by_acceleration, by_slip)
    )
    return acceleration, slip  # type: ignore[return-value]  # pairs


def _beats_by_motion(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Hz that beats (3, n) gain by 1 m/s^2 of acceleration, and by 1 m/s of slip."""
    rates = shots.beats_by_motion[1]
    starts = np.array([np.broadcast_to(start, shots.size) for start in shots.starts])
    within = shots.record_middle
    light = 2 / SPEED_OF_LIGHT
    optical = np.array([np.broadcast_to(carrier, shots.size) for carrier in shots.carriers])
    nearer = starts**2 / 2 + 2 * starts * within + 1.5 * within * shots.speeding
    by_acceleration = light * (optical * (starts + shots.speeding) + rates * nearer)
    return by_acceleration, -light * rates * (starts + within)


def _read(shots: Shots, drawn: Drawn, wander: np.ndarray | None) -> Told:
    """Tell range and velocity at mid-chirp by each return's reading of its up and down peak.

    Speckle that both see moves their beats against each other with the range, and along with each
    other with the velocity.
    """
    carrier, bandwidth, duration, rate = (
        columns(shots, column, 3)
        for column in (shots.carriers[0], shots.bandwidth, shots.duration, shots.sample_rate)
    )
    width, chirp_rate = rate / shots.fft_size, bandwidth / duration
    up, down = (drawn.peaks[..., side, : FINE + 1] * width for side in (0, 2))
    f_d, f_r = np.full((2, *up.shape), np.nan)
    for code in np.unique(drawn.code[drawn.code >= 0]):
        there = (drawn.code == code)[..., None]
        f_d, f_r = (
            np.where(there, new, old)
            for new, old in zip(waveform.reading(code, up, down, rate), (f_d, f_r), strict=True)
        )
    distance, velocity = waveform.measured(f_d, f_r, carrier, bandwidth, duration)
    metre = SPEED_OF_LIGHT / 4 * width / chirp_rate
    speed = SPEED_OF_LIGHT / 4 * width / (carrier + bandwidth / 2)
    variance = (drawn.peaks[..., ::2, ERROR] ** 2).sum(axis=-1)
    together = 0.0 if wander is None else 2 * wander[..., 0, 2]
    by_range, by_velocity = (np.maximum(variance + v, 0.0) for v in (-together, together))
    range_error, velocity_error = (
        np.sqrt(np.stack([value + 1 / 6, value], axis=-1)) for value in (by_range, by_velocity)
    )
    # Up and down beat tell the range at the middle of their starts; acceleration adds to it.
    first, last = (columns(shots, shots.starts[s], 2) for s in (0, 2))
    pulled = (carrier / chirp_rate)[..., 0] * columns(shots, shots.acceleration, 2)
    pulled = 0.5 * (last - first) * pulled
    pulled -= 0.5 * (last + first) * columns(shots, shots.approach, 2)
    return Told(
        distance,
        velocity,
        metre * range_error,
        speed * velocity_error,
        metre[..., 0],
        speed[..., 0],
        pulled,
    )


def _fitted(shots: Shots, drawn: Drawn, wander: np.ndarray | None) -> Told:
    """Tell range and velocity at the shot's start by the fit of each return's peaks."""
    shape = drawn.flags.shape
    point = np.repeat(np.arange(shots.size), shape[1] * shape[2])
    width = np.broadcast_to(shots.sample_rate / shots.fft_size, shots.size)
    carriers = [np.broadcast_to(carrier, shots.size) for carrier in shots.carriers]
    rate = np.broadcast_to(shots.chirp_rate, shots.size)
    peaks = np.moveaxis(drawn.peaks, 3, 0).reshape(3, point.size, -1)
    seen = np.isfinite(peaks[..., ERROR])

    def deviation(errors: np.ndarray, at: np.ndarray) -> Deviation:
        """Of errors [bins], (3, m), of points."""
        up, doppler, down = errors * width[at]
        return resolved_deviation(
            up=up, doppler=doppler, down=down, carriers=tuple(each[at] for each in carriers),
            chirp_rate=rate[at], slopes=shots.slopes, range=shots.range[at],
            radial_velocity=shots.radial_velocity[at],
        )  # fmt: skip

    columns_of = []
    for kind in (WHOLE, FINE):
        errors = np.where(seen, peaks[..., ERROR], np.inf)
        errors = np.hypot(errors, math.sqrt(1 / 12) if kind == WHOLE else 0.0)
        found = fit(shots, peaks[..., kind] * width[point], 1 / errors**2, point)
        spread = deviation(errors, point)
        if wander is not None:
            common = wander.reshape(point.size, 3, 3) * (width[point] ** 2)[:, None, None]
            spread = _with_common_wander(shots, spread, common, 1 / errors**2, point)
        columns_of.append((*found, *spread))
    there = (drawn.code >= 0)[..., None]
    distance, velocity, range_error, velocity_error = (
        np.where(there, np.stack(pair, axis=-1).reshape(*shape, 2), np.nan)
        for pair in zip(*columns_of, strict=True)
    )
    segments = np.array(shots.segments)[:, None]
    half = deviation(np.where(segments, np.sqrt(0.5), np.inf) + 0 * width, np.arange(shots.size))
    metre, speed = (value[:, None, None] for value in half)
    return Told(distance, velocity, range_error, velocity_error, metre, speed, 0.0)


def _with_common_wander(
    shots: Shots, spread: Deviation, common: np.ndarray, weights: np.ndarray, point: np.ndarray
) -> Deviation:
    """Add to deviations of fits what the covariances of their beats (m, 3, 3) [Hz^2] make."""
    carriers, rates = shots.beats_by_motion
    gains = []
    for unit in np.eye(3):
        beats = unit[:, None] + np.zeros(point.size)
        gains.append(
            waveform.response(
                beats, weights=weights, carriers=carriers[:, point], rates=rates[:, point]
            )
        )
    by_beat = np.array(gains)  # by beat, range and velocity, return
    found = []
    for value, gain in zip(spread, by_beat.swapaxes(0, 1), strict=True):
        both = sum(gain[i] * gain[j] * common[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2)))
        with np.errstate(invalid="ignore"):
            found.append(np.sqrt(np.maximum(value**2 + 2 * both, 0.0)))
    return Deviation(*found)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(keys, how, known, seen, leaks, tables, work, out):
    """All draws of all points: peaks of the three segments, and which make returns."""
    n, draws, most = out.flags.shape
    peaks, which = np.zeros((3, most + 1, 4)), np.empty((3, most + 1), np.int64)
    number, pairs = np.empty(3, np.int64), np.empty((most + 1, 4), np.int64)
    up, fading = np.zeros(most, np.bool_), np.ones((most, 3))
    fades = known.fan.spread.shape[0] > 0
    speckle = no_speckle(most)
    for i in range(n):
        if fades:
            speckle = speckled_bins(i, how, known, seen)
        for d in range(draws):
            address = keys[i, 0], keys[i, 1], how.first_draw + d
            if fades:
                draw_speckle(address, i, known, speckle, fading)
            for s in range(3):
                if s != 1 or how.doppler:
                    number[s] = draw_peaks(
                        address, (i, s), how, known, seen, leaks, fading, speckle, tables,
                        work, peaks[s], which[s], up,
                    )  # fmt: skip
            report((i, d), how, known, (peaks, which, number), pairs, work, out)


class Speckle(NamedTuple):
    """Bins of a point's groups by segment, and their speckle in a draw."""

    first: np.ndarray
    """(most, 3) int64: first bin."""
    number: np.ndarray
    """(most, 3) int64: number of bins, 0 where a segment lacks the group."""
    power: np.ndarray
    """(most, 3, bins): mean power by the lines of the footprint."""
    pseudo: np.ndarray
    """(most, 3, bins): pseudo-variance over that power."""
    size: np.ndarray
    """(most, 3, bins): root mean square of the echo's |X| / sigma."""
    drawn: np.ndarray
    """(most, looks, 3, bins): complex amplitudes of a mean power of 1; of one look where all have
    the same."""
    rank: np.ndarray
    """(most,) int64: rows of ``factor`` of a group; 0 where its lines are drawn one by one."""
    factor: np.ndarray
    """(most, rows, 3, bins): of :func:`sweep.model.speckle_lines.factor_bins`."""
    alone: np.ndarray
    """(sets, 3, bins): independent amplitudes, of which those of looks are mixed that share them in
    part."""
    detecting: np.ndarray
    """(most, 3, bins): weights of the bins in the amplitude, of mean power 1, that is held against
    the probability of detection."""


@njit(cache=True, error_model="numpy")
def no_speckle(most):
    """Return the record of a point whose echoes do not fade."""
    bins = np.zeros((most, 3), np.int64)
    nothing = np.zeros((most, 1, 3, 0), np.complex128)
    powers = np.zeros((most, 3, 0))
    alone = np.zeros((0, 3, 0), np.complex128)
    rank = np.zeros(most, np.int64)
    return Speckle(bins, bins, powers, powers, powers, nothing, rank, nothing, alone, powers)


@njit(cache=True, error_model="numpy")
def speckled_bins(i, how, known, seen):
    """List the bins of a point's groups that are looked at, and their mean powers."""
    most, widest = known.bins.shape[3], 0
    first, count = np.zeros((most, 3), np.int64), np.zeros((most, 3), np.int64)
    for g in range(most):
        for s in range(3):
            centre = known.bins[i, s, BIN, g]
            if centre < 0:
                continue
            if how.noisy and how.beside > 0:
                low, start = seen.low[i, s], seen.start[i, s]
                run = seen.ratios[start : start + seen.bins[i, s]]
                ends = known.bins[i, s, FIRST, g] - low, known.bins[i, s, LAST, g] - low
                beside = max(how.beside, int(known.of_bins[i, 4]))
                begin, end = echo_of(run, ends[0], ends[1], known.levels[i, 1], beside)
                first[g, s], count[g, s] = low + begin, end - begin + 1
            else:
                first[g, s] = centre - known.fan.reach[i]
                count[g, s] = 2 * known.fan.reach[i] + 1
            widest = max(widest, count[g, s])
    power, pseudo = np.zeros((most, 3, widest)), np.zeros((most, 3, widest))
    looks = how.looks if how.apart else 1
    rows = 3 * widest if 3 * widest <= FACTORED_ROWS_MAX else 0
    rank, factor = np.zeros(most, np.int64), np.empty((most, rows, 3, widest), np.complex128)
    for g in range(most):
        if count[g].max() == 0:
            continue
        imaged = line_powers(known.fan, i, known.middle[i, :, g], first[g], power[g], pseudo[g])
        if rows > 0 and not imaged:
            rank[g] = factor_bins(
                known.fan, i, known.middle[i, :, g], first[g], power[g], factor[g]
            )
    drawn = np.zeros((most, looks, 3, widest), np.complex128)
    alone = np.zeros((known.look_root.shape[3], 3, widest), np.complex128)
    size, detecting = np.zeros((most, 3, widest)), np.zeros((most, 3, widest))
    for g in range(most):
        for s in range(3):
            if count[g, s] == 0 or how.noisy:
                continue
            weigh_bins(i, (g, s), how, known, first, power, rank, factor, detecting[g, s])
            middle, sigma = known.bins[i, s, BIN, g] - first[g, s], known.levels[i, 0]
            magnitude = known.magnitude[i, s, g]
            for k in range(count[g, s]):
                if abs(k - middle) <= 1:
                    size[g, s, k] = magnitude[1 + k - middle] / sigma
                else:
                    share = power[g, s, k] / power[g, s, middle]
                    size[g, s, k] = magnitude[1] / sigma * math.sqrt(share)
    return Speckle(first, count, power, pseudo, size, drawn, rank, factor, alone, detecting)


@njit(cache=True, error_model="numpy", borrows=True)
def weigh_bins(i, at, how, known, first, power, rank, factor, out):
    """Set the weights (bins,) of :attr:`Speckle.detecting`, of group and segment ``at``.

    With ``peak_bin`` that is the amplitude of the strongest bin. If any bin detects, the amplitudes
    of two segments have the correlation of those in the middle of the echo: the bins are weighted
    as a lone line in the middle would fill them.
    """
    g, s = at
    out[:] = 0.0
    out[known.bins[i, s, BIN, g] - first[g, s]] = 1.0
    if how.beside == 0 or rank[g] == 0:
        return
    total = 0.0
    for k in range(out.size):
        distance = first[g, s] + k - known.middle[i, s, g]
        out[k] = transform_at(distance, known.fan) * math.sqrt(power[g, s, k])
    for r in range(rank[g]):
        one = complex(0.0, 0.0)
        for k in range(out.size):
            one += out[k] * factor[g, r, s, k]
        total += 2.0 * abs(one) ** 2
    out /= math.sqrt(total)


@njit(cache=True, error_model="numpy", borrows=True)
def draw_speckle(address, i, known, speckle, fading):
    """Draw the speckle of a point's groups, and the factors (most, 3) by which they fade."""
    for g in range(speckle.number.shape[0]):
        fading[g] = 1.0
        if speckle.number[g].max() == 0:
            continue
        sets = speckle.alone.shape[0]
        for look in range(sets if sets > 0 else speckle.drawn.shape[1]):
            own = address[0], address[1], address[2] + look * NEXT_LOOK
            amplitudes = speckle.alone[look] if sets > 0 else speckle.drawn[g, look]
            if speckle.rank[g] > 0:
                draw_factored(own, g, speckle.factor[g], speckle.rank[g], amplitudes)
            else:
                draw_lines(
                    own, g, known.fan, i, known.middle[i, :, g], speckle.first[g],
                    speckle.power[g], amplitudes,
                )  # fmt: skip
        if sets > 0:
            mix_looks(known.look_root[i], speckle.alone, speckle.drawn[g])
        for s in range(3):
            if speckle.number[g, s] == 0:
                continue
            centre, total = known.bins[i, s, BIN, g] - speckle.first[g, s], 0.0
            for look in range(speckle.drawn.shape[1]):
                own = speckle.drawn[g, look, s]
                for k in range(speckle.number[g, s]):
                    if not speckle.power[g, s, k] > 0.0:  # beyond all lines
                        own[k] = own[centre]
                total += own[centre].real ** 2 + own[centre].imag ** 2
            fading[g, s] = math.sqrt(total / speckle.drawn.shape[1])


@njit(cache=True, error_model="numpy", borrows=True)
def mix_looks(root, alone, out):
    """Mix independent amplitudes (sets, 3, bins) to those of looks (looks, 3, bins)."""
    out[:] = 0.0
    for look in range(out.shape[0]):
        for s in range(3):
            for k in range(alone.shape[0]):
                for bin_ in range(alone.shape[2]):
                    out[look, s, bin_] += root[s, look, k] * alone[k, s, bin_]


@njit(cache=True, error_model="numpy", borrows=True)
def report(at, how, known, found, pairs, work, out):
    """Pair the peaks of one point (i, draw) into returns, and judge each.

    ``found``: peaks (3, most + 1, 4), their groups, and their number in each segment.
    """
    (i, d), (peaks, which, number) = at, found
    if how.doppler:
        confirmed, count = pair_peaks(
            peaks[0, : number[0], FINE], peaks[1, : number[1], FINE],
            peaks[2, : number[2], FINE], known.third[i], 2.0 * how.half,
            how.signed, how.alone, TOLERANCE, pairs,
        )  # fmt: skip
    else:
        confirmed = count = min(number[0], number[2])
        for r in range(count):
            pairs[r, 0], pairs[r, 1], pairs[r, 2], pairs[r, 3] = r, -1, r, how.alone
    for r in range(min(count, out.flags.shape[2])):
        u, k, v, out.code[i, d, r] = pairs[r]
        group, centres = out.group[i, d, r], work.centre
        centres[1] = 0.0
        group[0], group[2] = which[0, u], which[2, v]
        centres[0], centres[2] = peaks[0, u, FINE], peaks[2, v, FINE]
        if k >= 0:
            group[1], centres[1] = which[1, k], peaks[1, k, FINE]
        for s in range(3):
            if group[s] >= 0 and known.fan.spread.shape[0] > 0:  # of the echo, not of its speckle
                centres[s] = known.middle[i, s, group[s]]
        for s in range(3):  # groups of complex records may lie whole FFT lengths from their peaks
            if how.signed != 0.0 and group[s] >= 0:
                apart = known.bins[i, s, BIN, group[s]] - centres[s]
                centres[s] += 2 * how.half * math.floor(apart / (2 * how.half) + 0.5)
        own = out.peaks[i, d, r]
        for f in range(4):  # slices would compile an error message of shapes
            own[0, f], own[2, f] = peaks[0, u, f], peaks[2, v, f]
            own[1, f] = peaks[1, k, f] if k >= 0 else np.nan
        flag, out.beamlet[i, d, r] = judge(
            group, centres, known.bins[i], known.lines[i], known.amplitude[i]
        )
        out.flags[i, d, r] = flag | (UNCONFIRMED if r >= confirmed else 0)


@njit(cache=True, error_model="numpy", borrows=True)
def draw_peaks(
    address, at, how, known, seen, leaks, fading, speckle, tables, work, peaks, which, up
):
    """Peaks (most + 1, 4) of a segment in a draw and their groups; returns how many there are.

    ``address`` is the key of the point and the number of the draw, ``at`` point and segment.
    ``fading`` (most, 3) are factors on the groups' magnitudes, by segment, and ``speckle`` has the
    amplitudes of their bins. ``up`` (most,) tells which groups are detected in the up segment,
    which comes first.
    """
    (a, b, draw), (i, s) = address, at
    sigma, beta, under_lines = known.levels[i]
    bins, count = known.bins[i, s], 0
    for g in range(bins.shape[1]):
        if bins[BIN, g] < 0:
            break
        if how.noisy and how.beside > 0:
            there = look_at_all(
                address, at, g, how, known, seen, speckle, tables, work, peaks[count]
            )
        elif how.noisy:
            there = look(address, at, g, how, known, seen, speckle, tables, work, peaks[count])
        elif speckle.number[g, s] > 0:
            there = detect_faded(address, at, g, how, known, speckle, tables, work, peaks[count])
        else:
            chance = known.beside[i, 1 if up[g] else 0, g] if s == 2 else known.pd[i, s, g]
            uniform = philox.uniform(a, b, draw, philox.STREAM_DETECTION[s], g)
            there = uniform < chance
            if there:
                m, spread = known.magnitude[i, s, g], known.spread[i, s, g]
                delta, ratio = sub_bin(m[0], m[1], m[2], tables), m[1] / sigma
                error = sub_bin_error(delta, ratio / under_lines, tables) / math.sqrt(how.looks)
                # With the pedestal that is under the lines.
                ratio = math.sqrt(ratio * ratio + 2.0 * (under_lines * under_lines - 1.0))
                normal, _ = philox.normal_pair(a, b, draw, philox.STREAM_NOISE[s], g)
                fine = bins[BIN, g] + delta + error * normal
                put(peaks[count], bins[BIN, g], fine, error, ratio, spread, how, tables)
        if s == 0:
            up[g] = there
        if there:
            which[count] = g
            count += 1
    room = peaks.shape[0] - count
    false, ratios, number = work.false_bin[:room], work.false_ratio[:room], 0
    ratios[:] = 0.0
    if how.noisy:
        number = list_noisy(address, at, seen, leaks, fading[:, s], beta, tables, false, ratios)
    else:
        number = draw_leaked(address, at, leaks, fading, beta, how.looks, tables, false, ratios)
    stream = philox.STREAM_NOISE_MAXIMUM[s] if how.noisy else philox.STREAM_FALSE_ALARM[s]
    words = philox.words4(a, b, draw, stream, philox.FIRST_BLOCK)
    chance = philox.to_uniform(words[0])
    if chance < known.alarm[i, s]:
        ratio = max(largest_of(seen.others[i, s], chance, how.looks), beta)
        ends = known.searched[i, s, 0], known.searched[i, s, 1]
        barred = leaks.barred_bin[leaks.barred_stretch[i, s, 0] : leaks.barred_stretch[i, s, 1]]
        chance = philox.to_uniform(words[1])
        place = free_bin(chance, bins, barred, ends, 2 * how.half, how.signed)
        number = list_peak((place, ratio), false, ratios, number)
    for n in range(number):
        error = sub_bin_error(0.0, ratios[n], tables) / math.sqrt(how.looks)
        put(peaks[count], false[n], false[n], error, ratios[n], 0.0, how, tables)
        which[count] = FALSE
        count += 1
    return count


@njit(cache=True, error_model="numpy", borrows=True)
def list_noisy(address, at, seen, leaks, fading, level, tables, bins, ratios):
    """List the strongest peaks of bins of leaked signal with their noise; return their number.

    Adjacent bins that cross make one peak, the largest, or are of the echo if they join on to a bin
    of it that crosses. ``fading`` (most,): factors on the groups' magnitudes. Results are bins, and
    |X| / sigma.
    """
    (a, b, draw), (i, s) = address, at
    number, before, peak, largest = 0, np.int64(-2), np.int64(-1), 0.0
    near, is_echo = tables.sidelobe_correlation, False
    rest = math.sqrt(1.0 - near * near)
    for n in range(seen.stretch[i, s, 0], seen.stretch[i, s, 1]):
        re, im = philox.normal_pair(a, b, draw, philox.STREAM_NOISE[s], seen.aside[n])
        faded = fading[leaks.echo[n]]
        ratio = math.hypot(seen.leaked[n] * faded + re, im)
        if ratio < level:
            continue
        place = seen.low[i, s] + seen.aside[n]
        if place != before + 1:
            number = list_peak((np.int64(-1) if is_echo else peak, largest), bins, ratios, number)
            peak, largest, is_echo = np.int64(-1), 0.0, False
        before = place
        if ratio > largest:
            peak, largest = place, ratio
        if seen.edge[n] > 0.0:
            own = seen.aside[n] + seen.side[n]
            re_own, im_own = philox.normal_pair(a, b, draw, philox.STREAM_NOISE[s], own)
            along = seen.edge[n] * faded + near * re + rest * re_own
            is_echo |= math.hypot(along, near * im + rest * im_own) >= level
    return list_peak((np.int64(-1) if is_echo else peak, largest), bins, ratios, number)


@njit(cache=True, error_model="numpy", borrows=True)
def look(address, at, g, how, known, seen, speckle, tables, work, peak):
    """Look at a group's strongest bin with its noise: True, and its peak, where it crosses."""
    (a, b, draw), (i, s) = address, at
    sigma, beta, under_lines = known.levels[i]
    centre, stream = known.bins[i, s, BIN, g], philox.STREAM_NOISE[s]
    k = centre - seen.low[i, s]
    re, im = philox.normal_pair(a, b, draw, stream, k)
    real = is_end(centre, how.ends)
    if real:
        re, im = math.sqrt(2.0) * re, 0.0
    re, im = re * under_lines, im * under_lines
    m = known.magnitude[i, s, g]
    near_end = speckle.number[g, s] > 0 and is_near_end(centre - 1, 3, how)
    room = work.noise
    if near_end:
        noise_near_end((a, b, draw, stream), ECHO * (1 + g), (centre - 1, 3), how, room)
        re, im = under_lines * room[0, 1], under_lines * room[1, 1]
    echo = speckled(m[1] / sigma, speckle, g, s, 1)
    if (echo.real + re) ** 2 + (echo.imag + im) ** 2 < beta * beta:
        return False
    # Neighbours are exempt from false alarms, so their bins' own numbers are free.
    re_below, im_below = philox.normal_pair(a, b, draw, stream, k - 1 if k > 0 else k + 2)
    re_above, im_above = philox.normal_pair(a, b, draw, stream, k + 1)
    re_below, im_below = re_below * under_lines, im_below * under_lines
    re_above, im_above = re_above * under_lines, im_above * under_lines
    near, rest, across, own = tables.mixing
    low = speckled(m[0] / sigma, speckle, g, s, 0)
    high = speckled(m[2] / sigma, speckle, g, s, 2)
    below = math.hypot(
        low.real + (near * re + across * re_above + own * re_below),
        low.imag + (near * im + across * im_above + own * im_below),
    )
    middle = math.hypot(echo.real + re, echo.imag + im)
    above = math.hypot(
        high.real + (near * re + rest * re_above), high.imag + (near * im + rest * im_above)
    )
    if near_end:
        below = abs(low + under_lines * complex(room[0, 0], room[1, 0]))
        above = abs(high + under_lines * complex(room[0, 2], room[1, 2]))
    delta = sub_bin(below, middle, above, tables)
    shift = 0
    if max(below, above) > middle:
        shift = 1 if above > below else -1
    error, ratio = sub_bin_error(delta, middle / under_lines, tables), max(below, middle, above)
    put(peak, centre + shift, centre + delta, error, ratio, known.spread[i, s, g], how, tables)
    return True


@njit(cache=True, error_model="numpy", borrows=True)
def speckled(magnitude, speckle, g, s, k):
    """Complex amplitude of bin k of a group in a draw, of a mean square magnitude."""
    if speckle.number[g, s] == 0:
        return complex(magnitude, 0.0)
    return magnitude * speckle.drawn[g, 0, s, k]


@njit(cache=True, error_model="numpy", borrows=True)
def detect_faded(address, at, g, how, known, speckle, tables, work, peak):
    """Draw a group in developed speckle: True, and its peak, where it is detected.

    Its amplitude, echo and noise, is normal, of the echo's share in the mean power. It is detected
    where its power exceeds what it exceeds with the group's probability of detection. So segments
    are detected together as two correlated Rayleigh magnitudes of their own probabilities are, by
    :func:`sweep.model.detection.fading_together`. An echo that counts as several independent bins
    is detected by any of as many amplitudes, of which the drawn one is the first. Several looks
    detect by their own powers.
    """
    (a, b, draw), (i, s) = address, at
    _, beta, under_lines = known.levels[i]
    centre, first = known.bins[i, s, BIN, g], speckle.first[g, s]
    middle, count, chance = centre - first, speckle.number[g, s], known.pd[i, s, g]
    number = known.number[i, s, g]
    if number > 1.0:
        chance = -math.expm1(math.log1p(-chance) / number)
    share, near_end = known.share[i, s, g], is_near_end(first, count, how)
    if not chance > 0.0:
        return False
    power, room = work.power[:count], work.noise
    power[:] = 0.0
    along, across, votes = 0.0, 0.0, 0
    of_echo, of_noise = math.sqrt(share), math.sqrt(0.5 * (1.0 - share))
    for look in range(how.looks):
        own = draw + look * NEXT_LOOK
        address_of_noise = a, b, own, philox.STREAM_NOISE[s]
        if count == 3 and not near_end:
            three_bins_of_noise(address_of_noise, 3 * g, tables, room)
        else:
            bins_of_noise(address_of_noise, ECHO * (1 + g), (first, count), how, room)
        echo = speckle.drawn[g, look if speckle.drawn.shape[1] > 1 else 0, s]
        for k in range(count):
            size, weight = speckle.size[g, s, k], of_echo * speckle.detecting[g, s, k]
            re = size * echo[k].real + under_lines * room[0, k]
            im = size * echo[k].imag + under_lines * room[1, k]
            if look == 0:
                along, across = along + weight * echo[k].real, across + weight * echo[k].imag
            if k == middle and look == 0:
                along, across = along + of_noise * room[0, k], across + of_noise * room[1, k]
            if k == middle:
                votes += re * re + im * im >= beta * beta
            power[k] += (re * re + im * im) / how.looks
    if how.looks > 1 and how.votes >= 0:
        there = votes >= how.votes if how.votes > 0 else power[middle] >= beta * beta
    elif near_end:
        pseudo = share * speckle.pseudo[g, s, middle]
        pseudo += (1.0 - share) * bin_share(abs(centre), how.half, how.noise_quadratures)
        there = hoyt_pair(1.0, pseudo, math.hypot(along, across))[0] < chance
    else:
        there = math.exp(-(along * along + across * across)) < chance
        if not there and number > 1.0:
            there = is_detected_aside(address, (i, s), g, known, chance)
    if not there:
        return False
    best = middle
    if count > 3:
        for k in range(1, count - 1):
            best = k if power[k] > power[best] else best
    below, strongest, above = (
        math.sqrt(power[best - 1]),
        math.sqrt(power[best]),
        math.sqrt(power[best + 1]),
    )
    delta, shift = sub_bin(below, strongest, above, tables), 0
    if max(below, above) > strongest:
        shift = 1 if above > below else -1
    error = sub_bin_error(delta, strongest / under_lines, tables) / math.sqrt(how.looks)
    ratio = max(below, strongest, above, beta)
    put(peak, first + best + shift, first + best + delta, error, ratio, 0.0, how, tables)
    return True


_ASIDE = 1 << 22
"""Random numbers from which those of further independent bins of groups count, group by group."""


@njit(cache=True, error_model="numpy", borrows=True)
def is_detected_aside(address, at, g, known, chance):
    """Return true where an independent bin of a group but its strongest one is detected.

    ``chance`` is the probability of a bin. The last of them is a part of one.
    """
    (a, b, draw), (i, s) = address, at
    left, share = known.number[i, s, g] - 1.0, known.share[i, s, g]
    bin_ = _ASIDE + g * int(FADED_BINS_MAX)
    while left > 1e-6:
        amplitude = fading_amplitudes((a, b), draw, bin_, known.mixing[i])[s]
        re, im = philox.normal_pair(a, b, draw, philox.STREAM_NOISE[s], bin_)
        noise, part = math.sqrt(0.5 * (1.0 - share)), math.sqrt(share)
        power = (part * amplitude[0] + noise * re) ** 2 + (part * amplitude[1] + noise * im) ** 2
        if math.exp(-power) < (chance if left >= 1.0 else -math.expm1(left * math.log1p(-chance))):
            return True
        left, bin_ = left - 1.0, bin_ + 1
    return False


@njit(cache=True, error_model="numpy", borrows=True)
def bins_of_noise(address, number, bins, how, room):
    """Noise of adjacent bins over sigma, to rows 0 and 1 of ``room`` (4, >= bins + TAPS).

    It has room for all bins of ``how.end_rule`` and TAPS where bins are near DC or Nyquist.

    ``address``: key, draw, stream; independent numbers count from ``number``. ``bins``: the first
    bin, and their number.
    """
    first, count = bins
    at_end = how.ends > 0 and (first == 0 or 2 * (first + count - 1) == how.ends)
    if is_near_end(first, count, how):
        noise_near_end(address, number, bins, how, room)
    elif count <= how.root.shape[0] and not at_end:
        draw_noise_by_root(address, number, count, how.root, room)
    else:
        draw_noise(address, number, first, count, how.rule, room)


@njit(cache=True, error_model="numpy", borrows=True)
def is_near_end(first, count, how):
    """Return true of adjacent bins so near to DC or Nyquist that the noise's quadratures differ."""
    near = how.noise_quadratures.size
    return near > 0 and (first < near or first + count - 1 > how.half - near)


@njit(cache=True, error_model="numpy", borrows=True)
def noise_near_end(address, number, bins, how, room):
    """Noise of :func:`bins_of_noise` near DC or Nyquist, beyond which bins are conjugate."""
    first, count = bins
    last = first + count - 1
    low, high = 0, max(last, -first)
    if first >= how.noise_quadratures.size:
        low, high = min(first, 2 * how.half - last), how.half
    draw_noise(address, number, low, high - low + 1, how.end_rule, room)
    for k in range(high - low + 1):
        room[2, k], room[3, k] = room[0, k], room[1, k]
    for k in range(count):
        bin_ = abs(first + k)
        sign = -1.0 if first + k < 0 or bin_ > how.half else 1.0
        bin_ = min(bin_, 2 * how.half - bin_) - low
        room[0, k], room[1, k] = room[2, bin_], sign * room[3, bin_]


@njit(cache=True, error_model="numpy", borrows=True)
def three_bins_of_noise(address, number, tables, room):
    """Noise of three adjacent bins over sigma, to rows 0 and 1 of ``room``.

    ``address``: key, draw, stream; independent numbers count from ``number``.
    """
    near, rest, across, own = tables.mixing
    a, b, draw, stream = address
    re, im = philox.normal_pair(a, b, draw, stream, number)
    re_above, im_above = philox.normal_pair(a, b, draw, stream, number + 1)
    re_below, im_below = philox.normal_pair(a, b, draw, stream, number + 2)
    room[0, 0] = near * re + across * re_above + own * re_below
    room[1, 0] = near * im + across * im_above + own * im_below
    room[0, 1], room[1, 1] = re, im
    room[0, 2], room[1, 2] = near * re + rest * re_above, near * im + rest * im_above


@njit(cache=True, error_model="numpy", borrows=True)
def look_at_all(address, at, g, how, known, seen, speckle, tables, work, peak):
    """Look at all bins of a group's echo with their noise: True, and its peak, where any crosses.

    The peak is the largest of them.
    """
    (a, b, draw), (i, s) = address, at
    sigma, beta, under_lines = known.levels[i]
    low, start = seen.low[i, s], seen.start[i, s]
    run = seen.ratios[start : start + seen.bins[i, s]]
    first, last = known.bins[i, s, FIRST, g] - low, known.bins[i, s, LAST, g] - low
    first, last = echo_of(run, first, last, beta, max(how.beside, int(known.of_bins[i, 4])))
    count, best = last - first + 1, 0
    pedestal, room = work.pedestal[:count], work.noise
    pedestal[:] = 0.0
    if under_lines > 1.0:
        magnitude = work.power[:count]
        for k in range(count):
            magnitude[k] = sigma * run[first + k]
        levels = levels_of(known.of_bins.T, i)
        pedestal_of_bins(magnitude, work.is_echo[:count], levels, pedestal)
    address_of_noise, numbers = (a, b, draw, philox.STREAM_NOISE[s]), ECHO * (1 + g)
    if speckle.number[g, s] > 0:
        bins_of_noise(address_of_noise, numbers, (low + first, count), how, room)
    else:
        draw_noise(address_of_noise, numbers, low + first, count, how.rule, room)
    for k in range(count):
        amplitude, deviation = speckled(run[first + k], speckle, g, s, k), 1.0
        if pedestal[k] > 0.0:  # fades as the lines do
            power = pedestal[k] * abs(speckled(1.0, speckle, g, s, k)) ** 2
            deviation = math.sqrt(1.0 + power)
        re, im = amplitude.real + deviation * room[0, k], amplitude.imag + deviation * room[1, k]
        room[0, k] = math.hypot(re, im)
        best = k if room[0, k] > room[0, best] else best
    middle, spread = room[0, best], known.spread[i, s, g]
    if middle < beta:
        return False
    below = room[0, best - 1] if best > 0 else 0.0
    above = room[0, best + 1] if best + 1 < count else 0.0
    delta, centre = sub_bin(below, middle, above, tables), low + first + best
    error = sub_bin_error(delta, middle / under_lines, tables)
    put(peak, centre, centre + delta, error, middle, spread, how, tables)
    return True


@njit(cache=True, error_model="numpy", borrows=True)
def put(peak, whole, fine, error, ratio, spread, how, tables):
    """Write a peak's fields, mirrored into 0..N/2 where it lies past DC or Nyquist.

    A peak of a complex record wraps from N/2 to -N/2.
    """
    end = 2 * how.half
    if how.signed:
        turned = end * math.floor((whole + how.half) / end)
        peak[WHOLE], peak[FINE] = whole - turned, fine - turned
    else:
        whole, fine = abs(whole), abs(fine)
        peak[WHOLE] = end - whole if whole > how.half else whole
        peak[FINE] = end - fine if fine > how.half else fine
    wide = spread_error(peak[FINE] - peak[WHOLE], spread, how.powers or not how.doppler, tables)
    peak[ERROR], peak[RATIO] = math.hypot(error, wide), ratio


@njit(cache=True, error_model="numpy")
def free_bin(chance, bins, barred, ends, size, signed):
    """Bin outside the groups, their neighbours and ``barred`` bins, uniformly with a probability.

    One of those from the first to the last of ``ends``; of a complex record, of N = ``size`` bins,
    as far round as they go on.
    """
    first, last = ends
    number = 0
    while number < bins.shape[1] and bins[BIN, number] >= 0:
        number += 1
    spans, free, end = np.empty((number, 2), np.int64), last - first + 1, first
    for g in range(number):  # disjoint; in rising order
        turned = (bins[BIN, g] - first) // size * size if signed else 0
        k = g
        while k > 0 and spans[k - 1, 0] > bins[FIRST, g] - turned:
            spans[k, 0], spans[k, 1] = spans[k - 1, 0], spans[k - 1, 1]
            k -= 1
        spans[k, 0], spans[k, 1] = bins[FIRST, g] - turned, bins[LAST, g] - turned
    for g in range(number):
        spans[g, 0] = max(spans[g, 0] - 1, end)
        end = max(min(spans[g, 1] + 2, last + 1), spans[g, 0])
        spans[g, 1], free = end, free - (end - spans[g, 0])
    outside = np.empty(barred.size, np.int64)  # barred bins that are searched, and in no group
    count = 0
    for k in range(barred.size):
        place = first + (barred[k] - first) % size if signed else barred[k]
        inside = place < first or place > last
        for g in range(number):
            inside |= spans[g, 0] <= place < spans[g, 1]
        if not inside:
            outside[count] = place
            count += 1
    rank = int(chance * max(free - count, 1))
    before, place = -1, first + rank
    passed = 0
    while passed != before:  # as many barred bins below it are passed over
        before, place = passed, first + rank + passed
        for g in range(number):
            if place >= spans[g, 0]:
                place += spans[g, 1] - spans[g, 0]
        passed = 0
        for k in range(count):
            passed += outside[k] <= place
    return min(place, last)
