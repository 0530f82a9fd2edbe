"""The supervisor: starts the loop process, records what it exchanges, and makes the rig safe.

It holds no device while the loop lives. Should the loop process die, it drains the ring to the last
sample, puts the output at its safe value by a connection of its own, and closes the recording.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np

from hilctl.compensator import Compensator
from hilctl.errors import DeviceError, InputError, RunError
from hilctl.loop import Outcome
from hilctl.preflight import Checked
from hilctl.recorder import Recorder
from hilctl.ring import Batch, Field, Phase, SampleRing, memory_folder

_POLL_S = 0.02
_READY_TIMEOUT_S = 120.0
_START_DELAY_NS = 50_000_000
_SIGNALS = {signal.SIGINT: 1, signal.SIGTERM: 2, signal.SIGHUP: 3}
_RECORDER_FAILED = 4


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended.

    Attributes:
        path: The recording.
        code: ``completed``, ``stopped`` or ``fault``.
        reason: One line for people.
        safe: Whether the output is known to be at its safe value.
        stop_signal: Number of the signal that stopped it, or 0.
        samples: Samples recorded.
        missing: Samples counted as dropped, skipped or lost.
        late_ticks: Ticks that woke late.
    """

    path: Path
    code: str
    reason: str
    safe: bool
    stop_signal: int
    samples: int
    missing: int
    late_ticks: int


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a run stands.

    Attributes:
        samples: Samples recorded so far.
        total: Samples of the waveform.
        late_ticks: Ticks that woke late so far.
        batch: The newest samples.
    """

    samples: int
    total: int
    late_ticks: int
    batch: Batch


class Supervisor:
    """Runs one checked experiment into one recording.

    Args:
        checked: The experiment.
        output: File to record to.
        overwrite: Whether an existing file may be replaced.
        on_progress: Called with each batch.
    """

    def __init__(
        self,
        checked: Checked,
        output: Path,
        *,
        overwrite: bool,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._checked = checked
        self._config = checked.loaded.config
        self._output = output
        self._overwrite = overwrite
        self._on_progress = on_progress
        self._stop_signal = 0

    def run(self) -> RunResult:
        """Run to the end.

        Raises:
            InputError: The recording can't be written; nothing has moved, and no file is left.
            RunError: The loop could not be started; nothing has moved, and no file is left.
        """
        recorder = Recorder(self._checked, self._output, overwrite=self._overwrite)
        with (
            self._signals(),
            tempfile.TemporaryDirectory(prefix="hilctl-", dir=memory_folder()) as folder,
        ):
            ring = self._make_ring(Path(folder))
            process = self._start(Path(folder), ring)
            try:
                self._await_ready(process, ring)
                start_ns = time.monotonic_ns() + _START_DELAY_NS
                recorder.begin(time.time_ns() + start_ns - time.monotonic_ns())
            except (RunError, InputError):
                process.kill()  # it waits for the word to start, so nothing has moved
                process.wait()
                recorder.give_back()
                raise
            ring.put(Field.START_NS, start_ns)
            ring.put(Field.GO, 1)
            self._drain_while_alive(ring, process, recorder)
            outcome = self._outcome(ring, process, recorder)
            recorder.finish(_end_facts(outcome, ring), outcome.ended_at)
            return self._result(outcome, ring, recorder)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        def note(number: int, frame: FrameType | None) -> None:
            self._stop_signal = self._stop_signal or number

        before = {number: signal.signal(number, note) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _make_ring(self, folder: Path) -> SampleRing:
        config = self._config
        slots = max(16, int(config.recording.ring_s / config.tick_s))
        state = Compensator(self._checked.loaded.model, config.sample_rate_hz).state_size + 1
        return SampleRing.create(folder / "ring", slots=slots, block=config.block, state_size=state)

    def _start(self, folder: Path, ring: SampleRing) -> subprocess.Popen[bytes]:
        reference = folder / "reference.npy"
        np.save(reference, self._checked.reference.values)
        job = {
            "experiment": self._checked.loaded.yaml_text,
            "folder": str(self._checked.loaded.folder.resolve()),
            "ring": str(ring.path),
            "reference": str(reference),
            "supervisor": os.getpid(),
        }
        process = subprocess.Popen(
            [sys.executable, "-m", "hilctl.loop_process"],
            stdin=subprocess.PIPE,
            start_new_session=True,  # a Ctrl-C in the terminal is the supervisor's to handle
        )
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # it died at once, which is told where it is waited for
            process.stdin.write(json.dumps(job).encode())
            process.stdin.close()
        return process

    def _await_ready(self, process: subprocess.Popen[bytes], ring: SampleRing) -> None:
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while ring.get(Field.PHASE) == Phase.STARTING and process.poll() is None:
            if self._stop_signal:
                raise RunError("stopped before the start; nothing has moved")
            if time.monotonic() > deadline:
                raise RunError(f"the loop was not ready within {_READY_TIMEOUT_S:g} s")
            time.sleep(0.005)
        if ring.get(Field.PHASE) == Phase.FAILED:
            raise RunError(ring.read_text())
        if ring.get(Field.PHASE) != Phase.READY:
            raise RunError(f"the loop process died before the start: {_death(process)}")

    def _drain_while_alive(
        self, ring: SampleRing, process: subprocess.Popen[bytes], recorder: Recorder
    ) -> None:
        flushed = time.monotonic()
        while True:
            ended = process.poll() is not None
            if self._stop_signal:
                ring.put(Field.STOP, _SIGNALS[signal.Signals(self._stop_signal)])
            elif recorder.error:
                ring.put(Field.STOP, _RECORDER_FAILED)
            while (batch := ring.pop()) is not None:
                recorder.batch(batch)
                self._show(recorder, ring, batch)
            now = time.monotonic()
            if now - flushed >= self._config.recording.flush_s:
                recorder.flush()
                flushed = now
            if ended:
                return
            time.sleep(_POLL_S)

    def _show(self, recorder: Recorder, ring: SampleRing, batch: Batch) -> None:
        total = self._checked.forecast.samples
        late = ring.get(Field.LATE_TICKS)
        self._on_progress(Progress(recorder.samples, total, late, batch))

    def _outcome(
        self, ring: SampleRing, process: subprocess.Popen[bytes], recorder: Recorder
    ) -> Outcome:
        if ring.get(Field.PHASE) == Phase.ENDED:
            return Outcome(**json.loads(ring.read_text()))
        failed = ring.get(Field.PHASE) == Phase.FAILED
        reason = ring.read_text() if failed else f"the loop process died: {_death(process)}"
        safe = True
        try:
            self._checked.loaded.device.make_safe(self._config.safe.value)
        except DeviceError as error:
            reason += f"; the safe value could not be confirmed: {error}"
            safe = False
        return Outcome("fault", reason, recorder.samples + recorder.missing, safe, 0)

    def _result(self, outcome: Outcome, ring: SampleRing, recorder: Recorder) -> RunResult:
        cut = f"; the recording is cut short: {recorder.error}" if recorder.error else ""
        code = "fault" if recorder.error else outcome.code
        return RunResult(
            path=self._output,
            code=code,
            reason=outcome.reason + cut,
            safe=outcome.safe,
            stop_signal=self._stop_signal if code == "stopped" else 0,
            samples=recorder.samples,
            missing=recorder.missing,
            late_ticks=ring.get(Field.LATE_TICKS),
        )


def _end_facts(outcome: Outcome, ring: SampleRing) -> dict[str, str]:
    return {
        "code": outcome.code,
        "reason": outcome.reason,
        "output_safe": str(outcome.safe).lower(),
        "late_ticks": str(ring.get(Field.LATE_TICKS)),
        "skipped_ticks": str(ring.get(Field.SKIPPED_TICKS)),
        "worst_late_ns": str(ring.get(Field.WORST_LATE_NS)),
        "worst_late_tick": str(ring.get(Field.WORST_LATE_TICK)),
        "longest_late_run": str(ring.get(Field.LONGEST_LATE_RUN)),
        "dropped_in_ring": str(outcome.dropped),
    }


def _death(process: subprocess.Popen[bytes]) -> str:
    code = process.wait()
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def default_output(name: str, folder: Path, now: time.struct_time) -> Path:
    """Return the file for a run that was given none: ``folder/name-date-time.mcap``."""
    stamp = time.strftime("%Y%m%d-%H%M%S", now)
    candidate = folder / f"{name}-{stamp}.mcap"
    number = 2
    while os.path.lexists(candidate):
        candidate = folder / f"{name}-{stamp}-{number}.mcap"
        number += 1
    return candidate
