"""One browser tab: its panel, its picture, its selection. What it does is a command to the session or a view change."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.session import Change, Session
from dbh_studio.core.arrays import Float32, Float64
from dbh_studio.core.dbh import CurveFit, DbhEstimate
from dbh_studio.core.review_queue import review_progress
from dbh_studio.core.trunks import Trunk
from dbh_studio.errors import StudioError
from dbh_studio.settings import Settings
from dbh_studio.ui import html
from dbh_studio.ui.bind import SceneClick, TabWorker
from dbh_studio.ui.bridge import Bridge
from dbh_studio.ui.camera_layer import CameraLayer
from dbh_studio.ui.chain_view import ChainView
from dbh_studio.ui.edit_desk import EditDesk
from dbh_studio.ui.edit_keys import add_edit_commands
from dbh_studio.ui.marking import Marking
from dbh_studio.ui.mask_paint import MaskTools
from dbh_studio.ui.panels.base import Panel, set_content
from dbh_studio.ui.panels.export import ExportPanel
from dbh_studio.ui.panels.inspect import InspectPanel
from dbh_studio.ui.panels.open import OpenPanel
from dbh_studio.ui.panels.scale import ScalePanel
from dbh_studio.ui.panels.trunks import TrunksPanel
from dbh_studio.ui.photo_view import PhotoView
from dbh_studio.ui.returning import Returning
from dbh_studio.ui.scene import SceneView, TrunkPicture
from dbh_studio.ui.steps import PlotStatus, StepName
from dbh_studio.ui.view_controls import ViewControls
from dbh_studio.ui.view_state import ViewState

if TYPE_CHECKING:
    from dbh_studio.stages.measure import StemMeasurement
    from dbh_studio.ui.studio import Studio
    from dbh_studio.ui.studio_jobs import RunningJob

log = logging.getLogger(__name__)


class Tab:
    """Builds the panel of one client and keeps it in step with the plot; `adopt_session` shows the plot."""

    def __init__(self, studio: Studio, worker: TabWorker) -> None:
        self.studio = studio
        self.worker = worker
        self.client = worker.client
        self.bridge = Bridge(worker)
        self.scene = SceneView(self.client, is_hurried=lambda: worker.is_behind)
        self.view = ViewState()
        self._build()
        self.bridge.on("step", self._step_chosen)
        self.bridge.on("row", self._row_chosen)
        self.bridge.on("undo", lambda _: self._undo_pressed())
        self.bridge.on("redo", lambda _: self._redo_pressed())
        # At once: what fills the queue may be waiting for the very job.
        self.bridge.on("cancel", lambda _: self.studio.cancel_job(), at_once=True)
        self.bridge.on("measure", lambda _: self.studio.measure_missing())
        self.bridge.on("neighbour", lambda n: self._step_tree(1 if n == 1 else -1))
        worker.on_scene_click(self.client, self.click_scene)
        worker.on_close(self.scene.stop)
        self.returning = Returning(self)

    # ---- building

    def _build(self) -> None:
        gui = self.client.gui
        self.bridge.run(html.style_js())
        self._header = gui.add_html("")
        self._job_box = gui.add_html("", visible=False)
        self.photos = PhotoView(self)
        self.masks = MaskTools(self)
        self.cameras = CameraLayer(self)
        self.marking = Marking(self)
        self.chain = ChainView(self)
        self.editing = EditDesk(self)
        before = (OpenPanel(self), ScalePanel(self), TrunksPanel(self))
        self.inspect = InspectPanel(self)
        self.panels: tuple[Panel, ...] = (*before, self.inspect, ExportPanel(self))
        self.controls = ViewControls(self)
        self._add_commands()

    def _add_commands(self) -> None:
        # W A S D Q E and the arrow keys already move the camera.
        for label, key, modifier, action in (
            ("Undo", "Z", "cmd/ctrl", self._undo_pressed),
            ("Redo", "Z", "cmd/ctrl+shift", self._redo_pressed),
            ("Next tree", "N", None, lambda: self._step_tree(1)),
            ("Previous tree", "P", None, lambda: self._step_tree(-1)),
            ("Accept and go on", "space", None, lambda: self.inspect.review.accept()),
            ("Look again later", "L", None, lambda: self.inspect.review.put_off()),
            ("Fly to the tree", "F", None, self.fly_to_selected),
            ("Next colours", "C", None, self.controls.next_mode),
            ("Look from the top", "T", None, self.scene.look_from_top),
            ("Whole plot", "H", None, self.scene.look_at_plot),
            ("Stop marking", "escape", None, self.marking.stop),
            ("Stop correcting the measurement", "escape", None, lambda: self.inspect.correction.stop()),
        ):
            self.worker.add_command(label, action, hotkey=key, modifier=modifier)
        add_edit_commands(self.worker, self.editing)

    # ---- the plot

    @property
    def session(self) -> Session | None:
        """The open plot, if any."""
        return self.studio.session

    def require_session(self) -> Session:
        """The open plot; StudioError where none is open."""
        if self.studio.session is None:
            raise StudioError("No plot is open.", "Open one in step 1.")
        return self.studio.session

    def settings(self) -> Settings:
        """The plot's settings, or the defaults."""
        return self.session.document.settings if self.session is not None else Settings()

    def adopt_session(self) -> None:
        """Show the plot that is open now from scratch: on connect, and after another one was opened."""
        self.view.selected, self.view.n_inspected = None, 0
        self.view.several, self.view.review_filter = frozenset(), "all"
        self.photos.close()
        self.editing.plot_opened()
        self.view.step = self.status().next_step()
        session = self.session
        check = session.data_check if session is not None else None
        if session is not None and len(session.document.trunks):
            self._show_in_red()
        elif check is not None and any(finding.level == "warn" for finding in check.findings):
            # A doubt about the file is read before anything is pressed.
            self.view.step = "open"
        self.refresh()
        self.client.flush()
        self.show_cloud()

    def show_cloud(self) -> None:
        """Send the cloud as it is now turned and scaled."""
        display = self.studio.display
        if display is None:
            self.scene.show_nothing_open()
            self.cameras.refresh()
            return
        if not self.scene.shows(display):  # after a row of changes the first of them has sent the last one's cloud
            self.scene.show_plot(display)
            self.editing.plot_sent()
        self.refresh_trunks()
        self.cameras.refresh()
        self.controls.show_plot()
        self.chain.plot_sent()

    def session_changed(self, change: Change) -> None:
        """Follow one change of the document."""
        session = self.session
        if session is None:
            return
        self.editing.follow(change)
        # Not those of the change: others may have followed while it waited.
        if self.view.selected not in session.document.trunks:
            self.view.selected = None
        if not self.view.several <= set(session.document.trunks.ids):
            self.view.several = frozenset()
        self.refresh()
        self.client.flush()
        if change.moves_points:
            self.show_cloud()
        elif change.before is not change.after:
            self.refresh_trunks()
            self.cameras.refresh()
        self.masks.offer_counts()
        self.photos.refresh()
        if change.before.trunks is not change.after.trunks and len(change.before.trunks) == 0:
            self._trunks_appeared()

    def photos_changed(self) -> None:
        """Show photos that have just been found or read."""
        self.refresh()
        self.cameras.refresh()
        self.photos.refresh()

    def _trunks_appeared(self) -> None:
        """The first trunks of a plot: show them, to be looked through."""
        self._show_in_red()
        if not self.masks.mode:  # nobody is taken away from what they paint
            self.view.step = "inspect"
        self.refresh()

    def _show_in_red(self) -> None:
        if self.view.mode == "Original":
            self.controls.set_mode("Segmentation (red)")

    def status(self) -> PlotStatus:
        """What is done of this plot."""
        session = self.session
        if session is None:
            return PlotStatus()
        document = session.document
        waiting = set(session.unmeasured(document))
        measured = [
            i for i in document.trunks.ids if i not in waiting and session.measurement(i, document=document).result
        ]
        return PlotStatus(
            has_plot=True,
            is_scaled=document.scale.is_known,
            n_trunks=len(document.trunks),
            n_measured=len(measured),
            n_waiting=len(waiting),
            n_inspected=self.view.n_inspected,
            n_reviewed=review_progress(self.inspect.review.queue()).n_reviewed,
            is_exported=self.studio.is_exported(),
            has_photos=session.cameras is not None,
        )

    # ---- showing

    def refresh(self) -> None:
        """Bring header, active panel and buttons in step."""
        self.chain.follow()
        with self.client.atomic():
            self.editing.show()
            self.refresh_header()
            for panel in self.panels:
                is_active = panel.step == self.view.step
                if is_active:
                    panel.refresh()
                panel.show(is_active)

    def measured(self) -> None:
        """Show diameters that have just been measured."""
        self.refresh()
        self._refresh_highlight()

    def refresh_header(self) -> None:
        """Plot name, steps, hint."""
        session = self.session
        content = html.header(
            session.document.plot_id if session is not None else "",
            self.status(),
            self.view.step,
            saved=self.studio.saved_text(),
            problem=self.studio.save_problem(),
            undo=session.undo_label if session is not None else "",
            redo=session.redo_label if session is not None else "",
            is_busy=self._job_box.visible,
            is_read_only=session is not None and session.is_read_only,
        )
        set_content(self._header, content)

    def refresh_trunks(self) -> None:
        """Bring the trunk overlays, labels and the highlight in step."""
        session = self.session
        if session is None or self.studio.display is None:
            return
        document = session.document
        self.scene.show_trunks(tuple(document.trunks), partial(self._picture_of, session, document))
        self._refresh_highlight()

    @staticmethod
    def _picture_of(session: Session, document: Document, trunk: Trunk) -> TrunkPicture:
        points, rgb = session.points_world(document)[trunk.points], session.cloud.rgb
        return TrunkPicture(points, None if rgb is None else rgb[trunk.points], _label_anchor(points))

    def _refresh_highlight(self) -> None:
        session, selected = self.session, self.view.selected
        document = session.document if session is not None else None
        if session is None or document is None or selected is None or selected not in document.trunks:
            self.scene.highlight(None)
            self.editing.draw()
            return
        picture = self._picture_of(session, document, document.trunks[selected])
        self.scene.highlight(picture, self._ring_world(self.stem(document, selected)))
        self.editing.draw()

    def stem(self, document: Document, trunk_id: int) -> StemMeasurement | None:
        """A stem of the plot; None while the ground is still being fitted, which may take long."""
        session = self.require_session()
        is_waiting = document.scale.is_known and not session.has_ground()
        if is_waiting and trunk_id in session.unmeasured(document):
            return None
        return session.measurement(trunk_id, document=document)

    def _ring_world(self, stem: StemMeasurement | None) -> Float32 | None:
        """(M, 3) outline of the measured curve in the world frame."""
        if stem is None or not isinstance(stem.result, DbhEstimate):
            return None
        fit = stem.result.fits[stem.result.curve]
        if not isinstance(fit, CurveFit):
            return None
        # A little outside the bark, or the trunk's own points, which are drawn as discs, would hide it.
        point_size = self.studio.display.point_size if self.studio.display is not None else 0.0
        centre, margin = fit.outline_uv_m.mean(axis=0), 0.02 + 0.8 * point_size
        outline = centre + (fit.outline_uv_m - centre) * (1.0 + 2.0 * margin / fit.diameter_m("curve"))
        flat = np.column_stack([outline, np.zeros(len(outline))])
        ring = stem.result.section.stem_from_section.apply(flat)
        return (ring + np.array([0.0, 0.0, stem.z_ground_m])).astype(np.float32)

    def show_job(self, job: RunningJob | None) -> None:
        """Show the running job, or that none runs."""
        with self.client.atomic():
            if job is not None:
                set_content(self._job_box, html.job_box(job.title))
            if self._job_box.visible != (job is not None):
                self._job_box.visible = job is not None
                self.refresh_header()
                for panel in self.panels:
                    panel.set_busy(job is not None)
        if job is not None:
            self.bridge.run(html.job_js(job.fraction, job.message))
        self.client.flush()

    # ---- what a person does

    def go_to_next_step(self) -> None:
        """Show the first step that is not done."""
        self.view.step = self.status().next_step()
        self.refresh()

    def select(self, trunk_id: int | None, *, fly: bool = False, several: frozenset[int] = frozenset()) -> None:
        """Choose a tree: text first, then the row, then the picture. What was typed about the last one is kept.

        Args:
            trunk_id: The tree whose card is shown.
            fly: Look at it.
            several: All that are chosen, it among them; empty for it alone.
        """
        if (trunk_id, several) != (self.view.selected, self.view.several):
            for panel in self.panels:
                panel.leave_tree()
        self.view.selected, self.view.several = trunk_id, several
        if trunk_id is not None:
            self.view.n_inspected += 1
            self.view.step = "inspect"
        self.refresh()
        self.client.flush()
        self._refresh_highlight()
        if fly and trunk_id is not None:
            self.fly_to_selected()

    def click_scene(self, click: SceneClick) -> None:
        """Do what a click in the picture does."""
        session, display = self.session, self.studio.display
        if session is None or display is None or self.marking.scene_clicked(click):
            return
        if self.inspect.correction.scene_clicked(click):
            return
        if not self.marking.is_on and (self.editing.gestures.scene_clicked(click) or self.chain.clicked(click)):
            return
        hit = display.picking.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if self.cameras.click(click, hit.depth if hit is not None else np.inf) or hit is None:
            return
        if self.marking.is_on:
            return
        trunk_id = display.trunk_under(hit, session.document.trunks)
        if trunk_id is not None or self.view.selected is not None:
            self.select(trunk_id)

    def _step_chosen(self, payload: Any) -> None:
        if payload in get_args(StepName):
            self.view.step = payload
            self.refresh()

    def _row_chosen(self, payload: Any) -> None:
        session = self.session
        is_there = session is not None and isinstance(payload, int) and payload in session.document.trunks
        if is_there and not self.editing.gestures.tree_clicked(payload):
            self.select(payload, fly=True)

    def _step_tree(self, step: int) -> None:
        ids = self.session.document.trunks.ids if self.session is not None else ()
        if not ids:
            return
        at = ids.index(self.view.selected) + step if self.view.selected in ids else (0 if step > 0 else -1)
        self.select(ids[at % len(ids)], fly=True)

    def fly_to_selected(self) -> None:
        """Look at the chosen tree at breast height; nothing where none is chosen."""
        session, selected = self.session, self.view.selected
        document = session.document if session is not None else None
        if session is None or document is None or selected is None or selected not in document.trunks:
            return
        stem = self.stem(document, selected)
        if stem is not None and isinstance(stem.result, DbhEstimate):
            target = np.array([*stem.xy_m, stem.z_ground_m + stem.result.section.hom_m])
        else:
            points = session.points_world(document)[document.trunks[selected].points]
            target = np.median(points, axis=0).astype(float)
        self.scene.fly_to(target)

    def _undo_pressed(self) -> None:
        if self.marking.take_back() or self.masks.take_back():  # the last thing that was done
            return
        # A key pressed once too often is no error.
        if self.session is not None and self.session.can_undo:
            self.inspect.review.went_back(self.session.undo())

    def _redo_pressed(self) -> None:
        if self.session is not None and self.session.can_redo:
            self.session.redo()


def _label_anchor(points: Float32) -> Float64:
    """Where a trunk's number stands: above the middle of its lower two metres."""
    if len(points) == 0:
        return np.zeros(3)
    base = float(np.percentile(points[:, 2], 2))
    low = points[points[:, 2] < base + 2.0]
    centre = np.median(low if len(low) else points, axis=0).astype(np.float64)
    centre[2] = base + 2.3
    return centre
