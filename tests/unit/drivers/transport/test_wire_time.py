"""What exchanges add up to, and the rates that they leave."""

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport.wire_time import RateLimit, WireTime, check_feeds


class TestSum:
    def test_then(self):
        first = WireTime("A", 1.0, 2.0, 1, 3.0, 4.0, samples=10)
        both = first.then(WireTime("B", 0.1, 0.2, 2, 0.3, 0.4, settle_s=5.0))
        assert both.what == "A, then B"
        assert both.answered_s == pytest.approx(11.0)
        assert both.total_s == pytest.approx(16.0)
        assert both.highest_rate_hz == pytest.approx(10 / 16)
        assert first.then(None) is first
        assert (both.gaps, both.samples) == (3, 10)


class TestLimits:
    SLOW = WireTime("A", 0.0, 0.0, 0, 0.0, 0.1)

    def test_the_slower_of_wire_and_device_counts(self):
        wire = RateLimit.of(self.SLOW, 50.0, "its profile")
        assert (wire.highest_hz, wire.note) == (pytest.approx(10.0), str(self.SLOW))
        device = RateLimit.of(self.SLOW, 5.0, "its profile")
        assert device.highest_hz == 5.0
        assert all(text in device.note for text in ("its profile", str(self.SLOW), "10 Hz"))

    @pytest.mark.parametrize(("limit", "rate_hz", "words"), [
        (RateLimit(10.0, "why"), 10.1, r"in \(0, 10\] Hz \(why\), got 10.1"),
        (RateLimit(10.0, ""), 0.0, r"in \(0, 10\] Hz, got 0"),
        (RateLimit(10.0, ""), float("nan"), "got nan"),
        (RateLimit(10.0, "", 2.0), 1.9, r"in \[2, 10\] Hz, got 1.9"),
    ])  # fmt: skip
    def test_others_are_refused(self, limit, rate_hz, words):
        with pytest.raises(DeviceError, match=words):
            limit.check(rate_hz)
        limit.check(limit.highest_hz)
        limit.check(limit.lowest_hz or 1e-9)


def test_watchdogs_are_fed_three_times_in_their_timeout():
    assert check_feeds(None, 1.0) == 0
    assert check_feeds(1.0, 30.0) == 10
    assert check_feeds(1.0, 3.0) == 1
    with pytest.raises(DeviceError, match="watchdog's timeout, 1"):
        check_feeds(1.0, 2.9)
