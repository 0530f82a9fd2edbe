"""Where a run stands, shown from a thread of its own: no terminal keeps a run waiting."""

import threading
from collections.abc import Callable

from hilctl.run.result import Progress

_EVERY_S = 0.05
_LAST_S = 0.5


class ProgressThread:
    """Calls somebody with where a run stands, some times a second.

    Args:
        current: Returns where it stands; None where there is nothing new to say.
        on_progress: Called with that; may take as long as it likes.
        on_error: Called once, with what went wrong in it; nothing is shown from then on.
    """

    def __init__(
        self,
        current: Callable[[], Progress | None],
        on_progress: Callable[[Progress], None],
        on_error: Callable[[str], None],
    ) -> None:
        self._current, self._on_progress, self._on_error = current, on_progress, on_error
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="progress", daemon=True)

    def start(self) -> None:
        """Begin to show."""
        self._thread.start()

    def end(self) -> None:
        """Show the last of it; a terminal that stands still is not waited for."""
        self._ending.set()
        self._thread.join(_LAST_S)

    def _run(self) -> None:
        try:
            while not self._ending.wait(_EVERY_S):
                self._show()
            self._show()
        except Exception as error:  # noqa: BLE001  whoever shows a run must not end it
            self._on_error(f"progress is not shown any more: {type(error).__name__}: {error}")

    def _show(self) -> None:
        if (progress := self._current()) is not None:
            self._on_progress(progress)
