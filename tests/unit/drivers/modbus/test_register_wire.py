"""modbus_dac on loopback: what it checks before it opens, how it exchanges, and its watchdog."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.dac import ModbusDac, ModbusOptions
from hilctl_drivers.emulator.options import parse_fault
from tests.fakes import T7_OPTIONS, made_safe, one_rig
from tests.unit.drivers.modbus.conftest import exchange

T7 = {**T7_OPTIONS, "host": "h"}
READER = {"profile": "adam_6217", "unit_id": 2}
READS = {"reader": READER, "input": "AI0"}


@pytest.fixture
def module(variant):
    """A profile for Modbus RTU, by path."""
    return variant(
        ("{kind: tcp, port: 502}", "{kind: rtu, baud: 115200}"), ("_s: 0.0005", "_s: 0.0")
    )


def made(**changes):
    return ModbusDac(ModbusOptions.model_validate({**T7, **changes}))


class TestOptions:
    @pytest.mark.parametrize(("changes", "words"), [
        ({"host": None}, "either host or serial_port"),
        ({"reader": {"unit_id": 2}}, "Field required"),
        ({"reader": {"profile": "nothing"}}, "no profile 'nothing' is shipped"),
        ({"profile": 7}, "valid string"),
        ({"amplifier": {"offset_a": 1.0}}, "must have one of gain_a_per_v"),
        ({"amplifier": {"gain_a_per_v": 1.0, "gain_v_per_v": 1.0}}, "must have one of"),
        ({"amplifier": {"gain_v_per_v": 1.0, "offset_a": 1.0}}, "offset must be in the unit"),
        ({"sensor": {"um_per_v": 1.0, "um_per_mm": 1.0}}, "must have one of um_per_v"),
    ])  # fmt: skip
    def test_options_that_contradict_themselves(self, changes, words):
        with pytest.raises(ValidationError, match=words):
            made(**changes)

    def test_watchdog_must_be_decided(self):
        with pytest.raises(ValidationError, match="watchdog"):
            ModbusOptions.model_validate({key: T7[key] for key in T7 if key != "watchdog"})

    @pytest.mark.parametrize(("changes", "words"), [
        ({"output": "DAC9"}, "output must be one that LabJack T7 has, got 'DAC9'"),
        ({"input": "AIN9"}, "input must be one that LabJack T7 has"),
        ({"amplifier": None}, "amplifier is required"),
        ({"amplifier": {"gain_a_per_ma": 1.0}}, "amplifier takes mA"),
        ({"profile": "kepco_bop"}, "kepco_bop"),
        ({"timeout_s": 1e-4}, "timeout_s must be > 0.001"),
        ({**READS, "input": "AI9"}, "input must be one that Advantech ADAM-6217 has"),
    ])  # fmt: skip
    def test_options_that_do_not_go_with_the_profile(self, changes, words):
        with pytest.raises(InputError, match=words):
            made(**changes)

    def test_range_is_that_of_the_terminals_through_the_chain(self):
        info = made().info
        assert (info.command_min, info.command_max, info.command_unit) == (-10.0, 10.0, "A")
        assert (info.sensor_min_um, info.sensor_max_um) == (-125.0, 125.0)
        turned = made(amplifier={"gain_v_per_v": -2.0, "offset_v": 1.0}).info
        assert (turned.command_min, turned.command_max, turned.command_unit) == (-9.0, 1.0, "V")

    def test_rate_is_what_the_wire_leaves(self, module):
        """115200 8N1 with standard gaps: 2.26 ms of characters and 3.5 ms of silence."""
        options = {
            "profile": module,
            "host": None,
            "serial_port": "/dev/x",
            "output": "OUT",
            "input": "IN",
        }
        info = made(**options).info
        assert info.max_rate_hz == pytest.approx(174.0, abs=1.0)
        assert "FC23 at 115200 8N1" in info.rate_note
        assert made(**options, baud=9600).info.max_rate_hz == pytest.approx(29.0, abs=1.0)

    def test_wiring_is_kept_as_json(self):
        calibration = {"date": "2026-01-01", "by": "N. N.", "reference": "sheet 4"}
        details = made(calibration=calibration).info.details
        assert json.loads(details["calibration"]) == calibration
        assert json.loads(details["amplifier"]).keys() == {"gain_a_per_v", "offset_a", "offset_v"}
        assert json.loads(details["sensor"]).keys() == {"um_per_v", "offset_um"}


SILENCE_S = 0.5
"""A timeout that a test waits for."""


class TestExchange:
    @pytest.mark.parametrize(("profile", "without", "one"), [
        ("labjack_t7", {}, True),
        ("labjack_t7", {"lacking": frozenset({76})}, False),
        ("wago_750", {}, True),
        ("wago_750", {"lacking": frozenset({23})}, False),
        ("wago_750", {"mute": frozenset({23})}, False),
        ("icp_et7000", {}, False),
    ])  # fmt: skip
    def test_one_transaction_is_found_out_without_moving(self, serve, profile, without, one):
        served = serve(profile, **without)
        device = served.running(10.0, timeout_s=0.5)
        assert (device.transactions == 1) is one
        assert {event["current_a"] for event in served.events()} <= {0.0}
        exchange(device, 3.0)
        served.clock.pass_s(0.1)
        assert exchange(device, 3.0) == pytest.approx(16.5, abs=1.0)
        assert served.events()[-1]["current_a"] == pytest.approx(3.0, abs=1e-3)
        device.close()

    @pytest.mark.parametrize("without", [{}, {"lacking": frozenset({76})}])
    def test_input_is_read_before_the_output_is_written(self, serve, without):
        served = serve("labjack_t7", **without)
        device = served.running(10.0)
        emulated, order = served.emulator.device, []
        read, write = emulated.read, emulated.write

        def reading(areas, address, count):
            order.append(("read", address))
            return read(areas, address, count)

        def writing(area, address, values):
            order.append(("write", address))
            write(area, address, values)

        emulated.read, emulated.write = reading, writing
        exchange(device, 1.0)
        assert order == [("read", 0), ("write", 1000)]
        device.close()

    @pytest.mark.parametrize("kind", ["23", "none"])
    def test_wrong_input_is_found_out_at_opening(self, serve, variant, kind):
        served = serve("generic_float32")
        wrong = variant(
            ("exchange: 23", f"exchange: {kind}"), ("IN: {address: 2,", "IN: {address: 50,")
        )
        with pytest.raises(DeviceError, match=r"exception 2 .*open"):
            served.device(profile=wrong).open(10.0, 1)
        assert served.events() == []

    def test_slower_way_may_be_too_slow(self, serve):
        device = serve("labjack_t7", lacking=frozenset({76})).running(500.0)
        with pytest.raises(DeviceError, match=r"\(0, 500\] Hz \(2 transactions a sample; "):
            device.open(501.0, 1)

    def test_output_that_can_not_be_read_is_not_tried(self, serve):
        """A TDAC cannot be read back, so trying function 76 on it would move it."""
        served = serve("labjack_t7", rigs=one_rig(output="TDAC0"))
        device = served.running(333.0)
        assert device.info.max_rate_hz == pytest.approx(1e3 / 3)  # 1 ms each and 1 ms to settle
        assert device.transactions == 2
        assert served.events() == []
        exchange(device, 1.0)
        device.close()

    @pytest.mark.parametrize(("link", "fault", "said"), [
        ("tcp", "silence", "no answer within"),
        ("tcp", "corrupt", "not a Modbus TCP header"),
        ("tcp", "cut", "only 6 bytes, 2 short, within"),
        ("tcp", "duplicate", "bytes after the end of the reply"),
        ("tcp", "wrong_id", "transaction must be"),
        ("tcp", "reset", "connection lost"),
        ("tcp", "exception", "exception 4"),
        ("rtu", "silence", "no answer within"),
        ("rtu", "corrupt", "CRC of 9 bytes is wrong"),
        ("rtu", "cut", "short, within"),
        ("rtu", "duplicate", "CRC of 18 bytes is wrong"),
        ("rtu", "wrong_id", "unit must be 1, got 2"),
    ])  # fmt: skip
    def test_bad_answer_is_told(self, serve, module, link, fault, said):
        profile = module if link == "rtu" else "labjack_t7"
        served = serve(profile, faults=(parse_fault(f"{fault}@1s"),))
        waits = {"timeout_s": SILENCE_S} if "within" in said else {}
        device = served.running(**waits)
        exchange(device, 1.0)
        served.clock.pass_s(2.0)
        with pytest.raises(DeviceError, match=rf"{said}.*\(to write"):
            exchange(device, 1.0)
        with pytest.raises(DeviceError, match="not open"):
            exchange(device, 1.0)
        device.make_safe(0.0)
        assert served.events()[-1]["current_a"] == pytest.approx(0.0, abs=1e-5)
        device.open(100.0, 1)
        exchange(device, 0.0)
        device.close()

    def test_nobody_there(self):
        device = made(host="127.0.0.1", tcp_port=1)
        words = r"modbus_dac labjack_t7 at 127\.0\.0\.1:1: cannot connect: .* \(to open\)"
        with pytest.raises(DeviceError, match=words):
            device.open(100.0, 1)
        with pytest.raises(DeviceError, match="make safe, DAC0"):
            device.make_safe(0.0)


class TestSteps:
    def test_wrong_device_is_refused(self, serve):
        """A self-test register with words swapped means another byte order than the profile's."""
        served = serve("labjack_t7")
        words, _ = served.emulator.device.memory._readable["holding", 55100]
        words.data = words.data[2:] + words.data[:2]
        with pytest.raises(DeviceError, match=r"self-test register 55100"):
            served.device().open(100.0, 1)
        assert served.events() == []

    def test_init_is_verified(self, serve):
        served = serve("labjack_t7")
        memory = served.emulator.device.memory
        kept, _ = memory._writable["holding", 43903]
        memory._writable["holding", 43903] = (type(kept)(kept.register), 0)
        with pytest.raises(DeviceError, match=r"step write"):
            served.device().open(100.0, 1)

    def test_expectation_is_checked(self, serve):
        served = serve("icp_et7000")
        words, _ = served.emulator.device.memory._readable["coil", 631]
        words.data = b"\0\1"
        with pytest.raises(DeviceError, match="AI data format"):
            served.device().open(10.0, 1)


