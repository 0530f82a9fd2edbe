"""Identify the crosstalk between the axes of a stage, and verify its removal.

In each run one axis follows a multisine through its inverse, and the others hold. ``T_ij`` is the
response of sensor i to the reference of axis j. The crosstalk to remove from the input of axis i is
``T_ij / T_ii``, because its removal also moves through the inverse and the actuator of axis i. A
second set of runs with this coupling measures what is left.
"""

import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hilctl import __version__
from hilctl.base.axes import axis_documents
from hilctl.base.errors import ConfigError, InputError, RunError
from hilctl.base.yaml import Document, loc_of, setting
from hilctl.experiment.load import document_with
from hilctl.experiment.sections.coupling import Coupling, CrosstalkFilter, write_coupling
from hilctl.lab.response.fir_fit import fit_fir
from hilctl.lab.response.frequency_response import Lines, excited_lines
from hilctl.lab.studies.study import Study, StudyStep
from hilctl.models.base import HysteresisModel
from hilctl.recording.recording import Recording
from hilctl.run.start import checked_run
from hilctl.signals.cycle_metrics import rms

Keys: TypeAlias = dict[str, Any]
Responses: TypeAlias = Mapping[str, Mapping[str, Lines]]
"""Responses by the axis of the sensor and the axis that moves."""

MOST_UNEXPLAINED = 0.3
"""Largest residual beyond the noise, rms, of a crosstalk that is removed."""

_HIGHEST_PART, _HIGHEST_HZ = 0.05, 1000.0  # of the sample rate; without a range of the model
_LINES = 256
_PERIODS, _SETTLING = 8, 0.5  # periods that are evaluated, and those before them
_SOFT_S = 0.5
_OCTAVES = 7
_SOFT_CYCLES, _CYCLES = 2.0, 8.0
_PARTS = (0.3, 0.1, 0.03)  # of the experiment's amplitude; the first that passes the check
_LEAST, _CLEAR = 1e-3, 2.0  # crosstalk that counts: of the motion, and over its noise
_REMOVED = ("feedback", "adaptation", "compensator.correction", "coupling", "apart", "trigger")
_OF_WAVEFORM = re.compile(r"\s*(axes\.\w+\.)?waveform[.=\s]")


def crossed(moving: Recording, sensor: Recording) -> Recording:
    """Return the recording of a moving axis with the displacement of another axis of its run.

    Raise RunError if one of them lacks samples of the other.
    """
    samples, other = moving.samples, sensor.samples
    if not np.array_equal(samples.index, other.index):
        raise RunError(f"{sensor.path}: has other samples than {moving.path}. Run it again")
    return replace(moving, samples=replace(samples, displacement_um=other.displacement_um))


