"""Causes of a large error are named only if the error halves without them."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.pipeline import identify_records
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.plays import PpiModel

TRUTH = PpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(2.0, 4.0))
RATE_HZ = 1000.0
TIME_S = np.arange(20_000) / RATE_HZ
CREEP = np.log1p(TIME_S / 0.1)


def noise(size_um):
    return size_um * np.random.default_rng(5).standard_normal(TIME_S.size)


def spikes(size_um, step=97):
    out = np.zeros(TIME_S.size)
    out[::step] = size_um
    return out


def asymmetric(command):
    return TRUTH.forward(RATE_HZ).process(command) + 0.5 * command**2


def causes(command, displacement_um):
    """Return the causes that are named of drift, spikes and noise."""
    settings = FitSettings(kind="ppi", plays=2, starts=1, weights="free")
    record = History("h", command, displacement_um, RATE_HZ)
    verdict = identify_records(FitRequest([record], settings)).verdict
    text = " ".join((*verdict.reasons, *verdict.notes))
    return {each for each in ("drifts by", "spikes", "sensor noise") if each in text}


def decay(frequency_hz=1.0):
    return (6.0 - 0.27 * TIME_S) * np.sin(2.0 * np.pi * frequency_hz * TIME_S)


def beat(frequency_hz=1.0):
    slow = 0.6 + 0.4 * np.cos(2.0 * np.pi * 0.3 * TIME_S)
    return 6.0 * slow * np.sin(2.0 * np.pi * frequency_hz * TIME_S)


@pytest.mark.parametrize("command", [decay(), beat(), beat(20.0)])
@pytest.mark.parametrize(("added_um", "named"), [
    (1.0 * TIME_S, {"drifts by"}),
    (-2.0 * TIME_S, {"drifts by"}),
    (4.0 * CREEP, set()),
    (-2.0 * CREEP, set()),
    (0.0 * TIME_S, set()),
    (noise(0.02), set()),
    (spikes(40.0), {"spikes"}),
])  # fmt: skip
def test_a_cause_is_named_if_it_is_one(command, added_um, named):
    assert causes(command, TRUTH.forward(RATE_HZ).process(command) + added_um) == named


@pytest.mark.parametrize("command", [decay(), beat(), decay(3.0)])
@pytest.mark.parametrize("added_um", [0.0 * TIME_S, 2.0 * CREEP, noise(0.2)])
def test_no_fault_of_the_model_is_one_of_the_data(command, added_um):
    assert causes(command, asymmetric(command) + added_um) == set()


def test_noise_is_named_as_the_cause_of_an_error():
    command = decay(40.0)
    noisy_um = TRUTH.forward(RATE_HZ).process(command) + noise(2.0)
    assert causes(command, noisy_um) == {"sensor noise"}


def loops(loop_of, drifts, rate_um_per_s=2.0):
    """Return loops of a sensor that drifts, each averaged at its time."""
    found = [loop_of(TRUTH, a, f) for a in (2.0, 4.0, 6.0) for f in (10.0, 50.0, 100.0)]
    return [
        replace(
            loop,
            displacement_um=loop.displacement_um + rate_um_per_s * 3.0 * at,
            start_s=3.0 * at,
            drift_um_per_s=drift,
        )
        for at, (loop, drift) in enumerate(zip(found, drifts, strict=True))
    ]


@pytest.mark.parametrize(("drifts", "named"), [
    ([2.0, 2.1, 1.9] * 3, True),
    ([0.1, -3.0, 1.0] * 3, False),
    ([0.0] * 9, False),
])  # fmt: skip
def test_drift_of_loops_is_what_their_cycles_show(loop_of, drifts, named):
    settings = FitSettings(kind="ppi", plays=2, starts=1, weights="free")
    verdict = identify_records(FitRequest(loops(loop_of, drifts), settings)).verdict
    assert any("drifts by about 2 " in text for text in (*verdict.reasons, *verdict.notes)) == named
