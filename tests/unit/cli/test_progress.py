"""The bar of progress: for people at a terminal only."""

import io
import threading

import pytest

from hilctl.cli.progress import shown_progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("quiet", "stream"), [(True, Terminal()), (False, io.StringIO())])
def test_nothing_is_shown_to_programs(monkeypatch, quiet, stream):
    """Neither where output is JSON, nor where standard error is a file."""
    monkeypatch.setattr("sys.stderr", stream)
    with shown_progress("identify", quiet=quiet) as report:
        report(0.5, "half")
    assert stream.getvalue().strip() == ""


def test_a_terminal_sees_what_is_done(monkeypatch):
    """The text of the last report, on standard error."""
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    threads = threading.active_count()
    with shown_progress("identify", quiet=False) as report:
        report(0.5, "following 3 starts")
        assert threading.active_count() == threads
    assert "following 3 starts" in stream.getvalue()
