"""The server of the live page on loopback."""

import asyncio
import json
import os
import re
import shutil
import socket
import subprocess
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from unittest.mock import Mock

import pytest
from websockets.asyncio.client import connect
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus

from hilctl.base.errors import InputError
from hilctl.live import server as module
from hilctl.live.server import (
    FILES,
    MOST_PENDING,
    PROTOCOL,
    SLOW_S,
    LiveServer,
    PageSession,
    PageView,
    file_response,
    refusal,
)
from tests.fakes import SteppingClock
from tests.unit.live.conftest import CONFIGS, active_axes, active_run, exchange, first


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    """Send a status every 30 ms instead of 200 ms."""
    monkeypatch.setattr(module, "_FRAME_S", 0.005)


@asynccontextmanager
async def serving(chosen=first):
    server, over = LiveServer(chosen), asyncio.Event()
    task = asyncio.create_task(server.run(lambda _: over.is_set()))
    await asyncio.sleep(0.05)
    try:
        yield server
    finally:
        over.set()
        await task


def opened(server, *, token=None, origin=None, host="127.0.0.1"):
    token = server.url.partition("#")[2] if token is None else token
    return connect(
        f"ws://{host}:{server.port}/live",
        origin=origin or f"http://{host}:{server.port}",
        subprotocols=["hilctl.live.1", f"token.{token}"],
        proxy=None,
    )


async def status_of(connection):
    while True:
        message = await connection.recv()
        if isinstance(message, str) and (said := json.loads(message))["kind"] == "status":
            return said


async def answer_to(connection, **message):
    await connection.send(json.dumps({"id": 7, **message}))
    while True:
        said = await connection.recv()
        if isinstance(said, str) and json.loads(said)["kind"] == "answer":
            return json.loads(said)


