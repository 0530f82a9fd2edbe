"""The last run of a device, kept by the device alone, and the compensator that begins with it."""

import os
from dataclasses import replace
from datetime import datetime
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.errors import ConfigError, DataError
from hilctl.base.samples import COLUMNS, BlockBatch, BlockHeader, Flag
from hilctl.base.yaml import Document
from hilctl.experiment.coil_heat import CoilHeat
from hilctl.experiment.device_state import (
    finish_state,
    heat_after,
    heat_before,
    initial_state_after,
    left_by_last_run,
)
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.compensator import InitialState, left_by
from hilctl.experiment.state_files import (
    CoilState,
    DeviceState,
    MachineTime,
    last_runs,
    write_state,
)
from hilctl.models.effective_field import FieldLosses
from hilctl.models.linear_stages import CreepModel, FirstMode
from hilctl.models.model_file import dump_model
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.writer import RecordingWriter, RunFacts
from tests.published import piezo_ppi
from tests.unit.models.test_effective_field import field_model
from tests.unit.models.test_staged import OMEGA

RATE_HZ = 10_000.0
BLOCK = 50
STAGED = StagedModel.around(
    OMEGA, lag=FieldLag(tau_s=2e-4, growth_per_unit=0.2), delay_s=2.0 / RATE_HZ
)
CREEPING = STAGED.model_copy(
    update={"creep": CreepModel(time_constants_s=(0.3, 20.0), shares=(0.03, 0.05))}
)
LATER_S = datetime.fromisoformat("2026-01-01T00:01:00+00:00").timestamp()
COMMAND = 4.0 * np.sin(np.pi * np.arange(1000) / 999.0)


