"""The translator of kernels: what it refuses, and statements that need care."""

import math

import pytest

from hilctl.base.errors import ModelError
from hilctl.base.types import F64
from hilctl.lab.model_export.kernel_translation import MatlabTranslator, Translator

BOTH = pytest.mark.parametrize("translator", [Translator, MatlabTranslator])


def _push(memory: F64, x: float) -> float:
    """Return what leaves."""
    left = memory[0]
    memory[0] = x
    return left


def beside(memory: F64) -> float:
    return memory[0] + _push(memory, 1.0)


def power(x: float) -> float:
    return x**2.0


def backwards(x: float) -> float:
    for _ in range(3, 0, -1):
        x -= 1.0
    return x


def local_array(memory: F64) -> None:
    other = memory
    other[0] = 1.0


def float_index(memory: F64, x: float) -> float:
    return memory[x]  # type: ignore[call-overload]


def unknown(x: float) -> float:
    return round(x)


def divided(i: int, j: int) -> float:
    return i / j


def two_types(x: float) -> float:
    a = x
    a = (x, x)
    return a[0]


def logarithm(x: float) -> float:
    return math.log10(x)


def moving_end(n: int) -> float:
    x = 0.0
    for _ in range(n):
        n = n - 1
        x = x + 1.0
    return x


def contained(x: float) -> float:
    return 1.0 if x in (1.0, 2.0) else x


@BOTH
@pytest.mark.parametrize(
    ("kernel", "code"),
    [
        (beside, "memory[0] + _push(memory, 1.0)"),
        (power, "x ** 2.0"),
        (backwards, "range(3, 0, -1)"),
        (local_array, "other[0]"),
        (float_index, "memory[x]"),
        (unknown, "round(x)"),
        (divided, "i / j"),
        (two_types, "a"),
        (logarithm, "math.log10(x)"),
        (moving_end, "range(n)"),
        (contained, "x in (1.0, 2.0)"),
    ],
)
def test_unknown_syntax_is_named_with_file_and_line(translator, kernel, code):
    with pytest.raises(ModelError, match=r"test_kernel_translation\.py:\d+: ") as caught:
        translator().add(kernel)
    assert code in str(caught.value)


def test_a_choice_in_a_condition_is_refused_in_matlab():
    def chosen(x: float) -> float:
        while (1.0 if x > 3.0 else x) > 0.0:
            x -= 1.0
        return x

    with pytest.raises(ModelError):
        MatlabTranslator().add(chosen)


def swapped(short: float, log: float) -> float:
    short, log = log, short
    return short - (log - math.log(short))


def test_values_swap_and_names_of_the_language_are_free():
    made = Translator()
    made.add(swapped)
    assert made.functions["swapped"].splitlines() == [
        "static double swapped(double short_, double log_)",
        "{",
        "    const double t1_ = log_;",
        "    const double t2_ = short_;",
        "    short_ = t1_;",
        "    log_ = t2_;",
        "    return short_ - (log_ - log(short_));",
        "}",
    ]


def pushed(memory: F64, out: F64) -> None:
    out[0] = 2.0 * _push(memory, out[0])


def test_a_matlab_function_returns_the_arrays_that_it_changes():
    made = MatlabTranslator()
    made.add(pushed)
    assert made.functions["pushed"].splitlines() == [
        "function [memory, out] = pushed(memory, out)",
        "    [t1_, memory] = test_kernel_translation_push(memory, out(1));",
        "    out(1) = 2.0 * t1_;",
        "end",
    ]
