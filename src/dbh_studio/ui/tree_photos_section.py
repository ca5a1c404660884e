"""The photographs of the chosen tree, beneath its card. A part of the Inspect step.

They are looked for and cut out on a thread of their own: neither the diameter nor the next click waits for them.
"""

from __future__ import annotations

import base64
import math
import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from dbh_studio.app.document import Document
from dbh_studio.app.report import north_of
from dbh_studio.app.session import Session
from dbh_studio.app.tree_photos import TreePhoto, TreePhotos, tree_photos
from dbh_studio.errors import CommandError
from dbh_studio.ui import html
from dbh_studio.ui.bridge import call, esc
from dbh_studio.ui.panels.base import Section, set_content, set_visible
from dbh_studio.ui.photo_look import MOST_ZOOM

if TYPE_CHECKING:
    from dbh_studio.ui.tab import Tab

_ZOOMS = (0.4, 0.65, 1.0, 1.6, 2.6)
_FIRST_ZOOM = _ZOOMS.index(1.0)
# Somebody who leafs through the trees looks at none of them for so long.
_SETTLED_S = 0.12
# The picture takes about this share of the viewer's height.
_IN_VIEWER = 0.7
_NEARLY_ALL = 0.85
_WINDS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
_LARGER_JS = "const f=this.closest('figure');f.dataset.large=f.dataset.large!=='true'"


@dataclass(frozen=True, eq=False)
class _Request:
    """Pictures that are wanted: of which tree, in which state of the plot."""

    key: Hashable
    session: Session
    document: Document
    trunk_id: int
    zoom: float


class TreePhotosSection(Section):
    """Two to four pictures of the chosen tree, or why there are none.

    Args:
        tab: Which tab; everything but the finding is on its thread.
    """

    def __init__(self, tab: Tab) -> None:
        self._zoom = _FIRST_ZOOM
        self._key: Hashable = None
        self._shown: tuple[TreePhoto, ...] = ()
        self._n_tiles = 2
        self._finder = _Finder(self._find)
        super().__init__(tab)

    def build(self) -> None:
        """Add the pictures' place at the GUI's current one."""
        self.tab.bridge.run(html.style_js("tree_photos"))
        self._box = self.gui.add_html("", visible=False)
        self.tab.bridge.on("tree-photo-open", self._open)
        self.tab.bridge.on("tree-photo-zoom", self._zoomed)
        self.tab.worker.on_close(self._finder.stop)

    def refresh(self) -> None:
        """Show the pictures of the tree that is chosen now; those that are not at hand come later."""
        request, words = self._wanted()
        set_visible(self._box, request is not None or bool(words))
        if request is None:
            self._key, self._shown = None, ()
            self._finder.forget()
            set_content(
                self._box, f'<div class="dbh dbh-shots muted" data-state="none">{esc(words)}</div>' if words else ""
            )
            return
        if request.key == self._key:
            return
        self._key, self._shown = request.key, ()
        set_content(self._box, busy_html(request.trunk_id, self._n_tiles))
        self._finder.ask(request)

    def _wanted(self) -> tuple[_Request | None, str]:
        """What to look for; or None, and why nothing is shown."""
        session, selected = self.tab.session, self.tab.view.selected
        if session is None or selected is None:
            return None, ""
        document, cameras = session.document, session.cameras
        if selected not in document.trunks:
            return None, ""
        if document.cameras is None:
            return None, "This plot has no photos. With photos (step 2) the tree's pictures stand here."
        if cameras is None:
            problem = self.tab.studio.photos.problem
            said = f"cannot be shown: {problem.problem}" if problem is not None else "have not been read yet."
            return None, f"The photos of this plot {said}"
        stem = self.tab.stem(document, selected)
        if stem is None:
            return None, "The tree's pictures follow when it has been measured."
        zoom, scale = _ZOOMS[self._zoom], document.scale
        place = (document.up_direction, document.north_direction, document.origin_src)
        measured = (stem, scale.metres_per_unit) if scale.is_known else None
        key = (session, document.trunks[selected], measured, cameras, place, zoom)
        return _Request(key, session, document, selected, zoom), ""

    # ---- on the finder's thread

    def _find(self, request: _Request, is_wanted: Callable[[], bool]) -> None:
        worker = self.tab.worker

        def find() -> None:
            found = tree_photos(
                request.session, request.trunk_id, document=request.document, zoom=request.zoom, is_wanted=is_wanted
            )
            if is_wanted():
                content = photos_html(
                    request.trunk_id, found, zoom=request.zoom, has_north=has_north(request.session, request.document)
                )
                worker.post(self._show, request, found, content)

        worker.attempt(find)

    # ---- on the tab's thread

    def _show(self, request: _Request, found: TreePhotos, content: str) -> None:
        if request.key != self._key:
            return
        self._shown = found.photos
        self._n_tiles = max(len(found.photos), 1)
        set_content(self._box, content)
        self.tab.client.flush()

    def _open(self, index: Any) -> None:
        """Show the place in the photo itself."""
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(self._shown):
            raise CommandError("This picture is not there any more.")
        photo = self._shown[index]
        at_px = photo.at_px if all(map(math.isfinite, photo.at_px)) else None
        zoom_px = min(_IN_VIEWER / photo.photo_px_per_px, MOST_ZOOM)
        self.tab.photos.open(photo.name, at_px=at_px, zoom_px=zoom_px)

    def _zoomed(self, step: Any) -> None:
        if step in (-1, 1):
            self._zoom = min(max(self._zoom + int(step), 0), len(_ZOOMS) - 1)
            self.refresh()


