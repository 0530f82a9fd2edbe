"""Word to systemd."""

import socket

from hilctl.run.systemd import Notifier
from tests.fakes import SteppingClock


def test_lines_reach_the_service_manager(tmp_path):
    """What is said comes as one datagram."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).say("READY=1", "STATUS=fine")
        assert manager.recv(100) == b"READY=1\nSTATUS=fine"


def test_watchdog_is_fed_three_times_in_its_interval(tmp_path):
    """However often it is called, it says so at a third of the interval."""
    clock = SteppingClock()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        notifier = Notifier(
            {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "3000000"}, clock
        )
        fed = []
        for step in range(31):
            clock.now = 0.1 * step
            notifier.alive()
            try:
                fed.append((step, manager.recv(100)))
            except BlockingIOError:
                continue
    assert fed == [(step, b"WATCHDOG=1") for step in (0, 10, 20, 30)]


def test_nobody_listening_is_no_matter(tmp_path):
    """A run outside a service, or one whose manager is gone, goes on."""
    Notifier({}).say("READY=1")
    Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "x"}).say("READY=1")
