"""The model of an effective field: conditions, forward and inverse."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.models.effective_field import (
    FieldLosses,
    FieldModel,
    OutputCurve,
    ThermalActivation,
)

RATE_HZ = 50_000.0
CURVE = OutputCurve(operators_um=(-60.0, 0.0, 60.0), displacement_um=(-50.0, 0.0, 45.0))
LOSSES = FieldLosses(
    field_s=1e-4,
    output_s=2e-6,
    decay_s=3e-5,
    growth=0.1,
    bend=0.02,
    excess=0.05,
    self_growth=0.2,
)

ACTIVATION = ThermalActivation(width=0.2, rate=1000.0)


def field_model(**changes):
    """Return a small model with everything in it."""
    slopes = ((4.0, 5.0, 4.0), (1.0, 1.0, 0.0), (2.0, 3.0, 2.0))
    given: dict[str, Any] = {
        "thresholds": (0.0, 1.0),
        "lengths": (1.5,),
        "lowest": -9.0,
        "cell": 6.0,
        "slopes": slopes,
        "coupling": -0.03,
        "curve": CURVE,
        "losses": LOSSES,
    }
    return FieldModel(**(given | changes))


def reference_um(seed):
    """Return a smooth, aperiodic reference from rest: float64[n]."""
    t = np.arange(4000) / RATE_HZ
    rng = np.random.default_rng(seed)
    sines = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (11.0, 57.0, 143.0, 231.0))
    return np.ascontiguousarray(9.0 * np.minimum(t / 0.02, 1.0) * sines)


@pytest.mark.parametrize("relaxing", [{}, {"activation": ACTIVATION}, {"accommodation": 0.2}])
@pytest.mark.parametrize("coupling", [-0.03, 0.0, 0.03])
def test_inverse_undoes_the_model(coupling, relaxing):
    model = field_model(coupling=coupling, **relaxing)
    wanted_um = reference_um(1)
    command = model.inverse(RATE_HZ).process(wanted_um)
    assert model.forward(RATE_HZ).process(command) == pytest.approx(wanted_um, abs=1e-4)
    assert np.ptp(command) > 5.0


def test_plays_that_creep_do_so_between_runs():
    slow = ThermalActivation(width=0.1, rate=10.0)
    model, rate_hz = field_model(activation=slow, coupling=0.0), 1000.0
    rise = np.concatenate((np.linspace(0.0, 2.0, 50), np.full(50, 2.0)))
    held, stood = model.forward(rate_hz), model.forward(rate_hz)
    before, *_, after = held.process(np.concatenate((rise, np.full(5000, 2.0))))[rise.size - 1 :]
    stood.process(rise)
    stood.stand(5.0)
    assert after > before + 0.2
    assert stood.process(np.full(1, 2.0)) == pytest.approx(after, abs=1e-3)
    inverse = model.inverse(rate_hz)
    inverse.process(model.forward(rate_hz).process(rise))
    inverse.stand(5.0)
    assert inverse.process(np.full(1, after)) == pytest.approx(2.0, abs=1e-3)


def test_small_biased_loops_creep_by_drags_and_close_by_plays():
    loop = [*np.linspace(5.0, 4.0), *np.linspace(4.0, 5.0)]
    turns = np.concatenate([np.linspace(0.0, 5.0), np.tile(loop, 8)])
    no_losses = {"losses": FieldLosses(), "coupling": 0.0}
    moved = []
    for slopes in (((1.0,) * 3, (3.0,) * 3, (0.0,) * 3), ((1.0,) * 3, (0.0,) * 3, (3.0,) * 3)):
        out = field_model(slopes=slopes, **no_losses).forward(RATE_HZ).process(turns)
        moved.append(abs(out[-1] - out[49]))
    assert moved[0] < 1e-9
    assert moved[1] > 0.1


def test_a_loop_is_the_narrower_the_slower_it_is():
    def width_um(frequency_hz):
        t = np.arange(round(2 * RATE_HZ / frequency_hz)) / RATE_HZ
        v = 5.0 * np.sin(2 * np.pi * frequency_hz * t)
        half = v.size // 2
        y = field_model().forward(RATE_HZ).process(v)[half:]
        return float(abs(np.interp(0.0, v[half:][: half // 4], y[: half // 4]) - y[half // 2]))

    assert width_um(200.0) > 1.5 * width_um(5.0)


@pytest.mark.parametrize(("changes", "words"), [
    ({"thresholds": (1.0, 2.0)}, "first threshold must be 0"),
    ({"thresholds": (0.0, 0.0)}, "thresholds must rise"),
    ({"lengths": (0.0,)}, "lengths must be > 0"),
    ({"activation": ACTIVATION, "accommodation": 0.1}, "accommodation must be 0"),
    ({"lengths": ()}, "per threshold and per length"),
    ({"cell": 0.0}, "cell must be > 0"),
    ({"slopes": ((1.0, 0.0), (1.0, 1.0), (1.0, 1.0))}, "first line must be > 0"),
    ({"slopes": ((1.0, 1.0), (-1.0, 1.0), (1.0, 1.0))}, "slopes must be >= 0"),
    ({"slopes": ((1.0, 1.0), (1.0,), (1.0, 1.0))}, "the same cells"),
])  # fmt: skip
def test_conditions(changes, words):
    with pytest.raises(ValidationError, match=words):
        field_model(**changes)


def test_a_curve_must_rise():
    with pytest.raises(ValidationError, match="displacement_um must rise"):
        OutputCurve(operators_um=(0.0, 1.0), displacement_um=(0.0, 0.0))
    with pytest.raises(ValidationError, match="at least two"):
        OutputCurve(operators_um=(0.0,), displacement_um=(0.0,))