async def http(server, line, host=None):
    """Return the status and the answer to a request."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    host = host or f"127.0.0.1:{server.port}"
    writer.write(f"{line} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    answer = (await reader.read()).decode()
    writer.close()
    await writer.wait_closed()
    return int(answer.split()[1]), answer


def test_page_gets_frames_and_status(description, tmp_path):
    async def seen():
        async with serving() as server, opened(server) as connection:
            assert connection.subprotocol == "hilctl.live.1"
            status = await status_of(connection)
            while isinstance(frame := await connection.recv(), str):
                pass
            return status, frame

    with active_run(description, tmp_path) as (folder, _):
        status, frame = asyncio.run(seen())
        assert (status["run"], status["state"]) == (folder.card.name, "running")
    assert b'"signals": 6' in frame


def test_page_gets_the_axis_and_the_path_of_its_view(description, tmp_path):
    async def seen(ring):
        async with serving() as server, opened(server) as connection:
            await status_of(connection)
            exchange(ring, range(4), spike_um=5.0)
            view = {"axis": "y", "across": "y", "up": "x", "path_s": 0.1}
            assert (await answer_to(connection, ask="view", view=view))["ok"]
            while (status := await status_of(connection))["axis"] != "y":
                pass
            while isinstance(frame := await connection.recv(), str):
                pass
            assert (await answer_to(connection, ask="reset"))["ok"]
            while (after := await status_of(connection))["peak_error"]["um"] is not None:
                pass
            return status, frame, after

    with active_axes(description, tmp_path) as (_, rings):
        status, frame, after = asyncio.run(asyncio.wait_for(seen(rings[1]), 20.0))
    assert (status["axes"], status["peak_error"]["um"]) == (["x", "y"], 5.0)
    assert b'"path": 0' not in frame
    assert after["peak_error"]["since_s"] == pytest.approx(200 / 50e3)


@pytest.mark.slow
def test_report_is_served_to_the_page_that_asked_for_it(description, tmp_path, monkeypatch):
    """It executes nothing of the working folder."""
    (tmp_path / "hilctl.py").write_text("raise SystemExit(7)", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    recording = tmp_path / "a.mcap"
    shutil.copy(CONFIGS.parent / "recordings" / "golden" / "terfenol_compensated.mcap", recording)

    async def run():
        async with serving() as server, opened(server) as connection:
            await status_of(connection)
            answer = await answer_to(connection, ask="report")
            served = await http(server, f"GET {answer['path']}", host="localhost:1")
            recording.unlink()
            return served, await answer_to(connection, ask="report")

    with active_run(description, tmp_path):
        (status, page), refused = asyncio.run(run())
    assert status == 200
    assert "default-src 'none'" in page
    assert "<svg" in page
    assert not refused["ok"]
    assert str(recording) in refused["error"]


def test_page_without_a_run():
    async def seen():
        async with serving() as server, opened(server) as connection:
            return await status_of(connection), await answer_to(connection, ask="stop")

    status, answer = asyncio.run(seen())
    assert "run" not in status
    assert not answer["ok"]


def test_unauthenticated_upgrades_are_refused():
    async def refusals():
        found = []
        async with serving() as server:
            for given in ({"token": "0" * 32}, {"token": ""}, {"origin": "http://evil.example"}):
                with pytest.raises(InvalidStatus) as refused:
                    await opened(server, **given)
                found.append(refused.value.response.status_code)
            status, answer = await http(server, "GET /", "evil.example")
            found.append(status)
            assert server.url.partition("#")[2] not in answer
            async with opened(server) as connection:  # others are still accepted
                await status_of(connection)
        return found

    assert asyncio.run(refusals()) == [401, 401, 403, 421]


def test_only_get_requests_of_files_are_served():
    async def answers():
        async with serving() as server:
            lines = ("GET /", "GET /?run=x", "GET /live", "POST /", "PUT /live.js", "GET /etc")
            return [(await http(server, line))[0] for line in lines]

    assert asyncio.run(answers()) == [200, 200, 403, 405, 405, 404]


def test_a_message_that_is_too_long_ends_its_connection_only():
    async def sent():
        async with serving() as server, opened(server) as other:
            async with opened(server) as connection:
                with suppress(ConnectionClosed):
                    await connection.send("x" * 1_000_000)
                await connection.wait_closed()
            await status_of(other)
            return connection.close_code

    assert asyncio.run(sent()) == 1009


def test_silent_connections_are_bounded():
    async def crowded():
        async with serving() as server:
            address = ("127.0.0.1", server.port)
            crowd = [(await asyncio.open_connection(*address))[1] for _ in range(100)]
            try:
                await asyncio.sleep(0.2)
                waiting = len(server._pending)
                async with asyncio.timeout(5), opened(server) as connection:
                    await status_of(connection)
            finally:
                for each in crowd:
                    each.close()
            return waiting

    assert asyncio.run(crowded()) == MOST_PENDING


def test_both_addresses_of_loopback_are_served():
    async def seen():
        async with serving() as server:
            if len(server._sockets) < 2:
                pytest.skip("this machine has no IPv6")
            async with opened(server, host="[::1]") as connection:
                return await status_of(connection)

    assert asyncio.run(seen())["kind"] == "status"


def test_port_in_use_is_an_error():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match="in use"):
            LiveServer(lambda runs: None, port)


@pytest.mark.parametrize("path", FILES)
def test_each_file_has_its_headers(path):
    response = file_response(path)
    assert response.status_code == 200
    assert len(response.body) == int(response.headers["Content-Length"]) > 100
    assert response.headers["Content-Security-Policy"].startswith("default-src 'self';")
    assert response.headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize("path", ["/x", "/../live.js", "/page/live.js", "", "//", "/live.js/"])
def test_nothing_else_is_served(path):
    assert file_response(path).status_code == 404


def test_page_has_no_external_address_and_no_inline_script():
    """It works offline and with a strict content security policy."""
    page = file_response("/").body.decode()
    script = file_response("/live.js").body.decode()
    assert not re.findall(r"""(?:https?:)?//[a-z0-9]""", page)
    assert not re.findall(r"""["'`](?:https?:)?//""", script)
    assert not re.findall(r"<script>|<style|style=|\son\w+=", page)
    assert "innerHTML" not in script
    asked = set(re.findall(r'(?:href|src)="([^"]+)"', page))
    assert {f"/{name}" for name in asked} == FILES.keys() - {"/"}
    ids = set(re.findall(r'id="([^"]+)"', page))
    assert set(re.findall(r'\$\("([^"]+)"\)', script)) <= ids


TOKEN = "0123456789abcdef" * 2
PORT = 4321
HOST, ORIGIN = f"127.0.0.1:{PORT}", f"http://127.0.0.1:{PORT}"
OFFER = f"{PROTOCOL}, token.{TOKEN}"


