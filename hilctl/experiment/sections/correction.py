"""Correction of the compensator's input by iterative learning: one period of each waveform.

A correction is added to the reference. It is stored as Fourier coefficients, so that it fits any
sampling of its period, together with the cycle it was learned for; it is rejected for another
waveform, sample rate or model.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import InputError
from hilctl.base.files import TextFiles, write_text
from hilctl.base.segments import Segment
from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.base.types import C128, CHUNK, F64, I64
from hilctl.base.yaml import Document, dump, load_document
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import model_sha256
from hilctl.waveforms.build import Reference

RESIDUAL = "residual error: "
"""Start of the keys of provenance with the frequencies that learning gave up."""

PHASES = 64  # points of a cycle that identify a waveform

_GRID = 1 << 16  # the highest harmonic of 2048 loses 0.5 % of its amplitude between points
_TOLERANCE = 1e-3
_SAME_PERIOD = 1e-6


class LearnedCycle(StrictModel):
    """One period of a correction: ``sum cosine_k cos(k phi) + sine_k sin(k phi)``."""

    label: str  # the waveform in words
    period_samples: Annotated[float, Field(gt=0.0)]  # phase 0 is at the waveform's first sample
    # cycles of the waveform in that period, which other axes share; None: one
    waveform_cycles: Annotated[int, Field(ge=2)] | None = None
    # the reference at 64 even phases of a cycle of the waveform
    reference_um: Annotated[tuple[float, ...], Field(min_length=PHASES, max_length=PHASES)]
    cosine_um: Annotated[tuple[float, ...], Field(min_length=1)]  # coefficients of k = 0, 1, ..
    sine_um: tuple[float, ...]  # coefficients of the same k; 0 for k = 0
    start_percent: float | None = None  # peak error before learning, of the peak-to-peak
    error_percent: float | None = None  # peak error with this correction

    @model_validator(mode="after")
    def _same_length(self) -> "LearnedCycle":
        if len(self.cosine_um) != len(self.sine_um):
            text = f"{len(self.sine_um)} for {len(self.cosine_um)}"
            raise ValueError(f"sine_um must have one value for each value of cosine_um: {text}")
        return self

    @classmethod
    def from_coefficients(
        cls,
        label: str,
        period: float,
        signature_um: F64,
        coefficients: C128,
        waveform_cycles: int = 1,
        **figures: float,
    ) -> "LearnedCycle":
        """Build a cycle from complex coefficients c_k, see :attr:`coefficients`."""
        last = int(np.flatnonzero(np.abs(coefficients) > 0.0).max(initial=0))
        kept = coefficients[: last + 1] * np.where(np.arange(last + 1) > 0, 2.0, 1.0)
        return cls(
            label=label,
            period_samples=period,
            waveform_cycles=waveform_cycles if waveform_cycles > 1 else None,
            reference_um=tuple(signature_um.tolist()),
            cosine_um=tuple(kept.real.tolist()),
            sine_um=(0.0, *(-kept.imag[1:]).tolist()),
            **figures,
        )

    @property
    def coefficients(self) -> C128:
        """complex128[K + 1], c_k of ``c_0 + 2 Re sum c_k exp(i k phi)``, in um."""
        both = np.array(self.cosine_um) - 1j * np.array(self.sine_um)
        both[1:] *= 0.5
        return both

    def at(self, index: npt.NDArray[np.int64]) -> F64:
        """Return the correction at samples counted from the waveform's first: float64[n], in um."""
        grid = evaluate(self.coefficients, _GRID)
        place = np.mod(index.astype(np.float64), self.period_samples) * (
            _GRID / self.period_samples
        )
        values: F64 = np.interp(place, np.arange(_GRID + 1), np.append(grid, grid[0]))
        return values


