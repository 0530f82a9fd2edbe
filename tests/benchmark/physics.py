"""Characterise each physics of the simulated rigs as a user does, and evaluate the inverse.

Run it with ``python -m tests.benchmark.physics``; see README.md beside it. One model per rig, of
``hilctl characterise --fast``, drives all references. The rig starts from rest at each reference,
without noise; nothing is learned or fed back.
"""

import argparse
import json
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from hilctl import api
from hilctl.base.types import F64
from hilctl.experiment.load import load_experiment
from hilctl.experiment.sections.compensator import begin, rests_at
from hilctl.lab.identify.evaluation import QUANTILE
from hilctl.loop.compensator import Compensator
from hilctl.models.base import STROKES, HysteresisModel, stroke_class
from hilctl.models.model_file import load_model
from hilctl.signals.cycle_metrics import expected_maximum
from hilctl_drivers.simulated.actuator_base import Plant
from hilctl_drivers.simulated.simulated_device import SimulatedDevice
from tests.benchmark.references import GOALS, RATE_HZ, Row, Stroke, references
from tests.rigs import register

register()

CONFIGS = Path(__file__).parents[2] / "configs"
LEAF_STAGES = {
    "plain": (),
    "accommodation": ("forgetting=0.05",),
    "creep": ("creep_percent=1.2",),
    "friction": ("rubbing_um=0.4",),
    "two_modes": ("modes=[[760, 0.03, 0.7], [930, 0.03, 0.3]]",),
}
LEAF_STAGES["all"] = tuple(each for added in LEAF_STAGES.values() for each in added)
DRAWS = (1, 2, 3)
RIGS: dict[str, tuple[str, ...]] = {
    "pinned_cells": ("terfenol_sine_6a.yaml",),
    **{
        name: ("terfenol_sine_6a.yaml", f"device.kind=simulated_{name}")
        for name in ("domains", "diffusion", "jiles_atherton", "growing_lag")
    },
    "thermal_switching": (
        "piezo_sine.yaml",
        "device.kind=simulated_thermal_switching",
        "limits.slew_v_per_s=200000",
    ),
    **{
        f"leaf_stage_{name}": (
            "piezo_sine.yaml",
            "device.kind=simulated_leaf_stage",
            "limits.slew_v_per_s=200000",
            "limits.stroke_um=[-5, 40]",
            *(f"device.{each}" for each in added),
        )
        for name, added in LEAF_STAGES.items()
    },
    **{
        f"anisotropic_rod_{draw}": (
            "terfenol_sine_6a.yaml",
            "device.kind=simulated_anisotropic_rod",
            "limits.stroke_um=[-145, 145]",
            f"device.draw={draw}",
        )
        for draw in DRAWS
    },
    **{
        f"relaxor_{draw}": (
            "piezo_sine.yaml",
            "device.kind=simulated_relaxor",
            "limits.slew_v_per_s=200000",
            "limits.stroke_um=[-5, 48]",
            f"device.draw={draw}",
        )
        for draw in DRAWS
    },
}
"""Experiment file and settings of each rig."""
MARGIN = 0.06  # of the range that a model was identified on, at either end
SLACK = 1.25  # of the promised error


@dataclass(frozen=True, slots=True)
class Result:
    """Error on one reference, in percent of its own peak-to-peak.

    Attributes:
        goal: Largest peak error allowed.
        stroke: Class of its stroke.
        promise: Expected peak error by the model file, for that class.
        peak: Largest error of the displacement without sensor noise, offset included.
        mean: Mean error, the offset.
        noise: Largest sensor noise expected in as many samples.
        floor: Largest effect of half a DAC code, and half an ADC code: the resolution of the rig.
        over: Largest command outside the limits, in percent of their range; a run would be refused.
    """

    group: str
    reference: str
    goal: float
    stroke: str
    promise: float
    peak: float
    mean: float
    noise: float
    floor: float
    over: float


def driven(plant: Plant, command: F64) -> F64:
    """Return the readings of a rig from rest, float64[n], each before its command has an effect."""
    displacement_um, measured = np.empty_like(command), np.empty_like(command)
    plant.reset()
    plant.step(command, displacement_um, measured)
    return displacement_um


def compensated(model: HysteresisModel, reference_um: F64) -> F64:
    """Return the commands for a reference from rest, float64[n], as a run has them."""
    compensator = Compensator(model, RATE_HZ)
    begun = begin(model, RATE_HZ, reference_um)
    if begun.state is not None:
        compensator.restore(begun.state)
    command = np.empty_like(reference_um)
    compensator.process(begun.input_um, command)
    return command


