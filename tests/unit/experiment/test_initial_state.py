"""What a run before left behind: the compensator that begins with it meets its model exactly."""

from datetime import datetime

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.samples import COLUMNS, BlockBatch, BlockHeader, Flag
from hilctl.experiment.initial_state import InitialState, initial_state_after, left_by
from hilctl.models.linear_stages import CreepModel
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.writer import RecordingWriter, RunFacts
from tests.published import piezo_ppi
from tests.unit.models.test_staged import OMEGA

RATE_HZ = 10_000.0
BLOCK = 50
STAGED = StagedModel.around(
    OMEGA, lag=FieldLag(tau_s=2e-4, growth_per_unit=0.2), delay_s=2.0 / RATE_HZ
)
CREEPING = STAGED.model_copy(
    update={"creep": CreepModel(time_constants_s=(0.3, 20.0), shares=(0.03, 0.05))}
)
NOW_S = datetime.fromisoformat("2026-01-01T00:01:00+00:00").timestamp()
COMMAND = 4.0 * np.sin(np.pi * np.arange(1000) / 999.0)


def record(path, command, *, first=0, flags=0, facts=None, **made):
    """Write a run of these commands without a compensator."""
    blocks = command.size // BLOCK
    batch = BlockBatch.empty(blocks, BLOCK, 1)
    batch.heads[:, BlockHeader.FIRST_SAMPLE] = first + BLOCK * np.arange(blocks)
    batch.heads[:, BlockHeader.SAMPLES] = BLOCK
    batch.heads[0, BlockHeader.DROPPED_BEFORE] = first
    batch.columns[:, list(COLUMNS).index("command")] = command.reshape(blocks, BLOCK)
    batch.flags[-1, -1] = flags
    return write_recording(path, batch, facts={"run_id": "before", **(facts or {})}, **made)


def write_recording(
    path, batch, rate_hz=RATE_HZ, *, whole=True, facts=None, end=None, measured=False
):
    """Write blocks of a run without a compensator."""
    run = RunFacts(
        facts={"compensator": "none", **(facts or {})},
        segments=(), experiment_yaml="name: made\n", model_yaml="",
        layout=RecordingLayout(
            sample_rate_hz=rate_hz, command_unit="A", measures_command=measured,
            scope_rate_hz=1000.0, start_unix_ns=1_700_000_000_000_000_000,
        ),
    )  # fmt: skip
    with path.open("xb") as stream:
        writer = RecordingWriter(stream, run)
        writer.batch(batch)
        if whole:
            writer.finish({"code": "completed", **(end or {})}, writer.samples)
        else:
            writer.flush()
    return path


@pytest.mark.parametrize("model", [OMEGA, STAGED], ids=["integrated", "staged"])
def test_compensator_goes_on_where_the_actuator_was_left(tmp_path, model):
    memory = initial_state_after(record(tmp_path / "run.mcap", COMMAND), model, RATE_HZ, NOW_S)
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
    left = initial_state_after(path, CREEPING, RATE_HZ, NOW_S)
    still = np.full(round(still_s * RATE_HZ), COMMAND[-1])
    wanted = left_by([COMMAND, still], CREEPING, RATE_HZ)
    gone = left_by([COMMAND], CREEPING, RATE_HZ)
    assert abs(gone.stands_um - wanted.stands_um) > 0.02
    assert left.stands_um == pytest.approx(wanted.stands_um, abs=1e-6)
    np.testing.assert_allclose(left.state, wanted.state, rtol=0.0, atol=1e-6)


def test_lead_in_of_a_run_that_is_shorter():
    memory = InitialState(np.zeros(1), 3.0, "")
    fed = np.zeros(10)
    led = memory.lead_in(fed, 20)
    assert led[0] == 3.0
    assert np.all(np.diff(led) < 0.0)
    assert led.size == 10
    assert not fed.any()


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
        initial_state_after(path, model, rate_hz, NOW_S)
    with pytest.raises(DataError, match="no such file"):
        initial_state_after(tmp_path / "absent.mcap", model, rate_hz, NOW_S)
