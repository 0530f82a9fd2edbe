"""Whole runs over text lines and board frames with things going wrong: one way out, every time."""

import re
import signal

import pytest

from hilctl_drivers.profile import shipped_profiles

TIMEOUT_S = 0.5
WATCHDOG_S = 1.0
WAVEFORM = {
    "kind": "sine",
    "unit": "A",
    "amplitude": 4.0,
    "frequency_hz": 1.0,
    "duration_s": 60.0,
    "soft_start_s": 0.2,
}
GUARDED = {"watchdog": {"timeout_s": WATCHDOG_S}}
DEVICE = {
    "kind": "serial_dac",
    "timeout_s": TIMEOUT_S,
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}
SETUPS = {
    "dcon": ({**GUARDED, "output": "AO0", "input": "AI0"}, {"sample_rate_hz": 100}),
    "scpi": ({"output": "DAC204", "input": "AI101"}, {"sample_rate_hz": 20}),
    "cobs": ({**GUARDED, "output": "DAC", "input": "ADC"}, {"sample_rate_hz": 200}),
    "fifo": (
        {**GUARDED, "output": "DAC", "input": "ADC", "fifo_blocks": 15},
        {"sample_rate_hz": 10_000, "block": 100},
    ),
}
GAINS = {"scpi": {"gain_a_per_v": 10.0 / 12.0}}
FAULT_AT = {"dcon": 201, "scpi": 41, "cobs": 100, "fifo": 100}


@pytest.fixture
def boards(tmp_path, profile):
    """Return where the profile of each kind is; a board of the tests needs no time to boot."""
    found = {"dcon": profile("dcon_module"), "scpi": "agilent_34970a"}
    for kind, name in {"cobs": "cobs_board", "fifo": "cobs_board_fifo"}.items():
        text = shipped_profiles()[name].read_text(encoding="utf-8")
        path = tmp_path / f"{name}.yaml"
        path.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"), encoding="utf-8")
        found[kind] = str(path)
    return found


@pytest.fixture
def meet(emulate, run, boards):
    """Return a function that starts an emulated device of a kind and a run on it."""

    def start(kind, *faults):
        words = [word for fault in faults for word in ("--fault", f"{fault}@{FAULT_AT[kind]}")]
        device = emulate(boards[kind], *words)
        options, changes = SETUPS[kind]
        section = {**DEVICE, "profile": boards[kind], "serial_port": device.address, **options}
        section["amplifier"] = GAINS.get(kind, section["amplifier"])
        return device, run(section, waveform=WAVEFORM, **changes), options["output"]

    return start


FAULTS = {
    ("dcon", "silence"): "no answer within 0.5 s",
    ("dcon", "corrupt"): "checksum of",
    ("dcon", "duplicate"): "must be one line",
    ("dcon", "exception"): r"invalid command \(\?02\)",
    ("dcon", "wrong_id"): "not an answer to this",
    ("scpi", "silence"): "no answer within 0.5 s",
    ("scpi", "cut"): "within 0.5 s",
    ("cobs", "corrupt"): "crc16_ccitt_false|COBS",
    ("cobs", "cut"): "within 0.5 s",
    ("cobs", "exception"): "refused by the board",
    ("fifo", "silence"): "no answer within 0.51 s",
    ("fifo", "corrupt"): "crc16_ccitt_false|COBS",
    ("fifo", "duplicate"): "bytes",
    ("fifo", "exception"): "refused by the board",
}


@pytest.mark.parametrize(("kind", "fault"), FAULTS)
def test_fault_ends_the_run_safely(meet, boards, kind, fault):
    """The run stops in time, one line says which device did what, and the coil is at 0 A."""
    device, started, output = meet(kind, fault)
    printed = started.end()
    # A watchdog that is armed stays so, and may have tripped since.
    events = [each for each in device.log.events(output) if each["event"] != "watchdog"]
    assert printed["code"] == "fault"
    assert printed["output_safe"] is True
    said = printed["reason"]
    assert said.startswith(f"serial_dac {boards[kind]} at {device.address}: ")
    assert re.search(FAULTS[kind, fault], said)
    assert f"(to write {output}, read " in said
    assert "\n" not in said
    assert events[-1]["event"] == ("safe" if kind in {"cobs", "fifo"} else "write")
    assert events[-1]["current_a"] == pytest.approx(0.0, abs=2e-3)
    assert events[-1]["unix_s"] - events[-2]["unix_s"] < TIMEOUT_S + 1.0
    if kind == "fifo":
        started.assert_recorded(at_least=5000)
    else:
        writes = device.log.writes(output)
        started.assert_put_out(writes, tail=0 if kind == "cobs" else 1, at_least=20)


@pytest.mark.parametrize("kind", SETUPS)
def test_pulled_adapter_takes_the_port_along(meet, kind):
    """Nobody can be reached: the run says so, and a device with a watchdog goes safe by itself."""
    device, started, output = meet(kind, "unplug")
    printed = started.end()
    assert printed["output_safe"] is False
    assert "port lost, unplugged?" in printed["reason"]
    assert "the safe value could not be confirmed" in printed["reason"]
    assert "\n" not in printed["reason"]
    started.assert_recorded(at_least=20)
    if kind == "scpi":  # it has no watchdog: the voltage stays, as its profile says
        assert device.log.events(output)[-1]["event"] == "write"
        return
    trip = device.log.await_event(output, "watchdog")
    assert trip["current_a"] == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(("kind", "events"), [("dcon", 250), ("fifo", 1200)])
def test_dead_host_is_noticed_by_the_device(meet, kind, events):
    """With all of hilctl killed at once, the device's watchdog makes the output safe in time."""
    device, started, output = meet(kind)
    device.log.await_events(output, events)  # long enough for the recording to be flushed
    started.kill_all(signal.SIGKILL)
    last = device.log.events(output)[-1]
    trip = device.log.await_event(output, "watchdog")
    assert trip["current_a"] == pytest.approx(0.0, abs=2e-3)
    assert (trip["monotonic_ns"] - last["monotonic_ns"]) * 1e-9 < WATCHDOG_S + 1.0
    assert started.readable_samples() > 20


def test_silent_reader_is_named(emulate, run):
    """Where the sensor stands on another device, the line says which of the two did not answer."""
    sensor = "agilent_34970a:AI101"
    device = emulate("kepco_bop", "--sensor", sensor, lines=2)
    section = {
        "kind": "serial_dac",
        "profile": "kepco_bop",
        "serial_port": device.addresses[0],
        "output": "current",
        "input": "AI101",
        "reader": "agilent_34970a",
        "reader_port": device.addresses[1],
        "measure": "current",
        "timeout_s": TIMEOUT_S,
        "sensor": {"um_per_v": 12.5},
        "watchdog": "none",
    }
    started = run(section, waveform=WAVEFORM, sample_rate_hz=19)
    device.log.await_events("current", 20)
    device.process.send_signal(signal.SIGSTOP)
    try:
        printed = started.end()
    finally:
        device.process.send_signal(signal.SIGCONT)
    assert printed["reason"].startswith(f"serial_dac kepco_bop at {device.addresses[0]}: ")
    recording = started.assert_recorded(at_least=10)
    samples = recording.samples
    assert samples.measured[:10] == pytest.approx(samples.command[:10], abs=1e-3)
