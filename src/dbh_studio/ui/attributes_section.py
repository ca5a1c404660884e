"""What a person says about a tree, or about several at once: species, state, tag, and fields of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import viser

from dbh_studio.app import commands, edits
from dbh_studio.app.commands import Command
from dbh_studio.app.document import Document
from dbh_studio.app.session import Session
from dbh_studio.app.species import Species, known_species, matching_species, shipped_species, species_list
from dbh_studio.core.tree_record import TREE_STATUSES, TreeRecord
from dbh_studio.errors import CommandError, FileError
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.panels.base import Section, set_content, set_value, set_visible

_STATUS_TITLES = {"": "not said", "live": "live", "dead": "dead", "broken": "broken"}
_MIXED = "as they are"
_HEALTHS = ("healthy", "damaged", "declining", "diseased")
_CROWN_CLASSES = ("dominant", "codominant", "intermediate", "suppressed")
_TEXTS = ("tag", "species", "health", "crown_class", "note")
_MOST_FIELDS, _LONGEST_NAME = 40, 40
_OFFERED = 5


class AttributesSection(Section):
    """What is typed stays until it is kept or another tree is chosen, which keeps it."""

    def build(self) -> None:
        """Add the inputs."""
        gui, worker = self.gui, self.tab.worker
        self._shown: tuple[Session, tuple[int, ...], dict[str, str]] | None = None
        self._species_known: tuple[Path | None, tuple[Species, ...]] | None = None
        self._own: dict[str, Any] = {}
        self._named: tuple[Session, list[str]] | None = None
        with gui.add_folder("About this tree", expand_by_default=False, visible=False) as self._about:
            self._these = gui.add_html("", visible=False)
            self._inputs: dict[str, Any] = {"species": gui.add_text("Species", "", hint="a name or a code; type some")}
            self._offers = gui.add_html("")
            self._inputs["status"] = gui.add_dropdown(
                "Status", tuple(_STATUS_TITLES[status] for status in TREE_STATUSES)
            )
            for name, title, offered in (
                ("health", "Health", _HEALTHS),
                ("crown_class", "Crown class", _CROWN_CLASSES),
            ):
                self._inputs[name] = gui.add_text(title, "")
                gui.add_html(chips(name, [(value, value) for value in offered]))
            self._inputs["tag"] = gui.add_text("Tag", "", hint="the number on the tree's tag")
            self._inputs["note"] = gui.add_text("Note", "")
            self._own_folder = gui.add_folder(None)
            worker.on_click(gui.add_button("Keep", icon=viser.Icon.CHECK, color="green"), self.keep)
            self._new_name = gui.add_text(
                "New field", "", hint="a name, such as Height class; for every tree of the plot"
            )
            add = gui.add_button("Add the field", icon=viser.Icon.PLUS, color="gray")
            worker.on_click(add, self._add_field)
            delete = gui.add_button("Delete this trunk", icon=viser.Icon.TRASH, color="red", hint="Undo brings it back")
            worker.on_click(delete, self._delete)
        worker.on_update(self._inputs["species"], lambda _: self._offer_species(), coalesce=True)
        self.tab.bridge.on("attribute", self._offer_taken)

    # ---- showing

    def refresh(self) -> None:
        """Show what is said about the chosen trees, but for what is being typed."""
        session, ids = self.tab.session, self.tab.view.chosen
        if session is None or not ids or not set(ids) <= set(session.document.trunks.ids):
            set_visible(self._about, False)
            self._shown = None
            return
        document = session.document
        self._add_inputs(session, document)
        now = shared_values([document.record(i) for i in ids], self._own)
        before = self._shown
        is_new = before is None or before[0] is not session or before[1] != ids
        status = self._inputs["status"]
        titles = tuple(_STATUS_TITLES[each] for each in TREE_STATUSES)
        wanted = (*titles, _MIXED) if now["status"] == _MIXED else titles
        if tuple(status.options) != wanted:
            status.options = wanted
        for name, value in now.items():
            handle = self._handle(name)
            is_typed = not is_new and before is not None and self._typed(name) != before[2].get(name, "")
            if not is_typed or handle.value not in getattr(handle, "options", (handle.value,)):
                set_value(handle, _STATUS_TITLES.get(value, value) if name == "status" else value)
        self._shown = session, ids, now
        set_content(self._these, _these_words(ids))
        set_visible(self._these, len(ids) > 1)
        set_visible(self._about, True)
        if is_new:
            self._offer_species()

    def _add_inputs(self, session: Session, document: Document) -> None:
        """An input for every field of one's own that any tree of the plot has, or that was named here."""
        named = self._named[1] if self._named is not None and self._named[0] is session else []
        wanted = sorted({name for record in document.trees.values() for name, _ in record.fields} | set(named))
        if wanted == list(self._own):
            return
        typed = {name: handle.value for name, handle in self._own.items()}
        for handle in self._own.values():
            handle.remove()
        with self._own_folder:
            self._own = {name: self.gui.add_text(name, typed.get(name, "")) for name in wanted}

    def _handle(self, name: str) -> Any:
        return self._own[name.removeprefix("field:")] if name.startswith("field:") else self._inputs[name]

    def _typed(self, name: str) -> str:
        value = str(self._handle(name).value)
        if name != "status":
            return value.strip()
        return next((key for key, title in _STATUS_TITLES.items() if title == value), value)

    # ---- species

    def _species(self) -> tuple[Species, ...]:
        """All species to offer; those of one's own list are read once for each plot."""
        session = self.tab.session
        folder = None
        if session is not None:
            kept = getattr(session.saver, "folder", None)
            folder = Path(kept if kept is not None else session.document.source.path).absolute().parent
        if self._species_known is None or self._species_known[0] != folder:
            try:
                self._species_known = folder, species_list(folder)
            except FileError as error:
                self._species_known = folder, shipped_species()
                self.tab.worker.notify_error(error)
        return self._species_known[1]

    def _offer_species(self) -> None:
        session, text = self.tab.session, str(self._inputs["species"].value)
        used = [] if session is None else [r.species for r in session.document.trees.values() if r.species]
        set_content(self._offers, species_offers(text, self._species(), used=used))

    def _offer_taken(self, payload: Any) -> None:
        """A chip was pressed: its text goes into the input, as if it had been typed."""
        is_pair = isinstance(payload, list) and len(payload) == 2 and all(isinstance(part, str) for part in payload)
        if is_pair and payload[0] in _TEXTS and len(payload[1]) <= 200:
            set_value(self._inputs[payload[0]], payload[1])
            if payload[0] == "species":
                self._offer_species()

    # ---- keeping

    def leave_tree(self) -> None:
        """Keep what was typed about the trees that were on screen, as the button Keep does."""
        session, shown = self.tab.session, self._shown
        if session is None or shown is None or shown[0] is not session:
            return
        if session.is_read_only:
            if any(self._typed(name) != value for name, value in shown[2].items()):
                told = "What was typed about the tree was not kept: the plot is open for reading only."
                self.tab.worker.notify_error(CommandError(told, "Save a copy in step 1, and type it there."))
            return
        ids = tuple(i for i in shown[1] if i in session.document.trunks)
        if ids:
            self._keep(session, ids, shown[2])

    def keep(self) -> None:
        """Keep what was typed about the chosen trees."""
        session = self.tab.require_session()
        if self._shown is None or not self.tab.view.chosen:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        self._keep(session, self._shown[1], self._shown[2])
        self.refresh()

    def _keep(self, session: Session, ids: tuple[int, ...], shown: Mapping[str, str]) -> None:
        typed = {name: self._typed(name) for name in shown}
        changed = {name: value for name, value in typed.items() if value != shown[name]}
        if changed:
            session.do(describe(ids, changed))
            self._shown = session, ids, dict(shown) | changed

    def _add_field(self) -> None:
        session, name = self.tab.require_session(), str(self._new_name.value).strip()
        named = self._named[1] if self._named is not None and self._named[0] is session else []
        problem = field_problem(name, [*self._own, *named])
        if problem:
            raise CommandError(problem, "Give it another name.")
        self._named = session, [*named, name]
        set_value(self._new_name, "")
        self.refresh()

    def _delete(self) -> None:
        session, ids = self.tab.require_session(), self.tab.view.chosen
        if not ids:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        session.do(commands.delete_trunk(ids[0]) if len(ids) == 1 else edits.delete_trunks(ids))


