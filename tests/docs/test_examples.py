"""Examples in docstrings run, and show what they say."""

import doctest
import importlib
import pkgutil

import pytest
import yaml
from small_flights import SCENE_MAPPING
from small_studies import small_mapping

import sweep
from sweep.spec.axes import remove_fields_on_axes

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(sweep.__path__, "sweep.")
    if "__main__" not in module.name
)
STUDY = small_mapping(
    axes={"target.range": ["500 m", "1 km"], "target.grazing_angle": ["30 deg", "90 deg"]}
)
"""Study that examples read from study.yaml."""
FLIGHT = remove_fields_on_axes({
    **SCENE_MAPPING,
    "axes": {},
    "scanners": {"three": SCENE_MAPPING["scanners"]["three"] | {"rate": "1 Hz"}},
    "draws": {"number": 1, "returns": 1},
})  # fmt: skip
"""Flight that examples read from flight.yaml."""
FINDER = doctest.DocTestFinder(exclude_empty=True)


def examples(module_name):
    """Docstrings of a module that hold examples."""
    module = importlib.import_module(module_name)
    tests = FINDER.find(module, module_name)
    for name, value in vars(module).items():
        kernel = getattr(value, "py_func", None)  # compiled functions are none to doctest
        if kernel is not None and kernel.__module__ == module_name:
            tests += FINDER.find(kernel, f"{module_name}.{name}", globs=dict(vars(module)))
    return [test for test in tests if test.examples]


def test_there_are_examples():
    assert sum(len(examples(name)) for name in MODULES) > 25


@pytest.mark.parametrize("module_name", MODULES)
def test_examples_of_a_module_show_what_they_say(module_name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY))
    (tmp_path / "flight.yaml").write_text(yaml.safe_dump(FLIGHT))
    report = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for test in examples(module_name):
        runner.run(test, out=report.append)
    assert not runner.failures, "".join(report)
