"""The terminal table of a comparison."""

from pathlib import Path

import pytest

from hilctl.cli.compare_view import headings, notes, render, table_rows
from hilctl.comparison.compare import ComparisonRequest, compare
from tests.fakes import SteppingClock

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "recordings" / "golden" / "terfenol_uncompensated.mcap"
OMEGA = ROOT / "configs" / "models" / "terfenol_omega.yaml"


def ignore(done, text):
    """Take a progress report."""


@pytest.fixture(scope="module")
def comparison():
    """Two models of the catalogue and one of a file, tried at 100 Hz."""
    request = ComparisonRequest([GOLDEN], ["duhem", "straight", str(OMEGA)], frequencies_hz=[100.0])
    return compare(request, SteppingClock(1e-3), ignore)


def test_the_table_has_a_column_a_trial(comparison):
    """Each row has as many texts as there are columns."""
    rows = list(table_rows(comparison))
    assert headings(comparison)[-1] == "100 Hz"
    assert {len(row) for row in rows} == {len(headings(comparison))}
    assert rows[2][1:3] == ["-", "-"]
    assert render(comparison) is not None
    assert any("simulated" in note for note in notes(comparison))
