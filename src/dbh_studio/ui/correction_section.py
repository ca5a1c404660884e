"""Correcting the measurement of one tree: height, ground, method, points, ring, tape. A part of the Inspect step."""

from __future__ import annotations

from functools import partial
from importlib import resources
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import viser

from dbh_studio.app import commands
from dbh_studio.app.document import Document
from dbh_studio.app.editing import split_by_stems
from dbh_studio.app.section_edits import (
    Drawing,
    drawn_points,
    drawn_polygon,
    in_source,
    moved_words,
    ring_in_source,
    tape_cm,
)
from dbh_studio.app.session import Session
from dbh_studio.core.corrections import CORRECTION_KINDS, Correction, CorrectionKind
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.section import CrossSection
from dbh_studio.core.section_drawing import CURVE_TITLES
from dbh_studio.errors import CommandError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import Section, set_content, set_value, set_visible
from dbh_studio.ui.signed import utc_now

if TYPE_CHECKING:
    from dbh_studio.ui.bind import SceneClick

_AS_PLOT = "as the plot"
_STEPS = {"−10 cm": -0.10, "−1 cm": -0.01, "+1 cm": 0.01, "+10 cm": 0.10}
_CHOICES: dict[CorrectionKind, tuple[str, dict[str, str]]] = {
    "curve": ("Method of this tree", {title: name for name, title in CURVE_TITLES.items()}),
    "base": ("Its base on a slope", {"uphill": "uphill", "midpoint": "midpoint", "downhill": "downhill"}),
    "along": ("Height counted", {"vertical": "vertical", "along the stem": "stem"}),
    "above": ("Measure it above", {"nothing": "nothing", "bulge": "bulge", "buttress": "buttress"}),
}
_ARROWS = "/breast-height"
_Result = DbhEstimate | Refusal