class TestWatchdog:
    def test_trips_to_the_safe_command(self, serve):
        """A T7 goes to the volts that stand for the safe command, when the time is up."""
        served = serve("labjack_t7")
        device = served.running(watchdog={"timeout_s": 2.0, "safe_command": 1.0})
        exchange(device, 3.0)
        served.clock.pass_s(1.9)
        exchange(device, 3.0)
        assert [event["event"] for event in served.events()].count("watchdog") == 0
        served.clock.pass_s(2.1)
        exchange(device, 3.0)
        trips = [event for event in served.events() if event["event"] == "watchdog"]
        assert [trip["output"] for trip in trips] == ["DAC0"]
        assert trips[0]["current_a"] == pytest.approx(1.0)
        assert trips[0]["monotonic_ns"] == pytest.approx(3.9e9)
        device.close()

    def test_settings_in_flash_are_written_once(self, serve):
        served = serve("labjack_t7")
        emulated, written = served.emulator.device, []
        write = emulated.write

        def noting(area, address, values):
            written.append(address)
            write(area, address, values)

        emulated.write = noting
        for watchdog_writes in ([61600, 61640, 61642, 61604, 61600], []):
            written.clear()
            served.running(watchdog={"timeout_s": 2.0}).close()
            assert [address for address in written if address > 61000] == watchdog_writes

    def test_trip_is_cleared_at_the_next_start(self, serve):
        """A tripped WAGO refuses commands until its watchdog is restarted; opening does that."""
        served = serve("wago_750")
        device = served.running(watchdog={"timeout_s": 0.5})
        exchange(device, 3.0)
        served.clock.pass_s(0.6)
        with pytest.raises(DeviceError, match="exception 4"):
            exchange(device, 3.0)
        assert served.emulator.device.tripped
        tripped = [event for event in served.events() if event["event"] == "watchdog"]
        assert [(each["output"], each["value"]) for each in tripped] == [("AO0", 0.0), ("AO1", 0.0)]
        device.open(100.0, 1)
        device.arm()
        exchange(device, 2.0)
        device.close()
        served.clock.pass_s(60.0)
        served_events = [event["event"] for event in served.events()]
        assert served_events.count("watchdog") == 2  # both outputs, once: closing disarmed it

    def test_too_slow_a_loop_would_trip_it(self, serve):
        device = serve("labjack_t7").device(watchdog={"timeout_s": 1.0})
        with pytest.raises(DeviceError, match="watchdog's timeout"):
            device.open(2.0, 1)


