"""What the search turns is what the model means: order, units, and a record taken apart."""

import math

import numpy as np
import pytest

from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.field import stages
from hilctl.lab.identify.field.densities import Curve
from hilctl.lab.identify.field.preprocess import Prepared, Run
from hilctl.models.effective_field import FieldLosses, FieldModel, OutputCurve, ThermalActivation
from hilctl.models.linear_stages import FirstMode

RATE_HZ = 20_000.0
STAGES = stages.Stages(0.3, 0.2, 0.1, 0.4, 0.06, 0.5, 0.08, 0.9, 0.11, 0.02, 0.3)
TIME_S = np.arange(2000) / RATE_HZ
COMMAND = 4.0 * np.sin(2.0 * np.pi * 50.0 * TIME_S) + np.sin(2.0 * np.pi * 230.0 * TIME_S)


def history(command: float = 1.0, um: float = 1.0, rate: float = 1.0) -> History:
    """Return a record in other units of command, displacement and time."""
    y = 9.0 * np.tanh(COMMAND / 4.0)
    return History("random", command * COMMAND, um * y, rate * RATE_HZ)


def plain_run(command: np.ndarray, derivatives: np.ndarray) -> Run:
    size = command.size
    steps = np.full(size, 1.0 / RATE_HZ)
    held = np.ascontiguousarray(command)
    return Run(RATE_HZ, np.arange(size), steps, held, held, derivatives, 0)


def test_a_search_can_begin_at_the_defaults_and_step_either_way():
    low, high, step = stages.row(stages.LOW), stages.row(stages.HIGH), stages.row(stages.STEP)
    assert (low <= stages.row(stages.Stages())).all()
    assert (stages.row(stages.Stages()) <= high).all()
    assert (step > 0.0).all()
    assert (2.0 * step <= high - low)[:-2].all()  # plays relax only if asked
    assert (low >= 0.0).all()
    # Without inertia or damping there is no structure: natural_hz is worked out as 1 / radian.
    assert stages.LOW.radian > 0.0
    assert stages.LOW.damping > 0.0


@pytest.mark.parametrize("bound", [stages.LOW, stages.HIGH])
def test_a_model_takes_every_bound(bound):
    known = stages.physical(bound, Prepared([history()]))
    assert FieldLosses(**known.losses.model_dump()) == known.losses


def test_units_by_hand():
    data = Prepared([history()])
    data.top_hz, data.reach, data.stroke_um = 50.0 / math.pi, 4.0, 16.0  # unit of time: 0.01 s
    known = stages.physical(STAGES, data)
    losses = FieldLosses(
        field_s=0.003, output_s=0.001, decay_s=0.001, growth=0.1, excess=0.12, self_growth=0.125
    )
    assert known.losses.model_dump() == pytest.approx(losses.model_dump())
    assert known.activation == ThermalActivation(width=0.08, rate=400.0)
    assert known.accommodation == pytest.approx(0.075)
    linear = known.radian_s, known.damping_ratio, known.delay_s
    assert linear == pytest.approx((0.0008, 0.9, 0.0011))
    assert stages.row(stages.stages_of(known, data)) == pytest.approx(stages.row(STAGES))


def test_stages_of_other_records_lie_within_the_bounds():
    known = stages.physical(stages.HIGH, Prepared([history()]))
    faster = Prepared([history(rate=5.0)])
    x = stages.StageSpace.of(faster, True).within(stages.stages_of(known, faster))
    assert stages.stages_in(x).radian == stages.HIGH.radian


def test_a_measured_structure_is_searched_nearby():
    measured, data = FirstMode(natural_hz=300.0, damping_ratio=0.1), Prepared([history()])
    space = stages.StageSpace.of(data, measured)
    low, high = (stages.physical(stages.stages_in(x), data) for x in (space.high, space.low))
    assert low.structure is not None
    assert high.structure is not None
    assert 250.0 < low.structure.natural_hz < 300.0 < high.structure.natural_hz < 350.0
    assert low.structure.damping_ratio > 0.1 > high.structure.damping_ratio
    held = space.at_bound(stages.stages_in(space.high))
    assert held[-3:] == ("natural_hz", "damping_ratio", "delay_s")


