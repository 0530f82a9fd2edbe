"""Models whose parameters are known are found again from their own loops."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.types import CommandUnit
from hilctl.lab.identify.data.records import History, Records, SteadyLoop
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.fit_api import LEAST_SLOPE, FitRequest
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import (
    FittedModel,
    fit_kind,
    fit_model,
    identified_range,
)
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.integrated import IntegratedModel, even_thresholds
from hilctl.models.linear_stages import CreepModel, FurtherMode
from hilctl.models.model_file import dump_model, parse_model
from hilctl.models.plays import PpiModel, RdpiModel
from hilctl.models.staged import FieldLag, StagedModel
from tests.published import piezo_ppi, terfenol_rdpi
from tests.unit.lab.identify.conftest import OMEGA
from tests.unit.models.test_staged import OMEGA as SMALL_OMEGA

Loops = Callable[..., list[SteadyLoop]]
GRID = [(a, f) for a in (3.0, 6.0) for f in (10.0, 50.0, 100.0, 150.0, 250.0)]


def fit(kind: str, data: Records, unit: CommandUnit = "A", **choices: Any) -> FittedModel:
    return fit_model(FitRequest(data, FitSettings(kind=kind, **choices), unit=unit))


def check(found: FittedModel, peak_percent: float = 0.1) -> None:
    assert found.own_peak_percent < peak_percent
    assert found.peak_percent <= found.own_peak_percent * (1.0 + 1e-12)
    assert all(abs(error.area_error_percent or 0.0) < 1.0 for error in found.errors)


def test_published_piezo_ppi_is_found_again(loops_of):
    """The PPI of the piezo stage comes back from its loop under 30 sin + 40 V (section 3.4.2).

    Its tenth threshold is beyond 30 V and never moves in that loop, so the drive is 38 V here.
    """
    loops = loops_of(piezo_ppi(), [(38.0, 1.0), (20.0, 1.0)], centre=40.0)
    found = fit("ppi", loops, "V", offset=True)
    check(found)
    expected = {"sigma": 3.548, "alpha": 0.0383, "beta": 0.1206, "p_0": 0.2567}
    for name, value in expected.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.02), name
    assert found.model.input_unit == "V"
    assert found.model.input_range == pytest.approx((2.0, 78.0), abs=1e-3)


def test_published_rdpi_is_found_again(loops_of):
    """The n = 4 RDPI of the magnetostrictive actuator comes back from 1 to 200 Hz (section 5.3)."""
    truth = terfenol_rdpi()
    found = fit("rdpi", loops_of(truth, [(2.3, f) for f in (1.0, 10.0, 50.0, 100.0, 200.0)], 400))
    check(found)
    assert found.model.gamma_s == pytest.approx(truth.gamma_s, rel=0.01)
    assert found.model.direct == pytest.approx(truth.direct, rel=0.01)
    np.testing.assert_allclose(found.model.thresholds, truth.thresholds, rtol=0.01)
    np.testing.assert_allclose(found.model.weights, truth.weights, atol=0.02 * truth.direct)
    assert found.parameters["a_4"] == found.model.weights[3]


@pytest.mark.parametrize("layout", ["even", "midpoint"])
def test_rdpi_with_exponential_weights(loops_of, layout):
    shift = 0.5 if layout == "midpoint" else 0.0
    truth = RdpiModel(
        direct=2.0,
        weights=tuple((1.5 * np.exp(-0.3 * np.arange(1, 7))).tolist()),
        thresholds=tuple((0.4 * (np.arange(1, 7) - shift)).tolist()),
        gamma_s=2e-4,
        output_offset_um=-3.0,
    )
    loops = loops_of(truth, [(3.0, 10.0), (3.0, 100.0)])
    found = fit("rdpi", loops, plays=6, weights="exponential", layout=layout, offset=True)
    check(found)
    assert found.parameters["alpha"] == pytest.approx(0.4, rel=0.01)
    assert found.parameters["gamma"] == pytest.approx(2e-4, rel=0.01)
    assert found.parameters["beta_0"] == pytest.approx(0.3, rel=0.03)
    assert found.model.output_offset_um == pytest.approx(-3.0, abs=0.02)


@pytest.mark.parametrize("skipped", [False, True])
def test_ppi_with_free_weights_from_a_decaying_history(skipped):
    truth = PpiModel(
        input_unit="V",
        direct=1.0,
        weights=(0.2, 1.5, 0.0, 0.7),
        thresholds=tuple(even_thresholds(0.4, 4).tolist()),
        output_offset_um=-12.0,
    )
    time = np.arange(3000)
    command = 1.8 + 1.8 * np.sin(2 * np.pi * time / 200) * np.interp(time, [1000, 2800], [1, 0])
    displacement_um = truth.forward(200.0).process(command)
    held = np.arange(1010, 1015) if skipped else np.empty(0, np.int64)
    displacement_um[held] += 5.0
    displacement_um[held + 10] -= 5.0  # still in motion after the jump of the command
    history = History("decay", command, displacement_um, 200.0, 100, held)
    found = fit("ppi", [history], plays=4, weights="free", offset=True)
    assert found.own_peak_percent < 0.01
    np.testing.assert_allclose(found.model.weights, truth.weights, atol=2e-3)
    assert found.errors[0].area_error_percent is None


@pytest.mark.slow
def test_published_parametrisation_of_omega_is_found_again(loops_of):
    """Eleven parameters of the integrated model come back from the published grid (6.24)."""
    found = fit("integrated", loops_of(OMEGA, GRID))
    check(found)
    expected = {"alpha": 0.33, "gamma": 2.5e-4, "a_0": 3.0, "alpha_0": 1.4, "beta_0": 0.23}
    for name, value in expected.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.05), name
    x = np.linspace(-45.0, 30.0, 50)
    np.testing.assert_allclose(found.model.deadband(x), OMEGA.deadband(x), atol=0.1)


def test_omega_with_free_weights(loops_of):
    """Free weights describe loops that exponential ones can't, within 0.1 % of the stroke."""
    weights = np.array(OMEGA.weights) * (1.0 + 0.4 * np.cos(np.arange(12)))
    truth = OMEGA.model_copy(update={"weights": tuple(weights.tolist())})
    loops = loops_of(truth, [(3.0, 10.0), (6.0, 10.0), (6.0, 100.0), (6.0, 250.0)])
    published = fit("integrated", loops, starts=2)
    free = fit("integrated", loops, starts=2, weights="free")
    assert free.peak_percent < 0.1 < published.peak_percent
    assert min(free.model.weights) >= 0.0
    IntegratedModel.model_validate(free.model.model_dump())


