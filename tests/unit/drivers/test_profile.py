"""Device profiles: loading, rules, messages."""

import json
import re
from typing import Any

import pytest
import yaml

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.yaml import dump
from hilctl_drivers.ascii.ascii_profile import AsciiProfile
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.modbus.modbus_profile import ModbusProfile
from hilctl_drivers.profile import (
    FOLDER,
    LINK_KINDS,
    load_profile,
    parse_profile,
    profile_schema_text,
    shipped_profiles,
    with_link,
)
from hilctl_drivers.sensor_stream.stream_profile import StreamProfile

MODBUS = """\
vendor: Acme
model: DAQ-1
source: [manual]
verified: partly
unverified: [turnaround_s]
link: {kind: rtu, baud: 9600}
address_base: 0
exchange: none
turnaround_s: 0.001
max_rate_hz: 100.0
outputs:
  AO: {address: 0, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0}
inputs:
  AI: {area: input, address: 4, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog: none
"""
ASCII = """\
vendor: Acme
model: PSU-1
source: [manual]
verified: partly
unverified: [turnaround_s]
link: {kind: ascii, baud: 9600, terminator: "\\r", reply_terminator: "\\r"}
address: 1
exchange: none
turnaround_s: 0.001
max_rate_hz: 10.0
outputs:
  OUT: {write: "SET {value:.3f}", reply: {pattern: OK, example: OK}, unit: A, min: 0.0, max: 5.0}
inputs:
  IN: {ask: "GET?", pattern: "([0-9.]+)", example: "1.5", unit: A, min: 0.0, max: 5.0}
watchdog: none
"""
BOARD = (FOLDER / "cobs_board_fifo.yaml").read_text(encoding="utf-8")
BYTES = (FOLDER / "npoint_lc400.yaml").read_text(encoding="utf-8")
TEXTS = {"modbus": MODBUS, "ascii": ASCII, "board": BOARD, "bytes": BYTES}


def changed(base, changes):
    """Return a profile's text with other values at dotted keys; None takes a key out."""
    data = yaml.safe_load(TEXTS[base])
    for key, value in changes.items():
        *parents, last = key.split(".")
        part = data
        for parent in parents:
            part = part[parent]
        if value is None:
            del part[last]
        else:
            part[last] = value
    return dump(data)


def lines(text):
    with pytest.raises(ConfigError) as caught:
        parse_profile(text, "acme.yaml")
    return str(caught.value).splitlines()


AO = "outputs.AO."
CHANNEL = {"address": 0, "type": "float32", "unit": "V", "min": 0.0, "max": 1.0}
WATCHDOG = {
    "unit_s": 0.1, "min_s": 0.1, "max_s": 25.5, "kick": "write", "on_trip": "zero",
    "refuses_while_tripped": True,
    "arm": [{"kind": "write", "address": 9, "type": "uint16", "value": "timeout"}],
}  # fmt: skip

KINDS = f"must be one of {', '.join(LINK_KINDS)}"

