"""Candidates of a search by masks: offered, accepted, dismissed, saved; and what is flagged."""

from __future__ import annotations

import numpy as np
import pytest
from tests.maskplot import MaskPlot, labels, save_masks, write_mask_plot

from dbh_studio.app import commands
from dbh_studio.app.brought_masks import MaskRequest
from dbh_studio.app.candidates import (
    accept_all,
    accept_candidate,
    add_candidates,
    bring_back,
    dismiss_candidate,
    kept_offers,
    open_offers,
)
from dbh_studio.app.image_trunks import masks_of_plot, trunks_from_masks
from dbh_studio.app.opening import open_plot, save_as
from dbh_studio.app.session import Session
from dbh_studio.core.candidates import CandidateTrunk
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.trunks import Trunk, TrunkSet
from dbh_studio.errors import CommandError
from dbh_studio.io.inventory_csv import write_inventory_csv

FLAG = "only masks see it: no stem by its shape"


@pytest.fixture(scope="module")
def plot(tmp_path_factory) -> MaskPlot:
    return write_mask_plot(tmp_path_factory.mktemp("mask_plot"))


@pytest.fixture(scope="module")
def searched(plot: MaskPlot) -> Session:
    """Masks show two of the three stems and not the pole: two candidates."""
    session = open_plot(plot.cloud, scale="metres")
    wanted = MaskRequest(plot.masks, categories=("1-2",), cameras=plot.poses, images_dir=plot.folder / "images")
    trunks_from_masks(session, masks_of_plot(session, wanted))
    return session


@pytest.fixture
def session(searched: Session):
    before, offers = searched.document, searched.offers
    yield searched
    while searched.document is not before:
        searched.undo()
    searched.offers = offers


def test_what_masks_do_not_show_is_offered(session):
    assert len(session.document.trunks) == 2 and {trunk.origin for trunk in session.document.trunks} == {"masks"}
    offers = open_offers(session)
    assert [offer.number for offer in offers] == [1, 2]
    assert all("none calls it trunk" in offer.reason for offer in offers)
    for offer in offers:
        points = session.points_world()[offer.candidate.points]
        np.testing.assert_allclose(offer.xyz_m, np.median(points, axis=0), atol=1e-4)
        assert 0.05 < offer.diameter_m < 0.6


def test_an_accepted_candidate_is_a_flagged_trunk_and_undo_offers_it_again(session):
    first, second = open_offers(session)
    next_id = session.next_id
    trunk_id = accept_candidate(session, first.candidate)
    assert trunk_id == next_id and session.undo_label == "Accept a candidate"
    document = session.document
    np.testing.assert_array_equal(document.trunks[trunk_id].points, first.candidate.points)
    assert document.trunks[trunk_id].origin == "geometry" and not document.record(trunk_id).edited
    assert first.reason in document.record(trunk_id).flag
    assert [offer.number for offer in open_offers(session)] == [second.number]
    row = next(row for row in session.inventory() if row.stem_id == trunk_id)
    assert first.reason in row.reason and row.dbh_cm is not None
    session.undo()
    assert [offer.number for offer in open_offers(session)] == [1, 2]
    session.redo()
    assert trunk_id in session.document.trunks


def test_all_at_once_is_one_command(session):
    next_id = session.next_id
    assert accept_all(session) == 2 and session.document.trunks.ids == (1, 2, next_id, next_id + 1)
    assert not open_offers(session) and accept_all(session) == 0
    session.undo()
    assert len(session.document.trunks) == 2 and len(open_offers(session)) == 2


def test_a_candidate_whose_points_others_have_cannot_be_accepted(session):
    (first, _) = open_offers(session)
    session.do(add_candidates([first.candidate]))
    with pytest.raises(CommandError, match=f"belongs to trunk {session.next_id - 1}"):
        accept_candidate(session, first.candidate)


