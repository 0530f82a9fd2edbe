"""Characterisation runner: one run per step, each planned from the steps before it."""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from hilctl.base.errors import ConfigError, DataError, InputError, RunError
from hilctl.base.files import check_writable, exists, make_folder, write_text
from hilctl.base.types import F64
from hilctl.experiment.coil_heat import CoilHeat, CoolingCoil, RunHeat
from hilctl.experiment.device_state import heat_before
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
from hilctl.lab.studies.step_runner import (
    StepRunner,
    StudyHost,
    free_mb,
    raise_if_stopped,
    require_room,
    setting,
)
from hilctl.loop.interlocks import InterlockRequirement, InterlockSettings
from hilctl.loop.pacer import TIMING_REMEDY
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import dump_model
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.run.result import RunResult
from hilctl.run.stalls import StallError, fault_of, repeated
from hilctl.run.start import RunKey, checked_experiment, unpaced


def without_reference(experiment: Path, settings: Sequence[str]) -> list[str]:
    """Return settings with a hold as waveform, without what belongs to the experiment's own one.

    That is the compensator, all that needs one, and the trigger.
    """
    document = document_with(experiment, settings)
    unit = "V" if document.holds(("limits", "drive_v")) else "A"
    hold = {"kind": "hold", "unit": unit, "level": 0.0, "duration_s": 1.0}
    needing = ("feedback", "adaptation", "trigger", *(f"limits.{key}" for key in _tracking_keys()))
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
        if self._host.run is unpaced and not info.simulated:
            raise InputError(f"--fast: {info.name}: only simulated devices run without real time")
        # Reject everything that does not depend on the waveform before anything moves.
        rest = setting("waveform", at_rest(self.limits))
        checked_experiment(experiment, [*self._settings, rest])
        self._coil = CoolingCoil(self._loaded.rig, 0.0, 0.0)
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

    @cached_property
    def _runner(self) -> StepRunner:
        return StepRunner(self._host, self.plan.seconds)

    def _heat(self, command: F64) -> RunHeat:
        heat = CoilHeat(self._loaded.config.limits, self.limits.sample_rate_hz, 0.0)
        heat.add(command)
        return heat.effect

    def discard(self) -> None:
        """Delete the recordings of all steps."""
        for number, step in enumerate(STEPS, 1):
            self._path(number, step).unlink(missing_ok=True)

    def characterise(self, output: Path, *, overwrite: bool = False) -> Characterisation:
        """Run all steps, then identify and validate the model and write it to ``output``.

        Raises:
            InputError: A file can't be written, no disk space, or the folder has recordings with
                other settings; nothing has moved.
            StepStoppedError: The user stopped a step.
            RunError: A step ended by a fault that is no known problem of the rig.
        """
        check_writable(output, overwrite=overwrite)
        require_room(self._folder, self.plan.megabytes, self.plan.free_mb)
        make_folder(self._folder)
        try:
            for number, step in enumerate(STEPS, 1):
                keys = step.waveform(self.limits, self._measured)
                if keys is not None:
                    self._do(number, step, keys)
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

    def _do(self, number: int, step: CharacterisationStep, keys: Keys) -> None:
        keys, command = within(self.limits, keys)
        path = self._path(number, step)
        settings = self._step_settings(number, step, keys)
        recording = self._kept(path, settings)
        kept, heat = recording is not None, self._heat(command)
        if recording is None:
            planned = {each.name: each.seconds for each in self.plan.steps}
            before = list(planned)[: list(planned).index(step.name)]
            self._runner.done_s = sum(planned[name] for name in before)
            planned_s = planned[step.name]
            recording = repeated(partial(self._recorded, step, settings, path, planned_s, heat))
        if not kept:
            self._coil.ran(heat, self._host.now().boot_s)
        self._recordings[step.name] = path
        seconds = command.size / self.limits.sample_rate_hz
        megabytes = path.stat().st_size / 1e6
        row = StepRow(step.name, step.purpose, seconds, megabytes, "", str(path), kept)
        self._rows.append(row)
        self._measured, text = step.take(recording, self.limits, self._measured)
        self._rows[-1] = replace(row, text=text)
        self._host.on_step(self._rows[-1])

    def _recorded(
        self,
        step: CharacterisationStep,
        settings: list[str],
        path: Path,
        seconds: float,
        heat: RunHeat,
    ) -> Recording:
        if self._host.run is not unpaced:  # without real time there is no coil
            self._runner.cool(step.name, self._pause_s(heat))
        text = f"{step.name}: {step.purpose}"
        try:
            result = self._runner.run(
                self._experiment, settings, path, text, seconds, overwrite=True
            )
        except InputError as error:
            if not self._rows:
                raise
            raise RunError(f"{step.name} is refused: {error}") from None
        raise_if_stopped(step.name, result)
        if result.code != "completed":
            raise self._fault(step, result, read(path))
        recording = read(path)
        if (missing := _missing(recording)) > MOST_MISSING:
            raise StallError(
                f"{step.name}: timing not kept: {100.0 * missing:.2g} % of the samples are "
                f"missing, more than {100.0 * MOST_MISSING:g} %: {TIMING_REMEDY}"
            )
        return recording

    def _fault(
        self, step: CharacterisationStep, result: RunResult, recording: Recording
    ) -> RunError:
        """Return the problem of the rig behind a fault, or the fault itself."""
        codes = {event.code for event in recording.events}
        text = f"{step.name}: {result.reason}"
        if "sensor_range" in codes:
            return RigProblemError(
                "saturated_sensor", text, "set a wider sensor range, or a narrower limits.stroke_um"
            )
        if "sensor_frozen" in codes:
            return RigProblemError("no_reading", text, "check the sensor and its wiring")
        return fault_of(text, result, recording, self._loaded.config.safe.at_start)

    def _kept(self, path: Path, settings: list[str]) -> Recording | None:
        """Return the recording of a step that is done; otherwise None.

        Raise InputError if it was recorded with other settings, not as a consequence of an earlier
        step that was run again.
        """
        if not exists(path):
            return None
        try:
            recording = read(path)
        except DataError:  # truncated before its first sample
            return None
        if recording.end.get("code") != "completed" or _missing(recording) > MOST_MISSING:
            return None
        if RunKey.of_facts(recording.run) == RunKey.of(load_experiment(self._experiment, settings)):
            return recording
        if all(row.kept for row in self._rows):
            raise InputError(
                f"{path} was recorded with other settings: restore them, choose another --folder, "
                "or replace all recordings with --overwrite"
            )
        return None

    def _pause_s(self, heat: RunHeat) -> float:
        """Return the time to cool after the steps so far and the device's last run."""
        now = self._host.now()
        last = CoolingCoil(self._loaded.rig, heat_before(self._loaded, now)[0], now.boot_s)
        return max(coil.pause_s(heat, now.boot_s) for coil in (self._coil, last))

    def _with_model(self, output: Path, *, overwrite: bool) -> Characterisation:
        self._host.on_progress(1.0, "identify")
        rest = self._measured.rest
        try:
            found = identified(self._recordings, self._measured.small)
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

    def _path(self, number: int, step: CharacterisationStep) -> Path:
        return self._folder / f"{number:02d}-{step.name}.mcap"

    def _step_settings(self, number: int, step: CharacterisationStep, keys: Keys) -> list[str]:
        name = f"{self._loaded.config.name}-{step.name}"[-_NAME_LENGTH:].lstrip("._-")
        settings = [*self._settings, setting("name", name), setting("waveform", keys)]
        if self._rows and self._loaded.config.safe.at_start is not None:
            settings.append(f"safe.at_start={self.limits.rest!r}")  # where the previous step ended
        # Noise common to all steps would be fitted.
        return settings + self._loaded.noise_settings(number)


def _missing(recording: Recording) -> float:
    """Return the share of missing samples: of the run, or of its multisine if that is larger.

    Samples are missing if their ticks were skipped or they have no displacement.
    """
    samples = recording.samples
    parts = [(int(samples.index[0]), int(samples.index[-1]) + 1)]
    parts += [(s.steady_start, s.steady_stop) for s in recording.segments if s.kind == "multisine"]
    good = samples.index[np.isfinite(samples.displacement_um)]
    return max(1.0 - float(np.ptp(np.searchsorted(good, each)) / np.ptp(each)) for each in parts)