def test_device_as_it_powers_up(driven):
    """A LabJack gives 0 V, which the amplifier makes the end of its range; opening leaves it."""
    made = driven("labjack_t7", current_a=None)
    made.open()
    assert made.device.output() == pytest.approx(-10.0)
    assert {each["current_a"] for each in made.writes()} == {-10.0}


def test_value_out_of_range_is_returned_as_it_is(driven):
    made = driven()
    made.open()
    made.emulated.device._outputs["OUT"].value = 17.0
    assert made.device.output() == pytest.approx(17.0)


def test_output_that_can_not_be_read_is_not_known(driven, variant):
    made = driven(variant(("OUT: {address: 0,", "OUT: {readback: none, address: 0,")))
    made.open()
    made.exchange(3.0)
    assert made.device.output() is None


END = "max: 10.0}\nwatchdog"
FOREVER_NS = 2**62


@pytest.mark.parametrize(("validity", "requests"), [
    ("{address: 4, type: uint16, mask: 0x3, valid: 0x1}", ["17000200030000000102"]),
    ("{address: 1, type: uint16, mask: 0x8}", ["17000100030000000102"]),
    ("{address: 3, type: uint16, mask: 0x1}", ["17000200020000000102"]),
    ("{address: 9, type: uint16, mask: 0x3, valid: 0x1}", ["17000200020000000102", "0300090001"]),
    ("{area: discrete, address: 5, type: bit, mask: 1}", ["17000200020000000102", "0200050001"]),
])  # fmt: skip
def test_invalid_reading_is_missing(driven, variant, validity, requests):
    """A register beside the input is read with it, and so is one that is part of it."""
    output = (
        "OUT: {address: 0, type: float32, order: ABCD",
        "OUT: {address: 0, type: int16, scale: 0.001",
    )
    made = driven(variant(output, (END, f"max: 10.0, validity: {validity}}}\nwatchdog")))
    made.open()
    assert abs(made.exchange(0.0)) < 1.0
    made.emulated.device.invalid_until_ns = FOREVER_NS
    made.link.requests.clear()
    assert math.isnan(made.exchange(1.0))
    sent = [each[7:].hex() for each in made.link.requests]
    assert [each[: len(start)] for each, start in zip(sent, requests, strict=True)] == requests
    made.emulated.device.invalid_until_ns = 0
    assert math.isfinite(made.exchange(1.0))


