"""How a tab shows the plot: the bar in the corner of the picture, and the rarer options in the panel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dbh_studio.core.arrays import UInt8
from dbh_studio.errors import StudioError
from dbh_studio.ui import html
from dbh_studio.ui.panels.base import set_value, set_visible
from dbh_studio.ui.scene import COLOUR_MODES, MOST_FACES, ColourMode

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_MODE_TITLES: dict[ColourMode, str] = {
    "Original": "Original",
    "Segmentation (red)": "Trunks red",
    "Segmentation (by tree)": "By tree",
    "Height": "Height",
    "Label count": "Label count",
    "Steps": "Steps",
}
# These colours come of work that is done later, if at all.
_LATER = frozenset({"Label count", "Steps"})
_LOOKS = (
    ("plot", "Plot", "The whole plot (H)"),
    ("top", "Top", "From above, north up (T)"),
    ("side", "Side", "Level, from the south"),
    ("tree", "Tree", "The chosen tree (F)"),
)


class ViewControls:
    """Builds the controls at the GUI's current place. What they change is never saved and never undone."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._there: set[ColourMode] = set()
        gui, worker, scene = tab.client.gui, tab.worker, tab.scene
        with gui.add_folder("View options", expand_by_default=False):
            labels = gui.add_checkbox("Tree numbers", True)
            worker.on_update(labels, scene.set_labels)
            self._crowns = gui.add_checkbox("Crowns", False, hint="points more than 6 m above the ground")
            worker.on_update(self._crowns, scene.set_crowns)
            self._mesh = gui.add_checkbox(
                "Mesh", False, visible=False, hint="the surface of the reconstruction, in place of the points"
            )
            worker.on_update(self._mesh, self._mesh_chosen)
            self._cameras = gui.add_checkbox(
                "Show cameras", True, visible=False, hint="where the photos were taken; click one to open it"
            )
            worker.on_update(self._cameras, tab.cameras.set_on)
            size = gui.add_slider("Point size", 0.3, 3.0, 0.1, 1.0)
            worker.on_update(size, scene.set_point_size, coalesce=True)
        tab.bridge.on("colours", self._mode_chosen)
        tab.bridge.on("look", self._look_chosen)
        self._show_bar()

    def set_mode(self, mode: ColourMode) -> None:
        """Switch the colours."""
        self._tab.view.mode = mode
        self._tab.chain.mode_chosen(mode)
        self._tab.scene.set_mode(mode)
        self._show_bar()
        self._tab.client.flush()  # not with the next heap: somebody waits for it

    def next_mode(self) -> None:
        """The colours after those on screen, round and round."""
        modes = self._modes()
        at = modes.index(self._tab.view.mode) if self._tab.view.mode in modes else -1
        self.set_mode(modes[(at + 1) % len(modes)])

    def offer(self, mode: ColourMode, colours: UInt8 | None) -> None:
        """Offer colours that come with time, (M, 3) of the points of the display; None where they are gone."""
        if colours is not None:
            self._there.add(mode)
        elif mode in self._there:
            self._there.discard(mode)
            if self._tab.view.mode == mode:
                self._tab.view.mode = "Original"
                self._tab.scene.set_mode("Original")
        else:
            return
        self._tab.scene.set_colours(mode, colours)
        self._show_bar()

    def offer_steps(self, is_there: bool) -> None:
        """Offer to colour by the steps of the last search, or no more."""
        if is_there == ("Steps" in self._there):
            return
        self._there ^= {"Steps"}
        if not is_there and self._tab.view.mode == "Steps":
            self.set_mode("Original")
        self._show_bar()

    def _modes(self) -> list[ColourMode]:
        return [mode for mode in COLOUR_MODES if mode not in _LATER or mode in self._there]

    def show_plot(self) -> None:
        """Bring options and picture in step with a plot that has just been sent."""
        session = self._tab.session
        has_mesh = session is not None and session.mesh is not None
        if self._mesh.visible != has_mesh:
            self._mesh.visible = has_mesh
        self._tab.scene.set_crowns(bool(self._crowns.value))
        if has_mesh and self._mesh.value:
            self._mesh_chosen(True)
        self._tab.masks.offer_counts()

    def show_cameras(self, has_cameras: bool) -> None:
        """Offer to hide the photos' places where there are any."""
        set_visible(self._cameras, has_cameras)

    def _show_bar(self) -> None:
        titles = tuple((mode, _MODE_TITLES[mode]) for mode in self._modes())
        self._tab.bridge.run(html.view_bar_js(titles, self._tab.view.mode, _LOOKS))
        self._tab.masks.show_legend()

    def _mode_chosen(self, payload: Any) -> None:
        if payload in self._modes():
            self.set_mode(payload)

    def _look_chosen(self, payload: Any) -> None:
        scene = self._tab.scene
        looks = {"plot": scene.look_at_plot, "top": scene.look_from_top, "side": scene.look_from_side}
        if payload == "tree":
            self._tab.fly_to_selected()
        elif isinstance(payload, str) and payload in looks:
            looks[payload]()

    def _mesh_chosen(self, on: bool) -> None:
        """Send the mesh when it is first asked for: it may be larger than the cloud."""
        session = self._tab.session
        if session is None or session.mesh is None:
            return
        n_faces = len(session.mesh.faces)
        if on and n_faces > MOST_FACES:
            set_value(self._mesh, False)
            raise StudioError(
                f"The mesh has {n_faces:,} triangles, too many for a browser.",
                f"Simplify it to {MOST_FACES:,} triangles, or use the points.",
            )
        self._tab.scene.show_mesh(session.mesh, session.document.world_from_source, on=on)
