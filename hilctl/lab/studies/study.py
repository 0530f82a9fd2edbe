"""Engine of studies: many runs, each of which may depend on the results of those before it.

A study is a generator. It yields a :class:`StudyStep`, receives its :class:`StudyRun`, and returns
its result:

    def largest_amplitude(experiment, most_um):
        amplitude = 0.5
        while True:
            run = yield StudyStep(experiment, {"waveform.amplitude": amplitude})
            if summarize(run.recording).peak_to_peak_um > most_um:
                return amplitude
            amplitude *= 1.5

Before each run the engine waits for the coil to cool. It repeats a run that a stall ended, names
the recordings and reports progress. The recordings are the checkpoint: a step is done if the folder
has a completed recording of its experiment. A killed study loses one run and resumes with the same
call, provided that it yields the same steps for the same results.

An error is raised at the ``yield``. A study that does not catch it ends there; a stopped study runs
no further step.
"""

import logging
import math
import shutil
import signal
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self, TypeAlias, TypeVar

from hilctl.base.errors import DataError, HilctlError, InputError, RunError
from hilctl.base.events import Event
from hilctl.base.files import exists, make_folder
from hilctl.base.yaml import texts_of
from hilctl.experiment.coil_heat import CoolingCoil, RunHeat
from hilctl.experiment.device_state import heat_after, heat_before
from hilctl.experiment.load import LoadedExperiment, load_axes
from hilctl.experiment.preflight import check
from hilctl.experiment.state_files import MachineTime
from hilctl.lab.studies.study_folder import completed_runs, last_started
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.recording.run_summary import read_ends
from hilctl.run.result import RunResult, recordings_of
from hilctl.run.start import RunKey, completed_key, paced, unpaced, unused

_log = logging.getLogger(__name__)

REPEATS = 2
HARMLESS = frozenset({"late", "dropped", "invalid_command"})
"""Codes of faults that are not the device's or the rig's: the next step may succeed."""

_STALLS = frozenset({"late", "device_lost", "sensor_invalid"})  # codes of events
_SPARE = 1.2
_WAIT_SHOWN_S = 1.0


@dataclass(frozen=True, slots=True)
class StudyStep:
    """The experiment of one run.

    Attributes:
        experiment: Experiment file (YAML).
        settings: Overrides of the experiment.
        name: Name of the recording without suffix, before the name of its axis; default: name of
            the experiment, and number of the step.
        text: Description for progress and messages; default: the name.
        replaces: Replace a recording of the same name; otherwise the new one gets a number.
        repeats: Largest number of repeats after a stall of the computer, the network or the device.
        flaw: Returns why a completed recording is unusable, as after a stall, or an empty text.
        cool_to_rms_a: Running rms of the current to cool to; by default, only as far as the run
            needs to keep its budget.
        loaded: The loaded experiment of each axis, if it is known.
        heat: Effect of the run on the heat of the coil, if it is known.
        done_s: Planned time of the steps before it, for progress.
    """

    experiment: str | Path
    settings: Mapping[str, object] | Sequence[str] = ()
    name: str = ""
    text: str = ""
    replaces: bool = False
    repeats: int = REPEATS
    flaw: Callable[[Recording], str] | None = None
    cool_to_rms_a: float = math.inf
    loaded: tuple[LoadedExperiment, ...] = ()
    heat: RunHeat | None = None
    done_s: float = 0.0


@dataclass(frozen=True)
class StudyRun:
    """A completed run.

    Attributes:
        paths: Recordings of its axes, that of the first one first.
        kept: Whether an earlier call of the study has recorded it.
    """

    step: StudyStep
    paths: tuple[Path, ...]
    kept: bool = False

    @property
    def path(self) -> Path:
        """Its recording; that of the first axis if there are several."""
        return self.paths[0]

    @cached_property
    def recordings(self) -> tuple[Recording, ...]:
        """The complete recordings of its axes."""
        return tuple(map(read, self.paths))

    @property
    def recording(self) -> Recording:
        """Its complete recording; that of the first axis if there are several."""
        return self.recordings[0]

    @property
    def flaw(self) -> str:
        """Why a recording is unusable; empty if all are usable."""
        if self.step.flaw is None:
            return ""
        return next(filter(None, map(self.step.flaw, self.recordings)), "")


_T = TypeVar("_T")
Study: TypeAlias = Generator[StudyStep, StudyRun, _T]


class StepStoppedError(RunError):
    """A study was stopped by a signal; earlier recordings are kept.

    Attributes:
        signal: Number of the signal.
        result: Result of the stopped run; None between two runs.
    """

    def __init__(self, text: str, number: int, result: RunResult | None = None) -> None:
        super().__init__(text)
        self.signal, self.exit_code, self.result = number, 128 + number, result


