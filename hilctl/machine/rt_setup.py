"""Real-time set-up of the loop's process, step by step, each with what came of it.

The steps are those that LinuxCNC, cyclictest and ros2_control take. None of them needs a real-time
kernel; what the kernel or the user's limits refuse is said, with the remedy, and kept with the
recording.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

from hilctl.base.errors import InputError
from hilctl.machine.settings import Realtime
from hilctl.machine.syscalls import DMA_LATENCY, LinuxProcess

StepOutcome: TypeAlias = Literal["done", "refused", "not asked"]

REQUIRED = ("fifo", "memory")
LIMITS_FILE = "/etc/security/limits.d/99-realtime.conf"
RT_RUNTIME = "/proc/sys/kernel/sched_rt_runtime_us"
RT_PERIOD = "/proc/sys/kernel/sched_rt_period_us"
ISOLATED = "/sys/devices/system/cpu/isolated"

PRIORITY_REMEDY = (
    f"put '@realtime - rtprio 98' and '@realtime - nice -10' into {LIMITS_FILE}, join that group, "
    "log in anew"
)
"""What to do where SCHED_FIFO is refused, or its supervisor may not come before others."""

_HEAP_BYTES = 2 << 20
_HEADROOM_BYTES = 256 << 20
_FAVOURED_NICE = -10


@dataclass(frozen=True, slots=True)
class SetUpStep:
    """One step of the set-up.

    Attributes:
        name: ``gc``, ``prefault``, ``memory``, ``timer_slack``, ``dma_latency``, ``cpu``, ``fifo``.
        outcome: Whether it was done.
        detail: What was set, or why it was refused.
        remedy: What to do about it; empty where there is nothing to do.
    """

    name: str
    outcome: StepOutcome
    detail: str
    remedy: str = ""


class System(Protocol):
    """What the set-up asks of the operating system. A refusal is an :class:`OSError`."""

    def read(self, path: str) -> str:
        """Return the text of a file."""
        ...

    def lockable_bytes(self) -> int | None:
        """Return how much memory may be locked; None where any amount."""
        ...

    def mapped_bytes(self) -> int:
        """Return the size of all that is mapped now."""
        ...

    def freeze_gc(self) -> None:
        """Collect once, then never again."""
        ...

    def prefault(self, heap_bytes: int) -> None:
        """Claim heap and stack now, and keep them."""
        ...

    def lock_memory(self) -> None:
        """Keep in RAM every page that is there now, and every page that is touched later."""
        ...

    def set_timer_slack(self, slack_ns: int) -> None:
        """Let timers fire this much late; 0 for the system's own value."""
        ...

    def hold_dma_latency(self, latency_us: int) -> None:
        """Keep CPUs out of idle states that take longer to leave."""
        ...

    def pin(self, cpu: int) -> None:
        """Run on this CPU only."""
        ...

    def set_fifo(self, priority: int) -> None:
        """Run before all that is not real-time; children start without it."""
        ...

    def set_ordinary(self) -> None:
        """Share the CPU with everybody else."""
        ...

    def policy(self, process: int = 0) -> int:
        """Return a scheduling policy, such as ``os.SCHED_OTHER``: of a process, or of this one."""
        ...

    def nice(self) -> int:
        """Return how far this thread stands back behind others; below 0, before them."""
        ...

    def set_nice(self, nice: int) -> None:
        """Set it, for the threads and processes too that this one starts from now on."""
        ...

    def undo(self) -> None:
        """Go back to an ordinary process, as far as each step was taken."""
        ...


def _step(name: str, detail: str, take: Callable[[], object], remedy: str = "") -> SetUpStep:
    try:
        take()
    except OSError as error:
        return SetUpStep(name, "refused", f"{detail}: {error.strerror}", remedy)
    return SetUpStep(name, "done", detail)


def _lock_memory(system: System) -> SetUpStep:
    """Lock all memory, unless what is claimed later would hit a limit in the middle of a run."""
    remedy = f"put '@realtime - memlock unlimited' into {LIMITS_FILE}, join that group, log in anew"
    limit = system.lockable_bytes()
    needed = system.mapped_bytes() + _HEADROOM_BYTES
    if limit is not None and limit < needed:
        detail = f"only {limit >> 20} MB may be locked, {needed >> 20} MB are needed"
        return SetUpStep("memory", "refused", detail, remedy)
    return _step(
        "memory", "locked: pages in RAM now, and those touched later", system.lock_memory, remedy
    )


def _pin(settings: Realtime, system: System) -> SetUpStep:
    cpu = settings.cpu
    if cpu is None:
        with suppress(OSError):
            cpu = min(cpu_numbers(system.read(ISOLATED)), default=None)
        if cpu is None:
            return SetUpStep("cpu", "not asked", "no CPU is isolated: any may be used")
    remedy = "name a CPU of this machine that this process may use under realtime.cpu"
    return _step("cpu", f"CPU {cpu}", lambda: system.pin(cpu), remedy)


