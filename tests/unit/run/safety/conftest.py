"""A reserve that is never held: each action has its own thread, and tests keep their input."""

import pytest

from hilctl.machine.reserve import Reserve
from hilctl.run.safety import guardian


@pytest.fixture(autouse=True)
def _no_reserve(monkeypatch):
    made = Reserve()
    monkeypatch.setattr(made, "hold", lambda lines: None)
    monkeypatch.setattr(guardian, "RESERVE", made)
