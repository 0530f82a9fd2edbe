"""A series of commands, as a user types them, and their results."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests import commands

CONFIGS = Path(__file__).parents[2] / "configs"


def hilctl(*arguments, code=0):
    return commands.hilctl(*arguments, code=code).stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of this module's recordings."""
    return tmp_path_factory.mktemp("rig")


@pytest.fixture(scope="module")
def run(folder):
    """A compensated run at full stroke, 100 Hz, and its printed result."""
    path = folder / "run.mcap"
    settings = ("--set", "waveform.frequency_hz=100", "--set", "waveform.duration_s=1.0")
    printed = hilctl(
        "run", CONFIGS / "terfenol_sine_6a.yaml", *settings, "--output", path, "--json"
    )
    return path, json.loads(printed)


def test_run_prints_its_result(run):
    _, result = run
    assert result["code"] == "completed"
    assert result["output_safe"] is True
    assert result["samples"] == 50_000
    assert result["dropped"] == 0
    assert result["peak_hysteresis_percent"] < 3.7
    # Where its kernels had to be compiled, too: a process keeps what that takes.
    assert result["processes"]["supervisor"]["resident_bytes"] < 300e6


def test_report_is_what_run_printed(run):
    path, result = run
    report = json.loads(hilctl("report", path, "--json"))
    for key in ("samples", "dropped", "peak_hysteresis_percent", "peak_to_peak_um", "loop_area",
                "peak_error_percent", "rms_error_percent", "late_ticks"):  # fmt: skip
        assert report[key] == result[key], key


def test_page_is_written_once(run, folder):
    path, _ = run
    page = folder / "run.html"
    hilctl("report", path, "--html", page)
    text = page.read_text()
    assert text.count("<svg") >= 4
    assert "<script" not in text
    addresses = text.replace("http://www.w3.org/", "")  # names of SVG, which nobody fetches
    assert "http://" not in addresses
    assert "https://" not in addresses
    hilctl("report", path, "--html", page, code=2)


def test_replay_is_identical(run):
    path, _ = run
    result = json.loads(hilctl("replay", path, "--json"))
    assert result["identical"] is True
    assert result["samples"] >= 50_000


def test_replay_with_another_model(run):
    """Another model is evaluated, which is no failure."""
    path, _ = run
    other = CONFIGS / "models" / "terfenol_omega_chapter4.yaml"
    result = json.loads(hilctl("replay", path, "--model", other, "--json"))
    assert 0.0 < result["rms_difference"] < 0.5
    assert 5.0 < result["command_max"] < 7.0


def test_export_agrees_with_an_independent_reader(run, folder):
    path, _ = run
    hilctl("export", path, folder / "run.npz")
    exported = np.load(folder / "run.npz")
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        blocks = [d for *_, d in reader.iter_decoded_messages(topics=["/samples"])]
    assert sum(block.n for block in blocks) == exported["current_a"].size
    assert [block.tick0 for block in blocks][1:] == np.cumsum([b.n for b in blocks])[:-1].tolist()
    current_a = np.concatenate([np.array(block.current_a) for block in blocks])
    assert np.array_equal(current_a, exported["current_a"])


def test_check_moves_nothing(folder):
    """Check prints the forecast of a run."""
    forecast = json.loads(hilctl("check", CONFIGS / "demo.yaml", "--json"))
    assert forecast["samples"] == 500_000
    assert forecast["command_unit"] == "A"
    assert -7.07 < forecast["command_min"] < -5.0


def test_identify_from_a_recording(folder):
    loops, model = folder / "piezo.mcap", folder / "piezo.yaml"
    hilctl("run", CONFIGS / "identify_piezo.yaml", "--output", loops)
    fit = json.loads(hilctl("identify", loops, "--model", "ppi", "--output", model, "--json"))
    assert fit["peak_percent"] < 0.5
    settings = ("--set", f"compensator.model={model}")
    hilctl("check", CONFIGS / "piezo_sine.yaml", *settings)
    hilctl("identify", loops, "--model", "ppi", "--output", model, code=2)