BROKEN: list[tuple[str, dict[str, Any], str]] = [
    ("modbus", {"verified": "yes"}, "must be partly or no if unverified lists keys"),
    ("modbus", {"unverified": []}, "or unverified must list the unconfirmed keys"),
    ("modbus", {"unverified": ["outputs.A1"]}, "unverified: must name keys that are in this file"),
    ("modbus", {"outputs": {}, "inputs": {}}, ": must have outputs or inputs, or both"),
    ("modbus", {"outputs": {}, "exchange": 76}, "exchange must be none if there are no outputs"),
    ("modbus", {"inputs": {}, "exchange": 23}, "exchange must be none if there are no outputs"),
    ("modbus", {"outputs": {}, "watchdog": WATCHDOG}, "watchdog must be none if there are no"),
    ("modbus", {"link.kind": "udp"}, f"{KINDS}, got"),
    ("modbus", {"link.kind": "ascii"}, "link.kind: must be one of rtu, rtu_tcp, tcp with the key"),
    ("modbus", {"watchdog": False},
     "watchdog: must be a mapping of keys to values, or 'none', got false"),
    ("modbus", {AO + "address": 65536}, "outputs.AO.address must be 0 to 65535 in area holding"),
    ("modbus", {"address_base": "modicon"},
     "outputs.AO.address must be 40001 to 49999 or 400001 to 465536 in area holding"),
    ("modbus", {"address_base": 1}, "outputs.AO.address must be 1 to 65536 in area holding"),
    ("modbus", {AO + "order": "AC"}, "order of int16 must name each of AB once"),
    ("modbus", {AO + "scale": 0.0}, "scale must be finite and not 0"),
    ("modbus", {AO + "max": 40.0}, "outputs.AO: min and max must be inside what the register holds,"
     " -32.768 to 32.767 V, got -10 to 40"),
    ("modbus", {AO + "raw_min": -5000}, "inside what the register holds, -5 to 32.767 V"),
    ("modbus", {AO + "raw_max": 40000}, "raw_min and raw_max must be ordered and fit into int16"),
    ("modbus", {AO + "raw_max": 10000, AO + "raw_min": 10001}, "must be ordered"),
    ("modbus", {AO + "min": 10.0}, "min must be < max, got 10 and 10"),
    ("modbus", {"inputs.AI.raw_max": 5}, "raw_min and raw_max are for whole-number types"),
    ("modbus", {AO + "area": "input"}, "area of an output must be holding, got input"),
    ("modbus", {AO + "area": "coil"}, "type must be bit in area coil"),
    ("modbus", {AO + "type": "bit"}, "type must not be bit in area holding"),
    ("modbus", {AO + "type": "float32", AO + "function": 6}, "function 6 writes one register"),
    ("modbus", {"inputs.AI.area": "discrete", "inputs.AI.type": "bit"},
     "inputs.AI: an analogue channel cannot be in area discrete"),
    ("modbus", {"exchange": 23}, "inputs.AI.area must be holding: exchange 23 reads holding"),
    ("modbus", {"init": [{"kind": "write", "address": 1, "type": "uint16"}]},
     "init.0.value: is required"),
    ("modbus", {"init": [{"kind": "write", "address": 1, "type": "uint16", "value": 70000}]},
     "init.0: value must fit into uint16, got 70000"),
    ("modbus", {"init": [{"kind": "write", "address": 1, "type": "uint16", "value": "safe"}]},
     "init: timeout and safe are for watchdog steps"),
    ("modbus", {"init": [{"kind": "write", "address": 65536, "type": "uint16", "value": 1}]},
     "init.0.address must be 0 to 65535"),
    ("modbus", {"init": [{"kind": "expect", "area": "coil", "address": 1, "type": "bit",
                          "value": 1, "scale": 2.0}]}, "a bit has no order, scale or offset"),
    ("modbus", {"selftest": {"address": 1, "type": "uint16", "expect": 65536}},
     "selftest: expect must fit into uint16, got 65536"),
    ("modbus", {"watchdog": WATCHDOG | {"min_s": 30.0}}, "watchdog: min_s must be <= max_s"),
    ("modbus", {"watchdog": WATCHDOG | {"kick": "strict"}}, "feed steps and kick: strict go"),
    ("modbus", {"watchdog": WATCHDOG | {"on_trip": "safe"}}, "watchdog: on_trip must be stored"),
    ("modbus", {"watchdog": WATCHDOG | {"on_trip": "safe", "safe": {"AO": []}}}, "on_trip must be"),
    ("modbus", {"watchdog": WATCHDOG | {"arm": [{"kind": "write", "address": 9, "type": "uint16",
                                                 "value": 20}]}},
     "watchdog: min_s and max_s must be equal"),
    ("ascii", {"watchdog": WATCHDOG | {"arm": [{"kind": "send", "text": "W1"}]}},
     "watchdog: min_s and max_s must be equal"),
    ("modbus", {"watchdog": WATCHDOG | {"safe": {"XO": []}}},
     "watchdog.safe.XO must be one of the outputs"),
    ("modbus", {"watchdog": WATCHDOG | {"tripped": {"address": 1, "type": "uint16",
                                                    "mask": 65536}}}, "mask must fit into uint16"),
    ("modbus", {"watchdog": WATCHDOG | {"tripped": {"address": 1, "type": "uint16"}}},
     "watchdog.tripped.mask: is required"),
    ("ascii", {"outputs.OUT.write": "SET 1"}, "outputs.OUT: write must have the field {value}"),
    ("ascii", {"outputs.OUT.write": "SET {volts}"}, "fields must be of {value}, {safe}, {address}"),
    ("ascii", {"outputs.OUT.write": "SET {value.real}"}, "fields must be of {value}, {safe}"),
    ("ascii", {"outputs.OUT.write": "SET {value:.0f}"}, "outputs.OUT: write must have the digits"),
    ("ascii", {"outputs.OUT.write": "SET {value:d}"}, "outputs.OUT: write must have the digits"),
    ("ascii", {"outputs.OUT.write": "SET {value:Q}"}, "outputs.OUT.write: fields must have the"),
    ("ascii", {"outputs.OUT.write": "SET {value"}, "outputs.OUT.write: must have { and } around"),
    ("ascii", {"outputs.OUT.write": ""}, "outputs.OUT.write: must be printable ASCII"),
    ("ascii", {"outputs.OUT.write": "SET {value:02X}", "outputs.OUT.scale": 0.01},
     "outputs.OUT: write must hold min and max"),
    ("ascii", {"outputs.OUT.write": "SET\t{value}"}, "must be printable ASCII"),
    ("ascii", {"outputs.OUT.reply.pattern": "("}, "must be a regular expression"),
    ("ascii", {"outputs.OUT.reply.example": "NO"}, "pattern 'OK' must match the example 'NO'"),
    ("ascii", {"outputs.OUT.reply.pattern": "\\d"}, r"pattern '\d' must match the example 'OK'"),
    ("ascii", {"inputs.IN.pattern": "[0-9.]+"}, "must have one group, around the number"),
    ("ascii", {"inputs.IN.example": "1.5.2"}, "the group must hold a number, got '1.5.2'"),
    ("ascii", {"errors": [{"pattern": "O.", "example": "OX", "meaning": "no"}]},
     "errors: 'O.' matches the good reply of outputs.OUT"),
    ("ascii", {"exchange": {"output": "OUT", "input": "XX", "write": "S {value}",
                            "pattern": "(1)", "example": "1"}}, "exchange.input must be an input"),
    ("ascii", {"exchange": {"output": "OUT", "input": "IN", "write": "S?", "pattern": "(1)",
                            "example": "1"}}, "exchange.write must have the field {value}"),
    ("bytes", {"init": [{"kind": "send", "text": "a2 55"}]}, "init.0.text: must be bytes in upper"),
    ("bytes", {"selftest.example": "A0 78 10 83 11 64 00 00 00 5", "selftest.pattern": ".*"},
     "selftest.example: must be bytes in upper"),
    ("bytes", {"inputs.position1.ask": "POS?"}, "inputs.position1.ask: must be bytes in upper"),
    ("bytes", {"outputs.axis1.write": "A2 {value:int16} 55"}, "write must hold min and max"),
    ("bytes", {"outputs.axis1.write": "A2 {value:int24} 55"}, "outputs.axis1.write: "),
    ("bytes", {"outputs.axis1.write": "A2 {value:int32 BA} 55"}, "order of int32 must name"),
    ("bytes", {"inputs.position1.pattern": "A0 {value:int8}"}, "inputs.position1.pattern: fields"),
    ("bytes", {"outputs.axis1.scale": 0}, "outputs.axis1: scale must not be 0"),
    ("bytes", {"link.flow": "xonxoff"}, "flow must not be xonxoff"),
    ("ascii", {"watchdog": {**{k: v for k, v in WATCHDOG.items() if k != "arm"},
                            "kick": "strict", "arm": [{"kind": "send", "text": "W{timeout}"}]}},
     "feed steps and kick: strict go together"),
    ("ascii", {"watchdog": WATCHDOG | {"arm": [{"kind": "send", "text": "W{timeout} {safe:.0f}"}]}},
     "watchdog.arm.0.text must have the digits of 0.005 A"),
    ("ascii", {"watchdog": WATCHDOG | {"arm": [{"kind": "send", "text": "W{timeout} {safe:.3f}"}],
                                       "safe": {"OUT": [{"kind": "send", "text": "{safe:.1f}"}]}}},
     "watchdog.safe.OUT.0.text must have the digits of 0.005 A"),
    ("board", {"streaming": None}, "streaming and exchange: stream go together"),
    ("board", {"streaming.fifo_depth": 100}, "streaming.block_max must be <= streaming.fifo_depth"),
    ("board", {"link.payload_max": 1000}, "streaming.block_max samples need"),
    ("board", {"link.framing": "length", "link.crc": "none"}, "link: crc must not be none"),
    ("board", {"outputs.DAC.type": "int16", "outputs.DAC.order": "BA", "outputs.DAC.scale": 1e-5},
     "min and max must be inside what int16 holds"),
]  # fmt: skip


