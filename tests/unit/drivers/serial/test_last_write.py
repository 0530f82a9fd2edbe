"""The last write on a serial line: sent first, believed when confirmed, tried for some time."""

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.serial.last_write import PATIENCE_S, SerialLastWrite
from hilctl_drivers.wire.links import LostError, NoAnswerError
from tests.fakes import VirtualTime


class ScriptedPort:
    """A port whose device answers from a time on; each exchange takes its time-out till then."""

    def __init__(self, time, answers_at_s=0.0, *, is_open=True, is_in_step=True, boot_s=0.0):
        self.time, self.answers_at_s, self.boot_s = time, time() + answers_at_s, boot_s
        self.is_open, self.is_in_step, self.timeout_s = is_open, is_in_step, 2.0
        self.calls = []
        self.late_s = 0.0
        self.late_answers = 0

    def open(self, *, boot=True):
        self.calls.append(f"open, boot {boot}")
        self.is_open, self.is_in_step = True, False

    def send(self):
        self.calls.append("send")
        self.late_answers += 1

    def await_silence(self, quiet_s):
        self.time.sleep(quiet_s)
        if quiet_s > self.late_s:
            self.late_answers = 0
        self.is_in_step = True

    def confirm(self):
        self.calls.append("confirm")
        if self.time() < self.answers_at_s:
            self.time.sleep(self.timeout_s)
            self.is_in_step = False
            raise NoAnswerError(f"no answer within {self.timeout_s:g} s")
        if self.late_answers and self.late_s:
            # The port takes any whole answer for a good one: it does not know what was asked.
            raise DeviceError("an answer to something else")


def carry_out(port):
    SerialLastWrite(port.time, port.time.sleep).carry_out(port, port.send, port.confirm)


def test_a_line_in_step_needs_one_exchange():
    port = ScriptedPort(VirtualTime())
    carry_out(port)
    assert port.calls == ["confirm"]


@pytest.mark.parametrize(("is_open", "before"), [(True, []), (False, ["open, boot False"])])
def test_the_value_goes_out_before_anything_is_awaited(is_open, before):
    """On a line that is out of step, and on a port that was just opened, without any wait."""
    port = ScriptedPort(VirtualTime(), is_open=is_open, is_in_step=False, boot_s=2.0)
    start_s = port.time()
    carry_out(port)
    assert port.calls == [*before, "send", "confirm"]
    assert port.time() - start_s < 0.05


@pytest.mark.parametrize("late_s", [0.03, 0.1, 0.4])
def test_answers_that_are_always_late_do_not_pass_for_the_next_ones(late_s):
    """The line is left silent for longer and longer, until no answer to an older try can come."""
    port = ScriptedPort(VirtualTime(), is_in_step=False)
    port.late_s = late_s
    start_s = port.time()
    carry_out(port)
    assert port.time() - start_s < 8.0 * late_s


@pytest.mark.parametrize("silent_s", [0.6, 2.5])
def test_a_device_that_is_silent_for_a_while_gets_it(silent_s):
    """It is sent before each try, and no try waits longer than half a second, and for silence."""
    port = ScriptedPort(VirtualTime(), silent_s)
    start_s = port.time()
    carry_out(port)
    assert port.calls[-2:] == ["send", "confirm"]
    assert silent_s <= port.time() - start_s <= silent_s + 0.8
    assert port.timeout_s == 2.0


@pytest.mark.parametrize("boot_s", [0.0, 2.0])
def test_what_never_answers_is_not_known(boot_s):
    """A board that boots is given that time on top."""
    port = ScriptedPort(VirtualTime(), 1e9, boot_s=boot_s)
    start_s = port.time()
    with pytest.raises(DeviceError, match="not known whether the value stands: no answer within"):
        carry_out(port)
    assert PATIENCE_S + boot_s <= port.time() - start_s <= PATIENCE_S + boot_s + 1.1
    assert port.timeout_s == 2.0


def test_a_port_that_is_gone_is_opened_again():
    """An adapter that comes back is a new port."""
    port = ScriptedPort(VirtualTime(), 0.0, is_open=False)
    opened = port.open

    def open_(*, boot=True):
        if len(port.calls) < 3:
            port.calls.append("can't open")
            raise LostError("can't be opened")
        opened(boot=boot)

    port.open = open_
    carry_out(port)
    assert port.calls == [*["can't open"] * 3, "open, boot False", "send", "confirm"]
