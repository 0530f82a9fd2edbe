"""The job of a run: what the supervisor hands to the loop process and to the guardian.

The job is JSON text in the run's folder. It holds the experiment and the files that the experiment
names as the texts that were checked, so a file that changes after the check does not matter. Arrays
are ``.npy`` files in the same folder.

The guardian imports this module, so it must not import numba.
"""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hilctl.base.device import Device
from hilctl.base.errors import InputError, RunError
from hilctl.base.files import TextFiles
from hilctl.base.types import F64
from hilctl.base.yaml import Document
from hilctl.experiment.devices import made_device

if TYPE_CHECKING:
    from hilctl.experiment.preflight import CheckedExperiment
    from hilctl.run.run_folder import RunFolder

_SIMULATED_MARGIN_S = 0.5
_HANG_S = 0.08
_STOPPED_S = 0.02


@dataclass(frozen=True, slots=True)
class SilenceLimits:
    """How long the loop may be silent.

    Attributes:
        real_time_s: While it runs with real-time priority.
        ordinary_s: While it runs without: a busy machine may keep it waiting for so long.
        exchange_s: What is added while it waits for the device.
        stopped_s: While its process is stopped, as by SIGSTOP: it waits for nothing that could
            come, and it is no busy machine that keeps it.
    """

    real_time_s: float
    ordinary_s: float
    exchange_s: float
    stopped_s: float


@dataclass(frozen=True, slots=True)
class Job:
    """One run.

    Attributes:
        experiment: The experiment as YAML, command-line settings included.
        files: Texts of the files that it refers to, by absolute path.
        folder: Folder that file names in it are relative to.
        ring: File of the ring.
        reference: File of the reference samples.
        input_um: File of the compensator's input.
        state: The compensator's memory before the first sample; None at rest.
        heat_a2: Heat of the coil before the run, in A^2.
        stands_um: Displacement before the first sample by the model; None if no offset is measured.
        adapted: Operator that the run adapts, see
            :meth:`hilctl.loop.adaptation.DisplacementOperator.to_lists`; None without adaptation.
        safe_value: The safe value, in the device's command unit.
        ramp_per_s: Fastest change on the way there.
        limits: How long the loop may be silent.
        supervisor: Process number of the supervisor.
        silence_s: How long the supervisor may be silent.
        safe_priority: SCHED_FIFO priority of the process that sets the safe value.
    """

    experiment: str
    files: Mapping[str, str]
    folder: str
    ring: str
    reference: str
    input_um: str
    state: list[float] | None
    heat_a2: float
    stands_um: float | None
    adapted: list[Any] | None
    safe_value: float
    ramp_per_s: float
    limits: SilenceLimits
    supervisor: int
    silence_s: float
    safe_priority: int

    @classmethod
    def of(
        cls, checked: "CheckedExperiment", folder: "RunFolder", *, supervisor: int, silence_s: float
    ) -> Self:
        """Return the job of a checked experiment, and write its arrays into the run's folder.

        Raises:
            RunError: There is no room for them.
        """
        loaded, begun = checked.loaded, checked.begun
        reference = input_um = folder.reference
        _save(reference, checked.reference.values)
        if begun.input_um is not checked.reference.values:
            input_um = folder.input_um
            _save(input_um, begun.input_um)
        limits = loaded.config.command_limits()
        return cls(
            experiment=loaded.yaml_text,
            files=loaded.files.texts,
            folder=str(loaded.folder.resolve()),
            ring=str(folder.ring),
            reference=str(reference),
            input_um=str(input_um),
            state=None if begun.state is None else begun.state.tolist(),
            heat_a2=checked.heat_a2,
            stands_um=begun.stands_um,
            adapted=None if checked.operator is None else checked.operator.to_lists(),
            safe_value=limits.safe,
            ramp_per_s=limits.ramp_per_s,
            limits=silence_limits(checked),
            supervisor=supervisor,
            silence_s=silence_s,
            safe_priority=safe_priority(checked),
        )

    def write(self, path: Path) -> None:
        """Write the job as JSON.

        Raises:
            RunError: There is no room for it.
        """
        try:
            path.write_text(json.dumps(asdict(self)), encoding="utf-8")
        except OSError as error:
            raise RunError(f"{path}: no memory: {error.strerror}") from None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the job that :meth:`write` wrote."""
        fields = json.loads(path.read_text(encoding="utf-8"))
        return cls(**{**fields, "limits": SilenceLimits(**fields["limits"])})

    def document(self) -> Document:
        """Return the experiment as a YAML document."""
        return Document("experiment", self.experiment)

    def device(self) -> Device:
        """Return the device, made but not opened; nothing is read from disk.

        Raises:
            InputError: It can't be made.
        """
        made = made_device(self.document(), Path(self.folder), TextFiles(self.files))
        if made is None:
            raise InputError("the experiment has no device")
        return made

    def arrays(self) -> tuple[F64, F64]:
        """Return reference and compensator's input, each float64[n]: one array if they are equal.

        They are mapped from their files.
        """
        reference = _mapped(self.reference)
        same = self.input_um == self.reference
        return reference, reference if same else _mapped(self.input_um)


def silence_limits(checked: "CheckedExperiment") -> SilenceLimits:
    """Return how long the loop of an experiment may be silent."""
    config = checked.loaded.config
    timing = config.timing
    simulated = checked.loaded.device.info.simulated
    hang_s = ordinary_s = timing.hang_s
    if hang_s is None or ordinary_s is None:
        # Without real-time priority a loop may be as late as its own limit tolerates.
        ordinary_s = timing.max_late_s + (_SIMULATED_MARGIN_S if simulated else 0.0)
        hang_s = ordinary_s if simulated else min(_HANG_S, ordinary_s)
    periods_s = 2.0 * config.tick_s
    return SilenceLimits(
        real_time_s=periods_s + hang_s,
        ordinary_s=periods_s + ordinary_s,
        # A device that takes longer makes the next tick too late, which ends the run as well.
        exchange_s=timing.max_late_s,
        # A stopped simulated loop may be under a debugger, and there is no coil to protect.
        stopped_s=periods_s + (hang_s if simulated else min(hang_s, _STOPPED_S)),
    )


def safe_priority(checked: "CheckedExperiment") -> int:
    """Return the SCHED_FIFO priority of the process that sets the safe value.

    It is above the loop's, so that a loop in an endless cycle cannot delay that process.
    """
    return checked.loaded.config.realtime.priority + 1


def start_process(
    module: str, *words: str, inherits: Sequence[int], stderr: Any = None
) -> "subprocess.Popen[bytes]":
    """Start a module as a process of the run.

    Args:
        module: Its dotted name.
        words: Its arguments.
        inherits: Descriptors that it keeps open, such as those of locks.
        stderr: File of its standard error; the supervisor's if None.

    Raises:
        OSError: It cannot be started.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *words],  # -P: import nothing from the working folder
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,  # a reader of the supervisor's would wait for this process's end
        stderr=stderr,
        start_new_session=True,  # the supervisor handles Ctrl-C in the terminal
        pass_fds=inherits,
    )


def _save(path: Path, values: F64) -> None:
    """Write an array, float64[n]."""
    try:
        np.save(path, values)
    except OSError as error:  # numpy's own has no errno: "8000 requested and 512 written"
        hint = "less recording.ring_s, or a shorter waveform, needs less of it"
        raise RunError(f"{path}: no memory: {error.strerror or error}; {hint}") from None


def _mapped(path: str) -> F64:
    values: F64 = np.load(path, mmap_mode="r").view(np.ndarray)  # quicker to slice
    return values
