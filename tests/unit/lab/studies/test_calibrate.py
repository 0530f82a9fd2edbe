"""Fits of sensor and amplifier."""

from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.calibration import CalibrationFile
from hilctl.base.errors import DataError, InputError, RunError
from hilctl.base.yaml import load_document
from hilctl.lab.studies import study
from hilctl.lab.studies.calibrate import (
    Origin,
    SensorPoints,
    existing_calibration,
    fit_sensor,
    measure_amplifier,
    sensor_points,
    write_calibration,
)
from hilctl.lab.studies.study import StudyHost, run_study
from hilctl.recording.reader import read
from hilctl.run.start import unpaced

HOST = StudyHost(run=unpaced, real_time=False)
ORIGIN = Origin(date(2026, 1, 31), "N. N.", "interferometer")
RIG = Path(__file__).parents[4] / "configs" / "terfenol_sine_6a.yaml"
TRUE = np.linspace(-100.0, 100.0, 21)


def s_shaped(true):
    """Return readings that err by up to 1.5 % of a range of 250 um."""
    share = true / 125.0
    return true + 3.75 * 1.5 * 3**0.5 * (share - share**3)


def linear(true):
    return 1.02 * true + 3.0


def waved(true):
    return true + 2.0 * np.sin(0.1 * true)


def pairs(reading, true):
    """Return points of rising reading, in lines from 2 on."""
    return SensorPoints(Path("pairs.csv"), reading, true, 2 + np.arange(reading.size))


def errors(fit, reading_of):
    """Return the rms and the largest error of corrected readings, in percent of their range."""
    fine = np.linspace(-100.0, 100.0, 1001)
    curve = fit.fitted.curve(-200.0, 200.0)
    left = (np.interp(reading_of(fine), *curve) - fine) / 2.0
    return np.sqrt(np.mean(left**2)), np.abs(left).max()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("reading_of", "orders"), [(linear, {1, 2}), (s_shaped, {3, 4})])
def test_the_lowest_order_that_the_noise_supports_is_chosen(reading_of, orders, seed):
    noise = np.random.default_rng(seed).normal(0.0, 0.0355, TRUE.size)
    fit = fit_sensor(pairs(reading_of(TRUE) + noise, TRUE), ORIGIN)
    assert len(fit.fitted.polynomial) - 1 in orders
    assert fit.fitted.residual_rms < 0.05e-2 * 200.0
    rms, largest = errors(fit, reading_of)
    assert rms < 0.05
    assert largest < 0.1


@pytest.mark.parametrize("points", [3, 4, 21])
def test_exact_points_of_a_line_give_a_line(points):
    true = np.linspace(-100.0, 100.0, points)
    fit = fit_sensor(pairs(linear(true), true), ORIGIN)
    assert len(fit.fitted.polynomial) == 2
    assert max(errors(fit, linear)) < 1e-6


def test_a_table_where_no_polynomial_fits():
    true = np.repeat(np.linspace(-100.0, 100.0, 81), 2)
    fit = fit_sensor(pairs(waved(true), true), ORIGIN)
    assert len(fit.fitted.table) == 81
    assert max(errors(fit, waved)) < 0.1


@pytest.mark.parametrize("factor", [-1.0, 0.4, 1000.0])
def test_a_falling_curve_and_another_unit_are_refused(factor):
    with pytest.raises(DataError, match=r"device\.sensor"):
        fit_sensor(pairs(TRUE, factor * TRUE), ORIGIN)


