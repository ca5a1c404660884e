"""One file from the network: resumed where it broke off, never more than it should be, and clear about what went wrong.

With urllib, which respects the proxy variables and the system's certificates. Pooch was looked at and not taken: it
does not resume, and these files have up to 700 MB.
"""

from __future__ import annotations

import contextlib
import errno
import http.client
import os
import re
import shutil
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dbh_studio.core.progress import Progress
from dbh_studio.errors import ModelError
from dbh_studio.io.ownfile import open_own_file

_BLOCK = 1 << 18
_TIMEOUT_S = 30.0
_TRIES = 5
# No model of the list is near this; a server that never ends is.
_MAX_BYTES = 8_000_000_000
_SPARE_BYTES = 64 << 20
_WORTH_ANOTHER_TRY = (408, 425, 429, 500, 502, 503, 504)


class _StaleError(Exception):
    """What is there of the file does not fit what the server has: begin again."""


class _NoDowngrade(urllib.request.HTTPRedirectHandler):
    """Follow redirects, as publishers' storage needs, but not from https to http."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        if req.full_url.startswith("https:") and not newurl.startswith("https:"):
            raise urllib.error.URLError(f"the server leads to an unencrypted address ({newurl})")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def download(
    url: str,
    part: Path,
    *,
    n_bytes: int | None,
    progress: Progress,
    label: str,
    tries: int = _TRIES,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Fetch `url` into `part`, going on behind what is there already.

    Args:
        url: The address.
        part: Where the bytes go; it stays when the download breaks off, for the next time.
        n_bytes: The size it must have; None takes the server's word.
        progress: Called with every block; its `CancelledError` ends the download, and what is there stays.
        label: What is said in front of the figures.
        tries: How often a broken connection is taken up again without getting any further.
        sleep: Waits between the tries.

    Raises:
        ModelError: No network, no such file, the disk is full, or the size is another.
    """
    opener = urllib.request.build_opener(_NoDowngrade())
    failures = 0
    while True:
        have = _size(part)
        try:
            total = _attempt(opener, url, part, have, n_bytes, progress, label)
            if _size(part) == total:
                return
            raise ConnectionError(f"the connection ended after {_size(part):,} of {total:,} bytes")
        except _StaleError:
            _cut(part)
            failures += 1
            problem: Exception = ConnectionError("the server does not send what it announces")
        except urllib.error.HTTPError as error:
            with contextlib.closing(error):
                if error.code not in _WORTH_ANOTHER_TRY:
                    raise _refused(url, error.code) from error
            problem, failures = error, failures + 1
        except (OSError, http.client.HTTPException) as error:
            if _is_hopeless(error):
                raise _no_network(url, error) from error
            # Getting on, however slowly, is not failing.
            failures = 1 if _size(part) > have else failures + 1
            problem = error
        if failures >= tries:
            raise _no_network(url, problem) from problem
        sleep(min(0.5 * 2.0**failures, 15.0))


def _attempt(
    opener: urllib.request.OpenerDirector,
    url: str,
    part: Path,
    have: int,
    n_bytes: int | None,
    progress: Progress,
    label: str,
) -> int:
    """One connection; returns how long the whole file is."""
    if n_bytes is not None and have > n_bytes:
        raise _StaleError
    if have and have == n_bytes:
        return have
    headers = {"User-Agent": "dbh-studio", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        answer = opener.open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:
            error.close()
            raise _StaleError from None
        raise
    with answer:
        start, total = _span(answer, have)
        if n_bytes is not None and total is not None and total != n_bytes:
            raise ModelError(
                f"{url} has {total:,} bytes, but {n_bytes:,} are expected.",
                "The publisher has changed the file. Update DBH Studio, or get the file elsewhere and use "
                "`dbh-studio models add`.",
            )
        limit = n_bytes or total or _MAX_BYTES
        _check_room(part.parent, limit - start)
        end = _receive(answer, part, start, limit, progress, label)
        return n_bytes or total or end


def _span(answer: Any, have: int) -> tuple[int, int | None]:
    """(first byte, whole size or None) of what the server is about to send."""
    length = answer.headers.get("Content-Length")
    if answer.status == 206:
        found = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", answer.headers.get("Content-Range", "").strip())
        if found is None or int(found[1]) != have:
            raise _StaleError
        return have, None if found[2] == "*" else int(found[2])
    # A server that does not know Range sends the whole: begin again.
    return 0, int(length) if length and length.isdigit() else None


def _receive(answer: Any, part: Path, start: int, limit: int, progress: Progress, label: str) -> int:
    done = start
    flags = os.O_WRONLY | os.O_CREAT | (os.O_APPEND if start else os.O_TRUNC)
    with _disk_errors(part), open(open_own_file(part, flags), "ab" if start else "wb", buffering=0) as file:
        while True:
            with _network_errors():
                block = answer.read(_BLOCK)
            if not block:
                return done
            done += len(block)
            if done > limit:
                raise _StaleError
            file.write(block)
            progress(min(done / limit, 1.0), f"{label}: {done / 1e6:,.0f} of {limit / 1e6:,.0f} MB")


class _NetworkError(ConnectionError):
    """What the network did, so that it is not taken for the disk's doing."""


@contextlib.contextmanager
def _network_errors() -> Any:
    try:
        yield
    except (OSError, http.client.HTTPException) as error:
        raise _NetworkError(str(error) or type(error).__name__) from error


@contextlib.contextmanager
def _disk_errors(part: Path) -> Any:
    try:
        yield
    except _NetworkError:
        raise
    except OSError as error:
        raise _cannot_write(part.parent, error) from error


def _check_room(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if needed + _SPARE_BYTES > free:
        reason = OSError(errno.ENOSPC, f"{needed / 1e6:,.0f} MB are needed, {free / 1e6:,.0f} MB are free")
        raise _cannot_write(folder, reason)


def _cannot_write(folder: Path, error: OSError) -> ModelError:
    remedy = "Make room, or set DBH_STUDIO_CACHE to a folder with room; what is there is kept."
    return ModelError(f"The model cannot be written to {folder} ({error.strerror or error}).", remedy)


def _is_hopeless(error: Exception) -> bool:
    """Whether another try in a few seconds would be the same: no name, no certificate, nobody there."""
    reason = getattr(error, "reason", error)
    return isinstance(reason, (socket.gaierror, ssl.SSLCertVerificationError, ConnectionRefusedError, str))


def _no_network(url: str, error: Exception) -> ModelError:
    host = re.sub(r"^https?://([^/]+)/.*$", r"\1", url)
    reason = getattr(error, "reason", error)
    what = str(getattr(reason, "strerror", None) or reason)
    return ModelError(
        f"{host} cannot be reached ({what}).",
        "Check the network and, behind a proxy, the variable HTTPS_PROXY; then run the same command again: it goes on "
        "where it stopped. Without network: fetch the file on another computer and use `dbh-studio models add`. The "
        f"file is {url}",
    )


def _refused(url: str, code: int) -> ModelError:
    what = {404: "there is no such file any more", 403: "access is not allowed", 401: "a login is asked for"}.get(code)
    what = what or ("the proxy asks for a login" if code == 407 else http.client.responses.get(code, "refused"))
    return ModelError(
        f"The server does not give {url} (HTTP {code}: {what}).",
        "Get the file elsewhere, and use `dbh-studio models add`.",
    )


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _cut(part: Path) -> None:
    part.unlink(missing_ok=True)
