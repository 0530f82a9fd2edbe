"""Late ticks, deadline misses and the silence of a hung loop, by the ``timing`` section."""

from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.experiment.load import load_experiment
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.timing import (
    Timing,
    late_rules,
    pace_warnings,
    silence_limits,
    timeout_warnings,
)

DEMO = Path(__file__).parents[4] / "configs" / "demo.yaml"
TICK_S = 1e-3


def warned(*settings, **info):
    loaded = load_experiment(DEMO, settings)
    return pace_warnings(loaded.config.tick_s, replace(loaded.device.info, **info))


@pytest.mark.parametrize(("block", "told"), [(4, True), (5, False)])
def test_ticks_of_less_than_a_tenth_of_a_millisecond_are_told(block, told):
    """The demo has 50 kHz."""
    assert bool(warned(f"block={block}")) == told


@pytest.mark.parametrize(("timeout_s", "warnings"), [(0.5, 0), (0.51, 1), ("text", 0), (None, 0)])
def test_a_timeout_longer_than_a_tick_may_be_late_is_told(timeout_s, warnings):
    found = timeout_warnings(Timing(max_late_s=0.5), timeout_s)
    assert len(found) == warnings
    assert all("timing.max_late_s, 0.5 s" in each for each in found)


def test_the_text_says_what_to_do():
    (text,) = warned("block=1")
    assert text.startswith("sample_rate_hz: 50000")
    assert "larger block" in text
    (text,) = warned("block=1", buffered=False)
    assert "lower rate" in text


def test_a_check_tells():
    settings = ["sample_rate_hz=20000", "block=1", "waveform.duration_s=1.0"]
    checked = check(load_experiment(DEMO, settings))
    assert any("ticks per second" in each for each in checked.warnings)


def test_late_rules_are_in_the_file_s_own_ticks():
    """No run of late ticks lasts 2 s."""
    rules = late_rules(Timing(late_after=0.5, max_late_s=0.25), TICK_S, 100)
    assert (rules.late_after_ns, rules.max_late_ns) == (pytest.approx(5e5), pytest.approx(2.5e8))
    assert rules.max_consecutive_late == 2000


@pytest.mark.parametrize(("given", "ticks", "expected"), [
    ({}, 20_000, (10_000, 100.0)),
    ({}, 300, (300, 3.0)),
    ({"max_missed_share": 0.2}, 20_000, (10_000, 2000.0)),
    ({"max_missed_share": 1}, 20_000, (10_000, 10_000)),
])  # fmt: skip
def test_misses_are_counted_over_ten_seconds_or_the_whole_run(given, ticks, expected):
    rules = late_rules(Timing(**given), TICK_S, ticks)
    assert (rules.missed_window, rules.max_missed) == expected


@pytest.mark.parametrize(("given", "simulated", "real_time_s", "ordinary_s", "stopped_s"), [
    ({}, False, 0.1, 1.02, 0.04),
    ({"max_late_s": 0.05}, False, 0.07, 0.07, 0.04),
    ({"max_late_s": 10.0}, False, 0.82, 10.02, 0.04),
    ({}, True, 1.52, 1.52, 1.52),
])  # fmt: skip
def test_how_long_a_loop_may_be_silent(given, simulated, real_time_s, ordinary_s, stopped_s):
    limits = silence_limits(Timing(**given), 0.01, simulated=simulated)
    assert limits.exchange_s == given.get("max_late_s", 1.0)
    assert limits.real_time_s == pytest.approx(real_time_s)
    assert limits.ordinary_s == pytest.approx(ordinary_s)
    assert limits.stopped_s == pytest.approx(stopped_s)
