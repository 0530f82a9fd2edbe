"""Shipped device profiles agree with the vendors' documents."""

import pytest

from hilctl.base.yaml import load_document, loc_of
from hilctl_drivers.ascii.ascii_profile import AsciiProfile, SendStep, fields_of
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.modbus.pdu import read_pdu, rtu_adu, write_single_pdu
from hilctl_drivers.modbus.register_map import EnsureStep, RegisterStep
from hilctl_drivers.profile import (
    FOLDER,
    link_kinds,
    load_profile,
    profile_class,
    shipped_profiles,
)

NAMES = (
    "adam_4024", "adam_4024_ascii", "adam_4117", "adam_6024", "adam_6217", "adam_6224",
    "agilent_34970a", "beckhoff_bk9000", "cobs_board", "cobs_board_fifo", "generic_float32",
    "icp_et7000", "icp_m7017", "icp_m7024", "icp_m7024_dcon", "kepco_bop", "labjack_t4",
    "labjack_t7", "labjack_t8", "tdk_lambda_gen", "wago_750", "waveshare_ai_8ch",
    "waveshare_ai_8ch_b", "waveshare_ao_8ch", "waveshare_ao_8ch_b",
)  # fmt: skip

OUTPUTS = [
    ("labjack_t7", "DAC0", 1000, 16, 2.5, "40200000"),
    ("labjack_t7", "DAC1", 1002, 16, 0.0, "00000000"),
    ("labjack_t7", "TDAC1", 30002, 16, -10.0, "c1200000"),
    ("labjack_t4", "DAC0", 1000, 16, 5.0, "40a00000"),
    ("labjack_t8", "DAC1", 1002, 16, 10.0, "41200000"),
    ("adam_4024", "AO0", 0, 6, -10.0, "0000"),
    ("adam_4024", "AO3", 3, 6, 10.0, "0fff"),
    ("adam_6024", "AO0", 10, 6, 10.0, "0fff"),
    ("adam_6024", "AO1", 11, 6, 0.0, "0000"),
    ("adam_6224", "AO0", 0, 6, -10.0, "0000"),
    ("adam_6224", "AO3", 3, 6, 10.0, "ffff"),
    ("icp_m7024", "AO0", 0, 6, 10.0, "7fff"),
    ("icp_m7024", "AO2", 2, 6, 0.0, "0000"),
    ("icp_et7000", "AO1", 1, 6, -10.0, "8001"),
    ("waveshare_ao_8ch", "AO0", 0, 6, 1.0, "03e8"),
    ("waveshare_ao_8ch", "AO7", 7, 6, 20.0, "4e20"),
    ("waveshare_ao_8ch_b", "AO7", 7, 6, 10.0, "2710"),
    ("wago_750", "AO0", 0x0000, 16, -10.0, "8001"),
    ("wago_750", "AO1", 0x0001, 16, 10.0, "7fff"),
    ("beckhoff_bk9000", "AO0", 0x0800, 16, 5.0, "4000"),
    ("beckhoff_bk9000", "AO1", 0x0801, 16, -10.0, "8001"),
]
INPUTS = [
    ("labjack_t7", "AIN0", 0, 3, "40200000", 2.5),
    ("labjack_t7", "AIN3", 6, 3, "c0200000", -2.5),
    ("labjack_t8", "AIN7", 14, 3, "00000000", 0.0),
    ("adam_6024", "AI0", 0, 3, "0000", -10.0),
    ("adam_6024", "AI5", 5, 3, "ffff", 10.0),
    ("icp_et7000", "AI0", 0, 4, "7fff", 10.0),
    ("adam_4117", "AI0", 0, 3, "0000", -10.0),
    ("adam_4117", "AI3", 3, 3, "8000", 10.0 / 65535.0),
    ("adam_4117", "AI7", 7, 3, "ffff", 10.0),
    ("adam_6217", "AI0", 0, 3, "ffff", 10.0),
    ("adam_6217", "AI7", 7, 3, "0000", -10.0),
    ("icp_m7017", "AI0", 0, 4, "7fff", 10.0),
    ("icp_m7017", "AI7", 7, 4, "8001", -10.0),
    ("waveshare_ai_8ch", "AI0", 0, 4, "4e20", 20.0),
    ("waveshare_ai_8ch", "AI7", 7, 4, "0fa0", 4.0),
    ("waveshare_ai_8ch_b", "AI7", 7, 4, "2710", 10.0),
    ("wago_750", "AI0", 0, 3, "8001", -10.0),
    ("beckhoff_bk9000", "AI1", 1, 3, "7fff", 10.0),
]
SPECIAL = [
    ("labjack_t7", "selftest", "holding", 55100),
    ("labjack_t7", "watchdog.unlock.0", "holding", 61600),
    ("labjack_t7", "watchdog.arm.2", "holding", 61604),
    ("labjack_t7", "watchdog.safe.DAC0.0", "holding", 61640),
    ("labjack_t7", "watchdog.safe.DAC0.1", "holding", 61642),
    ("labjack_t7", "watchdog.safe.DAC1.1", "holding", 61652),
    ("adam_4024", "init.0", "holding", 200),
    ("adam_4024", "selftest", "holding", 210),
    ("icp_m7024", "init.0", "coil", 268),
    ("icp_m7024", "watchdog.arm.0", "holding", 488),
    ("icp_m7024", "watchdog.arm.1", "coil", 260),
    ("icp_m7024", "watchdog.tripped", "coil", 269),
    ("icp_m7024", "watchdog.clear.0", "coil", 269),
    ("icp_et7000", "init.0", "coil", 631),
    ("adam_4117", "init.0", "holding", 200),
    ("adam_4117", "init.7", "holding", 207),
    ("adam_4117", "selftest", "holding", 210),
    ("adam_6217", "init.7", "holding", 207),
    ("icp_m7017", "init.0", "coil", 268),
    ("waveshare_ai_8ch", "init.0", "holding", 0x1000),
    ("waveshare_ai_8ch_b", "init.7", "holding", 0x1007),
    ("wago_750", "outputs.AO1.readback", "holding", 0x0201),
    ("wago_750", "watchdog.arm.1", "holding", 0x1000),
    ("wago_750", "watchdog.tripped", "holding", 0x1006),
    ("beckhoff_bk9000", "watchdog.arm.1", "holding", 0x1120),
    ("beckhoff_bk9000", "watchdog.clear.1", "holding", 0x1121),
]
WATCHDOGS = {
    "labjack_t4": (1.0, "any", "safe", False), "labjack_t7": (1.0, "any", "safe", False),
    "labjack_t8": (1.0, "any", "safe", False), "adam_4024_ascii": (0.1, "any", "safe", False),
    "icp_m7024": (0.1, "write", "safe", True), "icp_m7024_dcon": (0.1, "strict", "safe", True),
    "wago_750": (0.1, "write", "zero", True), "beckhoff_bk9000": (0.001, "write", "zero", True),
    "cobs_board": (0.001, "any", "safe", True), "cobs_board_fifo": (0.001, "any", "safe", True),
}  # fmt: skip
EXCHANGES = {
    "labjack_t4": 76, "labjack_t7": 76, "labjack_t8": 76, "wago_750": 23, "beckhoff_bk9000": 23,
    "generic_float32": 23,
}  # fmt: skip


