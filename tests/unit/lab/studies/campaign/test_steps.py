"""Steps of a campaign: settings over one experiment."""

import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document
from hilctl.lab.studies.campaign.steps import CampaignFile, groups_of, points, values_of
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN, EXPERIMENT


def test_each_step_is_the_experiment_with_its_values(campaign):
    few = campaign()
    assert few.keys == ("waveform.amplitude", "waveform.frequency_hz")
    loaded = [few.load(step, TextFiles())[0].config for step in few.steps]
    found = [(each.waveform.amplitude, each.waveform.frequency_hz) for each in loaded]
    assert found == [(1.0, 10.0), (1.0, 20.0), (2.0, 10.0), (2.0, 20.0)]
    assert {each.name for each in loaded} == {"few"}


def test_each_step_has_its_own_noise(campaign):
    """Noise depends on the step only, not on order or number of steps."""
    texts = {}
    more = CAMPAIGN.replace("[1.0, 2.0]", "[2.0, 0.5, 1.0]")
    for text in (CAMPAIGN, more, CAMPAIGN + "repeat: 2"):
        few = campaign(text)
        loaded = [few.load(step, TextFiles())[0] for step in few.steps]
        assert len({each.config.device["seed"] for each in loaded}) == len(loaded)
        texts[text] = {each.yaml_text for each in loaded}
    first, *others = texts.values()
    assert all(first <= other for other in others)


def test_each_axis_has_its_own_noise(campaign, experiment):
    axes = "axes:\n  x: {device: {seed: 5}}\n  y: {device: {seed: 6}}\n"
    experiment.write_text(EXPERIMENT + axes)
    few = campaign()
    loaded = [few.load(step, TextFiles()) for step in few.steps]
    assert {tuple(axis.axis for axis in each) for each in loaded} == {("x", "y")}
    seeds = [axis.config.device["seed"] for each in loaded for axis in each]
    assert len(seeds) == len(set(seeds)) == 8
    varied = campaign(CAMPAIGN + "  axes.y.device.seed: [7, 8]\n")
    x, y = varied.load(varied.steps[0], TextFiles())
    assert (x.config.device["seed"] > 5, y.config.device["seed"]) == (True, 7)


def test_seeds_that_are_varied_are_left_alone(campaign):
    few = campaign(CAMPAIGN + "  device.seed: [7, 8]\n")
    seeds = [few.load(step, TextFiles())[0].config.device["seed"] for step in few.steps]
    assert set(seeds) == {7, 8}


def test_reference_runs_come_first_now_and_then_and_last(campaign):
    few = campaign(CAMPAIGN + "reference_run: {every: 2, set: {waveform.amplitude: 3.0}}\n")
    assert [step.number for step in few.steps] == [*range(1, 8)]
    references = [step for step in few.steps if step.is_reference]
    assert [(step.number, step.repeat) for step in references] == [(1, 1), (4, 2), (7, 3)]
    amplitudes = {few.load(step, TextFiles())[0].config.waveform.amplitude for step in references}
    assert amplitudes == {3.0}


def test_whole_sections_and_the_condition(campaign):
    text = CAMPAIGN.replace("waveform.amplitude: [1.0, 2.0]", "compensator: [none]")
    few = campaign(text + "condition: {cycles: 4}\nset: {recording: {flush_s: 1.0}}\n", "block=10")
    config = few.load(few.steps[0], TextFiles())[0].config
    assert (config.condition.cycles, config.recording.flush_s, config.block) == (4, 1.0, 10)


def test_all_that_is_wrong_is_said_at_once_with_its_line():
    text = (
        CAMPAIGN + "order: sideways\nrepeat: 0\nreference_run: {evry: 3}\ncondition: {cycles: 1}\n"
    )
    with pytest.raises(ConfigError) as found:
        Document("few.yaml", text).validate(CampaignFile)
    said = str(found.value)
    for place in (
        "few.yaml:6: order:",
        "few.yaml:7: repeat:",
        "few.yaml:8: reference_run.evry",
        "few.yaml:8: reference_run.every",
        "few.yaml:9: condition.cycles",
    ):
        assert place in said


A = {"a": (1, 2, 3)}
B = {"b": ("x", "y")}


@pytest.mark.parametrize(("text", "values"), [
    ("1:9:3", (1.0, 5.0, 9.0)),
    ("9:1:3lin", (9.0, 5.0, 1.0)),
    ("1:1e2:3log", (1.0, 10.0, 100.0)),
    ("1:250:4log", (1.0, 6.29961, 39.685, 250.0)),
    ("-.5:+.5:2", (-0.5, 0.5)),
])  # fmt: skip
def test_ranges(text, values):
    assert values_of(text) == values


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ("1:9", "must be a list"),
        (3.0, "must be a list"),
        ("1:9:1", "must have 2 to"),
        ("0:9:3log", "ends above 0"),
        ((), "at least one"),
        ("1:9:10001", "must have 2 to"),
    ],
)
def test_what_is_no_list_of_values_is_refused(given, rule):
    with pytest.raises(ValueError, match=rule):
        values_of(given)


def ran(vary, order="as_written", seed=1, repeat=1):
    groups, broken = groups_of(vary)
    assert broken == []
    return ["".join(map(str, point.values())) for point, _ in points(groups, order, seed, repeat)]


@pytest.mark.parametrize(("vary", "order", "repeat", "points_in_order"), [
    ({**A, **B}, "as_written", 1, "1x 1y 2x 2y 3x 3y"),
    (({"a": (1, 2), "c": (7, 8)}, B), "as_written", 1, "17x 17y 28x 28y"),
    ({**A, **B}, "alternating", 1, "1x 1y 2y 2x 3x 3y"),
    (A, "alternating", 2, "1 2 3 3 2 1"),
])  # fmt: skip
def test_order_of_crossed_keys(vary, order, repeat, points_in_order):
    assert ran(vary, order, repeat=repeat) == points_in_order.split()


def test_random_is_the_same_for_a_seed():
    first, again, other = (ran({**A, **B}, "random", seed, 2) for seed in (1, 1, 2))
    assert first == again != other
    assert sorted(first) == sorted(ran({**A, **B}, repeat=2))


def test_everything_that_is_wrong_is_found():
    _, broken = groups_of(({"a": (1, 2), "b": (1, 2, 3)}, {"a": "1:2"}))
    assert [(loc, rule.split(" ")[0]) for loc, rule, _, _ in broken] == [
        ((0,), "must"),
        ((1, "a"), "must"),
        ((1, "a"), "is"),
    ]
    assert groups_of({})[1]
    assert groups_of(({},))[1]
