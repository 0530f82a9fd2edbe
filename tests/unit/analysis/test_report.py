"""Report of a recording: evaluated samples, metrics, and metrics that are not available."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.analysis.report import processes_of, summarize, worst_segment
from hilctl.analysis.run_metrics import RunReport, run_rows
from hilctl.base.device import AuxChannel
from hilctl.base.errors import DataError
from hilctl.base.events import ADAPTED, LOST_READINGS, MARK, TUNED, ZERO, Event
from hilctl.base.samples import Flag
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording import reader
from hilctl.recording.metadata_keys import USAGE_FACT
from hilctl.recording.reader import RecordingStream, read
from hilctl.recording.recording import Recording, Ticks
from hilctl.recording.time_range import TimeRange
from hilctl.run.metadata import usage_facts

RATE_HZ = 50_000.0
LAG = 0.05
STROKE_UM = 80.0
OFFSET_UM = 0.5
PEAK_ERROR_UM = STROKE_UM * np.sin(LAG / 2.0) + OFFSET_UM  # 2 sin(lag/2) times half the stroke


def wave(period: float, cycles: float, lag: float = 0.0) -> F64:
    """Return whole cycles of a full-stroke sine in um."""
    phase = 2.0 * np.pi * np.arange(np.ceil(period * cycles)) / period
    return 0.5 * STROKE_UM * np.sin(phase - lag)


def segment(start: int, samples: int, period: float, label: str = "sine") -> Segment:
    """Return a segment without soft start or end."""
    return Segment(label, start, start + samples, start, start + samples, period)


@pytest.fixture
def lagging(make_recording):
    """Return a builder of compensated recordings whose displacement lags and is offset."""

    def make(period: float = 1000.0, cycles: int = 5, lag: float = LAG, **more) -> Recording:
        reference_um = wave(period, cycles)
        displacement_um = wave(period, cycles, lag) + OFFSET_UM
        parts = [segment(0, reference_um.size, period)]
        more = {"segments": parts, **more}
        return make_recording(displacement_um, reference_um=reference_um, **more)

    return make


def check_loop(report: RunReport) -> None:
    """Compare the metrics of a lagging sine with their closed forms."""
    assert report.peak_hysteresis_percent == pytest.approx(100.0 * np.sin(LAG), rel=1e-3)
    area = np.pi * (0.5 * STROKE_UM) ** 2 * np.sin(LAG)
    assert report.loop_area == pytest.approx(area, rel=1e-3)
    assert report.peak_to_peak_um == pytest.approx(STROKE_UM, rel=1e-3)
    expected = 100.0 * PEAK_ERROR_UM / STROKE_UM
    assert report.peak_error_percent == pytest.approx(expected, rel=1e-3)
    rms_um = np.hypot(STROKE_UM * np.sin(LAG / 2.0) / np.sqrt(2.0), OFFSET_UM)
    assert report.rms_error_percent == pytest.approx(100.0 * rms_um / STROKE_UM, rel=1e-3)


class TestSteadyPeriodicRun:
    @pytest.mark.parametrize("period", [50_000.0, 200.0, 1000.0 / 3.0])
    @pytest.mark.parametrize("cycles", [1, 3])
    def test_metrics_are_those_of_the_closed_form(self, lagging, period, cycles) -> None:
        """1, 250 and 150 Hz at 50 kHz, one cycle or several, give the same figures."""
        report = summarize(lagging(period, cycles))
        check_loop(report)
        assert report.loop_area_unit == "um*um"
        assert (report.steady_cycles, report.settled) == (max(1, cycles - 1), cycles > 1)
        assert report.segments[0].frequency_hz == pytest.approx(RATE_HZ / period)

    def test_a_cycle_and_a_half_have_not_settled(self, lagging) -> None:
        parts = [Segment("sine", 0, 3000, 1500, 3000, 1000.0)]
        report = summarize(lagging(1000.0, 3, segments=parts))
        assert (report.steady_cycles, report.settled) == (1, False)

    def test_one_cycle_after_the_start_is_left_out(self, lagging) -> None:
        recording = lagging()
        recording.samples.displacement_um[:1000] = 500.0
        check_loop(summarize(recording))

    def test_average_is_less_noisy_than_the_raw_figures(self, lagging) -> None:
        recording = lagging(cycles=41)
        noise_um = np.random.default_rng(1).normal(0.0, 0.5, recording.samples.index.size)
        recording.samples.displacement_um[:] += noise_um
        report = summarize(recording)
        assert report.sensor_noise_um == pytest.approx(0.5, rel=0.05)
        error_percent = 100.0 * PEAK_ERROR_UM / STROKE_UM
        assert report.peak_error_percent == pytest.approx(error_percent, abs=0.4)
        assert report.peak_error_raw_percent > report.peak_error_percent + 1.0
        raw_um = (recording.samples.displacement_um - recording.samples.reference_um)[1000:]
        expected = 100.0 * np.sqrt(np.mean(raw_um**2)) / np.ptp(recording.samples.reference_um)
        assert report.rms_error_raw_percent == pytest.approx(expected)
        assert report.peak_hysteresis_percent == pytest.approx(
            100.0 * np.sin(LAG), abs=2.0 * report.noise_floor_percent
        )

    def test_gaps_in_the_samples_do_no_harm(self, lagging) -> None:
        whole = lagging(cycles=8)
        keep = np.ones(8000, dtype=bool)
        for cycle in range(1, 8):
            keep[1000 * cycle + 90 * cycle : 1000 * cycle + 90 * cycle + 150] = False
        recording = lagging(cycles=8)
        report = summarize(replace(recording, samples=whole.samples.rows(keep), dropped=1050))
        check_loop(report)
        assert report.dropped == 1050
        assert report.steady_samples == 7000 - 1050

    def test_samples_missing_all_through_make_no_cycle(self, lagging) -> None:
        recording = lagging()
        recording.samples.displacement_um[np.arange(5000) % 1000 < 100] = np.nan
        report = summarize(recording)
        assert report.peak_hysteresis_percent is report.peak_to_peak_um is None
        assert report.peak_error_percent is None

    def test_invalid_readings_are_not_evaluated(self, lagging) -> None:
        recording = lagging()
        recording.samples.displacement_um[2500] = np.nan
        recording.samples.displacement_um[2600] = 1e6
        recording.samples.flags[2500] |= Flag.SENSOR_INVALID.value
        recording.samples.flags[2600] |= Flag.SENSOR_INVALID.value
        report = summarize(recording)
        check_loop(report)
        assert report.sensor_invalid_samples == 2
        assert report.steady_samples == 3998

    def test_age_and_number_of_lost_readings(self, lagging) -> None:
        recording = lagging()
        assert "reading age" not in dict(run_rows(summarize(recording)))
        aged = np.linspace(0.001, 0.02, recording.samples.index.size)
        aged[0] = np.nan
        event = Event(4999, "warning", LOST_READINGS, "", {"readings": 7.0})
        samples = replace(recording.samples, reading_age_s=aged)
        report = summarize(replace(recording, samples=samples, events=(event,)))
        assert (report.reading_age_max_s, report.lost_readings) == (0.02, 7)
        assert "reading age" in dict(run_rows(report))

    def test_auxiliary_channels(self, lagging) -> None:
        recording = lagging()
        coil_c = np.linspace(20.0, 30.0, recording.samples.index.size)
        aux = np.column_stack((np.append(np.nan, coil_c[1:]), np.full(coil_c.size, np.nan)))
        channels = AuxChannel("coil_c", "degC", "coil"), AuxChannel("preload_n", "N")
        samples = replace(recording.samples, aux=aux)
        report = summarize(replace(recording, samples=samples, aux_channels=channels))
        found = report.to_mapping()["aux"]
        assert found["coil_c"] == {
            "unit": "degC", "meaning": "coil", "mean": pytest.approx(25.0, abs=0.01),
            "min": coil_c[1], "max": 30.0,
        }  # fmt: skip
        assert found["preload_n"]["mean"] is found["preload_n"]["max"] is None
        assert dict(run_rows(report)).keys() >= {"coil_c", "preload_n"}

    def test_zero_of_the_sensor(self, lagging) -> None:
        assert summarize(lagging()).zero_um is None
        event = Event(0, "info", ZERO, "", {"offset_um": 1.25})
        report = summarize(replace(lagging(), events=(event,)))
        assert report.zero_um == 1.25
        assert dict(run_rows(report))["sensor zero"].startswith("1.250 µm")

    def test_short_period_has_no_noise_estimate(self, lagging) -> None:
        """With 12 samples per period, signal and noise cannot be separated."""
        report = summarize(lagging(period=12.0, cycles=100))
        assert report.sensor_noise_um is None
        assert report.noise_floor_percent is None
        assert report.peak_hysteresis_percent is not None


class TestUncompensatedRun:
    def test_loop_is_against_the_command_and_there_are_no_errors(self, make_recording) -> None:
        command = wave(1000.0, 4) * 6.0 / 40.0
        displacement_um = wave(1000.0, 4, LAG)
        recording = make_recording(
            displacement_um, command=command, segments=[segment(0, 4000, 1000.0)]
        )
        report = summarize(recording)
        assert report.peak_hysteresis_percent == pytest.approx(100.0 * np.sin(LAG), rel=1e-3)
        assert report.loop_area == pytest.approx(np.pi * 6.0 * 40.0 * np.sin(LAG), rel=1e-3)
        assert report.loop_area_unit == "um*A"
        assert report.peak_error_percent is None
        assert report.rms_error_raw_percent is None
        assert (report.command_min, report.command_max) == pytest.approx((-6.0, 6.0))

    def test_reference_beside_an_uncompensated_run_makes_no_errors(self, lagging) -> None:
        report = summarize(replace(lagging(), compensated=False))
        assert report.peak_error_percent is report.peak_error_raw_percent is None


class TestWithoutAPeriod:
    def test_only_raw_figures_exist(self, make_recording) -> None:
        reference_um = np.linspace(0.0, 50.0, 2000)
        error_um = 0.1 * np.sin(np.arange(2000) / 100.0)
        recording = make_recording(
            reference_um + error_um, reference_um=reference_um, segments=[segment(0, 2000, 0.0)]
        )
        report = summarize(recording)
        stroke_um = np.ptp(reference_um + error_um)
        assert report.peak_to_peak_um == pytest.approx(stroke_um)
        wanted_um = np.ptp(reference_um)
        assert report.peak_error_percent == pytest.approx(100.0 * 0.1 / wanted_um, rel=1e-3)
        assert report.peak_error_percent == report.peak_error_raw_percent
        assert report.rms_error_percent == report.rms_error_raw_percent
        assert report.peak_hysteresis_percent is report.loop_area is None
        assert report.noise_floor_percent is None
        assert report.steady_cycles == 0
        assert report.segments[0].frequency_hz is None


class TestCutShort:
    def test_complete_cycles_are_evaluated(self, lagging) -> None:
        recording = lagging(cycles=6)
        recording = replace(recording, samples=recording.samples.part(0, 3700), end={})
        report = summarize(recording)
        check_loop(report)
        assert report.steady_cycles == 2
        assert not report.complete

    def test_ramp_is_not_evaluated(self, lagging) -> None:
        recording = lagging(cycles=6, end={"reason": "stopped"})
        samples = recording.samples
        samples.flags[3700:] |= Flag.RAMP.value
        samples.reference_um[3700:] = np.nan
        samples.displacement_um[3700:] = 0.0
        report = summarize(recording)
        check_loop(report)
        assert not report.complete
        assert (report.samples, report.ramp_samples, report.recorded_samples) == (3700, 2300, 6000)
        assert report.duration_s == pytest.approx(3700 / RATE_HZ)

    def test_segment_not_reached_has_no_figures(self, lagging) -> None:
        recording = lagging()
        later = segment(5000, 4000, 400.0, "not reached")
        report = summarize(replace(recording, segments=(*recording.segments, later), end={}))
        check_loop(report)
        missed = report.segments[1]
        assert missed.peak_hysteresis_percent is None
        assert (missed.samples, missed.steady_samples) == (0, 0)

    def test_empty_recording_has_a_report(self, lagging) -> None:
        recording = lagging(ticks=Ticks(*(np.empty(0, dtype=np.int64),) * 4))
        report = summarize(replace(recording, samples=recording.samples.part(0, 0), end={}))
        assert report.recorded_samples == 0
        assert report.duration_s == 0.0
        assert report.command_min is None
        assert report.lateness_us == {}
        assert report.late_ticks is None
        json.dumps(report.to_mapping(), allow_nan=False)


class TestWholeRun:
    def test_what_was_adapted_in_the_end(self, lagging) -> None:
        events = [Event(k, "info", ADAPTED, "", {"gain": 1.0 + k / 1e4}) for k in (500, 900)]
        events.append(Event(999, "info", "other", ""))
        report = summarize(replace(lagging(), events=tuple(events)))
        assert report.adapted == {"gain": 1.09}
        assert ("adapted", "gain 1.0900") in run_rows(report)
        assert summarize(lagging()).adapted == {}

    def test_marks_are_rows_with_their_time(self, lagging) -> None:
        made = lagging()
        mark = Event(round(0.5 * made.sample_rate_hz), "info", MARK, "tapped \x1b[2J")
        report = summarize(replace(made, events=(mark,)))
        assert report.marks == ((0.5, "tapped \x1b[2J"),)
        assert ("mark", "0.5 s: tapped \\x1b[2J") in run_rows(report)

    def test_worst_segment_counts(self, make_recording) -> None:
        reference_um = np.tile(wave(1000.0, 4), 2)
        displacement_um = np.concatenate((wave(1000.0, 4, 0.02), wave(1000.0, 4, 0.1)))
        parts = [segment(0, 4000, 1000.0, "a"), segment(4000, 4000, 1000.0, "b")]
        recording = make_recording(displacement_um, reference_um=reference_um, segments=parts)
        report = summarize(recording)
        first, second = report.segments
        assert first.peak_hysteresis_percent == pytest.approx(100.0 * np.sin(0.02), rel=1e-3)
        assert report.peak_hysteresis_percent == second.peak_hysteresis_percent
        assert report.peak_error_raw_percent == second.peak_error_raw_percent
        assert report.steady_cycles == 6
        assert report.steady_samples == 6000
        assert second.start_s == pytest.approx(4000 / RATE_HZ)

    def test_noise_floor_is_that_of_the_worst_segment(self, make_recording) -> None:
        """It is not that of a noisier segment with less hysteresis; noise is pooled."""
        rng = np.random.default_rng(8)
        reference_um = np.concatenate((wave(1000.0, 9), 0.1 * wave(1000.0, 3)))
        displacement_um = np.concatenate((wave(1000.0, 9, 0.2), 0.1 * wave(1000.0, 3, 0.01)))
        displacement_um += rng.normal(0.0, 0.05, 12_000)
        parts = [segment(0, 9000, 1000.0), segment(9000, 3000, 1000.0)]
        recording = make_recording(displacement_um, reference_um=reference_um, segments=parts)
        report = summarize(recording)
        first, second = report.segments
        assert worst_segment(report.segments) == 0
        assert first.noise_floor_percent < second.noise_floor_percent
        assert report.noise_floor_percent == first.noise_floor_percent
        pooled = np.sqrt(0.8 * first.sensor_noise_um**2 + 0.2 * second.sensor_noise_um**2)
        assert report.sensor_noise_um == pytest.approx(pooled)

    def test_run_without_segments_has_no_figures(self, lagging) -> None:
        report = summarize(replace(lagging(), segments=()))
        assert report.peak_hysteresis_percent is None
        assert report.sensor_noise_um is None
        assert report.samples == 5000
        assert worst_segment(report.segments) == 0

    def test_complete_needs_an_end_and_the_last_sample(self, lagging) -> None:
        recording = lagging()
        assert summarize(recording).complete
        assert not summarize(replace(recording, end={})).complete
        short = replace(recording, samples=recording.samples.part(0, 4997))
        assert not summarize(short).complete
        lacking = recording.samples.index.size - short.samples.index.size
        assert not summarize(replace(short, dropped=lacking - 1)).complete
        assert summarize(replace(short, dropped=lacking)).complete

    def test_counters_are_those_of_the_run(self, lagging) -> None:
        ticks = Ticks(
            np.arange(0, 5000, 50),
            1_000_000 * np.arange(100),
            np.repeat(np.array([100_000, 700_000]), 50),
            np.full(100, 30_000),
        )
        end = {"late_ticks": "7", "skipped_ticks": "3", "mean_wake_ns": "90000"}
        told = lagging(ticks=ticks, end=end)
        parts = {"wake": 90.0, "compute": 310.0, "exchange": 30.0}
        assert summarize(told).tick_us == pytest.approx(parts)
        assert summarize(told).late_ticks == 7
        assert summarize(told).skipped_ticks == 3
        counted = summarize(replace(told, end={}))
        assert counted.late_ticks is None
        assert counted.skipped_ticks is None
        assert counted.tick_us == {}
        misses = "deadline misses 3 of 103 (2.9 %)"
        assert summarize(told).deadline_misses.startswith(f"{misses}: ")
        kept = replace(told, run={**told.run, "max_missed_share": "0.9"})
        assert summarize(kept).deadline_misses == misses
        assert counted.deadline_misses == ""
        with pytest.raises(DataError, match=r"max_missed_share .*'x'"):
            summarize(replace(told, run={**told.run, "max_missed_share": "x"}))
        assert counted.lateness_us["max"] == pytest.approx(700.0)
        assert counted.exchange_us["p50"] == pytest.approx(30.0)
        assert counted.busy_us["max"] == pytest.approx(730.0)
        assert counted.period_us == pytest.approx(1000.0)

    def test_counter_that_is_no_number_is_refused(self, lagging) -> None:
        with pytest.raises(DataError, match=r"late_ticks .* 'many'"):
            summarize(lagging(end={"late_ticks": "many"}))

    def test_limited_samples_are_those_of_the_waveform(self, lagging) -> None:
        recording = lagging(ramp=100)
        recording.samples.flags[10] |= (Flag.RANGE_LIMITED | Flag.SLEW_LIMITED).value
        recording.samples.flags[11] |= Flag.INVALID.value
        recording.samples.flags[-1] |= Flag.SLEW_LIMITED.value
        assert summarize(recording).limited_samples == 2


GOLDEN = sorted((Path(__file__).parents[3] / "recordings" / "golden").glob("*.mcap"))


def near(found: RunReport, expected: RunReport) -> None:
    """Compare metrics: sums to their rounding, all else exactly."""
    floats, others = zip(*(flat(report.to_mapping()) for report in (found, expected)), strict=True)
    assert floats[0] == pytest.approx(floats[1], rel=1e-9)
    assert others[0] == others[1]


def flat(mapping: dict) -> tuple[dict, dict]:
    """Return the floats of a report and its segments, and all other values."""
    segments = enumerate(mapping.pop("segments"))
    mapping |= {f"{key} {n}": value for n, each in segments for key, value in each.items()}
    floats = {key: value for key, value in mapping.items() if isinstance(value, float)}
    return floats, {key: value for key, value in mapping.items() if key not in floats}


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
@pytest.mark.parametrize("size", [1, 1500, None])
@pytest.mark.parametrize("stretch", [None, TimeRange(0.02, 0.06), TimeRange(0.03, None)])
def test_a_report_in_pieces_is_that_of_the_whole(monkeypatch, path, size, stretch):
    expected = summarize(read(path, stretch))
    if size is None:
        assert summarize(RecordingStream(path, stretch)) == expected
        return
    monkeypatch.setattr(reader, "PIECE_SAMPLES", size)
    near(summarize(RecordingStream(path, stretch)), expected)


class Counted:
    """Pieces of a recording in memory, with the number of passes."""

    def __init__(self, recording: Recording, rows: int) -> None:
        self.walks = 0
        self._recording, self._rows = recording, rows

    def __iter__(self) -> Iterator[Recording]:
        self.walks += 1
        whole, none = self._recording, Ticks(*(np.empty(0, dtype=np.int64),) * 4)
        size = whole.samples.index.size
        for at in range(0, size, self._rows):
            samples = whole.samples.rows(slice(at, at + self._rows))
            yield replace(whole, samples=samples, ticks=none, end={}, events=(), dropped=0)
        yield replace(whole, samples=whole.samples.rows(slice(size, None)))


def test_a_whole_run_is_read_once_and_one_that_ended_early_twice(lagging):
    whole = lagging()
    once = Counted(whole, 700)
    near(summarize(once), summarize(whole))
    assert once.walks == 1
    samples = whole.samples.rows(slice(None, 3300))
    cut = replace(whole, samples=samples)
    tuned = replace(whole, events=(Event(1100, "info", TUNED, "", {"samples": 500.0}),))
    for recording in (cut, tuned):
        twice = Counted(recording, 700)
        near(summarize(twice), summarize(recording))
        assert twice.walks == 2
        assert summarize(twice).steady_cycles < summarize(whole).steady_cycles


def test_no_pieces_are_no_recording():
    with pytest.raises(DataError, match="no recording"):
        summarize([])


LOOP = ProcessUsage(98_000_000, 1_500_000_000, 12, 3, 1234)
SUPERVISOR = ProcessUsage(110_000_000, 0, 0, 0, 0)


def with_end(end):
    return SimpleNamespace(path=Path("run.mcap"), end=end)


@pytest.mark.parametrize("loop", [LOOP, None])
def test_usage_of_processes_is_read(loop):
    known = {"loop": loop} if loop else {}
    assert processes_of(with_end(usage_facts(loop, SUPERVISOR))) == {
        **known,
        "supervisor": SUPERVISOR,
    }


@pytest.mark.parametrize("text", [
    "none",
    "[]",
    '{"loop": {"resident_bytes": 1}}',
    usage_facts(LOOP, SUPERVISOR)[USAGE_FACT].replace("98000000", "-1"),
    usage_facts(LOOP, SUPERVISOR)[USAGE_FACT].replace("98000000", "1" + "0" * 400),
])  # fmt: skip
def test_damaged_usage_is_refused_with_its_place(text):
    with pytest.raises(DataError, match="processes: "):
        processes_of(with_end({USAGE_FACT: text}))


def test_whole_float_is_a_whole_number():
    """Other programs may write it like this."""
    text = usage_facts(LOOP, SUPERVISOR)[USAGE_FACT].replace("98000000", "98000000.0")
    assert processes_of(with_end({USAGE_FACT: text}))["loop"] == LOOP
