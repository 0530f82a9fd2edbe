"""The comparison as rows and lines of text."""

from collections.abc import Iterator, Sequence

from hilctl.comparison.compare import ComparedModel, Comparison
from hilctl.comparison.simulated_trials import InverseTrial


def headings(comparison: Comparison) -> list[str]:
    """Return the names of the columns."""
    return ["model", "par.", "fit s", "ns", "peak %", "rms %", *_trial_names(comparison)]


def _trial_names(comparison: Comparison) -> list[str]:
    return [f"{trial.frequency_hz:.4g} Hz" for trial in _most_trials(comparison)]


def _most_trials(comparison: Comparison) -> Sequence[InverseTrial]:
    return max((row.trials for row in comparison.rows), key=len, default=())


def table_rows(comparison: Comparison) -> Iterator[list[str]]:
    """Return the texts of each row, in the order asked for."""
    for row in comparison.rows:
        figures = [
            row.name,
            "-" if row.numbers is None else str(row.numbers),
            "-" if row.identify_s is None else f"{row.identify_s:.2f}",
            f"{row.inverse_ns:.0f}",
            f"{row.error.peak_percent:.2f}",
            f"{row.error.rms_percent:.2f}",
        ]
        yield [*figures, *(_trial_text(trial) for trial in row.trials)]


def _trial_text(trial: InverseTrial) -> str:
    if trial.peak_error_percent is None:
        return "-"
    return f"{trial.peak_error_percent:.2f}{'*' if trial.limited_samples else ''}"


def notes(comparison: Comparison) -> list[str]:
    """Return what the table's reader has to know."""
    found = [
        "par.: numbers found; fit s: time that took; ns: time one sample of the inverse takes",
        "peak, rms %: error of the model's displacement on all loops, of the largest peak-to-peak",
    ]
    if not comparison.device:
        return [*found, "compensated errors: none, the recording's device is not a simulated one"]
    found.append(
        "Hz: largest error with the inverse before the device, in percent of the stroke; "
        f"{comparison.device}"
    )
    limited = any(trial.limited_samples for row in comparison.rows for trial in row.trials)
    return [*found, "*: the limiter changed judged commands"] if limited else found


def titles(rows: Sequence[ComparedModel]) -> list[tuple[str, str]]:
    """Return each model's name and what it is."""
    return [(row.name, row.title) for row in rows]
