"""``serial_dac`` on lines of text and on single frames, against emulated devices on a pty."""

import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.yaml import dump
from hilctl_drivers.dac import SerialDac, SerialOptions
from hilctl_drivers.profile import shipped_profiles
from tests.fakes import made_safe
from tests.unit.drivers.conftest import TIMEOUT_S

DCON = (Path(__file__).parents[2] / "data" / "dcon_module.yaml").read_text()
KINDS = ["dcon", "scpi", "cobs", "length"]
WIRES = [*KINDS, "dcon tcp"]
"""On ptys, and one of them on TCP."""
PATIENT_S = 20.0
SILENCE_S = 0.5
"""A timeout that a test waits for."""


@pytest.fixture
def profiles(tmp_path, no_boot):
    """Return paths of one profile of each kind, none of which waits for a board to boot."""
    (tmp_path / "dcon.yaml").write_text(DCON)
    (tmp_path / "length.yaml").write_text(
        Path(no_boot("cobs_board")).read_text().replace("framing: cobs", "framing: length")
    )
    paths = {"dcon": "dcon.yaml", "cobs": "cobs_board.yaml", "length": "length.yaml"}
    return {kind: str(tmp_path / name) for kind, name in paths.items()} | {"scpi": "agilent_34970a"}


@pytest.fixture
def rig(profiles, serial_bench):
    """Return a function that wires a device of a kind to its emulator."""

    def of(kind, timeout_s=PATIENT_S, **options):
        name, *link = kind.split()
        more = {"link": link[0]} if link else {}
        return serial_bench(profiles.get(name, name), timeout_s=timeout_s, **more, **options)

    return of


def await_current(bench, current_a):
    """Let the emulator come to a setting that it does not answer; fail where it never does."""
    deadline = time.monotonic() + 20.0
    while bench.current_a() != pytest.approx(current_a):
        assert time.monotonic() < deadline, f"still at {bench.current_a()} A"
        os.sched_yield()


@pytest.mark.parametrize("kind", WIRES)
def test_a_command_arrives_and_a_reading_comes_back(rig, kind):
    bench = rig(kind)
    bench.open()
    assert abs(bench.exchange(0.0)) < 1.0
    bench.exchange(5.0)
    assert bench.current_a() == pytest.approx(5.0, abs=2e-3)
    bench.pass_s(0.5)
    assert 20.0 < bench.exchange(5.0) < 45.0
    bench.device.close()
    assert bench.current_a() == pytest.approx(5.0, abs=2e-3)


FAULTS = {
    "silence": f"no answer within {TIMEOUT_S:g} s",
    "delay": f"no answer within {TIMEOUT_S:g} s",
    "corrupt": "checksum of|does not match this request|crc16_ccitt_false of .* is wrong",
    "cut": rf"only . bytes, \d+ short, within {TIMEOUT_S:g} s",
    "duplicate": "must be one line|after the end of the frame",
    "wrong_id": "does not match this request|reply 90 to message",
    "exception": "invalid command|no answer within|refused by the board",
}


def exchange_until_it_fails(bench, command=2.0):
    for _ in range(40):
        assert abs(bench.exchange(command)) < 30.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", WIRES)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_answer_is_an_error_and_the_output_can_still_be_made_safe(rig, kind, fault):
    late = f":{1.5 * TIMEOUT_S}" if fault == "delay" else ""
    bench = rig(kind, faults=[f"{fault}{late}@30"], timeout_s=TIMEOUT_S)
    bench.open()
    with pytest.raises(DeviceError, match=FAULTS[fault]) as caught:
        exchange_until_it_fails(bench)
    assert str(caught.value).startswith("serial_dac ")
    with pytest.raises(DeviceError, match="not open"):
        bench.exchange(2.0)
    bench.device.make_safe(-1.0)
    assert bench.current_a() == pytest.approx(-1.0, abs=2e-3)


