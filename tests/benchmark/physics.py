"""Identify a model on each physics of the simulated rig, and judge its inverse on all references.

Run it with ``python tests/benchmark/physics.py``; see README.md beside it. The campaign is
``configs/identify_any.yaml``. The rig that the inverse drives has other noise than the one that the
model was identified on, and starts from rest at each reference; nothing is learned or fed back.
Errors are percent of the reference's own peak-to-peak, with their mean and without it. The floor is
what the sensor's noise alone makes of it.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from hilctl.base.arrays import F64
from hilctl.experiment.load import load_experiment
from hilctl.identify.data.records import History
from hilctl.identify.fit_model import FittedModel, fit_model
from hilctl.identify.settings import FitKind, FitSettings
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel
from hilctl.waveforms.build import build
from hilctl_drivers.simulated.rigs import PHYSICS, Physics, TerfenolOptions
from hilctl_drivers.simulated.terfenol import TerfenolActuator

RATE_HZ = 50_000.0
CAMPAIGN = Path(__file__).parents[2] / "configs" / "identify_any.yaml"
PARTS = (1.0, 0.5, 0.25, 0.1)
FREQUENCIES_HZ = (1.0, 50.0, 100.0, 250.0)
UNJUDGED = 250  # samples at the end, where the reference that an inverse looks ahead to stops
GOAL, SMALL_GOAL, RANDOM_GOAL = 0.5, 1.0, 1.5


def driven(physics: Physics, command: F64, seed: int) -> F64:
    """Return the displacement that a rig at rest answers with."""
    options = TerfenolOptions(physics=physics)
    rig = TerfenolActuator(options.parameters(), RATE_HZ, seed=seed)
    displacement_um, measured = np.empty_like(command), np.empty_like(command)
    rig.step(np.ascontiguousarray(command), displacement_um, measured)
    return displacement_um


def swelling(time_s: F64, over_s: float) -> F64:
    """Return a raised cosine from 0 to 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(time_s / over_s, 0.0, 1.0)))


def sine_um(middle_um: float, amplitude_um: float, frequency_hz: float) -> tuple[F64, int]:
    """Return a reference, and its first sample that is judged."""
    begin_s = max(0.04, 1.0 / frequency_hz)
    samples = round((begin_s + max(0.04, 2.0 / frequency_hz)) * RATE_HZ) + UNJUDGED
    time_s = np.arange(samples) / RATE_HZ
    wave = np.sin(2.0 * np.pi * frequency_hz * time_s)
    return swelling(time_s, begin_s) * (middle_um + amplitude_um * wave), round(begin_s * RATE_HZ)


