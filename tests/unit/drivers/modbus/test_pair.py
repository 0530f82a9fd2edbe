"""modbus_dac with its sensor on another module: same line, own line, gateway, and faults."""

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.emulator.setup import Emulator, build
from hilctl_drivers.modbus.device import ModbusDac
from hilctl_drivers.modbus.setup import ModbusOptions

PAIR = {
    "profile": "icp_m7024",
    "serial_port": "/dev/x",
    "output": "AO0",
    "input": "AI0",
    "reader": {"profile": "icp_m7017", "unit_id": 2},
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}
READS = PAIR["reader"]
SETTLE_S = 0.01
"""Of an M-7024's output."""
READER = """\
vendor: nobody
model: a reader that is told when it is no longer needed
source: [this test]
verified: "yes"
link: {kind: rtu, baud: 115200}
address_base: 0
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs: {}
inputs:
  IN: {area: input, address: 0, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0}
  OWN: {area: input, address: 1, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0,
        measures: output}
init:
  - {kind: write, address: 7, type: uint16, value: 1, verify: true, note: take over}
close:
  - {kind: write, address: 7, type: uint16, value: 2, note: let go}
watchdog: none
"""


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns

    def pass_s(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@dataclass
class Served:
    """Two emulated devices at one rig, and what the one that drives has put out."""

    emulator: Emulator
    clock: Clock
    log: Path

    def device(self, **changes) -> ModbusDac:
        options = {**self.emulator.options, "timeout_s": 2.0, **changes}
        return ModbusDac(ModbusOptions.model_validate(options))

    def events(self) -> list[dict]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]


@pytest.fixture
def serve(tmp_path) -> Iterator[Callable[..., Served]]:
    """Return a function that serves two devices on a clock that stands still."""
    started: list[tuple[Served, threading.Thread]] = []

    def start(profile: str, reader: str, **options) -> Served:
        clock, log = Clock(), tmp_path / f"writes{len(started)}.jsonl"
        emulator = build(EmulatorOptions(profile, reader=reader, log=log, **options), clock)
        thread = threading.Thread(target=emulator.server.run)
        thread.start()
        started.append((Served(emulator, clock, log), thread))
        return started[-1][0]

    yield start
    for served, thread in started:
        served.emulator.server.stop()
        thread.join()
        served.emulator.log.close()


@pytest.fixture
def reader(tmp_path) -> str:
    """A profile with init and close steps and nothing to drive, by path."""
    path = tmp_path / "reader.yaml"
    path.write_text(READER, encoding="utf-8")
    return str(path)


def exchange(device: ModbusDac, value: float) -> float:
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


def made(**changes) -> ModbusDac:
    return ModbusDac(ModbusOptions.model_validate({**PAIR, **changes}))


