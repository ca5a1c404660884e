"""Correcting trunks in a tab: tools, selections, commands, what is said, and what happens when it cannot be done."""

from __future__ import annotations

import numpy as np
import pytest
from edit_helpers import ask, bar, box_about, draw, offered, points_of, stand_before
from fakeclient import FakeClient
from panel import LONG, choose

from dbh_studio.app import commands, edits
from dbh_studio.core.dbh import DbhEstimate


@pytest.fixture
def tab(measured, studio):
    """The plot with its first tree chosen and the tools open; the camera looks at the tree."""
    choose(measured, studio.session.document.trunks.ids[0])
    ask(measured, "open")
    measured.wait(lambda t: bar(t).get("hasTree"))
    measured.wait_text("The tools are over the picture")
    stand_before(measured, studio, first(studio))
    return measured


def first(studio) -> int:
    return studio.session.document.trunks.ids[0]


def dbh(studio, trunk_id: int) -> float:
    result = studio.session.measurement(trunk_id).result
    assert isinstance(result, DbhEstimate)
    return result.dbh_cm


def select_upper(tab: FakeClient, studio, trunk_id: int) -> np.ndarray:
    """Select the upper part of a trunk by a lasso; its rows."""
    points = points_of(studio, trunk_id)
    upper = points[:, 2] > np.quantile(points[:, 2], 0.8)
    ask(tab, "tool", "lasso")
    tab.wait(lambda t: bar(t).get("draws"))
    draw(tab, "lasso", box_about(tab, points[upper], margin=0.0))
    tab.wait(lambda t: "selected" in bar(t)["chosen"])
    return studio.session.document.trunks[trunk_id].points[upper]


def test_the_section_opens_the_bar_and_closes_it(measured, studio):
    measured.wait_text("Correct the trunks")
    assert bar(measured) == {}
    ask(measured, "merge")  # nothing is done while the bar is closed
    ask(measured, "open")
    measured.wait(lambda t: bar(t).get("chosen") == "No tree chosen")
    assert offered(measured) == []
    assert not any(note.color == "red" for note in measured.notifications)
    choose(measured, first(studio))
    measured.wait(lambda t: bar(t)["chosen"] == f"Tree {first(studio)}")
    assert offered(measured) == ["split", "grow", "shrink", "delete"]
    ask(measured, "close")
    measured.wait(lambda t: bar(t) == {})
    measured.wait_text(f"Correct tree {first(studio)}")


def test_the_bar_is_gone_in_the_other_steps(tab):
    tab.bridge_send("step", "export")
    tab.wait(lambda t: bar(t) == {})
    tab.bridge_send("step", "inspect")
    tab.wait(lambda t: bar(t).get("hasTree"))


def test_keys_take_tools_and_all_are_listed(tab):
    known = tab.commands()
    for tool, _title, key, _tip in bar(tab)["tools"]:
        assert (key, None) in known.values()
        tab.send_key = None
        command = next(label for label, keys in known.items() if keys == (key, None))
        tab.command(command)
        tab.wait(lambda t, tool=tool: bar(t)["tool"] == tool)
    own = [keys for label, keys in known.items() if keys[0] is not None]
    # Escape ends several things, each of which looks whether it is meant.
    assert len({keys for keys in own if keys[0] != "escape"}) == len([keys for keys in own if keys[0] != "escape"])
    assert not {"W", "A", "S", "D", "Q", "E"} & {keys[0] for keys in own}
    listed = " ".join(key for key, _ in bar(tab)["keys"])
    assert "Delete" in listed and "[" in listed and "Shift+M" in listed


def test_a_lasso_selects_points_of_the_tree_and_takes_them_off(tab, studio):
    tree = first(studio)
    before = dbh(studio, tree)
    rows = select_upper(tab, studio, tree)
    n_own = len(studio.session.document.trunks[tree])
    tab.wait(lambda t: "/edit/chosen" in t.scene)
    n_selected = int(bar(tab)["chosen"].split(" ")[0].replace(",", ""))
    assert n_selected == pytest.approx(len(rows), rel=0.1)
    assert offered(tab) == ["off", "keep", "give", "new", "escape"]
    ask(tab, "off")
    tab.wait(lambda t: f"Tree {tree}:" in bar(t)["effect"])
    left = studio.session.document.trunks[tree].points
    assert len(left) == n_own - n_selected
    after = dbh(studio, tree)
    assert f"{after:.1f} cm" in bar(tab)["effect"]
    assert f"{before:.1f}" == f"{after:.1f}" or f"{before:.1f} →" in bar(tab)["effect"]
    tab.wait(lambda t: "/edit/chosen" not in t.scene and f"Tree {tree}" == bar(t)["chosen"])
    tab.command("Undo")
    tab.wait(lambda t: len(studio.session.document.trunks[tree]) == n_own and f"{before:.1f} cm" in bar(t)["effect"])


