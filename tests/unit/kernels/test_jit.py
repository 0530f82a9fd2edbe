"""What compilation must not change: bits, block cuts, types."""

import os
import pickle
from typing import Annotated

import numba
import numpy as np
import pytest

from hilctl.kernels import hysteresis, jit
from hilctl.kernels.limit import limit_block

PLAYS = (1.3, np.array([0.2, 0.5, 0.9]), np.array([0.7, 0.1, 0.4]))
DEADBANDS = (1.7, np.array([0.4, 1.1]), np.array([-0.2, -0.3]), np.array([-0.3]), np.array([0.25]))
SIGNAL = 2.0 * np.sin(np.arange(400) / 9.0) + 0.6 * np.cos(np.arange(400) / 2.3)
WIDENING = 0.1 + 0.1 * np.sin(np.arange(400) / 5.0)

STREAMING = {
    "play_sum": (hysteresis.play_sum, ((0.3, *PLAYS),)),
    "play_sum_shared": (hysteresis.play_sum_shared, (WIDENING, *PLAYS)),
    "stop_sum": (hysteresis.stop_sum, PLAYS),
    "integrated_forward": (hysteresis.integrated_forward, ((0.3, *PLAYS), DEADBANDS)),
    "integrated_inverse": (hysteresis.integrated_inverse, (DEADBANDS, (0.3, *PLAYS))),
}


def stream(kernel, signal, parameters, memory=None):
    memory = hysteresis.rest_memory(3) if memory is None else memory
    out = np.empty_like(signal)
    kernel(signal, *parameters, memory, out)
    return out, memory


@pytest.mark.parametrize("name", STREAMING)
def test_compiled_and_python_agree_bit_for_bit(name):
    kernel, parameters = STREAMING[name]
    compiled, memory = stream(kernel, SIGNAL, parameters)
    plain, plain_memory = stream(kernel.py_func, SIGNAL, parameters)
    np.testing.assert_array_equal(compiled, plain)
    np.testing.assert_array_equal(memory, plain_memory)


@pytest.mark.parametrize("name", STREAMING)
def test_output_may_replace_the_input(name):
    kernel, parameters = STREAMING[name]
    expected, expected_memory = stream(kernel, SIGNAL, parameters)
    both, memory = SIGNAL.copy(), hysteresis.rest_memory(3)
    kernel(both, *parameters, memory, both)
    np.testing.assert_array_equal(both, expected)
    np.testing.assert_array_equal(memory, expected_memory)


@pytest.mark.parametrize("name", STREAMING)
def test_an_empty_block_changes_nothing(name):
    kernel, parameters = STREAMING[name]
    _, memory = stream(kernel, SIGNAL, parameters)
    before = memory.copy()
    stream(kernel, np.empty(0), parameters, memory)
    np.testing.assert_array_equal(memory, before)


@pytest.mark.parametrize("name", STREAMING)
def test_nan_is_not_swallowed(name):
    kernel, parameters = STREAMING[name]
    signal = SIGNAL.copy()
    signal[200] = np.nan
    out, _ = stream(kernel, signal, parameters)
    assert np.all(np.isfinite(out[:200]))
    assert np.isnan(out[200])


@pytest.mark.parametrize("v", [-1.7, -0.2, 0.0, 0.3, 2.0])
def test_scalar_kernels_agree_with_python(v):
    stop = hysteresis.stop_step
    value = hysteresis.deadband_value

    @numba.njit
    def caller(v, deadbands):
        return stop(v, 0.2, 0.4, 0.1), value(v, deadbands)

    expected = (stop.py_func(v, 0.2, 0.4, 0.1), value.py_func(v, DEADBANDS))
    assert (stop(v, 0.2, 0.4, 0.1), value(v, DEADBANDS)) == expected
    assert caller(v, DEADBANDS) == expected


@pytest.mark.parametrize("name", STREAMING)
def test_float32_is_refused(name):
    kernel, parameters = STREAMING[name]
    with pytest.raises(TypeError, match="No matching definition"):
        kernel(SIGNAL.astype(np.float32), *parameters, hysteresis.rest_memory(3), SIGNAL.copy())


