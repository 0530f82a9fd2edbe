"""Programs for the end of a run are looked for before it starts."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml.document import Document
from hilctl.experiment.end_commands import end_command_problems, found_program
from hilctl.experiment.file import Experiment

TEXT = """\
name: told
device: {kind: simulated_terfenol}
sample_rate_hz: 1000
waveform: {kind: sine, unit: A, amplitude: 1.0, frequency_hz: 1.0, duration_s: 1.0}
compensator: none
limits: {peak_current_a: 7.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
on_end:
  - command: [sh, -c, "true"]
  - command: [no-such-program, --loud]
  - command: [./notify.py]
"""


def loaded(folder):
    document = Document("x.yaml", TEXT)
    config = document.validate(Experiment)
    return SimpleNamespace(config=config, document=document, folder=folder)


def test_each_program_that_can_not_be_run_is_a_problem(tmp_path):
    """Also a script that nobody may run; with its line in the file."""
    script = tmp_path / "notify.py"
    script.write_text("#!/usr/bin/env python3\n")
    problems = end_command_problems(loaded(tmp_path))
    assert [(each.where, each.key) for each in problems] == [
        ("x.yaml:9", "on_end.1.command"),
        ("x.yaml:10", "on_end.2.command"),
    ]
    assert "must begin with a program that can be run" in str(problems[0])
    script.chmod(0o755)
    assert len(end_command_problems(loaded(tmp_path))) == 1


def test_a_path_is_relative_to_the_experiment(tmp_path):
    script = tmp_path / "tools" / "notify"
    script.parent.mkdir()
    script.touch(mode=0o755)
    assert found_program("tools/notify", tmp_path) == str(script)
    assert found_program("notify", tmp_path) is None
    assert found_program("/bin/sh", Path("nowhere")) == "/bin/sh"


@pytest.mark.parametrize(
    "change",
    ["command: []", "command: ['']", "command: sh -c true", "command: [sh], timeout_s: 0"],
)
def test_what_is_no_argument_list_is_refused(change):
    text = TEXT[: TEXT.index("on_end")] + f"on_end: [{{{change}}}]\n"
    with pytest.raises(ConfigError, match="on_end"):
        Document("x.yaml", text).validate(Experiment)
