"""Diagnosis of this computer: checks, and measured timer latency.

A check of a :class:`~hilctl.machine.procfs.Machine` returns its finding and a remedy, which is
empty if there is nothing to do. The loop's own set-up (priority, locked memory, idle states, CPU)
is not checked: the measurement includes its steps, and so does each recording.
"""

import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hilctl.base.types import I64
from hilctl.machine.procfs import Finding, Level, Machine, login_of
from hilctl.machine.rt_setup import ISOLATED, Realtime, cpu_numbers
from hilctl.machine.suspend import SYSTEMD
from hilctl.machine.timer_latency import Latency, measure

_DYNAMIC = "/sys/kernel/debug/sched/preempt"
_CPU = "/sys/devices/system/cpu"
_SERIAL = ("/dev/ttyUSB*", "/dev/ttyACM*")
_SERIAL_DAEMONS = ("ModemManager", "brltty")
_LATENCY_TIMERS = "/sys/bus/usb-serial/devices/*/latency_timer"
_CLOCK_SOURCE = "/sys/devices/system/clocksource/clocksource0/current_clocksource"
_STEADY_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock")
_LITTLE_SPACE_BYTES = 1 << 30
_LOGIND_FOLDERS = ("/usr/lib/systemd", "/usr/local/lib/systemd", "/run/systemd", "/etc/systemd")
"""Folders of its settings; later ones take precedence."""
_SYSTEM_USERS = 999
_NO = {"no", "n", "false", "f", "off", "0"}
_THIS_MACHINE = Machine()

_Found: TypeAlias = tuple[str, str]


def preemption(machine: Machine) -> _Found:
    """Check the kernel's preemption model; PREEMPT_RT is best."""
    version = machine.text("/proc/version") or ""
    if machine.text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return "PREEMPT_RT", ""
    remedy = "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64, or -arm64)"
    if "PREEMPT_DYNAMIC" not in version:
        return "PREEMPT" if "PREEMPT" in version else "no preemption", remedy
    chosen = re.search(r"\((\w+)\)", machine.text(_DYNAMIC) or "")
    asked = re.search(r"\bpreempt=(\w+)", machine.text("/proc/cmdline") or "")
    if not (mode := chosen or asked):
        return (
            "PREEMPT_DYNAMIC, preemption mode not readable",
            f"boot with preempt=full, or {remedy}",
        )
    better = "" if mode[1] == "full" else "boot with preempt=full, or "
    return f"PREEMPT_DYNAMIC, {mode[1]} preemption", better + remedy


def isolated_cpus(machine: Machine) -> _Found:
    """Check whether the loop has a CPU of its own."""
    isolated = cpu_numbers(machine.text(ISOLATED) or "")
    online = cpu_numbers(machine.text(f"{_CPU}/online") or "")
    if not isolated:
        last = online[-1] if len(online) > 1 else "N"
        remedy = f"on several CPUs, boot with isolcpus={last} nohz_full={last}"
        return "none: other programs run on the loop's CPU", remedy
    ticks = (machine.text(f"{_CPU}/nohz_full") or "").replace("(null)", "")
    text = ", ".join(map(str, isolated))
    if set(isolated) <= set(cpu_numbers(ticks)):
        return f"{text}, without scheduler ticks", ""
    return f"{text}; nohz_full would avoid the scheduler's ticks", ""


def governor(machine: Machine) -> _Found:
    """Check the frequency governor of the CPUs."""
    names = {machine.text(path) for path in machine.glob(f"{_CPU}/cpu*/cpufreq/scaling_governor")}
    found = ", ".join(sorted(filter(None, names)))
    fixed = found in {"", "performance"}
    text = found or "none: the kernel does not control the frequency"
    return text, "" if fixed else "cpupower frequency-set --governor performance"


def hyperthreads(machine: Machine) -> _Found:
    """Check whether two threads share a core and slow each other down."""
    if machine.text(f"{_CPU}/smt/active") != "1":
        return "off", ""
    remedy = "isolate both threads of a core, or: echo off > /sys/devices/system/cpu/smt/control"
    return "on: two threads share a core", remedy


def virtual_machine(machine: Machine) -> _Found:
    """Check whether the machine is virtual."""
    product = machine.text("/sys/class/dmi/id/product_name")
    if "hypervisor" not in (machine.text("/proc/cpuinfo") or "").split():
        return product or "not virtual", ""
    kind = machine.text("/sys/hypervisor/type") or product or "a hypervisor"
    return f"virtual ({kind}): the host can stall it", "drive actuators from a dedicated machine"


