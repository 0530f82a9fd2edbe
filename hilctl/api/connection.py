"""A run that is going on, to look at, to change, to mark, to stop.

It speaks the protocol of ``docs/reference/protocol.md``, and imports nothing heavy until it is
needed.
"""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from hilctl.base.errors import InputError, RunError
from hilctl.run.control.client import (
    InverseState,
    find_run,
    mark_run,
    set_run,
    status_of,
    stop_runs,
)
from hilctl.run.run_folder import RunFolder

if TYPE_CHECKING:
    from hilctl.live.frame_codec import RunFrame


def connect(run: str | None = None) -> "RunConnection":
    """Return a run that is going on.

    Args:
        run: Its name, or the beginning of it; may be left out where there is one run only.

    Raises:
        InputError: There is none, or more than one.
    """
    return RunConnection(find_run(run))


class RunConnection:
    """A run that is going on. Each call is a request of its own: nothing is kept open.

    Args:
        folder: Its folder.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder

    @property
    def name(self) -> str:
        """Its name."""
        return self._folder.card.name

    @property
    def recording(self) -> str:
        """File that it is recorded to."""
        return self._folder.card.recording

    def status(self) -> dict[str, Any]:
        """Return where it stands; ``state`` says so too where nobody answers for it any more."""
        return status_of(self._folder)

    def set(
        self,
        *,
        gain: float | None = None,
        offset: float | None = None,
        inverse: InverseState | None = None,
        over_s: float = 1.0,
    ) -> dict[str, Any]:
        """Change the reference or the inverse over a ramp; what is None stays as it is.

        It returns once the change is accepted; ``begins_at_sample`` is its first sample.

        Args:
            gain: Factor of the reference.
            offset: Added to the reference, in the waveform's unit.
            inverse: ``out`` puts a straight line of the same stroke in its place, ``in`` it back.
            over_s: Time that the change takes.

        Raises:
            InputError: It is refused; the text says why, and nothing has changed.
            RunError: The run does not answer.
        """
        return set_run(self._folder, gain=gain, offset=offset, inverse=inverse, over_s=over_s)

    def mark(self, text: str) -> dict[str, Any]:
        """Set a mark at the present sample; return that sample.

        Args:
            text: One printable line.

        Raises:
            InputError: It is refused.
            RunError: The run does not answer.
        """
        return mark_run(self._folder, text)

    def frames(self, every_s: float = 0.1, window_s: float = 0.5) -> Iterator["RunFrame"]:
        """Subscribe to the run: give frames of its signals, figures and events until it is over.

        It reads the run's shared memory, writes nothing there, and costs the run nothing. A caller
        that is slow gets fewer frames; no spike is lost in those it gets.

        Args:
            every_s: Time from one frame to the next.
            window_s: Time that each frame shows.

        Raises:
            InputError: One of them is no time.
            RunError: The run has ended.
        """
        for name, value, least in (("every_s", every_s, 0.0), ("window_s", window_s, 1e-3)):
            if not least <= value <= 1e5:
                raise InputError(f"{name}: must be from {least:g} to 100000 s: got {value:g}")
        from hilctl.live.frame_codec import frames_of
        from hilctl.live.run_reader import RunReader

        return frames_of(RunReader(self._folder), every_s, window_s, time.monotonic, time.sleep)

    def stop(self, wait_s: float = 60.0) -> None:
        """End it by its safe ramp, and wait until its recording is closed.

        Args:
            wait_s: Longest wait.

        Raises:
            RunError: It is still going.
        """
        (stopped,) = stop_runs([self._folder], wait_s)
        if not stopped["ended"]:
            why = stopped["error"] or "it was requested to stop"
            raise RunError(f"{self.name} is still going after {wait_s:g} s: {why}")
