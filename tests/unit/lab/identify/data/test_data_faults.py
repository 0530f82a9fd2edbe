"""Faults of single samples and of parts of a record, and their cures."""

import re

import numpy as np
import pytest

from hilctl.lab.identify.data.data_faults import record_fault
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.settings import IdentifySettings
from hilctl.models.plays import PpiModel

TRUTH = PpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(2.0, 4.0))
TIME_S = np.arange(4000) / 500.0
COMMAND = 5.0 * np.sin(12.0 * TIME_S) * np.cos(0.2 * TIME_S)
MOVES = TRUTH.forward(500.0).process(COMMAND)
ROWS = 1 + np.arange(TIME_S.size)
NOISE = 0.01 * np.random.default_rng(1).standard_normal(TIME_S.size)


def fault(displacement_um, rows=ROWS):
    history = History("h", COMMAND, displacement_um + NOISE, 500.0, rows=rows)
    return record_fault(history, IdentifySettings(kind="ppi"))


def test_a_good_record_has_none():
    assert fault(MOVES) == ""


@pytest.mark.parametrize(
    ("displacement_um", "said", "cure"),
    [
        (np.where(TIME_S < 1.0, 15.0, 0.0) + MOVES, "µm at 1 s (row 501)", "ignore"),
        (np.where(TIME_S < 7.0, 15.0, 0.0) + MOVES, "at 7 s (row 3501)", "last_row"),
        (np.where(TIME_S < 3.0, 0.0, MOVES), "hardly moves from 0.", "ignore"),
        (np.where(TIME_S > 6.0, 0.0, MOVES), "hardly moves from 6.", "last_row"),
    ],
)
def test_a_bad_part_is_named_and_skipped_by_the_option(displacement_um, said, cure):
    found = fault(displacement_um)
    assert said in found
    key, value = re.search(r"--set table\.(\w+)=(\d+)", found).groups()
    assert key == cure
    kept = slice(int(value), None) if key == "ignore" else slice(0, int(value))
    rest = History("h.csv", COMMAND[kept], (displacement_um + NOISE)[kept], 500.0)
    assert record_fault(rest, IdentifySettings(kind="ppi")) == ""
    assert "table." not in fault(displacement_um, rows=np.empty(0, int))
    moved = fault(displacement_um, rows=10 + ROWS)
    if cure == "last_row":
        assert f"table.last_row={int(value) + 10}" in moved


@pytest.mark.parametrize(
    ("displacement_um", "said"),
    [
        (np.minimum(MOVES, 20.0) - NOISE, "stays at 20 µm"),
        (np.where(np.arange(4000) == 777, 900.0, MOVES), "spike of 900 µm at 1.554 s (row 778)"),
        (MOVES + 900.0, "offset of 9"),
    ],
)
def test_other_faults(displacement_um, said):
    assert said in fault(displacement_um)


def test_a_small_spike_is_named_with_a_cure_that_works():
    displacement_um = MOVES.copy()
    displacement_um[777] += 0.04 * np.ptp(MOVES)
    found = fault(displacement_um)
    assert "(row 778)" in found
    assert "NaN" in found
    assert "NaN" not in fault(displacement_um, rows=np.empty(0, int))


def test_a_step_of_the_command_is_no_fault():
    command = np.where(TIME_S < 3.0, 0.0, 4.0) + 0.1 * np.sin(12.0 * TIME_S)
    history = History("h.csv", command, 4.0 * command + NOISE, 500.0)
    assert record_fault(history, IdentifySettings()) == ""
