"""The page: the held-out error first, nothing fetched, texts as they are."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.models.linear_stages import FurtherMode
from hilctl.models.staged import StagedModel
from hilctl.studies.characterise.results import Measured, StepRow
from hilctl.studies.characterise.rig_page import (
    characterisation_page,
    figure_rows,
    write_characterisation,
)
from tests.published import piezo_ppi
from tests.unit.studies.characterise.test_plots import SMALL
from tests.unit.studies.characterise.test_results import FOUND, LOOP, UNSEEN, identification

LINE = np.linspace(0.0, 1.0, 50)
SEEN = replace(UNSEEN, time_s=LINE, measured_um=LINE, modelled_um=LINE)
DRAWN = replace(LOOP, command=LINE, displacement_um=LINE)
WHOLE = replace(
    FOUND,
    held_out=(SEEN,),
    measured=FOUND.measured.also(
        small=SMALL, growing=(DRAWN,), reversal=None, fast=(DRAWN, replace(DRAWN, amplitude=0.2))
    ),
)


@pytest.mark.slow
def test_the_held_out_error_comes_first():
    page = characterisation_page(replace(WHOLE, identification=identification()))
    assert page.index("Error on references that no fit saw") < page.index("<h2>Measured")
    assert "Verdict: good: within 1.50 %" in page
    assert "a note" in page
    assert "http://" not in page
    assert page.count("<svg") == 4  # held out, response, loops, model


def test_what_ended_a_campaign_stands_on_top():
    """With what was measured until then."""
    stopped = replace(
        FOUND, held_out=(), problem="no <reaction>: look", measured=FOUND.measured.also(
            growing=(), reversal=None
        ),
        steps=(StepRow("rest", "noise & drift", 2.0, 0.1, "0.03 um", "/x/01-rest.mcap"),),
    )  # fmt: skip
    page = characterisation_page(stopped)
    assert '<p class="note">no &lt;reaction&gt;: look</p>' in page
    assert "30.0 nm rms" in page
    assert "noise &amp; drift" in page
    assert "01-rest.mcap" in page
    assert "<svg" not in page


@pytest.mark.usefixtures("undrawn")
def test_a_page_is_written_over(tmp_path):
    path = tmp_path / "model.html"
    for _ in range(2):
        write_characterisation(WHOLE, path)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


def test_creep_is_a_figure_where_it_was_looked_for():
    rows = dict(figure_rows(replace(FOUND, measured=Measured(crept_percent=(2.44, -3.1)))))
    assert rows["moves on in rests"] == "+2.4 % and -3.1 % in 4 s"
    assert "moves on in rests" not in dict(figure_rows(replace(FOUND, measured=Measured())))


def test_further_modes_of_the_model_are_figures():
    """Those that the small-signal response is not fitted with."""
    mode = FurtherMode(
        natural_hz=602.0, damping_ratio=0.024, antiresonance_hz=633.0,
        antiresonance_damping_ratio=0.02,
    )  # fmt: skip
    known = identification()
    plain = dict(figure_rows(replace(FOUND, identification=known)))
    assert "further mode, in the model" not in plain
    model = StagedModel.around(piezo_ppi(), modes=(mode,))
    ringing = replace(known, fit=replace(known.fit, model=model))
    rows = dict(figure_rows(replace(FOUND, identification=ringing)))
    assert rows["further mode, in the model"] == (
        "602.0 Hz, damping ratio 0.024; antiresonance 633.0 Hz"
    )
