"""What the computer itself does to a loop: processor, firmware, clock and serial adapters."""

from pathlib import Path

import pytest

from hilctl.machine import findings, hardware

CPU = "/sys/devices/system/cpu"
CLOCK = "/sys/devices/system/clocksource/clocksource0"


def check(function, machine, *arguments):
    """Return level, text and remedy of one check."""
    found = function(machine, *arguments)
    return found.level, found.text, found.remedy


def test_idle_states(make_machine):
    """Without permission for the file, idle states can't be kept off; without the file, none is."""
    closed = make_machine(closed=("/dev/cpu_dma_latency",))
    assert check(findings.dma_latency, closed)[0] == "warn"
    assert check(findings.dma_latency, make_machine())[0] == "ok"


def test_no_file_for_idle_states(tmp_path):
    """Where the kernel has no such file, there is nothing to hold."""
    from hilctl.machine.procfs import Machine

    found = check(findings.dma_latency, Machine(tmp_path))
    assert (found[0], "manages none" in found[1]) == ("ok", True)


@pytest.mark.parametrize(
    ("governors", "level"),
    [
        (["performance", "performance"], "ok"),
        (["performance", "powersave"], "warn"),
        (["schedutil", "schedutil"], "warn"),
        ([None, None], "ok"),
    ],
)
def test_governor(make_machine, governors, level):
    """Every CPU has to stay at full speed, unless the kernel has no say in it."""
    files = {
        f"{CPU}/cpu{n}/cpufreq/scaling_governor": g for n, g in zip((0, 3), governors, strict=True)
    }
    assert check(hardware.governor, make_machine(files))[0] == level


def test_smt(make_machine):
    """Threads that share a core are told."""
    assert check(hardware.hyperthreads, make_machine())[0] == "ok"
    assert check(hardware.hyperthreads, make_machine({f"{CPU}/smt/active": "1"}))[0] == "warn"


def test_virtual_machine(make_machine):
    """A virtual machine is known by its CPU, and named after its product."""
    files = {"/proc/cpuinfo": "flags : hypervisor", "/sys/class/dmi/id/product_name": "KVM"}
    level, said, _ = check(hardware.virtual_machine, make_machine(files))
    assert (level, "KVM" in said) == ("warn", True)


@pytest.mark.parametrize(
    ("source", "level", "remedy"), [("tsc", "ok", ""), ("hpet", "warn", "boot with tsc=reliable")]
)
def test_clock_source(make_machine, source, level, remedy):
    """A clock that is slow to read is told, with the quick one where there is one."""
    found = check(hardware.clock_source, make_machine({f"{CLOCK}/current_clocksource": source}))
    assert (found[0], found[2]) == (level, remedy)


def test_ftdi_latency(make_machine):
    """An adapter at its default of 16 ms is bad, and named."""
    slow = {"/sys/bus/usb-serial/devices/ttyUSB1/latency_timer": "16"}
    level, said, remedy = check(hardware.latency_timers, make_machine(slow))
    assert (level, said) == ("bad", "ttyUSB1 16 ms")
    assert "latency_timer" in remedy


@pytest.mark.parametrize(
    ("active", "level"),
    [((), "ok"), (("ModemManager",), "warn"), (("brltty", "ModemManager"), "warn")],
)
def test_serial_daemons(make_machine, active, level):
    """They open ports by themselves, and take bytes from a run that has one."""
    files = {f"/proc/{number}/comm": name for number, name in enumerate(("sh", *active), start=1)}
    found, said, remedy = check(hardware.serial_daemons, make_machine(files))
    assert found == level
    for name in active:
        assert name in said
        assert name in remedy


def test_serial_ports(make_machine):
    """A port that this user may not open is bad, and its group named."""
    level, said, remedy = check(hardware.serial_ports, make_machine(closed=("/dev/ttyUSB0",)))
    assert (level, "/dev/ttyUSB0" in said) == ("bad", True)
    assert "usermod" in remedy


@pytest.mark.parametrize(("free", "level"), [(1 << 20, "bad"), (1 << 40, "ok")])
def test_disk_space(make_machine, tmp_path, free, level):
    """Little room for recordings is bad; the folder need not exist yet."""
    folder = tmp_path / "not" / "yet"
    assert check(hardware.disk_space, make_machine(free=free), folder)[0] == level


def test_disk_space_without_a_working_folder(make_machine, tmp_path, monkeypatch):
    """It was deleted: relative names lead nowhere, absolute ones still do."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    level, said, remedy = check(hardware.disk_space, make_machine(), Path("recordings"))
    assert (level, remedy) == ("bad", "change to another one")
    assert said == "recordings: the working folder has been deleted"
    assert check(hardware.disk_space, make_machine(free=1 << 40), tmp_path)[0] == "ok"
