"""Results of iterative learning: one row per run and waveform, and the overall result."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hilctl.base.formatting import shown_briefly
from hilctl.base.segments import Segment
from hilctl.experiment.correction import Correction
from hilctl.ilc.cycle import CycleScore
from hilctl.ilc.update import IlcState


@dataclass(frozen=True, slots=True)
class IlcRow:
    """Result of one run for one waveform.

    Attributes:
        run: Number of the run; 0 is the first, before learning.
        floor_percent: Peak error that sensor noise alone would cause.
        delay_samples: Delay between correction and displacement, identified so far.
        natural_hz: Resonance identified so far; None without one.
    """

    run: int
    label: str
    error_percent: float
    rms_percent: float
    floor_percent: float
    cycles: int
    reach_hz: float
    delay_samples: float
    natural_hz: float | None
    recording: str


@shown_briefly
@dataclass(frozen=True, slots=True)
class IlcResult:
    """Result of learning.

    Attributes:
        check: Verification run with the best correction, for each waveform; none if stopped.
        stop_signal: Number of the signal that stopped it, or 0.
        fault: Whether a run ended by a fault, or could not be run or evaluated.
    """

    correction: Correction
    rows: tuple[IlcRow, ...]
    check: tuple[IlcRow, ...]
    reason: str
    stop_signal: int = 0
    fault: bool = False

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, without the coefficients."""
        return {
            "reason": self.reason,
            "waveforms": [
                {
                    "label": cycle.label,
                    "start_percent": cycle.start_percent,
                    "error_percent": cycle.error_percent,
                }
                for cycle in self.correction.cycles
            ],
            "check": [asdict(row) for row in self.check],
            "runs": [asdict(row) for row in self.rows],
        }


def row_of(
    number: int, segment: Segment, error: CycleScore, state: IlcState, reach_hz: float, path: Path
) -> IlcRow:
    """Return the row of a run for one waveform, with the state of learning after the run."""
    return IlcRow(
        run=number,
        label=segment.label,
        error_percent=error.percent,
        rms_percent=100.0 * error.rms_um / error.peak_to_peak_um,
        floor_percent=error.floor_percent,
        cycles=error.cycles,
        reach_hz=reach_hz,
        delay_samples=state.response.delay_s * state.sample_rate_hz,
        natural_hz=state.response.natural_hz,
        recording=str(path),
    )
