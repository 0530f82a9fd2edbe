# %% [markdown]
"""# From a campaign to the figure of a paper.

Frequencies by amplitudes; what is killed goes on where it was. The table is CSV and Parquet.
"""

# %%
from pathlib import Path

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "campaign"
out.mkdir(parents=True, exist_ok=True)
experiment = examples_folder() / "terfenol_sine_6a_uncompensated.yaml"
file = out / "amplitudes.yaml"
file.write_text(f"""\
name: amplitudes
experiment: {experiment}
vary:
  waveform.frequency_hz: [10.0, 50.0, 250.0]
  waveform.amplitude: [2.0, 6.0]
""")

# %%
result = api.campaign(file, out / "runs", settings={"waveform.duration_s": 1.0}, fast=True)
for step, row in result.ordered:
    print(step.text, row.code)
print(*result.tables)

# %% Figures by what varied, 175 mm wide.
figures = api.figures(out / "runs", out / "figures", formats="svg,png", overwrite=True)
print(sorted(figures))

# %% Runs are found again by what they were.
for found in api.list_runs(out / "runs", where="waveform.frequency_hz > 100"):
    print(found["path"])
