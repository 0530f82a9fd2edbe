"""Load an experiment file and all files that it refers to.

A file with ``axes`` is one experiment per axis: the keys of each axis laid over those of the file.
"""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from hilctl.base.axes import (
    AXIS_NAME,
    axis_documents,
    of_each_axis,
    one_axis_document,
    with_settings,
)
from hilctl.base.device import Device
from hilctl.base.errors import ConfigError, ConfigProblem, InputError, broken
from hilctl.base.files import TextFiles, is_file
from hilctl.base.formatting import shown_briefly
from hilctl.base.yaml import Document, dump, load_document, loc_of
from hilctl.experiment.devices import made_device
from hilctl.experiment.file import Experiment
from hilctl.experiment.rig import RunRig
from hilctl.experiment.sections.conditioning import make_conditioning
from hilctl.experiment.sections.correction import Correction, load_correction
from hilctl.experiment.sections.coupling import Coupling, load_coupling
from hilctl.experiment.sections.open_loop import MeasuredResponse, load_response
from hilctl.experiment.sections.safe import safe_problems
from hilctl.loop.lead_in import Conditioning
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import load_model

T = TypeVar("T")
FILE_KEYS = {"coupling", "compensator.model", "compensator.correction", "compensator.initial_state",
             "feedback.response", "waveform.path", "device.profile", "device.reader.profile",
             "device.calibration"}  # fmt: skip
"""Keys of an experiment that name files, relative to its own folder."""


@shown_briefly
@dataclass(frozen=True, slots=True)
class LoadedExperiment:
    """An experiment with everything that its file refers to.

    Attributes:
        device: The device, not opened.
        folder: Base of relative file names.
        yaml_text: The experiment including command-line settings.
        document: The file, with the line of each value.
        correction: Learned correction of the reference, or None.
        response: Measured response for the margins of the feedback, or None.
        coupling: Crosstalk between the axes of the run to remove, or None.
        files: Contents of the files it refers to.
        axis: Name of the axis; empty if it is the only one.
    """

    config: Experiment
    device: Device
    model: HysteresisModel | None
    folder: Path
    yaml_text: str
    document: Document
    correction: Correction | None = None
    response: MeasuredResponse | None = None
    coupling: Coupling | None = None
    files: TextFiles = field(default_factory=TextFiles)
    axis: str = ""

    @property
    def rig(self) -> RunRig:
        """What the sections share of device, rate and limits."""
        return self.config.rig(self.device.info)

    def conditioning(self, stands_um: float | None = None) -> Conditioning | None:
        """Return the conditioning before the waveform, or None.

        ``stands_um`` is the model's displacement at its end; None if no offset is measured. Raise
        InputError if it is too long.
        """
        config = self.config
        return make_conditioning(
            config.condition,
            self.rig,
            zero=config.zero,
            offset=config.measures_offset,
            stands_um=stands_um,
        )

    def noise_settings(self, number: int) -> list[str]:
        """Return the settings for other noise of a simulated device in each run of several."""
        seed = self.device.Options.model_fields.get("seed")
        if seed is None:
            return []
        key = f"axes.{self.axis}.device.seed" if self.axis else "device.seed"
        return [f"{key}={self.config.device.get('seed', seed.default) + number}"]


def load_experiment(path: Path, settings: Sequence[str] = ()) -> LoadedExperiment:
    """Read an experiment file, apply ``key=value`` settings, and load what it refers to.

    A file name in a setting is relative to the working folder, or else to the experiment's folder.
    The setting ``axis=NAME`` chooses one axis; the other settings are then those of the axis.

    Raises:
        InputError: The file cannot be read.
        ConfigError: Rules are broken; the error lists every one of them.
    """
    return resolve(load_document(path), path.parent, _from_here(path, settings))


def load_axes(path: Path, settings: Sequence[str] = ()) -> tuple[LoadedExperiment, ...]:
    """Load an experiment file with one axis or several, see :func:`load_experiment`."""
    return resolve_axes(load_document(path), path.parent, _from_here(path, settings), TextFiles())


def resolve_axes(
    document: Document, folder: Path, settings: Sequence[str], files: TextFiles
) -> tuple[LoadedExperiment, ...]:
    """Build the experiment of each axis from a YAML document, see :func:`load_experiment`."""
    document = with_settings(document, settings)
    parts = axis_documents(document)
    loaded = of_each_axis(parts, lambda axis, part: _resolved(part, folder, files, axis))
    return tuple(loaded.values())


