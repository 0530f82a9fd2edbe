"""The refined model: files, conditions, and that its inverse undoes it, whatever its base."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.models.linear_stages import FirstMode
from hilctl.models.refined import RefinedModel, ResidualOperator, rest_um
from hilctl.models.staged import FieldLag, StagedModel
from tests.published import piezo_ppi, terfenol_rdpi

RATE_HZ = 50_000.0
STAGED = StagedModel.around(
    terfenol_rdpi(),
    lag=FieldLag(tau_s=1e-4),
    structure=FirstMode(natural_hz=2200.0, damping_ratio=0.12),
    delay_s=2.7e-5,
)
BASES = {
    "ppi": piezo_ppi(),
    "with an offset": piezo_ppi().model_copy(update={"output_offset_um": 7.0}),
    "rdpi": terfenol_rdpi(),
    "staged": STAGED,
}


def residual(scale=1.0, **changes):
    rng = np.random.default_rng(3)
    fields = {
        "lowest_um": -40.0,
        "cell_um": 10.0,
        "thresholds_um": (0.0, 3.0, 12.0),
        "slopes": tuple(map(tuple, (0.02 * scale * rng.normal(size=(3, 8))).tolist())),
        "lengths_um": (5.0, 40.0),
        "drags_um": tuple(map(tuple, (0.1 * scale * rng.normal(size=(4, 9))).tolist())),
        "rate_um": tuple((0.1 * scale * rng.normal(size=9)).tolist()),
        "window_s": 2e-4,
        "fastest_um_per_s": 5e4,
    }
    return ResidualOperator(**{**fields, **changes})


def refined(base, operator, offset_um):
    """Return a refined model in the unit of its base."""
    return RefinedModel(
        base=base, residual=operator, output_offset_um=offset_um, input_unit=base.input_unit
    )


def sine(frequency_hz=100.0, samples=10_000):
    t = np.arange(samples) / RATE_HZ
    swell = np.minimum(np.minimum(1.0, t / 0.04), (t[-1] - t) / 0.04)
    return swell * (9.0 * np.sin(2.0 * np.pi * frequency_hz * t) + 3.0)


@pytest.mark.parametrize("name", BASES)
def test_forward_of_the_inverse_is_the_reference(name):
    base = BASES[name]
    model = refined(base, residual(), 0.4)
    reference = sine() + rest_um(base)

    def missed(which):
        inverse = which.inverse(RATE_HZ)
        after = np.full(inverse.preview, reference[-1])
        inverse.process(reference[: inverse.preview].copy())
        command = inverse.process(np.concatenate((reference[inverse.preview :], after)))
        error = which.forward(RATE_HZ).process(command) - reference
        return float(np.abs(error[1000 : -2 * inverse.preview - 1]).max())

    assert missed(model) <= 1.5 * missed(base) + 3e-6


def test_at_rest_it_stands_where_its_base_does_and_its_own_offset_further():
    base = BASES["with an offset"]
    model = refined(base, residual(), 0.4)
    rest = model.forward(RATE_HZ).process(np.zeros(4))
    np.testing.assert_allclose(rest, 7.4, atol=1e-12)
    assert rest_um(base) == 7.0


@pytest.mark.parametrize(("change", "message"), [
    ({"thresholds_um": (1.0, 3.0, 12.0)}, "the first of thresholds_um must be 0"),
    ({"thresholds_um": (0.0, 12.0, 3.0)}, "r must rise from 0"),
    ({"lengths_um": (5.0, -1.0)}, "l must rise from 0"),
    ({"slopes": ((0.0,) * 8,) * 2}, "slopes must have 3 lines of 8 values each"),
    ({"drags_um": ((0.0,) * 9,) * 3}, "drags_um must have 4 lines of 9 values each"),
    ({"rate_um": (0.0,)}, "rate_um .*: 1"),
    ({"window_s": 0.0}, "greater than 0"),
])  # fmt: skip
def test_conditions_are_named(change, message):
    with pytest.raises(ValidationError, match=message):
        residual(**change)


def test_a_unit_of_its_own_is_refused():
    with pytest.raises(ValidationError, match=r"base.input_unit .* A"):
        RefinedModel(base=piezo_ppi(), residual=residual())
