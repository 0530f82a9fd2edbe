"""What reference runs say of drift: the same run, again and again."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hilctl.series.run_figures import RunFigures


@dataclass(frozen=True, slots=True)
class SeriesDrift:
    """How far reference runs moved away from the first of them; each the largest, with its sign.

    Attributes:
        runs: Reference runs that were completed.
        peak_to_peak_percent: Change of the peak-to-peak displacement, in percent of it.
        mean_um: Change of the mean displacement, in um.
        peak_hysteresis_percent: Change of the peak hysteresis, in points of percent.
    """

    runs: int
    peak_to_peak_percent: float | None
    mean_um: float | None
    peak_hysteresis_percent: float | None

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)

    def __str__(self) -> str:
        parts = [
            (self.peak_to_peak_percent, "{:+.3g} % in peak-to-peak"),
            (self.mean_um, "{:+.3g} µm in mean"),
            (self.peak_hysteresis_percent, "{:+.3g} points of hysteresis"),
        ]
        known = ", ".join(text.format(value) for value, text in parts if value is not None)
        return f"drift over {self.runs} reference runs: {known or 'nothing to compare'}"


def drift_of(done: Sequence[RunFigures]) -> SeriesDrift | None:
    """Return the drift; None with fewer than two reference runs.

    Args:
        done: Figures of the reference runs that were completed, in the order of their runs.
    """
    if len(done) < 2:
        return None

    def largest(name: str) -> float | None:
        values: list[float] = [getattr(each, name) for each in done]
        if None in values:
            return None
        return max((value - values[0] for value in values[1:]), key=abs)

    stroke, first = largest("peak_to_peak_um"), done[0].peak_to_peak_um
    percent = 100.0 * stroke / first if stroke is not None and first else None
    return SeriesDrift(len(done), percent, largest("mean_um"), largest("peak_hysteresis_percent"))
