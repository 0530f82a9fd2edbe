"""The staged model: files, conditions, preview, and that the inverse undoes the model."""

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.models.base import Provenance
from hilctl.models.integrated import exponential_integrated
from hilctl.models.linear_stages import Compliance, CreepModel, FirstMode, FurtherMode
from hilctl.models.staged import FieldLag, StagedModel
from tests.published import piezo_ppi

RATE_HZ = 50_000.0
LAG = FieldLag(tau_s=1e-4, growth_per_unit=0.28)
STRUCTURE = FirstMode(natural_hz=2200.0, damping_ratio=0.12)
COMPLIANCE = Compliance(lowest_um=-20.0, cell_um=20.0, relative=(1.4, 1.0, 0.7))
OMEGA = exponential_integrated(
    alpha=0.3, gamma_s=0.0, a_0=1.0, alpha_0=0.2, beta_0=0.3, g_0=6.0, alpha_1=0.3, beta_1=0.1,
    d_p=0.8, alpha_2=0.4, beta_2=0.1, d_n=0.8, plays=6, deadbands_a_side=2,
)  # fmt: skip
MODE = FurtherMode(
    natural_hz=600.0, damping_ratio=0.03, antiresonance_hz=630.0, antiresonance_damping_ratio=0.03
)
CREEP = CreepModel(time_constants_s=(0.02, 0.3), shares=(0.03, 0.02))
STAGES = {
    "bare": {},
    "lag": {"lag": LAG},
    "linear lag": {"lag": FieldLag(tau_s=1e-4)},
    "delay": {"delay_s": 3 / RATE_HZ},
    "part of a sample": {"delay_s": 2.35 / RATE_HZ},
    "structure": {"structure": STRUCTURE},
    "structure by place": {"structure": STRUCTURE.model_copy(update={"compliance": COMPLIANCE})},
    "modes": {"lag": LAG, "modes": (MODE,)},
    "smoothing": {"lag": LAG, "smoothing_s": 1.0 / (2.0 * np.pi * 2200.0)},
    "creep": {"lag": LAG, "creep": CREEP},
    "all": {
        "lag": LAG,
        "structure": STRUCTURE,
        "modes": (MODE,),
        "delay_s": 2.7e-5,
        "creep": CREEP,
    },
}
PREVIEW = {"bare": 1, "lag": 1, "linear lag": 1, "delay": 4, "part of a sample": 4, "structure": 13,
           "structure by place": 13, "modes": 1, "creep": 1, "all": 15,
           "smoothing": 12}  # fmt: skip


def sine(frequency_hz, n=12_000):
    """A sine whose amplitude rises over 0.05 s and falls over 0.05 s at its end."""
    t = np.arange(n) / RATE_HZ
    size = np.minimum(np.minimum(1.0, t / 0.05), (t[-1] - t) / 0.05)
    return size * (20.0 * np.sin(2.0 * np.pi * frequency_hz * t) - 3.0)


def ahead(reference, preview):
    return np.concatenate((reference[preview:], np.full(preview, reference[-1])))


def test_around_takes_over_unit_ranges_and_provenance():
    source = Provenance(source=("run.mcap",))
    inner = piezo_ppi().model_copy(
        update={"input_range": (0.0, 5.0), "output_range_um": (-1.0, 9.0), "provenance": source}
    )
    model = StagedModel.around(inner, lag=LAG)
    assert (model.input_unit, model.input_range, model.output_range_um) == ("V", (0, 5), (-1, 9))
    assert model.provenance == source
    assert model.hysteresis.input_range is None
    assert model.hysteresis.provenance == Provenance()
    assert model.operators == inner.operators


@pytest.mark.parametrize(("change", "message"), [
    ({"hysteresis": piezo_ppi()}, "hysteresis.input_unit .* A"),
    ({"hysteresis": OMEGA.model_copy(update={"input_range": (0.0, 1.0)})},
     "hysteresis.input_range must be"),
    ({"modes": ({**MODE.model_dump(), "damping_ratio": 0.0},)}, "greater than 0"),
    ({"modes": (MODE,) * 9}, "at most 8 items"),
    ({"delay_s": -1e-6}, "greater than or equal to 0"),
])  # fmt: skip
def test_conditions_are_named(change, message):
    with pytest.raises(ValidationError, match=message):
        StagedModel.model_validate({"hysteresis": OMEGA, **change})


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("frequency_hz", [10.0, 250.0])
def test_inverse_undoes_the_model(name, frequency_hz):
    """Fed ahead of its time, the inverse brings the model to the reference: within 0.02 %."""
    model = StagedModel.around(OMEGA, **STAGES[name])
    reference = sine(frequency_hz)
    inverse = model.inverse(RATE_HZ)
    assert inverse.preview == PREVIEW[name]
    command = inverse.process(ahead(reference, inverse.preview))
    came = model.forward(RATE_HZ).process(command)
    error = (came - reference)[2 * inverse.preview :]  # before it, the model stands where it began
    assert np.abs(error).max() < 2e-4 * np.ptp(reference)
    if name not in {
        "structure",
        "structure by place",
        "smoothing",
        "all",
        "part of a sample",
        "creep",
    }:
        np.testing.assert_allclose(error, 0.0, atol=1e-11)


def test_offsets_of_hysteresis_and_whole_add_up():
    inner = OMEGA.model_copy(update={"output_offset_um": 4.0})
    model = StagedModel.around(inner, **STAGES["all"]).model_copy(update={"output_offset_um": -1.5})
    command = model.inverse(RATE_HZ).process(np.full(60, 2.5))
    np.testing.assert_allclose(command, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.forward(RATE_HZ).process(command), 2.5, atol=1e-12)


@pytest.mark.parametrize("damping_ratio", [0.02, 0.12])
@pytest.mark.parametrize("rate_hz", [20e3, 50e3, 200e3])
def test_corners_of_a_triangle_are_rounded_and_excite_no_resonance(rate_hz, damping_ratio):
    """A full triangle at 100 Hz: within 1 % of it, and within 0.1 % from 0.5 ms after corners."""
    structure = STRUCTURE.model_copy(update={"damping_ratio": damping_ratio})
    model = StagedModel.around(OMEGA, lag=LAG, structure=structure)
    t = np.arange(int(0.04 * rate_hz)) / rate_hz
    triangle = 24.0 * np.arcsin(np.sin(2.0 * np.pi * 100.0 * t)) / np.pi
    inverse = model.inverse(rate_hz)
    command = inverse.process(ahead(triangle, inverse.preview))[: -inverse.preview]
    came = model.forward(rate_hz).process(command)
    error = np.abs(came - triangle[: came.size]) / np.ptp(triangle)
    begun, corner = t[: came.size] > 0.01, np.mod(100.0 * t[: came.size] - 0.25, 0.5)
    assert error[begun].max() < 0.01
    assert error[begun & (np.minimum(corner, 0.5 - corner) > 0.05)].max() < 1e-3
