"""Numbers for people."""

import math

import pytest

from hilctl.base.quantity import quantity, significant, unit_text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (39910.0, "us", "39.9 ms"),
        (999.96, "us", "1.00 ms"),
        (0.03553, "um", "35.5 nm"),
        (83.2149, "um", "83.2 µm"),
        (12.0, "%", "12.0 %"),
        (223.609, "um*um", "224 µm²"),
        (223.609, "um*A", "224 µm·A"),
        (2291.4, "Hz", "2290 Hz"),
        (-0.5, "s", "-500 ms"),
        (5400.0, "s", "1.50 h"),
        (0.0, "um", "0 µm"),
        (1.5e-12, "um", "1.50e-09 nm"),
        (None, "um", "-"),
    ],
)
def test_a_quantity_is_read_without_counting_zeros(value, unit, text):
    assert quantity(value, unit) == text


def test_digits_are_the_same_whatever_the_size():
    assert [significant(v) for v in (0.012345, 1.0, 9.996, 12345.0, 1e7, 1e-6)] == [
        "0.0123", "1.00", "10.0", "12300", "1.00e+07", "1.00e-06",
    ]  # fmt: skip
    assert significant(2291.4, 4) == "2291"
    assert significant(math.nan) == "nan"
    assert significant(1.7976931348623157e308) == "1.80e+308"


def test_units_have_their_signs():
    assert [unit_text(u) for u in ("um/A", "A", "um*V")] == ["µm/A", "A", "µm·V"]
