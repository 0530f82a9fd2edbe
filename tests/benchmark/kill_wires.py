"""The wires over which runs are attacked, and what a device's own log of writes says afterwards.

No device here has a watchdog: whatever it was last given stays on the output.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hilctl.base.samples import Flag
from hilctl.recording.data import Samples

GENERIC = """\
vendor: nobody
model: a server with float32 registers and no watchdog
source: [tests/benchmark/kill_wires.py]
verified: "yes"
link: {kind: tcp}
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  OUT: {address: 100, type: float32, unit: V, min: -10.0, max: 10.0}
inputs:
  IN: {address: 200, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog: none
"""
_SENSOR = {"sensor": {"um_per_v": 12.5}, "timeout_s": 1.0, "watchdog": "none"}
_VOLT_AN_AMPERE = {"amplifier": {"gain_a_per_v": 1.0}}
_TOLERANCE_A = 1e-5  # values are float32 on the wire


@dataclass(frozen=True, slots=True)
class AttackedWire:
    """One way to the rig.

    Attributes:
        rate_hz: Sample rate.
        device: The experiment's device section without profile and address.
        profile: Shipped profile; empty for :data:`GENERIC`.
        block: Samples an exchange.
        words: More words for ``hilctl emulate``.
        latest_s: How late an answer may be without ending a run: what a FIFO bears.
        late_every: Every so many answers is late, where any are.
    """

    rate_hz: float
    device: dict[str, Any]
    profile: str = ""
    block: int = 1
    words: tuple[str, ...] = ()
    latest_s: float = 0.4
    late_every: int = 1

    @property
    def streams(self) -> bool:
        """Whether the device plays from a FIFO of its own."""
        return self.block > 1

    def profile_in(self, folder: Path) -> str:
        """Return the profile to use, written there where it is not shipped."""
        if self.profile:
            return self.profile
        path = folder / "profile.yaml"
        path.write_text(GENERIC, encoding="utf-8")
        return str(path)

    def section(self, profile: str, address: str) -> dict[str, Any]:
        """Return the experiment's device section."""
        host, _, port = address.rpartition(":")
        place = {"host": host, "tcp_port": int(port)} if host else {"serial_port": address}
        return {**self.device, **_SENSOR, "profile": profile, **place}


_MODBUS = {"kind": "modbus_dac", "output": "OUT", "input": "IN", **_VOLT_AN_AMPERE}
_T7 = {"kind": "modbus_stream", "output": "DAC0", "input": "AIN0", "fifo_blocks": 9,
       "amplifier": {"gain_a_per_v": 4.0, "offset_a": -10.0}}  # fmt: skip
_BOARD = {"kind": "serial_dac", "output": "DAC", "input": "ADC", "fifo_blocks": 15}
WIRES = {
    "modbus": AttackedWire(500.0, _MODBUS),
    "modbus-1khz": AttackedWire(1000.0, _MODBUS),
    "labjack": AttackedWire(20e3, _T7, "labjack_t7", 580, ("--current-a", "0"), 0.12, 97),
    "cobs": AttackedWire(50e3, {**_BOARD, **_VOLT_AN_AMPERE}, "cobs_board_fifo", 500, (), 0.12, 7),
}


@dataclass(frozen=True, slots=True)
class DeviceLog:
    """What a device has put out.

    Attributes:
        times_ns: int64[n], monotonic time of each entry.
        current_a: float64[n], where the output stood from then on.
        ends: int64[n], samples played from the FIFO up to there; 0 for a write.
    """

    times_ns: np.ndarray = field(repr=False)
    current_a: np.ndarray = field(repr=False)
    ends: np.ndarray = field(repr=False)

    @classmethod
    def read(cls, path: Path) -> "DeviceLog":
        """Read an emulator's log as far as it is written."""
        lines = path.read_bytes().split(b"\n")[:-1]
        entries = [each for each in map(json.loads, lines) if "current_a" in each]
        ends = [each.get("first", 0) + each.get("samples", 0) for each in entries]
        return cls(
            np.array([each["monotonic_ns"] for each in entries], dtype=np.int64),
            np.array([each["current_a"] for each in entries]),
            np.array(ends, dtype=np.int64),
        )

    def uncontrolled_ms(self, hit_ns: int) -> float:
        """Return the longest time from then on without an entry at an output that is not safe."""
        if abs(self.current_a[-1]) > _TOLERANCE_A:
            return float("inf")
        until_ns = self.times_ns[1:]
        stood_ns = until_ns - np.maximum(self.times_ns[:-1], hit_ns)
        unsafe = (np.abs(self.current_a[:-1]) > _TOLERANCE_A) & (until_ns > hit_ns)
        return float(stood_ns[unsafe].max(initial=0) * 1e-6)

    def safe_after_ms(self, hit_ns: int) -> float:
        """Return how long from then on until the output stood at its safe value for good."""
        moved = np.flatnonzero(np.abs(self.current_a) > _TOLERANCE_A)
        if not moved.size:
            return 0.0
        if moved[-1] + 1 == self.current_a.size:
            return float("inf")
        return max(0.0, float(self.times_ns[moved[-1] + 1] - hit_ns) * 1e-6)

    def lost(self, samples: Samples) -> int:
        """Return how many samples were put out and are not in the recording, in order."""
        return self._lost_of_fifo(samples) if self.ends.any() else self._lost_writes(samples)

    def _lost_writes(self, samples: Samples) -> int:
        """Count writes that are missing.

        The device sees the value that it holds already when it is opened, each command in turn, and
        the safe value of the last resort; a last sample without answer may not have reached it.
        """
        commands, put_out = samples.command.astype(np.float32), self.current_a.astype(np.float32)
        sure = commands.size - int(np.count_nonzero(samples.flags & Flag.UNANSWERED.value))
        best = put_out.size
        for before in range(3):
            for size in range(sure, commands.size + 1):
                rest = put_out[before:]
                if rest.size >= size and np.array_equal(rest[:size], commands[:size]):
                    best = min(best, int(np.count_nonzero(rest[size:])))
        return best

    def _lost_of_fifo(self, samples: Samples) -> int:
        """Count samples of stretches whose last value is not the command of that sample.

        With nothing left to put out, a device holds the last value: that is no sample of ours.
        """
        played = self.ends > 0
        ends, current_a = self.ends[played], self.current_a[played]
        sizes = np.diff(ends, prepend=0)
        known = ends <= samples.command.size
        right = np.zeros(ends.size, dtype=bool)
        right[known] = np.isclose(
            samples.command[ends[known] - 1], current_a[known], rtol=0.0, atol=_TOLERANCE_A
        )
        held = ~known & np.isclose(current_a, samples.command[-1], rtol=0.0, atol=_TOLERANCE_A)
        return int(sizes[~right & ~held].sum())
