"""Evaluated samples of a segment."""

import json

import pytest

from hilctl.base.segments import Segment, common_period


def segment(steady_start: int, steady_stop: int, period: float) -> Segment:
    return Segment("sine", 0, steady_stop + 50, steady_start, steady_stop, period)


@pytest.mark.parametrize(("steady_start", "steady_stop", "period", "expected"), [
    pytest.param(0, 1000, 100.0, (100, 1000, 9), id="the first cycle is left out"),
    pytest.param(250, 1000, 100.0, (400, 1000, 6), id="what is no whole cycle goes first"),
    pytest.param(0, 200, 100.0, (100, 200, 1), id="of two cycles the last"),
    pytest.param(0, 199, 100.0, (99, 199, 1), id="almost two cycles are one"),
    pytest.param(0, 100, 100.0, (0, 100, 1), id="one cycle alone is taken"),
    pytest.param(30, 170, 100.0, (70, 170, 1), id="one and a part: the last whole one"),
    pytest.param(0, 99, 100.0, (99, 99, 0), id="less than a cycle: none"),
    pytest.param(500, 500, 100.0, (500, 500, 0), id="no steady part: none"),
    pytest.param(0, 1000, 1000.0 / 3.0, (333, 1000, 2), id="a third of 1000, three times"),
    pytest.param(0, 1000, 333.25, (334, 1000, 2), id="a period with a fraction, rounded once"),
    pytest.param(0, 250, 62.5, (62, 250, 3), id="half samples"),
    pytest.param(0, 7, 2.75, (4, 7, 1), id="short periods with a fraction"),
    pytest.param(0, 1000, 0.0, (0, 1000, 0), id="no period: all of the steady part"),
    pytest.param(200, 900, 0.0, (200, 900, 0), id="no period, soft ends"),
    pytest.param(0, 1_500_000, 50e3 / 30.0, (1667, 1_500_000, 899), id="30 Hz for 30 s"),
    pytest.param(0, 100, 1e300, (100, 100, 0), id="a period without end"),
])  # fmt: skip
def test_steady_cycles(
    steady_start: int, steady_stop: int, period: float, expected: tuple[int, int, int]
) -> None:
    assert segment(steady_start, steady_stop, period).steady_cycles() == expected


@pytest.mark.parametrize("frequency_hz", [1.0, 3.0, 7.0, 10.0, 33.3, 60.0, 150.0, 249.9])
@pytest.mark.parametrize("cycles", [1, 2, 3, 30])
def test_whole_cycles_are_all_counted(frequency_hz: float, cycles: int) -> None:
    period = 1.0 / frequency_hz * 50e3
    samples = round(cycles * period)
    start, stop, counted = segment(1000, 1000 + samples + 1, period).steady_cycles()
    assert counted == max(cycles - 1, 1)
    assert stop == 1000 + samples + 1
    assert stop - start == pytest.approx(counted * period, abs=0.5)


def test_shifted() -> None:
    moved = Segment("sine 6 A 10 Hz", 10, 500, 60, 450, 33.25).shifted(1000)
    assert moved == Segment("sine 6 A 10 Hz", 1010, 1500, 1060, 1450, 33.25)


def test_mapping_goes_through_json() -> None:
    original = Segment("complex harmonic 4 um 20 Hz", 7, 12345, 100, 12000, 50e3 / 3.0)
    text = json.dumps(original.to_mapping())
    assert Segment(**json.loads(text)) == original


@pytest.mark.parametrize(
    ("label", "loop"),
    [("sine 6 A 10 Hz", True), ("file step.csv", True), ("step", False), ("hold 2 A", False)],
)
def test_steps_and_multisines_are_no_loops(label, loop):
    assert Segment(label, 0, 100, 0, 100, 10.0).is_loop == loop


@pytest.mark.parametrize(("periods", "most", "expected"), [
    ([100.0], 1e9, 100.0),
    ([2500.0, 2500.0], 1e9, 2500.0),
    ([50_000.0 / 30.0, 2500.0], 1e9, 5000.0),
    ([50_000.0 / 30.0, 2500.0], 4999.0, None),
    ([100.0, 101.0], 1e4, None),
    ([100.0, 101.0], 10_100.0, 10_100.0),
    ([100.0, 0.0], 1e9, None),
])  # fmt: skip
def test_common_period(periods, most, expected):
    assert common_period(periods, most) == (expected and pytest.approx(expected))
