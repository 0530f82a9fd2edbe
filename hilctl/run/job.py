"""What the supervisor hands to the loop's process: the checked experiment and its arrays."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import RunError
from hilctl.base.files import TextFiles
from hilctl.base.values import Values, in_memory
from hilctl.base.yaml.document import Document
from hilctl.experiment.load import LoadedExperiment, resolve
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.window import window_size

if TYPE_CHECKING:  # the loop's process has no use for what these import
    from hilctl.experiment.check import Checked
    from hilctl.run.run_folder import RunFolder


@dataclass(frozen=True, slots=True)
class Job:
    """One run, as text.

    Attributes:
        experiment: The experiment as YAML, command-line settings included.
        files: Texts of the files that it refers to, as they were checked, by absolute path.
        folder: Folder that file names in it are relative to.
        ring: File of the ring.
        reference: File of the reference samples, or of a window of them.
        input_um: File of the compensator's input, or of a window of it.
        samples: Samples of the waveform: of a window, there are more than it has.
        state: The compensator's memory before the first sample; None where it is at rest.
        heat_a2: Heat of the coil before the run, in A^2.
        stands_um: Displacement there by the model, where the sensor is held against it.
        operator: What the run adapts, as lists; None where nothing is adapted.
        supervisor: The supervisor's process number.
        silence_s: Longest that it may be silent.
    """

    experiment: str
    files: Mapping[str, str]
    folder: str
    ring: str
    reference: str
    input_um: str
    samples: int
    state: list[float] | None
    heat_a2: float
    stands_um: float | None
    operator: list[Any] | None
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
        size = values.size
        if not in_memory(values):
            config = checked.loaded.config
            size = window_size(config.block, config.sample_rate_hz)
        reference = input_um = folder.reference
        _save(reference, values, size)
        if begun.input_um is not values:
            input_um = folder.input_um
            _save(input_um, begun.input_um, size)
        RunDescription.of(checked).write(folder.description)
        return cls(
            experiment=checked.loaded.yaml_text,
            files=checked.loaded.files.texts,
            folder=str(checked.loaded.folder.resolve()),
            ring=str(folder.ring),
            reference=str(reference),
            input_um=str(input_um),
            samples=values.size,
            state=None if begun.state is None else begun.state.tolist(),
            heat_a2=checked.heat_a2,
            stands_um=begun.stands_um,
            operator=None if checked.operator is None else checked.operator.to_lists(),
            supervisor=supervisor,
            silence_s=silence_s,
        )

    def to_json(self) -> str:
        """Return the fields as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Undo :meth:`to_json`."""
        return cls(**json.loads(text))

    @property
    def ring_path(self) -> Path:
        """File of the ring."""
        return Path(self.ring)

    @property
    def memory(self) -> F64 | None:
        """The compensator's memory before the first sample: float64[s]; None at rest."""
        return None if self.state is None else np.array(self.state)

    def load(self) -> LoadedExperiment:
        """Return the experiment, from the texts that were checked: nothing is read from disk."""
        document = Document("experiment", self.experiment)
        return resolve(document, Path(self.folder), files=TextFiles(self.files))

    @property
    def adapted(self) -> DisplacementOperator | None:
        """What the run adapts; None where nothing is adapted."""
        return None if self.operator is None else DisplacementOperator.from_lists(self.operator)

    def arrays(self) -> tuple[F64, F64]:
        """Return reference and input, one array where they are the same: float64[n], mapped."""
        reference = _mapped(self.reference)
        same = self.input_um == self.reference
        return reference, reference if same else _mapped(self.input_um)


def _save(path: Path, values: Values, size: int) -> None:
    """Leave an array, or the first samples of a window, float64[size]."""
    try:
        np.save(path, values[0:size])
    except OSError as error:  # numpy's own has no errno: "8000 requested and 512 written"
        hint = "less recording.ring_s, or a shorter waveform, needs less of it"
        raise RunError(f"{path}: no memory: {error.strerror or error}; {hint}") from None


def _mapped(path: str) -> F64:
    values: F64 = np.load(path, mmap_mode="r").view(np.ndarray)  # quicker to slice
    return values
