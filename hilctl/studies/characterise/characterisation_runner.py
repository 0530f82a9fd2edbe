"""A campaign: one run a step, each after looking at what those before it measured.

The recordings are the checkpoint. A whole one, of the very experiment that a step would run, is
that step done: a campaign that was killed goes on where it was, and loses one step.
"""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

from hilctl.base.errors import DataError, InputError, RunError
from hilctl.base.files import check_writable, write_text
from hilctl.base.types import F64, CommandUnit
from hilctl.base.yaml import Document, load_document
from hilctl.experiment.coil_heat import CoolingCoil, RunHeat
from hilctl.experiment.history import heat_before
from hilctl.experiment.load import load_experiment
from hilctl.loop.interlocks import InterlockRequirement, InterlockSettings
from hilctl.models.model_file import dump_model
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.run.result import RunResult
from hilctl.run.start import OnPart, RunKey, StepStoppedError, checked_experiment, paced, unpaced
from hilctl.studies.characterise.limits import CharacterisationLimits, limits_of
from hilctl.studies.characterise.response import RigProblemError
from hilctl.studies.characterise.results import (
    Characterisation,
    Measured,
    StepRow,
    identified,
    judged,
)
from hilctl.studies.characterise.steps import STEPS, CharacterisationStep
from hilctl.studies.characterise.waveforms import Keys, at_rest, within


def waveform_setting(keys: Keys) -> str:
    """Return the ``key=value`` text that has an experiment run a waveform."""
    return f"waveform={json.dumps(keys)}"


def unit_of(experiment: Path, settings: Sequence[str]) -> CommandUnit:
    """Return the unit of the commands that an experiment limits."""
    return "V" if _document(experiment, settings).holds(("limits", "drive_v")) else "A"


def without_reference(experiment: Path, settings: Sequence[str]) -> list[str]:
    """Return settings that take out what needs a compensator: a step has none.

    Args:
        experiment: Experiment file.
        settings: ``key=value`` texts over it.

    Raises:
        InputError: The file can't be read.
        ConfigError: It is no YAML, or a text is none of these.
    """
    document = _document(experiment, settings)
    found = ["compensator=none"]
    found += [f"{key}=null" for key in ("feedback", "adaptation") if document.holds((key,))]
    return found + [
        f"limits.{key}=null" for key in _tracking_keys() if document.holds(("limits", key))
    ]


def _document(experiment: Path, settings: Sequence[str]) -> Document:
    document = load_document(experiment)
    for setting in settings:
        document.set(setting)
    return document


def _tracking_keys() -> Iterator[str]:
    """Give the interlocks that need a reference, and those that need one of them."""
    known = {
        key: [each for each in field.metadata if isinstance(each, InterlockRequirement)]
        for key, field in InterlockSettings.model_fields.items()
    }
    tracking = {key for key, needs in known.items() if any(each.reference_um for each in needs)}
    for key, needs in known.items():
        if key in tracking or any(each.key in tracking for each in needs):
            yield key


StepRunner: TypeAlias = Callable[[Path, Sequence[str], Path, OnPart], RunResult]
"""Runs an experiment file with settings into a recording, over one that stands there."""

_BYTES_A_SAMPLE = 45.0
_SPARE = 1.2
_NAME_LENGTH = 80


@dataclass(frozen=True, slots=True)
class CharacterisationPlan:
    """What a campaign will do at most, before anything is measured.

    Attributes:
        limits: What it keeps to.
        steps: Its steps; of those for the first reaction, mostly only one is needed.
        pauses_s: Time for which the coil must cool between them.
        free_mb: Room on the disk.
    """

    limits: CharacterisationLimits
    steps: tuple[StepRow, ...]
    pauses_s: float
    free_mb: float

    @property
    def seconds(self) -> float:
        """Rig time, without pauses."""
        return sum(step.seconds for step in self.steps)

    @property
    def megabytes(self) -> float:
        """About how large all recordings will be."""
        return sum(step.megabytes for step in self.steps)


@dataclass(frozen=True, slots=True)
class CharacterisationHost:
    """What a campaign needs from outside: runs, time, and whoever watches.

    Attributes:
        run: How a step is run.
        now_s: Unix time in s.
        sleep_s: Waits that long.
        on_step: Called with each step that is done.
        on_progress: Called with what is done, from 0 to 1, and what is being done.
    """

    run: StepRunner = paced
    now_s: Callable[[], float] = time.time
    sleep_s: Callable[[float], None] = time.sleep
    on_step: Callable[[StepRow], None] = field(default=lambda row: None)
    on_progress: Callable[[float, str], None] = field(default=lambda done, text: None)


