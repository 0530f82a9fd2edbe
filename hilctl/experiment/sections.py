"""Common types of the experiment file, and its sections: limits, timing, recording, real time."""

import re
from typing import Annotated, Any, Literal, Self, TypeAlias

from hilctl.base.strict import (
    AfterValidator,
    BeforeValidator,
    Field,
    StrictModel,
    WithJsonSchema,
    model_validator,
)
from hilctl.base.types import CommandUnit
from hilctl.loop.interlocks import InterlockSettings
from hilctl.loop.pacer import USUAL_MISSED_SHARE
from hilctl.recording.metadata_keys import RECORDINGS

_NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,79}"


def _name(text: str) -> str:
    if not re.fullmatch(_NAME, text):
        raise ValueError(
            "must be at most 80 letters, digits, '.', '_' and '-', "
            f"and begin with a letter or digit: {text!r}"
        )
    return text


def _two(value: Any) -> Any:
    if isinstance(value, tuple) and len(value) != 2:
        raise ValueError(f"must be [lowest, highest]: {list(value)}")
    return value


def _rising(interval: tuple[float, float]) -> tuple[float, float]:
    if not interval[0] < interval[1]:
        raise ValueError(f"must be [lowest, highest]: {list(interval)}")
    return interval


Name = Annotated[
    str, AfterValidator(_name), WithJsonSchema({"type": "string", "pattern": f"^{_NAME}$"})
]
Interval = Annotated[
    tuple[float, float],
    BeforeValidator(_two),
    AfterValidator(_rising),
    Field(description="lowest, highest"),
]


class Timing(StrictModel):
    """What happens to late ticks.

    Attributes:
        late_policy: For devices paced by this machine: ``skip`` whole ticks and keep the phase,
            ``catch_up`` with a burst, or ``slip`` the phase. Devices with a sample clock of their
            own always catch up: their FIFO takes the burst. Before the waveform no tick is skipped.
        late_after: A tick counts as late when it wakes this many tick periods after it was due.
        max_late_s: A tick later than this ends the run.
        max_consecutive_late: So many late ticks one after the other end the run; 0 for any number.
            Left out, as many as come in two seconds: this machine can't keep the rate.
        grace_s: Time after the start in which late ticks count, but don't end the run.
        on_misses: What a run does that skips too many ticks: ``fault``, its safe ramp, or ``warn``,
            which is said once it has ended. The command stands still in a skipped tick and jumps
            after it, so that such a run does not put out the waveform that was checked.
        max_missed_share: Share of ticks that may be skipped, over ten seconds or the whole waveform
            where that is shorter; only as many as five stalls or more make end a run.
        hang_s: A loop that gives no sign for this time and two tick periods is killed, and the
            output made safe; while it waits for the device, ``max_late_s`` more. Left out, 80 ms;
            for a simulated device, which has no coil to protect, ``max_late_s`` and half a second.
            One that is stopped, as by SIGSTOP, has no more than 20 ms where there is a coil.
    """

    late_policy: Literal["skip", "catch_up", "slip"] = "skip"
    late_after: Annotated[float, Field(gt=0.0)] = 0.5
    max_late_s: Annotated[float, Field(gt=0.0)] = 1.0
    max_consecutive_late: Annotated[int, Field(ge=0)] | None = None
    grace_s: Annotated[float, Field(ge=0.0)] = 0.0
    on_misses: Literal["warn", "fault"] = "fault"
    max_missed_share: Annotated[float, Field(ge=0.0, lt=1.0)] = USUAL_MISSED_SHARE
    hang_s: Annotated[float, Field(ge=0.02, le=60.0)] | None = None


class RecordingConfig(StrictModel):
    """Where and how a run is recorded.

    Attributes:
        folder: Folder for recordings without a name of their own, relative to where hilctl runs.
        flush_s: Longest time that a sample stays out of the file; until then the ring keeps it.
        sync: Whether every flush waits until the disk itself has the samples, so that a power cut
            takes no more than ``flush_s``. At the end of a run that is always so.
        scope_rate_hz: Highest rate of the ``/scope`` topic.
        ring_s: Seconds of samples that the ring between loop and recorder holds.
        on_failure: What a run does when the disk has accepted nothing for half of ``ring_s``:
            ``stop`` by its safe ramp, or ``go_on`` and count what is lost once the ring is full.
            Refused writes are retried all the while.
    """

    folder: str = RECORDINGS
    flush_s: Annotated[float, Field(gt=0.0, le=10.0)] = 2.0
    sync: bool = False
    scope_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 1000.0
    ring_s: Annotated[float, Field(ge=1.0, le=60.0)] = 10.0
    on_failure: Literal["stop", "go_on"] = "stop"

    @model_validator(mode="after")
    def _room(self) -> Self:
        if self.ring_s < 3.0 * self.flush_s:
            raise ValueError(
                "ring_s must be at least three times flush_s, which the ring has to bridge: "
                f"{self.ring_s:g} and {self.flush_s:g}"
            )
        return self


REST_S = 0.1
"""Rest before the waveform where an offset is measured and no other rest is given."""


class Condition(StrictModel):
    """A decaying cycle around the safe value before the waveform, to a repeatable state.

    It goes to both sides of the safe value as far as the amplitude, and no further than the limits.

    Attributes:
        amplitude_a: Amplitude of the first cycle, for devices driven in A; as far as the limits go
            where it is left out.
        amplitude_v: The same for devices driven in V.
        frequency_hz: Left out, 10 Hz, or less where slew limit or rate ask for it.
        cycles: How many.
        decay: Amplitude of each cycle over that of the one before; 1 for one that falls in a line.
        rest_s: Rest at the safe value after it; over its second half the displacement is averaged.
    """

    amplitude_a: Annotated[float, Field(gt=0.0)] | None = None
    amplitude_v: Annotated[float, Field(gt=0.0)] | None = None
    frequency_hz: Annotated[float, Field(gt=0.0)] | None = None
    cycles: Annotated[int, Field(ge=2, le=1000)] = 20
    decay: Annotated[float, Field(ge=0.1, le=1.0)] = 0.8
    rest_s: Annotated[float, Field(ge=0.0, le=60.0)] = REST_S


