"""Which waveforms can be learned, and from where."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.learning.repeating import HIGHEST_PART, beginning, repeating
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"
SINE = CONFIGS / "terfenol_sine_6a.yaml"


def test_a_sine_is_learned_from_nothing():
    """As far up as an eighth of the sample rate."""
    checked = checked_experiment(SINE, [])
    (segment,) = repeating(checked)
    state = beginning(checked, segment)
    assert state.highest_hz == HIGHEST_PART * checked.reference.sample_rate_hz
    assert not np.any(state.next_um)


def test_without_a_compensator_there_is_no_input_to_correct():
    checked = checked_experiment(CONFIGS / "terfenol_sine_6a_uncompensated.yaml", [])
    with pytest.raises(ConfigError, match="compensator: is needed to learn"):
        repeating(checked)


def test_a_single_cycle_does_not_repeat():
    short = ["waveform.frequency_hz=10", "waveform.duration_s=0.5"]
    with pytest.raises(ConfigError, match="must repeat for at least 2 whole cycles"):
        repeating(checked_experiment(SINE, short))
