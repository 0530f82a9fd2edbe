"""A recording in memory: arrays and facts."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hilctl.base.device import AuxChannel
from hilctl.base.events import Event
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64, CommandUnit
from hilctl.recording.metadata_keys import LabelValue


@dataclass(frozen=True, slots=True)
class Ticks:
    """Timing of every tick.

    Attributes:
        first_sample: int64[m], index of the first sample of the tick.
        deadline_ns: int64[m], when the tick was due, relative to the start of the run.
        late_ns: int64[m], lateness of the exchange (of the wake-up in older recordings); after a
            skip, from the first missed tick.
        exchange_ns: int64[m], duration of the exchange with the device.
    """

    first_sample: I64
    deadline_ns: I64
    late_ns: I64
    exchange_ns: I64

    def rows(self, chosen: I64 | npt.NDArray[np.bool_]) -> "Ticks":
        """Return the ticks selected by indices or a mask."""
        return Ticks(*(getattr(self, name)[chosen] for name in TICK_COLUMNS))


TICK_COLUMNS = tuple(each.name for each in fields(Ticks))
"""Names of the columns of ticks, also in a block's header."""


@dataclass(frozen=True, slots=True)
class ReplayStart:
    """Start of a replay: the first block, or a block after a gap.

    Attributes:
        sample: Index of the block's first sample.
        state: float64[s], the compensator's memory before the block.
        previous_command: Command before the block, in the command unit.
    """

    sample: int
    state: F64
    previous_command: float


@dataclass(frozen=True, slots=True)
class Recording:
    """One recorded run.

    Attributes:
        run: Facts from the start of the run (identity, versions, device, units).
        end: Facts from its end (counters, reason); empty if the file is truncated.
        compensated: Whether a compensator computed the command from the reference.
        dropped: Samples that were exchanged or due but are missing.
        model_yaml: The compensator's model, or empty.
        starts: Possible starts of a replay.
        correction_yaml: The learned correction that was added to the reference, or empty.
        coupling_yaml: The coupling whose crosstalk was removed from the reference, or empty.
        device_files: YAML texts by name: ``profile.yaml`` and ``reader_profile.yaml``.
        aux_channels: Auxiliary channels, in the order of ``samples.aux``.
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
    coupling_yaml: str = ""
    labels: Mapping[str, LabelValue] = field(default_factory=dict)
    device_files: Mapping[str, str] = field(default_factory=dict)
    aux_channels: tuple[AuxChannel, ...] = ()

    @property
    def aux(self) -> Mapping[str, F64]:
        """Auxiliary channels by name, float64[n]; all samples of a block have the same value."""
        return {each.name: self.samples.aux[:, k] for k, each in enumerate(self.aux_channels)}
