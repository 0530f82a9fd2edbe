"""Steps of a campaign: settings over one experiment."""

import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.files import TextFiles
from tests.unit.studies.campaign.conftest import CAMPAIGN


def test_each_step_is_the_experiment_with_its_values(campaign):
    few = campaign()
    assert few.keys == ("waveform.amplitude", "waveform.frequency_hz")
    loaded = [few.load(step, TextFiles()).config for step in few.steps]
    found = [(each.waveform.amplitude, each.waveform.frequency_hz) for each in loaded]
    assert found == [(1.0, 10.0), (1.0, 20.0), (2.0, 10.0), (2.0, 20.0)]
    assert {each.name for each in loaded} == {"few"}


def test_each_step_has_its_own_noise(campaign):
    """Noise depends on the step only, not on order or number of steps."""
    texts = {}
    more = CAMPAIGN.replace("[1.0, 2.0]", "[2.0, 0.5, 1.0]")
    for text in (CAMPAIGN, more, CAMPAIGN + "repeat: 2"):
        few = campaign(text)
        loaded = [few.load(step, TextFiles()) for step in few.steps]
        assert len({each.config.device["seed"] for each in loaded}) == len(loaded)
        texts[text] = {each.yaml_text for each in loaded}
    first, *others = texts.values()
    assert all(first <= other for other in others)


def test_seeds_that_are_varied_are_left_alone(campaign):
    few = campaign(CAMPAIGN + "  device.seed: [7, 8]\n")
    seeds = [few.load(step, TextFiles()).config.device["seed"] for step in few.steps]
    assert set(seeds) == {7, 8}


def test_reference_runs_come_first_now_and_then_and_last(campaign):
    few = campaign(CAMPAIGN + "reference_run: {every: 2, set: {waveform.amplitude: 3.0}}\n")
    assert [step.number for step in few.steps] == [*range(1, 8)]
    references = [step for step in few.steps if step.is_reference]
    assert [(step.number, step.repeat) for step in references] == [(1, 1), (4, 2), (7, 3)]
    amplitudes = {few.load(step, TextFiles()).config.waveform.amplitude for step in references}
    assert amplitudes == {3.0}


def test_whole_sections_and_the_condition(campaign):
    text = CAMPAIGN.replace("waveform.amplitude: [1.0, 2.0]", "compensator: [none]")
    few = campaign(text + "condition: {cycles: 4}\nset: {recording: {flush_s: 1.0}}\n", "block=10")
    config = few.load(few.steps[0], TextFiles()).config
    assert (config.condition.cycles, config.recording.flush_s, config.block) == (4, 1.0, 10)


def test_broken_rules_have_their_place(campaign):
    text = CAMPAIGN.replace("[10.0, 20.0]", "10:20") + "  name: [x]\nset: {name: y}\n"
    with pytest.raises(ConfigError) as found:
        campaign(text, "waveform.amplitude=2")
    for place in ("5: vary.waveform.frequency_hz", "4: vary.waveform.amplitude", "6: vary.name"):
        assert f"few.yaml:{place}:" in str(found.value)
