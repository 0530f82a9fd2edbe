"""The contract of every device that hilctl ships: the same tests for each.

Simulated devices stand for themselves. Devices on a wire meet an emulator on loopback, one for each
shipped profile: alone where it can drive and measure, else beside the one that it goes with. Its
time passes by the exchanges, so that nothing depends on how fast this machine is.
"""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from hilctl.base.device import Device, WatchdogDevice
from hilctl.base.errors import DeviceError
from hilctl.experiment.registry import BUILTIN, device_class, known_devices
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.emulator.setup import build
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.profile import load_profile, shipped_profiles
from tests.fakes import ManualClock

RATE_HZ = 10_000.0
SAMPLES = 20
SETTLED_NS = 2_000_000
"""What the emulated rig takes to settle, 0.1 ms, many times over: it computes each sample of it."""
TIMEOUT_S = 5.0
"""A busy machine answers within it."""
STEP = 0.01
"""Of the coarsest converter, in the command's unit."""
ELSEWHERE = {
    "serial_dac": "test_serial_devices.py",
    "modbus_stream": "test_modbus_stream.py",
}
"""Devices that meet this contract, or the part of it that streams have, in a file of their own."""
SIMULATED = sorted(set(BUILTIN) - {"modbus_dac", *ELSEWHERE})
PHYSICS = ("domains", "diffusion", "jiles_atherton")
"""What simulated_terfenol is tried with beside its default."""
MODBUS = (
    "adam_6024", "beckhoff_bk9000", "generic_float32", "icp_et7000", "labjack_t4", "labjack_t7",
    "labjack_t8", "wago_750", "rtu",
    # What drives, what reads, and whether they share a line or connection by unit id.
    "adam_4024 adam_4117 same", "adam_4024 adam_4117 own", "adam_6224 adam_6217 same",
    "adam_6224 adam_6217 own", "icp_m7024 icp_m7017 same", "waveshare_ao_8ch waveshare_ai_8ch same",
    "waveshare_ao_8ch_b waveshare_ai_8ch_b same", "adam_4024 adam_6217 own",
)  # fmt: skip
"""What modbus_dac is tried with; every shipped Modbus profile is among them."""


@dataclass
class DrivenDevice:
    """A device and how to use it.

    Attributes:
        device: Not yet open.
        block: Samples it takes in one exchange.
        rate_hz: A sample rate that it can keep.
        stands: Returns what stands at its output, not by its own word: the emulated device's, or
            the simulated plant's.
        pass_time: Called before each exchange.
        exchanged: Samples since it was opened.
    """

    device: Device
    block: int
    rate_hz: float
    stands: Callable[[], float]
    pass_time: Callable[[], None] = lambda: None
    exchanged: int = 0
    must_be_at_rest: ClassVar[bool] = False
    """Whether opening is refused while it puts anything out."""
    reads_back: ClassVar[bool] = True
    """Whether it knows what it puts out."""

    def open(self) -> None:
        """Open and arm it, as a run does."""
        self.device.open(self.rate_hz, self.block)
        if isinstance(self.device, WatchdogDevice):
            self.device.arm()
        self.exchanged = 0

    def exchange(self, command):
        """Exchange any number of samples, a block at a time; the next ones follow them."""
        command = np.asarray(command, dtype=np.float64)
        displacement_um, measured = np.full(command.size, np.nan), np.full(command.size, np.nan)
        for start in range(0, command.size, self.block):
            part = slice(start, start + self.block)
            self.pass_time()
            self.device.exchange(
                self.exchanged, command[part], displacement_um[part], measured[part]
            )
            self.exchanged += self.block
        return displacement_um, measured

    def assert_stands(self, command):
        assert self.stands() == pytest.approx(command, abs=STEP)

    @property
    def middle(self) -> float:
        """A command well inside the range that is not the resting one."""
        info = self.device.info
        return 0.5 * (info.command_max + max(0.0, info.command_min))


