"""Standard streams: verbosity, escaped control characters, closed pipes; JSON."""

import errno
import io
import json
import logging
import os
import subprocess
import sys

import pytest

from hilctl import cli
from hilctl.base.errors import InputError
from hilctl.cli import output

HOSTILE = "a\x1b]0;title\x07b\x9b2Jc\rd\x7fe\u202ef"
SHOWN = r"a\x1b]0;title\x07b\x9b2Jc\rd\x7fe\u202ef"


def test_escaped_and_styled_text_stay_in_order():
    target = io.BytesIO()
    below = io.TextIOWrapper(target, encoding="ascii")
    stream = output.SafeStream(below)
    print("one\x1b", file=stream)
    stream.styled.write("\x1b[1mtwo\x1b[0m\n")
    print("40 µm", file=stream)
    assert stream.close_wrapper() is None
    assert target.getvalue() == b"one\\x1b\n\x1b[1mtwo\x1b[0m\n40 \\xb5m\n"


def test_closed_pipe_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as below:
        stream = output.StandardStream(below)
        for _ in range(3):
            assert stream.write("x" * 100_000) == 100_000
            stream.flush()
        stream.detach()
        assert stream.failure is not None
        assert stream.failure.errno == errno.EPIPE


def in_a_process(code, shell):
    command = ["sh", "-c", f'exec "$0" -c "$1" {shell}', sys.executable, code]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


PRINTING = "from hilctl.cli.output import safe_streams\nwith safe_streams():\n    print('µ' * 9)"


@pytest.mark.parametrize(
    ("acts", "code", "exit_code"), [(False, 0, 3), (False, 2, 2), (True, 0, 0), (True, 130, 130)]
)
def test_lost_output_changes_success_of_commands_that_do_not_act(acts, code, exit_code):
    printing = PRINTING.replace("safe_streams()", f"safe_streams(acts={acts})")
    ended = in_a_process(f"{printing}\n    raise SystemExit({code})", "> /dev/full")
    assert ended.returncode == exit_code
    assert "No space left" in ended.stderr


def test_reader_that_closes_early_is_no_error():
    assert in_a_process(f"{PRINTING}\n    print('x' * 10**6)", "| head -c 2").stderr == ""


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_closed_descriptor_is_not_reused_by_a_file(closed):
    """Otherwise a recording could become the standard output of other processes."""
    code = """
import os, sys
from hilctl.cli.output import safe_streams
with safe_streams():
    print("out"), print("err", file=sys.stderr)
    opened = os.open("/dev/null", os.O_RDONLY)
raise SystemExit(0 if opened > 2 else 1)
"""
    assert in_a_process(code, closed).returncode == 0


def test_json_is_one_object_without_nan(capsys):
    output.print_json({"gain": 0.5, "names": ["a"]})
    assert json.loads(capsys.readouterr().out) == {"gain": 0.5, "names": ["a"]}
    output.print_json({"gain": float("nan"), "largest": [float("inf")]})
    assert json.loads(capsys.readouterr().out) == {"gain": None, "largest": [None]}


@pytest.fixture(autouse=True)
def restored_settings():
    logger = logging.getLogger("hilctl")
    level, handlers = logger.level, logger.handlers[:]
    yield
    output.Verbosity.quiet = output.Verbosity.verbose = False
    logger.setLevel(level)
    logger.handlers[:] = handlers


@pytest.mark.parametrize(("words", "left", "quiet", "verbose"), [
    ("hilctl run x.yaml", "hilctl run x.yaml", False, False),
    ("hilctl --quiet run x.yaml", "hilctl run x.yaml", True, False),
    ("hilctl run x.yaml --verbose --quiet", "hilctl run x.yaml", True, True),
    ("hilctl run -- --quiet", "hilctl run -- --quiet", False, False),
    ("--quiet run", "--quiet run", False, False),
])  # fmt: skip
def test_options_are_accepted_anywhere(words, left, quiet, verbose):
    given = words.split()
    output.take_verbosity(given)
    assert given == left.split()
    assert (output.Verbosity.quiet, output.Verbosity.verbose) == (quiet, verbose)


def talks():
    print("a table")
    logging.getLogger("hilctl.x").warning("mind")
    logging.getLogger("hilctl.x").info("detail")


def test_quiet_prints_warnings_only(monkeypatch, hilctl, capsys):
    monkeypatch.setattr(cli, "_run_app", talks)
    assert hilctl() == (0, "a table\n", "hilctl: mind\n")
    assert hilctl("--quiet") == (0, "", "hilctl: mind\n")
    assert hilctl("--quiet", "--json")[1] == "a table\n"
    print("again")
    assert capsys.readouterr().out == "again\n"


def refuses():
    raise InputError("no")


def test_verbose_prints_the_traceback(monkeypatch, hilctl):
    monkeypatch.setattr(cli, "_run_app", refuses)
    assert hilctl("--quiet") == (2, "", "hilctl: no\n")
    code, out, err = hilctl("--verbose")
    assert (code, out) == (2, "")
    assert "in refuses" in err
    assert err.endswith("hilctl: no\n")
    monkeypatch.setattr(cli, "_run_app", talks)
    assert " INFO hilctl.x: detail\n" in hilctl("--verbose")[2]
