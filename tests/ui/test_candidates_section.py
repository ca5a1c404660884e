"""The list of candidates in the Trunks step, over the real websocket."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plots
import pytest
from fakeclient import FakeClient
from panel import LONG, choose, table_ids

from dbh_studio.app.candidates import Offer, Offers
from dbh_studio.app.commands import replace_trunks
from dbh_studio.app.session import Session
from dbh_studio.core.candidates import CandidateTrunk
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.ui.candidates_section import flag_html, offers_html

ATTACK = '<img src=x onerror="alert(1)">'


@pytest.fixture
def session(tmp_path) -> Session:
    """The small plot as a search by masks may leave it: two of its five stems are only offered, one is flagged."""
    session = plots.measured_session(tmp_path)
    trunks = session.document.trunks
    kept = TrunkSet(tuple(replace(trunks[i], origin="masks") for i in trunks.ids[:3]), trunks.next_id)
    session.offers = Offers(
        tuple(
            CandidateTrunk(trunks[i].points, (0.0, 0.0), 0.25, "denied", f"{n} photos have it in view", n, 0)
            for i, n in ((trunks.ids[3], 12), (trunks.ids[4], 7))
        )
    )
    session.do(replace_trunks(kept, flags={kept.ids[0]: "only masks see it: no stem by its shape"}))
    session.measurements()
    return session


@pytest.fixture
def tab(studio, session):
    studio.adopt(session)
    with FakeClient(studio.server.url) as client:
        client.wait(table_ids, LONG)  # the plot is shown: a step chosen before would be overtaken
        client.bridge_send("step", "trunks")
        client.wait(lambda t: 'data-candidate="2"' in t.html(), LONG)
        yield client


def numbers(tab: FakeClient) -> list[int]:
    return [int(part.split('"')[0]) for part in tab.html().split('data-candidate="')[1:]]


def test_they_are_listed_with_the_reason(tab):
    assert numbers(tab) == [1, 2] and tab.has("Accept all stems") and not tab.has("Show dismissed ones again")
    assert "12 photos have it in view" in tab.text() and "about 25 cm" in tab.text()


def test_show_marks_it_in_the_cloud_and_flies_there(tab, session):
    tab.wait(lambda t: "/highlight" not in t.scene)
    tab.bridge_send("candidate-show", 2)
    tab.wait(lambda t: "/highlight" in t.scene, LONG)
    tab.bridge_send("candidate-dismiss", 2)
    tab.wait(lambda t: "/highlight" not in t.scene, LONG)


def test_accept_makes_a_trunk_and_undo_brings_it_back(tab, session):
    before = len(session.document.trunks)
    tab.bridge_send("candidate-accept", 1)
    tab.wait(lambda t: numbers(t) == [2], LONG)
    assert len(session.document.trunks) == before + 1
    tab.bridge_send("undo")
    tab.wait(lambda t: numbers(t) == [1, 2], LONG)
    assert len(session.document.trunks) == before


def test_dismiss_takes_it_off_the_list_and_it_can_come_back(tab, session):
    document = session.document
    tab.bridge_send("candidate-dismiss", 1)
    tab.wait(lambda t: numbers(t) == [2] and t.has("Show dismissed ones again"), LONG)
    tab.press("Show dismissed ones again")
    tab.wait(lambda t: numbers(t) == [1, 2], LONG)
    assert session.document is document


def test_accept_all(tab, session):
    tab.press("Accept all stems")
    tab.wait(lambda t: not numbers(t) and not t.has("Accept all stems"), LONG)
    assert len(session.document.trunks) == 5


@pytest.mark.parametrize("payload", [99, None, [1], {}])
def test_what_the_page_sends_is_not_believed(tab, session, payload):
    document = session.document
    for kind in ("show", "accept", "dismiss"):
        tab.bridge_send(f"candidate-{kind}", payload)
    tab.bridge_send("flag-clear", payload)
    tab.wait(lambda t: "not there any more" in str(t.notifications), LONG)
    assert "not offered any more" in str(tab.notifications)
    assert session.document is document and session.offers.dismissed == frozenset()


def test_a_flag_is_on_the_card_and_in_the_table_until_it_was_looked_at(tab, session):
    flagged = session.document.trunks.ids[0]
    tab.bridge_send("step", "inspect")
    choose(tab, flagged)
    tab.wait(lambda t: f'data-tree-flag="{flagged}"' in t.html() and t.text().count("nly masks see it") >= 2, LONG)
    tab.bridge_send("flag-clear", flagged)
    tab.wait(lambda t: "nly masks see it" not in t.text(), LONG)
    assert session.document.record(flagged).flag == ""


def test_without_candidates_there_is_no_list(measured):
    measured.bridge_send("step", "trunks")
    measured.wait(lambda t: t.has("Trunk settings"), LONG)
    assert not measured.has("Candidates") and not measured.has("Accept all stems")


def test_reasons_are_text():
    points = np.arange(5, dtype=np.int32)
    candidate = CandidateTrunk(points, (0.0, 0.0), 0.2, "denied", ATTACK)

    content = offers_html([Offer(1, candidate, (0.0, 0.0, 0.0), 0.2)])
    assert "<img" not in content and "&lt;img" in content
    assert "<img" not in flag_html(1, ATTACK) and flag_html(1, "") == ""