@dataclass(frozen=True, slots=True)
class Rig:
    """A simulated rig without noise, with the model that was identified on it with noise."""

    plant: Plant
    command_step: float  # one DAC code
    command_range: tuple[float, float]
    noise_um: float
    model: HysteresisModel

    @classmethod
    def characterised(cls, file: str, settings: Sequence[str], folder: Path) -> "Rig":
        """Characterise a rig; earlier recordings in the folder are used again."""
        experiment, output = CONFIGS / file, folder / "model.yaml"
        output.unlink(missing_ok=True)
        settings = [f"sample_rate_hz={RATE_HZ:g}", *settings]
        result = api.characterise(experiment, output, settings=settings, fast=True)
        if result is None or result.verdict is None or not result.is_model:
            raise SystemExit(f"no model: {result and (result.problem or result.verdict)}")
        loaded = load_experiment(experiment, [*settings, "device.noise=false"])
        device, rest = loaded.device, result.measured.rest
        assert isinstance(device, SimulatedDevice)
        return cls(
            device.plant(RATE_HZ),
            device.info.command_step,
            loaded.config.limits.command_range,
            rest.noise_um if rest else 0.0,
            load_model(output),
        )

    def rows(self) -> Iterator[Row]:
        """Yield the references within the model's range, less a margin."""
        assert self.model.output_range_um is not None
        low_um, high_um = self.model.output_range_um
        margin_um = MARGIN * (high_um - low_um)
        rest_um = rests_at(self.model, RATE_HZ, 0.0)
        return references(Stroke(low_um + margin_um, high_um - margin_um, rest_um))

    def result(self, row: Row) -> Result:
        """Return the error on a reference."""
        command = compensated(self.model, row.reference_um)
        reading_um = driven(self.plant, command)[row.judged]
        shifted_um = driven(self.plant, command + self.command_step)[row.judged]
        error_um = reading_um - row.reference_um[row.judged]
        span_um = float(np.ptp(row.reference_um[row.judged]))
        to_percent = 100.0 / span_um
        known = self.model.provenance.identified_range
        assert known is not None
        stroke = stroke_class(span_um / known.peak_to_peak_um[1])
        low, high = self.command_range
        outside = max(float(command.max()) - high, low - float(command.min()), 0.0)
        return Result(
            group=row.group,
            reference=row.name,
            goal=GOALS[row.group],
            stroke=stroke,
            promise=self.model.provenance.errors_by_stroke.get(stroke, math.inf),
            peak=to_percent * float(np.max(np.abs(error_um))),
            mean=to_percent * float(error_um.mean()),
            noise=to_percent * self.noise_um * expected_maximum(error_um.size),
            floor=to_percent * 0.5 * float(np.max(np.abs(shifted_um - reading_um))),
            over=100.0 * outside / (high - low),
        )


HEADINGS = f"{'':28} {'peak %':>7} {'mean':>7} {'noise':>6} {'floor':>6} {'goal':>5} {'promise':>7}"


def line(result: Result) -> str:
    """Return the row of a table."""
    text = f"{result.reference:28} {result.peak:7.3f} {result.mean:7.3f} {result.noise:6.2f}"
    text += f" {result.floor:6.3f} {result.goal:5g} {result.promise:7.2f}"
    missed = "  missed" if result.peak > result.goal else ""
    return text + missed + (f"  {result.over:.1f} % beyond the limits" if result.over else "")


def summary(results: Sequence[Result]) -> dict[str, dict[str, Any]]:
    """Return the worst error of each class, and the shares of goals met and of promises held."""
    found = {}
    for group in GOALS:
        if rows := [result for result in results if result.group == group]:
            worst = max(rows, key=lambda row: row.peak)
            met = sum(row.peak <= row.goal for row in rows) / len(rows)
            held = sum(row.peak <= SLACK * row.promise for row in rows) / len(rows)
            found[group] = {"worst": worst.peak, "goal": worst.goal, "met": met, "held": held}
    return found


def promises(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return the 90 % quantile of the errors of each class of strokes, and the promise over it."""
    found = {}
    for stroke in STROKES:
        if rows := [result for result in results if result.stroke == stroke]:
            quantile = float(np.percentile([row.peak for row in rows], QUANTILE))
            promise = rows[0].promise
            found[stroke] = {"promise": promise, "error": quantile, "ratio": promise / quantile}
    return found


def show(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Print the tables of one rig, and return them as a mapping."""
    say = partial(print, file=sys.stderr if options.json else sys.stdout, flush=True)
    file, *settings = RIGS[name]
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)) / name
        folder.mkdir(parents=True, exist_ok=True)
        settings += [f"device.seed={options.seed}", *options.set]
        rig = Rig.characterised(file, settings, folder)
    say(f"\n{' '.join([name, *options.set])}\n{HEADINGS}")
    results = []
    for row in rig.rows():
        if not options.rows or any(part in row.name for part in options.rows):
            results.append(rig.result(row))
            say(line(results[-1]))
    groups = summary(results)
    say(f"{'class':12} {'worst %':>7} {'goal':>5} {'met':>5} {'promise':>7}")
    for group, of in groups.items():
        say(f"{group:12} {of['worst']:7.3f} {of['goal']:5g} {of['met']:5.0%} {of['held']:7.0%}")
    strokes = promises(results)
    say(f"{'stroke':16} {'promise':>7} {'90 % of references':>18} {'ratio':>5}")
    for stroke, of in strokes.items():
        say(f"{stroke:16} {of['promise']:7.2f} {of['error']:18.2f} {of['ratio']:5.2f}")
    return {
        "rig": name,
        "settings": settings,
        "strokes": strokes,
        "classes": groups,
        "rows": [asdict(result) for result in results],
    }


def main() -> int:
    """Run the benchmark; the exit code is 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--rigs", nargs="*", default=list(RIGS), choices=list(RIGS))
    parser.add_argument("--seed", type=int, default=3, help="of the sensor noise")
    parser.add_argument("--rows", nargs="*", default=[], help="parts of names of references")
    parser.add_argument("--set", action="append", default=[], help="key=value of the experiment")
    parser.add_argument("--folder", type=Path, help="keep the recordings, and use them again")
    parser.add_argument("--json", action="store_true", help="tables go to standard error")
    options = parser.parse_args()
    tables = [show(name, options) for name in options.rigs]
    if options.json:
        print(json.dumps(tables, indent=1))
    met = all(row["peak"] <= row["goal"] for table in tables for row in table["rows"])
    return int(not met)


if __name__ == "__main__":
    sys.exit(main())
