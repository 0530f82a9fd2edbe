"""Follow the path of a new user on emulated devices: init, check, characterise, run and learn.

Run it with ``python -m tests.benchmark.path``; see README.md beside it. Only addresses are set.
"""

import argparse
import json
import math
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hilctl.analysis.report import summarize
from hilctl.recording.reader import read
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
RESUMES = 12  # of a command whose step a stall of the machine ended
EMULATOR = ("chrt", "--fifo", "10")


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


def answer(name: str, folder: Path, command: str, *words: str) -> Any:
    """Run a command and return its JSON; raise PathError if it fails."""
    for _ in range(1 + RESUMES):
        done = subprocess.run(
            typed(command, *words, "--json"), capture_output=True, text=True, cwd=folder
        )
        if done.returncode == 0:
            print(f"{name}: {command}", flush=True)
            return json.loads(done.stdout)
        print(f"{name}: {command}: {done.stderr[-400:]}", flush=True)
        if "resumes" not in done.stderr:
            break
    raise PathError(command)


def follow(name: str, words: Sequence[str], folder: Path) -> str:
    """Return the row of a case: errors in percent, and those expected from noise in brackets."""
    folder.mkdir(parents=True)
    row = f"{name:24}"
    try:
        answer(name, folder, "init", *words, "--output", "rig.yaml")
        with emulated(folder / "rig.yaml") as at:
            answer(name, folder, "check", "rig.yaml", *at)
            found = answer(name, folder, "characterise", "rig.yaml", *at, "--output", "model.yaml")
            for each in found["held_out"]:
                row += f" {each['peak_percent']:.2f}"
            row += f" ({found['held_out'][0]['floor_percent']:.3f}) |"
            run = [*at, *(f"--set={each}" for each in found["first_run"])]
            answer(name, folder, "run", "rig.yaml", *run, "--output", "run.mcap")
            first = summarize(read(folder / "run.mcap")).peak_error_percent
            row += f" {math.nan if first is None else first:.2f} |"
            learned = answer(name, folder, "learn", "rig.yaml", *run, "--output", "learned.yaml")
            for waveform in learned["waveforms"]:
                row += f" {waveform['start_percent']:.2f} -> {waveform['error_percent']:.3f}"
    except PathError as error:
        row += f" failed: {error}"
    print(row, flush=True)
    return row


def main() -> int:
    """Follow the path with all cases, and print held-out errors, first run, and learning."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--jobs", type=int, default=3, help="devices at a time")
    parser.add_argument("--folder", type=Path, help="keep the files here, in a new folder")
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    places = [folder / each.replace(" ", "_") for each in given.cases]
    with ThreadPoolExecutor(given.jobs) as pool:
        rows = list(pool.map(follow, given.cases, map(CASES.__getitem__, given.cases), places))
    print("\n" + "\n".join(rows))
    return int(any("failed" in row for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
