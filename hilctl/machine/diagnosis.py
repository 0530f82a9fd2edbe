"""Diagnosis of this computer: all checks, and measured timer latency."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.types import I64
from hilctl.machine import checks
from hilctl.machine.procfs import Finding, Machine
from hilctl.machine.rt_setup import Realtime
from hilctl.machine.timer_latency import Latency, measure

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
        checks.preemption(machine),
        checks.fifo(machine, settings),
        checks.locked_memory(machine),
        checks.throttling(machine),
        checks.dma_latency(machine),
        checks.isolated_cpus(machine, settings),
        checks.governor(machine),
        checks.hyperthreads(machine),
        checks.virtual_machine(machine),
        checks.clock_source(machine),
        checks.latency_timers(machine),
        checks.serial_ports(machine),
        checks.serial_daemons(machine),
        checks.disk_space(machine, folder),
        checks.log_out(machine),
    )


def machine_facts(
    settings: Realtime | None = None, folder: Path | None = None, machine: Machine | None = None
) -> dict[str, str]:
    """Return the results of all checks as metadata of a recording, such as ``machine.kernel``."""
    found = examine(machine or Machine(), settings or Realtime(), folder or Path())
    return {
        f"machine.{each.name.replace(' ', '_').lower()}": f"{each.level}: {each.text}"
        for each in found
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