def shared_values(records: Sequence[TreeRecord], own: Iterable[str]) -> dict[str, str]:
    """What each input shows: the value that all records share; where they differ nothing, and of the status a word."""

    def shared(value: Callable[[TreeRecord], str], mixed: str = "") -> str:
        values = {value(record) for record in records}
        return values.pop() if len(values) == 1 else mixed

    values = {name: shared(lambda record, name=name: str(getattr(record, name))) for name in _TEXTS}  # type: ignore[misc]
    values["status"] = shared(lambda record: record.status, _MIXED)
    for name in own:
        values[f"field:{name}"] = shared(lambda record, name=name: dict(record.fields).get(name, ""))  # type: ignore[misc]
    return values


def describe(ids: Sequence[int], values: Mapping[str, str]) -> Command:
    """Say all this about trees in one step; names that begin with ``field:`` are fields of one's own."""
    fields = {name.removeprefix("field:"): value for name, value in values.items() if name.startswith("field:")}
    others = {name: value for name, value in values.items() if not name.startswith("field:")}
    described = commands.describe_trees(ids, **others)
    if not fields:
        return described
    filled = commands.set_tree_fields(ids, **fields)
    return Command(described.label, lambda document: filled.apply(described.apply(document)))


def field_problem(name: str, known: Sequence[str]) -> str:
    """Why a field cannot be called this; empty where it can."""
    if not name:
        return "The field has no name yet."
    if len(name) > _LONGEST_NAME:
        return f"A name of more than {_LONGEST_NAME} characters does not fit."
    if name.casefold() in {each.casefold() for each in known}:
        return f"There is a field {name} already."
    if len(known) >= _MOST_FIELDS:
        return f"There are {_MOST_FIELDS} fields already."
    return ""


