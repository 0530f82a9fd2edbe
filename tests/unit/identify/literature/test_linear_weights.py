"""Sums of operators, and a straight line, are found again, from loops that they made."""

import numpy as np
import pytest

from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.evaluation import judge
from hilctl.identify.fit_api import FitJob
from hilctl.identify.fit_data import FitData
from hilctl.identify.literature.linear_weights import fit_kp, fit_preisach, fit_straight
from hilctl.identify.settings import FitSettings
from hilctl.models.implicit_models import BoucWenModel, KrasnoselskiiPokrovskiiModel, PreisachModel
from hilctl.models.plays import PpiModel

RNG = np.random.default_rng(4)
SPAN = (-7.0, 7.0)
COMMON = {"command_span": SPAN, "output_offset_um": -3.0}
PREISACH = PreisachModel(
    **COMMON, thresholds=tuple((0.75 * np.arange(8)).tolist()), lowest=-6.0, cell=0.75,
    slopes=tuple(tuple(row) for row in RNG.uniform(0.2, 2.0, (8, 16)).tolist()),
)  # fmt: skip
KP = KrasnoselskiiPokrovskiiModel(
    **COMMON, lowest=-7.0, spacing=1.0,
    weights=tuple(tuple(RNG.uniform(0.2, 1.0, i + 1).tolist()) for i in range(14)),
)  # fmt: skip


FITS = [
    (fit_straight, PpiModel(direct=3.0, weights=(), thresholds=(), output_offset_um=2.0), 1e-3),
    (fit_preisach, PREISACH, 0.5),
    (fit_kp, KP, 1.5),
]


@pytest.mark.parametrize(("fit", "truth", "peak_percent"), FITS)
def test_a_model_of_its_own_kind_is_found_again(finds_its_own_kind, fit, truth, peak_percent):
    finds_its_own_kind(fit, truth, peak_percent)


@pytest.mark.parametrize(("fit", "truth"), [(fit, truth) for fit, truth, _ in FITS])
def test_what_is_found_can_be_inverted(finds_an_inverse, fit, truth):
    finds_an_inverse(fit, truth)


@pytest.mark.parametrize(
    ("fit", "peak_percent"), [(fit_straight, 12.0), (fit_preisach, 1.0), (fit_kp, 1.0)]
)
def test_commands_may_all_lie_on_one_side(takes_one_side, fit, peak_percent):
    takes_one_side(fit, peak_percent)


def test_operators_that_only_drift_have_no_weight(data_of):
    """A mean that differs from loop to loop does not become weights that no loop shows.

    An operator that moves on the way from rest and then stays could say it; the model would then be
    far off as soon as a run takes another way.
    """
    data = data_of(BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.4, gamma=0.1))
    moved = [
        SteadyLoop(loop.label, loop.command, loop.displacement_um - 20.0 * i, loop.frequency_hz)
        for i, loop in enumerate(data.loops)
    ]
    model = fit_kp(FitJob(FitData(moved, "A"), FitSettings(kind="kp"))).model
    there_and_back = np.concatenate([np.linspace(0, 6, 200), np.linspace(6, -6, 400)])
    y = model.forward(1.0).process(there_and_back)
    assert np.ptp(y) <= 1.15 * data.stroke_um


def test_whole_histories_will_do():
    """A record that does not repeat gives the same kind of model."""
    time = np.arange(4000) / 1000.0
    command = (1.0 + time) * np.sin(2.0 * np.pi * 5.0 * time)
    history = History("growing", command, PREISACH.forward(1.0).process(command), 1000.0)
    data = FitData([history])
    found = fit_preisach(FitJob(data, FitSettings(kind="preisach")))
    assert judge(found.model, data).peak_percent <= 1.0
