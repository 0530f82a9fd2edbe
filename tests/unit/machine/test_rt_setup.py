"""The real-time set-up: what is tried, what a refusal says, and what a run requires."""

import errno
import json
import os
import subprocess
import sys
from dataclasses import dataclass, field

import pytest
from pydantic import ValidationError

from hilctl.base.errors import InputError
from hilctl.machine.rt_setup import (
    ISOLATED,
    RT_PERIOD,
    RT_RUNTIME,
    Realtime,
    be_ordinary,
    cpu_numbers,
    favoured,
    prepare,
    require,
    rt_group_runtime_us,
    step_facts,
)

NAMES = ["gc", "memory", "prefault", "timer_slack", "dma_latency", "cpu", "fifo"]


@dataclass
class FakeSystem:
    """Notes what it is asked for, and refuses what the test names."""

    refuses: set[str] = field(default_factory=set)
    files: dict[str, str] = field(default_factory=dict)
    lockable: int | None = None
    mapped: int = 400 << 20
    policy_now: int = os.SCHED_OTHER
    policies: dict[int, int] = field(default_factory=dict)
    nice_now: int = 0
    asked: list[tuple] = field(default_factory=list)

    def _take(self, name, *values):
        self.asked.append((name, *values))
        if name in self.refuses:
            raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    def read(self, path):
        if path not in self.files:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        return self.files[path]

    def lockable_bytes(self):
        return self.lockable

    def mapped_bytes(self):
        return self.mapped

    def freeze_gc(self):
        self._take("freeze_gc")

    def prefault(self, heap_bytes):
        self._take("prefault", heap_bytes)

    def lock_memory(self):
        self._take("lock_memory")

    def set_timer_slack(self, slack_ns):
        self._take("set_timer_slack", slack_ns)

    def hold_dma_latency(self, latency_us):
        self._take("hold_dma_latency", latency_us)

    def pin(self, cpu):
        self._take("pin", cpu)

    def set_fifo(self, priority):
        self._take("set_fifo", priority)

    def set_ordinary(self):
        self._take("set_ordinary")

    def policy(self, process=0):
        if process and process not in self.policies:
            raise ProcessLookupError(errno.ESRCH, os.strerror(errno.ESRCH))
        return self.policies[process] if process else self.policy_now

    def nice(self):
        return self.nice_now

    def set_nice(self, nice):
        self._take("set_nice", nice)
        self.nice_now = nice

    def undo(self):
        self._take("undo")


def by_name(steps):
    return {step.name: step for step in steps}


def test_every_step_is_taken_in_order():
    """Where nothing is refused, every step is done, and the process turns real-time last."""
    system = FakeSystem()
    steps = prepare(Realtime(priority=42, cpu=1), system)
    assert [step.name for step in steps] == NAMES
    assert {step.outcome for step in steps} == {"done"}
    assert [asked[0] for asked in system.asked] == [
        "freeze_gc",
        "lock_memory",
        "prefault",
        "set_timer_slack",
        "hold_dma_latency",
        "pin",
        "set_fifo",
    ]
    assert {("set_fifo", 42), ("pin", 1), ("hold_dma_latency", 0)} <= set(system.asked)


@pytest.mark.parametrize(
    ("refused", "name"),
    [
        ("lock_memory", "memory"),
        ("set_timer_slack", "timer_slack"),
        ("hold_dma_latency", "dma_latency"),
        ("pin", "cpu"),
        ("set_fifo", "fifo"),
    ],
)
def test_a_refusal_stops_no_other_step(refused, name):
    """A refused step says why, and all others are taken all the same."""
    steps = by_name(prepare(Realtime(cpu=0), FakeSystem(refuses={refused})))
    assert steps[name].outcome == "refused"
    assert "Operation not permitted" in steps[name].detail
    assert [step.name for step in steps.values() if step.outcome == "done"] == [
        other for other in NAMES if other != name
    ]


def test_refusals_have_a_remedy():
    """What a user's limits refuse comes with what to change."""
    refuses = {"lock_memory", "hold_dma_latency", "pin", "set_fifo"}
    steps = by_name(prepare(Realtime(cpu=7), FakeSystem(refuses=refuses)))
    assert "memlock" in steps["memory"].remedy
    assert "udev" in steps["dma_latency"].remedy
    assert "realtime.cpu" in steps["cpu"].remedy
    assert "rtprio" in steps["fifo"].remedy