def simulated(kind: str, words: list[str]) -> DrivenDevice:
    chosen = device_class(kind)
    device = chosen(chosen.Options(physics=words[0]) if words else chosen.Options())
    return DrivenDevice(device, SAMPLES, RATE_HZ, lambda: device._last_command)


def of_another_package(kind: str) -> DrivenDevice:
    """Return a simulated device that is installed beside hilctl, or the example of one."""
    chosen = EXAMPLES[kind]() if kind in EXAMPLES else device_class(kind)
    device = chosen(chosen.Options())
    if not device.info.simulated:
        pytest.skip(f"{kind} drives hardware: pytest --device EXPERIMENT tests/hardware")
    rate_hz = min(RATE_HZ, device.info.max_rate_hz)

    def stands() -> float:
        try:
            return device.output()
        except DeviceError:  # it is not open, and keeps its output while it is not
            device.open(rate_hz, SAMPLES)
            current = device.output()
            device.close()
            return current

    return DrivenDevice(device, SAMPLES, rate_hz, stands)


def _spring() -> type[Device]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "data" / "own_device")
        found: type[Device] = import_module("own_device.spring").Spring
    return found


EXAMPLES = {"spring": _spring}
OTHERS = sorted({*EXAMPLES, *known_devices()} - set(BUILTIN))


RTU_PROFILE = """\
vendor: nobody
model: an analogue module on a serial line, which no shipped profile with an input is
source: [this test]
verified: "yes"
link: {kind: rtu, baud: 115200}
unit_id: 3
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  OUT: {address: 100, type: int16, scale: 0.001, unit: mA, min: -20.0, max: 20.0}
inputs:
  IN: {address: 200, type: float32, order: CDAB, unit: V, min: -10.0, max: 10.0}
watchdog: none
"""


def modbus(words: list[str], stack: list[Callable[[], None]]) -> DrivenDevice:
    """Return a modbus_dac that is wired to an emulator of the profile, or of two."""
    clock = ManualClock()
    name, reader, line = [*words, None, None][:3]
    options = EmulatorOptions(name, reader=reader, reader_line=line, current_a=0.0)
    emulator = build(options, clock)
    thread = threading.Thread(target=emulator.server.run)
    thread.start()

    def stop() -> None:
        emulator.server.stop()
        thread.join()

    stack.append(stop)
    chosen = device_class("modbus_dac")
    options = _fast({**emulator.options, "timeout_s": TIMEOUT_S})
    if "reader" in options:
        options["reader"] = _fast(options["reader"])
    device = chosen(chosen.Options.model_validate(options))
    rate_hz = min(RATE_HZ, device.info.max_rate_hz)

    def pass_time() -> None:
        clock.now_ns += min(round(1e9 / rate_hz), SETTLED_NS)

    return DrivenDevice(device, 1, rate_hz, lambda: emulator.device._rig.current_a, pass_time)


def _fast(section: dict) -> dict:
    """Return a section with a fast line, where it has one of its own."""
    return {**section, "baud": 115200} if "serial_port" in section else section


CASES = [
    *SIMULATED,
    *OTHERS,
    *(f"simulated_terfenol {words}" for words in PHYSICS),
    *(f"modbus_dac {words}" for words in MODBUS),
]


@pytest.fixture
def make(tmp_path) -> Iterator[Callable[[str], DrivenDevice]]:
    """Return a function that makes a device of a kind; all are closed afterwards."""
    benches: list[DrivenDevice] = []
    stack: list[Callable[[], None]] = []

    def of(case: str) -> DrivenDevice:
        kind, *words = case.split()
        if words == ["rtu"]:
            path = tmp_path / "rtu.yaml"
            path.write_text(RTU_PROFILE, encoding="utf-8")
            words = [str(path)]
        if kind == "modbus_dac":
            benches.append(modbus(words, stack))
        elif kind in OTHERS:
            benches.append(of_another_package(kind))
        else:
            benches.append(simulated(kind, words))
        return benches[-1]

    yield of
    for driven in benches:
        driven.device.close()
    for stop in stack:
        stop()


