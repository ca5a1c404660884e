"""Start viser so that it is safe by default.

Stock viser 1.1.1 listens on every address, asks for no login, answers any web page and lets any page drive it. Here it
listens on loopback, wants the token of its link, and checks every message (`guard.py`, `messages.py`). The hooks used
for this are private, hence the exact pin (docs/decisions/0004).
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import rich
import viser
import websockets.asyncio.server as websocket_server
from websockets.http11 import Request, Response

from dbh_studio.errors import MissingComponentError, StudioError
from dbh_studio.ui.guard import Guard, Route
from dbh_studio.ui.messages import MessageGate
from dbh_studio.ui.uploads import DEFAULT_MAX_UPLOAD_BYTES, UploadDesk

log = logging.getLogger(__name__)

VISER_VERSION = "1.1.1"
_LOOPBACK = ("127.0.0.1", "::1")
_ANY_ADDRESS = ("0.0.0.0", "::", "")
_N_PORTS_TRIED = 50
_patching = threading.Lock()


@dataclass(frozen=True, eq=False)
class StudioServer:
    """A running server.

    Attributes:
        viser: The wrapped server: scene, panel and tabs.
        guard: Who may talk to it.
        url: The link to open, with its token. Whoever has it may use the studio.
        port: Where it listens.
        note: What the person should know about the address, or empty: the port was taken, other machines may connect.
    """

    viser: viser.ViserServer
    guard: Guard
    url: str
    port: int
    note: str
    _uploads: UploadDesk

    @property
    def routes(self) -> dict[str, Route]:
        """The studio's own pages on the same port: path -> callable(`RouteRequest`) -> (status, content type, body)."""
        return self.guard.routes

    def stop(self) -> None:
        """End all connections and free the port."""
        with _quiet_console():
            self.viser.stop()
        self._uploads.close()


def start_server(
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    strict_port: bool = False,
    token: str = "auto",
    max_upload_bytes: int = DEFAULT_MAX_UPLOAD_BYTES,
    allowed_hosts: tuple[str, ...] = (),
    title: str = "DBH Studio",
) -> StudioServer:
    """Start the server and return at once.

    Args:
        host: Address to listen on. Anything but loopback lets other machines connect, with the link only.
        port: Where to listen; 0 for any free one.
        strict_port: Fail where `port` is taken, rather than take the next free one and say so.
        token: The secret in the link, 16 characters or more; ``auto`` makes one.
        max_upload_bytes: Largest file a page may send.
        allowed_hosts: Further names under which it may be addressed (``name`` or, for a proxy, ``name:port``).
        title: Of the panel.

    Raises:
        MissingComponentError: Another version of viser is installed.
        StudioError: The port or the address cannot be used.
    """
    _check_viser()
    host = "127.0.0.1" if host == "localhost" else host  # the name may mean two addresses, each with its own free ports
    free_port = _find_port(host, port, strict=strict_port)
    any_address = host in _ANY_ADDRESS
    own_names = (socket.gethostname(),) if any_address else () if host in _LOOPBACK else (_bracketed(host),)
    guard = Guard(
        token=None if token == "auto" else token, allowed_hosts=(*own_names, *allowed_hosts), any_address=any_address
    )
    uploads = UploadDesk(max_upload_bytes)
    with _quiet_console(), _guarded_sockets(guard):
        server = viser.ViserServer(host=host, port=free_port, label=title, verbose=False)
    actual = server.get_port()
    if strict_port and port and actual != port:
        with _quiet_console():
            server.stop()
        raise _port_taken(port)
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    MessageGate(server, uploads)
    guard.open(actual)
    shown_host = "127.0.0.1" if any_address else _bracketed(host)
    note = _note(host, port, actual)
    if note:
        log.warning(note)
    return StudioServer(server, guard, f"http://{shown_host}:{actual}/?token={guard.token}", actual, note, uploads)


def _check_viser() -> None:
    if viser.__version__ != VISER_VERSION:
        raise MissingComponentError(
            f"viser {viser.__version__} is installed but the studio needs exactly {VISER_VERSION}.",
            f"Install it with: pip install viser=={VISER_VERSION}",
        )


def _note(host: str, wanted: int, actual: int) -> str:
    notes = []
    if wanted and actual != wanted:
        notes.append(f"Port {wanted} is taken; using {actual}.")
    if host not in _LOOPBACK:
        notes.append("Other machines may connect with this link, and the connection is not encrypted.")
    return " ".join(notes)


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


# -- ports ----------------------------------------------------------------------------------------------------------


def _find_port(host: str, port: int, *, strict: bool) -> int:
    """The first free port from `port` on. viser would search by itself, but it hangs where no port works at all."""
    for candidate in range(port, min(port + (1 if strict or not port else _N_PORTS_TRIED), 65536)):
        if _is_free(host, candidate):
            return candidate
    raise _port_taken(port)


def _is_free(host: str, port: int) -> bool:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            if os.name == "posix":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return False
        reason = error.strerror or str(error)
        raise StudioError(
            f"The server cannot listen on {_bracketed(host)}:{port}: {reason}.", "Choose another --host or --port."
        ) from None
    return True


def _port_taken(port: int) -> StudioError:
    return StudioError(
        f"Port {port} is taken by another program.", "Choose another --port, or stop the program that uses it."
    )


# -- hooks into viser -----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _guarded_sockets(guard: Guard) -> Iterator[None]:
    """While viser starts, put the guard in front of the one call with which it opens its port."""
    stock = websocket_server.serve

    def serve(*args: Any, **options: Any) -> Any:
        serve_page = options["process_request"]

        def process_request(connection: Any, request: Request) -> Response | None:
            reply = guard.check(request)
            if reply is None:
                reply = serve_page(connection, request)
            return None if reply is None else guard.add_headers(request, reply)

        return stock(*args, **{**options, "process_request": process_request})

    with _patching:
        websocket_server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websocket_server.serve = stock  # type: ignore[misc]


@contextlib.contextmanager
def _quiet_console() -> Iterator[None]:
    """viser prints its address without the token, which opens nothing: the caller prints the link."""
    console = rich.get_console()
    before = console.quiet
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = before
