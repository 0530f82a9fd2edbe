"""Refinement of a model by recordings: a better model, or reasons why there is none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_writable, write_text
from hilctl.base.formatting import shown_briefly
from hilctl.base.samples import Flag
from hilctl.identify.data.data_files import history_from_pieces
from hilctl.identify.data.records import History
from hilctl.identify.fit_api import FitData, OnProgress, ignore_progress
from hilctl.identify.fit_model import VERSIONS, error_table, identified_range
from hilctl.identify.model_quality import data_reasons
from hilctl.identify.refine.regularisation import (
    WORTH,
    Regularisation,
    SelectedRegularisation,
    parts_of,
)
from hilctl.models.base import HysteresisModel, IdentifiedRange, Provenance
from hilctl.models.model_file import dump_model, load_model
from hilctl.models.refined import RefinedModel
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording

STILL_S = 1.0  # between a run and the one that began where it ended


def load_runs(paths: Sequence[Path], model: HysteresisModel) -> list[History]:
    """Read runs, each from rest, or after the run that it continues, which is not evaluated."""
    if not paths:
        raise InputError("no recordings to refine the model: name at least one")
    twice = {path for path in paths if list(paths).count(path) > 1}
    if twice:
        raise InputError(f"named twice: {', '.join(map(str, sorted(twice)))}")
    recordings = [read(path) for path in paths]
    for recording in recordings:
        if recording.command_unit != model.input_unit:
            raise DataError(
                f"{recording.path}: was recorded in {recording.command_unit}, the model takes "
                f"{model.input_unit}"
            )
    known = {recording.run.get("run_id", ""): recording for recording in recordings}
    return [_history(recording, known) for recording in recordings]


def _history(recording: Recording, known: Mapping[str, Recording]) -> History:
    history = history_from_pieces([recording])
    before = recording.run.get("initial_state_run_id", "")
    conditioned = (recording.samples.flags & Flag.CONDITION.value).any()
    if not before or conditioned:
        return history
    if before not in known:
        raise DataError(
            f"{recording.path}: began {recording.run.get('initial_state', 'where a run ended')}. "
            "Add that recording, so that the initial state is known"
        )
    first = known[before].samples
    last = float(first.command[-1])
    still = round(STILL_S * recording.sample_rate_hz)
    command = np.concatenate((first.command, np.full(still, last), history.command))
    ahead = np.zeros(command.size - history.command.size)  # not evaluated
    displacement_um = np.concatenate((ahead, history.displacement_um))
    ignore = ahead.size + history.ignore
    return replace(history, command=command, displacement_um=displacement_um, ignore=ignore)


@shown_briefly
@dataclass(frozen=True, slots=True)
class Refinement:
    """A refined model, and its errors.

    Attributes:
        choice: Selected regularisation, with errors before and after on held-out runs.
        reasons: Why it is no better than the old model; empty if it is better.
    """

    model: RefinedModel
    choice: SelectedRegularisation
    reasons: tuple[str, ...]

    @property
    def better(self) -> bool:
        """Whether it is better than the old model on held-out runs, and worse on none."""
        return not self.reasons

    def __str__(self) -> str:
        was, now = self.choice.before.judgement, self.choice.after.judgement
        what = f"peak error {now.own_peak_percent:.2f} % (before {was.own_peak_percent:.2f} %)"
        if self.better:
            return f"better: {self.choice.ratio:.2f} times the old error on held-out runs; {what}"
        return f"no better than the old model: {'; '.join(self.reasons)}"

    def to_mapping(self) -> dict[str, Any]:
        """Return all figures as plain mappings, lists and numbers, for JSON."""
        return {
            "better": self.better,
            "text": str(self),
            "reasons": list(self.reasons),
            "ratio": self.choice.ratio,
            "strength": self.choice.strength,
            "anchor": self.choice.anchor,
            "own_drift": self.choice.own,
            "before": self.choice.before.to_mapping(),
            "after": self.choice.after.to_mapping(),
        }


def refine_files(
    model: Path,
    paths: Sequence[Path],  # recordings of runs, compensated or not
    output: Path | None,  # model file to write
    validate: Sequence[Path] = (),  # if there are none, those of ``paths`` in turn
    *,
    overwrite: bool = False,
    progress: OnProgress = ignore_progress,
) -> Refinement:
    """Refine a model from recordings, and write it if it is better.

    Raises:
        InputError: A file can't be used; nothing is written.
    """
    if output is not None:
        check_writable(output, overwrite=overwrite, inputs=[model, *paths, *validate])
    old = load_model(model)
    progress(0.0, "reading")
    both = load_runs([*paths, *validate], old)
    found = refine_runs(old, both[: len(paths)], both[len(paths) :], model.name, progress)
    if output is not None and found.better:
        write_text(output, dump_model(found.model), overwrite=overwrite)
    return found


def refine_runs(
    old: HysteresisModel,
    runs: Sequence[History],
    validate: Sequence[History] = (),
    source: str = "",
    progress: OnProgress = ignore_progress,
) -> Refinement:
    """Refine a model from runs, and evaluate it on held-out runs."""
    if reasons := tuple(data_reasons([*runs, *validate])):
        raise InputError("\n".join(reasons))
    parts, splits = parts_of(runs, validate)
    choice, refined = Regularisation(old, parts, splits).best(progress)
    progress(1.0, "done")
    named = refined.model_copy(update={"provenance": _provenance(old, runs, choice, source)})
    return Refinement(named, choice, tuple(_reasons(choice)))


def _reasons(choice: SelectedRegularisation) -> list[str]:
    if choice.better:
        return []
    if choice.ratio <= WORTH:
        return [f"held-out run '{label}' would become worse" for label in choice.worse]
    return [
        f"held-out runs would have {choice.ratio:.2f} times the old error: the rest is noise or "
        "drift, or beyond this kind of model"
    ]


def _provenance(
    old: HysteresisModel, runs: Sequence[History], choice: SelectedRegularisation, source: str
) -> Provenance:
    was = old.provenance
    data = FitData(runs, old.input_unit)
    figures = {f"held_out_{k}": v for k, v in error_table(choice.after.judgement).items()}
    labels = tuple(run.label for run in runs)
    return was.model_copy(
        update={
            "source": (*was.source, *([source] if source else []), *labels),
            "method": f"{was.method}; refined on {len(runs)} runs, strength {choice.strength:g}",
            "errors_percent": figures,
            "identified_range": _wider(was.identified_range, identified_range(data)),
            "versions": VERSIONS,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
        }
    )


def _wider(old: IdentifiedRange | None, new: IdentifiedRange) -> IdentifiedRange:
    """Return the union of both ranges: beyond the runs, the old model still holds."""
    if old is None:
        return new
    moves, turns = (old.peak_to_peak_um, new.peak_to_peak_um), (old.frequency_hz, new.frequency_hz)
    return IdentifiedRange(
        peak_to_peak_um=(min(a for a, _ in moves), max(b for _, b in moves)),
        frequency_hz=(min(a for a, _ in turns), max(b for _, b in turns)),
        speed_um_per_s=max(old.speed_um_per_s, new.speed_um_per_s),
    )
