"""Provenance of a study: its fields, effects simulated, accuracy, citation and reproduction."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import dask
import numpy as np
import pandas
import xarray as xr
import yaml

from sweep.analysis import labels
from sweep.model.effects.catalogue import EFFECTS
from sweep.report.page import Section, Table, Text
from sweep.spec import SceneSpec, Spec
from sweep.spec.fields import parameter_rules

Declared = Spec | SceneSpec


def fields(spec: Declared) -> Table:
    """Every field of the spec with what it means."""
    rules = parameter_rules()
    written = spec.to_yaml_mapping()
    rows = [
        (path, _shown(value), rules[path].about if path in rules else "")
        for path, value in _leaves(written)
        if path.split(".")[0] not in ("title", "question", "figures", "axes", "effects")
    ]
    frame = pandas.DataFrame(rows, columns=["field", "value", "meaning"])
    return Table("Every field", ["Defaults included."], frame, "fields")


def _leaves(written: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in written.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{path}.")
        else:
            yield path, value


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 120 else f"{text[:117]}..."


def axes(spec: Declared) -> Table | None:
    """Axes with their values."""
    rows = [
        (axis.name, member.path, axis.size, _values(member.display, member.units))
        for axis in spec.axes
        for member in axis.members
    ]
    if not rows:
        return None
    frame = pandas.DataFrame(rows, columns=["axis", "parameter", "values", "which"])
    return Table("What varies", [], frame, "axes")


def _values(values: np.ndarray, units: str) -> str:
    told = [labels.quantity(v, units) for v in values[:4]]
    if len(values) > 5:
        return ", ".join([*told[:2], "...", labels.quantity(values[-1], units)])
    return ", ".join(labels.quantity(v, units) for v in values)


def effects(arrays: Sequence[xr.DataArray], modes: Mapping[str, str]) -> Table:
    """Effects that were simulated: at how many points, and in which part of the study."""
    counts, flags = [], []
    for array in arrays:
        counts.append([((array.data >> k) & 1).sum() for k in range(len(EFFECTS))])
        flags.append({dim: _any(array, dim) for dim in array.dims})
    counts, flags = dask.compute(counts, flags)
    size = sum(array.size for array in arrays)
    rows = []
    for k, effect in enumerate(EFFECTS):
        number = sum(int(own[k]) for own in counts)
        spans = [
            _span(array[dim].coords, (np.asarray(along) >> k) & 1 > 0)
            for array, own in zip(arrays, flags, strict=True)
            for dim, along in own.items()
        ]
        where = ", ".join(dict.fromkeys(filter(None, spans))) if number < size else "everywhere"
        rows.append(
            (effect.name.replace("_", " "), modes[effect.name], round(100 * number / size, 2),
             where, effect.about)
        )  # fmt: skip
    rows.sort(key=lambda row: -row[2])
    names = ["effect", "asked", "% of points", "within", "what it is"]
    caption = [
        "Asked: auto simulates an effect where leaving it out could change a probability, or the "
        "magnitude of a bin, by more than the tolerance allows.",
        "Within: the smallest part of the study that holds all points with the effect.",
    ]
    return Table("Effects", caption, pandas.DataFrame(rows, columns=names), "effects")


def _any(array: xr.DataArray, dim: Any) -> Any:
    """Flags that occur anywhere at each place along a dimension, chunk by chunk."""

    def over(chunk: np.ndarray, axis: tuple[int, ...], keepdims: bool) -> np.ndarray:
        return np.asarray(np.bitwise_or.reduce(chunk, axis=axis, keepdims=keepdims))  # type: ignore[call-overload]

    others = tuple(i for i, other in enumerate(array.dims) if other != dim)
    if not others:
        return array.data
    return dask.array.reduction(
        array.data, chunk=over, aggregate=over, axis=others, dtype=array.dtype
    )


def _span(coordinates: Any, present: np.ndarray) -> str:
    """Ends of the coordinates along a dimension between which an effect is present."""
    told = []
    for name, coordinate in coordinates.items():
        if coordinate.ndim != 1 or present.all() or not present.any():
            continue
        if labels.is_words(coordinate.values):
            continue
        chosen = coordinate.values[present]
        units = coordinate.attrs.get("units", "")
        ends = [labels.quantity(v, units) for v in (chosen.min(), chosen.max())]
        told.append(f"{labels.coordinate(str(name))} {ends[0]} to {ends[1]}")
    return ", ".join(told)


def accuracy(dataset: xr.Dataset, spec: Declared) -> list[str]:
    """Accuracy of the results, in sentences."""
    tolerance = spec.accuracy.tolerance
    told = [
        f"Asked for: no probability of detection off by more than {tolerance:g}"
        + (f", with a confidence of {spec.accuracy.confidence:g}" if "n_draws" in dataset else "")
        + "."
    ]
    if "effects_error" in dataset:
        told.append(
            "What was left out changes a probability by "
            f"{float(dataset['effects_error'].max()):.2g} at the most, at any point."
        )
    left = float(dataset["beamlets_error"].max()) if "beamlets_error" in dataset else 0.0
    if left > 0:
        told.append(f"More beamlets would change one by {left:.2g} at the most.")
    if "n_draws" in dataset:
        missed = dataset["accuracy_missed"]
        known = int(missed.notnull().sum())
        met = int((missed <= 0).sum())
        told.append(
            f"Drawn to that accuracy at {met:,} of {known:,} points; the largest half-width of "
            f"pd_shot is {float(dataset['pd_shot_half_width'].max()):.2g}, and "
            f"{int(dataset['n_draws'].where(dataset['n_draws'] > 0).sum()):,} draws were made."
        )
    return told


def reproduction(attributes: Mapping[Any, Any], spec: Declared, store: str) -> Section:
    """Citation of the study, and commands that make it again."""
    software = attributes["software"]
    version = software["sweep"]
    year = str(attributes.get("finished") or attributes.get("started") or "")[:4]
    identity = f"study {attributes['study_id']}, model {attributes['model_version']}"
    cite = (
        f"{attributes['title']}. Simulated with sweep {version}, {identity}"
        f"{f', {year}' if year else ''}."
    )
    bibtex = (
        f"@misc{{sweep-{attributes['study_id'][:8]},\n"
        f"  title = {{{{{attributes['title']}}}}},\n"
        f"  howpublished = {{Simulated with sweep {version}}},\n"
        f"  note = {{{identity}}},\n" + (f"  year = {{{year}}},\n" if year else "") + "}"
    )
    text = yaml.safe_dump(spec.to_yaml_mapping(), sort_keys=False, allow_unicode=True, width=100)
    commands = f"sweep run study.yaml --store {store}\nsweep figures {store}\nsweep report {store}"
    versions = ", ".join(f"{name} {number}" for name, number in software.items())
    words = [
        f"Made with {versions}, on a processor {attributes['processor']}. The same spec, seed and "
        "versions give the same numbers, bit for bit, on any number of workers."
    ]
    return Section(
        "reproduce",
        "Cite and reproduce",
        words,
        [
            Text("Citation", [], cite),
            Text("BibTeX", [], bibtex, "study.bib"),
            Text("Commands", ["With the spec below saved as study.yaml."], commands),
            Text("Spec", ["As it was computed, every default written out."], text, "study.yaml"),
        ],
    )
