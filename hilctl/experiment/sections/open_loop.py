"""Open loop of the feedback: the actuator behind its compensator, the controller, and the margins.

Both controllers take the mean error of a block and step once per block. Their correction changes
linearly over the next block; for single samples that is a step.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.files import TextFiles, write_text
from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.base.types import F64
from hilctl.base.yaml import commented, load_document
from hilctl.experiment.rig import Exchange
from hilctl.loop.feedback import Gains
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.model_file import model_sha256

LEAST_GAIN_MARGIN_DB = 6.0
LEAST_PHASE_MARGIN_DEG = 45.0
"""With a measured response."""
ASSUMED_PHASE_MARGIN_DEG = 60.0
"""Without one, and of a proposal."""

_POINTS = 4096
_LOWEST = 1e-6  # of the sample rate, and of the lowest measured frequency
_ROUNDING = 1e-6
_WHOLE = 0.44  # of the sample rate: a response up to there may end before a resonance


@dataclass(frozen=True, slots=True)
class LoopResponse:
    """Frequency response of the actuator behind its compensator, or of the open loop.

    Attributes:
        frequency_hz: float64[k], rising.
        size: float64[k], magnitude.
        lag: float64[k], continuous phase lag in radians.
    """

    frequency_hz: F64
    size: F64
    lag: F64

    @property
    def margins(self) -> tuple[float, float]:
        """Gain margin in dB and phase margin in degrees of an open loop."""
        late = self.size[self.lag >= math.pi].max(initial=0.0)
        lag = self.lag[self.size >= 1.0].max(initial=float(self.lag[0]))
        return -20.0 * math.log10(max(late, 1e-300)), 180.0 - math.degrees(lag)

    def room(self, phase_margin_deg: float) -> float:
        """Return the factor by which the gain of an open loop may change to have just its margins.

        The gain margin holds at all frequencies with a lag of 180 degrees or more, resonances
        included.
        """
        late = self.size[self.lag >= math.pi].max(initial=0.0) * 10 ** (LEAST_GAIN_MARGIN_DB / 20.0)
        tight = self.size[self.lag >= math.pi - math.radians(phase_margin_deg)].max(initial=0.0)
        return float(1.0 / max(late, tight, 1e-300))

    def holds(self, phase_margin_deg: float) -> bool:
        """Return whether an open loop has its margins."""
        return self.room(phase_margin_deg) >= 1.0 - _ROUNDING

    def controlled(self, gains: Gains, exchange: Exchange) -> "LoopResponse":
        """Return the open loop with a controller."""
        turn = 2.0 * math.pi * self.frequency_hz / exchange.rate_hz
        whole, block = turn * exchange.block, exchange.block
        # 1 / (1 - exp(-j whole)) = 1/2 - j/2 / tan(whole / 2)
        step = 0.5 * gains.ki_per_s * block / exchange.rate_hz
        steps = gains.kp + step * (1.0 - 1j / np.tan(0.5 * whole))
        # One mean of the error, two of the line through the corrections.
        mean = np.abs(np.sin(0.5 * whole) / (block * np.sin(0.5 * turn)))
        wait = (1 + exchange.latency_blocks) * block + 0.5 * (block - 1)
        lag = self.lag + wait * turn - np.angle(steps)
        return LoopResponse(self.frequency_hz, self.size * np.abs(steps) * mean**3, lag)


def assumed_response(rate_hz: float, delay_s: float, resonance: FirstMode | None) -> LoopResponse:
    """Return a gain of 1 with a sample of delay, ``delay_s`` more, and a resonance.

    A resonance above half the sample rate is assumed there.
    """
    hz = np.geomspace(_LOWEST * rate_hz, 0.5 * rate_hz, _POINTS)
    natural_hz, damping_ratio = math.inf, 1.0
    if resonance is not None:
        natural_hz, damping_ratio = (
            min(resonance.natural_hz, 0.5 * rate_hz),
            resonance.damping_ratio,
        )
        hz = np.unique(np.append(hz, natural_hz))
    ratio = hz / natural_hz
    mode = 1.0 / (1.0 - ratio**2 + 2j * damping_ratio * ratio)
    lag = 2.0 * math.pi * hz * (1.0 / rate_hz + delay_s)
    return LoopResponse(hz, np.abs(mode), lag - np.angle(mode))


class MeasuredResponse(StrictModel):
    """Response from the compensator's input to the displacement, with its origin."""

    sample_rate_hz: Annotated[float, Field(gt=0.0)]
    model_sha256: str  # digest of the compensator's model
    frequency_hz: Annotated[tuple[Annotated[float, Field(gt=0.0)], ...], Field(min_length=2)]
    gain: tuple[Annotated[float, Field(ge=0.0)], ...]
    phase_deg: tuple[float, ...]  # continuous; a delay is negative
    provenance: Mapping[str, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if not len(self.frequency_hz) == len(self.gain) == len(self.phase_deg):
            raise ValueError("frequency_hz, gain and phase_deg must have as many values")
        if any(np.diff(self.frequency_hz) <= 0.0):
            raise ValueError("frequency_hz must increase")
        return self

    def open_loop(self, gains: Gains, exchange: Exchange) -> LoopResponse:
        """Return the open loop with a controller.

        Raise InputError if the frequencies end before its lag reaches 180 degrees or before a
        resonance, or if the rate is another one.
        """
        if not math.isclose(exchange.rate_hz, self.sample_rate_hz, rel_tol=1e-6):
            was, now = self.sample_rate_hz, exchange.rate_hz
            raise InputError(f"was measured at {was:g} samples per second, not at {now:g}")
        known = np.array(self.frequency_hz)
        hz = np.geomspace(_LOWEST * known[0], known[-1], _POINTS)
        size, lag = (np.interp(hz, known, each) for each in (self.gain, self.phase_deg))
        loop = LoopResponse(hz, size, -np.radians(lag)).controlled(gains, exchange)
        if not loop.lag.max() >= math.pi:
            lag_deg = math.degrees(loop.lag[-1])
            text = f"ends at {known[-1]:g} Hz, where the open loop lags by {lag_deg:.3g} degrees"
            raise InputError(f"{text}: measure up to the lag of 180 degrees")
        before = float(np.interp(0.9 * known[-1], hz, loop.size))
        if loop.size[-1] > before and known[-1] < _WHOLE * exchange.rate_hz:
            text = f"ends at {known[-1]:g} Hz, where the gain of the open loop rises"
            raise InputError(f"{text}: measure beyond the resonance")
        return loop

    def check_model(self, model: HysteresisModel | None) -> None:
        """Raise InputError if the response was measured with another model."""
        if model_sha256(model) != self.model_sha256:
            raise InputError("was measured with another model")


class _ResponseFile(StrictModel):
    response: MeasuredResponse


def load_response(path: Path, files: TextFiles | None = None) -> MeasuredResponse:
    """Read a response file; raise InputError if it cannot be read or breaks a rule."""
    return load_document(path, files).validate(_ResponseFile).response


def write_response(path: Path, response: MeasuredResponse, *, overwrite: bool) -> None:
    """Write a response file atomically; raise InputError if that is not possible."""
    text = commented({"response": response.model_dump(mode="json")}, {})
    write_text(path, text, overwrite=overwrite)