class CouplingStudy:
    """Study of the crosstalk between the axes of an experiment.

    Raise InputError if it is invalid or has one axis, or an axis has no compensator.
    """

    def __init__(
        self,
        experiment: Path,
        settings: Sequence[str],
        folder: Path,
        highest_hz: float | None = None,  # of the multisine; from the sample rate if None
    ) -> None:
        self._experiment, self._folder = experiment, folder
        document = document_with(experiment, settings)
        names = [*axis_documents(document)]
        if len(names) < 2:
            raise ConfigError([document.problem("axes", "must be at least two to couple")])
        removed = [f"{key}=null" for key in _removed(document, names)]
        checked = checked_run(experiment, [*settings, *removed])
        # A setting without effect would be refused.
        self._settings = [each for each in settings if not _OF_WAVEFORM.match(each)] + removed
        for each in (each.loaded for each in checked.axes):
            if each.model is None:
                rule = "must name a model to couple: each axis moves through its inverse"
                raise ConfigError([each.document.problem("compensator", rule)])
        self._axes, rate_hz = checked.axes, checked.config.sample_rate_hz
        self._names = names
        self._highest_hz = highest_hz or min(
            _HIGHEST_PART * rate_hz, *(_identified_hz(each.loaded.model) for each in self._axes)
        )
        if not 0.0 < self._highest_hz < 0.5 * rate_hz:
            rule = f"must be between 0 and half the sample rate, {0.5 * rate_hz:g} Hz"
            raise InputError(f"--highest-hz {rule}, got {highest_hz:g}")
        self._step_hz = rate_hz / round(rate_hz * _LINES / self._highest_hz)
        spans = {each.loaded.axis: each.reference.span for each in self._axes}
        self._middles_um = {axis: 0.5 * sum(span) for axis, span in spans.items()}
        self._half_um = max(0.5 * (high - low) for low, high in spans.values())
        if not self._half_um > 0.0:
            rule = "must move an axis: it sets how far each one moves"
            raise ConfigError([document.problem("waveform", rule)])
        steps = (np.abs(np.diff(each.reference.values)).max() for each in self._axes)
        self._um_per_s = rate_hz * float(max(steps))
        self.seconds = 0.0
        """Duration of all runs."""
        self._multisines, self._sine_runs = (
            {axis: self._passing(axis, map(motion, parts)) for axis in self._names}
            for motion, parts in ((self._multisine, _PARTS), (self._sines, (1.0, *_PARTS)))
        )
        self._runs = 0

    def study(self) -> Study[Coupling]:
        """Run, and return the coupling; raise RunError if the crosstalk cannot be removed."""
        measured = yield from self._responses("measured", self._multisines)
        into = {axis: dict(self._filters(axis, measured[axis])) for axis in self._names}
        file = self._folder / "coupling.yaml"
        write_coupling(file, self._coupling(into), overwrite=True)
        use = setting("coupling", str(file.resolve()))
        verified = yield from self._responses("verified", self._sine_runs, use)
        for axis, others in into.items():
            for other, through in others.items():
                after = verified[axis][other]
                left = {
                    "left_hz": tuple(after.frequency_hz.tolist()),
                    "left_percent": _left_percent(measured[axis][other], after),
                }
                others[other] = through.model_copy(update=left)
        created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        return self._coupling(into, created=created)

    def _responses(
        self, name: str, motions: Mapping[str, list[str]], *more: str
    ) -> Study[Responses]:
        """Move each axis in turn; return the response of each sensor."""
        found: dict[str, dict[str, Lines]] = {axis: {} for axis in self._names}
        for axis, keys in motions.items():
            self._runs += 1
            noise = [key for each in self._axes for key in each.loaded.noise_settings(self._runs)]
            settings = [*self._settings, *keys, *noise, *more]
            run = yield StudyStep(
                self._experiment, settings, f"{axis}-{name}", f"crosstalk of {axis}, {name}",
                replaces=True, done_s=(self._runs - 1) * self.seconds / (2 * len(self._names)),
            )  # fmt: skip
            recordings = dict(zip(self._names, run.recordings, strict=True))
            for sensor, recording in recordings.items():
                seen = crossed(recordings[axis], recording)
                found[sensor][axis] = excited_lines(seen, "reference-displacement")
        return found

    def _filters(
        self, axis: str, seen: Mapping[str, Lines]
    ) -> Iterator[tuple[str, CrosstalkFilter]]:
        """Yield the other axes that a sensor sees, and their filters."""
        own = seen[axis]
        for other in (name for name in self._names if name != axis):
            hz = seen[other].frequency_hz
            through = np.interp(hz, own.frequency_hz, own.response)
            response, noise = seen[other].response / through, seen[other].noise / np.abs(through)
            size, noise_rms = rms(np.abs(response)), rms(noise)
            if size < max(_LEAST, _CLEAR * noise_rms):
                continue
            fit = fit_fir(hz, response, noise, self._axes[0].loaded.config.sample_rate_hz)
            residual = rms(np.abs(fit.residuals))
            unexplained = math.sqrt(max(residual**2 - noise_rms**2, 0.0)) / size
            if unexplained > MOST_UNEXPLAINED:
                what = f"{100.0 * unexplained:.0f} % of the crosstalk of {other} into {axis}"
                rule = "is not a linear response to its displacement"
                cure = f"a lower --highest-hz than {self._highest_hz:g} resolves sharper resonances"
                raise RunError(f"{what} {rule}: {cure}")
            found = CrosstalkFilter(
                first_sample=fit.first_sample,
                spacing=fit.spacing,
                taps=tuple(fit.taps.tolist()),
                coherence=float(seen[other].coherence.mean()),
                noise_percent=100.0 * noise_rms / size,
                residual_percent=100.0 * residual / size,
            )
            yield other, found

    def _coupling(
        self, into: Mapping[str, Mapping[str, CrosstalkFilter]], **provenance: str
    ) -> Coupling:
        config = self._axes[0].loaded.config
        return Coupling(
            axes=tuple(self._names),
            sample_rate_hz=config.sample_rate_hz,
            highest_hz=self._highest_hz,
            into=into,
            provenance={
                "experiment": config.name,
                "device": ", ".join(each.loaded.device.info.name for each in self._axes),
                "hilctl": __version__,
                **provenance,
            },
        )

    def _passing(self, axis: str, motions: Iterable[list[Keys]]) -> list[str]:
        """Return the settings of the first motion of an axis that passes the check."""
        refusal: ConfigError | None = None
        for motion in motions:
            seconds = sum(each["duration_s"] for each in motion)
            keys = [
                setting(f"axes.{name}.waveform", self._waveform(name, seconds, motion, axis))
                for name in self._names
            ]
            try:
                checked_run(self._experiment, [*self._settings, *keys])
            except ConfigError as error:
                refusal = error
            else:
                self.seconds += seconds
                return keys
        assert refusal is not None
        raise refusal

    def _waveform(self, axis: str, seconds: float, motion: list[Keys], moving: str) -> Keys:
        """Return a motion about the middle of an axis' reference, or a hold there."""
        parts = motion if axis == moving else [_hold(seconds)]
        middle_um = self._middles_um[axis]
        parts = [{"offset": middle_um, "rest": middle_um} | each for each in parts]
        # The safe ramp follows: a drive of one sign has no command for a soft end at rest.
        parts[0].pop("rest", None)  # that of the model
        parts[0]["soft_start_s"] = _SOFT_S
        # All keys of a sequence, so that none of the experiment's own waveform is left.
        return {"kind": "sequence", "unit": "um", "repeat": 1, "parts": parts}

    def _multisine(self, part: float) -> list[Keys]:
        """Return a multisine of a part of the experiment's motion."""
        return [
            {
                "kind": "multisine",
                "amplitude": part * self._half_um,
                "first_hz": self._step_hz,
                "last_hz": self._highest_hz,
                "step_hz": self._step_hz,
                "duration_s": _SOFT_S + (_PERIODS + _SETTLING) / self._step_hz,
            }
        ]

    def _sines(self, part: float) -> list[Keys]:
        """Return a sine per octave, of a part of the experiment's amplitude and speed."""
        found = [_hold(1.5 * _SOFT_S)]
        for octave in range(_OCTAVES - 1, -1, -1):
            hz = self._highest_hz / 2.0**octave
            soft_s = max(_SOFT_CYCLES / hz, 0.1 * _SOFT_S)
            most_um = min(self._half_um, self._um_per_s / (2.0 * math.pi * hz))
            found.append(
                {
                    "kind": "sine",
                    "amplitude": part * most_um,
                    "frequency_hz": hz,
                    "duration_s": 2.0 * soft_s + max(_CYCLES / hz, _SOFT_S),
                    "soft_start_s": soft_s,
                    "soft_end_s": soft_s,
                }
            )
        return [*found, _hold(1.5 * _SOFT_S)]


def _removed(document: Document, names: Sequence[str]) -> Iterator[str]:
    """Yield the keys of the file and of its axes that would change the response."""
    for key in _REMOVED:
        loc = loc_of(key)
        own = [axis for axis in names if document.holds(("axes", axis, *loc))]
        yield from (f"axes.{axis}.{key}" for axis in own)
        if document.holds(loc) and len(own) < len(names):
            yield key


def _hold(seconds: float) -> Keys:
    return {"kind": "hold", "level": 0.0, "duration_s": seconds}


def _identified_hz(model: HysteresisModel | None) -> float:
    """Return the highest frequency that a model was identified on, or a default."""
    known = None if model is None else model.provenance.identified_range
    return _HIGHEST_HZ if known is None else known.frequency_hz[1]


def _left_percent(measured: Lines, verified: Lines) -> tuple[float, ...]:
    """Return the crosstalk that is left at each verified frequency, without its noise."""
    before = np.interp(verified.frequency_hz, measured.frequency_hz, measured.response)
    power = np.maximum(np.abs(verified.response) ** 2 - verified.noise**2, 0.0)
    return tuple((100.0 * np.sqrt(power) / np.abs(before)).tolist())