class CharacterisationRunner:
    """Characterises the device of an experiment.

    Args:
        experiment: Experiment file: device, rate, limits, safe value; its waveform and compensator
            are not used.
        settings: ``key=value`` texts over it.
        folder: Where each step's recording goes.
        highest_hz: Highest frequency of loops; from the sample rate where None.
        host: What runs it.

    Raises:
        InputError: The experiment can't be used; or it is not to keep real time, and the device is
            no simulated one.
    """

    def __init__(
        self,
        experiment: Path,
        settings: Sequence[str],
        folder: Path,
        highest_hz: float | None = None,
        host: CharacterisationHost | None = None,
    ) -> None:
        self._experiment = experiment
        self._settings = [*settings, *without_reference(experiment, settings)]
        self._folder = folder
        self._host = host or CharacterisationHost()
        first = {"kind": "hold", "unit": unit_of(experiment, self._settings), "level": 0.0}
        self._loaded = load_experiment(
            experiment, [*self._settings, waveform_setting({**first, "duration_s": 1.0})]
        )
        self.limits = limits_of(self._loaded, highest_hz)
        info = self._loaded.device.info
        if self._host.run is unpaced and not info.simulated:
            raise InputError(
                f"--fast: {info.name}: only a simulated device can do without real time"
            )
        # What does not depend on the waveform is refused here, before anything moves.
        checked_experiment(experiment, [*self._settings, waveform_setting(at_rest(self.limits))])
        self._coil = CoolingCoil(self._loaded.config, 0.0, 0.0)
        self._measured = Measured()
        self._rows: list[StepRow] = []
        self._recordings: dict[str, Path] = {}

    @cached_property
    def plan(self) -> CharacterisationPlan:
        """What there is to do, at full amplitude."""
        coil, now_s, pauses_s = CoolingCoil(self._loaded.config, 0.0, 0.0), 0.0, 0.0
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
            megabytes = command.size * _BYTES_A_SAMPLE / 1e6
            rows.append(StepRow(step.name, step.purpose, seconds, megabytes))
        around = next(p for p in (self._folder, *self._folder.absolute().parents) if p.exists())
        return CharacterisationPlan(
            self.limits, tuple(rows), pauses_s, shutil.disk_usage(around).free / 1e6
        )

    def _heat(self, command: F64) -> RunHeat:
        return RunHeat().then(command, self._loaded.config.limits, self.limits.sample_rate_hz)

    def discard(self) -> None:
        """Remove the recordings of steps that stand in the folder, so that all begins anew."""
        for number, step in enumerate(STEPS, 1):
            path = self._path(number, step)
            if path.is_file():  # a folder of that name is none of them
                path.unlink()

    def characterise(self, output: Path, *, overwrite: bool = False) -> Characterisation:
        """Run every step, identify the model, and judge it.

        Args:
            output: Model file to write.
            overwrite: Whether one of that name may be replaced.

        Raises:
            InputError: A file can't be written, or there is no room; nothing has moved.
            StepStoppedError: Somebody stopped a step.
            RunError: A step ended by a fault that no measurement explains.
        """
        check_writable(output, overwrite=overwrite)
        self._make_room()
        result = Characterisation(
            experiment=self._loaded.config.name,
            device=self._loaded.device.info.name,
            unit=self.limits.unit,
            band_hz=(self.limits.lowest_hz, self.limits.highest_hz),
            steps=(),
            measured=self._measured,
        )
        try:
            self._run_steps()
            return self._with_model(result, output, overwrite=overwrite)
        except RigProblemError as error:
            return replace(self._so_far(result), problem=str(error), problem_code=error.code)

    def _so_far(self, result: Characterisation) -> Characterisation:
        return replace(result, steps=tuple(self._rows), measured=self._measured)

    def _make_room(self) -> None:
        plan = self.plan
        if plan.free_mb < _SPARE * plan.megabytes:
            room = f"{plan.megabytes:.0f} MB, and there are {plan.free_mb:.0f} MB"
            raise InputError(f"{self._folder}: no room for the recordings: they take {room}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self._folder}: can't be made: {error.strerror}") from None

    def _run_steps(self) -> None:
        for number, step in enumerate(STEPS, 1):
            keys = step.waveform(self.limits, self._measured)
            if keys is not None:
                self._do(number, step, keys)

    def _do(self, number: int, step: CharacterisationStep, keys: Keys) -> None:
        keys, command = within(self.limits, keys)
        path = self._path(number, step)
        settings = self._step_settings(number, step, keys)
        recording = self._kept(path, settings)
        kept, heat = recording is not None, self._heat(command)
        if recording is None:
            self._cool(step, self._pause_s(heat))
            recording = self._recorded(number, step, settings, path)
        now_s = self._host.now_s()
        # One that was kept has cooled the coil since.
        self._coil.ran(heat, min(path.stat().st_mtime, now_s) if kept else now_s)
        self._recordings[step.name] = path
        seconds = command.size / self.limits.sample_rate_hz
        row = StepRow(
            step.name, step.purpose, seconds, path.stat().st_size / 1e6, "", str(path), kept
        )
        self._rows.append(row)
        self._measured, text = step.take(recording, self.limits, self._measured)
        self._rows[-1] = replace(row, text=text)
        self._host.on_step(self._rows[-1])

    def _recorded(
        self, number: int, step: CharacterisationStep, settings: Sequence[str], path: Path
    ) -> Recording:
        def part_done(part: float) -> None:
            self._progress(step, f"{step.name}: {step.purpose}", part)

        part_done(0.0)
        try:
            result = self._host.run(self._experiment, settings, path, part_done)
        except InputError as error:
            if not self._rows:
                raise
            raise RunError(f"{step.name} is refused: {error}") from None
        if result.stop_signal:
            raise StepStoppedError(f"{step.name}: {result.reason}", result.stop_signal)
        if result.code != "completed":
            raise _fault(step, result, read(path))
        return read(path)

    def _kept(self, path: Path, settings: Sequence[str]) -> Recording | None:
        """Return the recording of a step that is done; None where there is none, or another's."""
        if not path.exists():
            return None
        try:
            recording = read(path)
        except DataError:  # cut short before its first sample: the step is run again
            return None
        key = RunKey.of(load_experiment(self._experiment, settings))
        same = RunKey.of_facts(recording.run) == key
        return recording if same and recording.end.get("code") == "completed" else None

    def _pause_s(self, heat: RunHeat) -> float:
        """Return how long the coil must cool, by the steps here and by the device's last run."""
        now_s = self._host.now_s()
        last_a2 = heat_before(self._loaded, now_s)
        last = CoolingCoil(self._loaded.config, last_a2, now_s)
        return max(coil.pause_s(heat, now_s) for coil in (self._coil, last))

    def _cool(self, step: CharacterisationStep, pause_s: float) -> None:
        """Let the coil cool; a run that need not keep real time is one of a rig without a coil."""
        if pause_s > 0.0 and self._host.run is not unpaced:
            self._progress(step, f"{step.name}: the coil cools for {pause_s:.0f} s", 0.0)
            self._host.sleep_s(pause_s)

    def _progress(self, step: CharacterisationStep, text: str, part: float) -> None:
        """Say where the campaign stands, by its rig time."""
        planned = {each.name: each.seconds for each in self.plan.steps}
        before = list(planned)[: list(planned).index(step.name)]
        done_s = sum(planned[name] for name in before) + part * planned[step.name]
        left_s = round(self.plan.seconds - done_s)
        left = f"{left_s // 60}:{left_s % 60:02d} left"
        self._host.on_progress(done_s / self.plan.seconds, f"{text}; {left}")

    def _with_model(
        self, result: Characterisation, output: Path, *, overwrite: bool
    ) -> Characterisation:
        self._host.on_progress(1.0, "identify")
        rest = self._measured.rest
        try:
            found = identified(self._recordings)
            apart = judged(found.fit.model, self._recordings, rest.noise_um if rest else 0.0)
        except InputError as error:
            remedy = "look at the loops on the page, and try 'hilctl identify' on the recordings"
            raise RigProblemError(
                "no_model", f"no model can be identified: {error}", remedy
            ) from None
        result = replace(self._so_far(result), held_out=apart, identification=found)
        if result.is_model:
            write_text(output, dump_model(found.fit.model), overwrite=overwrite)
        return result

    def _path(self, number: int, step: CharacterisationStep) -> Path:
        return self._folder / f"{number:02d}-{step.name}.mcap"

    def _step_settings(self, number: int, step: CharacterisationStep, keys: Keys) -> list[str]:
        name = f"{self._loaded.config.name}-{step.name}"[-_NAME_LENGTH:].lstrip("._-")
        settings = [*self._settings, f"name={json.dumps(name)}", waveform_setting(keys)]
        if self._rows and self._loaded.config.safe.at_start is not None:
            settings.append(f"safe.at_start={self.limits.rest!r}")  # the steps before ended there
        seed = self._loaded.device.Options.model_fields.get("seed")
        if seed is not None:  # noise that all steps share would be fitted
            first = self._loaded.config.device.get("seed", seed.default)
            settings.append(f"device.seed={first + number}")
        return settings


def _fault(step: CharacterisationStep, result: RunResult, recording: Recording) -> RunError:
    """Return what a run that ended by a fault says of the rig."""
    codes = {event.code for event in recording.events}
    text = f"{step.name}: {result.reason}"
    if "sensor_range" in codes:
        return RigProblemError(
            "saturated_sensor", text, "give the sensor a wider range, or narrow limits.stroke_um"
        )
    if "sensor_frozen" in codes:
        return RigProblemError("no_reading", text, "look at the sensor and its wires")
    return RunError(text)