def test_a_broken_connection_is_an_error_and_the_output_can_still_be_made_safe(rig):
    bench = rig("dcon tcp", faults=["reset@30"])
    bench.open()
    with pytest.raises(DeviceError, match=r"connection lost|closed by the device"):
        exchange_until_it_fails(bench)
    bench.device.make_safe(-1.0)
    assert bench.current_a() == pytest.approx(-1.0, abs=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unplugged_port_is_an_error_everywhere(rig, kind):
    bench = rig(kind, faults=["unplug@30"])
    bench.open()
    with pytest.raises(DeviceError, match="unplugged"):
        exchange_until_it_fails(bench)
    with pytest.raises(DeviceError, match="cannot be opened"):
        bench.device.make_safe(0.0)
    bench.device.close()


@pytest.mark.parametrize("kind", ["dcon", "cobs"])
def test_a_silent_host_is_noticed_by_the_device(rig, kind):
    bench = rig(kind, watchdog={"timeout_s": 20.0, "safe_command": 0.0})
    bench.open()
    for _ in range(10):
        bench.exchange(3.0)
    bench.pass_s(20.0)
    with pytest.raises(DeviceError, match="watchdog has tripped"):
        bench.exchange(3.0)
    assert (bench.events()[-1]["event"], bench.current_a()) == ("watchdog", 0.0)
    bench.device.make_safe(0.5)
    assert bench.current_a() == pytest.approx(0.5)


@pytest.mark.slow  # it is fed by this machine's clock, and would trip where that runs ahead
@pytest.mark.parametrize("kind", ["dcon", "cobs"])
def test_exchanges_feed_the_watchdog_and_close_disarms_it(rig, kind):
    bench = rig(kind, watchdog={"timeout_s": 2.0, "safe_command": 0.0})
    bench.open()
    for _ in range(60):
        bench.exchange(3.0)
        bench.pass_s(0.05)
    bench.device.close()
    bench.pass_s(3.0)
    bench.open()
    assert "watchdog" not in {event["event"] for event in bench.events()}


@pytest.mark.parametrize("readback", ["output", "command"])
def test_a_trip_of_an_earlier_run_ends_at_the_safe_value(rig, profiles, readback):
    """Before anything else is put out, whatever the module would say of its last command."""
    path = Path(profiles["dcon"])
    path.write_text(DCON.replace("of: output", f"of: {readback}"))
    bench = rig("dcon", watchdog={"timeout_s": 20.0, "safe_command": 0.0})
    # As where a trip keeps commands back, but does not forget the last one.
    switch, device = bench.emulator.device._switch, bench.emulator.device

    def restore(name, template, text):
        switch(name, template, text)
        if name == "clear":
            device._put_out("AO0", device._commands["AO0"], "stale", device._now_ns)

    device._switch = restore
    bench.device.open(60.0, 1)
    bench.device.arm()
    bench.exchange(3.0)
    bench.device._release()
    with pytest.raises(DeviceError, match="not open"):
        bench.device.close()
    bench.pass_s(21.0)
    bench.device.open(60.0, 1)
    events = [(event["event"], event["current_a"]) for event in bench.events()]
    assert events[-4:] == [("watchdog", 0.0), ("stale", 3.0), ("write", 0.0), ("write", 0.0)]
    assert bench.device.output() == 0.0
    assert bench.exchange(1.0) < 45.0


def test_scpi_supply_is_set_up_and_checked(rig):
    bench = rig("kepco_bop", reader="agilent_34970a", own_line=True)
    bench.open()
    bench.exchange(2.5)
    await_current(bench, 2.5)
    bench.emulator.device.refusal(b"")  # leaves an error to be asked for
    with pytest.raises(DeviceError, match=r"SYST:ERR\? says -200"):
        bench.device.close()


def test_errors_of_an_earlier_session_end_no_run(rig):
    bench = rig("kepco_bop", reader="agilent_34970a", own_line=True)
    for _ in range(3):
        bench.emulator.device.refusal(b"")
    bench.open()
    assert bench.device.info.details["earlier_errors"].count("-200") == 3
    bench.exchange(2.5)
    bench.device.close()


def test_errors_of_an_earlier_session_fail_no_probe(rig):
    bench = rig("kepco_bop", reader="agilent_34970a", own_line=True)
    for _ in range(3):
        bench.emulator.device.refusal(b"")
    assert bench.device.look().output == 0.0
    assert bench.device.info.details["earlier_errors"].count("-200") == 3
    bench.open()
    assert bench.device.info.details["earlier_errors"].count("-200") == 3


def test_an_error_of_an_init_step_is_not_the_safe_value_s(rig, tmp_path):
    text = shipped_profiles()["kepco_bop"].read_text(encoding="utf-8")
    path = tmp_path / "supply.yaml"
    path.write_text(text.replace('text: "CURR 0"', 'text: "CURR 99"'), encoding="utf-8")
    bench = rig(str(path), reader="agilent_34970a", own_line=True)
    with pytest.raises(DeviceError, match=r"init: SYST:ERR\? says -222"):
        bench.open()


def test_older_errors_do_not_prevent_a_confirmation(rig, tmp_path):
    """Without a read-back, only a query of errors confirms a value."""
    data = yaml.safe_load(shipped_profiles()["kepco_bop"].read_text(encoding="utf-8"))
    data["outputs"]["current"]["readback"] = "none"
    path = tmp_path / "supply.yaml"
    path.write_text(dump(data), encoding="utf-8")
    bench = rig(str(path), reader="agilent_34970a", own_line=True)
    bench.open()
    bench.exchange(2.5)
    for _ in range(3):
        bench.emulator.device.refusal(b"")
    bench.device.make_safe(0.0)
    assert bench.current_a() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("profile", "current_a"), [("kepco_bop", 2.5), ("tdk_lambda_gen", 3.0)])
