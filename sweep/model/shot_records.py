"""Records that prepared shots consist of, besides those of the link budget.

:class:`sweep.model.preparation.Shots` is a composition of these records. An effect changes one of
them by ``_replace``; the defaults stand for "no such effect". Arrays are (n,) or scalars unless
stated otherwise, in SI units. Segments are in the order up, Doppler, down.

The record of the laser's line is in the module of its physics, :mod:`sweep.model.laser_line`.
"""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import waveform
from sweep.model.error_budget import ErrorBudget
from sweep.model.link_budget import PROCESSING_PREFIX
from sweep.model.spectrum.search_band import search_band_bins

if TYPE_CHECKING:
    from sweep.model.detection.echo_detection import SegmentCorrelations
    from sweep.model.detection.look_speckle import LookSpeckle
    from sweep.model.detection.looks import Looks
    from sweep.model.detection.speckle_correlation import LineGradients


class FootprintLines(NamedTuple):
    """Lines of the beamlets of a footprint, relative to the line on the beam's axis.

    Points with equal footprints share a row of the arrays (rows, beamlets).
    """

    row_of_point: np.ndarray
    """(n,) int64: row of each point."""
    relative_range_offset: np.ndarray
    """(rows, beamlets): range of each beamlet relative to the axis's, (R_b - R_0) / R_0."""
    doppler_ratio_offset: np.ndarray
    """(rows, beamlets): Doppler ratio minus the axis's, beta_b - beta_0, beta = 2 v_r / c."""
    relative_amplitude: np.ndarray
    """(rows, beamlets): square root of the relative echo; for direct detection the relative echo.
    """
    adds_powers: bool = True
    """True if beamlets add as powers, False if as amplitudes."""
    phase_cycles: np.ndarray = np.empty((3, 0, 0))  # never written to
    """(3, rows, beamlets): additional phases [cycles] in up, Doppler and down segment; or empty."""
    beamlets_error: np.ndarray | float = math.nan
    """Error of pd due to the number of beamlets; nan where it was not estimated."""

    @property
    def n_beamlets(self) -> int:
        """Number of beamlets of each footprint."""
        return self.relative_range_offset.shape[1]


class DetectionSettings(NamedTuple):
    """Threshold, searched bins, and rules of detection; words are shared by all points."""

    tnr: np.ndarray
    """Threshold-to-noise ratio."""
    echo_bins: str
    """Bins that detect an echo: ``any_bin`` of the echo, or ``peak_bin``, its largest alone, as in
    [T]."""
    shot_rule: str
    """Segments that must detect a shot: ``both_chirps``, or ``any_two`` of the segments."""
    reported_peaks: str
    """Peaks that a segment reports: ``all`` crossings, or only the ``strongest``."""
    two_beat_assumption: str
    """Assumption that resolves two beats of real records: ``far`` or ``fast``."""
    noise_bins: str
    """Noise of adjacent bins: ``correlated``, as the record makes it, or ``independent``, as in
    [T]."""
    bins_counted: str
    """Bins that count for false alarms: ``half``, those of the spectrum; ``all`` N of the FFT."""
    search_band: np.ndarray | None = None
    """(3, 2, n) int64: first bin and number of bins of the search band; None if all bins are
    searched."""
    includes_leakage: bool = False
    """True if bins next to the detection are searched for groups of leaked signal."""

    @classmethod
    def from_parameters(
        cls, parameters: Mapping[str, np.ndarray], tnr: np.ndarray, n_points: int
    ) -> "DetectionSettings":
        """Return the settings of n points of one category.

        Parameters
        ----------
        parameters : mapping
            Parameters by dotted path, as arrays.
        tnr : ndarray
            Threshold-to-noise ratio.
        n_points : int
            Number of points n.
        """
        return cls(
            tnr=tnr,
            echo_bins=str(parameters[PROCESSING_PREFIX + "detection"]),
            shot_rule=str(parameters[waveform.SHOT_DETECTION_PATH]),
            reported_peaks=str(parameters[waveform.PEAKS_PATH]),
            two_beat_assumption=str(parameters[waveform.TWO_BEAT_ASSUMPTION_PATH]),
            noise_bins=str(parameters[PROCESSING_PREFIX + "noise_bins"]),
            bins_counted=str(parameters[PROCESSING_PREFIX + "bins_counted"]),
            search_band=search_band_bins(parameters, n_points),
        )


