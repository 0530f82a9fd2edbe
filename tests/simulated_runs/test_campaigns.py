"""The shipped campaigns on the simulated rig: every trend that the dissertation states.

Equation, figure and section numbers are those of the dissertation (chapters 2, 4 and 6).
"""

import csv
import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from hilctl.lab.studies.campaign.campaign_runner import planned_fast, run_fast
from hilctl.lab.studies.campaign.steps import load_campaign
from hilctl.lab.studies.multi_run import trend
from hilctl.lab.studies.multi_run.collect import collect
from hilctl.lab.studies.multi_run.plots import sheets_of
from hilctl.lab.studies.study import StudyHost
from hilctl.recording.reader import read
from tests.commands import ended, typed

CAMPAIGNS = Path(__file__).parents[2] / "configs" / "campaigns"

pytestmark = pytest.mark.long


class Table:
    """A campaign's table; columns by name."""

    def __init__(self, path):
        with path.open(newline="", encoding="utf-8") as stream:
            self.rows = [row for row in csv.DictReader(stream) if row["reference_run"] == "False"]

    def where(self, **chosen):
        """Rows of these values, by the last part of their keys."""
        keys = {name.split(".")[-1]: name for name in self.rows[0] if "." in name}
        keys = {**keys, **{name: name for name in self.rows[0]}}
        found = Table.__new__(Table)
        found.rows = [
            row
            for row in self.rows
            if all(row[keys[key]] == str(value) for key, value in chosen.items())
        ]
        assert found.rows
        return found

    def __getitem__(self, name):
        return np.array([float(row[name]) for row in self.rows])


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Run a shipped campaign, each once; return its table."""
    tables = {}

    def run(name):
        if name not in tables:
            folder = tmp_path_factory.mktemp(name)
            plan = planned_fast(load_campaign(CAMPAIGNS / f"{name}.yaml"), folder)
            result = run_fast(plan, StudyHost(), "processes")
            assert result.count("completed") == len(plan.steps), result.reason
            tables[name] = (Table(result.tables[0]), result)
        return tables[name]

    return run


def r2(x, y):
    slope, offset = np.polyfit(x, y, 1)
    return 1.0 - np.sum((y - slope * x - offset) ** 2) / np.sum((y - y.mean()) ** 2)


FREQUENCY = "waveform.frequency_hz"
AMPLITUDE = "waveform.amplitude"


class TestAmplitude:
    """Chapter 4, figures 4.2 to 4.5; chapter 2, figures 2.7 to 2.10."""

    @pytest.fixture
    def table(self, ran):
        return ran("amplitude")[0]

    @pytest.mark.parametrize("amplitude", [3.0, 7.0])
    def test_the_stroke_does_not_depend_on_frequency(self, table, amplitude):
        """Figure 4.5 (a)."""
        strokes = table.where(amplitude=amplitude)["peak_to_peak_um"]
        assert np.ptp(strokes) < 0.02 * strokes.mean()

    def test_stroke_and_area_grow_with_amplitude_and_saturate(self, table):
        """Figure 4.3: most a current from 3 to 6 A, less below and above."""
        chosen = table.where(frequency_hz=10.0)
        strokes, areas = chosen["peak_to_peak_um"], chosen["loop_area"]
        assert (np.diff(strokes) > 0.0).all()
        assert (np.diff(areas) > 0.0).all()
        slope = np.diff(strokes)
        assert 2 <= int(np.argmax(slope)) <= 5
        assert slope[-1] < 0.7 * slope.max()
        assert slope[0] < 0.95 * slope.max()

    def test_asymmetry_grows_with_amplitude(self, table):
        """4.2.2: from 6.4 % at 3 A to 17.3 % at 9 A; this rig's grows no more from 7 A on."""
        chosen = table.where(frequency_hz=10.0)
        percent = 100.0 * (-chosen["high_um"] - chosen["low_um"]) / chosen["peak_to_peak_um"]
        assert (np.diff(percent[1:7]) > 0.0).all()
        assert percent[2] == pytest.approx(6.4, abs=5.0)
        assert percent[8] == pytest.approx(17.31, abs=2.0)

    def test_the_reference_run_shows_no_drift(self, ran):
        drift = ran("amplitude")[1].drift
        assert drift.runs == 4
        assert abs(drift.peak_to_peak_percent) < 0.1
        assert abs(drift.mean_um) < 0.02


