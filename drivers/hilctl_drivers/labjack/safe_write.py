"""One attempt to make the output of a LabJack safe, streaming or not."""

from hilctl.base.errors import DeviceError
from hilctl_drivers.labjack.frames import ModbusFeedback, ReadFrame, WriteFrame
from hilctl_drivers.labjack.stream import ENABLE, u32
from hilctl_drivers.modbus.safe_write import ModbusSafeWrite
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.wire.errors import Refused


class StreamSafeWrite(ModbusSafeWrite):
    """Stops the stream and writes the output in one message; what is queued is dropped."""

    def _put(self, session: ModbusSession, data: bytes) -> None:
        feedback = ModbusFeedback(session.link, self._setup.writer.unit)
        write = WriteFrame(self._setup.writer.address(self._setup.output), data)
        # The stream first: it would write over the safe value with its next scan.
        try:
            feedback.call([WriteFrame(ENABLE, u32(0)), write])
        except Refused:  # a stream that does not run can't be stopped
            feedback.call([write])

    def _check_held(self, session: ModbusSession, value: float) -> None:
        output = self._setup.output
        feedback = ModbusFeedback(session.link, self._setup.writer.unit)
        target = ReadFrame(self._setup.writer.address(output), output.words)
        running, held = feedback.call([ReadFrame(ENABLE, 2), target])
        if running != u32(0):
            raise DeviceError("the stream was stopped, but still runs")
        self._check(output.format.decode(held), value)
