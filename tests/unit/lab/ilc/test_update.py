"""Learning on plants made of numbers: it converges, stops, and backs off. Fitted responses."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.lab.ilc.cycle import CycleScore
from hilctl.lab.ilc.update import (
    FIRST_GAIN,
    IlcChange,
    IlcIteration,
    IlcResponse,
    IlcState,
    best_run,
    fit,
    learn,
    refused,
)

RATE_HZ = 50_000.0
STEP_HZ = 100.0
HARMONICS = 60
FREQUENCY = np.arange(HARMONICS + 1) * STEP_HZ
NOISE_UM = 2e-4
RESONANT = IlcResponse(1.0, 2.0 / RATE_HZ, 1.0 / (2.0 * np.pi * 2300.0) ** 2, 0.12)


class Plant:
    """Answers a correction harmonic by harmonic, with some of it in the neighbours."""

    def __init__(self, response: IlcResponse, coupling: float = 0.0, seed: int = 1) -> None:
        self._random = np.random.default_rng(seed)
        decay = np.maximum(1.0, np.arange(HARMONICS + 1)) ** -2.0
        phase = np.exp(2j * np.pi * self._random.random(HARMONICS + 1))
        self._start = decay * phase
        self._start[0] = 0.3
        self._answer = response.at(FREQUENCY)
        self._coupling = coupling
        self.corrections: list[np.ndarray] = []

    def run(self, correction: np.ndarray) -> CycleScore:
        self.corrections.append(correction)
        beside = self._coupling * (np.roll(correction, 2) + np.roll(correction, -2))
        answered = self._answer * (correction + beside)
        normal = self._random.standard_normal((2, HARMONICS + 1)) / np.sqrt(2.0)
        noise = NOISE_UM * (normal[0] + 1j * normal[1])
        error = self._start + answered + noise
        error[0] = error[0].real
        cycle = np.fft.irfft(np.append(error, np.zeros(1000)) * 2120, 2120)
        return CycleScore(
            harmonics_um=error,
            noise_um=np.full(HARMONICS + 1, NOISE_UM),
            step_hz=STEP_HZ,
            cycles=16,
            peak_um=float(np.abs(cycle).max()),
            rms_um=float(np.sqrt(np.mean(cycle**2))),
            peak_to_peak_um=100.0,
            floor_um=4.0 * NOISE_UM * np.sqrt(2.0 * HARMONICS),
            strongest_hz=STEP_HZ,
            answer=complex(self._answer[1]),
        )


def begun() -> IlcState:
    return IlcState(RATE_HZ, 6000.0, np.zeros(HARMONICS + 1, dtype=complex))


def learned(plant: Plant, cycles: int = 20) -> IlcState:
    state = begun()
    for _ in range(cycles + 1):
        (state,) = learn([state], [plant.run(state.next_um)])
        if state.done:
            break
    return state


def best(state: IlcState) -> IlcIteration:
    return state.trials[best_run([state])]


def peaks(state: IlcState) -> list[float]:
    return [trial.error.peak_um for trial in state.trials]


@pytest.mark.parametrize("response", [
    pytest.param(IlcResponse(), id="exact", marks=pytest.mark.slow),
    pytest.param(IlcResponse(0.8, 5.0 / RATE_HZ), id="late", marks=pytest.mark.slow),
    pytest.param(RESONANT, id="resonant"),
    pytest.param(IlcResponse(1.1, 3.0 / RATE_HZ, 1.0 / (2.0 * np.pi * 480.0) ** 2, 0.12),
        id="loaded", marks=pytest.mark.slow),
])  # fmt: skip
@pytest.mark.parametrize(
    "coupling", [pytest.param(0.0, marks=[pytest.mark.slow, pytest.mark.long]), 0.15]
)
def test_the_error_goes_to_the_noise_floor(response, coupling):
    """Delay, resonance and hysteresis between harmonics leave less than 2 % within 20 runs."""
    state = learned(Plant(response, coupling))
    assert min(peaks(state)) < 0.02 * peaks(state)[0]
    assert max(peaks(state)) == peaks(state)[0]


def test_strongly_coupled_harmonics_are_learned():
    """A harmonic moves its two neighbours by 40 % each, as a resonance that moves does."""
    state = learned(Plant(RESONANT, 0.4))
    assert min(peaks(state)) < 0.02 * peaks(state)[0]


@pytest.mark.slow
def test_a_resonance_that_the_fit_lacks_is_learned():
    """The fit has one resonance. The plant has another, on a harmonic, with a gain of 5."""
    plant = Plant(RESONANT, 0.15)
    second = IlcResponse(0.1, 2.0 / RATE_HZ, 1.0 / (2.0 * np.pi * 1500.0) ** 2, 0.01)
    plant._answer = 0.9 * plant._answer + second.at(FREQUENCY)
    assert "noise floor" in learned(plant).done


@pytest.mark.slow
def test_it_stops_at_the_noise_floor():
    state = learned(Plant(IlcResponse()))
    assert "noise floor" in state.done
    assert best(state).error.peak_um <= 1.2 * best(state).error.floor_um
    assert len(state.trials) < 15


def test_noise_alone_is_not_learned():
    plant = Plant(IlcResponse())
    plant._start[:] = 0.0
    (state,) = learn([begun()], [plant.run(begun().next_um)])
    assert np.abs(state.next_um).max() < NOISE_UM


def test_the_first_step_reaches_no_further_than_the_phase_is_known():
    """30 degrees of what the first answer says: 50 samples late is 30 degrees at 83 Hz."""
    quick, late = begun(), begun()
    (quick,) = learn([quick], [Plant(IlcResponse()).run(quick.next_um)])
    (late,) = learn([late], [Plant(IlcResponse(1.0, 50.0 / RATE_HZ)).run(late.next_um)])
    assert quick.reach_hz == pytest.approx(500.0)
    assert late.reach_hz == pytest.approx(STEP_HZ)


def test_the_reach_grows_while_the_error_falls():
    plant = Plant(IlcResponse())
    (state,) = learn([begun()], [plant.run(begun().next_um)])
    beyond = 1.25 * state.reach_hz < FREQUENCY
    assert not state.next_um[beyond].any()
    (further,) = learn([state], [plant.run(state.next_um)])
    assert further.reach_hz > state.reach_hz


@pytest.mark.slow
def test_it_backs_off_to_the_best_where_the_error_grows():
    plant = Plant(IlcResponse())
    (state,) = learn([begun()], [plant.run(begun().next_um)])
    (state,) = learn([state], [plant.run(state.next_um)])
    before = best(state)
    worse = plant.run(state.next_um + 0.5)
    (after,) = learn([state], [worse])
    assert best(after) is before
    assert after.gain == pytest.approx(0.5 * state.gain)
    assert abs(after.next_um[0] - before.correction_um[0]) < 0.1


@pytest.mark.slow
def test_a_plant_that_turns_the_wrong_way_does_not_run_away():
    """Where the answer has the wrong sign above 1 kHz, the error never grows far beyond its start.

    It ends with a correction no worse than none.
    """
    plant = Plant(IlcResponse())
    plant._answer = np.where(FREQUENCY > 1000.0, -1.0, 1.0) * plant._answer
    state = learned(plant)
    assert max(peaks(state)) < 1.2 * peaks(state)[0]
    assert best(state).error.peak_um < 0.5 * peaks(state)[0]


def test_a_refused_correction_is_tried_again_with_less():
    (state,) = learn([begun()], [Plant(IlcResponse()).run(begun().next_um)])
    (smaller,) = refused([state])
    assert smaller.gain == pytest.approx(0.5 * FIRST_GAIN)
    assert smaller.reach_hz < state.reach_hz
    assert np.abs(smaller.next_um).sum() < np.abs(state.next_um).sum()
    (unlearned,) = refused([begun()])
    assert unlearned.gain == FIRST_GAIN


def test_learning_ends_at_a_limit():
    (state,) = learn([begun()], [Plant(IlcResponse()).run(begun().next_um)])
    for _ in range(10):
        (state,) = refused([state])
    assert state.done == "at a limit"
    assert state.next_um is best(state).correction_um


def test_it_gives_up_where_nothing_helps():
    plant = Plant(IlcResponse())
    plant._answer = 0.0 * plant._answer
    state = learned(plant)
    assert "5 runs" in state.done
    assert len(state.trials) == 6


def test_axes_that_move_together_end_with_one_run():
    """Each plant sees 10 % of the other's displacement: both errors fall, and the worst counts."""
    plants = Plant(IlcResponse()), Plant(RESONANT)
    plants[1]._start[:] = 0.3 * plants[1]._start
    states = (begun(), begun())
    while not states[0].done:
        own = [state.next_um for state in states]
        errors = [plant.run(own[k] + 0.1 * own[1 - k]) for k, plant in enumerate(plants)]
        states = learn(states, errors)
        assert len(states[0].trials) < 30
    assert states[0].done == states[1].done
    number = best_run(states)
    worst = [
        max(state.trials[k].error.peak_um / state.trials[0].error.floor_um for state in states)
        for k in range(len(states[0].trials))
    ]
    assert worst[number] == min(worst) < 0.1 * worst[0]
    for state in states:
        assert state.next_um is state.trials[number].correction_um


