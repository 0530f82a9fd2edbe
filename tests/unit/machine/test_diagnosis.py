"""The verdict on a machine: every part in the report, plain numbers for JSON."""

import io
import pwd
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from hilctl.cli.devices import render_diagnosis
from hilctl.machine import diagnosis as checks
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


def test_report_has_all_findings():
    findings = (Finding("kernel", "warn", "PREEMPT_DYNAMIC [none]", "install another"),)
    shown = text_of(Diagnosis(findings, latency([3000, 5000, 2 * MS])))
    for part in ("PREEMPT_DYNAMIC [none]", "-> install another", "refused", "-> rtprio",
                 "from 1024 us", "p99.9", "no, 1000 Hz is not kept"):  # fmt: skip
        assert part in shown


def test_verdict_of_a_rate_that_is_kept():
    kept = Diagnosis((), latency([3000, 5000, 3000]))
    assert kept.verdict == "yes, 1000 Hz is kept: the longest of 3 periods of 1 ms was 1 ms"
    assert kept.to_mapping()["kept"] is True


def test_an_empty_machine_is_no_error(make_machine, tmp_path):
    found = examine(Machine(tmp_path / "nothing"), Realtime(), tmp_path)
    assert all(each.text for each in found)
    assert {each.name: each.level for each in found}["SCHED_FIFO"] == "bad"


def test_facts_for_a_recording(make_machine):
    facts = machine_facts(Realtime(), Path(), make_machine())
    assert facts["machine.kernel"] == "ok: PREEMPT_RT"
    assert len(facts) == 15
    assert not any(" " in name for name in facts)


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


def test_good_machine_has_no_remedies(make_machine):
    found = examine(make_machine(), Realtime(), Path())
    assert {each.level for each in found} == {"ok"}
    assert {each.remedy for each in found} == {""}
    assert len({each.name for each in found}) == len(found) == 15


def test_every_problem_has_a_remedy(make_machine):
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


def fifo(machine):
    return checks.fifo(machine, Realtime(priority=80))


def isolated(cpu):
    return lambda machine: checks.isolated_cpus(machine, Realtime(cpu=cpu))


def governors(*names):
    paths = [f"{CPU}/cpu{number}/cpufreq/scaling_governor" for number in (0, 3)]
    return dict(zip(paths, names, strict=True))


def daemons(*names):
    return {f"/proc/{number}/comm": name for number, name in enumerate(("sh", *names), start=1)}


DYNAMIC = {"/proc/version": "SMP PREEMPT_DYNAMIC"}
VOLUNTARY = DYNAMIC | {"/sys/kernel/debug/sched/preempt": "none (voluntary) full"}
FULL = DYNAMIC | {"/proc/cmdline": "quiet preempt=full"}
RT_FILE = {"/sys/kernel/realtime": "1", "/proc/version": "Linux"}
VIRTUAL = {"/proc/cpuinfo": "flags : hypervisor", "/sys/class/dmi/id/product_name": "KVM"}
SLOW_FTDI = {"/sys/bus/usb-serial/devices/ttyUSB1/latency_timer": "16"}


