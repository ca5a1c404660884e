"""What a page may say: every websocket message is checked before viser acts on it.

viser 1.1.1 trusts its page: a message may set any attribute of an element's internal state, disabled and hidden buttons
fire, ranges and options exist only in the browser, and one message opens a public tunnel. Both dispatchers (the
server's and each connection's) are wrapped here; types that are not named below are dropped.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import viser
from viser import _messages as wire

from dbh_studio.ui.uploads import UploadDesk, rule_of

log = logging.getLogger(__name__)

MAX_TEXT_CHARS = 10_000
_MAX_NAME_CHARS = 1_000
_MACHINE_INPUT = "studio_machine_input"

# Plain data: numbers must be finite, texts short.
_PLAIN = (
    wire.SceneNodeClickMessage,
    wire.SceneNodeDragMessage,
    wire.TransformControlsUpdateMessage,
    wire.TransformControlsDragStartMessage,
    wire.TransformControlsDragEndMessage,
    wire.CommandTriggerMessage,
)
# Answers to a question of the server; viser drops those nobody asked for.
_ANSWERS = (wire.GetRenderResponseMessage, wire.LocalStorageGetItemResponseMessage)
_UPLOADS = (wire.FileTransferStartUpload, wire.FileTransferPart)


def let_page_scripts_write(text_input: Any, max_chars: int) -> None:
    """Accept messages for an invisible text input, up to a length: the studio's own scripts in the page use it."""
    setattr(text_input._impl, _MACHINE_INPUT, max_chars)


class MessageGate:
    """The checks in front of one server's dispatchers. To be made before the first connection is let in."""

    def __init__(self, server: viser.ViserServer, uploads: UploadDesk) -> None:
        self._server = server
        self._uploads = uploads
        websocket = server._websock_server
        for kind in (wire.ShareUrlRequest, wire.ShareUrlDisconnect):
            websocket.unregister_handler(kind)
        self._wrap(websocket, lambda _: server.gui)
        websocket._broadcast_buffer._warned_push_after_done = True
        websocket.on_client_connect(self._wrap_connection)
        websocket.on_client_disconnect(lambda connection: uploads.drop_tab(connection.client_id))

    def _wrap_connection(self, connection: Any) -> None:
        # A tab may close while its handlers still run; what they write then is not worth a warning.
        connection.get_message_buffer()._warned_push_after_done = True
        self._wrap(connection, self._client_gui, takes_uploads=True)

    def _client_gui(self, client_id: int) -> Any:
        client = self._server._connected_clients.get(client_id)
        return None if client is None else client.gui

    def _wrap(self, dispatcher: Any, gui_of: Callable[[int], Any], *, takes_uploads: bool = False) -> None:
        inner = dispatcher._handle_incoming_message

        async def checked(client_id: int, message: wire.Message) -> None:
            try:
                if isinstance(message, _UPLOADS):
                    if takes_uploads:
                        self._take_upload(client_id, message)
                elif is_acceptable(gui_of(client_id), message):
                    await inner(client_id, message)
                else:
                    log.debug("Dropped a %s from tab %s", type(message).__name__, client_id)
            except Exception:
                log.exception("A %s from tab %s could not be handled", type(message).__name__, client_id)

        dispatcher._handle_incoming_message = checked

    # -- uploads ----------------------------------------------------------------------------------------------------

    def _take_upload(self, client_id: int, message: Any) -> None:
        client = self._server._connected_clients.get(client_id)
        transfer = message.transfer_uuid
        if client is None or not isinstance(transfer, str) or not is_plain(message, skip=("content",)):
            return
        if isinstance(message, wire.FileTransferPart):
            if not isinstance(message.content, bytes):
                return
            done = self._uploads.part(client_id, transfer, message.part_index, message.content)
            if done is not None:
                self._acknowledge(client, message.source_component_uuid, transfer, *done)
            return
        handle = find_input(client.gui, message.source_component_uuid)
        handle = handle or find_input(self._server.gui, message.source_component_uuid)
        rule = rule_of(handle) if isinstance(handle, viser.GuiUploadButtonHandle) and is_usable(handle) else None
        if rule is None:
            log.debug("Dropped an upload from tab %s: no such button, or it accepts none", client_id)
            return
        size = message.size_bytes
        if not self._uploads.start(client_id, transfer, rule, str(message.filename), message.part_count, size):
            # The page has no word for a refusal; told that all has arrived, it makes the button usable again.
            self._acknowledge(client, message.source_component_uuid, transfer, size, size)

    @staticmethod
    def _acknowledge(client: viser.ClientHandle, source: str | None, transfer: str, received: int, total: int) -> None:
        client._websock_connection.queue_message(wire.FileTransferPartAck(source, transfer, received, total))


# -- the rules ------------------------------------------------------------------------------------------------------