class TestPlaces:
    """Where the reader is, and what that costs."""

    @pytest.mark.parametrize(
        ("profile", "reader", "options", "places"),
        [
            ("adam_4024", "adam_4117", {}, 1),
            ("adam_4024", "adam_4117", {"reader_line": "own"}, 2),
            ("adam_4024", "adam_4117", {"link": "tcp"}, 1),
            ("adam_6224", "adam_6217", {}, 2),
            ("adam_6224", "adam_6217", {"reader_line": "same", "reader_unit_id": 9}, 1),
            ("adam_4024", "adam_6217", {}, 2),
            ("adam_6224", "adam_4117", {}, 2),
        ],
    )
    def test_one_drives_and_the_other_reads(self, serve, profile, reader, options, places):
        """On one line, through one gateway, at two addresses, and on two kinds of wire."""
        served = serve(profile, reader, **options)
        device = served.device()
        assert len(device.info.holds) == places
        device.open(5.0, 1)
        exchange(device, 3.0)
        served.clock.pass_s(0.1)
        assert exchange(device, 3.0) == pytest.approx(16.5, abs=1.0)
        assert [event["output"] for event in served.events()] == ["AO0", "AO0"]
        device.make_safe(0.0)
        assert served.events()[-1]["current_a"] == pytest.approx(0.0, abs=5e-3)

    def test_rate_counts_both(self):
        """One read and one write at 9600 8N1: 31 characters, 4 gaps, two turnarounds, settling."""
        info = made().info
        total_s = 31 * 10 / 9600 + 4 * 3.5 * 10 / 9600 + 2 * 0.002 + SETTLE_S
        assert info.max_rate_hz == pytest.approx(1.0 / total_s)
        assert "FC04 at 9600 8N1, then FC06 at 9600 8N1" in info.rate_note

    def test_baud_of_a_shared_line_is_that_of_both(self):
        """The reader's own profile has another."""
        assert made(baud=115200).info.rate_note.startswith(
            "FC04 at 115200 8N1, then FC06 at 115200"
        )

    def test_slower_device_limits_a_faster_wire(self):
        """Where the wire could do more, the note says whose limit it is."""
        pair = {"profile": "adam_4024", "reader": {"profile": "adam_4117", "unit_id": 2}}
        slow = made(**pair, baud=115200).info
        assert slow.rate_note.startswith("profile adam_4024 says so; the wire alone: FC03 at 1152")

    def test_baud_that_nobody_can_be_set_to_is_refused(self, tmp_path, reader):
        """Both must keep the baud of their line; where a profile knows none, any will do."""
        known = tmp_path / "known.yaml"
        known.write_text(READER.replace("baud: 115200", "baud: 115200, bauds: [57600]"))
        with pytest.raises(InputError, match=r"baud must be .*nobody.*57600, 115200, got 96"):
            made(reader={"profile": str(known), "unit_id": 2}, input="IN")
        made(reader={"profile": reader, "unit_id": 2}, input="IN")
        with pytest.raises(InputError, match=r"baud must be .*M-7024.*, got 14400"):
            made(baud=14400)

    def test_two_lines_are_silent_at_the_same_time(self):
        """With a line each, only the silence before the two replies counts."""
        info = made(reader={**READS, "serial_port": "/dev/y"}).info
        total_s = 31 * 10 / 9600 + 2 * 3.5 * 10 / 9600 + 2 * 0.002 + SETTLE_S
        assert info.max_rate_hz == pytest.approx(1.0 / total_s)
        faster = made(reader={**READS, "serial_port": "/dev/y", "baud": 115200}).info
        assert faster.rate_note.startswith("FC04 at 115200 8N1, then FC06 at 9600 8N1")

    def test_a_place_named_twice_is_one_line(self, tmp_path):
        """Two names of one port are one port; a reader there needs a unit id of its own."""
        (tmp_path / "port").touch()
        (tmp_path / "by-id").symlink_to(tmp_path / "port")
        ours = {"serial_port": str(tmp_path / "port")}
        theirs = {**READS, "serial_port": str(tmp_path / "by-id")}
        assert made(**ours, reader=theirs).info.holds == (f"serial:{tmp_path / 'port'}",)
        with pytest.raises(InputError, match="can't both be unit 1"):
            made(**ours, reader={**theirs, "unit_id": 1})

    def test_what_it_is_is_kept(self):
        """Description and details name both devices, and where the reader's registers are from."""
        info = made().info
        assert info.description == (
            "ICP DAS M-7024 (Modbus RTU) at /dev/x: AO0; ICP DAS M-7017 (Modbus RTU), unit 2 at "
            "/dev/x: AI0"
        )
        assert info.details["model"] == "M-7024 (Modbus RTU)"
        assert info.details["reader_model"] == "M-7017 (Modbus RTU)"
        assert "m7000_address_mapping" in info.details["reader_source"]

    def test_an_input_that_measures_the_output_is_no_sensor(self, reader):
        """What a supply says of itself is not what the sensor says."""
        with pytest.raises(InputError, match=r"OWN .* measures the device's own output"):
            made(reader={"profile": reader, "unit_id": 2}, input="OWN")


