"""What compilation must not change: bits, block cuts, types."""

import os
import subprocess
import sys
from pathlib import Path

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
    "play_sum": (hysteresis.play_sum, (0.3, *PLAYS)),
    "play_sum_shared": (hysteresis.play_sum_shared, (WIDENING, *PLAYS)),
    "stop_sum": (hysteresis.stop_sum, PLAYS),
    "integrated_forward": (hysteresis.integrated_forward, (0.3, *PLAYS, *DEADBANDS)),
    "integrated_inverse": (hysteresis.integrated_inverse, (*DEADBANDS, 0.3, *PLAYS)),
}


def stream(kernel, signal, parameters, memory=None):
    memory = hysteresis.rest_memory(3) if memory is None else memory
    out = np.empty_like(signal)
    kernel(signal, *parameters, memory, out)
    return out, memory


@pytest.mark.parametrize("name", STREAMING)
def test_compiled_and_python_agree_bit_for_bit(name):
    """The function as written, run by Python, gives the same bits as its compiled form."""
    kernel, parameters = STREAMING[name]
    compiled, memory = stream(kernel, SIGNAL, parameters)
    plain, plain_memory = stream(kernel.py_func, SIGNAL, parameters)
    np.testing.assert_array_equal(compiled, plain)
    np.testing.assert_array_equal(memory, plain_memory)


@pytest.mark.slow
@pytest.mark.parametrize("name", STREAMING)
def test_callable_from_another_kernel(name):
    """Called inside somebody else's compiled function, a kernel does the same."""
    kernel, parameters = STREAMING[name]

    @numba.njit
    def caller(signal, parameters, memory, out):
        kernel(signal, *parameters, memory, out)

    expected, _ = stream(kernel, SIGNAL, parameters)
    out = np.empty_like(SIGNAL)
    caller(SIGNAL, parameters, hysteresis.rest_memory(3), out)
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("name", STREAMING)
def test_output_may_replace_the_input(name):
    """Writing over the input array changes nothing."""
    kernel, parameters = STREAMING[name]
    expected, expected_memory = stream(kernel, SIGNAL, parameters)
    both, memory = SIGNAL.copy(), hysteresis.rest_memory(3)
    kernel(both, *parameters, memory, both)
    np.testing.assert_array_equal(both, expected)
    np.testing.assert_array_equal(memory, expected_memory)


@pytest.mark.parametrize("name", STREAMING)
def test_an_empty_block_changes_nothing(name):
    """A block of no samples leaves the memory as it is."""
    kernel, parameters = STREAMING[name]
    _, memory = stream(kernel, SIGNAL, parameters)
    before = memory.copy()
    stream(kernel, np.empty(0), parameters, memory)
    np.testing.assert_array_equal(memory, before)


@pytest.mark.parametrize("name", STREAMING)
def test_nan_is_not_swallowed(name):
    """An input that is not a number gives an output that is not one."""
    kernel, parameters = STREAMING[name]
    signal = SIGNAL.copy()
    signal[200] = np.nan
    out, _ = stream(kernel, signal, parameters)
    assert np.all(np.isfinite(out[:200]))
    assert np.isnan(out[200])


@pytest.mark.parametrize("v", [-1.7, -0.2, 0.0, 0.3, 2.0])
def test_scalar_kernels_agree_with_python(v):
    """The scalar operators give Python's bits, alone and inside another compiled function."""
    stop = hysteresis.stop_step
    value = hysteresis.deadband_value

    @numba.njit
    def caller(v, deadbands):
        return stop(v, 0.2, 0.4, 0.1), value(v, *deadbands)

    expected = (
        stop.py_func(v, 0.2, 0.4, 0.1),
        value.py_func(v, *DEADBANDS),
    )
    assert (stop(v, 0.2, 0.4, 0.1), value(v, *DEADBANDS)) == expected
    assert caller(v, DEADBANDS) == expected


@pytest.mark.parametrize("name", STREAMING)
def test_float32_is_refused(name):
    """A float32 array is an error at once, not a new compilation."""
    kernel, parameters = STREAMING[name]
    with pytest.raises(TypeError, match="No matching definition"):
        kernel(SIGNAL.astype(np.float32), *parameters, hysteresis.rest_memory(3), SIGNAL.copy())


def test_float32_is_refused_everywhere_else():
    """So it is by the kernels without memory."""
    narrow, out = SIGNAL.astype(np.float32), np.empty(400)
    flags = np.zeros(400, dtype=np.uint32)
    grid, memory = np.empty((400, 3)), hysteresis.rest_memory(3)
    with pytest.raises(TypeError, match="No matching definition"):
        hysteresis.deadband_block(narrow, *DEADBANDS, out)
    with pytest.raises(TypeError, match="No matching definition"):
        hysteresis.play_outputs(narrow, WIDENING, PLAYS[1], memory, grid)
    with pytest.raises(TypeError, match="No matching definition"):
        limit_block(narrow, 0.0, -1.0, 1.0, 0.1, 1, 2, 4, out, flags)


def test_a_strided_view_is_refused():
    """A view that is not contiguous is refused too: it would need another compilation."""
    kernel, parameters = STREAMING["play_sum"]
    with pytest.raises(TypeError, match="No matching definition"):
        kernel(SIGNAL[::2], *parameters, hysteresis.rest_memory(3), np.empty(200))


