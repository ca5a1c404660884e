"""The attacks that stock viser 1.1.1 lets through, each over a real socket, and the rules that stop them."""

from __future__ import annotations

import math
import socket
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import viser
from fakeclient import FakeClient, http_get, login
from websockets.exceptions import InvalidStatus

from dbh_studio.errors import MissingComponentError, StudioError
from dbh_studio.ui import server as server_module
from dbh_studio.ui.guard import Guard, RouteRequest, content_security_policy
from dbh_studio.ui.server import StudioServer, start_server


class Panel:
    """One element of each kind in one scope, and what their callbacks saw."""

    def __init__(self, gui: viser.GuiApi, prefix: str) -> None:
        self.prefix, self.events = prefix, []
        self.go = gui.add_button(f"{prefix} go")
        self.off = gui.add_button(f"{prefix} off", disabled=True)
        self.hidden = gui.add_button(f"{prefix} hidden", visible=False)
        with gui.add_folder(f"{prefix} folder", visible=False), gui.add_folder(f"{prefix} inner"):
            self.nested = gui.add_button(f"{prefix} nested")
        tabs = gui.add_tab_group(visible=False)
        with tabs.add_tab("tab"):
            self.tabbed = gui.add_button(f"{prefix} tabbed")
        self.inputs = {
            "check": gui.add_checkbox("check", False),
            "slider": gui.add_slider("slider", 0, 10, 1, 5),
            "real": gui.add_slider("real", 0.0, 1.0, 0.1, 0.5),
            "number": gui.add_number("number", 2.0, min=1.0, max=3.0),
            "choice": gui.add_dropdown("choice", ("fourier", "ellipse")),
            "group": gui.add_button_group("group", ("near", "far")),
            "text": gui.add_text("text", "oak"),
            "range": gui.add_multi_slider("range", 0.0, 10.0, 0.1, (2.0, 4.0)),
            "vector": gui.add_vector2("vector", (0.0, 0.0), min=(-1.0, -1.0), max=(1.0, 1.0)),
            "colour": gui.add_rgb("colour", (1, 2, 3)),
            "bar": gui.add_progress_bar(10.0),
            "upload": gui.add_upload_button("upload"),
        }
        for button in (self.go, self.off, self.hidden, self.nested, self.tabbed):
            button.on_click(self._record(button.label))
        for name, handle in self.inputs.items():
            handle._impl.update_cb.append(self._record(name))

    def _record(self, name: str) -> Any:
        async def seen(_: viser.GuiEvent[Any]) -> None:
            self.events.append(name)

        return seen


@pytest.fixture(params=["shared", "private"])
def panel(request: pytest.FixtureRequest, server: StudioServer, tab: FakeClient) -> Iterator[Panel]:
    """The same elements once for all tabs and once for this tab only: each scope has its own dispatcher."""
    gui = server.viser.gui if request.param == "shared" else tab.handle(server.viser).gui
    made = Panel(gui, request.param)
    tab.element(f"{request.param} go")
    yield made
    if request.param == "shared":
        server.viser.gui.reset()


def forge(tab: FakeClient, handle: Any, **updates: Any) -> None:
    tab.send(type="GuiUpdateMessage", uuid=handle._impl.uuid, updates=updates)


def events_up_to_go(tab: FakeClient, panel: Panel) -> list[str]:
    """What callbacks ran before a rightful press that follows: messages are handled in order."""
    tab.press(f"{panel.prefix} go")
    tab.wait(lambda _: f"{panel.prefix} go" in panel.events)
    return [event for event in panel.events if event != f"{panel.prefix} go"]


def test_a_cookie_of_another_program_does_not_lock_anybody_out(server: StudioServer) -> None:
    """Cookies do not know ports: whatever else runs on this machine may have set one."""
    base = f"http://127.0.0.1:{server.port}/"
    cookie = login(server.url)
    for odd in ('state={"a": [1, 2], "b"}', "a b=c", "=", "x" * 50, '"', "dbh_studio=1"):
        assert http_get(base, {"Cookie": f"{odd}; {cookie}; {odd}"})[0] == 200, odd
    assert http_get(base, {"Cookie": f"{cookie}x"})[0] == 401


# -- the door -------------------------------------------------------------------------------------------------------


