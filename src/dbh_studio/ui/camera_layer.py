"""The photos' places in the picture of one tab: frustums, globes for panoramas, and the way from one to the next.

However many photos there are, they are four objects in the page: the globes, the dots, the frustums and the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dbh_studio.core.arrays import Bool, Float32, Float64
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.ui.bind import SceneClick

if TYPE_CHECKING:
    from dbh_studio.app.cameras import Cameras
    from dbh_studio.app.document import Document
    from dbh_studio.app.session import Session
    from dbh_studio.ui.tab import Tab

_COLOUR, _CURRENT, _PATH = (25, 113, 194), (240, 101, 0), (116, 143, 168)
# Shares of the distance between neighbouring photos, and of half the width of the plot at most: standing where one
# photo was taken, the next one must not hide the trees.
_GLOBE_SHARE, _FRUSTUM_SHARE, _MOST_SHARE = 0.06, 0.45, 0.02
_REACH_PX, _DOT_PX = 8.0, 6.0
# Neighbours on this side of the median: photos of a rig, or taken twice at one place, have no distance.
_SAME_PLACE = 1e-3


@dataclass(frozen=True, eq=False)
class CameraGlyphs:
    """What is drawn of the photos, in the world frame.

    Attributes:
        names: (K) of the photos, in the order of capture.
        centres: (K, 3) where they were taken.
        is_globe: (K,) whether a photo is a panorama.
        radius: Of a globe.
        frustums: (M, 2, 3) lines of the photos that are no panoramas.
        frustum_of: (M,) which photo a line belongs to.
        path: (K - 1, 2, 3) from each photo to the next.
    """

    names: tuple[str, ...]
    centres: Float64
    is_globe: Bool
    radius: float
    frustums: Float32
    frustum_of: Any
    path: Float32

    @classmethod
    def of(cls, cameras: Cameras, document: Document, cloud_origin: Float64, plot_radius: float) -> CameraGlyphs:
        """Lay out the photos of a plot.

        Args:
            cameras: In the cloud's frame.
            document: Says how the cloud lies in the world.
            cloud_origin: (3,) source coordinates of the cloud's origin.
            plot_radius: Half the width of the plot, world units.
        """
        world_from_source = document.world_from_source
        photos = tuple(cameras.posed)
        centres = world_from_source.apply(cameras.posed.centres_src - cloud_origin).astype(np.float64)
        step = min(_spacing(centres), 10.0 * plot_radius)
        size = min(_FRUSTUM_SHARE * step, 2.0 * _MOST_SHARE * plot_radius)
        radius = min(_GLOBE_SHARE * step, 0.5 * _MOST_SHARE * plot_radius)
        lines: list[Float64] = []
        owners: list[int] = []
        outlines: dict[int, Float64] = {}
        for index, photo in enumerate(photos):
            if photo.camera.is_panorama:
                continue
            key = id(photo.camera)
            if key not in outlines:
                outlines[key] = frustum_cam(photo.camera)
            world_from_cam = world_from_source.rotation @ photo.cam_from_source.rotation.T
            lines.append(outlines[key] @ world_from_cam.T * size + centres[index])
            owners += [index] * len(outlines[key])
        return cls(
            names=tuple(photo.name for photo in photos),
            centres=centres,
            is_globe=np.array([photo.camera.is_panorama for photo in photos], bool),
            radius=radius,
            frustums=np.concatenate([*lines, np.zeros((0, 2, 3))]).astype(np.float32),
            frustum_of=np.array(owners, np.int64),
            path=np.stack([centres[:-1], centres[1:]], axis=1).astype(np.float32),
        )

    def pick(self, origin: Float64, direction: Float64, pixel_angle_rad: float) -> tuple[int, float] | None:
        """The photo under the cursor and its distance along the ray, or None. One stood in is not in the way.

        Args:
            origin: (3,) of the ray.
            direction: (3,) unit.
            pixel_angle_rad: Of one pixel of the view.
        """
        away = self.centres - origin
        depth = away @ direction
        offset = np.linalg.norm(away - depth[:, None] * direction, axis=1)
        reach = np.maximum(1.3 * self.radius, _REACH_PX * pixel_angle_rad * depth)
        is_hit = (depth > 0.0) & (offset <= reach) & (np.linalg.norm(away, axis=1) > 1.5 * self.radius)
        if not is_hit.any():
            return None
        # Of those drawn under the cursor the front one; else the one beside it.
        is_under = is_hit & (offset <= 1.3 * self.radius)
        best = int(
            np.argmin(np.where(is_under, depth, np.inf) if is_under.any() else np.where(is_hit, offset / reach, 9))
        )
        return best, float(depth[best])


def frustum_cam(camera: CameraModel) -> Float64:
    """(M, 2, 3) lines of a camera of size 1 in its own frame: four edges, the frame of the image, and a roof on it.

    A perspective image lies at depth 1; what a fisheye sees lies on a sphere of radius 1.
    """
    width, height = float(camera.width_px), float(camera.height_px)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    middle = np.array([width / 2, height / 2])
    # Outside of its circle a fisheye sees nothing.
    for share in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.3):
        rays = camera.rays(middle + share * (corners - middle))
        if np.isfinite(rays).all():
            break
    else:
        return np.zeros((0, 2, 3))
    if rays[:, 2].min() > 0.4:
        rays = rays / rays[:, 2:]
    apex = np.zeros(3)
    roof = 0.5 * (rays[0] + rays[1]) + 0.35 * (0.5 * (rays[0] + rays[1]) - 0.5 * (rays[2] + rays[3])) / 2
    edges = [(apex, ray) for ray in rays] + [(rays[i], rays[(i + 1) % 4]) for i in range(4)]
    return np.array([*edges, (rays[0], roof), (roof, rays[1])], np.float64)


def _spacing(centres: Float64) -> float:
    """The usual distance of a photo to the nearest other one; infinite for a single photo."""
    from scipy.spatial import cKDTree

    extent = float(np.ptp(centres, axis=0).max(initial=0.0)) if len(centres) else 0.0
    if not extent > 0.0:
        return float("inf")
    places = centres[np.unique(np.round(centres / (_SAME_PLACE * extent)), axis=0, return_index=True)[1]]
    if len(places) < 2:
        return float("inf")
    return float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))


class CameraLayer:
    """The photos in the scene of one tab; for the tab's own thread."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._glyphs: CameraGlyphs | None = None
        self._shown_for: tuple[Any, ...] | None = None
        self._handles: list[Any] = []
        self._root: Any = None
        self._current_handle: Any = None
        self._current: str | None = None
        self._on = True

    @property
    def is_on(self) -> bool:
        """Whether the photos are to be seen, where there are any."""
        return self._on

    @property
    def glyphs(self) -> CameraGlyphs | None:
        """What is drawn; None where the plot has no photos."""
        return self._glyphs

    def set_on(self, on: bool) -> None:
        """Show or hide the photos."""
        self._on = on
        if self._root is not None and self._root.visible != on:
            self._root.visible = on

    def refresh(self) -> None:
        """Bring the picture in step with the photos of the plot and the way it lies in the world."""
        session = self._tab.session
        cameras = session.cameras if session is not None else None
        self._tab.controls.show_cameras(cameras is not None)
        if session is None or cameras is None:
            self._remove()
            return
        document, display = session.document, self._tab.studio.display
        frame = document.world_from_source
        key = (cameras, frame.scale, frame.rotation.tobytes(), frame.translation.tobytes())
        if key == self._shown_for or display is None:
            return
        self._remove()
        self._shown_for = key
        plot_radius = display.centre_and_radius()[1]
        self._glyphs = CameraGlyphs.of(cameras, document, session.cloud.origin, plot_radius)
        with self._tab.client.atomic():
            self._add(self._glyphs)
            self._draw_current()

    def set_current(self, name: str | None) -> None:
        """Mark the photo that is open."""
        if name != self._current:
            self._current = name
            with self._tab.client.atomic():
                self._draw_current()

    def click(self, click: SceneClick, depth_behind: float) -> bool:
        """Open the photo under the cursor and fly there.

        Args:
            click: What was clicked.
            depth_behind: How far along the ray the cloud is; a photo behind it was not meant.

        Returns:
            Whether there was one.
        """
        glyphs = self._glyphs
        if glyphs is None or not self._on:
            return False
        hit = glyphs.pick(click.ray_origin, click.ray_direction, click.view.pixel_angle_rad)
        if hit is None or hit[1] > depth_behind + glyphs.radius:
            return False
        name = glyphs.names[hit[0]]
        self._tab.photos.open(name)
        self.fly_to(name)
        return True

    def fly_to(self, name: str, direction_src: Float64 | None = None) -> None:
        """Stand where a photo was taken.

        Args:
            name: Of the photo.
            direction_src: (3,) where to look, source coordinates; by default towards the middle of the photo.
        """
        glyphs, session = self._glyphs, self._tab.session
        cameras = session.cameras if session is not None else None
        if glyphs is None or session is None or cameras is None or name not in glyphs.names:
            return
        photo = cameras.posed.by_name(name)
        if direction_src is None:
            direction_src = _direction(photo, session)
        direction = session.document.world_from_source.rotation @ direction_src
        # Upright stays upright: a look straight up or down has no upright.
        direction = direction / np.linalg.norm(direction)
        direction[2] = np.clip(direction[2], -0.95, 0.95)
        centre = glyphs.centres[glyphs.names.index(name)]
        ahead = max(30.0 * glyphs.radius, 1e-3)
        self._tab.scene.look_along(centre, direction, ahead)

    # ---- drawing

    def _remove(self) -> None:
        for handle in (self._current_handle, self._root):
            if handle is not None:
                handle.remove()
        self._root = self._current_handle = self._glyphs = self._shown_for = None
        self._handles = []

    def _add(self, glyphs: CameraGlyphs) -> None:
        scene = self._tab.client.scene
        self._root = scene.add_frame("/cameras", show_axes=False, visible=self._on)
        if len(glyphs.path):
            self._handles.append(
                scene.add_line_segments("/cameras/path", glyphs.path, _PATH, thickness=2.0, thickness_units="screen")
            )
        if len(glyphs.centres):
            # From afar a globe is smaller than a pixel; a dot has the same size from everywhere.
            dots = _dots(glyphs.centres, glyphs.radius)
            self._handles.append(
                scene.add_line_segments("/cameras/dots", dots, _COLOUR, thickness=_DOT_PX, thickness_units="screen")
            )
        if len(glyphs.frustums):
            self._handles.append(
                scene.add_line_segments(
                    "/cameras/frustums", glyphs.frustums, _COLOUR, thickness=2.0, thickness_units="screen"
                )
            )
        if glyphs.is_globe.any():
            vertices, faces = _globe()
            places = glyphs.centres[glyphs.is_globe].astype(np.float32)
            self._handles.append(
                scene.add_batched_meshes_simple(
                    "/cameras/globes",
                    vertices * np.float32(glyphs.radius),
                    faces,
                    batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(places), 1)),
                    batched_positions=places,
                    batched_colors=_COLOUR,
                    lod="off",
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )

    def _draw_current(self) -> None:
        if self._current_handle is not None:
            self._current_handle.remove()
            self._current_handle = None
        glyphs = self._glyphs
        if glyphs is None or self._current is None or self._current not in glyphs.names or self._root is None:
            return
        index, scene = glyphs.names.index(self._current), self._tab.client.scene
        if glyphs.is_globe[index]:
            vertices, faces = _globe()
            placed = (vertices * np.float32(1.35 * glyphs.radius) + glyphs.centres[index]).astype(np.float32)
            self._current_handle = scene.add_mesh_simple(
                "/cameras/current", placed, faces, color=_CURRENT, cast_shadow=False, receive_shadow=False
            )
            return
        lines = glyphs.frustums[glyphs.frustum_of == index]
        if len(lines):
            self._current_handle = scene.add_line_segments(
                "/cameras/current", lines, _CURRENT, thickness=5.0, thickness_units="screen"
            )


