"""Rates beyond timer accuracy: who is warned, and what to do."""

from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.experiment.check import check
from hilctl.experiment.load import load_experiment
from hilctl.experiment.pace import pace_warnings

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


def warned(*settings, **info):
    loaded = load_experiment(DEMO, settings)
    return pace_warnings(loaded.config, replace(loaded.device.info, **info))


@pytest.mark.parametrize(("block", "told"), [(4, True), (5, False)])
def test_ticks_of_less_than_a_tenth_of_a_millisecond_are_told(block, told):
    """The demo has 50 kHz."""
    assert bool(warned(f"block={block}")) == told


def test_the_text_says_what_to_do():
    (text,) = warned("block=1")
    assert text.startswith("sample_rate_hz: 50000 ticks per second: ")
    assert "larger block" in text
    (text,) = warned("block=1", buffered=False)
    assert "lower rate" in text


def test_a_device_that_keeps_the_pace_needs_no_timer():
    assert warned("block=1", latency_blocks=2) == ()


def test_a_check_tells():
    settings = ["sample_rate_hz=20000", "block=1", "waveform.duration_s=1.0"]
    checked = check(load_experiment(DEMO, settings))
    assert any("ticks per second" in each for each in checked.warnings)
