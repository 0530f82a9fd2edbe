"""What a running supervisor may be asked, and what it refuses; the page is not touched by those."""

import json
from mmap import mmap
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import pytest

from hilctl.base.errors import InputError
from hilctl.base.events import MARK
from hilctl.run.control import client
from hilctl.run.control.requests import REQUESTS, Requests
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.shared_page import SIZE, PageField, Phase, SharedPage, Stop
from hilctl.run.start import checked_experiment

DEMO = Path(__file__).parents[4] / "configs" / "demo.yaml"


@pytest.fixture(scope="module")
def checked():
    return checked_experiment(DEMO, [])


@pytest.fixture
def page():
    made = SharedPage(mmap(-1, SIZE))
    made.put(PageField.PHASE, Phase.RUNNING)
    made.put(PageField.NEXT_SAMPLE, 500)
    return made


@pytest.fixture
def recording():
    made = SimpleNamespace(events=[], takes_marks=True)
    made.recorder = SimpleNamespace(samples=450, missing=0, error="")
    made.record_event = made.events.append
    return made


@pytest.fixture
def requests(checked, page, recording, tmp_path):
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        yield Requests(checked, folder, page, recording)


def asked(requests, **message):
    return requests.answer(json.dumps(message).encode())


def test_status_says_where_the_run_stands(requests, page):
    found = asked(requests, command="status")
    assert (found["state"], found["sample"], found["gain"]) == ("running", 500, 1.0)
    page.put(PageField.STOP, Stop.CTRL_C)
    assert asked(requests, command="status")["state"] == "stopping"


def test_a_change_is_passed_to_the_loop(requests, page):
    answer = asked(requests, command="set", gain=0.5, over_s=2.0)
    assert (answer["gain"], answer["offset"], answer["over_s"]) == (0.5, 0.0, 2.0)
    assert (page.get_float(PageField.TUNE_GAIN), page.get(PageField.TUNE_WANTED)) == (0.5, 1)


def test_nobody_stops_a_run_by_its_socket(requests):
    """Others may keep it busy: a stop has a signal of its own."""
    with pytest.raises(InputError, match="does not match any of the expected tags"):
        asked(requests, command="stop")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"{", "message: "),
        (b'{"command": "fly"}', "message: "),
        (b'{"command": "set"}', "gain, offset or inverse is required"),
        (b'{"command": "set", "gain": "1"}', "gain: "),
        (b'{"command": "set", "gain": 1.0, "over_s": 0.0}', "over_s: "),
        (b'{"command": "set", "gain": 1.0, "over_s": 1e9}', "over_s: "),
        (b'{"command": "set", "gain": 1e999}', "finite"),
        (b'{"command": "set", "gain": NaN}', "finite"),
        (b'{"command": "set", "offset": -Infinity}', "finite"),
        (b'{"command": "set", "gain": 1e308}', "gain: "),
        (b'{"command": "set", "offset": -1e7}', "offset: "),
        (b'{"command": "set", "gain": 1' + b"0" * 400 + b"}", "gain: "),
        (b'{"command": "set", "gain": true}', "gain: "),
        (b'{"command": "set", "gain": 1.0, "over_s": -1.0}', "over_s: "),
        (b'{"command": "set", "gain": 1.0, "over_s": null}', "over_s: "),
        (b"[" * 4000, "message: "),
        (b'{"command": ' + b'{"command": ' * 300, "message: "),
        (b"null", "message: "),
        (b"\xff\xfe", "message: "),
        (b'{"command": "status", "more": 1}', "more: "),
    ],
)
def test_bad_requests_change_nothing(requests, page, line, said):
    before = bytes(page.numbers)
    with pytest.raises(InputError, match=said):
        requests.answer(line)
    assert bytes(page.numbers) == before


def test_a_mark_is_an_event_at_the_present_sample(requests, page, recording):
    page.put(PageField.WAVEFORM_AT, 100)
    answer = asked(requests, command="mark", text="tapped the stage")
    assert answer == {"sample": 600, "text": "tapped the stage"}
    (event,) = recording.events
    assert (event.sample, event.level, event.code) == (600, "info", MARK)
    assert event.text == "tapped the stage"


@pytest.mark.parametrize("text", ["", "  ", "two\nlines", "\x1b[2J", "\u202eabc", "x" * 201])
def test_a_mark_is_one_printable_line(requests, recording, text):
    with pytest.raises(InputError, match=r"mark\.text: "):
        asked(requests, command="mark", text=text)
    assert recording.events == []


def test_a_mark_that_would_be_lost_is_refused(requests, recording):
    recording.takes_marks = False
    with pytest.raises(InputError, match="mark: "):
        asked(requests, command="mark", text="late")
    assert recording.events == []


def test_the_protocol_names_every_request():
    """What a client may send by it is what is read here."""
    schema = REQUESTS.json_schema()
    assert {*schema["discriminator"]["mapping"]} == {*get_args(client.Command)}
    assert client.request("set", gain=0.5, offset=None) == {"command": "set", "gain": 0.5}