def modbus(name: str) -> ModbusProfile:
    """Return a shipped Modbus profile."""
    profile = load_profile(name)
    assert isinstance(profile, ModbusProfile)
    return profile


def text_based(name: str) -> AsciiProfile:
    """Return a shipped text profile."""
    profile = load_profile(name)
    assert isinstance(profile, AsciiProfile)
    return profile


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    """Each shipped profile's name."""
    found: str = request.param
    return found


class TestEach:
    """Every shipped profile."""

    def test_names(self) -> None:
        """The list of profiles is complete."""
        assert tuple(shipped_profiles()) == NAMES

    def test_no_two_alike(self) -> None:
        """No two profiles describe the same device."""
        titles = [load_profile(name).title for name in NAMES]
        assert len(set(titles)) == len(titles)

    def test_schema_line(self, name: str) -> None:
        """The first line refers to the schema."""
        text = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
        assert text.startswith("# yaml-language-server: $schema=schema.json\n")
        assert max(map(len, text.splitlines())) <= 120

    def test_round_trip(self, name: str) -> None:
        """A profile survives writing and reading."""
        profile = load_profile(name)
        assert type(profile).model_validate(profile.model_dump()) == profile
        assert type(profile) in {profile_class(kind) for kind in link_kinds()}

    def test_provenance(self, name: str) -> None:
        """Documents are named, and each unverified value is in the file and named once."""
        profile = load_profile(name)
        document = load_document(FOLDER / f"{name}.yaml")
        assert profile.verified in {"partly", "no"}
        assert len(set(profile.unverified)) == len(profile.unverified)
        assert profile.unverified or profile.verified == "no"
        assert all(document.holds(loc_of(key)) for key in profile.unverified)

    def test_no_sensor_is_said_so(self, name: str) -> None:
        """The notes of an output-only device mention a second device for the sensor."""
        profile = load_profile(name)
        channels = profile.inputs.values()
        reads = [getattr(channel, "measures", "terminal") == "terminal" for channel in channels]
        said = any("sensor must be read by another device" in note for note in profile.notes)
        assert said is not any(reads)

    def test_no_output_is_said_so(self, name: str) -> None:
        """The notes of an input-only device name a device for the output."""
        profile = load_profile(name)
        said = [note for note in profile.notes if note.startswith("It only reads.")]
        assert bool(said) is not bool(profile.outputs)

    def test_watchdog(self, name: str) -> None:
        """Unit, feeding and trip of the watchdog agree with the device."""
        watchdog = load_profile(name).watchdog
        if name not in WATCHDOGS:
            assert watchdog == "none"
            return
        assert watchdog != "none"
        assert WATCHDOGS[name] == (
            watchdog.unit_s, watchdog.kick, watchdog.on_trip, watchdog.refuses_while_tripped,
        )  # fmt: skip
        assert watchdog.counts(watchdog.min_s) >= 1