class TestBias:
    """Chapter 4, figure 4.6; chapter 2, figures 2.15 and 2.16."""

    @pytest.fixture
    def table(self, ran):
        return ran("bias")[0]

    @pytest.mark.parametrize("frequency", [10.0, 25.0, 50.0, 100.0, 150.0, 200.0])
    def test_more_bias_less_stroke_and_less_hysteresis(self, table, frequency):
        """From 35 kA/m on; at 25 kA/m this rig is below the field of its largest stroke."""
        chosen = table.where(frequency_hz=frequency)
        order = np.argsort(chosen["device.bias_a"])[1:]
        for name in ("peak_to_peak_um", "loop_area"):
            assert (np.diff(chosen[name][order]) < 0.0).all()

    def test_frequency_changes_the_hysteresis_not_the_stroke(self, table):
        """2.3.4.3: peak displacement is not affected by the rate, which yields more hysteresis."""
        for bias in {row["device.bias_a"] for row in table.rows}:
            chosen = table.where(bias_a=bias)
            order = np.argsort(chosen[FREQUENCY])
            assert np.ptp(chosen["peak_to_peak_um"]) < 0.02 * chosen["peak_to_peak_um"].mean()
            assert (np.diff(chosen["peak_hysteresis_percent"][order]) > 0.0).all()
            assert r2(chosen[FREQUENCY], chosen["loop_area"]) >= 0.99


class TestLoads:
    """Chapter 2, section 3.4.4: 2300 Hz unloaded, damping 0.12, and less with every load."""

    def test_natural_frequency_and_damping(self, ran):
        """By a step of 1 A and by the small-signal response: sqrt(k/m) / 2 pi."""
        for row in ran("loads")[0].rows:
            mass_kg = 0.162 + float(row["device.load_kg"])
            natural_hz = np.sqrt(33.597e6 / mass_kg) / (2.0 * np.pi)
            assert float(row["natural_hz"]) == pytest.approx(natural_hz, rel=0.02)
            step = json.loads(row["waveform"])["kind"] == "step"
            wanted = pytest.approx(0.12, rel=0.05 if step else 0.15)
            assert float(row["damping_ratio"]) == wanted

    def test_the_response_to_sines(self, ran):
        """Figures 2.20 and 2.21: it peaks near the natural frequency, lower and more with load."""
        table = ran("loads_sines")[0]
        peaks = []
        for load, natural_hz in ((0.0, 2292.0), (3.7, 469.5), (9.2, 301.6)):
            chosen = table.where(load_kg=load)
            relative = chosen["peak_to_peak_um"] / chosen["peak_to_peak_um"][0]
            best = int(np.argmax(relative))
            assert chosen[FREQUENCY][best] == pytest.approx(natural_hz, rel=0.05)
            peaks.append(relative[best])
        assert peaks == sorted(peaks)
        assert peaks[0] > 1.5


class TestCompensation:
    """Chapter 6, figure 6.13: 18.2 to 49.1 % before, 3.7 % at most after."""

    def test_harmonic(self, ran):
        table = ran("compensation")[0]
        before = table.where(compensator="none")
        assert before["peak_hysteresis_percent"][0] == pytest.approx(18.2, abs=1.0)
        assert before["peak_hysteresis_percent"][-1] == pytest.approx(49.1, abs=1.0)
        assert (np.diff(before["peak_hysteresis_percent"]) > 0.0).all()
        after = table.where(compensator='{"model": "models/terfenol_staged.yaml"}')
        assert after["peak_hysteresis_percent"].max() <= 3.7
        omega = table.where(compensator='{"model": "models/terfenol_omega.yaml"}')
        assert (omega["peak_hysteresis_percent"] < 0.2 * before["peak_hysteresis_percent"]).all()

    def test_complex(self, ran):
        """3.1 um of 83.1 um, 3.7 %, is what was left."""
        table = ran("compensation_complex")[0]
        after = table.where(compensator='{"model": "models/terfenol_staged.yaml"}')
        assert after["peak_error_percent"].max() <= 3.7
        assert table.where(compensator="none")["peak_hysteresis_percent"].min() > 25.0


FEW = """\
name: few
experiment: rig.yaml
vary: {waveform.amplitude: [2.0, 3.0, 2.5, 3.5]}
"""
RIG = """\
name: rig
device: {kind: simulated_terfenol}
sample_rate_hz: 2000
block: 20
waveform:
  {kind: sine, unit: A, amplitude: 2.0, frequency_hz: 5.0, duration_s: 1.5, soft_start_s: 0.2}
compensator: none
limits:
  peak_current_a: 4.0
  slew_a_per_s: 500.0
  stroke_um: [-75.0, 60.0]
  rms_current_a: 2.5
  thermal_time_constant_s: 5.0
recording: {flush_s: 0.2, ring_s: 2.0}
timing: {max_missed_share: 1}
"""


