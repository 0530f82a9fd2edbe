"""A machine made of files that a test writes."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hilctl.machine.procfs import Machine

GOOD = {
    "/proc/version": "Linux version 6.12.9-rt #1 SMP PREEMPT_RT Debian",
    "/proc/cmdline": "root=/dev/sda1",
    "/proc/self/status": "Name:\thilctl\nCapEff:\t0000000000000000",
    "/proc/self/limits": (
        "Limit                     Soft Limit           Hard Limit           Units\n"
        "Max locked memory         unlimited            unlimited            bytes\n"
        "Max realtime priority     98                   98\n"
    ),
    "/proc/self/cgroup": "0::/user.slice",
    "/proc/sys/kernel/sched_rt_runtime_us": "950000",
    "/proc/sys/kernel/sched_rt_period_us": "1000000",
    "/proc/cpuinfo": "flags\t\t: fpu tsc sse2",
    "/dev/cpu_dma_latency": "",
    "/sys/devices/system/cpu/isolated": "3",
    "/sys/devices/system/cpu/nohz_full": "3",
    "/sys/devices/system/cpu/online": "0-3",
    "/sys/devices/system/cpu/smt/active": "0",
    "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance",
    "/sys/devices/system/cpu/cpu3/cpufreq/scaling_governor": "performance",
    "/sys/class/dmi/id/product_name": "ThinkStation P3",
    "/sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
    "/sys/devices/system/clocksource/clocksource0/available_clocksource": "tsc hpet acpi_pm",
    "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1",
    "/dev/ttyUSB0": "",
}

MakeMachine = Callable[..., Machine]


@pytest.fixture
def make_machine(tmp_path: Path) -> MakeMachine:
    """Return a maker of machines: a good one, with files changed, or left out where None."""

    def make(
        changed: dict[str, str | None] | None = None,
        closed: tuple[str, ...] = (),
        free: int = 1 << 40,
    ) -> Machine:
        for name, text in (GOOD | (changed or {})).items():
            if text is None:
                continue
            path = tmp_path / name.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text + "\n", encoding="utf-8")
        shut = {tmp_path / name.lstrip("/") for name in closed}
        return Machine(tmp_path, lambda path: path not in shut, lambda _: free)

    return make
