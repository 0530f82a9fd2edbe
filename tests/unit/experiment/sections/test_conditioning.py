"""The conditioning cycle of an experiment: how far it goes, how it ends, and what it makes."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.models.model_file import load_model

MODEL = Path(__file__).parents[4] / "configs" / "models" / "terfenol_staged.yaml"
EXPERIMENT = f"""\
name: conditioned
device: {{kind: simulated_terfenol}}
sample_rate_hz: 10000
block: 50
waveform:
  {{kind: sine, unit: um, amplitude: 5.0, frequency_hz: 10.0, duration_s: 0.5, soft_start_s: 0.1}}
compensator: {{model: {MODEL}}}
condition: {{}}
limits: {{peak_current_a: 6.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}}
"""
PIEZO = """\
name: conditioned
device: {kind: simulated_piezo}
sample_rate_hz: 10000
waveform: {kind: hold, unit: V, level: 0.0, duration_s: 0.1}
compensator: none
condition: {}
limits: {drive_v: [-20.0, 120.0], slew_v_per_s: 20000.0, stroke_um: [-30.0, 60.0]}
"""


def loaded(*given, text=EXPERIMENT):
    return resolve(Document("x.yaml", text), Path(), given)


def command_of(*given, text=EXPERIMENT):
    made = loaded(*given, text=text).conditioning()
    assert made is not None
    return made.command[: made.cycle_samples], made


def test_a_cycle_beyond_the_memory_is_refused():
    with pytest.raises(ConfigError, match=r"condition: has .* samples"):
        check(loaded("condition.frequency_hz=1e-9"))


class TestCycle:
    def test_from_the_limits(self):
        """By itself it goes to the limits at 10 Hz, 20 times, ever less far, and rests 0.1 s."""
        cycle, made = command_of()
        assert cycle.size == 20_000
        assert made.command.size == 21_000
        assert made.rest == (20_500, 21_000)
        highs = cycle.reshape(20, 1000).max(axis=1)
        assert highs[0] == pytest.approx(6.0, rel=1e-6)
        assert (np.diff(highs[1:]) < 0.0).all()
        assert highs[-1] < 0.03
        assert cycle.reshape(20, 1000).min(axis=1)[0] == pytest.approx(-6.0, rel=1e-6)

    def test_each_side_as_far_as_there_is_room(self):
        cycle, _ = command_of(text=PIEZO)
        assert cycle.max() == pytest.approx(120.0, rel=1e-6)
        assert cycle.min() == pytest.approx(-20.0, rel=1e-6)
        cycle, _ = command_of("condition.amplitude_v=50.0", text=PIEZO)
        assert (round(cycle.max(), 6), round(cycle.min(), 6)) == (50.0, -20.0)

    @settings(max_examples=20)
    @given(
        cycles=st.integers(2, 40),
        decay=st.floats(0.1, 1.0),
        slew=st.floats(100.0, 1e5),
        safe=st.floats(-3.0, 3.0),
        rate_hz=st.sampled_from([200.0, 10e3]),
    )
    @example(cycles=2, decay=math.nextafter(1.0, 0.0), slew=100.0, safe=0.0, rate_hz=200.0)
    def test_within_limits_and_to_the_safe_value(self, cycles, decay, slew, safe, rate_hz):
        cycle, made = command_of(
            f"condition={{cycles: {cycles}, decay: {decay!r}}}",
            f"limits.slew_a_per_s={slew!r}",
            f"safe.value={safe!r}",
            f"sample_rate_hz={rate_hz!r}",
        )
        limits = loaded(f"safe.value={safe!r}").config.command_limits()
        assert limits.low - 1e-9 <= cycle.min() <= cycle.max() <= limits.high + 1e-9
        assert np.abs(np.diff(cycle, prepend=safe)).max() * rate_hz <= slew
        assert set(made.command[cycle.size - 1 :]) == {safe}

    def test_a_fifo_answers_before_the_waveform(self):
        made = loaded()
        info = replace(made.device.info, latency_blocks=3)
        late = replace(made, device=SimpleNamespace(info=info)).conditioning()
        assert late is not None
        assert late.command.size == 21_000 + 150
        assert late.rest == (20_500, 21_000)

    def test_it_makes_what_was_before_forgotten(self):
        cycle, _ = command_of()
        model, random = load_model(MODEL), np.random.default_rng(5)
        stands = []
        for _ in range(3):
            nodes = random.uniform(-6.0, 6.0, 12)
            before = np.interp(np.arange(24_000), np.arange(12) * 2000.0, nodes)
            plant = model.forward(10e3)
            plant.process(before)
            left = plant.process(np.zeros(3000))[-1]
            stands.append((left, plant.process(np.concatenate((cycle, np.zeros(3000))))[-1]))
        lefts, ends = np.array(stands).T
        assert np.ptp(lefts) > 1.0
        assert np.ptp(ends) < 1e-3


class TestCheck:
    def test_the_compensator_begins_where_the_cycle_ends(self):
        checked = check(loaded("compensator.offset=measured"))
        conditioning, begun = checked.conditioning(), checked.begun
        assert conditioning is not None
        model = load_model(MODEL)
        came = model.forward(10e3).process(conditioning.command.copy())
        assert begun.stands_um == pytest.approx(came[-1], abs=1e-4)
        assert begun.input_um[0] == pytest.approx(begun.stands_um, abs=0.01)
        inverse = model.inverse(10e3)
        inverse.restore(begun.state)
        assert abs(inverse.process(np.array([begun.input_um[0]]))[0]) < 0.02
        assert conditioning.stands_um == begun.stands_um
        assert checked.records_input

    def test_offset_is_measured_where_told_to(self):
        assert check(loaded()).conditioning().stands_um is None
        plain = loaded("condition=null")
        assert check(plain).conditioning() is None
        measured = check(loaded("condition=null", "compensator.offset=measured"))
        assert measured.conditioning().stands_um is not None
        assert (measured.conditioning().command == 0.0).all()
        assert loaded(text=PIEZO).conditioning().stands_um is None

    def test_zero_of_the_sensor_is_measured_with_and_without_a_model(self):
        rest = check(loaded("condition=null", "zero=true")).conditioning()
        assert (rest.zero, rest.cycle_samples) == (True, 0)
        assert rest.stands_um is not None
        bare = ("compensator=none", "waveform.unit=A", "waveform.amplitude=1.0")
        plain = check(loaded("condition=null", "zero=true", *bare)).conditioning()
        assert (plain.zero, plain.stands_um, plain.largest_um) == (True, 0.0, 0.25 * 135.0)
        with pytest.raises(ConfigError, match="zero: must be false"):
            check(loaded("zero=true", "compensator.offset=measured"))

    def test_forecast_counts_it(self):
        checked, plain = check(loaded()), check(loaded("condition=null"))
        assert plain.forecast.before_s == 0.0
        assert checked.forecast.before_s == 2.1
        assert checked.forecast.command_max == pytest.approx(6.0, rel=1e-6)
        assert checked.forecast.recording_mb > plain.forecast.recording_mb
        heat = ("limits.rms_current_a=1.0", "limits.thermal_time_constant_s=1.0")
        with pytest.raises(ConfigError, match="condition's amplitude"):
            check(loaded(*heat))

    @pytest.mark.parametrize(("setting", "rule"), [
        ("condition.amplitude_a=6.1", r"condition.amplitude_a: must be <= 6 A"),
        ("condition.amplitude_v=1.0", r"condition: must have amplitude_a: limits are in A"),
        ("condition.frequency_hz=531.0", r"condition.frequency_hz: must be <= 500 Hz"),
        ("condition={frequency_hz: 90.0, amplitude_a: 6.0}", r"must be <= 79.58 Hz"),
    ])  # fmt: skip
    def test_what_it_can_t_be(self, setting, rule):
        slew = "limits.slew_a_per_s=3000.0" if "90.0" in setting else "name=x"
        with pytest.raises(ConfigError, match=rule):
            check(loaded(setting, slew))
