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
from sweep.model.link_budget import PROCESSING_PREFIX, LinkBudget
from sweep.model.spectrum.search_band import SearchBand, search_band_of_points

if TYPE_CHECKING:
    from sweep.model.detection.echo_detection import SegmentCorrelations
    from sweep.model.detection.look_speckle import LookSpeckle
    from sweep.model.detection.looks import Looks
    from sweep.model.detection.speckle_correlation import LineGradients


class FootprintLines(NamedTuple):
    """Ranges, Doppler ratios and amplitudes of a footprint's beamlets, relative to the axis.

    Points with equal footprints share a row of the arrays (rows, beamlets).
    """

    row_of_point: np.ndarray
    """(n,) int64: index of each point's row in the arrays of this record."""
    relative_range_offset: np.ndarray
    """(rows, beamlets): range of a beamlet minus that on the beam's axis, divided by the range on
    the axis."""
    doppler_ratio_offset: np.ndarray
    """(rows, beamlets): Doppler ratio 2 v_r / c of a beamlet minus that on the beam's axis, with
    the radial velocity v_r."""
    relative_amplitude: np.ndarray
    """(rows, beamlets): amplitude of each beamlet's beat, divided by
    :attr:`sweep.model.link_budget.EchoScales.beat_amplitude_scale`. It is the square root of the
    relative echo [1/sr]; with direct detection it is the relative echo itself."""
    adds_powers: bool = True
    """True if the powers of beamlets add, False if their amplitudes do."""
    phase_cycles: np.ndarray = np.empty((3, 0, 0))  # never written to
    """(3, rows, beamlets): random phase of each beamlet in the up, Doppler and down segment
    [cycles]; of size 0 without random phases."""
    beamlets_error: np.ndarray | float = math.nan
    """Error of the detection probability due to the number of beamlets; nan where it is not
    estimated."""

    @property
    def n_beamlets(self) -> int:
        """Number of beamlets of each footprint."""
        return self.relative_range_offset.shape[1]


class DetectionSettings(NamedTuple):
    """Detection threshold, searched bins, and rules of detection.

    Text values are shared by all points.
    """

    tnr: np.ndarray
    """Threshold-to-noise ratio: threshold divided by the standard deviation of the magnitude of a
    noise-only bin."""
    echo_bin_rule: str
    """Name of the bins that can detect an echo: ``any_bin`` of the echo, or ``peak_bin``, only its
    largest, as in [T]."""
    shot_detection_rule: str
    """Name of the segments that must detect an echo for the shot to be detected: ``both_chirps``,
    or ``any_two`` segments."""
    reported_peaks_option: str
    """Name of the peaks that a segment reports: ``all`` above the threshold, or only the
    ``strongest``."""
    two_beat_assumption: str
    """Name of the assumption that resolves two beats of unknown sign: ``far``, the range beat
    exceeds the Doppler shift; or ``fast``, the Doppler shift exceeds the range beat."""
    noise_bin_model: str
    """Name of the model of noise in adjacent bins: ``correlated``, as in a record, or
    ``independent``, as in [T]."""
    counted_bins_rule: str
    """Name of the bins that count for false alarms: ``half``, those of a real spectrum, or ``all``
    N bins of the FFT."""
    search_band: SearchBand | None = None
    """Bins of each segment that are searched, (3, n); None if all bins are searched."""
    leakage_raises_false_alarms: bool = False
    """True if leakage, the echo's signal far from its lines, can raise false alarms."""

    @classmethod
    def from_budget(cls, budget: LinkBudget, n_points: int) -> "DetectionSettings":
        """Return the settings of n points that share text parameters and array sizes.

        Parameters
        ----------
        budget : LinkBudget
            Link budget of the points.
        n_points : int
            Number of points n.
        """
        parameters = budget.parameters
        return cls(
            tnr=budget.tnr,
            echo_bin_rule=str(parameters[PROCESSING_PREFIX + "detection"]),
            shot_detection_rule=str(parameters[waveform.SHOT_DETECTION_PATH]),
            reported_peaks_option=str(parameters[waveform.REPORTED_PEAKS_PATH]),
            two_beat_assumption=str(parameters[waveform.TWO_BEAT_ASSUMPTION_PATH]),
            noise_bin_model=str(parameters[PROCESSING_PREFIX + "noise_bins"]),
            counted_bins_rule=str(parameters[PROCESSING_PREFIX + "bins_counted"]),
            search_band=search_band_of_points(parameters, budget.waveform, budget.record, n_points),
        )


