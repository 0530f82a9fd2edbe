"""Session of iterative learning: repeated runs of one experiment, each with a new correction."""

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from hilctl import __version__
from hilctl.analysis.contour import average_contour
from hilctl.base.axes import names_text, problems_of_axes
from hilctl.base.errors import ConfigError, ConfigProblem, HilctlError
from hilctl.base.formatting import shown_briefly
from hilctl.base.segments import Segment, common_period
from hilctl.base.types import C128
from hilctl.base.yaml import setting
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun
from hilctl.experiment.sections.correction import (
    RESIDUAL,
    Correction,
    LearnedCycle,
    fits,
    signature,
    write_correction,
)
from hilctl.experiment.sections.coupling import coupling_sha256
from hilctl.lab.ilc.cycle import CycleScore, cycle_error, harmonic_count
from hilctl.lab.ilc.residual import CAUSES, ResidualBand, residual
from hilctl.lab.ilc.update import IlcIteration, IlcState, best_run, learn, refused
from hilctl.lab.studies.study import StepStoppedError, Study, StudyRun, StudyStep
from hilctl.models.model_file import model_sha256
from hilctl.recording.recording import Recording
from hilctl.run.result import recordings_of
from hilctl.run.start import checked_run

HIGHEST_PART = 0.125
"""Highest frequency of a correction, as a share of the sample rate."""

_FEWEST_CYCLES = 2


@dataclass(frozen=True, slots=True)
class Learner:
    """A periodic waveform to learn.

    Attributes:
        checked: The axis.
        segment: Segment of its reference.
        cycles: Cycles of the waveform in a period of all axes that move at the same time.
    """

    checked: CheckedExperiment
    segment: Segment
    cycles: int = 1

    @property
    def axis(self) -> str:
        """Name of the axis; empty if it is the only one."""
        return self.checked.loaded.axis

    @property
    def period(self) -> float:
        """Period of the error, in samples."""
        return self.cycles * self.segment.period

    @property
    def highest_hz(self) -> float:
        """Highest bandwidth of a correction."""
        return HIGHEST_PART * self.checked.reference.sample_rate_hz

    def recorded(self, recording: Recording) -> Segment:
        """Return the segment in a recording of the axis."""
        # Samples before the waveform: a ramp, a condition, a rest.
        before = recording.segments[0].start - self.checked.reference.segments[0].start
        return self.segment.shifted(before)

    def error(self, recording: Recording) -> CycleScore:
        """Return the error in a recording of the axis."""
        return cycle_error(recording, self.recorded(recording), self.highest_hz, self.cycles)

    def cycle(self, coefficients: C128, **figures: float) -> LearnedCycle:
        """Return a cycle of the correction from its coefficients."""
        wanted = signature(self.checked.reference.values, self.segment)
        assert wanted is not None
        label, period = self.segment.label, self.period
        return LearnedCycle.from_coefficients(
            label, period, wanted, coefficients, self.cycles, **figures
        )


def repeating(checked: CheckedExperiment) -> list[Segment]:
    """Return the periodic segments to learn, the first of equal ones.

    Raise ConfigError if none has enough cycles, or without a compensator.
    """
    loaded = checked.loaded

    def refuse(key: str, rule: str, hint: str) -> ConfigError:
        return ConfigError([loaded.document.problem(key, rule, hint=hint)])

    if loaded.model is None:
        raise refuse("compensator", "is needed to learn: its input is corrected", "set a model")
    found: list[Segment] = []
    known: list[LearnedCycle] = []
    for segment in checked.reference.segments:
        wanted = signature(checked.reference.values, segment)
        if wanted is None or segment.steady_cycles()[2] < _FEWEST_CYCLES:
            continue
        if any(fits(cycle, checked.reference.values, segment) for cycle in known):
            continue
        found.append(segment)
        nothing = np.zeros(1, dtype=np.complex128)
        known.append(LearnedCycle.from_coefficients(segment.label, segment.period, wanted, nothing))
    if not found:
        rule = f"must repeat for at least {_FEWEST_CYCLES} whole cycles after its soft start"
        raise refuse("waveform", rule, "16 or more average the noise well")
    return found