def random_um(middle_um: float, amplitude_um: float, seed: int) -> tuple[F64, int]:
    """Return a band-limited random reference, 5 to 200 Hz, and its first sample that is judged."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(0.8 * RATE_HZ)) / RATE_HZ
    sines = [
        np.sin(2.0 * np.pi * frequency * time_s + rng.uniform(0.0, 2.0 * np.pi))
        for frequency in rng.uniform(5.0, 200.0, 40)
    ]
    wave = np.sum(sines, axis=0)
    wave *= amplitude_um / np.max(np.abs(wave))
    return swelling(time_s, 0.05) * (middle_um + wave), round(0.05 * RATE_HZ)


def references(low_um: float, high_um: float) -> Iterator[tuple[str, float, F64, int]]:
    """Give name, goal, reference and first judged sample of each."""
    middle, half = 0.5 * (low_um + high_um), 0.5 * (high_um - low_um)
    for part in PARTS:
        places = {"": 0.0} if part == 1.0 else {"": 0.0, " low": part - 1.0, " high": 1.0 - part}
        for name, place in places.items():
            for frequency_hz in FREQUENCIES_HZ:
                wave, first = sine_um(middle + place * half, part * half, frequency_hz)
                goal = GOAL if part == 1.0 else SMALL_GOAL
                yield f"{100 * part:.0f} %{name}, {frequency_hz:g} Hz", goal, wave, first
    for part, seed in ((1.0, 5), (0.5, 6)):
        wave, first = random_um(middle, part * half, seed)
        yield f"random {100 * part:.0f} %", RANDOM_GOAL, wave, first


def judged(
    physics: Physics, model: HysteresisModel, reference_um: F64, first: int, seed: int
) -> tuple[float, float, float, float]:
    """Return peak error with its mean and without, rms, and the noise's peak, in percent."""
    compensator = Compensator(model, RATE_HZ)
    compensator.begin(reference_um)
    command = np.empty_like(reference_um)
    compensator.process(compensator.ahead(reference_um), command)
    command = np.clip(command, -8.0, 8.0)
    error = (driven(physics, command, seed) - reference_um)[first:-UNJUDGED]
    to_percent = 100.0 / float(np.ptp(reference_um[first:-UNJUDGED]))
    noise = np.random.default_rng(seed).standard_normal(error.size)
    floor = TerfenolOptions().parameters().sensor_noise_um * float(np.max(np.abs(noise)))
    bare = error - float(np.mean(error))
    figures = np.max(np.abs(error)), np.max(np.abs(bare)), np.std(bare), floor
    peak, peak_bare, rms, floor = (float(figure) * to_percent for figure in figures)
    return peak, peak_bare, rms, floor


def identified(physics: Physics, kind: FitKind, seed: int) -> tuple[FittedModel, float]:
    """Return a model of the campaign on one physics, and the processor time it took."""
    experiment = load_experiment(CAMPAIGN)
    waveform = build(experiment.config.waveform, RATE_HZ, CAMPAIGN.parent)
    command = np.array(waveform.values)
    history = History("campaign", command, driven(physics, command, seed), RATE_HZ)
    begin = time.process_time()
    fit = fit_model([history], FitSettings(kind=kind), time.process_time)
    return fit, time.process_time() - begin


def cost_us(model: HysteresisModel, reference_um: F64) -> float:
    """Return processor time of the inverse, in us a sample, the best of some."""
    took = []
    for _ in range(5):
        inverse = model.inverse(RATE_HZ)
        begin = time.process_time()
        inverse.process(reference_um.copy())
        took.append(time.process_time() - begin)
    return 1e6 * min(took) / reference_um.size


def show(physics: Physics, kind: FitKind) -> bool:
    """Print the table of one physics; return whether every goal is met."""
    fit, took_s = identified(physics, kind, seed=3)
    low_um, high_um = fit.model.output_range_um or (-50.0, 35.0)
    margin = 0.06 * (high_um - low_um)
    wave, _ = random_um(0.5 * (low_um + high_um), 0.3 * (high_um - low_um), 9)
    print(f"\n{physics}, {kind}: {took_s:.1f} s of processor time, "
          f"inverse {cost_us(fit.model, wave):.2f} us a sample")  # fmt: skip
    print(f"{'reference':22} {'peak %':>7} {'no mean':>8} {'rms %':>7} {'noise':>6}  goal")
    met = True
    for i, (name, goal, wave, first) in enumerate(references(low_um + margin, high_um - margin)):
        peak, bare, rms, floor = judged(physics, fit.model, wave, first, seed=100 + i)
        good = bare <= max(goal, goal + floor)
        met &= good
        mark = "" if good else "  missed"
        print(f"{name:22} {peak:7.2f} {bare:8.2f} {rms:7.3f} {floor:6.2f}  {goal:g}{mark}",
              flush=True)  # fmt: skip
    return met


def main() -> int:
    """Run the benchmark; the exit code is 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--physics", nargs="*", default=list(PHYSICS), choices=list(PHYSICS))
    parser.add_argument("--model", default="field")
    options = parser.parse_args()
    met = [show(physics, options.model) for physics in options.physics]
    return int(not all(met))


if __name__ == "__main__":
    sys.exit(main())
