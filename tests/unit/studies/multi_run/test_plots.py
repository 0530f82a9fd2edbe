"""Which figures apply."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilctl.base.errors import InputError
from hilctl.studies.characterise.response import SmallSignal
from hilctl.studies.multi_run.collect import RunSeries
from hilctl.studies.multi_run.plots import (
    applying_sheets,
    frequency_sheet,
    sheets_of,
    step_sheet,
    write_sheets,
)


def test_they_are_found_from_what_varied(crossed, compensated):
    assert [sheet.name for sheet in sheets_of(crossed)] == [
        "hysteresis_against_frequency",
        "hysteresis_against_amplitude",
        "loops_by_frequency",
        "loops_by_amplitude",
        "sensitivity",
    ]
    assert [sheet.name for sheet in sheets_of(compensated)] == [
        "before_and_after",
        "hysteresis_against_frequency",
        "compensation_against_frequency",
        "loops_by_frequency",
        "error_history",
    ]


def test_nothing_run_draws_nothing(crossed):
    planned = tuple(replace(run, result="planned", digest=None) for run in crossed.runs)
    assert sheets_of(replace(crossed, runs=planned)) == []


def drawn(panel):
    axes = Figure().subplots()
    panel.draw(axes)
    return axes


def series(run):
    return RunSeries("loads", (run,), ("waveform.amplitude",))


def test_a_step_with_its_resonance(make_run, make_digest):
    t = np.linspace(0.0, 0.01, 50)
    run = make_run(1.0, 10.0, digest=make_digest(step=np.array((t, np.sin(t)))))
    run = replace(run, figures=replace(run.figures, natural_hz=469.5, damping_ratio=0.12))
    axes = drawn(step_sheet(series(run)).panels[0])
    assert axes.lines[0].get_xdata()[-1] == 10.0
    assert axes.get_xlabel() == "time after the step, ms"
    assert axes.texts[0].get_text() == "470 Hz, damping ratio 0.120"


def test_magnitude_and_phase_measured_and_fitted(make_run, make_digest):
    frequency_hz = np.array([10.0, 100.0, 1000.0])
    answer = 4.0 / (1.0 + 1j * frequency_hz / 100.0)
    small = SmallSignal(frequency_hz, answer, np.full(3, 0.1), 1.0, 4.0, 0.0, 0.0, None, None, 1.0,
                        answer)  # fmt: skip
    run = make_run(1.0, 10.0, digest=make_digest(response=small))
    magnitude, phase = map(drawn, frequency_sheet(series(run)).panels)
    assert magnitude.get_ylabel() == "magnitude, µm/A"
    assert np.allclose(magnitude.lines[0].get_ydata(), np.abs(answer))
    assert np.allclose(phase.lines[1].get_ydata()[1], -45.0)


def test_runs_without_either_have_none(crossed):
    assert step_sheet(crossed) is None
    assert frequency_sheet(crossed) is None


@pytest.mark.slow
def test_each_figure_is_a_file_of_each_format(crossed, tmp_path):
    few = replace(crossed, runs=crossed.runs[:3])
    folder = tmp_path / "figures"
    written = write_sheets(applying_sheets(few), folder, ["svg"], "single", overwrite=False)
    assert [path.name for path in written] == [
        "hysteresis_against_frequency.svg",
        "loops_by_frequency.svg",
    ]
    assert all(path.is_file() for path in written)
    assert all(caption.endswith(".") for caption in written.values())
    with pytest.raises(InputError, match="exists already"):
        write_sheets(applying_sheets(few), folder, ["svg"], "single", overwrite=False)


def test_no_figure_is_refused(crossed):
    nothing = replace(crossed, runs=())
    with pytest.raises(InputError, match="no completed run"):
        applying_sheets(nothing)