def test_points_of_other_trunks_stay_with_them(session):
    first = open_offers(session)[0].candidate
    third = first.points[: len(first.points) // 3]
    session.do(commands.replace_trunks(TrunkSet((*session.document.trunks, Trunk(9, third, "masks")), 10)))
    trunk_id = accept_candidate(session, first)
    np.testing.assert_array_equal(session.document.trunks[trunk_id].points, first.points[len(third) :])


def test_what_is_dismissed_can_be_brought_back(session):
    dismiss_candidate(session, 1)
    assert [offer.number for offer in open_offers(session)] == [2]
    bring_back(session)
    assert [offer.number for offer in open_offers(session)] == [1, 2]
    for number in (0, 3):
        with pytest.raises(CommandError, match="no candidate"):
            dismiss_candidate(session, number)


def test_another_scale_moves_them_along(session):
    before = open_offers(session)
    session.do(commands.set_scale(ScaleEstimate(2.0, "factor")))
    for old, new in zip(before, open_offers(session), strict=True):
        assert new.diameter_m == pytest.approx(2 * old.diameter_m)
        np.testing.assert_allclose(new.xyz_m, 2 * np.array(old.xyz_m), rtol=1e-4, atol=1e-3)


def test_none_are_offered_for_trunks_by_geometry(session):
    session.do(commands.replace_trunks(TrunkSet.from_point_sets([np.arange(50)])))
    assert not open_offers(session)


def test_they_are_saved_and_read_again(session, plot, tmp_path):
    folder = tmp_path / "plot.dbh"
    saver = save_as(session, folder, background=False)
    accepted = accept_candidate(session, open_offers(session)[0].candidate)
    dismiss_candidate(session, 2)
    session.do(commands.set_tree_record(1, flag=FLAG))
    saver.close()
    session.saver = None
    reopened = open_plot(folder)
    try:
        assert reopened.document.record(1).flag == FLAG and accepted in reopened.document.trunks
        assert "no trunk by the masks" in reopened.document.record(accepted).flag
        assert reopened.document.trunks[1].origin == "masks" and not open_offers(reopened)
        bring_back(reopened)
        (offer,) = open_offers(reopened)
        before = session.offers.candidates[1]
        np.testing.assert_array_equal(offer.candidate.points, before.points)
        assert (offer.reason, offer.candidate.kind, offer.number) == (before.reason, before.kind, 2)
    finally:
        reopened.close()
    path = folder / "cache" / "candidates.npz"
    path.write_bytes(path.read_bytes()[:-40])
    assert kept_offers(folder, session.document) is None
    path.unlink()
    assert kept_offers(folder, session.document) is None


def test_flags_come_with_the_search_and_go_with_the_next(session, tmp_path):
    document = session.document
    sets = [trunk.points for trunk in document.trunks]
    # In another order: ids are given back by points.
    again = TrunkSet.from_point_sets(sets[::-1], origin="masks")
    session.do(commands.replace_trunks(again, flags={1: FLAG}))
    assert {i: session.document.record(i).flag for i in (1, 2)} == {1: "", 2: FLAG}
    session.do(commands.set_tree_record(2, note="by the path"))
    assert session.document.record(2).remark == f"by the path; {FLAG}"
    write_inventory_csv(tmp_path / "plot.csv", session.inventory())
    lines = (tmp_path / "plot.csv").read_text(encoding="utf-8-sig").splitlines()
    assert sum(FLAG in line for line in lines) == 1
    session.do(commands.replace_trunks(again))
    assert session.document.record(2).flag == "" and session.document.record(2).note == "by the path"


def test_a_flag_says_a_refusal_too(session):
    session.do(commands.replace_trunks(TrunkSet.from_point_sets([np.arange(40)], origin="masks"), flags={1: FLAG}))
    (row,) = session.inventory()
    assert row.dbh_cm is None and row.reason.endswith(f"; {FLAG}")


def test_the_masks_notes_count_them(plot, tmp_path):
    session = open_plot(plot.cloud, scale="metres")
    empty = save_masks(tmp_path, lambda each: np.where(each == 1, 255, 0))
    wanted = MaskRequest(empty, meaning="trunk_bright", cameras=plot.poses, images_dir=plot.folder / "images")
    masks = masks_of_plot(session, wanted)
    result = trunks_from_masks(session, masks, accept_candidates=True)
    assert any(note.startswith("3 candidates were found") for note in result.notes)
    assert any(note.startswith("3 candidates were taken as trunks") for note in result.notes)
    assert len(session.document.trunks) == 4 and labels()
    assert sum(bool(record.flag) for record in session.document.trees.values()) == 3
    assert session.undo_label == "Accept 3 candidates"


@pytest.mark.parametrize("points", [[], [3, 3], [5, 2], [-1, 4], [[1, 2]]])
def test_a_candidate_needs_sorted_indices(points):
    with pytest.raises(ValueError, match="sorted, unique"):
        CandidateTrunk(np.array(points, np.int32), (0.0, 0.0), 0.2, "denied", "because")
