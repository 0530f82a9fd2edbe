"""Diagnosis of this computer: checks, and measured timer latency.

The checks are of kernel, user limits, CPUs, clocks, serial ports, disks and log-out, each a
function of a :class:`~hilctl.machine.procfs.Machine`.
"""

import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.types import I64
from hilctl.machine.procfs import CAP_IPC_LOCK, Finding, Machine
from hilctl.machine.rt_setup import (
    DMA_REMEDY,
    GROUP_REMEDY,
    ISOLATED,
    MEMORY_REMEDY,
    PRIORITY_REMEDY,
    RT_PERIOD,
    RT_RUNTIME,
    Realtime,
    cpu_numbers,
    rt_group_runtime_us,
)
from hilctl.machine.syscalls import DMA_LATENCY
from hilctl.machine.timer_latency import Latency, measure

_CAP_SYS_NICE = 23
_ENOUGH_LOCKED_BYTES = 1 << 30
_DYNAMIC = "/sys/kernel/debug/sched/preempt"
_CPU = "/sys/devices/system/cpu"
_SERIAL = ("/dev/ttyUSB*", "/dev/ttyACM*")
_SERIAL_DAEMONS = ("ModemManager", "brltty")
_LATENCY_TIMERS = "/sys/bus/usb-serial/devices/*/latency_timer"
_LONG_LATENCY_MS = 1
_LITTLE_SPACE_BYTES = 1 << 30
_STEADY_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock")
_LOGIND_FOLDERS = ("/usr/lib/systemd", "/usr/local/lib/systemd", "/run/systemd", "/etc/systemd")
"""Folders of its settings; later ones take precedence."""
_SYSTEM_USERS = 999
_NO = {"no", "n", "false", "f", "off", "0"}
_THIS_MACHINE = Machine()


def preemption(machine: Machine) -> Finding:
    """Check the kernel's preemption model; PREEMPT_RT is best."""
    version = machine.text("/proc/version") or ""
    if machine.text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel", "ok", "PREEMPT_RT")
    remedy = "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64, or -arm64)"
    if "PREEMPT_DYNAMIC" in version:
        chosen = re.search(r"\((\w+)\)", machine.text(_DYNAMIC) or "")
        asked = re.search(r"\bpreempt=(\w+)", machine.text("/proc/cmdline") or "")
        mode = (chosen or asked or [""] * 2)[1]
        if mode == "full":
            return Finding("kernel", "warn", "PREEMPT_DYNAMIC, full preemption", remedy)
        known = f"{mode} preemption" if mode else "preemption mode not readable"
        text = f"PREEMPT_DYNAMIC, {known}"
        return Finding("kernel", "warn", text, f"boot with preempt=full, or {remedy}")
    model = "PREEMPT" if "PREEMPT" in version else "no preemption"
    return Finding("kernel", "warn", model, remedy)


def fifo(machine: Machine, settings: Realtime) -> Finding:
    """Check whether SCHED_FIFO is allowed at the requested priority."""
    wanted = settings.priority
    if rt_group_runtime_us(machine.read) == 0:
        text = "this control group has no real-time share"
        return Finding("SCHED_FIFO", "bad", text, GROUP_REMEDY)
    if machine.capable(_CAP_SYS_NICE):
        return Finding("SCHED_FIFO", "ok", f"priority {wanted} allowed (CAP_SYS_NICE)")
    limit = machine.limit("Max realtime priority")
    if limit is None or limit >= wanted:
        shown = "unlimited" if limit is None else f"up to {limit}"
        return Finding("SCHED_FIFO", "ok", f"priority {wanted} allowed ({shown})")
    detail = f"rtprio limit {limit}, {wanted} is wanted"
    return Finding("SCHED_FIFO", "bad", detail, PRIORITY_REMEDY)


def locked_memory(machine: Machine) -> Finding:
    """Check whether all memory may be locked."""
    limit = machine.limit("Max locked memory")
    if machine.capable(CAP_IPC_LOCK):
        return Finding("locked memory", "ok", "any amount (CAP_IPC_LOCK)")
    if limit is None or limit >= _ENOUGH_LOCKED_BYTES:
        text = "any amount" if limit is None else f"{limit >> 20} MB"
        return Finding("locked memory", "ok", text)
    return Finding("locked memory", "bad", f"limit {limit >> 20} MB", MEMORY_REMEDY)


