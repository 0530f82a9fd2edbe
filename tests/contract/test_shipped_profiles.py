"""Shipped device profiles agree with the vendors' documents."""

from itertools import chain

import pytest

from hilctl.base.yaml import load_document, loc_of
from hilctl_drivers.ascii.ascii_profile import AsciiProfile, SendStep, fields_of, fill
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.modbus.pdu import read_pdu, rtu_adu, write_single_pdu
from hilctl_drivers.modbus.register_map import EnsureStep, RegisterStep
from hilctl_drivers.profile import FOLDER, LINK_KINDS, load_profile, profile_class, shipped_profiles

NAMES = (
    "acromag_962en", "adam_4024", "adam_4024_ascii", "adam_4117", "adam_6024", "adam_6217",
    "adam_6224", "agilent_34970a", "attocube_anc300", "beckhoff_bk9000", "bk_precision_1785b",
    "capancdt_6200", "cobs_board", "cobs_board_fifo", "generic_float32", "icp_et7000", "icp_m7017",
    "icp_m7024", "icp_m7024_dcon", "kepco_bop", "keyence_cl3000", "labjack_t4", "labjack_t7",
    "labjack_t8", "magna_power_sl", "moxa_iologik_e1240", "npoint_lc400", "optoncdt_1420",
    "pi_e709", "pi_e727", "pi_e727_3cd", "tdk_lambda_gen", "thorlabs_kpz101", "thorlabs_ksg101",
    "thorlabs_mdt693b", "wago_750", "waveshare_ai_8ch", "waveshare_ai_8ch_b", "waveshare_ao_8ch",
    "waveshare_ao_8ch_b",
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
    ("acromag_962en", "CH0", 9, 4, "4e20", 10.0),
    ("acromag_962en", "CH5", 14, 4, "b1e0", -10.0),
    ("moxa_iologik_e1240", "AI0", 0, 4, "ffff", 10.0),
    ("moxa_iologik_e1240", "AI7", 7, 4, "0000", 0.0),
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
    ("acromag_962en", "init.1", "holding", 1),
    ("moxa_iologik_e1240", "init.7", "holding", 31),
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
    "labjack_t8": (1.0, "any", "safe", False), "adam_4024_ascii": (0.1, "any", "stored", False),
    "icp_m7024": (0.1, "write", "stored", True), "icp_m7024_dcon": (0.1, "strict", "safe", True),
    "wago_750": (0.1, "write", "zero", True), "beckhoff_bk9000": (0.001, "write", "zero", True),
    "cobs_board": (0.001, "any", "safe", True), "cobs_board_fifo": (0.001, "any", "safe", True),
}  # fmt: skip
EXCHANGES = {
    "labjack_t4": 76, "labjack_t7": 76, "labjack_t8": 76, "wago_750": 23, "beckhoff_bk9000": 23,
    "generic_float32": 23,
}  # fmt: skip


@pytest.fixture(scope="module")
def profiles():
    return {name: load_profile(name) for name in NAMES}


@pytest.fixture(scope="module")
def modbus(profiles):
    return {name: each for name, each in profiles.items() if isinstance(each, ModbusProfile)}


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


def test_names(profiles):
    assert tuple(shipped_profiles()) == NAMES
    assert len({profile.title for profile in profiles.values()}) == len(NAMES)


def test_schema_line(name):
    text = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.startswith("# yaml-language-server: $schema=schema.json\n")
    assert max(map(len, text.splitlines())) <= 120


def test_round_trip(profiles, name):
    profile = profiles[name]
    assert type(profile).model_validate(profile.model_dump()) == profile
    assert type(profile) in {profile_class(kind) for kind in LINK_KINDS}


def test_provenance(profiles, name):
    profile, document = profiles[name], load_document(FOLDER / f"{name}.yaml")
    assert profile.verified in {"partly", "no"}
    assert len(set(profile.unverified)) == len(profile.unverified)
    assert profile.unverified or profile.verified == "no"
    assert all(document.holds(loc_of(key)) for key in profile.unverified)


def test_missing_sensor_or_output_is_said_so(profiles, name):
    profile = profiles[name]
    channels = profile.inputs.values()
    reads = any(getattr(channel, "measures", "terminal") == "terminal" for channel in channels)
    said = any("sensor must be read by another device" in note for note in profile.notes)
    assert said is not reads
    only_reads = any(note.startswith("It only reads.") for note in profile.notes)
    assert only_reads is not bool(profile.outputs)


