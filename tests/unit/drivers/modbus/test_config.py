"""Where the device and its reader stand: one line, two lines or a gateway, and what that costs."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.modbus.config import ModbusOptions
from hilctl_drivers.modbus.modbus_dac import ModbusDac
from hilctl_drivers.profile import shipped_profiles
from tests.unit.drivers.modbus.conftest import exchange

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


def made(**changes):
    return ModbusDac(ModbusOptions.model_validate({**PAIR, **changes}))


@pytest.mark.parametrize("host", ["", " ", "10.0.0.7:502", "plc.local:1502"])
def test_host_is_a_name_without_a_port(host):
    with pytest.raises(ValueError, match="host"):
        made(serial_port=None, host=host)


@pytest.mark.parametrize("host", ["10.0.0.7", "plc.local", "::1", "fe80::1"])
def test_names_and_addresses_are_hosts(host):
    assert ModbusOptions.model_validate({**PAIR, "serial_port": None, "host": host}).host == host


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
        info = made().info
        total_s = 31 * 10 / 9600 + 4 * 3.5 * 10 / 9600 + 2 * 0.002 + SETTLE_S
        assert info.max_rate_hz == pytest.approx(1.0 / total_s)
        assert "FC04 at 9600 8N1, then FC06 at 9600 8N1" in info.rate_note

    def test_baud_of_a_shared_line_is_that_of_both(self):
        assert made(baud=115200).info.rate_note.startswith(
            "FC04 at 115200 8N1, then FC06 at 115200"
        )

    def test_slower_device_limits_a_faster_wire(self):
        pair = {"profile": "adam_4024", "reader": {"profile": "adam_4117", "unit_id": 2}}
        slow = made(**pair, baud=115200).info
        assert slow.rate_note.startswith("profile adam_4024 says so; the wire alone: FC03 at 1152")

    def test_baud_that_nobody_can_be_set_to_is_refused(self, tmp_path, reader):
        known = tmp_path / "known.yaml"
        known.write_text(
            Path(reader).read_text().replace("baud: 115200", "baud: 115200, bauds: [57600]")
        )
        with pytest.raises(InputError, match=r"baud must be .*nobody.*57600, 115200, got 96"):
            made(reader={"profile": str(known), "unit_id": 2}, input="IN")
        made(reader={"profile": reader, "unit_id": 2}, input="IN")
        with pytest.raises(InputError, match=r"baud must be .*M-7024.*, got 14400"):
            made(baud=14400)

    def test_two_lines_are_silent_at_the_same_time(self):
        info = made(reader={**READS, "serial_port": "/dev/y"}).info
        total_s = 31 * 10 / 9600 + 2 * 3.5 * 10 / 9600 + 2 * 0.002 + SETTLE_S
        assert info.max_rate_hz == pytest.approx(1.0 / total_s)
        faster = made(reader={**READS, "serial_port": "/dev/y", "baud": 115200}).info
        assert faster.rate_note.startswith("FC04 at 115200 8N1, then FC06 at 9600 8N1")

    def test_a_place_named_twice_is_one_line(self, tmp_path):
        (tmp_path / "port").touch()
        (tmp_path / "by-id").symlink_to(tmp_path / "port")
        ours = {"serial_port": str(tmp_path / "port")}
        theirs = {**READS, "serial_port": str(tmp_path / "by-id")}
        assert made(**ours, reader=theirs).info.holds == (f"serial:{tmp_path / 'port'}",)
        with pytest.raises(InputError, match="both are unit"):
            made(**ours, reader={**theirs, "unit_id": 1})

    def test_what_it_is_is_kept(self):
        info = made().info
        assert info.description == (
            "ICP DAS M-7024 (Modbus RTU) at /dev/x: AO0; ICP DAS M-7017 (Modbus RTU), unit 2 at "
            "/dev/x: AI0"
        )
        assert info.details["model"] == "M-7024 (Modbus RTU)"
        assert info.details["reader_model"] == "M-7017 (Modbus RTU)"
        assert "m7000_address_mapping" in info.details["reader_source"]
        shipped = shipped_profiles()
        assert info.files == {
            "profile.yaml": shipped["icp_m7024"].read_text(),
            "reader_profile.yaml": shipped["icp_m7017"].read_text(),
        }
