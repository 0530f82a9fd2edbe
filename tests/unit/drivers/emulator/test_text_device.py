"""Emulated devices that speak lines of text, with the time in the test's hand."""

from pathlib import Path

import pytest

from hilctl_drivers.emulator.text_device import in_style
from hilctl_drivers.emulator.wire import TemplateMatcher
from hilctl_drivers.simulated.devices import PiezoOptions

DCON = (Path(__file__).parents[3] / "data" / "dcon_module.yaml").read_text()


@pytest.fixture
def dcon(emulate, tmp_path):
    """A DCON module with an output and an input, at address 2."""
    path = tmp_path / "dcon.yaml"
    path.write_text(DCON)
    return emulate(path)


class TestTemplates:
    def test_a_template_is_read_backwards(self):
        assert TemplateMatcher("#{address:02X}0{value:+07.3f}", 1).match("#010-05.250") == {
            "value": -5.25
        }
        assert TemplateMatcher("~{address:02X}31{timeout:02X}", 10).match("~0A3164") == {
            "timeout": 100.0
        }
        assert TemplateMatcher("CURR {value:.6f};:MEAS:CURR?", 0).match("CURR 1.5;:MEAS:CURR?") == {
            "value": 1.5
        }
        frame = TemplateMatcher("A2 {address:uint16} {timeout:uint16 BA} {value:int16}", 258)
        assert frame.match("A2 01 02 64 00 FF FE") == {"timeout": 100.0, "value": -2.0}
        assert frame.match("A2 01 03 64 00 FF FE") is None
        for other in ("#020-05.250", "#010-05.250 ", "#010", "#011+05.000x"):
            assert TemplateMatcher("#{address:02X}0{value:+07.3f}", 1).match(other) is None

    @pytest.mark.parametrize(("example", "pattern", "value", "reply"), [
        ("!01+05.000", "![0-9A-F]{2}([+-][0-9]+\\.[0-9]+)", -1.5, "!01-01.500"),
        ("05.003", "([0-9]+\\.[0-9]+)", 12.3456, "12.346"),
        ("2.71E1", "(.*)", -0.00125, "-1.250000E-03"),
        ("+2.61920000E+00", "(.*)", 1.5, "+1.500000E+00"),
        ("id=-1234567", "id=([+-][0-9]+)", 42.0, "id=+0000042"),
        ("id=-1234567", "id=(-?[0-9]+)", 42.0, "id=0000042"),
        ("id=-1234567", "id=(-?[0-9]+)", -42.0, "id=-0000042"),
        ("id=-1234567", "id=([ -][0-9]+)", 42.0, "id= 0000042"),
        ("id=-1234567", "id=([-0-9]{8})", 42.0, "id=00000042"),
        ("-1.25E-03", "(-?[0-9.]+E[-+][0-9]+)", 1.5, "1.500000E+00"),
    ])  # fmt: skip
    def test_a_reply_looks_like_the_example(self, example, pattern, value, reply):
        """Sign, digits and exponent are as in the vendor's example."""
        assert in_style(example, pattern, value) == reply


class TestDcon:
    def test_out_of_range_and_unknown_are_said(self, dcon):
        assert dcon.ask(b"#020+10.001") == b"?"
        assert dcon.ask(b"$02Z") == b"?02"
        assert dcon.ask(b"#030+05.000") is None
        assert dcon.writes() == []

    def test_checksum_is_looked_at(self, dcon):
        wire = dcon.emulator.wires[0]
        good = b"#020+05.000"
        check = b"%02X" % (sum(good) & 0xFF)
        assert list(wire.requests(bytearray(good + check + b"\r"))) == [good]
        assert list(wire.requests(bytearray(good + b"00\r"))) == []


class TestHostWatchdog:
    @pytest.fixture
    def module(self, emulate, tmp_path):
        """The shipped DCON module, with a reader for the sensor, armed at 0.5 s."""
        path = tmp_path / "reader.yaml"
        path.write_text(DCON.replace("checksum: dcon", "checksum: none"))
        made = emulate("icp_m7024_dcon", reader=str(path), reader_line="same")
        assert made.ask(b"~013105") == b"!01"
        return made

    def test_only_the_host_ok_feeds_it(self, module):
        for _ in range(5):
            assert module.ask(b"~**", after_ms=400) is None
            assert module.ask(b"~010") == b"!0100"
        for _ in range(4):
            module.ask(b"#010+02.000", after_ms=200)
        assert module.ask(b"~010") == b"!0104"


