"""Who may look at a run: only who was given the address, with its token, from a page of this very server.

A server on one's own machine is within reach of every page in one's browser: pages of other sites may open web sockets to it
(no rule of the browser forbids that; the server must look at `Origin`), and a name of theirs may be made to point to it (DNS
rebinding; the server must look at `Host`). viser, which draws, looks at neither, and lets any client open a tunnel to a
relay on the internet.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

if TYPE_CHECKING:
    from viser import ViserServer

_STARTING = threading.Lock()


def is_known_host(header: str | None, host: str) -> bool:
    """Whether a `Host` names this machine: by address, as localhost, by its own name, or as it was told to listen.

    Names of others' domains may be made to point here; addresses may not.
    """
    if not header:
        return False
    try:
        name = urlsplit(f"//{header}").hostname
    except ValueError:
        return False
    if name is None:
        return False
    if name in ("localhost", host.lower(), socket.gethostname().lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class Guard:
    """Decides about requests.

    Args:
        host: address the server listens at.
        token: what requests must bring; a random one by default.
    """

    def __init__(self, host: str, token: str | None = None) -> None:
        self.host = host
        self.token = secrets.token_urlsafe(24) if token is None else token
        self.cookie = "nolbo-" + secrets.token_hex(4)

    def refusal(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Why a request is refused; None for one that is not.

        Args:
            path: path and query.
            headers: its headers.
        """
        header, origin = headers.get("Host"), headers.get("Origin")
        if not is_known_host(header, self.host):
            return "unknown host"
        if origin is not None and origin not in (f"http://{header}", f"https://{header}"):
            return "a page of another site"
        if not (self._is_token(self.token_of(path)) or self._is_token(self._stored(headers.get("Cookie", "")))):
            return "open the address that nolbo view prints, with its token"
        return None

    @staticmethod
    def token_of(path: str) -> str:
        """The token in a request's query."""
        return parse_qs(urlsplit(path).query).get("token", [""])[0]

    def grant(self, path: str) -> str | None:
        """The cookie that a page opened with the token is given, for what it loads afterwards."""
        if not self._is_token(self.token_of(path)):
            return None
        return f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self.token.encode())

    def _stored(self, header: str) -> str:
        try:
            found = SimpleCookie(header).get(self.cookie)
        except CookieError:
            return ""
        return "" if found is None else found.value

    def wrap(self, serve: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
        """`process_request` of the web server, behind the guard."""

        def process(connection: Any, request: Any) -> Any:
            try:
                reason = self.refusal(request.path, request.headers)
            except Exception:  # headers that name one thing twice, and other nonsense
                reason = "malformed request"
            if reason is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, reason + "\n")
            response = None if serve is None else serve(connection, request)
            cookie = self.grant(request.path)
            if response is not None:
                response.headers["Referrer-Policy"] = "no-referrer"
                if cookie is not None:
                    response.headers["Set-Cookie"] = cookie
            return response

        return process


def guarded_server(host: str, port: int, token: str | None = None) -> tuple[ViserServer, Guard]:
    """A viser server behind a guard, without a way out to a relay.

    viser has no option for either: the function that starts its web server is replaced while the server is made.

    Raises:
        InputError: viser is not installed.
    """
    import websockets.asyncio.server as web

    from nolbo_ppl.report.viewer import viser_module

    viser, guard, serve = viser_module(), Guard(host, token), web.serve

    def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        return serve(*arguments, process_request=guard.wrap(process_request), **options)

    with _STARTING:
        web.serve = guarded  # type: ignore[misc, assignment]
        try:
            server = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            web.serve = serve  # type: ignore[misc]
    shut_tunnel(server)
    return server, guard


def shut_tunnel(server: ViserServer) -> None:
    """Take away the request by which any client may publish the scene through a relay on the internet."""
    from viser import _messages

    server._websock_server.unregister_handler(_messages.ShareUrlRequest)
    server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign, assignment, misc]
    server.gui.configure_theme(show_share_button=False)
