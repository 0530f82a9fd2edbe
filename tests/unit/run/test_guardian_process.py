"""How long a loop may be silent before its output is made safe; processes: see tests/faults."""

from types import SimpleNamespace

import pytest

from hilctl.run.guardian_process import safe_priority, silence_limits


def checked(*, hang_s=None, simulated=False):
    info = SimpleNamespace(simulated=simulated)
    config = SimpleNamespace(
        timing=SimpleNamespace(hang_s=hang_s, max_late_s=1.0),
        tick_s=0.01,
        realtime=SimpleNamespace(priority=80),
    )
    loaded = SimpleNamespace(config=config, device=SimpleNamespace(info=info))
    return SimpleNamespace(loaded=loaded)


@pytest.mark.parametrize(
    ("given", "simulated", "real_time_s", "ordinary_s", "stopped_s"),
    [
        (None, False, 0.1, 1.02, 0.04),
        (0.5, False, 0.52, 0.52, 0.04),
        (None, True, 1.52, 1.52, 1.52),
    ],
)
def test_how_long_a_loop_may_be_silent(given, simulated, real_time_s, ordinary_s, stopped_s):
    """Two periods, and what the experiment says; simulated coils can wait."""
    limits = silence_limits(checked(hang_s=given, simulated=simulated))
    assert (limits.real_time_s, limits.exchange_s) == (pytest.approx(real_time_s), 1.0)
    assert limits.ordinary_s == pytest.approx(ordinary_s)
    assert limits.stopped_s == pytest.approx(stopped_s)


def test_who_makes_it_safe_comes_before_the_loop():
    assert safe_priority(checked()) == 81