class TestErrorRegister:
    REGISTER = "error_register: {address: 6, type: uint16, mask: 0xFF}\nwatchdog: none"
    ERROR = "error register, holding 6, holds 0x5"

    @pytest.fixture
    def rig(self, driven, variant):
        return driven(variant(("watchdog: none", self.REGISTER)))

    def test_refused_value_ends_exchanges(self, rig):
        rig.open()
        rig.exchange(1.0)
        rig.emulated.device.write("holding", 6, b"\xff\5")
        with pytest.raises(DeviceError, match=self.ERROR):
            rig.exchange(2.0)
        made_safe(rig.device, 0.0)
        assert rig.current_a == pytest.approx(0.0)

    def test_error_of_before_refuses_to_open(self, rig):
        rig.emulated.device.write("holding", 6, b"\0\5")
        with pytest.raises(DeviceError, match=self.ERROR):
            rig.open()
        assert rig.current_a == pytest.approx(0.0)

    def test_error_of_before_that_reading_clears_is_noted(self, rig, monkeypatch):
        device = rig.emulated.device
        device.write("holding", 6, b"\0\5")
        read = device.read

        def read_and_clear(areas, address, count):
            found = read(areas, address, count)
            if address == 6:
                device.write("holding", 6, bytes(2))
            return found

        monkeypatch.setattr(device, "read", read_and_clear)
        rig.open()
        assert "0x5" in rig.device.info.details["earlier_errors"]
        rig.exchange(1.0)


