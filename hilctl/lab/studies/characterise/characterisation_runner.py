"""Characterisation runner: one run per step, each planned from the steps before it."""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.files import check_writable, write_text
from hilctl.base.types import F64
from hilctl.base.yaml import setting
from hilctl.experiment.coil_heat import CoilHeat, CoolingCoil, RunHeat
from hilctl.experiment.load import document_with, load_experiment
from hilctl.lab.identify.data.data_files import MOST_MISSING
from hilctl.lab.studies.characterise.limits import CharacterisationLimits, limits_of
from hilctl.lab.studies.characterise.measurements import RigProblemError
from hilctl.lab.studies.characterise.results import (
    Characterisation,
    Measured,
    StepRow,
    identified,
    validated,
)
from hilctl.lab.studies.characterise.steps import STEPS, CharacterisationStep
from hilctl.lab.studies.characterise.waveforms import FIRST_PARTS, Keys, at_rest, first_run, within
from hilctl.lab.studies.study import (
    StepFaultError,
    Study,
    StudyHost,
    StudyStep,
    free_mb,
    require_room,
    run_study,
)
from hilctl.loop.interlocks import InterlockRequirement, InterlockSettings
from hilctl.loop.pacer import TIMING_REMEDY
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import dump_model
from hilctl.recording.recording import Recording
from hilctl.run.start import checked_experiment


def without_reference(experiment: Path, settings: Sequence[str]) -> list[str]:
    """Return settings with a hold as waveform, without all keys that need the experiment's own one.

    These are the compensator, all keys that need a compensator, and the trigger.
    """
    document = document_with(experiment, settings)
    unit = "V" if document.holds(("limits", "drive_v")) else "A"
    hold = {"kind": "hold", "unit": unit, "level": 0.0, "duration_s": 1.0}
    needing = ["feedback", "adaptation", "on_target", "trigger"]
    needing += [f"limits.{key}" for key in _tracking_keys()]
    removed = [f"{key}=null" for key in needing if document.holds(tuple(key.split(".")))]
    return [*settings, setting("waveform", hold), "compensator=none", *removed]


def _tracking_keys() -> Iterator[str]:
    """Yield the interlocks that need a reference, and those that depend on one of them."""
    known = {
        key: [each for each in field.metadata if isinstance(each, InterlockRequirement)]
        for key, field in InterlockSettings.model_fields.items()
    }
    tracking = {key for key, needs in known.items() if any(each.reference_um for each in needs)}
    for key, needs in known.items():
        if key in tracking or any(each.key in tracking for each in needs):
            yield key


_BYTES_PER_SAMPLE = 45.0
_NAME_LENGTH = 80


@dataclass(frozen=True, slots=True)
class CharacterisationPlan:
    """Plan of a characterisation, at full amplitude."""

    limits: CharacterisationLimits
    steps: tuple[StepRow, ...]  # its steps; most polarity and response steps are skipped in the end
    pauses_s: float  # time for the coil to cool
    free_mb: float  # free disk space

    @property
    def seconds(self) -> float:
        """Rig time without pauses."""
        return sum(step.seconds for step in self.steps)

    @property
    def megabytes(self) -> float:
        """Approximate size of all recordings."""
        return sum(step.megabytes for step in self.steps)


