"""The guardian: a small process that makes the output safe where the loop no longer can.

Started by the supervisor as ``python -m hilctl.run.guardian`` with the file of its job and a pidfd
of the loop's process. It reads no file and imports nothing after it has said that it watches, and
it waits for nobody: neither a disk nor the supervisor stands between a dead loop and the coil.

It acts whenever the loop has died without an outcome, or hangs. The supervisor makes the output
safe only after it has seen the guardian dead, or killed it: so no two of them ever hold the device.
"""

import json
import mmap
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Self

from hilctl.base.device import Device
from hilctl.base.errors import HilctlError, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml.document import Document
from hilctl.experiment.device import made_device
from hilctl.machine.linux import LinuxProcess
from hilctl.machine.realtime import be_quick
from hilctl.run.hang_watch import HangWatch, SilenceLimits, is_stopped
from hilctl.run.safe_action import SafeAction
from hilctl.run.shared_page import SIZE, Field, GuardianPhase, PageText, Phase, SharedPage

_POLL_MS = 5
LAST_CALL_MS = 5
"""How long a process that was killed may be in a call that it is to end. Then it is dying: giving
back its memory takes much longer, and only a device that takes one connection waits for that."""


@dataclass(frozen=True, slots=True)
class GuardianJob:
    """What the guardian is to guard, as text.

    Attributes:
        experiment: The experiment as YAML.
        files: Texts of the files that its device refers to, by absolute path.
        folder: Folder that file names in it are relative to.
        ring: File of the ring.
        safe_value: What to put out, in the device's command unit.
        limits: How long the loop may be silent.
        loop: Process number of the loop.
        priority: SCHED_FIFO priority that is asked for.
    """

    experiment: str
    files: Mapping[str, str]
    folder: str
    ring: str
    safe_value: float
    limits: SilenceLimits
    loop: int
    priority: int

    def to_json(self) -> str:
        """Return the fields as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Undo :meth:`to_json`."""
        fields = json.loads(text)
        return cls(**{**fields, "limits": SilenceLimits(**fields["limits"])})

    def device(self) -> Device:
        """Return the device, made but not opened; nothing is read from disk.

        Raises:
            InputError: It can't be made.
        """
        document = Document("experiment", self.experiment)
        made = made_device(document, Path(self.folder), TextFiles(self.files))
        if made is None:
            raise InputError("the experiment has no device")
        return made


class Guardian:
    """Watches the loop, and makes the output safe where it died or hangs.

    Args:
        page: Shared with loop and supervisor.
        device: Not open.
        job: What to guard.
        loop: A pidfd of the loop's process.
        prepare: Called first in the thread that makes the output safe.
    """

    def __init__(
        self,
        page: SharedPage,
        device: Device,
        job: GuardianJob,
        loop: int,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        self._page, self._device, self._job, self._loop = page, device, job, loop
        self._prepare = prepare
        self._watch = HangWatch(page, job.limits, lambda: is_stopped(job.loop))
        self._death = select.poll()
        self._death.register(loop, select.POLLIN)

    def watch(self) -> None:
        """Watch until the loop is gone, and the output safe as far as that can be had."""
        page = self._page
        page.put(Field.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        # After the heartbeat: an old one would pass for silence.
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.WATCHING)
        while True:
            now_ns = time.monotonic_ns()
            page.put(Field.GUARDIAN_HEARTBEAT_NS, now_ns)
            if self._death.poll(_POLL_MS):
                # Without the start signal nothing was sent: the output is as somebody left it.
                if page.get(Field.GO) and page.get(Field.PHASE) != Phase.ENDED:
                    self._make_safe(hung=False)
                return
            if self._watch.hangs(now_ns):
                self._kill_loop()
                self._make_safe(hung=True)
                return

    def _kill_loop(self) -> None:
        """End the loop for good: should it go on, it would send commands from before."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._loop, signal.SIGKILL)
        self._death.poll(LAST_CALL_MS)

    def _make_safe(self, *, hung: bool) -> None:
        page = self._page
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.ACTING)
        action = SafeAction(self._device, self._job.safe_value, hung=hung, prepare=self._prepare)
        while (made_safe := action.result(_POLL_MS * 1e-3)) is None:
            page.put(Field.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns())
        page.leave_made_safe(made_safe)


def main(words: list[str]) -> int:
    """Guard one run; the exit code is 0 where the job could be read and the device made."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the loop, and not before
    job = GuardianJob.from_json(Path(words[0]).read_text(encoding="utf-8"))
    page = _page(job.ring)
    try:
        device = job.device()
    except (HilctlError, MemoryError) as error:
        page.write_text(PageText.GUARDIAN, str(error) or "not enough memory")
        page.put(Field.GUARDIAN_PHASE, GuardianPhase.FAILED)
        return 1
    "localhost".encode("idna")  # the codec, which is imported at the first connection otherwise
    process = LinuxProcess()
    _stay_in_memory(process)
    be_quick(job.priority, process)
    prepare = partial(be_quick, job.priority, process)
    Guardian(page, device, job, int(words[1]), prepare).watch()
    return 0


def _page(ring: str) -> SharedPage:
    descriptor = os.open(ring, os.O_RDWR)
    try:
        return SharedPage(mmap.mmap(descriptor, SIZE))
    finally:
        os.close(descriptor)


def _stay_in_memory(process: LinuxProcess) -> None:
    """Keep all that is needed in RAM where that is allowed: to read it back may need a disk."""
    process.freeze_gc()
    with suppress(OSError):
        if process.lockable_bytes() is None:
            process.lock_memory()


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except MemoryError:
        sys.exit("hilctl: not enough memory for the guardian")