class Correction(StrictModel):
    """Learned cycles with their origin."""

    sample_rate_hz: Annotated[float, Field(gt=0.0)]
    model_sha256: str  # digest of the compensator's model
    coupling_sha256: str | None = None  # digest of the coupling in use; None: none
    cycles: Annotated[tuple[LearnedCycle, ...], Field(min_length=1)]  # one per waveform
    # experiment, runs, identified delay, residual error, versions
    provenance: Mapping[str, str] = Field(default_factory=dict)

    @property
    def of_several_cycles(self) -> bool:
        """Whether a period has several cycles of a waveform."""
        return any(cycle.waveform_cycles for cycle in self.cycles)

    @property
    def residual(self) -> dict[str, str]:
        """Frequencies that learning gave up, and why, by the label of the waveform."""
        provenance = self.provenance.items()
        return {k.removeprefix(RESIDUAL): v for k, v in provenance if k.startswith(RESIDUAL)}

    def added(self, reference: Reference, model: HysteresisModel | None) -> F64:
        """Return the reference of a run plus its correction: float64[n], in um.

        The correction follows the waveform's soft start and end; without a soft start it grows
        over the first period.

        Raises:
            InputError: The correction belongs to another rate, model or waveform.
        """
        if model_sha256(model) != self.model_sha256:
            raise InputError("was learned with another model")
        if not _alike(reference.sample_rate_hz, self.sample_rate_hz):
            was, now = self.sample_rate_hz, reference.sample_rate_hz
            raise InputError(f"was learned at {was:g} samples per second, not at {now:g}")
        found = [
            (segment, cycle)
            for segment in reference.segments
            for cycle in self.cycles
            if fits(cycle, reference.values, segment)
        ]
        if not found:
            known = "; ".join(cycle.label for cycle in self.cycles)
            raise InputError(f"was learned for another waveform: {known}")

        correction = np.zeros(reference.values.size)
        for segment, cycle in found:
            for start in range(segment.start, segment.stop, CHUNK):
                stop = min(start + CHUNK, segment.stop)
                index = np.arange(start, stop) - segment.start
                correction[start:stop] = cycle.at(index) * envelope(segment, index)
        correction += reference.values
        return correction


class CorrectionFile(StrictModel):
    """A correction file: one correction under the key ``correction``."""

    correction: Correction


def evaluate(coefficients: C128, points: int) -> F64:
    """Return one period on even phases from c_k: float64[points], in the unit of c_k."""
    size = min(coefficients.size, points // 2)
    spectrum = np.zeros(points // 2 + 1, dtype=np.complex128)
    spectrum[:size] = coefficients[:size]
    return np.fft.irfft(spectrum * points, points)


def signature(values: F64, segment: Segment) -> F64 | None:
    """Return a steady period of a reference at 64 even phases, float64[64]; None without one."""
    if segment.period <= 0.0:
        return None
    before = np.ceil((segment.steady_start - segment.start) / segment.period - 1e-9)
    first = segment.start + before * segment.period
    place = first + np.arange(PHASES) / PHASES * segment.period
    if place[-1] + 1.0 > segment.steady_stop:
        return None
    # Interpolate within the period only: the run may be long.
    low, high = int(place[0]), min(int(place[-1]) + 2, values.size)
    cycle: F64 = np.interp(place - low, np.arange(high - low), values[low:high])
    return cycle


def fits(cycle: LearnedCycle, values: F64, segment: Segment) -> bool:
    """Return whether a cycle was learned for a segment: same period, same reference."""
    wanted = signature(values, segment)
    period = cycle.period_samples / (cycle.waveform_cycles or 1)
    if wanted is None or not _alike(period, segment.period):
        return False
    learned = np.array(cycle.reference_um)
    return bool(np.abs(wanted - learned).max() <= _TOLERANCE * np.ptp(learned))


def envelope(segment: Segment, index: I64) -> F64:
    """Return the weight of a correction, 0 to 1, at samples (int64[n], from 0 on) of a segment."""
    n = segment.stop - segment.start
    rise = segment.steady_start - segment.start or min(n, int(segment.period))
    fall = segment.stop - segment.steady_stop
    grown = 0.5 - 0.5 * np.cos(np.pi * np.minimum(index, rise) / max(rise, 1))
    ended = np.maximum(index - (n - fall) + 1, 0)
    out: F64 = grown * (0.5 + 0.5 * np.cos(np.pi * ended / max(fall, 1)))
    return out


def _alike(a: float, b: float) -> bool:
    return abs(a - b) <= _SAME_PERIOD * abs(b)


def load_correction(path: Path, files: TextFiles | None = None) -> Correction:
    """Read a correction file; raise InputError if it cannot be read or breaks a rule."""
    return load_document(path, files).validate(CorrectionFile).correction


def parse_correction(name: str, text: str) -> Correction:
    """Read a correction from a YAML text; raise ConfigError as :func:`load_correction` does."""
    return Document(name, text).validate(CorrectionFile).correction


def dump_correction(correction: Correction) -> str:
    """Return a correction as YAML; reading it back gives the same one, bit for bit."""
    mapping: dict[str, Any] = correction.model_dump(mode="json", exclude_none=True)
    return dump({"correction": mapping})


def write_correction(path: Path, correction: Correction, *, overwrite: bool) -> None:
    """Write a correction file atomically; raise InputError if that is not possible."""
    write_text(path, dump_correction(correction), overwrite=overwrite)
