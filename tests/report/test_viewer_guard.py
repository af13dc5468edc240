"""The viewer's guard: other sites, other names and strangers are refused; no client opens a tunnel."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator

import pytest

from nolbo_ppl.report.viewer_guard import Guard, guarded_server, is_known_host

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'nolbo-ppl[viewer]'")
TOKEN = "s3cret"


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[object, Guard]]:
    made, guard = guarded_server("127.0.0.1", 18_180, TOKEN)
    yield made, guard
    made.stop()


def ask(server: tuple[viser.ViserServer, Guard], path: str, **headers: str) -> tuple[int, http.client.HTTPMessage]:
    port = server[0].get_port()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request("GET", path, headers={"Host": f"localhost:{port}", **headers})
        answer = connection.getresponse()
        answer.read()
        return answer.status, answer.headers
    finally:
        connection.close()


SOCKET = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}


@pytest.mark.parametrize("upgrade", [{}, SOCKET])
def test_strangers_are_refused(server: tuple[viser.ViserServer, Guard], upgrade: dict[str, str]) -> None:
    port, good = server[0].get_port(), f"/?token={TOKEN}"
    cookie = f"{server[1].cookie}={TOKEN}"
    assert ask(server, "/", **upgrade)[0] == 403
    assert ask(server, "/?token=other", **upgrade)[0] == 403
    assert ask(server, good, **upgrade, Host=f"evil.example:{port}")[0] == 403
    assert ask(server, good, **upgrade, Origin="http://evil.example")[0] == 403
    assert ask(server, "/", **upgrade, Cookie=cookie, Origin="null")[0] == 403
    assert ask(server, "/", **upgrade, Cookie=f"{server[1].cookie}=x")[0] == 403
    expected = 101 if upgrade else 200
    assert ask(server, good, **upgrade)[0] == expected
    assert ask(server, "/", **upgrade, Cookie=cookie, Origin=f"http://localhost:{port}")[0] == expected


def test_the_page_is_given_a_cookie_of_this_site_alone(server: tuple[viser.ViserServer, Guard]) -> None:
    _, headers = ask(server, f"/?token={TOKEN}")
    assert headers["Set-Cookie"] == f"{server[1].cookie}={TOKEN}; Path=/; HttpOnly; SameSite=Strict"
    assert headers["Referrer-Policy"] == "no-referrer"
    _, headers = ask(server, "/", Cookie=f"{server[1].cookie}={TOKEN}")
    assert headers["Set-Cookie"] is None


def test_no_client_opens_a_tunnel(server: tuple[viser.ViserServer, Guard]) -> None:
    from viser import _messages

    assert _messages.ShareUrlRequest not in server[0]._websock_server._incoming_handlers
    assert server[0].request_share_url() is None
    plain = viser.ViserServer(host="127.0.0.1", port=18_280, verbose=False)  # the name still means what is taken away
    try:
        assert _messages.ShareUrlRequest in plain._websock_server._incoming_handlers
    finally:
        plain.stop()


def test_other_servers_are_left_alone(server: tuple[viser.ViserServer, Guard]) -> None:
    import websockets.asyncio.server

    assert websockets.asyncio.server.serve.__module__ == "websockets.asyncio.server"


def test_names_of_this_machine() -> None:
    for header in ("localhost:80", "127.0.0.1", "[::1]:8080", "192.168.0.3:8080", socket.gethostname(), "robot.local:8080"):
        assert is_known_host(header, "robot.local"), header
    for header in (None, "", "evil.example", "localhost.evil.example:80", "127.0.0.1.evil.example", "[x", ":80"):
        assert not is_known_host(header, "127.0.0.1"), header


def test_tokens_differ_and_odd_requests_are_refused() -> None:
    first, second = Guard("127.0.0.1"), Guard("127.0.0.1")
    assert first.token != second.token and len(first.token) >= 32
    headers = {"Host": "localhost"}
    assert first.refusal(f"/?token={first.token}", headers) is None
    assert first.refusal(f"/?token={second.token}", headers) is not None
    for cookie in ("", ";;;", "a=b; =", f"{first.cookie}=\u00e4"):
        assert first.refusal("/", {**headers, "Cookie": cookie}) is not None
