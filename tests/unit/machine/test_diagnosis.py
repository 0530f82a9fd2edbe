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
from hilctl.machine.rt_setup import SetUpStep
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
    found = examine(Machine(tmp_path / "nothing"), tmp_path)
    assert all(each.text for each in found)
    assert {each.name: each.level for each in found}["kernel"] == "warn"


def test_facts_for_a_recording(make_machine):
    facts = machine_facts(Path(), make_machine())
    assert facts["machine.kernel"] == "ok: PREEMPT_RT"
    assert len(facts) == 12
    assert not any(" " in name for name in facts)


CPU = "/sys/devices/system/cpu"
CLOCK = "/sys/devices/system/clocksource/clocksource0"


def test_good_machine_has_no_remedies(make_machine):
    found = examine(make_machine(), Path())
    assert {each.level for each in found} == {"ok"}
    assert {each.remedy for each in found} == {""}
    assert len({each.name for each in found}) == len(found) == 12


def test_every_problem_has_a_remedy(make_machine):
    machine = make_machine(
        {
            "/proc/version": "Linux version 6.1 #1 SMP PREEMPT_DYNAMIC",
            "/run/systemd/system/x": "",
            "/proc/self/status": "Uid:\t1000\t1000",
            f"{CPU}/isolated": "",
            f"{CPU}/smt/active": "1",
            f"{CPU}/cpu0/cpufreq/scaling_governor": "powersave",
            "/proc/cpuinfo": "flags : fpu hypervisor",
            f"{CLOCK}/current_clocksource": "hpet",
            "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16",
            "/proc/1/comm": "ModemManager",
            "/sys/power/state": "freeze mem",
        },
        closed=("/dev/ttyUSB0",),
        free=1000,
    )
    found = examine(machine, Path())
    assert "ok" not in {each.level for each in found}
    assert all(each.remedy for each in found)


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
    ("check", "files", "said", "remedy"),
    [
        (checks.preemption, {}, "PREEMPT_RT", ""),
        (checks.preemption, RT_FILE, "PREEMPT_RT", ""),
        (checks.preemption, VOLUNTARY, "voluntary", "preempt=full"),
        (checks.preemption, FULL, "full preemption", "PREEMPT_RT"),
        (checks.preemption, DYNAMIC, "not readable", "preempt=full"),
        (checks.preemption, {"/proc/version": "SMP PREEMPT"}, "PREEMPT", "PREEMPT_RT"),
        (checks.preemption, {"/proc/version": "SMP"}, "no preemption", "PREEMPT_RT"),
        (checks.isolated_cpus, {}, "without scheduler ticks", ""),
        (checks.isolated_cpus, {f"{CPU}/nohz_full": "(null)"}, "nohz_full would", ""),
        (checks.isolated_cpus, {f"{CPU}/isolated": ""}, "none", "isolcpus=3"),
        (checks.governor, governors("performance", "performance"), "performance", ""),
        (checks.governor, governors("performance", "powersave"), "powersave", "cpupower"),
        (checks.governor, governors(None, None), "none", ""),
        (checks.hyperthreads, {f"{CPU}/smt/active": "1"}, "on", "smt/control"),
        (checks.virtual_machine, VIRTUAL, "KVM", "dedicated machine"),
        (checks.clock_source, {f"{CLOCK}/current_clocksource": "tsc"}, "tsc", ""),
        (checks.clock_source, {f"{CLOCK}/current_clocksource": "hpet"}, "hpet", "tsc="),
        (checks.latency_timers, SLOW_FTDI, "ttyUSB1 16 ms", "latency_timer"),
        (checks.serial_daemons, daemons(), "none active", ""),
        (checks.serial_daemons, daemons("brltty", "ModemManager"), "brltty", "brltty"),
    ],
)  # fmt: skip
def test_findings_of_each_check(make_machine, check, files, said, remedy):
    text, advised = check(make_machine(files))
    assert said in text
    assert remedy in advised
    assert bool(advised) == bool(remedy)


def test_a_serial_port_without_permission_is_named(make_machine):
    assert not checks.serial_ports(make_machine())[1]
    text, remedy = checks.serial_ports(make_machine(closed=("/dev/ttyUSB0",)))
    assert "/dev/ttyUSB0" in text
    assert "usermod" in remedy


@pytest.mark.parametrize(("free", "enough"), [(1 << 20, False), (1 << 40, True)])
def test_disk_space(make_machine, tmp_path, free, enough):
    folder = tmp_path / "not" / "yet"
    assert (not checks.disk_space(make_machine(free=free), folder)[1]) == enough


def test_disk_space_without_a_working_folder(make_machine, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert checks.disk_space(make_machine(), Path("recordings"))[1]
    assert not checks.disk_space(make_machine(free=1 << 40), tmp_path)[1]


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
    _, remedy = checks.log_out(make_machine({**SYSTEMD, **files}))
    assert bool(remedy) == (level == "warn")


@pytest.mark.parametrize(("files", "level"), [
    ({}, "ok"),
    ({"/sys/power/state": ""}, "ok"),
    ({"/sys/power/state": "freeze mem"}, "warn"),
    ({"/sys/power/state": "freeze mem", "/usr/bin/systemd-inhibit": ""}, "warn"),
    ({"/sys/power/state": "mem", "/usr/bin/systemd-inhibit": "", **SYSTEMD}, "ok"),
])  # fmt: skip
def test_suspend_needs_an_inhibitor(make_machine, files, level):
    _, remedy = checks.suspend(make_machine(files))
    assert bool(remedy) == (level == "warn")


def test_a_masked_suspend_needs_none(tmp_path):
    for folder in ("sys/power", "etc/systemd/system"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "sys/power/state").write_text("mem")
    (tmp_path / "etc/systemd/system/sleep.target").symlink_to("/dev/null")
    assert checks.suspend(Machine(tmp_path)) == ("disabled", "")
