"""How well a model found on one rig compensates another: see README.md beside it.

Run it with ``python -m tests.benchmark.robustness``. The simulated rig's lag, pinning, strain and
resonance are each off by 10 %, then it carries loads; every row is the full stroke at 1 to 250 Hz.
Commands come from the compensator and the limiter of a run, and figures from the report of one; no
time passes, so a run takes less than it would.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from hilctl.analysis.figures import SegmentReport
from hilctl.analysis.report import judge
from hilctl.base.errors import InputError
from hilctl.base.samples import Samples
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.loop.compensator import Compensator
from hilctl.loop.limiter import Limiter
from hilctl.models.base import HysteresisModel
from hilctl.models.files import load_model
from hilctl.recording.data import Recording, Ticks
from hilctl.waveforms.build import Reference, build

CONFIGS = Path(__file__).parents[2] / "configs"
EXPERIMENT = CONFIGS / "terfenol_sine_6a.yaml"
STAGED = CONFIGS / "models" / "terfenol_staged.yaml"
FREQUENCIES_HZ = (1.0, 10.0, 50.0, 100.0, 150.0, 200.0, 250.0)
SOFT_S = 0.2
WIDE = ("limits.stroke_um=[-124.0, 124.0]",)  # a load near its resonance; nothing can break
AMPLITUDE_UM, OFFSET_UM = 40.8, -6.9
RIGS = {
    "as identified": (),
    **{
        f"{name} {100.0 * (factor - 1.0):+.0f} %": (f"device.vary.{name}={factor}",)
        for name in ("lag", "pinning", "strain", "resonance")
        for factor in (0.9, 1.1)
    },
    "load 3.7 kg": ("device.load_kg=3.7",),
    "load 9.2 kg": ("device.load_kg=9.2",),
}


def experiment(
    options: argparse.Namespace, rig: tuple[str, ...], model: HysteresisModel, hz: float
) -> LoadedExperiment:
    """Return the full stroke of one rig at one frequency, some steady cycles long.

    Where the model was not found on all of that stroke, it is as much as the model's range holds.
    """
    low, high = model.output_range_um or (-np.inf, np.inf)
    amplitude = min(AMPLITUDE_UM, 0.5 * (high - low))
    settings = {
        "waveform.frequency_hz": hz,
        "waveform.duration_s": 2.0 * SOFT_S + max(0.1, 2.0 / hz),
        "waveform.amplitude": amplitude,
        "waveform.offset": float(np.clip(OFFSET_UM, low + amplitude, high - amplitude)),
        "device.seed": options.seed,
    }
    return load_experiment(
        EXPERIMENT, [*rig, *(f"{key}={value}" for key, value in settings.items())]
    )


def drive(loaded: LoadedExperiment, model: HysteresisModel, reference: Reference) -> Recording:
    """Compensate a reference on the experiment's device, as a run would, but without its clock."""
    config, device = loaded.config, loaded.device
    compensator = Compensator(model, config.sample_rate_hz)
    limiter = Limiter(config.command_limits(), 1.0 / config.sample_rate_hz)
    values = reference.array()
    wanted, command, flags = np.empty(values.size), np.empty(values.size), _flags(values.size)
    displacement_um, measured = np.empty(values.size), np.empty(values.size)
    compensator.process(compensator.ahead(values), wanted)
    limiter.limit(wanted, command, flags)
    block = device.info.fifo_depth
    device.open(config.sample_rate_hz, block)
    for start in range(0, values.size, block):
        part = slice(start, start + block)
        device.exchange(start, command[part], displacement_um[part], measured[part])
    device.close()
    index = np.arange(values.size)
    return _recording(
        loaded,
        reference,
        Samples(
            index=index,
            reference_um=values,
            wanted=wanted,
            command=command,
            displacement_um=displacement_um,
            measured=measured,
            input_um=values,
            flags=flags,
        ),
    )


def _flags(samples: int) -> np.ndarray:
    return np.zeros(samples, dtype=np.uint32)


