"""Numbers and texts for people, and JSON for programs."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest

from hilctl.base import formatting


@pytest.mark.parametrize(("value", "unit", "text"), [
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
])  # fmt: skip
def test_quantities_have_readable_prefixes(value, unit, text):
    assert formatting.quantity(value, unit) == text


def test_number_of_digits_does_not_depend_on_the_size():
    assert [formatting.significant(v) for v in (0.012345, 1.0, 9.996, 12345.0, 1e7, 1e-6)] == [
        "0.0123", "1.00", "10.0", "12300", "1.00e+07", "1.00e-06",
    ]  # fmt: skip
    assert formatting.significant(2291.4, 4) == "2291"
    assert formatting.significant(math.nan) == "nan"
    assert formatting.significant(1.7976931348623157e308) == "1.80e+308"


def test_units_have_their_signs():
    assert [formatting.unit_text(u) for u in ("um/A", "A", "um*V")] == ["µm/A", "A", "µm·V"]


@pytest.mark.parametrize(("text", "shown"), [
    ("sine 6 A 10 Hz, µm ü", "sine 6 A 10 Hz, µm ü"),
    ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
    ("a\r\nb", "a\\r\\nb"),
    ("\u202egnp.exe", "\\u202egnp.exe"),
    ("\x9b2Jc\rd\x7fe", "\\x9b2Jc\\rd\\x7fe"),
])  # fmt: skip
def test_control_characters_are_escaped(text: str, shown: str) -> None:
    assert formatting.printable(text) == shown


def test_line_breaks_are_kept_on_request() -> None:
    assert formatting.printable("a:\n\tb\r", lines=True) == "a:\n\tb\\r"


def test_names_are_short() -> None:
    assert formatting.short_name("x" * formatting.MOST_SHOWN) == "x" * formatting.MOST_SHOWN
    for long in ("x" * 10**6, "\x1b" * formatting.MOST_SHOWN):
        assert len(formatting.short_name(long)) == formatting.MOST_SHOWN
        assert formatting.short_name(long).endswith("...")


WHOLE = {"a": [1, 0.5, None, True, "NaN"], "b": {"c": (2.5,)}}


def refuse(constant: str) -> None:
    raise ValueError(constant)


@pytest.mark.parametrize("indent", [None, 2])
def test_finite_values_stay_as_they_are(indent: int | None) -> None:
    assert formatting.finite_json(WHOLE, indent) == json.dumps(WHOLE, indent=indent)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nonfinite_values_are_null(bad: float) -> None:
    text = formatting.finite_json({"x": bad, "y": [bad, 1.0], "z": {"deep": (bad, "inf")}})
    found = json.loads(text, parse_constant=refuse)
    assert found == {"x": None, "y": [None, 1.0], "z": {"deep": [None, "inf"]}}


def test_results_are_shown_in_one_line_and_as_a_table():
    @formatting.shown_briefly
    @dataclass
    class Result:
        name: str
        error_um: float
        values: object
        parts: tuple
        note: str | None = None
        marks: tuple = ()

    shown = Result("a<b", 1.23456789, np.zeros((3, 2)), (1, 2))
    expected = "Result(name='a<b', error_um=1.23457, values=<ndarray [3, 2]>, parts=<tuple of 2>)"
    assert repr(shown) == expected
    assert "<th>name</th><td>&#x27;a&lt;b&#x27;</td>" in shown._repr_html_()


KEYS = ("amplifier", "host", "parity", "sample_rate_hz", "serial_port", "tcp_port", "timeout_s")


@pytest.mark.parametrize(
    ("word", "offered"),
    [
        ("hosst", ["host"]),
        ("hsot", ["host"]),
        ("Host", ["host"]),
        ("timeout", ["timeout_s"]),
        ("amp", ["amplifier"]),
        ("rate_hz", ["sample_rate_hz"]),
        ("port", ["serial_port", "tcp_port"]),
        ("host_name", ["host"]),
        ("hyst", []),
        ("party_line", []),
        ("s", []),
        ("SERIAL", ["serial_port"]),
    ],
)
def test_similar_names_are_suggested_otherwise_all(word, offered):
    hint = formatting.did_you_mean(word, KEYS)
    assert [key for key in KEYS if key in hint] == (offered or list(KEYS))
    assert bool(formatting.did_you_mean(word, KEYS, listed=True)) == bool(offered)
    assert formatting.did_you_mean(word, []) == ""
