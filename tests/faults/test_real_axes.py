"""Runs of several axes on devices of their own that are killed, lost, or tripped.

The devices' own logs are evaluated. No device has a watchdog: it keeps its last command.
"""

import copy
import json
import os
import signal
import time

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from hilctl.run.run_folder import runs
from tests.fakes import children_of
from tests.faults.conftest import (
    EXPERIMENT,
    MODULE,
    T7,
    Emulated,
    StartedRun,
    each_kind,
    tcp,
)
from tests.faults.test_lost_devices import SETTING_SAFE, active, said

TIMEOUT_S = 1.5
RAMP_S = 1.0
RAMP_A_PER_S = 5.0 / RAMP_S
SAFE_A = 1e-3
LEVEL_A = 4.0


class Stage:
    """A run of several axes, each with an emulated device."""

    def __init__(self, folder, kinds, profile):
        self.folder, self.devices, self.sections = folder, {}, {}
        for name, (kind, *words) in kinds.items():
            (folder / name).mkdir()
            if kind == "t7":
                device, section = Emulated(folder / name, "labjack_t7", *words), T7
                section = {**T7, **tcp(device.address)}
                output = "DAC0"
            else:
                device = Emulated(folder / name, profile("rtu_module"), *words)
                section = {**MODULE, "profile": profile("rtu_module")}
                section |= {"serial_port": device.address}
                output = "OUT"
            self.devices[name] = device, output
            self.sections[name] = {"device": {**copy.deepcopy(section), "timeout_s": TIMEOUT_S}}
        self.run = None

    def start(self, axes=None, **changes):
        """Start the run, and wait until it exchanges samples."""
        own = {name: {**each, **(axes or {}).get(name, {})} for name, each in self.sections.items()}
        experiment = {**EXPERIMENT, "sample_rate_hz": 50, "safe": {"ramp_s": RAMP_S}, **changes}
        self.run = StartedRun(self.folder, {**experiment, "axes": own})
        self.outputs = [self.folder / f"run.{name}.mcap" for name in own]
        self.run.output = self.outputs[-1]
        return self

    def await_running(self):
        self.run.await_size(20_000)
        time.sleep(0.3)
        return self

    def writes(self, name, since_ns=0):
        """Return times in ns and values of the writes of an axis."""
        device, output = self.devices[name]
        found = [each for each in device.log.writes(output) if each["monotonic_ns"] >= since_ns]
        times_ns = np.array([each["monotonic_ns"] for each in found], dtype=np.int64)
        return times_ns, np.array([each["current_a"] for each in found])

    def await_safe(self, *names):
        """Wait until outputs have their safe value."""
        for name in names or self.devices:
            device, output = self.devices[name]
            device.log.await_output(output, 0.0)

    def ended(self):
        code, printed = self.run.ended()
        assert code == 3
        return printed

    def assert_complete(self):
        """Assert that each recording is complete and replays, up to a common end."""
        found = [read(each) for each in self.outputs]
        for each in found:
            # A busy machine skips ticks, which are counted.
            assert each.samples.index[-1] + 1 == each.samples.index.size + each.dropped
            assert replay(each).identical
        assert len({each.samples.index[-1] for each in found}) == 1
        return found

    def assert_one_ramp(self, since_ns):
        """Assert that all outputs ramp down from one start time."""
        began = []
        for name in self.devices:
            times_ns, values_a = self.writes(name, since_ns)
            assert abs(values_a[-1]) <= SAFE_A
            began.append(began_s(times_ns, values_a))
        assert max(began) - min(began) < 0.1 * RAMP_S

    def close(self):
        if self.run is not None:
            self.run.process.kill()
            self.run.process.communicate()
        for device in {device for device, _ in self.devices.values()}:
            device.end()


class OneDevice(Stage):
    """A run of two axes on two outputs of one emulated device."""

    def __init__(self, folder, *words):
        sections = {
            name: {
                "device": {
                    **copy.deepcopy(T7),
                    "output": output,
                    "input": source,
                    "timeout_s": TIMEOUT_S,
                }
            }
            for name, output, source in (("x", "DAC0", "AIN0"), ("y", "DAC1", "AIN1"))
        }
        wiring = folder / "wiring.yaml"
        text = {**EXPERIMENT, "device": {"host": "127.0.0.1", "tcp_port": 502}, "axes": sections}
        wiring.write_text(json.dumps(text), encoding="utf-8")
        device = Emulated(folder, str(wiring), "--port", "0", *words)
        self.folder, self.run = folder, None
        self.devices = {"x": (device, "DAC0"), "y": (device, "DAC1")}
        self.sections = sections
        for each in sections.values():
            each["device"] |= tcp(device.address)


@pytest.fixture
def stage(tmp_path, profile):
    """Return a function that emulates the devices of a stage; one for all axes without kinds."""
    made = []

    def emulated(*words, **kinds):
        made.append(Stage(tmp_path, kinds, profile) if kinds else OneDevice(tmp_path, *words))
        return made[-1]

    yield emulated
    for each in made:
        each.close()


def began_s(times_ns, values_a):
    """Return when a ramp from the held level to 0 at the usual slew began, in s.

    Writes may be delayed, so the earliest time counts.
    """
    on_ramp = np.abs(values_a) > SAFE_A
    passed_s = (LEVEL_A - values_a[on_ramp]) / RAMP_A_PER_S
    return float((times_ns[on_ramp] * 1e-9 - passed_s).min())