def test_a_small_memory_limit_is_not_run_into():
    """Memory is not locked where a limit would make a later allocation fail."""
    system = FakeSystem(lockable=500 << 20, mapped=400 << 20)
    step = by_name(prepare(Realtime(), system))["memory"]
    assert (step.outcome, "only 500 MB" in step.detail) == ("refused", True)
    assert ("lock_memory",) not in system.asked


def test_a_large_memory_limit_is_enough():
    """A limit with room for what is mapped and more is no obstacle."""
    system = FakeSystem(lockable=2 << 30, mapped=400 << 20)
    assert by_name(prepare(Realtime(), system))["memory"].outcome == "done"


@pytest.mark.parametrize(("isolated", "pinned"), [("3\n", 3), ("2-3,6\n", 2), ("\n", None)])
def test_an_isolated_cpu_is_taken(isolated, pinned):
    """Without a CPU of its own in the experiment, the first isolated one is taken, if any."""
    system = FakeSystem(files={ISOLATED: isolated})
    step = by_name(prepare(Realtime(), system))["cpu"]
    assert [asked[1] for asked in system.asked if asked[0] == "pin"] == (
        [] if pinned is None else [pinned]
    )
    assert step.outcome == ("not asked" if pinned is None else "done")


def test_the_experiments_cpu_goes_before_isolated_ones():
    """A CPU that the experiment names is taken even where another is isolated."""
    system = FakeSystem(files={ISOLATED: "3\n"})
    prepare(Realtime(cpu=1), system)
    assert ("pin", 1) in system.asked


@pytest.mark.parametrize(
    ("runtime", "said"),
    [("950000", "at most 950000 of 1000000 us"), ("-1", "no throttling")],
)
def test_throttling_is_reported(runtime, said):
    """The step says what share of a CPU the kernel leaves to real-time tasks."""
    files = {RT_RUNTIME: f"{runtime}\n", RT_PERIOD: "1000000\n"}
    assert said in by_name(prepare(Realtime(), FakeSystem(files=files)))["fifo"].detail


def test_a_control_group_without_share_is_named():
    """Where SCHED_FIFO is refused for the control group's sake, the remedy is that one."""
    files = {
        "/proc/self/cgroup": "1:cpu:/lab\n0::/\n",
        "/sys/fs/cgroup/cpu/lab/cpu.rt_runtime_us": "0\n",
    }
    system = FakeSystem(refuses={"set_fifo"}, files=files)
    assert "cpu.rt_runtime_us" in by_name(prepare(Realtime(), system))["fifo"].remedy


@pytest.mark.parametrize(
    ("files", "share"),
    [
        ({}, None),
        ({"/proc/self/cgroup": "0::/user.slice\n"}, None),
        (
            {
                "/proc/self/cgroup": "4:cpu,cpuacct:/\n",
                "/sys/fs/cgroup/cpu,cpuacct/cpu.rt_runtime_us": "950000\n",
            },
            950000,
        ),
    ],
)
def test_share_of_the_control_group(files, share):
    """The share of version 1 groups is found by their controllers; others have none."""
    assert rt_group_runtime_us(FakeSystem(files=files).read) == share


def test_a_run_that_requires_real_time():
    """SCHED_FIFO and locked memory are required; the text has each remedy. The rest is not."""
    require(prepare(Realtime(), FakeSystem(refuses={"hold_dma_latency", "set_timer_slack"})))
    refused = prepare(Realtime(), FakeSystem(refuses={"set_fifo", "lock_memory"}))
    with pytest.raises(InputError, match="nothing has moved") as raised:
        require(refused)
    text = str(raised.value)
    assert "rtprio" in text
    assert "memlock" in text


def test_facts_name_each_step():
    """A recording gets one line of text for each step."""
    facts = step_facts(prepare(Realtime(), FakeSystem(refuses={"set_fifo"})))
    assert list(facts) == [f"rt.{name}" for name in NAMES]
    assert facts["rt.fifo"].startswith("refused: SCHED_FIFO 80")
    assert facts["rt.timer_slack"] == "done: 1 ns"


@pytest.mark.parametrize("policy", [os.SCHED_FIFO, os.SCHED_RR])
def test_an_inherited_policy_is_given_up(policy):
    """A supervisor started by a real-time process turns ordinary."""
    system = FakeSystem(policy_now=policy)
    assert be_ordinary(system)
    assert system.asked == [("set_ordinary",)]


def test_an_ordinary_process_stays_one():
    """Nothing is set where there is nothing to give up."""
    system = FakeSystem()
    assert not be_ordinary(system)
    assert system.asked == []


