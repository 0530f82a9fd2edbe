"""Commands on this computer and its devices: doctor, devices."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from hilctl.cli.devices import print_described, print_inventory, print_probed, render_diagnosis
from hilctl.experiment.devices import DeviceDescription, DeviceOption
from hilctl.machine.diagnosis import Diagnosis
from hilctl.machine.timer_latency import Latency
from hilctl.run.probe import Probed

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


def test_devices_are_listed(hilctl, json_of):
    _, listed = json_of("devices")
    assert json_of("devices", "list") == (0, listed)
    assert "simulated_terfenol" in listed["devices"]
    assert "labjack_t7" in listed["profiles"]
    code, shown, _ = hilctl("devices")
    assert code == 0
    assert "simulated_terfenol" in shown
    assert "labjack_t7" in shown


def test_probe_prints_the_answers_of_a_device(hilctl, json_of):
    code, probed = json_of("devices", "probe", DEMO)
    assert (code, probed["name"]) == (0, "simulated_terfenol")
    assert probed["max_rate_hz"] > 0.0
    _, shown, _ = hilctl("devices", "probe", DEMO)
    assert "simulated_terfenol answers" in shown
    assert "profiles" not in shown
    code, _, err = hilctl("devices", "probe", "absent.yaml")
    assert code == 2
    assert err.startswith("hilctl: absent.yaml")


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_implausible_answer_has_exit_code_3(monkeypatch, hilctl, words):
    monkeypatch.setattr("hilctl.cli.devices.read_devices", lambda *_: {"": PROBED})
    code, shown, _ = hilctl("devices", "probe", DEMO, *words)
    assert code == 3
    assert "too far" in shown


def test_bars_are_logarithmic():
    late_ns = np.array([1500] * 9_999 + [70_000], dtype=np.int64)
    console = Console(file=io.StringIO(), width=120)
    console.print(render_diagnosis(Diagnosis((), Latency(1000.0, late_ns, ()))))
    bars = [line.count("#") for line in console.file.getvalue().splitlines() if "#" in line]
    assert max(bars) == 40
    assert min(bars) == round(40 * np.log(2.0) / np.log(10_000.0))


def test_serial_ports_are_listed(capsys):
    listed = {"devices": {"rig": "a:b"}, "profiles": {"labjack_t7": "x"}}
    print_inventory({**listed, "serial_ports": []})
    assert "no serial port" in capsys.readouterr().out
    port = {"path": "/dev/ttyUSB0", "description": "an adapter"}
    print_inventory({**listed, "serial_ports": [port]})
    shown = capsys.readouterr().out
    assert "/dev/ttyUSB0" in shown
    assert "no serial port" not in shown


def test_profile_is_printed_without_markup(capsys):
    channel = {"min": 0.0, "max": 5.0, "unit": "V"}
    profile = {"model": "[T7]", "outputs": {"DAC0": channel}, "notes": ("one\nnote", "another")}
    print_described(DeviceDescription("t7", "t7.yaml", (), profile))
    shown = capsys.readouterr().out
    for text in ("t7: t7.yaml", "model: [T7]", "0.0 to 5.0 V", "notes: one note", "notes: another"):
        assert text in shown


def test_required_options_are_marked(capsys):
    options = (DeviceOption("host", None, "where it is"), DeviceOption("port", "502", "its port"))
    print_described(DeviceDescription("dac", "a:B", options, {}))
    shown = capsys.readouterr().out
    assert "host  required" in shown
    assert "502" in shown


PROBED = Probed(
    "rig", "a [bold] device", 1000.0, "", "up to 0.3 s", {"firmware": "[1.2]"},
    2.8e20, None, 1.5, True, "A", ("too far",),
)  # fmt: skip


def test_answers_of_a_device_are_printed_without_markup(capsys):
    print_probed(PROBED)
    shown = capsys.readouterr().out
    assert "rig answers: a [bold] device\n" in shown
    assert "firmware: [1.2]" in shown
    assert "1000 samples per second\n" in shown
    assert "displacement: 2.8e+20 µm" in shown
    assert "output: unknown" in shown
    assert "watchdog: tripped" in shown
    assert "measured output: 1.5 A\n" in shown
    assert "safe value: up to 0.3 s" in shown
    assert "fault: too far" in shown
