"""A state model of the processes that hand a device over, searched exhaustively.

One run (loop, supervisor, guardian), one device that goes away and comes back and may execute one
request late, and one later command. Steps carry the names of the code that takes them; see
:data:`CODE`. Two rules hold in every state:

- "confirmed" is said only of an output that is safe and stays safe;
- an output that is driven has an owner that makes it safe once the device is there, or, if every
  process was killed, its run is still known to the next command.
"""

from collections import deque
from importlib import import_module
from typing import NamedTuple

import pytest

CODE = {
    "loop.begin_safe_ramp": "hilctl.loop.loop:Loop._begin_safe_ramp",
    "loop.attempt": "hilctl.loop.safe_output:drive_to_safe",
    "loop.become_guardian": "hilctl.run.loop_process:_become_guardian",
    "guardian.watch": "hilctl.run.safety.guardian:Guardian.watch",
    "guardian.act": "hilctl.run.safety.guardian:Guardian.act",
    "guardian.attempt": "hilctl.loop.safe_output:SafeOutput.attempt",
    "guardian.release_locks": "hilctl.run.safety.guardian:Guardian._release_locks",
    "guardian.await_device": "hilctl.run.safety.guardian:Guardian._awaits_device",
    "supervisor.keep_guardian": "hilctl.run.safety.safety_monitor:SafetyMonitor._keep_guardian",
    "supervisor.stand_in": "hilctl.run.safety.safety_monitor:SafetyMonitor._stand_in",
    "supervisor.attempt": "hilctl.loop.safe_output:SafeOutput.attempt",
    "supervisor.hand_over": "hilctl.run.safety.safety_monitor:SafetyMonitor._hand_over",
    "supervisor.close": "hilctl.run.safety.safety_monitor:SafetyMonitor.close",
    "command.claim": "hilctl.run.processes:GuardianRelief.acquire",
    "command.acquire": "hilctl.run.run_folder:DeviceLocks.holder",
    "command.attempt": "hilctl.loop.safe_output:drive_to_safe",
    "command.restart": "hilctl.run.processes:GuardianRelief.restart",
    "command.go": "hilctl.run.supervisor:_go",
    "command.relieve": "hilctl.run.processes:GuardianRelief.relieve",
}
"""The code of each step of a process; other steps are events of the device, or ends."""


GONE = {"dead", "killed"}
OVER = {"dead", "ended"}


class State(NamedTuple):
    """State of the processes and the device.

    Attributes:
        late: Whether a request that was never answered waits in the device or a gateway.
        unanswered: Whether the run knows that one may.
        lock: Holder of the device's locks: run, command or none.
        known: Whether the folder of the run exists.
        killed: Whether the last process of the run was killed from outside.
    """

    loop: str = "run"  # run, leave, safe; unsafe, ended, dead: without a safe output
    supervisor: str = "watch"  # watch, stand in, hand over, ended, dead
    guardian: str = "watch"  # start, watch, act, wait, done, dead by a crash, killed by the product
    command: str = "none"  # none, claim, has, go, owns
    lock: str = "run"
    relieved: bool = False
    claim: bool = False
    away: bool = False
    driven: bool = True
    late: bool = False
    unanswered: bool = False
    said: str = ""
    known: bool = True
    killed: bool = False
    crashes: int = 2
    lates: int = 1

    def to(self, **changes):
        return self._replace(**changes)

    @property
    def supervised(self):
        return self.supervisor in {"watch", "stand in", "hand over"}

    @property
    def alive(self):
        """Whether a process of the run is alive."""
        guarded = self.guardian in {"start", "watch", "act", "wait"}
        return self.supervised or guarded or self.loop in {"run", "leave", "unsafe"}

    def crash(self, **changes):
        """Return the state after a crash of a process of the run."""
        left = self.to(crashes=self.crashes - 1, **changes)
        return left.to(killed=not left.alive)

    @property
    def owners(self):
        """The processes that write to the device."""
        return [
            name
            for name, at in {
                "loop": self.loop in {"run", "leave"},
                "supervisor": self.supervisor == "stand in",
                "guardian": self.guardian == "act",
                "command": self.command in {"has", "go", "owns"},
            }.items()
            if at
        ]

    @property
    def is_watched(self):
        """Whether a process corrects an output that a late request may drive again."""
        return "command" in self.owners or "guardian" in self.owners or self.loop == "run"


