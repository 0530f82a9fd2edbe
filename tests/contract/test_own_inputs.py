"""No command overwrites a file that it reads, or a file that it has not written."""

import shutil
from pathlib import Path

import pytest

from tests.contract.test_bad_input import (
    GOOD,
    IN_UM,
    MODEL,
    SINE,
    check_refused,
    contents,
    hilctl,
    place,
)

__all__ = ["hilctl", "place"]

GOLDEN = Path(__file__).parents[2] / "recordings" / "golden"
FILE = GOOD.replace(SINE, "{kind: file, unit: A, path: wave.csv, file_rate_hz: 1000}")
RECORDED = GOOD.replace(
    SINE,
    "{kind: file, path: run.mcap, column: command, resample: linear, scale: 0.1, last_row: 5000, "
    "unit: A}",
)


@pytest.fixture(autouse=True)
def files(place):
    """An experiment, a model, tables and recordings of the user's own."""
    shutil.copy(GOLDEN / "terfenol_uncompensated.mcap", place / "run.mcap")
    shutil.copy(GOLDEN / "terfenol_compensated.mcap", place / "other.mcap")
    for name, text in {
        "x.yaml": GOOD,
        "rdpi.yaml": GOOD,
        "um.yaml": IN_UM,
        "model.yaml": MODEL,
        "wave.csv": "command\n" + "0.0\n" * 100,
        "file.yaml": FILE,
        "recorded.yaml": RECORDED,
        "notes.txt": "a week's notes\n",
        "loops.csv": "t_s,a,um\n0,0,0\n",
    }.items():
        (place / name).write_text(text)


@pytest.mark.parametrize("words", [
    "run x.yaml --output x.yaml",
    "run um.yaml --output model.yaml",
    "run file.yaml --output wave.csv",
    "run x.yaml --output notes.txt",
    "run recorded.yaml --output run.mcap",
    "run recorded.yaml --output ./linked.mcap",
    "learn um.yaml --output um.yaml",
    "learn um.yaml --output model.yaml",
    "learn um.yaml --output run.mcap",
    "characterise x.yaml --output x.yaml",
    "characterise x.yaml --output run.mcap",
    "couple x.yaml --output x.yaml",
    "couple x.yaml --output model.yaml --set=compensator.model=model.yaml",
    "export run.mcap run.csv",
    "report run.mcap --html run.mcap",
    "report run.mcap other.mcap --html other.mcap",
    "report run.mcap other.mcap --model model.yaml --html model.yaml",
    "identify loops.csv --output loops.csv",
    "identify run.mcap --output run.mcap",
    "identify run.mcap --validate other.mcap --html other.mcap",
    "identify run.mcap --output other.mcap",
    "refine model.yaml other.mcap --output model.yaml",
    "refine model.yaml other.mcap --html model.yaml",
    "refine model.yaml other.mcap --output other.mcap",
    "compare run.mcap --html run.mcap",
    "compare run.mcap --experiment x.yaml --html x.yaml",
    "compare run.mcap --models rdpi --experiment rdpi.yaml --save .",
    "compare run.mcap --models model.yaml --html model.yaml",
])  # fmt: skip
def test_an_output_is_no_input(hilctl, place, words):
    (place / "linked.mcap").symlink_to("run.mcap")
    (place / "run.csv").symlink_to("run.mcap")
    before = contents(place)
    ended = hilctl(*words.split(), "--overwrite")
    check_refused(ended, "name")
    assert contents(place) == before


@pytest.mark.parametrize("words", ["schema --output x.yaml", "emulate labjack_t7 --log x.yaml"])
def test_what_is_written_over_was_written_by_the_same_command(hilctl, place, words):
    before = contents(place)
    ended = hilctl(*words.split())
    check_refused(ended, "x")
    assert contents(place) == before


@pytest.mark.slow
def test_an_empty_file_and_a_torn_recording_are_replaced(hilctl, place):
    for text in (b"", b"\x89MCA", (place / "run.mcap").read_bytes()[:5000]):
        (place / "run.mcap").write_bytes(text)
        ended = hilctl("run", "x.yaml", "--output", "run.mcap", "--overwrite")
        assert ended.code == 0, ended.err
        assert (place / "run.mcap").stat().st_size > 5000
