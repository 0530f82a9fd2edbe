"""Kernels are compiled, or read from the disk, before the first tick."""

import json
import os
import sys
from pathlib import Path

import numpy as np

from tests.commands import ended

CONFIGS = Path(__file__).parents[2] / "configs"
STAGED = "compensator.model=" + str(CONFIGS / "models" / "terfenol_staged_preisach.yaml")
ADAPTED = "adaptation={time_constant_s: 0.2, noise_um: 0.036}"
HALF = ["waveform.amplitude=20.0", "waveform.offset=0.0"]
# In one process, one after the other: what is loaded once is not loaded again, so each shows what
# only it needs.
RUNS = [
    ("terfenol_sine_6a.yaml", [], 0.5),
    ("terfenol_sine_6a.yaml", [STAGED, ADAPTED, *HALF], 0.5),
    ("piezo_sine.yaml", ["feedback={kind: integral, bandwidth_hz: 2.0, limit_um: 3.0}"], 1.2),
    ("terfenol_other_rig_uncompensated.yaml", [], 0.5),
]
SCRIPT = """
import json, sys
from pathlib import Path
from hilctl.kernels import jit
from hilctl.run import unpaced
from hilctl.run.start import checked_run

folder, runs = Path(sys.argv[1]), json.loads(sys.argv[2])
drive, compiled, late = unpaced._drive, jit._Kernel._compile, []


def watch(*args):
    jit._Kernel._compile = lambda self: (late.append(self.py_func.__name__), compiled(self))[1]
    try:
        return drive(*args)
    finally:
        jit._Kernel._compile = compiled


unpaced._drive = watch
samples = 0
for number, (path, settings) in enumerate(runs):
    checked = checked_run(Path(path), settings)
    samples += unpaced.run_unpaced(checked, folder / f"{number}.mcap").samples
print(json.dumps({"late": late, "samples": samples}))
"""


def test_no_kernel_is_loaded_while_a_loop_is_active(tmp_path):
    runs = [
        (str(CONFIGS / name), [*settings, f"waveform.duration_s={seconds}"])
        for name, settings, seconds in RUNS
    ]
    command = [sys.executable, "-P", "-c", SCRIPT, str(tmp_path), json.dumps(runs)]
    found = json.loads(ended(command).stdout)
    assert found["samples"] > 50_000
    assert found["late"] == []


UNCOMPILED = """
import sys
from pathlib import Path
import numpy as np
from hilctl.recording.reader import read
from hilctl.run import unpaced
from hilctl.run.start import checked_run

times = {"duration_s": 0.03, "soft_start_s": 0.01, "soft_end_s": 0.01}
settings = [f"waveform.{name}={value}" for name, value in times.items()]
path = Path(sys.argv[2])
unpaced.run_unpaced(checked_run(Path(sys.argv[1]), settings), path)
columns = read(path).samples.columns()
np.save(path.with_suffix(".npy"), np.array([each for each in columns.values() if each.size]))
"""


def test_run_without_compilation_is_the_same(tmp_path):
    found = []
    for name, told in (("compiled", {}), ("plain", {"NUMBA_DISABLE_JIT": "1"})):
        path = tmp_path / f"{name}.mcap"
        command = [sys.executable, "-P", "-c", UNCOMPILED, str(CONFIGS / RUNS[0][0]), str(path)]
        ended(command, env={**os.environ, **told})
        found.append(np.load(path.with_suffix(".npy")))
    assert found[0].shape[1] >= 1000
    np.testing.assert_array_equal(*found)
