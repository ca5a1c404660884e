"""Which photos show a tree best: near, in the frame, not hidden by what stands before it, and from different sides.

All is in one frame with +z up, in any unit: nothing here needs the scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int64, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.occluders import N_UP, Occluders
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.stem_line import StemLine

_HEIGHTS = (np.arange(N_UP) + 0.5) / N_UP
# A stem that is lower than this in a photo shows nothing one could name a species by; above the other it is sharp.
_LEAST_PX, _SHARP_PX = 40.0, 500.0
_LEAST_SEEN = 0.35
_SECTORS, _PER_SECTOR, _MOST_TESTED = 12, 6, 150
_OTHER_SIDE_RAD, _LEAST_APART_RAD, _LEAST_OF_BEST = np.radians(70.0), np.radians(15.0), 0.2

WhyNone = Literal["", "no_photos", "far", "out_of_frame", "hidden"]


class Viewpoints:
    """All photos of a plot, so that a few points are projected into all of them in one go.

    Args:
        photos: With +z up.
    """

    def __init__(self, photos: tuple[PosedImage, ...]) -> None:
        self.photos = tuple(photos)
        self._groups: dict[tuple[object, ...], tuple[CameraModel, list[int]]] = {}
        for index, photo in enumerate(self.photos):
            camera = photo.camera
            key = (camera.kind, camera.width_px, camera.height_px, camera.params)
            self._groups.setdefault(key, (camera, []))[1].append(index)

    def __len__(self) -> int:
        return len(self.photos)

    @cached_property
    def centres(self) -> Float64:
        """(P, 3) where they were taken."""
        return readonly(np.array([photo.centre_src for photo in self.photos], np.float64).reshape(-1, 3))

    @cached_property
    def _rotations(self) -> Float64:
        rotations = [photo.cam_from_source.rotation for photo in self.photos]
        return readonly(np.array(rotations, np.float64).reshape(-1, 3, 3))

    def look(self, stem: StemLine) -> tuple[Float64, Float64, Float64]:
        """What every photo shows of a stem, were nothing in front.

        Returns:
            (P, N_UP) 1 where the axis is in the frame, from below; (P,) pixels between the stem's lower and upper end
            if it were seen across; (P,) how near it is to the middle of the frame, 1 in the middle, 0 in a corner.
        """
        points = stem.at(stem.low + _HEIGHTS * (stem.high - stem.low))
        inside = np.zeros((len(self), N_UP))
        height_px, central = np.zeros(len(self)), np.ones(len(self))
        for camera, rows in self._groups.values():
            offset = points - self.centres[rows][:, None, :]
            cam = np.einsum("pij,pkj->pki", self._rotations[rows], offset)
            uv, seen = camera.project(cam.reshape(-1, 3))
            uv, inside[rows] = uv.reshape(len(rows), N_UP, 2), seen.reshape(len(rows), N_UP)
            distance = np.linalg.norm(offset[:, N_UP // 2], axis=1)
            height_px[rows] = (
                _px_per_rad(camera, cam[:, N_UP // 2]) * (stem.high - stem.low) / np.maximum(distance, 1e-9)
            )
            if not camera.is_panorama:
                half = 0.5 * np.array([camera.width_px, camera.height_px])
                with np.errstate(invalid="ignore"):
                    off = np.linalg.norm(uv[:, N_UP // 2] / half - 1.0, axis=1) / np.sqrt(2.0)
                central[rows] = np.clip(1.0 - np.nan_to_num(off, nan=1.0), 0.0, 1.0)
        return inside, height_px, central


@dataclass(frozen=True, eq=False)
class TreeView:
    """One photo that shows a tree.

    Attributes:
        photo: In the frame that was asked in.
        distance: Level distance from the camera to the stem's axis, in the frame's unit.
        bearing_deg: From the tree to the camera, clockwise from +y.
        seen: Share of the lower stem that is in the frame and not hidden.
        hidden: (N_UP, N_ACROSS) see `Occluders.hidden`.
        score: What it was chosen by; only good for comparing.
    """

    photo: PosedImage
    distance: float
    bearing_deg: float
    seen: float
    hidden: Bool
    score: float


@dataclass(frozen=True, eq=False)
class TreeViews:
    """The best photos of a tree, best first.

    Attributes:
        views: At most as many as were asked for.
        why_none: Why there are none; empty where there are some.
        n_near: In how many photos the stem is in the frame and large enough to be looked at.
        n_seen: In how many of those that were looked at closely it can be seen.
    """

    views: tuple[TreeView, ...]
    why_none: WhyNone = ""
    n_near: int = 0
    n_seen: int = 0


def choose_views(
    stem: StemLine, viewpoints: Viewpoints, occluders: Occluders, *, own: Int64 | None = None, most: int = 4
) -> TreeViews:
    """The two to four photos a tree is best looked at in.

    A photo counts by the share of the lower stem that it shows, by how large and how central the stem is in it, and
    the second one on also by how far round the tree it was taken from those before. One from almost the same side as
    a better one is left out.

    Args:
        stem: Of the tree.
        viewpoints: All photos, in the frame of the stem.
        occluders: The cloud, in the same frame.
        own: Ascending rows of the cloud that belong to the tree.
        most: How many are wanted.
    """
    if not len(viewpoints):
        return TreeViews((), "no_photos")
    inside, height_px, central = viewpoints.look(stem)
    away = viewpoints.centres[:, :2] - stem.at(np.array([stem.middle]))[0, :2]
    distance = np.hypot(away[:, 0], away[:, 1])
    bearing = np.arctan2(away[:, 0], away[:, 1])
    in_frame = inside.mean(axis=1)
    is_shown = (in_frame >= _LEAST_SEEN) & (distance > 1.5 * stem.radius)
    is_near = is_shown & (height_px >= _LEAST_PX)
    if not is_near.any():
        return TreeViews((), "far" if is_shown.any() else "out_of_frame")
    # Nearer than the stem is tall one looks steeply up or down at most of it.
    steep = np.minimum(1.0, distance / (0.8 * (stem.high - stem.low)))
    worth = np.minimum(1.0, height_px / _SHARP_PX) ** 0.6 * steep * (0.6 + 0.4 * central)
    found: list[tuple[int, float, float, Bool]] = []
    first, others = _in_turn(np.where(is_near, worth * in_frame, 0.0), bearing)
    for turn, index in enumerate((*first, *others)):
        if found and (turn >= len(first) or _is_far_down(index, found, worth)):
            continue
        hidden = occluders.hidden(viewpoints.centres[index], stem, own=own)
        seen = float((inside[index][:, None] * ~hidden).mean())
        if seen >= _LEAST_SEEN:
            found.append((index, seen, seen**2 * float(worth[index]), hidden))
    n_near = int(is_near.sum())
    if not found:
        return TreeViews((), "hidden", n_near)
    views = [
        TreeView(viewpoints.photos[i], float(distance[i]), float(np.degrees(bearing[i]) % 360.0), seen, hidden, score)
        for i, seen, score, hidden in found
    ]
    return TreeViews(tuple(_different(views, most)), "", n_near, len(found))


def _is_far_down(index: int, found: list[tuple[int, float, float, Bool]], worth: Float64) -> bool:
    """Whether a photo could not be chosen even if all of the stem were seen in it."""
    return float(worth[index]) < _LEAST_OF_BEST * max(score for _, _, score, _ in found)


def _in_turn(worth: Float64, bearing_rad: Float64) -> tuple[list[int], list[int]]:
    """Photos to be asked: the best few from every side; and others, for where all of those are hidden."""
    order = np.argsort(-worth, kind="stable")
    order = order[worth[order] > 0.0]
    sector = np.floor((bearing_rad[order] / (2.0 * np.pi) % 1.0) * _SECTORS).astype(np.int64) % _SECTORS
    rank = np.zeros(len(order), np.int64)
    for which in range(_SECTORS):
        members = np.flatnonzero(sector == which)
        rank[members] = np.arange(len(members))
    is_first = rank < _PER_SECTOR
    return order[is_first].tolist(), order[~is_first][:_MOST_TESTED].tolist()


def _different(views: list[TreeView], most: int) -> list[TreeView]:
    """The best, then always the one that is best for its score and for how far round it is from those chosen."""
    score = np.array([view.score for view in views])
    bearing = np.radians([view.bearing_deg for view in views])
    apart = np.full(len(views), np.pi)
    chosen: list[int] = []
    while len(chosen) < most:
        value = score * (0.3 + 0.7 * np.minimum(1.0, apart / _OTHER_SIDE_RAD))
        value[apart < _LEAST_APART_RAD] = 0.0
        value[score < _LEAST_OF_BEST * score.max()] = 0.0
        best = int(value.argmax())
        if not value[best] > 0.0:
            break
        chosen.append(best)
        turn = np.abs((bearing - bearing[best] + np.pi) % (2.0 * np.pi) - np.pi)
        apart = np.minimum(apart, turn)
    return [views[index] for index in chosen]


def _px_per_rad(camera: CameraModel, points_cam: Float64) -> Float64:
    """(P,) pixels per radian in the direction of (P, 3) points; 0 where the lens shows nothing there."""
    if camera.is_panorama:
        return np.full(len(points_cam), camera.params[0] / (2.0 * np.pi))
    length = np.linalg.norm(points_cam, axis=1, keepdims=True)
    rays = points_cam / np.maximum(length, 1e-12)
    step = np.cross(rays, _across(rays)) * 1e-3
    uv, _ = camera.project(np.concatenate([rays - 0.5 * step, rays + 0.5 * step]))
    moved = np.linalg.norm(uv[len(rays) :] - uv[: len(rays)], axis=1) / 1e-3
    return np.asarray(np.nan_to_num(moved, nan=0.0, posinf=0.0))


def _across(rays: Float64) -> Float64:
    """(P, 3) unit vectors at right angles to the rays."""
    helper = np.where(np.abs(rays[:, :1]) < 0.9, np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]))
    across = np.cross(rays, helper)
    return np.asarray(across / np.linalg.norm(across, axis=1, keepdims=True))