class TestModbus:
    """Modbus registers."""

    @pytest.mark.parametrize(("name", "output", "address", "function", "value", "data"), OUTPUTS)
    def test_output(
        self, name: str, output: str, address: int, function: int, value: float, data: str
    ) -> None:
        """An output's value goes to the right address, in the right bytes."""
        profile = modbus(name)
        channel = profile.outputs[output]
        assert profile.wire_address(channel) == address
        assert channel.function == function
        assert channel.format.encode(value).hex() == data
        assert channel.limits[0] <= value <= channel.limits[1]

    @pytest.mark.parametrize(("name", "sensor", "address", "function", "data", "value"), INPUTS)
    def test_input(
        self, name: str, sensor: str, address: int, function: int, data: str, value: float
    ) -> None:
        """An input is read from the right address and understood."""
        profile = modbus(name)
        channel = profile.inputs[sensor]
        assert profile.wire_address(channel) == address
        assert channel.read_function == function
        assert channel.format.decode(bytes.fromhex(data)) == pytest.approx(value, abs=1e-9)

    @pytest.mark.parametrize(("name", "key", "area", "address"), SPECIAL)
    def test_other_registers(self, name: str, key: str, area: str, address: int) -> None:
        """Addresses of settings, watchdog and self test agree with the documents."""
        profile = modbus(name)
        register = dict(profile.registers())[key]
        assert (register.area, profile.wire_address(register)) == (area, address)

    @pytest.mark.parametrize("name", [name for name in NAMES if name not in EXCHANGES])
    def test_two_transactions(self, name: str) -> None:
        """Devices without function 23 use two transactions."""
        profile = load_profile(name)
        if isinstance(profile, ModbusProfile):
            assert profile.exchange == "none"

    @pytest.mark.parametrize(("name", "function"), EXCHANGES.items())
    def test_one_transaction(self, name: str, function: int) -> None:
        """Devices with function 23 use one transaction."""
        assert modbus(name).exchange == function

    def test_waveshare_example(self) -> None:
        """The vendor's example frame: register 0 set to 1000."""
        profile = modbus("waveshare_ao_8ch")
        channel = profile.outputs["AO0"]
        pdu = write_single_pdu(profile.wire_address(channel), channel.format.encode(1.0))
        assert rtu_adu(profile.unit_id, pdu).hex(" ") == "01 06 00 00 03 e8 89 74"

    def test_waveshare_input_examples(self) -> None:
        """The vendor's example frames: all eight inputs and their settings."""
        profile = modbus("waveshare_ai_8ch")
        values, settings = profile.inputs["AI0"], dict(profile.registers())["init.0"]
        frames = [
            rtu_adu(1, read_pdu(each.read_function, profile.wire_address(each), 8)).hex(" ")
            for each in (values, settings)
        ]
        assert frames == ["01 04 00 00 00 08 f1 cc", "01 03 10 00 00 08 40 cc"]

    def test_every_limit_can_be_written(self) -> None:
        """Both ends of every output's range fit into its register and its raw limits."""
        for name in NAMES:
            profile = load_profile(name)
            if isinstance(profile, ModbusProfile):
                for channel in profile.outputs.values():
                    for value in channel.limits:
                        data = channel.format.encode(value)
                        assert channel.format.decode(data) == pytest.approx(value, abs=1e-6)
                        raw = (channel.format.decode(data) - channel.offset) / channel.scale
                        low, high = channel.raw_limits
                        assert low <= round(raw, 6) <= high

    def test_write_only(self) -> None:
        """A LJTick-DAC can't be read; everything else can, WAGO's outputs 0x0200 further."""
        labjack, wago = modbus("labjack_t7"), modbus("wago_750")
        assert labjack.outputs["TDAC0"].readback_register is None
        assert labjack.outputs["DAC0"].readback_register is labjack.outputs["DAC0"]
        register = wago.outputs["AO0"].readback_register
        assert register is not None
        assert wago.wire_address(register) == 0x0200
        assert register.format.decode(bytes.fromhex("8001")) == pytest.approx(-10.0)

    def test_resolution(self) -> None:
        """The resolution includes the bits that the device drops."""
        assert modbus("wago_750").outputs["AO0"].step == pytest.approx(8 * 10.0 / 32767)
        assert modbus("adam_4024").outputs["AO0"].step == pytest.approx(20.0 / 4095)
        assert modbus("labjack_t7").outputs["DAC0"].step == 1.22e-3

    def test_flash_is_not_rewritten(self) -> None:
        """LabJack keeps its watchdog settings in flash: unchanged values are not written."""
        for name in ("labjack_t4", "labjack_t7", "labjack_t8"):
            watchdog = modbus(name).watchdog
            assert watchdog != "none"
            steps = (*watchdog.arm, *watchdog.safe["DAC0"], *watchdog.safe["DAC1"])
            assert all(isinstance(step, EnsureStep) for step in steps)
            assert not watchdog.disarm
            first, last = watchdog.unlock[0], watchdog.arm[-1]
            assert isinstance(first, RegisterStep)
            assert isinstance(last, RegisterStep)
            assert (first.address, first.value) == (last.address, 0.0)
            assert last.value == 1.0