@pytest.fixture(params=CASES)
def case(request) -> str:
    """A device by its registry name, and the profile where it needs one."""
    return request.param


@pytest.fixture
def driven(make, case) -> DrivenDevice:
    """A device that was not opened yet."""
    return make(case)


def test_no_device_is_left_out():
    """Each device of the table is tried here, or in a file that is there."""
    assert {case.split()[0] for case in CASES} | set(ELSEWHERE) == {*BUILTIN, *OTHERS}
    folder = Path(__file__).parent
    assert [name for name in ELSEWHERE.values() if not (folder / name).exists()] == []


def test_no_modbus_profile_is_left_out():
    """Each shipped Modbus profile meets its own emulation, those that only read as readers."""
    shipped = {name: load_profile(name) for name in shipped_profiles()}
    kept = {name: each for name, each in shipped.items() if isinstance(each, ModbusProfile)}
    pairs = [words.split()[:2] for words in MODBUS if words != "rtu"]
    assert {name for pair in pairs for name in pair} == set(kept)
    assert all(kept[pair[0]].outputs and kept[pair[-1]].inputs for pair in pairs)
    only_read = {name for name, each in kept.items() if not each.outputs}
    assert only_read == {pair[1] for pair in pairs if len(pair) == 2}


def test_says_what_it_is_before_it_is_opened(driven):
    """Info is complete and sensible without a connection."""
    info = driven.device.info
    assert info.name in {*BUILTIN, *OTHERS}
    assert info.description
    assert info.command_unit in {"A", "V"}
    assert info.command_min < info.command_max
    assert info.sensor_min_um < info.sensor_max_um
    assert info.max_rate_hz >= driven.rate_hz
    assert info.buffered == (info.fifo_depth > 0)
    assert all(isinstance(text, str) for text in info.details.values())


def test_exchanges_blocks(driven):
    """Every displacement is filled with a number in the sensor's range, and commands move it."""
    driven.open()
    info = driven.device.info
    rest, _ = driven.exchange(np.zeros(SAMPLES))
    driven.exchange(np.linspace(0.0, driven.middle, SAMPLES))
    moved, measured = driven.exchange(np.full(SAMPLES, driven.middle))
    for values in (rest, moved):  # none of which holds of what is not a number
        assert (values >= info.sensor_min_um).all()
        assert (values <= info.sensor_max_um).all()
    assert moved.max() > rest.max() + 1.0
    assert np.isfinite(measured).all() == info.measures_command


def test_displacement_is_sampled_before_the_command_acts(driven):
    """The first sample after a jump still shows the rest; a later one does not."""
    driven.open()
    rest, _ = driven.exchange(np.zeros(SAMPLES))
    moved, _ = driven.exchange(np.full(SAMPLES, driven.middle))
    assert abs(moved[0] - rest.mean()) < 0.5
    assert moved[-1] > rest.mean() + 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, "above", "below"])
