"""Addresses against profiles: the link that they lead to, shared lines, and what is refused."""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.dac import SerialOptions
from hilctl_drivers.endpoint import Endpoint, reader_of
from hilctl_drivers.signal_chain import AddressOptions
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.tcp import TcpLink, TcpStream

DCON = Path(__file__).parents[2] / "data" / "dcon_module.yaml"
CHANNELS = {
    "output": "any", "input": "any", "sensor": {"um_per_v": 1.0}, "watchdog": "none",
}  # fmt: skip


def endpoint(**keys):
    return Endpoint.of(AddressOptions.model_validate(keys), 0.1)


def pair(reader, **keys):
    """Return the endpoints of output and input."""
    options = SerialOptions.model_validate({**CHANNELS, **keys, "reader": reader})
    writer = Endpoint.of(options, 0.1)
    return writer, reader_of(options, writer)


@pytest.mark.parametrize(
    ("keys", "place", "framing", "link"),
    [
        ({"profile": "adam_6224", "host": "h"}, "h:502", "tcp", TcpLink),
        ({"profile": "adam_4024", "host": "h"}, "h:502", "tcp", TcpLink),
        ({"profile": "adam_4024", "host": "h", "framing": "rtu", "tcp_port": 8899}, "h:8899", "rtu",
         TcpStream),
        ({"profile": "adam_4024", "serial_port": "/dev/x"}, "/dev/x", "rtu", SerialLink),
        ({"profile": "kepco_bop", "serial_port": "/dev/x"}, "/dev/x", "", SerialLink),
        ({"profile": "kepco_bop", "host": "h", "tcp_port": 5025}, "h:5025", "", TcpStream),
        ({"profile": "cobs_board", "host": "h", "tcp_port": 7}, "h:7", "", TcpStream),
    ],
)  # fmt: skip
def test_an_address_leads_to_a_link(keys, place, framing, link):
    found = endpoint(**keys)
    assert (found.place, found.framing, type(found.link())) == (place, framing, link)


def test_settings_beside_the_address_are_those_of_the_link():
    keys = {"baud": 115200, "gap_s": 0.002, "boot_wait_s": 1.0, "dtr": False, "rts": True}
    board = endpoint(profile="cobs_board", serial_port="/dev/x", echo=True, rs485="high", **keys)
    settings = board.profile.link
    assert (settings.baud, settings.gap_s, settings.boot_wait_s) == (115200, 0.002, 1.0)
    assert (settings.dtr, settings.rts, settings.rs485, settings.echo) == (
        False,
        True,
        "high",
        True,
    )
    text = endpoint(profile="tdk_lambda_gen", serial_port="/dev/x", gap_s=0.01, echo=True)
    assert (text.profile.link.silence_s, text.profile.link.echo) == (0.01, True)
    assert not text.profile.link.removes_echo  # the session takes the lines that come back


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"profile": "adam_6224", "serial_port": "/dev/x"}, "is for TCP: give host"),
        ({"profile": "kepco_bop", "host": "h"}, "tcp_port is required"),
        ({"profile": "kepco_bop", "host": "h", "tcp_port": 1, "framing": "rtu"}, "be omitted"),
        ({"profile": "adam_6224", "host": "h", "framing": "rtu"}, "framing must be tcp with"),
        ({"profile": "adam_6224", "host": "h", "baud": 9600, "echo": True}, "baud, echo must be"),
        ({"profile": "cobs_board", "serial_port": "/dev/x", "unit_id": 2}, "has no address"),
        ({"profile": "adam_4024", "serial_port": "/dev/x", "baud": 300}, "baud must be one that"),
        ({"profile": "adam_4024", "serial_port": "/dev/x", "host": "h"}, "not both"),
        ({"profile": "adam_4024", "serial_port": "/dev/x", "tcp_port": 502}, "must go with host"),
        ({"profile": "adam_4024", "serial_port": "/dev/x", "framing": "rtu"}, "framing must go"),
        ({"profile": "adam_4024", "host": "h", "dtr": True}, "dtr must go with serial_port"),
        ({"profile": "adam_4024", "echo": True}, "echo must go with serial_port or host"),
    ],
)  # fmt: skip
def test_an_address_that_does_not_fit_is_refused(keys, words):
    with pytest.raises((InputError, ValueError), match=words):
        endpoint(**keys)


def test_a_reader_without_an_address_is_on_the_line_of_the_output():
    writer, reader = pair(
        {"profile": "adam_4117", "unit_id": 2},
        profile="adam_4024", host="h", tcp_port=8899, framing="rtu", baud=115200, echo=True,
    )  # fmt: skip
    assert (reader.place, reader.framing, reader.unit) == (writer.place, "rtu", 2)
    assert (reader.profile.link.baud, reader.profile.link.echo) == (115200, True)


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        ({"profile": "agilent_34970a"}, "reply_terminator.* must be the same; give reader.host or"),
        ({"profile": "labjack_t7"}, "is for TCP: give reader.host"),
        ({"profile": "icp_m7017"}, "another protocol"),
        ({"profile": "icp_m7017", "serial_port": "/dev/x"}, "another protocol"),
        ({"profile": str(DCON)}, "both are unit"),
        ({"profile": "kepco_bop", "host": "h"}, "reader.tcp_port is required"),
        ({"profile": "labjack_t7", "host": "h", "parity": "E"}, "reader.parity must be omitted"),
    ],
)
def test_a_reader_that_cannot_share_the_line_is_refused(reader, words):
    with pytest.raises(InputError, match=words):
        pair(reader, profile=str(DCON), serial_port="/dev/x")
