"""The commands frf, spectrum, step and tune: output, files and refusals."""

from pathlib import Path

import pytest

from tests.unit.lab.response.test_bode import SMALL

RUN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_uncompensated.mcap"


def test_frequency_responses_are_tables_or_json(monkeypatch, tmp_path, hilctl, json_of):
    monkeypatch.setattr("hilctl.api.frf", lambda runs, *_, **__: (SMALL,) * len(runs))
    code, shown, _ = hilctl("frf", "a.mcap", "b.mcap")
    assert code == 0
    assert shown.count("natural frequency") == 2
    assert max(map(len, shown.splitlines())) <= 80
    assert json_of("frf", "a.mcap")[1]["responses"][0]["natural_hz"] == SMALL.natural_hz


@pytest.mark.parametrize("command", ["frf", "step", "tune"])
def test_a_run_without_a_response_is_refused(hilctl, command):
    assert hilctl(command, RUN)[0] == 2


def test_spectra_are_rows_or_json(tmp_path, hilctl, json_of):
    page = tmp_path / "page.html"
    code, found = json_of("spectrum", RUN, "--html", page)
    (segment,) = found["spectra"]
    assert (code, page.exists(), segment["rest"]) == (0, True, None)
    assert len(segment["sine"]["harmonics_um"]) == 20
    assert "THD" in hilctl("spectrum", RUN)[1]
    assert hilctl("spectrum", RUN, "--html", page)[0] == 2
    assert hilctl("spectrum", RUN, RUN, "--from", "99")[0] == 2
