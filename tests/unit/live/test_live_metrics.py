"""Running metrics of a run, and the use of each limit."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.samples import BlockBatch, BlockHeader, Flag
from hilctl.base.segments import Segment
from hilctl.experiment.device_rules import TAKEN_AUX_NAMES
from hilctl.live import live_metrics
from hilctl.live.scope import ROW
from hilctl.run.metadata import AuxBounds, RunDescription
from hilctl.run.start import checked_experiment
from hilctl.signals.cycle_metrics import peak_hysteresis_percent
from tests.unit.live.conftest import CONFIGS, traces

RATE, PERIOD = 1000.0, 100.0
SEGMENT = Segment("sine", 30, 100_000, 30, 100_000, PERIOD)


def loop(start, stop, lag=0.2):
    phase = 2 * np.pi * (np.arange(start, stop) - 30) / PERIOD
    reference, displacement = 10.0 * np.sin(phase), 10.0 * np.sin(phase - lag)
    error = displacement - reference
    return traces(start, reference=reference, displacement=displacement, error=error)


def added(figures, samples, segment=SEGMENT, part=37):
    for at in range(0, samples.index.size, part):
        figures.add(samples.rows(slice(at, at + part)), segment)
    return figures


def test_figures_are_those_of_whole_cycles():
    figures = added(live_metrics.RunningMetrics(RATE, "reference"), loop(30, 1200)).newest
    cycle = loop(30, 130).values
    expected = peak_hysteresis_percent(cycle[ROW["reference"]], cycle[ROW["displacement"]])
    assert figures["peak_hysteresis_percent"] == pytest.approx(expected, rel=1e-6)
    error_um = cycle[ROW["error"]]
    assert figures["peak_error_um"] == pytest.approx(np.abs(error_um).max())
    assert figures["rms_error_um"] == pytest.approx(np.sqrt(np.mean(error_um**2)))
    assert figures["peak_to_peak_um"] == pytest.approx(20.0, rel=1e-3)
    assert figures["noise_floor_percent"] < 1e-3


def test_metrics_are_of_the_newest_complete_cycles():
    figures = added(live_metrics.RunningMetrics(RATE, "reference"), loop(75, 2000, lag=0.4))
    assert figures.newest["peak_error_um"] == pytest.approx(20 * np.sin(0.2), rel=1e-3)
    added(figures, loop(2000, 4000, lag=0.1))
    assert figures.newest["peak_error_um"] == pytest.approx(20 * np.sin(0.05), rel=1e-3)


@pytest.mark.parametrize("period", [PERIOD, 0.0])
def test_metrics_of_the_steady_part_stay_in_the_soft_end(period):
    ending = Segment("sine", 30, 1630, 30, 1230, period)
    figures = added(live_metrics.RunningMetrics(RATE, "reference"), loop(30, 1230), ending)
    steady = figures.newest
    assert steady["peak_to_peak_um"] == pytest.approx(20.0, rel=1e-3)
    added(figures, loop(1230, 1630, lag=2.0), ending)
    assert figures.newest == steady


def test_metrics_of_a_steady_part_that_is_shorter_than_a_group():
    short = Segment("sine", 30, 400, 30, 260, PERIOD)
    figures = added(live_metrics.RunningMetrics(RATE, "reference"), loop(30, 400), short).newest
    assert figures["peak_to_peak_um"] == pytest.approx(20.0, rel=1e-3)


def test_invalid_samples_are_omitted():
    samples = loop(30, 1200)
    samples.values[[ROW["displacement"], ROW["error"]], 300] = 1e6
    samples.flags[300] = int(Flag.SENSOR_INVALID)
    assert (
        added(live_metrics.RunningMetrics(RATE, "reference"), samples).newest["peak_error_um"] < 3.0
    )


def test_metrics_without_a_period():
    plain = Segment("steps", 0, 100_000, 0, 100_000)
    figures = added(live_metrics.RunningMetrics(RATE, "reference"), loop(0, 1200), plain).newest
    assert figures["peak_error_um"] == pytest.approx(20 * np.sin(0.1), rel=1e-3)
    assert "peak_hysteresis_percent" not in figures


def test_no_metrics_before_the_first_complete_cycle():
    figures = live_metrics.RunningMetrics(RATE, "reference")
    assert added(figures, loop(30, 90)).newest == {}
    assert added(figures, loop(90, 200), None).newest == {}


def test_each_tick_is_counted_once():
    counts = live_metrics.LatenessCounts()
    assert counts.percentiles_us() == {}
    batch = BlockBatch.empty(5, 1, 1)
    batch.heads[:, BlockHeader.LATE_NS] = (-5, 0, 30_000, 30_000, 9_000_000_000)
    counts.add(batch)
    assert counts.counts.sum() == 5
    assert counts.counts[-1] == 1
    assert counts.counts[np.searchsorted(live_metrics.EDGES_US, 30.0) - 1] == 2
    assert counts.percentiles_us()["p50"] == 30.0
    assert counts.percentiles_us()["max"] == 9e6


def test_line_of_a_sine_in_the_spectrum():
    spectrum = live_metrics.LiveErrorSpectrum(50000.0)
    t_s = np.arange(16384) / 50000.0
    spectrum.add(traces(0, error=5.0 + 0.3 * np.sin(2 * np.pi * 1000.0 * t_s)))
    hz, um = spectrum.points()
    assert um.max() == pytest.approx(0.3, rel=0.1)
    assert hz[um.argmax()] == pytest.approx(1000.0, rel=0.05)


def test_gap_clears_the_spectrum():
    spectrum = live_metrics.LiveErrorSpectrum(1000.0)
    assert spectrum.points()[0].size == 0
    spectrum.add(traces(0, error=np.zeros(300)))
    assert spectrum.points()[0].size > 0
    spectrum.add(traces(300, error=[np.nan, 1.0]))
    assert spectrum.points()[0].size == 0


LIMITS = {"rms_current_a": 5, "thermal_time_constant_s": 10, "tracking_error_um": 8}


@pytest.fixture(scope="module")
def description():
    settings = [f"limits.{key}={value}" for key, value in LIMITS.items()]
    return RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", settings))


def used(headroom, late_s=0.0):
    return {gauge.name: gauge.used for gauge in headroom.gauges(late_s)}


def test_use_of_each_limit(description):
    headroom = live_metrics.Headroom(description)
    headroom.add(traces(0, command=[0.0, 0.1], displacement=[0.0, 26.25], error=[1.0, -4.0]))
    headroom.add(traces(2, command=[0.3], displacement=[0.0], error=[0.0]))
    found = used(headroom, 0.25)
    assert found["command"] == pytest.approx(0.3 / 7.07)
    assert found["slew"] == pytest.approx(0.2 * 50000 / 20000)  # from one look to the next
    assert found["displacement"] == pytest.approx((26.25 + 7.5) / 67.5)
    assert found["tracking error"] == 0.5
    assert found["late tick"] == 0.25
    assert "measured - command" not in found


@pytest.mark.parametrize(("values", "part"), [([-90.0, 20.0], 0.25), ([-90.0], 0.0)])
def test_only_a_highest_value_ignores_negative_ones(description, values, part):
    bounds = AuxBounds(name="coil_c", unit="°C", low=None, high=80.0)
    headroom = live_metrics.Headroom(description.model_copy(update={"aux": [bounds]}))
    found = traces(0, command=np.zeros(len(values)))
    headroom.add(replace(found, values=np.vstack((found.values, values))))
    assert used(headroom)["coil_c"] == part


def test_peak_is_held_for_a_second(description):
    headroom = live_metrics.Headroom(description)
    headroom.add(traces(0, command=[7.07]))
    headroom.add(traces(30_000, command=[1.0]))
    assert used(headroom)["command"] == 1.0
    headroom.add(traces(60_000, command=[1.0]))
    assert used(headroom)["command"] == pytest.approx(1.0 / 7.07)


def test_coil_heat_agrees_with_the_interlock(description):
    headroom = live_metrics.Headroom(description)
    for start in range(0, 500_000, 50_000):  # one time constant
        headroom.add(traces(start, command=np.full(50_000, 5.0)))
    assert used(headroom)["coil heat"] == pytest.approx(math.sqrt(1 - math.exp(-1)), rel=1e-6)


@pytest.mark.parametrize(("part", "level"), [(0.5, "info"), (0.81, "warning"), (0.96, "error")])
def test_level_of_a_gauge(part, level):
    assert live_metrics.Gauge("slew", part, part, 1.0, "A/s").level == level


def test_no_auxiliary_channel_has_the_name_of_a_signal():
    """Its gauge would be that of the signal."""
    names = {*ROW, *live_metrics._HELD}
    assert {name for name in names if name.isidentifier()} <= TAKEN_AUX_NAMES
