"""Export of drawn spectra of one point, with the noise level and the true quantities."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import option_text
from sweep.model.detection.detectors import cached_window_samples
from sweep.model.detection.looks import LOOKS_NUMBER_PATH, Looks
from sweep.model.effects.catalogue import EFFECTS, PARAMETER_DEFAULTS
from sweep.model.waveform import SEGMENT_NAMES
from sweep.storage.locations import can_create_store, write_path_atomically
from sweep.storage.size_checks import SingleWriterLocalStore
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.grid_study import random_keys_of_points

if TYPE_CHECKING:
    import xarray as xr

    from sweep.model.preparation import Shots
    from sweep.spec import GridSpec

SPECTRA_FILE_SUFFIXES = (".zarr", ".npz")
"""Suffixes of the formats to which spectra are exported."""


def draw_point_spectra(
    spec: GridSpec,
    parameters: Mapping[str, float | int | str],
    *,
    n_draws: int,
    first_draw: int = 0,
) -> xr.Dataset:
    """Draw random spectra of one point of a study, with the random numbers of the study.

    Parameters
    ----------
    spec
        Study whose effects and seed are used. It need not draw whole spectra itself.
    parameters
        SI values of all parameters of the point, by path.
    n_draws, first_draw
        Number of draws, and number of the first one.

    Returns
    -------
    xarray.Dataset
        Complex ``spectrum`` (draw, segment, frequency), ``signal`` without noise, and the true
        quantities. All effects are simulated that are not off and not absent from the point.
    """
    from sweep.model.sampling.noisy_spectra import (
        draw_bin_speckle,
        draw_noise_spectra,
        draw_signal_spectra,
        noiseless_signal,
    )
    from sweep.model.sampling.realisations import iter_realisations, random_effects

    if Looks.from_parameters(parameters).number > 1:
        raise ValueError(
            f"a file of spectra holds one record of each segment, and {LOOKS_NUMBER_PATH} takes "
            f"{Looks.from_parameters(parameters).number}: export a point of one look"
        )
    effect_modes, key = spec.effect_modes(), random_keys_of_points(spec, parameters, 1)
    arrays = {
        path: np.asarray(value) for path, value in (PARAMETER_DEFAULTS | dict(parameters)).items()
    }
    effect_names = [
        e.name for e in EFFECTS if effect_modes[e.name] != "off" and not e.is_absent(arrays).all()
    ]
    draw_numbers, has_random_effects = (
        np.arange(first_draw, first_draw + n_draws),
        bool(random_effects(effect_names)),
    )
    realisations = iter_realisations(
        parameters,
        effect_names,
        keys=key,
        first_draw=first_draw,
        draws=n_draws if has_random_effects else 1,
    )
    drawn_spectra, signals_by_draw, shots = [], [], None
    for realisation in realisations:
        shots = realisation.shots
        for shot, draw in enumerate(realisation.draw_numbers):
            segments = list(map(int, np.flatnonzero(shots.has_segment)))
            signals = [noiseless_signal(shots, shot, segment) for segment in segments]
            draws = np.array([draw]) if has_random_effects else draw_numbers
            drawn_spectra.append(np.stack([
                draw_signal_spectra(shots, shot, segment, signal, key=key[0], draws=draws)
                * draw_bin_speckle(shots, shot, segment, signal, key=key[0], draws=draws)
                + draw_noise_spectra(shots, shot, segment, key=key[0], draws=draws)
                for segment, signal in zip(segments, signals, strict=True)
            ], axis=1))  # fmt: skip
            signals_by_draw.append(signals)
    assert shots is not None  # at least one draw is made
    return _spectra_dataset(
        spec, shots, np.concatenate(drawn_spectra), signals_by_draw, draw_numbers
    )


VARIABLE_ATTRIBUTES = {
    "spectrum": ("V", "X[k] with noise, no 1/N"),
    "signal": ("V", "X[k] without noise"),
    "noise_power": ("V^2", "mean |X|^2 of a bin of noise alone"),
    "threshold": ("V", "fixed threshold on |X|"),
    "window": ("1", "samples of the window"),
    "true_frequency": ("Hz", "place of the signal's peak between bins"),
    "first_bin": ("1", "first bin that the signal occupies"),
    "last_bin": ("1", "last bin that the signal occupies"),
    "cnr": ("1", "signal over noise in the record"),
    "line_frequency": ("Hz", "where each beamlet's line appears"),
    "line_amplitude": ("V", "amplitude of each beamlet's beat at the ADC"),
    "range": ("m", "true range"),
    "radial_velocity": ("m s-1", "true radial velocity, positive when closing"),
    "draw": ("1", "number of the draw"),
    "segment": ("", "segment of the waveform"),
    "frequency": ("Hz", "frequency of the bin"),
}
"""Unit and description of each exported variable, by the variable's name."""