@pytest.mark.parametrize("before", [0, 10, -15])
def test_beside_a_real_time_loop_a_thread_is_favoured_for_a_while(before):
    """Never less than it was; the loop's own policy decides, which is of another process."""
    system = FakeSystem(policies={7: os.SCHED_FIFO}, nice_now=before)
    with favoured(7, system):
        assert system.nice_now == min(before, -10)
    assert system.nice_now == before


@pytest.mark.parametrize("system", [
    FakeSystem(policies={7: os.SCHED_OTHER}),
    FakeSystem(policies={7: os.SCHED_FIFO}, refuses={"set_nice"}),
    FakeSystem(),
], ids=["the loop is ordinary", "it is not allowed", "the loop is gone"])  # fmt: skip
def test_otherwise_nothing_changes(system):
    with favoured(7, system):
        assert system.nice_now == 0
    assert system.nice_now == 0


@pytest.mark.parametrize(
    ("text", "cpus"), [("", []), ("0\n", [0]), ("1,4-6\n", [1, 4, 5, 6]), ("0-1", [0, 1])]
)
def test_cpu_lists(text, cpus):
    """The kernel's lists of CPUs are read as ranges and single numbers."""
    assert cpu_numbers(text) == cpus


REAL = """
import gc, json, os, subprocess, sys
from dataclasses import asdict
from hilctl.machine.rt_setup import Realtime, prepare, undo

def state():
    lines = open("/proc/self/status").read().splitlines()
    locked = next(int(line.split()[1]) for line in lines if line.startswith("VmLck"))
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    return {"locked": locked, "policy": policy, "gc": gc.isenabled(),
            "cpus": sorted(os.sched_getaffinity(0))}

before = state()
steps = [asdict(step) for step in prepare(Realtime(cpu=before["cpus"][0]))]
during = state()
child = subprocess.run([sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"],
                       capture_output=True, text=True)
undo()
json.dump({"before": before, "steps": steps, "during": during, "after": state(),
           "child": int(child.stdout)}, sys.stdout)
"""


@pytest.fixture(scope="module")
def real():
    """What a process of its own says before, during and after the set-up."""
    ran = subprocess.run([sys.executable, "-c", REAL], capture_output=True, text=True, check=True)
    return json.loads(ran.stdout)


def test_what_is_said_to_be_done_is_done(real):
    """In a real process, each step's outcome agrees with what the kernel says."""
    done = {step["name"] for step in real["steps"] if step["outcome"] == "done"}
    assert {"gc", "prefault", "cpu"} <= done
    assert not real["during"]["gc"]
    assert len(real["during"]["cpus"]) == 1
    assert (real["during"]["policy"] == os.SCHED_FIFO) == ("fifo" in done)
    assert (real["during"]["locked"] > 0) == ("memory" in done)


def test_children_start_ordinary(real):
    """What the loop's process starts is never real-time."""
    assert real["child"] == os.SCHED_OTHER


def test_undo_brings_all_back(real):
    """After undo the process is as it was."""
    assert real["after"] == real["before"]


@pytest.mark.parametrize(("given", "cpu"), [("none", None), (0, 0), (3, 3)])
def test_cpu_in_the_experiment(given, cpu):
    """The experiment names a CPU by its number, or none."""
    assert Realtime.model_validate({"cpu": given}).cpu == cpu


@pytest.mark.parametrize(
    "wrong",
    [{"cpu": -1}, {"cpu": "two"}, {"cpu": True}, {"priority": 0}, {"priority": 99}, {"require": 1}],
)
def test_wrong_settings_are_refused(wrong):
    """Priorities the kernel keeps for itself, and values of another type, are refused."""
    with pytest.raises(ValidationError):
        Realtime.model_validate(wrong)


def test_command_line_requires_real_time(monkeypatch):
    """--require-rt is a setting of the experiment, beside those given with --set."""
    from typer.testing import CliRunner

    from hilctl.cli.commands import app

    asked = []

    def refuse(experiment, settings, *others):
        asked.append(settings)
        raise InputError("far enough")

    monkeypatch.setattr("hilctl.api.runs.start_run", refuse)
    monkeypatch.setattr("hilctl.cli.run.finish_dead_runs", lambda: None)  # not this machine's own
    runner = CliRunner()
    for flags in ([], ["--require-rt"], ["--require-rt", "--set", "name=other"]):
        runner.invoke(app, ["run", "experiment.yaml", *flags])
    assert asked == [
        [],
        ["realtime.require=true"],
        ["name=other", "realtime.require=true"],
    ]
