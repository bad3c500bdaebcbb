"""Some eighty random specs, valid and spoilt; `make fuzz` looks at thousands."""

import os
import resource

import pytest
from command_checks import check_plan_command
from corrupted_specs import GARBAGE_TEXTS, ODD_VALUES, CorruptedSpec, corrupted_specs, to_yaml
from fast_plans import fast_planning
from flight_checks import check_flight
from flight_strategies import SECTION_STRATEGIES as FLIGHT_PARTS
from flight_strategies import flights
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from study_checks import check_study
from study_strategies import SECTION_STRATEGIES, studies
from value_strategies import value_strategy

from sweep.spec import GridSpec, SceneSpec
from sweep.spec.fields import reachable_models, rule_of_field
from sweep.spec.rules import CustomRule, FilePathRule, NumericRule, Rule
from sweep.units import QuantityError

MANY = int(os.environ.get("FUZZ", 0))
"""Specs of each kind that `make fuzz` asks for, by the seed of the command line."""
MEMORY_MAX_BYTES = 8 << 30
"""Address space of `make fuzz` [bytes]: what asks for more has failed."""
FEW = settings(
    derandomize=not MANY, deadline=None, database=None, suppress_health_check=list(HealthCheck),
    phases=[Phase.generate, *[Phase.shrink] * bool(MANY)], print_blob=bool(MANY),
)  # fmt: skip


@pytest.fixture(autouse=True)
def quick():
    if MANY:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
    with fast_planning():
        yield


@pytest.fixture(scope="module")
def file(folder):
    return folder / "now.yaml"


@settings(FEW, max_examples=MANY * 2 // 3 or 24)
@given(mapping=studies())
def test_a_study_is_computed_to_sane_numbers_or_refused_in_words(file, mapping):
    file.write_text(to_yaml(mapping), encoding="utf-8")
    check_study(file)


def test_a_flight_is_computed_to_sane_points_or_refused_in_words(folder):
    @settings(FEW, max_examples=MANY // 3 or 5)
    @given(mapping=flights(folder))
    def holds(mapping):
        (folder / "now.yaml").write_text(to_yaml(mapping), encoding="utf-8")
        check_flight(folder / "now.yaml")

    holds()


def test_a_spoilt_spec_ends_with_exit_code_2_and_plain_words(folder):
    @settings(FEW, max_examples=MANY or 50)
    @given(wrong=corrupted_specs(st.one_of(studies(), flights(folder))))
    def holds(wrong):
        check_plan_command(folder / "spoilt.yaml", wrong)

    holds()


@pytest.mark.parametrize("text", GARBAGE_TEXTS)
def test_another_text_in_a_specs_place_is_refused_in_words(file, text):
    assert check_plan_command(file, CorruptedSpec(text, "another text")).refusals


def _all_fields():
    for model in reachable_models(GridSpec, SceneSpec):
        for name, field in model.model_fields.items():
            rule = rule_of_field(field)
            if rule is not None:
                yield pytest.param(model, name, rule, id=f"{model.__name__}.{name}")


ALL_FIELDS = list(_all_fields())


@pytest.mark.parametrize(("model", "name", "rule"), ALL_FIELDS)
def test_every_number_has_a_smallest_and_a_largest_value(model, name, rule):
    """What has no bounds ends in overflows and nans: the fuzz goes to both ends of every field."""
    number = getattr(rule, "element_rule", rule)
    if isinstance(number, NumericRule):
        assert (number.at_most or number.below) and (number.at_least or number.above)


@pytest.mark.parametrize(("model", "name", "rule"), ALL_FIELDS)
def test_every_field_refuses_odd_values_in_words_or_takes_them(model, name, rule):
    for text in ODD_VALUES:
        try:
            rule.read(text)
        except QuantityError as error:
            assert error.rule and "<" not in error.rule


@pytest.mark.parametrize(("model", "name", "rule"), ALL_FIELDS)
def test_every_rule_has_a_strategy_all_of_whose_values_it_takes(model, name, rule: Rule):
    if isinstance(rule, FilePathRule):
        assert f"{model.__name__}.{name}" in FLIGHT_PARTS.file_by_field
        return
    if isinstance(rule, CustomRule):  # figures, which the fuzz leaves alone, and axes
        return

    @settings(FEW, max_examples=6)
    @given(value_strategy(rule, 300.0))
    def holds(mapping):
        rule.read(mapping)

    holds()


def test_tightened_bounds_are_those_of_fields_that_there_are():
    """A field that is renamed is no longer held to a small cost: this says so first."""
    known = {
        f"{m.__name__}.{n}" for m in reachable_models(GridSpec, SceneSpec) for n in m.model_fields
    }
    bases = {
        f"{base.__name__}.{n}"
        for m in reachable_models(GridSpec, SceneSpec)
        for base in m.__mro__
        for n in getattr(base, "model_fields", ())
    }
    for parts in (SECTION_STRATEGIES, FLIGHT_PARTS):
        assert (
            set(parts.tighter_bounds) | parts.costly_defaults | set(parts.file_by_field)
            <= known | bases
        )
