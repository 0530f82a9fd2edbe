# %% [markdown]
"""# Learn what a model leaves.

A reference that repeats can be met to the noise: iterative learning control adds, run by run,
what the last run was short of.
"""

# %%
from pathlib import Path

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "learn"
out.mkdir(parents=True, exist_ok=True)
experiment = examples_folder() / "terfenol_sine_6a.yaml"
settings = {"waveform.frequency_hz": 100.0, "waveform.duration_s": 1.0}

# %%
learned = api.learn(
    experiment,
    out / "correction.yaml",
    cycles=4,
    settings=settings,
    fast=True,
    overwrite=True,
    on_rows=lambda rows: print(f"run {rows[0].run}: {rows[0].error_percent:.3f} %"),
)
print(learned.reason)

# %% From now on the correction is part of the experiment.
corrected = api.run(
    experiment,
    out / "corrected.mcap",
    settings=settings | {"compensator.correction": str((out / "correction.yaml").resolve())},
    fast=True,
    overwrite=True,
)
print(f"{api.summarize(corrected.path).peak_error_percent:.3f} % peak error")