@pytest.mark.parametrize(("rate_hz", "rest"), [(75_000.0, 0.01), (50_000.0, 0.25)])
def test_errors_are_those_of_the_run_at_its_own_rate(loops_of, rate_hz, rest):
    """Loops of 300 points predict what the model does sample by sample in the run.

    At 250 Hz a cycle has 300 samples at 75 kHz, which leaves nothing; it has 200 at 50 kHz, whose
    turns lie at other phases, which leaves 0.2 % of the stroke.
    """
    wrong = OMEGA.model_copy(update={"gamma_s": 4e-4})
    (measured,) = loops_of(OMEGA, [(6.0, 250.0)], rate_hz=rate_hz)
    (modelled,) = loops_of(wrong, [(6.0, 250.0)], rate_hz=rate_hz)
    judged = judge(wrong, [measured])
    difference = modelled.displacement_um - measured.displacement_um
    expected = 100.0 * np.max(np.abs(difference)) / np.ptp(measured.displacement_um)
    assert expected > 3.0
    assert judged.peak_percent == pytest.approx(expected, abs=rest)
    assert judge(OMEGA, [measured]).peak_percent < rest


def test_hysteresis_weights_shift_the_fit_to_wide_loops(loops_of):
    """Weighted as in (5.14), the loop with most hysteresis is fitted better than unweighted."""
    loops = loops_of(OMEGA, [(6.0, f) for f in (1.0, 50.0, 250.0)])
    even = fit("rdpi", loops, weight_by="equal")
    weighted = fit("rdpi", loops, weight_by="hysteresis")
    assert weighted.errors[2].rms_percent < even.errors[2].rms_percent
    assert weighted.errors[0].rms_percent > even.errors[0].rms_percent


def test_no_slope_falls_below_the_least(loops_of):
    """Loops of pure plays would have a_0 = 0; it stays at the least slope, so it inverts."""
    play = PpiModel(direct=1e-6, weights=(2.0,), thresholds=(0.7,), input_unit="V")
    loops = loops_of(play, [(2.0, 1.0)])
    found = fit("ppi", loops, plays=3, weights="free")
    low, high = found.model.input_range
    gain = found.errors[0].peak_to_peak_um / (high - low)
    assert found.model.direct == pytest.approx(LEAST_SLOPE * gain, rel=1e-9)
    found.model.inverse(1000.0)


