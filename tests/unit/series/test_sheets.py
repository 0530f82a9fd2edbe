"""Which figures apply."""

from dataclasses import replace

from hilctl.series.sheets import sheets_of


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