@pytest.mark.parametrize(
    ("check", "files", "level", "said", "remedy"),
    [
        (checks.preemption, {}, "ok", "PREEMPT_RT", ""),
        (checks.preemption, RT_FILE, "ok", "PREEMPT_RT", ""),
        (checks.preemption, VOLUNTARY, "warn", "voluntary", "preempt=full"),
        (checks.preemption, FULL, "warn", "full preemption", "PREEMPT_RT"),
        (checks.preemption, DYNAMIC, "warn", "not readable", "preempt=full"),
        (checks.preemption, {"/proc/version": "SMP PREEMPT"}, "warn", "PREEMPT", "PREEMPT_RT"),
        (checks.preemption, {"/proc/version": "SMP"}, "warn", "no preemption", "PREEMPT_RT"),
        (fifo, limits("98", "0"), "ok", "up to 98", ""),
        (fifo, limits("79", "0"), "bad", "rtprio limit 79", "rtprio"),
        (fifo, limits("0", "0") | CAPABLE, "ok", "CAP_SYS_NICE", ""),
        (fifo, CAPABLE | GROUP | {SHARE: "0"}, "bad", "no real-time share", "rt_runtime_us"),
        (checks.locked_memory, limits("0", "unlimited"), "ok", "any amount", ""),
        (checks.locked_memory, limits("0", str(8 << 20)), "bad", "8 MB", "memlock"),
        (checks.locked_memory, limits("0", str(8 << 20)) | CAPABLE, "ok", "any amount", ""),
        (checks.throttling, {}, "ok", "950000 of 1000000 us", ""),
        (checks.throttling, {RT: "-1"}, "ok", "off", ""),
        (checks.throttling, {RT: None}, "ok", "none", ""),
        (checks.throttling, {RT: "400000"}, "warn", "400000", "950000"),
        (checks.throttling, GROUP | {SHARE: "100000"}, "warn", "group 100000 us", "950000"),
        (isolated(None), {}, "ok", "without scheduler ticks", ""),
        (isolated(None), {f"{CPU}/nohz_full": "(null)"}, "ok", "nohz_full would", ""),
        (isolated(None), {f"{CPU}/isolated": ""}, "warn", "none", "isolcpus=3"),
        (isolated(9), {}, "bad", "CPU 9 is not online", "realtime.cpu"),
        (checks.governor, governors("performance", "performance"), "ok", "performance", ""),
        (checks.governor, governors("performance", "powersave"), "warn", "powersave", "cpupower"),
        (checks.governor, governors(None, None), "ok", "none", ""),
        (checks.hyperthreads, {f"{CPU}/smt/active": "1"}, "warn", "on", "smt/control"),
        (checks.virtual_machine, VIRTUAL, "warn", "KVM", "machine of their own"),
        (checks.clock_source, {f"{CLOCK}/current_clocksource": "tsc"}, "ok", "tsc", ""),
        (checks.clock_source, {f"{CLOCK}/current_clocksource": "hpet"}, "warn", "hpet", "tsc="),
        (checks.latency_timers, SLOW_FTDI, "bad", "ttyUSB1 16 ms", "latency_timer"),
        (checks.serial_daemons, daemons(), "ok", "none active", ""),
        (checks.serial_daemons, daemons("brltty", "ModemManager"), "warn", "brltty", "brltty"),
    ],
)  # fmt: skip
def test_findings_of_each_check(make_machine, check, files, level, said, remedy):
    found = check(make_machine(files))
    assert found.level == level
    assert said in found.text
    assert remedy in found.remedy
    assert bool(found.remedy) == (level != "ok")


@pytest.mark.parametrize(("check", "path", "level", "remedy"), [
    (checks.dma_latency, "/dev/cpu_dma_latency", "warn", "udev"),
    (checks.serial_ports, "/dev/ttyUSB0", "bad", "usermod"),
])  # fmt: skip
def test_a_device_file_without_permission_is_named(make_machine, check, path, level, remedy):
    assert check(make_machine()).level == "ok"
    found = check(make_machine(closed=(path,)))
    assert found.level == level
    assert path in found.text
    assert remedy in found.remedy


def test_no_file_for_idle_states(tmp_path):
    found = checks.dma_latency(Machine(tmp_path))
    assert (found.level, "manages none" in found.text) == ("ok", True)


@pytest.mark.parametrize(("free", "level"), [(1 << 20, "bad"), (1 << 40, "ok")])
def test_disk_space(make_machine, tmp_path, free, level):
    folder = tmp_path / "not" / "yet"
    assert checks.disk_space(make_machine(free=free), folder).level == level


def test_disk_space_without_a_working_folder(make_machine, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert checks.disk_space(make_machine(), Path("recordings")).level == "bad"
    assert checks.disk_space(make_machine(free=1 << 40), tmp_path).level == "ok"


SYSTEMD = {
    "/run/systemd/system/x": "",
    "/proc/self/status": "Name:\thilctl\nUid:\t1000\t1000\t1000\t1000",
}
CONF = "/etc/systemd/logind.conf"


@pytest.fixture
def login(monkeypatch):
    monkeypatch.setattr(pwd, "getpwuid", lambda _: SimpleNamespace(pw_name="lab"))


@pytest.mark.parametrize(("files", "level"), [
    ({}, "warn"),
    ({CONF: "[Login]\nRemoveIPC=no"}, "ok"),
    ({CONF: "[Login]\n RemoveIPC = false \nKillUserProcesses=no"}, "ok"),
    ({CONF: "RemoveIPC=no", f"{CONF}.d/z.conf": "RemoveIPC=yes"}, "warn"),
    ({"/usr/lib/systemd/logind.conf.d/a.conf": "RemoveIPC=no"}, "ok"),
    ({"/usr/lib/systemd/logind.conf.d/a.conf": "RemoveIPC=no", f"{CONF}.d/a.conf": ""}, "warn"),
    ({"/var/lib/systemd/linger/lab": ""}, "ok"),
    ({"/var/lib/systemd/linger/other": ""}, "warn"),
    ({CONF: "RemoveIPC=no\nKillUserProcesses=yes"}, "warn"),
    ({"/proc/self/status": "Uid:\t0\t0\t0\t0"}, "ok"),
    ({"/run/systemd/system/x": None}, "ok"),
])  # fmt: skip
def test_settings_of_logind_are_evaluated(make_machine, login, files, level):
    found = checks.log_out(make_machine({**SYSTEMD, **files}))
    assert found.level == level
    assert bool(found.remedy) == (level == "warn")