DELETE = "Correct: take the selected points off, or delete the trunk"


def test_delete_pressed_once_more_takes_points_off_and_leaves_the_trunk(tab, studio):
    tree = first(studio)
    n_own = len(studio.session.document.trunks[tree])
    select_upper(tab, studio, tree)
    for _ in range(3):
        tab.command(DELETE)
    tab.wait(lambda t: f"To delete tree {tree} itself" in bar(t)["note"])
    tab.settle()
    assert 0 < len(studio.session.document.trunks[tree]) < n_own
    assert f"Tree {tree}:" in bar(tab)["effect"]  # what the first press did is still said
    # Selected with the lasso, taken off with Click in hand: the same.
    select_upper(tab, studio, tree)
    ask(tab, "tool", "click")
    tab.wait(lambda t: bar(t)["tool"] == "click")
    n_own = len(studio.session.document.trunks[tree])
    for _ in range(3):
        tab.command(DELETE)
    tab.wait(lambda t: f"To delete tree {tree} itself" in bar(t)["note"])
    tab.settle()
    assert 0 < len(studio.session.document.trunks[tree]) < n_own
    # Chosen again, it is what is meant.
    tab.bridge_send("row", tree)
    tab.command(DELETE)
    tab.wait(lambda t: f"Tree {tree} is gone" in bar(t)["effect"])
    tab.command("Undo")
    tab.wait(lambda _: tree in studio.session.document.trunks)


def test_delete_with_a_tool_in_hand_that_found_no_points_leaves_the_trunk(tab, studio):
    tree = first(studio)
    for tool in ("lasso", "plane"):
        ask(tab, "tool", tool)
        tab.wait(lambda t, tool=tool: bar(t)["tool"] == tool)
        tab.command(DELETE)
        tab.wait(lambda t: f"To delete tree {tree} itself" in bar(t)["note"])
        tab.settle()
        assert tree in studio.session.document.trunks
    ask(tab, "tool", "click")
    tab.command(DELETE)
    tab.wait(lambda t: f"Tree {tree} is gone" in bar(t)["effect"])


def test_shift_adds_alt_takes_and_escape_clears(tab, studio):
    tree = first(studio)
    points = points_of(studio, tree)
    ask(tab, "tool", "rectangle")
    tab.wait(lambda t: bar(t).get("draws"))

    def part(low: float, high: float) -> np.ndarray:
        low_z, high_z = np.quantile(points[:, 2], [low, high])
        corners = box_about(tab, points[(points[:, 2] >= low_z) & (points[:, 2] <= high_z)], margin=0.0)
        return corners[[0, 2]]

    def n_selected(t: FakeClient) -> int:
        return int(bar(t)["chosen"].split(" ")[0].replace(",", "")) if "selected" in bar(t)["chosen"] else 0

    draw(tab, "rectangle", part(0.0, 0.3))
    tab.wait(lambda t: n_selected(t) == pytest.approx(0.3 * len(points), rel=0.2))
    draw(tab, "rectangle", part(0.6, 0.9), mode="add")
    tab.wait(lambda t: n_selected(t) == pytest.approx(0.6 * len(points), rel=0.2))
    draw(tab, "rectangle", part(0.6, 0.9), mode="take")
    tab.wait(lambda t: n_selected(t) == pytest.approx(0.3 * len(points), rel=0.2))
    ask(tab, "escape")
    tab.wait(lambda t: n_selected(t) == 0 and bar(t)["tool"] == "rectangle")
    ask(tab, "escape")
    tab.wait(lambda t: bar(t)["tool"] == "click")
    ask(tab, "escape")
    tab.wait(lambda t: bar(t) == {})


