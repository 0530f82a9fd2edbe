"""Requests to a running supervisor: accepted, queued, refused without touching the page."""

import json
import shutil
import socket
import stat
import threading
from dataclasses import replace
from mmap import mmap
from pathlib import Path
from types import SimpleNamespace
from typing import get_args
from unittest.mock import Mock

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import MARK
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import CheckedRun, check
from hilctl.loop.interlocks import ApartSettings
from hilctl.loop.tuning import LinearBypass
from hilctl.models.staged import FieldLag, StagedModel
from hilctl.run.control import client
from hilctl.run.control.client import MAX_BYTES, VERSION, ask
from hilctl.run.control.requests import (
    REQUESTS,
    Changes,
    ControlServer,
    Requests,
    SetRequest,
    bound_refusal,
    command_range,
    fade_refusal,
)
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.shared_page import SIZE, PageField, Phase, SharedPage, Stop
from hilctl.run.start import checked_experiment
from tests.fakes import DESCRIBED, DescribedDevice, SteppingClock
from tests.published import terfenol_rdpi

DEMO = Path(__file__).parents[4] / "configs" / "demo.yaml"


@pytest.fixture(scope="module")
def demo():
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
    made.recorders = [SimpleNamespace(samples=450, missing=0)]
    made.error = ""
    made.record_event = made.events.append
    return made


@pytest.fixture
def requests(demo, page, recording, tmp_path):
    with run_folder("demo", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _):
        yield Requests(CheckedRun((demo,)), folder, [page], recording)


def asked(requests, **message):
    return requests.answer(json.dumps(message).encode())


def test_status_has_state_sample_and_gain(requests, page):
    found = asked(requests, command="status")
    assert (found["state"], found["sample"], found["gain"]) == ("running", 500, 1.0)
    page.put(PageField.STOP, Stop.CTRL_C)
    assert asked(requests, command="status")["state"] == "stopping"


def test_socket_accepts_no_stop(requests):
    """Other clients could block it; a stop is a signal."""
    with pytest.raises(InputError, match="one of"):
        asked(requests, command="stop")


@pytest.mark.parametrize(("line", "said"), [
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
    (rb'{"command": "mark", "text": "\ud83d"}', "half a character"),
    (b"\xff\xfe", "message: "),
    (b'{"command": "status", "more": 1}', "more: "),
])  # fmt: skip
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
    """The client and the supervisor know the same requests."""
    schema = REQUESTS.json_schema()
    assert {*schema["discriminator"]["mapping"]} == {*get_args(client.Command)}
    assert client.request("set", gain=0.5, offset=None) == {"command": "set", "gain": 0.5}


RATE_HZ, BLOCK, SAMPLES = 10_000.0, 10, 20_000
LEAD = 500 + BLOCK
TEXT = """\
name: changed
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform: WAVEFORM
compensator: COMPENSATOR
limits: {peak_current_a: PEAK, slew_a_per_s: SLEW, stroke_um: [-75.0, 60.0]}
"""
SINE = """{kind: sine, unit: UNIT, amplitude: AMPLITUDE, offset: OFFSET, frequency_hz: HZ,
  duration_s: 2.0, soft_start_s: 0.5}"""
MODEL = str(Path(__file__).parents[4] / "configs" / "models" / "terfenol_rdpi.yaml")
RDPI = terfenol_rdpi()
LOOKING_AHEAD = StagedModel.around(RDPI, lag=FieldLag(tau_s=2e-3))


def experiment_of(
    model=None,
    amplitude=4.0,
    offset=0.0,
    hz=10.0,
    peak_a=7.0,
    limits="",
    amplifier="null",
    slew_a_per_s=1e6,
):
    text = TEXT.replace("WAVEFORM", SINE).replace("UNIT", "A" if model is None else "um")
    numbers = {"AMPLITUDE": amplitude, "OFFSET": offset, "HZ": hz, "PEAK": peak_a}
    for name, value in {**numbers, "SLEW": slew_a_per_s}.items():
        text = text.replace(name, str(value))
    text = text.replace("COMPENSATOR", "none" if model is None else f"{{model: {MODEL}}}")
    text = text.replace("stroke_um", limits + "stroke_um")
    text += f"block: {BLOCK}\namplifier: {amplifier}\n"
    loaded = resolve(Document("x.yaml", text), Path())
    info = replace(DESCRIBED, buffered=True, fifo_depth=1000)
    return check(replace(loaded, device=DescribedDevice(info), model=model))