def refused(upgrade=True, **given):
    headers = Headers()
    for name, values in given.items():
        for value in [values] if isinstance(values, str) else values:
            headers[name.replace("_", "-")] = value
    found = refusal(headers, TOKEN, upgrade=upgrade)
    return found and found[0].value


@pytest.mark.parametrize("host", [HOST, f"[::1]:{PORT}", f"localhost:{PORT}", "localhost:9000"])
def test_page_with_token_is_accepted(host):
    """On any port: an SSH tunnel may have another."""
    assert not refused(Host=host, Origin=f"http://{host}", Sec_WebSocket_Protocol=OFFER)
    assert not refused(upgrade=False, Host=host)


@pytest.mark.parametrize(
    "host", ["evil.example", f"evil.example:{PORT}", f"127.0.0.1.evil:{PORT}", [HOST, HOST], []]
)
@pytest.mark.parametrize("upgrade", [True, False])
def test_a_foreign_host_is_refused(host, upgrade):
    """DNS rebinding in particular."""
    assert refused(upgrade, Host=host, Origin=ORIGIN, Sec_WebSocket_Protocol=OFFER) == 421


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        f"https://127.0.0.1:{PORT}",
        "http://127.0.0.1:1",
        [],
        [ORIGIN] * 2,
    ],
)
def test_a_foreign_origin_is_refused(origin):
    assert refused(Host=HOST, Origin=origin, Sec_WebSocket_Protocol=OFFER) == 403


WRONG = ("token.", f"token.{TOKEN[:-1]}", f"token.{TOKEN}0", f"token.{'0' * 32}, token.{TOKEN}")


@pytest.mark.parametrize(
    "offer", [[], PROTOCOL, "a b, ;", *(f"{PROTOCOL}, {token}" for token in (*WRONG, TOKEN))]
)
def test_missing_or_wrong_token_is_refused(offer):
    assert refused(Host=HOST, Origin=ORIGIN, Sec_WebSocket_Protocol=offer) == 401


class Connection:
    """A connection that receives the given messages and blocks while ``free`` is unset."""

    def __init__(self, *messages):
        self.messages, self.sent, self.closed = list(messages), [], None
        self.transport = Mock()
        self.free = asyncio.Event()
        self.free.set()

    async def __aiter__(self):
        for message in self.messages:
            if self.closed:
                return
            yield message

    async def send(self, message):
        await self.free.wait()
        self.sent.append(message)

    async def close(self, code, reason):
        self.closed = (code, reason)


async def answer(viewer, message):
    return f"{message.id} {message.ask}"


def message(**fields):
    return json.dumps({"id": 1, "ask": "view"} | fields)


def served(*messages):
    """Return a session that has received messages at one time, and its connection."""

    async def exchanged():
        connection = Connection(*messages)
        viewer = PageSession(connection, answer, clock=lambda: 0.0)
        await viewer.serve()
        return viewer, connection

    return asyncio.run(exchanged())


def test_messages_are_answered_and_change_the_view():
    view = {"run": "a", "mode": "roll", "window_s": 10.0}
    viewer, connection = served(message(view=view), message(id=2, ask="stop"))
    assert viewer.view == PageView(**view)
    assert connection.sent == ["1 view", "2 stop"]


def test_invalid_message_ends_the_connection():
    for raw in ("", "{}", b"\xff\x00", message(ask="format"), message(more=1), message(id="1")):
        _, connection = served(raw, message(id=2))
        assert (connection.closed[0], connection.sent) == (1008, [])


@pytest.mark.parametrize("half", [r"\ud83d", r"\uDE00", r"\ud83dx", r"\ud83d\u0041"])
def test_half_a_character_is_refused_without_effect(half):
    """A browser cuts a mark at its greatest length in the middle of a character."""
    mark = f'{{"id": 5, "ask": "run", "request": {{"command": "mark", "text": "{half}"}}}}'
    _, connection = served(mark, message(id=6, ask="stop"))
    assert connection.closed is None
    refused = json.loads(connection.sent[0])
    assert (refused["id"], refused["ok"]) == (5, False)
    assert "half a character" in refused["error"]
    assert connection.sent[1] == "6 stop"


