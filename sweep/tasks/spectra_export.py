"""Spectra of a shot, draw by draw, for code of one's own: with noise, its level, and the truth."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import option
from sweep.model.detectors import taper
from sweep.model.effects.catalogue import DEFAULTS, EFFECTS
from sweep.model.looks import NUMBER, Looks
from sweep.storage.chunks import DraftFiles
from sweep.storage.locations import draft, is_free
from sweep.tasks.grid_study import draw_keys
from sweep.tasks.progress import StoreError

if TYPE_CHECKING:
    import xarray as xr

    from sweep.model.preparation import Shots
    from sweep.spec import Spec

SEGMENTS = ("up", "doppler", "down")
SUFFIXES = (".zarr", ".npz")


def spectra(
    spec: Spec, parameters: Mapping[str, float | int | str], *, draws: int, first: int = 0
) -> xr.Dataset:
    """Spectra of one point of a study, by the SI values of its parameters, as the study draws them.

    Complex ``spectrum`` (draw, segment, frequency), ``signal`` without noise, and what is true.
    Every effect is there that is not off and that the point has anything of. The draws begin at
    ``first``.
    """
    from sweep.model.noisy_spectra import drawn_of, noise_of, signal_of, speckle_of
    from sweep.model.realisations import random_effects, realise

    if Looks.of(parameters).number > 1:
        raise ValueError(
            f"a file of spectra holds one record of each segment, and {NUMBER} takes "
            f"{Looks.of(parameters).number}: export a point of one look"
        )
    modes, key = spec.modes(), draw_keys(spec, parameters, 1)
    arrays = {path: np.asarray(value) for path, value in (DEFAULTS | dict(parameters)).items()}
    effects = [e.name for e in EFFECTS if modes[e.name] != "off" and not e.absent(arrays).all()]
    numbers, random = np.arange(first, first + draws), bool(random_effects(effects))
    stretches = realise(
        parameters, effects, keys=key, first_draw=first, draws=draws if random else 1
    )
    drawn, found, shots = [], [], None
    for stretch in stretches:
        shots = stretch.shots
        for i, draw in enumerate(stretch.draw):
            there = list(map(int, np.flatnonzero(shots.segments)))
            signals = [signal_of(shots, i, s) for s in there]
            chosen = np.array([draw]) if random else numbers
            drawn.append(np.stack([
                drawn_of(shots, i, s, signal, key=key[0], draws=chosen)
                * speckle_of(shots, i, s, signal, key=key[0], draws=chosen)
                + noise_of(shots, i, s, key=key[0], draws=chosen)
                for s, signal in zip(there, signals, strict=True)
            ], axis=1))  # fmt: skip
            found.append(signals)
    assert shots is not None  # one draw is asked for at least
    return _dataset(spec, shots, np.concatenate(drawn), found, numbers)


TOLD = {
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
"""Units and meaning of what is written."""


def _dataset(
    spec: Spec, shots: Shots, spectrum: np.ndarray, found: list[list[Any]], numbers: np.ndarray
) -> xr.Dataset:
    import xarray as xr

    width = float(shots.sample_rate[0]) / shots.fft_size
    there = [name for name, is_there in zip(SEGMENTS, shots.segments, strict=True) if is_there]
    of_signal = ("draw", "segment") if len(found) > 1 else ("segment",)

    def each(name: str) -> np.ndarray:
        values = np.array([[getattr(signal, name) for signal in signals] for signals in found])
        return values if len(found) > 1 else values[0]

    lines, amplitude = _lines(shots, width)
    content: dict[str, tuple[tuple[str, ...], Any]] = {
        "spectrum": (("draw", "segment", "frequency"), spectrum),
        "signal": ((*of_signal, "frequency"), each("spectrum")),
        "noise_power": ((), float(shots.window.energy * shots.noise_variance[-1])),
        "threshold": ((), float(shots.threshold[-1])),
        "window": (("sample",), taper(shots.window)),
        "true_frequency": (of_signal, each("frequency") * width),
        "first_bin": (of_signal, each("first")),
        "last_bin": (of_signal, each("last")),
        "cnr": (of_signal, each("cnr")),
        "line_frequency": (("segment", "line"), lines),
        "line_amplitude": (("line",), amplitude),
        "range": ((), float(shots.range[-1])),
        "radial_velocity": ((), float(shots.radial_velocity[-1])),
        "draw": (("draw",), numbers),
        "segment": (("segment",), np.array(there, dtype=object)),
        "frequency": (("frequency",), shots.signed_bins * width),
    }
    variables = {
        name: (dims, values, dict(zip(("units", "long_name"), TOLD[name], strict=True)))
        for name, (dims, values) in content.items()
    }
    return xr.Dataset(
        variables,
        attrs={
            "title": spec.title, "spec": spec.to_json(), "fft_size": shots.fft_size,
            "sample_rate": float(shots.sample_rate[0]), "window_name": shots.window.name,
        },
    )  # fmt: skip


def _lines(shots: Shots, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies of the beamlets' lines [Hz], (segments, lines), and their amplitudes [V]."""
    from sweep.model.returns import beamlet_lines

    lines = beamlet_lines(shots)[-1, list(shots.segments)]
    scale = np.broadcast_to(shots.beat_scale, shots.size)[-1]
    return lines * width, shots.amplitude[int(shots.row[-1])] * scale


def write(dataset: xr.Dataset, path: Path, *, overwrite: bool = False) -> None:
    """Write spectra as a Zarr store or as a numpy archive, by the path's suffix.

    StoreError for another suffix, or something in the way: with `overwrite`, what is no such
    file.
    """
    if path.suffix not in SUFFIXES:
        raise StoreError(f"{path} ends in neither {' nor '.join(SUFFIXES)}")
    if not is_free(path):
        if not overwrite:
            raise StoreError(
                f"{path} is there already: {option('overwrite')} puts the new one in its place"
            )
        if not _is_written_here(path):
            raise StoreError(f"{path} holds no spectra of `sweep spectra`: name another file")
    with draft(path.resolve(), replace=overwrite) as made:
        if path.suffix == ".zarr":
            dataset.to_zarr(DraftFiles(made), mode="w", zarr_format=3, consolidated=False)
            return
        arrays = {str(name): value.values for name, value in dataset.variables.items()}
        arrays["segment"] = arrays["segment"].astype("U")  # objects would have to be unpickled
        with open(made, "wb") as file:  # by a name, numpy would give it a suffix
            np.savez_compressed(file, **arrays, attributes=np.array(json.dumps(dataset.attrs)))  # type: ignore[arg-type]


def _is_written_here(path: Path) -> bool:
    """Tell whether a file or folder is what `write` makes, by the names in it."""
    names = {*TOLD, "attributes"}
    try:
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                return {name.removesuffix(".npy") for name in archive.namelist()} == names
        found = {child.name for child in path.iterdir() if (child / "zarr.json").is_file()}
        return found == names - {"attributes"}
    except (OSError, zipfile.BadZipFile):
        return False
