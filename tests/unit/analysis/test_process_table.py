"""Memory and processor time of a run's processes, read from its recording."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.analysis.process_table import processes_of, usage_text
from hilctl.base.errors import DataError
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import USAGE_FACT
from hilctl.run.metadata import usage_facts

LOOP = ProcessUsage(98_000_000, 1_500_000_000, 12, 3, 1234)
SUPERVISOR = ProcessUsage(110_000_000, 0, 0, 0, 0)


def recording(end):
    return SimpleNamespace(path=Path("run.mcap"), end=end)


@pytest.mark.parametrize("loop", [LOOP, None])
def test_what_a_run_wrote_is_read(loop):
    """Of a loop that died, nothing is known."""
    known = {"loop": loop} if loop else {}
    assert processes_of(recording(usage_facts(loop, SUPERVISOR))) == {
        **known,
        "supervisor": SUPERVISOR,
    }


def test_of_an_old_recording_nothing_is_known():
    assert processes_of(recording({})) == {}


@pytest.mark.parametrize(
    "text",
    [
        "none",
        "[]",
        '{"loop": {"resident_bytes": 1}}',
        usage_facts(LOOP, SUPERVISOR)[USAGE_FACT].replace("98000000", "-1"),
        usage_facts(LOOP, SUPERVISOR)[USAGE_FACT].replace("98000000", "1" + "0" * 400),
    ],
)
def test_what_is_damaged_is_refused_with_its_place(text):
    with pytest.raises(DataError, match=r"run\.mcap: hilctl\.end: processes: "):
        processes_of(recording({USAGE_FACT: text}))


def test_a_number_with_a_point_that_is_whole_is_one():
    """Other programs may write it so."""
    text = usage_facts(LOOP, SUPERVISOR)[USAGE_FACT].replace("98000000", "98000000.0")
    assert processes_of(recording({USAGE_FACT: text}))["loop"] == LOOP


def test_people_read_megabytes_and_seconds():
    assert usage_text(LOOP) == (
        "98 MB, 1.50 s of CPU, 15 page faults, 3 from a disk; 1,234 involuntary switches"
    )