def learners_of(run: CheckedRun) -> tuple[list[list[Learner]], dict[str, str]]:
    """Return the waveforms to learn, grouped by those that move at the same time.

    Also return why an axis is left alone, by its name. Raise ConfigError if all are, or if the
    waveforms of a group have no common period.
    """
    found: list[Learner] = []
    alone: dict[str, Sequence[ConfigProblem]] = {}
    for checked in run.axes:
        try:
            found += [Learner(checked, segment) for segment in repeating(checked)]
        except ConfigError as error:
            alone[checked.loaded.axis] = error.problems
    if not found:
        raise ConfigError(problems_of_axes(alone))
    groups: list[list[Learner]] = []
    for each in sorted(found, key=lambda learner: learner.segment.start):
        if groups and each.segment.start < max(other.segment.stop for other in groups[-1]):
            groups[-1].append(each)
        else:
            groups.append([each])
    reasons = {axis: "; ".join(map(str, problems)) for axis, problems in alone.items()}
    return [*map(_synchronised, groups)], reasons


def _synchronised(group: Sequence[Learner]) -> list[Learner]:
    """Return learners with a common period; raise ConfigError without one."""
    segments = [each.segment for each in group]
    shortest = min(each.steady_stop - each.steady_start for each in segments)
    period = common_period([each.period for each in segments], shortest)
    if period is not None:
        whole = [replace(each, period=period).steady_cycles()[2] for each in segments]
    if period is None or min(whole) < _FEWEST_CYCLES:
        first = group[0].checked
        each_hz = [f"{first.reference.sample_rate_hz / each.period:g} Hz" for each in segments]
        rule = f"must have a common period, of which {_FEWEST_CYCLES} cycles fit into the run"
        got = f"{', '.join(each_hz)} for {names_text([each.axis for each in group])}"
        hint = "set frequencies with a smaller common multiple, or a longer duration"
        raise ConfigError([first.loaded.document.problem("waveform", rule, got, hint)])
    return [replace(each, cycles=round(period / each.segment.period)) for each in group]


