"""The job of a run, which the supervisor passes to the loop process and the guardian.

The job is JSON text in the run's folder. It contains the experiment and its files as the texts that
were checked, so later changes of the files have no effect. Arrays are ``.npy`` files in the same
folder.

The guardian imports this module, so it must not import numba.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hilctl.base.device import Device, PortDevice
from hilctl.base.errors import InputError, RunError
from hilctl.base.files import TextFiles
from hilctl.base.types import F64
from hilctl.base.yaml import Document
from hilctl.experiment.devices import made_device
from hilctl.experiment.sections.timing import SilenceLimits

if TYPE_CHECKING:
    from hilctl.experiment.file import Experiment
    from hilctl.experiment.preflight import CheckedExperiment, CheckedRun
    from hilctl.run.run_folder import RunFolder


@dataclass(frozen=True, slots=True)
class AxisJob:
    """One axis of a run."""

    axis: str  # its name; empty if it is the only one
    experiment: str
    files: Mapping[str, str]
    folder: str
    ring: str
    reference: str
    input_um: str
    state: list[float] | None
    heat_a2: float  # heat of the coil before the run, in A^2
    stands_um: float | None  # modelled before the first sample; None if no offset is measured
    adapted: list[Any] | None  # see DisplacementOperator.to_lists; None without adaptation
    safe_value: float
    ramp_per_s: float
    port_identity: str = ""

    @classmethod
    def of(cls, checked: "CheckedExperiment", folder: "RunFolder", number: int) -> Self:
        """Return the job of axis ``number``, and write its arrays into the run's folder."""
        loaded, begun = checked.loaded, checked.begun
        device = loaded.device
        reference = input_um = folder.file_of("reference.npy", number)
        _save(reference, checked.reference.values)
        if begun.input_um is not checked.reference.values:
            input_um = folder.file_of("input_um.npy", number)
            _save(input_um, begun.input_um)
        limits = loaded.config.command_limits()
        return cls(
            axis=loaded.axis,
            experiment=loaded.yaml_text,
            files=loaded.files.texts,
            folder=str(loaded.folder.absolute()),  # a link stays, as in the names of the texts
            ring=str(folder.ring_of(number)),
            reference=str(reference),
            input_um=str(input_um),
            state=None if begun.state is None else begun.state.tolist(),
            heat_a2=checked.heat_a2,
            stands_um=begun.stands_um,
            adapted=None if checked.operator is None else checked.operator.to_lists(),
            safe_value=limits.safe,
            ramp_per_s=limits.ramp_per_s,
            port_identity=device.port_identity if isinstance(device, PortDevice) else "",
        )

    def document(self) -> Document:
        """Return the experiment as a YAML document."""
        return Document("experiment", self.experiment)

    def device(self) -> Device:
        """Return the device, not opened; nothing is read from disk."""
        made = made_device(self.document(), Path(self.folder), TextFiles(self.files))
        if made is None:
            raise InputError("the experiment has no device")
        if self.port_identity and isinstance(made, PortDevice):
            made.port_identity = self.port_identity
        return made

    def arrays(self) -> tuple[F64, F64]:
        """Return reference and compensator's input, float64[n] each, mapped from their files."""
        reference = _mapped(self.reference)
        same = self.input_um == self.reference
        return reference, reference if same else _mapped(self.input_um)


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    axes: list[AxisJob]
    holds: list[str]  # resources of the devices, see DeviceInfo.holds
    locks: list[int]  # descriptors of their locks, which the processes of the run inherit
    take_over: bool  # see DeviceLocks
    segments: list[dict[str, Any]]  # of the first waveform, for marks; empty without a trigger
    limits: SilenceLimits
    supervisor: int
    silence_s: float
    safe_priority: int

    @classmethod
    def of(
        cls,
        run: "CheckedRun",
        folder: "RunFolder",
        *,
        locks: list[int],
        take_over: bool,
        supervisor: int,
        silence_s: float,
    ) -> Self:
        """Return the job of a checked run, and write its arrays into the run's folder."""
        first = run.first
        return cls(
            axes=[AxisJob.of(each, folder, number) for number, each in enumerate(run.axes)],
            holds=list(run.holds),
            locks=locks,
            take_over=take_over,
            segments=[each.to_mapping() for each in first.reference.segments]
            if run.config.trigger
            else [],
            limits=run.silence,
            supervisor=supervisor,
            silence_s=silence_s,
            safe_priority=safe_priority(run.config),
        )

    def write(self, path: Path) -> None:
        """Write the job as JSON."""
        try:
            path.write_text(json.dumps(asdict(self)), encoding="utf-8")
        except OSError as error:
            raise RunError(f"{path}: no memory: {error.strerror}") from None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the job that :meth:`write` wrote."""
        fields = json.loads(path.read_text(encoding="utf-8"))
        axes = [AxisJob(**each) for each in fields["axes"]]
        return cls(**{**fields, "axes": axes, "limits": SilenceLimits(**fields["limits"])})


def safe_priority(config: "Experiment") -> int:
    """Return the SCHED_FIFO priority of the process that sets the safe value, above the loop's."""
    return config.realtime.priority + 1


def _save(path: Path, values: F64) -> None:
    """Write an array, float64[n]."""
    try:
        np.save(path, values)
    except OSError as error:  # numpy's own has no errno: "8000 requested and 512 written"
        hint = "reduce recording.ring_s or the length of the waveform"
        raise RunError(f"{path}: no memory: {error.strerror or error}; {hint}") from None


def _mapped(path: str) -> F64:
    values: F64 = np.load(path, mmap_mode="r").view(np.ndarray)  # quicker to slice
    return values
