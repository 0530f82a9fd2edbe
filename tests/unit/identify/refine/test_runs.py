"""Recordings as histories from rest."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DataError, InputError
from hilctl.identify.refine.runs import STILL_S, _history, load_runs
from hilctl.models.files import load_model
from hilctl.recording.reader import read
from tests.published import piezo_ppi

ROOT = Path(__file__).parents[4]
GOLDEN = ROOT / "recordings" / "golden" / "terfenol_compensated.mcap"
OMEGA = load_model(ROOT / "configs" / "models" / "terfenol_omega.yaml")


def test_a_run_from_rest_is_what_was_put_out_and_what_came():
    (run,), recording = load_runs([GOLDEN], OMEGA), read(GOLDEN)
    assert run.ignore == 0
    np.testing.assert_array_equal(run.command, recording.samples.command[: run.command.size])


def test_a_run_that_goes_on_has_the_one_before_ahead_of_it():
    """Not judged; without it, where the actuator stood could not be known."""
    first = read(GOLDEN)
    later = replace(first, run={**first.run, "run_id": "b", "initial_state_run_id": "a"})
    run = _history(later, {"a": first, "b": later})
    still = round(STILL_S * first.sample_rate_hz)
    assert run.ignore == first.samples.index.size + still
    np.testing.assert_array_equal(run.command[: first.samples.index.size], first.samples.command)
    assert (run.command[run.ignore - still : run.ignore] == first.samples.command[-1]).all()


def test_a_run_that_goes_on_from_one_that_is_not_given_is_refused():
    first = read(GOLDEN)
    later = replace(first, run={**first.run, "initial_state_run_id": "a"})
    with pytest.raises(DataError, match="give that recording too"):
        _history(later, {})


def test_what_can_not_be_used_is_said(tmp_path):
    copy = Path(shutil.copy(GOLDEN, tmp_path / "run.mcap"))
    with pytest.raises(InputError, match="named twice"):
        load_runs([copy, copy], OMEGA)
    with pytest.raises(InputError, match="name recordings"):
        load_runs([], OMEGA)
    with pytest.raises(DataError, match="was recorded in A, the model takes V"):
        load_runs([copy], piezo_ppi())
