"""A comparison of three models on a tracked recording."""

from pathlib import Path

import pytest

from hilctl.lab.comparison.compare import compare
from hilctl.lab.identify.fit_api import ignore_progress
from tests.fakes import SteppingClock

ROOT = Path(__file__).parents[4]
GOLDEN = ROOT / "recordings" / "golden" / "terfenol_uncompensated.mcap"
OMEGA = ROOT / "configs" / "models" / "terfenol_omega.yaml"


def compared(path=GOLDEN, models=("straight",), progress=ignore_progress, **options):
    return compare([path], models, clock=SteppingClock(1e-3), progress=progress, **options)


@pytest.fixture(scope="package")
def comparison():
    """Two models of the catalogue and one of a file, tried at 100 Hz."""
    return compared(models=["duhem", "straight", str(OMEGA)], frequencies_hz=[100.0])