@pytest.mark.timeout(600)
def test_killed_campaign_loses_one_run_and_continues(tmp_path):
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "few.yaml").write_text(FEW)
    runs = tmp_path / "runs"
    command = typed("campaign", tmp_path / "few.yaml", "--folder", runs)
    process = subprocess.Popen(command, env=os.environ, stdout=subprocess.DEVNULL)
    second = runs / "few-0002.mcap"
    deadline = time.monotonic() + 240.0
    while not (second.exists() and second.stat().st_size > 3000):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    first = (runs / "few-0001.mcap").read_bytes()
    ended(command, env=os.environ)
    assert (runs / "few-0001.mcap").read_bytes() == first
    with (runs / "few.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["result"] for row in rows] == ["completed"] * 4
    begun = sorted(
        (read(path) for path in runs.glob("*.mcap")), key=lambda each: each.run["started"]
    )
    assert len(begun) == 5
    assert sum(each.end["code"] == "completed" for each in begun) == 4
    assert all(float(each.run["coil_heat_a2"]) > 0.0 for each in begun[1:])


def trends_of(series, figure, name):
    """Trends of what nothing compensated, along a dimension by its name."""
    along = next(each for each in series.dimensions if each.name == name)
    plain = [run for run in series.done if run.digest.is_plain_loop]
    return trend.trends(series, figure, along, plain)


class TestFiguresAndTrends:
    """What page and figures say of the shipped campaigns is what the dissertation states."""

    @pytest.fixture
    def series(self, ran):
        return lambda name: collect([ran(name)[1].tables[0].parent])

    @pytest.mark.parametrize(("name", "along", "groups"), [
        ("amplitude", "frequency", 9),
        ("bias", "frequency", 6),
        ("waveforms", "frequency of sine 1", 3),
        ("compensation", "frequency", 1),
    ])  # fmt: skip
    def test_area_and_peak_hysteresis_are_linear_in_frequency(self, series, name, along, groups):
        """4.2.3, figures 4.5 (b), 5.5, 6.4: r2 = 0.99, and both grow; the stroke does not."""
        found = series(name)
        for figure in (trend.AREA, trend.HYSTERESIS):
            lines = trends_of(found, figure, along)
            assert len(lines) == groups
            assert min(line.r2 for line in lines) >= 0.99
            assert {line.direction for line in lines} == {"rises"}
        strokes = trends_of(found, trend.STROKE, along)
        assert {line.direction for line in strokes} == {"does not change"}

    def test_more_bias_more_saturation(self, series):
        """Figure 4.6: from 35 kA/m on loops lose their symmetry, and the stroke gets less."""
        found = series("bias")
        for line in trends_of(found, trend.ASYMMETRY, "bias current"):
            assert (np.diff(line.y[1:]) > 0.0).all()
        for line in trends_of(found, trend.STROKE, "bias current"):
            assert (np.diff(line.y[1:]) < 0.0).all()

    def test_the_natural_frequency_falls_with_the_load_and_the_damping_stays(self, series):
        """Section 3.4.4 of chapter 2; 0.12 without load."""
        found = series("loads")
        load = next(each for each in found.dimensions if each.name == "load")
        assert {line.direction for line in trend.trends(found, trend.NATURAL, load)} == {"falls"}
        assert all(
            np.ptp(line.y) < 0.1 * line.y.mean()
            for line in trend.trends(found, trend.DAMPING, load)
        )

    @pytest.mark.parametrize(
        ("name", "figures"),
        [
            ("amplitude", {"loops_by_amplitude", "hysteresis_against_frequency"}),
            ("bias", {"loops_by_bias_current", "hysteresis_against_bias_current"}),
            ("waveforms", {"hysteresis_against_frequency_of_sine_1"}),
            ("loads", {"resonance_against_load"}),
            ("loads_sines", {"loops_by_load", "hysteresis_against_frequency"}),
            ("compensation", {"before_and_after", "model_against_measured"}),
            ("compensation_complex", {"before_and_after"}),
        ],
    )  # fmt: skip
    def test_each_campaign_has_its_figures(self, series, name, figures):
        assert figures <= {sheet.name for sheet in sheets_of(series(name))}
