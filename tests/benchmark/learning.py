"""How far learning gets on the simulated rig, frequency by frequency.

Runs go through preflight, loop and recorder in this process, without waiting for real time
(`hilctl learn --fast`). Each run has sensor noise of its own, and 16 steady cycles are averaged.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilctl.learning.session import Learned, Runner, Session
from hilctl.run.result import RunResult
from hilctl.run.start import checked_experiment
from hilctl.run.step import unpaced
from hilctl.run.unpaced import run_unpaced
from hilctl_drivers.simulated.rigs import SimulatedTerfenol, TerfenolOptions

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
SOFT_S = 0.2
CYCLES = 17
PARAMETERS = (
    "lag_s", "lag_growth_m_per_a", "langevin_field_a_per_m", "pinning_max_a_per_m",
    "free_fraction", "weight_decay", "strain_um", "strain_quartic", "stiffness_n_per_m",
    "damping_ratio",
)  # fmt: skip


def other_rig(part: float, signs_seed: int) -> Runner:
    """Return a runner on a rig whose physical parameters are each off by a part, up or down."""
    signs = np.random.default_rng(signs_seed).choice([-1.0, 1.0], len(PARAMETERS))

    def run(path: Path, settings: Sequence[str], output: Path) -> RunResult:
        checked = checked_experiment(path, settings)
        keys = {k: v for k, v in checked.loaded.config.device.items() if k != "kind"}
        device = SimulatedTerfenol(TerfenolOptions(**keys))
        rated = device._parameters
        factors = dict(zip(PARAMETERS, 1.0 + part * signs, strict=True))
        device._parameters = replace(
            rated, **{name: getattr(rated, name) * factor for name, factor in factors.items()}
        )
        loaded = replace(checked.loaded, device=device)
        return run_unpaced(replace(checked, loaded=loaded), output, overwrite=True)

    return run


def learned(frequency_hz: float, args: argparse.Namespace, run: Runner) -> Learned:
    settings = [
        f"waveform.frequency_hz={frequency_hz}",
        f"waveform.duration_s={round(2.0 * SOFT_S + (CYCLES + 0.02) / frequency_hz, 5)}",
        f"device.load_kg={args.load_kg}",
        f"device.seed={args.seed}",
        *([f"compensator.model={args.model.resolve()}"] if args.model else []),
    ]
    with tempfile.TemporaryDirectory(prefix="learning-") as folder:
        return Session(EXPERIMENT, settings, Path(folder), run).learn(args.cycles, lambda _: None)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--frequency-hz", type=float, nargs="+", default=[1, 10, 50, 100, 150, 200, 250]
    )
    parser.add_argument("--cycles", type=int, default=20)
    parser.add_argument("--model", type=Path, help="model file instead of the experiment's")
    parser.add_argument("--load-kg", type=float, default=0.0)
    parser.add_argument("--off-percent", type=float, default=0.0, help="rig's parameters, +-")
    parser.add_argument("--signs", type=int, default=1, help="seed of the signs of those")
    parser.add_argument("--seed", type=int, default=1000, help="of the first run's noise")
    parser.add_argument("--max-percent", type=float, default=0.15)
    args = parser.parse_args()
    run = other_rig(args.off_percent / 100.0, args.signs) if args.off_percent else unpaced
    good = True
    print("     Hz  start %   best %  check %  floor %  runs to <=  highest/start  delay  it ended")
    for frequency_hz in args.frequency_hz:
        found = learned(float(frequency_hz), args, run)
        errors = [row.error_percent for row in found.rows]
        reached = [row.run for row in found.rows if row.error_percent <= args.max_percent]
        check = max((row.error_percent for row in found.check), default=float("nan"))
        highest = max(errors[1:]) / errors[0]
        good &= check <= args.max_percent and highest <= 1.0
        last = found.rows[-1]
        print(
            f"{frequency_hz:7g} {errors[0]:8.4f} {min(errors):8.4f} {check:8.4f} "
            f"{last.floor_percent:8.4f} {reached[0] if reached else 'never':>11} {highest:14.3f} "
            f"{last.delay_samples:6.2f}  {found.reason}",
            flush=True,
        )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
