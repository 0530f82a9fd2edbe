"""Identify a model on each physics of the simulated rig, and judge its inverse on all references.

Run it with ``python -m tests.benchmark.physics``; see README.md beside it. The campaign is
``configs/identify_any.yaml``. The rig that the inverse drives has other noise than the one that the
model was identified on, and starts from rest at each reference; nothing is learned or fed back.
Errors are percent of the reference's own peak-to-peak.
"""

import argparse
import copy
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from hilctl.base.types import F64
from hilctl.experiment.conditioning import conditioning_of
from hilctl.experiment.device_state import InitialState, begin, left_by
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.identify.data.records import History
from hilctl.identify.fit_api import FitRequest
from hilctl.identify.fit_model import FittedModel
from hilctl.identify.pipeline import identify_records, settings_from
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import load_model
from hilctl.waveforms.build import build
from hilctl_drivers.simulated.devices import PHYSICS, Physics, TerfenolOptions
from hilctl_drivers.simulated.terfenol import TerfenolActuator
from tests.benchmark.references import RATE_HZ, Row, Stroke, random, references

CAMPAIGN = Path(__file__).parents[2] / "configs" / "identify_any.yaml"
OMEGA = CAMPAIGN.parent / "models" / "terfenol_omega.yaml"
MARGIN = 0.06  # of the range that a model was identified on, at either end
MOST_A = 8.0
EXTRAS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "creep": ("creep", {"share": 0.05}),
    "thermal": (
        "thermal",
        {"rise_k_per_a2": 0.5, "tau_s": 60.0, "growth_um_per_k": 0.5, "ambient_k": 2.0},
    ),
    "second_mode": ("second_mode", {"frequency_hz": 1200.0, "damping_ratio": 0.05, "share": 0.03}),
    "low_mode": ("second_mode", {"frequency_hz": 600.0, "damping_ratio": 0.03, "share": 0.1}),
    "opposite_mode": (
        "second_mode",
        {"frequency_hz": 450.0, "damping_ratio": 0.02, "share": -0.05},
    ),
    "amplifier": (
        "amplifier",
        {"voltage_max_v": 60.0, "resistance_ohm": 2.0, "inductance_h": 5e-3},
    ),
}
"""Options of the rig and what they are set to, see ``extras.py`` of the simulated rig."""

Drive: TypeAlias = Callable[[Row], tuple[F64, TerfenolActuator]]
"""Gives the commands for a reference, and the rig as it stands before them."""


@dataclass(frozen=True, slots=True)
class Figures:
    """How far a displacement was from its reference, in percent of its peak-to-peak.

    Attributes:
        peak: Largest error as the sensor reads it.
        bare: The same less the mean error.
        rms: Of the sensor's error less its mean.
        aside: Largest error with the sensor's noise aside, offset included.
        rms_aside: The same root-mean-square.
    """

    peak: float
    bare: float
    rms: float
    aside: float
    rms_aside: float

    def share_of_goal(self, row: Row) -> float:
        """Return the error over what is asked for; met up to 1."""
        rms = self.rms_aside / row.rms_goal if row.rms_goal else 0.0
        return max(self.aside / row.goal, rms)


@dataclass(frozen=True, slots=True)
class Result:
    """How one reference was followed."""

    row: Row
    noise: float
    figures: Mapping[str, Figures]

    def to_mapping(self) -> dict[str, Any]:
        row = self.row
        goals = {"reference": row.name, "goal": row.goal, "rms_goal": row.rms_goal}
        return goals | {"noise": self.noise} | {k: asdict(v) for k, v in self.figures.items()}


class Rig:
    """The simulated rig of one physics, anew for each run."""

    def __init__(self, physics: Physics, extras: Sequence[str]) -> None:
        self.physics = physics
        chosen = dict(EXTRAS[name] for name in extras)
        self._options = TerfenolOptions.model_validate({"physics": physics, **chosen})

    def at_rest(self, *, noise: bool = False, seed: int = 1) -> TerfenolActuator:
        options = self._options.model_copy(update={"noise": noise})
        return TerfenolActuator(options.parameters(), RATE_HZ, seed=seed)


def driven(rig: TerfenolActuator, command: F64) -> F64:
    displacement_um, measured = np.empty_like(command), np.empty_like(command)
    rig.step(np.ascontiguousarray(command), displacement_um, measured)
    return displacement_um