def _spectra_dataset(
    spec: GridSpec,
    shots: Shots,
    spectrum: np.ndarray,
    signals_by_draw: list[list[Any]],
    draw_numbers: np.ndarray,
) -> xr.Dataset:
    """Return an xarray Dataset of drawn spectra, signals without noise, and true quantities."""
    import xarray as xr

    bin_width = float(shots.sample_rate[0]) / shots.fft_size
    segment_names = [
        name for name, is_there in zip(SEGMENT_NAMES, shots.has_segment, strict=True) if is_there
    ]
    signal_dims = ("draw", "segment") if len(signals_by_draw) > 1 else ("segment",)

    def signal_values(name: str) -> np.ndarray:
        values = np.array(
            [[getattr(signal, name) for signal in signals] for signals in signals_by_draw]
        )
        return values if len(signals_by_draw) > 1 else values[0]

    line_frequency, line_amplitude = _beamlet_lines(shots, bin_width)
    variable_contents: dict[str, tuple[tuple[str, ...], Any]] = {
        "spectrum": (("draw", "segment", "frequency"), spectrum),
        "signal": ((*signal_dims, "frequency"), signal_values("spectrum")),
        "noise_power": ((), float(shots.window.energy * shots.noise_variance[-1])),
        "threshold": ((), float(shots.threshold[-1])),
        "window": (("sample",), cached_window_samples(shots.window)),
        "true_frequency": (signal_dims, signal_values("frequency_bins") * bin_width),
        "first_bin": (signal_dims, signal_values("first_bin")),
        "last_bin": (signal_dims, signal_values("last_bin")),
        "cnr": (signal_dims, signal_values("cnr")),
        "line_frequency": (("segment", "line"), line_frequency),
        "line_amplitude": (("line",), line_amplitude),
        "range": ((), float(shots.range[-1])),
        "radial_velocity": ((), float(shots.target.radial_velocity[-1])),
        "draw": (("draw",), draw_numbers),
        "segment": (("segment",), np.array(segment_names, dtype=object)),
        "frequency": (("frequency",), shots.all_signed_bins * bin_width),
    }
    variables = {
        name: (
            dims,
            values,
            dict(zip(("units", "long_name"), VARIABLE_ATTRIBUTES[name], strict=True)),
        )
        for name, (dims, values) in variable_contents.items()
    }
    return xr.Dataset(
        variables,
        attrs={
            "title": spec.title, "spec": spec.to_json(), "fft_size": shots.fft_size,
            "sample_rate": float(shots.sample_rate[0]), "window_name": shots.window.name,
        },
    )  # fmt: skip


def _beamlet_lines(shots: Shots, bin_width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies [Hz] and amplitudes [V] of the beamlets' spectral lines.

    Both arrays have the shape (segments, lines).
    """
    from sweep.model.pointcloud.returns import beamlet_line_positions

    line_bins = beamlet_line_positions(shots)[-1, list(shots.has_segment)]
    scale = np.broadcast_to(shots.echo_scales.beat_amplitude_scale, shots.size)[-1]
    return line_bins * bin_width, shots.footprint.relative_amplitude[
        int(shots.footprint.row_of_point[-1])
    ] * scale


def write_spectra(dataset: xr.Dataset, path: Path, *, overwrite: bool = False) -> None:
    """Write spectra to a Zarr store or a NumPy archive, depending on the suffix of the path.

    Parameters
    ----------
    dataset
        Spectra of :func:`draw_point_spectra`.
    path
        Path that ends in .zarr or .npz.
    overwrite
        Whether to replace a file of spectra at the path; no other file is replaced.

    Raises
    ------
    StoreError
        For another suffix, or if something exists at the path.
    """
    if path.suffix not in SPECTRA_FILE_SUFFIXES:
        raise StoreError(f"{path} ends in neither {' nor '.join(SPECTRA_FILE_SUFFIXES)}")
    if not can_create_store(path):
        if not overwrite:
            raise StoreError(
                f"{path} is there already: {option_text('overwrite')} puts the new one in its place"
            )
        if not _is_spectra_file(path):
            raise StoreError(f"{path} holds no spectra of `sweep spectra`: name another file")
    with write_path_atomically(path.resolve(), replace=overwrite) as draft_path:
        if path.suffix == ".zarr":
            dataset.to_zarr(
                SingleWriterLocalStore(draft_path), mode="w", zarr_format=3, consolidated=False
            )
            return
        arrays = {str(name): value.values for name, value in dataset.variables.items()}
        arrays["segment"] = arrays["segment"].astype("U")  # objects would need pickle
        with open(draft_path, "wb") as file:  # given a name, NumPy would add a suffix
            np.savez_compressed(file, **arrays, attributes=np.array(json.dumps(dataset.attrs)))  # type: ignore[arg-type]


def _is_spectra_file(path: Path) -> bool:
    """Return True if a file or folder contains the variables that `write_spectra` writes."""
    expected_names = {*VARIABLE_ATTRIBUTES, "attributes"}
    try:
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                return {name.removesuffix(".npy") for name in archive.namelist()} == expected_names
        array_names = {entry.name for entry in path.iterdir() if (entry / "zarr.json").is_file()}
        return array_names == expected_names - {"attributes"}
    except (OSError, zipfile.BadZipFile):
        return False
