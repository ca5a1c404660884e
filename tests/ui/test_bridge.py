"""The channel between scripts in the page and Python, and text that goes into the page."""

from __future__ import annotations

import html
import json
import re
import threading
from typing import Any

import pytest
from fakeclient import BRIDGE_LABEL, FakeClient
from panel import LONG

from dbh_studio.ui import bridge as bridge_module
from dbh_studio.ui.bind import TabWorker
from dbh_studio.ui.bridge import Bridge, call, esc, js
from dbh_studio.ui.server import StudioServer


@pytest.fixture
def bridge(worker: TabWorker) -> Bridge:
    return Bridge(worker)


def send_text(tab: FakeClient, text: Any) -> None:
    tab.send(type="GuiUpdateMessage", uuid=tab.element(BRIDGE_LABEL, force=True).uuid, updates={"value": text})


def test_messages_arrive_in_order_with_their_payload(bridge: Bridge, tab: FakeClient) -> None:
    seen: list[Any] = []
    bridge.on("row", lambda payload: seen.append(("row", payload)))
    bridge.on("sort", lambda payload: seen.append(("sort", payload)))
    payloads = [3, "é<&", None, [1.5, [2]], {"a": True}]
    for payload in payloads:
        tab.bridge_send("row", payload)
        tab.bridge_send("sort", payload)
    tab.wait(lambda _: len(seen) == 10)
    assert seen == [(kind, payload) for payload in payloads for kind in ("row", "sort")]


def test_the_same_message_twice_is_two_messages(bridge: Bridge, tab: FakeClient) -> None:
    seen: list[Any] = []
    bridge.on("row", seen.append)
    tab.bridge_send("row", 3)
    tab.bridge_send("row", 3)
    tab.wait(lambda _: seen == [3, 3])


def test_messages_wait_their_turn_in_the_tab(bridge: Bridge, tab: FakeClient) -> None:
    seen: list[str] = []
    go = threading.Event()
    worker = bridge._worker
    worker.on_click(worker.client.gui.add_button("First"), lambda: (go.wait(LONG), seen.append("first")))
    bridge.on("row", lambda _: seen.append("second"))
    tab.press("First")
    tab.bridge_send("row", 1)
    tab.delivered()
    go.set()
    tab.wait(lambda _: seen == ["first", "second"])


def test_strokes_may_be_thinned_to_the_latest(bridge: Bridge, tab: FakeClient) -> None:
    seen: list[int] = []
    go, started = threading.Event(), threading.Event()
    bridge.on("stroke", seen.append, coalesce=True)
    bridge._worker.post(lambda: (started.set(), go.wait(LONG)))
    assert started.wait(LONG)
    for i in range(20):
        tab.bridge_send("stroke", i)
    tab.delivered()
    go.set()
    tab.settle()
    assert seen == [19]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not json",
        "[]",
        "[1]",
        '[1,"row"]',
        '[1,"row",2,3]',
        '{"a":1}',
        '[1,["row"],2]',
        '[1,"unknown",2]',
        '[1,"row",NaN]',
        '[1,"row",Infinity]',
        "[" * 100_000,
        7,
        None,
        '[1,"row","' + "x" * bridge_module.MAX_MESSAGE_CHARS + '"]',
    ],
    ids=lambda text: repr(text)[:24],
)
def test_malformed_messages_reach_nobody(bridge: Bridge, tab: FakeClient, text: Any) -> None:
    seen: list[Any] = []
    bridge.on("row", seen.append)
    send_text(tab, text)
    tab.bridge_send("row", "good")
    tab.settle()
    assert seen == ["good"] and not tab.notifications


def test_the_input_takes_nothing_but_its_value(bridge: Bridge, tab: FakeClient) -> None:
    element = tab.element(BRIDGE_LABEL, force=True)
    assert not tab.visible(element)
    seen: list[Any] = []
    bridge.on("row", seen.append)
    tab.send(type="GuiUpdateMessage", uuid=element.uuid, updates={"update_cb": []})
    tab.bridge_send("row", 1)
    tab.wait(lambda _: seen == [1])


def test_a_failing_handler_is_reported_like_any_other(bridge: Bridge, tab: FakeClient) -> None:
    bridge.on("row", lambda payload: payload["missing"])
    tab.bridge_send("row", {})
    tab.wait_notification("Unexpected error")


def test_the_page_gets_the_sending_function_and_further_scripts(bridge: Bridge, tab: FakeClient) -> None:
    bridge.run(f"document.title = {js('</script>')};")
    tab.wait(lambda t: len(t.javascript) == 2)
    assert "window.dbh" in tab.javascript[0] and tab.element(BRIDGE_LABEL, force=True).uuid in tab.javascript[0]
    assert "</script>" not in tab.javascript[1]


def test_a_reload_gets_a_new_bridge(server: StudioServer) -> None:
    seen: list[tuple[int, Any]] = []
    for n in (1, 2):
        with FakeClient(server.url) as tab:
            worker = TabWorker(tab.handle(server.viser))
            Bridge(worker).on("row", lambda payload, n=n: seen.append((n, payload)))
            tab.bridge_send("row", "x")
            tab.wait(lambda _, n=n: len(seen) == n)
            worker.close()
    assert seen == [(1, "x"), (2, "x")]


HOSTILE = """<img src=x onerror="alert('1')">&`</script>"""


def test_text_is_escaped_for_elements_and_attributes() -> None:
    escaped = esc(HOSTILE)
    assert not set("<>\"'`") & set(escaped)
    assert html.unescape(escaped) == HOSTILE
    assert esc(12) == "12"


def test_values_become_harmless_javascript() -> None:
    literal = js({"name": HOSTILE, "n": [1, None]})
    assert not set("<>&") & set(literal)
    assert json.loads(literal) == {"name": HOSTILE, "n": [1, None]}
    with pytest.raises(ValueError):
        js(float("nan"))


def test_an_onclick_attribute_survives_hostile_names() -> None:
    element = f'<tr onclick="{call("row", HOSTILE)}">'
    match = re.fullmatch(r'<tr onclick="([^"<>]*)">', element)
    assert match is not None
    code = html.unescape(match.group(1))
    kind, payload = re.fullmatch(r"dbh\((\"[^\"]*\"),(.*)\)", code).groups()  # type: ignore[union-attr]
    assert (json.loads(kind), json.loads(payload)) == ("row", HOSTILE)


def test_names_agree_with_the_fake_page() -> None:
    assert bridge_module.INPUT_LABEL == BRIDGE_LABEL
