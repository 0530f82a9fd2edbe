"""One short compensated run over every wire, in the processes that a user starts."""

import json
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from hilctl_drivers.profile import shipped_profiles
from tests.benchmark.attacked import make_real_time
from tests.commands import hilctl, typed

ROOT = Path(__file__).parents[2]
MODEL = ROOT / "configs" / "models" / "terfenol_omega.yaml"
DCON_READER = ROOT / "tests" / "data" / "dcon_module.yaml"
CYCLES = 3
AMPLIFIER = {"amplifier": {"gain_a_per_v": 1.0}}
COMMON = {"sensor": {"um_per_v": 12.5}, "timeout_s": 2.0, "watchdog": "none"}
VOLTMETER = {"reader": {"profile": "agilent_34970a"}}
BOARD = {"kind": "serial_dac", "output": "DAC", "input": "ADC", **AMPLIFIER}
MODBUS = {"kind": "modbus_dac", "output": "OUT", "input": "IN", **AMPLIFIER}
SCPI = {"kind": "serial_dac", "output": "current", "input": "AI101", **VOLTMETER}
DCON = {"kind": "serial_dac", "output": "AO0", "input": "AI0", "reader": {"profile": "dcon.yaml"}}


@dataclass(frozen=True, slots=True)
class Wire:
    """One connection to the rig.

    Attributes:
        device: The experiment's device section without profile and addresses.
        ports: Keys of the device section that the emulator's addresses go to, in order.
    """

    profile: str
    device: dict[str, Any]
    rate_hz: float
    ports: tuple[str, ...] = ("serial_port",)
    words: tuple[str, ...] = ()
    block: int = 1
    per_cycle: int = 50


TWO_PORTS = ("serial_port", "reader")
SCPI_SENSOR = ("--sensor", "agilent_34970a:AI101")
WIRES = {
    "Modbus TCP": Wire("generic_float32", MODBUS, 500.0, ("host",)),
    "Modbus RTU": Wire("rtu.yaml", MODBUS, 100.0),
    "SCPI": Wire("kepco_bop", SCPI, 15.0, TWO_PORTS, SCPI_SENSOR, per_cycle=20),
    "SCPI, measured": Wire(
        "kepco_bop", {**SCPI, "measure": "current"}, 15.0, TWO_PORTS, SCPI_SENSOR, per_cycle=20
    ),
    "DCON": Wire(
        "icp_m7024_dcon", {**DCON, **AMPLIFIER}, 35.0, TWO_PORTS, ("--sensor", "dcon.yaml:AI0")
    ),
    "COBS": Wire("cobs_board", BOARD, 200.0),
    "COBS FIFO": Wire(
        "cobs_board_fifo", {**BOARD, "fifo_blocks": 15}, 10_000.0, block=100, per_cycle=500
    ),
}
TRANSACTIONS = {"SCPI": "2", "SCPI, measured": "3", "DCON": "2"}
"""Requests per tick, where they are not one."""
LIKE_OTHERS = {"Modbus RTU", "SCPI, measured"}
"""Wires whose parts the others have, each in a run that takes its time."""


def write_profiles(folder: Path) -> None:
    """Write the profiles that are not shipped: float32 and function 23 over RTU, a DCON reader."""
    rtu = yaml.safe_load(shipped_profiles()["generic_float32"].read_text(encoding="utf-8"))
    rtu["link"] = {"kind": "rtu", "baud": 115200}
    (folder / "rtu.yaml").write_text(yaml.safe_dump(rtu), encoding="utf-8")
    shutil.copy(DCON_READER, folder / "dcon.yaml")


@contextmanager
def emulated(wire: Wire, folder: Path) -> Iterator[dict[str, Any]]:
    """Emulate a wire's device in a process; yield the device section that reaches it."""
    command = typed("emulate", wire.profile, *wire.words)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            assert process.stdout is not None
            make_real_time(process.pid)
            found = [process.stdout.readline().split()[-1] for _ in wire.ports]
            yield {**COMMON, "profile": wire.profile, **device_at(wire, found)}
        finally:
            process.terminate()


def device_at(wire: Wire, found: Sequence[str]) -> dict[str, Any]:
    """Return a wire's device section with the addresses that its emulator listens at."""
    if wire.ports == ("host",):
        host, port = found[0].split(":")
        return {**wire.device, "host": host, "tcp_port": int(port)}
    section = {**wire.device, "serial_port": found[0]}
    if "reader" in wire.ports:
        section["reader"] = {**wire.device["reader"], "serial_port": found[1]}
    return section


def write_experiment(path: Path, wire: Wire, device: dict[str, Any]) -> None:
    """Write a compensated sine at full stroke: a soft start of one cycle, then two more."""
    frequency_hz = wire.rate_hz / wire.per_cycle
    experiment = {
        "name": "wire",
        "device": device,
        "sample_rate_hz": wire.rate_hz,
        "block": wire.block,
        "waveform": {
            "kind": "sine",
            "unit": "um",
            "amplitude": 40.8,
            "offset": -6.9,
            "frequency_hz": frequency_hz,
            "duration_s": CYCLES / frequency_hz,
            "soft_start_s": 1.0 / frequency_hz,
        },
        "compensator": {"model": str(MODEL)},
        "limits": {
            "peak_current_a": 7.07,
            "slew_a_per_s": 400.0 * frequency_hz,
            "stroke_um": [-75.0, 60.0],
        },
        "safe": {"value": 0.0, "ramp_s": 0.2},
        # A busy machine may miss deadlines; that must not end the run.
        "timing": {"max_missed_share": 1.0, "max_late_s": 5.0},
    }
    path.write_text(yaml.safe_dump(experiment), encoding="utf-8")


