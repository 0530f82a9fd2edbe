"""Parts of all profiles: watchdog counts, ranges, and what is said to be unverified."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import Watchdog

WATCHDOG = Watchdog(
    unit_s=0.1, min_s=0.1, max_s=25.5, kick="any", on_trip="safe", refuses_while_tripped=False
)


@pytest.mark.parametrize(("timeout_s", "counts"), [(0.1, 1), (0.3, 3), (25.5, 255)])
def test_a_timeout_is_a_whole_number_of_counts(timeout_s, counts):
    """0.3 is three times 0.1, whatever binary numbers make of it."""
    assert WATCHDOG.counts(timeout_s) == counts


@pytest.mark.parametrize(("timeout_s", "said"), [
    (0.05, "0.1 to 25.5"),
    (26.0, "0.1 to 25.5"),
    (float("nan"), "0.1 to"),
    (0.25, "multiple of 0.1"),
])  # fmt: skip
def test_other_timeouts_are_refused_not_rounded(timeout_s, said):
    """A watchdog that trips later than was asked is no watchdog."""
    with pytest.raises(InputError, match=said):
        WATCHDOG.counts(timeout_s)


def test_provenance_goes_with_a_recording():
    found = load_profile("labjack_t7").provenance("reader_")
    assert found["reader_vendor"] == "LabJack"
    assert found["reader_verified"] == "partly"
    assert "Datasheet" in found["reader_source"]


def test_lines_are_set_as_their_profiles_say():
    settings = load_profile("tdk_lambda_gen").link
    assert (settings.baud, settings.parity, settings.silence_s) == (9600, "N", 0.005)
    assert load_profile("adam_4024").link.silence_s == pytest.approx(35 / 9600)
    assert load_profile("cobs_board").link.dtr is True
