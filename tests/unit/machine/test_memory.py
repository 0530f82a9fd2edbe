"""What is kept in RAM, and what is given back."""

import json
import subprocess
import sys

import pytest

from hilctl.machine import memory
from hilctl.machine.memory import Mapping, ProcessMemory, mappings

SMAPS = """\
55e0-75e0 r-xp 00000000 08:01 11    /usr/lib/llvmlite/binding/libllvmlite.so
Size:                  8 kB
Rss:                   4 kB
Anonymous:             0 kB
THPeligible:           0
VmFlags: rd ex mr
7f00-8f00 rw-p 00000000 00:00 0
Size:                  4 kB
Rss:                   4 kB
Anonymous:             4 kB
VmFlags: rd wr
8f00-9f00 rw-s 00000000 00:00 7     /dev/shm/a folder/ring (deleted)
Rss:                   0 kB
Anonymous:             0 kB
"""


def mapping(path="", size=4096, access="rw-p"):
    return Mapping(0, size, access, path, 0, 0)


def test_the_lines_of_smaps_are_read():
    found = list(mappings(SMAPS.splitlines()))
    assert found == [
        Mapping(0x55E0, 0x2000, "r-xp", "/usr/lib/llvmlite/binding/libllvmlite.so", 4096, 0),
        Mapping(0x7F00, 0x1000, "rw-p", "", 4096, 4096),
        Mapping(0x8F00, 0x1000, "rw-s", "/dev/shm/a folder/ring (deleted)", 0, 0),
    ]
    assert [each.in_a_tick for each in found] == [False, True, True]
    assert [each.of_file for each in found] == [True, False, True]


@pytest.mark.parametrize(
    ("given", "whole"),
    [
        (mapping("/lib/libc.so.6", 64 << 20), True),
        (mapping("[heap]", 64 << 20), False),
        (mapping("/site-packages/numpy/random/_generator.so", 64 << 20), False),
        (mapping("", (8 << 20) - 1), True),
        (mapping("", 8 << 20), False),
        (mapping("/lib/libc.so.6", access="---p"), False),
        (mapping("[vvar]", access="r--p"), False),
    ],
)
def test_what_a_thread_or_a_library_only_reserves_is_not_filled(given, whole):
    """Else every thread's stack and BLAS' buffers would take 8 and 32 MB of RAM.

    Of the heap, what has been freed would come back.
    """
    assert given.whole is whole


def test_no_page_that_differs_from_its_file_is_given_back(monkeypatch):
    """The loader's changes are nowhere else: without them the next call of the library crashes."""
    library = "/usr/lib/libllvmlite.so"
    asked = []
    memory_of_test = ProcessMemory()
    monkeypatch.setattr(
        memory,
        "_own_mappings",
        lambda: [
            Mapping(0, 4096, "r--p", library, 4096, 4096),
            Mapping(8192, 4096, "r-xp", library, 4096, 0),
            Mapping(16384, 4096, "r-xp", "/lib/libc.so.6", 4096, 0),
        ],
    )
    fake = type("Libc", (), {"madvise": lambda self, *words: asked.append(words[0].value)})
    monkeypatch.setattr(memory_of_test, "_libc", fake())
    memory_of_test.release()
    assert asked == [8192]


SMALL = """
import json, sys
from hilctl.kernels.jit import ensure_compiled
from hilctl.kernels.limit import limit_block
from hilctl.machine.memory import ProcessMemory, _own_mappings

ensure_compiled(limit_block)
try:
    ProcessMemory().lock()
except OSError:  # this user may not: what it gave back before shows all the same
    pass
found = _own_mappings()
compiler = sum(each.resident for each in found if "llvmlite" in each.path)
json.dump([sum(each.resident for each in found), compiler], sys.stdout)
"""


def test_a_process_with_kernels_stays_small():
    """Its compiler, 150 MB of code, is given back; it ends without a crash."""
    command = [sys.executable, "-c", SMALL]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    resident, compiler = json.loads(ran.stdout)
    assert compiler < 8 << 20
    assert resident < 100 << 20


SUPERVISOR = """
import json, sys
import numpy as np
from hilctl.machine.memory import ProcessMemory, _own_mappings


def of_files():
    return sum(e.resident - e.changed for e in _own_mappings() if e.of_file)


before = of_files()
ProcessMemory().stay_small()
after = of_files()
resident = []
for _ in range(4):
    np.ones(2_000_000)
    resident.append(sum(each.resident for each in _own_mappings()))
json.dump([before, after, resident[-1] - resident[0]], sys.stdout)
"""


def test_who_has_no_ticks_gives_back_its_libraries_and_what_it_frees():
    """It reads again what it needs of them, and its arrays leave nothing behind."""
    command = [sys.executable, "-c", SUPERVISOR]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    before, after, grown = json.loads(ran.stdout)
    assert after < 0.7 * before
    assert grown < 4 << 20
