"""The rig of an emulated device: in real time or by a sample clock, wiring, watchdog, and log."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.files import reason
from hilctl.base.samples import COLUMNS
from hilctl.base.types import F64, CommandUnit
from hilctl_drivers.profile_base import BaseProfile, Range
from hilctl_drivers.signal_chain import Amplifier, Sensor, SignalChain
from hilctl_drivers.simulated.crosstalk import CoupledPlants
from hilctl_drivers.simulated.devices import SimulatedPiezo, SimulatedTerfenol
from hilctl_drivers.simulated.simulated_device import SimulatedDevice

RATE_HZ = 10_000.0
SETTLED_S = 1.0  # the slowest part of the rig has a time constant of 0.1 ms
ACTUATORS: dict[CommandUnit, type[SimulatedDevice]] = {"A": SimulatedTerfenol, "V": SimulatedPiezo}
"""The actuator behind an emulated device, by the unit of its drive."""


class Stage:
    """Rigs in real time, from rest at ``now_ns``; a sensor may see the displacement of another rig.

    The caller supplies the time. Each rig has held its output since the last change, and its sensor
    shows the last sample of the stage's clock, so readings are one to two periods of it old.

    Args:
        now_ns: The present time.
        actuators: Actuators by axis; of one axis, its name may be empty.
    """

    def __init__(self, now_ns: int, actuators: Mapping[str, SimulatedDevice]) -> None:
        self._actuators = actuators
        self.rigs = tuple(Rig(self, each) for each in actuators.values())
        self._plants = self.plants(RATE_HZ)
        self._origin_ns = now_ns
        self._samples = 1
        self._step(1)

    def plants(self, rate_hz: float) -> CoupledPlants:
        """Return the plants of all rigs at rest, in their order."""
        plants = {axis: each.plant(rate_hz) for axis, each in self._actuators.items()}
        crosstalk = {axis: each.crosstalk for axis, each in self._actuators.items()}
        return CoupledPlants(plants, crosstalk, rate_hz)

    def advance(self, now_ns: int) -> None:
        """Advance the time until ``now_ns``, with the outputs held."""
        due = int((now_ns - self._origin_ns) * RATE_HZ * 1e-9)
        if due > self._samples:
            # Nothing changes any more on a held output, and catching up with hours takes minutes.
            self._step(min(due - self._samples, int(SETTLED_S * RATE_HZ)))
            self._samples = due

    def _step(self, count: int) -> None:
        commands = [each.command for each in self.rigs]
        self._plants.hold(count - 1, commands)
        read_um, read = np.empty((2, len(commands), 1))
        self._plants.step([*np.array([commands]).T], [*read_um], [*read])
        for rig, (displacement_um,) in zip(self.rigs, read_um.tolist(), strict=True):
            rig.displacement_um = displacement_um


class Rig:
    """An actuator with its amplifier and sensor, on a stage."""

    def __init__(self, stage: Stage, actuator: SimulatedDevice) -> None:
        self.stage, self.actuator = stage, actuator
        self.command = 0.0
        self.displacement_um = 0.0

    def put_out(self, command: float, now_ns: int) -> None:
        """Change the output; the amplifier saturates at the actuator's range."""
        self.stage.advance(now_ns)
        info = self.actuator.info
        self.command = min(max(command, info.command_min), info.command_max)


class SimulatedWiring(SignalChain):
    """Amplifier and sensor between the device's terminals and the rig."""

    def at_terminal(self, displacement_um: F64 | float) -> F64:
        """Return the sensor's signal, clipped to the input's range as by an ADC."""
        *_, um_per_unit, offset_um = self.factors
        signal = (displacement_um - offset_um) / um_per_unit
        clipped: F64 = np.clip(signal, *self.input.limits)
        return clipped

    def monitor(self, command: F64, source: Range) -> F64:
        """Return the reading of an input at the output; in another unit it reads the command."""
        signal = self.output(command) if source.unit == self._output_unit else command
        clipped: F64 = np.clip(signal, source.min, source.max)
        return clipped

    @classmethod
    def spread(
        cls, output: Range, sensor_input: Range, actuator: SimulatedDevice
    ) -> "SimulatedWiring":
        """Spread the actuator's ranges over those of two channels; an output in A drives it."""
        info, amplifier = actuator.info, None
        if output.unit != "A":
            unit = info.command_unit.lower()
            gain, offset = _spread(output, info.command_min, info.command_max)
            keys = {f"gain_{unit}_per_{output.unit.lower()}": gain, f"offset_{unit}": offset}
            amplifier = Amplifier.model_validate(keys)
        gain, offset = 1.0, 0.0 - sensor_input.rest  # of a reading in um
        if sensor_input.unit != "um":
            gain, offset = _spread(sensor_input, info.sensor_min_um, info.sensor_max_um)
        keys = {f"um_per_{sensor_input.unit.lower()}": gain, "offset_um": offset}
        return cls(output, sensor_input, amplifier, Sensor.model_validate(keys))