class _Finder:
    """Looks for one tree at a time, on a thread that ends when nothing is wanted; what is wanted last wins."""

    def __init__(self, find: Callable[[_Request, Callable[[], bool]], None]) -> None:
        self._find = find
        self._wanted: _Request | None = None
        self._changed = threading.Condition()
        self._is_running = False
        self._is_stopped = False

    def ask(self, request: _Request) -> None:
        """Look for this, and for nothing asked before."""
        with self._changed:
            if self._is_stopped:
                return
            self._wanted = request
            self._changed.notify_all()
            if not self._is_running:
                self._is_running = True
                threading.Thread(target=self._run, daemon=True, name="tree photos").start()

    def forget(self) -> None:
        """Nothing is wanted any more."""
        with self._changed:
            self._wanted = None
            self._changed.notify_all()

    def stop(self) -> None:
        """For good."""
        self._is_stopped = True
        self.forget()

    def _run(self) -> None:
        while (request := self._next()) is not None:
            try:
                self._find(request, partial(self._is_wanted, request))
            finally:
                with self._changed:
                    if self._wanted is request:
                        self._wanted = None

    def _is_wanted(self, request: _Request) -> bool:
        return self._wanted is request

    def _next(self) -> _Request | None:
        """What has been wanted for a moment; None, and the thread has ended, where nothing is."""
        with self._changed:
            request = self._wanted
            while request is not None:
                self._changed.wait(_SETTLED_S)
                if self._wanted is request:
                    return request
                request = self._wanted
            self._is_running = False
            return None


def busy_html(trunk_id: int, n_tiles: int) -> str:
    """Empty tiles in the pictures' place, so that nothing jumps when they come."""
    tiles = '<figure><div class="shot"></div><figcaption><span>&nbsp;</span></figcaption></figure>' * n_tiles
    said = _line("Looking through the photos …", "")
    return (
        f'<div class="dbh dbh-shots" data-state="busy" data-tree="{trunk_id}">{said}'
        f'<div class="grid">{tiles}</div></div>'
    )


def photos_html(trunk_id: int, found: TreePhotos, *, zoom: float = 1.0, has_north: bool = True) -> str:
    """The pictures with what is drawn on them, or why there are none.

    Args:
        trunk_id: Of the tree.
        found: Its pictures.
        zoom: As they were asked for.
        has_north: Whether the plot's +y is north, so that sides have names.
    """
    said = html.message(found.note) if found.note else ""
    state = "shown" if found.photos else "none"
    head = f'<div class="dbh dbh-shots" data-state="{state}" data-tree="{trunk_id}">'
    if not found.photos:
        return f'{head}<span class="muted">{esc(found.note)}</span></div>'
    legend = '<i class="ring"></i>breast height <i class="edge"></i>trunk'
    buttons = f"{_zoom_button('Wider', -1, zoom > _ZOOMS[0])} {_zoom_button('Closer', 1, zoom < _ZOOMS[-1])}"
    figures = "".join(_figure(index, photo, has_north) for index, photo in enumerate(found.photos))
    return f'{head}{_line(legend, buttons)}<div class="grid">{figures}</div></div>{said}'


def _line(left: str, right: str) -> str:
    return f'<div class="line"><span class="muted">{left}</span><span>{right}</span></div>'


def _zoom_button(title: str, step: int, is_possible: bool) -> str:
    state = "" if is_possible else " disabled"
    return (
        f'<button type="button" data-do="tree-photo-{title.lower()}" onclick="{call("tree-photo-zoom", step)}"{state}>'
        f"{title}</button>"
    )


def _figure(index: int, photo: TreePhoto, has_north: bool) -> str:
    said = caption(photo, has_north=has_north)
    address = "data:image/jpeg;base64," + base64.b64encode(photo.jpeg()).decode("ascii")
    tip = f"{photo.name}: click to enlarge"
    return (
        f'<figure data-shot="{index}">'
        f'<button type="button" class="shot" title="{esc(tip)}" onclick="{esc(_LARGER_JS)}">'
        f'<img alt="{esc(said)}" src="{address}"></button>'
        f'<figcaption><span class="muted" title="{esc(photo.name)}">{esc(said)}</span>'
        f'<button type="button" data-do="tree-photo-open" title="{esc(f"Look around in {photo.name}")}" '
        f'onclick="{call("tree-photo-open", index)}">Photo</button></figcaption></figure>'
    )


def caption(photo: TreePhoto, *, has_north: bool = True) -> str:
    """How far and from which side, and how much is seen where that is not nearly all."""
    place = f"{photo.distance_m:.1f} m" if math.isfinite(photo.distance_m) else ""
    if has_north:
        place = f"{place} from {wind(photo.bearing_deg)}".strip()
    seen = f"{100 * photo.seen:.0f} % seen" if photo.seen < _NEARLY_ALL else ""
    return ", ".join(part for part in (place, seen) if part) or photo.name


def has_north(session: Session, document: Document) -> bool:
    """Whether the plot's +y is north: somebody said so, or the cloud lies upright in a map's coordinates."""
    return north_of(session, document).letter == "N"


def wind(bearing_deg: float) -> str:
    """One of eight points of the compass."""
    return _WINDS[round(bearing_deg / 45.0) % 8]
