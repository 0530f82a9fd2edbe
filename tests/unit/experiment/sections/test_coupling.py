"""The coupling key: filters, removal of crosstalk, and its rules."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import dump
from hilctl.experiment.load import load_axes, load_experiment
from hilctl.experiment.preflight import check, check_axes
from hilctl.experiment.sections.coupling import (
    Coupling,
    CrosstalkFilter,
    coupled_feedback_problems,
    load_coupling,
    write_coupling,
)
from hilctl.experiment.sections.feedback import PiFeedbackConfig

STAGE = Path(__file__).parents[4] / "configs" / "stage_xy.yaml"
SHORT = ["waveform.duration_s=0.5", "sample_rate_hz=10000"]


def crosstalk(*taps, first_sample=0, spacing=1):
    return CrosstalkFilter(
        first_sample=first_sample, spacing=spacing, taps=taps, coherence=1.0,
        noise_percent=0.0, residual_percent=0.0,
    )  # fmt: skip


def coupling(x=None, y=None, axes=("x", "y"), rate_hz=10000.0):
    into = {"x": {"y": x} if x else {}, "y": {"x": y} if y else {}}
    return Coupling(axes=axes, sample_rate_hz=rate_hz, highest_hz=500.0, into=into)


@pytest.fixture
def used(tmp_path):
    """Return the settings that name a coupling, which is written first."""

    def write(found):
        path = tmp_path / "coupling.yaml"
        write_coupling(path, found, overwrite=True)
        return [*SHORT, f"coupling={path}"]

    return write


def refused(settings):
    with pytest.raises(ConfigError) as error:
        check_axes(load_axes(STAGE, settings))
    return error.value.problems


@pytest.mark.parametrize(("taps", "first"), [(1, 0), (4, 3), (4, -9), (900, -30)])
def test_filter_is_a_convolution_whose_ends_hold(taps, first):
    rng = np.random.default_rng(3)
    values, weights = rng.standard_normal(70_000), rng.standard_normal(taps)
    found = coupling(crosstalk(*weights, first_sample=first)).crosstalk(
        {"x": np.zeros(values.size), "y": values}
    )
    held = np.pad(values, 2000, mode="edge")
    wanted = np.convolve(held, weights)[2000 - first :][: values.size]
    np.testing.assert_allclose(found["x"], wanted, atol=1e-10)
    assert not found["y"].any()


def test_taps_apart_are_smoothed_about_their_places():
    response, first = crosstalk(0.01, 0.02, 0.01, first_sample=-10, spacing=10).response()
    assert response.sum() == pytest.approx(0.04)
    assert (np.arange(response.size) + first) @ response / response.sum() == pytest.approx(0.0)
    assert response.size == 57


def test_removed_crosstalk_is_that_of_the_inputs():
    """So that each axis moves as if the others did not."""
    strong = coupling(crosstalk(0.1, 0.2, -0.1, first_sample=-1), crosstalk(0.3))
    rng = np.random.default_rng(1)
    wanted = {name: np.cumsum(rng.standard_normal(3000)) for name in "xy"}
    rests = {"x": 2.0, "y": -1.0}
    removed = strong.removed(wanted, rests)
    own = {name: wanted[name] - removed[name] - rests[name] for name in wanted}
    seen = strong.crosstalk(own)
    for name, values in wanted.items():
        np.testing.assert_allclose(own[name] + rests[name] + seen[name], values, atol=1e-4)


def test_file_is_read_back_bit_for_bit(tmp_path):
    made = coupling(crosstalk(1.0 / 3.0, 1e-7, spacing=7), crosstalk(-0.1))
    path = tmp_path / "coupling.yaml"
    write_coupling(path, made, overwrite=False)
    assert load_coupling(path) == made
    path.write_text(dump({"coupling": {**made.model_dump(mode="json"), "axes": ["x", "z"]}}))
    with pytest.raises(ConfigError, match="y"):
        load_coupling(path)


def test_inputs_are_decoupled_and_recorded(used):
    settings = used(coupling(crosstalk(0.05), crosstalk(0.02)))
    run = check_axes(load_axes(STAGE, settings))
    assert run.coupled
    assert not check_axes(load_axes(STAGE, SHORT)).coupled
    x, y = run.axes
    assert x.records_input
    preview = x.begun.preview
    inputs = [each.begun.input_um[:-preview] for each in (x, y)]
    wanted = [each.reference.values[preview:] for each in (x, y)]
    rest = wanted[0][0]  # both begin there
    np.testing.assert_allclose(inputs[0] + 0.05 * (inputs[1] - rest), wanted[0], atol=1e-3)
    np.testing.assert_allclose(inputs[1] + 0.02 * (inputs[0] - rest), wanted[1], atol=1e-3)


def test_one_axis_of_a_coupled_stage_runs_alone(used, tmp_path):
    """The others are at rest then; a coupling set for one axis is refused."""
    used(coupling(rate_hz=50000.0))
    stage = tmp_path / "stage.yaml"
    model = f"model: {STAGE.parent}/models"
    text = STAGE.read_text(encoding="utf-8").replace("model: models", model)
    stage.write_text(f"{text}coupling: coupling.yaml\n", encoding="utf-8")
    assert all(each.coupling for each in load_axes(stage))
    assert coupling(rate_hz=50000.0) == load_axes(stage)[1].coupling
    assert load_experiment(stage, ["axis=x"]).coupling is None
    with pytest.raises(ConfigError, match="coupling"):
        check(load_experiment(stage, ["axis=x", "coupling=coupling.yaml"]))


@pytest.mark.parametrize("other", [
    coupling(axes=("x", "z", "y")),
    coupling(rate_hz=50000.0),
    coupling(crosstalk(0.6)),
])  # fmt: skip
def test_foreign_or_strong_couplings_are_refused(used, other):
    (problem,) = refused(used(other))
    assert problem.key == "coupling"


def test_every_axis_needs_a_compensator(used):
    bare = ["axes.y.compensator=none", "axes.y.waveform.unit=A", "axes.y.waveform.amplitude=1"]
    assert "coupling" in {each.key for each in refused([*used(coupling()), *bare])}


def test_pi_feedback_is_refused_near_strong_crosstalk():
    found = coupling(crosstalk(0.35), crosstalk(0.05))
    slow = PiFeedbackConfig(limit_um=1.0, bandwidth_hz=50.0)
    (problem,) = coupled_feedback_problems(found, "x", slow, 10000.0)
    assert problem.key == "feedback"
    assert not [*coupled_feedback_problems(found, "y", slow, 10000.0)]
    assert not [*coupled_feedback_problems(None, "x", slow, 10000.0)]