def test_watchdog(profiles, name):
    watchdog = profiles[name].watchdog
    if name not in WATCHDOGS:
        assert watchdog == "none"
        return
    assert WATCHDOGS[name] == (
        watchdog.unit_s, watchdog.kick, watchdog.on_trip, watchdog.refuses_while_tripped,
    )  # fmt: skip
    assert watchdog.counts(watchdog.min_s) >= 1


@pytest.mark.parametrize(("name", "output", "address", "function", "value", "data"), OUTPUTS)
def test_modbus_output(modbus, name, output, address, function, value, data):
    channel = modbus[name].outputs[output]
    assert modbus[name].wire_address(channel) == address
    assert channel.function == function
    assert channel.format.encode(value).hex() == data
    assert channel.limits[0] <= value <= channel.limits[1]


@pytest.mark.parametrize(("name", "sensor", "address", "function", "data", "value"), INPUTS)
def test_modbus_input(modbus, name, sensor, address, function, data, value):
    channel = modbus[name].inputs[sensor]
    assert modbus[name].wire_address(channel) == address
    assert channel.read_function == function
    assert channel.format.decode(bytes.fromhex(data)) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize(("name", "key", "area", "address"), SPECIAL)
def test_other_registers(modbus, name, key, area, address):
    register = dict(modbus[name].registers())[key]
    assert (register.area, modbus[name].wire_address(register)) == (area, address)


def test_transactions(modbus):
    """Devices with a function that writes and reads use one transaction, the others two."""
    found = {name: each.exchange for name, each in modbus.items() if each.exchange != "none"}
    assert found == EXCHANGES


def test_waveshare_examples(modbus):
    """The vendor's frames: output 0 set to 1000, all eight inputs, and their settings."""
    output, reader = modbus["waveshare_ao_8ch"], modbus["waveshare_ai_8ch"]
    channel = output.outputs["AO0"]
    write = write_single_pdu(output.wire_address(channel), channel.format.encode(1.0))
    values, settings = reader.inputs["AI0"], dict(reader.registers())["init.0"]
    reads = [
        read_pdu(each.read_function, reader.wire_address(each), 8) for each in (values, settings)
    ]
    assert output.unit_id == 1
    assert [rtu_adu(1, pdu).hex(" ") for pdu in (write, *reads)] == [
        "01 06 00 00 03 e8 89 74",
        "01 04 00 00 00 08 f1 cc",
        "01 03 10 00 00 08 40 cc",
    ]


def test_every_limit_can_be_written(modbus):
    for channel in chain(*(each.outputs.values() for each in modbus.values())):
        for value in channel.limits:
            written = channel.format.decode(channel.format.encode(value))
            assert written == pytest.approx(value, abs=1e-6)
            low, high = channel.raw_limits
            assert low <= round((written - channel.offset) / channel.scale, 6) <= high


def test_write_only(modbus):
    """A LJTick-DAC cannot be read; everything else can, WAGO's outputs 0x0200 further."""
    labjack, wago = modbus["labjack_t7"], modbus["wago_750"]
    assert labjack.outputs["TDAC0"].readback_register is None
    assert labjack.outputs["DAC0"].readback_register is labjack.outputs["DAC0"]
    register = wago.outputs["AO0"].readback_register
    assert wago.wire_address(register) == 0x0200
    assert register.format.decode(bytes.fromhex("8001")) == pytest.approx(-10.0)


def test_resolution(modbus):
    """The resolution includes the bits that the device drops."""
    assert modbus["wago_750"].outputs["AO0"].step == pytest.approx(8 * 10.0 / 32767)
    assert modbus["adam_4024"].outputs["AO0"].step == pytest.approx(20.0 / 4095)
    assert modbus["labjack_t7"].outputs["DAC0"].step == 1.22e-3


