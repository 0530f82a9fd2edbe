"""Texts and classes of errors."""

import pickle
import re
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import FunctionType

import pytest

from hilctl.base import errors
from hilctl.base.errors import ConfigError, ConfigProblem, DeviceError, HilctlError, InputError


@pytest.mark.parametrize(("problem", "text"), [
    (ConfigProblem("a.yaml:3", "limits.slew", "must be > 0"), "a.yaml:3: limits.slew: must be > 0"),
    (ConfigProblem("a.yaml", "", "is empty"), "a.yaml: is empty"),
    (ConfigProblem("a.yaml:3", "x", "must be > 0", "-1", "in A"),
     "a.yaml:3: x: must be > 0, got -1 (in A)"),
])  # fmt: skip
def test_a_problem_has_place_key_rule_value_and_hint(problem, text):
    assert str(problem) == text


def test_all_problems_of_a_file_are_one_error():
    problems = [ConfigProblem("a", "x", "one"), ConfigProblem("b", "y", "two")]
    error = ConfigError(iter(problems))
    assert str(error) == "a: x: one\nb: y: two"
    assert error.problems == tuple(problems)


def test_input_errors_and_run_errors_are_separate():
    """Exit codes are by these two: bad input ends with 2, a run that failed with 3."""
    found = {c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, Exception)}
    assert all(issubclass(each, HilctlError) for each in found)
    assert not issubclass(DeviceError, InputError)
    assert issubclass(ConfigError, InputError)


def subclasses(kind):
    return {kind}.union(*map(subclasses, kind.__subclasses__()))


def test_every_error_passes_from_process_to_process():
    """Class, text and attributes are unchanged."""
    root = Path(__file__).parents[3]
    for package in (root, root / "drivers"):
        for path in package.glob("hilctl*/**/*.py"):
            if re.search(r"^class \w+Error\(", path.read_text(encoding="utf-8"), re.MULTILINE):
                import_module(".".join(path.relative_to(package).with_suffix("").parts))
    values = {"problems": [ConfigProblem("a", "x", "one")], "number": 2, "code": "E01"}
    for kind in subclasses(HilctlError):
        own = isinstance(kind.__init__, FunctionType)
        names = [*signature(kind).parameters] if own else ["text"]
        given = {name: values.get(name, f"a {name}") for name in names}
        error = kind(**given) if own else kind(*given.values())
        error.add_note("a note")
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again), vars(again)) == (kind, str(error), vars(error))
