"""Accuracy settings that are compared for a study.

Each overrides some fields of the study's spec.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from sweep.model.effects.catalogue import EFFECT_NAMES, EFFECTS
from sweep.model.error_budget import THESIS_BEAMLET_COUNT
from sweep.model.ground import beamlets_add_as_powers
from sweep.spec import GridSpec, SceneSpec
from sweep.spec.fields import OFF
from sweep.storage.accuracy_setting_kinds import (
    ADAPTIVE_KIND,
    ALL_EFFECTS_KIND,
    AS_WRITTEN_KIND,
    BEAMLET_LATTICE_KIND,
    BEAMLET_ROW_KIND,
    CLOSED_FORM_KIND,
    COUNTED_DETECTIONS_IN_NOISE_KIND,
    COUNTED_DETECTIONS_KIND,
    FIXED_EFFECTS_KIND,
    IMPROVED_THESIS_METHOD_KIND,
    MEAN_PD_OF_DRAWS_KIND,
    REFERENCE_KIND,
    THESIS_METHOD_KIND,
)
from sweep.tasks.studies.study_loading import AnySpec, apply_changes

TRIED_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

TRIED_BEAMLET_COUNTS = (1, 7, 19, 37, 61, 109, 223, 1015, 4009)
"""Numbers of beamlets in a hexagonal lattice that are tried as fixed numbers.

Each number fills complete shells of the lattice.
"""

TRIED_LINE_BEAMLET_COUNTS = (3, 9, 33, 163, 1234)
"""Numbers of beamlets along one line that are tried as fixed numbers.

The line follows the slope of the target, which must be a plane.
"""

FIXED_EFFECTS_LINE_BEAMLET_COUNT = 163
"""Number of beamlets along a line in settings with fixed effects; enough for the widest footprints.
"""

REFERENCE_RAYS_PER_SHOT, REFERENCE_RAYS_TOLERANCE = 8017, 3e-7
"""Settings of rays for the reference of a flight, the most accurate setting.

The first is the number of rays per shot. The second is the largest error of a shot's results by the
finite number of rays; a shot with a larger error gets more rays.
"""

FIXED_RAYS_PER_SHOT_MAX = 223
"""Largest fixed number of rays per shot that is tried.

With a larger number, one trial would take as much time as the trials of all other settings.
"""

FIXED_RAYS_PER_SHOT_MIN, RAYS_TIMES_TOLERANCE = 19, 0.1
"""Constants for the number of rays per shot in settings with fixed effects.

The number is `RAYS_TIMES_TOLERANCE` over the tolerance, but at least `FIXED_RAYS_PER_SHOT_MIN`. It
is rounded up to one of the numbers that are tried. About one shot in a thousand over open ground
then exceeds the tolerance.
"""

REFERENCE_TOLERANCE = 1e-9
"""Tolerance of the most accurate setting, to which all others are compared.

It limits the errors by lines and leakage and, over a plane, by the number of beamlets.
"""

TRIED_DRAW_COUNTS = (10, 100, 1000)

REFERENCE_DRAWS_FACTOR = 10
"""Number of draws of the reference, as a multiple of the largest number of draws that is tried."""

TRIED_DRAW_TOLERANCES = (1e-1, 3e-2, 1e-2)
"""Tolerances of pd that are tried. Draws are made at a point until the statistical error of its pd
is below the tolerance."""

_TOLERANCE_FIELD, _DRAWS_FIELD, _DRAWS_LIMIT_FIELD = (
    "accuracy.tolerance",
    "draws.number",
    "draws.limit",
)
_BEAMLETS_FIELD, _PATTERN_FIELD, _LINE_PATTERN = "footprint.beamlets", "footprint.pattern", "line"
_REFERENCE_ACCURACY_OVERRIDES = dict.fromkeys(
    ("accuracy.line_error", "accuracy.leakage_error", "accuracy.leakage_floor"), REFERENCE_TOLERANCE
)
"""Value of each accuracy field that reference settings override, by dotted path."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AccuracySetting:
    """Accuracy setting of a study: values of fields of its spec by dotted path, as in YAML.

    ``thesis_grid_options`` are options of
    :func:`sweep.model.spectrum.oversampled_grid.find_peaks_on_grid`, if this function finds the
    peaks. ``rays_error_max`` is the largest error of a flight's shot by its finite number of rays;
    a shot with a larger error gets more rays. 0 means that the spec sets it.
    """

    name: str
    kind: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    thesis_grid_options: Mapping[str, Any] = field(default_factory=dict)
    rays_error_max: float = 0.0

    @property
    def has_line_effects_only(self) -> bool:
        """True if the setting simulates only effects that the thesis's method can simulate.

        Effects of this kind move or scale a spectral line as a whole. They do not change the line
        within a record.
        """
        return self.kind in (CLOSED_FORM_KIND, THESIS_METHOD_KIND, IMPROVED_THESIS_METHOD_KIND)

    @property
    def plans_effects(self) -> bool:
        """True if the setting chooses effects point by point; its time includes the choice."""
        return not self.has_line_effects_only and self.kind not in (
            FIXED_EFFECTS_KIND,
            ALL_EFFECTS_KIND,
            REFERENCE_KIND,
        )

    @property
    def counts_detections(self) -> bool:
        """True if pd is the fraction of draws with a detection, not the mean of the draws' pd."""
        return self.kind in (COUNTED_DETECTIONS_KIND, COUNTED_DETECTIONS_IN_NOISE_KIND)

    def apply_to(self, spec: AnySpec) -> AnySpec:
        """Return a copy of a spec with the setting's values.

        SpecError is raised if the result is invalid.
        """
        return apply_changes(spec, self.overrides) if self.overrides else spec


