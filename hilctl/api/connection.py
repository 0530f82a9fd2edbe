"""Connect to an active run: status, changes, marks, frames, stop.

The protocol is described in ``docs/reference/protocol.md``.
"""

import time
from collections.abc import Iterator, Mapping
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
    from hilctl.live.run_reader import RunFrame


def connect(run: str | None = None) -> "RunConnection":
    """Return the connection to an active run.

    Args:
        run: Its name, or the beginning of it; required if several runs are active.

    Raises:
        InputError: No run matches, or several do.
    """
    return RunConnection(find_run(run))


class RunConnection:
    """An active run. Each call is a separate request; no connection stays open.

    Args:
        folder: Folder of the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder

    @property
    def name(self) -> str:
        """Name of the run."""
        return self._folder.card.name

    @property
    def recording(self) -> str:
        """File of the recording."""
        return self._folder.card.recording

    def status(self) -> dict[str, Any]:
        """Return the status; ``state`` shows whether the run still answers."""
        return status_of(self._folder)

    def set(
        self,
        *,
        gain: float | None = None,
        offset: float | None = None,
        inverse: InverseState | None = None,
        axes: Mapping[str, Mapping[str, Any]] | None = None,
        over_s: float = 1.0,
    ) -> dict[str, Any]:
        """Change the reference or the inverse of all axes by a ramp; values of None are kept.

        Return when the change is accepted; ``begins_at_sample`` is its first sample.

        Args:
            gain: Factor of the reference.
            offset: Offset of the reference, in the waveform's unit.
            inverse: ``out`` replaces the inverse by a linear gain of the same stroke, ``in``
                enables it again.
            axes: Values of single axes by name, ``{"x": {"gain": 0.5}}``; they come first.
            over_s: Duration of the change.

        Raises:
            InputError: The change is rejected; nothing has changed.
            RunError: The run does not answer.
        """
        return set_run(
            self._folder, gain=gain, offset=offset, inverse=inverse, axes=axes, over_s=over_s
        )

    def mark(self, text: str) -> dict[str, Any]:
        """Add a mark at the current sample and return that sample.

        Args:
            text: One printable line.

        Raises:
            InputError: The text is invalid.
            RunError: The run does not answer.
        """
        return mark_run(self._folder, text)

    def frames(
        self, every_s: float = 0.1, window_s: float = 0.5, axis: str = ""
    ) -> Iterator["RunFrame"]:
        """Yield frames of the run's signals, metrics and events until the run ends.

        Frames are read from the run's shared memory, so the run is not affected. A slow caller gets
        fewer frames; each contains the minimum and maximum of all its samples.

        Args:
            every_s: Interval of the frames.
            window_s: Duration that each frame shows.
            axis: Axis of a run of several; default: the first one.

        Raises:
            InputError: An argument is out of range, or the run has no such axis.
            RunError: The run has ended.
        """
        for name, value, least in (("every_s", every_s, 0.0), ("window_s", window_s, 1e-3)):
            if not least <= value <= 1e5:
                raise InputError(f"{name} must be from {least:g} to 100000 s (got {value:g})")
        from hilctl.live.run_reader import RunReader, frames_of

        reader = RunReader(self._folder, axis)
        return frames_of(reader, every_s, window_s, time.monotonic, time.sleep)

    def stop(self, wait_s: float = 60.0) -> None:
        """Stop the run: ramp to the safe value, and wait until the recording is closed.

        Args:
            wait_s: Timeout.

        Raises:
            RunError: The run is still active.
        """
        (stopped,) = stop_runs([self._folder], wait_s)
        if not stopped["ended"]:
            why = stopped["error"] or "stop requested"
            raise RunError(f"{self.name} is still active after {wait_s:g} s: {why}")
