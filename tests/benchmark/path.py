"""Follow the path of a new user on emulated devices: init, check, characterise, run and learn.

Run it with ``python -m tests.benchmark.path``; see README.md beside it. Only addresses are set.
"""

import argparse
import json
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.commands import typed

CASES = {
    "labjack_t7 A": ("labjack_t7",),
    "labjack_t7 V": ("labjack_t7", "--unit", "V"),
    "labjack_t8 V": ("labjack_t8", "--unit", "V"),
    "generic_float32 A": ("generic_float32",),
    "cobs_board A": ("cobs_board",),
    "cobs_board_fifo A": ("cobs_board_fifo",),
    "beckhoff_bk9000 A": ("beckhoff_bk9000",),
    "wago_750 A": ("wago_750",),
    "wago_750 A, 0 to 4 A": ("wago_750", "--set", "limits.drive_a=[0.0, 4.0]"),
    "npoint_lc400 V": ("npoint_lc400", "--unit", "V"),
    "pi_e727 V": ("pi_e727", "--unit", "V"),
    "pi_e709 V": ("pi_e709", "--unit", "V"),
    "agilent_34970a A": ("agilent_34970a",),
    "thorlabs_kpz101 V": ("thorlabs_kpz101", "--unit", "V", "--reader", "thorlabs_ksg101"),
    "kepco_bop A": ("kepco_bop", "--reader", "labjack_t7"),
    "tdk_lambda_gen A": ("tdk_lambda_gen", "--reader", "labjack_t7"),
    "adam_6024 A": ("adam_6024",),
    "adam_6024 V": ("adam_6024", "--unit", "V"),
    "icp_et7000 A": ("icp_et7000",),
    "adam_6224 A": ("adam_6224", "--reader", "adam_6217"),
    "magna_power_sl A": ("magna_power_sl", "--reader", "moxa_iologik_e1240"),
    "bk_precision_1785b A": ("bk_precision_1785b", "--reader", "capancdt_6200"),
}
"""Words of ``hilctl init`` by the name of the case."""
RESUMES = 12  # of a command whose step was ended by the machine


class PathError(Exception):
    """A command of the path failed."""


@contextmanager
def emulated(experiment: Path) -> Iterator[list[str]]:
    """Emulate the devices of an experiment; yield the arguments that set their addresses."""
    command = [*EMULATOR, *typed("emulate", experiment, "--json")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["arguments"][2:]
        finally:
            process.terminate()


EMULATOR = ("chrt", "--fifo", "10")


def follow(name: str, words: Sequence[str], folder: Path) -> dict[str, Any]:
    """Return the answer of each command, or the end of its error text under ``failed``."""
    folder.mkdir(parents=True, exist_ok=True)
    answers: dict[str, Any] = {}

    def said(command: str, *more: str) -> Any:
        command_line = typed(command, *more, "--json")
        for again in range(1 + RESUMES):
            done = subprocess.run(command_line, capture_output=True, text=True, cwd=folder)
            if done.returncode == 0:
                print(f"{name}: {command}", f"({again} resumes)" * (again > 0), flush=True)
                answers[command] = json.loads(done.stdout)
                return answers[command]
            print(f"{name}: {command}: {done.stderr[-400:]}", flush=True)
            if "resumes" not in done.stderr:
                break
        raise PathError(f"{command}: {done.stderr[-400:]}")

    try:
        said("init", *words, "--output", "rig.yaml")
        with emulated(folder / "rig.yaml") as at:
            said("check", "rig.yaml", *at)
            found = said("characterise", "rig.yaml", *at, "--output", "model.yaml")
            run = [*at, *(f"--set={each}" for each in found["first_run"])]
            said("run", "rig.yaml", *run, "--output", "run.mcap")
            said("learn", "rig.yaml", *run, "--output", "learned.yaml")
    except PathError as error:
        answers["failed"] = str(error)
    return answers


def main() -> int:
    """Follow the path with all devices and print the errors."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--jobs", type=int, default=3, help="devices at a time")
    parser.add_argument("--folder", type=Path, default=None)
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    with ThreadPoolExecutor(given.jobs) as pool:
        places = [folder / each.replace(" ", "_").replace(",", "") for each in given.cases]
        words = [CASES[each] for each in given.cases]
        results = list(pool.map(follow, given.cases, words, places))
    for name, answers in zip(given.cases, results, strict=True):
        print(name, json.dumps({key: answers[key] for key in answers if key == "failed"}))
    return int(any("failed" in each for each in results))


if __name__ == "__main__":
    raise SystemExit(main())
