"""Page and figures of a characterisation."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.identify.evaluation import StrokeError
from hilctl.lab.identify.model_quality import Verdict
from hilctl.lab.pages.figure_layout import drawn
from hilctl.lab.studies.characterise import rig_page
from hilctl.lab.studies.characterise.measurements import ReversalCurves
from hilctl.lab.studies.characterise.results import Measured, StepRow
from hilctl.models.linear_stages import FurtherMode
from hilctl.models.staged import StagedModel
from tests.published import piezo_ppi
from tests.unit.lab.response.test_bode import SMALL
from tests.unit.lab.studies.characterise.test_results import FOUND, LOOP, UNSEEN, identification


def test_loops_are_closed_and_drawn_over_the_command():
    loop = replace(LOOP, command=np.arange(4.0), displacement_um=np.arange(4.0))
    (axes,) = drawn(rig_page.loops_sheet("growing", [loop] * 20, "A")).axes
    assert len(axes.lines) == 20
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [0.0, 1.0, 2.0, 3.0, 0.0])
    assert axes.get_xlabel() == "command, A"


def test_reversal_curves_are_drawn_against_the_outer_one():
    line = np.linspace(-1.0, 1.0, 50)
    curves = (np.array((line, 2.0 * line)), np.array((line[25:], 2.0 * line[25:] + 0.5)))
    found = ReversalCurves((-1.0, 0.0), curves, 0.0, 0.0)
    _, lower = drawn(rig_page.reversal_sheet(found, "A")).axes
    np.testing.assert_allclose(lower.lines[0].get_ydata(), 0.0, atol=1e-12)
    np.testing.assert_allclose(lower.lines[1].get_ydata(), 0.5)


def test_what_was_not_judged_is_a_gap():
    time_s = np.concatenate((np.arange(100), np.arange(300, 400))) / 1000.0
    found = replace(UNSEEN, time_s=time_s, measured_um=time_s, modelled_um=time_s + 0.5)
    _, lower = drawn(rig_page.held_out_sheet(found, close=False)).axes
    assert np.isnan(lower.lines[0].get_ydata()).sum() == 200
    close, _ = drawn(rig_page.held_out_sheet(found, close=True)).axes
    assert close.lines[0].get_xdata().size < 50


LINE = np.linspace(0.0, 1.0, 50)
SEEN = replace(UNSEEN, time_s=LINE, measured_um=LINE, modelled_um=LINE)
DRAWN = replace(LOOP, command=LINE, displacement_um=LINE)
WHOLE = replace(
    FOUND,
    held_out=(SEEN,),
    measured=replace(
        FOUND.measured,
        small=SMALL,
        growing=(DRAWN,),
        reversal=None,
        fast=(DRAWN, replace(DRAWN, amplitude=0.2)),
    ),
)


@pytest.mark.slow
def test_the_held_out_error_comes_first():
    classes = (StrokeError("full stroke", 1.5, 0.4, 3),)
    verdict = Verdict("good", 1.5, held_out=True, notes=("a note",), classes=classes)
    known = replace(identification(), verdict=verdict)
    page = rig_page.characterisation_page(replace(WHOLE, identification=known))
    assert page.index("Errors by stroke") < page.index("<h2>Measured")
    assert page.index(">good</td>") < page.index("<svg")
    assert "a note" in page
    assert "http://" not in page
    assert page.count("<figcaption") == page.count("<svg") > 5
    assert page.index("<details") < page.index("Fitted data") < page.rindex("<figcaption")


def test_the_problem_is_at_the_top():
    stopped = replace(
        FOUND, held_out=(), problem="no <reaction>: look", measured=replace(FOUND.measured,
            small=None, growing=(), reversal=None
        ),
        steps=(StepRow("rest", "noise & drift", 2.0, 0.1, "0.03 um", "/x/01-rest.mcap"),),
    )  # fmt: skip
    page = rig_page.characterisation_page(stopped)
    for said in ("no &lt;reaction&gt;", "30.0 nm rms", "noise &amp; drift", "01-rest.mcap"):
        assert said in page
    assert "<svg" not in page


def test_creep_is_a_figure_where_it_was_looked_for():
    rows = dict(rig_page.value_rows(replace(FOUND, measured=Measured(crept_percent=(2.44, -3.1)))))
    assert rows["creep in holds"] == "+2.4 % and -3.1 % in 4 s"
    assert "creep in holds" not in dict(rig_page.value_rows(replace(FOUND, measured=Measured())))


def test_further_modes_of_the_model_are_figures():
    mode = FurtherMode(
        natural_hz=602.0, damping_ratio=0.024, antiresonance_hz=633.0,
        antiresonance_damping_ratio=0.02,
    )  # fmt: skip
    known = identification()
    plain = dict(rig_page.value_rows(replace(FOUND, identification=known)))
    assert "further mode of the model" not in plain
    model = StagedModel.around(piezo_ppi(), modes=(mode,))
    ringing = replace(known, fit=replace(known.fit, model=model))
    rows = dict(rig_page.value_rows(replace(FOUND, identification=ringing)))
    row = rows["further mode of the model"]
    assert all(value in row for value in ("602.0 Hz", "0.024", "633.0 Hz"))
