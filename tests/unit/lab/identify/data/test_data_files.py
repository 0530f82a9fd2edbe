"""Recordings and tables to records: loops or whole histories, one unit, and no gaps."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Flag
from hilctl.lab.identify.data import data_files
from hilctl.lab.identify.data.data_files import (
    history_from_pieces,
    load_records,
    read_table,
    without_gaps,
)
from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.pipeline import settings_from
from hilctl.lab.identify.settings import TableSettings

GOLDEN = Path(__file__).parents[5] / "recordings" / "golden"
CURRENT, VOLTAGE = GOLDEN / "terfenol_uncompensated.mcap", GOLDEN / "piezo_compensated.mcap"


def test_a_recording_gives_loops_or_its_history():
    loops, unit, _ = load_records([CURRENT], settings_from("rdpi", []), 0)
    assert unit == "A"
    assert all(isinstance(each, SteadyLoop) for each in loops)
    (history,), *_ = load_records([CURRENT], settings_from("ppi", ["whole=true"]), 0)
    assert isinstance(history, History)


def test_currents_and_voltages_are_not_fitted_together():
    with pytest.raises(InputError, match="in A and in V"):
        load_records([CURRENT, VOLTAGE], settings_from("ppi", ["whole=true"]), 0)


def test_a_history_ends_where_the_ramp_begins(recording_of):
    command = np.linspace(0.0, 1.0, 100)
    recording = recording_of(command, 2.0 * command, [])
    recording.samples.flags[80:] |= Flag.RAMP.value
    history = history_from_pieces([recording])
    assert history.command.size == 80
    np.testing.assert_array_equal(history.displacement_um, 2.0 * command[:80])


def test_a_history_that_begins_with_a_ramp_is_refused(recording_of):
    recording = recording_of(np.zeros(100), np.zeros(100), [])
    recording.samples.flags[:20] |= Flag.RAMP.value
    with pytest.raises(DataError, match="ramp"):
        history_from_pieces([recording])


@pytest.mark.parametrize("ramp", [0, 20])
def test_a_conditioned_history_begins_with_its_cycle(recording_of, ramp):
    command = np.linspace(0.0, 1.0, 150)
    recording = recording_of(command, 2.0 * command, [])
    recording.samples.flags[:ramp] |= Flag.RAMP.value
    recording.samples.flags[ramp:60] |= Flag.CONDITION.value
    recording.samples.flags[130:] |= Flag.RAMP.value
    history = history_from_pieces([recording])
    np.testing.assert_array_equal(history.command, command[ramp:130])
    assert history.ignore == 60 - ramp


@pytest.mark.parametrize("what", ["begins late", "lost samples"])
def test_a_history_without_known_commands_is_refused(recording_of, what):
    index = np.arange(200)
    index[0 if what == "begins late" else 50 :] += 1
    with pytest.raises(DataError, match="command is unknown"):
        history_from_pieces([recording_of(np.zeros(200), np.zeros(200), [], index=index)])


def skipping(recording_of, skipped):
    """Return a ramp of 1000 samples with skipped ticks."""
    index = np.delete(np.arange(1000), skipped)
    recording = recording_of(1.0 * index, 2.0 * index, [], index=index)
    recording.samples.flags[1:][np.diff(index) > 1] |= Flag.AFTER_SKIPPED.value
    return recording


@pytest.mark.parametrize("edges", [[], [500], [300, 501, 700]])
def test_skipped_samples_hold_the_command(recording_of, edges):
    recording = skipping(recording_of, [500, 501])
    history = history_from_pieces(pieces_of(recording, edges))
    assert history.command.size == 1000
    np.testing.assert_array_equal(history.command[498:504], [498, 499, 499, 499, 502, 503])
    np.testing.assert_allclose(history.displacement_um, 2.0 * np.arange(1000))
    np.testing.assert_allclose(history.rate()[1:], history.sample_rate_hz)  # no faster motion
    command, displacement_um = without_gaps(recording, 100, 900)
    np.testing.assert_array_equal(command, history.command[100:900])
    np.testing.assert_array_equal(displacement_um, history.displacement_um[100:900])


def test_readings_that_are_no_numbers_are_missing_too(recording_of):
    recording = skipping(recording_of, [])
    recording.samples.displacement_um[300] = np.nan
    np.testing.assert_allclose(without_gaps(recording, 0, 1000)[1], 2.0 * np.arange(1000))


def test_too_many_missing_samples_are_refused(recording_of):
    recording = skipping(recording_of, np.arange(500, 511))
    for read in (history_from_pieces, lambda pieces: without_gaps(*pieces, 0, 1000)):
        with pytest.raises(DataError, match="11 of 1000"):
            read([recording])


def pieces_of(recording, edges):
    """Return a recording in pieces, cut before some samples."""
    bounds = zip([0, *edges], [*edges, recording.samples.index.size], strict=True)
    return [replace(recording, samples=recording.samples.rows(slice(*each))) for each in bounds]


def test_a_history_in_pieces_is_that_of_the_whole(recording_of):
    command = np.linspace(0.0, 1.0, 150)
    recording = recording_of(command, 2.0 * command, [])
    recording.samples.flags[:30] |= Flag.RAMP.value
    recording.samples.flags[30:60] |= Flag.CONDITION.value
    recording.samples.flags[130:] |= Flag.RAMP.value
    whole = history_from_pieces([recording])
    for edges in ([20, 40, 100, 140], [30, 60], [0, 29, 31, 150]):
        history = history_from_pieces(pieces_of(recording, edges))
        np.testing.assert_array_equal(history.command, whole.command)
        np.testing.assert_array_equal(history.displacement_um, whole.displacement_um)
        assert history.ignore == whole.ignore == 30


def test_a_run_that_is_too_long_for_memory_is_refused_as_a_whole(recording_of, monkeypatch):
    monkeypatch.setattr(data_files, "MOST_WHOLE", 99)
    recording = recording_of(np.linspace(0.0, 1.0, 150), np.linspace(0.0, 1.0, 150), [])
    with pytest.raises(DataError, match=r"more than 99"):
        history_from_pieces(pieces_of(recording, [50]))


def test_tables_have_no_unit_of_their_own(tmp_path):
    path = tmp_path / "t.csv"
    rows = "\n".join(f"{v!r},{2.0 * v!r}" for v in np.sin(np.arange(60) / 5.0).tolist())
    path.write_text(f"drive,um\n{rows}\n")
    texts = ["table.command_column=drive", "table.displacement_column=um", "table.rate_hz=200",
             "table.unit=V", "whole=true"]  # fmt: skip
    (history,), unit, understood = load_records([path], settings_from("ppi", texts), 0)
    assert unit == "V"
    assert understood[0].startswith(
        "t.csv: command drive [V, assumed], displacement um [um, assumed]; 60 rows at 200 Hz; "
    )
    assert history.sample_rate_hz == 200.0
    (late,), *_ = load_records([path], settings_from("ppi", texts), 3)
    assert late.command.size == history.command.size - 3


def test_a_loop_is_left_out_by_its_label():
    every, *_ = load_records([CURRENT], settings_from("ppi", []), 0)
    first = every[0].label
    chosen = settings_from("ppi", [f"leave_out=[{json.dumps(first)}]"])
    kept = load_records([CURRENT], chosen, 0)[0] if len(every) > 1 else []
    assert [each.label for each in kept] == [each.label for each in every if each.label != first]


@pytest.mark.parametrize(("label", "rule"), [("nothing", "unknown label"), ("", "excludes all")])
def test_leaving_out_what_is_not_there_or_all_is_refused(label, rule):
    with pytest.raises(InputError, match=rule):
        load_records([CURRENT], settings_from("ppi", [f"leave_out=['{label}']"]), 0)


def write(folder: Path, lines: list[str], name: str = "t.csv") -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def table(path: Path, command: str | int, displacement: str | int, **options: Any) -> History:
    columns = {"command_column": command, "displacement_column": displacement}
    return read_table(path, TableSettings(**columns, **options)).history


def rows(separator: str, n: int = 40) -> list[str]:
    return [separator.join([f"{0.01 * k:.2f}", str(k % 7), str(-2.5 * k)]) for k in range(n)]


def test_quotes_comments_and_blank_lines(tmp_path):
    lines = ["# rig 3", "", '"drive, V","displacement"', *[f"{k},{k * k}" for k in range(20)]]
    history = table(
        write(tmp_path, lines),
        "drive, V",
        "displacement",
        rate_hz=5.0,
        first_row=3,
        last_row=19,
        ignore=1,
    )
    np.testing.assert_array_equal(history.command, np.arange(2, 19))
    assert (history.sample_rate_hz, history.ignore) == (5.0, 1)


def test_units_are_those_of_the_columns(tmp_path):
    lines = [f"{5 * k},{k},{2 * k},{k / 4}" for k in range(20)]
    path = write(tmp_path, ["t [ms],drive [mA],gap [nm],monitor [V]", *lines])
    read = read_table(path, TableSettings(
        time_column="t", command_column="drive", displacement_column="gap"))  # fmt: skip
    assert read.unit == "A"
    assert read.history.sample_rate_hz == pytest.approx(200.0)
    np.testing.assert_allclose(read.history.command, 1e-3 * np.arange(20))
    np.testing.assert_allclose(read.history.displacement_um, 2e-3 * np.arange(20))
    volts = {"command": "drive", "displacement": "monitor", "time_column": 1}
    scaled = table(path, **volts, displacement_scale=12.5)
    np.testing.assert_allclose(scaled.displacement_um, 12.5 * np.arange(20) / 4)
    with pytest.raises(DataError, match=r"monitor .* V.* --displacement-scale"):
        table(path, **volts)
    with pytest.raises(DataError, match=r"drive .* A.* --command-scale"):
        table(path, "drive", "gap", time_column=1, unit="V")
    with pytest.raises(DataError, match="--time-column"):
        table(path, "drive", "gap", time_column="monitor")
    with pytest.raises(DataError, match=r"t \[ms\], 2: drive .*--command-column"):
        table(path, "current", "gap", time_column=1)


def test_missing_displacements_are_interpolated(tmp_path):
    lines = [f"{k / 200},{k % 50},{'' if 100 <= k < 103 else 2 * k}" for k in range(400)]
    path = write(tmp_path, ["t_s,current_a,displacement_um", *lines])
    history = read_table(path, TableSettings()).history
    np.testing.assert_allclose(history.displacement_um, 2.0 * np.arange(400))
    np.testing.assert_array_equal(history.held, [100, 101, 102])
    path = write(tmp_path, ["t_s,current_a,displacement_um", *lines[:150]])
    with pytest.raises(DataError, match="3 of 150 samples"):
        read_table(path, TableSettings())


def test_rate_or_time_not_both(tmp_path):
    path = write(tmp_path, rows(","))
    with pytest.raises(DataError, match="--time-column or --rate-hz"):
        table(path, 2, 3)
    with pytest.raises(DataError, match="got both"):
        table(path, 2, 3, time_column=1, rate_hz=100.0)


def test_columns_are_known_by_their_units(tmp_path):
    lines = [f"{k / 200},{k},{2 * k},{3 * k}" for k in range(20)]

    def read(head, **settings):
        path = write(tmp_path, [head, *lines])
        return read_table(path, TableSettings(**settings)).history

    history = read("t [ms],input,gap [nm],drive [mA]")
    np.testing.assert_allclose(history.command, 3e-3 * np.arange(20))
    np.testing.assert_allclose(history.displacement_um, 2e-3 * np.arange(20))
    assert history.sample_rate_hz == pytest.approx(2e5)
    for unit, name in (("a", "current_a"), ("v", "drive_v")):
        assert read(f"t_s,wanted_{unit},displacement_um,{name}").command[-1] == 57.0
    with pytest.raises(DataError) as caught:
        read("x,CH1,CH2,CH3")
    for option in ("--time-column", "--rate-hz", "--command-column", "--displacement-column"):
        assert option in str(caught.value)
    with pytest.raises(DataError, match="both column sensor"):
        read("t_s,drive,sensor [V],note", displacement_column=3)


@pytest.mark.parametrize(
    ("head", "time", "um", "cures"),
    [
        ("t,drive,gap", 2.0, 30.0, [{"rate_hz": 500.0}, {"rate_hz": 0.5}]),
        ("t_s,drive,gap", 2.0, 30.0, [{"rate_hz": 500.0}]),
        ("t,drive,gap", 0.05, 30.0, [{"rate_hz": 20000.0}, {"rate_hz": 20.0}]),
        ("t_s,drive,gap", 0.05, 30.0, []),
        ("t_ms,drive,gap_um", 200.0, 30.0, []),
        ("t_ns,drive,gap_um", 2e6, 30.0, []),
        ("t,drive,gap", 0.002, 0.03, [{"displacement_scale": 1000.0}, {"displacement_scale": 1.0}]),
        ("t,drive,gap_um", 0.002, 0.03, [{"displacement_scale": 1000.0}]),
        ("t,drive,gap_nm", 0.002, 30.0, []),
    ],
)
def test_units_in_doubt_are_refused_until_an_option_confirms_them(tmp_path, head, time, um, cures):
    rows = [f"{time * k!r},{k % 50},{um * (k % 50) / 49!r}\n" for k in range(200)]
    (tmp_path / "t.csv").write_text(f"{head}\n{''.join(rows)}")
    columns = {"command_column": "drive", "displacement_column": head.split(",")[2], "unit": "V"}
    columns["time_column"] = head.split(",")[0]
    if cures:
        with pytest.raises(DataError) as caught:
            read_table(tmp_path / "t.csv", TableSettings(**columns))
    for cure in cures or [{}]:
        ((key, value),) = cure.items() or [("time_column", columns["time_column"])]
        if cures:
            assert f"--{key.replace('_', '-')} {value:g}" in str(caught.value)
        given = {**columns, **cure, **({"time_column": None} if key == "rate_hz" else {})}
        assert read_table(tmp_path / "t.csv", TableSettings(**given)).history.command.size == 200


@pytest.mark.parametrize(
    ("bias", "envelope", "ignored"),
    [
        (0.0, (1.0, 1.0), 70),
        (2.0, (1.0, 1.0), 70),  # until it has been at both ends
        (2.0, (0.3, 1.0), 25),  # its largest motion is the last: until it first turns
    ],
)
def test_a_history_from_an_unknown_state_is_evaluated_once_its_motion_determines_it(
    bias, envelope, ignored
):
    command = bias + np.linspace(*envelope, 1000) * np.sin(0.02 * np.pi * np.arange(1000))
    found = data_files.from_known_state(History("h", command, 5.0 * command, 100.0))
    assert found.ignore == pytest.approx(ignored, abs=5)


def test_missing_rows_are_interpolated_and_not_evaluated(tmp_path):
    kept = np.delete(np.arange(600), [200, 201, 202, 500])
    lines = [f"{k / 200},{3 * k},{'OL' if k == 550 else 2 * k}" for k in kept]
    history = read_table(
        write(tmp_path, ["t_s,current_a,displacement_um", *lines]), TableSettings()
    ).history
    assert history.sample_rate_hz == pytest.approx(200.0)
    np.testing.assert_allclose(history.command, 3.0 * np.arange(600))
    np.testing.assert_allclose(history.displacement_um, 2.0 * np.arange(600))
    np.testing.assert_array_equal(history.held, [200, 201, 202, 500, 550])
    assert not history.evaluated()[[200, 203, 500, 550]].any()
    assert history.rows[[0, 199, 203, 499, 599]].tolist() == [1, 200, 201, 497, 596]
    late = read_table(tmp_path / "t.csv", TableSettings(first_row=101)).history.without_lag(2)
    assert late.rows[[0, 400]].tolist() == [103, 499]


def test_more_missing_rows_are_refused_with_the_first(tmp_path):
    lines = [f"{k / 200},{k % 50},{2 * k}" for k in range(600) if not 300 <= k < 310]
    path = write(tmp_path, ["t_s,current_a,displacement_um", *lines])
    rule = r"t\.csv:302: samples must be evenly spaced.* --set table\.last_row=300$"
    with pytest.raises(DataError, match=rule):
        read_table(path, TableSettings())
    assert read_table(path, TableSettings(last_row=300)).history.command.size == 300
    assert read_table(path, TableSettings(first_row=302)).history.command.size == 289


def test_faults_of_all_tables_are_named_before_a_fit(tmp_path):
    command = 5.0 * np.sin(0.02 * np.arange(3000))
    paths = []
    for name, fault in (("a", 0), ("b", 40), ("c", -40)):
        moved = 4.0 * command + np.where(np.arange(3000) < 900, fault, 0)
        lines = [f"{k / 500},{command[k]:.4f},{moved[k]:.4f}" for k in range(3000)]
        paths.append(write(tmp_path, ["t_s,drive_v,displacement_um", *lines], f"{name}.csv"))
    settings = settings_from("ppi", [])
    with pytest.raises(DataError) as caught:
        load_records(paths, settings, 0)
    first, second = str(caught.value).splitlines()
    for path, text in zip(paths[1:], (first, second), strict=True):
        assert text.startswith(f"{path}: ")
        assert text.endswith("1.8 s (row 901). Use the rows after it with --set table.ignore=900")
    confirmed = settings_from("ppi", ["table.ignore=900"])
    assert len(load_records(paths, confirmed, 0).records) == 3


@pytest.mark.parametrize(("bad", "rows"), [(10, 189), (190, 190)])
def test_the_setting_that_omits_an_invalid_row_works(tmp_path, bad, rows):
    lines = [f"{k / 200},{'OL' if k == bad else k % 50},{2 * k}" for k in range(200)]
    path = write(tmp_path, ["t_s,current_a,displacement_um", *lines, "Total,200,"])
    settings = {"last_row": 200}
    with pytest.raises(DataError, match=r"t\.csv:202: .* --set table\.last_row=200$"):
        read_table(path, TableSettings(first_row=100 if bad < 100 else 195))
    with pytest.raises(DataError) as caught:
        read_table(path, TableSettings(**settings))
    key, value = str(caught.value).rpartition("--set table.")[2].split("=")
    history = read_table(path, TableSettings(**settings | {key: int(value)})).history
    assert history.command.size == rows