def test_refuses_what_it_can_not_do(driven, bad):
    """A value that is not finite or out of range is refused whole: nothing of the block is sent."""
    driven.open()
    info = driven.device.info
    beyond = 0.001 * (info.command_max - info.command_min)
    value = {"above": info.command_max + beyond, "below": info.command_min - beyond}
    command = np.full(driven.block, driven.middle)
    command[driven.block // 2] = value.get(bad, bad) if isinstance(bad, str) else bad
    with pytest.raises(DeviceError, match=info.name):
        driven.exchange(command)
    after, _ = driven.exchange(np.zeros(SAMPLES))
    assert np.abs(after).max() < 0.5


def test_takes_its_whole_range(driven):
    """Both ends of the stated range are accepted."""
    driven.open()
    for value in (driven.device.info.command_min, driven.device.info.command_max):
        driven.exchange(np.full(SAMPLES, value))


def test_does_not_change_the_command(driven):
    """The command array is read, never written."""
    driven.open()
    command = np.linspace(0.0, driven.middle, SAMPLES)
    before = command.copy()
    driven.exchange(command)
    assert np.array_equal(command, before)


def test_use_before_open_and_after_close_is_refused(driven):
    """Exchange needs an open device; closing twice is fine, and opening again too."""
    with pytest.raises(DeviceError):
        driven.exchange(np.zeros(SAMPLES))
    driven.open()
    driven.device.close()
    driven.device.close()
    with pytest.raises(DeviceError):
        driven.exchange(np.zeros(SAMPLES))
    driven.open()
    driven.exchange(np.zeros(SAMPLES))


def test_opening_does_not_move_the_output(driven):
    """What was put out before stays through closing and opening; simulated ones start at rest."""
    driven.open()
    driven.exchange(np.full(SAMPLES, driven.middle))
    held, _ = driven.exchange(np.full(SAMPLES, driven.middle))
    driven.device.close()
    driven.open()
    first, _ = driven.exchange(np.zeros(driven.block))
    expected = 0.0 if driven.device.info.name in SIMULATED else held[-1]
    assert first[0] == pytest.approx(expected, abs=0.5)


def test_rate_beyond_its_limit_is_refused(driven):
    """A sample rate that it can't keep is refused at open."""
    with pytest.raises(DeviceError):
        driven.device.open(driven.device.info.max_rate_hz * 1.01, driven.block)


def test_make_safe_works_open_or_closed(driven):
    """The last resort needs no open connection; what stands at the output then is the judge."""
    safe = 0.5 * driven.middle
    driven.device.make_safe(safe)
    driven.assert_stands(safe)
    driven.device.make_safe(0.0)
    driven.assert_stands(0.0)
    driven.open()
    driven.exchange(np.full(SAMPLES, driven.middle))
    # Else it would be safe by itself; behind a FIFO, what was sent is still to come.
    assert driven.stands() > safe + STEP or driven.device.info.latency_blocks
    driven.device.make_safe(safe)
    driven.assert_stands(safe)
    driven.device.close()
    driven.assert_stands(safe)
    driven.device.make_safe(0.0)
    driven.assert_stands(0.0)


def test_each_value_of_a_ramp_is_put_out(driven):
    """Safe values may follow one another, and each is confirmed by itself."""
    driven.open()
    driven.exchange(np.full(SAMPLES, driven.middle))
    for share in (0.5, 0.25, 0.0):
        driven.device.make_safe(share * driven.middle)
        driven.assert_stands(share * driven.middle)


def test_arming_moves_nothing_and_needs_an_open_device(driven):
    if not isinstance(driven.device, WatchdogDevice):
        return
    with pytest.raises(DeviceError):
        driven.device.arm()
    at_rest = driven.must_be_at_rest or driven.device.info.simulated
    held = 0.0 if at_rest else 0.5 * driven.middle
    driven.device.make_safe(held)
    driven.open()
    driven.assert_stands(held)
    driven.device.close()
    with pytest.raises(DeviceError):
        driven.device.arm()


def test_says_what_it_puts_out(driven):
    """After opening it knows what stands there, or says that it does not."""
    with pytest.raises(DeviceError):
        driven.device.output()
    driven.open()
    driven.exchange(np.full(SAMPLES, 0.0 if driven.must_be_at_rest else driven.middle))
    driven.device.close()
    driven.open()
    found = driven.device.output()
    assert (found is not None) == driven.reads_back
    if found is not None:
        driven.assert_stands(found)


def test_two_of_a_kind_agree(driven, make, case):
    """A second one with the same options gives the same bits: runs can be repeated."""
    other = make(case)
    command = np.linspace(0.0, driven.middle, SAMPLES)
    results = []
    for each in (driven, other):
        each.open()
        results.append(each.exchange(command)[0])
    assert np.array_equal(*results)