def test_listens_on_loopback_only(server: StudioServer) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=60):
        pass
    if sys.platform != "linux":
        pytest.skip("only Linux answers on all of 127.0.0.0/8 without set-up")
    with socket.socket() as probe:  # the port is free on another address of this machine, so it is not 0.0.0.0
        probe.bind(("127.0.0.2", server.port))


def test_no_page_without_the_token(server: StudioServer) -> None:
    base = f"http://127.0.0.1:{server.port}/"
    assert http_get(base)[0] == 401
    assert http_get(base + "?token=wrong-wrong-wrong-wrong")[0] == 401
    assert http_get(base + "?token=%C3%A9")[0] == 401
    assert http_get(base, {"Cookie": f"{server.guard.cookie_name}=guess"})[0] == 401


def test_token_becomes_a_strict_cookie_and_leaves_the_address(server: StudioServer) -> None:
    status, headers, _ = http_get(server.url + "&fixedDpr=1")
    assert status == 303
    assert headers["location"] == "/?fixedDpr=1"
    cookie, *attributes = headers["set-cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= set(attributes)
    assert server.guard.token not in cookie
    status, headers, body = http_get(f"http://127.0.0.1:{server.port}/", {"Cookie": cookie})
    assert status == 200 and b"<html" in body.lower()


def test_the_login_redirects_nowhere_else(server: StudioServer) -> None:
    url = f"http://127.0.0.1:{server.port}//evil.example/?token={server.guard.token}"
    assert http_get(url)[1]["location"] == "/"


def test_websocket_needs_the_cookie(server: StudioServer) -> None:
    with pytest.raises(InvalidStatus) as refused:
        FakeClient(server.url, cookie="")
    assert refused.value.response.status_code == 401


def test_websocket_of_another_web_page_is_refused(server: StudioServer) -> None:
    for origin in ("http://evil.example", f"http://localhost.evil.example:{server.port}", "null", "file://"):
        with pytest.raises(InvalidStatus) as refused:
            FakeClient(server.url, origin=origin)
        assert refused.value.response.status_code == 403, origin


def test_another_local_port_is_another_origin(server: StudioServer) -> None:
    with pytest.raises(InvalidStatus) as refused:
        FakeClient(server.url, origin="http://127.0.0.1:1")
    assert refused.value.response.status_code == 403


def test_dns_rebinding_is_refused(server: StudioServer) -> None:
    cookie = login(server.url)
    for host in ("evil.example", f"evil.example:{server.port}", "127.0.0.1:1", "127.0.0.1"):
        assert http_get(f"http://127.0.0.1:{server.port}/", {"Host": host, "Cookie": cookie})[0] == 421, host
    assert (
        http_get(f"http://127.0.0.1:{server.port}/", {"Host": f"localhost:{server.port}", "Cookie": cookie})[0] == 200
    )


@pytest.mark.parametrize("name", ["websocket", "playbackPath"])
def test_a_link_cannot_make_the_page_load_a_foreign_server(server: StudioServer, name: str) -> None:
    cookie = login(server.url)
    base = f"http://127.0.0.1:{server.port}/?{name}="
    own = f"127.0.0.1:{server.port}"
    for address in (
        "ws://rogue:9",
        "//rogue/x",
        "http://rogue/x.viser",
        f"ws://{own}@rogue",
        f"ws:\\\\rogue\\{own}",
        "x",
    ):
        assert http_get(base + address, {"Cookie": cookie})[0] == 400, address
    assert http_get(f"{base}ws%3A%2F%2F{own}", {"Cookie": cookie})[0] == 200


def test_the_token_does_not_excuse_a_foreign_server_in_the_link(server: StudioServer) -> None:
    assert http_get(server.url + "&websocket=ws://rogue:9")[0] == 400


def test_the_page_may_connect_to_this_server_only(server: StudioServer) -> None:
    policy = http_get(f"http://127.0.0.1:{server.port}/", {"Cookie": login(server.url)})[1]["content-security-policy"]
    connect = next(part for part in policy.split("; ") if part.startswith("connect-src")).split()[1:]
    assert f"ws://127.0.0.1:{server.port}" in connect
    assert not {"*", "ws:", "wss:", "http:", "https:"} & set(connect)
    assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy


# -- the messages ---------------------------------------------------------------------------------------------------


def test_buttons_that_cannot_be_pressed_do_not_fire(tab: FakeClient, panel: Panel) -> None:
    for handle in (panel.off, panel.hidden, panel.nested, panel.tabbed):
        forge(tab, handle, value=True)
    assert events_up_to_go(tab, panel) == []


ILLEGAL = [
    ("check", 1),
    ("check", "yes"),
    ("slider", 999),
    ("slider", -1),
    ("slider", 2.5),
    ("slider", True),
    ("slider", "5"),
    ("real", 1.5),
    ("real", math.nan),
    ("real", math.inf),
    ("number", 0.5),
    ("number", None),
    ("choice", "<script>"),
    ("choice", ["ellipse"]),
    ("group", "elsewhere"),
    ("text", "x" * 10_001),
    ("text", 7),
    ("range", [2.0, 11.0]),
    ("range", [2.0]),
    ("vector", [0.5, 2.0]),
    ("vector", [0.5]),
    ("vector", [0.5, "x"]),
    ("colour", [0, 0, 256]),
    ("colour", [0, 0, 0.5]),
    ("bar", 99.0),
    ("upload", "x"),
]
LEGAL = [
    ("check", True),
    ("slider", 10),
    ("real", 1),
    ("number", 2.5),
    ("choice", "ellipse"),
    ("group", "far"),
    ("text", "beech"),
    ("range", [1.0, 9.0]),
    ("vector", [1.0, -1.0]),
    ("colour", [255, 0, 9]),
]


def test_only_values_that_the_element_offers_are_taken(tab: FakeClient, panel: Panel) -> None:
    before = {name: handle.value for name, handle in panel.inputs.items()}
    for name, value in ILLEGAL:
        forge(tab, panel.inputs[name], value=value)
    assert events_up_to_go(tab, panel) == []
    assert {name: handle.value for name, handle in panel.inputs.items()} == before


def test_legal_values_are_taken(tab: FakeClient, panel: Panel) -> None:
    for name, value in LEGAL:
        forge(tab, panel.inputs[name], value=value)
    assert events_up_to_go(tab, panel) == [name for name, _ in LEGAL]
    assert all(panel.inputs[name].value == (tuple(v) if isinstance(v, list) else v) for name, v in LEGAL)


def test_internal_state_cannot_be_set(tab: FakeClient, panel: Panel) -> None:
    forge(tab, panel.go, update_cb=[])
    forge(tab, panel.go, removed=True)
    forge(tab, panel.inputs["slider"], value=6, update_cb=[])
    forge(tab, panel.off, props={"disabled": False})
    assert events_up_to_go(tab, panel) == []
    assert len(panel.go._impl.update_cb) == 1 and panel.inputs["slider"].value == 5 and panel.off.disabled


def test_unhashable_and_unknown_targets_do_no_harm(tab: FakeClient, panel: Panel) -> None:
    for target in (["x"], {"x": 1}, None, 3, "nobody"):
        tab.send(type="GuiUpdateMessage", uuid=target, updates={"value": True})
    assert events_up_to_go(tab, panel) == []


def test_a_tab_cannot_reach_the_private_elements_of_another(server: StudioServer, tab: FakeClient) -> None:
    mine = Panel(tab.handle(server.viser).gui, "mine")
    tab.element("mine go")
    with FakeClient(server.url) as other:
        theirs = Panel(other.handle(server.viser).gui, "theirs")
        other.element("theirs go")
        forge(other, mine.go, value=True)
        events_up_to_go(other, theirs)
        tab.settle()
    assert mine.events == []


def test_no_client_can_open_a_public_tunnel(
    server: StudioServer, tab: FakeClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(server.viser, "request_share_url", lambda *_: asked.append("share"))
    monkeypatch.setattr(server.viser, "disconnect_share_url", lambda *_: asked.append("unshare"))
    tab.send(type="ShareUrlRequest")
    tab.send(type="ShareUrlDisconnect")
    panel = Panel(server.viser.gui, "after")
    events_up_to_go(tab, panel)
    server.viser.gui.reset()
    assert asked == []


def test_a_page_cannot_send_scripts_or_signals_to_other_pages(server: StudioServer, tab: FakeClient) -> None:
    panel = Panel(server.viser.gui, "after")
    with FakeClient(server.url) as other:
        tab.send(type="RunJavascriptMessage", source="alert(1)")
        tab.send(type="GuiFormDirtyMessage", uuid="x")
        tab.send(type="GuiFormSubmitMessage", uuid="x")
        events_up_to_go(tab, panel)
        other.settle()
        assert not {"RunJavascriptMessage", "GuiFormDirtyMessage", "GuiFormSubmitMessage"} & {
            m["type"] for m in other.messages
        }
    server.viser.gui.reset()


@pytest.mark.parametrize(
    "junk",
    [b"", b"\xff" * 64, b"\x80", "text", b"\x81\xa4type\xa5never"],
    ids=["none", "bytes", "empty", "text", "type"],
)
def test_garbage_ends_only_its_own_connection(server: StudioServer, tab: FakeClient, junk: bytes | str) -> None:
    with FakeClient(server.url) as attacker:
        attacker.send_raw(junk)
        attacker.wait(lambda t: t.closed)
    panel = Panel(server.viser.gui, "after")
    assert events_up_to_go(tab, panel) == [] and not tab.closed
    server.viser.gui.reset()


def test_impossible_cameras_and_rays_are_dropped(server: StudioServer, tab: FakeClient) -> None:
    client = tab.handle(server.viser)
    rays: list[Any] = []
    client.scene.on_click()(lambda event: rays.append(event.ray_direction))
    camera = next_camera = dict(
        type="ViewerCameraMessage", wxyz=[1.0, 0, 0, 0], position=[0.0, 0, 0], fov=1.0, near=0.1, far=10.0,
        image_height=10, image_width=10, look_at=[0.0, 0, 1], up_direction=[0.0, 0, 1],
    )  # fmt: skip
    before = client.camera.position.copy()
    for change in ({"position": [math.nan, 0.0, 0.0]}, {"fov": 0.0}, {"wxyz": [0.0, 0, 0, 0]}, {"fov": math.inf}):
        tab.send(**{**next_camera, **change})
    click = dict(type="ScenePointerMessage", event_type="click", ray_origin=[0.0, 0, 0], modifier=None)
    tab.send(**click, ray_direction=[math.nan, 0.0, 0.0], screen_pos=[[0.5, 0.5]])
    tab.send(**click, ray_direction=[0.0, 0.0, 0.0], screen_pos=[[0.5, 0.5]])
    tab.send(**click, ray_direction=None, screen_pos=[[0.5, 0.5]])
    tab.send(**click, ray_direction=[0.0, 1.0, 0.0], screen_pos=[])
    tab.send(**click, ray_direction=[0.0, 0.0, 1.0], screen_pos=[[0.5, 0.5]])
    tab.wait(lambda _: len(rays) > 0)
    assert rays == [(0.0, 0.0, 1.0)]
    assert (client.camera.position == before).all()
    tab.send(**camera)
    tab.wait(lambda _: (client.camera.position == 0).all())


# -- the studio's own pages -----------------------------------------------------------------------------------------


def test_routes_are_served_to_a_session_only(server: StudioServer) -> None:
    asked: list[RouteRequest] = []

    def photo(request: RouteRequest) -> tuple[int, str, bytes]:
        asked.append(request)
        return 200, "image/jpeg", b"\xff\xd8"

    server.routes["/frame.jpg"] = photo
    server.routes["/frames/"] = photo
    url = f"http://127.0.0.1:{server.port}"
    assert http_get(url + "/frame.jpg")[0] == 401 and not asked
    cookie = {"Cookie": login(server.url)}
    status, headers, body = http_get(url + "/frame.jpg?w=3", cookie)
    assert (status, headers["content-type"], body) == (200, "image/jpeg", b"\xff\xd8")
    assert asked == [RouteRequest("/frame.jpg", {"w": "3"})]
    assert http_get(url + "/frames/7.jpg", cookie)[0] == 200 and asked[-1].path == "/frames/7.jpg"
    assert http_get(url + "/nothing", cookie)[0] == 404


def test_a_route_that_fails_says_nothing_of_its_insides(server: StudioServer, caplog: pytest.LogCaptureFixture) -> None:
    server.routes["/broken"] = lambda _: 1 / 0  # type: ignore[assignment,return-value]
    status, _, body = http_get(f"http://127.0.0.1:{server.port}/broken", {"Cookie": login(server.url)})
    assert status == 500 and b"ZeroDivision" not in body
    assert "ZeroDivisionError" in caplog.text


# -- starting -------------------------------------------------------------------------------------------------------


def test_another_viser_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser, "__version__", "1.1.2")
    with pytest.raises(MissingComponentError, match=r"1\.1\.2.*exactly 1\.1\.1"):
        start_server(port=0)


def test_a_taken_port(server: StudioServer, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StudioError, match=f"Port {server.port} is taken"):
        start_server(port=server.port, strict_port=True)
    monkeypatch.setattr(server_module, "_N_PORTS_TRIED", 200)
    second = start_server(port=server.port)
    try:
        assert second.port > server.port and f"Port {server.port} is taken; using {second.port}" in second.note
        assert second.guard.cookie_name != server.guard.cookie_name
        assert http_get(f"http://127.0.0.1:{second.port}/", {"Cookie": login(server.url)})[0] == 401
        with FakeClient(second.url):
            pass
    finally:
        second.stop()


def test_an_address_that_is_not_ours_is_a_clear_error() -> None:
    with pytest.raises(StudioError, match=r"cannot listen on 192\.0\.2\.1"):
        start_server(host="192.0.2.1", port=0)


def test_the_network_only_when_asked_and_then_with_a_token_too() -> None:
    running = start_server(host="0.0.0.0", port=0)
    try:
        assert "Other machines may connect" in running.note and running.guard.token in running.url
        assert http_get(f"http://127.0.0.1:{running.port}/")[0] == 401
        cookie = {"Cookie": login(running.url)}
        local = f"http://127.0.0.1:{running.port}/"
        assert http_get(local, {**cookie, "Host": f"10.1.2.3:{running.port}"})[0] == 200
        assert http_get(local, {**cookie, "Host": f"evil.example:{running.port}"})[0] == 421
    finally:
        running.stop()


@pytest.mark.parametrize("token", ["", "short", "x" * 15, "with space and more", "a;b=c;d=e;f=g;h=i", "x" * 200])
def test_weak_or_unsafe_tokens_are_refused(token: str) -> None:
    with pytest.raises(ValueError, match="token"):
        start_server(port=0, token=token)


def test_stopping_frees_the_port_and_ends_the_tabs() -> None:
    running = start_server(port=0, token="a-token-of-my-own_1")
    assert running.url.endswith("?token=a-token-of-my-own_1")
    with FakeClient(running.url) as tab:
        running.stop()
        tab.wait(lambda t: t.closed)
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", running.port), timeout=60).close()


# -- rules without a server -----------------------------------------------------------------------------------------


def request(host: str = "127.0.0.1:8080", path: str = "/", **headers: str) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Request

    return Request(path, Headers([("Host", host), *headers.items()]))


def test_nothing_is_served_before_the_message_checks_are_in_place() -> None:
    guard = Guard()
    reply = guard.check(request(path=f"/?token={guard.token}"))
    assert reply is not None and reply.status_code == 503


def test_a_proxy_in_front_is_let_in_by_name_only() -> None:
    guard = Guard(allowed_hosts=("forest.example",))
    guard.open(8080)
    login_path = f"/?token={guard.token}"
    for host, status in (
        ("forest.example", 303),
        ("forest.example:8080", 303),
        ("forest.example:1", 421),
        ("127.0.0.1", 421),
    ):
        reply = guard.check(request(host, login_path))
        assert reply is not None and reply.status_code == status, host
    reply = guard.check(request("forest.example", login_path, Origin="https://forest.example"))
    assert reply is not None and reply.status_code == 303


def test_malformed_requests_are_refused() -> None:
    guard = Guard()
    guard.open(8080)
    reply = guard.check(request(path="http://[bad/"))
    assert reply is not None and reply.status_code == 400
    from websockets.datastructures import Headers
    from websockets.http11 import Request

    for headers in ([], [("Host", "127.0.0.1:8080"), ("Host", "evil.example")]):
        reply = guard.check(Request("/", Headers(headers)))
        assert reply is not None and reply.status_code == 421


def test_policy_for_numeric_ipv6_names_no_socket() -> None:
    assert "[::1]" not in content_security_policy("[::1]:8080")
