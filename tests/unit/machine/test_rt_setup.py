"""The real-time set-up: what is tried, what a refusal says, and what a run requires."""

import errno
import json
import os
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
from tests.commands import ended

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

    def __getattr__(self, name):
        return lambda *values: self._take(name, *values)

    def policy(self, process=0):
        if process and process not in self.policies:
            raise ProcessLookupError(errno.ESRCH, os.strerror(errno.ESRCH))
        return self.policies[process] if process else self.policy_now

    def nice(self):
        return self.nice_now

    def set_nice(self, nice):
        self._take("set_nice", nice)
        self.nice_now = nice


def by_name(steps):
    return {step.name: step for step in steps}


def test_every_step_is_taken_in_order():
    system = FakeSystem()
    steps = prepare(Realtime(priority=42, cpu=1), system)
    assert [step.name for step in steps] == NAMES
    assert {step.outcome for step in steps} == {"done"}
    (before, *heap), asked = system.asked[2], system.asked[:2] + system.asked[3:]
    assert (before, len(heap)) == ("prefault", 1)
    assert asked == [
        ("freeze_gc",),
        ("lock_memory",),
        ("set_timer_slack", 1),
        ("hold_dma_latency", 0),
        ("pin", 1),
        ("set_fifo", 42),
    ]


@pytest.mark.parametrize(("refused", "name", "remedy"), [
    ("lock_memory", "memory", "memlock"),
    ("set_timer_slack", "timer_slack", ""),
    ("hold_dma_latency", "dma_latency", "udev"),
    ("pin", "cpu", "realtime.cpu"),
    ("set_fifo", "fifo", "rtprio"),
])  # fmt: skip
def test_a_refusal_has_a_remedy_and_stops_no_other_step(refused, name, remedy):
    steps = by_name(prepare(Realtime(cpu=0), FakeSystem(refuses={refused})))
    assert steps[name].outcome == "refused"
    assert "Operation not permitted" in steps[name].detail
    assert remedy in steps[name].remedy
    assert [step.name for step in steps.values() if step.outcome == "done"] == [
        other for other in NAMES if other != name
    ]


@pytest.mark.parametrize(("lockable", "outcome"), [(500 << 20, "refused"), (2 << 30, "done")])
def test_memory_is_locked_only_if_later_allocations_fit(lockable, outcome):
    system = FakeSystem(lockable=lockable, mapped=400 << 20)
    assert by_name(prepare(Realtime(), system))["memory"].outcome == outcome
    assert (("lock_memory",) in system.asked) == (outcome == "done")


@pytest.mark.parametrize(
    ("isolated", "cpu", "pinned"),
    [("3\n", None, 3), ("2-3,6\n", None, 2), ("\n", None, None), ("3\n", 1, 1)],
)
def test_cpu_of_the_experiment_precedes_the_first_isolated_one(isolated, cpu, pinned):
    system = FakeSystem(files={ISOLATED: isolated})
    step = by_name(prepare(Realtime(cpu=cpu), system))["cpu"]
    asked = [asked[1] for asked in system.asked if asked[0] == "pin"]
    assert asked == ([] if pinned is None else [pinned])
    assert step.outcome == ("not asked" if pinned is None else "done")


@pytest.mark.parametrize(
    ("runtime", "said"), [("950000", "at most 950000 of 1000000 us"), ("-1", "no throttling")]
)
def test_throttling_is_reported(runtime, said):
    files = {RT_RUNTIME: f"{runtime}\n", RT_PERIOD: "1000000\n"}
    assert said in by_name(prepare(Realtime(), FakeSystem(files=files)))["fifo"].detail


def test_a_control_group_without_share_is_named():
    files = {
        "/proc/self/cgroup": "1:cpu:/lab\n0::/\n",
        "/sys/fs/cgroup/cpu/lab/cpu.rt_runtime_us": "0\n",
    }
    system = FakeSystem(refuses={"set_fifo"}, files=files)
    assert "cpu.rt_runtime_us" in by_name(prepare(Realtime(), system))["fifo"].remedy


@pytest.mark.parametrize(("files", "share"), [
    ({}, None),
    ({"/proc/self/cgroup": "0::/user.slice\n"}, None),
    ({"/proc/self/cgroup": "4:cpu,cpuacct:/\n",
     "/sys/fs/cgroup/cpu,cpuacct/cpu.rt_runtime_us": "950000\n", }, 950000),
])  # fmt: skip
def test_share_of_the_control_group(files, share):
    assert rt_group_runtime_us(FakeSystem(files=files).read) == share