class SpectrumTolerances(NamedTuple):
    """Tolerated errors of bin magnitudes and leakage in the evaluation of spectra."""

    line_error: np.ndarray
    """Tolerated error of a bin's magnitude, relative to the noise sigma, when few lines represent
    all beamlets."""
    leakage_probability: np.ndarray
    """Tolerated probability of false alarms due to leaked signal that is not evaluated."""
    leakage_floor: np.ndarray
    """Magnitude of leaked signal in a bin, relative to the noise sigma, below which the bin counts
    as noise alone. The value :data:`sweep.model.error_budget.SET_BY_TOLERANCE` means that it
    follows from ``leakage_probability``."""

    @classmethod
    def from_parameters(
        cls, parameters: Mapping[str, np.ndarray], looks: "Looks"
    ) -> "SpectrumTolerances":
        """Return the tolerances that parameters and looks determine.

        Parameters
        ----------
        parameters : mapping
            Parameters by dotted path, of which those under ``accuracy.`` are used.
        looks : Looks
            Number of records of each segment, and how they are combined
            (:class:`sweep.model.detection.looks.Looks`).

        Returns
        -------
        SpectrumTolerances
            Tolerances as scalars or (n,) arrays, like the parameters. If the powers of N looks are
            averaged, ``line_error`` is sqrt(N) times smaller than for one look.
        """
        budget = ErrorBudget.from_parameters(parameters)
        return cls(
            line_error=budget.allowed_line_error / math.sqrt(looks.n_power_averaged),
            leakage_probability=budget.allowed_leakage_error,
            leakage_floor=np.asarray(budget.leakage_floor, float),
        )


class PhaseError(NamedTuple):
    """Phase error of the echo over the record, not random, common to all lines of a footprint."""

    phase_function: Callable[..., np.ndarray]
    """Function that returns the phase error (n, m) [cycles] at positions x (m,) in the record, -1
    .. 1. It is called with x, `arguments`, and ``sign``, the segment's chirp rate relative to the
    up-chirp's."""
    arguments: dict[str, Any]
    """Arguments of ``phase_function`` by name, (n,) or scalars; a tuple has one value per segment.
    """

    def select_arguments(self, segment: int, point_indices: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arguments of ``phase_function`` for selected points in one segment.

        Parameters
        ----------
        segment : int
            Index of the segment.
        point_indices : ndarray of int
            Indices of the m selected points.

        Returns
        -------
        dict
            Arguments by name, (m,) each; scalars are repeated m times.
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
    """Number of samples before the echo arrives, and phase errors of the echo over the record."""

    n_samples_before_echo: np.ndarray | None = None
    """(3, n) int64: number of samples of each segment's record that precede the echo; None if
    echoes fill their records."""
    phase_errors: tuple[PhaseError, ...] = ()
    """Phase errors of the echo over the record; their phases are summed."""
    shots_share_phase_errors: bool = False
    """True if many shots have equal phase errors, as on a grid; False for shots of a flight."""


class LineImages(NamedTuple):
    """Amplitudes of the images of lines, which lie at the negative frequencies."""

    are_summed: bool = False
    """True if spectra of real records include the images of lines."""
    iq_image_gain: np.ndarray | float = 0.0
    """(n,): amplitude of a line's image in a complex record, relative to the line's, 0..1. Its
    cause is imbalance of I and Q."""


class PermanentLine(NamedTuple):
    """Beat of light other than the echo that is present in every record.

    Its spectrum is that of :mod:`sweep.model.spectrum.permanent_line`. Arrays are (n,) or scalars.
    """

    amplitude: np.ndarray
    """Amplitude of the beat at the ADC [V], before the receiver's poles."""
    delay: np.ndarray
    """Delay of the light relative to the local oscillator [s]."""


class EchoSpeckle(NamedTuple):
    """Developed speckle of an echo, by which its power fades; by default there is none."""

    segment_correlations: "SegmentCorrelations | None" = None
    """Correlations of the speckle between the segments of a shot; None without speckle."""
    line_deviation_bins: np.ndarray | float = 0.0
    """(3, n): standard deviation of the frequencies of an echo's lines in each segment [bins of
    fs/N, sample rate over FFT size]."""
    line_gradients: "LineGradients | None" = None
    """Changes of an echo's lines across the footprint, from which speckle is drawn; None without
    speckle."""
    look_speckle: "LookSpeckle | None" = None
    """Speckle that looks share in part; None if all looks have the same speckle or independent
    speckle. A look is one of several records of a segment."""
    phase_cycles_per_look: np.ndarray | None = None
    """(3, n): phase [cycles] by which a line of each segment advances from one look to the next;
    None without speckle."""
