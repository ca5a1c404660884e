"""A network between page and studio that can be held up, cut and mended."""

from __future__ import annotations

import contextlib
import socket
import threading


class Line:
    """Listens on `port` and passes on to `target`, which is set before the first connection is made."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self.target = 0
        self._lock = threading.Lock()
        self._is_cut = False
        self._flows = threading.Event()
        self._flows.set()
        self._ends: set[socket.socket] = set()
        self._threads = [threading.Thread(target=self._accept, name="line")]
        self._threads[0].start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # the end
            while True:
                near, _ = self._listening.accept()
                thread = threading.Thread(target=self._join, args=(near,), name="line")
                self._threads.append(thread)
                thread.start()

    def _join(self, near: socket.socket) -> None:
        """One connection, to its end; whoever opened a socket closes it."""
        with near, contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.target)) as far:
            ends = {near, far}
            with self._lock:
                if self._is_cut:
                    return
                self._ends |= ends
            back = threading.Thread(target=self._pass_on, args=(far, near), name="line")
            back.start()
            self._pass_on(near, far)
            back.join()
            with self._lock:
                self._ends -= ends

    def _pass_on(self, source: socket.socket, target: socket.socket) -> None:
        try:
            while content := source.recv(1 << 16):
                self._flows.wait()
                target.sendall(content)
            self._flows.wait()
            target.shutdown(socket.SHUT_WR)
        except OSError:
            # The other side hears of a reset too, as it would without this line between.
            self._flows.wait()
            _end(source)
            _end(target)

    def hold(self) -> None:
        """Nothing comes through any more, and neither side hears of it."""
        self._flows.clear()

    def cut(self) -> None:
        """End all connections, and take none."""
        with self._lock:
            self._is_cut = True
            for end in self._ends:
                _end(end)
        self._flows.set()

    def mend(self) -> None:
        """Take connections again."""
        with self._lock:
            self._is_cut = False

    def close(self) -> None:
        """Cut it for good."""
        self.cut()
        _end(self._listening)
        self._threads[0].join()
        self._listening.close()
        for thread in self._threads[1:]:
            thread.join()


def _end(end: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it has ended already
        end.shutdown(socket.SHUT_RDWR)
