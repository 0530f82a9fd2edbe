"""Whether what is started once a run is over can be: mail, chat, a lamp."""

import shutil
from pathlib import Path

from hilctl.base.errors import Problem
from hilctl.experiment.load import LoadedExperiment


def found_program(name: str, folder: Path) -> str | None:
    """Return the path of a program; None where there is none that can be run.

    Args:
        name: A name on the PATH, or a path.
        folder: What a path is relative to.
    """
    return shutil.which(str((folder / name).absolute()) if "/" in name else name)


def end_command_problems(loaded: LoadedExperiment) -> list[Problem]:
    """Return which programs of ``on_end`` can't be run."""
    found = []
    for number, each in enumerate(loaded.config.on_end):
        name = each.command[0]
        if found_program(name, loaded.folder) is None:
            where = loaded.document.where(("on_end", number, "command", 0))
            rule = "must begin with a program that can be run"
            hint = "give its path, or install it; a script needs its first line and chmod +x"
            found.append(Problem(where, f"on_end.{number}.command", rule, repr(name), hint))
    return found
