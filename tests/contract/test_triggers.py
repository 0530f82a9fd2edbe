"""Triggers of every kind of device with digital channels, against its emulation.

The loop, the device and the wire are those of a run; only the clock is not real.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.device import Device
from hilctl.base.errors import InputError
from hilctl.base.events import TRIGGERED
from hilctl.base.samples import BlockHeader, Flag
from hilctl.experiment.devices import device_class
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.triggers import Triggers
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.profile import load_profile
from tests.fakes import FakeClock, FakeHost, emulated, logged, loop_plan

DCON = (Path(__file__).parents[1] / "data" / "dcon_module.yaml").read_text()
DIGITAL = """
digital_outputs:
  DO0:
    {high: "@{address:02X}DO01", low: "@{address:02X}DO00", reply: {pattern: ">", example: ">"}}
digital_inputs:
  DI0:
    ask: "@{address:02X}DI"
    high: {pattern: "!1", example: "!1"}
    low: {pattern: "!0", example: "!0"}
"""
CHANNELS = {
    "labjack_t4": ("FIO4", "FIO6"),
    "labjack_t7": ("FIO0", "FIO2"),
    "labjack_t8": ("FIO0", "FIO2"),
    "adam_6024": ("DO0", "DI0"),
    "dcon": ("DO0", "DI0"),
}
"""Profiles with a digital output and a digital input."""
LOW_NS = 2 * 10**9
"""A time at which the emulated inputs are low, for a second."""


@dataclass
class Bench:
    """A device at an emulator, and the log of what the emulator outputs."""

    make: object
    log: Path
    clock: FakeClock

    def run(self, samples, *, device=None, rate_hz=None, **triggers):
        device = device or self.make()
        rate_hz = rate_hz or min(100.0, device.info.max_rate_hz)
        device.open(rate_hz, 1)
        values = 0.5 * np.sin(np.arange(samples))
        plan = loop_plan(
            reference=values,
            input_um=values,
            block=1,
            latency_blocks=0,
            sample_rate_hz=rate_hz,
            compensator=Compensator(None, rate_hz),
            limits=CommandLimits(low=-5.0, high=5.0, slew_per_s=1e6, safe=0.0, ramp_per_s=1e6),
            interlocks=InterlockContext(stroke_um=(-100.0, 100.0), sensor_um=(-125.0, 125.0)),
            triggers=Triggers(**{"marks": np.empty(0, np.int64), **triggers}),
        )
        self.host = FakeHost(self.clock)
        loop = Loop(plan, [device], self.host)
        loop.begin_at([0.0])
        self.opened = len(self.events)
        try:
            return loop.run(self.clock.now)
        finally:
            device.close()

    @property
    def events(self):
        """Values of the outputs in order, those of digital ones as bool."""
        lines = logged(self.log)
        return [bool(e["value"]) if e["event"] == "digital" else e["value"] for e in lines]

    @property
    def marks(self):
        """Recorded samples with a mark."""
        firsts = [head[BlockHeader.FIRST_SAMPLE] for head in self.host.heads]
        pairs = zip(firsts, self.host.flags, strict=True)
        return [first for first, flags in pairs if flags[0] & Flag.TRIGGER]

    @property
    def pulses(self):
        """Samples with which the device's digital output rose, and those with which it fell."""
        found, sample = {True: [], False: []}, -1
        for value in self.events[self.opened :]:
            if isinstance(value, bool):
                found[value].append(sample)
            else:
                sample += 1
        return found[True], found[False]


