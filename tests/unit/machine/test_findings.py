"""What each check makes of a machine's files."""

from pathlib import Path

import pytest

from hilctl.machine import findings
from hilctl.machine.diagnosis import examine
from hilctl.machine.settings import Realtime

CPU = "/sys/devices/system/cpu"
CLOCK = "/sys/devices/system/clocksource/clocksource0"
RT = "/proc/sys/kernel/sched_rt_runtime_us"
SHARE = "/sys/fs/cgroup/cpu/cpu.rt_runtime_us"
GROUP = {"/proc/self/cgroup": "1:cpu:/"}
CAPABLE = {"/proc/self/status": "CapEff:\t000001ffffffffff"}


def limits(rtprio: str, memlock: str) -> dict[str, str]:
    """Return /proc/self/limits with these soft limits."""
    text = (
        f"Max locked memory         {memlock:20} unlimited            bytes\n"
        f"Max realtime priority     {rtprio:20} 99\n"
    )
    return {"/proc/self/limits": text}


def check(function, machine, *arguments):
    """Return level, text and remedy of one check."""
    found = function(machine, *arguments)
    return found.level, found.text, found.remedy


def test_a_good_machine_has_nothing_to_mend(make_machine):
    """On a real-time kernel with all rights, every check is ok and asks for nothing."""
    found = examine(make_machine(), Realtime(), Path())
    assert {each.level for each in found} == {"ok"}
    assert {each.remedy for each in found} == {""}
    assert len({each.name for each in found}) == len(found) == 15


def test_every_trouble_has_a_remedy(make_machine):
    """Each finding that is not ok says what to do, on a machine with nothing right."""
    machine = make_machine(
        {
            "/proc/version": "Linux version 6.1 #1 SMP PREEMPT_DYNAMIC",
            **limits("0", "8388608"),
            "/run/systemd/system/x": "",
            "/proc/self/status": "Uid:\t1000\t1000",
            RT: "100000",
            f"{CPU}/isolated": "",
            f"{CPU}/smt/active": "1",
            f"{CPU}/cpu0/cpufreq/scaling_governor": "powersave",
            "/proc/cpuinfo": "flags : fpu hypervisor",
            f"{CLOCK}/current_clocksource": "hpet",
            "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16",
            "/proc/1/comm": "ModemManager",
        },
        closed=("/dev/cpu_dma_latency", "/dev/ttyUSB0"),
        free=1000,
    )
    found = examine(machine, Realtime(), Path())
    assert "ok" not in {each.level for each in found}
    assert all(each.remedy for each in found)


@pytest.mark.parametrize(
    ("files", "level", "said", "remedy"),
    [
        ({}, "ok", "PREEMPT_RT", ""),
        ({"/sys/kernel/realtime": "1", "/proc/version": "Linux"}, "ok", "PREEMPT_RT", ""),
        (
            {
                "/proc/version": "SMP PREEMPT_DYNAMIC",
                "/sys/kernel/debug/sched/preempt": "none (voluntary) full",
            },
            "warn",
            "voluntary",
            "preempt=full",
        ),
        (
            {"/proc/version": "SMP PREEMPT_DYNAMIC", "/proc/cmdline": "quiet preempt=full"},
            "warn",
            "full preemption",
            "PREEMPT_RT",
        ),
        ({"/proc/version": "SMP PREEMPT_DYNAMIC"}, "warn", "not readable", "preempt=full"),
        ({"/proc/version": "SMP PREEMPT"}, "warn", "PREEMPT", "PREEMPT_RT"),
        ({"/proc/version": "SMP"}, "warn", "no preemption", "PREEMPT_RT"),
    ],
)
def test_kernel(make_machine, files, level, said, remedy):
    """The preemption model is read from wherever the kernel tells it."""
    found = check(findings.preemption, make_machine(files))
    assert found[0] == level
    assert said in found[1]
    assert remedy in found[2]


@pytest.mark.parametrize(
    ("files", "level", "said"),
    [
        (limits("98", "0"), "ok", "up to 98"),
        (limits("unlimited", "0"), "ok", "unlimited"),
        (limits("79", "0"), "bad", "rtprio limit 79"),
        (limits("0", "0") | CAPABLE, "ok", "CAP_SYS_NICE"),
        (CAPABLE | GROUP | {SHARE: "0"}, "bad", "no real-time share"),
        (CAPABLE | GROUP | {SHARE: "950000"}, "ok", "CAP_SYS_NICE"),
    ],
)
def test_fifo(make_machine, files, level, said):
    """SCHED_FIFO needs the capability or the limit, and a share of the control group's CPU."""
    found = check(findings.fifo, make_machine(files), Realtime(priority=80))
    assert (found[0], said in found[1]) == (level, True)


@pytest.mark.parametrize(
    ("files", "level"),
    [
        (limits("0", "unlimited"), "ok"),
        (limits("0", str(2 << 30)), "ok"),
        (limits("0", str(8 << 20)), "bad"),
        (limits("0", str(8 << 20)) | CAPABLE, "ok"),
    ],
)
def test_locked_memory(make_machine, files, level):
    """Memory may be locked with the capability, or with a limit that is large enough."""
    assert check(findings.locked_memory, make_machine(files))[0] == level


@pytest.mark.parametrize(
    ("files", "level", "said"),
    [
        ({}, "ok", "950000 of 1000000 us"),
        ({RT: "-1"}, "ok", "off"),
        ({RT: None}, "ok", "none"),
        ({RT: "400000"}, "warn", "400000"),
        (GROUP | {SHARE: "100000"}, "warn", "this control group 100000 us"),
    ],
)
def test_throttling(make_machine, files, level, said):
    """A share of half a CPU or more is enough for a loop that sleeps."""
    found = check(findings.throttling, make_machine(files))
    assert (found[0], said in found[1]) == (level, True)


@pytest.mark.parametrize(
    ("files", "cpu", "level", "said"),
    [
        ({}, None, "ok", "without scheduler ticks"),
        ({f"{CPU}/nohz_full": "(null)"}, None, "ok", "nohz_full would"),
        ({f"{CPU}/isolated": ""}, None, "warn", "none"),
        ({}, 2, "ok", "3"),
        ({}, 9, "bad", "CPU 9 is not online"),
    ],
)
def test_isolated_cpus(make_machine, files, cpu, level, said):
    """A CPU of the loop's own is found, and one that is not there is refused."""
    found = check(findings.isolated_cpus, make_machine(files), Realtime(cpu=cpu))
    assert (found[0], said in found[1]) == (level, True)
