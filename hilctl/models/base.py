"""Common parts of all models: parameters with their conditions, and streaming operators."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import InputError, ModelError
from hilctl.base.formatting import shown_briefly
from hilctl.base.strict import (
    CheckedModel,
    Field,
    KnownError,
    PlainSerializer,
    StrictModel,
    ValidationInfo,
    field_validator,
    model_validator,
)
from hilctl.base.types import F64, CommandUnit
from hilctl.kernels.hysteresis import rest_memory
from hilctl.kernels.jit import compiled
from hilctl.models import kinds

MAX_OPERATORS = 10_000
"""Largest number of operators of a model: more would take milliseconds per sample."""

Thresholds: TypeAlias = tuple[Annotated[float, Field(allow_inf_nan=False)], ...]
Weights: TypeAlias = tuple[Annotated[float, Field(allow_inf_nan=False)], ...]


class Operator:
    """A hysteresis operator that processes a signal block by block.

    The results have the same bits for any division into blocks.

    Args:
        kernel: Called with input, float64[n], parameters, memory and output, float64[n].
        parameters: Parameters between input and memory.
        operators: Number of operators with memory.
        input_offset: Added to the input first.
        output_offset: Added to the output last.
    """

    def __init__(
        self,
        kernel: Callable[..., None],
        parameters: tuple[Any, ...],
        operators: int,
        *,
        input_offset: float = 0.0,
        output_offset: float = 0.0,
    ) -> None:
        self.preview = 0
        """Samples by which the input must run ahead of the output; more for some inverses."""
        self.kernel = kernel
        self.parameters = parameters
        self.input_offset = input_offset
        self.output_offset = output_offset
        self._process = compiled(kernel)
        self._rest = rest_memory(operators)
        self._memory = self._rest.copy()

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__}: preview {self.preview}, state of {self._memory.size} values>"
        )

    def __call__(self, signal: npt.ArrayLike) -> F64:
        """Process one block of numbers of any type; raise ModelError if it is not 1-D."""
        block = np.ascontiguousarray(signal, dtype=np.float64)
        if block.ndim != 1:
            raise ModelError(f"the signal must be one sequence of numbers: shape {block.shape}")
        return self.process(block)

    def process(self, block: F64, out: F64 | None = None) -> F64:
        """Process a contiguous block, float64[n]; return the result, in ``out`` or a new array."""
        if out is None:
            out = np.empty_like(block)
        if self.input_offset != 0.0:
            block = block + self.input_offset
        elif not block.flags.writeable:
            block = block.copy()  # the kernels reject read-only arrays
        self._process(block, *self.parameters, self._memory, out)
        if self.output_offset != 0.0:
            out += self.output_offset
        return out

    def state(self, out: F64 | None = None) -> F64:
        """Return a copy of the memory: operator outputs, then the previous input."""
        if out is None:
            return self._memory.copy()
        out[:] = self._memory
        return out

    def restore(self, state: F64) -> None:
        """Restore a result of :meth:`state`; raise ModelError if it belongs to another model."""
        if state.shape != self._memory.shape:
            raise ModelError(
                f"state must have {self._memory.size} values, as this model's memory has: "
                f"got {state.size}"
            )
        if np.isinf(state).any():  # NaN is allowed: no input yet
            raise ModelError("state must have no infinite value")
        self._memory[:] = state

    def keep_in(self, memory: F64) -> None:
        """Move the memory into an array."""
        memory[:] = self._memory
        self._memory = memory

    def stand(self, seconds: float) -> None:
        """Let time pass at constant input; only creep changes the output meanwhile."""

    def reset(self, first_input: float | None = None) -> None:
        """Reset to rest, or to the start of a signal that begins with ``first_input``."""
        self._memory[:] = self._rest
        if first_input is not None:
            self.process(np.array([first_input]))


STROKES: Mapping[str, float] = {
    "full stroke": 1.0,
    "half stroke": 0.5,
    "quarter stroke": 0.25,
    "tenth stroke": 0.1,
}
"""Classes of motions: peak-to-peak values relative to the identified range of a model."""
SMALLEST_STROKE = 0.05
"""Smallest motion of the last class."""


def stroke_class(part: float) -> str:
    """Return the class of a motion relative to the range: the nearest one by ratio."""
    return min(STROKES, key=lambda name: abs(math.log(part / STROKES[name])))


class IdentifiedRange(StrictModel):
    """The motions on which a model was identified; outside them its error is unknown.

    Attributes:
        peak_to_peak_um: Smallest and largest peak-to-peak displacement.
        frequency_hz: Lowest fundamental frequency, and highest frequency of a command.
        speed_um_per_s: Largest speed.
    """

    peak_to_peak_um: tuple[float, float]
    frequency_hz: tuple[float, float]
    speed_um_per_s: float = Field(gt=0.0)

    @field_validator("peak_to_peak_um", "frequency_hz")
    @classmethod
    def _check_order(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 < limits[0] <= limits[1]:
            raise ValueError(f"must be above 0, and the second no less than the first: {limits}")
        return limits


class Provenance(StrictModel):
    """Origin of the parameters of a model.

    Attributes:
        source: Recordings, data files or publication.
        method: Identification method.
        grid: The loops used.
        parameters: Fitted parameters by name.
        errors_percent: Model errors, by name, in percent of the peak-to-peak output.
        errors_by_stroke: Expected peak error of a motion of each class of :data:`STROKES`, in
            percent of its own peak-to-peak: what 90 % of places and frequencies do not exceed.
            Classes without data are missing.
        median_by_stroke: The same error of half of the places and frequencies.
        worst_by_stroke: Peak error of the worst motion of each class, with its record, frequency
            and middle.
        identified_range: The motions used; None if unknown.
        versions: Software versions, by name.
        created: Date and time in ISO 8601, UTC.
    """

    source: tuple[str, ...] = ()
    method: str = ""
    grid: tuple[str, ...] = ()
    parameters: Mapping[str, float] = Field(default_factory=dict)
    errors_percent: Mapping[str, float] = Field(default_factory=dict)
    errors_by_stroke: Mapping[str, float] = Field(default_factory=dict)
    median_by_stroke: Mapping[str, float] = Field(default_factory=dict)
    worst_by_stroke: Mapping[str, str] = Field(default_factory=dict)
    identified_range: IdentifiedRange | None = None
    versions: Mapping[str, str] = Field(default_factory=dict)
    created: str = ""


@shown_briefly
class HysteresisModel(CheckedModel, ABC):
    """Parameters of a model from command to displacement, and of its inverse.

    A mapping is validated by the class of its ``kind``, see :mod:`hilctl.models.kinds`.

    Attributes:
        kind: Registered name of the class.
        input_unit: Unit of the command, ``A`` or ``V``.
        input_range: Lowest and highest command of the identification.
        output_range_um: Lowest and highest displacement of the identification that a steady command
            reaches; a reference outside is rejected.
        output_offset_um: Displacement at which the operators' output is 0.
        provenance: Origin of the parameters.
    """

    STANDALONE: ClassVar[bool] = True
    """Whether a run can use the model directly; otherwise only as part of a staged model."""
    STAGEABLE: ClassVar[bool] = False
    """Whether the model can be the hysteresis of a staged model."""

    kind: str
    input_unit: CommandUnit = "A"
    input_range: tuple[float, float] | None = None
    output_range_um: tuple[float, float] | None = None
    output_offset_um: float = 0.0
    provenance: Provenance = Field(default_factory=Provenance)

    @classmethod
    def described_by(cls, data: Any) -> "type[HysteresisModel]":
        """Return the class of a mapping's ``kind``; raise InputError as ``kinds.load`` does."""
        if cls is not HysteresisModel:
            return cls
        found: type[HysteresisModel] = kinds.load(kinds.MODELS, data["kind"])
        return found

    @model_validator(mode="wrap")
    @classmethod
    def _of_its_kind(cls, data: Any, make: Callable[[Any], Self], info: ValidationInfo) -> Any:
        if cls is not HysteresisModel or not isinstance(data, Mapping):
            return make(data)
        known, kind = kinds.known(kinds.MODELS), data.get("kind")
        names = ", ".join(map(repr, known))
        if kind is None:
            raise ValueError(f"needs a 'kind': {names}")
        if not isinstance(kind, str) or kind not in known:
            context = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": names}
            raise KnownError("union_tag_invalid", context)
        try:
            chosen = cls.described_by(data)
        except InputError as error:
            raise ValueError(str(error)) from error
        return chosen.model_validate(data, context=info.context)

    @field_validator("input_range", "output_range_um")
    @classmethod
    def _check_range(cls, limits: tuple[float, float] | None) -> tuple[float, float] | None:
        if limits is not None and not limits[0] < limits[1]:
            raise ValueError(f"the second value must be above the first: {list(limits)}")
        return limits

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        if self.operators > MAX_OPERATORS:
            raise ValueError(f"must have at most {MAX_OPERATORS} operators: {self.operators}")
        return self

    def __str__(self) -> str:
        return repr(self)  # the message of pydantic lists all numbers

    @abstractmethod
    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to displacement in um, at rest."""

    @abstractmethod
    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest; raise ModelError without an inverse."""

    def earlier(self) -> "HysteresisModel | None":
        """Return the model with the inverse of an earlier version, for replays; None if equal."""
        return None

    @property
    @abstractmethod
    def operators(self) -> int:
        """Number of operators with memory."""

    def _forward(self, kernel: Callable[..., None], *parameters: Any) -> Operator:
        """Return a kernel from command to um, at rest."""
        offset_um = self.output_offset_um
        return Operator(kernel, parameters, self.operators, output_offset=offset_um)

    def _inverse(self, kernel: Callable[..., None], *parameters: Any) -> Operator:
        """Return a kernel from um to command, at rest."""
        offset_um = self.output_offset_um
        return Operator(kernel, parameters, self.operators, input_offset=-offset_um)

    def to_mapping(self) -> dict[str, Any]:
        """Return kind and parameters as plain mappings, lists and numbers, defaults omitted."""
        parameters = self.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        return {"kind": self.kind, **parameters}