@pytest.fixture(scope="module")
def experiment():
    return experiment_of(RDPI)


class Waits:
    """The time of the changes; each wait calls ``meanwhile``."""

    def __init__(self):
        self.clock, self.meanwhile = SteppingClock(), lambda: None

    def sleep(self, seconds):
        self.clock.now += seconds
        self.meanwhile()


@pytest.fixture
def waits():
    return Waits()


@pytest.fixture
def changes(experiment, page, waits):
    return Changes(CheckedRun((experiment,)), [page], waits.clock, waits.sleep)


def change(changes, gain=None, offset=None, over_s=0.2, inverse=None):
    wanted = SetRequest(command="set", gain=gain, offset=offset, over_s=over_s, inverse=inverse)
    return changes.make(wanted)


def take(page, at):
    """Take the change on the page at a sample, as the loop does."""
    page.put(PageField.NEXT_SAMPLE, at)
    page.put(PageField.TUNE_TAKEN, page.get(PageField.TUNE_WANTED))


def test_a_change_reaches_the_loop_whole(changes, page):
    assert change(changes, gain=0.5) == {
        "gain": 0.5,
        "offset": 0.0,
        "inverse": "in",
        "over_s": 0.2,
        "begins_at_sample": 500 + LEAD,
    }
    assert (page.get_float(PageField.TUNE_GAIN), page.get_float(PageField.TUNE_OFFSET)) == (
        0.5,
        0.0,
    )
    numbers = (PageField.TUNE_SAMPLES, PageField.TUNE_BEGINS_AT, PageField.TUNE_WANTED)
    assert [page.get(each) for each in numbers] == [2000, 500 + LEAD, 1]
    assert changes.references() == {"gain": 0.5, "offset": 0.0, "inverse": "in"}


def test_second_change_follows_the_first(changes, page, waits):
    wanted = []

    def meanwhile():
        wanted.append(page.get(PageField.TUNE_WANTED))
        if len(wanted) == 3:
            take(page, 1013)

    change(changes, gain=0.5)
    waits.meanwhile = meanwhile
    answer = change(changes, offset=3.0)
    assert wanted == [1, 1, 1]
    assert (answer["gain"], answer["offset"]) == (0.5, 3.0)
    assert answer["begins_at_sample"] == 1020 + LEAD
    assert page.get(PageField.TUNE_WANTED) == 2


def test_a_refusal_changes_nothing_and_the_next_has_its_turn(changes, page):
    before = bytes(page.numbers)
    with pytest.raises(InputError, match=r"limits\.stroke_um"):
        change(changes, gain=90.0)
    assert bytes(page.numbers) == before
    assert change(changes, offset=1.0)["gain"] == 1.0


@pytest.mark.parametrize(
    ("number", "value", "said"),
    [(PageField.STOP, Stop.CTRL_C, "safe ramp"), (PageField.NEXT_SAMPLE, SAMPLES, "has ended")],
)
def test_the_end_of_the_run_refuses_a_change_that_waits(changes, page, waits, number, value, said):
    change(changes, gain=0.1)
    waits.meanwhile = lambda: page.put(number, value)
    for gain in (0.2, 0.3):
        with pytest.raises(InputError, match=said):
            change(changes, gain=gain)
    assert page.get(PageField.TUNE_WANTED) == 1


def test_waiting_for_a_loop_that_takes_no_change_has_a_limit(changes, waits):
    """The client has a shorter timeout."""
    change(changes, gain=0.1)
    with pytest.raises(InputError, match="previous change"):
        change(changes, gain=0.2)
    assert waits.clock.now < client._SET_S


