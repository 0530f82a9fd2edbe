"""What a log-out does to a run, by files of systemd."""

import pwd
from types import SimpleNamespace

import pytest

from hilctl.machine.logind import log_out

SYSTEMD = {
    "/run/systemd/system/x": "",
    "/proc/self/status": "Name:\thilctl\nUid:\t1000\t1000\t1000\t1000",
}
CONF = "/etc/systemd/logind.conf"


@pytest.fixture(autouse=True)
def login(monkeypatch):
    monkeypatch.setattr(pwd, "getpwuid", lambda _: SimpleNamespace(pw_name="lab"))


@pytest.mark.parametrize(
    ("files", "level"),
    [
        ({}, "warn"),
        ({CONF: "[Login]\n#RemoveIPC=no\n"}, "warn"),
        ({CONF: "[Login]\nRemoveIPC=no"}, "ok"),
        ({CONF: "[Login]\n RemoveIPC = false \nKillUserProcesses=no"}, "ok"),
        ({CONF: "RemoveIPC=no", f"{CONF}.d/z.conf": "RemoveIPC=yes"}, "warn"),
        ({"/usr/lib/systemd/logind.conf.d/a.conf": "RemoveIPC=no"}, "ok"),
        ({"/usr/lib/systemd/logind.conf.d/a.conf": "RemoveIPC=no", f"{CONF}.d/a.conf": ""}, "warn"),
        ({"/var/lib/systemd/linger/lab": ""}, "ok"),
        ({"/var/lib/systemd/linger/other": ""}, "warn"),
        ({CONF: "RemoveIPC=no\nKillUserProcesses=yes"}, "warn"),
        ({"/proc/self/status": "Uid:\t0\t0\t0\t0"}, "ok"),
        ({"/proc/self/status": "Uid:\t998\t998\t998\t998"}, "ok"),
        ({"/run/systemd/system/x": None}, "ok"),
    ],
)
def test_what_logind_is_set_to(make_machine, files, level):
    """The newest of its files counts; a warning names the remedy."""
    found = log_out(make_machine({**SYSTEMD, **files}))
    assert found.level == level
    assert bool(found.remedy) == (level == "warn")
