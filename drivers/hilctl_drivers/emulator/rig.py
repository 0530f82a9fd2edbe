"""What stands behind an emulated device: rig, wiring, and a log of what was put out."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.files import reason
from hilctl_drivers.profile_base import Range
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

RATE_HZ = 10_000.0
SETTLED_S = 1.0  # the slowest part of the rig has a time constant of 0.1 ms
_CHUNK = 1000


class Rig:
    """The actuator with its amplifier and sensor, in real time.

    Whoever asks gives the time. The rig has then held its output since the last change, and its
    sensor shows the last sample of its own clock: readings are one to two of its periods old.

    Args:
        now_ns: Time at which it stands still and at 0 A.
        noise: Whether the sensor has noise.
        seed: Seed of that noise.
    """

    def __init__(self, now_ns: int, *, noise: bool = True, seed: int = 1) -> None:
        rated = TerfenolParameters()
        parameters = rated if noise else replace(rated, sensor_noise_um=0.0)
        self._plant = TerfenolActuator(parameters, RATE_HZ, seed=seed)
        self._held = np.zeros(_CHUNK)
        self._read = np.zeros((2, _CHUNK))
        self._origin_ns = now_ns
        self._samples = 0
        self.current_a = 0.0
        self.displacement_um = 0.0
        self._step(1)

    def advance(self, now_ns: int) -> None:
        """Let time pass until ``now_ns``, with the output held."""
        due = int((now_ns - self._origin_ns) * RATE_HZ * 1e-9)
        if due - self._samples > SETTLED_S * RATE_HZ:
            # Nothing changes any more on a held output, and catching up with hours takes minutes.
            self._samples = due - int(SETTLED_S * RATE_HZ)
        while self._samples < due:
            self._step(min(_CHUNK, due - self._samples))

    def put_out(self, current_a: float, now_ns: int) -> None:
        """Change the output, after :meth:`advance`.

        Args:
            current_a: What the amplifier is asked for; beyond its range it gives what it can.
            now_ns: When.
        """
        self.advance(now_ns)
        limit_a = TerfenolParameters().dac_range_a
        self.current_a = min(max(current_a, -limit_a), limit_a)

    def _step(self, count: int) -> None:
        self._held[:count] = self.current_a
        self._plant.step(self._held[:count], self._read[0, :count], self._read[1, :count])
        self.displacement_um = float(self._read[0, count - 1])
        self._samples += count


@dataclass(frozen=True, slots=True)
class SimulatedWiring:
    """What stands between the device's terminals and the rig.

    Attributes:
        gain_a: Amplifier, A for one unit of the output.
        offset_a: Current at 0 of the output.
        sensor_um: Sensor, um for one unit of the input.
        offset_um: Displacement at 0 of the input.
    """

    gain_a: float
    offset_a: float
    sensor_um: float
    offset_um: float

    @classmethod
    def spread(cls, output: Range, sensor: Range) -> "SimulatedWiring":
        """Return a wiring that spreads the rig's ranges over those of the two channels.

        An output in A drives the coil itself.
        """
        rig = TerfenolParameters()
        gain_a, offset_a = _spread(output, rig.dac_range_a)
        if output.unit == "A":
            gain_a, offset_a = 1.0, 0.0
        return cls(gain_a, offset_a, *_spread(sensor, rig.sensor_range_um))


def _spread(channel: Range, reach: float) -> tuple[float, float]:
    gain = 2.0 * reach / (channel.max - channel.min)
    return gain, -0.5 * gain * (channel.max + channel.min)


_BEGIN = b'{"event": '


class WriteLog:
    """One JSON object a line, on disk as soon as it happened.

    Args:
        path: File to write; an older log is replaced. None keeps no log.
        unix_offset_ns: What to add to the monotonic clock to get Unix time.

    Raises:
        InputError: The file can't be written.
    """

    def __init__(self, path: Path | None, unix_offset_ns: int) -> None:
        self._offset_ns = unix_offset_ns
        self._file: IO[bytes] | None = None
        if path is not None:
            try:
                if path.is_file():
                    with path.open("rb") as before:
                        if before.read(len(_BEGIN)) not in {b"", _BEGIN}:
                            raise InputError(f"{path}: is no log of a device: give another name")
                self._file = path.open("wb", buffering=0)
            except OSError as error:
                raise InputError(f"{path}: can't be written: {reason(error)}") from None

    def event(self, now_ns: int, event: str, **more: Any) -> None:
        """Write one line.

        Args:
            now_ns: Monotonic time.
            event: What happened.
            more: Plain values.
        """
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