def test_the_output_is_measured_where_that_is_asked_for(rig, profile, current_a):
    quick = rig(profile, reader="agilent_34970a", own_line=True).device.info
    bench = rig(profile, reader="agilent_34970a", own_line=True, measure="current")
    info = bench.device.info
    assert (quick.measures_command, info.measures_command) == (False, True)
    assert "to measure" in info.rate_note
    assert info.max_rate_hz <= quick.max_rate_hz  # which one of them limits itself
    bench.device.open(10.0, 1)
    displacement_um, measured = np.full(1, np.nan), np.full(1, np.nan)
    bench.device.exchange(0, np.array([current_a]), displacement_um, measured)
    assert measured[0] == pytest.approx(current_a, abs=1e-3)
    assert np.isfinite(displacement_um).all()


def test_a_channel_that_would_never_change_is_refused(rig):
    aux = {"coil_a": {"input": "current", "scale": 0.0}}
    with pytest.raises(ValueError, match=r"aux\.coil_a\.scale"):
        rig("kepco_bop", reader="agilent_34970a", own_line=True, aux=aux)


def test_auxiliary_channels_of_either_device(rig):
    aux = {"sensor_v": {"input": "AI101"}, "coil_a": {"input": "current", "scale": -1.0}}
    bench = rig("kepco_bop", reader="agilent_34970a", own_line=True, aux=aux)
    assert "for an auxiliary channel" in bench.device.info.rate_note
    bench.device.open(10.0, 1)
    assert np.isfinite(bench.device.aux).all()
    reading = np.empty(1)
    for sample in range(40):  # until the rig has settled, as both are read one after the other
        bench.device.exchange(sample, np.array([2.5]), reading, np.empty(1))
    assert bench.device.aux[1] == pytest.approx(-2.5, abs=1e-3)
    assert bench.device.aux[0] == pytest.approx(reading[0] / 12.5, abs=0.1)


def test_a_reader_that_fails_is_named(rig):
    bench = rig("kepco_bop", reader="agilent_34970a", own_line=True, timeout_s=SILENCE_S)
    bench.open()
    bench.exchange(0.0)
    bench.emulator.wires[1].devices = []
    port = bench.emulator.places[1].address
    with pytest.raises(DeviceError, match=rf"reader agilent_34970a at {port}: "):
        exchange_until_it_fails(bench, 0.0)


