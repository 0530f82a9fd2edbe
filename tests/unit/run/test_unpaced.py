"""Runs without real time: batches of blocks, virtual time, simulated devices only."""

import errno
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pyarrow import parquet

from hilctl.analysis.catalogue import read_catalogue, select
from hilctl.analysis.export import columns, export_all
from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.base.errors import InputError
from hilctl.base.samples import BlockHeader, Flag
from hilctl.experiment.preflight import CheckedRun
from hilctl.recording import writer
from hilctl.recording.metadata_keys import END_FIGURES
from hilctl.recording.reader import read
from hilctl.recording.writer import PendingFile
from hilctl.run.assemble import assemble, axis_plan
from hilctl.run.start import checked_experiment, checked_run
from hilctl.run.unpaced import OfflineLane, run_in_memory, run_unpaced
from tests.fakes import FailingFile

UNCOMPENSATED = Path(__file__).parents[3] / "configs" / "terfenol_sine_6a_uncompensated.yaml"
SHORT = ["waveform.duration_s=0.25", "waveform.frequency_hz=100"]


def plan(block, latency_blocks):
    compensator, interlocks = SimpleNamespace(state_size=0), SimpleNamespace(aux=())
    axis = SimpleNamespace(compensator=compensator, interlocks=interlocks)
    return SimpleNamespace(block=block, latency_blocks=latency_blocks), axis


@pytest.mark.parametrize(("pending_bytes", "writes_before"), [(0, 12), (1 << 20, 1)])
def test_a_refused_write_costs_nothing(tmp_path, monkeypatch, pending_bytes, writes_before):
    disks = []

    class Refused(PendingFile):
        def __init__(self, raw, **options):
            super().__init__(disk := FailingFile(raw.name), **options)
            raw.close()
            disk.write_errors = [None] * writes_before + [errno.EIO]
            disks.append(disk)

    monkeypatch.setattr(writer, "PendingFile", Refused)
    monkeypatch.setattr(writer, "_MOST_PENDING_BYTES", pending_bytes)
    checked = checked_run(UNCOMPENSATED, SHORT)
    result = run_unpaced(checked, tmp_path / "run.mcap")
    assert not disks[0].write_errors
    assert (result.code, result.missing) == ("completed", 0)
    recording = read(result.path)
    assert recording.samples.index.size == result.samples > 0
    assert recording.end["code"] == "completed"


@pytest.mark.parametrize(
    ("settings", "value"),
    [([], 30.0), (["device.fault={kind: aux_nan, at_sample: 2000}"], np.nan)],
)
def test_an_auxiliary_channel_ends_a_run(tmp_path, settings, value):
    settings += ["device.temperatures={coil_tau_s: 0.2}", "limits.aux={coil_c: 30}"]
    result = run_unpaced(checked_run(UNCOMPENSATED, SHORT + settings), tmp_path / "r.mcap")
    recording = read(result.path)
    (fault,) = (each for each in recording.events if each.code == "aux")
    at = int(np.searchsorted(recording.samples.index, fault.sample))
    assert (result.code, fault.level) == ("fault", "error")
    assert recording.aux["coil_c"][at] == pytest.approx(value, abs=0.5, nan_ok=True)
    assert recording.samples.command[-1] == 0.0
    highest = select(read_catalogue(tmp_path), "aux.rod_c.max < aux.coil_c.max")[0]["options"]
    assert highest["aux.coil_c.max"] == np.nanmax(recording.aux["coil_c"])
    assert [*columns(recording)][-3:] == ["coil_c", "rod_c", "flags"]


def test_all_exported_files_have_the_auxiliary_channels_of_all_runs(tmp_path):
    for name, settings in (("plain", []), ("warm", ["device.temperatures={coil_tau_s: 0.2}"])):
        run_unpaced(checked_run(UNCOMPENSATED, SHORT + settings), tmp_path / f"{name}.mcap")
    assert export_all(tmp_path, tmp_path / "out", lambda part, path: None).written == 2
    for name, channels in (("plain", set()), ("warm", {"coil_c", "rod_c"})):
        (path,) = (tmp_path / "out").rglob(f"{name}-*.parquet")
        table = parquet.ParquetFile(path).read()
        aux = table.select(["coil_c", "rod_c"])
        assert {each for each in aux.column_names if not aux[each].null_count} == channels


@pytest.mark.parametrize("latency", [0, 3])
def test_every_block_comes_once_and_in_order(latency):
    firsts, seen = [], []

    def take(batch):
        firsts.extend(batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist())
        seen.extend(batch.columns[:, 0, 0].tolist())

    lane = OfflineLane(*plan(2, latency), on_batch=take, on_event=None)
    waiting = []
    for number in range(1000):
        block = lane.claim()
        block.head[BlockHeader.FIRST_SAMPLE] = 2 * number
        block.reference[:] = number
        waiting.append(block)
        if len(waiting) > latency:
            assert lane.answered(waiting.pop(0))
    for block in waiting:
        lane.answered(block)
    lane.flush()
    assert firsts == [2 * number for number in range(1000)]
    assert seen == list(range(1000))


