"""The process that works changes out: from where the ring says that the run stands."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.base.samples import Head
from hilctl.experiment.tuned import InputPeaks
from hilctl.loop.compensator import Compensator
from hilctl.loop.tuning import Tuner
from hilctl.run.change_worker import SUPERVISORS, ChangeWorker, WantedChange, answer_to
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field
from hilctl.run.start import checked_experiment
from tests.fakes import SteppingClock

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
BLOCK = 10


@pytest.fixture(scope="module")
def checked():
    return checked_experiment(DEMO, [f"block={BLOCK}"])


@pytest.fixture
def ring(checked, tmp_path):
    size = checked.state_size
    return SampleRing.create(tmp_path / "ring", slots=16, block=BLOCK, state_size=size)


def pass_block(ring, first_sample, memory):
    """Let the loop exchange one block that begins with this memory."""
    block = ring.claim()
    block.head[Head.FIRST_SAMPLE] = first_sample
    block.memory[:] = memory
    ring.sending(block)
    ring.answered(block)
    ring.page.put(Field.NEXT_SAMPLE, first_sample + BLOCK)


def wanted(ring, **changes):
    given = {
        "gain": 0.5,
        "offset": 0.0,
        "inverse_share": 1.0,
        "samples": 5000,
        "lead_s": 0.5,
        "tuner": Tuner(),
    }
    given |= {"tuner_at": 0, "heat_a2": 0.0, **changes}
    return WantedChange(ring=str(ring.path), **given)


def answered(ring, checked, **changes):
    peaks = InputPeaks(checked.begun.input_um)
    return answer_to(wanted(ring, **changes), checked, peaks, SteppingClock(1e-4), lambda s: None)


def test_a_change_begins_a_block_after_the_time_to_work_it_out(ring, checked):
    rate_hz = checked.loaded.config.sample_rate_hz
    memory = Compensator(checked.loaded.model, rate_hz).state()
    pass_block(ring, 2000, memory)
    found = answered(ring, checked, lead_s=0.1)
    lead = 2000 + 2 * BLOCK + round(0.1 * rate_hz)
    assert found.tuning.begins_at == lead
    assert (found.tuning.gain, found.tuning.samples) == (0.5, 5000)
    assert found.checked_s > 0.2
    pass_block(ring, 2005, memory)
    assert answered(ring, checked, lead_s=0.1).tuning.begins_at == lead + BLOCK


def test_a_run_that_has_not_begun_begins_at_its_start(ring, checked):
    assert answered(ring, checked).checked_s > 0.5


def test_the_change_before_must_show_in_the_ring(ring, checked):
    """Blocks that are on their way are waited for; a loop that stands still is not, for long."""
    slept = []
    memory = Compensator(checked.loaded.model, checked.loaded.config.sample_rate_hz).state()
    pass_block(ring, 0, memory)

    def sleep(seconds):
        slept.append(seconds)
        if len(slept) == 3:
            pass_block(ring, BLOCK, memory)

    peaks = InputPeaks(checked.begun.input_um)
    again = wanted(ring, tuner_at=BLOCK)
    assert answer_to(again, checked, peaks, SteppingClock(1e-4), sleep).checked_s > 0.5
    assert len(slept) == 3
    assert "does not go on" in answer_to(
        wanted(ring, tuner_at=500), checked, peaks, SteppingClock(1.0), slept.append
    )


def test_what_can_t_be_followed_is_said_in_words(ring, checked):
    assert "must stay within" in answered(ring, checked, gain=50.0)
    assert "over before" in answered(ring, checked, lead_s=1e6)
    absent = wanted(ring)
    ring.path.unlink()
    peaks = InputPeaks(checked.begun.input_um)
    assert "No such file" in answer_to(absent, checked, peaks)


def test_a_process_answers_and_ends_with_its_supervisor(ring, checked):
    """Signals to the whole group are the supervisor's to handle."""
    with ChangeWorker(checked) as worker:
        number = worker._process.pid
        for sent in (*SUPERVISORS, signal.SIGTSTP):
            worker.begin(wanted(ring))
            os.kill(number, sent)
            assert await_result(worker).tuning.gain == 0.5
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


def test_a_process_whose_supervisor_is_gone_ends_by_itself(checked):
    """However that died: the end of its side is what shows it."""
    with ChangeWorker(checked) as worker:
        worker._connection.close()
        worker._process.join(20)
        assert worker._process.exitcode == 0


def await_result(worker):
    while (found := worker.result()) is None:
        time.sleep(0.001)
    return found


def test_a_process_that_died_or_hangs_is_a_refusal(ring, checked):
    """And stays one: another could not be forked from a supervisor at work."""
    clock = SteppingClock()
    with ChangeWorker(checked, clock) as worker:
        worker.begin(wanted(ring))
        await_result(worker)
        os.kill(worker._process.pid, signal.SIGSTOP)
        worker.begin(wanted(ring))
        assert worker.result() is None
        clock.now = 21.0
        with pytest.raises(InputError, match="not worked out within 20 s"):
            worker.result()
        worker._process.join()
        with pytest.raises(InputError, match="process that did so is gone"):
            worker.result()


def test_refusals_of_the_process_are_refusals_here(ring, checked):
    with ChangeWorker(checked) as worker:
        worker.begin(wanted(ring, gain=50.0))
        with pytest.raises(InputError, match="must stay within"):
            await_result(worker)


def test_the_newest_state_is_that_of_the_newest_whole_block(tmp_path):
    """Of one that is on its way nothing is taken; nor of a slot that the loop is about to use."""
    ring = SampleRing.create(tmp_path / "small", slots=4, block=BLOCK, state_size=2)
    assert ring.newest_state() is None
    pass_block(ring, 0, np.array([1.5]))
    block = ring.claim()
    block.head[Head.FIRST_SAMPLE] = BLOCK
    ring.sending(block)
    first, state = ring.newest_state()
    assert (first, state[0]) == (0, 1.5)
    ring.page.put(Field.SENT, 4)
    assert ring.newest_state() is None
