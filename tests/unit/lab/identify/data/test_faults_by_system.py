"""Faults are named in the data of all kinds of actuators, and none in sound data."""

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter

from hilctl.lab.identify.data.data_faults import record_fault, table_fault
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.settings import IdentifySettings
from hilctl.models.plays import PpiModel

RATE_HZ = 1000.0
SIZE = 5000
TIME_S = np.arange(SIZE) / RATE_HZ
TURN = 2.0 * np.pi * TIME_S / TIME_S[-1]
PLAYS = PpiModel(direct=4.0, weights=(0.9, 0.7, 0.5, 0.4), thresholds=(1.0, 2.0, 3.0, 4.0))
COMMANDS = {
    "decaying": 5.0 * (1.0 - 0.95 * TIME_S / TIME_S[-1]) * np.sin(8.0 * TURN),
    "beat": 5.0 * (0.6 + 0.4 * np.cos(3.0 * TURN)) * np.sin(22.0 * TURN),
    "steps": 5.0 * np.repeat([1.0, 0.8, 0.6, 0.4, 0.2], SIZE // 5) * np.sin(30.0 * TURN),
    "random": 2.0 * (np.sin(11.3 * TURN) + np.sin(17.9 * TURN + 2.0) + np.sin(29.1 * TURN + 4.0)),
}


def plays(command):
    return PLAYS.forward(RATE_HZ).process(command)


def relaxing(displacement_um):
    """Return a displacement of which 3 % follow with each of four time constants."""
    decays = [np.exp(-1.0 / (RATE_HZ * tau_s)) for tau_s in (0.05, 0.5, 5.0, 50.0)]
    return displacement_um + 0.03 * sum(
        lfilter([1.0 - decay], [1.0, -decay], displacement_um) for decay in decays
    )


def ringing(displacement_um, natural_hz=150.0, damping_ratio=0.05):
    w = 2.0 * np.pi * natural_hz
    return lfilter(*bilinear([w * w], [1.0, 2.0 * damping_ratio * w, w * w], RATE_HZ),
                   displacement_um)  # fmt: skip


SYSTEMS = {
    "hysteresis": plays,
    "creep": lambda u: relaxing(plays(u)),
    "asymmetric": lambda u: relaxing(plays(u) + 0.3 * u**2),
    "resonance": lambda u: ringing(plays(u)),
    "lag": lambda u: plays(lfilter([0.2], [1.0, -0.8], u)),
}


FAULTS = {
    "jump": (
        lambda y: y + np.where(TIME_S > 2.5, 0.1 * np.ptp(y), 0.0), "2.501 s", "last_row=2501"),
    "transient": (
        lambda y: y + 0.8 * np.ptp(y) * np.exp(-TIME_S / 0.4), "departs", "table.ignore="),
    "spike": (
        lambda y: y + np.where(np.arange(SIZE) == 3100, 0.4 * np.ptp(y), 0.0), "3.1 s", "NaN"),
    "dead": (lambda y: np.where(TIME_S < 4.0, y, y[4000]), "hardly moves", "table.last_row="),
}  # fmt: skip


def history(displacement_um, command):
    noise_um = 0.002 * np.ptp(displacement_um)
    noisy_um = displacement_um + noise_um * np.random.default_rng(2).standard_normal(SIZE)
    return History("h.csv", command, noisy_um, RATE_HZ, rows=1 + np.arange(SIZE))


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_no_fault_is_named_in_sound_data(system, command):
    record = history(SYSTEMS[system](COMMANDS[command]), COMMANDS[command])
    assert table_fault(record) == ""
    assert record_fault(record, IdentifySettings(kind="ppi")) == ""


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_fault_is_named_with_its_place_and_option(system, fault):
    change, place, option = FAULTS[fault]
    # The range of the random command is covered when the transient has ended.
    command = COMMANDS["decaying" if fault == "transient" else "random"]
    found = table_fault(history(change(SYSTEMS[system](command)), command))
    assert place in found
    assert option in found
