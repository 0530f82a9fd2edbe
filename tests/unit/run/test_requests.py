"""What a running supervisor may be asked, and what it refuses; the page is not touched by those."""

import json
from mmap import mmap
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.run.requests import Requests
from hilctl.run.run_folder import run_folder
from hilctl.run.shared_page import SIZE, Field, Phase, SharedPage, Stop
from hilctl.run.start import checked_experiment

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


@pytest.fixture(scope="module")
def checked():
    return checked_experiment(DEMO, [])


@pytest.fixture
def page():
    made = SharedPage(mmap(-1, SIZE))
    made.put(Field.PHASE, Phase.RUNNING)
    made.put(Field.NEXT_SAMPLE, 500)
    return made


@pytest.fixture
def requests(checked, page, tmp_path):
    recorder = SimpleNamespace(samples=450, missing=0, error="")
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        yield Requests(checked, folder, page, recorder)


def asked(requests, **message):
    return requests.answer(json.dumps(message).encode())


def test_status_says_where_the_run_stands(requests, page):
    found = asked(requests, command="status")
    assert (found["state"], found["sample"], found["gain"]) == ("running", 500, 1.0)
    assert not requests.stop
    page.put(Field.STOP, Stop.CTRL_C)
    assert asked(requests, command="status")["state"] == "stopping"


def test_stop_is_noted_and_ends_all_tuning(requests):
    assert asked(requests, command="stop")["state"] == "stopping"
    assert requests.stop
    with pytest.raises(InputError, match="on its way to the safe value"):
        asked(requests, command="set", gain=0.5)


def test_a_change_reaches_the_loop_whole_and_one_at_a_time(requests, page):
    """Numbers first, then the count that the loop looks at; the next waits until it is taken."""
    answer = asked(requests, command="set", gain=0.5, over_s=2.0)
    assert answer == {"gain": 0.5, "offset": 0.0, "over_s": 2.0}
    assert page.get_float(Field.TUNE_GAIN) == 0.5
    assert (page.get(Field.TUNE_SAMPLES), page.get(Field.TUNE_WANTED)) == (100_000, 1)
    with pytest.raises(InputError, match="has not been taken yet"):
        asked(requests, command="set", offset=1.0)
    page.put(Field.TUNE_TAKEN, 1)
    assert asked(requests, command="set", offset=1.0)["gain"] == 0.5


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"{", "message: "),
        (b'{"command": "fly"}', "message: "),
        (b'{"command": "set"}', "gain or offset is required"),
        (b'{"command": "set", "gain": "1"}', "gain: "),
        (b'{"command": "set", "gain": 1.0, "over_s": 0.0}', "over_s: "),
        (b'{"command": "set", "gain": 50.0}', "set: "),
        (b'{"command": "status", "more": 1}', "more: "),
    ],
)
def test_bad_requests_change_nothing(requests, page, line, said):
    before = bytes(page.numbers)
    with pytest.raises(InputError, match=said):
        requests.answer(line)
    assert bytes(page.numbers) == before
    assert not requests.stop


def test_nothing_is_moved_when_the_waveform_is_over(requests, page, checked):
    page.put(Field.NEXT_SAMPLE, checked.forecast.samples)
    with pytest.raises(InputError, match="the waveform is over"):
        asked(requests, command="set", gain=0.5)