def test_without_a_structure_none_is_searched_nor_named():
    data = Prepared([history()])
    space = stages.StageSpace.of(data, False)
    known = stages.physical(stages.stages_in(space.within(stages.Stages())), data)
    assert known.structure is None
    assert "natural_hz" not in known.parameters(0.0)
    assert space.at_bound(stages.stages_in(space.low)) == ()
    assert "natural_hz" not in space.at_bound(stages.stages_in(space.high))


@pytest.mark.parametrize("units", [(3.0, 1.0, 1.0), (1.0, 0.2, 1.0), (1.0, 1.0, 5.0)])
def test_the_same_stages_mean_the_same_in_any_units(units):
    def worked_out(record: History) -> tuple[np.ndarray, np.ndarray]:
        data = Prepared([record])
        return stages.signals(data.runs[0], stages.physical(STAGES, data), None, 2.0 * data.reach)

    u, y = worked_out(history())
    other_u, other_y = worked_out(history(*units))
    np.testing.assert_allclose(other_u / units[0], u, atol=1e-5)
    np.testing.assert_allclose(other_y / units[1], y, atol=1e-5)
    assert np.ptp(u) > 2.0


@pytest.mark.parametrize("decay_s", [0.0, 1e-4])
def test_of_a_model_s_record_the_field_is_the_model_s(decay_s):
    """The model's operators give 2 u: so what its curve is undone to is twice the field."""
    operators, displacement_um = np.array([-40.0, 5.0, 40.0]), np.array([-20.0, 1.0, 50.0])
    losses = FieldLosses(
        field_s=2e-4,
        output_s=3e-5,
        decay_s=decay_s,
        growth=0.2,
        bend=0.05,
        excess=0.3,
        self_growth=0.1,
    )
    model = FieldModel(
        thresholds=(0.0,), lowest=-10.0, cell=20.0, slopes=((2.0,),),
        curve=OutputCurve(
            operators_um=tuple(operators.tolist()), displacement_um=tuple(displacement_um.tolist())
        ),
        losses=losses,
    )  # fmt: skip
    y_um = model.forward(RATE_HZ).process(COMMAND)
    run = plain_run(COMMAND, np.stack([y_um, np.zeros_like(y_um), np.zeros_like(y_um)]))
    known = stages.Physical(losses, 1e-4, 0.3, 0.0, lag_s=2e-4 + 3e-5 * 2.0)
    u, bare_um = stages.signals(run, known, Curve(operators, displacement_um), 20.0)
    np.testing.assert_array_equal(bare_um, y_um)
    np.testing.assert_allclose(2.0 * u, np.interp(y_um, displacement_um, operators), atol=1e-4)


def test_structure_and_delay_are_taken_off_the_displacement():
    """Before 1 / (1 + 2 d r s + r^2 s^2), a sine was larger and ahead; before a delay, earlier."""
    w, r, d, late = 2.0 * np.pi * 200.0, 3e-4, 0.4, 7
    sine, cosine = np.sin(w * TIME_S), np.cos(w * TIME_S)
    run = plain_run(np.zeros_like(sine), np.stack([sine, w * cosine, -(w**2) * sine]))
    known = stages.Physical(FieldLosses(), r, d, late / RATE_HZ, 1.0)
    u, y = stages.signals(run, known, None, 20.0)
    before = (1.0 - (r * w) ** 2) * sine + 2.0 * d * r * w * cosine
    np.testing.assert_allclose(y[:-late], before[late:], atol=1e-9)
    np.testing.assert_allclose(u, 0.0, atol=1e-9)
