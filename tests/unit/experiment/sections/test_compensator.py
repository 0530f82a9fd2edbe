"""The start of the compensator: at rest, or where earlier commands left the actuator."""

import re

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, DataError
from hilctl.experiment import device_state
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.compensator import InitialState, left_by
from hilctl.models.base import HysteresisModel, Operator
from tests.published import terfenol_rdpi
from tests.unit.experiment.test_preflight import (
    DISPLACEMENT,
    PIEZO,
    STAGE,
    VOLTS,
    checked,
    compensated,
    loaded,
    refusals,
    refused,
)

MOVED = terfenol_rdpi().model_copy(update={"output_offset_um": 24.5})
"""At 0 A the actuator rests at 24.5 um."""


@pytest.mark.parametrize(
    ("setting", "cure"),
    [
        ("waveform.soft_start_s=0", r"set (waveform\.soft_start_s) to ([.\d]+)"),
        ("waveform.rest=0", r"remove (waveform\.rest): ([.\d]+)"),
    ],
)
def test_a_reference_begins_where_the_actuator_rests(setting, cure):
    """From 0 um the first command would be a step."""
    found = checked(DISPLACEMENT, model=MOVED)
    assert found.reference.values[0] == 24.5
    (problem,) = refusals(DISPLACEMENT, setting, model=MOVED)
    assert problem.key == "waveform"
    assert "24.5 µm" in problem.rule
    assert "slew" not in str(problem)
    key, value = re.search(cure, problem.hint).groups()
    assert checked(DISPLACEMENT, setting, f"{key}={value}", model=MOVED)


def test_a_soft_start_begins_where_the_last_run_left_the_actuator(monkeypatch):
    """A unipolar drive cannot bring it back to rest."""
    left = left_by([100.0 * np.sin(np.linspace(0.0, np.pi, 1000))], STAGE, 1000.0)
    monkeypatch.setattr(device_state, "left_by_last_run", lambda *_: (left, "as left"))
    made = compensated(loaded(PIEZO, model=STAGE, **VOLTS), initial_state="last")
    found = check(made)
    assert left.stands_um > 1.0
    assert found.begun.input_um[0] == pytest.approx(left.stands_um)
    assert found.forecast.command_min > -1e-9
    assert found.reference.values[0] == pytest.approx(0.006)


def test_a_start_that_would_trip_on_the_tracking_error_is_refused(monkeypatch):
    left = left_by([100.0 * np.sin(np.linspace(0.0, np.pi, 1000))], STAGE, 1000.0)
    monkeypatch.setattr(device_state, "left_by_last_run", lambda *_: (left, "as left"))
    given = ("waveform.soft_start_s=0.0", "limits.tracking_error_um=1.0", "limits.tracking_s=0.0")
    far = compensated(loaded(PIEZO, *given, model=STAGE, **VOLTS), initial_state="last")
    with pytest.raises(ConfigError) as refused:
        check(far)
    assert [each.key for each in refused.value.problems] == ["waveform"]


class Offset(HysteresisModel):
    """Commands are 3 A above the reference, and rest comes slowly: a um more with each sample."""

    kind: str = "offset"

    @property
    def operators(self):
        """Return 1: a number that is added to the commands."""
        return 1

    def forward(self, sample_rate_hz):
        def run(x, memory, out):
            out[:] = np.arange(x.size)

        return Operator(run, (), self.operators)

    def inverse(self, sample_rate_hz):
        def run(x, memory, out):
            out[:] = x + 3.0 + memory[0]

        return Operator(run, (), self.operators)


FAST = (
    "waveform.rest=0",
    "limits.slew_a_per_s=400.0",
    "waveform.frequency_hz=20.0",
    "waveform.amplitude=3.5",
)


@pytest.mark.parametrize(("rate_hz", "rests_um"), [(10_000.0, 999), (40.0, 3), (2.0, 0)])
def test_where_it_rests_is_said_once_all_stages_do(rate_hz, rests_um):
    slow = (
        "waveform.rest=0",
        f"sample_rate_hz={rate_hz}",
        "limits.slew_a_per_s=1.0",
        "waveform.frequency_hz=0.01",
    )
    (found,) = refusals(DISPLACEMENT, *slow, "waveform.amplitude=1.0", model=Offset())
    assert (found.key, found.value) == ("waveform", "0 µm")
    assert f" {rests_um} µm" in found.rule
    assert "3 A" in found.hint


def test_at_the_safe_value_there_is_no_step():
    (found,) = refusals(DISPLACEMENT, *FAST, "safe.value=3.0", model=Offset())
    assert found.key == "limits.slew_a_per_s"


def test_the_first_command_is_that_of_the_state_it_begins_with(monkeypatch):
    there = InitialState(np.array([-3.0, 0.0]), 0.0, "before")
    monkeypatch.setattr(device_state, "left_by_last_run", lambda *_: (there, "as left"))
    made = compensated(loaded(DISPLACEMENT, *FAST, model=Offset()), initial_state="last")
    assert [problem.key for problem in refused(made)] == ["limits.slew_a_per_s"]


def test_a_run_before_that_says_nothing_is_a_problem(monkeypatch):
    def refuse(path, *_):
        raise DataError(f"{path}: nothing there")

    monkeypatch.setattr(device_state, "initial_state_after", refuse)
    made = loaded(DISPLACEMENT, model=terfenol_rdpi())
    (problem,) = refused(compensated(made, initial_state="before.mcap"))
    assert problem.key == "compensator.initial_state"
    assert problem.rule == "before.mcap: nothing there"


def test_a_faster_change_further_on_is_what_is_told():
    moved = terfenol_rdpi().model_copy(update={"output_offset_um": 24.5})
    holds = ", ".join(f"{{kind: hold, level: {um}, duration_s: 0.2}}" for um in (22.0, 18.0))
    steps = f"waveform={{kind: sequence, unit: A, parts: [{holds}]}}"
    (found,) = refusals(DISPLACEMENT, steps, "limits.slew_a_per_s=1000.0", model=moved)
    assert found.key == "limits.slew_a_per_s"
    a_third_more = steps.replace("22.0", "0.0").replace("18.0", "3.9")
    (found,) = refusals(DISPLACEMENT, a_third_more, model=Offset())
    assert found.key == "limits.slew_a_per_s"


def test_a_rest_before_the_waveform_does_not_make_the_last_run_forgotten(monkeypatch):
    model = terfenol_rdpi()
    there = InitialState(model.inverse(10_000.0).state(), 0.0, "before")
    monkeypatch.setattr(device_state, "left_by_last_run", lambda *_: (there, "as left"))
    made = loaded(DISPLACEMENT, model=model)
    for named, run_id in (("last", "before"), ("rest", "")):
        found = check(compensated(made, initial_state=named, offset="measured"))
        assert found.conditioning() is not None
        assert found.begun.run_id == run_id