def test_required_real_time_is_refused_with_all_remedies():
    require(prepare(Realtime(), FakeSystem(refuses={"hold_dma_latency", "set_timer_slack"})))
    refused = prepare(Realtime(), FakeSystem(refuses={"set_fifo", "lock_memory"}))
    with pytest.raises(InputError, match="rtprio") as raised:
        require(refused)
    text = str(raised.value)
    assert "rtprio" in text
    assert "memlock" in text


def test_facts_name_each_step():
    facts = step_facts(prepare(Realtime(), FakeSystem(refuses={"set_fifo"})))
    assert list(facts) == [f"rt.{name}" for name in NAMES]
    assert facts["rt.fifo"].startswith("refused: SCHED_FIFO 80")
    assert facts["rt.timer_slack"] == "done: 1 ns"


@pytest.mark.parametrize("policy", [os.SCHED_FIFO, os.SCHED_RR, os.SCHED_OTHER])
def test_inherited_real_time_policy_is_dropped(policy):
    system, inherited = FakeSystem(policy_now=policy), policy != os.SCHED_OTHER
    assert be_ordinary(system) == inherited
    assert system.asked == [("set_ordinary",)] * inherited


@pytest.mark.parametrize("before", [0, 10, -15])
def test_thread_has_priority_beside_a_real_time_loop(before):
    system = FakeSystem(policies={7: os.SCHED_FIFO}, nice_now=before)
    with favoured(7, system):
        assert system.nice_now == min(before, -10)
    assert system.nice_now == before


@pytest.mark.parametrize("system", [
    FakeSystem(policies={7: os.SCHED_OTHER}),
    FakeSystem(policies={7: os.SCHED_FIFO}, refuses={"set_nice"}),
    FakeSystem(),
], ids=["the loop is ordinary", "it is not allowed", "the loop is gone"])  # fmt: skip
def test_priority_is_unchanged_without_a_real_time_loop(system):
    with favoured(7, system):
        assert system.nice_now == 0
    assert system.nice_now == 0


@pytest.mark.parametrize(
    ("text", "cpus"), [("", []), ("0\n", [0]), ("1,4-6\n", [1, 4, 5, 6]), ("0-1", [0, 1])]
)
def test_cpu_lists(text, cpus):
    assert cpu_numbers(text) == cpus


REAL = """
import gc, json, os, subprocess, sys
from dataclasses import asdict
from hilctl.machine.rt_setup import Realtime, prepare

def state():
    lines = open("/proc/self/status").read().splitlines()
    locked = next(int(line.split()[1]) for line in lines if line.startswith("VmLck"))
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    return {"locked": locked, "policy": policy, "gc": gc.isenabled(),
            "cpus": sorted(os.sched_getaffinity(0))}

steps = [asdict(step) for step in prepare(Realtime(cpu=state()["cpus"][0]))]
child = subprocess.run([sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"],
                       capture_output=True, text=True)
json.dump({"steps": steps, "during": state(), "child": int(child.stdout)}, sys.stdout)
"""


@pytest.fixture(scope="module")
def real():
    """What a process of its own says after the set-up."""
    return json.loads(ended([sys.executable, "-c", REAL]).stdout)


def test_reported_steps_are_done(real):
    done = {step["name"] for step in real["steps"] if step["outcome"] == "done"}
    assert {"gc", "prefault", "cpu"} <= done
    assert not real["during"]["gc"]
    assert len(real["during"]["cpus"]) == 1
    assert (real["during"]["policy"] == os.SCHED_FIFO) == ("fifo" in done)
    assert (real["during"]["locked"] > 0) == ("memory" in done)


def test_children_start_ordinary(real):
    assert real["child"] == os.SCHED_OTHER


@pytest.mark.parametrize(("given", "cpu"), [("none", None), (0, 0), (3, 3)])
def test_cpu_in_the_experiment(given, cpu):
    assert Realtime.model_validate({"cpu": given}).cpu == cpu


@pytest.mark.parametrize(
    "wrong",
    [{"cpu": -1}, {"cpu": "two"}, {"cpu": True}, {"priority": 0}, {"priority": 99}, {"require": 1}],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValidationError):
        Realtime.model_validate(wrong)
