"""A channel between the studio's own scripts in the page and Python, and safe ways to put text into the page.

viser has no tables and reports no clicks on images or plots. Two of its private hooks fill the gap: a message that runs
JavaScript in the page, and the page's own way to send a message, used here on an invisible text input of the tab.
"""

from __future__ import annotations

import html
import json
import logging
from collections.abc import Callable
from functools import partial
from typing import Any

from viser import _messages as wire

from dbh_studio.ui.bind import TabWorker
from dbh_studio.ui.messages import let_page_scripts_write

log = logging.getLogger(__name__)

INPUT_LABEL = "dbh-bridge"
MAX_MESSAGE_CHARS = 1_000_000

# A counter makes every message differ: viser drops a value equal to the last one.
_PAGE_SCRIPT = """
window.dbh = (() => {
  let n = 0;
  return (kind, payload) => window.__viserMutable.sendMessage({
    type: 'GuiUpdateMessage', uuid: %s,
    updates: {value: JSON.stringify([++n, kind, payload === undefined ? null : payload])},
  });
})();
"""


def esc(text: object) -> str:
    """`text` for use inside HTML, in an element or a quoted attribute.

    Every name that a person or a file gave goes through this: the page interprets what ``add_html`` and
    ``add_markdown`` get. Markdown has meanings of its own (links, images): such names belong into ``add_html`` only.
    """
    return html.escape(str(text), quote=True).replace("`", "&#96;")


def call(kind: str, payload: Any = None) -> str:
    """JavaScript for an ``onclick="..."`` in ``add_html`` that sends `kind` and `payload`; escaped for the attribute.

    It does nothing in ``add_markdown``, whose page code rejects such attributes.
    """
    return esc(f"dbh({js(kind)},{js(payload)})")


def js(value: Any) -> str:
    """`value` as a JavaScript literal that is also harmless inside a ``<script>`` element."""
    text = json.dumps(value, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


class Bridge:
    """The channel of one tab. A reload is a new tab with a new bridge.

    In the page, ``dbh(kind, payload)`` calls what `on` registered for `kind`, in the tab's queue, in order.
    """

    def __init__(self, worker: TabWorker) -> None:
        self._worker = worker
        self._handlers: dict[str, Callable[[Any], Any]] = {}
        self._inbox = worker.client.gui.add_text(INPUT_LABEL, "", visible=False)
        let_page_scripts_write(self._inbox, MAX_MESSAGE_CHARS)

        @self._inbox.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self._receive(event.target.value)

        self.run(_PAGE_SCRIPT % js(self._inbox._impl.uuid))

    def on(self, kind: str, fn: Callable[[Any], Any], *, coalesce: bool = False, at_once: bool = False) -> None:
        """Run `fn(payload)` for every message of this kind.

        Args:
            kind: One handler per kind; a new one replaces the old.
            fn: Gets JSON data as Python values. It comes from a browser: check its type and range.
            coalesce: While messages of this kind wait, keep the latest only: for strokes and hovering.
            at_once: Run it beside the queue, see `TabWorker.run_at_once`: for Cancel.
        """
        worker = self._worker
        if at_once:
            self._handlers[kind] = partial(worker.run_at_once, fn)
        elif coalesce:
            self._handlers[kind] = partial(worker.post_latest, ("bridge", kind), fn)
        else:
            self._handlers[kind] = partial(worker.post, fn)

    def run(self, javascript: str) -> None:
        """Run a script in the page. Values go into it through `js`, never by pasting text."""
        self._worker.client._websock_connection.queue_message(wire.RunJavascriptMessage(source=javascript))

    def _receive(self, text: str) -> None:
        try:
            _, kind, payload = json.loads(text, parse_constant=_reject_constant)
        except (ValueError, TypeError, RecursionError):
            log.debug("Dropped a malformed message from the page")
            return
        take = self._handlers.get(kind) if isinstance(kind, str) else None
        if take is None:
            log.debug("Dropped a message of unknown kind from the page")
        else:
            take(payload)


def _reject_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")