def test_stop_waits_for_no_other_request():
    """A change waits for the one before it, and a report for its process."""

    async def exchanged():
        done = asyncio.Event()
        messages = asyncio.Queue()

        async def slow_answer(viewer, message):
            if message.ask != "stop":
                await done.wait()
            return f"{message.id} {message.ask}"

        class Open(Connection):
            async def __aiter__(self):
                while True:
                    yield await messages.get()

        connection = Open()
        serving = asyncio.create_task(PageSession(connection, slow_answer).serve())
        for number in range(30):
            messages.put_nowait(message(id=number, ask="run"))
        messages.put_nowait(message(id=99, ask="stop"))
        while "99 stop" not in connection.sent:
            await asyncio.sleep(0)
        early = list(connection.sent)
        done.set()
        while "15 run" not in connection.sent:
            await asyncio.sleep(0)
        serving.cancel()
        return early, connection.sent[len(early) :]

    early, later = asyncio.run(asyncio.wait_for(exchanged(), 20.0))
    assert early[-1] == "99 stop"
    assert [json.loads(each)["ok"] for each in early[:-1]] == [False] * len(early[:-1])
    assert len(early) > 5  # the number of waiting requests is limited
    assert later == [f"{number} run" for number in range(len(later))]


@pytest.fixture
def reports(monkeypatch):
    """Commands in place of the one that makes a report, and the processes of them."""
    commands, made = [], []
    start = asyncio.create_subprocess_exec

    async def started(*command, **options):
        made.append((command, await start(*commands.pop(0)(command), **options)))
        return made[-1][1]

    monkeypatch.setattr(asyncio, "create_subprocess_exec", started)
    return commands, made


def written(command):
    return ["sh", "-c", f"echo {len(command)} > '{command[-1]}'"]


def slow(command):
    return ["sleep", "60"]


def test_report_has_a_time_limit(reports, monkeypatch):
    commands, made = reports
    commands += [slow, written]
    monkeypatch.setattr(module, "_REPORT_S", 0.05)

    async def asked():
        async with serving() as server:
            with pytest.raises(InputError, match="hilctl report"):
                await server._report(Path("a.mcap"))
            assert made[0][1].returncode is not None
            monkeypatch.setattr(module, "_REPORT_S", 20.0)
            assert await server._report(Path("a.mcap")) in server._reports

    asyncio.run(asked())


def test_one_report_is_made_at_a_time(reports):
    commands, made = reports
    commands += [slow, written]

    async def asked():
        async with serving() as server:
            going = asyncio.create_task(server._report(Path("a.mcap")))
            while not made:
                await asyncio.sleep(0.01)
            with pytest.raises(InputError, match="another report"):
                await server._report(Path("b.mcap"))
            going.cancel()  # as when its page is closed
            with suppress(asyncio.CancelledError):
                await going
            assert made[0][1].returncode is not None
            return await server._report(Path("b.mcap"))

    assert asyncio.run(asked()).startswith("/report/")


def test_the_newest_reports_are_kept(reports):
    commands, _ = reports
    commands += [written] * 9

    async def asked():
        async with serving() as server:
            paths = [await server._report(Path("a.mcap")) for _ in range(9)]
            return paths, list(server._reports)

    paths, kept = asyncio.run(asked())
    assert 0 < len(kept) < 9
    assert kept == paths[-len(kept) :]


BAD_TIMES = ("0", "-0.0", "-1", "1e-320", "1e308", "NaN", "Infinity", "1e999", "true", '"2"', "[]")


@pytest.mark.parametrize("value", [*BAD_TIMES, "null", "1" + "0" * 400])
def test_invalid_window_is_refused_without_effect(value):
    raw = f'{{"id": 5, "ask": "view", "view": {{"window_s": {value}}}}}'
    viewer, connection = served(raw, message(id=6, ask="stop"))
    assert viewer.view == PageView()
    assert connection.closed is None
    refused = json.loads(connection.sent[0])
    assert (refused["kind"], refused["id"], refused["ok"]) == ("answer", 5, False)
    assert refused["error"].startswith("window_s: ")
    assert connection.sent[1] == "6 stop"


def test_slow_page_gets_the_newest_frame_and_is_disconnected():
    async def slow():
        clock, connection = SteppingClock(), Connection()
        viewer = PageSession(connection, answer, clock)
        connection.free.clear()
        viewer.offer("status", b"old")
        await asyncio.sleep(0)
        assert not viewer.ready
        connection.free.set()
        await asyncio.sleep(0.01)
        assert viewer.ready
        assert connection.sent == ["status", b"old"]
        connection.free.clear()
        viewer.offer(b"new")
        clock.now = SLOW_S - 0.1
        assert not viewer.ready
        assert not connection.transport.abort.called
        clock.now = SLOW_S + 0.1
        assert not viewer.ready
        assert connection.transport.abort.called
        connection.free.set()
        await asyncio.sleep(0.01)

    asyncio.run(slow())


