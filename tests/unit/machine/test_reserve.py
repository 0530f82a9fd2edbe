"""The reserve of a process that is out of descriptors or memory."""

import subprocess
import sys
import threading
from textwrap import dedent

from hilctl.machine.reserve import Reserve


def alone(code, stdin=subprocess.DEVNULL):
    """Run code in a process of its own, whose limits and input it may change."""
    start = """
        import errno, os, resource, sys
        from hilctl.machine.reserve import RESERVE, Reserve
        RESERVE.hold()
        def limit(kind, soft, hard=None):
            resource.setrlimit(kind, (soft, soft if hard is None else hard))
        def opened():
            try:
                return os.open(os.devnull, os.O_RDONLY)
            except OSError as error:
                assert error.errno == errno.EMFILE
    """
    words = [sys.executable, "-c", dedent(start) + dedent(code)]
    subprocess.run(words, check=True, stdin=stdin, timeout=60.0)


def test_a_lowered_limit_leaves_one_descriptor():
    alone("""
        limit(resource.RLIMIT_NOFILE, 3)
        assert opened() is None
        assert RESERVE.release()
        assert opened() == 0
        assert opened() is None
        assert not RESERVE.release()
    """)


def test_a_limit_that_may_be_raised_is_raised():
    alone("""
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        for kind in (resource.RLIMIT_NOFILE, resource.RLIMIT_AS):
            limit(kind, 3, hard)
        assert RESERVE.release()
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (hard, hard)
        assert resource.getrlimit(resource.RLIMIT_AS) == (hard, hard)
    """)


def test_exhausted_numbers_are_free_for_a_serial_port():
    alone("""
        limit(resource.RLIMIT_NOFILE, 50)
        while opened() is not None: pass
        assert RESERVE.release()
        assert all(opened() is not None for _ in range(6))
    """)


def test_a_file_that_took_the_number_of_a_closed_input_stays():
    alone("""
        if len(sys.argv) == 1:
            os.close(0)
            os.execv(sys.executable, [*sys.orig_argv, "again"])
        assert sys.__stdin__ is None
        assert os.fstat(0)  # of the reserve that is held first
        other = Reserve()
        other.hold()
        assert other.release()
        assert os.fstat(0)
    """)


def test_work_needs_no_new_thread():
    alone("""
        limit(resource.RLIMIT_AS, 4096)
        done = []
        assert RESERVE.run(lambda: done.append(1)).wait(30.0)
        assert done == [1]
    """)


def test_work_behind_a_busy_thread_is_not_delayed():
    reserve, go_on = Reserve(), threading.Event()
    reserve.hold()
    first = reserve.run(lambda: go_on.wait(30.0))
    assert reserve.run(lambda: None).wait(30.0)
    assert not first.is_set()
    go_on.set()
    assert first.wait(30.0)


def test_work_does_not_need_a_reserve():
    reserve = Reserve()
    assert reserve.run(lambda: None).wait(30.0)
    assert not reserve.release()
