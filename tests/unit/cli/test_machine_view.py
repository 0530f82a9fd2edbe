"""Devices and lateness for people, in a terminal."""

import io

import numpy as np
import pytest
from rich.console import Console

from hilctl.cli.machine_view import measuring, print_described, print_inventory, render
from hilctl.experiment.inventory import (
    Described,
    DeviceOption,
    Inventory,
    SerialPort,
)
from hilctl.machine.diagnosis import Diagnosis
from hilctl.machine.latency import Latency


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "150")


def test_bars_grow_with_the_logarithm_of_the_count():
    """One late tick among thousands still has a bar."""
    late_ns = np.array([1500] * 9_999 + [70_000], dtype=np.int64)
    console = Console(file=io.StringIO(), width=120)
    console.print(render(Diagnosis((), Latency(1000.0, late_ns, ()))))
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
    assert "host  must be given" in shown
    assert "502" in shown


def test_no_bar_where_output_is_for_programs(capsys):
    with measuring(1.0, quiet=True) as report:
        report(0.5)
    assert capsys.readouterr().err == ""