def test_a_strided_view_is_refused():
    kernel, parameters = STREAMING["play_sum"]
    with pytest.raises(TypeError, match="No matching definition"):
        kernel(SIGNAL[::2], *parameters, hysteresis.rest_memory(3), np.empty(200))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Return a cache folder for the kernels of one test."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def double(value: float) -> float:
    return 2.0 * value


double_kernel = jit.kernel()(double)


@jit.kernel()
def twice(value: int) -> float:
    return double_kernel(value)


def stats_of_first_call(function=double):
    """Return numba's cache statistics of a new kernel, called once."""
    made = jit.kernel()(function)
    assert made(1.5) == 3.0
    return made.dispatcher.stats


def test_second_process_loads_the_kernel_from_the_cache(cache):
    assert sum(stats_of_first_call().cache_misses.values()) == 1
    assert sum(stats_of_first_call().cache_hits.values()) == 1


def test_compiled_without_a_cache_folder():
    names = {}
    exec("def double(value: float) -> float:\n    return 2.0 * value", names)
    assert not stats_of_first_call(names["double"]).cache_path


def test_compiled_with_a_full_disk(cache, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert not stats_of_first_call().cache_path
    assert not [path for path in cache.rglob("*") if path.is_file()]


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", [
    lambda whole: b"",
    lambda whole: whole[: len(whole) // 2],
    lambda whole: bytes(len(whole)),
    lambda whole: np.random.default_rng(4).bytes(len(whole)),
], ids=["emptied", "halved", "zeroed", "random"])  # fmt: skip
def test_damaged_cache_file_is_replaced(cache, suffix, damage):
    stats_of_first_call()
    (file,) = cache.rglob(f"*.{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    assert sum(stats_of_first_call().cache_misses.values()) == 1
    assert sum(stats_of_first_call().cache_hits.values()) == 1


@pytest.mark.parametrize("package", [False, True])
@pytest.mark.parametrize("home", [False, True])
@pytest.mark.parametrize("chosen", ["", "/chosen"])
def test_kernels_are_cached_in_memory_if_no_other_folder_is_writable(
    tmp_path, monkeypatch, package, home, chosen
):
    monkeypatch.setenv("XDG_CACHE_HOME", "/home/cache")
    monkeypatch.setattr(numba.config, "CACHE_DIR", chosen)
    monkeypatch.setattr(os, "access", lambda path, _: home if path == "/home/cache" else package)
    monkeypatch.setattr(jit, "user_folders", lambda: [tmp_path / "no" / "place", tmp_path / "own"])
    jit._numba.cache_clear()
    jit._numba()
    in_memory = not (package or home or chosen)
    expected = str(tmp_path / "own" / "kernels") if in_memory else chosen
    assert expected == numba.config.CACHE_DIR


def test_mistake_in_a_kernel_is_raised(cache):
    def halved(value: Annotated[float, "unicode_type"]) -> float:
        return 0.5 * value

    wrong = jit.kernel()(halved)
    for _ in range(2):
        with pytest.raises(numba.TypingError):
            wrong(1.5)


def test_nothing_is_compiled_before_the_first_use(cache):
    deferred = jit.kernel()(double)
    assert not list(cache.iterdir())
    jit.ensure_compiled(deferred, double, None)
    compiled = deferred.dispatcher
    jit.ensure_compiled(deferred)
    assert deferred.dispatcher is compiled
    assert [str(types) for types in compiled.overloads] == ["(float64,)"]


def test_kernels_compile_the_kernels_that_they_call(cache):
    assert twice(2) == 4.0
    assert [str(types) for types in double_kernel.dispatcher.overloads] == ["(float64,)"]


def test_another_process_gets_the_kernel_by_its_name():
    assert pickle.loads(pickle.dumps(limit_block)) is limit_block


def test_called_with_a_type_that_casts(cache):
    assert jit.kernel()(double)(2) == 4.0
