"""Exported C and MATLAB functions compute what the kernels compute."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.models import kinds
from hilctl.models.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.model_export import export_text
from hilctl.models.plays import SpiModel
from hilctl.models.staged import StagedModel
from tests.published import piezo_ppi, terfenol_rdpi
from tests.unit.models.test_effective_field import ACTIVATION, field_model
from tests.unit.models.test_generalised_duhem import duhem_model
from tests.unit.models.test_implicit_models import BOUC_WEN, DUHEM, KP, PLAIN, PREISACH
from tests.unit.models.test_integrated import butterfly
from tests.unit.models.test_refined import refined, residual
from tests.unit.models.test_staged import OMEGA, STAGES

RATE_HZ = 50_000.0
FORMS = {
    "ppi": piezo_ppi().model_copy(update={"output_offset_um": 2.0}),
    "spi": SpiModel(**piezo_ppi().model_dump(exclude={"kind"})),
    "rdpi": terfenol_rdpi(),
    "integrated": OMEGA.model_copy(update={"gamma_s": 2e-5}),
    "butterfly": butterfly(gamma_s=2e-5),
    "generalised": GeneralisedModel(
        **PLAIN, direct=20.0, weights=(5.0, 3.0), thresholds=(0.1, 0.4),
        rising=PlayEnvelope(slope=0.15, shift=0.2, level=-0.2),
        falling=PlayEnvelope(height=1.1, slope=0.14, shift=0.2, level=-0.1),
    ),
    "preisach": PREISACH,
    "krasnoselskii_pokrovskii": KP,
    "bouc_wen": BOUC_WEN,
    "duhem": DUHEM,
    "staged": StagedModel.around(OMEGA, **STAGES["all"]),
    "field": StagedModel.around(field_model()),
    "generalised_duhem": StagedModel.around(duhem_model()),
    "refined": refined(terfenol_rdpi(), residual(), 0.4),
}  # fmt: skip
FORMS["plays that creep"] = field_model(activation=ACTIVATION)
FORMS["linear lag"] = StagedModel.around(OMEGA, **STAGES["linear lag"])
FORMS["exponent 2"] = BOUC_WEN.model_copy(update={"exponent": 2})


def test_every_kind_is_covered():
    assert kinds.known(kinds.MODELS).keys() <= FORMS.keys()


def signal(forward, samples):
    """Return an input with jumps, turns and values that are no number: float64[n]."""
    rng = np.random.default_rng(5)
    path = np.cumsum(rng.normal(size=samples))
    path *= (5.0 if forward else 15.0) / np.abs(path).max()
    path += 0.0 if forward else 10.0
    path[samples // 3] += 1.0
    path[samples // 2] = np.nan
    return path


def expected(model, forward, samples=400):
    """Return an input, the output of the kernels, and the state after it."""
    operator = model.forward(RATE_HZ) if forward else model.inverse(RATE_HZ)
    given = signal(forward, samples)
    return given, operator.process(given.copy()), operator.state()


MAIN = """
#include <stdio.h>
#include "compensate.c"

int main(void)
{
    static double memory[compensate_memory], in[1000], out[1000];
    const int n = (int)fread(in, sizeof(double), 1000, stdin);
    compensate_reset(memory);
    compensate(memory, in, out, 151);
    compensate(memory, in + 151, out + 151, n - 151);
    fwrite(out, sizeof(double), n, stdout);
    fwrite(memory, sizeof(double), compensate_memory, stdout);
    return 0;
}
"""
DIRECTIONS = pytest.mark.parametrize("forward", [False, True], ids=["inverse", "forward"])


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc is not installed")
@DIRECTIONS
@pytest.mark.parametrize("name", FORMS)
def test_c_function_is_equal_in_two_blocks(name, forward, tmp_path):
    model, file = FORMS[name], tmp_path / "compensate.c"
    file.write_text(export_text(model, file, RATE_HZ, forward=forward), encoding="utf-8")
    (tmp_path / "main.c").write_text(MAIN, encoding="utf-8")
    options = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]
    subprocess.run(["gcc", *options, "main.c", "-lm"], cwd=tmp_path, check=True, timeout=60)
    given, *wanted = expected(model, forward)
    run = subprocess.run(
        [tmp_path / "a.out"], input=given.tobytes(), capture_output=True, check=True, timeout=60
    )
    found = np.frombuffer(run.stdout)
    np.testing.assert_allclose(found, np.concatenate(wanted), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("octave-cli"), reason="octave-cli is not installed")
def test_matlab_function_is_equal_in_two_blocks(tmp_path):
    script, cases = ["format long;"], {}
    for i, (name, model) in enumerate(FORMS.items()):
        for forward in (False, True):
            made = f"m{i}_{forward}".lower()
            file = tmp_path / f"{made}.m"
            file.write_text(export_text(model, file, RATE_HZ, forward=forward), encoding="utf-8")
            given, *cases[name, forward] = expected(model, forward, samples=120)
            np.savetxt(tmp_path / f"{made}.txt", given, fmt="%.17g")
            script += [
                f"x = load('{made}.txt');",
                f"[first, memory] = {made}(x(1:51));",
                f"[second, memory] = {made}(x(52:end), memory);",
                "fprintf('%.17g ', [first; second]); fprintf('\\n');",
                "fprintf('%.17g ', memory); fprintf('\\n');",
            ]
    (tmp_path / "script.m").write_text("\n".join(script), encoding="utf-8")
    run = subprocess.run(
        ["octave-cli", "--no-init-file", "script.m"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert run.returncode == 0, run.stderr
    rows = [np.array(line.split(), dtype=float) for line in run.stdout.splitlines()]
    for case, (out, memory) in zip(cases, zip(rows[::2], rows[1::2], strict=True), strict=True):
        for found, wanted in zip((out, memory), cases[case], strict=True):
            np.testing.assert_allclose(found, wanted, 1e-12, 1e-12, err_msg=str(case))


@pytest.mark.parametrize(
    "name", ["a.txt", "2a.c", "a b.m", "ä.c", f"{'a' * 49}.c", "play_sum.c", "end.m", "double.c"]
)
def test_a_name_that_is_no_function_is_refused(name):
    with pytest.raises(InputError, match=r"\.c or \.m|letter|another"):
        export_text(FORMS["ppi"], Path(name), RATE_HZ)