@dataclass(frozen=True)
class SettingLadder:
    """All settings that are compared, with notes.

    The last setting is the most accurate one, the reference.
    """

    settings: tuple[AccuracySetting, ...]
    """Settings in the order in which they are shown."""
    reference_text: str
    """Description of the reference, for users."""
    notes: tuple[str, ...] = ()
    """Remarks for users on what is not tried, and why."""

    @property
    def reference(self) -> AccuracySetting:
        """Most accurate setting, to whose results the results of all others are compared."""
        return self.settings[-1]


def build_setting_ladder(spec: AnySpec) -> SettingLadder:
    """Return the accuracy settings to compare for a study, without settings with fixed effects."""
    if isinstance(spec, GridSpec) and spec.draws.has_draws:
        return _build_draw_setting_ladder(spec)
    notes: list[str] = []
    settings = [AccuracySetting(name="as written", kind=AS_WRITTEN_KIND)]
    why_beamlets_are_fixed = _fixed_beamlets_reason(spec)
    adaptive_beamlets: dict[str, Any] = {} if why_beamlets_are_fixed else {_BEAMLETS_FIELD: "auto"}
    if _is_varied_by_axis(spec, _TOLERANCE_FIELD):
        notes.append("accuracy.tolerance is on an axis: left as it is")
    else:
        settings += [
            AccuracySetting(
                name=f"auto at {tolerance:g}",
                kind=ADAPTIVE_KIND,
                overrides=adaptive_beamlets | {_TOLERANCE_FIELD: tolerance},
            )
            for tolerance in TRIED_TOLERANCES
        ]
    all_effects = _all_effects_overrides(spec)
    settings.append(
        AccuracySetting(name="all effects on", kind=ALL_EFFECTS_KIND, overrides=all_effects)
    )
    reference_overrides, reference_text, rays_error_max = (
        all_effects | _REFERENCE_ACCURACY_OVERRIDES,
        "all effects on",
        0.0,
    )
    if why_beamlets_are_fixed:
        notes.append(f"the number of beamlets is left alone: {why_beamlets_are_fixed}")
    elif isinstance(spec, SceneSpec):
        reference_overrides, rays_error_max = (
            reference_overrides | {_BEAMLETS_FIELD: REFERENCE_RAYS_PER_SHOT},
            REFERENCE_RAYS_TOLERANCE,
        )
        reference_text += f", {REFERENCE_RAYS_PER_SHOT} beamlets or more"
    else:
        reference_overrides |= adaptive_beamlets | {_TOLERANCE_FIELD: REFERENCE_TOLERANCE}
        reference_text += f", beamlets as at {REFERENCE_TOLERANCE:g}"
    settings += () if why_beamlets_are_fixed else _beamlet_settings(isinstance(spec, SceneSpec))
    settings += _thesis_settings(
        {} if why_beamlets_are_fixed else {_BEAMLETS_FIELD: THESIS_BEAMLET_COUNT},
        beamlets_add_as_powers(spec.parameters()),
    )
    settings.append(
        AccuracySetting(
            name="reference",
            kind=REFERENCE_KIND,
            overrides=reference_overrides,
            rays_error_max=rays_error_max,
        )
    )
    return SettingLadder(tuple(settings), reference_text, tuple(notes))


