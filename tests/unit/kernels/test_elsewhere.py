"""Kernels that another process compiles, and what happens where it can't."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from hilctl.kernels import jit
from hilctl.kernels.elsewhere import Compiler, compiled_elsewhere

LIMIT = ("hilctl.kernels.limit", "limit_block")

ONCE = """
import json, sys
from numba.core.event import Listener, install_listener
from hilctl.kernels import jit, limit
from hilctl.kernels.elsewhere import compiled_elsewhere

class Here(Listener):
    names = []
    def on_start(self, event):
        self.names.append(event.data["dispatcher"].py_func.__name__)
    def on_end(self, event):
        pass

elsewhere = []
with install_listener("numba:compile", Here()), compiled_elsewhere(elsewhere.append):
    jit.load(limit.limit_block)
hits = sum(limit.limit_block.stats.cache_hits.values())
print(json.dumps([elsewhere, Here.names, hits]))
"""


def loaded(folder, **around):
    """Load a kernel in a process of its own; return what was compiled where, and what was kept."""
    around = {**os.environ, "NUMBA_CACHE_DIR": str(folder), **around}
    command = [sys.executable, "-P", "-c", ONCE]
    ran = subprocess.run(command, capture_output=True, text=True, env=around, check=False)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_what_is_not_kept_is_compiled_by_another_process_and_loaded_by_this_one(tmp_path):
    assert loaded(tmp_path) == [["limit_block"], [], 1]
    assert loaded(tmp_path) == [[], [], 1]  # and nobody is asked for what is kept


def test_it_is_compiled_here_where_nothing_can_be_started(tmp_path, monkeypatch):
    compiler = Compiler()
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    compiler.compile(*LIMIT)  # and who asked looks for it in vain
    compiler.close()

    def double(value: float) -> float:
        return 2.0 * value

    monkeypatch.setattr(jit.numba.config, "CACHE_DIR", str(tmp_path))
    with compiled_elsewhere():
        assert jit.kernel("float64(float64)")(double)(1.5) == 3.0


def test_kernels_of_others_are_compiled_here(tmp_path, monkeypatch):
    """To import their modules a second time may touch a device; a wrong one is refused in words."""
    monkeypatch.setattr(jit.numba.config, "CACHE_DIR", str(tmp_path))

    def half(value: float) -> float:
        return 0.5 * value

    shown = []
    monkeypatch.setattr(Compiler, "_running", None)  # nothing is started for them
    with compiled_elsewhere(shown.append):
        assert jit.kernel("float64(float64)")(half)(3.0) == 1.5
        with pytest.raises(jit.numba.TypingError):
            jit.kernel("float64(unicode_type)")(half)(3.0)
    assert shown == []
    assert jit._Elsewhere.compile is None


def test_what_the_other_process_can_not_name_is_left_to_who_asks():
    shown = []
    compiler = Compiler(shown.append)
    compiler.compile("hilctl.kernels.limit", "absent.<locals>.half")
    assert compiler._process.poll() is None  # it answers, and goes on
    compiler.close()
    assert shown == ["absent.<locals>.half"]


def test_one_that_has_ended_is_started_again():
    compiler = Compiler()
    compiler.compile(*LIMIT)
    first = compiler._process
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    compiler.compile(*LIMIT)
    second = compiler._process
    assert (second.pid != first.pid, second.poll()) == (True, None)
    compiler.close()
    assert second.returncode == -signal.SIGKILL
    assert compiler._process is None


def test_nothing_is_left_running_when_nobody_asks_any_more():
    """Nor where who asked was killed: its end of the pipe is closed."""
    compiler = Compiler()
    compiler.compile(*LIMIT)
    process = compiler._process
    process.stdin.close()
    assert process.wait(timeout=60.0) == 0
    compiler.close()


IDLE = """
import sys
from hilctl.kernels import elsewhere
elsewhere._IDLE_S = 0.0
sys.exit(elsewhere.main())
"""


def test_it_ends_where_nothing_is_asked_for_a_while():
    command = [sys.executable, "-P", "-c", IDLE, json.dumps(sys.path)]
    ended = subprocess.run(command, input=None, stdin=subprocess.PIPE, timeout=60.0, check=False)
    assert ended.returncode == 0


def test_bits_are_those_of_a_kernel_compiled_here(tmp_path):
    """Any difference would show in recordings: in the first run and in no other."""
    code = """
import sys, numpy as np
from contextlib import nullcontext
from hilctl.kernels import jit
from hilctl.kernels import dynamics as creep
from hilctl.kernels.elsewhere import compiled_elsewhere
with compiled_elsewhere() if sys.argv[1] == "elsewhere" else nullcontext():
    jit.load(creep.creep_stage)
x = np.cumsum(np.random.default_rng(5).standard_normal(5000))
out = np.empty_like(x)
creep.creep_stage(x, np.array([0.5, 0.9, 0.02, 0.004]), np.zeros(3), out)
sys.stdout.buffer.write(out.tobytes())
"""
    found = []
    for where in ("here", "elsewhere"):
        around = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / where)}
        command = [sys.executable, "-P", "-c", code, where]
        found.append(subprocess.run(command, capture_output=True, env=around, check=True).stdout)
    np.testing.assert_array_equal(*map(np.frombuffer, found))