def clock_source(machine: Machine) -> _Found:
    """Check whether reading the time is fast."""
    source = machine.text(_CLOCK_SOURCE) or "unknown"
    if source in _STEADY_CLOCKS:
        return source, ""
    return f"{source}: slow to read", "boot with tsc=reliable if the machine has a TSC"


def latency_timers(machine: Machine) -> _Found:
    """Check the latency timer of FTDI adapters; by default they hold bytes for up to 16 ms."""
    timers = {
        Path(each).parent.name: machine.number(each) for each in machine.glob(_LATENCY_TIMERS)
    }
    slow = [f"{name} {timer_ms} ms" for name, timer_ms in timers.items() if timer_ms not in {0, 1}]
    if not slow:
        return "1 ms" if timers else "no FTDI adapter", ""
    rule = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'
    return ", ".join(slow), f"a udev rule: {rule}"


def serial_ports(machine: Machine) -> _Found:
    """Check whether this user may open the connected serial ports."""
    ports = [port for pattern in _SERIAL for port in machine.glob(pattern)]
    closed = [port for port in ports if not machine.writable(machine.path(port))]
    if not closed:
        return ", ".join(ports) or "none plugged in", ""
    try:
        group = machine.path(closed[0]).group()
    except (KeyError, OSError):
        group = "dialout"
    remedy = f"sudo usermod --append --groups {group} $USER, and log in again"
    return f"no permission for {', '.join(closed)}", remedy


def serial_daemons(machine: Machine) -> _Found:
    """Check for active daemons that open serial ports."""
    running = {machine.text(path) for path in machine.glob("/proc/[0-9]*/comm")}
    active = [name for name in _SERIAL_DAEMONS if name in running]
    if not active:
        return "none active", ""
    remedy = f"sudo systemctl disable --now {' '.join(active)}"
    return f"{', '.join(active)}: use serial ports that are plugged in", remedy


def disk_space(machine: Machine, folder: Path) -> _Found:
    """Check the free space for recordings; their folder need not exist yet."""
    try:
        place = folder.absolute()
    except FileNotFoundError:
        return f"{folder}: the working folder has been deleted", "change to another one"
    while not place.exists():
        place = place.parent
    free = machine.free_bytes(place)
    remedy = "delete files, or set recording.folder to another disk"
    text = f"{free / 1e9:.1f} GB free for {folder}"
    return text, remedy if free < _LITTLE_SPACE_BYTES else ""


def suspend(machine: Machine) -> _Found:
    """Check whether this computer may suspend during a run."""
    if not (machine.text("/sys/power/state") or "").split():
        return "not supported by this computer", ""
    if machine.path("/etc/systemd/system/sleep.target").is_symlink():
        return "disabled", ""
    if machine.path(SYSTEMD).is_dir() and machine.path("/usr/bin/systemd-inhibit").exists():
        return "inhibited during a run, by logind", ""
    return "possible during a run: no logind inhibits it", "disable it in the system's settings"


def log_out(machine: Machine) -> _Found:
    """Check what systemd-logind does to a run when its user logs out."""
    user = int((machine.status("Uid") or str(os.geteuid())).split()[0])
    if not machine.path(SYSTEMD).is_dir():
        return "no systemd: a log-out removes nothing", ""
    settings = _logind_settings(machine)
    if settings.get("KillUserProcesses", "no").lower() not in _NO:
        text = "ends all processes of a user, background runs too (KillUserProcesses=yes)"
        return text, "put KillUserProcesses=no into /etc/systemd/logind.conf, or run as a service"
    if settings.get("RemoveIPC", "yes").lower() in _NO:
        return "removes nothing (RemoveIPC=no)", ""
    if user <= _SYSTEM_USERS:
        return "removes nothing of a system user", ""
    login = login_of(user) or str(user)
    if machine.path(f"/var/lib/systemd/linger/{login}").exists():
        return "removes nothing while the user lingers", ""
    text = "removes a user's files in /dev/shm, those of active runs too (RemoveIPC=yes)"
    return text, f"sudo loginctl enable-linger {login}"


