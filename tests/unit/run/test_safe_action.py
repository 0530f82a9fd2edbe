"""A safe action runs beside whatever else there is to do."""

import threading
from types import SimpleNamespace

import pytest

from hilctl.base.errors import DeviceError
from hilctl.loop.safe_output import SafeGoal
from hilctl.run.ring import SampleRing
from hilctl.run.safe_action import SafeAction
from hilctl.run.shared_page import SafeActionResult

GOAL = SafeGoal(0.5, 1.0, None, pending=False)


@pytest.fixture
def act(tmp_path):
    """Return a function that starts a safe action."""
    page = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1).page

    def start(make_safe, **changes):
        device = SimpleNamespace(make_safe=make_safe)
        action = SafeAction(page, device, GOAL, **{"hung": False, **changes})
        action.page = page
        return action

    return start


def test_the_caller_is_not_blocked(act):
    go_on, asked = threading.Event(), []

    def make_safe(value):
        go_on.wait(30.0)
        asked.append(value)

    action = act(make_safe, hung=True, prepare=lambda: asked.append("prepared"))
    assert not action.result().final
    assert action._thread.daemon  # nor does it keep the process from ending
    go_on.set()
    assert action.result(30.0) == SafeActionResult(hung=True, output="confirmed")
    assert asked == ["prepared", 0.5]
    assert action.page.last_safe_write() == 0.5


def test_an_action_goes_on_until_it_is_ended(act):
    asked = threading.Event()

    def make_safe(value):
        asked.set()
        raise DeviceError("no answer")

    action = act(make_safe)
    assert asked.wait(30.0)
    assert action.end(30.0)
    assert (action.result().output, action.result().error) == ("unknown", "no answer")
    assert not action.result().final


@pytest.mark.parametrize("error", [KeyError("x"), MemoryError()])
def test_a_failure_of_this_process_is_no_answer_of_the_device(act, error):
    def make_safe(value):
        raise error

    action = act(make_safe)
    action.result(30.0)
    assert type(error).__name__ in action.failed
    assert not action.result().final
