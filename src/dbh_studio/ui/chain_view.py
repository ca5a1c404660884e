"""The steps of the last search for trunks: the cloud in their colours, and in the panel why something was lost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.app.last_search import LastSearch
from dbh_studio.core.arrays import Float32, Float64, Int64
from dbh_studio.core.chain_advice import Story, story_of_cluster, story_of_miss, story_of_point
from dbh_studio.core.chain_steps import ChainSteps, Step
from dbh_studio.core.display import sample_for_display
from dbh_studio.core.picking import PickCloud
from dbh_studio.ui import chain_html
from dbh_studio.ui.bind import SceneClick
from dbh_studio.ui.display_cloud import DisplayCloud
from dbh_studio.ui.panels.base import set_content, set_visible
from dbh_studio.ui.scene import ColourMode, PointLayer, TrunkPicture

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_MODE: ColourMode = "Steps"
# Points of each step at most; more in one message and a click waits for it.
_PER_STEP = 200_000
# What was never in question, drawn from the display's sample; crowns would hide the stems.
_BACKGROUND = (Step.NO_CANDIDATE, Step.TOO_LOW, Step.TOO_HIGH)
_HIDDEN_AT_FIRST = frozenset({Step.TOO_HIGH})
_SIZES: Mapping[Step, float] = {Step.NOT_SIDEWAYS: 1.3, Step.LOOSE: 1.6, Step.DROPPED: 1.6, Step.KEPT: 1.2}


class ChainView:
    """Keeps legend, picture and panel in step with the last search. Only the tab's own worker thread calls it."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._search: LastSearch | None = None
        self._shown = frozenset(Step) - _HIDDEN_AT_FIRST
        self._sent: tuple[LastSearch, DisplayCloud] | None = None
        self._rows: dict[Step, Int64] = {}
        self._pick: tuple[PickCloud, Int64] | None = None
        self._story: Story | None = None
        self._fill: Callable[[Mapping[str, Any]], object] = lambda changes: None
        tab.bridge.on("chain_step", self._step_chosen)
        tab.bridge.on("chain_go", self._go)
        tab.bridge.on("chain_try", self._try)

    # ---- the panel

    def build(self, fill: Callable[[Mapping[str, Any]], object]) -> None:
        """Add its part of the panel at the GUI's current place; `fill` puts values into the form."""
        gui, self._fill = self._tab.client.gui, fill
        self._box = gui.add_html("", visible=False)
        self._folder = gui.add_folder("Where trees were lost", expand_by_default=False, visible=False)
        with self._folder:
            self._about, self._table, self._sizes, self._lost = (gui.add_html("") for _ in range(4))

    def refresh(self) -> None:
        """Show the search the session remembers."""
        session, search = self._tab.session, self._search
        set_visible(self._folder, search is not None)
        set_visible(self._box, self._story is not None)
        if session is None or search is None:
            return
        steps = search.steps
        remarks = search.remarks(session.document)
        set_content(self._about, chain_html.about(search.when, steps, search.n_trunks, remarks))
        set_content(self._table, chain_html.step_table(steps))
        set_content(self._sizes, chain_html.histogram(steps))
        set_content(self._lost, chain_html.lost(steps))

    def follow(self) -> None:
        """Take over what the session remembers now; cheap where it is what it was."""
        session = self._tab.session
        search = session.last_search if session is not None else None
        if search is self._search:
            return
        self._search, self._story = search, None
        self._tab.controls.offer_steps(search is not None)
        if self._tab.studio.display is not None and self._tab.scene.shows(self._tab.studio.display):
            self._show_mode()

    # ---- the picture

    def mode_chosen(self, mode: ColourMode) -> None:
        """Follow the colours that are about to be shown."""
        if mode == _MODE:
            self._send()
        self._show_legend(mode)

    def plot_sent(self) -> None:
        """Send the steps again, for all of the picture was made anew."""
        self._sent = None
        self._show_mode()

    def _show_mode(self) -> None:
        if self._tab.view.mode == _MODE:
            self.mode_chosen(_MODE)

    def _show_legend(self, mode: ColourMode) -> None:
        on = mode == _MODE and self._search is not None
        content = chain_html.legend(self._search.steps, self._shown) if on and self._search is not None else ""
        self._tab.bridge.run(chain_html.legend_js(content))

    def _send(self) -> None:
        """Send the points of every step, unless they are there."""
        session, display, search = self._tab.session, self._tab.studio.display, self._search
        if session is None or display is None or search is None or self._sent == (search, display):
            return
        points = session.points_world()
        self._rows = {step: _rows_of(step, search.steps, display) for step in Step if search.steps.counts[step]}
        self._pick = None
        self._tab.scene.show_steps(
            {
                int(step): PointLayer(
                    points.take(rows, axis=0),
                    chain_html.STEP_COLOURS[step],
                    _SIZES.get(step, 1.0),
                    step in self._shown,
                )
                for step, rows in self._rows.items()
            }
        )
        self._sent = (search, display)

    def _step_chosen(self, payload: Any) -> None:
        if type(payload) is not int or payload not in list(Step):
            return
        self._shown ^= {Step(payload)}
        self._pick = None
        self._tab.scene.set_step(payload, Step(payload) in self._shown)
        self._show_legend(self._tab.view.mode)

    # ---- what a person asks

    def clicked(self, click: SceneClick) -> bool:
        """Tell what became of the point under the cursor; False where that is a trunk, or steps are not shown."""
        session, search = self._tab.session, self._search
        if self._tab.view.mode != _MODE or session is None or search is None or not self._rows:
            return False
        pick, rows = self._pick_cloud(session.points_world())
        hit = pick.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if hit is None or self._tab.cameras.click(click, hit.depth):
            return hit is not None
        surface = rows[hit.surface]
        found = search.steps.labels[surface]
        step = Step(int(np.bincount(found, minlength=len(Step)).argmax()))
        if step in (Step.KEPT, Step.JOINED):
            return False
        at = rows[hit.index]
        point = int(at if search.steps.labels[at] == step else surface[found == step][0])
        self._tell(self._story_at(search.steps, point))
        return True

    def _pick_cloud(self, points: Float32) -> tuple[PickCloud, Int64]:
        """What is on screen, and no more: a hidden step cannot be clicked."""
        if self._pick is None:
            shown = [rows for step, rows in self._rows.items() if step in self._shown]
            rows = np.concatenate(shown) if shown else np.empty(0, np.int64)
            self._pick = PickCloud(points.take(rows, axis=0)), rows
        return self._pick

    def _story_at(self, steps: ChainSteps, point: int) -> Story:
        session = self._tab.require_session()
        points = session.points_world()
        place = points[point].astype(np.float64)
        height_m = float("nan")
        if session.has_ground():
            height_m = float(session.ground().height_above(points[point : point + 1])[0])
        n_near = _count_near(points, steps, place) if steps.labels[point] == Step.LOOSE else None
        xy_m = (float(place[0]), float(place[1]))
        return story_of_point(steps, point, height_m=height_m, xy_m=xy_m, n_near=n_near)

    def _tell(self, story: Story) -> None:
        """Show a story above the settings, and mark the cluster it is about."""
        search = self._search
        if search is None:
            return
        self._story = story
        title = chain_html.step_title(story.step, search.steps)
        set_content(self._box, chain_html.story_box(title[:1].upper() + title[1:], story))
        self._tab.view.step = "trunks"
        self._tab.view.selected = None
        self._tab.refresh()
        points = np.empty((0, 3), np.float32)
        if story.cluster is not None:
            points = self._tab.require_session().points_world()[search.steps.points_of_cluster(story.cluster)]
        self._tab.scene.highlight(TrunkPicture(points, None, np.zeros(3)))

    def _go(self, payload: Any) -> None:
        """Look at something that was lost, in the colours of the steps."""
        story = self._story_of(payload)
        search = self._search
        if story is None or search is None:
            return
        if self._tab.view.mode != _MODE:
            self._tab.controls.set_mode(_MODE)
        self._tell(story)
        target, height_m = self._place(search.steps, payload)
        self._tab.scene.fly_to(target, distance=max(4.0, 1.3 * height_m))

    def _place(self, steps: ChainSteps, payload: Any) -> tuple[Float64, float]:
        """(3,) world, and how tall it is."""
        session = self._tab.require_session()
        kind, number = payload[:2]
        if kind == "cluster":
            cluster = steps.clusters[number]
            return session.points_world()[cluster.point].astype(np.float64), cluster.high_m - cluster.low_m
        miss = steps.near_misses[number]
        height_m = 0.5 * (miss.low_m + miss.high_m)
        z_m = session.ground().z_at(np.array([[miss.x_m, miss.y_m]]))[0] if session.has_ground() else 0.0
        return np.array([miss.x_m, miss.y_m, float(z_m) + height_m]), miss.span_m

    def _try(self, payload: Any) -> None:
        """Fill what is advised into the form; nothing is searched yet."""
        story = self._story_of(payload)
        number = payload[2] if story is not None and len(payload) > 2 else None
        if story is None or type(number) is not int or not 0 <= number < len(story.advice):
            return
        self._fill(story.advice[number].changes)

    def _story_of(self, payload: Any) -> Story | None:
        """What ``[kind, number, …]`` from the page speaks of."""
        search = self._search
        if search is None or not isinstance(payload, list) or len(payload) < 2 or type(payload[1]) is not int:
            return None
        kind, number = payload[:2]
        if kind == "cluster" and 0 <= number < len(search.steps.clusters):
            return story_of_cluster(search.steps, number)
        if kind == "miss" and 0 <= number < len(search.steps.near_misses):
            return story_of_miss(search.steps, search.steps.near_misses[number])
        return self._story if kind == "point" else None


def _rows_of(step: Step, steps: ChainSteps, display: DisplayCloud) -> Int64:
    """Rows in the cloud of what is drawn of a step."""
    if step in _BACKGROUND:
        # The sample is shuffled: its beginning is a thinner sample.
        chosen = np.flatnonzero(steps.labels[display.indices] == step)
        if step == Step.NO_CANDIDATE:
            chosen = chosen[~display.is_crown[chosen]]
        return np.asarray(display.indices[chosen[:_PER_STEP]], np.int64)
    rows = np.flatnonzero(steps.labels == step)
    return rows[np.sort(sample_for_display(len(rows), _PER_STEP))]


def _count_near(points: Float32, steps: ChainSteps, place: Float64) -> int:
    """Points that faced sideways within the cluster distance of a place."""
    reach = max(steps.settings.cluster_distance_m, 2.5 * steps.spacing_m)
    rows = np.flatnonzero(np.abs(points[:, 0] - np.float32(place[0])) <= reach)
    rows = rows[np.isin(steps.labels[rows], (Step.LOOSE, Step.DROPPED, Step.KEPT, Step.JOINED))]
    return int(np.count_nonzero(((points[rows] - place) ** 2).sum(axis=1) <= reach**2))
