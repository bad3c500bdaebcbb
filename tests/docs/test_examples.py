"""Examples in docstrings run, and show what they say."""

import doctest
import importlib
import pkgutil

import pytest

import sweep

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(sweep.__path__, "sweep.")
    if "__main__" not in module.name
)
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
    report = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for test in examples(module_name):
        runner.run(test, out=report.append)
    assert not runner.failures, "".join(report)
