"""Commands about runs: exit codes, and what programs read of them."""

import json
import signal
from pathlib import Path

import pytest
import typer

from hilctl.base.errors import InputError
from hilctl.cli.running import check, run, safe
from hilctl.run.by_hand import SafeResult
from hilctl.run.result import RunResult

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


@pytest.fixture
def ended(monkeypatch):
    """Let a run end at once, as told; collect what it was started with."""
    started = []

    def so(code, stop_signal=0):
        def start_run(experiment, settings, output, overwrite, on_progress):
            started.append((experiment, settings, output, overwrite))
            return RunResult(Path("no.mcap"), code, "because", "confirmed", stop_signal, 0, 0, 0)

        monkeypatch.setattr("hilctl.run.start.start_run", start_run)
        monkeypatch.setattr("hilctl.cli.run_view.report_of", lambda result, *, whole: None)
        return started

    return so


@pytest.mark.parametrize(
    ("code", "stop_signal", "exit_code"), [("fault", 0, 3), ("stopped", signal.SIGTERM, 143)]
)
def test_a_run_that_did_not_complete_says_so_by_its_exit_code(ended, code, stop_signal, exit_code):
    before = signal.getsignal(signal.SIGTERM)
    ended(code, stop_signal)
    try:
        with pytest.raises(typer.Exit) as left:
            run(DEMO, as_json=True)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert left.value.exit_code == exit_code


def test_require_rt_is_one_more_setting(ended, capsys):
    """Behind those that were given, which it goes before."""
    started = ended("completed")
    run(DEMO, settings=["block=25"], require_rt=True, as_json=True)
    assert started == [(DEMO, ["block=25", "realtime.require=true"], None, False)]
    assert json.loads(capsys.readouterr().out)["code"] == "completed"


def test_check_moves_nothing_and_says_what_would(capsys):
    check(DEMO, ["waveform.duration_s=1.0"], as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["experiment"] == str(DEMO)
    assert printed["samples"] == 50_000


@pytest.mark.parametrize("as_json", [True, False])
def test_an_output_that_is_not_known_to_be_safe_is_an_error(monkeypatch, capsys, as_json):
    """Exit code 3, as after a run."""
    put = SafeResult("a device", 0.0, "A", "unknown", "no answer")
    monkeypatch.setattr("hilctl.run.by_hand.put_safe", lambda path, settings: put)
    with pytest.raises(typer.Exit) as left:
        safe(DEMO, as_json=as_json)
    assert left.value.exit_code == 3
    out, err = capsys.readouterr()
    assert "no answer" in (out if as_json else err)
    assert not as_json or json.loads(out)["output_safe"] is False


def test_a_confirmed_safe_value_is_said(monkeypatch, capsys):
    put = SafeResult("a device", 0.25, "A", "confirmed", "")
    monkeypatch.setattr("hilctl.run.by_hand.put_safe", lambda path, settings: put)
    safe(DEMO)
    assert "0.25 A" in capsys.readouterr().out


def test_an_address_with_its_token_goes_into_no_log():
    """That of a run in the background may be read by others."""
    with pytest.raises(InputError, match="hilctl live"):
        run(DEMO, detach=True, live=True)
