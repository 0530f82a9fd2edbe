"""Structure and further modes: their conditions, frequency responses and inverses."""

import math
import subprocess
import sys

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ModelError
from hilctl.kernels.dynamics import unmode_stage
from hilctl.models.mechanics import FirstMode, FurtherMode, _decay

RATE_HZ = 50e3
MODE = {
    "natural_hz": 900.0,
    "damping_ratio": 0.04,
    "antiresonance_hz": 760.0,
    "antiresonance_damping_ratio": 0.02,
}


def answer(operator, frequency_hz):
    """Return the steady answer to a sine, as a complex gain."""
    time_s = np.arange(round(0.4 * RATE_HZ)) / RATE_HZ
    out = operator.process(np.sin(2.0 * math.pi * frequency_hz * time_s))
    steady = slice(round(0.3 * RATE_HZ), None)
    turning = np.exp(-2j * math.pi * frequency_hz * time_s[steady])
    return 2j * np.mean(out[steady] * turning)


def second_order(frequency_hz, natural_hz, damping_ratio):
    part = 1j * frequency_hz / natural_hz
    return 1.0 / (1.0 + 2.0 * damping_ratio * part + part**2)


@pytest.mark.parametrize("frequency_hz", [100.0, 760.0, 900.0, 1500.0])
def test_a_mode_answers_sines_as_its_response_says(frequency_hz):
    mode = FurtherMode(**MODE)
    wanted = mode.response(np.array([frequency_hz]))[0]
    up = second_order(frequency_hz, 900.0, 0.04) / second_order(frequency_hz, 760.0, 0.02)
    assert wanted == pytest.approx(up)
    assert answer(mode.forward(RATE_HZ), frequency_hz) == pytest.approx(wanted, rel=2e-3, abs=3e-3)


def test_modes_side_by_side_are_the_first_and_a_pair():
    """(1 - c) G_1 + c G_2 with equal damping of both, over frequencies on all sides of them."""
    share, first, second = 0.1, (2300.0, 0.12), (700.0, 0.03)
    w, f = np.array([first[0], second[0]]), np.array([50.0, 300.0, 690.0, 1200.0, 3000.0])
    bend = (1.0 - share) / w[1] ** 2 + share / w[0] ** 2
    slope = 2.0 * ((1.0 - share) * second[1] / w[1] + share * first[1] / w[0])
    hz = 1.0 / math.sqrt(bend)
    mode = FurtherMode(natural_hz=w[1], damping_ratio=second[1], antiresonance_hz=hz,
                antiresonance_damping_ratio=0.5 * slope * hz)  # fmt: skip
    both = (1.0 - share) * second_order(f, *first) + share * second_order(f, *second)
    np.testing.assert_allclose(second_order(f, *first) * mode.response(f), both, rtol=1e-12)


def test_the_inverse_of_a_mode_is_exact_and_dies_away():
    x = np.cumsum(np.random.default_rng(3).standard_normal(20_000))
    mode = FurtherMode(**MODE)
    y = mode.forward(RATE_HZ).process(x)
    np.testing.assert_allclose(mode.inverse(RATE_HZ).process(y), x, rtol=0.0, atol=1e-8)
    step = mode.inverse(RATE_HZ).process(np.concatenate(([0.0], np.ones(round(0.5 * RATE_HZ)))))
    assert step[-1] == pytest.approx(1.0, abs=1e-9)


def test_a_mode_beyond_what_samples_show_is_refused_in_words():
    mode = FurtherMode(**(MODE | {"natural_hz": 8000.0, "antiresonance_hz": 700.0}))
    with pytest.raises(ModelError, match=r"8000 Hz .* can't be undone at 5000 samples a second"):
        mode.inverse(5000.0)


@pytest.mark.parametrize("change", [
    {},
    {"natural_hz": 2500.0, "damping_ratio": 0.3},
    {"antiresonance_hz": 1500.0, "antiresonance_damping_ratio": 0.2},
    {"natural_hz": 8000.0, "antiresonance_hz": 700.0},
])  # fmt: skip
def test_what_is_known_of_the_inverse_s_decay_is_what_it_does(change):
    """Whether it dies away or grows, by what is left of a moment's input after some time."""
    parameters = FurtherMode(**(MODE | change))._parameters(5000.0)
    memory, sizes = np.array([0.3, -0.7, 1.0]), []
    for _ in range(2):
        unmode_stage(np.zeros(60), parameters, memory, np.empty(60))
        sizes.append(float(np.abs(memory).max()))
    # Over a whole number of turns it would be exact.
    rate = (sizes[1] / sizes[0]) ** (1.0 / 60.0)
    assert rate == pytest.approx(_decay(parameters), rel=0.02)


def test_a_mode_that_would_come_to_grow_slowly_is_refused_too():
    mode = FurtherMode(
        natural_hz=1500.0, damping_ratio=0.01, antiresonance_hz=100.0,
        antiresonance_damping_ratio=0.01,
    )  # fmt: skip
    assert 1.0 < _decay(mode._parameters(2000.0)) < 2.0
    with pytest.raises(ModelError, match="can't be undone"):
        mode.inverse(2000.0)


@pytest.mark.parametrize(("made", "limits"), [
    (FurtherMode, {"natural_hz": 1e6, "damping_ratio": 1.0, "antiresonance_hz": 1e6,
            "antiresonance_damping_ratio": 1.0}),
    (FirstMode, {"natural_hz": 1e9, "damping_ratio": 10.0}),
])  # fmt: skip
def test_limits_are_within(made, limits):
    assert made(**limits).model_dump() == limits
    for name, limit in limits.items():
        with pytest.raises(ValidationError, match=name):
            made(**(limits | {name: math.nextafter(limit, math.inf)}))


@pytest.mark.parametrize("frequency_hz", [100.0, 2300.0])
def test_a_structure_answers_sines_as_a_second_order_does(frequency_hz):
    structure = FirstMode(natural_hz=2300.0, damping_ratio=0.12)
    wanted = second_order(frequency_hz, 2300.0, 0.12)
    came = answer(structure.forward(RATE_HZ), frequency_hz)
    assert came == pytest.approx(wanted, rel=1e-2, abs=3e-3)
    assert structure.radian_s == pytest.approx(1.0 / (2.0 * math.pi * 2300.0))


@pytest.mark.parametrize("name", MODE)
@pytest.mark.parametrize("value", [0.0, -1.0, math.inf])
def test_a_mode_has_frequencies_and_damping_above_0(name, value):
    with pytest.raises(ValidationError, match=name):
        FurtherMode(**(MODE | {name: value}))


def test_a_structure_that_does_not_move_is_refused():
    with pytest.raises(ModelError, match="natural_hz is too low for a step of 2e-05 s"):
        FirstMode(natural_hz=1e-12, damping_ratio=0.1).motion(RATE_HZ)


def test_a_run_needs_no_scipy_for_modes():
    """It would take the loop's process 0.2 s, and 9 MB that are kept in RAM."""
    code = """if True:
        import sys
        from hilctl.models.mechanics import FurtherMode
        FurtherMode(natural_hz=900.0, damping_ratio=0.04, antiresonance_hz=760.0,
             antiresonance_damping_ratio=0.02).inverse(50e3)
        print("scipy.linalg" in sys.modules)
    """
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"
