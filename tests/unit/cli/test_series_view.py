"""Many runs in a terminal: what came out first, then a table, then the files."""

from hilctl.cli.console import print_rich
from hilctl.cli.series_view import render_series
from hilctl.series.collect import RunSeries
from tests.unit.series.conftest import grown


def test_what_could_not_be_read_is_said_and_nothing_steers_the_terminal(capsys):
    runs = (grown(3.0, 10.0), grown(3.0, 100.0, 2))
    missing = ("lost.mcap: \x1b[2J[bold]no such file",)
    print_rich(render_series(RunSeries("[red]two", runs, ("waveform.frequency_hz",), missing)))
    shown = capsys.readouterr().out
    assert shown.startswith("2 runs")
    assert "[red]two" in shown
    assert "not read: lost.mcap: \\x1b[2J[bold]no such file" in shown
    assert "\x1b[2J" not in shown
    assert [line.split(":")[0] for line in shown.splitlines()[-2:]] == ["1", "2"]