def _direction(photo: PosedImage, session: Session) -> Float64:
    """(3,) where a photo looks, source coordinates; level for a panorama, which looks everywhere."""
    camera = photo.camera
    direction: Float64 = photo.ray(np.array([[camera.width_px / 2, camera.height_px / 2]]))[1][0]
    if not np.isfinite(direction).all():
        direction = photo.cam_from_source.rotation[2]
    if camera.is_panorama:
        up = np.array(session.document.up_direction)
        level = direction - (direction @ up) * up
        direction = level if np.linalg.norm(level) > 1e-3 else np.cross(up, np.roll(up, 1))
    return direction / np.linalg.norm(direction)


def _dots(centres: Float64, radius: float) -> Float32:
    """(K, 2, 3) lines so short that they are dots."""
    half = np.array([0.0, 0.0, 0.3 * radius])
    return np.stack([centres - half, centres + half], axis=1).astype(np.float32)


def _globe() -> tuple[Float32, Any]:
    """(V, 3) and (F, 3) of a round enough ball of radius 1: eighty triangles."""
    t = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array(
        [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t),
         (0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]
    )  # fmt: skip
    faces = np.array(
        [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
         (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
         (8, 6, 7), (9, 8, 1)]
    )  # fmt: skip
    a, b, c = (corners[faces[:, i]] for i in range(3))
    ab, bc, ca = a + b, b + c, c + a
    triangles = np.concatenate(
        [np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    triangles = triangles / np.linalg.norm(triangles, axis=2, keepdims=True)
    vertices = triangles.reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
