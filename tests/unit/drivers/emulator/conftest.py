"""Emulators that all tests here share."""

from contextlib import ExitStack
from dataclasses import fields

import pytest

from hilctl_drivers.emulator.factory import build
from hilctl_drivers.emulator.modbus_device import EmulatedModbus
from hilctl_drivers.emulator.options import EmulatorOptions, RigOptions
from hilctl_drivers.emulator.rig import Bench, SimulatedWiring, Stage, WiredRig, WriteLog
from hilctl_drivers.profile import load_profile
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions
from tests.fakes import emulated, logged, one_rig

MS = 1_000_000
START_NS = 10_000_000_000


def emulated_modbus(name, output, sensor, current_a=None):
    """Return an emulated Modbus device that drives and shows a rig of its own."""
    profile = load_profile(name)
    actuator = SimulatedTerfenol(TerfenolOptions())
    wiring = SimulatedWiring.spread(profile.outputs[output], profile.inputs[sensor], actuator)
    wired = WiredRig(Stage(0, {"": actuator}).rigs[0], wiring)
    bench = Bench({output: wired}, {sensor: wired}, WriteLog(None, 0))
    return EmulatedModbus(profile, bench, current_a)


class Emulated:
    """An emulated device on a line, with the time and the bytes in the test's hand."""

    def __init__(self, profile, tmp_path, **wanted):
        self.log = tmp_path / "writes.jsonl"
        self.now_ns = START_NS
        names = {each.name for each in fields(RigOptions)}
        of_rig = {name: wanted.pop(name) for name in names & wanted.keys()}
        rigs = one_rig(**{"actuator": TerfenolOptions(noise=False), **of_rig})
        made = EmulatorOptions(str(profile), log=self.log, **{"rigs": rigs, **wanted})
        self.emulator = build(made, lambda: self.now_ns)
        self.device = self.emulator.device

    def ask(self, message, after_ms=0):
        """Return the answer to a message without framing, sent ``after_ms`` after the last."""
        self.now_ns += after_ms * MS
        answer = self.device.answer(message, self.now_ns)
        if answer is None or (answer.make is None and answer.data is None):
            return None
        if answer.make is None:
            return answer.data
        self.now_ns = max(self.now_ns, answer.due_ns)
        return answer.make(self.now_ns)

    def writes(self):
        return logged(self.log)

    def close(self):
        self.emulator.server.close()
        self.emulator.log.close()


@pytest.fixture
def emulate(tmp_path):
    """Return a function that makes an emulated device; all are put away afterwards."""
    made = []

    def of(profile, **wanted):
        made.append(Emulated(profile, tmp_path, **wanted))
        return made[-1]

    yield of
    for each in made:
        each.close()


@pytest.fixture
def served():
    """Serve emulators in threads; yield a function that starts one and returns its address."""
    with ExitStack() as running:

        def start(profile, **options):
            return running.enter_context(emulated(EmulatorOptions(profile, **options))).address

        yield start