def test_the_brush_paints_over_what_is_seen_and_its_size_changes(tab, studio):
    tree = first(studio)
    middle = np.median(points_of(studio, tree), axis=0)
    ask(tab, "tool", "brush")
    tab.wait(lambda t: bar(t)["tool"] == "brush" and bar(t)["at"])
    ask(tab, "wider")
    tab.wait(lambda t: bar(t)["brushCm"] == 12.5)
    tab.bridge_send("edit-set", ["brush", 20])
    tab.wait(lambda t: bar(t)["brushCm"] == 20)
    path = [tab.screen(middle + [0, 0, dz]) for dz in np.linspace(-0.5, 0.5, 12)]
    draw(tab, "brush", path[:6], is_end=False)
    draw(tab, "brush", path[5:])
    tab.wait(lambda t: "selected" in bar(t)["chosen"])
    tab.settle()
    selected = next(iter(studio._tabs.values())).editing.points
    z = studio.session.points_world()[selected][:, 2]
    assert np.isin(selected, studio.session.document.trunks[tree].points).all()
    assert 0.9 < np.ptp(z) < 1.8
    assert tab.javascript.count("dbhEdit.taken()") == 2


def test_points_make_a_new_trunk_and_go_to_a_neighbour(tab, studio):
    tree, other = studio.session.document.trunks.ids[:2]
    rows = select_upper(tab, studio, tree)
    ask(tab, "enter")
    tab.wait(lambda t: "New tree" in bar(t)["effect"])
    new = max(studio.session.document.trunks.ids)
    assert f"New tree {new}" in bar(tab)["effect"]
    assert len(np.intersect1d(studio.session.document.trunks[new].points, rows)) > 0.8 * len(rows)
    tab.wait(lambda t: bar(t)["chosen"] == f"Tree {new}")
    choose(tab, tree)
    stand_before(tab, studio, tree)
    n_other = len(studio.session.document.trunks[other])
    select_upper(tab, studio, tree)
    ask(tab, "give")
    tab.wait(lambda t: "Click the tree that is to get" in bar(t)["hint"])
    tab.bridge_send("row", tree)
    tab.wait_notification("They are to go to another tree")
    tab.bridge_send("row", other)
    tab.wait(lambda t: f"Tree {other}:" in bar(t)["effect"])
    assert len(studio.session.document.trunks[other]) > n_other


def test_ctrl_click_chooses_two_trunks_that_are_merged_and_grouped(tab, studio):
    one, two = studio.session.document.trunks.ids[:2]
    points = points_of(studio, two)
    tab.look(np.median(points, axis=0) + [0, -3.0, 0.2], np.median(points, axis=0))
    front = points[np.abs(points[:, 2] - np.median(points[:, 2])) < 0.1]
    tab.click_scene(front[front[:, 1].argmin()], modifier="cmd/ctrl")
    tab.wait(lambda t: bar(t)["chosen"] == f"Trees {one} and {two}")
    tab.wait(lambda t: f"/edit/also/{two}" in t.scene)
    assert offered(tab) == ["merge", "group", "ungroup", "delete"]
    ask(tab, "group")
    tab.wait(lambda t: "are one tree now" in bar(t)["effect"])
    assert studio.session.document.record(two).tree_id == one
    ask(tab, "ungroup")
    tab.wait(lambda t: "each a tree of its own" in bar(t)["effect"])
    n_points = len(studio.session.document.trunks[one]) + len(studio.session.document.trunks[two])
    ask(tab, "merge")
    tab.wait(lambda t: f"Tree {two} is gone" in bar(t)["effect"])
    assert len(studio.session.document.trunks[one]) == n_points
    tab.wait(lambda t: bar(t)["chosen"] == f"Tree {one}" and f"/edit/also/{two}" not in t.scene)


def test_a_line_and_a_plane_cut_a_trunk_in_two(tab, studio):
    tree = first(studio)
    points = points_of(studio, tree)
    ask(tab, "tool", "line")
    tab.wait(lambda t: bar(t).get("draws"))
    x, y = tab.screen(np.median(points, axis=0))
    draw(tab, "line", [[x - 0.3, y], [x + 0.3, y]])
    tab.wait(lambda t: "New tree" in bar(t)["effect"])
    new = max(studio.session.document.trunks.ids)
    assert (
        points_of(studio, new)[:, 2].min() > points_of(studio, tree)[:, 2].max() - 0.2
        or points_of(studio, new)[:, 2].max() < points_of(studio, tree)[:, 2].min() + 0.2
    )
    tab.command("Undo")
    tab.wait(lambda t: f"Tree {new} is gone" in bar(t)["effect"])
    ask(tab, "tool", "plane")
    tab.wait(lambda t: bar(t)["plane"] and "/edit/plane" in t.scene and "/edit/chosen" in t.scene)
    tab.bridge_send("edit-set", ["level", 1])
    tab.wait(lambda t: bar(t)["plane"]["level"])
    tab.bridge_send("edit-set", ["height", 3.0])
    tab.wait(lambda t: bar(t)["plane"]["height"] == 3.0)
    ask(tab, "enter")
    tab.wait(lambda t: "New tree" in bar(t)["effect"] and bar(t)["tool"] == "click")
    stem = studio.session.measurement(tree)
    parts = sorted((points_of(studio, i)[:, 2] for i in (tree, max(studio.session.document.trunks.ids))), key=np.min)
    assert parts[0].max() == pytest.approx(stem.z_ground_m + 3.0, abs=0.06)
    assert parts[1].min() == pytest.approx(stem.z_ground_m + 3.0, abs=0.06)
    tab.wait(lambda t: "/edit/plane" not in t.scene)


