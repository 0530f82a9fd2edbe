"""The verdict on a machine: every part in the report, plain numbers for JSON."""

import io
import json
from pathlib import Path

import numpy as np
from rich.console import Console

from hilctl.cli.devices import render_diagnosis
from hilctl.machine.diagnosis import Diagnosis, examine, machine_facts
from hilctl.machine.procfs import Finding, Machine
from hilctl.machine.rt_setup import Realtime, SetUpStep
from hilctl.machine.timer_latency import Latency

MS = 1_000_000
STEPS = (SetUpStep("fifo", "refused", "SCHED_FIFO 80: Operation not permitted", "rtprio"),)


def latency(late_ns, rate_hz=1000.0):
    return Latency(rate_hz, np.array(late_ns, dtype=np.int64), STEPS)


def text_of(diagnosis):
    console = Console(file=io.StringIO(), width=100)
    console.print(render_diagnosis(diagnosis))
    return console.file.getvalue()


def test_report_has_all_of_it():
    findings = (Finding("kernel", "warn", "PREEMPT_DYNAMIC [none]", "install another"),)
    shown = text_of(Diagnosis(findings, latency([3000, 5000, 2 * MS])))
    for part in ("PREEMPT_DYNAMIC [none]", "-> install another", "refused", "-> rtprio",
                 "from 1024 us", "p99.9", "no, 1000 Hz is not kept"):  # fmt: skip
        assert part in shown


def test_verdict_of_a_rate_that_is_kept():
    kept = Diagnosis((), latency([3000, 5000, 3000]))
    assert kept.verdict == "yes, 1000 Hz is kept: the longest of 3 periods of 1 ms was 1 ms"
    assert kept.to_mapping()["kept"] is True


def test_mapping_is_plain():
    mapping = Diagnosis((), latency([3000, 5000, 3000])).to_mapping()
    again = json.loads(json.dumps(mapping, allow_nan=False))
    assert again["late_us"]["max"] == 5.0
    assert again["late_histogram_us"] == {"0": 0, "1": 0, "2": 2, "4": 1}


def test_an_empty_machine_is_no_error(make_machine, tmp_path):
    found = examine(Machine(tmp_path / "nothing"), Realtime(), tmp_path)
    assert all(each.text for each in found)
    assert {each.name: each.level for each in found}["SCHED_FIFO"] == "bad"


def test_facts_for_a_recording(make_machine):
    facts = machine_facts(Realtime(), Path(), make_machine())
    assert facts["machine.kernel"] == "ok: PREEMPT_RT"
    assert len(facts) == 15
    assert not any(" " in name for name in facts)
