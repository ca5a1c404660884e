"""Events of a tab: in order, once, on one thread, and never after the tab has gone."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

import numpy as np
import pytest
import viser
from fakeclient import FakeClient
from panel import LONG

from dbh_studio.errors import CancelledError, MalformedFileError, StudioError
from dbh_studio.ui.bind import SceneClick, SceneRectangle, TabWorker, for_each_tab
from dbh_studio.ui.server import StudioServer, start_server


class Gate:
    """A handler that says when it has started and waits to be let go."""

    def __init__(self) -> None:
        self.started, self.release = threading.Event(), threading.Event()

    def __call__(self, *_: Any) -> None:
        self.started.set()
        assert self.release.wait(LONG)


def test_work_runs_in_order_on_one_thread(worker: TabWorker) -> None:
    seen: list[tuple[int, str]] = []
    for i in range(200):
        assert worker.post(lambda i=i: seen.append((i, threading.current_thread().name)))
    assert worker.join(LONG)
    assert [i for i, _ in seen] == list(range(200))
    assert len({name for _, name in seen}) == 1 and seen[0][1] != threading.current_thread().name


def test_click_then_press_keeps_its_order(worker: TabWorker, tab: FakeClient) -> None:
    """viser's own thread pool runs these in any order."""
    seen: list[str] = []
    worker.on_scene_click(worker.client, lambda _: seen.append("click"))
    worker.on_click(worker.client.gui.add_button("Delete"), lambda: seen.append("delete"), once_at_a_time=False)
    worker.on_command(worker.client.gui.add_command("Undo"), lambda: seen.append("undo"))
    tab.element("Delete")
    for _ in range(20):
        tab.click_scene((0, 0, 1))
        tab.press("Delete", hurried=True)
        tab.command("Undo")
    tab.wait(lambda _: len(seen) == 60)
    assert seen == ["click", "delete", "undo"] * 20


def test_each_value_is_the_one_of_its_event(worker: TabWorker, tab: FakeClient) -> None:
    seen: list[int] = []
    gate = Gate()
    worker.on_update(worker.client.gui.add_slider("Height", 0, 100, 1, 0), seen.append)
    worker.post(gate)
    for value in range(1, 31):
        tab.set("Height", value, hurried=True)
    tab.delivered()
    gate.release.set()
    tab.wait(lambda _: len(seen) == 30)
    assert seen == list(range(1, 31))


def test_a_drag_leaves_only_its_latest_value(worker: TabWorker, tab: FakeClient) -> None:
    seen: list[Any] = []
    gate = Gate()
    slider = worker.client.gui.add_slider("Height", 0, 100, 1, 0)
    worker.on_update(slider, seen.append, coalesce=True)
    worker.on_click(worker.client.gui.add_button("Measure"), lambda: seen.append("measure"))
    worker.post(gate)
    for value in (1, 2, 3):
        tab.set("Height", value)
    tab.press("Measure")
    for value in (4, 5, 6):
        tab.set("Height", value)
    assert slider.value == 6
    gate.release.set()
    tab.settle()
    assert seen == [3, "measure", 6]  # the press still sees the value that was set before it


def test_two_streams_of_latest_values_do_not_push_each_other_along(worker: TabWorker) -> None:
    seen: list[tuple[str, int]] = []
    gate = Gate()
    worker.post(gate)
    for i in range(5):
        worker.post_latest("a", lambda i: seen.append(("a", i)), i)
        worker.post_latest("b", lambda i: seen.append(("b", i)), i)
    gate.release.set()
    assert worker.join(LONG)
    assert seen == [("a", 4), ("b", 4)]


