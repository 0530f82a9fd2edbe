"""One short compensated run over every wire, in the processes that a user starts."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read


def _wire_runs():
    """Return the benchmark's module: test files can't import each other."""
    path = Path(__file__).parents[1] / "benchmark" / "wire_runs.py"
    spec = importlib.util.spec_from_file_location("wire_runs", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["wire_runs"] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


RUNS = _wire_runs()
RATES_HZ = {
    "Modbus TCP": 500.0,
    "Modbus RTU": 100.0,
    "SCPI": 15.0,
    "SCPI, measured": 15.0,
    "DCON": 35.0,
    "COBS": 200.0,
    "COBS FIFO": 10_000.0,
}
PER_CYCLE = {"SCPI": 20, "SCPI, measured": 20, "COBS FIFO": 500}
LIKE_OTHERS = {"Modbus RTU", "SCPI, measured"}
"""Wires whose parts the others have, each in a run that takes its time."""
CYCLES = 3


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(each, marks=pytest.mark.long if each in LIKE_OTHERS else ())
        for each in RATES_HZ
    ],
)
def test_compensated_run_is_complete(tmp_path, name):
    """Every sample of the waveform is recorded or counted, and the commands replay bit for bit."""
    wire = next(each for each in RUNS.WIRES if each.name == name)
    wire = replace(wire, per_cycle=PER_CYCLE.get(name, 50), block=min(wire.block, 100))
    RUNS.write_profiles(tmp_path)
    path = tmp_path / "experiment.yaml"
    with RUNS.emulated(wire, tmp_path) as device:
        RUNS.write_experiment(path, wire, device, RATES_HZ[name], 0.0)
        printed = RUNS.run(path)
    assert printed["code"] == "completed", printed["reason"]
    assert printed["complete"]
    assert printed["output_safe"]
    recording = read(path.with_suffix(".mcap"))
    waveform = recording.samples.index[recording.samples.index < CYCLES * wire.per_cycle]
    missing = CYCLES * wire.per_cycle - waveform.size
    assert missing <= recording.dropped
    if name == "COBS FIFO":  # its own clock paces it, whatever this machine does meanwhile
        assert recording.dropped == 0
    # All of it, and not of its steady cycles alone: a busy machine may leave none.
    assert np.ptp(recording.samples.displacement_um) > 60.0
    measured = recording.samples.measured
    assert (measured.size > 0 and abs(measured - recording.samples.command).max() < 1e-3) == (
        name == "SCPI, measured"
    )
    assert replay(recording).identical
