"""Fits of models of the literature; tests/contract/test_kinds.py fits each to its own loops."""

import numpy as np
import pytest

from hilctl.lab.identify.data.records import History, SteadyLoop
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.fit_api import FitJob
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.literature.bouc_wen import fit_bouc_wen
from hilctl.lab.identify.literature.duhem import fit_duhem
from hilctl.lab.identify.literature.generalised_plays import fit_generalised
from hilctl.lab.identify.literature.krasnoselskii import fit_kp
from hilctl.lab.identify.literature.preisach import fit_preisach
from hilctl.lab.identify.literature.straight import fit_straight
from hilctl.lab.identify.settings import FitSettings
from hilctl.lab.identify.staged.staged_fits import fit_free
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.literature.bouc_wen import BoucWenModel
from hilctl.models.literature.duhem import DuhemModel
from hilctl.models.literature.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.literature.preisach import PreisachModel
from tests.published import piezo_ppi

RNG = np.random.default_rng(4)
COMMON = {"command_span": (-7.0, 7.0), "output_offset_um": -3.0}
PREISACH = PreisachModel(
    **COMMON, thresholds=tuple((0.75 * np.arange(8)).tolist()), lowest=-6.0, cell=0.75,
    slopes=tuple(tuple(row) for row in RNG.uniform(0.2, 2.0, (8, 16)).tolist()),
)  # fmt: skip
GENERALISED = GeneralisedModel(
    **COMMON, direct=30.0, weights=(8.0, 5.0, 5.0), thresholds=(0.06, 0.12, 0.3),
    rising=PlayEnvelope(slope=0.12, shift=0.3, level=-0.29),
    falling=PlayEnvelope(slope=0.12, shift=0.35, level=-0.29),
)  # fmt: skip
BOUC_WEN = BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.4, gamma=0.1)
DUHEM = DuhemModel(**COMMON, a=0.4, b=8.0, c=6.0)
BOUC_WEN_2 = BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.2, gamma=0.05, exponent=2)
ASYMMETRIC = IntegratedModel(
    direct=4.0, weights=(1.0, 1.5, 2.0), thresholds=(0.5, 1.5, 2.5), output_offset_um=1.0,
    deadband=DeadbandFunction(
        up_thresholds=(10.0, 20.0), up_weights=(-0.3, -0.2), down_thresholds=(-15.0,),
        down_weights=(0.5,),
    ),
)  # fmt: skip


def found_by(fit, data):
    """Return the model that a fit finds with the settings of its kind."""
    kind = "asymmetric" if fit is fit_free else fit.__name__.removeprefix("fit_")
    return fit(FitJob(data, FitSettings(kind=kind))).model


@pytest.mark.parametrize("fit", [
    *(fit_straight, fit_preisach, fit_kp, fit_bouc_wen, fit_duhem, fit_free),
    pytest.param(fit_generalised, marks=pytest.mark.slow),
])  # fmt: skip
def test_commands_may_all_lie_on_one_side(fit):
    """A drive of 10 to 90 V, as a piezo stage has it, is no special case."""
    angle = 2.0 * np.pi * np.arange(300) / 300
    command = np.tile(50.0 + 40.0 * np.sin(angle), 3)
    displacement_um = piezo_ppi().forward(1.0).process(command)[-300:]
    data = FitData([SteadyLoop("stage", command[-300:], displacement_um, 10.0)], "V")
    most_percent = 12.0 if fit is fit_straight else 1.0
    assert judge(found_by(fit, data), data).peak_percent <= most_percent


def test_operators_that_only_drift_have_no_weight(data_of):
    """Means that differ from loop to loop do not become weights that no loop shows.

    With such weights the model would be far off when a run takes another path.
    """
    data = data_of(BOUC_WEN)
    moved = [
        SteadyLoop(loop.label, loop.command, loop.displacement_um - 20.0 * i, loop.frequency_hz)
        for i, loop in enumerate(data.loops)
    ]
    model = found_by(fit_kp, FitData(moved, "A"))
    there_and_back = np.concatenate([np.linspace(0, 6, 200), np.linspace(6, -6, 400)])
    y = model.forward(1.0).process(there_and_back)
    assert np.ptp(y) <= 1.15 * data.stroke_um


def test_histories_are_fitted_like_loops():
    time = np.arange(4000) / 1000.0
    command = (1.0 + time) * np.sin(2.0 * np.pi * 5.0 * time)
    data = FitData([History("growing", command, PREISACH.forward(1.0).process(command), 1000.0)])
    assert judge(found_by(fit_preisach, data), data).peak_percent <= 1.0
