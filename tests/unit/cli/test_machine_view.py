"""Devices and lateness for people, in a terminal."""

import io

import numpy as np
import pytest
from rich.console import Console

from hilctl.cli.machine_view import measuring, print_inventory, render
from hilctl.experiment.inventory import Inventory, SerialPort
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


def test_no_bar_where_output_is_for_programs(capsys):
    with measuring(1.0, quiet=True) as report:
        report(0.5)
    assert capsys.readouterr().err == ""