class CorrectionSection(Section):
    """Everything takes effect at once, is kept with who, when and why, and can be withdrawn by one press."""

    def build(self) -> None:
        """Add the inputs."""
        gui, worker, bridge = self.gui, self.tab.worker, self.tab.bridge
        bridge.run(resources.files("dbh_studio.ui").joinpath("section_tools.js").read_text(encoding="utf-8"))
        self._picture: tuple[int, int, CrossSection] | None = None
        self._moved: tuple[Session, int, _Result, _Result] | None = None
        self._shown: tuple[Session, int, tuple[Correction, ...], float] | None = None
        self._is_placing_ground = False
        self._arrows: viser.TransformControlsHandle | None = None
        with gui.add_folder("Correct this measurement", expand_by_default=False, visible=False) as self._folder:
            self._these = gui.add_html("", visible=False)
            self._why = gui.add_text("Why", "", hint="kept with what you change next; may stay empty")
            self._height = gui.add_number("Height (m)", 1.3, min=0.1, max=20.0, step=0.01, hint="above the base")
            self._steps = gui.add_button_group("Raise or lower", tuple(_STEPS))
            worker.on_click(gui.add_button("Measure at this height", icon=viser.Icon.RULER_2), self._typed_height)
            drag = gui.add_button("Drag the ring in the picture", icon=viser.Icon.ARROWS_VERTICAL, color="gray")
            worker.on_click(drag, self._toggle_arrows)
            ground = gui.add_button("Click where its ground is", icon=viser.Icon.MAP_PIN, color="gray")
            worker.on_click(ground, self._place_ground)
            self._state = gui.add_html("", visible=False)
            self._choices = {
                kind: gui.add_dropdown(title, (_AS_PLOT, *values)) for kind, (title, values) in _CHOICES.items()
            }
            self._tape = gui.add_text("Tape", "", hint="diameter read in the field: 31.5, or 12.4 in; never mixed in")
            self._tape_height = gui.add_text("Read at (m)", "", hint="height of the tape, if it is not breast height")
            worker.on_click(gui.add_button("Keep the tape value", icon=viser.Icon.RULER_MEASURE), self._typed_tape)
        worker.on_update(self._steps, self._stepped)
        for kind, choice in self._choices.items():
            worker.on_update(choice, partial(self._chosen, kind))
        for name, action in (
            ("section-draw", self._drawn),
            ("height-set", self._height_sent),
            ("tape", self._tape_sent),
            ("tape-typed", self._tape_half_typed),
            ("withdraw", self._withdrawn),
            ("split-stems", self._split),
            ("accept-arc", self._accept_arc),
        ):
            bridge.on(name, action)

    # ---- showing

    def refresh(self) -> None:
        """Show how the chosen tree is measured, but for what is being typed."""
        session, selected = self.tab.session, self.tab.view.selected
        document = session.document if session is not None else None
        is_there = document is not None and selected in document.trunks and document.scale.is_known
        set_visible(self._folder, is_there)
        if session is None or document is None or selected is None or not is_there:
            self._shown = None
            self._stop_gestures()
            return
        record, measure = document.record(selected), document.settings.measure
        said = (session, selected, record.corrections, measure.breast_height_m)
        if said != self._shown:
            if self._shown is None or said[:2] != self._shown[:2]:
                self._stop_gestures()
                for handle in (self._tape, self._tape_height, self._why):
                    set_value(handle, "")
            self._shown = said
            set_value(self._height, round(record.correction("breast_height") or measure.breast_height_m, 2))
            for kind, choice in self._choices.items():
                titles = {name: title for title, name in _CHOICES[kind][1].items()}
                set_value(choice, titles.get(record.correction(kind), _AS_PLOT))
        n_chosen = len(self.tab.view.chosen)
        if n_chosen > 1:
            words = f"{n_chosen} trees are chosen; only tree {selected} is corrected here."
            set_content(self._these, html.message(words))
        set_visible(self._these, n_chosen > 1)
        if self._is_placing_ground:
            set_content(self._state, html.message("Click the ground beside the stem, in the picture. Esc stops."))
        set_visible(self._state, self._is_placing_ground)

    def leave_tree(self) -> None:
        """Keep the tape value that was typed about the tree that was on screen, as its button does."""
        session, shown, text = self.tab.session, self._shown, str(self._tape.value).strip()
        if session is None or shown is None or shown[:2] != (session, self.tab.view.selected) or not text:
            return
        if shown[1] not in session.document.trunks:
            return
        try:
            self._typed_tape()
        except CommandError as error:  # nobody is held back by it
            told = f"The tape value of tree {shown[1]} was not kept. {error.problem}"
            self.tab.worker.notify_error(CommandError(told, error.remedy))
            set_value(self._tape, "")

    def picture_serial(self, trunk_id: int, section: CrossSection | None) -> int:
        """The number of the picture of a section: another one for every other section."""
        if section is None:
            return 0
        known = self._picture
        if known is None or known[2] is not section:
            self._picture = ((known[0] if known is not None else 0) + 1, trunk_id, section)
        assert self._picture is not None
        return self._picture[0]

    def moved(self, trunk_id: int, result: _Result) -> str:
        """What the last correction of a tree in this tab did to its number; empty once that is another, as by Undo."""
        if self._moved is None or self._moved[0] is not self.tab.session or self._moved[1] != trunk_id:
            return ""
        _, _, was, now = self._moved
        return "" if moved_words(now, result) else moved_words(was, now)

    # ---- correcting

    def correct(self, kind: CorrectionKind, value: Any) -> None:
        """Say something else about the measurement of the chosen tree, signed and dated."""
        session, trunk_id = self._chosen_tree()
        try:
            correction = Correction(kind, value, session.author, utc_now(), str(self._why.value).strip())
        except (TypeError, ValueError) as error:
            raise CommandError(f"This cannot be: {error}.") from None
        self._do(session, trunk_id, commands.correct_measurement(trunk_id, correction))
        set_value(self._why, "")

    def _do(self, session: Session, trunk_id: int, command: commands.Command) -> None:
        """Do it, and remember how the number has moved by it.

        The stem is measured before anybody hears of the change: it is at hand then, and no job begins for one stem.
        """
        before = session.document
        after = command.apply(before)
        if after is not before and session.has_ground():
            was, now = (session.measurement(trunk_id, document=each).result for each in (before, after))
            self._moved = session, trunk_id, was, now
        session.do(command)

    def _chosen_tree(self) -> tuple[Session, int]:
        session, selected = self.tab.require_session(), self.tab.view.selected
        if selected is None or selected not in session.document.trunks:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        session.require_scale()
        return session, selected

    def _set_height(self, height_m: float) -> None:
        session, _ = self._chosen_tree()
        if abs(height_m - session.document.settings.measure.breast_height_m) < 1e-6:
            self._withdrawn("breast_height")
        else:
            self.correct("breast_height", round(height_m, 3))

    def _typed_height(self) -> None:
        self._set_height(float(self._height.value))

    def _stepped(self, title: str) -> None:
        session, trunk_id = self._chosen_tree()
        document = session.document
        own = document.record(trunk_id).correction("breast_height")
        self._set_height((own or document.settings.measure.breast_height_m) + _STEPS[title])

    def _height_sent(self, payload: Any) -> None:
        """``[tree, metres]`` from a picture of the card."""
        tree, height = _pair(payload)
        if tree == self.tab.view.selected and isinstance(height, (int, float)) and not isinstance(height, bool):
            self._set_height(float(height))

    def _chosen(self, kind: CorrectionKind, title: str) -> None:
        if title == _AS_PLOT:
            self._withdrawn(kind)
        elif title in _CHOICES[kind][1]:
            self.correct(kind, _CHOICES[kind][1][title])

    def _withdrawn(self, payload: Any) -> None:
        if payload not in CORRECTION_KINDS:
            return
        session, trunk_id = self._chosen_tree()
        command = commands.withdraw_correction(trunk_id, payload)
        if payload == "tape":
            height = commands.withdraw_correction(trunk_id, "tape_height")
            command = _both(command, height)
        self._do(session, trunk_id, command)

    # ---- tape

    def _typed_tape(self) -> None:
        height = str(self._tape_height.value).strip()
        self._keep_tape(str(self._tape.value), height)
        for handle in (self._tape, self._tape_height):
            set_value(handle, "")

    def _tape_sent(self, payload: Any) -> None:
        tree, text = _pair(payload)
        if tree == self.tab.view.selected and isinstance(text, str):
            self._keep_tape(text[:100], "")
            set_value(self._tape, "")

    def _tape_half_typed(self, payload: Any) -> None:
        """``[tree, text]`` of the card's field: kept when one goes on, as what is typed in the panel."""
        tree, text = _pair(payload)
        if tree == self.tab.view.selected and isinstance(text, str):
            set_value(self._tape, text[:100])

    def _keep_tape(self, text: str, height: str) -> None:
        from dbh_studio.app.lengths import metres_from_text

        session, trunk_id = self._chosen_tree()
        signed = (session.author, utc_now(), str(self._why.value).strip())
        try:
            command = commands.correct_measurement(trunk_id, Correction("tape", tape_cm(text), *signed))
            if height:
                at = Correction("tape_height", metres_from_text(height, "The height of the tape"), *signed)
                command = _both(command, commands.correct_measurement(trunk_id, at))
        except ValueError as error:
            raise CommandError(f"This cannot be: {error}.") from None
        session.do(command)
        set_value(self._why, "")
        self.tab.bridge.run("dbhCard.forget()")

    # ---- drawn in the section

    def _drawn(self, payload: Any) -> None:
        """``[kind, tree, serial, corners]`` from the picture of the section."""
        if not isinstance(payload, list) or len(payload) != 4 or payload[0] not in get_args(Drawing):
            return
        kind, tree, serial, corners = payload
        session, trunk_id = self._chosen_tree()
        if self._picture is None or tree != trunk_id or self._picture[:2] != (serial, trunk_id):
            raise CommandError("The section has changed since it was drawn in.", "Draw it again.")
        document, section = session.document, self._picture[2]
        polygon = drawn_polygon(corners, at_least=4 if kind == "ring" else 3)
        if kind == "ring":
            self.correct("ring", ring_in_source(session, document, trunk_id, section, polygon))
            return
        found = drawn_points(session, document, trunk_id, section, polygon, keep=kind == "keep")
        earlier = document.record(trunk_id).correction("left_out") or ()
        self.correct("left_out", tuple(np.union1d(np.array(earlier, np.int64), found).tolist()))

    def _split(self, payload: Any) -> None:
        session, trunk_id = self._chosen_tree()
        if payload == trunk_id:
            session.do(split_by_stems(session, trunk_id))

    def _accept_arc(self, payload: Any) -> None:
        """Be content with the arc that was seen of the chosen tree, if that gives a diameter."""
        session, trunk_id = self._chosen_tree()
        document = session.document
        refused = session.measurement(trunk_id, document=document).result
        if payload != trunk_id or not isinstance(refused, Refusal) or refused.section is None:
            return
        least = float(np.floor(refused.section.coverage_deg))
        tried = commands.correct_measurement(trunk_id, Correction("least_arc", least)).apply(document)
        result = session.measurement(trunk_id, document=tried).result
        if isinstance(result, Refusal):
            raise CommandError(f"That gives no diameter either. {result.reason}", result.remedy)
        self.correct("least_arc", least)

    # ---- in the 3D picture

    def _place_ground(self) -> None:
        self._chosen_tree()
        self._is_placing_ground = not self._is_placing_ground
        self.refresh()

    def scene_clicked(self, click: SceneClick) -> bool:
        """Take a click that says where the ground is. Returns whether it did."""
        display, session, view = self.tab.studio.display, self.tab.session, self.tab.view
        if not self._is_placing_ground or display is None or session is None or view.step != "inspect":
            return False
        hit = display.picking.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if hit is None:
            raise CommandError("There is no point under the cursor.", "Click the ground where it was recorded.")
        place = np.asarray(click.ray_origin, np.float64) + hit.depth * np.asarray(click.ray_direction, np.float64)
        self._is_placing_ground = False
        self.correct("ground", tuple(float(part) for part in in_source(session.document, place[None])[0]))
        return True

    def stop(self) -> bool:
        """End what was begun in the picture. Returns whether anything was."""
        was_on = self._is_placing_ground or self._arrows is not None
        self._stop_gestures()
        if was_on:
            self.refresh()
        return was_on

    def _stop_gestures(self) -> None:
        self._is_placing_ground = False
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None

    def _toggle_arrows(self) -> None:
        if self._arrows is not None:
            self._stop_gestures()
            return
        session, trunk_id = self._chosen_tree()
        stem = session.measurement(trunk_id)
        if not np.isfinite([*stem.xy_m, stem.z_ground_m]).all():
            raise CommandError("The stem has no place yet.", "Type its height instead.")
        height = self._height_now(session.document, trunk_id)
        z_ground_m = stem.z_ground_m
        self._arrows = self.tab.client.scene.add_transform_controls(
            _ARROWS,
            0.6,
            active_axes=(False, False, True),
            disable_sliders=True,
            disable_rotations=True,
            depth_test=False,
            position=(float(stem.xy_m[0]), float(stem.xy_m[1]), float(z_ground_m + height)),
        )
        self.tab.worker.on_dragged(self._arrows, lambda at: self._dragged(trunk_id, float(at[2]) - z_ground_m))

    def _dragged(self, trunk_id: int, height_m: float) -> None:
        if trunk_id == self.tab.view.selected:
            self._set_height(round(max(height_m, 0.1), 2))

    def _height_now(self, document: Document, trunk_id: int) -> float:
        result = self.tab.require_session().measurement(trunk_id, document=document).result
        if isinstance(result, DbhEstimate):
            return result.hom_m
        own = document.record(trunk_id).correction("breast_height")
        return float(own or document.settings.measure.breast_height_m)


def _both(first: commands.Command, second: commands.Command) -> commands.Command:
    """Two commands as one step, by the name of the first."""
    return commands.Command(first.label, lambda document: second.apply(first.apply(document)))


def _pair(payload: Any) -> tuple[Any, Any]:
    return (payload[0], payload[1]) if isinstance(payload, list) and len(payload) == 2 else (None, None)
