"""Model errors as a run would have them, and the time of a sample."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.evaluation import hysteresis_weights, judge
from hilctl.models.linear_stages import FirstMode
from hilctl.models.plays import PpiModel
from hilctl.models.staged import FieldLag, StagedModel

PLAYS = {"direct": 4.0, "weights": (1.0, 2.0), "thresholds": (0.5, 1.5)}
PPI = PpiModel(**PLAYS)
RATE_HZ = 50_000.0


@pytest.mark.parametrize("frequency_hz", [1.0, 50.0, 150.0])
def test_a_model_meets_its_own_loop(loop_of, frequency_hz):
    error = judge(PPI, [loop_of(PPI, 6.0, frequency_hz)])
    assert error.peak_percent <= 0.1
    assert error.errors[0].peak_to_peak_um == pytest.approx(
        error.modelled_um[0].max() * 2.0, rel=0.01
    )


def test_without_a_rate_each_point_is_a_sample(loop_of):
    loop = loop_of(PPI, 6.0)
    unknown = SteadyLoop(loop.label, loop.command, loop.displacement_um, loop.frequency_hz)
    (modelled_um,) = judge(PPI, [unknown]).modelled_um
    np.testing.assert_allclose(modelled_um, loop.displacement_um, atol=1e-9)


def test_errors_are_of_the_right_stroke(loop_of):
    small, large = loop_of(PPI, 1.0), loop_of(PPI, 6.0)
    raised = SteadyLoop("raised", small.command, small.displacement_um + 1.0, 50.0, RATE_HZ)
    error = judge(PPI, [raised, large])
    assert error.errors[0].peak_percent == pytest.approx(
        100.0 / np.ptp(small.displacement_um), 1e-3
    )
    assert error.peak_percent == pytest.approx(100.0 / np.ptp(large.displacement_um), 1e-3)
    expected = np.sqrt(0.5) * 100.0 / np.ptp(large.displacement_um)
    assert error.rms_percent == pytest.approx(expected, 1e-3)


@pytest.mark.parametrize("frequency_hz", [10.0, 17.3])
def test_stages_are_judged_sample_by_sample_at_the_rate_of_the_data(loops_of, frequency_hz):
    """At 1 kHz a lag of 0.1 ms is a whole sample late, not half a one."""
    lag = FieldLag(tau_s=1e-4, growth_per_unit=0.1)
    model = StagedModel.around(PPI, lag=lag, structure=FirstMode(natural_hz=300, damping_ratio=0.1))
    error = judge(model, loops_of(model, [(6.0, frequency_hz)], rate_hz=1000.0))
    assert error.peak_percent <= 0.5
    late = model.model_copy(update={"delay_s": 5e-4})
    assert judge(late, loops_of(model, [(6.0, frequency_hz)], rate_hz=1000.0)).peak_percent > 1.0


def test_a_long_record_has_an_error_for_each_stroke():
    """A constant error of 1 % of the stroke is 2 % of half of it and 10 % of a tenth."""
    amplitudes = np.repeat([1.0, 0.5, 0.1, 0.01], 1000)
    command = amplitudes * np.sin(0.02 * np.pi * np.arange(4000))
    straight = PpiModel(direct=1.0, weights=(), thresholds=())
    record = History("h", command, command + 0.02, 1000.0)
    found = {each.label: each for each in judge(straight, [record]).classes}
    percent = {"full stroke": 1.0, "half stroke": 2.0, "quarter stroke": 4.0, "tenth stroke": 10.0}
    assert {name: round(each.peak_percent, 1) for name, each in found.items()} == percent
    doubled = {each.label for each in judge(straight, [record], stroke_um=4.0).classes}
    assert doubled == {"half stroke", "quarter stroke", "tenth stroke"}


def test_motions_below_all_classes_count_only_if_there_are_no_others():
    command = np.sin(0.02 * np.pi * np.arange(1000))
    straight = PpiModel(direct=1.0, weights=(), thresholds=())
    large, small = (History("h", x, x + 0.02, 1000.0) for x in (command, 0.04 * command))
    assert [each.label for each in judge(straight, [large, small]).classes] == ["full stroke"]
    (tenth,) = judge(straight, [small], stroke_um=2.0).classes
    assert (tenth.label, tenth.peak_percent) == ("tenth stroke", pytest.approx(25.0))


@pytest.mark.parametrize("error_um", [0.0, 0.01, 0.1])
def test_sensor_noise_is_not_an_error_of_the_model(error_um):
    time_s = np.arange(20_000) / 10_000.0
    command = np.sin(20.0 * np.pi * time_s)
    noise_um = 0.02 * np.random.default_rng(4).standard_normal(time_s.size)
    off_um = error_um * np.sin(100.0 * np.pi * time_s)
    record = History("h", command, command + off_um + noise_um, 10_000.0)
    (full,) = judge(PpiModel(direct=1.0, weights=(), thresholds=()), [record]).classes
    averaged = np.sinc(5.0 / 25.0)  # a harmonic over a 25th of a cycle
    expected = 100.0 * error_um * averaged / np.ptp(record.displacement_um)
    assert full.rms_percent == pytest.approx(expected / np.sqrt(2.0), abs=0.1)
    assert full.peak_percent == pytest.approx(expected, abs=0.45)


TURN = 2.0 * np.pi * np.arange(400) / 400


def ellipse(lag: float, *, frequency_hz: float = 1.0, amplitude: float = 2.0) -> SteadyLoop:
    """Return y = 10 sin(t - lag) over v = amplitude sin t."""
    return SteadyLoop(
        f"{frequency_hz:g} Hz", amplitude * np.sin(TURN), 10.0 * np.sin(TURN - lag), frequency_hz
    )


def test_loops_with_minor_loops_have_a_weight():
    command = np.sin(TURN) + 0.5 * np.sin(3.0 * TURN)
    lagging = np.roll(command, 10)
    slow, fast = (
        SteadyLoop("slow", command, lagging, 1.0),
        SteadyLoop("fast", command, command, 2.0),
    )
    np.testing.assert_allclose(hysteresis_weights([slow, fast]), [1.0, 0.0], atol=1e-12)


def test_weights_are_relative_to_the_slowest_and_largest():
    fast = ellipse(0.6, frequency_hz=100.0)
    small = ellipse(0.5, amplitude=1.0)
    weights = hysteresis_weights([fast, small, ellipse(0.3)])
    expected = np.sin([0.6, 0.5, 0.3]) / np.sin(0.3)
    np.testing.assert_allclose(weights, expected, rtol=4e-3)


def test_weights_need_loops():
    history = History("decay", np.sin(TURN), np.sin(TURN), 100.0)
    with pytest.raises(DataError, match="weight_by"):
        hysteresis_weights([ellipse(0.3), history])
