"""Live views of runs: ``hilctl watch`` without a run, ``hilctl live`` without its server."""

import os
import pty
import select
import sys
import termios
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from rich.text import Text

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import Event
from hilctl.cli import live as module
from hilctl.cli.console import print_rich
from hilctl.cli.live import View, print_lines
from hilctl.run.run_folder import run_folder


class FakeFeed:
    """A run that ends after some polls."""

    def __init__(self, polls=10**9, inverse="in", axis=""):
        self.folder, self.inverse, self.loop_input = "folder", inverse, "reference"
        self.axis = axis
        self.state, self.ended, self._polls = "running", False, polls
        self.description = SimpleNamespace(
            command_unit="A", sample_rate_hz=1000.0, coupled=axis == "coupled"
        )
        self.events = [Event(1000 * k, "info", "mark", f"tap {k}") for k in range(5)]
        self.values = {
            "run": "demo-7", "state": "running", "reason": "", "t_s": 12.34, "total_s": 30.0,
            "inverse": inverse, "gain": 0.7, "offset": -2.0,
            "figures": {"peak_hysteresis_percent": 29.6, "rms_error_percent": None},
            "aux": [{"name": "coil_c", "unit": "°C", "value": 41.26}],
            "lateness_us": {"p50": 3.0, "p99": 21.0, "max": 40.0}, "late_ticks": 9,
            "gauges": [{"name": "command", "used": 0.84}],
        }  # fmt: skip

    def status(self):
        return self.values

    def poll(self, now_s):
        self._polls -= 1
        self.ended = self._polls <= 0

    def events_since(self, seen):
        return self.events[seen:], len(self.events)


@pytest.fixture
def sent(monkeypatch):
    """Requests to the run, each made in the thread of the test."""
    asked = []

    def set_run(folder, **wanted):
        asked.append(wanted)
        if wanted.get("gain", 0.0) > 1.0:
            raise InputError("set: too much")
        return wanted

    for name, value in {
        "set_run": set_run,
        "mark_run": lambda folder, text: asked.append(text) or {"x": 1},
        "request_stop": lambda folder: asked.append("stop") or True,
        "threading.Thread": lambda target, daemon: SimpleNamespace(start=target),
    }.items():
        monkeypatch.setattr(f"hilctl.cli.live.{name}", value)
    return asked


def shown(view, capsys, height=9):
    print_rich(view.screen(height))
    return capsys.readouterr().out


@pytest.mark.parametrize(("key", "inverse", "wanted"), [
    (b"i", "in", {"inverse": "out", "over_s": 0.5}),
    (b"i", "out", {"inverse": "in", "over_s": 0.5}),
    (b"+", "in", {"gain": 0.8, "over_s": 0.5}),
    (b"-", "in", {"gain": 0.6, "over_s": 0.5}),
    (b"s", "in", "stop"),
])  # fmt: skip
def test_key_sends_one_request(sent, key, inverse, wanted):
    view = View(FakeFeed(inverse=inverse))
    view.press(key)
    assert sent == [wanted]
    assert view.message.endswith(": done")


def test_keys_change_the_axis_shown(sent, capsys):
    view = View(FakeFeed(axis="x"), FakeFeed(axis="y"))
    view.press(b"+a-a")
    assert [each["axes"] for each in sent] == [{"x": {"gain": 0.8}}, {"y": {"gain": 0.6}}]
    assert view.feed.axis == "x"
    View(FakeFeed(axis="coupled")).press(b"+")
    assert sent[2:] == [{"gain": 0.8, "over_s": 0.5}]
    assert "a axis" in shown(view, capsys)


def test_refused_request_is_shown(sent, monkeypatch, capsys):
    feed = FakeFeed()
    feed.values["gain"] = 1.0
    view = View(feed)
    view.press(b"+")
    assert "set: too much" in shown(view, capsys)

    def refuse(folder):
        raise RunError("no right")

    monkeypatch.setattr(module, "request_stop", refuse)
    view.press(b"s")
    assert "no right" in view.message


