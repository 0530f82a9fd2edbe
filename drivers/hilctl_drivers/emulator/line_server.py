"""Serves emulated devices on serial lines, with faults where they are wanted.

One thread and no locks: messages, the rig's time, watchdogs and sample clocks take turns.
"""

import heapq
import select
import socket
import time
from collections.abc import Callable, Sequence

from hilctl_drivers.emulator.answer import Answer, SerialDevice
from hilctl_drivers.emulator.faults import Fault, FaultPlan, spoil
from hilctl_drivers.emulator.serial_line import SerialLine

TICK_S = 0.005


class SerialServer:
    """Answers until it is stopped.

    Args:
        lines: What it serves; faults happen on the first.
        faults: What goes wrong.
        clock_ns: Monotonic time.
    """

    def __init__(
        self,
        lines: Sequence[SerialLine],
        faults: Sequence[Fault] = (),
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._lines = lines
        self._plan = FaultPlan(faults)
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._late: list[tuple[int, int, SerialLine, Answer, Fault | None]] = []
        self._count = 0
        self._wake, self._woken = socket.socketpair()
        self._stopping = False

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        while not self._stopping:
            self._wait()
            now_ns = self._clock_ns()
            for line in self._lines:
                for device in line.devices:
                    device.tick(now_ns)
            self._send_due(now_ns)
        self.close()

    def close(self) -> None:
        """Let go of the lines; :meth:`run` does so at its end."""
        for line in self._lines:
            line.unplug()
        self._wake.close()
        self._woken.close()

    def stop(self) -> None:
        """Make :meth:`run` end; from any thread or signal handler."""
        self._wake.send(b"\0")  # first: once the flag is up, run() may close this at any time
        self._stopping = True

    def _wait(self) -> None:
        pause_s = TICK_S
        if self._late:
            pause_s = min(pause_s, max(0.0, (self._late[0][0] - self._clock_ns()) * 1e-9))
        plugged = {line.fileno(): line for line in self._lines if line.plugged}
        full = [number for number, line in plugged.items() if line.has_unsent]
        ready, room, _ = select.select([*plugged, self._woken.fileno()], full, [], pause_s)
        for number in room:
            plugged[number].send(b"")
        for number in set(ready) & set(plugged):
            line = plugged[number]
            for message in line.read():
                self._hear(line, message)

    def _hear(self, line: SerialLine, message: bytes) -> None:
        now_ns = self._clock_ns()
        # A new message means that the host has given up on answers that are still to come.
        self._late = [each for each in self._late if each[2] is not line or each[4] is not None]
        fault = None
        if line is self._lines[0]:
            fault = self._plan.next((now_ns - self._start_ns) * 1e-9)
        if fault is not None and fault.kind in {"silence", "unplug", "exception"}:
            self._keep_back(line, message, fault)
            return
        heard = line.hear(message, now_ns)
        if heard is None:
            return
        device, answer = heard
        if answer.due_ns > now_ns or (fault is not None and fault.kind == "delay"):
            delay_ns = round(fault.delay_s * 1e9) if fault and fault.kind == "delay" else 0
            self._count += 1
            due_ns = max(answer.due_ns, now_ns) + delay_ns
            heapq.heappush(self._late, (due_ns, self._count, line, answer, fault))
        else:
            self._send(line, device, answer, fault, now_ns)

    def _keep_back(self, line: SerialLine, message: bytes, fault: Fault) -> None:
        """Do what a fault says that keeps the message from the device."""
        if fault.kind == "unplug":
            line.unplug()
        elif fault.kind == "exception":
            answer = line.devices[0].refusal(message)
            if answer is not None and answer.data is not None:
                line.send(line.framing.encode(answer.data))

    def _send_due(self, now_ns: int) -> None:
        while self._late and self._late[0][0] <= now_ns:
            _, _, line, answer, fault = heapq.heappop(self._late)
            self._send(line, line.devices[0], answer, fault, now_ns)

    def _send(
        self,
        line: SerialLine,
        device: SerialDevice,
        answer: Answer,
        fault: Fault | None,
        now_ns: int,
    ) -> None:
        data = answer.make(now_ns) if answer.make is not None else answer.data
        if data is None or not line.plugged:
            return
        if fault is None:
            line.send(line.framing.encode(data))
            return
        if fault.kind == "wrong_id":
            data = device.wrong_id(data)
        framed = line.framing.encode(data)
        line.send(spoil(fault.kind, framed, line.framing.corrupt_at(framed)))