def add_settings_for_effect_sets(
    setting_ladder: SettingLadder,
    spec: AnySpec,
    effects_by_tolerance: Mapping[float, frozenset[str]],
    tolerances: Iterable[float] = (),
) -> SettingLadder:
    """Return the ladder with added settings that simulate the same effects at every point.

    A set of effects holds all effects that one tolerance requires at any point. Each set is tried
    with all ``tolerances`` for lines and leakage, by default with the tolerances of all sets.
    """
    tolerance_by_effects: dict[frozenset[str], float] = {}
    for tolerance, effect_names in effects_by_tolerance.items():
        tolerance_by_effects.setdefault(effect_names, tolerance)
    fixed_settings = [
        AccuracySetting(
            name=f"{len(effect_names)} effects as at {effects_tolerance:g}, to {tolerance:g}",
            kind=FIXED_EFFECTS_KIND,
            overrides={
                f"effects.{effect_name}": "on" if effect_name in effect_names else "off"
                for effect_name in EFFECT_NAMES
            }
            | _beamlets_overrides(spec, tolerance)
            | {_TOLERANCE_FIELD: tolerance},
        )
        for effect_names, effects_tolerance in tolerance_by_effects.items()
        for tolerance in tolerances or effects_by_tolerance
    ]
    all_effects_index = next(
        index
        for index, setting in enumerate(setting_ladder.settings)
        if setting.kind == ALL_EFFECTS_KIND
    )
    return replace(
        setting_ladder,
        settings=(
            *setting_ladder.settings[:all_effects_index],
            *fixed_settings,
            *setting_ladder.settings[all_effects_index:],
        ),
    )


def _beamlets_overrides(spec: AnySpec, tolerance: float) -> dict[str, Any]:
    """Return the spec fields, by dotted path, that set the beamlets in settings with fixed effects.

    The result is empty if the scene sets the number of beamlets.
    """
    if _fixed_beamlets_reason(spec):
        return {}
    if not isinstance(spec, SceneSpec):
        return {_BEAMLETS_FIELD: FIXED_EFFECTS_LINE_BEAMLET_COUNT, _PATTERN_FIELD: _LINE_PATTERN}
    rays_min = max(FIXED_RAYS_PER_SHOT_MIN, RAYS_TIMES_TOLERANCE / tolerance)
    return {
        _BEAMLETS_FIELD: min(
            next(
                (n_beamlets for n_beamlets in TRIED_BEAMLET_COUNTS if n_beamlets >= rays_min),
                FIXED_RAYS_PER_SHOT_MAX,
            ),
            FIXED_RAYS_PER_SHOT_MAX,
        )
    }


def _beamlet_settings(is_flight: bool) -> Iterator[AccuracySetting]:
    """Return settings with fixed numbers of beamlets, in a lattice or, over a plane, on a line."""
    for n_beamlets in TRIED_BEAMLET_COUNTS:
        if not is_flight or n_beamlets <= FIXED_RAYS_PER_SHOT_MAX:
            yield AccuracySetting(
                name=f"{n_beamlets} beamlets",
                kind=BEAMLET_LATTICE_KIND,
                overrides={_BEAMLETS_FIELD: n_beamlets},
            )
    for n_beamlets in () if is_flight else TRIED_LINE_BEAMLET_COUNTS:
        overrides = {_BEAMLETS_FIELD: n_beamlets, _PATTERN_FIELD: _LINE_PATTERN}
        yield AccuracySetting(
            name=f"{n_beamlets} in a line", kind=BEAMLET_ROW_KIND, overrides=overrides
        )


def _thesis_settings(overrides: Mapping[str, Any], adds_powers: bool) -> Iterator[AccuracySetting]:
    """Yield settings of the thesis's method, its improved versions and closed-form equivalents."""
    yield AccuracySetting(name="closed form, as thesis", kind=CLOSED_FORM_KIND, overrides=overrides)
    variants: list[tuple[str, str, int, dict[str, Any]]] = [
        *((THESIS_METHOD_KIND, "", log2_cells, {}) for log2_cells in (11, 12)),
        *(
            (IMPROVED_THESIS_METHOD_KIND, ", real", log2_cells, {"uses_real_transform": True})
            for log2_cells in (11, 12)
            if adds_powers
        ),
        *(
            (
                IMPROVED_THESIS_METHOD_KIND,
                ", folded",
                log2_cells,
                {"transforms_to_bins_only": True, "uses_real_transform": adds_powers},
            )
            for log2_cells in (11, 12)
        ),
        (
            IMPROVED_THESIS_METHOD_KIND,
            ", folded, degree 9",
            12,
            {"transforms_to_bins_only": True, "uses_real_transform": adds_powers, "degree": 9},
        ),
    ]
    for kind, variant_text, log2_cells, options in variants:
        grid_options = {"n_cells_min": 1 << log2_cells} | options
        yield AccuracySetting(
            name=f"thesis 2^{log2_cells}{variant_text}",
            kind=kind,
            overrides=overrides,
            thesis_grid_options=grid_options,
        )