def test_slow_change_does_not_delay_a_stop(monkeypatch):
    started = []
    view = View(FakeFeed())

    def thread(target, daemon):
        return SimpleNamespace(start=lambda: started.append(target))

    monkeypatch.setattr(module.threading, "Thread", thread)
    monkeypatch.setattr(module, "request_stop", lambda folder: False)
    view.press(b"is")
    assert len(started) == 2
    started[1]()
    assert "ended" in view.message


def test_letters_of_a_mark_are_not_keys(sent, capsys):
    view = View(FakeFeed())
    view.press(b"mtaqs\x7f\x07")
    assert "mark: taq_" in shown(view, capsys)
    view.press(b"\r")
    view.press(b"mqsi")
    view.press(b"\x1b")
    view.press(b"m  \r")
    view.press("mµ\n".encode())
    assert sent == ["taq", "µ"]
    assert not view.left


def test_arrows_and_unknown_keys_do_nothing(sent):
    view = View(FakeFeed())
    for raw in (b"\x1b[A", b"z", b"\xff"):
        view.press(raw)
    assert (sent, view.left, view.message) == ([], False, "")
    view.press(b"\x1b[A\x1bOB\x1b[3~sq")
    assert (sent, view.left) == (["stop"], True)


@pytest.mark.parametrize(("height", "events"), [(5, 1), (7, 1), (9, 3), (24, 5)])
def test_screen_fits_the_terminal(height, events, capsys):
    view = View(FakeFeed())
    view.message = "x" * 200
    lines = shown(view, capsys, height).splitlines()
    assert len(lines) == max(7, height)
    assert sum(" mark: tap" in line for line in lines) == events


def test_the_screen_has_state_limits_figures_and_the_newest_events(capsys):
    text = shown(View(FakeFeed()), capsys)
    values = "demo-7|running|12.3/30.0 s|gain 0.7|offset -2|29.60 %|84 %|late ticks 9|21 us"
    for value in (*values.split("|"), "3.000 s  mark: tap 3", "tap 4"):
        assert value in text
    assert "tap 1" not in text


def test_control_characters_are_escaped(monkeypatch, capsys):
    monkeypatch.setattr(module.time, "sleep", lambda s: None)
    feed = FakeFeed(polls=3)
    feed.events = [Event(1500, "info", "mark", "tapped \x1b[2J")]
    feed.values["run"] = "demo\x07"
    view = View(feed)
    view.message = "refused: \x1b]0;x\x07"
    text = shown(view, capsys)
    print_lines(feed)
    text += capsys.readouterr().out
    assert not {"\x1b", "\x07"} & set(text)
    assert text.count("1.500 s  mark: tapped \\x1b[2J") == 2


def test_lines_show_each_event_once_and_the_state(monkeypatch, capsys):
    monkeypatch.setattr(module.time, "sleep", lambda s: None)
    print_lines(FakeFeed(polls=15))
    lines = capsys.readouterr().out.splitlines()
    marks = [f"{k}.000 s  mark: tap {k}" for k in range(5)]
    assert [line for line in lines if "mark" in line] == marks
    assert sum(line.startswith("12.3 s  running  hyst. 29.60 %") for line in lines) == 2


@pytest.fixture
def terminal(monkeypatch):
    """Make a pseudo terminal standard input and output; return the side of its user.

    To be called by the test: pytest replaces the standard streams before each.
    """
    user, ours = pty.openpty()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())

    def take():
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(sys, "stdout", stdout)
        return user

    with (
        os.fdopen(ours, encoding="utf-8", closefd=False) as stdin,
        os.fdopen(ours, "w", encoding="utf-8", closefd=False) as stdout,
    ):
        yield take
    os.close(ours)
    os.close(user)


