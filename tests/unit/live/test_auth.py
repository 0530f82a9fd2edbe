"""Authentication of requests."""

import pytest
from websockets.datastructures import Headers

from hilctl.live.auth import PROTOCOL, Admission, PendingConnections

TOKEN = "0123456789abcdef" * 2
PORT = 4321
HOST, ORIGIN = f"127.0.0.1:{PORT}", f"http://127.0.0.1:{PORT}"
OFFER = f"{PROTOCOL}, token.{TOKEN}"


def refusal(upgrade=True, **given):
    headers = Headers()
    for name, values in given.items():
        for value in [values] if isinstance(values, str) else values:
            headers[name.replace("_", "-")] = value
    found = Admission(TOKEN).refusal(headers, upgrade=upgrade)
    return found and found[0].value


@pytest.mark.parametrize("host", [HOST, f"[::1]:{PORT}", f"localhost:{PORT}", "localhost:9000"])
def test_page_with_token_is_accepted(host):
    """On any port: an SSH tunnel may have another."""
    assert not refusal(Host=host, Origin=f"http://{host}", Sec_WebSocket_Protocol=OFFER)
    assert not refusal(upgrade=False, Host=host)


@pytest.mark.parametrize(
    "host", ["evil.example", f"evil.example:{PORT}", f"127.0.0.1.evil:{PORT}", [HOST, HOST], []]
)
@pytest.mark.parametrize("upgrade", [True, False])
def test_a_foreign_host_is_refused(host, upgrade):
    """DNS rebinding in particular."""
    assert refusal(upgrade, Host=host, Origin=ORIGIN, Sec_WebSocket_Protocol=OFFER) == 421


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", f"https://127.0.0.1:{PORT}", "http://127.0.0.1:1",
     [], [ORIGIN] * 2],
)  # fmt: skip
def test_a_foreign_origin_is_refused(origin):
    assert refusal(Host=HOST, Origin=origin, Sec_WebSocket_Protocol=OFFER) == 403


def test_foreign_page_gets_no_file():
    assert refusal(upgrade=False, Host=HOST, Origin="http://evil.example") == 403


WRONG = ("token.", f"token.{TOKEN[:-1]}", f"token.{TOKEN}0", f"token.{'0' * 32}, token.{TOKEN}")


@pytest.mark.parametrize(
    "offer", [[], PROTOCOL, "a b, ;", *(f"{PROTOCOL}, {token}" for token in (*WRONG, TOKEN))]
)
def test_missing_or_wrong_token_is_refused(offer):
    assert refusal(Host=HOST, Origin=ORIGIN, Sec_WebSocket_Protocol=offer) == 401


def test_oldest_pending_connection_is_aborted():
    pending, cut = PendingConnections(2), []
    for name in "abc":
        pending.add(name, lambda name=name: cut.append(name))
    assert cut == ["a"]
    pending.remove("b")
    pending.remove("x")
    pending.add("d", lambda: cut.append("d"))
    assert (cut, len(pending)) == (["a"], 2)
