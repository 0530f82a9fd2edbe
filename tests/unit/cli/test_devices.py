"""Commands on this computer and its devices: doctor, devices."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from hilctl.cli.devices import (
    devices_app,
    measurement_progress,
    print_described,
    print_inventory,
    print_probed,
    render_diagnosis,
)
from hilctl.experiment.inventory import (
    Described,
    DeviceOption,
    Inventory,
    SerialPort,
)
from hilctl.machine.diagnosis import Diagnosis
from hilctl.machine.latency import Latency
from hilctl.run.probe import Probed

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


@pytest.fixture
def devices():
    """Return a function that runs `hilctl devices` with words; it must end well."""

    def run(*words):
        ended = CliRunner().invoke(devices_app, list(map(str, words)))
        assert ended.exit_code == 0, ended.output
        return ended.stdout

    return run


def test_devices_are_listed_for_people_and_programs(devices):
    listed = json.loads(devices("--json"))
    assert "simulated_terfenol" in listed["devices"]
    assert "labjack_t7" in listed["profiles"]
    shown = devices()
    assert "simulated_terfenol" in shown
    assert "labjack_t7" in shown


def test_a_device_is_probed_instead_of_listed(devices):
    """The self-test's answer, and no list."""
    probed = json.loads(devices("probe", DEMO, "--json"))
    assert probed["name"] == "simulated_terfenol"
    assert probed["max_rate_hz"] > 0.0
    shown = devices("probe", DEMO)
    assert "simulated_terfenol answers" in shown
    assert "profiles" not in shown


def test_a_device_that_says_what_can_not_be_is_a_fault(monkeypatch):
    """The exit code of a fault, for people and for programs."""
    wrong = Probed("rig", "a device", 1.0, "", "", {}, 2.8e20, None, "A", ("too far",))
    monkeypatch.setattr("hilctl.run.probe.probe", lambda path, settings: wrong)
    for words in ([], ["--json"]):
        ended = CliRunner().invoke(devices_app, ["probe", str(DEMO), *words])
        assert ended.exit_code == 3
        assert "too far" in ended.stdout


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "150")


def test_bars_grow_with_the_logarithm_of_the_count():
    """One late tick among thousands still has a bar."""
    late_ns = np.array([1500] * 9_999 + [70_000], dtype=np.int64)
    console = Console(file=io.StringIO(), width=120)
    console.print(render_diagnosis(Diagnosis((), Latency(1000.0, late_ns, ()))))
    bars = [line.count("#") for line in console.file.getvalue().splitlines() if "#" in line]
    assert max(bars) == 40
    assert min(bars) == round(40 * np.log(2.0) / np.log(10_000.0))


def test_ports_are_listed_or_said_to_be_none(capsys):
    print_inventory(Inventory({"rig": "a:b"}, {"labjack_t7": "x"}, ()))
    assert "no serial port found" in capsys.readouterr().out
    print_inventory(Inventory({}, {}, (SerialPort("/dev/ttyUSB0", "an adapter"),)))
    shown = capsys.readouterr().out
    assert "/dev/ttyUSB0" in shown
    assert "no serial port" not in shown


def test_what_is_known_of_a_profile_is_printed_as_it_stands(capsys):
    channel = {"min": 0.0, "max": 5.0, "unit": "V"}
    profile = {"model": "[T7]", "outputs": {"DAC0": channel}, "notes": ("one\nnote", "another")}
    print_described(Described("t7", "t7.yaml", (), profile))
    shown = capsys.readouterr().out
    for text in ("t7: t7.yaml", "model: [T7]", "0.0 to 5.0 V", "notes: one note", "notes: another"):
        assert text in shown


def test_options_that_must_be_given_are_said(capsys):
    options = (DeviceOption("host", None, "where it is"), DeviceOption("port", "502", "its port"))
    print_described(Described("dac", "a:B", options, {}))
    shown = capsys.readouterr().out
    assert "host  required" in shown
    assert "502" in shown


def test_no_bar_where_output_is_for_programs(capsys):
    with measurement_progress(1.0, quiet=True) as report:
        report(0.5)
    assert capsys.readouterr().err == ""


PROBED = Probed(
    "rig", "a [bold] device", 1000.0, "", "a message takes up to 0.3 s", {"firmware": "[1.2]"},
    2.8e20, None, "A", ("too far",),
)  # fmt: skip


def test_what_a_device_says_is_no_markup(capsys):
    """Brackets of its own stay as they are; reading, output and faults are there."""
    print_probed(PROBED)
    shown = capsys.readouterr().out
    assert "rig answers: a [bold] device\n" in shown
    assert "firmware: [1.2]" in shown
    assert "1000 samples per second\n" in shown
    assert "displacement: 2.8e+20 µm" in shown
    assert "output: unknown" in shown
    assert "safe value: a message takes up to 0.3 s" in shown
    assert "fault: too far" in shown