def test_refused_axes_end_together():
    quick, slow = begun(), begun()
    states = learn([quick, slow], [Plant(IlcResponse()).run(quick.next_um)] * 2)
    states = (states[0], replace(states[1], gain=0.015))
    states = refused(states)
    assert [state.done for state in states] == ["at a limit"] * 2


PLANT = IlcResponse(1.05, 3.0 / RATE_HZ, 1.0 / (2.0 * np.pi * 1500.0) ** 2, 0.12)


def change(
    plant: IlcResponse, reach_hz: float, size_um: float, noise_um: float, seed: int
) -> IlcChange:
    """Every harmonic up to a reach moved by a random phase, and what a plant makes of it."""
    random = np.random.default_rng(seed)
    frequency = np.arange(60) * STEP_HZ
    moved = size_um * np.exp(2j * np.pi * random.random(60)) * (frequency <= reach_hz)
    noise = noise_um * (random.standard_normal(60) + 1j * random.standard_normal(60)) / np.sqrt(2)
    return IlcChange(STEP_HZ, moved, plant.at(frequency) * moved + noise, np.full(60, noise_um))


def test_nothing_but_the_first_answer_gives_delay_and_gain_near_what_is_usual():
    """A sine that is answered as wanted leaves a gain of 1 and about a sample of delay."""
    found = fit([], (STEP_HZ, 1.0 + 0.0j), RATE_HZ)
    assert found.gain == pytest.approx(1.0, abs=0.02)
    assert abs(found.delay_s * RATE_HZ) < 2.0
    assert found.natural_hz is None or found.natural_hz < RATE_HZ


