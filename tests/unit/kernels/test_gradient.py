"""The operator after a model: its inverse, and the step of its parameters."""

import numpy as np
import pytest

from hilctl.kernels import gradient as kernel

THRESHOLDS = np.array([0.15, 0.4, 0.7])
MIDDLE_UM, HALF_UM = 5.0, 30.0
FORM = np.array([4.0, -0.1, 0.06, -0.05, 0.08])


def settings(**changed):
    values = np.zeros(kernel.SETTINGS)
    values[kernel.MIDDLE_UM], values[kernel.HALF_UM] = MIDDLE_UM, HALF_UM
    values[kernel.LARGEST_UM], values[kernel.COUNT] = 20.0, 5.0
    values[kernel.RATE], values[kernel.SMOOTHING] = 0.01, 0.5
    for name, value in changed.items():
        values[getattr(kernel, name)] = value
    return values


def table(bound=1.0):
    centre = [0.0, 3.0, 1.0, -2.0, 0.5]
    return np.array([[bound] * 5, centre, [1.0, *[HALF_UM**2] * 4]])


def constants():
    return settings(), table(), np.eye(5), THRESHOLDS


def rest():
    return np.zeros(4)


def wanted_um(n=500):
    rng = np.random.default_rng(4)
    return MIDDLE_UM + HALF_UM * np.sin(np.cumsum(rng.uniform(-0.3, 0.35, n)))


def displaced(input_um, form=FORM):
    """Return what the operator makes of a model's output, by the definition of the plays."""
    play, out = np.zeros(3), []
    for x_um in input_um + form[0]:
        u = (x_um - MIDDLE_UM) / HALF_UM
        play = np.maximum(u - THRESHOLDS, np.minimum(u + THRESHOLDS, play))
        regressors = HALF_UM * np.array([u, *play]) - table()[kernel.CENTRE, 1:]
        out.append(x_um + form[1:] @ regressors)
    return np.array(out)


def adapted(values, form=FORM, memory=None, size=None):
    out = values.copy()
    memory = rest() if memory is None else memory
    kernel.adapted_input(out, size or out.size, form, form, constants(), memory)
    return out


def test_inverse_is_exact():
    wanted = wanted_um()
    np.testing.assert_allclose(displaced(adapted(wanted)), wanted, atol=1e-10)


def test_identified_parameters_change_nothing():
    wanted = wanted_um()
    np.testing.assert_allclose(adapted(wanted, np.zeros(5)), wanted, atol=1e-12)


def test_any_cut_gives_the_same_bits():
    wanted, memory = wanted_um(), rest()
    parts = [adapted(each, memory=memory) for each in np.split(wanted, [1, 2, 50, 333])]
    np.testing.assert_array_equal(np.concatenate(parts), adapted(wanted))


def test_parameters_move_in_a_line():
    before, after = np.zeros(5), np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    out = np.full(3, MIDDLE_UM)
    kernel.adapted_input(out, 4, before, after, constants(), rest())
    np.testing.assert_allclose(out, MIDDLE_UM - np.array([0.25, 0.5, 0.75]), atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_moves_nothing(bad):
    wanted = wanted_um(20)
    out = adapted(np.insert(wanted, 7, bad))
    assert out[7] == bad or np.isnan(out[7])
    np.testing.assert_array_equal(np.delete(out, 7), adapted(wanted))


class Step:
    """One block after the other into ``adapt_block``."""

    def __init__(self, due_after=0, shown_after=0, **changed):
        self.settings, self.state = settings(**changed), np.zeros((kernel.TOTAL + 1, 5))
        self.table, self.shape, self.memory = table(), np.eye(5), rest()
        due, shown = np.full(due_after + 1, np.nan), np.full(shown_after + 1, np.nan)
        self.lines = due, shown, np.zeros(2, dtype=np.int64)

    def take(self, reference, error, flags=None, input_um=None):
        reference = np.asarray(reference, dtype=float)
        flags = np.zeros(reference.size, dtype=np.uint32) if flags is None else flags
        input_um = reference.copy() if input_um is None else input_um
        return kernel.adapt_block(
            reference,
            input_um,
            reference + error,
            flags,
            (self.settings, self.table, self.shape, THRESHOLDS),
            self.lines,
            self.memory,
            self.state,
        )

    @property
    def values(self):
        return self.state[kernel.VALUE]


def test_parameters_go_where_the_error_is_less():
    step = Step()
    assert step.take(np.full(10, MIDDLE_UM), 2.0) == 10
    assert 0.0 < step.values[kernel.OFFSET] <= 0.1


def test_pace_and_bounds_hold():
    step = Step()
    for k in range(400):
        step.take(np.full(5, MIDDLE_UM + 20.0), 15.0)
        assert np.abs(step.values).max() <= min(1.0, 0.05 * (k + 1)) + 1e-12
    assert step.values[kernel.OFFSET] == 1.0


def test_dead_zone():
    for error, moved in ((0.9, False), (1.1, True)):
        step = Step(DEAD_UM2=1.0, SMOOTHING=1e9)
        step.take(np.full(10, MIDDLE_UM), error)
        assert (step.values[kernel.OFFSET] > 0.0) == moved


def test_leakage():
    step = Step(LEAK=0.1)
    step.values[:] = 0.5
    step.take(np.full(10, MIDDLE_UM - 0.5), 0.0)
    assert step.values[kernel.OFFSET] == 0.5
    assert (step.values[kernel.GAIN :] < 0.5).all()


@pytest.mark.parametrize("error", [np.nan, np.inf, 20.1, -20.1])
def test_errors_that_no_parameter_makes_are_left_out(error):
    step = Step()
    step.values[:] = 0.5
    assert step.take(np.full(10, MIDDLE_UM), error) == 0
    assert step.values.tolist() == [0.5] * 5


def test_flags_hold_for_what_is_shown_later():
    step, reference = Step(due_after=2, shown_after=3), np.full(10, MIDDLE_UM)
    assert step.take(reference, 1.0) == 7
    flags = np.zeros(10, dtype=np.uint32)
    flags[-1] = 2
    assert step.take(reference, 1.0, flags) == 9
    assert step.take(reference, 1.0) == 8
    assert step.take(reference, 1.0) == 10


def test_one_flag_does_not_stop_a_long_block():
    """Near a limit each long block has some limited samples: nothing would be learned."""
    long, short = Step(), Step()
    flags = np.zeros(580, dtype=np.uint32)
    flags[300] = 1
    error = np.where(flags, 19.0, 2.0)
    assert long.take(np.full(580, MIDDLE_UM), error, flags) == 579
    assert short.take(np.full(580, MIDDLE_UM), 2.0 * (flags == 0)) == 580
    assert long.values.tolist() == short.values.tolist()
    assert long.values[kernel.OFFSET] > 0.0


def test_large_regressors_count_no_more():
    near, far = Step(RATE=1e-6), Step(RATE=1e-6)
    near.take([MIDDLE_UM + HALF_UM], 1.0)
    far.take([MIDDLE_UM + 3.9 * HALF_UM], 1.0)
    assert 0.0 < far.values[kernel.GAIN] < near.values[kernel.GAIN] * 1.5