def chips(name: str, offered: Sequence[tuple[str, str]]) -> str:
    """HTML: buttons that put their text into an input; pairs of the text and its tooltip."""
    buttons = "".join(
        f'<button type="button" data-offer="{esc(value)}" title="{esc(tip)}" '
        f'onclick="{call("attribute", [name, value])}">{esc(value)}</button>'
        for value, tip in offered
    )
    return f'<div class="dbh dbh-chips dbh-offered" data-for="{esc(name)}">{buttons}</div>'


def species_offers(text: str, species: Sequence[Species], *, used: Sequence[str] = ()) -> str:
    """HTML under the species: what may be meant by what was typed, or what it is; before that, what the plot has.

    Args:
        text: What is typed so far.
        species: All that are known.
        used: Species of the plot's other trees.
    """
    found = known_species(text, species)
    if found is not None and found.scientific_name == text.strip():
        return f'<div class="dbh dbh-offered muted" data-known>{esc(found.words())}</div>'
    if not text.strip():
        often = sorted(set(used), key=lambda name: (-used.count(name), name))[:_OFFERED]
        return chips("species", [(name, "as other trees of the plot") for name in often])
    offered = [(each.scientific_name, each.words()) for each in matching_species(text, species, at_most=_OFFERED)]
    return chips("species", offered)


def _these_words(ids: Sequence[int]) -> str:
    listed = ", ".join(map(str, ids[:8])) + (", …" if len(ids) > 8 else "")
    return (
        f'<div class="dbh"><div class="dbh-hint" data-level="ok" data-several="{len(ids)}">These {len(ids)} trees '
        f"({esc(listed)}): what you change here is kept for all of them.</div></div>"
    )