@pytest.fixture
def in_memory(tmp_path, monkeypatch):
    """A user's folder in memory, and nothing else that could be written."""
    cache = numba.core.caching
    for locator in (cache.InTreeCacheLocator, cache.UserWideCacheLocator):
        monkeypatch.setattr(locator, "get_cache_path", lambda self: "/proc/closed")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(jit, "user_folders", lambda: [Path("/proc/closed"), tmp_path / "own"])
    jit._cache_in_memory.cache_clear()
    yield tmp_path / "own" / "kernels"
    jit._cache_in_memory.cache_clear()
    monkeypatch.undo()
    numba.config.reload_config()


def double(value: float) -> float:
    return 2.0 * value


def test_kept_in_memory_where_no_folder_can_be_written(in_memory):
    """A user with a read-only home waits for the compiler once, and so does the loop's process."""
    assert jit.kernel("float64(float64)")(double)(1.5) == 3.0
    assert list(in_memory.rglob("*.nbc"))
    assert os.environ["NUMBA_CACHE_DIR"] == str(in_memory)
    again = jit.kernel("float64(float64)")(double)
    jit.load(again)
    assert sum(again.stats.cache_hits.values()) == 1


def test_compiled_where_nothing_can_be_kept(in_memory, monkeypatch):
    """Not even memory: it takes longer, and runs."""
    monkeypatch.setattr(jit, "user_folders", lambda: [Path("/proc/closed")])
    assert jit.kernel("float64(float64)")(double)(1.5) == 3.0
    assert not in_memory.exists()


def test_full_disk_keeps_no_kernel_from_being_compiled(tmp_path, in_memory, monkeypatch):
    """What numba's own folder has no room for goes into memory."""
    full = tmp_path / "full"
    monkeypatch.setattr(numba.core.caching.InTreeCacheLocator, "get_cache_path", lambda _: full)
    save = numba.core.caching.IndexDataCacheFile.save

    def save_where_there_is_room(self, key, data):
        if full in Path(self._index_path).parents:
            raise OSError(28, "No space left on device")
        save(self, key, data)

    monkeypatch.setattr(numba.core.caching.IndexDataCacheFile, "save", save_where_there_is_room)
    assert jit.kernel("float64(float64)")(double)(1.5) == 3.0
    assert list(in_memory.rglob("*.nbc"))


def item(values: np.ndarray, at: int) -> float:
    return values[at]


def test_compiled_where_the_working_folder_has_been_deleted(tmp_path, monkeypatch, in_memory):
    """What is named from the root can be run from there; names from the folder stay unknown."""
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert jit.kernel("float64(float64[::1], int64)")(item)(np.array([0.5, 1.5]), 1) == 1.5
    with pytest.raises(FileNotFoundError):
        Path.cwd()


def emptied(whole: bytes) -> bytes:
    return b""


def halved(whole: bytes) -> bytes:
    return whole[: len(whole) // 2]


def zeroed(whole: bytes) -> bytes:
    return bytes(len(whole))


def random_bytes(whole: bytes) -> bytes:
    return np.random.default_rng(4).bytes(len(whole))


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", [emptied, halved, zeroed, random_bytes])
def test_damaged_cache_file_is_replaced(in_memory, suffix, damage):
    assert jit.kernel("float64(float64)")(double)(1.5) == 3.0
    (file,) = in_memory.rglob(f"*.{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    again = jit.kernel("float64(float64)")(double)
    assert again(1.5) == 3.0
    assert sum(again.stats.cache_misses.values()) == 1
    repaired = jit.kernel("float64(float64)")(double)
    assert repaired(1.5) == 3.0
    assert sum(repaired.stats.cache_hits.values()) == 1


def test_mistake_in_a_kernel_is_said(in_memory):
    """What has nothing to do with the cache is not passed over."""
    wrong = jit.kernel("float64(unicode_type)")(double)
    for _ in range(2):
        with pytest.raises(numba.TypingError):
            wrong(1.5)


def test_nothing_is_compiled_before_it_is_wanted(in_memory):
    """A process waits for no kernel but its own."""
    deferred = jit.kernel("float64(float64)")(double)
    assert not deferred.overloads
    assert not in_memory.exists()
    jit.load(deferred)
    jit.load(deferred)
    assert [str(types) for types in deferred.overloads] == ["(float64,)"]


def test_a_kept_kernel_is_loaded_without_what_compiling_takes():
    """numba registers that first otherwise, in half of the time in which a run begins."""
    jit.load(limit_block)  # it is kept now
    code = """if True:
        import sys
        from hilctl.kernels import jit, limit
        jit.load(limit.limit_block)
        print("numba.np.npyimpl" in sys.modules, [*limit.limit_block.stats.cache_hits.values()])
    """
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["False", "[1]"], ran.stderr


def test_called_with_a_type_that_casts():
    """The first call takes what later ones take: an integer for a number."""
    assert jit.kernel("float64(float64)")(double)(2) == 4.0


def test_what_is_no_kernel_is_its_own_entry():
    """As where numba is told not to compile: who calls by entries works there, too."""

    def plain(x):
        return x

    assert jit.entry(plain) is plain
