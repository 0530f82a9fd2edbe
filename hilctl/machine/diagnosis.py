"""All findings of a machine, and whether it keeps a rate."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.types import I64
from hilctl.machine import findings, hardware
from hilctl.machine.logind import log_out
from hilctl.machine.procfs import Finding, Machine
from hilctl.machine.settings import Realtime
from hilctl.machine.timer_latency import Latency, measure

DEFAULT_RATE_HZ = 1000.0
_EDGES_US = np.concatenate([[0], 2 ** np.arange(17)])


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What was found.

    Attributes:
        findings: What files say of the machine.
        latency: What was measured.
    """

    findings: tuple[Finding, ...]
    latency: Latency

    @property
    def verdict(self) -> str:
        """In words: whether every period was at most twice the nominal one, and the longest."""
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
        """Return all of it as plain values."""
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
    """Count wake-ups by lateness: lower edge of each bin in us, a power of two, to their number.

    The bins up to the last one that holds any; the last one has no upper edge.
    """
    late_us = np.clip(late_ns // 1000, 0, int(_EDGES_US[-1]))
    counts, _ = np.histogram(late_us, _EDGES_US)
    used = int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0
    return dict(zip(_EDGES_US[:used].tolist(), counts[:used].tolist(), strict=True))


def examine(machine: Machine, settings: Realtime, folder: Path) -> tuple[Finding, ...]:
    """Return what files say of a machine; quick, nothing is measured or opened.

    Args:
        machine: The machine.
        settings: What the loop would ask for.
        folder: Where recordings go.
    """
    return (
        findings.preemption(machine),
        findings.fifo(machine, settings),
        findings.locked_memory(machine),
        findings.throttling(machine),
        findings.dma_latency(machine),
        findings.isolated_cpus(machine, settings),
        hardware.governor(machine),
        hardware.hyperthreads(machine),
        hardware.virtual_machine(machine),
        hardware.clock_source(machine),
        hardware.latency_timers(machine),
        hardware.serial_ports(machine),
        hardware.serial_daemons(machine),
        hardware.disk_space(machine, folder),
        log_out(machine),
    )


def machine_facts(
    settings: Realtime | None = None, folder: Path | None = None, machine: Machine | None = None
) -> dict[str, str]:
    """Return the findings for a recording's metadata: ``machine.kernel`` and so on, to text.

    Args:
        settings: What the loop asks for; else the defaults.
        folder: Where the recording goes; else the current folder.
        machine: The machine; else this one.
    """
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
    """Look at this machine, and measure how late a process set up as the loop's wakes.

    Args:
        rate_hz: Ticks a second.
        settings: What the loop would ask for.
        folder: Where recordings go.
        seconds: Length of the measurement.
        on_progress: See :func:`hilctl.machine.timer_latency.measure`.

    Raises:
        InputError: The rate is beyond what is measured.
        RunError: The measurement failed.
    """
    found = examine(Machine(), settings, folder)
    return Diagnosis(found, measure(rate_hz, seconds, settings, on_progress))