def throttling(machine: Machine) -> Finding:
    """Check the CPU share of real-time tasks; the loop sleeps, so it needs little."""
    runtime_us, period_us = machine.number(RT_RUNTIME), machine.number(RT_PERIOD)
    group_us = rt_group_runtime_us(machine.read)
    if runtime_us is None:
        return Finding("RT throttling", "ok", "none in this kernel")
    text = "off" if runtime_us < 0 else f"{runtime_us} of {period_us} us"
    if group_us is not None:
        text += f", this control group {group_us} us"
    share = min(us for us in (runtime_us, group_us, period_us) if us is not None and us >= 0)
    if period_us and share < period_us // 2:
        remedy = f"sysctl kernel.sched_rt_runtime_us={period_us * 95 // 100}, and the group's share"
        return Finding("RT throttling", "warn", text, remedy)
    return Finding("RT throttling", "ok", text)


def dma_latency(machine: Machine) -> Finding:
    """Check whether slow idle states can be disabled."""
    path = machine.path(DMA_LATENCY)
    if not path.exists():
        return Finding("idle states", "ok", f"no {DMA_LATENCY}: the kernel manages none")
    if machine.writable(path):
        return Finding("idle states", "ok", f"{DMA_LATENCY} can be held at 0")
    return Finding("idle states", "warn", f"no permission for {DMA_LATENCY}", DMA_REMEDY)


def isolated_cpus(machine: Machine, settings: Realtime) -> Finding:
    """Check whether the loop has a CPU of its own."""
    name = "isolated CPUs"
    isolated = cpu_numbers(machine.text(ISOLATED) or "")
    ticks = machine.text("/sys/devices/system/cpu/nohz_full") or ""
    online = cpu_numbers(machine.text("/sys/devices/system/cpu/online") or "")
    if settings.cpu is not None and online and settings.cpu not in online:
        remedy = f"realtime.cpu must be one of {', '.join(map(str, online))}"
        return Finding(name, "bad", f"CPU {settings.cpu} is not online", remedy)
    if not isolated:
        last = online[-1] if len(online) > 1 else None
        remedy = f"boot with isolcpus={last} nohz_full={last}" if last else ""
        return Finding(name, "warn", "none: other programs run on the loop's CPU", remedy)
    text = ", ".join(map(str, isolated))
    if set(isolated) <= set(cpu_numbers(ticks if ticks != "(null)" else "")):
        return Finding(name, "ok", f"{text}, without scheduler ticks")
    return Finding(name, "ok", f"{text}; nohz_full would spare it the scheduler's ticks")


def governor(machine: Machine) -> Finding:
    """Check the frequency governor of the CPUs."""
    names = {machine.text(path) for path in machine.glob(f"{_CPU}/cpu*/cpufreq/scaling_governor")}
    governors = sorted(filter(None, names))
    if not governors:
        return Finding("CPU governor", "ok", "none: the kernel does not control the frequency")
    text = ", ".join(governors)
    if governors == ["performance"]:
        return Finding("CPU governor", "ok", text)
    return Finding("CPU governor", "warn", text, "cpupower frequency-set --governor performance")


def hyperthreads(machine: Machine) -> Finding:
    """Check whether two threads share a core and slow each other down."""
    if machine.text(f"{_CPU}/smt/active") == "1":
        remedy = (
            "isolate both threads of a core, or: echo off > /sys/devices/system/cpu/smt/control"
        )
        return Finding("SMT", "warn", "on: two threads share a core", remedy)
    return Finding("SMT", "ok", "off")


def virtual_machine(machine: Machine) -> Finding:
    """Check whether the machine is virtual."""
    flags = machine.text("/proc/cpuinfo") or ""
    product = machine.text("/sys/class/dmi/id/product_name")
    kind = machine.text("/sys/hypervisor/type") or product or "a hypervisor"
    if "hypervisor" in flags.split():
        remedy = "drive real actuators from a machine of their own"
        return Finding("hardware", "warn", f"virtual ({kind}): the host can stall it", remedy)
    return Finding("hardware", "ok", product or "not virtual")


