"""Varied parameters with names and units."""

from itertools import product

import pytest

from hilctl.lab.studies.multi_run.varied_parameter import dimensions, keys_of, short_value, value_at

HZ, A, S = "waveform.frequency_hz", "waveform.amplitude", "waveform.duration_s"


def test_keys_that_follow_others_are_left_out():
    """A duration depends on its frequency, an amplitude on the compensator."""
    rows = [{HZ: hz, A: a, S: 1.0 / hz} for hz in (1.0, 10.0) for a in (3.0, 6.0)]
    assert [each.key for each in dimensions([A, HZ, S], rows)] == [HZ, A]
    rows = [
        {"compensator": name, A: a, HZ: hz}
        for name, a in (("none", 6.0), ("omega", 40.8), ("staged", 40.8))
        for hz in (1.0, 10.0)
    ]
    assert [each.key for each in dimensions(["compensator", A, HZ], rows)] == ["compensator", HZ]


def test_an_amplitude_stays_where_each_run_has_a_frequency_of_its_own():
    rows = [{HZ: 10.0, A: 6.0}, {HZ: 50.0, A: 6.0}, {HZ: 100.0, A: 3.0}]
    assert [each.key for each in dimensions([HZ, A], rows)] == [HZ, A]


def test_names_have_units():
    axes = {
        HZ: "frequency, Hz",
        A: "amplitude, A",
        "device.load_kg": "load, kg",
        "waveform.components.0.frequency_hz": "frequency of sine 1, Hz",
        "x.gap_um": "gap, µm",
        "order": "order",
    }
    # A full grid, so that no key depends on another.
    grid = product((1.0, 2.0), repeat=len(axes))
    rows = [dict(zip(axes, values, strict=True)) for values in grid]
    assert {each.key: each.axis for each in dimensions([*axes], rows, "A")} == axes


def test_numbers_rise_and_names_keep_their_order():
    rows = [{HZ: hz, "compensator": name} for hz in (9.0, 1.0) for name in ("none", "b", "a")]
    by = {each.key: each for each in dimensions([HZ, "compensator"], rows)}
    assert by[HZ].values == (1.0, 9.0)
    assert by["compensator"].values == ("none", "b", "a")
    assert by["compensator"].text("none") == "without compensator"
    assert (by[HZ].text(9.0), by[HZ].numeric, by["compensator"].numeric) == ("9 Hz", True, False)


@pytest.mark.parametrize(("value", "short"), [
    ({"model": "models/omega.yaml"}, "omega"),
    ({"kind": "complex_harmonic", "unit": "A"}, "complex harmonic"),
    ([1, 2], "[1, 2]"),
    (3, 3.0),
    (True, "True"),
    (None, None),
])  # fmt: skip
def test_a_value_is_shown_by_what_people_call_it(value, short):
    assert short_value(value) == short


def test_experiments_are_compared_key_by_key():
    one = {"name": "a", "device": {"seed": 1, "load_kg": 0.0}, "compensator": "none",
           "waveform": {"components": ({"amplitude": 1.0}, {"amplitude": 5.0})}}  # fmt: skip
    other = {"name": "b", "device": {"seed": 2, "load_kg": 3.7}, "compensator": {"model": "m.yaml"},
             "waveform": {"components": ({"amplitude": 1.0}, {"amplitude": 4.0})}}  # fmt: skip
    amplitude = "waveform.components.1.amplitude"
    assert keys_of([one, other]) == ["device.load_kg", "compensator", amplitude]
    assert value_at(other, amplitude) == 4.0
    for missing in ("waveform.components.7.amplitude", f"{amplitude}.x"):
        assert value_at(other, missing) is None