class TestRules:
    @pytest.mark.parametrize("base", TEXTS)
    def test_unbroken(self, base):
        parse_profile(changed(base, {}), "acme.yaml")

    @pytest.mark.parametrize(("base", "changes", "message"), BROKEN)
    def test_broken(self, base, changes, message):
        found = lines(changed(base, changes))
        assert len(found) == 1, found
        assert re.match(r"acme\.yaml:\d+: ", found[0])
        assert message in found[0]

    @pytest.mark.parametrize("changes", [
        {"on_trip": "stored"},
        {"min_s": 2.0, "max_s": 2.0, "arm": [{"kind": "send", "text": "W1"}]},
        {"on_trip": "safe", "arm": [{"kind": "send", "text": "W{timeout:d} {safe:.4f}"}]},
    ])  # fmt: skip
    def test_settings_of_a_watchdog(self, changes):
        """A fixed timeout, and a value stored in the device, need no step."""
        arm = [{"kind": "send", "text": "W{timeout:d}"}]
        parse_profile(
            changed("ascii", {"watchdog": WATCHDOG | {"arm": arm} | changes}), "acme.yaml"
        )

    @pytest.mark.parametrize("base", ["modbus", "ascii"])
    @pytest.mark.parametrize("group", ["outputs", "inputs"])
    def test_one_of_them_is_enough(self, base, group):
        profile = parse_profile(changed(base, {group: {}}), "acme.yaml")
        assert not getattr(profile, group)

    def test_board_with_integers(self):
        changes = {"outputs.DAC.type": "int16", "outputs.DAC.order": "BA"}
        profile = parse_profile(changed("board", changes), "acme.yaml")
        assert isinstance(profile, FrameProfile)
        assert profile.outputs["DAC"].format.size == 2

    def test_all_at_once(self):
        text = changed("modbus", {"vendor": None, "link.baud": 1, AO + "type": "int8"})
        keys = [line.split(": ")[1] for line in lines(text)]
        assert sorted(keys) == ["link.baud", "outputs.AO.type", "vendor"]

    @pytest.mark.parametrize(
        ("old", "new", "found"),
        [
            ("unverified: [turnaround_s]", "unverified:\n- turnaround_s\n- outputs.A1",
             "acme.yaml:7: unverified: must name keys that are in this file, got outputs.A1"),
            ("max: 10.0}\ninputs", "max: 40.0}\ninputs",
             "acme.yaml:12: outputs.AO: min and max must be inside what the register holds, "
             "-32.768 to 32.767 V, got -10 to 40"),
            ("address: 0,", "address: 65536,", "acme.yaml:12: outputs.AO.address must be 0 to "
             "65535 in area holding with address_base 0, got 65536"),
            ("exchange: none", "exchange: none\nselftest: {address: 1, type: uint16, expect: x}",
             "acme.yaml:9: selftest.expect: must be a number, got 'x'"),
        ],
    )  # fmt: skip
    def test_lines(self, old, new, found):
        assert MODBUS.count(old) == 1
        assert lines(MODBUS.replace(old, new))[0].startswith(found)


