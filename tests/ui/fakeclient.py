"""A viser page without a browser: the real server over its real websocket, in milliseconds.

Use it like a person uses the page. ``url`` is `StudioServer.url`, token included::

    with FakeClient(server.url) as tab:                   # logs in (token -> cookie), connects, waits for the replay
        tab.wait_text("Click a trunk")                    # polls the mirrored panel; TimeoutError shows what it held
        tab.look((0, -3, 2), (0, 0, 1.3))                 # camera position, look-at point (world)
        tab.click_scene((0.1, 0.0, 1.3))                  # left click on what is drawn at that world point
        tab.rect((0.4, 0.4), (0.6, 0.6))                  # shift-drag; corners 0..1, y down
        tab.press("Delete trunk")                         # button by its label; AssertionError if hidden or disabled
        tab.set("Curve", "ellipse")                       # dropdown, slider, checkbox, text, number ...
        tab.command("Undo")                               # a hotkey / command palette entry, by label
        tab.upload("Upload a cloud", "plot.ply", b"...")  # in 512 KB parts, as the page does
        tab.bridge_send("row", 3)                         # what page JavaScript does with dbh('row', 3)
        tab.wait(lambda t: t.value("Curve") == "ellipse")
        tab.settle()                                      # all that was done so far has had its effect, seen here

What an action brings about comes later, on a slow machine much later: wait for the state itself, or, for what must
*not* come about, `settle` first. A long timeout costs nothing when all goes well.

What the page would show is mirrored and may be read at any time:

    text()  html()             all visible panel text without / with its tags
    element(label)             `Element`: type, value, props; waits for it to appear
    elements  labels()         every element by uuid; labels of the visible ones
    value(label)  props(label)
    scene                      {name: SceneNode(type, props, visible)}, numpy arrays decoded (``props["points"]``)
    notifications              list of `Notification(title, body, color, open)`, in order of arrival
    downloads                  {file name: bytes} of completed downloads
    javascript                 JavaScript the server sent to the page, in order
    messages                   every message received, as dictionaries (arrays decoded)
    closed                     whether the server has ended the connection
    handle(server.viser)       the server's `viser.ClientHandle` of this tab; waits until it exists

`send(type=..., **fields)` sends any message and `send_raw(bytes)` any bytes: attacks are written with these.
`element`, `press` and `set` take ``force=True`` to act on what a page would not let a person touch.
"""

from __future__ import annotations

import functools
import html as html_module
import http.client
import itertools
import re
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import viser
import viser.transforms
import zstandard
from viser import _messages as wire
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from dbh_studio.ui.bind import TabWorker
from dbh_studio.ui.messages import MessageGate

BRIDGE_LABEL = "dbh-bridge"
PART_BYTES = 512 * 1024
PATIENCE_S = 120.0
_NO_DOUBLE_CLICK_S = 0.45
_MARK = "// so far "
_serials = itertools.count(1)


def _remembered(kind: type) -> list[weakref.ref[Any]]:
    """All objects of a class that are made from now on: a tab finds its server, and what works for it there."""
    made: list[weakref.ref[Any]] = []
    init = kind.__init__  # type: ignore[misc]

    @functools.wraps(init)
    def remembering(self: Any, *args: Any, **options: Any) -> None:
        init(self, *args, **options)
        made.append(weakref.ref(self))

    kind.__init__ = remembering  # type: ignore[misc]
    return made


def _living(made: list[weakref.ref[Any]]) -> list[Any]:
    return [thing for thing in (reference() for reference in list(made)) if thing is not None]


_gates, _workers = _remembered(MessageGate), _remembered(TabWorker)


def until_ended(*names: str) -> None:
    """Wait until no thread has one of these names."""
    deadline = time.monotonic() + PATIENCE_S
    # Not `join`: one that is just being started cannot be joined.
    while any(thread.name in names for thread in threading.enumerate()):
        assert time.monotonic() < deadline, f"one of {names} goes on and on"
        time.sleep(0.005)


