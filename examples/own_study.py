# %% [markdown]
"""# A study of your own.

The results of the runs choose the next experiment: here the amplitude for a stroke.
"""

# %%
from pathlib import Path

from hilctl import api
from hilctl.experiment.examples import examples_folder

out = Path("examples-out") / "own-study"
experiment = examples_folder() / "terfenol_sine_6a_uncompensated.yaml"
STROKE_UM = 60.0

# %% A study yields an experiment, receives its run, and returns the result.


def amplitude_for(stroke_um):
    """Approach the amplitude for a stroke in µm."""
    amplitude = 3.0
    while True:
        settings = {"waveform.amplitude": amplitude, "waveform.duration_s": 0.5}
        run = yield api.StudyStep(experiment, settings, text=f"{amplitude:.3f} A")
        moved_um = api.summarize(run.path).peak_to_peak_um
        how = "done earlier" if run.kept else "run"
        print(f"{amplitude:.3f} A: {moved_um:.2f} µm ({how})")
        if abs(moved_um - stroke_um) < 0.5:
            return amplitude
        amplitude *= stroke_um / moved_um


# %%
amplitude = api.study(amplitude_for(STROKE_UM), out, fast=True)
print(f"{STROKE_UM:g} µm need {amplitude:.2f} A")

# %% The recordings are the checkpoint: the same study again runs nothing.
api.study(amplitude_for(STROKE_UM), out, fast=True)