def test_grow_shrink_delete_bring_back_and_another_number(tab, studio):
    tree = first(studio)
    n_points = len(studio.session.document.trunks[tree])
    ask(tab, "shrink")
    tab.wait(lambda t: len(studio.session.document.trunks[tree]) < n_points)
    shrunk = len(studio.session.document.trunks[tree])
    ask(tab, "grow")
    tab.wait(lambda t: len(studio.session.document.trunks[tree]) > shrunk)
    ask(tab, "delete")
    tab.wait_text("Bring back")
    assert tree not in studio.session.document.trunks
    assert f"Tree {tree} is gone" in bar(tab)["effect"]
    ask(tab, "restore", tree)
    tab.wait(lambda t: f"New tree {tree}" in bar(t)["effect"] and bar(t)["chosen"] == f"Tree {tree}")
    ask(tab, "call", "77")
    tab.wait(lambda t: bar(t)["chosen"] == "Tree 77")
    assert 77 in studio.session.document.trunks and tree not in studio.session.document.trunks
    ask(tab, "call", "seven")
    tab.wait_notification("That is no tree number")
    ask(tab, "call", str(studio.session.document.trunks.ids[0]))
    tab.wait_notification("already")


def test_a_stem_without_number_is_added_by_a_click(tab, studio):
    tree = first(studio)
    points = points_of(studio, tree)
    ask(tab, "delete")
    tab.wait(lambda t: "is gone" in bar(t)["effect"])
    ask(tab, "tool", "add")
    tab.wait(lambda t: bar(t)["tool"] == "add")
    ground = np.quantile(points[:, 2], 0.01)
    band = points[np.abs(points[:, 2] - ground - 1.3) < 0.1]
    target = band[band[:, 1].argmin()]
    tab.look(target + [0, -2.5, 0.1], target)
    tab.click_scene(target)
    tab.wait(lambda t: "New tree" in bar(t)["effect"], LONG)
    new = max(studio.session.document.trunks.ids)
    assert np.allclose(points_of(studio, new)[:, :2].mean(axis=0), points[:, :2].mean(axis=0), atol=0.15)
    tab.click_scene(target)
    tab.wait(lambda t: any(note.color == "red" for note in t.notifications), LONG)  # its points are taken


def test_one_tree_alone_and_a_slice_of_it(tab, studio):
    tree = first(studio)
    ask(tab, "others")
    tab.wait(lambda t: "/edit/alone" in t.scene and not t.scene["/rgb"].visible and not t.scene["/red"].visible)
    whole = len(tab.scene["/edit/alone"].props["points"])
    points = tab.scene["/edit/alone"].props["points"]
    own = points_of(studio, tree)
    assert (points.min(axis=0) >= own.min(axis=0) - 1.01).all() and (points.max(axis=0) <= own.max(axis=0) + 1.01).all()
    ask(tab, "slice")
    tab.wait(lambda t: "/edit/alone" in t.scene and len(t.scene["/edit/alone"].props["points"]) < 0.5 * whole)
    tab.bridge_send("edit-set", ["slice", 10])
    tab.wait(lambda t: bar(t)["sliceCm"] == 10)
    stem = studio.session.measurement(tree)
    middle = stem.z_ground_m + stem.result.section.hom_m
    tab.wait(lambda t: np.ptp(t.scene["/edit/alone"].props["points"][:, 2]) <= 0.101)
    assert np.abs(tab.scene["/edit/alone"].props["points"][:, 2] - middle).max() <= 0.051
    # What is hidden is not selected.
    ask(tab, "tool", "lasso")
    tab.wait(lambda t: bar(t).get("draws"))
    draw(tab, "lasso", [[0, 0], [1, 0], [1, 1], [0, 1]])
    tab.wait(lambda t: "selected" in bar(t)["chosen"])
    selected = next(iter(studio._tabs.values())).editing.points
    assert np.abs(studio.session.points_world()[selected][:, 2] - middle).max() <= 0.051
    ask(tab, "slice")
    ask(tab, "others")
    tab.wait(lambda t: "/edit/alone" not in t.scene and t.scene["/rgb"].visible)


