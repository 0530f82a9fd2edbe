"""One run of several: in real time or not, and by what a recording is known to be of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

from hilctl.base.errors import DataError, RunError
from hilctl.experiment.correction import dump_correction
from hilctl.experiment.load import LoadedExperiment
from hilctl.models.files import dump_model
from hilctl.recording.ends import read_ends
from hilctl.run.metadata import experiment_sha256, sha256_of
from hilctl.run.result import Progress, RunResult
from hilctl.run.start import checked_experiment, start_run
from hilctl.run.unpaced import run_unpaced

OnPart: TypeAlias = Callable[[float], None]
"""Called with how much of a run is done, from 0 to 1."""


def _unseen(part: float) -> None:
    del part


def paced(
    path: Path,
    settings: Sequence[str],
    output: Path,
    on_part: OnPart = _unseen,
    *,
    overwrite: bool = True,
    heat_a2: float = 0.0,
) -> RunResult:
    """Run as ``hilctl run`` does, into a file of this name; see :func:`start_run`."""

    def show(progress: Progress) -> None:
        on_part(progress.samples / max(progress.total, 1))

    return start_run(path, settings, output, overwrite, show, heat_a2)


def unpaced(
    path: Path,
    settings: Sequence[str],
    output: Path,
    on_part: OnPart = _unseen,
    *,
    overwrite: bool = True,
    heat_a2: float = 0.0,
) -> RunResult:
    """Run a simulated device as fast as it goes."""
    del on_part
    checked = checked_experiment(path, settings, heat_a2=heat_a2)
    return run_unpaced(checked, output, overwrite=overwrite)


class StepStoppedError(RunError):
    """Somebody stopped a run of several; the runs before it stand.

    Attributes:
        signal: Number of the signal.
    """

    def __init__(self, text: str, number: int) -> None:
        super().__init__(text)
        self.signal = number


@dataclass(frozen=True, slots=True)
class RunKey:
    """What a run is of: two of one key differ in nothing that is chosen.

    Attributes:
        experiment: SHA-256 of the experiment as it runs.
        model: SHA-256 of the compensator's model; empty without one.
        correction: SHA-256 of what has been learned; empty without.
    """

    experiment: str
    model: str = ""
    correction: str = ""

    @classmethod
    def of(cls, loaded: LoadedExperiment) -> Self:
        """Return the key of an experiment."""
        model = dump_model(loaded.model) if loaded.model else ""
        correction = dump_correction(loaded.correction) if loaded.correction else ""
        return cls(experiment_sha256(loaded), sha256_of(model), sha256_of(correction))

    @classmethod
    def of_facts(cls, run: Mapping[str, str]) -> Self:
        """Return the key of a recorded run, by the facts of its beginning."""
        names = ("experiment_sha256", "model_sha256", "correction_sha256")
        return cls(*(run.get(name, "") for name in names))


def completed_key(path: Path) -> RunKey | None:
    """Return what a recording is of; None where it is not of a whole run that was completed."""
    try:
        ends = read_ends(path)
    except DataError:
        return None
    return RunKey.of_facts(ends.run) if ends.end.get("code") == "completed" else None