def test_a_change_that_could_not_begin_is_refused(changes, page):
    page.put(PageField.NEXT_SAMPLE, SAMPLES - LEAD)
    with pytest.raises(InputError, match="begin"):
        change(changes, gain=0.5)
    assert page.get(PageField.TUNE_WANTED) == 0


def test_a_queue_that_is_full_takes_no_more(changes, page, waits):
    refused, made = [], [change(changes, gain=1.0)]

    def meanwhile():
        if refused:
            take(page, page.get(PageField.NEXT_SAMPLE))
            return
        try:
            made.append(change(changes, gain=1.0))
        except InputError as error:
            refused.append((len(made), str(error)))

    waits.meanwhile = meanwhile
    made.append(change(changes, gain=1.0))
    assert len(refused) == 1
    assert "16 changes are waiting" in refused[0][1]
    assert len(made) == 17


def test_inverse_stays_bypassed_until_it_is_enabled(changes, page, experiment):
    line = experiment.forecast.line
    numbers = [PageField.TUNE_INVERSE_SHARE, PageField.TUNE_LINE_SLOPE, PageField.TUNE_LINE_AT_ZERO]
    for at, wanted, share in (
        (2000, {"inverse": "out"}, 0.0),
        (4000, {"gain": 0.5}, 0.0),
        (6000, {"inverse": "in"}, 1.0),
    ):
        assert change(changes, **wanted)["inverse"] == ("in" if share else "out")
        assert [page.get_float(each) for each in numbers] == [share, line.slope, line.at_zero]
        take(page, at)


def test_bypass_without_a_compensator_is_refused(page):
    changes = Changes(CheckedRun((experiment_of(),)), [page])
    with pytest.raises(InputError, match="set: inverse: "):
        change(changes, inverse="out")
    assert changes.references()["inverse"] is None
    assert page.get(PageField.TUNE_WANTED) == 0


def axes_of(*experiments):
    """Return a run with the axes x, y ... of experiments."""
    return CheckedRun(
        tuple(
            replace(each, loaded=replace(each.loaded, axis=axis))
            for axis, each in zip("xyz", experiments, strict=False)
        )
    )


@pytest.fixture
def axes(experiment, page, waits):
    """Changes of two axes, and their pages."""
    run, pages = axes_of(experiment, experiment_of(peak_a=5.0)), [page, SharedPage(mmap(-1, SIZE))]
    return Changes(run, pages, waits.clock, waits.sleep), pages


def change_axes(changes, **values):
    return changes.make(SetRequest.model_validate({"command": "set", **values}))


def test_axes_change_together_by_one_count(axes, page):
    changes, pages = axes
    answer = change_axes(changes, gain=0.5, axes={"y": {"gain": 0.25, "offset": 1.0}})
    assert answer["references"] == {
        "x": {"gain": 0.5, "offset": 0.0, "inverse": "in"},
        "y": {"gain": 0.25, "offset": 1.0, "inverse": None},
    }
    assert [each.get_float(PageField.TUNE_GAIN) for each in pages] == [0.5, 0.25]
    assert [each.get(PageField.TUNE_NUMBER) for each in pages] == [1, 1]
    assert [each.get(PageField.TUNE_WANTED) for each in pages] == [1, 0]
    take(page, 2000)
    assert {*change_axes(changes, axes={"y": {"gain": 1.0}})["references"]} == {"y"}
    assert [each.get(PageField.TUNE_NUMBER) for each in pages] == [1, 2]
    assert page.get(PageField.TUNE_WANTED) == 2
    assert changes.references()["references"]["x"]["gain"] == 0.5


@pytest.mark.parametrize(("values", "said"), [
    ({"axes": {"yy": {"gain": 1.0}}}, "'yy'.*x, y"),
    ({"axes": {"x": {}}}, "required"),
    ({"inverse": "out"}, "set: y: inverse: "),
    ({"gain": 2.0}, "set: y: "),
    ({"gain": 90.0}, "set: x: .*; y: "),
])  # fmt: skip
def test_a_refused_axis_keeps_all_from_changing(axes, values, said):
    changes, pages = axes
    before = [bytes(each.numbers) for each in pages]
    with pytest.raises(InputError, match=said):
        change_axes(changes, **values)
    assert [bytes(each.numbers) for each in pages] == before
    assert changes.references()["references"]["x"]["gain"] == 1.0


