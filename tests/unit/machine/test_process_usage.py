"""What a process says that it took is what it took."""

import mmap

from hilctl.machine.process_usage import ProcessUsage

PAGES = 64


def test_pages_and_time_are_counted():
    """Touching a page for the first time is a fault, and keeps it resident."""
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


def test_the_difference_is_of_all_that_adds_up():
    before, after = ProcessUsage(9, 10, 20, 30, 40), ProcessUsage(7, 11, 22, 33, 44)
    assert after.since(before) == ProcessUsage(7, 1, 2, 3, 4)