def test_a_lost_sensor_is_not_waited_for(rig):
    """The safe value uses the link of the output only."""
    bench = rig("kepco_bop", reader="labjack_t7", own_line=True, timeout_s=SILENCE_S)
    bench.open()
    bench.exchange(2.0)
    asked, wire = [], bench.emulator.wires[1]
    wire.answer = lambda request, now_ns: asked.append(request)
    with pytest.raises(DeviceError, match=r"reader labjack_t7, unit 1 at .*: no answer"):
        bench.exchange(2.0)
    bench.device.make_safe(-1.0)
    assert bench.current_a() == -1.0
    assert len(asked) == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", WIRES)
@pytest.mark.parametrize("fault", ["silence", "corrupt", "duplicate", "wrong_id"])
def test_a_bad_answer_to_the_safe_value_confirms_nothing(rig, kind, fault):
    message = {"dcon": 15, "scpi": 16, "cobs": 10, "length": 10}[kind.split()[0]]
    bench = rig(kind, faults=[f"{fault}@{message}"], timeout_s=TIMEOUT_S)
    bench.open()
    for _ in range(5):
        bench.exchange(2.0)
    made_safe(bench.device, 0.0)
    assert bench.current_a() == pytest.approx(0.0, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", WIRES)
def test_a_device_that_was_deaf_is_made_safe_when_it_comes_back(rig, kind):
    bench = rig(kind, faults=[f"silence@{n}" for n in range(20, 25)], timeout_s=0.3)
    bench.open()
    with pytest.raises(DeviceError, match="no answer"):
        exchange_until_it_fails(bench)
    made_safe(bench.device, -1.0)
    assert bench.current_a() == pytest.approx(-1.0, abs=2e-3)


@pytest.mark.parametrize("kind", WIRES)
def test_safe_is_said_only_of_what_was_read_back(rig, kind):
    bench = rig(kind)
    bench.open()
    bench.exchange(2.0)
    device = bench.emulator.device
    device._set = lambda name, value, reply: reply
    device._put_out = lambda *args: None
    with pytest.raises(DeviceError):
        bench.device.make_safe(0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_line_that_never_falls_silent_gets_the_safe_value(rig, kind):
    bench = rig(kind, timeout_s=SILENCE_S)
    bench.open()
    bench.exchange(2.0)
    link = bench.device.wire.link
    # As where somebody keeps sending: the line is never found quiet.
    link._stale = True

    def drain(quiet_s=0.0):
        raise DeviceError("the line does not get quiet")

    link.drain = drain
    with pytest.raises(DeviceError, match="the line does not"):
        bench.device.make_safe(-1.0)
    await_current(bench, -1.0)


def test_an_output_that_nobody_can_read_back_is_not_known(rig, profiles):
    """No query for it; a board of version 1; a query for commands, where a trip does not show."""
    silent = Path(profiles["dcon"])
    start = DCON.index("    readback:")
    silent.write_text(DCON[:start] + DCON[DCON.index("    unit: V", start) :])
    old = Path(profiles["cobs"])
    old.write_text(old.read_text().replace("hilctl-2", "hilctl-1"))
    adam = rig("adam_4024_ascii", reader="agilent_34970a", own_line=True)
    for bench in (rig("dcon"), rig("cobs"), adam):
        assert not bench.device.info.reads_output
        bench.device.open(10.0, 1)
        assert bench.device.output() is None
        bench.device.make_safe(1.0)
        assert bench.current_a() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_looking_changes_nothing(rig, kind):
    """Displacement and output as they are; no write, no step, and a trip stays."""
    watched = {"watchdog": {"timeout_s": 5.0}} if kind != "scpi" else {}
    bench = rig(kind, **watched)
    bench.open()
    bench.exchange(3.0)
    bench.device._release()
    bench.device._block = 0
    bench.pass_s(6.0)  # each second takes the emulated rig time, too
    before = bench.events()
    displacement_um, output, _, tripped = bench.device.look()
    assert tripped == bool(watched)
    held = 3.0 if kind == "scpi" else 0.0  # tripped
    assert output == pytest.approx(held, abs=2e-3)
    assert displacement_um == pytest.approx(bench.emulator.rigs[0].rig.displacement_um, abs=0.5)
    since = bench.events()[len(before) :]
    assert {event["event"] for event in since} <= {"watchdog"}
    if kind != "scpi":
        assert bench.emulator.device.tripped
    bench.open()
    with pytest.raises(DeviceError, match="open"):
        bench.device.look()


def test_another_device_is_noticed_at_open(rig, tmp_path):
    path = tmp_path / "other.yaml"
    path.write_text(DCON.replace("{2}7.*", "{2}9.*").replace("!027024", "!029024"))
    bench = rig("dcon", profile=str(path))
    with pytest.raises(DeviceError, match=r"'!029024', got '!027024'"):
        bench.open()


def test_nobody_there_is_said(rig):
    bench = rig("dcon")
    away = SerialDac(
        SerialOptions.model_validate({**bench.emulator.options, "serial_port": "/dev/ttyNOWHERE"})
    )
    with pytest.raises(DeviceError, match=r"/dev/ttyNOWHERE: cannot"):
        away.open(20.0, 1)
    bench.open()
    second = SerialDac(SerialOptions.model_validate(bench.emulator.options))
    with pytest.raises(DeviceError, match="lock"):
        second.open(20.0, 1)


@pytest.mark.parametrize(("changes", "text"), [
    ({"output": "AO9"}, "output must be one that nobody DCON"),
    ({"input": "AI9"}, "input must be one that nobody DCON"),
    ({"profile": "labjack_t7"}, "for kind: modbus_dac"),
    ({"profile": "kepco_bop", "output": "current", "input": "current"}, "as reader"),
    ({"measure": "AI0"}, "measure must be an input of nobody .* measures its own output"),
    ({"profile": "cobs_board", "output": "DAC", "input": "ADC", "measure": "ADC"}, "measures its"),
    ({"watchdog": {"timeout_s": 100.0}}, "timeout_s must be 0.1 to 25.5"),
    ({"watchdog": {"timeout_s": 1.0, "safe_command": 11.0}}, "safe_command must be -10 to 10"),
    ({"sensor": {"um_per_ma": 1.0}}, "the input is in V"),
    ({"reader": {"profile": "agilent_34970a"}, "input": "AI101"}, "cannot share the line"),
])  # fmt: skip
def test_options_that_do_not_go_together_are_refused(profiles, changes, text):
    dcon = {**TWO_LINES, "profile": profiles["dcon"], "input": "AI0", "reader": None}
    with pytest.raises(InputError, match=text):
        SerialDac(SerialOptions.model_validate({**dcon, **changes}))


def test_a_line_too_slow_for_the_safe_value_is_said():
    slow = {"baud": 1200, "watchdog": {"timeout_s": 2.0}}

    def note(**changes):
        device = SerialDac(SerialOptions.model_validate({**TWO_LINES, **changes}))
        return device.info.safe_note

    assert note() == ""
    assert re.fullmatch(r"a message takes up to 0.2\d s on .*no watchdog.*", note(baud=1200))
    assert note(**slow).endswith("after 2 s")


TWO_LINES = {
    "profile": "icp_m7024_dcon", "serial_port": "/dev/x", "output": "AO0", "input": "AI101",
    "reader": {"profile": "agilent_34970a", "serial_port": "/dev/y"},
    "amplifier": {"gain_a_per_v": 1.0}, "sensor": {"um_per_v": 12.5}, "watchdog": "none",
}  # fmt: skip


def test_a_marked_reading_is_missing(rig, tmp_path):
    text = DCON.replace('>+05.123",', '>+05.123", invalid: {pattern: ">OVL", example: ">OVL"},')
    path = tmp_path / "marked.yaml"
    path.write_text(text)
    bench = rig(str(path), faults=["invalid:1@30"])
    bench.open()
    readings = [float(bench.exchange(0.0)[0]) for _ in range(40)]
    bench.pass_s(2.0)
    assert np.isnan(readings).any()
    assert np.isfinite([readings[0], float(bench.exchange(0.0)[0])]).all()


def test_fault_that_the_input_cannot_show_is_refused(rig):
    with pytest.raises(InputError, match="fault invalid: AI0 of"):
        rig("dcon", faults=["invalid@30"])
