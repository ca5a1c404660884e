"""The card of the chosen tree: its number, its section, what is to be decided, and what helps where it is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources
from typing import TYPE_CHECKING, Any

from dbh_studio.app.document import Document
from dbh_studio.app.section_edits import left_out_uv_m, other_heights
from dbh_studio.core.dbh import DbhEstimate, Refusal
from dbh_studio.core.stem_profile import ProfilePoint, breast_height_flag
from dbh_studio.errors import CommandError
from dbh_studio.ui import tree_card
from dbh_studio.ui.candidates_section import flag_html
from dbh_studio.ui.correction_html import corrections_html, picture_tools, remedies_html
from dbh_studio.ui.correction_section import CorrectionSection
from dbh_studio.ui.panels.base import Section, set_content
from dbh_studio.ui.profile_svg import profile_svg
from dbh_studio.ui.review_section import ReviewSection, review_card
from dbh_studio.ui.section_svg import section_svg

if TYPE_CHECKING:
    from dbh_studio.stages.measure import StemMeasurement
    from dbh_studio.ui.tab import Tab


@dataclass(frozen=True, eq=False)
class Compared:
    """One tree looked at more closely, as it is measured in one way."""

    document: Document
    measured: StemMeasurement
    result: DbhEstimate | Refusal
    profile: tuple[ProfilePoint, ...]
    height_m: float


class CardSection(Section):
    """Shows the chosen tree."""

    def __init__(self, tab: Tab, review: ReviewSection) -> None:
        self._review = review
        self.correction: CorrectionSection | None = None
        self._compared: Compared | None = None
        super().__init__(tab)

    def build(self) -> None:
        """Add the card."""
        self._card = self.gui.add_html("")
        bridge = self.tab.bridge
        bridge.run(resources.files("dbh_studio.ui").joinpath("card_fields.js").read_text(encoding="utf-8"))
        bridge.on("compare", self._compare)

    def refresh(self) -> None:
        """Show the chosen tree: text first, so that it is there before the picture has turned."""
        session, selected = self.tab.session, self.tab.view.selected
        document = session.document if session is not None else None
        if session is None or document is None or selected is None or selected not in document.trunks:
            set_content(self._card, tree_card.no_tree_card() if document and len(document.trunks) else "")
            return
        stem = self.tab.stem(document, selected)
        if stem is None:
            set_content(self._card, tree_card.waiting_card(selected))
            return
        compared = self.compared(document, stem)
        result, profile = stem.result, ""
        if compared is not None:
            result = compared.result
            profile = profile_svg(compared.profile, height_m=compared.height_m, tree_id=selected)
        record, entry = document.record(selected), self._review.entry(selected)
        said = "" if entry is None else review_card(entry, record.review, n_chosen=len(self.tab.view.chosen))
        moved, serial = "", 0
        if self.correction is not None:
            moved = self.correction.moved(selected, stem.result)
            serial = self.correction.picture_serial(selected, result.section)
        said += corrections_html(record, result, moved)
        crossed = left_out_uv_m(session, document, selected, result.section) if result.section is not None else None
        picture = section_svg(result, curve=_drawn_curve(result, document), crossed_uv_m=crossed)
        if picture:
            picture += picture_tools(selected, serial, has_left_out=record.correction("left_out") is not None)
        actions = ""
        if isinstance(result, Refusal):
            found = None if compared is None else other_heights(compared.profile, compared.height_m)
            actions = remedies_html(selected, result, found, serial=serial)
        scale = tree_card.scale_words(document.scale)
        card = tree_card.tree_card(
            selected,
            result,
            section=picture + profile,
            scale=scale,
            said=said,
            actions=actions,
            plot_height_m=tree_card.height_of_plot_m(result, document.settings.measure),
        )
        set_content(self._card, card + flag_html(selected, record.flag))

    def compared(self, document: Document, stem: StemMeasurement) -> Compared | None:
        """What was found on looking more closely at a tree, if it is still so: a note about it changes nothing."""
        found = self._compared
        if found is None or found.measured.trunk_id != stem.trunk_id:
            return None
        return found if found.document is document or found.measured is stem else None

    def _compare(self, _: Any = None) -> None:
        """Measure the chosen tree by every method and all along the stem, for the pictures."""
        session, selected = self.tab.require_session(), self.tab.view.selected
        if selected is None:
            raise CommandError("No tree is chosen.", "Click a trunk first.")
        document = session.document
        if not document.scale.is_known or selected not in document.trunks:
            return
        stem = session.measurement(selected, document=document)
        result = session.compared(selected, document=document).result
        profile = session.profile(selected, document=document)
        height_m = result.hom_m if isinstance(result, DbhEstimate) else document.settings.measure.breast_height_m
        if isinstance(result, DbhEstimate) and "profile" not in result.flag_codes:
            scale_sd = document.scale.relative_sd
            flag = breast_height_flag(profile, height_m, result.diameters[result.definition], scale_sd=scale_sd)
            if flag is not None:
                result = replace(result, flags=(*result.flags, flag.words), flag_codes=(*result.flag_codes, flag.code))
        self._compared = Compared(document, stem, result, profile, height_m)
        self.refresh()


def _drawn_curve(result: DbhEstimate | Refusal, document: Document) -> str:
    """The curve the diameter is read from: a tree may have one of its own."""
    return result.curve if isinstance(result, DbhEstimate) else document.settings.measure.curve