class TestMeasure:
    INPUT = "\n  MON: {address: 8, type: float32, unit: %s, min: -9.0, max: 9.0, measures: output}"

    @pytest.mark.parametrize("unit", ["V", "A"])
    def test_measured_command(self, driven, variant, unit):
        made = driven(variant((END, f"max: 10.0}}{self.INPUT % unit}\nwatchdog")), measure="MON")
        made.open()
        assert made.device.info.measures_command
        measured = np.full(1, np.nan)
        made.device.exchange(0, np.array([3.0]), np.empty(1), measured)
        assert measured == pytest.approx([3.0])
        assert not made.another(measure=None).info.measures_command

    @pytest.mark.parametrize(("unit", "name", "words"), [
        ("um", "MON", "measure must be in V or A"),
        ("V", "IN", "measures its own output, got 'IN'"),
    ])  # fmt: skip
    def test_input_that_does_not_measure_it_is_refused(self, variant, unit, name, words):
        path = variant((END, f"max: 10.0}}{self.INPUT % unit}\nwatchdog"))
        with pytest.raises(InputError, match=words):
            made(profile=path, output="OUT", input="IN", measure=name)


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
SETTLE_S = 0.01
"""Of an M-7024's output."""


def placed(**changes):
    return ModbusDac(ModbusOptions.model_validate({**PAIR, **changes}))


class TestPlaces:
    @pytest.mark.parametrize(("profile", "reader", "options", "places"), [
        ("adam_4024", "adam_4117", {}, 1),
        ("adam_4024", "adam_4117", {"reader_line": "own"}, 2),
        ("adam_4024", "adam_4117", {"link": "tcp"}, 1),
        ("adam_6224", "adam_6217", {}, 2),
        ("adam_6224", "adam_6217", {"reader_line": "same", "reader_unit_id": 9}, 1),
        ("adam_4024", "adam_6217", {}, 2),
        ("adam_6224", "adam_4117", {}, 2),
    ])  # fmt: skip
    def test_one_drives_and_the_other_reads(self, serve, profile, reader, options, places):
        served = serve(profile, reader, **options)
        device = served.device()
        held = [name for name in device.info.holds if not name.startswith("tty:")]
        assert len(held) == places
        device.open(5.0, 1)
        exchange(device, 3.0)
        served.clock.pass_s(0.1)
        assert exchange(device, 3.0) == pytest.approx(16.5, abs=1.0)
        assert [event["output"] for event in served.events()] == ["AO0"] * 3
        device.make_safe(0.0)
        assert served.events()[-1]["current_a"] == pytest.approx(0.0, abs=5e-3)

    def test_rate_counts_both(self):
        """One read and one write at 9600 8N1: 31 characters, 4 gaps, two turnarounds, settling."""
        info = placed().info
        total_s = 31 * 10 / 9600 + 4 * 3.5 * 10 / 9600 + 2 * 0.002 + SETTLE_S
        assert info.max_rate_hz == pytest.approx(1.0 / total_s)
        assert "FC04 at 9600 8N1, then FC06 at 9600 8N1" in info.rate_note

    def test_slower_device_limits_a_faster_wire(self):
        pair = {"profile": "adam_4024", "reader": {"profile": "adam_4117", "unit_id": 2}}
        slow = placed(**pair, baud=115200).info
        assert slow.rate_note.startswith("profile adam_4024 says so; the wire alone: FC03 at 1152")

    def test_baud_that_nobody_can_be_set_to_is_refused(self, tmp_path, reader):
        known = tmp_path / "known.yaml"
        known.write_text(
            Path(reader).read_text().replace("baud: 115200", "baud: 115200, bauds: [57600]")
        )
        with pytest.raises(InputError, match=r"baud must be .*nobody.*57600, 115200, got 96"):
            placed(reader={"profile": str(known), "unit_id": 2}, input="IN")
        placed(reader={"profile": reader, "unit_id": 2}, input="IN")
        with pytest.raises(InputError, match=r"baud must be .*M-7024.*, got 14400"):
            placed(baud=14400)

    @pytest.mark.parametrize(("baud", "slower"), [(115200, "FC06 at 9600"), (1200, "FC04 at 1200")])
    def test_the_slower_of_two_lines_sets_the_rate(self, baud, slower):
        """A write of 16 characters with settling, and a read of 15, each with two gaps."""
        reader = {**PAIR["reader"], "serial_port": "/dev/y", "baud": baud}
        info = placed(reader=reader, timeout_s=1.0).info
        write_s = 16 * 10 / 9600 + 2 * 3.5 * 10 / 9600 + 0.002 + SETTLE_S
        read_s = 15 * 10 / baud + 2 * max(3.5 * 10 / baud, 1.75e-3) + 0.002
        assert info.max_rate_hz == pytest.approx(1.0 / max(read_s, write_s))
        assert info.rate_note.startswith(f"{slower} 8N1 with FC0")

    def test_a_place_named_twice_is_one_line(self, tmp_path):
        (tmp_path / "port").touch()
        (tmp_path / "by-id").symlink_to(tmp_path / "port")
        ours = {"serial_port": str(tmp_path / "port")}
        theirs = {**PAIR["reader"], "serial_port": str(tmp_path / "by-id")}
        assert placed(**ours, reader=theirs).info.holds == (f"serial:{tmp_path / 'port'}",)
        with pytest.raises(InputError, match="both are unit"):
            placed(**ours, reader={**theirs, "unit_id": 1})


