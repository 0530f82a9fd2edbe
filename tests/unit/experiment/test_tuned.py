"""A change of gain and offset, held against what the loop would really do with it."""

import itertools
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment import tuned
from hilctl.experiment.check import check
from hilctl.experiment.load import resolve
from hilctl.experiment.tuned import InputPeaks, RunPosition, tuned_forecast
from hilctl.loop.compensator import Compensator
from hilctl.loop.host import StraightLine, Tuning
from hilctl.loop.tuning import Tuner, tune
from hilctl.models.staged import FieldLag, StagedModel
from tests.published import terfenol_rdpi

TEXT = """\
name: tuned
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform: WAVEFORM
compensator: COMPENSATOR
limits: {peak_current_a: 7.0, slew_a_per_s: SLEW, stroke_um: [-75.0, 60.0]}
"""
SINE = "{kind: sine, unit: UNIT, amplitude: 5.0, frequency_hz: HZ, duration_s: 4.0}"
CHIRP = "{kind: chirp, unit: UNIT, amplitude: 5.0, start_hz: 1.0, stop_hz: 40.0, duration_s: 4.0}"
INFO = DeviceInfo(
    name="fake",
    description="a device that does nothing",
    command_unit="A",
    command_min=-8.0,
    command_max=8.0,
    sensor_min_um=-100.0,
    sensor_max_um=100.0,
    max_rate_hz=20e3,
)
MODEL = str(Path(__file__).parents[3] / "configs" / "models" / "terfenol_rdpi.yaml")
LOOKING_AHEAD = StagedModel.around(terfenol_rdpi(), lag=FieldLag(tau_s=2e-3))


class DescribedDevice:
    info = INFO


def checked(waveform=SINE, model=None, slew=20000.0, hz="10.0", limits=""):
    compensator = "none" if model is None else f"{{model: {MODEL}}}"
    waveform = waveform.replace("UNIT", "A" if model is None else "um").replace("HZ", hz)
    text = TEXT.replace("WAVEFORM", waveform).replace("COMPENSATOR", compensator)
    text = text.replace("SLEW", str(slew)).replace("stroke_um", limits + "stroke_um")
    loaded = resolve(Document("x.yaml", text), Path())
    return check(replace(loaded, device=DescribedDevice(), model=model))


def position_at(made, sample, before=()):
    """Return where a run stands, and all its commands up to there, as the loop works them out."""
    compensator = Compensator(made.loaded.model, made.loaded.config.sample_rate_hz)
    if made.begun.state is not None:
        compensator.restore(made.begun.state)
    tuner = Tuner()
    put_out(made, compensator, tuner, 0, sample, before)
    return RunPosition(sample, compensator.state(), copy(tuner), 0.0), compensator, tuner


def put_out(made, compensator, tuner, start, stop, tunings):
    """Return the commands of a stretch, block by block, with changes where they begin."""
    found = []
    for at in range(start, stop, 500):
        for each in tunings:
            if each.begins_at == at:
                tuner.move(each)
        values = made.begun.input_um[at : at + 500].copy()
        if (factors := tuner.advance(values.size)) is not None:
            tune(factors, values, values)
        out = np.empty_like(values)
        compensator.process(values, out)
        if factors is not None:
            reference = np.empty_like(values)
            tune(factors, made.reference.values[at : at + 500], reference)
            tuner.fade(factors, reference, out, np.zeros(500, dtype=np.uint32))
        found.append(out)
    return np.concatenate(found) if found else np.empty(0)


def forecast(made, position, tuning, chunks=10**9):
    """Work a change out with time for so many chunks."""
    left = itertools.count(chunks, -1)
    peaks = InputPeaks(made.begun.input_um)
    return tuned_forecast(made, peaks, position, tuning, lambda: next(left) > 0)


def seen(monkeypatch):
    """Keep the figures that are held against the limits."""
    kept = []
    held = tuned.command_problems

    def keep(loaded, figures):
        kept.append(figures)
        return held(loaded, figures)

    monkeypatch.setattr(tuned, "command_problems", keep)
    return kept


