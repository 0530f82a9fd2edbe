"""The limiter as the loop uses it."""

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.loop.limiter import CommandLimits, Limiter

LIMITS = CommandLimits(low=-2.0, high=3.0, slew_per_s=100.0, safe=0.5, ramp_per_s=50.0)
DT_S = 1e-3
SWEEP = [-np.inf, -1e9, -3.0, -2.0, -1.0, 0.0, 0.5, 1.0, 3.0, 3.5, 1e9, np.inf, np.nan]


def limited(limiter, wanted):
    wanted = np.asarray(wanted, dtype=np.float64)
    command, flags = np.empty_like(wanted), np.zeros(wanted.size, dtype=np.uint32)
    limiter.limit(wanted, command, flags)
    return command, flags


def test_starts_at_the_safe_value():
    command, flags = limited(Limiter(LIMITS, DT_S), [3.0])
    assert command.tolist() == [0.6]
    assert flags.tolist() == [Flag.SLEW_LIMITED]


@pytest.mark.parametrize("before", SWEEP)
@pytest.mark.parametrize("after", SWEEP)
def test_no_pair_of_requests_exceeds_the_limits(before, after):
    limiter = Limiter(LIMITS, DT_S)
    last = limiter.last
    for wish in (before, after) * 40:
        command, flags = limited(limiter, [wish])
        assert LIMITS.low <= command[0] <= LIMITS.high
        assert abs(command[0] - last) <= LIMITS.slew_per_s * DT_S * (1 + 1e-12)
        assert bool(flags[0] & Flag.INVALID) == (not np.isfinite(wish))
        assert bool(flags[0] & Flag.RANGE_LIMITED) == (
            np.isfinite(wish) and not LIMITS.low <= wish <= LIMITS.high
        )
        assert limiter.last == command[0]
        last = command[0]


def test_ramp_ends_exactly_at_the_safe_value():
    limiter = Limiter(LIMITS, DT_S)
    limited(limiter, np.full(100, 3.0))
    way, done = [], False
    while not done:
        command, flags = np.empty(7), np.zeros(7, dtype=np.uint32)
        done = limiter.ramp(command, flags)
        assert (flags == Flag.RAMP).all()
        way += command.tolist()
    steps = np.diff([3.0, *way])
    assert way[-1] == LIMITS.safe
    assert (steps <= 0.0).all()
    assert np.abs(steps).max() == pytest.approx(LIMITS.ramp_per_s * DT_S)
    assert len(way) == 56  # 2.5 / 0.05 = 50 samples, in blocks of 7


class TestFromElsewhere:
    @pytest.mark.parametrize("start", [-50.0, -2.001, -1.9, 0.61, 2.9, 3.1, 40.0])
    def test_ramp_has_the_promised_length(self, start):
        limiter = Limiter(LIMITS, DT_S)
        limiter.last = start
        samples = limiter.ramp_samples
        command, flags = np.empty(samples), np.zeros(samples, dtype=np.uint32)
        limiter.ramp(command, flags)
        assert limiter.last == pytest.approx(0.5, abs=1e-9)
        assert limiter.at_rest
        assert np.abs(np.diff([start, *command])).max() <= LIMITS.ramp_per_s * DT_S * (1 + 1e-9)
        assert (np.diff(np.abs([start - 0.5, *(command - 0.5)])) < 0.0).all()
        assert samples == np.ceil(round(abs(start - 0.5) / 0.05, 6))

    @pytest.mark.parametrize("wish", [np.nan, -1e9, 0.0, 1e9])
    @pytest.mark.parametrize("start", [-9.0, 9.0])
    def test_no_request_jumps_from_outside_the_limits(self, start, wish):
        limiter = Limiter(LIMITS, DT_S)
        limiter.last = start
        command, _ = limited(limiter, np.full(3, wish))
        assert np.abs(np.diff([start, *command])) == pytest.approx(0.1)
        assert (np.abs(command) < 9.0).all()


class TestLateRamp:
    @pytest.mark.parametrize(
        ("skipped", "step"), [(0, 0.05), (1, 0.1), (9, 0.5), (12, 0.625), (10**9, 0.625)]
    )
    def test_first_step_is_as_many_times_larger(self, skipped, step):
        """Up to a quarter of the way from the far limit, 2.5 A."""
        limiter = Limiter(LIMITS, DT_S)
        limiter.last = 3.0
        command, flags = np.empty(3), np.zeros(3, dtype=np.uint32)
        limiter.ramp(command, flags, skipped)
        assert (3.0 - command).tolist() == pytest.approx([step, step + 0.05, step + 0.1])
        assert (flags == Flag.RAMP).all()

    def test_a_slow_ramp_still_ends_at_the_safe_value(self):
        limiter = Limiter(LIMITS, DT_S)
        limiter.last, steps = -2.0, 0
        while not limiter.ramp(np.empty(1), np.zeros(1, dtype=np.uint32), 400):
            steps += 1
        assert (limiter.last, steps) == (0.5, 3)


def test_a_block_of_no_samples_changes_nothing():
    limiter = Limiter(LIMITS, DT_S)
    limited(limiter, [0.55])
    limited(limiter, [])
    assert limiter.last == 0.55
    assert not limiter.ramp(np.empty(0), np.zeros(0, dtype=np.uint32))


FIELDS = {"low": -2.0, "high": 3.0, "slew_per_s": 100.0, "safe": 0.5, "ramp_per_s": 50.0}


@pytest.mark.parametrize(("rule", "key", "values"), [
    ("finite and rising", "low", [4.0, 3.0, -np.inf, np.nan]),
    ("finite and rising", "high", [np.inf]),
    ("safe value", "safe", [3.1, -2.1, np.nan]),
    ("slew limit", "ramp_per_s", [0.0, 101.0]),
    ("slew limit", "slew_per_s", [np.inf]),
])  # fmt: skip
def test_invalid_limits_are_refused(rule, key, values):
    """The error names the values that break the rule."""
    for value in values:
        with pytest.raises(InputError, match=rule) as caught:
            CommandLimits(**{**FIELDS, key: value})
        assert str(value) in str(caught.value)


@pytest.mark.parametrize(
    "change", [{"safe": -2.0}, {"safe": 3.0}, {"ramp_per_s": 100.0}, {"ramp_per_s": 1e-3}]
)
def test_edges_of_limits_are_allowed(change):
    limits = CommandLimits(**{**FIELDS, **change})
    assert {name: getattr(limits, name) for name in FIELDS} == {**FIELDS, **change}
