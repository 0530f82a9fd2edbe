"""The table of commands, and what some of them import."""

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer

from hilctl import __version__
from hilctl.base.errors import InputError
from hilctl.cli.commands import COMMANDS, app, load

RECORDING = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"
MAIN = "from hilctl.cli import main; main()"
THREADS = "OPENBLAS_NUM_THREADS"


def in_a_process(code, *arguments, **environment):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True, text=True, timeout=120, env={**os.environ, **environment},
    )  # fmt: skip


@pytest.mark.parametrize("module", ["hilctl_absent.command", "hilctl.cli.devices"])
def test_missing_command_is_an_input_error(module, monkeypatch):
    monkeypatch.setitem(COMMANDS, "emulate", module)
    with pytest.raises(InputError, match="emulate"):
        load("emulate")


def test_help_is_a_command_as_well():
    shown = in_a_process(MAIN, "help", "devices", "probe")
    assert shown.returncode == 0
    assert shown.stdout == in_a_process(MAIN, "devices", "probe", "--help").stdout


def test_a_clock_that_python_cannot_read_is_one_message():
    code = f"import time\ndef far(): raise OverflowError\ntime.time = far\n{MAIN}"
    ended = in_a_process(code, "list")
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert ended.stderr.startswith("hilctl: ")


@pytest.mark.parametrize(("own", "expected"), [("", "1"), ("3", "3")])
def test_a_command_has_one_blas_thread_unless_set(own, expected):
    code = f"from hilctl import cli\nimport os\nif not {own!r}: os.environ.pop({THREADS!r})\n"
    code += f"cli._run_app = lambda: print(os.environ[{THREADS!r}])\ncli.main()"
    assert in_a_process(code, "list", **{THREADS: own}).stdout.split() == [expected]


def test_similar_command_is_suggested():
    ended = in_a_process(MAIN, "stauts")
    assert "'status'" in ended.stderr


def completing(words):
    """Return the environment in which bash asks for the last of some words."""
    words = words.split(" ")
    return {
        "_HILCTL_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }


@pytest.mark.parametrize(("words", "some"), [
    ("report --", {"--html", "--from", "--json", "--help"}),
    ("stop --", {"--all", "--wait", "--run"}),
    ("stop --run ", {"rig-1"}),
    ("devices show lab", {"labjack_t7"}),
    ("init sim", {"simulated_piezo"}),
    ("init kepco_bop --reader ag", {"agilent_34970a"}),
    ("emulate wag", {"wago_750"}),
    ("examples models/", {"models/piezo_ppi"}),
    ("identify x.mcap --model f", {"field"}),
    ("identify x.mcap --set table.u", {"table.unit="}),
    ("report ", {"recordings/day/a.mcap"}),
    ("run x.yaml --set limits.d", {"limits.drive_a=", "limits.drive_v="}),
    ("run x.yaml --set waveform.freq", {"waveform.frequency_hz="}),
    ("check x.yaml --set device.h", {"device.host="}),
    ("sweep x.yaml --vary samp", {"sample_rate_hz="}),
    ("run xy.yaml --set axis", {"axis=x", "axis=y"}),
    ("run xy.yaml --set block=5 --set axes.y.waveform.ph", {"axes.y.waveform.phase_deg="}),
])  # fmt: skip
def test_shell_completes_options_and_values(words, some, tmp_path, monkeypatch, hilctl):
    monkeypatch.chdir(tmp_path)
    day = tmp_path / "recordings" / "day"
    day.mkdir(parents=True)
    (day / "a.mcap").touch()
    (tmp_path / "xy.yaml").write_text("axes: {x: {}, y: {}}", encoding="utf-8")
    load(words.split(" ")[0])  # it must not import the fake run for all later tests
    card = SimpleNamespace(name="rig-1", experiment="rig.yaml")
    monkeypatch.setattr("hilctl.run.run_folder.runs", lambda: [SimpleNamespace(card=card)])
    monkeypatch.setattr(sys.modules["__main__"], "__package__", "")  # also by python -m pytest
    for name, value in completing(f"hilctl {words}").items():
        monkeypatch.setenv(name, value)
    code, out, err = hilctl()
    assert code == 0, err
    assert set(out.split()) >= some


@pytest.mark.parametrize(("words", "environment"), [
    (["--help"], {}),
    (["status"], {}),
    (["stop", "--all"], {}),
    (["report", str(RECORDING), "--json"], {}),
    ([], completing("hilctl run x.yaml --set limits.")),
    ([], completing("hilctl report ")),
])  # fmt: skip
def test_commands_import_nothing_heavy_that_they_do_not_use(words, environment):
    code = """
import sys
from hilctl.cli import main
sys.argv[0] = "hilctl"
try:
    main()
finally:
    heavy = ("numba", "scipy", "matplotlib", "websockets")
    print([each for each in heavy if each in sys.modules])
"""
    ended = in_a_process(code, *words, **environment)
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (0, "[]"), ended.stderr


def test_help_names_every_command(hilctl):
    text = hilctl("--help")[1]
    table = typer.main.get_group(app).commands
    assert list(table) == list(COMMANDS)
    for name, line in table.items():
        assert line.short_help == load(name).help.splitlines()[0], name
        assert re.search(rf"^ +{name} .*{re.escape(line.short_help[:30])}", text, re.MULTILINE)


def test_help_reads_no_source():
    """An installation may have none."""
    code = """
import sys
from hilctl.cli import commands, main
def refuse(event, words):
    if event == "open" and "/cli/" in str(words[0]) and str(words[0]).endswith(".py"):
        raise FileNotFoundError(words[0])
sys.addaudithook(refuse)
main()
"""
    ended = in_a_process(code, "--help")
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("name", ["check", "report"])
def test_eof_error_is_not_reported_as_ctrl_d(hilctl, monkeypatch, name):
    def ended():
        raise EOFError("ran out")

    monkeypatch.setattr("hilctl.cli.reports.report", ended)
    monkeypatch.setattr("hilctl.cli.run.check", ended)
    code, _, stderr = hilctl(name)
    assert code == 3
    assert stderr.startswith("hilctl: ")
    assert "ran out" in stderr


def test_version(hilctl):
    assert hilctl("--version")[1] == f"hilctl {__version__}\n"
