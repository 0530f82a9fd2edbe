"""One attempt on a serial line: sent first, confirmed by an answer that cannot be an older one."""

import pytest

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.transport.links import LostError, NoAnswerError
from hilctl_drivers.transport.safe_exchange import SafeExchange
from tests.fakes import VirtualTime

TIMEOUT_S = 0.1


class LineOfText:
    """A line to a device that answers each message with the same word, in order and in time.

    Attributes:
        busy_until_s: Until then the device answers nothing; what came meanwhile is answered then.
        forgets: Whether what came meanwhile is lost, except for its first message.
    """

    def __init__(self, *, is_open=True, is_in_step=True, forgets=False):
        self.time = VirtualTime()
        self.is_open, self.is_in_step, self.timeout_s = is_open, is_in_step, TIMEOUT_S
        self.calls = []
        self.value, self.busy_until_s, self.forgets = 4.0, 0.0, forgets
        self._waiting, self._answers_s = [], []

    def command(self, value):
        """Send a message whose answer is not awaited."""
        if self.time() < self.busy_until_s:
            if not (self.forgets and self._waiting):
                self._waiting.append(value)
                self._answers_s.append(self.busy_until_s + 0.001 * len(self._waiting))
        else:
            self.value = value
            self._answers_s.append(self.time() + 0.001)

    def pass_until(self, time_s):
        self.time.sleep(max(0.0, time_s - self.time()))
        if self.time() >= self.busy_until_s and self._waiting:
            self.value = self._waiting[-1]
            self._waiting.clear()

    def open(self, *, boot=True):
        self.calls.append(f"open, boot {boot}")
        self.is_open, self.is_in_step = True, False

    def doubt(self):
        self.is_in_step = False

    def await_silence(self, quiet_s, answer_s=0.0):
        first_s = min(self._answers_s, default=float("inf"))
        self.pass_until(min(self.time() + answer_s, max(self.time(), first_s)))
        silent_from_s = self.time()
        for answer_s in sorted(self._answers_s):
            if answer_s > silent_from_s + quiet_s:
                break
            silent_from_s = max(silent_from_s, answer_s)
            self._answers_s.remove(answer_s)
        self.pass_until(silent_from_s + quiet_s)
        self.is_in_step = True

    def attempt(self, exchange, value):
        def send():
            self.calls.append("send")
            self.command(value)

        def confirm():
            self.calls.append("confirm")
            self.command(value)
            answer_s = min(self._answers_s, default=float("inf"))
            if answer_s > self.time() + self.timeout_s:
                self.pass_until(self.time() + self.timeout_s)
                raise NoAnswerError("no answer")
            self._answers_s.remove(answer_s)
            self.pass_until(answer_s)

        exchange.attempt(self, send, confirm)


def test_a_line_in_step_needs_one_exchange():
    line = LineOfText()
    line.attempt(SafeExchange(), 0.0)
    assert line.calls == ["confirm"]


@pytest.mark.parametrize(("is_open", "before"), [(True, []), (False, ["open, boot False"])])
def test_the_value_is_sent_before_anything_is_awaited(is_open, before):
    line = LineOfText(is_open=is_open, is_in_step=False)
    line.attempt(SafeExchange(), 0.0)
    assert line.calls == [*before, "send", "confirm", "confirm"]


def test_an_attempt_repeats_nothing():
    line = LineOfText(is_in_step=False)
    line.busy_until_s = 1e9
    start_s = line.time()
    for count in range(1, 9):
        with pytest.raises(NoAnswerError):
            line.attempt(SafeExchange(), 0.0)
        assert line.calls == ["send", "confirm"] * count
    assert line.time() - start_s <= 8 * 3.0 * TIMEOUT_S


@pytest.mark.parametrize("forgets", [False, True])
@pytest.mark.parametrize("late_s", [0.11, 0.15, 0.2, 0.25, 0.3, 0.5, 1.0, 2.37, 10.0])
@pytest.mark.parametrize("shift_s", [0.0, 0.01, 0.02, 0.04, 0.06])
def test_the_answer_to_an_older_command_confirms_nothing(late_s, shift_s, forgets):
    line, exchange = LineOfText(forgets=forgets), SafeExchange()
    line.busy_until_s = line.time() + late_s + shift_s
    line.command(4.5)
    line.pass_until(line.time() + TIMEOUT_S)
    line.doubt()
    for _ in range(1000):
        try:
            line.attempt(exchange, 0.0)
        except DeviceError:
            continue
        break
    assert line.time() >= line.busy_until_s
    assert line.value == 0.0


def test_the_silence_grows_with_each_failure_up_to_the_time_out():
    line, exchange, waited_s = LineOfText(), SafeExchange(), []
    line.timeout_s = 1.0
    line.await_silence = lambda quiet_s, answer_s=0.0: waited_s.append(quiet_s)

    def fail():
        raise NoAnswerError("no answer")

    for _ in range(6):
        with pytest.raises(NoAnswerError):
            exchange.attempt(line, lambda: None, fail)
    assert waited_s == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.0])
    line.doubt()
    exchange.attempt(line, lambda: None, lambda: None)
    line.doubt()
    exchange.attempt(line, lambda: None, lambda: None)
    assert waited_s[-2:] == pytest.approx([0.05, 0.05])


def test_what_cannot_be_confirmed_is_no_failure_of_the_line():
    line = LineOfText()

    def confirm():
        raise UnconfirmedError("sent")

    with pytest.raises(UnconfirmedError):
        SafeExchange().attempt(line, lambda: None, confirm)
    assert line.is_in_step


def test_a_port_that_cannot_be_opened_ends_the_attempt():
    line = LineOfText(is_open=False)

    def refuse(*, boot):
        raise LostError("cannot be opened")

    line.open = refuse
    with pytest.raises(LostError):
        line.attempt(SafeExchange(), 0.0)
    assert line.calls == []
