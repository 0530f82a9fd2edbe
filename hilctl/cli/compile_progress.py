"""Progress of compiling kernels, which takes seconds at the first use on a machine."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hilctl.cli.verbosity import Verbosity

_ONCE = "hilctl: compiling for this machine, about 10 s in all, and only this once:"


@contextmanager
def compile_progress() -> Iterator[None]:
    """Print the name of each kernel that is compiled meanwhile; only to a terminal."""
    if Verbosity.quiet or not sys.stderr.isatty():
        yield
        return
    from numba.core.event import Event, Listener, install_listener

    class Progress(Listener):
        depth = 0
        lines: tuple[str, ...] = (_ONCE,)

        def on_start(self, event: Event) -> None:
            if not self.depth:  # a kernel is compiled during the compilation of its caller
                name = event.data["dispatcher"].py_func.__name__
                print(*self.lines, f"  {name}", sep="\n", file=sys.stderr)
                self.lines = ()
            self.depth += 1

        def on_end(self, event: Event) -> None:
            self.depth -= 1

    with install_listener("numba:compile", Progress()):
        yield
