"""Faults of an emulator: words that mean nothing are refused at once."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.options import KINDS, FaultPlan, WireFault, parse_fault


@pytest.mark.parametrize("kind", KINDS)
def test_texts_are_read(kind):
    assert parse_fault(f"{kind}@12") == WireFault(kind, at_count=12)
    assert parse_fault(f"{kind}@2.5s") == WireFault(kind, at_s=2.5)
    if kind in {"delay", "late"}:
        assert parse_fault(f"{kind}:0.3@1") == WireFault(kind, at_count=1, delay_s=0.3)


@pytest.mark.parametrize(("text", "words"), [
    ("silence", "KIND@COUNT"),
    ("noise@1", "must be one of silence"),
    ("reset:2@1", "take a time before the @"),
    ("reset@0", "whole number from 1"),
    ("reset@1.5", "whole number from 1"),
    ("", "KIND@COUNT"),
    ("DAC1:unplug@1", "faults of all outputs"),
    (":silence@1", "KIND@COUNT"),
])  # fmt: skip
def test_nonsense_is_refused(text, words):
    with pytest.raises(InputError, match=words):
        parse_fault(text)


def test_a_fault_may_be_of_an_output():
    assert parse_fault("DAC1:silence@2") == WireFault("silence", at_count=2, output="DAC1")
    delay = WireFault("delay", at_s=3.0, delay_s=0.2, output="y")
    assert parse_fault("y:delay:0.2@3s") == delay


def test_a_fault_of_an_output_lasts():
    """It concerns the requests that write the output, from its time on."""
    plan = FaultPlan([parse_fault("y:silence@2"), parse_fault("cut@3")])
    written = [{"y"}, {"x"}, {"x", "y"}, {"y"}, set()]
    seen = [plan.next(0.0, lambda names=names: names) for names in written]
    assert [fault.kind if fault else None for fault in seen] == [
        None, None, "silence", "silence", "cut",
    ]  # fmt: skip


def test_each_happens_once_when_it_is_due():
    plan = FaultPlan([parse_fault("cut@2"), parse_fault("reset@1s")])
    seen = [plan.next(elapsed_s, set) for elapsed_s in (0.0, 0.5, 0.9, 1.0, 2.0)]
    assert [fault.kind if fault else None for fault in seen] == [
        None, "cut", None, "reset", None,
    ]  # fmt: skip
