# %% [markdown]
"""# A first run.

A sine of 6 A through the simulated Terfenol-D rig: run it, read the recording, look at the loop.
"""

# %%
from pathlib import Path

import matplotlib.pyplot as plt

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "first-run"
out.mkdir(parents=True, exist_ok=True)
experiment = examples_folder() / "terfenol_sine_6a_uncompensated.yaml"

# %% What would it do? Nothing moves.
checked = api.check(experiment)
forecast = checked.forecast
print(f"{forecast.samples} samples, {forecast.command_min:.1f} to {forecast.command_max:.1f} A")

# %% Run it. Settings go over the file by their keys.
result = api.run(
    experiment,
    out / "sine.mcap",
    settings={"waveform.frequency_hz": 100.0, "waveform.duration_s": 1.0},
    fast=True,
    overwrite=True,
)
print(result.code, result.reason)

# %% Figures of the run: hysteresis, errors, timing.
report = api.summarize(result.path)
print(f"peak hysteresis {report.peak_hysteresis_percent:.1f} % of {report.peak_to_peak_um:.1f} µm")

# %% Samples are named columns with units.
run = api.read(result.path, from_s=0.5, to_s=0.6)
print(run.table)

# %%
figure, axes = plt.subplots()
axes.plot(run.table["current_a"], run.table["displacement_um"])
axes.set_xlabel("current (A)")
axes.set_ylabel("displacement (µm)")
figure.savefig(out / "loop.svg")
