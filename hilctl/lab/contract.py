"""The contract of a kind of model as pytest checks, for the kinds of any package.

In a test file of the package::

    import pytest
    from hilctl.lab.contract import *
    from my_package.model import MyModel

    @pytest.fixture
    def case():
        return KindCase(MyModel(...), fit="my_kind")
"""

import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.lab.identify.data.records import History, Record, SteadyLoop
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import fit_model
from hilctl.lab.identify.registry import HISTORIES, fit_named
from hilctl.lab.identify.settings import FitSettings
from hilctl.lab.model_export.model_export import export_text
from hilctl.models import kinds
from hilctl.models.base import HysteresisModel, Operator
from hilctl.models.model_file import dump_model, parse_model

RATE_HZ = 50_000.0
CUT = 71  # sample at which a signal is cut into two blocks


@dataclass(frozen=True)
class KindCase:
    """A model of a kind, with the signals and tolerances of its checks.

    Attributes:
        model: A model as in a file: one for stages only is inside a staged model.
        command: Amplitude of the commands, in the input unit.
        centre: Middle of the commands.
        inverse_percent: Largest error of the inverse, of the peak-to-peak displacement.
        fit: Name of the fit that identifies such models; empty without one.
        settings: Of the fit.
        fit_percent: Largest error of a fit to the model's own displacement, of its peak-to-peak.
    """

    model: HysteresisModel
    command: float = 6.0
    centre: float = 0.0
    inverse_percent: float = 1e-4
    fit: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    fit_percent: float = 1.0

    def path(self, samples: int = 12_000) -> F64:
        """Return a command from rest with small parts after large ones, and back: float64[n]."""
        t = np.arange(samples) / RATE_HZ
        rise = np.minimum(np.minimum(t, t[-1] - t) / 0.05, 1.0)
        waves = np.sin(2.0 * np.pi * 11.0 * t) + 0.6 * np.sin(2.0 * np.pi * 37.0 * t + 1.0)
        return np.asarray(rise * (self.centre + self.command / 1.6 * waves))

    def records(self) -> list[Record]:
        """Return the displacement of the model: steady loops, or a history if the fit needs one."""
        if fit_named(self.fit).data == HISTORIES:
            path = self.path()
            return [History("path", path, self.model.forward(RATE_HZ).process(path), RATE_HZ)]
        angle = 2.0 * np.pi * np.arange(300) / 300
        loops: list[Record] = []
        for part in (1.0, 0.67, 0.33):
            sine = self.centre + part * self.command * np.sin(angle)
            y = self.model.forward(300 * 50.0).process(np.tile(sine, 4))[-sine.size :]
            loops.append(SteadyLoop(f"{part:g} at 50 Hz", sine, y, 50.0, RATE_HZ))
        return loops


@pytest.fixture
def case() -> KindCase:
    """Return the model under test; each test file has its own."""
    raise NotImplementedError("define a fixture case that returns a KindCase")


@pytest.fixture(params=["forward", "inverse"])
def direction(request: pytest.FixtureRequest) -> str:
    """Return a direction of the model."""
    return str(request.param)


def operator_of(case: KindCase, direction: str) -> Operator:
    """Return the model's operator at rest."""
    made: Operator = getattr(case.model, direction)(RATE_HZ)
    return made


