"""The queue of review: how far one is, which trees are shown, and what is decided about each. A part of Inspect."""

from __future__ import annotations

from typing import Any

from dbh_studio.app import commands
from dbh_studio.app.document import Document
from dbh_studio.app.session import Change, Session
from dbh_studio.core.dbh import DbhEstimate
from dbh_studio.core.review_queue import (
    FILTERS,
    QueueEntry,
    QueueFilter,
    ReviewProgress,
    in_filter,
    next_to_review,
    queue_entry,
    review_progress,
    review_queue,
)
from dbh_studio.core.tree_record import Review, ReviewDecision
from dbh_studio.errors import CommandError
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.html import plain
from dbh_studio.ui.panels.base import Section, set_content, set_visible
from dbh_studio.ui.signed import signed_words, utc_now

_FILTER_TITLES: dict[QueueFilter, str] = {
    "all": "All",
    "open": "Not yet",
    "doubtful": "Look again",
    "stale": "Moved",
    "refused": "No DBH",
}
_DONE = {
    "all": "Every tree has been looked at.",
    "open": "Every tree has been looked at.",
    "doubtful": "No other tree is put off.",
    "stale": "No other number has moved since it was decided about.",
    "refused": "No other tree without a diameter is left to look at.",
}


class ReviewSection(Section):
    """Progress and filters above the table; the keys that decide and go on."""

    def build(self) -> None:
        """Add the bar."""
        self._bar = self.gui.add_html("", visible=False)
        self._known: tuple[Session, Document, tuple[int, ...], tuple[QueueEntry, ...]] | None = None
        # Trees that were decided about in one step of this tab, where they were several.
        self._together: set[frozenset[int]] = set()
        bridge = self.tab.bridge
        bridge.on("review", self._review_pressed)
        bridge.on("review-filter", self._filter_chosen)
        bridge.on("review-good", lambda _: self.accept_good())
        bridge.on("review-worst", lambda _: self._sort_by_worst())

    def refresh(self) -> None:
        """Show how far one is."""
        session, queue = self.tab.session, self.queue()
        n_waiting = len(session.unmeasured()) if session is not None else 0
        is_there = bool(queue) or n_waiting > 0  # while all are measured again, too: the table below must not jump
        set_visible(self._bar, is_there)
        if is_there:
            view = self.tab.view
            progress = review_progress(queue, n_waiting=n_waiting)
            bar = review_bar(progress, view.review_filter, is_worst_first=view.sort_column == "worst")
            set_content(self._bar, bar)

    # ---- the queue

    def queue(self) -> tuple[QueueEntry, ...]:
        """The measured trees of the plot, worst first; empty where the plot cannot be measured yet."""
        session = self.tab.session
        if session is None or not session.document.scale.is_known:
            return ()
        document = session.document
        waiting = session.unmeasured(document)
        known = self._known
        if known is not None and known[0] is session and known[1] is document and known[2] == waiting:
            return known[3]
        stems = []
        not_yet = set(waiting)
        for i in document.trunks.ids:
            if i not in not_yet:
                record, result = document.record(i), session.measurement(i, document=document).result
                stems.append((queue_entry(i, result, search_flag=record.flag, review=record.review), result))
        queue = review_queue(stems)
        self._known = session, document, waiting, queue
        return queue

    def entry(self, tree_id: int) -> QueueEntry | None:
        """A tree's place in the queue; None where it has none."""
        return next((entry for entry in self.queue() if entry.tree_id == tree_id), None)

    def is_shown(self, entry: QueueEntry) -> bool:
        """Whether the filter lets it through."""
        return in_filter(entry, self.tab.view.review_filter)

    # ---- what a person does

    def accept(self) -> None:
        """Accept the chosen trees and go to the next; where none is chosen, begin with the worst."""
        self._decide("accepted")

    def put_off(self) -> None:
        """Put the chosen trees off, to be looked at again, and go to the next."""
        self._decide("doubtful")

    def _decide(self, decision: ReviewDecision) -> None:
        session, view = self.tab.session, self.tab.view
        if session is None or view.step != "inspect":  # a key pressed elsewhere is no decision
            return
        queue = self.queue()
        if not queue:
            raise CommandError("There is no measured tree to look at.", "Find the trunks, and set the scale, first.")
        if view.selected is None:
            self._go_on(queue, ())
            return
        ids = view.chosen
        known = {entry.tree_id for entry in queue}
        if not known.issuperset(ids):
            raise CommandError("A tree that is not measured yet cannot be decided about.", "Wait until it is.")
        for panel in self.tab.panels:  # what was typed about it belongs to what is accepted
            panel.leave_tree()
        session.do(commands.review_trees(decided(session, ids, decision)))
        if len(ids) > 1:
            self._together.add(frozenset(ids))
        self._go_on(queue, ids)

    def went_back(self, change: Change) -> None:
        """After Undo: show the trees again whose decision it took back; accepting them had gone on to the next."""
        before, after, view = change.before, change.after, self.tab.view
        if view.step != "inspect" or before.trunks is not after.trunks:
            return
        ids = frozenset(i for i in {*before.trees, *after.trees} if before.record(i).review != after.record(i).review)
        # Not those that were accepted by their number alone: nobody had chosen them.
        if len(ids) == 1 or ids in self._together:
            self.tab.select(min(ids), fly=True, several=ids if len(ids) > 1 else frozenset())

    def _go_on(self, queue: tuple[QueueEntry, ...], ids: tuple[int, ...]) -> None:
        view = self.tab.view
        following = next_to_review(queue, view.selected, wanted=view.review_filter, decided=ids)
        if following is not None:
            self.tab.select(following, fly=True)
            return
        self.tab.select(view.selected)
        progress = review_progress(self.queue())
        again = f" {progress.n_doubtful} are put off: press Look again." if progress.n_doubtful else ""
        self.tab.worker.notify("Nothing is left here", _DONE[view.review_filter] + again, "success")

    def accept_good(self) -> None:
        """Accept every good diameter about which nothing stands out, in one step."""
        session = self.tab.require_session()
        ids = tuple(entry.tree_id for entry in self.queue() if entry.is_good)
        if not ids:
            raise CommandError("No tree is left that may be accepted without looking at it.")
        session.do(commands.review_trees(decided(session, ids, "accepted")))
        trees = "1 tree" if len(ids) == 1 else f"{len(ids)} trees"
        self.tab.worker.notify(f"{trees} accepted", "Good ones, with nothing to look at. Undo takes it back.")

    def _review_pressed(self, payload: Any) -> None:
        if payload == "accept":
            self.accept()
        elif payload == "later":
            self.put_off()
        elif payload == "undecide" and self.tab.session is not None:
            ids = self.tab.view.chosen
            self.tab.session.do(commands.review_trees(dict.fromkeys(ids)))

    def _filter_chosen(self, payload: Any) -> None:
        if payload in FILTERS:
            self.tab.view.review_filter = payload
            self.tab.refresh()

    def _sort_by_worst(self) -> None:
        view = self.tab.view
        view.sort_column, view.sort_descending = ("id" if view.sort_column == "worst" else "worst"), False
        self.tab.refresh()


