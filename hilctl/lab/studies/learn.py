"""Session of iterative learning: repeated runs of one experiment, each with a new correction."""

import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilctl import __version__
from hilctl.base.errors import ConfigError, HilctlError
from hilctl.base.formatting import shown_briefly
from hilctl.base.segments import Segment
from hilctl.base.types import C128
from hilctl.base.yaml import setting
from hilctl.experiment.preflight import CheckedExperiment
from hilctl.experiment.sections.correction import (
    Correction,
    LearnedCycle,
    fits,
    signature,
    write_correction,
)
from hilctl.lab.ilc.cycle import CycleScore, cycle_error, harmonic_count
from hilctl.lab.ilc.update import IlcState, learn, refused
from hilctl.lab.studies.study import StepStoppedError, Study, StudyStep
from hilctl.models.model_file import model_sha256
from hilctl.recording.recording import Recording
from hilctl.run.start import checked_experiment

HIGHEST_PART = 0.125
"""Highest frequency of a correction, as a share of the sample rate."""

_FEWEST_CYCLES = 2


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


def beginning(checked: CheckedExperiment, segment: Segment) -> IlcState:
    """Return the initial state, from the correction of the experiment if it has one."""
    rate_hz = checked.reference.sample_rate_hz
    highest_hz = HIGHEST_PART * rate_hz
    count = harmonic_count(segment.period, rate_hz / segment.period, highest_hz)
    first: C128 = np.zeros(count + 1, dtype=np.complex128)
    known = checked.loaded.correction
    for cycle in known.cycles if known else ():
        if fits(cycle, checked.reference.values, segment):
            size = min(first.size, cycle.coefficients.size)
            first[:size] = cycle.coefficients[:size]
    return IlcState(rate_hz, highest_hz, first)


def correction_setting(file: Path) -> str:
    """Return the ``key=value`` text that selects a correction file."""
    return setting("compensator.correction", str(file.resolve()))


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


class IlcSession:
    """Session that learns the correction of every periodic waveform of an experiment.

    Learning continues from the correction of the experiment, if it has one. Raise InputError if it
    has no compensator, or no waveform with enough whole steady cycles.
    """

    def __init__(self, experiment: Path, settings: Sequence[str], folder: Path) -> None:
        self._experiment, self._settings, self._folder = experiment, list(settings), folder
        self._checked = checked_experiment(experiment, settings)
        self._segments = repeating(self._checked)
        self._learning = [beginning(self._checked, each) for each in self._segments]
        self._rows: list[IlcRow] = []
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
        return IlcResult(self._best(), tuple(self._rows), check, reason, stop_signal, fault)

    def _runs_until_done(
        self, cycles: int, on_rows: Callable[[Sequence[IlcRow]], None]
    ) -> Study[str]:
        """Run and learn; return the reason for the end."""
        for number in range(cycles + 1):
            try:
                run = yield self._step(number, [each.next_um for each in self._learning])
            except ConfigError as error:
                if not self._rows:
                    raise
                self._refusals.append(str(error))
                self._learning = [refused(each) for each in self._learning]
            else:
                rows = self._judge(number, run.recording, learning=True)
                self._rows += rows
                on_rows(rows)
            if all(each.done for each in self._learning):
                return "; ".join(sorted({each.done for each in self._learning}))
        return f"no convergence in {cycles} learning cycles: specify more with --cycles"

    def _step(self, number: int, coefficients: Sequence[C128]) -> StudyStep:
        """Return the run with a correction, which is kept beside its recording."""
        name = f"run-{number:02d}"
        file = self._folder / f"{name}.yaml"
        cycles = [
            self._cycle(segment, each)
            for segment, each in zip(self._segments, coefficients, strict=True)
        ]
        write_correction(file, self._whole(cycles), overwrite=True)
        noise = self._checked.loaded.noise_settings(number)  # which must not be learned
        settings = [*self._settings, correction_setting(file), *noise]
        return StudyStep(self._experiment, settings, name, f"run {number}", replaces=True)

    def _judge(self, number: int, recording: Recording, *, learning: bool) -> list[IlcRow]:
        # Samples before the waveform: a ramp, a condition, a rest.
        before = recording.segments[0].start - self._checked.reference.segments[0].start
        rows = []
        for i, segment in enumerate(self._segments):
            state = self._learning[i]
            error = cycle_error(recording, segment.shifted(before), state.highest_hz)
            reach_hz = state.reach_hz
            if learning and not state.done:
                state = learn(state, error)
                if state.done:  # its correction stays while others are learned
                    state = replace(state, next_um=state.best.correction_um)
                self._learning[i] = state
            rows.append(row_of(number, segment, error, state, reach_hz, recording.path))
        return rows

    def _check(self) -> Study[tuple[IlcRow, ...]]:
        """Verify the best corrections in another run, with new noise."""
        number = self._rows[-1].run + 1
        run = yield self._step(number, [each.best.correction_um for each in self._learning])
        return tuple(self._judge(number, run.recording, learning=False))

    def _best(self) -> Correction:
        cycles = []
        for segment, state in zip(self._segments, self._learning, strict=True):
            figures = {
                "start_percent": state.trials[0].error.percent,
                "error_percent": state.best.error.percent,
            }
            cycles.append(self._cycle(segment, state.best.correction_um, **figures))
        return self._whole(cycles)

    def _cycle(self, segment: Segment, coefficients: C128, **figures: float) -> LearnedCycle:
        wanted = signature(self._checked.reference.values, segment)
        assert wanted is not None
        return LearnedCycle.from_coefficients(
            segment.label, segment.period, wanted, coefficients, **figures
        )

    def _whole(self, cycles: Sequence[LearnedCycle]) -> Correction:
        rate_hz = self._checked.reference.sample_rate_hz
        provenance = {
            "experiment": self._checked.loaded.config.name,
            "device": self._checked.loaded.device.info.name,
            "hilctl": __version__,
            "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "runs": str(len(self._rows) // len(self._segments)),
        }
        for segment, state in zip(self._segments, self._learning, strict=True):
            if state.trials:
                delay = state.response.delay_s * rate_hz
                provenance[f"delay_samples: {segment.label}"] = f"{delay:.2f}"
        return Correction(
            sample_rate_hz=rate_hz,
            model_sha256=model_sha256(self._checked.loaded.model),
            cycles=tuple(cycles),
            provenance=provenance,
        )