def input_files(document: Document, path: Path) -> list[Path]:
    """Return the experiment file and the files that its keys name."""
    axes = document.data.get("axes")
    prefixes = [(), *(("axes", name) for name in axes)] if isinstance(axes, dict) else [()]
    names = [
        document.value((*prefix, *loc_of(key))) for prefix in prefixes for key in sorted(FILE_KEYS)
    ]
    # A profile may be the name of a shipped one.
    return [path, *(path.parent / name for name in names if isinstance(name, str))]


def inputs_of(path: Path, settings: Sequence[str] = ()) -> list[Path]:
    """Return the files that a run of an experiment reads; raise InputError if it cannot be read."""
    return input_files(document_with(path, _from_here(path, settings)), path)


def document_with(path: Path, settings: Iterable[str], files: TextFiles | None = None) -> Document:
    """Return an experiment file with ``key=value`` texts over it."""
    return with_settings(load_document(path, files), settings)


def _from_here(path: Path, settings: Iterable[str]) -> list[str]:
    return [named_from(path.parent, setting) for setting in settings]


def named_from(folder: Path, setting: str) -> str:
    """Return a ``key=value`` setting with its file name made relative to another folder."""
    key, _, text = setting.partition("=")
    name = text.strip().strip("'\"")
    of_axis = re.sub(rf"^axes\.{AXIS_NAME}\.", "", key.strip())
    if of_axis not in FILE_KEYS or not name or Path(name).is_absolute():
        return setting
    if not is_file(Path(name)):
        return setting
    return f"{key}={json.dumps(os.path.relpath(name, folder), ensure_ascii=False)}"


def resolve(
    document: Document, folder: Path, settings: Sequence[str] = (), files: TextFiles | None = None
) -> LoadedExperiment:
    """Build the experiment of one axis from a YAML document, see :func:`load_experiment`."""
    document = one_axis_document(with_settings(document, settings))
    return _resolved(document, folder, TextFiles() if files is None else files)


def _resolved(
    document: Document, folder: Path, files: TextFiles, axis: str = ""
) -> LoadedExperiment:
    problems: list[ConfigProblem] = []

    def named(key: str, load: Callable[[Path, TextFiles], T]) -> T | None:
        """Return the content of the file under a dotted key; None without the key."""
        name = document.value(loc_of(key))
        if not isinstance(name, str):
            return None
        try:
            return load(folder / name, files)
        except ConfigError:
            raise
        except InputError as error:
            raise ConfigError([document.problem(key, str(error))]) from None

    config = _collect(problems, lambda: document.validate(Experiment))
    device = _collect(problems, lambda: made_device(document, folder, files))
    model = _collect(problems, lambda: named("compensator.model", load_model))
    correction = _collect(problems, lambda: named("compensator.correction", load_correction))
    response = _collect(problems, lambda: named("feedback.response", load_response))
    coupling = _collect(problems, lambda: named("coupling", load_coupling))
    if config is not None:
        problems += document.refusal(_joint_problems(config)).problems
    if problems or config is None or device is None:
        raise ConfigError(problems)
    yaml_text = dump(document.data)
    return LoadedExperiment(
        config,
        device,
        model,
        folder,
        yaml_text,
        document,
        correction,
        response,
        coupling,
        files,
        axis,
    )


def _joint_problems(config: Experiment) -> Iterator[ConfigProblem]:
    """Yield broken rules between sections of the experiment."""
    unit, limits = config.waveform.unit, config.limits
    if unit is None:
        yield broken("waveform.unit", "is required", hint="um, A or V")
    elif config.compensator is not None and unit != "um":
        yield broken("waveform.unit", "must be um with a compensator", unit)
    elif config.compensator is None and unit != limits.unit:
        rule = f"must be {limits.unit}, the unit of the limits, without a compensator"
        yield broken("waveform.unit", rule, unit)
    if config.amplifier is not None and limits.unit != "A":
        yield broken("amplifier", "is for a device driven in A", hint="remove it")
    yield from safe_problems(config.safe, *limits.command_range, limits.unit)


def _collect(problems: list[ConfigProblem], load: Callable[[], T]) -> T | None:
    try:
        return load()
    except ConfigError as error:
        problems.extend(error.problems)
    return None
