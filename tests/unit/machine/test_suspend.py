"""Suspend: detected by two clocks, inhibited by a process that holds logind's lock."""

import pytest

from hilctl.machine.suspend import SuspendDetector, SuspendInhibitor

S = 1_000_000_000


@pytest.mark.parametrize(("boot_ns", "monotonic_ns", "suspended_s"), [
    (7 * S, 2 * S, 0.0),
    (8 * S, 3 * S, 0.0),  # both advance, also of a process that was stopped
    (8 * S, 3 * S + S // 2, 0.0),  # a pause between the two readings
    (12 * S, 3 * S, 4.0),
])  # fmt: skip
def test_only_a_suspend_moves_the_clocks_apart(boot_ns, monotonic_ns, suspended_s):
    now = [7 * S, 2 * S]
    detector = SuspendDetector(lambda: now[0], lambda: now[1])
    now[:] = boot_ns, monotonic_ns
    assert detector.suspended_s() == suspended_s


def test_the_real_clocks_agree():
    assert SuspendDetector().suspended_s() == 0.0


def inhibitor(folder, *command, needed=True):
    return SuspendInhibitor(needed=needed, command=command, systemd=str(folder))


def test_the_lock_is_held_until_closed(tmp_path):
    with inhibitor(tmp_path, "sh", "-c", f"cat; echo > {tmp_path}/released") as held:
        assert held.refusal() == ""
        assert not (tmp_path / "released").exists()
    assert (tmp_path / "released").exists()


def test_a_refusal_is_told(tmp_path):
    with inhibitor(tmp_path, "sh", "-c", "echo denied >&2; exit 1") as refused:
        refused._process.wait()
        assert refused.refusal() == "denied"


@pytest.mark.parametrize("folder", ["", "missing"])
def test_no_logind_or_no_need_is_no_refusal(tmp_path, folder):
    with inhibitor(tmp_path / folder, "no such program", needed=bool(folder)) as absent:
        assert absent.refusal() == ""
    with inhibitor(tmp_path, "no such program") as absent:
        assert absent.refusal() == ""