@pytest.mark.parametrize("output", [7.0, -9.5])
def test_run_from_another_output_ramps_in_and_replays(tmp_path, output):
    plain = read(run_unpaced(checked_run(UNCOMPENSATED, SHORT), tmp_path / "a.mcap").path)
    checked = checked_run(UNCOMPENSATED, [*SHORT, f"device.output_at_open={output}"])
    result = run_unpaced(checked, tmp_path / "b.mcap")
    recording = read(result.path)
    assert (result.code, result.missing, recording.dropped) == ("completed", 0, 0)
    (segment,) = recording.segments
    n = segment.start
    assert n > 0
    samples, limits = recording.samples, checked.config.command_limits()
    steps = np.abs(np.diff([output, *samples.command]))
    assert steps.max() <= limits.slew_per_s / recording.sample_rate_hz * (1 + 1e-9)
    assert samples.command[n:].tolist() == plain.samples.command.tolist()
    assert (samples.flags[:n] == Flag.RAMP).all()
    assert recording.events[0].code == "start_ramp"
    replayed = replay(recording)
    assert (replayed.identical, replayed.samples) == (True, samples.index.size)
    before, after = summarize(plain), summarize(recording)
    assert after.samples == before.samples
    assert after.complete
    assert after.peak_hysteresis_percent == pytest.approx(before.peak_hysteresis_percent, rel=0.1)


@pytest.mark.parametrize(("settings", "words"), [
    (["device.output_at_open=null"], "safe.at_start is required"),
    (["device.output_at_open=30.0"], "output is 30 A"),
])  # fmt: skip
def test_unknown_or_impossible_start_is_refused(tmp_path, settings, words):
    checked = checked_run(UNCOMPENSATED, [*SHORT, *settings])
    with pytest.raises(InputError, match=words):
        run_unpaced(checked, tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []


def test_start_of_a_device_without_readback_is_set_by_the_user(tmp_path):
    settings = ["device.output_at_open=null", "safe.at_start=0.0"]
    result = run_unpaced(checked_run(UNCOMPENSATED, [*SHORT, *settings]), tmp_path / "r.mcap")
    assert result.code == "completed"


def test_real_devices_are_refused_before_a_file_is_created(tmp_path):
    checked = checked_experiment(UNCOMPENSATED, SHORT)
    info = replace(checked.loaded.device.info, simulated=False)
    loaded = replace(checked.loaded, device=SimpleNamespace(info=info))
    with pytest.raises(InputError, match="simulated"):
        run_unpaced(CheckedRun((replace(checked, loaded=loaded),)), tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []


def test_run_in_memory_equals_the_recorded_run(tmp_path):
    checked = checked_experiment(UNCOMPENSATED, SHORT)
    recorded = read(run_unpaced(CheckedRun((checked,)), tmp_path / "run.mcap").path).samples
    loaded, begun = checked.loaded, checked.begun
    axis = axis_plan(loaded, checked.reference.values, begun.input_um, begun.state)
    made = assemble(loaded, [axis], paced=False)
    outcome, [samples] = run_in_memory(made, [loaded.device])
    assert outcome.code == "completed"
    assert samples.index.tolist() == recorded.index.tolist()
    assert samples.command.tobytes() == recorded.command.tobytes()
    assert samples.displacement_um.tobytes() == recorded.displacement_um.tobytes()
    assert samples.flags.tobytes() == recorded.flags.tobytes()


@pytest.mark.parametrize("name", ["terfenol_sine_6a_uncompensated", "terfenol_sine_6a"])
def test_end_of_a_recording_has_the_metrics_of_the_report(tmp_path, name):
    """They can be read without the samples."""
    soft = [f"waveform.soft_{end}_s=0.05" for end in ("start", "end")]
    checked = checked_run(UNCOMPENSATED.with_stem(name), [*SHORT, *soft])
    recording = read(run_unpaced(checked, tmp_path / "run.mcap").path)
    report = summarize(recording).to_mapping()
    found = {key: float(recording.end[key]) for key in END_FIGURES if key in recording.end}
    assert found == pytest.approx({key: report[key] for key in END_FIGURES if report[key]})
    assert recording.run["waveform.kind"] == "sine"
    assert float(recording.run["waveform.frequency_hz"]) == 100.0


CURRENT = "waveform={kind: %s, unit: A, amplitude: 3.0, duration_s: 1.0, %s}"


@pytest.mark.parametrize(("name", "settings"), [
    ("demo", ["waveform.duration_s=1"]),
    ("terfenol_sine_6a", ["waveform.duration_s=1"]),
    ("terfenol_sine_6a", ["sample_rate_hz=2000", "block=1", "waveform.frequency_hz=20"]),
    ("piezo_sine", []),
    ("terfenol_sine_6a_uncompensated", []),
    ("terfenol_sine_6a_uncompensated", [CURRENT % ("random", "first_hz: 1, last_hz: 99")]),
])  # fmt: skip
def test_size_of_the_recording_is_forecast(tmp_path, name, settings):
    checked = checked_run(UNCOMPENSATED.with_name(f"{name}.yaml"), settings)
    result = run_unpaced(checked, tmp_path / "run.mcap")
    expected = checked.first.forecast.recording_mb * 1e6
    assert expected == pytest.approx(result.path.stat().st_size, rel=0.3)