def decided(session: Session, ids: tuple[int, ...], decision: ReviewDecision) -> dict[int, Review | None]:
    """A decision about trees as they are measured now, with who decided and when."""
    now = utc_now()
    document, reviews = session.document, {}
    for i in ids:
        result = session.measurement(i, document=document).result
        dbh_cm, refusal = (result.dbh_cm, "") if isinstance(result, DbhEstimate) else (None, result.code)
        reviews[i] = Review(decision, dbh_cm, refusal, session.author, now)
    return dict(reviews)


def review_bar(progress: ReviewProgress, shown: QueueFilter, *, is_worst_first: bool) -> str:
    """HTML: how many are looked at, a button for each kind of tree, and two for all of them."""
    numbers = {
        "all": progress.n_all,
        "open": progress.n_all - progress.n_reviewed,
        "doubtful": progress.n_doubtful,
        "stale": progress.n_stale,
        "refused": progress.n_refused,
    }
    chips = "".join(
        f'<button type="button" data-filter="{name}" aria-pressed="{"true" if name == shown else "false"}" '
        f'onclick="{call("review-filter", name)}">{title} <b>{numbers[name]}</b></button>'
        for name, title in _FILTER_TITLES.items()
        if name in ("all", "open") or numbers[name] or name == shown
    )
    width = 100.0 * progress.n_reviewed / max(progress.n_all, 1)
    worst = (
        f'<button type="button" data-do="worst" aria-pressed="{"true" if is_worst_first else "false"}" '
        f'title="The order in which Space goes through them" onclick="{call("review-worst")}">Worst first</button>'
    )
    good = ""
    if progress.n_good:
        tip = "Good diameters with nothing to look at, in one step that Undo takes back"
        good = (
            f'<button type="button" data-do="review-good" title="{tip}" onclick="{call("review-good")}">'
            f"&#10003; Accept {progress.n_good} good</button>"
        )
    return (
        f'<div class="dbh dbh-review"><div class="dbh-review-line"><span>{progress.n_reviewed} of {progress.n_all} '
        f'reviewed</span><i class="dbh-review-bar"><i style="width:{width:.0f}%"></i></i>{good}</div>'
        f'<div class="dbh-chips">{chips}{worst}</div></div>'
    )


def review_card(entry: QueueEntry, review: Review | None, *, n_chosen: int = 1) -> str:
    """HTML in the card of a tree: why it comes now, what was decided, and the buttons that decide."""
    # The reason of a refusal stands in red below; of the others the worst is enough here, the list has them all.
    others = entry.reasons[1:] if entry.concern == "refused" else entry.reasons
    moved = entry.reasons[-1:] if entry.state == "stale" else ()
    reasons = "; ".join(dict.fromkeys((*others[:1], *moved)))
    said = ""
    if review is not None:
        verb = "Accepted" if review.decision == "accepted" else "Put off, to be looked at again"
        signed = signed_words(review.who, review.when)
        said = (
            f'<div class="dbh-decided" data-state="{esc(entry.state)}">{esc(": ".join(filter(None, (verb, signed))))}'
        )
        said += f' <button type="button" title="Take it back" onclick="{call("review", "undecide")}">&#10005;</button>'
        said += "</div>"
    these = f" these {n_chosen}" if n_chosen > 1 else " without DBH" if entry.quality == "refused" else ""
    why = f'<div class="dbh-why" title="Why it comes now">{esc(plain(reasons))}</div>' if reasons else ""
    fine = "" if reasons or entry.concern == "refused" or n_chosen > 1 else "<span>Nothing stands out.</span>"
    return (
        f'<div class="dbh-decide" data-concern="{esc(entry.concern)}">{why}{said}<div>'
        f'<button type="button" data-do="accept" title="Right as it is; go to the next one (Space)" '
        f'onclick="{call("review", "accept")}">&#10003; Accept{these} <kbd>Space</kbd></button>'
        f'<button type="button" data-do="later" title="Not sure; go to the next one (L)" '
        f'onclick="{call("review", "later")}">Later <kbd>L</kbd></button>{fine}</div></div>'
    )
