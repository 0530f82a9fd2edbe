"""The proposal for an actuator of a sample's delay, whose margins are analytic; its page."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import HilctlError
from hilctl.base.segments import Segment
from hilctl.base.yaml import Document, dump
from hilctl.lab.response.feedback_design import design_feedback, write_design
from hilctl.loop.feedback import MOST_GAIN_PER_BLOCK
from tests.unit.experiment.sections.test_adaptation import MODEL, PLAIN
from tests.unit.loop.test_feedback import EXPERIMENT

RATE_HZ, PERIOD, PERIODS = 5000.0, 1000, 6
FEEDBACK = "{limit_um: 5.0, bandwidth_hz: 50.0, sensor_delay_s: 0.001}"


@pytest.fixture
def measured(make_recording):
    """Return a recording of a multisine through a compensator, with noise, by experiment keys."""

    def measure(text=PLAIN, *settings, last=480, sign=1.0, compensated=True, **facts):
        document = Document("e", text)
        for setting in settings:
            document.set(setting)
        turns = np.outer(np.arange(1, last, 4), np.arange(PERIOD * PERIODS)) / PERIOD
        phases = -np.pi * np.arange(len(turns)) ** 2 / len(turns)
        wave = np.sin(2.0 * np.pi * turns + phases[:, None]).sum(axis=0)
        moved = sign * np.roll(wave, 1) + 1e-3 * np.random.default_rng(1).standard_normal(wave.size)
        segment = Segment("multisine 1 µm", 0, wave.size, 0, wave.size, float(PERIOD))
        recording = make_recording(
            moved, reference_um=wave, segments=[segment], sample_rate_hz=RATE_HZ, run=facts,
            experiment_yaml=dump(document.data),
        )  # fmt: skip
        return replace(recording, model_yaml=MODEL, compensated=compensated)

    return measure


def test_the_gain_of_single_samples_has_its_margins(measured, tmp_path):
    """The phase margin of 60 degrees leaves 30 degrees for 1.5 samples."""
    of_earlier_release = measured(PLAIN, "timing.late_policy=skip")
    design = design_feedback(of_earlier_release, "response.yaml")
    assert design.feedback["kind"] == "pi"
    assert design.feedback["bandwidth_hz"] == pytest.approx(RATE_HZ / 18.0, rel=0.01)
    assert design.feedback["response"] == "response.yaml"
    assert design.proposed.phase_margin_deg == pytest.approx(60.0, abs=1.0)
    assert design.proposed.gain_margin_db == pytest.approx(9.2, abs=0.2)
    assert design.recorded is None
    write_design(design, tmp_path / "tune.html")
    assert "bandwidth_hz" in (tmp_path / "tune.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("block", "latency"), [(20, 0), (1, 2), (20, 2)])
def test_blocks_and_a_fifo_get_the_integral_controller(measured, block, latency):
    found = design_feedback(measured(PLAIN, f"block={block}", latency_blocks=str(latency)))
    assert found.feedback["kind"] == "integral"
    wait = (1 + latency) * block + 0.5  # samples
    assert found.feedback["bandwidth_hz"] == pytest.approx(RATE_HZ / 12.0 / wait, rel=0.03)


def test_the_gain_per_block_is_one_that_a_run_accepts(measured):
    """The margins alone allow a larger one if the displacement is a third of the reference."""
    found = design_feedback(measured(PLAIN, "block=20", sign=0.3))
    gain_per_block = 2.0 * np.pi * found.feedback["bandwidth_hz"] * 20 / RATE_HZ
    assert 0.99 < gain_per_block < MOST_GAIN_PER_BLOCK


def test_recorded_feedback_is_evaluated_and_its_other_keys_are_kept(measured):
    design = design_feedback(measured(EXPERIMENT, f"feedback={FEEDBACK}"))
    assert design.recorded.crossover_hz == pytest.approx(50.0, rel=0.02)
    assert design.feedback["sensor_delay_s"] == 0.001
    assert design.to_mapping()["recorded"]["phase_margin_deg"] > 80.0


@pytest.mark.parametrize("facts", [{"compensated": False}, {"sign": -1.0}, {"last": 100}], ids=str)
def test_a_run_without_a_usable_response(measured, facts):
    with pytest.raises(HilctlError, match=r"^run\.mcap: "):
        design_feedback(measured(**facts))
