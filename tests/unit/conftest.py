"""Recordings made of formulas, and pages without drawings, for tests of several rooms."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.events import Event
from hilctl.base.samples import Flag, Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64, U32
from hilctl.lab.pages import html
from hilctl.recording.recording import Recording, Ticks

MakeRecording = Callable[..., Recording]


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave all figures white, for tests of something else: to draw one takes half a second."""
    monkeypatch.setattr(html, "drawn", lambda sheet: None)
    monkeypatch.setattr(html, "svg", lambda figure, text: f'<svg aria-label="{text}"></svg>')


def _ticks(samples: int, block: int, rate_hz: float) -> Ticks:
    first = np.arange(0, samples, block, dtype=np.int64)
    deadline_ns = np.round(first * 1e9 / rate_hz).astype(np.int64)
    late_ns = 50_000 + 1_000 * np.arange(first.size, dtype=np.int64)
    return Ticks(first, deadline_ns, late_ns, np.full(first.size, 30_000, dtype=np.int64))


@pytest.fixture(scope="session")
def make_recording() -> MakeRecording:
    """Return a builder: displacement and what it is held against in, a whole recording out."""

    def make(
        displacement_um: F64,
        *,
        reference_um: F64 | None = None,
        command: F64 | None = None,
        segments: Sequence[Segment] = (),
        sample_rate_hz: float = 50_000.0,
        ramp: int = 0,
        run: Mapping[str, str] | None = None,
        end: Mapping[str, str] | None = None,
        ticks: Ticks | None = None,
        index: I64 | None = None,
        flags: U32 | None = None,
        events: tuple[Event, ...] = (),
        experiment_yaml: str = "name: test\n",
    ) -> Recording:
        n = displacement_um.size
        if flags is None:
            flags = np.zeros(n, dtype=np.uint32)
            flags[n - ramp :] |= Flag.RAMP.value
        put_out = np.zeros(n) if command is None else command
        wanted_um = np.full(n, np.nan) if reference_um is None else reference_um
        samples = Samples(
            index=np.arange(n, dtype=np.int64) if index is None else index,
            reference_um=wanted_um,
            wanted=put_out,
            command=put_out,
            displacement_um=displacement_um,
            input_um=wanted_um,
            flags=flags,
        )
        return Recording(
            path=Path("run.mcap"),
            run={"name": "test", "device": "serial_dac"} if run is None else run,
            end={"reason": "waveform completed"} if end is None else end,
            sample_rate_hz=sample_rate_hz,
            command_unit="A",
            compensated=reference_um is not None,
            segments=tuple(segments),
            samples=samples,
            dropped=0,
            ticks=_ticks(n, 50, sample_rate_hz) if ticks is None else ticks,
            events=events,
            experiment_yaml=experiment_yaml,
            model_yaml="",
        )

    return make
