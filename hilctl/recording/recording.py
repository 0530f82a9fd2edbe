"""A recording in memory: arrays and facts, however they were stored."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from hilctl.base.events import Event
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64, CommandUnit
from hilctl.recording.metadata_keys import LabelValue


@dataclass(frozen=True, slots=True)
class Ticks:
    """Timing of every tick.

    Attributes:
        first_sample: int64[m], index of the tick's first sample.
        deadline_ns: int64[m], when the tick was due, since the start of the run.
        late_ns: int64[m], how much later the loop woke; after a skip, than the first tick missed.
        exchange_ns: int64[m], how long the exchange with the device took.
    """

    first_sample: I64
    deadline_ns: I64
    late_ns: I64
    exchange_ns: I64


TICK_COLUMNS = tuple(each.name for each in fields(Ticks))
"""Their names, which are those of a block's head as well."""


@dataclass(frozen=True, slots=True)
class ReplayStart:
    """Where a replay can begin: the first block, and every block after a gap.

    Attributes:
        sample: Index of the block's first sample.
        state: float64[s], the compensator's memory before it.
        previous_command: Command before it, in the command unit.
    """

    sample: int
    state: F64
    previous_command: float


@dataclass(frozen=True, slots=True)
class Recording:
    """One run, read back.

    Attributes:
        path: File it was read from.
        run: Facts of the run as recorded at its start (identity, versions, device, units).
        end: Facts recorded at its end (counters, reason); empty where the file is cut short.
        sample_rate_hz: Samples a second.
        command_unit: Unit of commands, ``A`` or ``V``.
        compensated: Whether a compensator stood between reference and command.
        segments: The stretches of the run.
        samples: All samples.
        dropped: Samples that were exchanged or due but are missing here.
        ticks: Timing of every tick.
        events: Events in order.
        experiment_yaml: The experiment as it was run.
        model_yaml: The compensator's model, or empty.
        starts: Where a replay can begin.
        correction_yaml: What had been learned and was added to the reference, or empty.
        labels: What the run is found by.
    """

    path: Path
    run: Mapping[str, str]
    end: Mapping[str, str]
    sample_rate_hz: float
    command_unit: CommandUnit
    compensated: bool
    segments: tuple[Segment, ...]
    samples: Samples
    dropped: int
    ticks: Ticks
    events: tuple[Event, ...]
    experiment_yaml: str
    model_yaml: str
    starts: tuple[ReplayStart, ...] = ()
    correction_yaml: str = ""
    labels: Mapping[str, LabelValue] = field(default_factory=dict)