def beginning(learner: Learner) -> IlcState:
    """Return the initial state, from the correction of the experiment if it has one."""
    checked, period = learner.checked, learner.period
    rate_hz = checked.reference.sample_rate_hz
    count = harmonic_count(period, rate_hz / period, learner.highest_hz)
    first: C128 = np.zeros(count + 1, dtype=np.complex128)
    known = checked.loaded.correction
    for cycle in known.cycles if known else ():
        times, more = divmod(learner.cycles, cycle.waveform_cycles or 1)
        if fits(cycle, checked.reference.values, learner.segment) and not more:
            size = min(-(-first.size // times), cycle.coefficients.size)
            first[: size * times : times] = cycle.coefficients[:size]
    return IlcState(rate_hz, learner.highest_hz, first)


def correction_setting(file: Path, axis: str = "") -> str:
    """Return the ``key=value`` text that selects a correction file, for an axis."""
    key = f"axes.{axis}.compensator.correction" if axis else "compensator.correction"
    return setting(key, str(file.resolve()))


@dataclass(frozen=True, slots=True)
class IlcRow:
    """Result of one run for one waveform.

    Attributes:
        run: Number of the run; 0 is the first, before learning.
        floor_percent: Peak error that sensor noise alone would cause.
        delay_samples: Delay between correction and displacement, identified so far.
        natural_hz: Resonance identified so far; None without one.
        axis: Name of the axis; empty if it is the only one.
        contour_percent: Peak contour error of the learned axes in the average cycle, in percent of
            the largest peak-to-peak reference; None if only one axis moves at that time.
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
    axis: str = ""
    contour_percent: float | None = None


@shown_briefly
@dataclass(frozen=True, slots=True)
class IlcResult:
    """Result of learning.

    Attributes:
        corrections: Correction of each learned axis by its name; "" if there is only one axis.
        check: Verification run with the best correction, for each waveform; none if stopped.
        stop_signal: Number of the signal that stopped it, or 0.
        fault: Whether a run ended by a fault, or could not be run or evaluated.
        alone: Why an axis was left alone, by its name.
        residual: Error that remains, by the axis and label of a waveform; none at the noise floor.
    """

    corrections: Mapping[str, Correction]
    rows: tuple[IlcRow, ...]
    check: tuple[IlcRow, ...]
    reason: str
    stop_signal: int = 0
    fault: bool = False
    alone: Mapping[str, str] = field(default_factory=dict)
    residual: Mapping[tuple[str, str], Sequence[ResidualBand]] = field(default_factory=dict)

    @property
    def correction(self) -> Correction:
        """The correction; that of the first learned axis if there are several."""
        return next(iter(self.corrections.values()))

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, without the coefficients."""
        return {
            "reason": self.reason,
            "waveforms": [
                {
                    "axis": axis,
                    "label": cycle.label,
                    "start_percent": cycle.start_percent,
                    "error_percent": cycle.error_percent,
                    "residual": [
                        {**asdict(band), "reason": CAUSES[band.cause]}
                        for band in self.residual.get((axis, cycle.label), ())
                    ],
                }
                for axis, correction in self.corrections.items()
                for cycle in correction.cycles
            ],
            "left_alone": dict(self.alone),
            "check": [asdict(row) for row in self.check],
            "runs": [asdict(row) for row in self.rows],
        }


def row_of(
    number: int,
    learner: Learner,
    error: CycleScore,
    state: IlcState,
    reach_hz: float,
    path: Path,
    contour_percent: float | None = None,
) -> IlcRow:
    """Return the row of a run for one waveform, with the state of learning after the run."""
    return IlcRow(
        run=number,
        label=learner.segment.label,
        error_percent=error.percent,
        rms_percent=100.0 * error.rms_um / error.peak_to_peak_um,
        floor_percent=error.floor_percent,
        cycles=error.cycles,
        reach_hz=reach_hz,
        delay_samples=state.response.delay_s * state.sample_rate_hz,
        natural_hz=state.response.natural_hz,
        recording=str(path),
        axis=learner.axis,
        contour_percent=contour_percent,
    )


class IlcSession:
    """Session that learns the correction of every periodic waveform of an experiment.

    All axes learn from the same runs. Learning continues from the corrections of the experiment, if
    it has some. Raise InputError if no axis has a compensator and a waveform with enough whole
    steady cycles.
    """

    def __init__(self, experiment: Path, settings: Sequence[str], folder: Path) -> None:
        self._experiment, self._settings, self._folder = experiment, list(settings), folder
        self._checked = checked_run(experiment, settings)
        self._groups, self._alone = learners_of(self._checked)
        self._learners = [*chain(*self._groups)]
        self._states = [tuple(map(beginning, group)) for group in self._groups]
        self._rows: list[IlcRow] = []
        self._check_errors: list[CycleScore] = []
        self._refusals: list[str] = []

    def study(self, cycles: int, on_rows: Callable[[Sequence[IlcRow]], None]) -> Study[IlcResult]:
        """Run and learn until the error no longer improves.

        An error of the first run ends the study; a later one ends the learning.
        """
        reason, stop_signal, fault = "", 0, False
        check: tuple[IlcRow, ...] = ()
        try:
            reason = yield from self._runs_until_done(cycles, on_rows)
            check = yield from self._check()
        except (KeyboardInterrupt, HilctlError) as error:
            if not self._rows:
                raise
            fault = not isinstance(error, StepStoppedError | KeyboardInterrupt)
            stop_signal = 0 if fault else getattr(error, "signal", signal.SIGINT)
            reason = "; ".join(filter(None, (reason, str(error) or "stopped by Ctrl-C")))
        if self._refusals:
            reason += f"; {len(self._refusals)} corrections were refused: {self._refusals[-1]}"
        learned = [
            learner.cycle(
                best.correction_um,
                start_percent=state.trials[0].error.percent,
                error_percent=best.error.percent,
            )
            for learner, state, best in zip(
                self._learners, chain(*self._states), self._best(), strict=True
            )
        ]
        bands = self._residual()
        corrections, rows = self._corrections(learned, bands), tuple(self._rows)
        return IlcResult(corrections, rows, check, reason, stop_signal, fault, self._alone, bands)

    def _runs_until_done(
        self, cycles: int, on_rows: Callable[[Sequence[IlcRow]], None]
    ) -> Study[str]:
        """Run and learn; return the reason for the end."""
        for number in range(cycles + 1):
            try:
                run = yield self._step(number, [each.next_um for each in chain(*self._states)])
            except ConfigError as error:
                if not self._rows:
                    raise
                self._refusals.append(str(error))
                self._states = [
                    states if states[0].done else refused(states) for states in self._states
                ]
            else:
                rows = self._judge(number, run, learning=True)
                self._rows += rows
                on_rows(rows)
            if all(states[0].done for states in self._states):
                return "; ".join(sorted({states[0].done for states in self._states}))
        return f"no convergence in {cycles} learning cycles: specify more with --cycles"

    def _step(self, number: int, coefficients: Sequence[C128]) -> StudyStep:
        """Return the run with corrections, which are kept beside its recordings."""
        name, settings = f"run-{number:02d}", [*self._settings]
        corrections = self._corrections([*map(Learner.cycle, self._learners, coefficients)])
        for axis, file in recordings_of([*corrections], self._folder / f"{name}.yaml").items():
            write_correction(file, corrections[axis], overwrite=True)
            settings.append(correction_setting(file, axis))
        for checked in self._checked.axes:  # noise must not be learned
            settings += checked.loaded.noise_settings(number)
        return StudyStep(self._experiment, settings, name, f"run {number}", replaces=True)

    def _judge(self, number: int, run: StudyRun, *, learning: bool) -> list[IlcRow]:
        """Evaluate a run, and learn from it; return the row of each waveform."""
        recordings = dict(zip(self._checked.names, run.recordings, strict=True))
        rows = []
        for k, (group, before) in enumerate(zip(self._groups, self._states, strict=True)):
            errors = [each.error(recordings[each.axis]) for each in group]
            contour_percent = _contour(recordings, group)
            if not learning:
                self._check_errors += errors
            elif not before[0].done:
                self._states[k] = learn(before, errors)
            for i, learner in enumerate(group):
                state, path = self._states[k][i], recordings[learner.axis].path
                found = errors[i], state, before[i].reach_hz, path, contour_percent
                rows.append(row_of(number, learner, *found))
        return rows

    def _check(self) -> Study[tuple[IlcRow, ...]]:
        """Verify the best corrections in another run, with new noise."""
        number = self._rows[-1].run + 1
        run = yield self._step(number, [each.correction_um for each in self._best()])
        return tuple(self._judge(number, run, learning=False))

    def _best(self) -> list[IlcIteration]:
        """Return the best run of each waveform, the same one for those of a group."""
        return [each.trials[best_run(states)] for states in self._states for each in states]

    def _residual(self) -> dict[tuple[str, str], list[ResidualBand]]:
        """Return the residual error of each waveform, see :class:`IlcResult`."""
        checks: Sequence[CycleScore | None] = self._check_errors or [None] * len(self._learners)
        states = chain(*self._states)
        return {
            (learner.axis, learner.segment.label): residual(state, best, check)
            for learner, state, best, check in zip(
                self._learners, states, self._best(), checks, strict=True
            )
        }

    def _corrections(
        self,
        cycles: Sequence[LearnedCycle],
        residual: Mapping[tuple[str, str], Sequence[ResidualBand]] | None = None,
    ) -> dict[str, Correction]:
        """Return the correction of each learned axis from the cycle of each waveform."""
        found = {}
        for checked in self._checked.axes:
            loaded, rate_hz = checked.loaded, checked.reference.sample_rate_hz
            provenance = {
                "experiment": loaded.config.name,
                "device": loaded.device.info.name,
                "hilctl": __version__,
                "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                "runs": str(len(self._rows) // len(cycles)),
            }
            mine = []
            for learner, state, cycle in zip(
                self._learners, chain(*self._states), cycles, strict=True
            ):
                if learner.axis == loaded.axis:
                    mine.append(cycle)
                    if state.trials:
                        delay = state.response.delay_s * rate_hz
                        provenance[f"delay_samples: {cycle.label}"] = f"{delay:.2f}"
                    if bands := (residual or {}).get((learner.axis, cycle.label)):
                        provenance[RESIDUAL + cycle.label] = "; ".join(map(str, bands))
            if mine:
                found[loaded.axis] = Correction(
                    sample_rate_hz=rate_hz,
                    model_sha256=model_sha256(loaded.model),
                    coupling_sha256=coupling_sha256(loaded.coupling),
                    cycles=tuple(mine),
                    provenance=provenance,
                )
        return found


def _contour(recordings: Mapping[str, Recording], group: Sequence[Learner]) -> float | None:
    """Return the contour error of waveforms of several axes, see :class:`IlcRow`."""
    axes = {each.axis: each for each in group}
    if not 1 < len(axes) == len(group):
        return None
    parts = [each.recorded(recordings[axis]) for axis, each in axes.items()]
    common = replace(
        parts[0],
        steady_start=max(each.steady_start for each in parts),
        steady_stop=min(each.steady_stop for each in parts),
        period=group[0].period,
    )
    return average_contour([recordings[axis] for axis in axes], common)