@pytest.mark.parametrize(("for_s", "gain", "refused"), [
    (0.0, 0.76, False), (0.0, 0.74, True), (0.01, 0.74, False), (0.01, 0.7, True),
])  # fmt: skip
def test_a_pair_is_not_moved_apart(experiment, page, for_s, gain, refused):
    """A sine of 4 um at 10 Hz; a gain of 0.7 leaves 1.2 um, beyond 1 um for 19 ms."""
    run, pages = axes_of(experiment, experiment), [page, SharedPage(mmap(-1, SIZE))]
    apart = ApartSettings(axes=("x", "y"), um=1.0, for_s=for_s)
    config = run.config.model_copy(update={"apart": apart})
    first = replace(run.first, loaded=replace(run.first.loaded, config=config))
    changes = Changes(replace(run, axes=(first, run.axes[1])), pages)
    if refused:
        with pytest.raises(InputError, match=r"set: .*apart"):
            change_axes(changes, axes={"x": {"gain": gain}})
        change_axes(changes, gain=gain)
    else:
        change_axes(changes, axes={"x": {"gain": gain}})


def test_a_run_of_one_axis_has_no_name(changes):
    with pytest.raises(InputError, match="without the name 'x'"):
        change_axes(changes, axes={"x": {"gain": 0.5}})


def test_coupled_axes_change_together_only(experiment, page):
    run, pages = axes_of(experiment, experiment), [page, SharedPage(mmap(-1, SIZE))]
    coupled = replace(run.first.loaded, coupling=Mock())
    run = replace(run, axes=(replace(run.first, loaded=coupled), *run.axes[1:]))
    changes = Changes(run, pages)
    with pytest.raises(InputError, match="set: coupling: "):
        change_axes(changes, gain=0.5, axes={"x": {"gain": 0.5}})
    assert change_axes(changes, gain=0.5)["references"]["y"]["gain"] == 0.5


@pytest.mark.parametrize(("gain", "offset", "refused"), [
    (1.0, 0.0, False),
    (1.25, 0.0, False),
    (-1.25, 0.0, False),
    (1.2501, 0.0, True),
    (-1.2501, 0.0, True),
    (1.0, 1.0, False),
    (1.0, 1.0001, True),
    (0.0, -5.0, False),
    (0.0, -5.001, True),
    (1e6, 1e6, True),
])  # fmt: skip
def test_without_a_model_the_bound_is_exact(gain, offset, refused):
    made = experiment_of(peak_a=5.0)
    assert bool(bound_refusal(made, gain, offset, bypassed=False)) == refused


@pytest.mark.parametrize(("gain", "offset", "refused"), [
    (1.0, 1.0, False),
    (1.19, 0.0, False),
    (1.2, 0.0, True),
    (-1.2, 0.0, True),
])  # fmt: skip
def test_a_change_beyond_the_slew_limit_is_refused(gain, offset, refused):
    """4 A of 10 Hz change by 251 A/s."""
    why = bound_refusal(experiment_of(slew_a_per_s=300.0), gain, offset, bypassed=False)
    assert ("301.5" in why) == ("300 A/s" in why) == refused


@pytest.mark.parametrize("model", [None, RDPI])
def test_a_run_at_its_slew_limit_accepts_an_offset(model):
    slew_per_s = experiment_of(model).forecast.slew_per_s
    made = experiment_of(model, slew_a_per_s=slew_per_s)
    assert bound_refusal(made, 1.0, 0.01, bypassed=False) == ""
    assert "A/s" in bound_refusal(made, 1.01, 0.0, bypassed=False)


def test_the_step_to_the_first_command_does_not_limit_a_change():
    made = experiment_of(slew_a_per_s=300.0)
    stepped = replace(made, forecast=replace(made.forecast, fastest_at_s=made.forecast.before_s))
    assert bound_refusal(stepped, 1.2, 0.0, bypassed=False) == ""


