# %% [markdown]
"""# A model for your actuator.

A history with loops of all sizes goes through the actuator; a model is identified from its
recording and judged on parts that no fit saw. `api.characterise` does it all for a wired device:
it chooses the history by what it measures.
"""

# %%
from pathlib import Path

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "find-a-model"
out.mkdir(parents=True, exist_ok=True)

# %% Loops at several frequencies, recorded.
history = api.run(
    examples_folder() / "identify_rdpi.yaml", out / "history.mcap", fast=True, overwrite=True
)
print(history.reason)

# %% The rate-dependent Prandtl-Ishlinskii model: plays whose thresholds grow with the rate.
found = api.identify(history.path, out / "model.yaml", model="rdpi", overwrite=True)
print(found.verdict)

# %% What the inverse of it does to a sine that it has not seen.
after = api.run(
    examples_folder() / "terfenol_sine_6a.yaml",
    out / "after.mcap",
    settings={
        "compensator.model": str((out / "model.yaml").resolve()),
        "waveform.amplitude": 11.0,  # within the range that the model was found on
        "waveform.offset": -1.0,
        "waveform.frequency_hz": 70.0,
        "waveform.duration_s": 1.0,
    },
    fast=True,
    overwrite=True,
)
report = api.summarize(after.path)
print(f"peak hysteresis {report.peak_hysteresis_percent:.2f} %")
