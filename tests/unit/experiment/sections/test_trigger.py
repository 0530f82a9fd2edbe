"""Triggers need channels of the device, blocks of one sample, and marks far enough apart."""

from dataclasses import replace

import pytest

from hilctl.experiment.sections.trigger import on_target_problems, trigger_problems
from tests.unit.experiment.test_preflight import CURRENT, checked, loaded, refusals

SHORT = "{kind: sine, amplitude: 1.0, frequency_hz: 1000.0, duration_s: 0.0011}"


@pytest.mark.parametrize(
    ("waveform", "cure"),
    [
        ("{kind: hold, unit: A, level: 0.0, duration_s: 1.0}", "trigger.output=segment"),
        (f"{{kind: sequence, unit: A, parts: [{SHORT}, {SHORT}]}}", "sample_rate_hz=20000"),
    ],
    ids=["no cycles", "marks of two parts in a row"],
)
def test_cycles_that_cannot_be_marked_are_refused(waveform, cure):
    bad = (f"waveform={waveform}", "trigger={output: cycle}", "limits.slew_a_per_s=1e6")
    (problem,) = refusals(CURRENT, *bad, digital_output="DO")
    assert (problem.key, problem.value) == ("trigger.output", "cycle")
    checked(CURRENT, *bad, cure, digital_output="DO")


@pytest.mark.parametrize(
    ("settings", "compensated", "keys"),
    [
        (["on_target={tolerance_um: 0.1}"], False, ["on_target"]),
        (["trigger={output: on_target}"], True, ["trigger.output"]),
        (["trigger={output: on_target}", "on_target={tolerance_um: 0.1}"], True, []),
    ],
)
def test_on_target_needs_a_compensator_and_its_tolerance(settings, compensated, keys):
    config = loaded(CURRENT, *settings, digital_output="DO").config
    problems = on_target_problems(config.on_target, config.trigger, compensated=compensated)
    assert [each.key for each in problems] == keys


@pytest.mark.parametrize(
    ("settings", "info", "keys"),
    [
        (["trigger={output: run}"], {"digital_output": ""}, ["trigger.output"]),
        (["trigger={start: low}"], {"digital_input": ""}, ["trigger.start"]),
        (["trigger={start: low}", "block=10"], {}, ["block"]),
        (
            ["trigger={output: run, start: high}", "block=10"],
            {"digital_output": "", "digital_input": ""},
            ["trigger.output", "trigger.start", "block"],
        ),
    ],
)
def test_triggers_need_channels_and_blocks_of_one_sample(settings, info, keys):
    rig = loaded(CURRENT, *settings, digital_output="DO", digital_input="DI").rig
    trigger = loaded(CURRENT, *settings).config.trigger
    problems = [*trigger_problems(trigger, replace(rig, info=replace(rig.info, **info)))]
    assert [each.key for each in problems] == keys
    assert all(each.hint or "must be 1" in each.rule for each in problems)
