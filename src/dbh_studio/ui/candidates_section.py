"""Where masks and shape disagree: what may be a trunk, to look at, accept or dismiss. A part of the Trunks step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from dbh_studio.app import commands
from dbh_studio.app.candidates import (
    Offer,
    accept_all,
    accept_candidate,
    bring_back,
    dismiss_candidate,
    open_offers,
)
from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.errors import CommandError
from dbh_studio.ui import html
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.panels.base import set_content, set_visible
from dbh_studio.ui.scene import TrunkPicture

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_LOOK_FROM_M = 5.0


class CandidatesSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot; hidden where it is empty."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self._seen: tuple[Session, Document, object] | None = None
        self._offers: tuple[Offer, ...] = ()
        gui = tab.client.gui
        self._folder = gui.add_folder("Candidates", visible=False)
        with self._folder:
            self._list = gui.add_html("")
            self._all = gui.add_button("Accept all stems", icon=viser.Icon.CHECKS, color="gray", visible=False)
            tab.worker.on_click(self._all, self._accept_all)
            self._back = gui.add_button("Show dismissed ones again", color="gray", visible=False)
            tab.worker.on_click(self._back, self._bring_back)
        for kind, action in (
            ("candidate-show", self._show),
            ("candidate-accept", self._accept),
            ("candidate-dismiss", self._dismiss),
            ("flag-clear", self._clear_flag),
        ):
            tab.bridge.on(kind, action)

    def refresh(self) -> None:
        """List what is offered now."""
        session = self.tab.session
        if session is None:
            set_visible(self._folder, False)
            return
        seen = (session, session.document, session.offers)
        if self._seen is None or any(now is not before for now, before in zip(seen, self._seen, strict=True)):
            self._seen, self._offers = seen, open_offers(session)
        n_dismissed = len(session.offers.dismissed) if session.offers is not None else 0
        n_stems = sum(offer.candidate.kind != "low" for offer in self._offers)
        set_content(self._list, offers_html(self._offers))
        set_visible(self._all, n_stems > 1)
        set_visible(self._back, n_dismissed > 0)
        set_visible(self._folder, bool(self._offers) or n_dismissed > 0)

    def _offer(self, number: Any) -> Offer:
        """What the page speaks of, which may be gone by now."""
        for offer in open_offers(self.tab.require_session()):
            if isinstance(number, int) and offer.number == number:
                return offer
        raise CommandError("This candidate is not offered any more.")

    def _show(self, number: Any) -> None:
        offer = self._offer(number)
        session, points = self.tab.require_session(), offer.candidate.points
        rgb, target = session.cloud.rgb, np.array(offer.xyz_m)
        picture = TrunkPicture(session.points_world()[points], None if rgb is None else rgb[points], target)
        self.tab.scene.highlight(picture)
        self.tab.scene.fly_to(target, distance=_LOOK_FROM_M)

    def _accept(self, number: Any) -> None:
        session = self.tab.require_session()
        trunk_id = accept_candidate(session, self._offer(number).candidate)
        self.tab.worker.notify(f"Tree {trunk_id}", "The candidate is a trunk now. Undo takes it back.", "info")

    def _accept_all(self) -> None:
        accept_all(self.tab.require_session())

    def _dismiss(self, number: Any) -> None:
        dismiss_candidate(self.tab.require_session(), self._offer(number).number)
        self.tab.refresh()
        self.tab.refresh_trunks()  # with it goes what Show has marked

    def _clear_flag(self, trunk_id: Any) -> None:
        session = self.tab.require_session()
        if not isinstance(trunk_id, int) or trunk_id not in session.document.trunks:
            raise CommandError("This tree is not there any more.")
        session.do(commands.set_tree_record(trunk_id, flag=""))

    def _bring_back(self) -> None:
        bring_back(self.tab.require_session())
        self.tab.refresh()


def offers_html(offers: Sequence[Offer]) -> str:
    """A row for each candidate: what it is, why it is only one, and three buttons."""
    if not offers:
        return html.message("No candidate is left.", level="ok")
    rows = "".join(
        f'<li data-level="note" data-candidate="{offer.number}"><b>{offer.number}</b> about '
        f"{100 * offer.diameter_m:.0f} cm: {esc(offer.reason)}<br>{_buttons(offer.number)}</li>"
        for offer in offers
    )
    said = html.message("Masks and shape disagree here. Look at each, and accept what is a trunk.")
    return f'{said}<div class="dbh"><ul class="dbh-list">{rows}</ul></div>'


def _buttons(number: int) -> str:
    return " ".join(
        f'<button type="button" data-do="{kind}" onclick="{call("candidate-" + kind, number)}">{title}</button>'
        for kind, title in (("show", "Show"), ("accept", "Accept"), ("dismiss", "Dismiss"))
    )


def flag_html(trunk_id: int, flag: str) -> str:
    """What the search wants looked at, below the card of a tree; empty where nothing."""
    if not flag:
        return ""
    return (
        f'<div class="dbh"><div class="dbh-hint" data-level="todo" data-tree-flag="{trunk_id}">{esc(html.plain(flag))} '
        f'<button type="button" data-do="flag-clear" onclick="{call("flag-clear", trunk_id)}">Looked at</button>'
        "</div></div>"
    )
