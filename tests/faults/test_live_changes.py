"""Change, mark, watch and stop a running compensated run."""

import itertools
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl import api
from hilctl.analysis.replay import replay
from hilctl.base.errors import InputError
from hilctl.recording.reader import read
from tests.commands import typed
from tests.faults.test_daemon import await_state, hilctl, stop_all

CONFIGS = Path(__file__).parents[2] / "configs"
CHANGES = {"sample_rate_hz": 10000, "block": 20, "recording": {"flush_s": 0.2, "ring_s": 30.0}}


def experiment(folder):
    """Write the demo with a rate for a busy machine."""
    made = yaml.safe_load((CONFIGS / "demo.yaml").read_text(encoding="utf-8")) | CHANGES
    made["waveform"] |= {"frequency_hz": 20.0, "duration_s": 60.0}
    made["compensator"]["model"] = str(CONFIGS / "models" / "terfenol_staged.yaml")
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(made), encoding="utf-8")
    return path


@pytest.fixture
def recording(tmp_path):
    """Recording of a running experiment, which the test may stop."""
    started = hilctl("run", experiment(tmp_path), "--output", tmp_path / "run.mcap", "--detach")
    await_state("running")
    yield Path(started["recording"])
    stop_all()


def test_a_run_is_switched_marked_watched_and_stopped(recording):
    run = api.connect()
    assert run.status()["inverse"] == "in"
    assert hilctl("set", "inverse=out", "--over", "0.3")["inverse"] == "out"
    assert hilctl("mark", "tapped the stage")["text"] == "tapped the stage"
    with pytest.raises(InputError, match=r"mark\.text: "):
        run.mark("two\nlines")
    frames = [*itertools.islice(run.frames(every_s=0.2), 6)]
    assert frames[-1].status["inverse"] == "out"
    assert "mark" in {event.code for frame in frames for event in frame.events}
    assert np.nanmax(np.abs(frames[-1].high["error"])) > 3.0
    run.set(inverse="in", over_s=0.3)
    with subprocess.Popen(typed("watch"), stdout=subprocess.PIPE, text=True) as watching:
        assert "mark: tapped" in "".join(itertools.islice(watching.stdout, 4))
        run.stop()
        *_, last = watching.stdout.read().splitlines()
    assert ": stopped: " in last
    left = read(recording)
    # A change starts some time after the request, so a mark may come first.
    *codes, last_code = [event.code for event in left.events]
    assert sorted(codes) == ["inverse", "inverse", "mark"]
    assert last_code == "run_ended"
    assert replay(left).identical
    step = np.abs(np.diff(left.samples.command)).max() * left.sample_rate_hz
    assert step <= 20_000.0