@pytest.mark.parametrize("way_out", ["q", "end", KeyboardInterrupt, SystemExit, ValueError])
def test_terminal_is_restored_on_every_exit(terminal, monkeypatch, way_out):
    user = terminal()
    assert module._has_keys()
    before = termios.tcgetattr(sys.stdin.fileno())
    view = View(FakeFeed(polls=2 if way_out == "end" else 10**9))

    def screen(height):
        assert not termios.tcgetattr(sys.stdin.fileno())[3] & termios.ICANON
        if way_out == "q":
            os.write(user, b"q")
        elif way_out != "end":
            raise way_out
        return Text("shown")

    monkeypatch.setattr(view, "screen", screen)
    raised = () if isinstance(way_out, str) else way_out
    with pytest.raises(raised) if raised else nullcontext():
        view.show()
    sys.stdout.flush()
    text = ""
    while not text.endswith("\x1b[?1049l"):  # the kernel passes it on in parts
        assert select.select([user], [], [], 5.0)[0]
        text += os.read(user, 1000).decode(errors="replace")
    assert text.startswith("\x1b[?1049h")
    assert text.rindex("\x1b[?25l") < text.rindex("\x1b[?25h")
    assert termios.tcgetattr(sys.stdin.fileno()) == before


def test_lines_are_printed_in_the_background_and_without_a_terminal(terminal, monkeypatch):
    terminal()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    assert not module._has_keys()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
    monkeypatch.setenv("TERM", "dumb")
    assert not module._has_keys()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: False))
    assert not module._has_keys()


@pytest.fixture
def run(monkeypatch):
    """A run that is over, shown without a terminal by the subprocess of its supervisor 7."""
    made = SimpleNamespace(card=SimpleNamespace(name="demo-7", supervisor=7))
    made.description = SimpleNamespace(exists=lambda: True)
    made.feed = FakeFeed()
    made.feed.ended, made.feed.state = True, "stopped"
    made.feed.values["reason"] = "by hand"
    for name, value in {
        "find_run": lambda name: made,
        "active_runs": lambda: [made],
        "RunReader": lambda folder: made.feed,
        "print_lines": lambda feed: None,
        "signal.signal": lambda *given: None,
        "_has_keys": lambda: False,
        "os.getppid": lambda: 7,
        "time.sleep": lambda s: None,
        "sys.argv": ["watch", "7"],
    }.items():
        monkeypatch.setattr(f"hilctl.cli.live.{name}", value)
    return made


@pytest.fixture
def served(monkeypatch):
    """Replace the servers; return their arguments."""
    given = {}

    def serve(chosen, over, on_url, port, *, foxglove):
        given.update(chosen=chosen, over=over, port=port)
        on_url("ws://127.0.0.1:5" if foxglove else "http://127.0.0.1:5/#x")

    monkeypatch.setattr(module, "serve_runs", serve)
    return given


@pytest.mark.parametrize(("words", "port", "shown"), [
    (["--port", "0"], 0, "live page: http://127.0.0.1:5/#x"),
    (["--port", "5"], 5, "live page: http://127.0.0.1:5/#x"),
    (["--foxglove"], None, "Foxglove server: ws://127.0.0.1:5"),
    (["--foxglove", "--port", "0"], 0, "Foxglove server: ws://127.0.0.1:5"),
])  # fmt: skip
def test_server_is_started_and_its_address_printed(served, hilctl, words, port, shown):
    assert hilctl("live", *words)[1] == f"{shown}\n"
    assert served["port"] == port
    assert (served["chosen"]([]), served["chosen"](["a", "b"])) == (None, "a")
    assert not served["over"](None)


def test_server_of_a_run_ends_with_it(served, hilctl, tmp_path):
    nothing = SimpleNamespace(feed=lambda name: None)
    with run_folder("demo", {"": tmp_path / "a.mcap"}, 1.0) as (folder, _):
        assert hilctl("live", "x")[0] == 2
        assert hilctl("live", "de")[0] == 0
        assert served["chosen"]([]) == folder
        assert not served["over"](nothing)
    assert served["over"](nothing)
