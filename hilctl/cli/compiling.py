"""Says what is compiled, where somebody waits for it: that comes once, and takes seconds."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hilctl.cli.volume import Volume

if TYPE_CHECKING:
    from numba.core.event import Event

_ONCE = "hilctl: compiling for this machine, about 10 s in all, and only this once:"


@contextmanager
def compiling_shown() -> Iterator[None]:
    """Print the name of each kernel that is compiled, to a terminal; nothing where all are kept."""
    if Volume.quiet or not sys.stderr.isatty():
        yield
        return
    from numba.core.event import Listener, install_listener

    class Shown(Listener):
        depth = named = 0

        def on_start(self, event: "Event") -> None:
            if not self.depth:  # what a kernel calls is compiled within it
                if not self.named:
                    print(_ONCE, file=sys.stderr)
                self.named += 1
                print(f"  {event.data['dispatcher'].py_func.__name__}", file=sys.stderr)
            self.depth += 1

        def on_end(self, _event: "Event") -> None:
            self.depth -= 1

    with install_listener("numba:compile", Shown()):
        yield
