"""What dead runs left is put into their recordings, and logged; nothing is done where none died."""

from pathlib import Path
from types import SimpleNamespace

from hilctl.run.dead_runs import finish_dead_runs
from hilctl.run.orphans import RecoveredRun


def test_what_was_done_is_logged(monkeypatch, caplog):
    found = [RecoveredRun("sine-7", Path("a.mcap"), safe=False, text="supervisor and loop died")]
    monkeypatch.setattr("hilctl.run.orphans.recover_orphans", lambda: found)
    monkeypatch.setattr("hilctl.run.run_folder.runs", lambda: [SimpleNamespace(alive=True)])
    finish_dead_runs()
    assert caplog.messages == []
    monkeypatch.setattr("hilctl.run.run_folder.runs", lambda: [SimpleNamespace(alive=False)])
    finish_dead_runs()
    assert caplog.messages == [
        "sine-7 was not recorded to its end: supervisor and loop died",
        "recovered into a.mcap",
    ]


def test_a_run_that_never_started_is_one_line(monkeypatch, caplog):
    found = [RecoveredRun("sine-7", Path("a.mcap"), True, "nothing has moved", started=False)]
    monkeypatch.setattr("hilctl.run.orphans.recover_orphans", lambda: found)
    monkeypatch.setattr("hilctl.run.run_folder.runs", lambda: [SimpleNamespace(alive=False)])
    finish_dead_runs()
    assert len(caplog.messages) == 1
