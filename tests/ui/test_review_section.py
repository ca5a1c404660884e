"""The last hour with a plot: trees are looked through worst first, described one or several at once, and corrected."""

from __future__ import annotations

import re

import numpy as np
import pytest
from fakeclient import FakeClient
from panel import LONG, choose, table_ids

from dbh_studio.app import commands
from dbh_studio.app.section_edits import drawn_points
from dbh_studio.core.corrections import Correction
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.measured import Diameter
from dbh_studio.core.review_queue import ReviewProgress
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.stem_profile import ProfilePoint
from dbh_studio.ui.bind import CAMERA_KEYS
from dbh_studio.ui.correction_html import remedies_html
from dbh_studio.ui.keys import KEYS
from dbh_studio.ui.review_section import review_bar
from dbh_studio.ui.studio import Studio

ATTACK = "<img src=x onerror=alert(1)>"


def state_of(studio: Studio, trunk_id: int) -> str:
    return {row.stem_id: row.review for row in studio.session.inventory()}[trunk_id]


def dbh(studio: Studio, trunk_id: int) -> float:
    result = studio.session.measurement(trunk_id).result
    assert isinstance(result, DbhEstimate)
    return result.dbh_cm


def said(tab: FakeClient, words: str) -> bool:
    """Whether the panel says so, whatever the tags between."""
    return words in " ".join(tab.text().split())


# ---- the queue