class StepFaultError(RunError):
    """A run of a study ended by a fault, or its recording is unusable.

    Attributes:
        result: Result of the run.
        events: Events of the run.
        stalled: Whether the run may be repeated.
    """

    def __init__(
        self, text: str, result: RunResult, events: Sequence[Event] = (), *, stalled: bool
    ) -> None:
        super().__init__(text)
        self.result, self.events, self.stalled = result, events, stalled

    @property
    def harmless(self) -> bool:
        """Whether the fault is not the device's or the rig's, so that the next step may succeed."""
        errors = {event.code for event in self.events if event.level == "error"} - {"run_ended"}
        return self.result.safe and bool(errors) and errors <= HARMLESS


@dataclass(frozen=True, slots=True)
class StudyHost:
    """Runs, time and observers of a study."""

    run: Callable[..., RunResult] = paced
    real_time: bool = True  # otherwise no time passes for the coil to cool
    now: Callable[[], MachineTime] = MachineTime.now
    sleep_s: Callable[[float], None] = time.sleep
    # With the part that is done, 0 to 1, and a description.
    on_progress: Callable[[float, str], None] = field(default=lambda done, text: None)
    on_step: Callable[..., None] = field(default=lambda *result: None)  # with each step's result
    # With a note on each repaired recording.
    on_note: Callable[[str], None] = field(default=lambda text: None)

    @classmethod
    def of(cls, *, fast: bool, **observers: Any) -> Self:
        """Return a host in real time, or of simulated devices as fast as possible."""
        return cls(run=unpaced if fast else paced, real_time=not fast, **observers)


def run_study(
    study: Study[_T],
    folder: Path,
    host: StudyHost,
    *,
    resume: bool = True,
    total_s: float | None = None,
) -> _T:
    """Run a study, and return its result; ``total_s`` is its planned duration, for progress.

    Raises:
        InputError: An experiment was rejected before anything moved.
        RunError: A run ended by a fault, or an experiment was rejected later.
        StepStoppedError: A run was stopped.
    """
    make_folder(folder)
    engine = _Engine(folder, host, resume=resume, total_s=total_s)
    go_on: Callable[[], StudyStep] = partial(next, study)
    stopped: StepStoppedError | None = None
    try:
        while True:
            step = go_on()
            if stopped is not None:
                study.close()
                raise stopped
            try:
                run = engine.run(step)
            except KeyboardInterrupt:  # between two runs: a run has its own handler
                stopped = engine.interrupted()
                go_on = partial(study.throw, stopped)
            except HilctlError as error:
                stopped = error if isinstance(error, StepStoppedError) else None
                go_on = partial(study.throw, error)
            else:
                go_on = partial(study.send, run)
    except StopIteration as end:
        found: _T = end.value
        return found
    except KeyboardInterrupt:  # while the study evaluates a run
        raise engine.interrupted() from None
    except InputError as error:
        if not engine.moved:
            raise
        raise RunError(f"{engine.text}: {error}") from None