def http_get(url: str, headers: dict[str, str] | None = None) -> tuple[int, dict[str, str], bytes]:
    """One GET without following redirects: (status, headers by lower-case name, body). `headers` may replace Host."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=PATIENCE_S)
    try:
        connection.request(
            "GET", (parts.path or "/") + (f"?{parts.query}" if parts.query else ""), headers=headers or {}
        )
        response = connection.getresponse()
        return response.status, {k.lower(): v for k, v in response.getheaders()}, response.read()
    finally:
        connection.close()


def login(url: str) -> str:
    """Open the link with the token and return the ``name=value`` of the cookie it sets."""
    status, headers, body = http_get(url)
    if status != 303 or "set-cookie" not in headers:
        raise AssertionError(f"no login: HTTP {status} {body[:200]!r}")
    return headers["set-cookie"].split(";")[0]


@dataclass
class Element:
    """One element of the panel, as the page knows it."""

    uuid: str
    type: str
    container: str
    props: dict[str, Any]
    value: Any = None

    @property
    def label(self) -> str:
        return str(self.props.get("label") or "")


@dataclass
class SceneNode:
    """One node of the 3D scene."""

    name: str
    type: str
    props: dict[str, Any]
    visible: bool = True


@dataclass
class Notification:
    """A message shown at the corner of the page."""

    title: str
    body: str
    color: Any = None
    open: bool = True


@dataclass
class _Download:
    name: str
    part_count: int
    parts: dict[int, bytes] = field(default_factory=dict)


class FakeClient:
    """One browser tab. See the module's text for what it can do.

    Args:
        url: The server's link with its token, or without one when `cookie` is given.
        position: Camera position in the world.
        look_at: What the camera looks at.
        fov_rad: Vertical field of view.
        size: Canvas width and height in pixels.
        cookie: A cookie to use in place of a login; ``""`` for none at all.
        origin: The Origin header; by default that of the page itself.
        headers: Further request headers.
    """

    def __init__(
        self,
        url: str,
        *,
        position: Sequence[float] = (0.0, -10.0, 3.0),
        look_at: Sequence[float] = (0.0, 0.0, 1.0),
        fov_rad: float = 1.3,
        size: tuple[int, int] = (1280, 800),
        cookie: str | None = None,
        origin: str | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        parts = urlsplit(url)
        self.fov_rad, self.size = fov_rad, size
        self._port = parts.port
        cookie = login(url) if cookie is None else cookie
        all_headers = {**({"Cookie": cookie} if cookie else {}), **(headers or {})}
        self.elements: dict[str, Element] = {}
        self._pressed_at: dict[str, float] = {}
        self.notifications: list[Notification] = []
        self.downloads: dict[str, bytes] = {}
        self.javascript: list[str] = []
        self.messages: list[dict[str, Any]] = []
        self.closed = False
        self._nodes: dict[tuple[str, str], SceneNode] = {}
        self._commands: dict[str, dict[str, Any]] = {}
        self._shown: dict[str, Notification] = {}
        self._downloading: dict[str, _Download] = {}
        self._n_bridge = 0
        self._handle: viser.ClientHandle | None = None
        self._marks: set[str] = set()
        self._far = 1000.0 + next(_serials)  # tells this tab from the others, see `handle`
        self._changed = threading.Condition()
        self._socket = connect(
            f"ws://{parts.netloc}/",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            compression=None,
            origin=origin or f"http://{parts.netloc}",  # type: ignore[arg-type]
            additional_headers=all_headers,
            open_timeout=PATIENCE_S,
        )
        self._receiver = threading.Thread(target=self._receive, daemon=True)
        self._receiver.start()
        self.look(position, look_at)
        self.wait(lambda t: any(m["type"] == "ReplayDoneMessage" for m in t.messages))

    def __enter__(self) -> FakeClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the tab."""
        self._socket.close()
        self._receiver.join(PATIENCE_S)

    # -- the wire ---------------------------------------------------------------------------------------------------

    def send(self, **message: Any) -> None:
        """Send one message, well-formed or not: ``send(type="GuiUpdateMessage", uuid=..., updates={...})``."""
        self._socket.send(msgspec.msgpack.encode(message, enc_hook=lambda value: value.item()))

    def send_raw(self, data: bytes | str) -> None:
        """Send one frame of anything."""
        self._socket.send(data)

    def _receive(self) -> None:
        try:
            for frame in self._socket:
                assert isinstance(frame, bytes)
                with self._changed:
                    for message in _decode(frame):
                        self._apply(message)
                    self._changed.notify_all()
        except ConnectionClosed:
            pass
        finally:
            with self._changed:
                self.closed = True
                self._changed.notify_all()

    def _apply(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "RunJavascriptMessage" and message["source"].startswith(_MARK):
            self._marks.add(message["source"])
            return
        self.messages.append(message)
        handler = getattr(self, f"_apply_{kind}", None)
        if handler is not None:
            handler(message)
        elif "props" in message and "name" in message:
            node = SceneNode(message["name"], kind, message["props"])
            self._nodes[message.get("owner", ""), node.name] = node
        elif "props" in message and "uuid" in message:
            self.elements[message["uuid"]] = Element(
                message["uuid"], kind, message.get("container_uuid", "root"), message["props"], message.get("value")
            )

    def _apply_GuiUpdateMessage(self, message: dict[str, Any]) -> None:
        element = self.elements.get(message["uuid"])
        for name, value in message["updates"].items() if element else ():
            if name == "value":
                element.value = value
            else:
                element.props[name] = value

    def _apply_GuiRemoveMessage(self, message: dict[str, Any]) -> None:
        self.elements.pop(message["uuid"], None)

    def _apply_GuiPanelRemoveMessage(self, message: dict[str, Any]) -> None:
        self.elements.pop(message["uuid"], None)

    def _apply_GuiModalMessage(self, message: dict[str, Any]) -> None:
        props = {"label": message["title"], "visible": True}
        self.elements[message["uuid"]] = Element(message["uuid"], "GuiModalMessage", "root", props)

    def _apply_GuiCloseModalMessage(self, message: dict[str, Any]) -> None:
        self.elements.pop(message["uuid"], None)

    def _apply_ResetGuiMessage(self, message: dict[str, Any]) -> None:
        self.elements.clear()

    def _apply_SceneNodeUpdateMessage(self, message: dict[str, Any]) -> None:
        node = self._nodes.get((message.get("owner", ""), message["name"]))
        if node is not None:
            node.props.update(message["updates"])

    def _apply_SetSceneNodeVisibilityMessage(self, message: dict[str, Any]) -> None:
        node = self._nodes.get((message.get("owner", ""), message["name"]))
        if node is not None:
            node.visible = message["visible"]

    def _apply_SetPositionMessage(self, message: dict[str, Any]) -> None:
        node = self._nodes.get((message.get("owner", ""), message["name"]))
        if node is not None:
            node.props["position"] = message["position"]

    def _apply_RemoveSceneNodeMessage(self, message: dict[str, Any]) -> None:
        owner, name = message.get("owner", ""), message["name"]
        for key in [k for k in self._nodes if k[0] == owner and (k[1] == name or k[1].startswith(name + "/"))]:
            del self._nodes[key]

    def _apply_RegisterCommandMessage(self, message: dict[str, Any]) -> None:
        self._commands[message["uuid"]] = message["props"]

    def _apply_CommandUpdateMessage(self, message: dict[str, Any]) -> None:
        self._commands.get(message["uuid"], {}).update(message["updates"])

    def _apply_RemoveCommandMessage(self, message: dict[str, Any]) -> None:
        self._commands.pop(message["uuid"], None)

    def _apply_NotificationShowMessage(self, message: dict[str, Any]) -> None:
        props = message["props"]
        shown = Notification(props["title"], props["body"], props.get("color"))
        self.notifications.append(shown)
        self._shown[message["uuid"]] = shown

    def _apply_NotificationUpdateMessage(self, message: dict[str, Any]) -> None:
        shown, props = self._shown.get(message["uuid"]), message["props"]
        if shown is not None:
            shown.title, shown.body, shown.color = props["title"], props["body"], props.get("color")

    def _apply_RemoveNotificationMessage(self, message: dict[str, Any]) -> None:
        if message["uuid"] in self._shown:
            self._shown[message["uuid"]].open = False

    def _apply_RunJavascriptMessage(self, message: dict[str, Any]) -> None:
        self.javascript.append(message["source"])

    def _apply_FileTransferStartDownload(self, message: dict[str, Any]) -> None:
        self._downloading[message["transfer_uuid"]] = _Download(message["filename"], message["part_count"])
        self._finish_download(message["transfer_uuid"])

    def _apply_FileTransferPart(self, message: dict[str, Any]) -> None:
        download = self._downloading.get(message["transfer_uuid"])
        if download is not None:
            download.parts[message["part_index"]] = bytes(message["content"])
            self._finish_download(message["transfer_uuid"])

    def _finish_download(self, transfer: str) -> None:
        download = self._downloading[transfer]
        if len(download.parts) == download.part_count:
            self.downloads[download.name] = b"".join(download.parts[i] for i in range(download.part_count))
            del self._downloading[transfer]

    # -- waiting ----------------------------------------------------------------------------------------------------

    def wait(self, condition: Callable[[FakeClient], Any], timeout: float = PATIENCE_S) -> FakeClient:
        """Block until `condition(self)` is true. Raises TimeoutError with what the panel held."""
        deadline = time.monotonic() + timeout
        with self._changed:
            while not condition(self):
                left = deadline - time.monotonic()
                if left <= 0:
                    shown = [f"{n.title}: {n.body}" for n in self.notifications]
                    raise TimeoutError(f"not met within {timeout} s; panel:\n{self.text()}\nnotifications: {shown}")
                self._changed.wait(min(left, 0.05))  # conditions may read what does not arrive here
        return self

    def wait_text(self, text: str, timeout: float = PATIENCE_S) -> FakeClient:
        """Block until the visible panel text contains `text`."""
        return self.wait(lambda t: text in t.text(), timeout)

    def wait_notification(self, text: str, timeout: float = PATIENCE_S) -> Notification:
        """Block until a notification's title or body contains `text`, and return it."""
        self.wait(lambda t: t._notification(text) is not None, timeout)
        found = self._notification(text)
        assert found is not None
        return found

    def _notification(self, text: str) -> Notification | None:
        return next((n for n in self.notifications if text in n.title or text in n.body), None)

    def delivered(self) -> FakeClient:
        """Block until the server has taken all that was sent, in its order, and put it into the tab's queue."""
        handle = self._own_handle()
        if handle is not None:
            uuid_, taken = uuid.uuid4().hex, threading.Event()

            def note(_: int, message: wire.LocalStorageGetItemResponseMessage) -> None:
                if message.request_uuid == uuid_:
                    taken.set()

            kind = wire.LocalStorageGetItemResponseMessage  # it does nothing but come behind everything else
            handle._websock_connection.register_handler(kind, note)
            try:
                self.send(type=kind.__name__, request_uuid=uuid_, value=None, error=None)
                self.wait(lambda t: taken.is_set() or t.closed)
            finally:
                handle._websock_connection.unregister_handler(kind, note)
        return self

    def settle(self, quiet_s: float = 0.1) -> FakeClient:
        """Block until nothing goes on any more between page and server, and then for `quiet_s`.

        All that was sent has been taken, no plot is being opened, the tab's queue is empty, no cloud is being sent, and
        all that came of it has arrived here. A job in a child process is no part of it: see `Studio.wait_idle`.
        """
        n_messages = -1
        while n_messages != len(self.messages) and not self.closed:
            n_messages = len(self.messages)
            self._caught_up()
            time.sleep(quiet_s)
            self._caught_up()
        return self

    def _caught_up(self) -> None:
        self.delivered()
        handle = self._own_handle()
        if handle is None or self.closed:
            return
        until_ended("open", "at once")
        for worker in _living(_workers):
            if worker.client is handle:
                assert worker.join(PATIENCE_S), "the tab's queue stands still; `delivered` is what to wait for"
        until_ended("stream")
        mark = f"{_MARK}{uuid.uuid4().hex}"
        handle._websock_connection.queue_message(wire.RunJavascriptMessage(source=mark))
        handle.flush()
        self.wait(lambda t: mark in t._marks or t.closed)

    def _own_handle(self) -> viser.ClientHandle | None:
        """The server's handle of this tab; None where the server is in another process, or has lost the tab."""
        if self._handle is None and any(gate._server.get_port() == self._port for gate in _living(_gates)):

            def found() -> bool:
                clients = [c for gate in _living(_gates) for c in gate._server.get_clients().values()]
                self._handle = next((client for client in clients if client.camera.far == self._far), None)
                return self._handle is not None or self.closed

            self.wait(lambda _: found())
        return self._handle

    def handle(self, server: viser.ViserServer) -> viser.ClientHandle:
        """The server's handle of this tab, once the server has seen its camera."""

        def own() -> viser.ClientHandle | None:
            return next((c for c in server.get_clients().values() if c.camera.far == self._far), None)

        self.wait(lambda _: own() is not None)
        found = own()
        assert found is not None
        return found

    # -- the panel --------------------------------------------------------------------------------------------------

    def visible(self, element: Element) -> bool:
        """Whether the element and all folders, tabs and panels around it are shown."""
        with self._changed:
            while element.props.get("visible", True):
                parent = self._container(element.container)
                if parent is None:
                    return True
                element = parent
            return False

    def _container(self, container: str) -> Element | None:
        if container in self.elements:
            return self.elements[container]
        for element in self.elements.values():
            if container in (element.props.get("_tab_container_ids") or ()):
                return element
        return None

    def _find(self, label: str, *, force: bool = False) -> Element | None:
        with self._changed:
            found = [e for e in self.elements.values() if e.label == label]
            return next((e for e in found if self.visible(e)), found[0] if found and force else None)

    def element(self, label: str, *, force: bool = False, timeout: float = PATIENCE_S) -> Element:
        """The visible element with this label; with `force` also a hidden one. Raises KeyError with all labels."""
        try:
            self.wait(lambda t: t._find(label, force=force) is not None, timeout)
        except TimeoutError:
            raise KeyError(f"no element {label!r} among {self.labels()}") from None
        found = self._find(label, force=force)
        assert found is not None
        return found

    def labels(self) -> list[str]:
        """Labels of all visible elements."""
        with self._changed:
            return [e.label for e in self.elements.values() if e.label and self.visible(e)]

    def has(self, label: str) -> bool:
        """Whether a visible element has this label now."""
        return self._find(label) is not None

    def enabled(self, label: str) -> bool:
        """Whether the visible element may be used."""
        return not self.element(label).props.get("disabled", False)

    def value(self, label: str) -> Any:
        """Value of an input, as the page shows it."""
        return self.element(label).value

    def props(self, label: str) -> dict[str, Any]:
        """Properties of an element: ``options``, ``min``, ``disabled`` …"""
        return self.element(label).props

    def press(self, label: str, *, force: bool = False, hurried: bool = False) -> None:
        """Press a button as soon as it can be pressed.

        The same one again when the first press has been dealt with, and so long after it that it is no double click,
        unless `hurried` or forced.
        """
        element = self._usable(label, force)
        if element.uuid in self._pressed_at and not (force or hurried):
            self._caught_up()
            time.sleep(max(0.0, self._pressed_at[element.uuid] + _NO_DOUBLE_CLICK_S - time.monotonic()))
            element = self._usable(label, force)
        self._update(element, True)
        if not hurried:
            self.delivered()  # the server has the time of the press by its own clock, not later than this
        self._pressed_at[element.uuid] = time.monotonic()

    def set(self, label: str, value: Any, *, force: bool = False, hurried: bool = False) -> None:
        """Change an input; the page shows the new value at once, as a browser does.

        The server has it when this returns, unless `hurried`.
        """
        element = self._usable(label, force)
        element.value = value  # before it is sent: the server may answer with another one
        self._update(element, value)
        if not hurried:
            self.delivered()

    def _usable(self, label: str, force: bool) -> Element:
        element = self.element(label, force=force)
        if not force:
            try:
                self.wait(lambda t: (e := t._find(label)) is not None and not e.props.get("disabled", False))
            except TimeoutError:
                raise AssertionError(f"{label!r} is disabled or has gone") from None
            element = self.element(label)
        return element

    def _update(self, element: Element, value: Any) -> None:
        self.send(type="GuiUpdateMessage", uuid=element.uuid, updates={"value": value})

    def command(self, label: str) -> None:
        """Trigger a command, as its hotkey or the palette does."""
        self.wait(lambda t: any(p["label"] == label for p in t._commands.values()))
        with self._changed:
            key, props = next((k, p) for k, p in self._commands.items() if p["label"] == label)
        assert not props["disabled"], f"command {label!r} is disabled"
        self.send(type="CommandTriggerMessage", uuid=key)

    def commands(self) -> dict[str, tuple[str | None, str | None]]:
        """Label of every command with its hotkey and modifier."""
        with self._changed:
            return {p["label"]: (p["hotkey"], p["modifier"]) for p in self._commands.values()}

    def upload(self, label: str, name: str, content: bytes, *, mime: str = "application/octet-stream") -> str:
        """Send a file through an upload button; returns the transfer's id. Does not wait for the server."""
        source, transfer = self.element(label).uuid, uuid.uuid4().hex
        parts = [content[i : i + PART_BYTES] for i in range(0, len(content), PART_BYTES)]
        self.upload_start(source, transfer, name, len(parts), len(content), mime=mime)
        for index, part in enumerate(parts):
            self.upload_part(source, transfer, index, part)
        return transfer

    def upload_start(
        self, source: str, transfer: str, name: str, n_parts: int, n_bytes: int, *, mime: str = ""
    ) -> None:
        """Announce a file, truthfully or not."""
        self.send(
            type="FileTransferStartUpload",
            source_component_uuid=source,
            transfer_uuid=transfer,
            filename=name,
            mime_type=mime,
            part_count=n_parts,
            size_bytes=n_bytes,
        )

    def upload_part(self, source: str, transfer: str, index: int, content: bytes) -> None:
        """Send one part of an announced file."""
        self.send(
            type="FileTransferPart",
            source_component_uuid=source,
            transfer_uuid=transfer,
            part_index=index,
            content=content,
        )

    def bridge_send(self, kind: str, payload: Any = None) -> None:
        """What JavaScript in the page does with ``dbh(kind, payload)``."""
        self._n_bridge += 1
        text = msgspec.json.encode([self._n_bridge, kind, payload]).decode()
        element = self.element(BRIDGE_LABEL, force=True)
        self.send(type="GuiUpdateMessage", uuid=element.uuid, updates={"value": text})

    def _contents(self) -> Iterator[str]:
        for element in sorted(list(self.elements.values()), key=lambda e: e.props.get("order") or 0):
            if element.label != BRIDGE_LABEL and self.visible(element):
                yield element.label
                yield from element.props.get("_tab_labels") or ()
                yield str(element.props.get("_markdown") or "")
                yield str(element.props.get("content") or "")
                if isinstance(element.value, str):
                    yield element.value

    def html(self) -> str:
        """Everything visible in the panel, tags included: labels, markdown, HTML and text values."""
        with self._changed:
            return "\n".join(part for part in self._contents() if part)

    def text(self) -> str:
        """As `html`, without tags and entities."""
        return html_module.unescape(re.sub(r"<[^>]*>", " ", self.html()))

    # -- the scene --------------------------------------------------------------------------------------------------

    @property
    def scene(self) -> dict[str, SceneNode]:
        """Nodes by name; one of this tab hides a shared one of the same name."""
        with self._changed:
            return {name: self._nodes[owner, name] for owner, name in sorted(self._nodes, key=lambda k: k[0] != "")}

    def look(self, position: Sequence[float], look_at: Sequence[float]) -> None:
        """Move the camera (up is +z)."""
        origin, target = np.asarray(position, float), np.asarray(look_at, float)
        forward = (target - origin) / np.linalg.norm(target - origin)
        right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.999 else [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        self.position, self.rotation = origin, np.stack([right, np.cross(forward, right), forward])
        quaternion = viser.transforms.SO3.from_matrix(self.rotation.T).wxyz
        self.send(
            type="ViewerCameraMessage",
            wxyz=[float(q) for q in quaternion],
            position=[float(p) for p in origin],
            fov=self.fov_rad,
            near=0.01,
            far=self._far,
            image_height=self.size[1],
            image_width=self.size[0],
            look_at=[float(t) for t in target],
            up_direction=[0.0, 0.0, 1.0],
        )

    def screen(self, point: Sequence[float]) -> tuple[float, float]:
        """Where a world point appears: 0..1 from the upper left corner."""
        x, y, z = self.rotation @ (np.asarray(point, float) - self.position)
        scale = 1.0 / np.tan(self.fov_rad / 2)
        return float((x / z * scale * self.size[1] / self.size[0] + 1) / 2), float((y / z * scale + 1) / 2)

    def click_scene(self, point: Sequence[float], *, modifier: str | None = None) -> None:
        """Click where `point` is drawn."""
        ray = np.asarray(point, float) - self.position
        ray /= np.linalg.norm(ray)
        self.send(
            type="ScenePointerMessage",
            event_type="click",
            ray_origin=[float(p) for p in self.position],
            ray_direction=[float(r) for r in ray],
            screen_pos=[self.screen(point)],
            modifier=modifier,
        )

    def rect(self, lower: Sequence[float], upper: Sequence[float], *, modifier: str | None = "shift") -> None:
        """Drag a rectangle from upper left `lower` to lower right `upper`, both 0..1."""
        self.send(
            type="ScenePointerMessage",
            event_type="rect-select",
            ray_origin=None,
            ray_direction=None,
            screen_pos=[list(lower), list(upper)],
            modifier=modifier,
        )


def _decode(frame: bytes) -> list[dict[str, Any]]:
    """Messages of one frame: zstd-compressed msgpack, then the arrays it refers to, each 8-byte aligned."""
    raw_size, size = (int.from_bytes(frame[i : i + 8], "little") for i in (0, 8))
    packed = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size], max_output_size=raw_size)
    content = msgspec.msgpack.decode(packed)
    buffers, offset = [], 16 + size
    for length in content["binaryBufferLengths"]:
        offset += -offset % 8
        buffers.append(frame[offset : offset + length])
        offset += length
    return [_with_arrays(message, buffers) for message in content["messages"]]


def _with_arrays(value: Any, buffers: list[bytes]) -> Any:
    if isinstance(value, dict):
        if "__binary_index" in value:
            array = np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
            return array.reshape(-1, 3) if array.size % 3 == 0 else array
        return {k: _with_arrays(v, buffers) for k, v in value.items()}
    if isinstance(value, list):
        return [_with_arrays(v, buffers) for v in value]
    return value
