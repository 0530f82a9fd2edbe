"""Has kernels compiled by a process of its own, with which the compiler's memory goes.

What compiles keeps 80 MB more for as long as it lives; what finds compiled kernels on the disk does
not. That process ends by itself where nothing is asked of it for a while, or nobody is there to
ask any more. Where it can't do its work, kernels are compiled by who needs them.
"""

import importlib
import json
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import reduce
from typing import IO, Any

from hilctl.kernels.jit import compile_by, load

_OURS = ("hilctl", "hilctl_drivers")
_IDLE_S = 5.0
_DONE = b"\n"


class Compiler:
    """The process, from the first kernel on.

    Args:
        shown: Called with the name of each kernel that is compiled.
    """

    def __init__(self, shown: Callable[[str], object] = lambda _: None) -> None:
        self._shown = shown
        self._process: subprocess.Popen[bytes] | None = None

    def compile(self, module: str, name: str) -> None:
        """Have a kernel compiled and kept; looking for it then says whether that went well.

        Those of others are left to who asks: importing their modules once more may touch a device.
        """
        if module.partition(".")[0] not in _OURS:
            return
        self._shown(name)
        request = json.dumps([module, name]).encode() + b"\n"
        for _ in range(2):  # it may just have ended, as nobody had asked it for a while
            with suppress(OSError):
                pipes = self._running()
                pipes[0].write(request)
                pipes[0].flush()
                if pipes[1].readline() == _DONE:
                    return
            self.close()

    def _running(self) -> tuple[IO[bytes], IO[bytes]]:
        if self._process is None:
            start = "import sys; from hilctl.kernels.elsewhere import main; sys.exit(main())"
            self._process = subprocess.Popen(
                # -P: what lies in the working folder is not to be imported.
                [sys.executable, "-P", "-c", start, json.dumps(sys.path)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # who needs the kernel compiles it then, and says all
                start_new_session=True,
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        return process.stdin, process.stdout

    def close(self) -> None:
        """End the process: nothing that it has begun is asked for any more."""
        if self._process is None:
            return
        process, self._process = self._process, None
        process.kill()
        process.wait()
        for pipe in filter(None, (process.stdin, process.stdout)):
            with suppress(OSError):  # what was left to write goes nowhere
                pipe.close()


@contextmanager
def compiled_elsewhere(shown: Callable[[str], object] = lambda _: None) -> Iterator[None]:
    """Have kernels that are not on the disk compiled by another process meanwhile.

    Args:
        shown: Called with the name of each.
    """
    if sys.platform == "win32":  # select takes no pipe there: the process would end at once
        yield
        return
    compiler = Compiler(shown)
    compile_by(compiler.compile)
    try:
        yield
    finally:
        compile_by(None)
        compiler.close()


def main() -> int:
    """Compile what is asked for on standard input until that ends, or nothing comes for a while."""
    sys.path[:] = json.loads(sys.argv[1])
    while select.select([0], [], [], _IDLE_S)[0] and (line := os.read(0, 65536)):
        module, name = json.loads(line)
        # A kernel that can't be compiled is tried again where it is needed, and refused in words.
        with suppress(Exception):
            wanted: Any = reduce(getattr, name.split("."), importlib.import_module(module))
            load(wanted)
        os.write(1, _DONE)
    return 0