def wild(case: KindCase, direction: str, samples: int = 200) -> F64:
    """Return an input of an operator with a jump, turns and one NaN: float64[n]."""
    path = np.cumsum(np.random.default_rng(5).normal(size=samples))
    path *= case.command / np.abs(path).max()
    path += case.centre
    path[samples // 3] += 0.2 * case.command
    if direction == "inverse":
        path = case.model.forward(RATE_HZ).process(path)
    path[samples // 2] = np.nan
    return np.asarray(path)


def in_blocks(operator: Operator, signal: F64) -> F64:
    """Return the output of two blocks: float64[n]."""
    return np.concatenate([operator.process(part.copy()) for part in np.split(signal, [CUT])])


def test_is_registered_by_its_kind(case: KindCase) -> None:
    """The table, or the entry point, names the class."""
    assert kinds.load(kinds.MODELS, case.model.kind) is type(case.model)


def test_survives_its_file(case: KindCase) -> None:
    """A file keeps every bit."""
    assert parse_model("model", dump_model(case.model)) == case.model


def test_undoes_its_inverse(case: KindCase) -> None:
    """The model follows a reference that its inverse gets ``preview`` samples ahead."""
    reference_um = case.model.forward(RATE_HZ).process(case.path())
    inverse = operator_of(case, "inverse")
    ahead = np.append(reference_um[inverse.preview :], np.full(inverse.preview, reference_um[-1]))
    came_um = case.model.forward(RATE_HZ).process(inverse.process(ahead))
    error_um = np.abs(came_um - reference_um)[2 * inverse.preview : -2 * inverse.preview - 1]
    assert error_um.max() <= 0.01 * case.inverse_percent * np.ptp(reference_um)


def test_blocks_make_no_difference(case: KindCase, direction: str) -> None:
    """The division into blocks changes no bit, and a new operator is at rest."""
    signal, whole = wild(case, direction), operator_of(case, direction)
    expected = whole.process(signal.copy())
    parts = operator_of(case, direction)
    np.testing.assert_array_equal(in_blocks(parts, signal), expected)
    np.testing.assert_array_equal(parts.state(), whole.state())
    whole.reset()
    np.testing.assert_array_equal(whole.process(signal.copy()), expected)


def test_continues_from_a_restored_state(case: KindCase, direction: str) -> None:
    """A state holds all memory, and is a copy."""
    signal = wild(case, direction)
    first, second = operator_of(case, direction), operator_of(case, direction)
    first.process(signal[:CUT].copy())
    second.process(signal[::-1].copy())
    state = first.state()
    expected = first.process(signal[CUT:].copy())
    second.restore(state)
    np.testing.assert_array_equal(second.process(signal[CUT:].copy()), expected)


C_MAIN = f"""
#include <stdio.h>
#include "made.c"

int main(void)
{{
    static double memory[made_memory], in[1000], out[1000];
    const int n = (int)fread(in, sizeof(double), 1000, stdin);
    made_reset(memory);
    made(memory, in, out, {CUT});
    made(memory, in + {CUT}, out + {CUT}, n - {CUT});
    fwrite(out, sizeof(double), n, stdout);
    fwrite(memory, sizeof(double), made_memory, stdout);
    return 0;
}}
"""
MATLAB_MAIN = f"""
file = fopen('in.bin'); in = fread(file, Inf, 'double'); fclose(file);
[first, memory] = made(in(1:{CUT}));
[second, memory] = made(in({CUT + 1}:end), memory);
file = fopen('out.bin', 'w'); fwrite(file, [first(:); second(:); memory(:)], 'double');
fclose(file);
"""
_STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off")


def _run_c(folder: Path, signal: F64) -> F64:
    (folder / "main.c").write_text(C_MAIN, encoding="utf-8")
    subprocess.run(["gcc", *_STRICT, "main.c", "-lm"], cwd=folder, check=True)  # noqa: S607
    done = subprocess.run(
        [folder / "a.out"], input=signal.tobytes(), capture_output=True, check=True
    )
    return np.frombuffer(done.stdout)


def _run_matlab(folder: Path, signal: F64) -> F64:
    (folder / "script.m").write_text(MATLAB_MAIN, encoding="utf-8")
    signal.tofile(folder / "in.bin")
    subprocess.run(["octave-cli", "--no-init-file", "script.m"], cwd=folder, check=True)  # noqa: S607
    return np.fromfile(folder / "out.bin")


@pytest.mark.parametrize(
    ("suffix", "program", "run"), [(".c", "gcc", _run_c), (".m", "octave-cli", _run_matlab)]
)
def test_exported_function_is_equal(
    case: KindCase, direction: str, suffix: str, program: str, run: Any, tmp_path: Path
) -> None:
    """The C and MATLAB functions agree with the kernels, in two blocks."""
    if not shutil.which(program):
        pytest.skip(f"{program} is not installed")
    file = tmp_path / f"made{suffix}"
    text = export_text(case.model, file, RATE_HZ, forward=direction == "forward")
    file.write_text(text, encoding="utf-8")
    signal, operator = wild(case, direction), operator_of(case, direction)
    expected = np.concatenate((operator.process(signal.copy()), operator.state()))
    np.testing.assert_allclose(run(tmp_path, signal), expected, rtol=1e-12, atol=1e-12)


def test_is_identified_from_its_own_displacement(case: KindCase) -> None:
    """The fit returns a model of this kind with a small error, and a usable inverse."""
    if not case.fit:
        pytest.skip("no fit")
    settings = FitSettings(kind=case.fit, **case.settings)
    found = fit_model(FitRequest(case.records(), settings, unit=case.model.input_unit))
    assert found.model.kind == case.model.kind
    assert found.peak_percent <= case.fit_percent
    again = replace(case, model=found.model, inverse_percent=max(case.inverse_percent, 0.1))
    test_survives_its_file(again)
    test_undoes_its_inverse(again)


def test_settings_of_its_fit_are_documented(case: KindCase) -> None:
    """Each setting is known and described, and the published values are the defaults."""
    if not case.fit:
        pytest.skip("no fit")
    fit, fields = fit_named(case.fit), FitSettings.model_fields
    assert fit.title
    assert {*fit.takes, *fit.published, *(fit.compared or {})} <= fields.keys()
    assert all(each.description for each in (fit.own.model_fields if fit.own else {}).values())
    assert FitSettings(kind=case.fit).changes() == ""
    FitSettings(kind=case.fit, **(fit.compared or {}))