def clock_source(machine: Machine) -> Finding:
    """Check whether reading the time is fast."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = machine.text(f"{folder}/current_clocksource") or "unknown"
    if source in _STEADY_CLOCKS:
        return Finding("clock source", "ok", source)
    have = machine.text(f"{folder}/available_clocksource") or ""
    remedy = "boot with tsc=reliable" if "tsc" in have.split() else ""
    return Finding("clock source", "warn", f"{source}: slow to read", remedy)


def latency_timers(machine: Machine) -> Finding:
    """Check the latency timer of FTDI adapters; by default they hold bytes for up to 16 ms."""
    slow = []
    paths = machine.glob(_LATENCY_TIMERS)
    for path in paths:
        timer_ms = machine.number(path)
        if timer_ms is None or timer_ms > _LONG_LATENCY_MS:
            slow.append(f"{Path(path).parent.name} {timer_ms} ms")
    if slow:
        remedy = (
            'a udev rule: ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
            'ATTR{latency_timer}="1"'
        )
        return Finding("FTDI latency", "bad", ", ".join(slow), remedy)
    return Finding("FTDI latency", "ok", "1 ms" if paths else "no FTDI adapter")


def serial_ports(machine: Machine) -> Finding:
    """Check whether this user may open the connected serial ports."""
    ports = [port for pattern in _SERIAL for port in machine.glob(pattern)]
    closed = [port for port in ports if not machine.writable(machine.path(port))]
    if closed:
        group = _group_of(machine.path(closed[0]))
        remedy = f"sudo usermod --append --groups {group} $USER, and log in anew"
        return Finding("serial ports", "bad", f"no permission for {', '.join(closed)}", remedy)
    return Finding("serial ports", "ok", ", ".join(ports) or "none plugged in")


def serial_daemons(machine: Machine) -> Finding:
    """Check for active daemons that open serial ports."""
    running = {machine.text(path) for path in machine.glob("/proc/[0-9]*/comm")}
    active = [name for name in _SERIAL_DAEMONS if name in running]
    if not active:
        return Finding("serial daemons", "ok", "none active")
    verb = "read and write" if len(active) > 1 else "reads and writes"
    text = f"{' and '.join(active)} {verb} serial ports that are plugged in"
    remedy = f"sudo systemctl disable --now {' '.join(active)}"
    return Finding("serial daemons", "warn", text, remedy)


def _group_of(path: Path) -> str:
    import grp

    try:
        return grp.getgrgid(path.stat().st_gid).gr_name
    except (KeyError, OSError):
        return "dialout"


def disk_space(machine: Machine, folder: Path) -> Finding:
    """Check the free space for recordings; their folder need not exist yet."""
    try:
        place = folder.absolute()
    except FileNotFoundError:
        said = f"{folder}: the working folder has been deleted"
        return Finding("recordings", "bad", said, "change to another one")
    while not place.exists():
        place = place.parent
    free = machine.free_bytes(place)
    text = f"{free / 1e9:.1f} GB free for {folder}"
    if free < _LITTLE_SPACE_BYTES:
        remedy = "make room, or set recording.folder to another disk"
        return Finding("recordings", "bad", text, remedy)
    return Finding("recordings", "ok", text)


def log_out(machine: Machine) -> Finding:
    """Check what systemd-logind does to a run when its user logs out."""
    name = "log-out"
    user = int((machine.status("Uid") or str(os.geteuid())).split()[0])
    if not machine.path("/run/systemd/system").is_dir():
        return Finding(name, "ok", "no systemd: a log-out removes nothing")
    settings = _logind_settings(machine)
    if settings.get("KillUserProcesses", "no").lower() not in _NO:
        text = "ends all processes of a user, background runs too (KillUserProcesses=yes)"
        remedy = "put KillUserProcesses=no into /etc/systemd/logind.conf, or run as a service"
        return Finding(name, "warn", text, remedy)
    if settings.get("RemoveIPC", "yes").lower() in _NO:
        return Finding(name, "ok", "removes nothing (RemoveIPC=no)")
    if user <= _SYSTEM_USERS:
        return Finding(name, "ok", "removes nothing of a system user")
    import pwd  # Windows, on which offline commands import this module, has none

    try:
        login = pwd.getpwuid(user).pw_name
    except KeyError:
        login = str(user)
    if machine.path(f"/var/lib/systemd/linger/{login}").exists():
        return Finding(name, "ok", "removes nothing while the user lingers")
    text = "removes a user's files in /dev/shm, those of active runs too (RemoveIPC=yes)"
    return Finding(name, "warn", text, f"sudo loginctl enable-linger {login}")


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


def examine(machine: Machine, settings: Realtime, folder: Path) -> tuple[Finding, ...]:
    """Return the results of all checks; nothing is measured, and no device is opened."""
    return (
        preemption(machine),
        fifo(machine, settings),
        locked_memory(machine),
        throttling(machine),
        dma_latency(machine),
        isolated_cpus(machine, settings),
        governor(machine),
        hyperthreads(machine),
        virtual_machine(machine),
        clock_source(machine),
        latency_timers(machine),
        serial_ports(machine),
        serial_daemons(machine),
        disk_space(machine, folder),
        log_out(machine),
    )


def machine_facts(
    settings: Realtime, folder: Path, machine: Machine = _THIS_MACHINE
) -> dict[str, str]:
    """Return the results of all checks as metadata of a recording, such as ``machine.kernel``."""
    return {
        f"machine.{each.name.replace(' ', '_').lower()}": f"{each.level}: {each.text}"
        for each in examine(machine, settings, folder)
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
    found = examine(Machine(), settings, folder)
    return Diagnosis(found, measure(rate_hz, seconds, settings, on_progress))