def test_units_of_columns_are_converted(tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text("true [mm],x,reading_um\n0.002,0,3\n0,0,1\n0.001,0,2\n")
    found = sensor_points(path, "reading_um", 1)
    assert found.reading.tolist() == [1.0, 2.0, 3.0]
    assert found.true == pytest.approx([0.0, 1.0, 2.0])
    assert found.lines.tolist() == [3, 4, 2]


def sensor_table(tmp_path, head):
    path = tmp_path / "pairs.csv"
    path.write_text(f"{head}\n1,2,4\n2,4,8\n3,6,12\n")
    return path


@pytest.mark.parametrize(("head", "asked", "factor"), [
    ("no,reading_um,true_um", (None, None), 2.0),
    ("no,true displacement [um],Sensor reading (um)", (None, None), 0.5),
    ("reference,no,indicated", (None, None), 0.25),
    ("a,b,c", (2, "c"), 2.0),
    ("true,reading,c", (2, 3), 2.0),
    ("true,reading,c", ("reading", None), 0.5),
])  # fmt: skip
def test_columns_are_known_by_a_word_of_their_names_or_are_set(tmp_path, head, asked, factor):
    found = sensor_points(sensor_table(tmp_path, head), *asked)
    assert found.true.tolist() == (factor * found.reading).tolist()


@pytest.mark.parametrize(("head", "asked"), [
    ("1,2,3", (None, None)),
    ("no,x,y", (None, None)),
    ("no,reading,y", (None, None)),
    ("reading,true,sensor", (None, None)),
    ("no,reading,true reading", (None, None)),
    ("no,reading,true", (3, None)),
    ("no,reading,true", (2, 2)),
])  # fmt: skip
def test_columns_in_doubt_are_refused_with_the_options_that_set_them(tmp_path, head, asked):
    with pytest.raises(DataError) as caught:
        sensor_points(sensor_table(tmp_path, head), *asked)
    assert all(f"--{each}-column" in str(caught.value) for each in ("reading", "true"))


@pytest.mark.parametrize("reading_of", [linear, s_shaped])
@pytest.mark.parametrize("mistyped", [{0: 9.0}, {9: 9.0}, {9: 9.0, 10: -8.0}, {3: 3.0, 20: 30.0}])
def test_points_off_the_curve_of_the_others_are_refused_with_their_lines(reading_of, mistyped):
    true = TRUE.copy()
    true[list(mistyped)] += list(mistyped.values())
    with pytest.raises(DataError) as caught:
        fit_sensor(pairs(reading_of(TRUE), true), ORIGIN)
    problems = sorted(str(caught.value).splitlines(), key=lambda line: int(line.split(":")[1]))
    assert [int(each.split(":")[1]) - 2 for each in problems] == list(mistyped)
    for each, (at, off) in zip(problems, mistyped.items(), strict=True):
        assert f"{true[at]:g} µm" in each
        assert float(each.split(" is ")[1].split()[0]) == pytest.approx(off, rel=0.3)


def test_a_point_off_a_table_is_refused_with_its_line():
    true = np.repeat(np.linspace(-100.0, 100.0, 81), 2)
    reading, true[61] = waved(true), true[61] + 9.0
    with pytest.raises(DataError, match=r"pairs\.csv:63:"):
        fit_sensor(pairs(reading, true), ORIGIN)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("points", [3, 7, 21, 81])
@pytest.mark.parametrize(("noise_um", "grade"), [(0.02, "good"), (1.0, "usable"), (5.0, "poor")])
def test_noise_is_graded_and_has_no_outlier(noise_um, grade, points, seed):
    true = np.linspace(-100.0, 100.0, points)
    noise = noise_um * np.random.default_rng(seed).uniform(-1.7, 1.7, points)
    fitted = fit_sensor(pairs(true, linear(true) + noise), ORIGIN).fitted
    assert fitted.grade == grade or points < 21


def test_a_kink_is_no_outlier():
    assert fit_sensor(pairs(TRUE, np.where(TRUE < 0.0, TRUE, 1.2 * TRUE)), ORIGIN).fitted.table


@pytest.mark.parametrize("text", [
    "reading_v,true_um\n1,1\n2,2\n3,3\n",
    "reading_um,true_um\n1,1\n2,2\n2,3\n",
    "reading_um\n1\n2\n",
])  # fmt: skip
def test_an_unusable_table_is_refused(tmp_path, text):
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=r"pairs\.csv"):
        sensor_points(path, 1, 2)


def amplifier(tmp_path):
    slow = ("sample_rate_hz=1000", "block=10")
    return run_study(measure_amplifier(RIG, slow, "run", ORIGIN), tmp_path, HOST)


def spoiled(monkeypatch, gain, offset):
    def changed(path):
        recording = read(path)
        measured = gain * recording.samples.measured + offset
        return replace(recording, samples=replace(recording.samples, measured=measured))

    monkeypatch.setattr(study, "read", changed)


def test_gain_and_offset_of_the_read_back(tmp_path, monkeypatch):
    spoiled(monkeypatch, 1.03, 0.02)
    fit = amplifier(tmp_path)
    assert fit.fitted.gain == pytest.approx(1.03, abs=1e-3)
    assert fit.fitted.offset == pytest.approx(0.02, abs=1e-3)
    assert fit.fitted.range == pytest.approx((-0.707, 0.707))
    assert np.abs(read(tmp_path / "run.mcap").samples.command).max() == pytest.approx(0.707)
    assert fit.fitted.residual_max < 1e-3


@pytest.mark.parametrize(("gain", "offset"), [(-1.0, 0.0), (0.5, 0.0), (1.0, 2.0), (np.nan, 0.0)])
def test_a_read_back_without_the_command_is_refused(tmp_path, monkeypatch, gain, offset):
    spoiled(monkeypatch, gain, offset)
    with pytest.raises(RunError, match=r"device\.measure"):
        amplifier(tmp_path)


def test_a_device_that_does_not_measure_is_refused(tmp_path):
    rig = RIG.with_name("modbus_labjack_t7.yaml")
    with pytest.raises(InputError, match=r"device\.measure"):
        run_study(measure_amplifier(rig, (), "run", ORIGIN), tmp_path, HOST)
    assert not any(tmp_path.iterdir())


def test_a_file_keeps_its_other_part(tmp_path):
    path = tmp_path / "calibration.yaml"
    sensor = fit_sensor(pairs(linear(TRUE), TRUE), ORIGIN).fitted
    line = amplifier(tmp_path).fitted
    for part, fitted in (("sensor", sensor), ("amplifier", line)):
        before = existing_calibration(path, part, overwrite=False)
        write_calibration(path, fitted, before)
    content = load_document(path).validate(CalibrationFile)
    assert (content.sensor, content.amplifier) == (sensor, line)
    with pytest.raises(InputError, match=path.name):
        existing_calibration(path, "sensor", overwrite=False)
    assert existing_calibration(path, "sensor", overwrite=True) == content