def confirmed_or_set(s):
    """Return a state after a write of the safe value that the device confirmed."""
    return s.to(driven=False, said="set" if s.unanswered else "confirmed")


def loop_steps(s):
    if s.loop == "run":
        yield "loop.begin_safe_ramp", s.to(loop="leave")
        if s.away:  # in an exchange, which may be executed later
            lost = s.to(loop="leave", unanswered=True)
            yield "loop.begin_safe_ramp", lost
            if s.lates:
                yield "loop.begin_safe_ramp", lost.to(late=True, lates=0)
    if s.loop == "leave":
        if s.away:
            yield "loop.attempt", s.to(loop="unsafe")
        else:
            done = confirmed_or_set(s)
            yield "loop.attempt", done.to(loop="unsafe" if s.unanswered else "safe")
    if s.loop == "unsafe":
        last = not s.supervised and s.guardian in GONE
        if last:
            yield "loop.become_guardian", s.to(loop="dead", guardian="act")
        else:
            yield "loop.end", s.to(loop="ended")


def guardian_steps(s):
    if s.guardian == "start":
        yield "guardian.watch", s.to(guardian="watch")
    if s.guardian == "watch" and s.loop == "safe":
        yield "guardian.watch", s.to(guardian="done", known=False)
    if s.guardian == "watch" and s.loop in OVER:
        yield "guardian.act", s.to(guardian="act")
    if s.guardian == "act" and not s.away:
        done = confirmed_or_set(s)
        final = done.said == "confirmed"
        yield "guardian.attempt", done.to(guardian="done", known=False) if final else done
    if s.guardian == "act" and s.claim:
        yield "guardian.release_locks", s.to(guardian="wait", lock="none", claim=False)
    if s.guardian == "wait":
        stands_in = s.supervisor == "stand in"
        if s.relieved:
            yield "guardian.await_device", s.to(guardian="done", known=False)
        elif s.lock in {"none", "run"} and not stands_in:
            yield "guardian.await_device", s.to(guardian="act", lock="run")


def supervisor_steps(s):
    over = s.loop in OVER
    if s.supervisor == "watch":
        if s.guardian == "dead" and s.loop in {"run", "leave"}:
            yield "supervisor.keep_guardian", s.to(guardian="start")
        if s.guardian in {"dead", "start"} and over:
            yield "supervisor.stand_in", s.to(supervisor="stand in", guardian="wait")
        settled = s.guardian == "act" or (s.guardian == "done" and over)
        if s.loop == "safe" or settled:
            yield "supervisor.close", s.to(supervisor="ended")
    if s.supervisor == "hand over":
        if s.guardian == "act":
            yield "supervisor.close", s.to(supervisor="ended")
        if s.guardian == "dead":
            yield "supervisor.stand_in", s.to(supervisor="stand in", guardian="wait")


def standing_in_steps(s):
    if s.supervisor == "stand in":
        if not s.away:
            done = confirmed_or_set(s)
            if done.said == "confirmed":
                done = done.to(relieved=True, supervisor="ended", known=False)
            yield "supervisor.attempt", done
        if s.guardian == "dead":
            yield "supervisor.stand_in", s.to(guardian="wait")
        if s.guardian == "wait":
            yield "supervisor.hand_over", s.to(supervisor="hand over")


def command_steps(s):
    if s.command == "claim":
        yield "command.end", s.to(command="none")
        idle = s.guardian in {*GONE, "done"} and s.loop in {"safe", *OVER}
        if s.lock == "none" or idle:
            yield "command.acquire", s.to(command="has", lock="command")
        elif s.guardian == "act":
            yield "command.claim", s.to(claim=True)
    if s.command == "has":
        released = s.to(command="none", lock="none")
        if s.guardian in GONE:
            released = released.to(guardian="wait")
        yield "command.restart", released
        if not s.away:
            tried = released.to(driven=False, said="set")
            yield "command.attempt", tried
            yield "command.go", s.to(command="go", driven=True, said="")
    if s.command == "go":  # its own loop and guardian protect the output
        yield "command.relieve", s.to(command="owns", relieved=True)


def device_steps(s):
    if s.away:
        yield "device.return", s.to(away=False)