class _AnyFeedback(StrictModel):
    """What every feedback has.

    Attributes:
        limit_um: Largest correction of the compensator's input, either way.
        sensor_delay_s: Age of a displacement when it is read, as far as the model does not know it:
            the filter of the sensor, its line.
        resonance_hz: Lowest natural frequency of the actuator with its load; the feedback must stay
            well below it. Left out, that of the model's structure.
        damping_ratio: Damping of that resonance.
    """

    limit_um: Annotated[float, Field(gt=0.0)]
    sensor_delay_s: Annotated[float, Field(ge=0.0)] = 0.0
    resonance_hz: Annotated[float, Field(gt=0.0)] | None = None
    damping_ratio: Annotated[float, Field(gt=0.0, le=2.0)] | None = None


class PiFeedbackConfig(_AnyFeedback):
    """A PI controller around the compensator, for devices that exchange sample by sample.

    Attributes:
        bandwidth_hz: Frequency up to which the error is brought down; gives the gains.
        kp: Proportional gain, um of correction per um of error, where there is no bandwidth.
        ki_per_s: Integral gain, per s, where there is no bandwidth.
    """

    kind: Literal["pi"] = "pi"
    bandwidth_hz: Annotated[float, Field(gt=0.0)] | None = None
    kp: Annotated[float, Field(ge=0.0)] | None = None
    ki_per_s: Annotated[float, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        by_gains = self.kp is not None or self.ki_per_s is not None
        if by_gains == (self.bandwidth_hz is not None) or (by_gains and self.ki_per_s is None):
            raise ValueError("must have either bandwidth_hz or ki_per_s, the latter with kp or not")
        return self


class IntegralFeedbackConfig(_AnyFeedback):
    """An integrator of the mean error of each block, for every device: see loop/feedback.py.

    Attributes:
        bandwidth_hz: Frequency below which offset, creep and drift are taken out; a disturbance
            that comes at once fades as e^(-2 pi bandwidth t).
    """

    kind: Literal["integral"]
    bandwidth_hz: Annotated[float, Field(gt=0.0)]


class AdaptationConfig(StrictModel):
    """Slow adaptation of the compensator's model by the tracking error: see loop/adaptation.py.

    Attributes:
        time_constant_s: Time in which what is wrong with the model falls to 1/e.
        offset_um: Largest offset that is adapted; left out, a tenth of ``limits.stroke_um``, or 0
            with feedback, which takes the offset out itself.
        gain: Largest change of the gain, as a share of the identified one.
        weight: Largest weight of each of the plays after the model, as such a share.
        noise_um: Standard deviation of the sensor's noise, for the dead zone; left out, that of the
            rest before the waveform, which ``condition`` or ``compensator.offset: measured`` gives.
        sensor_delay_s: See ``feedback``.
    """

    time_constant_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0
    offset_um: Annotated[float, Field(ge=0.0)] | None = None
    gain: Annotated[float, Field(ge=0.0, le=0.3)] = 0.1
    weight: Annotated[float, Field(ge=0.0, le=0.1)] = 0.02
    noise_um: Annotated[float, Field(ge=0.0)] | None = None
    sensor_delay_s: Annotated[float, Field(ge=0.0)] = 0.0


def _pi_where_not_said(value: Any) -> Any:
    return {"kind": "pi", **value} if isinstance(value, dict) else value


FeedbackConfig: TypeAlias = Annotated[
    Annotated[PiFeedbackConfig | IntegralFeedbackConfig, Field(discriminator="kind")],
    BeforeValidator(_pi_where_not_said),
]


class Limits(InterlockSettings):
    """What the limiter and the interlocks hold the run to; the limiter is last before the device.

    Attributes:
        peak_current_a: Largest magnitude of the coil current, for devices driven in A.
        slew_a_per_s: Fastest change of the coil current.
        drive_v: Lowest and highest drive voltage, for devices driven in V.
        slew_v_per_s: Fastest change of the drive voltage.
        stroke_um: Displacements that the sensor may show; outside, the run ends by its safe ramp.
    """

    peak_current_a: Annotated[float, Field(gt=0.0)] | None = None
    slew_a_per_s: Annotated[float, Field(gt=0.0)] | None = None
    drive_v: Interval | None = None
    slew_v_per_s: Annotated[float, Field(gt=0.0)] | None = None
    stroke_um: Interval

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        current = (self.peak_current_a, self.slew_a_per_s)
        voltage = (self.drive_v, self.slew_v_per_s)
        complete = None not in current or None not in voltage
        mixed = any(v is not None for v in current) and any(v is not None for v in voltage)
        if mixed or not complete:
            raise ValueError(
                "must have either peak_current_a and slew_a_per_s (a device driven in A) or "
                "drive_v and slew_v_per_s (a device driven in V)"
            )
        return self

    @property
    def unit(self) -> CommandUnit:
        """Unit of the commands that are limited."""
        return "V" if self.drive_v is not None else "A"

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command, in :attr:`unit`."""
        if self.drive_v is not None:
            return self.drive_v
        peak = self.peak_current_a or 0.0
        return -peak, peak

    @property
    def slew_per_s(self) -> float:
        """Fastest change of the command, in :attr:`unit` a second."""
        return self.slew_v_per_s or self.slew_a_per_s or 0.0