def _spread(channel: Range, low: float, high: float) -> tuple[float, float]:
    gain = (high - low) / (channel.max - channel.min)
    return gain, low - gain * channel.min


class WatchdogTimer:
    """Host watchdog of an emulated device; a ``timeout_ns`` of 0 disarms it."""

    def __init__(self) -> None:
        self.timeout_ns = 0
        self.fed_ns = 0
        self.tripped = False

    @property
    def due_ns(self) -> int | None:
        """Time of the next trip without another request; None if disarmed or tripped."""
        return None if self.tripped or not self.timeout_ns else self.fed_ns + self.timeout_ns

    def trip(self, now_ns: int) -> int | None:
        """Trip if it is due; return the time of the trip, None without one."""
        due_ns = self.due_ns
        if due_ns is None or due_ns > now_ns:
            return None
        self.tripped = True
        return due_ns


_BEGIN = b'{"event": '


class WriteLog:
    """One JSON object per line, on disk immediately; replaces an older log, if ``path`` is set."""

    def __init__(self, path: Path | None, unix_offset_ns: int) -> None:
        self._offset_ns = unix_offset_ns
        self._file: IO[bytes] | None = None
        if path is not None:
            try:
                if path.is_file():
                    with path.open("rb") as before:
                        if before.read(len(_BEGIN)) not in {b"", _BEGIN}:
                            raise InputError(f"{path}: is no emulator log: choose another name")
                self._file = path.open("wb", buffering=0)
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {reason(error)}") from None

    def event(self, now_ns: int, event: str, **more: Any) -> None:
        """Write one line; ``now_ns`` is monotonic time, ``more`` are plain values."""
        if self._file is None:
            return
        unix_s = (now_ns + self._offset_ns) * 1e-9
        entry = {"event": event, "monotonic_ns": now_ns, "unix_s": unix_s, **more}
        self._file.write(json.dumps(entry).encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None


@dataclass(frozen=True, slots=True)
class WiredRig:
    """A rig between an output and an input, of one device or of two."""

    rig: Rig
    wiring: SimulatedWiring
    axis: str = ""

    def logged(self, command: float) -> dict[str, Any]:
        """Return the fields of a command in the log."""
        name = COLUMNS["command"].field(self.wiring.command_unit).name
        return {name: command} | ({"axis": self.axis} if self.axis else {})


@dataclass(frozen=True, slots=True)
class Bench:
    """The rigs of a stage at the terminals of one device, and the log of its outputs.

    If it has both outputs and inputs, they are in the same order.
    """

    driven: Mapping[str, WiredRig]  # by output
    shown: Mapping[str, WiredRig]  # by input
    log: WriteLog

    @property
    def first(self) -> WiredRig:
        """The first rig."""
        return next(iter((self.driven or self.shown).values()))


class EmulatedDevice(ABC):
    """A device on a bench; another device may have the inputs of its rigs, or their outputs."""

    profile: BaseProfile

    def __init__(self, profile: BaseProfile, bench: Bench) -> None:
        self.profile = profile
        self._driven, self._shown, self._log = bench.driven, bench.shown, bench.log
        self._first = bench.first
        self._timer = WatchdogTimer()
        self._now_ns = 0
        self.invalid_until_ns = 0
        """Time until which the sensor's readings are marked as invalid."""

    @property
    def digital_input(self) -> bool:
        """Whether the digital inputs are high: every other second, for a start by one of them."""
        return self._now_ns // 10**9 % 2 == 1

    @property
    def _is_invalid(self) -> bool:
        return self._now_ns < self.invalid_until_ns

    @property
    def tripped(self) -> bool:
        """Whether the host watchdog has tripped."""
        return self._timer.tripped

    def names(self, outputs: Iterable[str]) -> set[str]:
        """Return the names of outputs, and those of their axes."""
        found = {*outputs}
        return found | {self._driven[each].axis for each in found & self._driven.keys()}

    def tick(self, now_ns: int) -> None:
        """Advance the time; the watchdog may trip meanwhile."""
        due_ns = self._timer.trip(now_ns)
        if due_ns is not None:
            self._trip(due_ns)
        self._now_ns = max(self._now_ns, now_ns)
        self._advance()

    @abstractmethod
    def _trip(self, due_ns: int) -> None:
        """Apply a watchdog trip to the outputs."""

    def _advance(self) -> None:
        self._first.rig.stage.advance(self._now_ns)

    def _reading(self, name: str, source: Range) -> float:
        """Return the reading of an input: a displacement, or the first output for all others."""
        if name in self._shown:
            shown = self._shown[name]
            return float(shown.wiring.at_terminal(shown.rig.displacement_um))
        first = self._first
        return float(first.wiring.monitor(np.asarray(first.rig.command), source))

    def _set_terminal(self, name: str, value: float, event: str, now_ns: int) -> None:
        """Log an output's new value, and drive the rig if one is wired to it."""
        more: dict[str, Any] = {}
        if name in self._driven:
            driven = self._driven[name]
            driven.rig.put_out(driven.wiring.command(value), now_ns)
            more = driven.logged(driven.rig.command)
        unit = self.profile.outputs[name].unit
        self._log.event(now_ns, event, output=name, value=value, unit=unit, **more)

    def _log_played(self, name: str, first: int, command: F64, now_ns: int) -> float:
        """Log a block that a FIFO has output; return its last value in the output's unit."""
        last, driven = float(command[-1]), self._driven[name]
        value, unit = driven.wiring.output(last), self.profile.outputs[name].unit
        self._log.event(
            now_ns, "played", output=name, first=first, samples=command.size,
            value=value, unit=unit, **driven.logged(last),
        )  # fmt: skip
        return value


_SETTLED_S = 0.1

Played: TypeAlias = Callable[[int, Sequence[F64], Sequence[F64], int], None]
"""First value's number, commands and readings in um, float64[n] per rig, time of the last."""


class SampleQueue:
    """Values of one output that wait for their periods; it holds the last one."""

    def __init__(self) -> None:
        self._values = np.empty(0)
        self.command = 0.0

    @property
    def level(self) -> int:
        """Number of values."""
        return self._values.size

    def put(self, command: F64) -> None:
        """Queue float64[n]."""
        self._values = np.concatenate([self._values, command])

    def clear(self) -> None:
        """Discard the values."""
        self._values = np.empty(0)

    def take(self, periods: int) -> F64:
        """Return and remove the commands of the next periods, float64[periods]."""
        values, self._values = np.split(self._values, [periods])
        if values.size:
            self.command = float(values[-1])
        return np.concatenate([values, np.full(periods - values.size, self.command)])


class SampleFifo:
    """FIFO of a stage's rigs, each of which outputs one value per period of a common clock.

    A period without a value holds or ``repeats`` the last one.
    """

    def __init__(self, stage: Stage, *, repeats: bool, on_played: Played) -> None:
        self._stage = stage
        self.queues = tuple(SampleQueue() for _ in stage.rigs)
        self._repeats = repeats
        self._on_played = on_played
        self._plants: CoupledPlants | None = None
        self._plants_rate_hz = 0.0
        self._rate_hz = 0.0
        self._start_ns: int | None = None
        self._periods = 0
        self.played = 0  # values output since the rate was set
        self.underruns = 0  # periods since then that found nothing queued

    @property
    def running(self) -> bool:
        """Whether a rate is set, started or not."""
        return self._rate_hz > 0.0

    @property
    def started(self) -> bool:
        """Whether periods pass."""
        return self._start_ns is not None

    def set_rate(self, rate_hz: float) -> None:
        """Stop, and count from 0 at another rate after :meth:`start`; queued values stay."""
        if self._plants is None or self._plants_rate_hz != rate_hz:
            self._plants = self._stage.plants(rate_hz)
            self._plants_rate_hz = rate_hz
        # It compiles the plants too, which would be late once the clock runs.
        self._plants.hold(round(_SETTLED_S * rate_hz), [each.command for each in self.queues])
        self.stop()
        self._rate_hz = rate_hz
        self._periods = self.played = self.underruns = 0

    def start(self, now_ns: int) -> None:
        """Start; the first value is output one period from now."""
        self._start_ns = now_ns

    def stop(self) -> None:
        """Stop; queued values stay, and the outputs hold their values."""
        self._rate_hz = 0.0
        self._start_ns = None

    def due_ns(self, values: int) -> int | None:
        """Return when that many values will have been output; None before the start."""
        if self._start_ns is None:
            return None
        return self._start_ns + round((values + self.underruns) * 1e9 / self._rate_hz)

    def advance(self, now_ns: int) -> None:
        """Output the values due by now; repeat or hold the last value if none is queued."""
        if self._start_ns is None or self._plants is None:
            return
        due = int((now_ns - self._start_ns) * self._rate_hz * 1e-9 + 1e-6) - self._periods
        if due <= 0:
            return
        self._periods += due
        queued = min(due, max(each.level for each in self.queues))
        self.underruns += due - queued
        played = due if self._repeats else queued
        commands = [each.take(due) for each in self.queues]
        displacements_um, measured = np.empty((2, len(commands), due))
        self._plants.step(commands, [*displacements_um], [*measured])
        if played:
            read_um = [each[:played] for each in displacements_um]
            self._on_played(self.played, [each[:played] for each in commands], read_um, now_ns)
            self.played += played
