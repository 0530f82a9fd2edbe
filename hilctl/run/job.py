"""What the supervisor hands to the loop's process: the checked experiment and its arrays.

It goes there as it is, checks and files behind it, so that process imports nothing that checks or
reads files: no pydantic, no YAML. Only a device that is not simulated is made there anew, and its
options are checked once more: it holds what a process has for itself, and may count on the checks.
"""

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from hilctl.base.device import Device
from hilctl.base.errors import RunError
from hilctl.base.types import F64
from hilctl.experiment.file import Experiment
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.models.base import HysteresisModel
from hilctl.run.waiting_loop import CHECKING, PLAIN

if TYPE_CHECKING:  # the loop's process has no use for what these import
    from hilctl.experiment.check import Checked
    from hilctl.experiment.load import LoadedExperiment
    from hilctl.run.run_folder import RunFolder

_SENT = "hilctl_drivers.simulated."


@dataclass(frozen=True, slots=True)
class DeviceText:
    """A device as text.

    Attributes:
        experiment: The experiment as YAML, command-line settings included.
        files: Texts of the files that it refers to, as they were checked, by absolute path.
        folder: Folder that file names in it are relative to.
    """

    experiment: str
    files: Mapping[str, str]
    folder: str

    def made(self) -> Device:
        """Return the device; nothing is read from disk."""
        from hilctl.base.files import TextFiles
        from hilctl.base.yaml import Document
        from hilctl.experiment.device import made_device

        document = Document("experiment", self.experiment)
        device = made_device(document, Path(self.folder), TextFiles(self.files))
        assert device is not None  # it was checked
        return device


@dataclass(frozen=True, slots=True)
class GivenParts:
    """See :class:`hilctl.experiment.run_parts.RunParts`."""

    config: Experiment
    device: Device
    model: HysteresisModel | None


@dataclass(frozen=True, slots=True)
class Job:
    """One run.

    Attributes:
        config: The experiment.
        model: The compensator's model; None where nothing compensates.
        device: Not opened, pickled; or what it is made from.
        ring: File of the ring.
        reference: File of the reference samples.
        input_um: File of the compensator's input.
        state: float64[s], the compensator's memory before the first sample; None where it is at
            rest.
        heat_a2: Heat of the coil before the run, in A^2.
        stands_um: Displacement there by the model, where the sensor is held against it.
        adapted: What the run adapts; None where nothing is adapted.
        supervisor: The supervisor's process number.
        silence_s: Longest that it may be silent.
    """

    config: Experiment
    model: HysteresisModel | None
    device: bytes | DeviceText
    ring: Path
    reference: str
    input_um: str
    state: F64 | None
    heat_a2: float
    stands_um: float | None
    adapted: DisplacementOperator | None
    supervisor: int
    silence_s: float

    @classmethod
    def of(
        cls, checked: "Checked", folder: "RunFolder", *, supervisor: int, silence_s: float
    ) -> Self:
        """Return the job of a checked experiment; its arrays are left in the run's folder.

        So is what the run says of itself to those who look on.

        Raises:
            RunError: There is no room for them.
        """
        from hilctl.run.description import RunDescription

        begun, values = checked.begun, checked.reference.values
        loaded = checked.loaded
        reference = input_um = folder.reference
        _save(reference, values)
        if begun.input_um is not values:
            input_um = folder.input_um
            _save(input_um, begun.input_um)
        RunDescription.of(checked).write(folder.description)
        return cls(
            config=loaded.config,
            model=loaded.model,
            device=_device(loaded),
            ring=folder.ring,
            reference=str(reference),
            input_um=str(input_um),
            state=begun.state,
            heat_a2=checked.heat_a2,
            stands_um=begun.stands_um,
            adapted=checked.operator,
            supervisor=supervisor,
            silence_s=silence_s,
        )

    def to_bytes(self) -> bytes:
        """Return whether it needs checks, :data:`PLAIN` or :data:`CHECKING`, and its fields."""
        needs = PLAIN if isinstance(self.device, bytes) else CHECKING
        return needs + pickle.dumps(self)

    @staticmethod
    def from_bytes(data: bytes) -> "Job":
        """Undo :meth:`to_bytes`, for what comes from a process of the same run."""
        job: Job = pickle.loads(data[1:])  # noqa: S301  its maker is this process's own
        return job

    def parts(self) -> GivenParts:
        """Return what was checked: nothing is read from disk."""
        given = self.device
        device: Device = (
            pickle.loads(given) if isinstance(given, bytes) else given.made()  # noqa: S301
        )
        return GivenParts(self.config, device, self.model)

    def arrays(self) -> tuple[F64, F64]:
        """Return reference and input, one array where they are the same: float64[n], mapped."""
        reference = _mapped(self.reference)
        same = self.input_um == self.reference
        return reference, reference if same else _mapped(self.input_um)


def _device(loaded: "LoadedExperiment") -> bytes | DeviceText:
    """Return a simulated device as it is, any other as its text."""
    if type(loaded.device).__module__.startswith(_SENT):
        return pickle.dumps(loaded.device)
    return DeviceText(loaded.yaml_text, loaded.files.texts, str(loaded.folder.resolve()))


def _save(path: Path, values: F64) -> None:
    """Leave an array, float64[n]."""
    try:
        np.save(path, values)
    except OSError as error:  # numpy's own has no errno: "8000 requested and 512 written"
        hint = "less recording.ring_s, or a shorter waveform, needs less of it"
        raise RunError(f"{path}: no memory: {error.strerror or error}; {hint}") from None


def _mapped(path: str) -> F64:
    values: F64 = np.load(path, mmap_mode="r").view(np.ndarray)  # quicker to slice
    return values