def _build_draw_setting_ladder(spec: GridSpec) -> SettingLadder:
    """Return settings for a study with random draws.

    The reference is a setting with many more draws, made with other random numbers.
    """
    reference_draws = REFERENCE_DRAWS_FACTOR * TRIED_DRAW_COUNTS[-1]
    notes = ["errors are differences from a long run with other draws, so they are random too"]
    as_written_overrides: dict[str, Any] = {}
    for field_path, n_written in (
        (_DRAWS_FIELD, spec.draws.number),
        (_DRAWS_LIMIT_FIELD, spec.draws.limit),
    ):
        if n_written > reference_draws:
            as_written_overrides = {field_path: reference_draws}
            notes.append(f"with {reference_draws} of the {n_written} draws that are written")
    settings = [
        AccuracySetting(name="as written", kind=AS_WRITTEN_KIND, overrides=as_written_overrides)
    ]
    for tolerance in TRIED_DRAW_TOLERANCES:
        adaptive_overrides = {
            _DRAWS_FIELD: 0,
            _DRAWS_LIMIT_FIELD: reference_draws,
            _TOLERANCE_FIELD: tolerance,
        }
        settings.append(
            AccuracySetting(
                name=f"auto at {tolerance:g}", kind=ADAPTIVE_KIND, overrides=adaptive_overrides
            )
        )
    for n_draws in TRIED_DRAW_COUNTS:
        draws_overrides = {_DRAWS_FIELD: n_draws, _DRAWS_LIMIT_FIELD: 0}
        noise_overrides = draws_overrides | {"draws.method": "noise"}
        settings += [
            AccuracySetting(
                name=f"{n_draws} draws, mean", kind=MEAN_PD_OF_DRAWS_KIND, overrides=draws_overrides
            ),
            AccuracySetting(
                name=f"{n_draws} draws, counts",
                kind=COUNTED_DETECTIONS_KIND,
                overrides=draws_overrides,
            ),
            AccuracySetting(
                name=f"{n_draws} draws, noise",
                kind=COUNTED_DETECTIONS_IN_NOISE_KIND,
                overrides=noise_overrides,
            ),
        ]
    reference_overrides = {
        _DRAWS_FIELD: reference_draws,
        "seed": int(spec.seed) ^ 1,
        _DRAWS_LIMIT_FIELD: 0,
    }
    settings.append(
        AccuracySetting(
            name="reference",
            kind=REFERENCE_KIND,
            overrides=_all_effects_overrides(spec) | reference_overrides,
        )
    )
    return SettingLadder(
        tuple(settings), f"{reference_draws} other draws, all effects on", tuple(notes)
    )


def _all_effects_overrides(spec: AnySpec) -> dict[str, Any]:
    """Return the spec fields, by dotted path, whose values enable all effects.

    An effect whose absence is a rule of the scene, such as segment motion, stays off if the spec
    disables it. Random effects are enabled only if probabilities are means over draws, which they
    are not in a flight.
    """
    has_draws, modes = isinstance(spec, GridSpec) and spec.draws.has_draws, spec.effect_modes()
    return {
        f"effects.{effect.name}": "on"
        for effect in EFFECTS
        if (has_draws or not effect.is_random)
        and not (effect.defines_scene_if_off and modes[effect.name] == OFF)
    }


def _is_varied_by_axis(spec: AnySpec, path: str) -> bool:
    """Return True if an axis of the spec varies the parameter at a dotted path."""
    return any(member.path == path for axis in spec.axes for member in axis.parameters)


def _fixed_beamlets_reason(spec: AnySpec) -> str:
    """Return why the scene, not the accuracy, sets the number of beamlets; '' if it does not."""
    if spec.parameters()["footprint.phases"] == "coherent":
        return "with coherent phases it is part of the scene, as the thesis has it"
    if spec.instrument.receiver.architecture == "direct":
        return "in direct detection beamlets add as amplitudes, and are part of the scene"
    if any(
        _is_varied_by_axis(spec, path)
        for path in (_BEAMLETS_FIELD, _PATTERN_FIELD, "footprint.phases")
    ):
        return "it is on an axis"
    return ""