class ErrorTolerances(NamedTuple):
    """Errors that the evaluation of spectra may make."""

    line_error: np.ndarray
    """Error of a bin [sigma] due to few lines in place of one for each beamlet."""
    leakage_probability: np.ndarray
    """Probability of leakage, over all bins far from the lines, that may be neglected."""
    leakage_floor: np.ndarray
    """Leaked signal [sigma] below which a bin counts as noise alone;
    :data:`sweep.model.error_budget.AUTOMATIC` if it follows from the probability."""

    @classmethod
    def from_parameters(
        cls, parameters: Mapping[str, np.ndarray], looks: "Looks"
    ) -> "ErrorTolerances":
        """Return the tolerances for parameters by dotted path and the number of looks."""
        budget = ErrorBudget.from_parameters(parameters)
        return cls(
            line_error=budget.allowed_line_error / math.sqrt(looks.n_power_averaged),
            leakage_probability=budget.allowed_leakage,
            leakage_floor=np.asarray(budget.leakage_floor, float),
        )


class PhaseError(NamedTuple):
    """Deterministic phase error over the record, common to the lines of a footprint."""

    phase: Callable[..., np.ndarray]
    """Function of positions x (m,) in the record, ``sign`` and `arguments`; returns the phase
    [cycles], (n, m)."""
    arguments: dict[str, Any]
    """Arguments by name, (n,) or scalars; a tuple holds one for each segment."""

    def select_arguments(self, segment: int, point_indices: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arguments of selected points in one segment, (points,) each.

        Parameters
        ----------
        segment : int
            Index of the segment.
        point_indices : ndarray of int
            Selected points.
        """
        selected = {}
        for name, value in self.arguments.items():
            value = value[segment] if isinstance(value, tuple) else value
            selected[name] = (
                value[point_indices]
                if np.ndim(value)
                else np.full(point_indices.size, float(value))
            )
        return selected


class EchoRecord(NamedTuple):
    """Samples of a segment's record before the echo, and phase errors of the echo."""

    n_samples_before: np.ndarray | None = None
    """(3, n) int64: samples of the record before the echo arrives, up to all; None where echoes
    fill records."""
    phase_errors: tuple[PhaseError, ...] = ()
    """Deterministic phase errors, which add."""
    shares_phase_errors: bool = False
    """True if many shots have equal phase errors, as on a grid; False for those of a flight."""


class LineImages(NamedTuple):
    """Images of lines at their negative frequencies."""

    are_summed: bool = False
    """True if a real record's images are summed with its lines."""
    iq_gain: np.ndarray | float = 0.0
    """(n,): amplitude, 0..1, of the image of a line in a complex record, due to imbalance of I and
    Q."""


class PermanentLine(NamedTuple):
    """Beat of light that is in every record (:mod:`sweep.model.spectrum.permanent_line`).

    Arrays are (n,) or scalars.
    """

    amplitude: np.ndarray
    """Amplitude of the beat at the ADC [V], before the receiver's poles."""
    delay: np.ndarray
    """Delay of the light against the local oscillator [s]."""


class EchoSpeckle(NamedTuple):
    """Developed speckle of an echo, in which it fades; none by default."""

    segment_correlations: "SegmentCorrelations | None" = None
    """Correlations between segments of echoes in developed speckle; None without speckle."""
    line_deviation_bins: np.ndarray | float = 0.0
    """(3, n): standard deviation of the lines of an echo [bins of fs/N]."""
    line_gradients: "LineGradients | None" = None
    """Gradients across the footprint of the lines of an echo, for draws of speckle."""
    look_speckle: "LookSpeckle | None" = None
    """Speckle of looks that share it partly; None if looks have equal or independent speckle."""
    phase_cycles_per_look: np.ndarray | None = None
    """(3, n): phase [cycles] by which a line turns from one look to the next."""