def test_provenance_and_mapping_say_where_the_model_is_from(loops_of):
    loops, parts = loops_of(OMEGA, GRID[:1] + GRID[5:6]), []
    settings = FitSettings(kind="integrated", starts=1)
    told = {"source": ["grid.mcap"], "progress": lambda done, text: parts.append(done)}
    found = fit_model(FitRequest(loops, settings, **told))
    provenance = found.model.provenance
    assert provenance.source == ("grid.mcap",)
    low, high = found.model.output_range_um
    assert high - low == pytest.approx(found.errors[1].peak_to_peak_um)
    assert provenance.method == "integrated, Omega: rate, asymmetry (6.18-6.24); starts=1"
    assert provenance.grid[1].startswith("6 at 10 Hz: -6 to 6, 300 points")
    assert provenance.errors_percent["peak"] == found.peak_percent
    assert set(provenance.versions) == {"hilctl", "numpy", "scipy"}
    assert parse_model("x.yaml", dump_model(found.model)) == found.model
    mapping = json.loads(json.dumps(found.to_mapping(), allow_nan=False))
    assert mapping["elapsed_s"] > 0.0
    assert mapping["model"]["kind"] == "integrated"
    assert mapping["errors"][0]["label"] == "3 at 10 Hz"
    assert parts[-1] == 1.0


def test_no_data_are_refused():
    with pytest.raises(DataError, match="empty"):
        fit("ppi", [])


RATE_HZ = 2000.0
MODE = FurtherMode(
    natural_hz=150.0, damping_ratio=0.1, antiresonance_hz=140.0, antiresonance_damping_ratio=0.1
)
FIELD = FitSettings(kind="field", plays=8, cells=8, knots=8)
TRUTH = StagedModel.around(
    SMALL_OMEGA,
    lag=FieldLag(tau_s=1e-3),
    creep=CreepModel(time_constants_s=(0.11, 1.3, 14.0), shares=(0.015, 0.02, 0.02)),
)


