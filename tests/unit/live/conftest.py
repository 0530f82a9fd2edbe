"""An active run that exchanges samples, and traces of known values."""

from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.samples import BlockHeader
from hilctl.live.scope import ROW, SIGNALS, Traces
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, Phase
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"
BLOCK = 50


@pytest.fixture(scope="session")
def description():
    return RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", []))


@contextmanager
def active_run(description, place, slots=16):
    """Yield the folder and the ring of a run at 50 kHz."""
    with run_folder("demo", {"": place / "a.mcap"}, 12.0) as (folder, _):
        yield folder, begun(folder, description, slots)


@contextmanager
def active_axes(description, place, slots=16):
    """Yield the folder and the rings of a run with the axes x and y."""
    recordings = {axis: place / f"a.{axis}.mcap" for axis in "xy"}
    with run_folder("stage", recordings, 12.0) as (folder, _):
        yield folder, [begun(folder, description, slots, axis) for axis in range(2)]


def begun(folder, description, slots=16, axis=0):
    """Return the ring of an axis of a run whose loop is active."""
    description.write(folder.description_of(axis))
    aux = len(description.aux)
    path = folder.ring_of(axis)
    ring = SampleRing.create(path, slots=slots, block=BLOCK, state_size=1, aux=aux)
    ring.page.put(PageField.PHASE, Phase.RUNNING)
    return ring


def exchange(ring, blocks, spike_um=0.0, keep=None):
    """Add blocks whose values are sample numbers, with a spike in the last displacement.

    With ``keep`` they are recorded, and the ring keeps that many.
    """
    for number in blocks:
        block = ring.claim()
        index = number * BLOCK + np.arange(BLOCK)
        block.head[BlockHeader.FIRST_SAMPLE] = index[0]
        block.head[BlockHeader.LATE_NS] = 20_000
        block.flags[:] = 0
        block.reference[:] = block.input_um[:] = index
        block.command[:] = block.wanted[:] = index / 10.0
        ring.sending(block)
        block.displacement_um[:] = index
        block.aux[:] = number
        if number == blocks[-1]:
            block.displacement_um[7] += spike_um
        ring.answered(block)
        while keep is not None and ring.pop() is not None:
            ring.release(keep=keep)


def traces(start, flags=0, **rows):
    """Return samples whose signals have the given values; the others have none."""
    size = len(next(iter(rows.values())))
    values = np.full((len(SIGNALS), size), np.nan)
    for name, row in rows.items():
        values[ROW[name]] = row
    return Traces(np.arange(start, start + size), values, np.full(size, flags, dtype=np.uint32))


def first(runs):
    return runs[0] if runs else None