def test_a_late_first_answer_is_seen():
    """20 samples late at 250 Hz, as a link with a buffer is."""
    late = np.exp(-2j * np.pi * 250.0 * 20.0 / RATE_HZ)
    found = fit([], (250.0, complex(late)), RATE_HZ)
    turned = np.angle(found.at(np.array([250.0])))[0]
    assert turned == pytest.approx(-2.0 * np.pi * 250.0 * 20.0 / RATE_HZ, abs=0.1)


def test_delay_and_resonance_are_found_from_changes():
    changes = [change(PLANT, 2500.0, 0.1, 1e-3, seed) for seed in (1, 2)]
    found = fit(changes, (STEP_HZ, complex(PLANT.at(np.array([STEP_HZ]))[0])), RATE_HZ)
    assert found.natural_hz == pytest.approx(1500.0, rel=0.02)
    assert found.damping_ratio == pytest.approx(0.12, abs=0.03)
    assert found.delay_s * RATE_HZ == pytest.approx(3.0, abs=0.7)


def test_the_slope_below_a_resonance_already_tells_of_it():
    """Up to 900 Hz of 1500 Hz, the answer beyond is foreseen within 30 degrees up to 1200 Hz."""
    found = fit([change(PLANT, 900.0, 0.1, 1e-3, 3)], (STEP_HZ, 1.05 + 0.0j), RATE_HZ)
    beyond = np.array([1000.0, 1100.0, 1200.0])
    turned = np.angle(found.at(beyond) / PLANT.at(beyond))
    assert np.abs(turned).max() < np.pi / 6.0


def test_changes_within_the_noise_are_not_believed():
    without = fit([], (STEP_HZ, 1.0 + 0.0j), RATE_HZ)
    hidden = fit([change(PLANT, 2500.0, 1e-3, 1e-3, 4)], (STEP_HZ, 1.0 + 0.0j), RATE_HZ)
    frequency = np.array([500.0, 1500.0])
    np.testing.assert_allclose(hidden.at(frequency), without.at(frequency), rtol=1e-6)


def test_a_strong_neighbour_is_not_taken_for_an_answer():
    moved = np.zeros(12, dtype=complex)
    moved[1], moved[2] = 1.0, 0.01
    answer = moved.copy()
    answer[2] = 0.1j
    frequency, _, _ = IlcChange(STEP_HZ, moved, answer, np.full(12, 1e-4)).points()
    assert frequency.tolist() == [100.0]


def test_no_resonance_has_no_natural_frequency():
    assert IlcResponse().natural_hz is None
    assert PLANT.natural_hz == pytest.approx(1500.0)
