"""Real-time set-up of the loop process: settings, steps, and the outcome of each step.

LinuxCNC, cyclictest and ros2_control take the same steps. None needs a real-time kernel.
The recording contains the outcome of each step. A refused step has a remedy.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

from hilctl.base.errors import InputError
from hilctl.base.strict import BeforeValidator, Field, StrictModel
from hilctl.machine.syscalls import DMA_LATENCY, LinuxProcess

StepOutcome: TypeAlias = Literal["done", "refused", "not asked"]

REQUIRED = ("fifo", "memory")
LIMITS_FILE = "/etc/security/limits.d/99-realtime.conf"
RT_RUNTIME = "/proc/sys/kernel/sched_rt_runtime_us"
RT_PERIOD = "/proc/sys/kernel/sched_rt_period_us"
ISOLATED = "/sys/devices/system/cpu/isolated"

PRIORITY_REMEDY = (
    f"put '@realtime - rtprio 98' and '@realtime - nice -10' into {LIMITS_FILE}, join that group, "
    "log in again"
)
"""What to do if SCHED_FIFO or a higher priority of the supervisor is refused."""
GROUP_REMEDY = "write 950000 to its cpu.rt_runtime_us, or boot with rt_group_sched=0"
MEMORY_REMEDY = (
    f"put '@realtime - memlock unlimited' into {LIMITS_FILE}, join that group, log in again"
)
DMA_REMEDY = 'a udev rule: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"'

_HEAP_BYTES = 2 << 20
_HEADROOM_BYTES = 256 << 20
_FAVOURED_NICE = -10


def _none_or_number(value: Any) -> Any:
    return None if value == "none" else value


class Realtime(StrictModel):
    """Real-time settings of the loop process.

    Attributes:
        priority: SCHED_FIFO priority of the loop process.
        cpu: CPU of the loop process; ``none`` for the first isolated one, otherwise any.
        require: Whether to refuse a run without SCHED_FIFO and locked memory.
    """

    priority: Annotated[int, Field(ge=1, le=98)] = 80
    cpu: Annotated[
        Annotated[int, Field(ge=0)] | None,
        BeforeValidator(
            _none_or_number, json_schema_input_type=Literal["none"] | Annotated[int, Field(ge=0)]
        ),
    ] = None
    require: bool = False


@dataclass(frozen=True, slots=True)
class SetUpStep:
    """One step of the set-up.

    Attributes:
        name: ``gc``, ``prefault``, ``memory``, ``timer_slack``, ``dma_latency``, ``cpu``, ``fifo``.
        detail: What was set, or why it was refused.
    """

    name: str
    outcome: StepOutcome
    detail: str
    remedy: str = ""


def _step(name: str, detail: str, take: Callable[[], object], remedy: str = "") -> SetUpStep:
    try:
        take()
    except OSError as error:
        return SetUpStep(name, "refused", f"{detail}: {error.strerror}", remedy)
    return SetUpStep(name, "done", detail)


def _lock_memory(system: LinuxProcess) -> SetUpStep:
    """Lock all memory, unless a later allocation would exceed the limit."""
    limit = system.lockable_bytes()
    needed = system.mapped_bytes() + _HEADROOM_BYTES
    if limit is not None and limit < needed:
        detail = f"only {limit >> 20} MB may be locked, {needed >> 20} MB are needed"
        return SetUpStep("memory", "refused", detail, MEMORY_REMEDY)
    detail = "locked: pages in RAM now, and those touched later"
    return _step("memory", detail, system.lock_memory, MEMORY_REMEDY)


def _pin(settings: Realtime, system: LinuxProcess) -> SetUpStep:
    cpu = settings.cpu
    if cpu is None:
        with suppress(OSError):
            cpu = min(cpu_numbers(system.read(ISOLATED)), default=None)
        if cpu is None:
            return SetUpStep("cpu", "not asked", "no CPU is isolated: any may be used")
    remedy = "set realtime.cpu to a CPU that this process may use"
    return _step("cpu", f"CPU {cpu}", lambda: system.pin(cpu), remedy)


def _set_fifo(settings: Realtime, system: LinuxProcess) -> SetUpStep:
    priority = settings.priority
    throttling = _throttling(system)
    try:
        system.set_fifo(priority)
    except OSError as error:
        remedy = PRIORITY_REMEDY
        if rt_group_runtime_us(system.read) == 0:
            remedy = f"this control group has no real-time share: {GROUP_REMEDY}"
        return SetUpStep("fifo", "refused", f"SCHED_FIFO {priority}: {error.strerror}", remedy)
    return SetUpStep("fifo", "done", f"SCHED_FIFO {priority}{throttling and ', '}{throttling}")


def _throttling(system: LinuxProcess) -> str:
    """Describe the CPU share of real-time tasks; empty if unknown."""
    with suppress(OSError, ValueError):
        runtime_us = int(system.read(RT_RUNTIME))
        period_us = int(system.read(RT_PERIOD))
        return f"at most {runtime_us} of {period_us} us" if runtime_us >= 0 else "no throttling"
    return ""


_THIS_PROCESS = LinuxProcess()


def prepare(settings: Realtime, system: LinuxProcess = _THIS_PROCESS) -> tuple[SetUpStep, ...]:
    """Take every step that is allowed. Call it last, when all memory is mapped and warm."""
    # The heap after the lock, so that its pages stay in RAM. The CPU before the policy, so that
    # other processes keep theirs. SCHED_FIFO last: the other steps take milliseconds.
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
            DMA_REMEDY,
        ),
        _pin(settings, system),
        _set_fifo(settings, system),
    )


def require(steps: Sequence[SetUpStep]) -> None:
    """Raise an error if SCHED_FIFO or locked memory was refused.

    Idle states are not required: virtual machines have none, and firmware may ignore the setting.

    Raises:
        InputError: A required step was refused; the text contains the remedies.
    """
    if lines := refusals(steps):
        raise InputError(
            "real time is required and not available; nothing has moved\n" + "\n".join(lines)
        )


def step_facts(steps: Sequence[SetUpStep]) -> dict[str, str]:
    """Return the steps as metadata of a recording, such as ``rt.fifo``."""
    return {f"rt.{step.name}": f"{step.outcome}: {step.detail}" for step in steps}


def refusals(steps: Sequence[SetUpStep]) -> list[str]:
    """Return the required steps that were refused, each with its remedy."""
    return [
        f"{step.name}: {step.detail}: {step.remedy}"
        for step in steps
        if step.name in REQUIRED and step.outcome != "done"
    ]


def be_quick(priority: int, system: LinuxProcess = _THIS_PROCESS) -> None:
    """Give the calling thread a real-time priority if that is allowed."""
    with suppress(OSError):
        system.set_fifo(priority)


def be_ordinary(system: LinuxProcess = _THIS_PROCESS) -> bool:
    """Drop an inherited real-time policy; return whether there was one.

    A supervisor at the loop's own priority could delay the loop.
    """
    if system.policy() == os.SCHED_OTHER:
        return False
    system.set_ordinary()
    return True


@contextmanager
def favoured(loop: int, system: LinuxProcess = _THIS_PROCESS) -> Iterator[None]:
    """Lower the nice value of the calling thread and its new threads, if that is allowed.

    On a busy machine the supervisor must be scheduled in time to set the safe value. Without a
    real-time loop nothing changes: the loop would have to wait for the supervisor.
    """
    nice = system.nice()
    with suppress(OSError):  # not allowed, or the loop has ended
        if system.policy(loop) != os.SCHED_OTHER:
            system.set_nice(min(nice, _FAVOURED_NICE))
    try:
        yield
    finally:
        with suppress(OSError):
            system.set_nice(nice)


def rt_group_runtime_us(read: Callable[[str], str]) -> int | None:
    """Return the real-time share of this process's control group, in us per period.

    None if the kernel has no such share. 0 refuses SCHED_FIFO even to root.
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
