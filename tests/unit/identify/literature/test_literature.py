"""Each fit finds a model of its own kind again, from loops that one made."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.job import FitJob
from hilctl.identify.judge import judge
from hilctl.identify.literature.asymmetric import fit_asymmetric
from hilctl.identify.literature.differential import fit_bouc_wen, fit_duhem
from hilctl.identify.literature.envelopes import fit_generalised
from hilctl.identify.literature.operators import fit_kp, fit_preisach, fit_straight
from hilctl.identify.settings import FitSettings
from hilctl.models.bouc_wen import BoucWenModel
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.duhem import DuhemModel
from hilctl.models.generalised import Envelope, GeneralisedModel
from hilctl.models.integrated import IntegratedModel
from hilctl.models.kp import KrasnoselskiiPokrovskiiModel
from hilctl.models.plays import PpiModel
from hilctl.models.preisach import PreisachModel
from hilctl.models.published import piezo_ppi

RNG = np.random.default_rng(4)
SPAN = (-7.0, 7.0)
COMMON = {"command_span": SPAN, "output_offset_um": -3.0}
PLAYS = {"direct": 4.0, "weights": (1.0, 1.5, 2.0), "thresholds": (0.5, 1.5, 2.5)}
DEADBAND = DeadbandFunction(
    up_thresholds=(10.0, 20.0), up_weights=(-0.3, -0.2), down_thresholds=(-15.0,),
    down_weights=(0.5,),
)  # fmt: skip
BOUC_WEN = BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.4, gamma=0.1)
BOUC_WEN_2 = BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.2, gamma=0.05, exponent=2)
GENERALISED = GeneralisedModel(
    **COMMON, direct=30.0, weights=(8.0, 5.0, 5.0), thresholds=(0.06, 0.12, 0.3),
    rising=Envelope(slope=0.12, shift=0.3, level=-0.29),
    falling=Envelope(slope=0.12, shift=0.35, level=-0.29),
)  # fmt: skip
PREISACH = PreisachModel(
    **COMMON, thresholds=tuple((0.75 * np.arange(8)).tolist()), lowest=-6.0, cell=0.75,
    slopes=tuple(tuple(row) for row in RNG.uniform(0.2, 2.0, (8, 16)).tolist()),
)  # fmt: skip
KP = KrasnoselskiiPokrovskiiModel(
    **COMMON, lowest=-7.0, spacing=1.0,
    weights=tuple(tuple(RNG.uniform(0.2, 1.0, i + 1).tolist()) for i in range(14)),
)  # fmt: skip


def found_by(fit, data):
    """Return what a fit finds with the settings of its kind."""
    return fit(FitJob(data, FitSettings(kind=fit.__name__.removeprefix("fit_"))))


FITS = [
    (fit_straight, PpiModel(direct=3.0, weights=(), thresholds=(), output_offset_um=2.0), 1e-3),
    (fit_bouc_wen, BOUC_WEN, 0.01),
    (fit_bouc_wen, BOUC_WEN_2, 0.01),
    (fit_duhem, DuhemModel(**COMMON, a=0.4, b=8.0, c=6.0), 0.01),
    (fit_generalised, GENERALISED, 0.5),
    (fit_asymmetric, IntegratedModel(**PLAYS, deadband=DEADBAND, output_offset_um=1.0), 1.0),
    (fit_preisach, PREISACH, 0.5),
    (fit_kp, KP, 1.5),
]


@pytest.mark.parametrize(
    ("fit", "truth", "peak_percent"), FITS, ids=lambda value: getattr(value, "__name__", None)
)
def test_a_model_of_its_own_kind_is_found_again(data_of, fit, truth, peak_percent):
    """Loops without noise, at three amplitudes, are met."""
    data = data_of(truth)
    found = found_by(fit, data)
    assert judge(found.model, data).peak_percent <= peak_percent
    assert found.model.input_range == pytest.approx((-6.0, 6.0), abs=1e-3)


def test_bouc_wen_parameters_are_found(data_of):
    """The exponent and the shape come out, not only the loop."""
    for truth in (BOUC_WEN, BOUC_WEN_2):
        found = found_by(fit_bouc_wen, data_of(truth)).model
        assert found.exponent == truth.exponent
        for name in ("direct", "hysteretic", "beta", "gamma", "output_offset_um"):
            assert getattr(found, name) == pytest.approx(getattr(truth, name), rel=1e-2), name


def test_operators_that_only_drift_have_no_weight(data_of):
    """A mean that differs from loop to loop does not become weights that no loop shows.

    An operator that moves on the way from rest and then stays could say it; the model would then be
    far off as soon as a run takes another way.
    """
    data = data_of(BOUC_WEN)
    moved = [
        SteadyLoop(loop.label, loop.command, loop.displacement_um - 20.0 * i, loop.frequency_hz)
        for i, loop in enumerate(data.loops)
    ]
    model = found_by(fit_kp, FitData(moved, "A")).model
    there_and_back = np.concatenate([np.linspace(0, 6, 200), np.linspace(6, -6, 400)])
    y = model.forward(1.0).process(there_and_back)
    assert np.ptp(y) <= 1.15 * data.stroke_um


@pytest.mark.parametrize(("fit", "truth"), [(fit, truth) for fit, truth, _ in FITS],
                         ids=lambda value: getattr(value, "__name__", None))  # fmt: skip
def test_what_is_found_can_be_inverted(data_of, fit, truth):
    """The inverse of a found model brings a sine within the stroke back."""
    data = data_of(truth)
    model = found_by(fit, data).model
    low, high = data.output_range_um
    y = 0.5 * (low + high) + 0.48 * (high - low) * np.sin(np.arange(2_000) / 100.0)
    command = model.inverse(1e4).process(y)
    back = model.forward(1e4).process(command)
    assert np.max(np.abs(back - y)[400:]) <= 1e-3 * data.stroke_um


@pytest.mark.parametrize("fit", [fit for fit, *_ in FITS])
def test_commands_may_all_lie_on_one_side(fit):
    """A drive of 10 to 90 V, as a piezo stage has it, is no special case."""
    angle = 2.0 * np.pi * np.arange(300) / 300
    command = np.tile(50.0 + 40.0 * np.sin(angle), 3)
    stage = piezo_ppi()
    displacement_um = stage.forward(1.0).process(command)[-300:]
    data = FitData([SteadyLoop("stage", command[-300:], displacement_um, 10.0)], "V")
    error = judge(found_by(fit, data).model, data)
    assert error.peak_percent <= (12.0 if fit is fit_straight else 1.0)


def test_no_loops_are_refused():
    """There is nothing to find a model from on an empty list."""
    with pytest.raises(DataError, match="empty"):
        FitData([], "A")


def test_whole_histories_will_do():
    """A record that does not repeat gives the same kind of model."""
    time = np.arange(4000) / 1000.0
    command = (1.0 + time) * np.sin(2.0 * np.pi * 5.0 * time)
    history = History("growing", command, PREISACH.forward(1.0).process(command), 1000.0)
    data = FitData([history])
    assert judge(found_by(fit_preisach, data).model, data).peak_percent <= 1.0