def run(path: Path) -> dict[str, Any]:
    """Run an experiment in processes of its own; return the JSON that it prints."""
    command = typed("run", path, "--output", path.with_suffix(".mcap"), "--json")
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, cwd=path.parent)
    assert done.stdout, done.returncode
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks=pytest.mark.long if each in LIKE_OTHERS else ()) for each in WIRES],
)
def test_compensated_run_is_complete(tmp_path, name):
    wire = WIRES[name]
    write_profiles(tmp_path)
    path = tmp_path / "experiment.yaml"
    with emulated(wire, tmp_path) as device:
        write_experiment(path, wire, device)
        printed = run(path)
    assert "error" not in printed, printed["error"]
    assert printed["code"] == "completed", printed["reason"]
    assert printed["complete"]
    assert printed["output_safe"]
    recording = read(path.with_suffix(".mcap"))
    waveform = recording.samples.index[recording.samples.index < CYCLES * wire.per_cycle]
    missing = CYCLES * wire.per_cycle - waveform.size
    assert missing <= recording.dropped
    if name == "COBS FIFO":  # its own clock paces it, whatever this machine does meanwhile
        assert recording.dropped == 0
    # All of it, and not of its steady cycles alone: a busy machine may leave none.
    assert np.ptp(recording.samples.displacement_um) > 60.0
    measured = recording.samples.measured
    assert (measured.size > 0 and abs(measured - recording.samples.command).max() < 1e-3) == (
        name == "SCPI, measured"
    )
    assert recording.run["device.transactions"] == TRANSACTIONS.get(name, "1")
    assert replay(recording).identical


PIEZO = {
    "device.host": "127.0.0.1", "device.timeout_s": 2.0, "device.watchdog": "none",
    "device.amplifier.gain_v_per_v": 10.0, "device.sensor.um_per_v": 5.0,
    "sample_rate_hz": 100.0, "limits.drive_v": "[0, 100]", "limits.slew_v_per_s": 1000.0,
    "limits.stroke_um": "[-5, 48]", "waveform.offset": 40.0, "waveform.amplitude": 40.0,
    "timing.max_missed_share": 1.0, "timing.max_late_s": 5.0,
}  # fmt: skip


@pytest.mark.slow
def test_a_piezo_is_rehearsed(tmp_path):
    """From ``init`` to a recording that agrees with the emulated device's log."""
    path, log, output = (tmp_path / name for name in ("rig.yaml", "log.jsonl", "run.mcap"))
    settings = [word for pair in PIEZO.items() for word in ("--set", "{}={}".format(*pair))]
    hilctl("init", "labjack_t8", "--unit", "V", "--output", path, *settings)
    command = typed("emulate", path, "--log", log, "--json")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            assert process.stdout is not None
            make_real_time(process.pid)
            arguments = json.loads(process.stdout.readline())["arguments"]
            hilctl(*arguments, "--output", output)
        finally:
            process.terminate()
    recording = read(output)
    assert recording.end["code"] == "completed"
    command_v, displacement_um = recording.samples.command, recording.samples.displacement_um
    entries = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    put_out = np.array([each["drive_v"] for each in entries])
    # Opening the device may repeat the present output.
    assert any(
        np.allclose(put_out[first : first + command_v.size], command_v, atol=2e-3)
        for first in range(4)
    )
    # 80 % of 50 um at 100 V, and less than proportionally at 80 V.
    assert (command_v.max(), displacement_um.max()) == pytest.approx((80.0, 31.2), abs=0.3)


@pytest.mark.slow
def test_a_raster_of_two_axes_on_one_device(tmp_path):
    """Both are in one scan list: each sample of both has the same scan."""
    path, log, output = (
        ROOT / "configs" / "raster.yaml",
        tmp_path / "log.jsonl",
        tmp_path / "r.mcap",
    )
    shorter = {
        "device.tcp_port": 502,  # so the emulator takes a free one
        "device.timeout_s": 5.0, "timing.max_late_s": 5.0,
        "axes.x.waveform.duration_s": 1.6, "axes.y.waveform.levels": "[4.0, 6.0]",
    }  # fmt: skip
    settings = [word for pair in shorter.items() for word in ("--set", "{}={}".format(*pair))]
    command = typed("emulate", path, "--log", log, "--json", *settings)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            assert process.stdout is not None
            make_real_time(process.pid)
            arguments = json.loads(process.stdout.readline())["arguments"]
            hilctl(*arguments, "--output", output)
        finally:
            process.terminate()
    x, y = (read(output.with_suffix(f".{axis}.mcap")) for axis in "xy")
    assert [each.end["code"] for each in (x, y)] == ["completed"] * 2
    assert x.samples.index.tolist() == y.samples.index.tolist()
    for recording, error_um in ((x, 0.4), (y, 0.3)):
        samples, late = recording.samples, slice(2000, 6000)
        found_um = samples.displacement_um[late] - samples.reference_um[late]
        assert np.abs(found_um).max() < error_um
    assert replay(y).identical
    played = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    scans = {
        axis: [
            (each["monotonic_ns"], each["first"], each["samples"])
            for each in played
            if each["event"] == "played" and each["axis"] == axis
        ]
        for axis in "xy"
    }
    assert scans["x"] == scans["y"] != []