class TestScpi:
    @pytest.fixture
    def supply(self, emulate):
        """A Kepco BOP, with the sensor on a voltmeter on another line."""
        return emulate("kepco_bop", reader="agilent_34970a")

    def test_commands_are_silent_and_errors_wait_to_be_asked_for(self, supply):
        """A setting is not answered; one out of range is kept as error -222 and changes nothing."""
        assert supply.ask(b"CURR 3.000000") is None
        assert supply.ask(b"MEAS:CURR?") == b"3.000000E+00"
        assert supply.ask(b"CURR 99") is None
        assert supply.ask(b"SYST:ERR?") == b'-222,"Data out of range"'
        assert supply.ask(b"SYST:ERR?").startswith(b"0")
        assert supply.ask(b"NONSENSE") is None
        assert supply.ask(b"SYST:ERR?").startswith(b"-113")
        assert supply.ask(b"CURR?") == b"3.000000E+00"


def test_gen_refuses_with_its_codes(emulate):
    supply = emulate("tdk_lambda_gen", reader="agilent_34970a")
    assert supply.ask(b"ADR 06") == b"OK"
    assert supply.ask(b"PC 5.000") == b"OK"
    assert supply.ask(b"MC?") == b"05.000"
    assert supply.ask(b"PC 39.000") == b"C05"
    assert supply.ask(b"PC?") == b"05.000"


@pytest.mark.parametrize(("profile", "message", "written"), [
    ("tdk_lambda_gen", b"PC 5.000", {"current"}),
    ("tdk_lambda_gen", b"PC?", set()),
    ("pi_e727", b"SVA 1 2.5000", {"axis1"}),
    ("pi_e727_3cd", b"SVA 3 1.5000 1 2.5000", {"axis1", "axis3"}),
    ("pi_e727_3cd", b"POS? 3 1", set()),
    ("pi_e727_3cd", b"SVA 3 1.5000 4 2.5000", set()),
    ("kepco_bop", b"CURR 3.000000;:MEAS:CURR?", {"current"}),
    ("cobs_board", b"\x10\x01\x01\0\0\0\0\0", {"DAC"}),
    ("cobs_board", b"\x14\x01", set()),
])  # fmt: skip
def test_outputs_that_a_message_writes(emulate, profile, message, written):
    reader = None if profile.startswith(("pi_", "cobs_")) else "agilent_34970a"
    made = emulate(profile, reader=reader)
    assert made.emulator.wires[0].written(message) - {""} == written


def test_a_line_reads_or_sets_several_channels(emulate):
    made = emulate("pi_e727_3cd", actuator=PiezoOptions(noise=False))
    assert made.ask(b"SVA 2 20.0000 1 10.0000") is None
    assert [(each["output"], each["value"]) for each in made.writes()] == [
        ("axis2", 20.0), ("axis1", 10.0),
    ]  # fmt: skip
    first, second = made.ask(b"POS? 2 1", after_ms=10).split(b" \n")
    assert (first[:2], second[:2]) == (b"2=", b"1=")
    assert second == made.ask(b"POS? 1")
    assert made.ask(b"SVA? 2") == b"2=20.0000"
    assert made.ask(b"SVA 2 20.0000 1") is None
    assert len(made.writes()) == 2


class TestFrames:
    @pytest.fixture
    def supply(self, emulate):
        return emulate("bk_precision_1785b", reader="agilent_34970a")

    def test_one_reply_has_all_numbers(self, supply):
        """The measured current is in bytes 3 and 4, the commanded one in 10 and 11."""
        reserved = b" 00" * 20
        assert supply.ask(b"AA 00 24 C4 09" + reserved).startswith(b"AA 00 12 80 ")
        words = supply.ask(b"AA 00 26 00 00" + reserved).split()
        assert words[3:5] == words[10:12] == [b"C4", b"09"]
        assert supply.ask(b"AA 00 24 89 13" + reserved).startswith(b"AA 00 12 A0 ")

    def test_requests_are_found_behind_rubbish_and_in_parts(self, supply):
        wire = supply.emulator.wires[0]
        good = bytes.fromhex("aa002400" + "00" * 21 + "ce")
        bad = good[:-1] + b"\0"
        found = [*wire.requests(bytearray(b"\xaa\x00" + bad + good[:7]))]
        found += wire.requests(bytearray(good[7:] + good))
        assert found == [good[:-1].hex(" ").upper().encode()] * 2