NODE = shutil.which("node")
PAGE = Path(module.__file__).with_name("page") / "live.js"
HARNESS = Path(__file__).with_name("page.mjs")


def page_after(*steps):
    """Return what the page shows after each step, and the messages that it has sent."""
    if NODE is None:
        assert "CI" not in os.environ
        pytest.skip("node is not installed")
    words = [NODE, str(HARNESS), str(PAGE)]
    given = json.dumps([{"open": True}, *steps])
    ran = subprocess.run(words, input=given, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    answer = json.loads(ran.stdout)
    return answer["found"][1:], answer["sent"]


def status_at(description, run, *others, state="running", **more):
    """Return a status of the server while other runs are active."""
    active = [{"name": name} for name in (run, *others)]
    values = {"ended": False, "reason": "", "safe": None, "t_s": 1.0, "total_s": 2.0} | more
    lists = {"figures": {}, "aux": [], "gauges": [], "events": [], "lateness_us": {}}
    return {"status": {
        "run": run, "runs": active, "state": state, "segment": "", "recording": "a.mcap",
        "disk": None, "ring_used": 0.0, "missed_samples": 0, "gain": 1.0, "offset": 0.0,
        "inverse": "in", "axis": "", "axes": [], "peak_error": {"um": None, "since_s": 0.0},
        "description": description.model_dump(mode="json"), **lists, **values,
    }}  # fmt: skip


def ended(description, run, *others, safe=True):
    end = {"state": "completed", "ended": True, "reason": "waveform completed", "safe": safe}
    return status_at(description, run, *others, **end)


def test_end_of_a_run_is_not_shown_with_the_next_run(description):
    """Its notices, its answers and its frozen scope are those of one run."""
    shown, sent = page_after(
        ended(description, "sine-1"),
        {"click": "freeze"},
        status_at(description, "sine-2"),
        {"click": "stop"},
        {"answer": {"ok": True, "requested": True, "run": "sine-2"}},
        status_at(description, "sine-3"),
    )
    first, _, second, asked, stopping, third = shown
    assert (first["kind"], first["badge"]) == ("good", "completed")
    assert "sine-1" in first["notice"]
    assert (second["notice"], second["badge"], second["frozen"]) == ("", "running", False)
    assert second["title"] == "running · sine-2"
    assert sent[-1]["ask"] == "stop"
    assert "sine-2" in stopping["notice"]
    assert "✓" in stopping["stop"]
    assert asked["notice"]
    assert (third["notice"], "✓" in third["stop"]) == ("", False)


def test_answer_on_a_run_is_not_shown_with_the_next_run(description):
    shown, _ = page_after(
        status_at(description, "sine-1"),
        {"click": "stop"},
        status_at(description, "sine-2"),
        {"answer": {"ok": True, "requested": True, "run": "sine-1"}},
    )
    assert (shown[-1]["notice"], "✓" in shown[-1]["stop"]) == ("", False)


def test_refused_stop_is_always_shown(description):
    shown, _ = page_after(
        status_at(description, "sine-1"),
        {"click": "stop"},
        status_at(description, "sine-2"),
        {"answer": {"ok": False, "error": "no supervisor"}},
    )
    assert "no supervisor" in shown[-1]["notice"]
    assert shown[-1]["kind"] == "bad"


def test_requests_name_the_run_that_the_page_shows(description):
    _, sent = page_after(status_at(description, "sine-1"), {"click": "report"})
    assert (sent[-1]["ask"], sent[-1]["run"]) == ("report", "sine-1")


def test_report_that_fails_stays_on_the_page(description):
    shown, _ = page_after(
        ended(description, "sine-1"),
        {"click": "report"},
        {"answer": {"ok": False, "error": "no recording"}},
        ended(description, "sine-1"),
        status_at(description, "sine-2"),
    )
    assert "no recording" in shown[-2]["notice"]
    assert shown[-1]["notice"] == ""


def test_end_of_a_run_names_the_runs_that_are_active(description):
    """They may drive the same output."""
    (shown,), _ = page_after(ended(description, "sine-1", "sine-2"))
    assert "sine-2" in shown["notice"]
    assert shown["kind"] == "calm"


@pytest.mark.parametrize("loss", [{"close": True}, {"wait_ms": 5000}])
def test_end_without_a_connection_is_not_a_present_state(description, loss):
    """A server that has ended, or hangs, shows no later run."""
    shown, _ = page_after(ended(description, "sine-1"), loss, ended(description, "sine-1"))
    assert [each["kind"] for each in shown] == ["good", "calm", "good"]
    assert shown[1]["badge"] not in {"completed", ""}
    assert shown[1]["title"] != shown[0]["title"]


def test_unsafe_end_stays_bad(description):
    shown, _ = page_after(ended(description, "sine-1", "sine-2", safe=False), {"close": True})
    assert [each["kind"] for each in shown] == ["bad", "bad"]


def test_page_without_a_run_shows_nothing_of_the_last_one(description):
    """As after a reconnect, when the server no longer knows the run."""
    gone = {"status": {"runs": [{"name": "sine-2"}]}}
    shown, _ = page_after(
        ended(description, "sine-1"), {"close": True}, gone, status_at(description, "sine-2")
    )
    assert (shown[-2]["notice"], shown[-2]["main"], shown[-2]["name"]) == ("", False, "hilctl")
    assert shown[-1]["main"]


def test_status_of_a_run_precedes_its_first_frame(description, tmp_path, monkeypatch):
    """Otherwise the page draws a run below the end of the one before."""
    monkeypatch.setattr(module, "_STATUS_FRAMES", 10**9)

    async def shown():
        async with serving() as server, opened(server) as connection:
            names = [(await status_of(connection)).get("run")]
            with active_run(description, tmp_path) as (folder, _):
                server._feeds.update(1e12)
                while isinstance(message := await connection.recv(), bytes):
                    assert names[-1]
                names.append(json.loads(message)["run"])
                assert isinstance(await connection.recv(), bytes)
                return names, folder.card.name

    names, name = asyncio.run(shown())
    assert names == [None, name]


def test_request_concerns_the_named_run(description, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "ask", lambda path, *_: asked.append(path) or {})

    async def answers():
        async with serving() as server, opened(server) as connection:
            await status_of(connection)
            named = await answer_to(connection, ask="run", run=second.card.name)
            return named, await answer_to(connection, ask="run", run="sine-0")

    with active_run(description, tmp_path), active_run(description, tmp_path) as (second, _):
        named, unknown = asyncio.run(answers())
    assert (named["ok"], unknown["ok"]) == (True, False)
    assert asked == [second.socket]


def test_stop_without_a_supervisor_is_refused_with_its_reason(description, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "request_stop", lambda run: False)

    async def pressed():
        async with serving() as server, opened(server) as connection:
            await status_of(connection)
            return await answer_to(connection, ask="stop")

    with active_run(description, tmp_path):
        answer = asyncio.run(pressed())
    assert not answer["ok"]
    assert "supervisor" in answer["error"]


def test_page_of_several_axes_shows_a_path_and_changes_the_axis_shown(description):
    x, y = (
        status_at(description, "stage-1", axis=axis, axes=["x", "y", "z"]) for axis in ("x", "y")
    )
    clicks = [{"click": "inverse-out"}, y, {"click": "inverse-out"}, {"click": "reset"}]
    _, sent = page_after(x, *clicks)
    views = [each["view"] for each in sent if each["ask"] == "view"]
    assert (views[-1]["across"], views[-1]["up"]) == ("x", "y")
    requests = [each["request"] for each in sent if each["ask"] == "run"]
    assert [each["axes"] for each in requests] == [
        {"x": {"inverse": "out"}},
        {"y": {"inverse": "out"}},
    ]
    assert sent[-1]["ask"] == "reset"


def test_page_of_coupled_axes_changes_all(description):
    coupled = description.model_copy(update={"coupled": True})
    status = status_at(coupled, "stage-1", axis="x", axes=["x", "y"])
    _, sent = page_after(status, {"click": "inverse-out"})
    (request,) = (each["request"] for each in sent if each["ask"] == "run")
    assert "axes" not in request


def test_page_of_one_axis_has_no_path_and_names_no_axis(description):
    _, sent = page_after(status_at(description, "sine-1"), {"click": "inverse-out"})
    assert {each["view"]["across"] for each in sent if each["ask"] == "view"} == {""}
    (request,) = (each["request"] for each in sent if each["ask"] == "run")
    assert "axes" not in request