InnerModel: TypeAlias = Annotated[HysteresisModel, PlainSerializer(HysteresisModel.to_mapping)]
"""A model as part of another model."""


def threshold_problems(name: str, thresholds: Thresholds, *, sign: int = 1) -> Iterator[str]:
    """Yield problems of thresholds that do not move away from 0; indices count from 1."""
    last = 0.0
    order = "rise from 0" if sign > 0 else "fall from 0"
    for i, threshold in enumerate(thresholds, start=1):
        if not sign * threshold > sign * last:
            yield (
                f"{name} must {order} (the thresholds must dilate): {name}_{i} = {threshold!r} "
                f"after {last!r}"
            )
        last = threshold


def length_problems(name: str, values: Weights, thresholds: Thresholds) -> Iterator[str]:
    """Yield a problem if the numbers of weights and thresholds differ."""
    if len(values) != len(thresholds):
        yield f"{name} must have one value per threshold: {len(values)} for {len(thresholds)}"


def play_weight_problems(direct: float, weights: Weights) -> Iterator[str]:
    """Yield violated conditions for the inverse of a sum of plays (5.5, 5.10)."""
    if not direct > 0.0:
        yield f"a_0 must be > 0 for the inverse to exist: {direct!r}"
    for i, weight in enumerate(weights, start=1):
        if not weight >= 0.0:
            yield f"a_{i} must be >= 0 for the inverse to exist: {weight!r}"