def _set_fifo(settings: Realtime, system: System) -> SetUpStep:
    priority = settings.priority
    throttling = _throttling(system)
    try:
        system.set_fifo(priority)
    except OSError as error:
        remedy = PRIORITY_REMEDY
        if rt_group_runtime_us(system.read) == 0:
            remedy = (
                "this control group has no real-time share: "
                "write 950000 to its cpu.rt_runtime_us, or boot with rt_group_sched=0"
            )
        return SetUpStep("fifo", "refused", f"SCHED_FIFO {priority}: {error.strerror}", remedy)
    return SetUpStep("fifo", "done", f"SCHED_FIFO {priority}{throttling and ', '}{throttling}")


def _throttling(system: System) -> str:
    """Return what the kernel leaves to real-time work, in words; empty where it does not say."""
    with suppress(OSError, ValueError):
        runtime_us = int(system.read(RT_RUNTIME))
        period_us = int(system.read(RT_PERIOD))
        return f"at most {runtime_us} of {period_us} us" if runtime_us >= 0 else "no throttling"
    return ""


_THIS_PROCESS = LinuxProcess()


def prepare(settings: Realtime, system: System = _THIS_PROCESS) -> tuple[SetUpStep, ...]:
    """Take every step that is allowed; call it last, when all memory is mapped and warm.

    Args:
        settings: What the experiment asks for.
        system: The operating system.

    Returns:
        The steps in the order in which they were tried.
    """
    # The heap after the lock: its pages then stay in RAM. The CPU before the policy, so that none
    # is taken from other processes; SCHED_FIFO last, as the steps before it take milliseconds.
    return (
        _step("gc", "collected once, then off", system.freeze_gc),
        _lock_memory(system),
        _step(
            "prefault",
            f"{_HEAP_BYTES >> 20} MB of heap and 512 kB of stack",
            lambda: system.prefault(_HEAP_BYTES),
        ),
        _step("timer_slack", "1 ns", lambda: system.set_timer_slack(1)),
        _step(
            "dma_latency",
            f"{DMA_LATENCY} held at 0 us",
            lambda: system.hold_dma_latency(0),
            'a udev rule: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"',
        ),
        _pin(settings, system),
        _set_fifo(settings, system),
    )


def undo(system: System = _THIS_PROCESS) -> None:
    """Make this an ordinary process again."""
    system.undo()


def require(steps: Sequence[SetUpStep]) -> None:
    """Refuse a run that has to be real-time and would not be.

    SCHED_FIFO and locked memory are required. The idle states of the CPU are not: virtual machines
    have none, and firmware may ignore the wish; ``hilctl doctor`` shows what they cost.

    Raises:
        InputError: A required step was refused; the text has the remedies.
    """
    if lines := refusals(steps):
        raise InputError(
            "real time is required and can't be had; nothing has moved\n" + "\n".join(lines)
        )


def step_facts(steps: Sequence[SetUpStep]) -> dict[str, str]:
    """Return the steps for a recording's metadata: ``rt.fifo`` and so on, to text."""
    return {f"rt.{step.name}": f"{step.outcome}: {step.detail}" for step in steps}


def refusals(steps: Sequence[SetUpStep]) -> list[str]:
    """Return which steps that real time needs were refused, each with what to do about it."""
    return [
        f"{step.name}: {step.detail}: {step.remedy}"
        for step in steps
        if step.name in REQUIRED and step.outcome != "done"
    ]


def be_quick(priority: int, system: System = _THIS_PROCESS) -> None:
    """Put the calling thread before all that is not real-time, where that is allowed."""
    with suppress(OSError):
        system.set_fifo(priority)


def be_ordinary(system: System = _THIS_PROCESS) -> bool:
    """Give up a real-time policy inherited from whoever started this process.

    A supervisor at the loop's own priority could keep it waiting.

    Returns:
        Whether there was one.
    """
    if system.policy() == os.SCHED_OTHER:
        return False
    system.set_ordinary()
    return True


@contextmanager
def favoured(loop: int, system: System = _THIS_PROCESS) -> Iterator[None]:
    """Put the calling thread, and those that it starts, before ordinary ones, where that may be.

    A supervisor that waits for its turn on a busy machine can't make the output safe in time. Only
    beside a loop that is real-time: another would have to wait for it.

    Args:
        loop: Process number of the loop.
        system: The operating system.
    """
    nice = system.nice()
    with suppress(OSError):  # of the loop too: it may be gone
        if system.policy(loop) != os.SCHED_OTHER:
            system.set_nice(min(nice, _FAVOURED_NICE))
    try:
        yield
    finally:
        with suppress(OSError):
            system.set_nice(nice)


def rt_group_runtime_us(read: Callable[[str], str]) -> int | None:
    """Return the real-time share of this process's control group, in us a period.

    None where the kernel has no such thing; 0 refuses SCHED_FIFO even to root.
    """
    with suppress(OSError, ValueError):
        for line in read("/proc/self/cgroup").splitlines():
            _, controllers, group = line.split(":", 2)
            if "cpu" in controllers.split(","):
                folder = f"/sys/fs/cgroup/{controllers}{group}".rstrip("/")
                return int(read(f"{folder}/cpu.rt_runtime_us"))
    return None


def cpu_numbers(text: str) -> list[int]:
    """Return the CPUs of a kernel list such as ``1,4-6``."""
    found: list[int] = []
    for part in filter(None, text.strip().split(",")):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found
