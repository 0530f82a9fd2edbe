"""What a process has taken of its machine: memory, processor time, page faults, switches."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

_STATM = Path("/proc/self/statm")


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """What this process has taken, from its start or since another one.

    Attributes:
        resident_bytes: Memory in RAM now, what is shared with others included.
        cpu_ns: Processor time.
        minor_faults: Pages that had to be mapped.
        major_faults: Pages that had to be read from a disk.
        involuntary_switches: How often another process was put before this one.
    """

    resident_bytes: int
    cpu_ns: int
    minor_faults: int
    major_faults: int
    involuntary_switches: int

    @classmethod
    def now(cls) -> Self:
        """Return what this process has taken so far, with all of its threads; Linux only."""
        import resource

        pages = int(_STATM.read_text(encoding="ascii").split()[1])
        taken = resource.getrusage(resource.RUSAGE_SELF)
        return cls(
            resident_bytes=pages * os.sysconf("SC_PAGE_SIZE"),
            cpu_ns=time.process_time_ns(),
            minor_faults=taken.ru_minflt,
            major_faults=taken.ru_majflt,
            involuntary_switches=taken.ru_nivcsw,
        )

    def since(self, before: "ProcessUsage") -> "ProcessUsage":
        """Return what came after another one; memory is that of now."""
        return ProcessUsage(
            self.resident_bytes,
            self.cpu_ns - before.cpu_ns,
            self.minor_faults - before.minor_faults,
            self.major_faults - before.major_faults,
            self.involuntary_switches - before.involuntary_switches,
        )
