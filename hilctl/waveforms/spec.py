"""Waveforms in the experiment file.

Amplitudes, offsets and levels are in the waveform's ``unit``: um with a compensator, A or V
without one.
"""

import math
from typing import Annotated, Any, Literal, TypeAlias

from hilctl.base.strict import AfterValidator, Field, StrictModel, ValidationInfo, field_validator

UNIT = "unit of every amplitude, offset and level"
WaveformUnit: TypeAlias = Literal["um", "A", "V"]
Positive: TypeAlias = Annotated[float, Field(gt=0.0)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0.0)]
Amplitude: TypeAlias = Annotated[Positive, Field(description="amplitude, in unit")]
Frequency: TypeAlias = Annotated[Positive, Field(description="frequency, Hz")]
Phase: TypeAlias = Annotated[float, Field(description="phase at the start, degrees")]
Duration: TypeAlias = Annotated[Positive, Field(description="duration, s")]

MAX_SINES = 10_000
"""Largest number of sines in a multisine."""


def _not_empty(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if not values:  # min_length also rejects a list whose only item is invalid
        raise ValueError("must have at least one value: []")
    return values


def _not_below_first(last_hz: float, info: ValidationInfo) -> float:
    first_hz = info.data.get("first_hz", last_hz)
    if last_hz < first_hz:
        raise ValueError(f"must be >= first_hz, {first_hz}: {last_hz}")
    return last_hz


FirstFrequency: TypeAlias = Annotated[Positive, Field(description="lowest frequency, Hz")]
LastFrequency: TypeAlias = Annotated[
    Positive, AfterValidator(_not_below_first), Field(description="highest frequency, Hz")
]
NotEmpty = AfterValidator(_not_empty)
AtLeastOne = Field(json_schema_extra={"minItems": 1})


class _Shape(StrictModel):
    """Keys common to all kinds of waveform."""

    unit: WaveformUnit | None = Field(default=None, description=UNIT)
    offset: float = Field(default=0.0, description="constant added to the waveform, in unit")
    rest: float | None = Field(
        default=None,
        description="value before a soft start and after a soft end, in unit; default: the model's"
        " displacement at safe.value, or safe.value without a compensator",
    )
    soft_start_s: NotNegative = Field(
        default=0.0,
        description="duration of the fade from rest, offset included, s; part of the waveform's"
        " duration",
    )
    soft_end_s: NotNegative = Field(
        default=0.0,
        description="duration of the fade to rest, s; part of the waveform's duration. Leave it at"
        " 0 for a unipolar drive, which has no command for rest after a motion; the safe ramp"
        " follows the waveform",
    )

    @property
    def rest_value(self) -> float:
        """Value at rest; 0 if it is not set."""
        return self.rest or 0.0


class Sine(_Shape):
    """``offset + amplitude sin(2 pi frequency t + phase)``."""

    kind: Literal["sine"]
    amplitude: Amplitude
    frequency_hz: Frequency
    phase_deg: Phase = 0.0
    duration_s: Duration


class Triangle(_Shape):
    """A triangle that starts at its offset and rises, at phase 0."""

    kind: Literal["triangle"]
    amplitude: Amplitude
    frequency_hz: Frequency
    phase_deg: Phase = 0.0
    rise: float = Field(default=0.5, gt=0.0, lt=1.0, description="share of the period that rises")
    duration_s: Duration


class Harmonic(StrictModel):
    """One component of a complex harmonic."""

    amplitude: Amplitude
    frequency_hz: Frequency
    phase_deg: Phase = 0.0


class ComplexHarmonic(_Shape):
    """A sum of sines with any amplitudes, frequencies and phases."""

    kind: Literal["complex_harmonic"]
    components: Annotated[tuple[Harmonic, ...], NotEmpty, AtLeastOne] = Field(
        description="sines to add"
    )
    duration_s: Duration


class GrowingOrDecaying(_Shape):
    """A sine whose amplitude grows from 0, or decays to 0, linearly with time."""

    kind: Literal["growing", "decaying"]
    amplitude: Amplitude
    frequency_hz: Frequency
    phase_deg: Phase = 0.0
    duration_s: Duration


class Chirp(_Shape):
    """A sine whose frequency changes from ``start_hz`` to ``stop_hz``."""

    kind: Literal["chirp"]
    amplitude: Amplitude
    start_hz: Positive = Field(description="first frequency, Hz")
    stop_hz: Positive = Field(description="last frequency, Hz")
    spacing: Literal["linear", "logarithmic"] = Field(
        default="linear", description="change of the frequency with time"
    )
    duration_s: Duration


class Step(_Shape):
    """Consecutive constant levels, each reached in ``rise_s``, beginning at ``rest``."""

    kind: Literal["step"]
    levels: Annotated[tuple[float, ...], NotEmpty, AtLeastOne] = Field(
        description="levels without offset, in unit"
    )
    dwell_s: Positive = Field(description="duration of each level with its rise, s")
    rise_s: NotNegative = Field(default=0.0, description="duration of each rise, s")

    @field_validator("rise_s")
    @classmethod
    def _rise_fits(cls, rise_s: float, info: ValidationInfo) -> float:
        dwell_s = info.data.get("dwell_s", rise_s)
        if rise_s > dwell_s:
            raise ValueError(f"must be <= dwell_s, {dwell_s}: {rise_s}")
        return rise_s


class Hold(_Shape):
    """A constant level."""

    kind: Literal["hold"]
    level: float = Field(description="level without offset, in unit")
    duration_s: Duration


class Multisine(_Shape):
    """Equal sines at evenly spaced frequencies, Schroeder phases, scaled to a peak amplitude."""

    kind: Literal["multisine"]
    amplitude: Amplitude
    first_hz: FirstFrequency
    last_hz: LastFrequency
    step_hz: Positive = Field(description="spacing of the frequencies, Hz")
    duration_s: Duration

    @field_validator("step_hz")
    @classmethod
    def _not_too_many(cls, step_hz: float, info: ValidationInfo) -> float:
        span_hz = info.data.get("last_hz", 0.0) - info.data.get("first_hz", 0.0)
        if span_hz / step_hz >= MAX_SINES:
            raise ValueError(f"must leave at most {MAX_SINES} sines in {span_hz} Hz: {step_hz}")
        return step_hz


class RandomSines(_Shape):
    """Equal sines with random phases over a whole band, scaled to a peak amplitude.

    Its period is its duration.

    Attributes:
        seed: Seed of the phases.
    """

    kind: Literal["random"]
    amplitude: Amplitude
    first_hz: FirstFrequency
    last_hz: LastFrequency
    seed: Annotated[int, Field(ge=0)] = 1
    duration_s: Duration

    @field_validator("duration_s")
    @classmethod
    def _some_line(cls, duration_s: float, info: ValidationInfo) -> float:
        first_hz, last_hz = info.data.get("first_hz", 0.0), info.data.get("last_hz", math.inf)
        if math.ceil(first_hz * duration_s) > last_hz * duration_s:
            rule = f"must hold whole cycles of a frequency from {first_hz} to {last_hz} Hz"
            raise ValueError(f"{rule}: {duration_s}")
        return duration_s


class LevelPath(_Shape):
    """Straight lines from level to level at one rate, beginning at ``rest``.

    Attributes:
        levels: End points of the lines, without offset.
        rate_per_s: Rate in the waveform's unit per second.
    """

    kind: Literal["path"]
    levels: Annotated[tuple[float, ...], NotEmpty, AtLeastOne]
    rate_per_s: Positive


class FileWaveform(_Shape):
    """Samples from a table (text, NPY, NPZ, MAT, Parquet) or a recording (MCAP).

    They are ``offset + scale * value``, with the value in the waveform's unit if its column has one
    of the same kind.

    Attributes:
        path: File, relative to the experiment file's folder.
        column: Column by name, or by number counted from 1; for MCAP one of ``reference_um``,
            ``displacement_um``, ``command``, ``wanted``. Not used for a one-column file.
        file_rate_hz: Sample rate of a file without a time column (``t_s``, or the only one in s).
        first_row: First data row used, counted from 1.
        last_row: Last data row used. Default: the last of the file.
        scale: Factor of the values.
        resample: Method if the file has another sample rate: ``refuse``, ``linear`` interpolation
            or a ``cubic`` spline.
        period_s: Period of a periodic waveform, for metrics of steady cycles.
    """

    kind: Literal["file"]
    path: str
    column: str | int | None = None
    file_rate_hz: Positive | None = None
    first_row: Annotated[int, Field(ge=1)] = 1
    last_row: Annotated[int, Field(ge=1)] | None = None
    scale: float = 1.0
    resample: Literal["refuse", "linear", "cubic"] = "refuse"
    period_s: Positive | None = None

    @field_validator("column", mode="before")
    @classmethod
    def _name_or_number(cls, column: Any) -> Any:
        if isinstance(column, bool) or not isinstance(column, str | int | None):
            rule = "must be a column's name, or its number from 1"
            raise ValueError(f"{rule}: {column!r}")  # noqa: TRY004  pydantic wants this one
        return column

    @field_validator("last_row")
    @classmethod
    def _rows_ordered(cls, last_row: int | None, info: ValidationInfo) -> int | None:
        first_row = info.data.get("first_row", 1)
        if last_row is not None and last_row < first_row:
            raise ValueError(f"must be >= first_row, {first_row}: {last_row}")
        return last_row


ShapeOfTime: TypeAlias = (
    Sine
    | Triangle
    | ComplexHarmonic
    | GrowingOrDecaying
    | Chirp
    | Step
    | Hold
    | Multisine
    | LevelPath
)
Shape: TypeAlias = ShapeOfTime | RandomSines
_Single: TypeAlias = Shape | FileWaveform
SinglePart: TypeAlias = Annotated[_Single, Field(discriminator="kind")]


class Sequence(StrictModel):
    """Consecutive waveforms with a common unit."""

    kind: Literal["sequence"]
    unit: WaveformUnit | None = Field(default=None, description=UNIT)
    parts: Annotated[tuple[SinglePart, ...], NotEmpty, AtLeastOne] = Field(
        description="waveforms in order"
    )
    repeat: int = Field(default=1, ge=1, le=10_000, description="number of repetitions")

    @field_validator("parts")
    @classmethod
    def _one_unit(cls, parts: tuple[SinglePart, ...], info: ValidationInfo) -> Any:
        unit = info.data.get("unit")
        for i, part in enumerate(parts):
            if unit is not None and part.unit not in {None, unit}:
                raise ValueError(f"{i}.unit must be that of the sequence, {unit}: {part.unit}")
        return parts


AnyWaveform: TypeAlias = Annotated[_Single | Sequence, Field(discriminator="kind")]