@pytest.fixture(params=CHANNELS)
def bench(request, tmp_path):
    name = request.param
    output, source = CHANNELS[name]
    if name == "dcon":
        (tmp_path / "dcon.yaml").write_text(DCON + DIGITAL)
        name = str(tmp_path / "dcon.yaml")
    link = "tcp" if load_profile(name).link.kind == "ascii" else None
    clock = FakeClock(now=LOW_NS)
    wanted = EmulatorOptions(
        name, log=tmp_path / "log.jsonl", command=None if link else 0.0, link=link
    )
    with emulated(wanted, lambda: clock.now) as emulator:
        chosen = device_class("serial_dac" if link else "modbus_dac")
        options = {**emulator.options, "digital_output": output, "digital_input": source}
        options |= {"timeout_s": 5.0}

        def make(**changes) -> Device:
            return chosen(chosen.Options.model_validate(options | changes))

        yield Bench(make, wanted.log, clock)


@pytest.mark.slow
def test_pulses_are_at_the_recorded_marks(bench):
    marks = np.sort(np.random.default_rng(1).choice(np.arange(0, 520, 2), 60, replace=False))
    assert bench.run(520, marks=marks).code == "completed"
    assert bench.marks == marks.tolist()
    assert bench.pulses == (marks.tolist(), (marks + 1).tolist())


def test_without_channels_nothing_digital_is_written(bench):
    device = bench.make(digital_output=None, digital_input=None)
    assert bench.run(5, device=device).code == "completed"
    assert not any(isinstance(each, bool) for each in bench.events)


def test_the_input_starts_the_run(bench):
    assert bench.run(5, start="high", timeout_s=5.0).code == "completed"
    event = next(each for each in bench.host.events if each.code == TRIGGERED)
    assert event.values["waited_s"] == pytest.approx(1.0, abs=0.11)
    assert bench.run(5, start="high").code == "completed"  # it is high already


def test_nothing_moves_before_the_timeout(bench):
    outcome = bench.run(5, start="high", timeout_s=0.2)
    assert (outcome.code, outcome.output) == ("fault", "confirmed")
    assert [each.code for each in bench.host.events] == ["start_timeout"]
    assert bench.events[bench.opened :] == pytest.approx([bench.events[-1]])


@pytest.mark.parametrize("own", [True, False], ids=["loop", "guardian"])
def test_the_output_is_low_after_a_fault(bench, own):
    """The guardian makes a device of its own, which does not know the state of the output."""
    device = bench.make()
    device.open(10.0, 1)
    device.set_digital(True)
    safe = device if own else bench.make()
    safe.safe_command = 0.0
    safe.make_safe(1.0)
    assert not isinstance(bench.events[-1], bool)  # the safe ramp does not wait
    safe.make_safe(0.0)
    analogue, digital = bench.events[-2:]
    assert digital is False
    assert not isinstance(analogue, bool)  # the safe value first
    device.close()


def test_the_rate_includes_the_pulse(bench):
    info, without = bench.make().info, bench.make(digital_output=None).info
    assert info.digital_output_s > 0.0
    assert without.digital_output_s == 0.0
    assert info.max_rate_hz <= without.max_rate_hz
    assert 1.0 / info.max_rate_hz >= info.digital_output_s


@pytest.mark.parametrize("key", ["digital_output", "digital_input"])
def test_another_channel_is_refused(bench, key):
    with pytest.raises(InputError, match=key):
        bench.make(**{key: "NONE9"})


@pytest.mark.parametrize(
    ("kind", "profile"),
    [
        ("modbus_dac", "generic_float32"),
        ("serial_dac", "cobs_board"),
        ("modbus_stream", "labjack_t7"),
    ],
)
@pytest.mark.parametrize("key", ["digital_output", "digital_input"])
def test_a_device_without_digital_channels_refuses_them(kind, profile, key):
    known = load_profile(profile)
    options = {
        "profile": profile,
        "output": next(iter(known.outputs)),
        "input": next(iter(known.inputs)),
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 12.5},
        "watchdog": "none",
        key: {"digital_output": "FIO0", "digital_input": "FIO2"}[key],
    }
    options |= {"serial_port": "/dev/null"} if kind == "serial_dac" else {"host": "127.0.0.1"}
    chosen = device_class(kind)
    with pytest.raises(InputError, match=f"{key} must be omitted"):
        chosen(chosen.Options.model_validate(options))