class TestText:
    """Text lines."""

    @pytest.mark.parametrize(
        ("name", "output", "value", "line"),
        [
            ("icp_m7024_dcon", "AO2", 5.0, "#012+05.000"),
            ("icp_m7024_dcon", "AO0", -10.0, "#010-10.000"),
            ("adam_4024_ascii", "AO1", 2.5, "#01C1+02.500"),
            ("kepco_bop", "current", -2.5, "CURR -2.500000"),
            ("kepco_bop", "current", 1e-7, "CURR 0.000000"),
            ("tdk_lambda_gen", "current", 7.07, "PC 7.070"),
        ],
    )
    def test_write(self, name: str, output: str, value: float, line: str) -> None:
        """The output line agrees with the manual and has no exponent."""
        profile = text_based(name)
        address = 0 if profile.address == "none" else profile.address
        assert profile.outputs[output].write.format(value=value, address=address) == line

    def test_dcon_watchdog(self) -> None:
        """The manual's example: ~013164 is 10.0 s for module 01."""
        profile = text_based("icp_m7024_dcon")
        assert profile.watchdog != "none"
        step = profile.watchdog.arm[0]
        assert isinstance(step, SendStep)
        line = step.text.format(address=profile.address, timeout=profile.watchdog.counts(10.0))
        assert line == "~013164"

    def test_kepco_exchange(self) -> None:
        """One line sets the current and reads it back."""
        profile = text_based("kepco_bop")
        assert profile.exchange != "none"
        assert profile.exchange.write.format(value=1.0) == "CURR 1.000000;:MEAS:CURR?"

    def test_gap(self) -> None:
        """TDK-Lambda needs 5 ms between commands."""
        assert text_based("tdk_lambda_gen").link.min_gap_s == 0.005

    def test_no_timeout_in_outputs(self) -> None:
        """An output line contains the value and the address only."""
        for name in NAMES:
            profile = load_profile(name)
            if isinstance(profile, AsciiProfile):
                for output in profile.outputs.values():
                    assert fields_of(output.write) <= {"value", "address"}


class TestBoards:
    """Microcontroller boards."""

    @pytest.mark.parametrize(("name", "stream"), [("cobs_board", False), ("cobs_board_fifo", True)])
    def test_board(self, name: str, stream: bool) -> None:
        """Little-endian float32 volts in COBS frames, single samples or a stream."""
        profile = load_profile(name)
        assert isinstance(profile, FrameProfile)
        assert (profile.exchange == "stream") is stream
        assert (profile.link.framing, profile.link.crc) == ("cobs", "crc16_ccitt_false")
        assert profile.outputs["DAC"].format.encode(2.5).hex() == "00002040"