def test_a_press_while_the_first_is_dealt_with_does_nothing(
    worker: TabWorker, tab: FakeClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dbh_studio.ui.bind._DOUBLE_CLICK_S", 0.0)  # however long it comes after it
    gate, runs = Gate(), []
    worker.on_click(worker.client.gui.add_button("Segment"), lambda: (runs.append(1), gate()))
    other: list[int] = []
    worker.on_click(worker.client.gui.add_button("Other"), lambda: other.append(1))
    tab.press("Segment")
    assert gate.started.wait(LONG)
    tab.press("Segment", hurried=True)
    tab.press("Segment", hurried=True)
    tab.press("Other")
    tab.wait(lambda _: len(worker._queue) == 1)
    gate.release.set()
    tab.wait(lambda _: other == [1])
    tab.settle()
    assert len(runs) == 1
    tab.press("Segment")  # and works again afterwards, also after a failure
    tab.wait(lambda _: len(runs) == 2)


def test_a_button_works_again_after_its_handler_failed(worker: TabWorker, tab: FakeClient) -> None:
    runs: list[int] = []

    def fail() -> None:
        runs.append(1)
        raise StudioError("No trunk is selected.", "Click one first.")

    worker.on_click(worker.client.gui.add_button("Measure"), fail)
    tab.press("Measure")
    tab.wait_notification("No trunk is selected.")
    assert worker.join(LONG)
    tab.press("Measure")
    tab.wait(lambda _: len(runs) == 2)


def test_cancel_does_not_wait_in_the_queue(worker: TabWorker, tab: FakeClient) -> None:
    gate = Gate()
    worker.on_click(worker.client.gui.add_button("Run"), gate)
    tab.press("Run")
    assert gate.started.wait(LONG)
    worker.run_at_once(gate.release.set)
    assert gate.release.wait(LONG)


def test_changes_by_the_program_are_not_events(worker: TabWorker, tab: FakeClient) -> None:
    seen: list[Any] = []
    box = worker.client.gui.add_checkbox("Labels", False)
    worker.on_update(box, seen.append)
    box.value = True
    tab.wait(lambda t: t.value("Labels") is True)
    tab.set("Labels", False)
    tab.settle()
    assert seen == [False]


def test_a_shared_element_tells_only_the_tab_that_used_it(
    server: StudioServer, worker: TabWorker, tab: FakeClient
) -> None:
    shared = server.viser.gui.add_button("Shared")
    mine: list[int] = []
    theirs: list[int] = []
    worker.on_click(shared, lambda: mine.append(1))
    with FakeClient(server.url) as second:
        other = TabWorker(second.handle(server.viser))
        other.on_click(shared, lambda: theirs.append(1))
        second.press("Shared")
        second.wait(lambda _: theirs == [1])
        tab.settle()
        assert mine == []
        other.close()
    shared.remove()


def test_button_groups_and_texts(worker: TabWorker, tab: FakeClient) -> None:
    seen: list[Any] = []
    worker.on_update(worker.client.gui.add_button_group("Mode", ("near", "far")), seen.append)
    worker.on_update(worker.client.gui.add_text("Species", "oak"), seen.append)
    tab.set("Mode", "far")
    tab.set("Species", "beech")
    tab.wait(lambda _: len(seen) == 2)
    assert seen == ["far", "beech"]


def test_the_fake_page_settles_when_all_it_set_off_has_arrived(worker: TabWorker, tab: FakeClient) -> None:
    gate = Gate()

    def slowly() -> None:
        gate()
        worker.notify("one")
        worker.post(lambda: (time.sleep(0.5), worker.notify("two")))

    worker.on_click(worker.client.gui.add_button("Go"), slowly)
    tab.press("Go")
    assert not tab.delivered().notifications
    gate.release.set()
    assert [note.title for note in tab.settle().notifications] == ["one", "two"]


# -- gestures -------------------------------------------------------------------------------------------------------


def test_a_scene_click_brings_ray_and_camera(worker: TabWorker, tab: FakeClient) -> None:
    clicks: list[SceneClick] = []
    worker.on_scene_click(worker.client, clicks.append)
    target = np.array([0.5, 0.3, 1.1])
    tab.look((1.0, -8.0, 3.0), (0.0, 0.0, 1.0))
    tab.click_scene(target)
    tab.wait(lambda _: len(clicks) == 1)
    click = clicks[0]
    np.testing.assert_allclose(click.ray_origin, [1.0, -8.0, 3.0])
    np.testing.assert_allclose(np.cross(click.ray_direction, target - click.ray_origin), 0, atol=1e-12)
    # The view projects the target to the very place that was clicked, and back.
    np.testing.assert_allclose(click.view.project(target[None])[0], click.screen_xy, atol=1e-9)
    np.testing.assert_allclose(click.view.ray(click.screen_xy), click.ray_direction, atol=1e-9)
    assert click.view.height_px == 800 and click.view.aspect == pytest.approx(1.6)


def test_modifiers_keep_gestures_apart(worker: TabWorker, tab: FakeClient) -> None:
    seen: list[Any] = []
    worker.on_scene_click(worker.client, lambda _: seen.append("plain"))
    worker.on_scene_click(worker.client, lambda e: seen.append(e.modifier), modifier="cmd/ctrl")
    worker.on_scene_rectangle(worker.client, seen.append)
    tab.click_scene((0, 0, 1), modifier="cmd/ctrl")
    tab.click_scene((0, 0, 1))
    tab.rect((0.6, 0.2), (0.4, 0.3))
    tab.wait(lambda _: len(seen) == 3)
    assert seen[:2] == ["cmd/ctrl", "plain"]
    assert isinstance(seen[2], SceneRectangle) and (seen[2].lower_xy, seen[2].upper_xy) == ((0.4, 0.2), (0.6, 0.3))


@pytest.mark.parametrize("key", ["W", "s", "arrowup", "E"])
def test_keys_that_move_the_camera_are_refused(worker: TabWorker, key: str) -> None:
    with pytest.raises(ValueError, match="moves the camera"):
        worker.add_command("Save", lambda: None, hotkey=key)


def test_a_hotkey_runs_its_command(worker: TabWorker, tab: FakeClient) -> None:
    seen: list[int] = []
    worker.add_command("Undo", lambda: seen.append(1), hotkey="Z", modifier="cmd/ctrl")
    tab.command("Undo")
    tab.command("Undo")
    tab.wait(lambda _: seen == [1, 1])
    assert tab.commands()["Undo"] == ("Z", "cmd/ctrl")


# -- what goes wrong ------------------------------------------------------------------------------------------------


def test_a_studio_error_is_shown_with_its_remedy(
    worker: TabWorker, tab: FakeClient, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise MalformedFileError("plots/oak.ply", "The header is broken.", "Export it again.")

    worker.post(fail)
    note = tab.wait_notification("header is broken")
    assert (note.title, note.body, note.color) == ("oak.ply: The header is broken.", "Export it again.", "red")
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


def test_an_unexpected_error_is_logged_and_not_spelled_out(
    worker: TabWorker, tab: FakeClient, caplog: pytest.LogCaptureFixture
) -> None:
    worker.post(lambda: {}["secret"])
    note = tab.wait_notification("Unexpected error")
    assert "secret" not in note.title + note.body and "Traceback" not in note.body
    assert "KeyError: 'secret'" in caplog.text
    done = threading.Event()
    worker.post(done.set)
    assert done.wait(LONG)  # the tab goes on


def test_cancelled_work_is_not_an_error(worker: TabWorker, tab: FakeClient) -> None:
    def cancelled() -> None:
        raise CancelledError

    worker.post(cancelled)
    assert tab.wait_notification("Cancelled").color == "blue"


def test_long_notes_are_cut(worker: TabWorker, tab: FakeClient) -> None:
    worker.notify("x" * 5000, "y" * 5000, "warning")
    note = tab.wait_notification("xxx")
    assert len(note.title) <= 600 and len(note.body) <= 600 and note.body.endswith("…")


# -- the end of a tab -----------------------------------------------------------------------------------------------


def test_after_close_nothing_runs_and_nothing_listens(worker: TabWorker, tab: FakeClient) -> None:
    gui = worker.client.gui
    gate, seen = Gate(), []
    button, box = gui.add_button("Go"), gui.add_checkbox("Box", False)
    command = worker.add_command("Undo", lambda: seen.append("undo"))
    worker.on_click(button, lambda: seen.append("go"))
    worker.on_update(box, seen.append)
    worker.on_scene_click(worker.client, lambda _: seen.append("click"))
    worker.on_close(lambda: seen.append("closed"))
    worker.post(gate)
    assert gate.started.wait(LONG)
    worker.post(seen.append, "queued")
    worker.close()
    worker.close()
    gate.release.set()
    assert worker.closed and worker.join(LONG) and not worker.post(seen.append, "late")
    assert not button._impl.update_cb and not box._impl.update_cb and not command._impl.trigger_cb
    assert not worker.client.scene._scene_pointer_cb
    worker.on_close(lambda: seen.append("closed late"))
    worker.run_at_once(seen.append, "too late")
    worker.notify("never shown")
    worker._thread.join(LONG)
    assert not worker._thread.is_alive()
    assert seen == ["closed", "closed late"]
    assert not any("never shown" in note.title for note in tab.settle().notifications)


def test_a_listener_that_fails_to_leave_does_not_keep_the_others(
    worker: TabWorker, caplog: pytest.LogCaptureFixture
) -> None:
    left: list[int] = []
    worker.on_close(lambda: left.remove(9))
    worker.on_close(lambda: left.append(1))
    worker.close()
    assert left == [1] and "Could not clean up" in caplog.text


def test_every_tab_gets_a_worker_and_loses_it(server: StudioServer) -> None:
    own = start_server(port=0)
    workers: list[TabWorker] = []

    def open_tab(worker: TabWorker) -> None:
        worker.client.gui.add_markdown(f"tab {len(workers)}")
        workers.append(worker)

    for_each_tab(own.viser, open_tab)
    try:
        with FakeClient(own.url) as first, FakeClient(own.url) as second:
            first.wait_text("tab")
            second.wait_text("tab")
            first.wait(lambda _: len(workers) == 2)
            assert len(workers) == 2 and not any(w.closed for w in workers)
            first.close()
            second.wait(lambda _: sum(w.closed for w in workers) == 1)
        with FakeClient(own.url) as again:
            again.wait_text("tab 2")
    finally:
        own.stop()


def test_work_that_outlives_its_tab_is_harmless(server: StudioServer, caplog: pytest.LogCaptureFixture) -> None:
    with FakeClient(server.url) as tab:
        worker = TabWorker(tab.handle(server.viser))
        text = worker.client.gui.add_markdown("before")
        gate = Gate()
        worker.post(lambda: (gate(), setattr(text, "content", "after"), worker.notify("done")))
        assert gate.started.wait(LONG)
    client_id = worker.client.client_id
    tab.wait(lambda _: client_id not in server.viser.get_clients())
    worker.close()
    gate.release.set()
    worker._thread.join(LONG)
    assert not worker._thread.is_alive() and not caplog.records


def test_a_flood_is_cut_off(
    worker: TabWorker, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("dbh_studio.ui.bind._MAX_QUEUED", 5)
    gate, seen = Gate(), []
    worker.post(gate)
    assert gate.started.wait(LONG)
    accepted = [worker.post(seen.append, i) for i in range(8)]
    gate.release.set()
    assert worker.join(LONG) and accepted == [True] * 5 + [False] * 3 and seen == list(range(5))
    assert "too far behind" in caplog.text


def test_viser_still_has_the_parts_we_lean_on(worker: TabWorker) -> None:
    """Private names used by the wrapper: a moved pin fails here first."""
    client = worker.client
    assert isinstance(client, viser.ClientHandle)
    assert isinstance(client.gui._gui_input_handle_from_uuid, dict)
    assert hasattr(client._websock_connection, "_handle_incoming_message")
    assert hasattr(client._websock_connection.get_message_buffer(), "_warned_push_after_done")
