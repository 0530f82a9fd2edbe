"""Time the integrated inverse, compiled by numba, against the same loop in C.

Run it with ``python -m tests.benchmark.kernel``; see README.md beside it. Both are compiled
into a temporary folder, so the tree stays as it is.
"""

import argparse
import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SOURCE = Path(__file__).with_name("kernel.c")
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
SAMPLE_RATE_HZ = 50_000.0
SAMPLES = 500_000
TOLERANCE = 1e-12
Run = Callable[[], None]


def reference_um() -> np.ndarray:
    """Return a swelling 50 Hz reference that crosses every threshold: float64[SAMPLES]."""
    t = np.arange(SAMPLES) / SAMPLE_RATE_HZ
    swell = 0.55 + 0.45 * np.sin(2 * np.pi * 1.3 * t)
    return 40.0 * swell * np.sin(2 * np.pi * 50.0 * t)


def inverse_parameters() -> tuple[Any, ...]:
    """Return what the kernel takes between input and memory: 12 plays, 17 deadbands."""
    from hilctl.models.integrated import exponential_integrated

    model = exponential_integrated(
        alpha=0.3, gamma_s=2e-4, a_0=1.0, alpha_0=0.2, beta_0=0.3, g_0=6.0,
        alpha_1=0.3, beta_1=0.1, d_p=0.8, alpha_2=0.4, beta_2=0.1, d_n=0.8,
    )  # fmt: skip
    return model.deadband.inverse().packed(), model.packed_inverse(SAMPLE_RATE_HZ)


def numba_run(
    y: np.ndarray, parameters: tuple[Any, ...], memory: np.ndarray, out: np.ndarray
) -> Run:
    """Return the numba kernel, bound to its arguments."""
    from hilctl.kernels.hysteresis import integrated_inverse

    return lambda: integrated_inverse(y, *parameters, memory, out)


def c_run(
    library: Path, y: np.ndarray, parameters: tuple[Any, ...], memory: np.ndarray, out: np.ndarray
) -> Run:
    """Return the C function, bound to its arguments; after its arrays go their lengths."""
    (slope, d_up, g_up, d_down, g_down), (gain, direct, thresholds, weights) = parameters
    number, size, array = ctypes.c_double, ctypes.c_ssize_t, np.ctypeslib.ndpointer(np.float64)
    function = ctypes.CDLL(str(library)).integrated_inverse
    function.restype = None
    function.argtypes = [array, size, number, array, array, size, array, array, size, number,
                         number, array, array, size, array, array]  # fmt: skip
    return lambda: function(
        y, y.size, slope, d_up, g_up, d_up.size, d_down, g_down, d_down.size, gain,
        direct, thresholds, weights, weights.size, memory, out,
    )  # fmt: skip


def compile_c(folder: Path) -> Path:
    """Compile the C source into ``folder`` with gcc, or else cc."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        sys.exit("no C compiler: install gcc")
    library = folder / "kernel.so"
    subprocess.run([compiler, *FLAGS, "-o", str(library), str(SOURCE)], check=True)
    return library


def timed_ns(run: Run, memory: np.ndarray) -> float:
    """Return how long a sample takes, from rest."""
    memory[:-1], memory[-1] = 0.0, np.nan
    start = time.perf_counter_ns()
    run()
    return (time.perf_counter_ns() - start) / SAMPLES


def measure(by_numba: Run, by_c: Run, memory: np.ndarray, pairs: int) -> np.ndarray:
    """Run both in turn, the first of each pair alternating: float64[pairs, 2] ns a sample."""
    times = np.empty((pairs, 2))
    for i in range(pairs):
        for column in ((0, 1), (1, 0))[i % 2]:
            times[i, column] = timed_ns((by_numba, by_c)[column], memory)
    return times


def compare(folder: Path, pairs: int) -> float:
    """Check that both agree, print their times, and return the median ratio.

    Both work on the same memory: where it lies in the cache can double the time of either.
    """
    y, parameters = reference_um(), inverse_parameters()
    memory = np.empty(parameters[-1].size + 1)
    numba_out, c_out = np.empty_like(y), np.empty_like(y)
    by_numba = numba_run(y, parameters, memory, numba_out)
    by_c = c_run(compile_c(folder), y, parameters, memory, c_out)
    measure(by_numba, by_c, memory, 2)
    times = measure(by_numba, by_c, memory, pairs)
    difference = float(np.max(np.abs(numba_out - c_out)))
    if not difference <= TOLERANCE * float(np.max(np.abs(c_out))):
        sys.exit(f"the two disagree by {difference}")
    numba_ns, c_ns = np.median(times, axis=0)
    ratio = float(np.median(times[:, 0] / times[:, 1]))
    print(f"numba       {numba_ns:6.2f} ns a sample")
    print(f"C           {c_ns:6.2f} ns a sample")
    print(f"numba / C   {ratio:6.3f}  (median of {pairs} pairs)")
    print(f"difference  {difference:6.1e}")
    return ratio


def main() -> int:
    """Run the benchmark; the exit code is 1 where the ratio is above ``--max-ratio``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--pairs", type=int, default=31)
    parser.add_argument("--max-ratio", type=float, default=1.2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ["NUMBA_CACHE_DIR"] = name
        sys.dont_write_bytecode = True
        return int(compare(Path(name), options.pairs) > options.max_ratio)


if __name__ == "__main__":
    sys.exit(main())