class _Engine:
    """Runs of one study.

    Attributes:
        moved: Whether a step has run.
        text: Description of the current step.
    """

    def __init__(
        self, folder: Path, host: StudyHost, *, resume: bool, total_s: float | None
    ) -> None:
        self._folder, self._host, self._resume, self._total_s = folder, host, resume, total_s
        self._completed = completed_runs(folder) if resume else {}
        self._last: Sequence[Path | None] = ()
        self._count = 0
        self.moved, self.text = False, ""

    def run(self, step: StudyStep) -> StudyRun:
        """Return the run of a step, recorded now unless it was recorded earlier."""
        self._count += 1
        self.text = step.text or step.name or f"step {self._count}"
        loaded = step.loaded or load_axes(Path(step.experiment), texts_of(step.settings))
        name = step.name or f"{loaded[0].config.name}-{self._count:04d}"
        file = self._folder / f"{name}.mcap"
        keys = {each.axis: RunKey.of(each) for each in loaded}
        kept = self._kept(step, keys, file) if self._resume else None
        if kept is not None:
            return kept
        for number in range(1, step.repeats + 1):
            try:
                return self._recorded(step, loaded, keys, file)
            except StepFaultError as error:
                if not error.stalled:
                    raise
                _log.warning("%s; the run is repeated (%d of %d)", error, number, step.repeats)
        return self._recorded(step, loaded, keys, file)

    def interrupted(self) -> StepStoppedError:
        """Return the error for Ctrl-C while no run is active."""
        return StepStoppedError(f"{self.text}: stopped by Ctrl-C", signal.SIGINT)

    def _kept(self, step: StudyStep, keys: Mapping[str, RunKey], file: Path) -> StudyRun | None:
        """Return an earlier run of a step, which counts once; None without one."""
        recorded = self._completed.get(tuple(keys.values()), [])
        while recorded:
            run = StudyRun(step, recorded.pop(0), kept=True)
            if not run.flaw:
                return run
        # Once a step has run again, its results may change the steps after it.
        axis, there = next(iter(recordings_of([*keys], file).items()))
        if step.replaces and not self.moved and completed_key(there) not in {None, keys[axis]}:
            raise InputError(
                f"{there} was recorded with other settings: restore them, choose another folder, "
                "or overwrite all recordings"
            )
        return None

    def _recorded(
        self,
        step: StudyStep,
        loaded: Sequence[LoadedExperiment],
        keys: Mapping[str, RunKey],
        file: Path,
    ) -> StudyRun:
        """Run a step when the coil is cool enough."""
        heat_a2 = self._cool(step, loaded) if self._host.real_time else 0.0
        self._show(step, self.text)
        result = self._host.run(
            Path(step.experiment), texts_of(step.settings),
            file if step.replaces else unused(file, "-", [*keys]),
            lambda part: self._show(step, self.text, part),
            overwrite=step.replaces, heat_a2=heat_a2,
        )  # fmt: skip
        self.moved, self._last = True, result.recordings
        reason = f"{self.text}: {result.reason}"
        if result.stop_signal:
            raise StepStoppedError(reason, result.stop_signal, result)
        if result.code != "completed":
            reads = all(each.config.safe.at_start is None for each in loaded)
            raise _fault(reason, result, reads_output=reads)
        if [RunKey.of_facts(read_ends(path).run) for path in result.recordings] != [*keys.values()]:
            rule = "the experiment, or a file it uses, changed during the study"
            raise RunError(f"{self.text}: {rule}. Start the study again")
        run = StudyRun(step, tuple(result.recordings))
        if flaw := run.flaw:
            raise StepFaultError(f"{self.text}: {flaw}", result, stalled=True)
        return run

    def _cool(self, step: StudyStep, loaded: Sequence[LoadedExperiment]) -> float:
        """Wait until each coil is cool enough; return the highest heat then, in A^2."""
        now, coils = self._host.now(), []
        recorded = self._last or [last_started(self._folder)] * len(loaded)
        for each, last in zip(loaded, recorded, strict=True):
            if each.config.limits.thermal_time_constant_s is not None:
                # Heat of the last run causes a pause, not an error.
                heat = step.heat or check(each, heat_a2=None).forecast.heat
                coils.append((CoolingCoil(each.rig, heat_of(each, last, now), now.boot_s), heat))
        if not coils:
            return 0.0
        pause_s = max(coil.pause_s(heat, now.boot_s, step.cool_to_rms_a) for coil, heat in coils)
        heat_a2 = max(coil.heat_a2(now.boot_s + pause_s) for coil, _ in coils)
        while pause_s > 0.0:
            self._show(step, f"{self.text}: the coil cools for {pause_s:.0f} s")
            self._host.sleep_s(min(pause_s, _WAIT_SHOWN_S))
            pause_s -= _WAIT_SHOWN_S
        return heat_a2

    def _show(self, step: StudyStep, text: str, part: float = 0.0) -> None:
        """Report progress: the completed part, a description, and the time left if it is known."""
        if self._total_s is not None:
            done_s = step.done_s + part * (step.heat.seconds if step.heat else 0.0)
            left = timedelta(seconds=max(0, round(self._total_s - done_s)))
            part, text = done_s / max(self._total_s, 1e-9), f"{text}; {left} left"
        self._host.on_progress(part, text)


def _fault(text: str, result: RunResult, *, reads_output: bool) -> StepFaultError:
    """Return the error of a run that ended by a fault."""
    events: tuple[Event, ...] = ()
    with suppress(DataError):  # no sample was recorded
        events = tuple(read(result.path).events)
    # The next run must know the output. It reads it from the device, except if at_start is set:
    # then this run must have confirmed its safe value.
    known = result.safe or reads_output
    stalled = known and not _STALLS.isdisjoint(event.code for event in events)
    return StepFaultError(text, result, events, stalled=stalled)


def heat_of(loaded: LoadedExperiment, last: Path | None, now: MachineTime) -> float:
    """Return the heat that the last run of the device or of the study left in the coil, in A^2."""
    # A simulated device has no history of its own; within a study it counts as one rig.
    config, info = loaded.config, loaded.device.info
    heat_a2, _ = heat_before(loaded, now)
    if config.limits.thermal_time_constant_s is None or not info.simulated or last is None:
        return heat_a2
    return max(heat_a2, heat_after(last, config, now.unix_s))


def free_mb(folder: Path) -> float:
    """Return the free disk space for a folder that may not exist yet, in MB."""
    around = next(path for path in (folder, *folder.absolute().parents) if exists(path))
    return shutil.disk_usage(around).free / 1e6


def require_room(folder: Path, needed_mb: float, available_mb: float) -> None:
    """Raise InputError if the disk has no room for the recordings of a study."""
    if available_mb < _SPARE * needed_mb:
        sizes = f"{needed_mb:.0f} MB needed, {available_mb:.0f} MB free"
        raise InputError(f"{folder}: no room for the recordings: {sizes}")
