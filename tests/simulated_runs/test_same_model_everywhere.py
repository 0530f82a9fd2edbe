"""Every kind of fit gives the same model on every processor.

OpenBLAS picks its kernels by processor, and sums in another order on each. What a fit makes of that
must stay rounding. Each set of kernels runs in a process of its own.
"""

import ctypes
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy

from hilctl.base.types import F64
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import fit_model
from hilctl.lab.identify.registry import HISTORIES, all_fits, fit_named
from hilctl.lab.identify.settings import FitSettings
from tests.commands import ended
from tests.rig import RATE_HZ, driven, steady_loop

TONES = [(a, f) for a in (3.0, 7.0) for f in (10.0, 100.0, 200.0)]
FITS: dict[str, dict[str, Any]] = {
    **{kind: {"kind": kind} for kind in all_fits() if kind != "field"},
    "generalised_duhem": {"kind": "generalised_duhem", "cells": 12, "across": 8},
    "rdpi, exponential": {"kind": "rdpi", "weights": "exponential", "weight_by": "equal"},
    "integrated, free": {"kind": "integrated", "weights": "free"},
    "integrated, hysteresis": {"kind": "integrated", "weight_by": "hysteresis"},
}
KERNELS = {"Nehalem": "", "Haswell": "avx2", "SkylakeX": "avx512f"}
"""Kernels of OpenBLAS, and the flag of processors that run them."""
CLOSE = 1e-6  # relative to the largest of the values that belong together


def history() -> History:
    """Return the response to a random command from rest, small parts after large ones."""
    rng = np.random.default_rng(4)
    time = np.arange(round(0.5 * RATE_HZ)) / RATE_HZ
    sines = [np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in rng.uniform(4.0, 200.0, 12)]
    command = np.sum(sines, axis=0) * np.minimum(time / 0.02, 1.0)
    command = np.ascontiguousarray(6.0 * command / np.abs(command).max())
    return History("random", command, driven(command, seed=5), RATE_HZ)


def kernels_in_use() -> set[str]:
    """Return the kernels that NumPy's and SciPy's OpenBLAS report."""
    names = set()
    for package in (np, scipy):
        folder = Path(package.__file__).parents[1] / f"{package.__name__}.libs"
        for path in folder.glob("*openblas*"):
            library = ctypes.CDLL(str(path))
            for name in ("scipy_openblas_get_corename64_", "scipy_openblas_get_corename"):
                if hasattr(library, name):
                    get = getattr(library, name)
                    get.restype = ctypes.c_char_p
                    names.add(get().decode())
    return names


def fit_all() -> None:
    """Fit every kind and print all models: what the processes of this test do."""
    loops, whole = [steady_loop(tone, points=64, cycles=5) for tone in TONES], [history()]
    models = {}
    for name, choices in FITS.items():
        records = whole if fit_named(choices["kind"]).data == HISTORIES else loops
        fit = fit_model(FitRequest(records, FitSettings(**choices)))
        models[name] = fit.model.model_dump(mode="json", exclude={"provenance"})
    print(json.dumps(models))


def numbers(value: object, name: str = "") -> dict[str, F64]:
    """Return all numbers of a model in arrays."""
    if isinstance(value, dict):
        parts = [numbers(inner, f"{name}.{key}") for key, inner in value.items()]
        return {key: array for part in parts for key, array in part.items()}
    if isinstance(value, list) and value:
        rows = [numbers(row).get("", np.zeros(0)) for row in value]  # of a triangle, of any length
        return {name: np.concatenate(rows)}
    return {name: np.array([value], dtype=np.float64)} if isinstance(value, float | int) else {}


@pytest.fixture(scope="module")
def models_by() -> dict[str, dict[str, object]]:
    flags = Path("/proc/cpuinfo").read_text()
    found: dict[str, dict[str, object]] = {}
    for kernels, flag in KERNELS.items():
        if flag in flags and (models := models_with(kernels)):
            found[kernels] = models
    return found


def models_with(kernels: str) -> dict[str, object]:
    """Run this module in a process of its own that takes these kernels; return its models."""
    done = ended(
        [sys.executable, "-m", "tests.simulated_runs.test_same_model_everywhere", kernels],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "OPENBLAS_CORETYPE": kernels, "OPENBLAS_NUM_THREADS": "1"},
    )
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", FITS)
def test_a_model_is_the_same_on_every_processor(
    models_by: dict[str, dict[str, object]], name: str
) -> None:
    if len(models_by) < 2:
        pytest.skip("this processor has one set of kernels only")
    first, *others = models_by.values()
    expected = numbers(first[name])
    assert len(expected) >= 3
    for other in others:
        found = numbers(other[name])
        assert found.keys() == expected.keys()
        for key, values in expected.items():
            size = max(float(np.abs(values).max()), 1e-300)
            np.testing.assert_allclose(found[key], values, rtol=0.0, atol=CLOSE * size, err_msg=key)


if __name__ == "__main__":
    if kernels_in_use() == set(sys.argv[1:]):
        fit_all()
    else:
        print("{}")  # this build of OpenBLAS has other kernels
