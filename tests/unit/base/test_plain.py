"""Models without pydantic: the values and the arithmetic of those that were checked."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hilctl.base import plain
from hilctl.experiment.load import load_experiment
from hilctl.models.files import load_model

CONFIGS = Path(__file__).parents[3] / "configs"
PROGRAM = """
import pickle, sys
import hilctl.base.plain
import numpy as np
given, rate_hz, signal = pickle.load(sys.stdin.buffer)
out = given.inverse(rate_hz).process(signal) if rate_hz else given
if not rate_hz:
    low, high = out.limits.command_range
    out = np.array([out.sample_rate_hz, out.tick_s, low, high, out.safe.ramp_s,
                    out.command_limits().ramp_per_s, out.limits.tracking_error_um or 0.0,
                    out.recording.ring_s, out.waveform.soft_start_s])
assert "pydantic" not in sys.modules
sys.stdout.buffer.write(out.tobytes())
"""


def in_a_process_without_pydantic(*given):
    words = [sys.executable, "-P", "-c", PROGRAM]
    ran = subprocess.run(words, input=pickle.dumps(given), capture_output=True, check=True)
    return np.frombuffer(ran.stdout)


@pytest.mark.parametrize("path", sorted((CONFIGS / "models").glob("*.yaml")), ids=lambda p: p.stem)
def test_an_inverse_is_the_same_to_the_last_bit(path):
    model = load_model(path)
    low, high = model.output_range_um or (-10.0, 10.0)
    way = np.linspace(0.0, 6.0 * np.pi, 400)
    signal = 0.5 * (low + high) + 0.4 * (high - low) * np.sin(way)
    here = model.inverse(10_000.0).process(signal)
    there = in_a_process_without_pydantic(model, 10_000.0, signal)
    np.testing.assert_array_equal(there, here)


def test_an_experiment_has_what_was_checked():
    config = load_experiment(CONFIGS / "demo.yaml").config
    low, high = config.limits.command_range
    here = [config.sample_rate_hz, config.tick_s, low, high, config.safe.ramp_s]
    here += [config.command_limits().ramp_per_s, config.limits.tracking_error_um or 0.0]
    here += [config.recording.ring_s, config.waveform.soft_start_s]
    assert in_a_process_without_pydantic(config, 0.0, None).tolist() == here


def test_a_copy_has_other_values_and_leaves_the_first_as_it_is():
    class Model(plain.Strict):
        size: int = plain.field(default=3, ge=0)
        names: list = plain.field(default_factory=list)

    first = Model(names=["a"])
    second = first.model_copy(update={"size": 5})
    assert (first.size, second.size, second.names) == (3, 5, ["a"])
    assert type(second) is Model


def test_what_checks_elsewhere_is_left_as_it_is():
    @plain.validator("size", mode="before")
    def unchanged(value):
        return value

    assert unchanged(7) == 7
    assert plain.ValidationError("never").errors() == []
    plain.Rule(lambda value: 1 / 0)
