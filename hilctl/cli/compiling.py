"""Says what is compiled, where somebody waits for it: that comes once, and takes seconds."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hilctl.cli.verbosity import Verbosity

if TYPE_CHECKING:
    from numba.core.event import Event

_ONCE = "hilctl: compiling for this machine, about 10 s in all, and only this once:"


@contextmanager
def compiling_shown() -> Iterator[None]:
    """Print the name of each kernel that is compiled, to a terminal; nothing where all are kept.

    They are compiled by another process, where that can be had: this one goes on for as long as a
    run does, and would keep the compiler in its memory.
    """
    from hilctl.kernels.elsewhere import compiled_elsewhere

    if Verbosity.quiet or not sys.stderr.isatty():
        with compiled_elsewhere():
            yield
        return
    from numba.core.event import Listener, install_listener

    class Shown(Listener):
        depth = named = 0

        def on_start(self, event: "Event") -> None:
            if not self.depth:  # what a kernel calls is compiled within it
                self.show(event.data["dispatcher"].py_func.__name__)
            self.depth += 1

        def on_end(self, _event: "Event") -> None:
            self.depth -= 1

        def show(self, name: str) -> None:
            if not self.named:
                print(_ONCE, file=sys.stderr)
            self.named += 1
            print(f"  {name}", file=sys.stderr)

    shown = Shown()
    with install_listener("numba:compile", shown), compiled_elsewhere(shown.show):
        yield
