"""The contract of a kind of model, for every registered kind and one of another package."""

import importlib
import json
import subprocess
import sys

import numpy as np
import pytest

from hilctl.lab.contract import *  # noqa: F403  the checks, and the fixture direction
from hilctl.lab.contract import KindCase
from hilctl.lab.identify.registry import all_fits
from hilctl.models import kinds
from hilctl.models.plays import PpiModel, SpiModel
from hilctl.models.staged import StagedModel
from tests import device_packages
from tests.published import piezo_ppi, terfenol_rdpi
from tests.unit.lab.identify.literature.test_literature import (
    ASYMMETRIC,
    BOUC_WEN,
    BOUC_WEN_2,
    DUHEM,
    GENERALISED,
    PREISACH,
)
from tests.unit.models.literature.test_implicit_models import KP
from tests.unit.models.test_effective_field import ACTIVATION, field_model
from tests.unit.models.test_generalised_duhem import duhem_model
from tests.unit.models.test_integrated import butterfly
from tests.unit.models.test_linear_stages import BENT
from tests.unit.models.test_refined import refined, residual
from tests.unit.models.test_staged import OMEGA, STAGES

PPI = piezo_ppi().model_copy(update={"output_offset_um": 2.0})
FREE = {"weights": "free", "offset": True}
PLAYS = ((4.0, 5.0, 4.0), (2.0, 3.0, 1.0))
SMALL = {"plays": 8, "cells": 8, "knots": 8}
CASES = {
    "ppi": KindCase(PPI, 40.0, fit="ppi", settings={"offset": True, "layout": "even"}),
    "spi": KindCase(SpiModel(**PPI.model_dump(exclude={"kind"})), 40.0, fit="spi",
                    settings={"offset": True}),
    "rdpi": KindCase(terfenol_rdpi(), inverse_percent=3.0, fit="rdpi"),
    "integrated": KindCase(OMEGA, fit="integrated", settings=FREE),
    "integrated with rate": KindCase(
        OMEGA.model_copy(update={"gamma_s": 2e-5}), inverse_percent=1.0
    ),
    "asymmetric": KindCase(ASYMMETRIC, fit="asymmetric"),
    "straight": KindCase(PpiModel(direct=3.0, weights=(), thresholds=()), fit="straight"),
    "butterfly": KindCase(butterfly(), 3.0, 4.5, fit="butterfly",
                          settings={"turning_um": 0.0, "magnets": False}, fit_percent=2.0),
    "generalised": KindCase(GENERALISED, fit="generalised", fit_percent=0.5),
    "preisach": KindCase(PREISACH, fit="preisach", fit_percent=0.5),
    "krasnoselskii_pokrovskii": KindCase(KP, 2.0, fit="kp", fit_percent=0.01),
    "bouc_wen": KindCase(BOUC_WEN, fit="bouc_wen", fit_percent=0.01),
    "exponent 2": KindCase(BOUC_WEN_2, fit="bouc_wen", fit_percent=0.01),
    "duhem": KindCase(DUHEM, fit="duhem", fit_percent=0.01),
    "staged": KindCase(StagedModel.around(OMEGA, **STAGES["all"]), inverse_percent=0.1,
                       fit="staged", settings={"plays": 8, "deadbands": 4, "starts": 1}),
    "bent creep": KindCase(StagedModel.around(OMEGA, creep=BENT)),
    "linear lag": KindCase(StagedModel.around(OMEGA, **STAGES["linear lag"])),
    "structure by place": KindCase(
        StagedModel.around(OMEGA, **STAGES["structure by place"]), inverse_percent=0.1
    ),
    "field": KindCase(StagedModel.around(field_model(lengths=(), slopes=PLAYS)), fit="field",
                      settings=SMALL),
    "drags": KindCase(StagedModel.around(field_model())),
    "plays that creep": KindCase(StagedModel.around(field_model(activation=ACTIVATION))),
    "plays that accommodate": KindCase(StagedModel.around(field_model(accommodation=0.2))),
    "generalised_duhem": KindCase(StagedModel.around(duhem_model()), fit="generalised_duhem",
                                  settings={"cells": 12, "across": 8}),
    "refined": KindCase(refined(PPI, residual(), 0.4), 40.0),
}  # fmt: skip


@pytest.fixture(params=[*CASES, "of another package"])
def case(request, monkeypatch):
    if request.param in CASES:
        return CASES[request.param]
    device_packages.installed_here("own_kind", monkeypatch)
    model = importlib.import_module("own_kind.model")
    made = model.BacklashModel(gain=4.0, weight=2.0, threshold=1.5, output_offset_um=3.0)
    return KindCase(made, fit="backlash", settings={"own": {"trials": 50}})


def test_every_kind_is_covered():
    assert kinds.BUILTIN[kinds.MODELS].keys() <= CASES.keys() | {"field", "generalised_duhem"}
    assert {case.fit for case in CASES.values()} - {""} == all_fits().keys()
    assert len({fit.title for fit in all_fits().values()}) == len(all_fits())


@pytest.mark.slow
def test_a_kind_of_another_package_is_used_like_any_other(tmp_path):
    environment = device_packages.installed("own_kind", tmp_path / "site")

    def hilctl(*words):
        done = subprocess.run(
            [sys.executable, "-m", "hilctl", *map(str, words)],
            capture_output=True, text=True, env=environment, cwd=tmp_path,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    listed = hilctl("identify", "--settings")
    assert "backlash" in listed
    assert "own.trials" in listed
    time = np.arange(4000) / 1000.0
    command = 5.0 * np.minimum(time, 1.0) * np.sin(2.0 * np.pi * 2.0 * time)
    play = SpiModel(direct=4.0, weights=(2.0,), thresholds=(1.5,)).forward(1.0).process(command)
    table = np.column_stack((time, command, play))
    np.savetxt(
        tmp_path / "loops.csv", table, delimiter=",", comments="",
        header="t_s,current_a,displacement_um",
    )  # fmt: skip
    model = tmp_path / "model.yaml"
    words = ("identify", "loops.csv", "--model", "backlash", "--output", model, "--json")
    found = json.loads(hilctl(*words, "--set", "own.trials=100"))
    assert found["parameters"]["threshold"] == pytest.approx(1.5, abs=0.05)
    assert "own.trials=100" in model.read_text()
    assert found["model"]["kind"] == "backlash"
    hilctl("export-model", model, "backlash.c", "--rate-hz", "1000")
