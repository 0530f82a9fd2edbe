# %% [markdown]
"""# Before and after.

The same motion without and with the inverse, in one figure and one page.
"""

# %%
from pathlib import Path

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "before-and-after"
out.mkdir(parents=True, exist_ok=True)
settings = {"waveform.frequency_hz": 100.0, "waveform.duration_s": 1.0}

# %%
runs = {
    name: api.run(
        examples_folder() / f"{experiment}.yaml",
        out / f"{name}.mcap",
        settings=settings,
        fast=True,
        overwrite=True,
    ).path
    for name, experiment in [
        ("before", "terfenol_sine_6a_uncompensated"),
        ("after", "terfenol_sine_6a"),
    ]
}
for name, path in runs.items():
    print(f"{name}: {api.summarize(path).peak_hysteresis_percent:.2f} % peak hysteresis")

# %% The figures that apply, as axes to go on with, and as files.
figures = api.figures([*runs.values()], out, formats="svg,png", overwrite=True)
print(sorted(figures))