@pytest.mark.parametrize("name", ["labjack_t4", "labjack_t7", "labjack_t8"])
def test_flash_is_not_rewritten(modbus, name):
    """LabJack keeps its watchdog settings in flash: unchanged values are not written."""
    watchdog = modbus[name].watchdog
    steps = (*watchdog.arm, *watchdog.safe["DAC0"], *watchdog.safe["DAC1"])
    assert all(isinstance(step, EnsureStep) for step in steps)
    assert not watchdog.disarm
    first, last = watchdog.unlock[0], watchdog.arm[-1]
    assert isinstance(first, RegisterStep)
    assert isinstance(last, RegisterStep)
    assert (first.address, first.value) == (last.address, 0.0)
    assert last.value == 1.0


@pytest.mark.parametrize(("name", "output", "value", "line"), [
    ("icp_m7024_dcon", "AO2", 5.0, "#012+05.000"),
    ("icp_m7024_dcon", "AO0", -10.0, "#010-10.000"),
    ("adam_4024_ascii", "AO1", 2.5, "#01C1+02.500"),
    ("kepco_bop", "current", -2.5, "CURR -2.500000"),
    ("kepco_bop", "current", 1e-7, "CURR 0.000000"),
    ("tdk_lambda_gen", "current", 7.07, "PC 7.070"),
    ("pi_e727", "axis1", 12.5, "SVA 1 12.5000"),
    ("magna_power_sl", "current", 2.5, "CURR 2.5000"),
    ("bk_precision_1785b", "current", 3.12, "AA 00 24 30 0C" + " 00" * 20),
    ("thorlabs_kpz101", "voltage", 75.0, "43 06 04 00 D0 01 01 00 FF 7F"),
    ("thorlabs_kpz101", "voltage", 0.0, "43 06 04 00 D0 01 01 00 00 00"),
    ("npoint_lc400", "axis1", 0.0190735, "A2 18 12 83 11 E8 03 00 00 55"),
    ("npoint_lc400", "axis1", -10.0, "A2 18 12 83 11 01 00 F8 FF 55"),
])  # fmt: skip
def test_text_output(profiles, name, output, value, line):
    """The output line agrees with the manual and has no exponent."""
    profile = profiles[name]
    channel = profile.outputs[output]
    assert fill(channel.write, value=channel.number(value), address=profile.unit) == line


def test_dcon_watchdog(profiles):
    """The manual's example: ~013164 is 10.0 s for module 01."""
    profile = profiles["icp_m7024_dcon"]
    step = profile.watchdog.arm[0]
    assert isinstance(step, SendStep)
    line = step.text.format(address=profile.address, timeout=profile.watchdog.counts(10.0))
    assert line == "~013164"


@pytest.mark.parametrize(("name", "text"), [
    ("kepco_bop", "CURR 1.000000;:MEAS:CURR?"), ("pi_e709", "POS? 1\nSVA 1 1.0000"),
])  # fmt: skip
def test_text_exchange(profiles, name, text):
    assert profiles[name].exchange.write.format(value=1.0) == text


@pytest.mark.parametrize(("reply", "number", "invalid"), [
    ("MS,-0000.1234,0,LO", "-0000.1234", False), ("MS,-999999,1,--", None, True),
    ("MS,-999999.0,1,GO", None, True),
])  # fmt: skip
def test_keyence_reading(profiles, reply, number, invalid):
    sensor = profiles["keyence_cl3000"].inputs["OUT1"]
    found = sensor.match(reply)
    assert (found and found[1]) == number
    assert (sensor.invalid.match(reply) is not None) is invalid


def test_gap(profiles):
    """TDK-Lambda needs 5 ms between commands."""
    assert profiles["tdk_lambda_gen"].link.min_gap_s == 0.005


def test_no_timeout_in_text_outputs(profiles):
    texts = [each for each in profiles.values() if isinstance(each, AsciiProfile)]
    outputs = [output for each in texts for output in each.outputs.values()]
    assert outputs
    assert all(fields_of(output.write) <= {"value", "address"} for output in outputs)


@pytest.mark.parametrize(("name", "stream"), [("cobs_board", False), ("cobs_board_fifo", True)])
def test_board(profiles, name, stream):
    """Little-endian float32 volts in COBS frames, single samples or a stream."""
    profile = profiles[name]
    assert isinstance(profile, FrameProfile)
    assert (profile.exchange == "stream") is stream
    assert (profile.link.framing, profile.link.crc) == ("cobs", "crc16_ccitt_false")
    assert profile.outputs["DAC"].format.encode(2.5).hex() == "00002040"