class TestAux:
    INPUTS = "".join(
        f"\n  {name}: {{address: {at}, type: uint16, unit: {unit}, min: 0.0, max: 999.0}}"
        for name, at, unit in (("TEMP", 20, "degC"), ("FORCE", 21, "V"))
    )
    AUX = (("coil_c", {"input": "TEMP"}),
           ("preload_n", {"input": "FORCE", "scale": 2.0, "offset": 1.0, "unit": "N"}))  # fmt: skip

    def test_one_channel_per_exchange_in_turn(self, driven, variant):
        profile = variant((END, f"max: 10.0}}{self.INPUTS}\nwatchdog"))
        made = driven(profile, aux=dict(self.AUX))
        device = made.device
        made.open()
        assert [(each.name, each.unit) for each in device.info.aux] == [
            ("coil_c", "°C"), ("preload_n", "N"),
        ]  # fmt: skip
        found = [device.aux.tolist()]
        for _ in range(2):  # the emulated inputs read the command, and the output as a voltage
            made.exchange(4.0)
            found.append(device.aux.tolist())
        assert found == [[0.0, 1.0], [4.0, 1.0], [4.0, 9.0]]

    @pytest.mark.parametrize(("profile", "inputs"), [
        ("labjack_t7", ("AIN2", "AIN3")),
        ("wago_750", ("AI1", "AI0")),
        ("beckhoff_bk9000", ("AI1", "AI0")),
    ])  # fmt: skip
    def test_channels_of_the_output_s_device_are_read_in_its_one_transaction(
        self, serve, profile, inputs
    ):
        aux = {f"aux{k}_v": {"input": each} for k, each in enumerate(inputs)}
        served = serve(profile)
        alone, device = served.device(), served.running(aux=aux)
        assert device.info.details["transactions"] == "1"
        assert device.info.max_rate_hz == alone.info.max_rate_hz
        device.aux[:] = np.nan
        exchange(device, 1.0)
        assert np.isfinite(device.aux).all()
        device.close()

    def test_channels_and_the_measured_output_share_a_span(self, driven, variant):
        measure = TestMeasure.INPUT.replace("address: 8", "address: 4") % "V"
        inputs = self.INPUTS.replace("20", "6").replace("21", "7")
        profile = variant((END, f"max: 10.0}}{measure}{inputs}\nwatchdog"))
        made = driven(profile, aux=dict(self.AUX), measure="MON")
        made.open()
        made.link.requests.clear()
        measured = np.full(1, np.nan)
        made.device.exchange(0, np.array([3.0]), np.empty(1), measured)
        assert [each[7] for each in made.link.requests] == [23]
        assert measured == pytest.approx([3.0])
        assert made.device.aux.tolist() == pytest.approx([3.0, 7.0])

    @pytest.mark.parametrize(("changes", "words"), [
        ({"aux": {"coil_c": {"input": "AIN99"}}}, r"aux.coil_c.input.*AIN2.*LabJack T7.*'AIN99'"),
        ({"aux": {"t_s": {"input": "AIN2"}}}, "aux.t_s"),
    ])  # fmt: skip
    def test_refused(self, changes, words):
        with pytest.raises(InputError, match=words):
            made(**changes)