@pytest.mark.parametrize(("gain", "offset", "refused"), [
    (1.0, 0.0, False),
    (-1.2, 0.0, False),
    (-1.22, 0.0, True),
    (1.0, 1.5, False),
    (1.0, -1.6, True),
    (0.0, 6.0, False),
])  # fmt: skip
def test_the_voltage_is_bounded_too(gain, offset, refused):
    """4 A of 100 Hz need 29.8 V: 4 ohm and 6.28 ohm of the inductance."""
    amplifier = "{voltage_max_v: 36, resistance_ohm: 4, inductance_h: 0.01}"
    made = experiment_of(hz=100.0, amplifier=amplifier)
    assert ("V" in bound_refusal(made, gain, offset, bypassed=False)) == refused


def test_bypass_is_bounded_while_it_gives_commands():
    made = experiment_of(RDPI, 10.0, -10.0, peak_a=5.5)
    assert bound_refusal(made, 0.3, 30.0, bypassed=False) == ""
    assert "5.5 A" in bound_refusal(made, 0.3, 30.0, bypassed=True)


@pytest.mark.parametrize("model", [RDPI, LOOKING_AHEAD])
@pytest.mark.parametrize("hz", [2.0, 50.0])
@pytest.mark.parametrize(
    ("gain", "offset"), [(1.0, 0.0), (0.3, 5.0), (2.0, 0.0), (-1.5, -3.0), (1.0, 10.0)]
)
def test_command_range_is_that_of_a_run_with_the_new_amplitude(model, hz, gain, offset):
    made = experiment_of(model, 10.0, -10.0, hz)
    low, high = sorted(gain * end + offset for end in made.reference.span)
    after = experiment_of(model, abs(gain) * 10.0, gain * -10.0 + offset, hz)
    line = after.forecast.line
    known = sorted(line.slope * end + line.at_zero for end in after.reference.span)
    found = command_range(made, low, high, gain)
    assert found == pytest.approx(known, abs=0.05 * (known[1] - known[0]))


PATIENT_S = 60.0


def echo(line):
    if line == b"refuse":
        raise InputError("not today")
    if line == b"break":
        raise ZeroDivisionError("a bug")
    return {"heard": line.decode(errors="replace")}


def serving(path, answer=echo, request_s=PATIENT_S):
    server = ControlServer(path, answer, request_s)
    server.start()
    return server


@pytest.fixture
def server(tmp_path):
    with serving(tmp_path / "socket") as made:
        yield made


def connect(folder):
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.settimeout(PATIENT_S)
    client.connect(str(folder / "socket"))
    return client


def answer_of(client):
    answer = bytearray()
    while data := client.recv(100_000):
        answer += data
    return bytes(answer)


def exchange(folder, raw):
    """Send bytes, close the sending side, and return the answer."""
    with connect(folder) as client:
        client.sendall(raw)
        client.shutdown(socket.SHUT_WR)
        return answer_of(client)


def test_only_its_owner_may_use_it(server, tmp_path):
    assert stat.S_IMODE((tmp_path / "socket").stat().st_mode) == 0o600


def test_it_listens_again_after_its_folder_was_removed(tmp_path):
    """As after a logout, except in a folder that others can write to."""
    path = tmp_path / "runs" / "sine-7" / "socket"
    path.parent.mkdir(parents=True, mode=0o700)
    path.parent.parent.chmod(0o700)
    with ControlServer(path, echo) as server:
        shutil.rmtree(path.parent.parent)
        path.parent.parent.mkdir()
        path.parent.parent.chmod(0o777)
        server._restore_socket()
        assert not path.exists()
        path.parent.parent.chmod(0o700)
        server._restore_socket()
        server.start()
        assert json.loads(exchange(path.parent, b"hello"))["heard"] == "hello"


def test_request_and_answer_are_one_line_each(server, tmp_path):
    with connect(tmp_path) as client:
        client.sendall(b"hel")
        client.sendall(b"lo\n")
        assert json.loads(answer_of(client)) == {"protocol": VERSION, "ok": True, "heard": "hello"}