def identified(rig: Rig, kind: str, seed: int) -> tuple[FittedModel, float]:
    """Return a model of the campaign on one rig, and the processor time it took."""
    experiment = load_experiment(CAMPAIGN)
    waveform = build(experiment.config.waveform, RATE_HZ, CAMPAIGN.parent)
    command = waveform.values.copy()
    measured = driven(rig.at_rest(noise=True, seed=seed), command)
    records = [History("campaign", command, measured, RATE_HZ)]
    start = time.process_time()
    found = identify_records(FitRequest(records, settings_from(kind, []), "A"))
    return found.fit, time.process_time() - start


def after_conditioning(
    rig: Rig, model: HysteresisModel
) -> tuple[LoadedExperiment, InitialState, TerfenolActuator]:
    """Return where a decaying cycle leaves the model, and the rig."""
    loaded = load_experiment(CAMPAIGN, ["condition={}"])
    conditioning = conditioning_of(loaded)
    assert conditioning is not None
    stands = rig.at_rest()
    driven(stands, conditioning.command)
    return loaded, left_by([conditioning.command], model, RATE_HZ), stands


def compensated(model: HysteresisModel, reference_um: F64, before: InitialState | None) -> F64:
    """Return the commands for a reference, as a run has them."""
    compensator = Compensator(model, RATE_HZ)
    begun = begin(model, RATE_HZ, reference_um, before)
    if begun.state is not None:
        compensator.restore(begun.state)
    command = np.empty_like(reference_um)
    compensator.process(begun.input_um, command)
    return np.clip(command, -MOST_A, MOST_A)


def drives(rig: Rig, model: HysteresisModel, *, conditioned: bool) -> dict[str, Drive]:
    """Return how the rig is driven: from rest and, if wanted, after a decaying cycle."""

    def from_rest(row: Row) -> tuple[F64, TerfenolActuator]:
        return compensated(model, row.reference_um, None), rig.at_rest()

    found: dict[str, Drive] = {"from rest": from_rest}
    if conditioned:
        loaded, left, stands = after_conditioning(rig, model)

        def after(row: Row) -> tuple[F64, TerfenolActuator]:
            # References are shorter than the way from where the actuator stands: that comes first.
            way = loaded.config.lead_in_samples
            rested_um = np.concatenate((np.full(way, row.reference_um[0]), row.reference_um))
            command = compensated(model, left.lead_in(rested_um, way)[:], left)
            rig_then = copy.deepcopy(stands)
            driven(rig_then, command[:way])
            return command[way:], rig_then

        found["conditioned"] = after
    return found


def judged(row: Row, drive: Drive, noise_um: F64) -> Figures:
    """Return how far the rig is from a reference."""
    command, stands = drive(row)
    error = (driven(stands, command) - row.reference_um)[row.judged]
    read = error + noise_um[row.judged]
    bare = read - float(np.mean(read))
    to_percent = 100.0 / float(np.ptp(row.reference_um[row.judged]))
    figures = (
        np.max(np.abs(read)),
        np.max(np.abs(bare)),
        np.std(read),
        np.max(np.abs(error)),
        np.sqrt(np.mean(error**2)),
    )
    return Figures(*(to_percent * float(figure) for figure in figures))


def judge(
    rows: Sequence[Row], ways: Mapping[str, Drive], shown: Callable[[Result], None]
) -> list[Result]:
    """Return how all references were followed, each of them shown as it comes."""
    results = []
    noise_rms_um = TerfenolOptions().parameters().sensor_noise_um
    for i, row in enumerate(rows):
        noise_um = noise_rms_um * np.random.default_rng(100 + i).standard_normal(row.judged.size)
        noise = float(np.max(np.abs(noise_um[row.judged])))
        noise *= 100.0 / float(np.ptp(row.reference_um[row.judged]))
        figures = {name: judged(row, drive, noise_um) for name, drive in ways.items()}
        results.append(Result(row, noise, figures))
        shown(results[-1])
    return results


def cost_us(model: HysteresisModel, reference_um: F64) -> float:
    """Return processor time of the inverse, in us a sample, the best of some."""
    took = []
    for _ in range(5):
        inverse = model.inverse(RATE_HZ)
        start = time.process_time()
        inverse.process(reference_um.copy())
        took.append(time.process_time() - start)
    return 1e6 * min(took) / reference_um.size


