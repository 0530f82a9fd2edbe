"""What each check makes of a machine's files."""

import pwd
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.machine import checks
from hilctl.machine.diagnosis import examine
from hilctl.machine.procfs import Machine
from hilctl.machine.rt_setup import Realtime

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
    found = examine(make_machine(), Realtime(), Path())
    assert {each.level for each in found} == {"ok"}
    assert {each.remedy for each in found} == {""}
    assert len({each.name for each in found}) == len(found) == 15


def test_every_trouble_has_a_remedy(make_machine):
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
    found = check(checks.preemption, make_machine(files))
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
    found = check(checks.fifo, make_machine(files), Realtime(priority=80))
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
    assert check(checks.locked_memory, make_machine(files))[0] == level


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
    found = check(checks.throttling, make_machine(files))
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
    found = check(checks.isolated_cpus, make_machine(files), Realtime(cpu=cpu))
    assert (found[0], said in found[1]) == (level, True)


def test_idle_states(make_machine):
    closed = make_machine(closed=("/dev/cpu_dma_latency",))
    assert check(checks.dma_latency, closed)[0] == "warn"
    assert check(checks.dma_latency, make_machine())[0] == "ok"


def test_no_file_for_idle_states(tmp_path):
    found = check(checks.dma_latency, Machine(tmp_path))
    assert (found[0], "manages none" in found[1]) == ("ok", True)


@pytest.mark.parametrize(
    ("governors", "level"),
    [
        (["performance", "performance"], "ok"),
        (["performance", "powersave"], "warn"),
        (["schedutil", "schedutil"], "warn"),
        ([None, None], "ok"),
    ],
)
def test_governor(make_machine, governors, level):
    files = {
        f"{CPU}/cpu{n}/cpufreq/scaling_governor": g for n, g in zip((0, 3), governors, strict=True)
    }
    assert check(checks.governor, make_machine(files))[0] == level


def test_smt(make_machine):
    assert check(checks.hyperthreads, make_machine())[0] == "ok"
    assert check(checks.hyperthreads, make_machine({f"{CPU}/smt/active": "1"}))[0] == "warn"


def test_virtual_machine(make_machine):
    files = {"/proc/cpuinfo": "flags : hypervisor", "/sys/class/dmi/id/product_name": "KVM"}
    level, said, _ = check(checks.virtual_machine, make_machine(files))
    assert (level, "KVM" in said) == ("warn", True)


@pytest.mark.parametrize(
    ("source", "level", "remedy"), [("tsc", "ok", ""), ("hpet", "warn", "boot with tsc=reliable")]
)
def test_clock_source(make_machine, source, level, remedy):
    found = check(checks.clock_source, make_machine({f"{CLOCK}/current_clocksource": source}))
    assert (found[0], found[2]) == (level, remedy)


def test_ftdi_latency(make_machine):
    slow = {"/sys/bus/usb-serial/devices/ttyUSB1/latency_timer": "16"}
    level, said, remedy = check(checks.latency_timers, make_machine(slow))
    assert (level, said) == ("bad", "ttyUSB1 16 ms")
    assert "latency_timer" in remedy


@pytest.mark.parametrize(
    ("active", "level"),
    [((), "ok"), (("ModemManager",), "warn"), (("brltty", "ModemManager"), "warn")],
)
def test_serial_daemons(make_machine, active, level):
    files = {f"/proc/{number}/comm": name for number, name in enumerate(("sh", *active), start=1)}
    found, said, remedy = check(checks.serial_daemons, make_machine(files))
    assert found == level
    for name in active:
        assert name in said
        assert name in remedy


def test_serial_ports(make_machine):
    """A port that this user may not open is bad, and its group named."""
    level, said, remedy = check(checks.serial_ports, make_machine(closed=("/dev/ttyUSB0",)))
    assert (level, "/dev/ttyUSB0" in said) == ("bad", True)
    assert "usermod" in remedy


@pytest.mark.parametrize(("free", "level"), [(1 << 20, "bad"), (1 << 40, "ok")])
def test_disk_space(make_machine, tmp_path, free, level):
    folder = tmp_path / "not" / "yet"
    assert check(checks.disk_space, make_machine(free=free), folder)[0] == level


def test_disk_space_without_a_working_folder(make_machine, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert check(checks.disk_space, make_machine(), Path("recordings"))[0] == "bad"
    assert check(checks.disk_space, make_machine(free=1 << 40), tmp_path)[0] == "ok"


SYSTEMD = {
    "/run/systemd/system/x": "",
    "/proc/self/status": "Name:\thilctl\nUid:\t1000\t1000\t1000\t1000",
}
CONF = "/etc/systemd/logind.conf"


@pytest.fixture
def login(monkeypatch):
    monkeypatch.setattr(pwd, "getpwuid", lambda _: SimpleNamespace(pw_name="lab"))


@pytest.mark.parametrize(
    ("files", "level"),
    [
        ({}, "warn"),
        ({CONF: "[Login]\n#RemoveIPC=no\n"}, "warn"),
        ({CONF: "[Login]\nRemoveIPC=no"}, "ok"),
        ({CONF: "[Login]\n RemoveIPC = false \nKillUserProcesses=no"}, "ok"),
        ({CONF: "RemoveIPC=no", f"{CONF}.d/z.conf": "RemoveIPC=yes"}, "warn"),
        ({"/usr/lib/systemd/logind.conf.d/a.conf": "RemoveIPC=no"}, "ok"),
        ({"/usr/lib/systemd/logind.conf.d/a.conf": "RemoveIPC=no", f"{CONF}.d/a.conf": ""}, "warn"),
        ({"/var/lib/systemd/linger/lab": ""}, "ok"),
        ({"/var/lib/systemd/linger/other": ""}, "warn"),
        ({CONF: "RemoveIPC=no\nKillUserProcesses=yes"}, "warn"),
        ({"/proc/self/status": "Uid:\t0\t0\t0\t0"}, "ok"),
        ({"/proc/self/status": "Uid:\t998\t998\t998\t998"}, "ok"),
        ({"/run/systemd/system/x": None}, "ok"),
    ],
)
def test_what_logind_is_set_to(make_machine, login, files, level):
    found = checks.log_out(make_machine({**SYSTEMD, **files}))
    assert found.level == level
    assert bool(found.remedy) == (level == "warn")
