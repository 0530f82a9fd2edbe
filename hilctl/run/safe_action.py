"""Setting the output to its safe value in place of a loop that cannot."""

import threading
from collections.abc import Callable

from hilctl.base.device import Device
from hilctl.loop.safe_output import LocalError, SafeGoal, SafeOutput
from hilctl.run.shared_page import SafeActionResult, SharedPage


class SafeAction:
    """Drives a device to its safe value in a thread, until no write can tell more.

    Args:
        page: Shared with the other processes of the run.
        device: Not open; each write opens a connection of its own.
        goal: Where the output goes.
        hung: Whether the loop had to be killed.
        prepare: Called in that thread first.

    Attributes:
        failed: What broke in this process, so that another one has to try; empty if nothing did.

    Raises:
        RuntimeError: No thread can be started.
    """

    def __init__(
        self,
        page: SharedPage,
        device: Device,
        goal: SafeGoal,
        *,
        hung: bool,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        self._output = SafeOutput(device, goal, on_write=page.note_safe_write)
        self._hung, self._prepare = hung, prepare
        self._result = SafeActionResult(hung, "unknown", self._output.error, final=False)
        self._ending = threading.Event()
        self.failed = ""
        # A daemon: a device that blocks it for ever must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="safe action", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        output = self._output
        try:
            self._prepare()
            while not output.final and not self._ending.is_set():
                output.attempt()
                self._result = SafeActionResult(
                    self._hung, output.state, output.error, output.final
                )
                if not output.final:
                    self._ending.wait(output.pause_s)
        except LocalError as error:
            self.failed = str(error)
        except Exception as error:  # noqa: BLE001  no error may pass for a confirmed output
            self.failed = f"{type(error).__name__}: {error}"

    def result(self, wait_s: float = 0.0) -> SafeActionResult:
        """Return what is reached so far, after ``wait_s`` or when nothing more follows."""
        self._thread.join(wait_s)
        return self._result

    def end(self, wait_s: float) -> bool:
        """Write no more; return whether the last write is over within ``wait_s``."""
        self._ending.set()
        self._thread.join(wait_s)
        return not self._thread.is_alive()