HOLD = {"kind": "hold", "unit": "A", "level": LEVEL_A, "duration_s": 60.0, "soft_start_s": 0.2}


def killed(stage, targets):
    """Kill processes of a run; return the time."""
    supervisor, loop = stage.run.process.pid, stage.run.loop_pid()
    (guardian,) = {*children_of(supervisor)} - {loop}
    pids = {"supervisor": supervisor, "loop": loop, "guardian": guardian}
    for name in targets.split("+"):
        os.kill(pids[name], signal.SIGKILL)
    return time.monotonic_ns()


@pytest.mark.parametrize("targets", each_kind(
    ["loop", "guardian+loop", "supervisor", "supervisor+guardian"], {"loop"}
))  # fmt: skip
def test_killed_processes_leave_every_output_safe(stage, targets):
    """Three axes on three devices, over TCP and a serial line."""
    made = stage(x=("t7",), y=("t7",), z=("rtu",)).start(waveform=HOLD).await_running()
    at_ns = killed(made, targets)
    made.run.process.communicate(timeout=240)
    made.await_safe()
    if targets == "loop":
        made.assert_one_ramp(at_ns)
    for each in active():  # a command that was not answered may follow: only the user ends it
        assert each["state"] == SETTING_SAFE
        assert said("stop", "--run", each["name"])["ended"]
    made.assert_complete()
    assert runs() == []


@pytest.mark.parametrize("fault", each_kind(["silence", "unplug"], {"unplug"}))
def test_an_axis_that_is_lost_delays_no_other_and_is_never_confirmed(stage, fault):
    """One axis is safe although the other does not answer, and only that one is named."""
    made = stage(x=("t7",), y=("t7", "--fault", f"{fault}@150")).start(waveform=HOLD)
    printed = made.ended()
    assert printed["output_state"] != "confirmed"
    assert printed["guardian_active"]
    assert printed["reason"].startswith("y: ")
    times_ns, values_a = made.writes("x")
    ramp_ns = times_ns[np.flatnonzero(values_a > LEVEL_A - SAFE_A)[-1] :]
    on_ramp = np.diff(ramp_ns[: np.count_nonzero(values_a[-ramp_ns.size :] > SAFE_A) + 1])
    # The first gap is that of the exchange that y did not answer.
    assert on_ramp[1:].max() * 1e-9 < TIMEOUT_S / 5.0
    (run,) = active()
    assert run["state"] == SETTING_SAFE
    assert "y" in run["error"].split(": ")
    assert "x" not in run["error"].split(": ")
    if fault == "unplug":
        assert run["output_state"] == "unknown"
        found = said("safe", made.run.output.with_name("run.yaml"), code=3)
        states = {name: each["output_state"] for name, each in found["axes"].items()}
        assert states == {"x": "confirmed", "y": "unknown"}
        alone = said("safe", made.run.output.with_name("run.yaml"), "--set", "axis=x", code=2)
        assert "in use" in alone["error"]
    assert said("stop", "--run", run["name"])["ended"]
    made.assert_complete()


def test_an_interlock_of_one_axis_ramps_all(stage):
    """The difference of two commands is never larger than at the trip and one step."""
    limits = {**EXPERIMENT["limits"], "stroke_um": [-100.0, 15.0]}
    made = stage(x=("t7",), y=("t7",)).start({"y": {"limits": limits}})
    printed = made.ended()
    assert (printed["code"], printed["output_state"]) == ("fault", "confirmed")
    assert printed["reason"].startswith("y: ")
    commands = [each.samples.command for each in made.assert_complete()]
    assert np.array_equal(*commands)
    made.await_safe()
    assert runs() == []


def test_a_device_that_does_not_open_moves_nothing(stage):
    made = stage(x=("t7",), y=("t7", "--fault", "silence@1")).start()
    assert made.run.process.wait(240) in {2, 3}
    assert set(made.writes("x")[1]) <= {-10.0}
    assert not any(each.exists() for each in made.outputs)
    assert runs() == []


@pytest.mark.parametrize("targets", each_kind(["loop", "guardian+loop", "supervisor"], {"loop"}))
def test_killed_processes_leave_both_outputs_of_one_device_safe(stage, targets):
    made = stage().start(waveform=HOLD).await_running()
    at_ns = killed(made, targets)
    made.run.process.communicate(timeout=240)
    made.await_safe()
    if targets == "loop":
        made.assert_one_ramp(at_ns)
    for each in active():
        assert said("stop", "--run", each["name"])["ended"]
    x, y = made.assert_complete()
    assert x.run["device.transactions"] == y.run["device.transactions"] == "1"
    np.testing.assert_array_equal(x.ticks.late_ns, y.ticks.late_ns)
    np.testing.assert_array_equal(x.ticks.exchange_ns, y.ticks.exchange_ns)


def test_a_lost_device_is_lost_for_both_axes(stage):
    made = stage("--fault", "reset@300").start(waveform=HOLD)
    printed = made.ended()
    assert printed["code"] == "fault"
    made.await_safe()
    made.assert_complete()
