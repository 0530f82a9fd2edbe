"""A whole reference: shapes, soft starts and ends, sequences, and what of it is judged."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import InputError
from hilctl.base.segments import Segment
from hilctl.waveforms import shapes, spec
from hilctl.waveforms.table import read_samples


@dataclass(frozen=True, slots=True)
class Reference:
    """The samples of a run's waveform.

    Attributes:
        values: float64[n], read-only, in ``unit``.
        unit: ``um``, ``A`` or ``V``.
        sample_rate_hz: Samples a second.
        segments: Which samples belong to which waveform, and which of them are steady.
    """

    values: F64
    unit: spec.WaveformUnit
    sample_rate_hz: float
    segments: tuple[Segment, ...]


def build(waveform: spec.AnyWaveform, sample_rate_hz: float, folder: Path) -> Reference:
    """Work out every sample of a waveform.

    Args:
        waveform: What the experiment asks for; its unit must be given.
        sample_rate_hz: Samples a second.
        folder: Folder that file names are relative to.

    Raises:
        InputError: A file can't be used, the waveform is too long, a soft start does not fit, a
            frequency is not below half the sample rate, or a value is too large for a float.
    """
    if waveform.unit is None:
        raise InputError("unit is required: um, A or V")
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        built = _parts(waveform, waveform.unit, sample_rate_hz, folder)
    segments: list[Segment] = []
    start = 0
    for values, segment in built:
        segments.append(segment.shifted(start))
        start += values.size
    values = np.concatenate([values for values, _ in built])
    if not np.isfinite(values).all():
        raise InputError("amplitude, offset or scale is too large: a value is not finite")
    values.flags.writeable = False
    return Reference(values, waveform.unit, sample_rate_hz, tuple(segments))


def _parts(
    waveform: spec.AnyWaveform, unit: str, sample_rate_hz: float, folder: Path
) -> list[tuple[F64, Segment]]:
    if waveform.kind != "sequence":
        return [_part(waveform, waveform.kind, unit, sample_rate_hz, folder)]
    built = []
    samples = 0
    for i, part in enumerate(waveform.parts):
        name = f"parts.{i} ({part.kind})"
        values, segment = _part(part, name, unit, sample_rate_hz, folder)
        samples += values.size
        shapes.check_length(samples * waveform.repeat)
        built.append((values, segment))
    return built * waveform.repeat


def _part(
    w: spec.SinglePart, name: str, unit: str, sample_rate_hz: float, folder: Path
) -> tuple[F64, Segment]:
    if w.kind == "file":
        values, period = read_samples(w, sample_rate_hz, folder)
        label = f"file {Path(w.path).name}"
    else:
        label, highest_hz, period_s = shapes.outline(w, unit)
        if highest_hz >= sample_rate_hz / 2.0:
            raise InputError(
                f"{name}: every frequency must be below half the sample rate, "
                f"{sample_rate_hz / 2.0:.10g} Hz: {highest_hz:.10g} Hz"
            )
        values, period = shapes.sampled(w, sample_rate_hz), period_s * sample_rate_hz
    soft_start, soft_end = _soften(w, name, values, sample_rate_hz)
    n = values.size
    period = period if math.isfinite(period) else 0.0
    return values, Segment(label, 0, n, soft_start, n - soft_end, period)


def _soften(w: spec.SinglePart, name: str, values: F64, sample_rate_hz: float) -> tuple[int, int]:
    """Bend start and end of ``values`` to rest; return how many samples of each are bent."""
    n = values.size
    soft_s = w.soft_start_s + w.soft_end_s
    if soft_s * sample_rate_hz > n + 0.5:
        raise InputError(
            f"{name}: soft_start_s + soft_end_s = {soft_s:.10g} s must fit in its "
            f"{n / sample_rate_hz:.10g} s"
        )
    # whole samples, and one that rounding kept from being whole: never more than n together
    soft_start = int(w.soft_start_s * sample_rate_hz + 1e-6)
    soft_end = int(w.soft_end_s * sample_rate_hz + 1e-6)
    start, end = values[:soft_start], values[n - soft_end :]
    start[:] = w.rest + _soft(soft_start) * (start - w.rest)
    end[:] = w.rest + _soft(soft_end)[::-1] * (end - w.rest)
    return soft_start, soft_end


def _soft(n: int) -> F64:
    """Return a raised cosine from 0 to 1: float64[n]."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / max(n, 1))
