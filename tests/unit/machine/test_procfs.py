"""What is read of a machine's files, and what is said where they are absent or strange."""

import mmap

import pytest

from hilctl.machine.procfs import Machine, ProcessUsage

LIMITS = """\
Limit                     Soft Limit           Hard Limit           Units
Max locked memory         8388608              unlimited            bytes
Max realtime priority     unlimited            98
"""


@pytest.fixture
def written(tmp_path):
    """Return a function that makes a machine of these files."""

    def make(**files):
        for name, text in files.items():
            path = tmp_path / "proc" / name.replace("__", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return Machine(tmp_path)

    return make


def test_missing_files_raise_nothing(written):
    machine = written()
    assert machine.text("/proc/version") is None
    assert machine.number("/proc/version") is None
    assert machine.status("CapEff") == ""
    assert not machine.capable(14)
    assert machine.limit("Max locked memory") == 0
    assert machine.glob("/dev/ttyUSB*") == []
    with pytest.raises(FileNotFoundError):
        machine.read("/proc/version")


@pytest.mark.parametrize(("text", "number"), [("12\n", 12), ("-1", -1), ("max", None), ("", None)])
def test_a_number_is_a_whole_file(written, text, number):
    assert written(n=text).number("/proc/n") == number


def test_capabilities_are_bits_of_this_process(written):
    machine = written(self__status="Name:\thilctl\nCapEff:\t0000000000004000\n")
    assert machine.status("Name") == "hilctl"
    assert machine.capable(14)
    assert not machine.capable(23)


def test_limits_are_the_soft_limits(written):
    machine = written(self__limits=LIMITS)
    assert machine.limit("Max locked memory") == 8388608
    assert machine.limit("Max realtime priority") is None


def test_patterns_give_absolute_paths_in_order(written):
    machine = written(cpu__1="", cpu__0="")
    assert machine.glob("/proc/cpu/*") == ["/proc/cpu/0", "/proc/cpu/1"]


PAGES = 64


def test_pages_and_time_are_counted():
    before = ProcessUsage.now()
    with mmap.mmap(-1, PAGES * mmap.PAGESIZE) as memory:
        memory.madvise(mmap.MADV_NOHUGEPAGE)
        for page in range(PAGES):
            memory[page * mmap.PAGESIZE] = 1
        after = ProcessUsage.now()
    taken = after.since(before)
    assert taken.minor_faults >= PAGES
    assert taken.cpu_ns > 0
    assert taken.resident_bytes == after.resident_bytes
    assert after.resident_bytes - before.resident_bytes >= PAGES * mmap.PAGESIZE // 2


def test_usage_is_a_difference_of_counters():
    before, after = ProcessUsage(9, 10, 20, 30, 40), ProcessUsage(7, 11, 22, 33, 44)
    assert after.since(before) == ProcessUsage(7, 1, 2, 3, 4)