def test_without_a_tree_a_drawing_selects_what_is_in_front(measured, studio):
    tree = first(studio)
    points = points_of(studio, tree)
    stand_before(measured, studio, tree)
    ask(measured, "tool", "lasso")
    measured.wait(lambda t: bar(t).get("draws"))
    draw(measured, "lasso", box_about(measured, points, margin=0.0))
    measured.wait(lambda t: "selected" in bar(t)["chosen"])
    selected = next(iter(studio._tabs.values())).editing.points
    depth = np.abs(studio.session.points_world()[selected][:, 1] - np.median(points[:, 1]))
    assert depth.max() < 2.6 and np.isin(studio.session.document.trunks[tree].points, selected).mean() > 0.9
    assert offered(measured) == ["new", "give", "off", "escape"]


def test_what_cannot_be_done_is_said_with_what_to_do(tab, studio):
    tree = first(studio)
    document = studio.session.document
    for action, words in (
        ("off", "No points are selected"),
        ("keep", "No points are selected"),
        ("give", "No points are selected"),
        ("new", "No points are selected"),
        ("merge", "Two or more trunks are needed to merge"),
        ("group", "Two or more trunks are needed to group"),
        ("ungroup", "Nothing was changed"),
        ("restore", "no deleted trunk"),
        ("split", "Only one stem is seen"),
    ):
        ask(tab, action)
        tab.wait_notification(words)
    ask(tab, "tool", "line")
    tab.wait(lambda t: bar(t).get("draws"))
    draw(tab, "line", [[0.01, 0.2], [0.02, 0.8]])
    tab.wait_notification(f"The line does not cross trunk {tree}")
    ask(tab, "tool", "lasso")
    tab.wait(lambda t: bar(t)["tool"] == "lasso")
    draw(tab, "lasso", [[0.01, 0.01], [0.03, 0.01], [0.02, 0.03]])
    tab.wait(lambda t: f"No points of tree {tree} were there" in bar(t)["note"])
    assert studio.session.document is document


def test_a_change_in_another_tab_is_not_overwritten(tab, studio):
    tree, other = studio.session.document.trunks.ids[:2]
    select_upper(tab, studio, tree)
    desk = next(iter(studio._tabs.values())).editing
    seen = desk.seen
    studio.session.do(commands.delete_trunk(other))
    tab.settle()
    tab.wait(lambda t: f"Tree {other} is gone" in bar(t)["effect"])
    assert "selected" in bar(tab)["chosen"]  # of a tree that nobody touched
    desk.seen = seen  # as if the change had not arrived yet
    document = studio.session.document
    ask(tab, "off")
    tab.wait_notification("changed meanwhile")
    assert studio.session.document is document
    desk.seen = studio.session.document
    studio.session.do(edits.drop_points(studio.session.document.trunks[tree].points[:50], tree))
    tab.wait(lambda t: "selected" not in bar(t)["chosen"])


def test_rubbish_from_a_page_does_nothing(tab, studio):
    document = studio.session.document
    ask(tab, "tool", "lasso")
    tab.wait(lambda t: bar(t).get("draws"))
    for kind, payload in (
        ("edit", 7),
        ("edit", ["tool", "chainsaw"]),
        ("edit", ["restore", "x"]),
        ("edit", [["close"], 1]),
        ("edit-set", ["brush", None]),
        ("edit-set", ["brush", 1e300]),
        ("edit-draw", ["lasso", "new", True, [1, 2, 3], [0.1, 0.1, 0.2, 0.2]]),
        ("edit-draw", ["lasso", "new", True, [0.0] * 15, [0.1, 0.1, 0.2, 0.2]]),
        ("edit-draw", ["lasso", "new", True, "camera", "path"]),
        ("edit-draw", None),
    ):
        tab.bridge_send(kind, payload)
    tab.settle()
    assert studio.session.document is document
    assert bar(tab)["tool"] == "lasso" and bar(tab)["brushCm"] == 10
    assert not any("Unexpected" in note.title for note in tab.notifications)