def is_acceptable(gui: Any, message: wire.Message) -> bool:
    """Whether a message from a page may reach viser, given the `GuiApi` to look it up in (None: not there yet)."""
    if isinstance(message, wire.ScenePointerMessage):
        return is_plain(message) and _is_gesture(message)
    if isinstance(message, wire.ViewerCameraMessage):
        return is_plain(message) and _is_camera(message)
    if isinstance(message, _PLAIN):
        return is_plain(message)
    if isinstance(message, _ANSWERS):
        return True
    if isinstance(message, wire.GuiUpdateMessage) and gui is not None:
        handle = find_input(gui, message.uuid)
        if handle is None or set(message.updates) != {"value"}:
            return False
        value = message.updates["value"]
        machine_limit = getattr(handle._impl, _MACHINE_INPUT, None)
        if machine_limit is not None:
            return isinstance(value, str) and len(value) <= machine_limit
        return is_usable(handle) and is_legal(handle, value)
    return False


def find_input(gui: Any, uuid: Any) -> Any:
    """The input element of a `GuiApi` with this uuid, or None."""
    return gui._gui_input_handle_from_uuid.get(uuid) if isinstance(uuid, str) else None


def is_plain(message: wire.Message, *, skip: tuple[str, ...] = ()) -> bool:
    """Whether all numbers are finite and all texts short."""
    return all(_is_plain_value(value) for name, value in vars(message).items() if name not in skip)


def _is_plain_value(value: Any) -> bool:
    if value is None or isinstance(value, (bool, int)):
        return True
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, str):
        return len(value) <= _MAX_NAME_CHARS
    return isinstance(value, (tuple, list)) and len(value) <= 64 and all(_is_plain_value(v) for v in value)


def _is_gesture(message: wire.ScenePointerMessage) -> bool:
    corners = message.screen_pos
    if not all(isinstance(corner, tuple) and len(corner) == 2 for corner in corners):
        return False
    if message.event_type == "rect-select":
        return len(corners) == 2
    rays = (message.ray_origin, message.ray_direction)
    return (
        message.event_type == "click"
        and len(corners) == 1
        and all(isinstance(ray, tuple) and len(ray) == 3 for ray in rays)
        and any(message.ray_direction or ())
    )


def _is_camera(message: wire.ViewerCameraMessage) -> bool:
    vectors = (message.position, message.look_at, message.up_direction)
    return (
        len(message.wxyz) == 4
        and any(message.wxyz)
        and all(len(vector) == 3 for vector in vectors)
        and 0 < message.fov < math.pi
        and message.image_height >= 0
        and message.image_width >= 0
    )


def is_usable(handle: Any) -> bool:
    """Whether a person could use the element now: it and everything around it is shown, and it is not disabled."""
    if handle._impl.removed or getattr(handle._impl.props, "disabled", False):
        return False
    gui = handle._impl.gui_api
    while handle is not None:
        if not getattr(handle._impl.props, "visible", True):
            return False
        handle = _parent(gui, handle)
    return True


def _parent(gui: Any, handle: Any) -> Any:
    """The folder, tab group or panel around an element; None at the top and in a modal (which is always shown)."""
    container = gui._resolve_container_handle(handle._impl.parent_container_id) if _is_nested(handle) else None
    container = getattr(container, "_parent", container)  # a tab belongs to its group
    return container if hasattr(container, "_impl") else None


def _is_nested(handle: Any) -> bool:
    return not isinstance(handle, viser.PanelHandle) and handle._impl.parent_container_id != "root"


def is_legal(handle: Any, value: Any) -> bool:
    """Whether `value` is one that the element offers. Kinds of element that are not named here accept none."""
    props = handle._impl.props
    if isinstance(handle, viser.GuiButtonHandle):
        return value is True
    if isinstance(handle, viser.GuiCheckboxHandle):
        return isinstance(value, bool)
    if isinstance(handle, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        return isinstance(value, str) and value in props.options
    if isinstance(handle, viser.GuiTextHandle):
        return isinstance(value, str) and len(value) <= MAX_TEXT_CHARS
    if isinstance(handle, (viser.GuiNumberHandle, viser.GuiSliderHandle)):
        return _is_number(value, handle.value) and _is_between(value, props.min, props.max)
    if isinstance(handle, viser.GuiMultiSliderHandle):
        return _are_numbers(value, handle.value) and all(_is_between(v, props.min, props.max) for v in value)
    if isinstance(handle, (viser.GuiVector2Handle, viser.GuiVector3Handle)):
        low, high = (limit or (None,) * len(handle.value) for limit in (props.min, props.max))
        return _are_numbers(value, handle.value) and all(map(_is_between, value, low, high))
    if isinstance(handle, (viser.GuiRgbHandle, viser.GuiRgbaHandle)):
        return _are_numbers(value, handle.value) and all(_is_between(v, 0, 255) for v in value)
    return False


def _is_number(value: Any, like: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return False
    return not isinstance(like, int) or float(value).is_integer()


def _are_numbers(values: Any, like: tuple[Any, ...]) -> bool:
    return isinstance(values, (list, tuple)) and len(values) == len(like) and all(map(_is_number, values, like))


def _is_between(value: float, low: float | None, high: float | None) -> bool:
    return (low is None or value >= low) and (high is None or value <= high)
