"""Marking known lengths in one tab: what clicks in the cloud, in photos and in the close-up do to the points."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from dbh_studio.app import commands
from dbh_studio.app.cameras import require_fit
from dbh_studio.app.document import Document
from dbh_studio.app.lengths import metres_from_text
from dbh_studio.core.arrays import Float64
from dbh_studio.core.close_up import CloseUp
from dbh_studio.core.picking import PickCloud, PickHit
from dbh_studio.core.scale_evidence import MarkedPoint, PointSrc, ScaleBar, Sight
from dbh_studio.errors import StudioError
from dbh_studio.ui import marking_html
from dbh_studio.ui.bind import SceneClick, view_of
from dbh_studio.ui.plot_frame import direction_in_world, source_of, world_of
from dbh_studio.ui.point_picks import LengthKind, PickPlace, PointPicks
from dbh_studio.ui.scale_html import metres
from dbh_studio.ui.scale_scene import LengthMark, PointMark, ScaleScene

if TYPE_CHECKING:
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.app.session import Session
    from dbh_studio.core.posed_images import PosedImages
    from dbh_studio.ui.tab import Tab

# Half the width of a new close-up: pixels of the picture, and within which number of point spacings.
_CLOSE_UP_PX = 28.0
_LEAST_SPACINGS, _MOST_SPACINGS = 8.0, 80.0
_CLOSEST_SPACINGS, _WIDEST_SPACINGS = 3.0, 400.0
# How near to what they mean people click, pixels of the picture or of the close-up.
_HIT_PX = 1.5
_PHOTO_ZOOM = 4.0
_MOST_TYPED = 40
# In a sparse part a click falls between the points: how far from it they are looked for, spacings of the whole cloud,
# and how far they may be, spacings of that part.
_SPARSE_SPACINGS, _BETWEEN_SPACINGS = (6.0, 12.0, 24.0), 4.0
_NOTHING_THERE = ("There is no point of the cloud there.", "Click on the cloud itself; zoom in if need be.")


class Marking:
    """The length that is being marked, if any."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self.picks: PointPicks | None = None
        self.close_up: CloseUp | None = None
        self._frame: Document | None = None
        self._scene = ScaleScene(tab.worker, self._dragged)
        self._is_drawn_on = False
        self._banner = ""
        tab.bridge.on("mark", self._asked)
        tab.bridge.run(marking_html.keys_js())

    # ---- beginning and ending

    @property
    def is_on(self) -> bool:
        """Whether clicks mark points."""
        return self.picks is not None and self._tab.view.step == "scale"

    def start(self, kind: LengthKind, place: PickPlace) -> None:
        """Begin a new length; what was begun before is dropped."""
        self._tab.require_session()
        if place == "photos":
            require_fit(self._cameras())
        self._begin(PointPicks(kind, place))

    def edit(self, name: str) -> None:
        """Mark the points of a known length anew."""
        evidence = self._tab.require_session().document.evidence
        if name in evidence:
            self._begin(PointPicks.of(evidence[name]))
            self._choose(0)

    def _begin(self, picks: PointPicks) -> None:
        self.picks, self.close_up = picks, None
        self._changed()

    def stop(self) -> None:
        """Drop what was begun."""
        if self.picks is not None:
            self.forget()
            self._changed()

    def forget(self) -> None:
        """As `stop`, where everything is shown anew anyway."""
        self.picks = self.close_up = None

    def keep(self, text: str) -> None:
        """Keep the length with its true length as typed, as one undoable step."""
        picks, session = self.picks, self._tab.require_session()
        if picks is None or not picks.is_complete:
            raise StudioError("Not all points are marked yet.", "Click the missing ones first.")
        what = "The side of the black square" if picks.kind == "square" else "The length of the bar"
        true_m = metres_from_text(text, what)
        document = session.document
        evidence = document.evidence
        before = next((length for length in evidence if length.name == picks.edited), None)
        length = picks.length(evidence.free_name("Bar" if picks.kind == "bar" else "Marker"), true_m, before)
        # Another tab may have given the name to another length just now.
        session.do(commands.add_length(length), based_on=document, reads=("evidence",))
        self.stop()

    @staticmethod
    def _offered_text(session: Session, picks: PointPicks) -> str:
        """What stands in the field of the true length: as typed, else that of the length marked anew, or a metre."""
        if picks.typed is not None:
            return picks.typed
        evidence = session.document.evidence
        return metres(evidence[picks.edited].length_m if picks.edited in evidence else 1.0)

    # ---- what a page may ask

    def _asked(self, payload: Any) -> None:
        """``[action, value]``, from a browser: anything may stand in it."""
        if not isinstance(payload, list) or len(payload) != 2 or not isinstance(payload[0], str):
            return
        action, value = payload
        if action == "start" and isinstance(value, list) and len(value) == 2:
            if value[0] in get_args(LengthKind) and value[1] in get_args(PickPlace):
                self.start(value[0], value[1])
        elif action == "stop":
            self.stop()
        elif action == "keep" and isinstance(value, str):
            self.keep(value)
        elif action == "edit" and isinstance(value, str):
            self.edit(value)
        elif self.picks is not None:
            self._asked_of_points(self.picks, action, value)

    def _asked_of_points(self, picks: PointPicks, action: str, value: Any) -> None:
        is_number = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(picks.picks)
        if action == "choose" and is_number:
            self._choose(value)
        elif action == "move" and is_number:
            self._choose(value)
            picks.is_moving = True
            self._changed()
        elif action == "remove" and is_number:
            picks.remove(value)
            self.close_up = None
            self._changed()
        elif action == "typed" and isinstance(value, str):
            picks.typed = value[:_MOST_TYPED]  # the card is drawn anew with every point
        elif action == "back":
            self.take_back()
        elif action == "next":
            following = picks.next_open()
            if following is not None:
                self._choose(following)
        elif action in ("at", "nudge") and _is_pair(value):
            self._refine(action, float(value[0]), float(value[1]))
        elif action == "zoom" and value in (1, -1):
            self._zoom(0.5 if value == 1 else 2.0)
        elif action == "photo" and isinstance(value, str):
            self._open_photo(value)
        elif action == "unsee" and isinstance(value, str):
            picks.remove_sight(value, self._posed(), self._rough)
            self._changed()

    def take_back(self) -> bool:
        """Forget the last point. False where there is none: then Undo undoes what was done before."""
        if not self.is_on or self.picks is None or not self.picks.remove_last():
            return False
        self.close_up = None
        self._changed()
        return True

    # ---- in the cloud

    def scene_clicked(self, click: SceneClick) -> bool:
        """Take a click in the picture. False where nothing is being marked, so that it may choose a tree."""
        picks = self.picks
        if picks is None or not self.is_on or picks.place != "cloud":
            return False
        target = picks.target_of_click()
        if target is None:
            return True
        session, display = self._tab.require_session(), self._tab.studio.display
        if display is None:
            return True
        spacing = display.picking.spacing
        hit, is_between = _picked(display.picking, click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if hit is None:
            raise StudioError(*_NOTHING_THERE)
        centre = click.ray_origin + hit.depth * click.ray_direction
        pixel = click.view.pixel_angle_rad * hit.depth
        half_width = float(np.clip(_CLOSE_UP_PX * pixel, _LEAST_SPACINGS * spacing, _MOST_SPACINGS * spacing))
        half_width = max(half_width, 1.5 * hit.offset)
        close_up = self._seen_closely(
            session, centre, _towards(click.ray_direction, click.view.rotation[1]), half_width
        )
        surface = close_up.surface_at(0.5, 0.5, pointing_sigma=_HIT_PX * pixel)
        if surface is None or (is_between and hit.offset > _BETWEEN_SPACINGS * close_up.spacing):
            raise StudioError(*_NOTHING_THERE)
        rotation = close_up.rotation
        if surface.normal is not None:
            # Squarely, so that a corner on the ground is as easy to hit as one on a wall.
            rotation = _towards(-surface.normal, click.view.rotation[1])
        self._look_closely(session, surface.xyz, rotation, half_width)
        self._put(session, picks, target, surface.xyz, surface.sigma, source_of(session, click.ray_origin))
        return True

    def _put(
        self,
        session: Session,
        picks: PointPicks,
        number: int,
        xyz_world: Float64,
        sigma_world: float,
        seen_from: PointSrc | None = None,
    ) -> None:
        scale = session.document.world_from_source.scale
        point = MarkedPoint(source_of(session, xyz_world), sigma_world / scale)
        picks.put(number, point, seen_from_src=None if seen_from is None else np.array(seen_from))
        self._changed()

    def _look_closely(self, session: Session, centre: Float64, rotation: Float64, half_width: float) -> None:
        self._frame = session.document
        self.close_up = self._seen_closely(session, centre, rotation, half_width)

    @staticmethod
    def _seen_closely(session: Session, centre: Float64, rotation: Float64, half_width: float) -> CloseUp:
        return CloseUp.of(session.points_world(), session.cloud.rgb, centre, rotation, half_width)

    def _refine(self, action: str, x: float, y: float) -> None:
        """Put the chosen point at a place of the close-up, or move it by pixels of it."""
        picks, close_up, session = self.picks, self.close_up, self._tab.session
        if picks is None or close_up is None or session is None or picks.current.point is None:
            return
        if picks.current.sights:
            return
        if action == "nudge":
            now = close_up.place_of(world_of(session, picks.current.point.xyz_src)[0])
            x, y = (
                at + float(np.clip(by, -20, 20)) / marking_html.CLOSE_UP_PX for at, by in zip(now, (x, y), strict=True)
            )
        if not (0.0 <= x <= 1.0 and 0.0 <= y <= 1.0):
            return
        pixel = 2 * close_up.half_width / marking_html.CLOSE_UP_PX
        surface = close_up.surface_at(x, y, pointing_sigma=_HIT_PX * pixel)
        if surface is not None:
            self._put(session, picks, picks.chosen, surface.xyz, surface.sigma)

    def _zoom(self, factor: float) -> None:
        picks, close_up, session = self.picks, self.close_up, self._tab.session
        display = self._tab.studio.display
        if picks is None or close_up is None or session is None or display is None or picks.current.point is None:
            return
        spacing = max(display.picking.spacing, 1e-9)
        half_width = float(
            np.clip(factor * close_up.half_width, _CLOSEST_SPACINGS * spacing, _WIDEST_SPACINGS * spacing)
        )
        centre = world_of(session, picks.current.point.xyz_src)[0]
        self._look_closely(session, centre, close_up.rotation, half_width)
        self._changed()

    def _choose(self, number: int) -> None:
        """Turn to a point; one of the cloud is shown enlarged, as the picture shows it now."""
        picks, session, display = self.picks, self._tab.session, self._tab.studio.display
        if picks is None or session is None:
            return
        picks.choose(number)
        self.close_up = None
        point = picks.current.point
        if point is not None and not picks.current.sights and display is not None:
            view = view_of(self._tab.client.camera)
            centre = world_of(session, point.xyz_src)[0]
            direction = centre - view.origin
            if float(np.linalg.norm(direction)) > 0:
                half_width = 12 * max(display.picking.spacing, 1e-9)
                self._look_closely(session, centre, _towards(direction, view.rotation[1]), half_width)
                surface = self.close_up.surface_at(0.5, 0.5) if self.close_up is not None else None
                if surface is not None and surface.normal is not None:
                    self._look_closely(session, centre, _towards(-surface.normal, view.rotation[1]), half_width)
        self._changed()

    def _dragged(self, xyz_world: Float64) -> None:
        picks, session = self.picks, self._tab.session
        if picks is None or session is None or picks.current.point is None or not np.isfinite(xyz_world).all():
            return
        sigma = picks.current.point.sigma_src * session.document.world_from_source.scale
        self._put(session, picks, picks.chosen, xyz_world, sigma)
        self._choose(picks.chosen)

    # ---- in photos

    def _cameras(self) -> Cameras:
        cameras = self._tab.require_session().cameras
        if cameras is None:
            raise StudioError("This plot has no photos yet.", "Add them under Photos, or click in the cloud instead.")
        return cameras

    def _posed(self) -> PosedImages:
        return self._cameras().posed

    def photo_clicked(self, image: str, u_px: float, v_px: float) -> None:
        """A place of a photo was clicked; pixels of its camera."""
        picks = self.picks
        if picks is None or picks.place != "photos" or not np.isfinite([u_px, v_px]).all():
            return
        picks.put_sight(Sight(image, float(u_px), float(v_px)), self._posed(), self._rough)
        self._changed()

    def _rough(self, sight: Sight) -> PointSrc | None:
        """Where the line of sight meets the cloud, as well as the displayed points tell."""
        session, display = self._tab.session, self._tab.studio.display
        if session is None or display is None:
            return None
        photo = self._posed().by_name(sight.image)
        uv = np.array([[sight.u_px, sight.v_px], [sight.u_px + 1.0, sight.v_px]])
        origin, rays = photo.ray(uv)
        if not np.isfinite(rays[0]).all():
            return None
        pixel = float(np.linalg.norm(rays[1] - rays[0])) if np.isfinite(rays[1]).all() else 1e-3
        start, direction = world_of(session, origin)[0], direction_in_world(session, rays[0])
        hit, _ = _picked(display.picking, start, direction, pixel)
        return None if hit is None else source_of(session, start + hit.depth * direction)

    def _open_photo(self, name: str) -> None:
        """Open a photo where the chosen point should be."""
        picks, posed = self.picks, self._posed()
        if picks is None or name not in {photo.name for photo in posed}:
            return
        place, at_px = picks.current.place_src, None
        known = next((sight for sight in picks.current.sights if sight.image == name), None)
        if known is not None:
            at_px = (known.u_px, known.v_px)
        elif place is not None:
            uv, in_view = posed.by_name(name).project(np.array([place]))
            at_px = (float(uv[0, 0]), float(uv[0, 1])) if in_view[0] else None
        self._tab.photos.open(name, at_px=at_px, zoom_px=None if at_px is None else _PHOTO_ZOOM)

    def _marks_of(self, image: str) -> list[Any]:
        """What is drawn in one photo: the points marked, where they should be, and the other lengths."""
        from dbh_studio.ui.photo_view import PhotoMark

        session = self._tab.session
        if session is None or session.cameras is None or self._tab.view.step != "scale":
            return []
        posed, marks = session.cameras.posed, []
        if image not in {photo.name for photo in posed}:
            return []
        photo = posed.by_name(image)
        for number, pick in enumerate(self.picks.picks if self.picks is not None else ()):
            sight = next((each for each in pick.sights if each.image == image), None)
            if sight is not None:
                marks.append(PhotoMark(sight.u_px, sight.v_px, str(number + 1), "mark"))
            elif pick.place_src is not None:
                marks += _projected(photo, pick.place_src, f"{number + 1}?", partial(PhotoMark, kind="hint"))
        for length in session.document.evidence:
            if self.picks is None or length.name != self.picks.edited:
                for point in length.ends if isinstance(length, ScaleBar) else length.corners:
                    marks += _projected(photo, point.xyz_src, "", partial(PhotoMark, kind="other"))
        return marks

    # ---- showing

    def _changed(self) -> None:
        """Show the points as they are now."""
        self._tab.refresh()
        view = self._tab.photos
        if self._is_drawn_on:
            view.refresh()
        else:
            self._is_drawn_on = True
            view.set_marks(self._marks_of)

    def card(self) -> str:
        """What the panel shows while a length is being marked."""
        session, picks = self._tab.session, self.picks
        if session is None or picks is None:
            return ""
        if self.close_up is not None and (self._frame is None or not session.document.has_frame_of(self._frame)):
            self.close_up = None  # the points lie elsewhere in the picture by now
        point = picks.current.point
        cross = None
        if self.close_up is not None and point is not None:
            cross = self.close_up.place_of(world_of(session, point.xyz_src)[0])
        first = self._first_photo(session, picks) if picks.place == "photos" else ""
        offered = picks.offered(session.cameras.posed) if picks.place == "photos" and session.cameras else ()
        return marking_html.marking_card(
            picks,
            scale=session.document.scale,
            typed=self._offered_text(session, picks),
            close_up=self.close_up,
            cross=cross,
            offered=offered,
            first_photo=first,
        )

    def _first_photo(self, session: Session, picks: PointPicks) -> str:
        """A photo to begin with; none where one is open."""
        if self._tab.photos.image is not None or session.cameras is None:
            return ""
        marked = [sight.image for pick in picks.picks for sight in pick.sights]
        there = [photo.name for photo in session.cameras.posed if photo.path is not None]
        return next(iter([*marked, *there]), "")

    def show(self) -> None:
        """Bring the picture, the banner over it and the photo in step."""
        session, display = self._tab.session, self._tab.studio.display
        is_shown = session is not None and display is not None and self._tab.view.step == "scale"
        banner = marking_html.banner_js(self.picks if is_shown else None)
        if banner != self._banner:
            self._banner = banner
            self._tab.bridge.run(banner)
        if session is None or display is None or not is_shown:
            self._scene.clear()
        else:
            size = 1.2 * display.point_size
            points = self._point_marks(session)
            chosen = next((mark.xyz for mark in points if mark.is_chosen), None)
            eye = np.asarray(self._tab.client.camera.position, float)
            reach = 10 * size if chosen is None else 0.08 * float(np.linalg.norm(eye - chosen))
            self._scene.show(self._length_marks(session), points, size=size, reach=reach)
        is_wanted = is_shown and self.picks is not None and self.picks.place == "photos"
        self._tab.photos.on_pick = self.photo_clicked if is_wanted else None

    def _length_marks(self, session: Session) -> list[LengthMark]:
        edited = self.picks.edited if self.picks is not None else ""
        marks = [
            LengthMark(square.name, world_of(session, square.corners_src), square.role == "control")
            for square in session.document.evidence.squares
            if square.name != edited
        ]
        return marks + [
            LengthMark(bar.name, world_of(session, [end.xyz_src for end in bar.ends]), bar.role == "control")
            for bar in session.document.evidence.bars
            if bar.name != edited
        ]

    def _point_marks(self, session: Session) -> list[PointMark]:
        if self.picks is None:
            return []
        return [
            PointMark(
                str(number + 1),
                world_of(session, pick.point.xyz_src)[0],
                number == self.picks.chosen and not pick.sights,
            )
            for number, pick in enumerate(self.picks.picks)
            if pick.point is not None
        ]


def _picked(cloud: PickCloud, *ray: Any) -> tuple[PickHit | None, bool]:
    """What lies on a ray (origin, direction, angle of a pixel), and whether only near it: between sparse points."""
    hit = cloud.pick(*ray)
    if hit is not None:
        return hit, False
    for reach in _SPARSE_SPACINGS:
        hit = cloud.pick(*ray, radius=reach * cloud.spacing)
        if hit is not None:
            break
    return hit, True


def _towards(direction: Float64, down: Float64) -> Float64:
    """(3, 3) rows right, down and forward of a look along `direction` in which `down` is down."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(down, forward)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([1.0, 0.0, 0.0] if abs(forward[0]) < 0.9 else [0.0, 1.0, 0.0], forward)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _is_pair(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < 1e6 for v in value)
    )


def _projected(photo: Any, place_src: PointSrc, label: str, mark: Any) -> list[Any]:
    uv, in_view = photo.project(np.array([place_src]))
    return [mark(float(uv[0, 0]), float(uv[0, 1]), label)] if in_view[0] else []