class TestYaml:
    @pytest.mark.parametrize(("text", "message"), [
        ("[1, 2]", "must hold a mapping"),
        (MODBUS + "vendor: Other\n", "acme.yaml:16: vendor: stands already at acme.yaml:1"),
        (MODBUS.replace("address: 4", "address: 1:30"),
         "acme.yaml:14: inputs.AI.address: must be a whole number, got '1:30'"),
        ("a: !!python/object:os.system {}", "is not readable YAML"),
    ])  # fmt: skip
    def test_refused(self, text, message):
        found = lines(text)
        assert message in found[0]
        assert len(found) == 1

    @pytest.mark.parametrize(("written", "address"), [("0x0200", 512), ("00257", 257)])
    def test_addresses(self, written, address):
        """Addresses can be written as manuals have them."""
        profile = parse_profile(MODBUS.replace("address: 4", f"address: {written}"), "acme.yaml")
        assert isinstance(profile, ModbusProfile)
        assert profile.inputs["AI"].address == address


class TestLoading:
    def test_by_path(self, tmp_path):
        path = tmp_path / "mine.yaml"
        path.write_text(MODBUS, encoding="utf-8")
        assert load_profile(str(path)).title == "Acme DAQ-1"

    def test_unknown_name(self):
        with pytest.raises(InputError, match=r"'labjack'.* 'labjack_t"):
            load_profile("labjack")
        with pytest.raises(InputError, match="'zzz' is shipped") as error:
            load_profile("zzz")
        assert all(name in str(error.value) for name in shipped_profiles())

    def test_no_file(self, tmp_path):
        path = tmp_path / "none.yaml"
        with pytest.raises(InputError, match=f"^{re.escape(str(path))}"):
            load_profile(str(path))

    def test_with_link(self):
        profile = parse_profile(MODBUS, "acme.yaml")
        faster = with_link(profile, baud=115200, parity="E")
        assert isinstance(faster, ModbusProfile)
        assert faster.link.model_dump()["baud"] == 115200
        assert faster.model_copy(update={"link": profile.link}) == profile
        with pytest.raises(InputError, match=r"link.baud: must be >= 300, got 1"):
            with_link(profile, baud=1)
        with pytest.raises(InputError, match=r"link.buad: unknown key \(did you mean 'baud'\?\)"):
            with_link(profile, buad=9600)


class TestSchema:
    def test_file_is_up_to_date(self):
        path = FOLDER / "schema.json"
        assert path.read_text(encoding="utf-8") == profile_schema_text(), (
            "write hilctl_drivers.profile.profile_schema_text() to profiles/schema.json"
        )

    def test_covers_all_kinds(self):
        schema = json.loads(profile_schema_text())
        names = [choice["$ref"].rsplit("/", 1)[1] for choice in schema["oneOf"]]
        kinds = (AsciiProfile, FrameProfile, ModbusProfile, StreamProfile)
        assert names == [kind.__name__ for kind in kinds]
        objects = [part for part in schema["$defs"].values() if "properties" in part]
        assert len(objects) > 30
        assert all(part["additionalProperties"] is False for part in objects)