@pytest.mark.parametrize("model", [None, terfenol_rdpi(), LOOKING_AHEAD])
@pytest.mark.parametrize("waveform", [SINE, CHIRP])
@pytest.mark.parametrize("share", [1.0, 0.0])
def test_figures_are_those_of_the_loop_to_come(monkeypatch, model, waveform, share):
    """From a change that is under way on, with the ramp of the next, to the end."""
    made = checked(waveform, model)
    line = made.forecast.line or StraightLine()
    first = Tuning(0.8, 0.5, 9000, 2000)
    second = Tuning(0.5, -1.0, 3000, 7000, share if model else 1.0, line)
    position, compensator, tuner = position_at(made, 5000, [first])
    assert position.tuner.moving
    kept = seen(monkeypatch)
    result = forecast(made, position, second)
    commands = put_out(made, compensator, tuner, 5000, 40_000, [second])
    assert kept[0].command_min == pytest.approx(commands.min(), rel=2e-3)
    assert kept[0].command_max == pytest.approx(commands.max(), rel=2e-3)
    slew = np.abs(np.diff(commands)).max() * 10e3
    assert kept[0].slew_per_s == pytest.approx(slew, rel=5e-3)
    assert result.to_the_end
    assert result.checked_s == pytest.approx(3.5)
    assert position.tuner.moving  # what was handed over is as it was


@pytest.mark.parametrize("hz", ["10.0", "33.3", "10.00037"])
def test_what_repeats_is_passed_over(monkeypatch, hz):
    """Also where a cycle is no whole number of samples; the step over makes no slew of its own."""
    made = checked(model=LOOKING_AHEAD, hz=hz)
    position, compensator, tuner = position_at(made, 1000)
    tuning = Tuning(0.7, 0.0, 2000, 2000)
    worked, commands = [], tuned._Walk._commands

    def count(walk, stop):
        found = commands(walk, stop)
        worked.append(found.size)
        return found

    monkeypatch.setattr(tuned._Walk, "_commands", count)
    kept = seen(monkeypatch)
    assert forecast(made, position, tuning).to_the_end
    if hz == "10.0":
        assert sum(worked) < 12_000
    out = put_out(made, compensator, tuner, 1000, 40_000, [tuning])
    assert kept[0].command_max == pytest.approx(out.max(), rel=2e-3)
    assert kept[0].slew_per_s == pytest.approx(np.abs(np.diff(out)).max() * 10e3, rel=1e-2)


def test_what_is_behind_the_repeating_part_is_worked_out(monkeypatch):
    """A sequence whose second part goes further than its first."""
    small = "{kind: sine, amplitude: 1.0, frequency_hz: 10.0, duration_s: 3.0, soft_end_s: 0.1}"
    large = "{kind: sine, amplitude: 5.0, frequency_hz: 10.0, duration_s: 1.0, soft_start_s: 0.1}"
    made = checked(f"{{kind: sequence, unit: UNIT, parts: [{small}, {large}]}}")
    position, *_ = position_at(made, 1000)
    kept = seen(monkeypatch)
    assert forecast(made, position, Tuning(1.2, 0.0, 500, 2000)).to_the_end
    assert kept[0].command_max == pytest.approx(6.0, rel=1e-6)
    with pytest.raises(ConfigError, match="must stay within -7 to 7 A, got"):
        forecast(made, position, Tuning(1.5, 0.0, 500, 2000))


def soft(waveform):
    return waveform.replace("duration_s", "soft_start_s: 0.1, soft_end_s: 0.1, duration_s")


@pytest.mark.slow
@pytest.mark.parametrize("model", [None, LOOKING_AHEAD])
@pytest.mark.parametrize("waveform", [SINE, CHIRP])
@pytest.mark.parametrize("chunks", [1, 3, 10**9])
def test_the_verdict_is_that_of_the_loop_to_come(model, waveform, chunks):
    """Range and slew, with a compensator as without; where there is little time to within 8 %."""
    off = 0.02 if chunks > 3 else 0.08
    slew = 1.2 * checked(soft(waveform), model, slew=1e6).forecast.slew_per_s
    made = checked(soft(waveform), model, slew=slew)
    position, compensator, tuner = position_at(made, 1000)
    state, refused = compensator.state(), []
    for gain, samples in itertools.product(np.linspace(0.1, 3.0, 9), (5, 3000)):
        tuning = Tuning(float(gain), 0.3, samples, 2000)
        compensator.restore(state)
        out = put_out(made, compensator, copy(tuner), 1000, 40_000, [tuning])
        of_limits = np.abs(out).max() / 7.0, np.abs(np.diff(out)).max() * 10e3 / slew
        if max(of_limits) > 1.0 + off:
            with pytest.raises(ConfigError, match="must") as error:
                forecast(made, position, tuning, chunks)
            rules = [each.rule for each in error.value.problems]
            assert (
                any("stay within -7 to 7 A" in rule for rule in rules) or of_limits[0] < 1.0 + off
            )
            assert any("no faster" in rule for rule in rules) or of_limits[1] < 1.0 + off
        elif max(of_limits) < 1.0 - off:
            forecast(made, position, tuning, chunks)
        refused.append(max(of_limits) > 1.0)
    assert {True, False} == set(refused)


