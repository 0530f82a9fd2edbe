"""Faults of single samples and of parts of a record, and their cures."""

import re
from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.identify.data.data_faults import record_fault, table_fault
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
        (np.where(np.arange(4000) == 777, 900.0, MOVES), "900 µm at 1.554 s (row 778)"),
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


TIMES_S = {
    "jump": np.where(TIME_S < 1.2, 8.0, 0.0) + MOVES,
    "transient": 20.0 * np.exp(-TIME_S / 0.4) + MOVES,
    "constant start": np.where(TIME_S < 1.3, MOVES[650], MOVES),
}


@pytest.mark.parametrize(("kind", "ends_s"), [
    ("jump", 1.2), ("transient", 3.0), ("constant start", 1.3)])  # fmt: skip
def test_a_bad_start_of_a_table_is_named_and_the_option_omits_it(kind, ends_s):
    history = History("h", COMMAND, TIMES_S[kind] + NOISE, 500.0, rows=ROWS)
    found = table_fault(history)
    (ignore,) = re.search(r"--set table\.ignore=(\d+)", found).groups()
    assert abs(int(ignore) / 500.0 - ends_s) < 0.7
    assert table_fault(replace(history, ignore=int(ignore)), start=False) == ""


def test_any_start_may_be_kept():
    history = History("h", COMMAND, TIMES_S["transient"] + NOISE, 500.0, rows=ROWS)
    assert "--set table.ignore=0" in table_fault(history)
    assert table_fault(history, start=False) == ""


@pytest.mark.parametrize("late", [-150, 150])
def test_a_late_trigger_is_named_and_the_option_shifts_it(late):
    command = 3.0 * np.sin(12.0 * TIME_S) + 2.0 * np.sin(5.3 * TIME_S)
    displacement_um = TRUTH.forward(500.0).process(command)
    history = History("h", command, displacement_um, 500.0, rows=ROWS).without_lag(-late)
    found = table_fault(history)
    (lag,) = re.search(r"--set table\.lag_samples=(-?\d+)", found).groups()
    assert int(lag) == pytest.approx(late, abs=10)
    assert table_fault(history.without_lag(int(lag))) == ""


def test_a_command_that_is_recorded_late_is_named_and_the_option_omits_it():
    history = History("h", np.where(TIME_S < 1.3, 0.0, COMMAND), MOVES, 500.0, rows=10 + ROWS)
    assert "1.3 s (row 661)" in (found := table_fault(history))
    assert "--set table.first_row=661" in found


def test_single_values_and_dropouts_are_all_named():
    displacement_um = MOVES + NOISE
    displacement_um[[700, 1400, 1401]] = -9999.0
    found = table_fault(History("h", COMMAND, displacement_um, 500.0, rows=ROWS))
    assert all(f"(row {row})" in found for row in (701, 1401, 1402))
    displacement_um = 200.0 + MOVES + NOISE
    displacement_um[900:910] = 0.0
    assert "1.8 s (row 901)" in table_fault(
        History("h", COMMAND, displacement_um, 500.0, rows=ROWS)
    )


def test_a_start_from_rest_or_another_state_is_no_fault():
    rest = np.zeros(500)
    command, displacement_um = np.append(rest, COMMAND), np.append(rest, MOVES)
    assert table_fault(History("h", command, displacement_um, 500.0)) == ""
    biased = PpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(2.0, 4.0)).forward(500.0)
    biased.process(np.linspace(0.0, 9.0, 100))
    assert table_fault(History("h", COMMAND, biased.process(COMMAND) + NOISE, 500.0)) == ""
