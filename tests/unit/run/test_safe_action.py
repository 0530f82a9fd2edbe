"""Making a device safe beside whatever else there is to do."""

import threading
from types import SimpleNamespace

import pytest

from hilctl.base.errors import DeviceError
from hilctl.run.safe_action import SafeAction
from hilctl.run.shared_page import MadeSafe


def test_nobody_is_kept_waiting():
    go_on, asked = threading.Event(), []

    def make_safe(value):
        go_on.wait(30.0)
        asked.append(value)

    device = SimpleNamespace(make_safe=make_safe)
    action = SafeAction(device, 0.5, hung=True, prepare=lambda: asked.append("prepared"))
    assert action.result() is None
    assert action._thread.daemon  # nor is the process that ends meanwhile
    go_on.set()
    assert action.result(30.0) == MadeSafe(hung=True, error="")
    assert asked == ["prepared", 0.5]


@pytest.mark.parametrize(
    ("error", "words"),
    [(DeviceError("no answer"), "no answer"), (KeyError("x"), "KeyError: 'x'")],
)
def test_no_error_passes_for_a_confirmed_output(error, words):
    def make_safe(value):
        raise error

    action = SafeAction(SimpleNamespace(make_safe=make_safe), 0.0, hung=False)
    assert action.result(30.0).error == words
    assert not action.result().confirmed


def test_a_look_at_what_came_of_it_does_not_wait():
    waited_s = []
    action = SafeAction(SimpleNamespace(make_safe=lambda value: None), 0.0, hung=False)
    action.result(30.0)
    action._thread = SimpleNamespace(join=waited_s.append)
    assert action.result().confirmed
    assert waited_s == [0.0]