def line(result: Result, names: Sequence[str]) -> str:
    row, rest = result.row, result.figures["from rest"]
    text = f"{row.name:20} {rest.peak:7.2f} {rest.bare:8.2f} {rest.rms:6.3f} {result.noise:6.2f}"
    for name in names:
        figures = result.figures[name]
        text += f" | {figures.aside:6.2f} {figures.rms_aside:6.3f}"
    goals = f"{row.goal:g}" + (f", {row.rms_goal:g} rms" if row.rms_goal else "")
    missed = [name for name in names if result.figures[name].share_of_goal(row) > 1.0]
    return f"{text} | {goals}" + (f"  missed {', '.join(missed)}" if missed else "")


def summary(results: Sequence[Result], name: str) -> tuple[str, bool]:
    """Return how many goals were met, in words, and whether all were."""
    shares = [(result.figures[name].share_of_goal(result.row), result.row) for result in results]
    met = sum(share <= 1.0 for share, _ in shares)
    worst, row = max(shares, key=lambda each: each[0])
    text = f"{name}: {met} of {len(shares)} met, worst {worst:.1f} times its goal ({row.name})"
    return text, met == len(shares)


def show(rig: Rig, options: argparse.Namespace) -> tuple[dict[str, Any], bool]:
    """Print the table of one physics; return it as mappings, and whether every goal is met."""
    fit, took_s = identified(rig, options.model, options.seed)
    provenance = fit.model.provenance
    taken = provenance.method if provenance else ""
    low_um, high_um = fit.model.output_range_um or (-50.0, 35.0)
    margin = MARGIN * (high_um - low_um)
    inside = Stroke(low_um + margin, high_um - margin)
    timed_um = inside.row("", (1.0, None), 0.6 * random(9)).reference_um
    cost, omega = cost_us(fit.model, timed_um), cost_us(load_model(OMEGA), timed_um)
    rows = [row for row in references(inside.low_um, inside.high_um) if wanted(row, options.rows)]
    names = ["from rest", *(["conditioned"] if options.conditioned else [])]
    say = partial(print, file=sys.stderr if options.json else sys.stdout, flush=True)
    say(f"\n{' '.join([rig.physics, *options.options])}, {options.model}, {taken}: "
        f"{took_s:.1f} s of processor time, inverse {cost:.2f} us a sample, "
        f"Omega {omega:.2f}")  # fmt: skip
    say(f"{'reference':20} {'peak %':>7} {'no mean':>8} {'rms %':>6} {'noise':>6}"
        + "".join(f" | {name:>13}" for name in names) + " | goal")  # fmt: skip
    ways = drives(rig, fit.model, conditioned=options.conditioned)
    results = judge(rows, ways, lambda result: say(line(result, names)))
    sums = [summary(results, name) for name in names]
    for text, _ in sums:
        say(f"{rig.physics}, {text}")
    table = {
        "physics": rig.physics,
        "options": list(options.options),
        "model": taken,
        "fit_s": took_s,
        "inverse_us": cost,
        "omega_us": omega,
        "rows": [result.to_mapping() for result in results],
    }
    return table, all(met for _, met in sums)


def wanted(row: Row, parts: Sequence[str]) -> bool:
    """Return whether a row is asked for: all are where no part of a name is given."""
    return not parts or any(part in row.name for part in parts)


def main() -> int:
    """Run the benchmark; the exit code is 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--physics", nargs="*", default=list(PHYSICS), choices=list(PHYSICS))
    parser.add_argument("--model", default="field", help="kind of model, or auto")
    parser.add_argument("--seed", type=int, default=3, help="noise that it is identified under")
    parser.add_argument("--rows", nargs="*", default=[], help="parts of names of references")
    parser.add_argument("--options", nargs="*", default=[], choices=list(EXTRAS))
    parser.add_argument("--condition", dest="conditioned", action="store_true")
    parser.add_argument("--json", action="store_true", help="tables go to standard error")
    options = parser.parse_args()
    shown = [show(Rig(physics, options.options), options) for physics in options.physics]
    if options.json:
        print(json.dumps([table for table, _ in shown], indent=1))
    return int(not all(met for _, met in shown))


if __name__ == "__main__":
    sys.exit(main())
