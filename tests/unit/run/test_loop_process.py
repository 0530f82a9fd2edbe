"""The loop's process, run in this one: what it says when something breaks."""

from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError, InputError, RunError
from hilctl.run import loop_process
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunCard, RunFolder
from hilctl.run.shared_page import Field, Phase
from hilctl.run.start import checked_experiment

EXPERIMENT = Path(__file__).parents[3] / "configs" / "demo.yaml"


class Closing:
    """A device that may refuse to be made safe."""

    def __init__(self, info, *, reachable=True, output=0.0):
        self.info, self._reachable, self._output, self.events = info, reachable, output, []

    def open(self, sample_rate_hz, block):
        self.events.append("open")

    def output(self):
        return self._output

    def make_safe(self, command):
        self.events.append("make_safe")
        if not self._reachable:
            raise DeviceError("no answer")

    def close(self):
        self.events.append("close")


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """Run a job that breaks; return its device, what was raised and the page."""

    def run(**device_is):
        checked = checked_experiment(EXPERIMENT, ["waveform.duration_s=1.0"])
        folder = RunFolder(tmp_path, RunCard("demo", "demo", "", 1, 0.0))
        info = checked.loaded.device.info
        ring = SampleRing.create(folder.ring, slots=16, block=50, state_size=checked.state_size)
        ring.page.put(Field.GO, 1)
        job = Job.of(checked, folder, supervisor=1, silence_s=1.0)
        loaded = job.load()
        device = Closing(info, **device_is)
        object.__setattr__(loaded, "device", device)
        monkeypatch.setattr(loop_process, "prepare", lambda settings: ())
        monkeypatch.setattr("hilctl.loop.loop.Loop.run", lambda self, start_ns: 1 / 0)
        with pytest.raises((ZeroDivisionError, RunError, InputError)) as caught:
            loop_process.run_job(job, ring, loaded)
        return device, caught.value, ring.page

    return run


def test_a_loop_that_breaks_makes_the_output_safe_and_closes(broken):
    """The error is the loop's own."""
    device, error, page = broken(reachable=True)
    assert device.events == ["open", "make_safe", "close"]
    assert isinstance(error, ZeroDivisionError)
    assert page.get(Field.PHASE) == Phase.RUNNING


def test_the_cause_is_not_lost_behind_a_device_that_can_not_be_reached(broken):
    """Both are told, the cause first."""
    device, error, _ = broken(reachable=False)
    assert device.events[-1] == "close"
    assert str(error).startswith("the loop broke: ZeroDivisionError")
    assert str(error).endswith("; the safe value could not be confirmed: no answer")


@pytest.mark.parametrize("output", [None, 99.0])
def test_a_start_that_is_refused_moves_nothing(broken, output):
    """Not to the safe value either, which would be the jump that the refusal is to spare."""
    device, error, page = broken(output=output)
    assert device.events == ["open", "close"]
    assert isinstance(error, InputError)
    assert str(error).endswith("nothing has moved")
    assert page.get(Field.PHASE) == Phase.STARTING


@pytest.mark.parametrize(("output", "ramps"), [(0.0, False), (5.0, True)])
def test_the_waveform_begins_after_the_ramp(broken, output, ramps):
    """The recorder needs to know before the first sample: the page says it."""
    _, _, page = broken(output=output)
    assert (page.get(Field.WAVEFORM_AT) > 0) == ramps