def claims(s, *, kills_first):
    """Yield the start of a command by the user."""
    if s.command == "none" and not s.supervised and s.known and not s.relieved:
        if s.guardian in {"act", "wait"}:
            killed = s.to(command="has", lock="command", guardian="killed")
            yield "command.claim", killed if kills_first else s.to(command="claim", claim=True)
        elif s.guardian in GONE and s.loop in {"safe", *OVER}:
            yield "command.claim", s.to(command="claim")


def faults(s):
    if not s.away:
        yield "device.leave", s.to(away=True)
        if s.late:
            yield "device.execute_late", s.to(late=False, driven=True)
    if s.crashes:
        yield from crashes(s)


def crashes(s):
    if s.loop in {"run", "leave", "unsafe"}:
        yield "loop.crash", s.crash(loop="dead")
    if s.loop in {"run", "leave"}:  # in an exchange, which may be executed later
        yield "loop.crash", s.crash(loop="dead", unanswered=True)
        if s.lates:
            yield "loop.crash", s.crash(loop="dead", unanswered=True, late=True, lates=0)
    if s.supervised:
        yield "supervisor.crash", s.crash(supervisor="dead")
    if s.guardian in {"start", "watch", "act", "wait"}:
        yield "guardian.crash", s.crash(guardian="dead")
    if s.command in {"claim", "has"}:
        lock = "none" if s.lock == "command" else s.lock
        yield "command.crash", s.to(command="none", lock=lock, crashes=s.crashes - 1)


def progress(s):
    yield from loop_steps(s)
    yield from guardian_steps(s)
    yield from supervisor_steps(s)
    yield from standing_in_steps(s)
    yield from device_steps(s)
    yield from command_steps(s)


def search(*, kills_first=False):
    """Return all reachable states with the step that led to each, and those that break a rule."""
    came, queue = {State(): None}, deque([State()])
    helps = {}
    while queue:
        s = queue.popleft()
        steps = list(progress(s))
        for _, each in steps:
            helps.setdefault(each, []).append(s)
        for name, each in [*steps, *claims(s, kills_first=kills_first), *faults(s)]:
            if each not in came:
                came[each] = name, s
                queue.append(each)
    # States from which steps without a fault lead to an output that is safe, and stays so.
    fine = {s for s in came if is_fine(s)}
    queue = deque(fine)
    while queue:
        for before in helps.get(queue.popleft(), ()):
            if before not in fine:
                fine.add(before)
                queue.append(before)
    broken = {s: rule for s in came if (rule := broken_rule(s, fine))}
    return came, broken


def is_fine(s):
    if s.command == "owns" or (s.loop == "run" and not s.away):
        return True
    return not s.driven and (not s.late or s.is_watched)


def broken_rule(s, fine):
    if s.said == "confirmed" and (s.driven or s.late):
        return "confirmed is said of an output that is driven, or may be"
    if len(s.owners) > 1:
        return "two processes write to the device"
    if s not in fine and not s.known:
        return "the output may be driven, and no command knows"
    # After a kill of the last process from outside only the next command can help.
    if s not in fine and not (s.killed and s.command == "none"):
        return "no process drives the output to its safe value"
    return ""


def trace(came, s):
    names = []
    while came[s] is not None:
        name, s = came[s]
        names.append(name)
    return names[::-1]


def test_no_order_of_events_leaves_a_driven_output_alone_or_calls_it_safe():
    came, broken = search()
    shown = [(rule, trace(came, s), s) for s, rule in broken.items()]
    assert not shown, min(shown, key=lambda each: len(each[1]))
    assert len(came) > 2_000


def test_killing_the_guardian_first_leaves_an_output_alone():
    """The fault that the claim mends: the search finds it."""
    came, broken = search(kills_first=True)
    found = [trace(came, s) for s in broken]
    assert any(names[-2:] == ["command.claim", "command.crash"] for names in found)


@pytest.mark.parametrize("step", CODE)
def test_each_step_of_a_process_is_in_the_code(step):
    module, _, path = CODE[step].partition(":")
    found = import_module(module)
    for name in path.split("."):
        found = getattr(found, name)
    assert callable(found)


def test_each_step_of_a_process_names_its_code():
    came, _ = search()
    taken = {step for found in came.values() if found for step in [found[0]]}
    ends = {"device.return", "device.leave", "device.execute_late", "command.end", "loop.end"}
    assert taken - ends - {name for name in taken if name.endswith(".crash")} <= set(CODE)