def _logind_settings(machine: Machine) -> dict[str, str]:
    main = ""
    parts: dict[str, str] = {}
    for folder in _LOGIND_FOLDERS:
        main = machine.text(f"{folder}/logind.conf") or main
        for path in machine.glob(f"{folder}/logind.conf.d/*.conf"):
            parts[path.rsplit("/", 1)[1]] = machine.text(path) or ""
    found = {}
    for text in (main, *(parts[name] for name in sorted(parts))):
        for line in text.splitlines():
            key, equals, value = line.partition("=")
            if equals and not line.lstrip().startswith(("#", ";")):
                found[key.strip()] = value.strip()
    return found


DEFAULT_RATE_HZ = 1000.0
_EDGES_US = np.concatenate([[0], 2 ** np.arange(17)])


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of a diagnosis."""

    findings: tuple[Finding, ...]
    latency: Latency

    @property
    def verdict(self) -> str:
        """Text: whether every period was at most twice the nominal one, and the longest."""
        latency = self.latency
        longest_ms, nominal_ms = latency.longest_period_ns * 1e-6, 1e3 / latency.rate_hz
        said = f"the longest of {latency.late_ns.size} periods of {nominal_ms:g} ms"
        if latency.kept:
            return f"yes, {latency.rate_hz:g} Hz is kept: {said} was {longest_ms:.3g} ms"
        return (
            f"no, {latency.rate_hz:g} Hz is not kept: {said} was {longest_ms:.3g} ms, over twice "
            f"as long; about {latency.kept_rate_hz:.3g} Hz would have been"
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        latency = self.latency
        counts = lateness_counts(latency.late_ns)
        return {
            "kept": latency.kept,
            "verdict": self.verdict,
            "rate_hz": latency.rate_hz,
            "ticks": latency.late_ns.size,
            "longest_period_us": latency.longest_period_ns * 1e-3,
            "late_us": latency.percentiles_us(),
            "late_histogram_us": {str(edge): count for edge, count in counts.items()},
            "steps": [asdict(step) for step in latency.steps],
            "findings": [asdict(finding) for finding in self.findings],
        }


def lateness_counts(late_ns: I64) -> dict[int, int]:
    """Return a histogram of lateness: lower edge of each bin in us, a power of two, to its count.

    Bins above the last occupied one are omitted; the last possible bin has no upper edge.
    """
    late_us = np.clip(late_ns // 1000, 0, int(_EDGES_US[-1]))
    counts, _ = np.histogram(late_us, _EDGES_US)
    used = int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0
    return dict(zip(_EDGES_US[:used].tolist(), counts[:used].tolist(), strict=True))


def examine(machine: Machine, folder: Path) -> tuple[Finding, ...]:
    """Return the results of all checks; nothing is measured, and no device is opened."""
    found: dict[str, tuple[Level, _Found]] = {
        "kernel": ("warn", preemption(machine)),
        "isolated CPUs": ("warn", isolated_cpus(machine)),
        "CPU governor": ("warn", governor(machine)),
        "SMT": ("warn", hyperthreads(machine)),
        "hardware": ("warn", virtual_machine(machine)),
        "clock source": ("warn", clock_source(machine)),
        "FTDI latency": ("bad", latency_timers(machine)),
        "serial ports": ("bad", serial_ports(machine)),
        "serial daemons": ("warn", serial_daemons(machine)),
        "recordings": ("bad", disk_space(machine, folder)),
        "log-out": ("warn", log_out(machine)),
        "suspend": ("warn", suspend(machine)),
    }
    return tuple(
        Finding(name, level if remedy else "ok", text, remedy)
        for name, (level, (text, remedy)) in found.items()
    )


def machine_facts(folder: Path, machine: Machine = _THIS_MACHINE) -> dict[str, str]:
    """Return the results of all checks as metadata of a recording, such as ``machine.kernel``."""
    return {
        f"machine.{each.name.replace(' ', '_').lower()}": f"{each.level}: {each.text}"
        for each in examine(machine, folder)
    }


def diagnose(
    rate_hz: float,
    settings: Realtime,
    folder: Path,
    seconds: float,
    on_progress: Callable[[float], None],
) -> Diagnosis:
    """Check this machine, and measure the timer latency of a process set up like the loop.

    Raises:
        InputError: The rate is out of range.
        RunError: The measurement failed.
    """
    found = examine(Machine(), folder)
    return Diagnosis(found, measure(rate_hz, seconds, settings, on_progress))
