"""The masks of the photos, part of the Trunks step: which way is taken and why; made, brought and looked through."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import viser

from dbh_studio.app.ladder import Ladder, look_at_ladder
from dbh_studio.app.mask_request import KeyframeChoice, MakeRequest, MaskRequest
from dbh_studio.errors import SettingError, StudioError
from dbh_studio.io.masks import MEANING_TITLES, MEANINGS, MaskMeaning
from dbh_studio.settings import MaskDetectorSettings, ModelRunSettings, VoteSettings
from dbh_studio.ui import html, mask_html
from dbh_studio.ui.forms import SettingsForm
from dbh_studio.ui.mask_jobs import MaskLook, with_meaning
from dbh_studio.ui.panels.base import set_content, set_disabled, set_value, set_visible, typed_path

if TYPE_CHECKING:
    from dbh_studio.app.session import Session
    from dbh_studio.ui.tab import Tab

_FIRST_DETECTOR = ("prompt", "box_threshold", "text_threshold", "mask_threshold")
_FIRST_VOTES = ("rule", "min_share", "min_count", "max_distance_m")
_WAYS: dict[str, Literal["auto", "detector", "prompted"]] = {
    "The best there is": "auto",
    "Detector and SAM": "detector",
    "SAM on trunks found by geometry": "prompted",
}
_DEFAULT_MODEL = "default"
# Models may be fetched in another window meanwhile: so often it is looked.
_LOOK_AGAIN_S = 10.0


class MasksSection:
    """Built at the GUI's current place, in a panel that brings it in step with the plot.

    Args:
        tab: The tab.
        keep_settings: Takes over what the forms of the panel say, before a search that reads it.
    """

    def __init__(self, tab: Tab, keep_settings: Callable[[], object]) -> None:
        self.tab, self._keep_settings = tab, keep_settings
        self._ladder: Ladder | None = None
        self._ladder_for: tuple[Any, ...] = ()
        self._looked_at = 0.0
        self._asked: MaskLook | None = None
        gui, worker = tab.client.gui, tab.worker
        self._folder = gui.add_folder("Masks of the photos")
        with self._folder:
            self._build_question(gui)
            self._state = gui.add_html("")
            self._find = gui.add_button("Find trunks from the masks", icon=viser.Icon.TREES, color="green")
            self._through = gui.add_button("Look through the masks", icon=viser.Icon.PHOTO_SEARCH, color="gray")
            self._make = gui.add_button("Make masks", icon=viser.Icon.WAND, color="green")
            self._build_bring(gui)
            self._build_make(gui)
            self._votes_folder = gui.add_folder("How masks vote", expand_by_default=False)
            with self._votes_folder:
                self._votes = SettingsForm(gui, VoteSettings(), first=_FIRST_VOTES)
        worker.on_click(self._find, self._find_pressed)
        worker.on_click(self._through, self._through_pressed)
        worker.on_click(self._make, self._make_pressed)

    def _build_question(self, gui: viser.GuiApi) -> None:
        worker = self.tab.worker
        self._question = gui.add_folder("What do these masks mean?", visible=False)
        with self._question:
            self._look = gui.add_html("")
            self._meaning = gui.add_dropdown("They mean", tuple(MEANING_TITLES.values()))
            self._numbers = gui.add_text(
                "Which are trunks", "", hint="of numbered masks, such as 7 or 1-12; of a COCO file names; empty for all"
            )
            self._look_again = gui.add_button("Show them read so", icon=viser.Icon.REFRESH, color="gray")
            self._use = gui.add_button("Use these masks", icon=viser.Icon.CHECK, color="green")
            self._ignore_them = gui.add_button("Keep as areas to ignore", icon=viser.Icon.EYE_OFF, color="green")
            self._not = gui.add_button("Do not use them", icon=viser.Icon.X, color="gray")
        worker.on_update(self._meaning, lambda _: self._look_pressed())
        worker.on_click(self._look_again, self._look_pressed)
        worker.on_click(self._use, self._use_pressed)
        worker.on_click(self._ignore_them, self._ignore_pressed)
        worker.on_click(self._not, self.tab.studio.mask_jobs.give_up)

    def _build_bring(self, gui: viser.GuiApi) -> None:
        self._bring = gui.add_folder("Bring masks", expand_by_default=False)
        with self._bring:
            self._path = gui.add_text(
                "Masks in", "", hint="on this computer: a folder with a mask per photo, or a COCO file"
            )
            self._ignored = gui.add_text(
                "Also ignore", "", hint="a folder of masks, black where the walker and the sky are; may stay empty"
            )
            self._style = gui.add_text(
                "Named like", "", hint="only where they are not found by themselves, such as {stem}_segm.png"
            )
            self._first_look = gui.add_button("Look at them", icon=viser.Icon.PHOTO, color="gray")
        self.tab.worker.on_click(self._first_look, self._first_look_pressed)

    def _build_make(self, gui: viser.GuiApi) -> None:
        self._making = gui.add_folder("How masks are made", expand_by_default=False)
        with self._making:
            self._way = gui.add_dropdown("Way", tuple(_WAYS))
            self._photos = gui.add_text(
                "Photos", "auto", hint="auto: those that add something; all; or so many, those that add most"
            )
            self._redo = gui.add_checkbox("Make all anew", False, hint="also those that are there; painted ones stay")
            detectors, segmenters = self._models("detector"), self._models("segmenter")
            self._detector = gui.add_dropdown("Detector", detectors)
            self._segmenter = gui.add_dropdown("Segmenter", segmenters)
            self._settings = SettingsForm(gui, MaskDetectorSettings(), first=_FIRST_DETECTOR)
            with gui.add_folder("Computer", expand_by_default=False):
                self._run = SettingsForm(gui, ModelRunSettings())

    # ---- showing

    @property
    def has_votes(self) -> bool:
        """Whether any mask would vote."""
        return any(state.votes for state in self.tab.studio.masks.states().values())

    def refresh(self) -> None:
        """Say which way is taken and why, what there is, and what can be done now."""
        session, studio, jobs = self.tab.session, self.tab.studio, self.tab.studio.mask_jobs
        set_visible(self._folder, session is not None)
        if session is None:
            return
        states = studio.masks.states()
        has_photos, n_masks = bool(states), sum(state.has_mask for state in states.values())
        problem = studio.masks.problem
        if problem is not None:
            set_content(self._state, html.message(problem.problem, level="stop", remedy=problem.remedy))
            for handle in (self._find, self._through, self._make):
                set_visible(handle, False)
            return
        ladder = self._looked(session)
        parts = [mask_html.ladder(ladder, mask_html.kept(states.values())) if has_photos else mask_html.no_photos()]
        if jobs.undone is not None:
            made, of = jobs.undone
            text = f"{made:,} of {of:,} masks are made. Go on where it stopped, or use those that are there."
            parts.append(html.message(text))
        if jobs.said:
            parts.append(html.findings([("note", text, "") for text in jobs.said]))
        set_content(self._state, "".join(parts))
        set_visible(self._find, self.has_votes)
        set_visible(self._through, n_masks > 0)
        can_make = ladder["detector"].can_make or ladder["prompted"].can_make
        set_visible(self._make, has_photos and can_make)
        label = "Go on making masks" if jobs.undone else "Make more masks" if n_masks else "Make masks"
        if self._make.label != label:
            self._make.label = label
        for folder in (self._bring, self._votes_folder):
            set_visible(folder, has_photos)
        set_visible(self._making, has_photos and can_make)
        self._refresh_question(jobs.look)

    def _refresh_question(self, look: MaskLook | None) -> None:
        set_visible(self._question, look is not None)
        if look is None or look is self._asked:
            self._asked = look
            return
        self._asked = look
        masks = look.masks
        set_content(self._look, mask_html.question(look))
        set_value(self._meaning, MEANING_TITLES[masks.meaning])
        # A COCO file says itself what its outlines are.
        set_visible(self._meaning, masks.coco is None)
        set_visible(self._numbers, masks.meaning == "labels")
        set_visible(self._look_again, masks.meaning == "labels")
        set_value(self._numbers, ", ".join(look.request.categories))
        set_visible(self._use, masks.finds_trunks)
        set_disabled(self._use, not look.may_confirm)
        self._use.label = "Yes, use them so" if masks.unclear else "Use these masks"
        set_visible(self._ignore_them, not masks.finds_trunks)

    def _looked(self, session: Session) -> Ladder:
        """The ladder, looked at again where something has changed, and now and then."""
        studio, document = self.tab.studio, session.document
        request = self._request(strict=False)
        key = (
            session,
            session.cameras,
            document.scale,
            len(document.trunks),
            studio.masks.states(),  # itself: the number of one that is gone may come again
            request,
        )
        now = time.monotonic()
        if self._ladder is None or key != self._ladder_for or now - self._looked_at > _LOOK_AGAIN_S:
            self._ladder = look_at_ladder(session, models=studio.masks.models, request=request)
            self._ladder_for, self._looked_at = key, now
        return self._ladder

    def set_busy(self, busy: bool) -> None:
        """One job at a time."""
        for button in (self._find, self._make, self._first_look, self._look_again, self._use, self._meaning):
            set_disabled(button, busy)
        look = self.tab.studio.mask_jobs.look
        if not busy and look is not None:
            set_disabled(self._use, not look.may_confirm)

    # ---- what a person does

    def _find_pressed(self) -> None:
        self._keep_settings()
        self.tab.studio.mask_jobs.find_trunks(self._votes.read())

    def _through_pressed(self) -> None:
        self.tab.masks.look_through()

    def _make_pressed(self) -> None:
        self.tab.studio.mask_jobs.make(self._request())

    def _first_look_pressed(self) -> None:
        path, ignored = typed_path(self._path.value), typed_path(self._ignored.value)
        if path is None:
            raise StudioError("No masks were named.", "Type the folder they are in, or a COCO file.")
        self._look_at(MaskRequest(path, style=self._style.value.strip() or None, ignore_path=ignored))

    def _look_pressed(self) -> None:
        look = self.tab.studio.mask_jobs.look
        if look is None:
            return
        meaning: MaskMeaning | None = None
        if look.masks.coco is None:
            meaning = next(each for each in MEANINGS if MEANING_TITLES[each] == self._meaning.value)
        # Numbers were asked for only where they are shown.
        numbers = tuple(part.strip() for part in self._numbers.value.split(",") if part.strip())
        self._look_at(with_meaning(look.request, meaning, numbers if meaning in (None, "labels") else ()))

    def _look_at(self, request: MaskRequest) -> None:
        self.tab.studio.mask_jobs.look_at(request)

    def _use_pressed(self) -> None:
        self.tab.studio.mask_jobs.use_brought()

    def _ignore_pressed(self) -> None:
        """Masks for structure from motion: they only say where photos say nothing."""
        jobs = self.tab.studio.mask_jobs
        if jobs.look is None:
            return
        path = jobs.look.request.path
        set_value(self._ignored, str(path))
        set_value(self._path, "")
        jobs.give_up()
        self.tab.worker.notify(
            "Kept as areas to ignore", f"Now name the masks of trunks: {path.name} says where they say nothing.", "info"
        )

    def _request(self, *, strict: bool = True) -> MakeRequest:
        """How masks are to be made; not `strict`, what is half typed is left out."""
        try:
            return MakeRequest(
                rung=_WAYS[self._way.value],
                keyframes=_photo_choice(self._photos.value),
                settings=self._settings.read(),
                run=self._run.read(),
                detector=_model(self._detector.value),
                segmenter=_model(self._segmenter.value),
                redo=bool(self._redo.value),
            )
        except SettingError:
            if strict:
                raise
            return MakeRequest()

    def _models(self, purpose: str) -> tuple[str, ...]:
        return (_DEFAULT_MODEL, *(spec.name for spec in self.tab.studio.masks.models.ready(purpose)))


def _model(name: str) -> str:
    return "" if name == _DEFAULT_MODEL else name


def _photo_choice(text: str) -> KeyframeChoice:
    """``auto``, ``all`` or a number."""
    typed = text.strip().lower()
    if typed in ("auto", ""):
        return "auto"
    if typed == "all":
        return "all"
    try:
        number = int(typed)
    except ValueError:
        number = 0
    if number < 1:
        raise SettingError(f"Photos: {text!r} is no number of photos.", "Write auto, all, or a number such as 40.")
    return number
