"""The page of an identification: escaped, self-contained, and not longer than can be read."""

import numpy as np
import pytest

from hilctl.identify import model_page as module
from hilctl.identify.data.records import History
from hilctl.identify.evaluation import judge
from hilctl.identify.fit_api import FitRequest
from hilctl.identify.fit_model import fit_model
from hilctl.identify.model_page import identification_page, loops_figure
from hilctl.identify.model_quality import verdict_of
from hilctl.identify.model_selection import HeldOut
from hilctl.identify.pipeline import Identification
from hilctl.identify.settings import FitSettings
from hilctl.models.plays import PpiModel

TRUTH = PpiModel(direct=4.0, weights=(1.0,), thresholds=(0.5,))


@pytest.fixture
def page_of(data_of):
    """Return a function that makes the page of a straight line through loops."""

    def make(held_out=()):
        records = data_of(TRUTH).records
        fit = fit_model(FitRequest(records, FitSettings(kind="straight"), source=["<a & b>.csv"]))
        unseen = HeldOut(judge(fit.model, held_out), held_out, "others") if held_out else None
        verdict = verdict_of(fit, records, FitSettings(kind="straight"), unseen)
        return identification_page(Identification(fit, records, verdict, unseen, (), 0))

    return make


@pytest.mark.slow
def test_the_page_fetches_nothing_and_shows_names_as_they_are(page_of):
    page = page_of()
    assert page.count("<svg") == 1
    assert "http://" not in page
    assert "&lt;a &amp; b&gt;.csv" in page
    assert "<a & b>" not in page
    assert "not fitted" not in page
    assert "fit error" in page


@pytest.mark.usefixtures("undrawn")
def test_data_not_fitted_have_errors_and_a_figure_of_their_own(page_of, data_of, monkeypatch):
    monkeypatch.setattr(module, "MOST_RECORDS", 2)
    loops = data_of(TRUTH).loops
    page = page_of((loops[0],) * 3)
    assert page.count("<svg") == 2
    assert "The first 2 of 3." in page


def test_loops_are_drawn_over_the_command_and_histories_over_samples(data_of):
    loop = data_of(TRUTH).loops[0]
    history = History("h", np.arange(50.0), np.arange(50.0), 1000.0, ignore=10)
    modelled = [loop.displacement_um + 1.0, np.zeros(40)]
    figure = loops_figure(modelled, [loop, history], "A")
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_xlabel() for axes in shown if axes.get_xlabel()] == ["command, A", "sample"]
    errors = [axes.lines[0].get_ydata() for axes in shown if axes.get_ylabel() == "error, µm"]
    np.testing.assert_allclose(errors[0], 1.0)
    np.testing.assert_allclose(errors[1], -np.arange(10.0, 50.0))