def record(path, command, *, first=0, skipped=0, flags=0, facts=None, **made):
    """Write a run of these commands without a compensator, with ticks skipped in the middle."""
    blocks = command.size // BLOCK
    batch = BlockBatch.empty(blocks, BLOCK, 1)
    batch.heads[:, BlockHeader.FIRST_SAMPLE] = first + BLOCK * np.arange(blocks)
    batch.heads[:, BlockHeader.SAMPLES] = BLOCK
    batch.heads[0, BlockHeader.DROPPED_BEFORE] = first
    batch.columns[:, list(COLUMNS).index("command")] = command.reshape(blocks, BLOCK)
    batch.flags[-1, -1] = flags
    if skipped:
        batch.heads[blocks // 2 :, BlockHeader.FIRST_SAMPLE] += skipped
        batch.heads[blocks // 2, BlockHeader.DROPPED_BEFORE] = skipped
        batch.flags[blocks // 2] |= Flag.AFTER_SKIPPED.value
    return write_recording(path, batch, facts={"run_id": "before", **(facts or {})}, **made)


def write_recording(
    path, batch, rate_hz=RATE_HZ, *, whole=True, facts=None, end=None, measured=False
):
    """Write blocks of a run without a compensator."""
    run = RunFacts(
        facts={"compensator": "none", **(facts or {})},
        segments=(),
        experiment_yaml="name: made\n",
        model_yaml="",
        layout=RecordingLayout(
            sample_rate_hz=rate_hz,
            command_unit="A",
            measures_command=measured,
            scope_rate_hz=1000.0,
            start_unix_ns=1_700_000_000_000_000_000,
        ),
    )
    with path.open("xb") as stream:
        writer = RecordingWriter(stream, run)
        writer.batch(batch)
        if whole:
            writer.finish({"code": "completed", **(end or {})}, writer.samples)
        else:
            writer.flush()
    return path


def state_after(path, model, rate_hz=RATE_HZ, safe=0.0):
    return initial_state_after(path, model, rate_hz, LATER_S, safe)


@pytest.mark.parametrize("model", [OMEGA, STAGED], ids=["integrated", "staged"])
def test_compensator_goes_on_where_the_actuator_was_left(tmp_path, model):
    memory = state_after(record(tmp_path / "run.mcap", COMMAND), model)
    plant, inverse = model.forward(RATE_HZ), model.inverse(RATE_HZ)
    plant.process(np.concatenate((COMMAND, np.full(20_000, COMMAND[-1]))))
    assert abs(memory.stands_um) > 0.5
    assert memory.run_id == "before"
    reference = np.linspace(0.0, 10.0, 500) + 5.0 * np.sin(np.arange(500) / 60.0)
    fed = np.concatenate((reference[inverse.preview :], np.full(inverse.preview, reference[-1])))
    fed = memory.lead_in(fed, 100)
    inverse.restore(memory.state)
    command = inverse.process(fed.copy())
    assert abs(command[0] - COMMAND[-1]) < 1e-9
    came = plant.process(command)
    wanted = np.concatenate((np.full(inverse.preview, memory.stands_um), fed))[:500]
    np.testing.assert_allclose(came, wanted, atol=1e-9)
    np.testing.assert_allclose(came[110:], reference[110:], atol=1e-9)


@pytest.mark.parametrize("down", [4, 31])
def test_inverse_begins_at_the_last_command(down):
    """The inverse of a lag is inexact after the corner of a ramp: it could begin below a limit."""
    lagging = field_model(losses=FieldLosses(field_s=2.4e-3, growth=0.01))
    up = 2.0 - 2.0 * np.cos(np.linspace(0.0, np.pi, 50))
    model = StagedModel.around(lagging, delay_s=2.5e-3)
    left = left_by([up, np.linspace(4.0, 0.0, down), np.zeros(100)], model, 100.0)
    inverse = model.inverse(100.0)
    inverse.restore(left.state)
    assert inverse.process(np.full(5, left.stands_um)) == pytest.approx(np.zeros(5), abs=1e-4)


@pytest.mark.parametrize("model", [OMEGA, STAGED, CREEPING], ids=["integrated", "staged", "creep"])
def test_a_run_in_pieces_leaves_what_the_whole_leaves(model):
    whole = left_by([COMMAND], model, RATE_HZ)
    pieces = np.split(COMMAND, [1, 2, 2, COMMAND.size // 2])
    left = left_by(pieces, model, RATE_HZ)
    assert left.stands_um == whole.stands_um
    np.testing.assert_array_equal(left.state, whole.state)


@pytest.mark.parametrize(("ended", "still_s"), [
    ("2026-01-01T00:00:56.500+00:00", 3.5),
    ("2026-01-01T00:01:09.000+00:00", 1.0),
    ("yesterday", 1.0),
])  # fmt: skip
def test_what_has_crept_goes_back_until_the_next_run(tmp_path, ended, still_s):
    path = record(tmp_path / "run.mcap", COMMAND, end={"ended": ended})
    left = state_after(path, CREEPING)
    still = np.full(round(still_s * RATE_HZ) + 1, COMMAND[-1])
    wanted = left_by([COMMAND, still], CREEPING, RATE_HZ)
    gone = left_by([COMMAND], CREEPING, RATE_HZ)
    assert abs(gone.stands_um - wanted.stands_um) > 0.02
    assert left.stands_um == pytest.approx(wanted.stands_um, abs=1e-6)
    np.testing.assert_allclose(left.state, wanted.state, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(("facts", "safe"), [
    ({"safe_value": "0.0"}, 0.0),  # set by the guardian, so it is not among the samples
    ({"safe_value": "-1.0"}, 0.0),
    ({}, -1.0),
])  # fmt: skip
def test_the_output_rests_at_the_safe_value(tmp_path, facts, safe):
    half = COMMAND[: COMMAND.size // 2]
    left = state_after(record(tmp_path / "run.mcap", half, facts=facts), STAGED, safe=safe)
    values = [float(value) for value in (*facts.values(), safe)]
    still = np.full(round(RATE_HZ), safe)
    wanted = left_by([half, np.array(values), still], STAGED, RATE_HZ)
    assert left.stands_um == wanted.stands_um
    inverse = STAGED.inverse(RATE_HZ)
    inverse.restore(left.state)
    assert inverse.process(np.full(10, left.stands_um))[-1] == pytest.approx(safe, abs=1e-6)


@pytest.mark.parametrize(("rate_hz", "rest", "stage"), [
    (RATE_HZ, 2000, {"delay_s": 2.4 / RATE_HZ}),
    (RATE_HZ, 2000, {"structure": FirstMode(natural_hz=800.0, damping_ratio=0.2)}),
    (10.0, 1, {"delay_s": 0.0226}),
])  # fmt: skip
def test_the_safe_value_is_held_after_steps_of_the_command(rate_hz, rest, stage):
    """The inverse of a part of a sample, or of a structure, is inexact at steps."""
    model = STAGED.model_copy(update=stage)
    left = left_by([np.repeat(COMMAND[::50], 50), np.zeros(rest)], model, rate_hz)
    inverse = model.inverse(rate_hz)
    inverse.restore(left.state)
    assert np.abs(inverse.process(np.full(100, left.stands_um))).max() < 1e-9


def test_lead_in_of_a_run_that_is_shorter():
    memory = InitialState(np.zeros(1), 3.0, "")
    fed = np.zeros(10)
    led = memory.lead_in(fed, 20)
    assert led[0] == 3.0
    assert np.all(np.diff(led) < 0.0)
    assert led.size == 10
    assert not fed.any()


def test_the_output_is_held_in_skipped_ticks(tmp_path):
    blocks = COMMAND.size // BLOCK
    head, tail = COMMAND[: blocks // 2 * BLOCK], COMMAND[blocks // 2 * BLOCK :]
    held = np.concatenate((head, np.full(BLOCK, head[-1]), tail))
    left = state_after(record(tmp_path / "skipped.mcap", COMMAND, skipped=BLOCK), STAGED)
    whole = state_after(record(tmp_path / "whole.mcap", held), STAGED)
    assert left.stands_um == whole.stands_um
    np.testing.assert_array_equal(left.state, whole.state)


@pytest.mark.parametrize(("model", "rate_hz", "made", "message"), [
    (OMEGA, 5e3, {}, "10000 Hz.*5000 Hz"),
    (piezo_ppi(), RATE_HZ, {}, "in A.* V"),
    (OMEGA, RATE_HZ, {"first": 50}, "incomplete"),
    (OMEGA, RATE_HZ, {"whole": False}, "incomplete"),
    (OMEGA, RATE_HZ, {"flags": int(Flag.UNANSWERED)}, "lost"),
    (OMEGA, RATE_HZ, {"end": {"output_safe": "false"}}, "safe value"),
])  # fmt: skip
def test_recordings_that_don_t_tell_are_refused(tmp_path, model, rate_hz, made, message):
    path = record(tmp_path / "run.mcap", COMMAND, **made)
    with pytest.raises(DataError, match=message):
        state_after(path, model, rate_hz)
    with pytest.raises(DataError, match="No such file"):
        state_after(tmp_path / "absent.mcap", model, rate_hz)


HOLDS = ("tcp:10.0.0.5:502", "serial:/dev/ttyUSB0")


@pytest.fixture(autouse=True)
def states(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "hilctl" / "devices"


EXPERIMENT = """\
name: again
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform: {kind: hold, unit: um, level: 0.0, duration_s: 0.5}
compensator: {model: model.yaml}
limits: {peak_current_a: 6.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
recording: {folder: runs}
"""

NOW = MachineTime(2e9, 2e9)


STARTED = datetime.fromisoformat("2026-01-01T00:00:00+00:00")


class Folder:
    """An experiment, and the folder that its runs are written to."""

    def __init__(self, path):
        self.path, self.runs = path, path / "runs"
        self.runs.mkdir()
        (path / "model.yaml").write_text(dump_model(OMEGA))

    def loaded(self, *settings, holds=HOLDS):
        where = f"recording.folder={self.runs}"
        made = resolve(Document("x.yaml", EXPERIMENT), self.path, [where, *settings])
        info = replace(made.device.info, holds=holds)
        return replace(made, device=SimpleNamespace(info=info, check_rate=lambda *_: None))

    def record(self, name, *, holds=HOLDS, facts=None, coil=None, **made):
        """Write a run, which is the last of its device."""
        path = self.runs / f"{name}.mcap"
        record(path, COMMAND, facts={"run_id": name, **(facts or {})}, **made)
        self.begin(name, holds=holds, coil=coil)
        return path

    def begin(self, name, *, holds=HOLDS, coil=None, **more):
        path = str(self.runs / f"{name}.mcap")
        write_state(
            DeviceState(
                holds=[*holds], run_id=name, recording=path, started=STARTED, coil=coil, **more
            )
        )


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


def test_the_last_run_of_this_device_is_taken(folder):
    folder.record("older")
    path = folder.record("last")
    folder.record("other", holds=("tcp:10.0.0.6:502",))
    for each in folder.runs.iterdir():
        # As after a recovery, a copy or a checkout of an old recording.
        os.utime(each, (1e9, 1e9) if each == path else (2e9, 2e9))
    left, words = left_by_last_run(folder.loaded(), NOW)
    assert left is not None
    assert left.run_id == "last"
    assert abs(left.stands_um) > 0.5
    assert words == f"where {path} left the actuator"


@pytest.mark.parametrize(("made", "why"), [
    ({"whole": False}, "incomplete"),
    ({"first": 50}, "incomplete"),
    ({"end": {"output_safe": "false"}}, "safe value"),
])  # fmt: skip
def test_no_older_one_stands_in_for_the_last(folder, made, why):
    folder.record("old")
    folder.record("new", **made)
    left, words = left_by_last_run(folder.loaded(), NOW)
    assert left is None
    assert words.startswith("at rest")
    assert why in words
    assert "new.mcap" in words


def test_a_run_without_a_recording_is_not_known(folder):
    folder.record("old")
    folder.begin("new")
    assert "new.mcap" in left_by_last_run(folder.loaded(), NOW)[1]
    (folder.runs / "old.mcap").rename(folder.runs / "new.mcap")
    left, words = left_by_last_run(folder.loaded(), NOW)
    assert left is None
    assert "new.mcap" in words


def test_another_rate_or_a_large_file(folder, monkeypatch):
    path = folder.record("new")
    assert "10000 Hz" in left_by_last_run(folder.loaded("sample_rate_hz=5000"), NOW)[1]
    monkeypatch.setattr("hilctl.experiment.device_state._LARGEST_BYTES", 1 << 10)
    left, words = left_by_last_run(folder.loaded(), NOW)
    assert (left, "0 MB" in words and str(path) in words) == (None, True)


def test_nothing_there(folder):
    words = left_by_last_run(folder.loaded(), NOW)[1]
    assert words.startswith("at rest")
    folder.record("new")
    assert left_by_last_run(folder.loaded(holds=()), NOW) == (None, "at rest")


class TestCheck:
    def test_by_default(self, folder):
        folder.record("new")
        begun = check(folder.loaded()).begun
        left, words = left_by_last_run(folder.loaded(), NOW)
        np.testing.assert_array_equal(begun.state, left.state)
        assert (begun.run_id, begun.begins) == ("new", words)
        assert begun.input_um[0] == pytest.approx(left.stands_um)
        assert check(folder.loaded()).forecast.begins == words

    @pytest.mark.parametrize(("setting", "words"), [
        ("compensator.initial_state=rest", "at rest"),
        ("condition={cycles: 2}", "where its condition leaves the actuator"),
        ("compensator.initial_state=old.mcap", "where old.mcap left the actuator"),
    ])  # fmt: skip
    def test_switched_off_or_over(self, folder, setting, words):
        folder.record("new")
        record(folder.path / "old.mcap", 0.5 * COMMAND)
        begun = check(folder.loaded(setting)).begun
        assert begun.begins == words
        assert begun.run_id == ("before" if "old" in setting else "")


HOT = ["limits.rms_current_a=3.0", "limits.thermal_time_constant_s=20.0"]
ENDED = datetime.fromisoformat("2026-01-01T00:01:00+00:00")
ENDED_S = ENDED.timestamp()
SAFE_END = {"output_safe": "true", "ended": ENDED.isoformat()}


def coil(heat_a2=4.0, *, output_safe=True, tau_s=20.0):
    return CoilState(
        ended=ENDED, output_safe=output_safe, heat_a2=heat_a2, thermal_time_constant_s=tau_s
    )


def at(unix_s):
    """Return a time of a machine that was booted long ago."""
    return MachineTime(unix_s, 1e9)


class TestHeat:
    def record(self, folder, coil=None, end=None, **facts):
        facts |= {
            "started": STARTED.isoformat(),
            "limits": folder.loaded(*HOT).config.limits.model_dump_json(exclude_none=True),
        }
        return folder.record("a", facts=facts, coil=coil, end=end)

    def left(self, folder, waited_s, *settings):
        heat_a2, notes = heat_before(folder.loaded(*HOT, *settings), at(ENDED_S + waited_s))
        self.why = " ".join(notes)
        return heat_a2

    def test_it_has_cooled_since(self, folder):
        folder.begin("gone", coil=coil(4.0))
        assert self.left(folder, 0.0) == 4.0
        assert self.left(folder, 20.0) == pytest.approx(4.0 / np.e)
        assert self.left(folder, 1e6, "safe.value=1.0") == pytest.approx(1.0)

    @pytest.mark.parametrize("end", [{}, SAFE_END, {**SAFE_END, HEAT_FACT: "warm"}])
    def test_a_killed_run_s_is_worked_out_from_its_samples(self, folder, end):
        path = self.record(folder, end=end, **{HEAT_FACT: "4.0"})
        limits = folder.loaded(*HOT).config.limits
        sure = CoilHeat(limits, 10000.0, 4.0)
        sure.add(COMMAND)
        expected = 9.0 if HEAT_FACT in end else pytest.approx(sure.heat_a2, rel=1e-9)
        assert heat_after(path, folder.loaded(*HOT).config, ENDED_S - 60.0) == expected
        assert self.left(folder, -60.0) == expected

    def test_another_time_constant_asks_for_the_samples(self, folder):
        self.record(folder, coil=coil(4.0), end=SAFE_END, **{HEAT_FACT: "0.0"})
        other = self.left(folder, -1e6, "limits.thermal_time_constant_s=0.05")
        sure = CoilHeat(
            folder.loaded(*HOT, "limits.thermal_time_constant_s=0.05").config.limits, 10000.0, 0.0
        )
        sure.add(COMMAND)
        assert other == pytest.approx(sure.heat_a2, rel=1e-9)

    def test_an_output_that_is_not_known_to_be_safe_leaves_it_as_hot_as_can_be(self, folder):
        folder.begin("gone", coil=coil(1.0, output_safe=False))
        assert self.left(folder, 0.0) == 9.0
        assert self.left(folder, 20.0) == pytest.approx(9.0 / np.e)
        assert "not confirmed" in self.why

    def test_a_killed_run_without_a_recording_leaves_it_as_hot_as_can_be(self, folder):
        folder.begin("gone")
        assert self.left(folder, -60.0) == 9.0
        assert self.left(folder, -40.0) == pytest.approx(9.0 / np.e)
        assert "gone.mcap" in self.why

    def test_a_damaged_state_leaves_it_as_hot_as_can_be(self, folder, states, caplog):
        folder.begin("damaged", coil=coil(1.0))
        (path,) = states.iterdir()
        path.write_bytes(b"")
        os.utime(path, (ENDED_S, ENDED_S))
        assert self.left(folder, 0.0) == 9.0
        assert self.left(folder, 20.0) == pytest.approx(9.0 / np.e)
        assert str(path) in self.why
        loaded = folder.loaded(*HOT)
        assert any(str(path) in each for each in check(loaded, now=at(ENDED_S)).warnings)
        assert check(loaded, now=at(ENDED_S)).heat_a2 == 9.0
        assert str(path) in left_by_last_run(loaded, at(ENDED_S))[1]
        sine = "waveform={kind: sine, unit: A, amplitude: 5.0, frequency_hz: 10.0, duration_s: 2.0}"
        with pytest.raises(ConfigError):
            check(folder.loaded(*HOT, "compensator=none", sine), now=at(ENDED_S))
        assert str(path) in caplog.messages[-1]
        # Long after, it makes no difference.
        assert (self.left(folder, 1e4), self.why) == (pytest.approx(0.0), "")

    def test_the_hottest_of_several_counts(self, folder):
        folder.begin("one", coil=coil(4.0))
        folder.begin("two", coil=coil(2.0), holds=HOLDS[1:])
        folder.begin("three", coil=coil(8.0), holds=("tcp:10.0.0.6:502",))
        assert self.left(folder, 0.0) == 4.0

    @pytest.mark.parametrize("set_s", [600.0, -366 * 86400.0])
    def test_a_clock_that_was_set_does_not_cool_the_coil(self, folder, set_s):
        folder.begin("one", coil=coil(4.0), boot="b", boot_s=100.0)
        now = MachineTime(ENDED_S + set_s, 120.0, "b")
        assert heat_before(folder.loaded(*HOT), now) == (pytest.approx(4.0 / np.e), ())
        rebooted = MachineTime(ENDED_S + set_s, 20.0, "c")
        assert heat_before(folder.loaded(*HOT), rebooted)[0] >= 4.0 / np.e

    def test_a_run_that_would_overheat_the_coil_is_refused_until_it_has_cooled(self, folder):
        folder.begin("gone", coil=coil(8.9))
        sine = "waveform={kind: sine, unit: A, amplitude: 5.0, frequency_hz: 10.0, duration_s: 2.0}"
        loaded = folder.loaded(*HOT, "compensator=none", sine)
        with pytest.raises(ConfigError, match=r"2\.98 A .*wait"):
            check(loaded, 0.0, at(ENDED_S))
        later = check(loaded, 0.0, at(ENDED_S + 60.0))
        assert later.heat_a2 == pytest.approx(8.9 * np.exp(-3.0))
        with pytest.raises(ConfigError, match="rms_current_a"):
            check(loaded, 8.9, at(ENDED_S + 60.0))


class TestRecoveredRun:
    """A killed run leaves the state that its recovered recording shows."""

    NOW = MachineTime(ENDED_S, 500.0, "b")

    def left(self, folder, boot_s=900.0, boot="b", **end):
        limits = folder.loaded(*HOT).config.limits
        facts = {
            "started": STARTED.isoformat(),
            "limits": limits.model_dump_json(exclude_none=True),
            HEAT_FACT: "4.0",
        }
        path = folder.record("a", facts=facts, end=end)
        folder.begin("a", boot=boot, boot_s=boot_s)
        finish_state(path, self.NOW)
        path.unlink()
        (run,) = last_runs(folder.loaded().device.info)
        sure = CoilHeat(limits, RATE_HZ, 4.0)
        sure.add(COMMAND)
        return run.state, sure.heat_a2

    def test_its_heat_is_that_of_its_samples(self, folder):
        state, heat_a2 = self.left(folder, code="fault", output_safe="true")
        assert state.coil.heat_a2 == pytest.approx(heat_a2)
        assert (state.coil.output_safe, state.boot_s) == (True, 500.0)
        assert state.coil.ended.timestamp() == pytest.approx(STARTED.timestamp() + 0.1)

    @pytest.mark.parametrize("end", [{"output_safe": "false"}, {"code": "recovered"}])
    def test_without_a_known_end_it_is_unknown_and_ended_by_now(self, folder, end):
        state, _ = self.left(folder, **end)
        assert (state.coil, state.boot_s) == (None, 500.0)

    def test_one_of_an_earlier_boot(self, folder):
        state, heat_a2 = self.left(folder, boot="a", output_safe="true")
        assert (state.boot, state.boot_s) == ("a", 900.0)
        assert state.coil.heat_a2 == pytest.approx(heat_a2)

    def test_a_state_that_is_known_stays(self, folder):
        path = folder.record("a", coil=coil(2.0), end={"output_safe": "true"})
        finish_state(path, self.NOW)
        finish_state(folder.runs / "absent.mcap", self.NOW)
        (run,) = last_runs(folder.loaded().device.info)
        assert run.state.coil == coil(2.0)