class CharacterisationRunner:
    """Characterise the device of an experiment; its waveform and compensator are not used.

    Raise InputError if it is invalid, or a real device is to run without real time.
    """

    def __init__(
        self,
        experiment: Path,
        settings: Sequence[str],
        folder: Path,
        highest_hz: float | None = None,  # of loops; derived from the sample rate if None
        host: StudyHost | None = None,
    ) -> None:
        self._experiment, self._given = experiment, settings
        self._settings = without_reference(experiment, settings)
        self._folder = folder
        self._host = host or StudyHost()
        self._loaded = load_experiment(experiment, self._settings)
        self.limits = limits_of(self._loaded, highest_hz)
        info = self._loaded.device.info
        if not (self._host.real_time or info.simulated):
            raise InputError(f"--fast: {info.name}: only simulated devices run without real time")
        # Reject everything that does not depend on the waveform before anything moves.
        rest = setting("waveform", at_rest(self.limits))
        checked_experiment(experiment, [*self._settings, rest])
        self._measured = Measured()
        self._rows: list[StepRow] = []
        self._recordings: dict[str, Path] = {}

    @cached_property
    def plan(self) -> CharacterisationPlan:
        """Plan of all steps at full amplitude."""
        coil, now_s, pauses_s = CoolingCoil(self._loaded.rig, 0.0, 0.0), 0.0, 0.0
        rows = []
        for step in STEPS:
            keys = step.waveform(self.limits, Measured())
            if keys is None:
                continue
            _, command = within(self.limits, keys)
            heat = self._heat(command)
            pause_s, seconds = coil.pause_s(heat, now_s), heat.seconds
            now_s += pause_s + seconds
            coil.ran(heat, now_s)
            pauses_s += pause_s
            megabytes = command.size * _BYTES_PER_SAMPLE / 1e6
            rows.append(StepRow(step.name, step.purpose, seconds, megabytes))
        return CharacterisationPlan(self.limits, tuple(rows), pauses_s, free_mb(self._folder))

    def _heat(self, command: F64) -> RunHeat:
        heat = CoilHeat(self._loaded.config.limits, self.limits.sample_rate_hz, 0.0)
        heat.add(command)
        return heat.effect

    def discard(self) -> None:
        """Delete the recordings of all steps."""
        for number, step in enumerate(STEPS, 1):
            (self._folder / f"{_name(number, step)}.mcap").unlink(missing_ok=True)

    def characterise(self, output: Path, *, overwrite: bool = False) -> Characterisation:
        """Run all steps, then identify and validate the model and write it to ``output``.

        Raises:
            InputError: A file cannot be written, no disk space, or the folder has recordings with
                other settings; nothing has moved.
            StepStoppedError: The user stopped a step.
            RunError: A step ended by a fault that is no known problem of the rig.
        """
        check_writable(output, overwrite=overwrite)
        require_room(self._folder, self.plan.megabytes, self.plan.free_mb)
        study = self._study(output, overwrite=overwrite)
        return run_study(study, self._folder, self._host, total_s=self.plan.seconds)

    def _study(self, output: Path, *, overwrite: bool) -> Study[Characterisation]:
        try:
            for number, step in enumerate(STEPS, 1):
                keys = step.waveform(self.limits, self._measured)
                if keys is not None:
                    yield from self._step(number, step, *within(self.limits, keys))
            return self._with_model(output, overwrite=overwrite)
        except RigProblemError as error:
            return replace(self._so_far(), problem=str(error), problem_code=error.code)

    def _so_far(self) -> Characterisation:
        return Characterisation(
            experiment=self._loaded.config.name,
            device=self._loaded.device.info.name,
            unit=self.limits.unit,
            band_hz=(self.limits.lowest_hz, self.limits.highest_hz),
            steps=tuple(self._rows),
            measured=self._measured,
        )

    def _step(
        self, number: int, step: CharacterisationStep, keys: Keys, command: F64
    ) -> Study[None]:
        names = [each.name for each in self.plan.steps]
        before = self.plan.steps[: names.index(step.name)]
        try:
            run = yield StudyStep(
                self._experiment,
                self._step_settings(number, step, keys),
                name=_name(number, step),
                text=f"{step.name} ({step.purpose})",
                replaces=True,
                flaw=_flaw,
                heat=self._heat(command),
                done_s=sum(each.seconds for each in before),
            )
        except StepFaultError as error:
            raise _problem(error) or error from None
        self._recordings[step.name] = run.path
        seconds = command.size / self.limits.sample_rate_hz
        megabytes = run.path.stat().st_size / 1e6
        row = StepRow(step.name, step.purpose, seconds, megabytes, "", str(run.path), run.kept)
        self._rows.append(row)
        self._measured, text = step.take(run.recording, self.limits, self._measured)
        self._rows[-1] = replace(row, text=text)
        self._host.on_step(self._rows[-1])

    def _with_model(self, output: Path, *, overwrite: bool) -> Characterisation:
        self._host.on_progress(1.0, "identify")
        rest = self._measured.rest
        try:
            found = identified(self._recordings, self._measured)
            found, apart = validated(found, self._recordings, rest.noise_um if rest else 0.0)
        except InputError as error:
            remedy = "check the loops on the page, or run 'hilctl identify' on the recordings"
            raise RigProblemError("no_model", f"no model identified: {error}", remedy) from None
        result = replace(self._so_far(), held_out=apart, identification=found)
        if not result.is_model:
            return result
        write_text(output, dump_model(found.fit.model), overwrite=overwrite)
        return replace(result, first_run=self._first_run(output, found.fit.model))

    def _first_run(self, output: Path, model: HysteresisModel) -> tuple[str, ...]:
        """Return the settings of a run through the model; empty if its check fails."""
        named = [*self._given, f"compensator.model={json.dumps(str(output))}"]
        own = document_with(self._experiment, self._given).value(("waveform", "unit")) == "um"
        for part in FIRST_PARTS:
            keys = [] if own else [setting("waveform", first_run(self.limits, model, part))]
            with suppress(ConfigError):
                checked_experiment(self._experiment, [*named, *keys])
                return (*named, *keys)
        return ()

    def _step_settings(self, number: int, step: CharacterisationStep, keys: Keys) -> list[str]:
        name = f"{self._loaded.config.name}-{step.name}"[-_NAME_LENGTH:].lstrip("._-")
        settings = [*self._settings, setting("name", name), setting("waveform", keys)]
        if self._rows and self._loaded.config.safe.at_start is not None:
            settings.append(f"safe.at_start={self.limits.rest!r}")  # where the previous step ended
        # Noise common to all steps would be fitted.
        return settings + self._loaded.noise_settings(number)


def _name(number: int, step: CharacterisationStep) -> str:
    return f"{number:02d}-{step.name}"


def _problem(error: StepFaultError) -> RigProblemError | None:
    """Return the problem of the rig behind a fault, or None."""
    codes = {event.code for event in error.events}
    if "sensor_range" in codes:
        remedy = "set a wider sensor range, or a narrower limits.stroke_um"
        return RigProblemError("saturated_sensor", str(error), remedy)
    if "sensor_frozen" in codes:
        return RigProblemError("no_reading", str(error), "check the sensor and its wiring")
    return None


def _flaw(recording: Recording) -> str:
    """Return why too many samples are missing, or an empty text."""
    missing = _missing(recording)
    if missing <= MOST_MISSING:
        return ""
    return (
        f"timing not kept: {100.0 * missing:.2g} % of the samples are missing, more than "
        f"{100.0 * MOST_MISSING:g} %: {TIMING_REMEDY}"
    )


def _missing(recording: Recording) -> float:
    """Return the share of missing samples: of the run, or of its multisine if that is larger.

    Samples are missing if their ticks were skipped or they have no displacement.
    """
    samples = recording.samples
    parts = [(int(samples.index[0]), int(samples.index[-1]) + 1)]
    parts += [(s.steady_start, s.steady_stop) for s in recording.segments if s.kind == "multisine"]
    good = samples.index[np.isfinite(samples.displacement_um)]
    return max(1.0 - float(np.ptp(np.searchsorted(good, each)) / np.ptp(each)) for each in parts)
