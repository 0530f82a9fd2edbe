"""Programs after a run: what they get, what becomes of them, and that they can't harm it."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.experiment.parts import EndCommand
from hilctl.run import end_commands as module
from hilctl.run.end_commands import SUFFIX, with_end_commands
from hilctl.run.result import RunResult
from tests.fakes import SteppingClock

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_compensated.mcap"


@pytest.fixture
def result(tmp_path):
    return RunResult(tmp_path / "run.mcap", "stopped", "by hand", "confirmed", 15, 90, 2, 1)


def ended(result, *commands, timeout_s=120.0):
    """Run shell lines, or what is no text as it is; return the result."""
    lists = [("sh", "-c", each) if isinstance(each, str) else each for each in commands]
    wanted = tuple(EndCommand(command=each, timeout_s=timeout_s) for each in lists)
    config = SimpleNamespace(on_end=wanted, name="told")
    loaded = SimpleNamespace(config=config, folder=result.path.parent)
    return with_end_commands(result, loaded, SteppingClock(0.5))


def test_each_gets_the_result_and_its_exit_code_is_kept(result, tmp_path):
    """In order, whatever became of the one before; the figures are those of the recording."""
    result = replace(result, path=tmp_path / "run.mcap")
    result.path.write_bytes(GOLDEN.read_bytes())
    one, two = tmp_path / "one", tmp_path / "two"
    found = ended(result, f"cat > {one}; echo a; echo went wrong >&2; exit 3", f"cat > {two}")
    first, second = found.on_end
    assert (first.exit_code, first.error, first.took_s) == (3, "went wrong", 0.5)
    assert (second.exit_code, second.error) == (0, "")
    given = json.loads(two.read_text())
    assert one.read_text() == two.read_text()
    assert (given["experiment"], given["code"], given["output_safe"]) == ("told", "stopped", True)
    assert (given["output"], given["recorded_samples"]) == (str(result.path), 90)
    assert isinstance(given["figures"], dict)
    beside = json.loads((tmp_path / f"run{SUFFIX}").read_text())
    assert beside["recording"] == "run.mcap"
    assert [each["exit_code"] for each in beside["on_end"]] == [3, 0]
    assert replace(found, on_end=()) == result


def test_nothing_reads_them_but_the_program(result, tmp_path):
    """No shell: what stands in an argument is an argument."""
    listed = tmp_path / "arguments"
    script = tmp_path / "tell"
    script.write_text(f"#!/bin/sh\nprintf '%s|' \"$@\" > {listed}\n")
    script.chmod(0o755)
    assert ended(result, ("./tell", "$HOME", "a; b", "*")).on_end[0].exit_code == 0
    assert listed.read_text() == "$HOME|a; b|*|"


def test_one_that_does_not_end_is_killed_with_all_it_has_started(result, tmp_path):
    """And one that does not read is no error."""
    number = tmp_path / "number"
    found = ended(result, f"sleep 60 & echo $! > {number}; wait", "exit 0", timeout_s=0.3)
    assert (found.on_end[0].exit_code, found.on_end[0].error) == (-9, "killed after 0.3 s")
    assert found.on_end[1].exit_code == 0
    state = Path(f"/proc/{number.read_text().strip()}/stat")
    assert not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z"


def test_one_that_is_gone_or_can_not_be_started_is_said(result, tmp_path):
    script = tmp_path / "bad"
    script.write_text("no program at all")
    script.chmod(0o755)
    gone, bad, silent = ended(result, ("no-such-program",), ("./bad",), "exit 1").on_end
    assert (gone.exit_code, gone.error) == (None, "it is not there any more")
    assert (bad.exit_code, bad.error) == (None, "Exec format error")
    assert (silent.exit_code, silent.error) == (1, "it said nothing")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_impatient_user_ends_the_wait_and_keeps_the_result(result, number):
    # Where the tests run in the background, a shell has had SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    before = signal.getsignal(number)
    found = ended(result, f"sleep 0.5; kill -{number.name[3:]} {os.getpid()}; sleep 60", "exit 0")
    assert [(each.exit_code, each.error) for each in found.on_end] == [(None, "interrupted")] * 2
    assert signal.getsignal(number) == before
    assert found.code == "stopped"


def test_where_nothing_can_be_written_it_says_so(result):
    found = ended(replace(result, path=Path("/proc/run.mcap")), "exit 0")
    assert found.on_end[0].exit_code == 0
    assert f"run{SUFFIX}" in found.on_end[0].error


def test_what_it_says_is_cut_and_steers_no_terminal(result):
    long = "yes | head -c 100000 | tr -d '\\n'; printf '\\033[2J'; exit 1"
    (found,) = ended(result, long).on_end
    assert len(found.error) <= module._SAID + 10
    assert found.error.endswith("\\x1b[2J")


def test_without_any_nothing_is_written(result, tmp_path):
    assert ended(result) is result
    assert list(tmp_path.iterdir()) == []