@pytest.mark.parametrize("chunks", [0, 1, 3])
def test_no_more_is_said_to_be_known_than_was_worked_out(chunks):
    made = checked(soft(CHIRP), LOOKING_AHEAD)
    position, *_ = position_at(made, 1000)
    found = forecast(made, position, Tuning(0.9, 0.0, 500, 2000), chunks)
    assert not found.to_the_end
    assert (found.checked_s > 0) == (chunks > 0)
    assert found.checked_s <= chunks * 4096 / 10e3


def test_a_reference_out_of_the_stroke_is_refused_by_what_is_left_of_it():
    """A peak that has gone by counts no more."""
    decaying = "{kind: decaying, unit: um, amplitude: 8.0, frequency_hz: 10.0, duration_s: 4.0}"
    made = checked(decaying, terfenol_rdpi(), slew=1e6)
    early, *_ = position_at(made, 0)
    late, *_ = position_at(made, 20_000)
    with pytest.raises(ConfigError, match="reference must stay within") as refused:
        forecast(made, early, Tuning(1.0, 55.0, 5000, 2000))
    assert "to 62.9" in str(refused.value)
    with pytest.raises(ConfigError, match="reference must stay within") as refused:
        forecast(made, late, Tuning(-1.0, 58.0, 5000, 22_000))
    assert "to 61.8" in str(refused.value)
    with pytest.raises(ConfigError) as refused:
        forecast(made, late, Tuning(1.0, 55.0, 5000, 22_000))
    assert "reference must stay" not in str(refused.value)


BUDGET = "rms_current_a: 4.0, thermal_time_constant_s: 0.5, "


@pytest.mark.parametrize("chunks", [0, 10**9])
def test_the_thermal_budget_is_kept(chunks):
    """Of cycles that were passed over too; and what the coil has before counts."""
    made = checked(limits=BUDGET)
    position, *_ = position_at(made, 1000)
    assert forecast(made, position, Tuning(1.1, 0.0, 500, 2000), chunks).heat_a2 <= 16.0
    with pytest.raises(ConfigError, match="within 4 A rms"):
        forecast(made, position, Tuning(1.3, 0.0, 500, 2000), chunks)
    hot = replace(position, heat_a2=17.0)
    with pytest.raises(ConfigError, match="within 4 A rms"):
        forecast(made, hot, Tuning(1.1, 0.0, 500, 2000), chunks)


def test_heat_of_cycles_passed_over_is_that_of_each():
    """The geometric row gives what working out every cycle does."""
    made = checked(limits=BUDGET, hz="7.3")
    position, *_ = position_at(made, 1000)
    for start in (0.0, 14.0):
        whole = replace(position, heat_a2=start)
        passed = forecast(made, whole, Tuning(1.1, 0.0, 500, 2000))
        reference = made.begun.input_um[1000:].copy()
        reference[1000:1500] *= 1.0 + 0.1 * np.arange(1, 501) / 500
        reference[1500:] *= 1.1
        heat, highest = start, start
        for value in reference:
            heat += (value**2 - heat) * (1.0 - np.exp(-1.0 / 5000.0))
            highest = max(highest, heat)
        assert passed.heat_a2 == pytest.approx(highest, rel=2e-3)


def test_places_of_the_rest_are_found_in_any_block(monkeypatch):
    """The highest, the lowest and the fastest at or after a sample, to within a block."""
    monkeypatch.setattr(tuned, "_PEAK_BLOCK", 50)
    values = np.random.default_rng(3).normal(size=1003)
    peaks = InputPeaks(values)
    for sample in (0, 49, 50, 500, 951, 1002):
        first = sample // 50 * 50
        rest = values[first:]
        high, low, fast = peaks.after(sample)
        assert high == max(sample, first + int(rest.argmax()))
        assert low == max(sample, first + int(rest.argmin()))
        if rest.size > 3:
            assert fast == max(sample, first + int(np.abs(np.diff(rest)).argmax()))


def test_a_wish_that_is_no_number_is_refused():
    made = checked(model=LOOKING_AHEAD)
    position, *_ = position_at(made, 1000)
    with pytest.raises(ConfigError):
        forecast(made, position, Tuning(1e308, 1e308, 500, 2000))


def test_a_fade_that_is_too_fast_is_refused():
    """Where the two commands are far apart, one sample is too short a time between them."""
    made = checked(SINE, terfenol_rdpi(), slew=200.0)
    position, _, _ = position_at(made, 1000)
    slow, fast = (Tuning(1.0, 0.0, n, 2000, 0.0, made.forecast.line) for n in (500, 1))
    assert forecast(made, position, slow).to_the_end
    with pytest.raises(ConfigError, match="must change no faster than 200 A/s"):
        forecast(made, position, fast)