@pytest.fixture(scope="module")
def records():
    """A growing sine, rests on either side, and random motion."""
    time_s = np.arange(4000) / RATE_HZ
    parts = [2.0 * time_s * np.sin(2.0 * np.pi * 8.0 * time_s)]
    last = float(parts[0][-1])
    for level in (3.5, -3.5, 0.0):
        parts += [np.linspace(last, level, 200), np.full(3000, level)]
        last = level
    rng = np.random.default_rng(3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    waves = np.sin(2.0 * np.pi * np.outer(time_s, np.arange(2.0, 26.0, 2.0)) + phases).sum(axis=1)
    parts.append(4.0 * waves / np.abs(waves).max() * np.sin(np.pi * time_s / time_s[-1]))
    command = np.concatenate(parts)
    displacement_um = TRUTH.forward(RATE_HZ).process(command)
    return [History("made", command, displacement_um, RATE_HZ)]


def error_um(model, records):
    (record,) = records
    came = model.forward(record.sample_rate_hz).process(record.command)
    return float(np.sqrt(np.mean((came - record.displacement_um) ** 2)))


def test_the_model_creeps_and_fits_the_better_for_it(records):
    creeping = fit_kind(FitRequest(records, FIELD, "A"))
    plain = fit_kind(FitRequest(records, FIELD.model_copy(update={"creep_stage": False}), "A"))
    assert creeping.model.creep is not None
    assert plain.model.creep is None
    assert error_um(creeping.model, records) < 0.15 * error_um(plain.model, records)
    assert creeping.parameters["creep_share"] == pytest.approx(sum(creeping.model.creep.shares))
    assert "creep_share" not in plain.parameters


def test_overshoot_does_not_widen_the_range(records):
    """A reference may be slow, and then it is not amplified."""
    (record,) = records
    mode = MODE.model_copy(update={"natural_hz": 30.0, "antiresonance_hz": 60.0})
    ringing_um = mode.forward(RATE_HZ).process(record.displacement_um)
    moved = [replace(record, displacement_um=ringing_um)]
    low_um, high_um = fit_model(FitRequest(moved, FIELD, "A", modes=[mode])).model.output_range_um
    calm_um = record.displacement_um
    assert np.ptp(ringing_um) > 1.3 * np.ptp(calm_um)
    assert [low_um, high_um] == pytest.approx([calm_um.min(), calm_um.max()], rel=0.1)


def test_a_drive_of_one_sign_does_not_return_to_its_first_rest():
    swept = np.interp(np.arange(6001) / 1000.0, np.arange(7.0), [0, 4, 0, 2, 1, 4, 0])
    swung_um = StagedModel.around(SMALL_OMEGA).forward(RATE_HZ).process(swept)
    records = [History("made", swept, swung_um, RATE_HZ)]
    low_um, high_um = fit_model(FitRequest(records, FIELD, "A")).model.output_range_um
    assert low_um == pytest.approx(swung_um[2000], abs=0.02 * np.ptp(swung_um))
    assert high_um == pytest.approx(swung_um.max(), abs=0.02 * np.ptp(swung_um))
    assert low_um > 0.03 * np.ptp(swung_um)


def test_known_modes_are_taken_off_the_records_and_put_into_the_model(records):
    (record,) = records
    ringing_um = MODE.forward(RATE_HZ).process(record.displacement_um)
    moved = [replace(record, displacement_um=ringing_um)]
    bare = fit_kind(FitRequest(records, FIELD, "A"))
    with_it = fit_kind(FitRequest(moved, FIELD, "A", modes=[MODE]))
    assert with_it.model.modes == (MODE,)
    assert with_it.parameters["antiresonance_hz_2"] == MODE.antiresonance_hz
    assert len(with_it.parameters) == len(bare.parameters) + 4
    assert with_it.numbers > bare.numbers  # weights that come out as 0 do not count
    assert error_um(with_it.model, moved) < 2.0 * error_um(bare.model, records)


def test_kinds_without_stages_have_no_creep(records):
    model = fit_kind(FitRequest(records, FitSettings(kind="ppi", plays=4), "A", modes=[MODE])).model
    assert not hasattr(model, "creep")


TURN = 2.0 * np.pi * np.arange(300) / 300


def loop(amplitude, frequency_hz, harmonic=0.0):
    command = amplitude * (np.sin(TURN) + harmonic * np.sin(2.0 * TURN))
    return SteadyLoop("loop", command, 5.0 * command, frequency_hz, 50_000.0)


def test_motions_frequencies_and_speed():
    found = identified_range(FitData([loop(1.0, 100.0), loop(6.0, 10.0, harmonic=0.5)]))
    assert found.peak_to_peak_um[0] == pytest.approx(10.0, rel=1e-3)
    assert found.frequency_hz == pytest.approx((10.0, 100.0))
    assert found.speed_um_per_s == pytest.approx(5.0 * 2.0 * np.pi * 120.0, rel=0.05)
    assert identified_range(FitData([loop(1.0, 10.0, 0.5)])).frequency_hz[1] == 20.0


def test_motions_that_are_not_evaluated_are_not_in_the_identified_range():
    """Of two cycles, the first is from -10 and thus larger."""
    command = np.sin(np.linspace(0.0, 4.0 * np.pi, 400))
    displacement_um = 5.0 * command
    displacement_um[0] = -10.0
    record = History("sine", command, displacement_um, 1e3, ignore=200)
    assert identified_range(FitData([record])).peak_to_peak_um == pytest.approx(
        (10.0, 10.0), rel=0.01
    )


def test_of_a_history_the_frequencies_of_its_command():
    """A sweep from 2 to 20 Hz, a sine, and a sine with rests in which the sensor is noisy."""
    time_s = np.arange(20_000) / 1000.0
    command = np.sin(2.0 * np.pi * (2.0 + 0.45 * time_s) * time_s)
    low, high = identified_range(FitData([History("sweep", command, command, 1e3)])).frequency_hz
    assert low == pytest.approx(2.2, abs=0.5)
    assert high == pytest.approx(20.0, abs=1.0)
    command = np.sin(2.0 * np.pi * 7.7 * time_s)
    faded = 10.0 * np.maximum(np.sin(2.0 * np.pi * time_s / 20.0), 0.0) * command
    resting = faded + 1e-3 * np.random.default_rng(1).random(time_s.size)
    for each in (command, resting):
        found = identified_range(FitData([History("sine", each, each, 1e3)])).frequency_hz
        assert found == pytest.approx((7.7, 7.7), abs=2.0)


def test_of_a_history_the_swings_from_turn_to_turn():
    time_s = np.arange(20_000) / 1000.0
    wave = np.sin(2.0 * np.pi * 5.0 * time_s)
    for part, wanted_um in ((0.3, 5.0), (0.9, 30.0)):
        command = np.where(np.arange(wave.size) < part * wave.size, 3.0, 0.5) * wave
        history = History("both", command, 5.0 * command, 1e3)
        found = identified_range(FitData([history])).peak_to_peak_um
        assert found == pytest.approx((wanted_um, 30.0), rel=0.01)


def test_of_a_history_that_turns_little_all_of_it():
    command = np.concatenate((np.linspace(0.0, 2.0, 100), np.linspace(2.0, 0.0, 100)))
    found = identified_range(FitData([History("once", command, 5.0 * command, 1e3)]))
    assert found.peak_to_peak_um == pytest.approx((10.0, 10.0))