def test_space_begins_with_the_worst_accepts_and_goes_on(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    studio.session.do(commands.set_tree_record(ids[2], flag="no mask shows it"))
    measured.wait_text(f"0 of {len(ids)} reviewed")
    measured.command("Accept and go on")
    measured.wait(lambda t: f'data-tree="{ids[2]}"' in t.html() and "No mask shows it" in t.text())
    assert not any(record.review for record in studio.session.document.trees.values())
    measured.command("Accept and go on")
    measured.wait_text(f"1 of {len(ids)} reviewed")
    measured.wait(lambda t: f'data-tree="{ids[0]}"' in t.html())
    review = studio.session.document.record(ids[2]).review
    assert review.decision == "accepted" and review.dbh_cm == pytest.approx(dbh(studio, ids[2]))
    assert review.who == studio.session.author and review.when
    assert studio.session.undo_label == f"Review trunk {ids[2]}"


def test_undo_of_a_decision_shows_the_tree_it_was_about(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    n_good = sum(studio.session.measurement(i).result.quality == "good" for i in ids)
    (tab,) = studio._tabs.values()

    def shows(t: FakeClient, trunk_id: int) -> bool:
        return f'dbh-card" data-tree="{trunk_id}"' in t.html()

    choose(measured, ids[1])
    measured.command("Accept and go on")
    measured.wait(lambda t: "1 of" in t.text() and not shows(t, ids[1]))
    measured.command("Undo")
    measured.wait(lambda t: shows(t, ids[1]) and "0 of" in t.text())
    # Several that were chosen are chosen again.
    measured.bridge_send("row-add", ids[3])
    measured.wait_text("these 2")
    measured.command("Accept and go on")
    measured.wait(lambda t: "2 of" in t.text() and "these 2" not in t.text())
    measured.command("Undo")
    measured.wait(lambda t: shows(t, ids[1]) and "these 2" in t.text())
    assert tab.view.chosen == (ids[1], ids[3])
    # Those that nobody had chosen are not.
    choose(measured, ids[2])
    measured.wait(lambda t: shows(t, ids[2]))
    measured.bridge_send("review-good")
    measured.wait_text(f"{n_good} of {len(ids)} reviewed")
    measured.command("Undo")
    measured.wait_text(f"0 of {len(ids)} reviewed")
    measured.settle()
    assert tab.view.chosen == (ids[2],)


def test_space_in_another_step_decides_nothing(measured: FakeClient, studio: Studio) -> None:
    choose(measured, table_ids(measured)[0])
    measured.bridge_send("step", "export")
    measured.wait(lambda t: t.has("Download the inventory (CSV)"))
    before = studio.session.document
    measured.command("Accept and go on")
    measured.settle()
    assert studio.session.document is before


def test_a_tree_put_off_is_found_again_by_the_filter(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    choose(measured, ids[1])
    measured.command("Look again later")
    measured.wait(lambda t: f'data-tree="{ids[2]}"' in t.html())
    measured.bridge_send("review-filter", "doubtful")
    measured.wait(lambda t: table_ids(t) == [ids[1]])
    measured.bridge_send("review-filter", "refused")
    measured.wait_text("No tree is of this kind")
    measured.bridge_send("review-filter", "all")
    measured.wait(lambda t: table_ids(t) == ids)
    assert state_of(studio, ids[1]) == "doubtful"


def test_all_that_are_good_are_accepted_in_one_step(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    n_good = sum(studio.session.measurement(i).result.quality == "good" for i in ids)
    studio.session.do(commands.set_tree_record(ids[0], flag="look"))
    measured.wait_text(f"Accept {n_good - 1} good")
    measured.bridge_send("review-good")
    measured.wait_text(f"{n_good - 1} of {len(ids)} reviewed")
    assert studio.session.document.record(ids[0]).review is None
    measured.bridge_send("undo")
    measured.wait_text(f"0 of {len(ids)} reviewed")


def test_a_decision_goes_stale_when_its_number_moves_and_says_so(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    was = dbh(studio, trunk_id)
    measured.bridge_send("review", "accept")
    measured.wait(lambda _: studio.session.document.record(trunk_id).review)
    studio.session.do(commands.correct_measurement(trunk_id, Correction("breast_height", 2.5)))
    now = dbh(studio, trunk_id)
    choose(measured, trunk_id)
    measured.wait_text(f"Was {was:.1f} cm when accepted, now {now:.1f} cm")
    measured.wait(lambda t: said(t, "Moved 1"))
    assert state_of(studio, trunk_id) == "stale"
    measured.bridge_send("review", "undecide")
    measured.wait(lambda _: studio.session.document.record(trunk_id).review is None)


NONSENSE = [
    ("review", {"a": 1}), ("review", "drop"), ("review-filter", "every"), ("review-filter", 3), ("row-add", "x"),
    ("row-range", -1), ("sort", "rank"), ("withdraw", "all"), ("height-set", [1]), ("height-set", ["1", 2]),
    ("height-set", [1, "2"]), ("tape", [None, None]), ("tape", 3), ("tape-typed", 3), ("attribute", ["edited", "x"]),
    ("attribute", "species"), ("split-stems", True), ("accept-arc", None), ("section-draw", None),
    ("section-draw", ["out", 1, 1]), ("section-draw", ["erase", 1, 1, []]),
]  # fmt: skip


@pytest.mark.parametrize("is_chosen", [False, True])
def test_nonsense_from_the_page_changes_nothing(measured: FakeClient, studio: Studio, is_chosen: bool) -> None:
    if is_chosen:
        choose(measured, table_ids(measured)[0])
    before = studio.session.document
    for kind, payload in NONSENSE:
        measured.bridge_send(kind, payload)
    measured.settle()
    assert studio.session.document is before
    assert not any(note.title == "Unexpected error" for note in measured.notifications)


def test_the_bar_offers_only_what_there_is() -> None:
    bar = review_bar(ReviewProgress(52, 37, 0, 0, 0, 0), "all", is_worst_first=False)
    assert "37 of 52 reviewed" in bar
    assert "stale" not in bar and "review-good" not in bar
    assert 'data-filter="stale"' in review_bar(ReviewProgress(52, 37, 0, 2, 0, 0), "all", is_worst_first=False)


# ---- several trees


def test_the_bar_stays_while_every_tree_is_measured_again(
    measured: FakeClient, studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = table_ids(measured)
    measured.wait_text(f"0 of {len(ids)} reviewed")
    monkeypatch.setattr(studio.session, "unmeasured", lambda document=None: tuple(ids))
    studio.session.do(commands.describe_trees((ids[0],), note="a fork"))
    measured.wait(lambda t: t.text().count("not measured yet") == len(ids))
    measured.wait_text(f"0 of {len(ids)} reviewed")
    assert not measured.has("Accept")


def test_a_filter_hides_no_tree_where_there_is_no_queue_any_more(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    measured.bridge_send("review-filter", "doubtful")
    measured.wait_text("No tree is of this kind")
    studio.session.do(commands.set_scale(ScaleEstimate()))
    measured.wait(lambda t: table_ids(t) == ids)


def test_two_trees_get_their_species_at_once(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    choose(measured, ids[0])
    measured.bridge_send("row-add", ids[2])
    measured.wait_text("These 2 trees")
    measured.set("Species", "Fagus sylvatica")
    measured.set("Status", "live")
    measured.press("Keep")
    measured.wait(lambda _: studio.session.document.record(ids[2]).species == "Fagus sylvatica")
    records = {i: studio.session.document.record(i) for i in ids}
    assert [i for i in ids if records[i].species] == [ids[0], ids[2]]
    assert records[ids[0]].status == records[ids[2]].status == "live"
    measured.bridge_send("undo")  # one step
    measured.wait(lambda _: not studio.session.document.trees)


def test_where_trees_differ_what_is_not_changed_stays(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    studio.session.do(commands.set_tree_record(ids[0], species="Picea abies", status="dead"))
    studio.session.do(commands.set_tree_record(ids[1], species="Abies alba", status="live"))
    choose(measured, ids[0])
    measured.bridge_send("row-range", ids[1])
    measured.wait(lambda t: t.value("Status") == "as they are" and t.value("Species") == "")
    measured.set("Note", "edge")
    measured.press("Keep")
    measured.wait(lambda _: studio.session.document.record(ids[1]).note == "edge")
    records = [studio.session.document.record(i) for i in ids[:2]]
    assert [(r.species, r.status) for r in records] == [("Picea abies", "dead"), ("Abies alba", "live")]


def test_a_range_follows_the_order_of_the_table(measured: FakeClient, studio: Studio) -> None:
    ids = table_ids(measured)
    measured.bridge_send("sort", "dbh")
    measured.wait(lambda t: table_ids(t) != ids)
    by_size = table_ids(measured)
    choose(measured, by_size[0])
    measured.bridge_send("row-range", by_size[2])
    measured.wait_text("These 3 trees")
    (tab,) = studio._tabs.values()
    assert tab.view.several == frozenset(by_size[:3])


# ---- attributes


def test_what_is_typed_outlives_a_change_from_elsewhere(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.set("Note", "leans over the pa")
    measured.settle()
    studio.session.do(commands.set_tree_record(trunk_id, species="Quercus robur", note="edge"))
    measured.wait(lambda t: t.value("Species") == "Quercus robur")
    assert measured.value("Note") == "leans over the pa"
    measured.bridge_send("step", "export")
    measured.bridge_send("step", "inspect")
    measured.settle()
    assert measured.value("Note") == "leans over the pa"


def test_a_species_is_offered_by_code_and_by_the_beginning_of_its_name(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.set("Species", "802")
    measured.wait(lambda t: 'data-offer="Quercus alba"' in t.html())
    measured.set("Species", "fag sy")
    measured.wait(lambda t: 'data-offer="Fagus sylvatica"' in t.html() and "Quercus alba" not in t.html())
    measured.bridge_send("attribute", ["species", "Fagus sylvatica"])
    measured.wait(lambda t: t.value("Species") == "Fagus sylvatica" and "EPPO FAUSY" in t.text())
    measured.press("Keep")
    measured.wait(lambda _: studio.session.document.record(trunk_id).species == "Fagus sylvatica")


def test_a_field_of_ones_own_is_there_for_every_tree(measured: FakeClient, studio: Studio) -> None:
    first, second = table_ids(measured)[:2]
    choose(measured, first)
    measured.set("New field", "Ivy")
    measured.press("Add the field")
    measured.set("Ivy", "to the crown")
    choose(measured, second)
    measured.wait(lambda t: t.has("Ivy") and t.value("Ivy") == "")
    assert dict(studio.session.document.record(first).fields) == {"Ivy": "to the crown"}
    measured.set("New field", "ivy")
    measured.press("Add the field")
    measured.wait_notification("There is a field ivy already")


# ---- correcting


def test_breast_height_of_one_tree_is_raised_signed_and_withdrawn(measured: FakeClient, studio: Studio) -> None:
    first, second = table_ids(measured)[:2]
    choose(measured, first)
    was, other = dbh(studio, first), dbh(studio, second)
    measured.set("Why", "a whorl")
    measured.set("Height (m)", 2.0)
    measured.press("Measure at this height")
    measured.wait(lambda t: said(t, "Breast height 2.00 m “a whorl”"))
    now = dbh(studio, first)
    assert now < was and dbh(studio, second) == other
    measured.wait_text(f"{was:.1f} → {now:.1f} cm")
    (correction,) = studio.session.document.record(first).corrections
    assert (correction.value, correction.who, correction.why) == (2.0, studio.session.author, "a whorl")
    assert measured.value("Why") == ""
    measured.bridge_send("withdraw", "breast_height")
    measured.wait_text(f"{now:.1f} → {was:.1f} cm")
    assert studio.session.document.record(first).corrections == ()
    assert dbh(studio, first) == was


def test_a_tape_value_stands_beside_the_estimate(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    before = studio.session.measurement(trunk_id)
    measured.set("Tape", "12.4 in")
    measured.set("Read at (m)", "1.3")
    measured.press("Keep the tape value")
    measured.wait(lambda t: said(t, "Tape 31.5 cm at 1.30 m (DBH"))
    measured.wait(lambda t: 'data-column="tape">31.5<' in t.html())
    assert studio.session.measurement(trunk_id) is before
    (row,) = [row for row in studio.session.inventory() if row.stem_id == trunk_id]
    assert row.field_tape_cm == pytest.approx(31.496) and row.field_tape_height_m == pytest.approx(1.3)
    measured.bridge_send("withdraw", "tape")
    measured.wait(lambda t: 'data-column="tape"' not in t.html())
    assert studio.session.document.record(trunk_id).corrections == ()


def test_what_a_correction_did_is_told_until_undo_takes_it_back(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    was = dbh(studio, trunk_id)
    measured.set("Height (m)", 2.0)
    measured.press("Measure at this height")
    told = f"{was:.1f} → {dbh_at(studio, trunk_id, 2.0):.1f} cm"
    measured.wait_text(told)
    studio.session.undo()
    measured.wait(lambda t: told not in t.text() and f'data-dbh="{was:.1f}"' in t.html())
    studio.session.redo()
    measured.wait_text(told)


def dbh_at(studio: Studio, trunk_id: int, height_m: float) -> float:
    document = commands.correct_measurement(trunk_id, Correction("breast_height", height_m)).apply(
        studio.session.document
    )
    return studio.session.measurement(trunk_id, document=document).result.dbh_cm


def test_a_tape_value_that_was_typed_is_kept_when_one_goes_on(measured: FakeClient, studio: Studio) -> None:
    first, second, third = table_ids(measured)[:3]
    choose(measured, first)
    measured.set("Tape", "31.5")
    choose(measured, second)
    assert studio.session.document.record(first).correction("tape") == 31.5
    measured.wait(lambda t: t.value("Tape") == "")
    measured.set("Tape", "thick")
    choose(measured, third)
    measured.wait_notification(f"The tape value of tree {second} was not kept")
    measured.wait(lambda t: t.value("Tape") == "")
    assert not studio.session.document.record(second).corrections
    assert not studio.session.document.record(third).corrections


def test_a_tape_value_typed_in_the_card_is_kept_when_one_goes_on(measured: FakeClient, studio: Studio) -> None:
    first, second = table_ids(measured)[:2]
    studio.session.do(commands.correct_measurement(first, Correction("breast_height", 19.5)))
    choose(measured, first)
    measured.bridge_send("tape-typed", [second, "50"])  # of a tree that is no longer shown
    measured.bridge_send("tape-typed", [first, "31.5"])
    measured.wait(lambda t: t.value("Tape") == "31.5")
    choose(measured, second)
    measured.wait(lambda t: t.value("Tape") == "")
    assert studio.session.document.record(first).correction("tape") == 31.5
    assert studio.session.document.record(second).corrections == ()
    choose(measured, first)
    measured.bridge_send("tape-typed", [first, "32"])
    measured.bridge_send("tape", [first, "32"])
    measured.wait(lambda t: said(t, "Tape 32.0 cm"))
    measured.wait(lambda t: t.value("Tape") == "" and "dbhCard.forget()" in t.javascript)


def test_with_several_chosen_it_is_said_which_one_is_corrected(measured: FakeClient, studio: Studio) -> None:
    first, second = table_ids(measured)[:2]
    choose(measured, first)
    measured.bridge_send("row-add", second)
    measured.wait_text(f"2 trees are chosen; only tree {second} is corrected here")
    measured.set("Height (m)", 2.0)
    measured.press("Measure at this height")
    measured.wait(lambda _: studio.session.document.record(second).correction("breast_height") == 2.0)
    assert not studio.session.document.record(first).corrections


def test_what_was_found_along_the_stem_outlives_a_note(measured: FakeClient, studio: Studio) -> None:
    trunk_id, other = table_ids(measured)[:2]
    choose(measured, trunk_id)
    measured.bridge_send("compare", None)
    measured.wait(lambda t: "data-height-grip" in t.html())
    studio.session.do(commands.describe_trees((other,), note="a fork"))
    measured.wait(lambda t: "a fork" in t.html())
    assert "data-height-grip" in measured.html()
    studio.session.do(commands.correct_measurement(trunk_id, Correction("breast_height", 2.0)))
    measured.wait(lambda t: "data-height-grip" not in t.html())


def serial_of(measured: FakeClient, trunk_id: int) -> int:
    return int(measured.html().split(f"dbhSection.begin(&quot;out&quot;,{trunk_id},")[1].split(")")[0])


def test_points_drawn_round_are_left_out_and_come_back(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    section = studio.session.measurement(trunk_id).result.section
    half = [[0.0, -5.0], [5.0, -5.0], [5.0, 5.0], [0.0, 5.0]]
    serial = serial_of(measured, trunk_id)
    measured.bridge_send("section-draw", ["out", trunk_id, serial + 7, half])
    measured.wait_notification("The section has changed")
    assert studio.session.document.record(trunk_id).corrections == ()
    measured.bridge_send("section-draw", ["out", trunk_id, serial, half])
    measured.wait_text("Points left out")
    assert "data-crossed" in measured.html() and said(measured, "left out by hand")
    after = studio.session.measurement(trunk_id).result
    assert after.section.coverage_deg < section.coverage_deg - 100
    measured.bridge_send("withdraw", "left_out")
    measured.wait(lambda t: "Points left out" not in t.text())
    assert studio.session.measurement(trunk_id).result.section is section


def test_a_ring_drawn_in_the_section_gives_its_own_diameter(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    result = studio.session.measurement(trunk_id).result
    outline = result.fits[result.curve].outline_uv_m[::3]
    middle = outline.mean(axis=0)
    wider = middle + 1.2 * (outline - middle)
    measured.bridge_send("section-draw", ["ring", trunk_id, serial_of(measured, trunk_id), wider.tolist()])
    measured.wait_text("Ring drawn by hand")
    assert dbh(studio, trunk_id) == pytest.approx(1.2 * result.dbh_cm, rel=0.03)


def test_the_ground_is_where_it_was_clicked(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    choose(measured, trunk_id)
    measured.press("Click where its ground is")
    measured.wait_text("Click the ground beside the stem")
    points = studio.display.points
    stem = studio.session.measurement(trunk_id)
    away = np.hypot(*(points[:, :2] - stem.xy_m).T)
    near = points[(away > 1.0) & (away < 2.0) & (points[:, 2] < stem.z_ground_m + 0.1)]
    place = near[0].astype(float)
    measured.look(place + np.array([0.3, 0.3, 5.0]), place)
    measured.click_scene(place)
    measured.wait_text("placed by hand")
    assert studio.session.measurement(trunk_id).z_ground_m == pytest.approx(place[2], abs=0.15)
    (tab,) = studio._tabs.values()
    assert tab.view.selected == trunk_id


# ---- refusals


def test_a_refused_tree_is_measured_where_the_profile_says_it_can_be(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    studio.session.do(commands.correct_measurement(trunk_id, Correction("breast_height", 19.5)))
    assert isinstance(studio.session.measurement(trunk_id).result, Refusal)
    choose(measured, trunk_id)
    measured.wait_text("Look along the stem")
    measured.bridge_send("compare")
    measured.wait(lambda t: 'data-height="' in t.html(), LONG)
    heights = [float(h) for h in re.findall(r'button type="button" data-height="([\d.]+)"', measured.html())]
    assert heights[0] == 1.3
    measured.bridge_send("height-set", [trunk_id, heights[1]])
    measured.wait(lambda t: said(t, f"Breast height {heights[1]:.2f} m"), LONG)
    assert studio.session.measurement(trunk_id).result.hom_m == pytest.approx(heights[1], abs=0.02)
    # That of the plot is no correction.
    measured.bridge_send("height-set", [trunk_id, 1.3])
    measured.wait(lambda _: not studio.session.document.record(trunk_id).corrections, LONG)


def test_a_smaller_arc_is_accepted_where_it_gives_a_diameter(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    session = studio.session
    whole = session.document
    section = session.measurement(trunk_id).result.section

    def leave_out(beyond_m: float) -> None:
        box = [[beyond_m, -5.0], [5.0, -5.0], [5.0, 5.0], [beyond_m, 5.0]]
        away = drawn_points(session, whole, trunk_id, section, box)
        session.do(commands.correct_measurement(trunk_id, Correction("left_out", tuple(away.tolist()))))

    leave_out(0.0)
    session.do(commands.change_settings("measure", min_coverage_deg=300.0))
    refused = session.measurement(trunk_id).result
    assert isinstance(refused, Refusal) and refused.code == "small_arc"
    choose(measured, trunk_id)
    measured.wait(lambda t: f"Accept an arc of {refused.section.coverage_deg:.0f}" in t.html())
    measured.bridge_send("accept-arc", trunk_id)
    measured.wait(lambda t: said(t, "Smaller arc accepted") and "arc_accepted" in t.html(), LONG)
    assert isinstance(session.measurement(trunk_id).result, DbhEstimate)
    # So little that no diameter comes of it: it says why, and nothing is changed.
    session.do(commands.withdraw_correction(trunk_id, "least_arc"))
    leave_out(-0.95 * section.ring_radius_m)
    before = session.document
    measured.wait(lambda t: "data-dbh" not in t.html())
    measured.bridge_send("accept-arc", trunk_id)
    measured.wait_notification("That gives no diameter either")
    assert session.document is before


def test_the_remedies_of_a_refusal_are_those_that_can_be_done() -> None:
    nothing_seen = Refusal("no_points", "no points", "add some")
    before = remedies_html(3, nothing_seen, None, serial=1)
    assert 'data-do="look-along"' in before and 'data-do="tape"' in before
    assert "draw-ring" not in before and "split" not in before
    after = remedies_html(3, nothing_seen, (), serial=1)
    assert "look-along" not in after and "along the stem either" in after
    seen = (ProfilePoint(1.0, Diameter(31.2, 30.0, 32.0), 300.0),)
    assert "Measure at 1.00 m (31 cm there)" in remedies_html(3, nothing_seen, seen, serial=1)
    assert "split-stems" in remedies_html(3, Refusal("no_ring", "heap", "look"), None, serial=1)
    assert "tape" not in remedies_html(3, Refusal("unscaled", "no scale", "set it"), None, serial=1)


def test_what_a_person_writes_never_becomes_markup(measured: FakeClient, studio: Studio) -> None:
    trunk_id = table_ids(measured)[0]
    command = commands.correct_measurement(trunk_id, Correction("tape", 30.0, who=ATTACK, when=ATTACK, why=ATTACK))
    studio.session.do(command)
    studio.session.do(commands.set_tree_fields([trunk_id], **{"ids": ATTACK, "Ivy": ATTACK}))
    studio.session.do(commands.set_tree_record(trunk_id, species=ATTACK))
    choose(measured, trunk_id)
    measured.wait(lambda t: t.html().count("&lt;img") > 3)
    contents = [element.props.get("content") or "" for element in list(measured.elements.values())]
    assert not any("<img" in content for content in contents)


def test_every_key_of_the_review_is_in_the_list_of_keys_and_none_moves_the_camera(measured: FakeClient) -> None:
    told = " ".join(key.lower() for key, _ in KEYS).split()
    hotkeys = {label: key for label, (key, _) in measured.commands().items()}
    for label in ("Accept and go on", "Look again later", "Next tree", "Previous tree", "Fly to the tree"):
        assert hotkeys[label].lower() in told
    assert not {key.upper() for key in hotkeys.values() if key} & CAMERA_KEYS
