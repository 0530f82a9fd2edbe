# %% [markdown]
"""# Samples for MATLAB, and for everything else.

Numbers are kept bit for bit.
"""

# %%
from pathlib import Path

from scipy.io import loadmat

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "handover"
out.mkdir(parents=True, exist_ok=True)
run = api.run(
    examples_folder() / "terfenol_sine_6a.yaml",
    out / "run.mcap",
    settings={"waveform.frequency_hz": 50.0, "waveform.duration_s": 0.8},
    fast=True,
    overwrite=True,
)

# %% In MATLAB: s = load('run.mat'); plot(s.reference_um, s.displacement_um)
for suffix in (".mat", ".csv", ".npz"):
    rows = api.export(run.path, out / f"run{suffix}", overwrite=True)
    print(f"run{suffix}: {rows} samples")

# %% What MATLAB gets is what was recorded.
table = api.read(run.path).table
matlab = loadmat(out / "run.mat")
print((matlab["displacement_um"].ravel() == table["displacement_um"]).all())
