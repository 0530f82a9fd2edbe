"""What the kernel and this user's limits allow: one function a check."""

import re

from hilctl.machine.procfs import Finding, Machine
from hilctl.machine.rt_setup import (
    ISOLATED,
    LIMITS_FILE,
    PRIORITY_REMEDY,
    RT_PERIOD,
    RT_RUNTIME,
    cpu_numbers,
    rt_group_runtime_us,
)
from hilctl.machine.settings import Realtime
from hilctl.machine.syscalls import DMA_LATENCY

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_ENOUGH_LOCKED_BYTES = 1 << 30
_DYNAMIC = "/sys/kernel/debug/sched/preempt"


def preemption(machine: Machine) -> Finding:
    """Which preemption model the kernel has; PREEMPT_RT is what real time wants."""
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
    """Whether SCHED_FIFO may be had at the priority that is asked for."""
    wanted = settings.priority
    if rt_group_runtime_us(machine.read) == 0:
        remedy = "write 950000 to its cpu.rt_runtime_us, or boot with rt_group_sched=0"
        return Finding("SCHED_FIFO", "bad", "this control group has no real-time share", remedy)
    if machine.capable(_CAP_SYS_NICE):
        return Finding("SCHED_FIFO", "ok", f"priority {wanted} allowed (CAP_SYS_NICE)")
    limit = machine.limit("Max realtime priority")
    if limit is None or limit >= wanted:
        shown = "unlimited" if limit is None else f"up to {limit}"
        return Finding("SCHED_FIFO", "ok", f"priority {wanted} allowed ({shown})")
    detail = f"rtprio limit {limit}, {wanted} is wanted"
    return Finding("SCHED_FIFO", "bad", detail, PRIORITY_REMEDY)


def locked_memory(machine: Machine) -> Finding:
    """Whether all memory may be locked."""
    limit = machine.limit("Max locked memory")
    if machine.capable(_CAP_IPC_LOCK):
        return Finding("locked memory", "ok", "any amount (CAP_IPC_LOCK)")
    if limit is None or limit >= _ENOUGH_LOCKED_BYTES:
        return Finding(
            "locked memory", "ok", "any amount" if limit is None else f"{limit >> 20} MB"
        )
    remedy = f"put '@realtime - memlock unlimited' into {LIMITS_FILE}, join that group, log in anew"
    return Finding("locked memory", "bad", f"limit {limit >> 20} MB", remedy)


def throttling(machine: Machine) -> Finding:
    """What share of a CPU real-time tasks may have; the loop sleeps, so it needs little of it."""
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
    """Whether CPUs can be kept out of slow idle states."""
    path = machine.path(DMA_LATENCY)
    if not path.exists():
        return Finding("idle states", "ok", f"no {DMA_LATENCY}: the kernel manages none")
    if machine.writable(path):
        return Finding("idle states", "ok", f"{DMA_LATENCY} can be held at 0")
    remedy = 'a udev rule: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"'
    return Finding("idle states", "warn", f"no permission for {DMA_LATENCY}", remedy)


def isolated_cpus(machine: Machine, settings: Realtime) -> Finding:
    """Whether the loop has a CPU of its own."""
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
