"""A run in a terminal whose user presses Ctrl-Z, or starts it in the background of the shell."""

import os
import pty
import select
import signal
import sys
import time

import pytest
import yaml

from hilctl.recording.reader import read
from tests.faults.test_daemon import EXPERIMENT, await_state, hilctl


class Shell:
    """An interactive shell with job control, on a terminal of its own."""

    def __init__(self):
        self.process, self.terminal = pty.fork()
        if self.process == 0:
            os.execvp("bash", ["bash", "--norc", "-i"])
        self.text = ""

    def type(self, text):
        os.write(self.terminal, text.encode())

    def read(self, wait_s=0.0):
        while select.select([self.terminal], [], [], wait_s)[0]:
            try:
                self.text += os.read(self.terminal, 65536).decode(errors="replace")
            except OSError:
                break
        return self.text

    def await_text(self, text):
        deadline = time.monotonic() + 120.0
        while text not in self.read(0.05):
            assert time.monotonic() < deadline, self.text

    def await_end(self):
        """Wait until the commands in the background have ended."""
        self.type("wait; echo no''jobs\n")
        self.await_text("nojobs\r\n")

    def close(self):
        os.kill(self.process, signal.SIGHUP)
        os.close(self.terminal)
        os.waitpid(self.process, 0)


@pytest.fixture
def shell(tmp_path):
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(EXPERIMENT), encoding="utf-8")
    made = Shell()
    made.type(f"cd {tmp_path}; stty tostop\n")
    yield made
    for run in hilctl("status")["runs"]:
        hilctl("stop", "--run", run["name"])
    made.close()


def command(options=""):
    return f"{sys.executable} -m hilctl run run.yaml --output run.mcap {options}\n"


@pytest.mark.parametrize("option", [pytest.param("", marks=pytest.mark.long), "--watch"])
def test_ctrl_z_neither_suspends_a_run_nor_hides_how_to_end_it(shell, tmp_path, option):
    """The supervisor still sees requests, and makes changes."""
    shell.type(command(option))
    await_state("running")
    shell.type("\x1a")
    shell.await_text("Ctrl-Z")
    assert await_state("running")
    assert hilctl("set", "gain=0.5", "--over", "0.1")["gain"] == 0.5
    assert hilctl("stop", "--wait", "30")["ended"]
    assert read(tmp_path / "run.mcap").end["code"] == "stopped"


@pytest.mark.parametrize("option", [pytest.param("&", marks=pytest.mark.long), "--watch &"])
def test_a_run_in_the_background_of_the_shell_does_not_freeze(shell, tmp_path, option):
    """It does not take the terminal from the shell."""
    shell.type(command(option))
    first = await_state("running")
    shell.type("echo sh''ell\n")
    shell.await_text("shell")
    deadline = time.monotonic() + 30.0
    while await_state("running")["sample"] <= first["sample"]:
        assert time.monotonic() < deadline
    assert hilctl("stop", "--wait", "30")["ended"]
    assert read(tmp_path / "run.mcap").end["code"] == "stopped"
    shell.await_end()


def test_several_runs_in_the_background_of_the_shell_do_not_freeze(shell, tmp_path):
    """The command writes its progress before the first run, and between them."""
    words = f"run.yaml --output {tmp_path}/model.yaml --folder {tmp_path}/runs"
    shell.type(f"{sys.executable} -m hilctl characterise {words} &\n")
    await_state("running")
    assert hilctl("stop", "--wait", "30")["ended"]
    shell.await_end()