def _recording(loaded: LoadedExperiment, reference: Reference, samples: Samples) -> Recording:
    nothing = np.empty(0, dtype=np.int64)
    return Recording(
        path=EXPERIMENT,
        run={},
        end={},
        sample_rate_hz=loaded.config.sample_rate_hz,
        command_unit=loaded.device.info.command_unit,
        compensated=True,
        segments=reference.segments,
        samples=samples,
        dropped=0,
        ticks=Ticks(nothing, nothing, nothing, nothing),
        events=(),
        experiment_yaml=loaded.yaml_text,
        model_yaml="",
    )


def identified(options: argparse.Namespace, rig: tuple[str, ...], folder: Path) -> HysteresisModel:
    """Run the campaign on a rig and identify it anew, by the commands that a user has.

    Raises:
        InputError: The campaign or the identification did not come to its end; the text says why.
    """
    settings = [part for setting in (*rig, *WIDE, "device.seed=1") for part in ("--set", setting)]
    loops, model = folder / "loops.mcap", folder / "model.yaml"
    _hilctl("run", str(options.campaign), *settings, "--output", str(loops))
    _hilctl("identify", str(loops), "--output", str(model), *options.identify)
    return load_model(model)


def _hilctl(*words: str) -> None:
    command = [sys.executable, "-m", "hilctl", *words, "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = json.loads(done.stdout).get("reason", "") if done.stdout.startswith("{") else ""
        raise InputError(f"hilctl {words[0]}: {said or done.stderr.strip()}")


def figures(
    options: argparse.Namespace, model: HysteresisModel, rig: tuple[str, ...]
) -> list[SegmentReport]:
    """Return the report of one rig at every frequency."""
    found = []
    for hz in options.frequencies:
        loaded = experiment(options, rig, model, hz)
        reference = build(loaded.config.waveform, loaded.config.sample_rate_hz, CONFIGS)
        recording = drive(loaded, model, reference)
        found.append(judge(recording, recording.segments[0]))
    return found


def table(options: argparse.Namespace) -> dict[str, list[SegmentReport]]:
    """Work out and print every row, hysteresis / error in percent."""
    heads = "".join(f"{f'{hz:g} Hz':>14}" for hz in options.frequencies)
    print(f"{'peak hysteresis / error, %':>26}{heads}")
    shipped = load_model(options.model)
    rows = {}
    for name, rig in RIGS.items():
        if options.rigs and not any(part in name for part in options.rigs):
            continue
        try:
            with tempfile.TemporaryDirectory(prefix="hilctl-") as folder:
                again = options.identify is not None
                model = identified(options, rig, Path(folder)) if again else shipped
            rows[name] = figures(options, model, rig)
        except InputError as error:
            print(f"{name:>26}  {error}", flush=True)
            continue
        print(f"{name:>26}" + "".join(f"{_cell(r):>14}" for r in rows[name]), flush=True)
    return rows


def _cell(report: SegmentReport) -> str:
    return f"{report.peak_hysteresis_percent:.2f} / {report.peak_error_percent:.2f}"


def main() -> int:
    """Run the benchmark; the exit code is 1 where a figure is beyond a limit that was given."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    default = STAGED if STAGED.exists() else CONFIGS / "models" / "terfenol_omega.yaml"
    parser.add_argument("--model", type=Path, default=default)
    parser.add_argument("--rigs", nargs="*", help="only rows with one of these in their name")
    parser.add_argument("--frequencies", type=float, nargs="+", default=FREQUENCIES_HZ)
    parser.add_argument("--seed", type=int, default=7, help="of the sensor's noise")
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--max-error", type=float, help="largest peak error in percent")
    campaign = CONFIGS / "identify_staged.yaml"
    parser.add_argument("--campaign", type=Path, default=campaign, help="loops to identify on")
    parser.add_argument(
        "--identify",
        nargs=argparse.REMAINDER,
        help="identify each rig anew; what follows goes to hilctl identify (--model staged)",
    )
    options = parser.parse_args()
    print(f"model: {'of each rig' if options.identify is not None else options.model}")
    rows = table(options)
    if options.json is not None:
        plain = {name: [asdict(r) for r in reports] for name, reports in rows.items()}
        options.json.write_text(json.dumps(plain, indent=1))
    worst = max((r.peak_error_percent for reports in rows.values() for r in reports), default=0.0)
    print(f"largest peak error {worst:.2f} %")
    return int(options.max_error is not None and worst > options.max_error)


if __name__ == "__main__":
    sys.exit(main())
