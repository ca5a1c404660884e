"""Who may talk to the server: Host, Origin, token, and what the page itself may load.

viser has none of this. The rules are plain functions of a request, so they are tested without a server; `server.py`
puts them in front of viser's own.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import logging
import re
import secrets
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlencode, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

log = logging.getLogger(__name__)

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")


@dataclass(frozen=True)
class RouteRequest:
    """A GET for one of the studio's own routes; the session has been checked already.

    Attributes:
        path: Without the query; starts with ``/``.
        query: The query's values by name, the last one of each.
    """

    path: str
    query: dict[str, str]


RouteReply = tuple[int, str, bytes]
"""Status, content type, body."""

Route = Callable[[RouteRequest], RouteReply]


class Guard:
    """The policy in front of every HTTP request and websocket handshake of one server.

    Args:
        token: The secret of the link; None makes one.
        allowed_hosts: Names under which the server may be addressed besides loopback. They are also accepted exactly
            as given, for a proxy in front: ``forest.example``, ``forest.example:8443``.
        any_address: Also accept any numeric address: a numeric Host cannot come from DNS rebinding.

    Attributes:
        routes: The studio's own pages by path; a path that ends in ``/`` answers everything below it. They run on the
            event loop and must be quick.
        denied: The last refusals, in words, for the log and the tests.
    """

    def __init__(
        self, *, token: str | None = None, allowed_hosts: tuple[str, ...] = (), any_address: bool = False
    ) -> None:
        if token is not None and not _TOKEN.fullmatch(token):
            raise ValueError("a token is 16 to 128 letters, digits, '-' and '_'")
        self.token = token or secrets.token_urlsafe(24)
        # Not the token itself, so that what a browser stores is useless in a link.
        self._session = secrets.token_urlsafe(24)
        self._exact_hosts = {name.lower() for name in allowed_hosts}
        self._names = {*LOOPBACK_NAMES, *self._exact_hosts}
        self._any_address = any_address
        self._port: int | None = None
        self.routes: dict[str, Route] = {}
        self.denied: deque[str] = deque(maxlen=100)

    def open(self, port: int) -> None:
        """Start answering. Until then every request is turned away: the message checks are not in place yet."""
        self._port = port

    @property
    def cookie_name(self) -> str:
        """Browsers share cookies between the ports of a host, so two running studios need two names."""
        return f"dbh_studio_{self._port}"

    # -- the rules --------------------------------------------------------------------------------------------------

    def check(self, request: Request) -> Response | None:
        """Answer a request, or None to let viser serve it."""
        if self._port is None:
            return _text(http.HTTPStatus.SERVICE_UNAVAILABLE, "The studio is starting.")
        try:
            return self._check_open(request)
        except ValueError as error:  # an address that cannot be parsed
            return self._deny(http.HTTPStatus.BAD_REQUEST, f"malformed request: {error}")

    def _check_open(self, request: Request) -> Response | None:
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._is_own_host(hosts[0]):
            return self._deny(http.HTTPStatus.MISDIRECTED_REQUEST, f"unknown host {hosts!r}")
        host = hosts[0]
        origins = request.headers.get_all("Origin")
        if not all(_is_same_origin(origin, host) for origin in origins):
            return self._deny(http.HTTPStatus.FORBIDDEN, f"cross-origin request from {origins!r}")
        url = urlsplit(request.path)
        query = parse_qsl(url.query, keep_blank_values=True)
        # The page would load what these point to and run the JavaScript in it.
        for name, value in query:
            if name.lower() in ("websocket", "playbackpath") and not _is_same_place(value, host):
                return self._deny(http.HTTPStatus.BAD_REQUEST, f"foreign ?{name}= in the link")
        if any(name == "token" and _equal(value, self.token) for name, value in query):
            return self._log_in(query)
        if not self._has_session(request):
            return self._deny(http.HTTPStatus.UNAUTHORIZED, "Open DBH Studio with the full link that it printed.")
        if request.headers.get_all("Upgrade"):
            return None
        return self._serve_route(url.path, dict(query))

    def add_headers(self, request: Request, response: Response) -> Response:
        """Tell the browser what this page may load and who may frame it."""
        hosts = request.headers.get_all("Host")
        host = hosts[0] if len(hosts) == 1 and self._is_own_host(hosts[0]) else "localhost"
        response.headers["Content-Security-Policy"] = content_security_policy(host)
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        if "Cache-Control" not in response.headers:
            response.headers["Cache-Control"] = "no-store"
        return response

    def _is_own_host(self, host: str) -> bool:
        host = host.lower()
        name = host.removesuffix(f":{self._port}")
        if name == host and self._port != 80:
            return host in self._exact_hosts
        return name in self._names or (self._any_address and _is_address(name.strip("[]")))

    def _has_session(self, request: Request) -> bool:
        # Split by hand: `http.cookies` gives up at the first cookie it does not like, which may be another program's.
        for header in request.headers.get_all("Cookie"):
            for cookie in header.split(";"):
                name, _, value = cookie.strip().partition("=")
                if name == self.cookie_name and _equal(value, self._session):
                    return True
        return False

    def _log_in(self, query: list[tuple[str, str]]) -> Response:
        """Turn the token of the link into a cookie, and take it out of the address bar."""
        rest = urlencode([(name, value) for name, value in query if name != "token"])
        response = _text(http.HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = f"/?{rest}" if rest else "/"
        response.headers["Set-Cookie"] = f"{self.cookie_name}={self._session}; Path=/; HttpOnly; SameSite=Strict"
        return response

    def _serve_route(self, path: str, query: dict[str, str]) -> Response | None:
        route = self.routes.get(path)
        if route is None:
            folders = [p for p in self.routes if p.endswith("/") and p != "/" and path.startswith(p)]
            route = self.routes[max(folders, key=len)] if folders else None
        if route is None:
            return None
        try:
            status, content_type, body = route(RouteRequest(path, query))
        except Exception:
            log.exception("The page %s could not be made", path)
            return _text(http.HTTPStatus.INTERNAL_SERVER_ERROR, "Unexpected error; see the program's log.")
        return _reply(http.HTTPStatus(status), content_type, body)

    def _deny(self, status: http.HTTPStatus, reason: str) -> Response:
        self.denied.append(reason)
        log.warning("Refused a request: %s", reason)
        return _text(status, reason)


def content_security_policy(host: str) -> str:
    """What viser's page needs and nothing more; naming one websocket address is what keeps data from leaving.

    CSP has no syntax for numeric IPv6 addresses; there ``'self'`` has to do.
    """
    socket = "" if host.startswith("[") else f" ws://{host} wss://{host}"
    return (
        "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src blob:; child-src blob:; "
        "style-src 'self' 'unsafe-inline'; font-src 'self' data:; img-src 'self' data: blob:; "
        "media-src 'self' data: blob:; "
        f"connect-src 'self' data: blob:{socket}; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'; object-src 'none'"
    )


def _is_same_origin(origin: str, host: str) -> bool:
    parts = urlsplit(origin)
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


def _is_same_place(address: str, host: str) -> bool:
    """Whether a browser would read `address` as one on `host`; odd spellings are refused, not interpreted."""
    if re.search(r"[\s\\\x00-\x1f@]", address):
        return False
    parts = urlsplit(address)
    return parts.scheme.lower() in ("ws", "wss", "http", "https") and parts.netloc.lower() == host.lower()


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _equal(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode(), secret.encode())


def _text(status: http.HTTPStatus, text: str) -> Response:
    return _reply(status, "text/plain; charset=utf-8", text.encode())


def _reply(status: http.HTTPStatus, content_type: str, body: bytes) -> Response:
    headers = Headers({"Content-Type": content_type, "Content-Length": str(len(body))})
    return Response(status.value, status.phrase, headers, body)
