"""The page of an identification: escaped, self-contained, and not longer than can be read."""

import numpy as np
import pytest

from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import fit_model
from hilctl.lab.identify.model_page import drawn_records, identification_page, record_sheet
from hilctl.lab.identify.model_quality import verdict_of
from hilctl.lab.identify.model_selection import HeldOut
from hilctl.lab.identify.pipeline import Identification
from hilctl.lab.identify.settings import FitSettings
from hilctl.lab.pages.figure_layout import drawn
from hilctl.models.plays import PpiModel

TRUTH = PpiModel(direct=4.0, weights=(1.0,), thresholds=(0.5,))


@pytest.fixture
def page_of(data_of):
    """Return a function that makes the page of a straight line through loops."""

    def make(held_out=()):
        records = data_of(TRUTH).records
        fit = fit_model(FitRequest(records, FitSettings(kind="straight"), source=["<a & b>.csv"]))
        unseen = HeldOut(judge(fit.model, held_out), held_out, "others") if held_out else None
        verdict = verdict_of(
            fit, records, FitSettings(kind="straight"), unseen, lambda records: None
        )
        return identification_page(Identification(fit, records, verdict, unseen, 0))

    return make


@pytest.mark.slow
def test_the_page_fetches_nothing_and_shows_names_as_they_are(page_of):
    page = page_of()
    assert page.count("<svg") == page.count("<figcaption") > 0
    assert "http://" not in page
    assert "&lt;a &amp; b&gt;.csv" in page
    assert "<a & b>" not in page
    assert "not fitted" not in page
    assert "no validation data" in page


@pytest.mark.usefixtures("undrawn")
def test_data_not_fitted_have_errors_and_figures_of_their_own(page_of, data_of):
    loops = data_of(TRUTH).loops
    page = page_of((loops[0],) * 3)
    assert page.count("<svg") == len(loops) + 3
    shown = "".join(drawn_records(judge(TRUTH, (loops[0],) * 3), (loops[0],) * 3, "A", most=2))
    assert shown.count("<svg") == 2
    assert "first 2 of 3" in shown


SWING = np.sin(np.linspace(0.0, 20.0 * np.pi, 2000))


@pytest.mark.parametrize(
    ("label", "axis"), [("h", "time, s"), ("12-slow-loops.mcap", "command, A")]
)
def test_histories_are_drawn_over_time_except_loops(label, axis):
    history = History(label, SWING, SWING, 1000.0, ignore=10)
    upper, lower = drawn(record_sheet(history, SWING[10:] + 0.5, "A")).axes
    assert lower.get_xlabel() == axis
    assert upper.get_ylabel() == "displacement, µm"
    error_um = lower.lines[0].get_ydata()
    np.testing.assert_allclose(error_um[np.isfinite(error_um)], 0.5)


def test_loops_are_drawn_over_the_command(data_of):
    loop = data_of(TRUTH).loops[0]
    upper, _ = drawn(record_sheet(loop, loop.displacement_um, "A")).axes
    around = np.append(loop.command, loop.command[0])
    np.testing.assert_array_equal(upper.lines[0].get_xdata(), around)