def test_a_refusal_is_an_answer(server, tmp_path):
    answer = json.loads(exchange(tmp_path, b"refuse\n"))
    assert answer == {"protocol": VERSION, "ok": False, "error": "not today"}


def test_a_request_that_is_too_long_is_refused(server, tmp_path):
    with connect(tmp_path) as client:
        client.sendall(b"x" * (MAX_BYTES + 100))
        answer = json.loads(client.recv(1000))
    assert (answer["ok"], answer["error"]) == (False, f"longer than {MAX_BYTES} bytes")
    assert json.loads(exchange(tmp_path, b"x" * MAX_BYTES + b"\n"))["ok"]


@pytest.mark.parametrize("sent", [b"", b"hel"])
def test_a_slow_client_is_dropped_without_an_answer(tmp_path, sent):
    with serving(tmp_path / "socket", request_s=1e-3), connect(tmp_path) as client:
        client.sendall(sent)
        assert answer_of(client) == b""


def test_an_answer_that_takes_time_delays_no_other(tmp_path):
    released = threading.Event()

    def answer(line):
        if line == b"slow":
            assert released.wait(PATIENT_S)
        return {}

    with serving(tmp_path / "socket", answer), connect(tmp_path) as slow:
        slow.sendall(b"slow\n")
        slow.shutdown(socket.SHUT_WR)
        assert json.loads(exchange(tmp_path, b"fast\n"))["ok"]
        released.set()
        assert json.loads(answer_of(slow))["ok"]


def test_an_error_of_one_request_ends_no_other(server, tmp_path, caplog):
    assert exchange(tmp_path, b"break\n") == b""
    assert "request failed" in caplog.text
    assert json.loads(exchange(tmp_path, b"hello\n"))["ok"]


def test_clients_without_a_thread_take_no_place(server, tmp_path, monkeypatch, caplog):
    with monkeypatch.context() as patch:
        patch.setattr(
            threading.Thread, "start", Mock(side_effect=RuntimeError("cannot start new thread"))
        )
        for _ in range(70):
            with connect(tmp_path) as client:
                assert answer_of(client) == b""
    assert "request failed" in caplog.text
    assert json.loads(exchange(tmp_path, b"hello\n"))["ok"]


def test_connection_of_another_user_is_closed(server, tmp_path, monkeypatch):
    monkeypatch.setattr("hilctl.run.control.requests.is_same_user", lambda connection: False)
    with connect(tmp_path) as client:
        assert answer_of(client) == b""


def test_ask_returns_the_answer_or_raises(tmp_path):
    path = tmp_path / "socket"
    with serving(path, lambda line: echo(json.loads(line)["say"].encode())):
        assert ask(path, {"say": "hello"}) == {"heard": "hello"}
        with pytest.raises(InputError, match="not today"):
            ask(path, {"say": "refuse"})
    with pytest.raises(RunError, match="answer"):
        ask(path, {"say": "hello"})


def test_a_path_that_cannot_be_used_is_an_error(tmp_path):
    with pytest.raises(RunError, match="cannot listen"):
        ControlServer(tmp_path / ("x" * 200), echo)
    assert list(tmp_path.iterdir()) == []


def test_output_that_cannot_be_bypassed_is_reported():

    def refused(line=LinearBypass(), wanted="out", model=1, tracking_error_um=None):  # noqa: B008
        limits = SimpleNamespace(tracking_error_um=tracking_error_um)
        loaded = SimpleNamespace(model=model, config=SimpleNamespace(limits=limits))
        checked = SimpleNamespace(loaded=loaded, forecast=SimpleNamespace(line=line))
        return fade_refusal(checked, wanted)

    assert refused() == ""
    assert "no compensator" in refused(model=None)
    assert "constant" in refused(line=None)
    assert "limits.tracking_error_um" in refused(tracking_error_um=5.0)
    assert refused(wanted="in", tracking_error_um=5.0) == ""