class TestReader:
    """What is done with the reader itself."""

    def test_self_test_comes_before_anything_moves(self, serve):
        """Another module at the reader's unit id is found out, and named."""
        served = serve("adam_4024", "adam_4117")
        words, _ = served.emulator.reader.memory._readable["holding", 210]
        words.words[:] = [0x4018]
        said = r"at /dev/pts/\d+: reader adam_4117, unit 2 at /dev/pts/\d+: self-test .* \(to open"
        with pytest.raises(DeviceError, match=said):
            served.device().open(5.0, 1)
        assert served.events() == []

    def test_init_and_close_steps_are_carried_out(self, serve, reader):
        """The reader is set up before the first sample, and let go of after the last."""
        served = serve("adam_4024", reader)
        state, _ = served.emulator.reader.memory._readable["holding", 7]
        device = served.device(baud=115200)
        device.open(5.0, 1)
        assert state.words == [1]
        exchange(device, 1.0)
        device.close()
        assert state.words == [2]

    def test_expectations_are_checked(self, serve):
        """An input that is set to another range than the profile's is refused."""
        served = serve("waveshare_ao_8ch", "waveshare_ai_8ch")
        words, _ = served.emulator.reader.memory._readable["holding", 0x1000]
        words.words[:] = [3]
        with pytest.raises(DeviceError, match=r"reader waveshare_ai_8ch.* 0 to 20 mA\)"):
            served.device().open(5.0, 1)

    @pytest.mark.parametrize(
        ("fault", "said"),
        [({"mute": frozenset({4})}, "no answer"), ({"lacking": frozenset({4})}, "exception 1")],
    )
    def test_input_that_can_not_be_read_moves_nothing(self, serve, fault, said):
        """It is read once at opening, before the first write."""
        served = serve("icp_m7024", "icp_m7017", **fault)
        with pytest.raises(DeviceError, match=rf": reader icp_m7017, .*{said}.* \(to open\)"):
            served.device(timeout_s=0.2).open(5.0, 1)
        assert served.events() == []

    @pytest.mark.parametrize(
        ("fault", "said"), [("silence@1s", "no answer"), ("exception@1s", "exception 4")]
    )
    def test_errors_name_the_reader(self, serve, fault, said):
        """The message says which device, where, and what was being done; nothing was written."""
        served = serve("icp_m7024", "icp_m7017", faults=(parse_fault(fault),))
        device = served.device(timeout_s=0.2)
        device.open(5.0, 1)
        served.clock.pass_s(2.0)
        named = rf"modbus_dac icp_m7024 at .*: reader icp_m7017, unit 2 at .*: .*{said}.* \(to wri"
        with pytest.raises(DeviceError, match=named):
            exchange(device, 1.0)
        assert served.events() == []
        with pytest.raises(DeviceError, match="not open"):
            exchange(device, 1.0)
        device.make_safe(0.0)
        assert served.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-3)

    def test_errors_of_the_one_that_drives_are_not_the_readers(self, serve):
        """A write that is refused names the device itself."""
        served = serve("icp_m7024", "icp_m7017", lacking=frozenset({6}))
        device = served.device()
        device.open(5.0, 1)
        with pytest.raises(DeviceError, match="exception 1") as refused:
            exchange(device, 1.0)
        assert "reader" not in str(refused.value)

    def test_both_lines_are_let_go_of(self, serve):
        """After an error in the one, neither port is kept."""
        faults = (parse_fault("silence@1s"),)
        served = serve("icp_m7024", "icp_m7017", reader_line="own", faults=faults)
        device, other = served.device(timeout_s=0.2), served.device(timeout_s=0.2)
        device.open(5.0, 1)
        with pytest.raises(DeviceError, match="can't be opened"):
            other.open(5.0, 1)
        served.clock.pass_s(2.0)
        with pytest.raises(DeviceError, match="reader icp_m7017"):
            exchange(device, 1.0)
        other.open(5.0, 1)
        other.close()

    def test_no_reader_there_moves_nothing(self, serve):
        """A reader that can't be reached is told at opening, by its own address."""
        served = serve("adam_6224", "adam_6217")
        said = r"reader adam_6217, unit 1 at 127\.0\.0\.1:1: can't connect: .* \(to open\)"
        with pytest.raises(DeviceError, match=said):
            served.device(reader={**served.emulator.options["reader"], "tcp_port": 1}).open(5.0, 1)
        assert served.events() == []


class TestWatchdog:
    """The watchdog belongs to the device that drives."""

    def test_writes_feed_it(self, serve):
        """Samples keep it quiet, though every second request is for the reader; silence trips."""
        served = serve("icp_m7024", "icp_m7017")
        device = served.device(watchdog={"timeout_s": 1.0})
        device.open(5.0, 1)
        for _ in range(6):
            served.clock.pass_s(0.5)
            exchange(device, 2.0)
        assert not served.emulator.device.tripped
        served.clock.pass_s(1.5)
        with pytest.raises(DeviceError, match="exception 4"):
            exchange(device, 2.0)
        assert served.emulator.device.tripped
