"""Tune the feedback of each simulated rig as a user does, and evaluate it against creep and offset.

Run it with ``python -m tests.benchmark.feedback``; see README.md beside it.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from hilctl import api
from hilctl.models.model_file import load_model
from tests.benchmark.physics import CONFIGS, RIGS
from tests.benchmark.references import RATE_HZ as MODEL_RATE_HZ

RIG_NAMES = ("domains", "jiles_atherton", "pinned_cells", "diffusion")
RATE_HZ = 10_000.0
STROKE = 0.88  # of the model's range
SMALL = 0.016  # of the same, peak-to-peak
GOAL_PERCENT, LEAST_DB, LEAST_DEG = 0.3, 6.0, 45.0
SLOW = {"device.creep": {"share": 0.02}, "device.drift": {"um": 5.0, "tau_s": 0.01}}
SOFT = {"unit": "um", "soft_start_s": 0.25, "soft_end_s": 0.2}


def shown(name: str, folder: Path) -> bool:
    """Print margins and errors of a rig; return whether it meets the goals."""
    file, *settings = RIGS[name]
    experiment, path = CONFIGS / file, folder / "model.yaml"
    if not path.exists():
        fixed = [f"sample_rate_hz={MODEL_RATE_HZ:g}", "device.seed=3", *settings]
        api.characterise(experiment, path, settings=fixed, fast=True)
    span = load_model(path).output_range_um
    assert span is not None
    low_um, high_um = span
    plain = dict(each.split("=") for each in settings)
    plain |= {"sample_rate_hz": RATE_HZ, "block": 1, "compensator.model": str(path)}

    def run(label: str, waveform: dict[str, Any], **changes: Any) -> Path:
        output = folder / f"{label}.mcap"
        output.unlink(missing_ok=True)
        keys = plain | {"waveform": SOFT | waveform} | changes
        result = api.run(experiment, settings=keys, output=output, fast=True)
        assert result.code == "completed", result.reason
        return output

    lines = {"first_hz": 5.0, "last_hz": 0.45 * RATE_HZ, "step_hz": 20.0, "duration_s": 4.5}
    small = {"kind": "multisine", "amplitude": 0.5 * SMALL * (high_um - low_um)} | lines
    found = api.tune(run("small", small), folder / "response.yaml", overwrite=True)
    fed = SLOW | {"feedback": found.feedback}
    recorded = api.tune(run("small-fed", small, **fed)).recorded
    assert recorded is not None
    half_um, middle_um = 0.5 * STROKE * (high_um - low_um), 0.5 * (low_um + high_um)
    sine = {"kind": "sine", "amplitude": half_um, "offset": middle_um}
    sine |= {"frequency_hz": 20.0, "duration_s": 1.5}
    errors = []
    for label, changes in (("sine", SLOW), ("sine-fed", fed)):
        (segment,) = api.summarize(run(label, sine, **changes)).segments
        errors.append(float(segment.peak_error_percent or 0.0))
    margins = f"{recorded.gain_margin_db:8.1f} {recorded.phase_margin_deg:6.1f}"
    proposed = found.feedback["bandwidth_hz"]
    print(f"{name:16} {proposed:8g} {margins} {errors[0]:9.3f} {errors[1]:7.3f}", flush=True)
    held = recorded.gain_margin_db >= LEAST_DB and recorded.phase_margin_deg >= LEAST_DEG
    return held and errors[1] <= GOAL_PERCENT


def main() -> int:
    """Run the benchmark; the exit code is 1 if a rig misses a goal."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--rigs", nargs="*", default=list(RIG_NAMES), choices=list(RIG_NAMES))
    parser.add_argument("--folder", type=Path, help="keep the models, and use them again")
    options = parser.parse_args()
    print(f"{'':16} {'Hz':>8} {'dB':>8} {'deg':>6} {'without %':>9} {'with %':>7}")
    with tempfile.TemporaryDirectory() as temporary:
        met = []
        for name in options.rigs:
            folder = (options.folder or Path(temporary)) / name
            folder.mkdir(parents=True, exist_ok=True)
            met.append(shown(name, folder))
    return int(not all(met))


if __name__ == "__main__":
    sys.exit(main())
