"""A straight picture of a tree out of any photo, and where ring and outline of the trunk are in it.

The picture is what a camera with a shifting lens would take: it looks level, so that whatever is upright in the plot is
upright in the picture, right to the border, however the photo was held. Only where the tree is far above or below the
camera it looks up or down, as far as it must; then what is upright is so in the middle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, as_points, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage
from dbh_studio.core.stem_line import StemLine
from dbh_studio.core.transforms import Similarity

# Farther above or below the horizon a level picture would draw everything out.
_LEVEL_TO_RAD = np.radians(25.0)
# Nearer than this share of what is to be seen, less is shown, for the same reason.
_MOST_TALL = 1.7
_GRID, _COVERED, _SMALLER = 16, 0.985, (1.0, 0.85, 0.7, 0.55, 0.42)
_SHIFTS = (0.0, 0.25, -0.25, 0.5, -0.5)
_ROW_PX, _LEAST_IN_ROW, _EDGE_QUANTILE = 12, 4, 0.03
_MOST_POINTS, _MOST_GAP_ROWS, _CUT_SHARE = 40_000, 4, 0.88


@dataclass(frozen=True, eq=False)
class TreeCrop:
    """A picture to be cut out of a photo.

    Attributes:
        photo: Which; in the frame of the stem, +z up.
        view: The picture as a photo of its own, taken from the same place.
        units_per_px: Of one pixel of the picture at the stem's axis, where it was looked at.
        covered: Share of the picture that the photo shows.
    """

    photo: PosedImage
    view: PosedImage
    units_per_px: float
    covered: float

    def maps(self) -> tuple[Float32, Float32]:
        """(H, W) float32 each: the pixel of the photo shown by the middle of each pixel; NaN where it shows none."""
        camera = self.view.camera
        across, down = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
        uv, is_seen = _photo_pixels(self, np.column_stack([across.ravel(), down.ravel()]))
        uv[~is_seen] = np.nan
        spots = uv.astype(np.float32).reshape(camera.height_px, camera.width_px, 2)
        return spots[..., 0], spots[..., 1]

    def photo_px_per_px(self) -> float:
        """How many pixels of the photo one pixel of the picture is wide, in the middle."""
        camera = self.view.camera
        middle = np.array([camera.width_px / 2.0, camera.height_px / 2.0])
        if self.photo.camera.is_panorama:
            focal = camera.params[0]
            return float(self.photo.camera.params[0] / (2.0 * np.pi) / focal)
        uv, _ = _photo_pixels(self, middle + np.array([[-2.0, 0.0], [2.0, 0.0]]))
        width = float(np.linalg.norm(uv[1] - uv[0]) / 4.0)
        return width if np.isfinite(width) and width > 0.0 else 1.0

    def middle_in_photo(self) -> tuple[float, float]:
        """The pixel of the photo in the middle of the picture; NaN where the photo does not reach."""
        camera = self.view.camera
        uv, _ = _photo_pixels(self, np.array([[camera.width_px / 2.0, camera.height_px / 2.0]]))
        return float(uv[0, 0]), float(uv[0, 1])


def tree_crop(photo: PosedImage, stem: StemLine, *, tall: float, foot: float, size_px: tuple[int, int]) -> TreeCrop:
    """The picture of a stem's lower part.

    Where the photo does not reach as far, it is a smaller part, as near to what was asked for as the photo allows.

    Args:
        photo: In the frame of the stem, +z up.
        stem: Its `point` is in the picture, its axis in the middle of it.
        tall: How much of the stem is to be seen, in the frame's unit.
        foot: z of the ground; a little below it is where the picture ends.
        size_px: Width and height.
    """
    distance = float(np.hypot(*(stem.point - photo.centre_src)[:2]))
    tall = min(tall, _MOST_TALL * distance)
    # Wide enough for the stem itself, were it ever so near.
    tall = max(tall, 3.0 * stem.radius * size_px[1] / size_px[0])
    best: TreeCrop | None = None
    for share in _SMALLER:
        for shift in _SHIFTS if share < 1.0 else _SHIFTS[:1]:
            height = share * tall
            bottom = max(foot - 0.07 * height, stem.point[2] - (0.5 + 0.6 * shift) * height)
            crop = _looking_at(photo, stem.at(np.array([bottom + 0.5 * height]))[0], height, size_px)
            crop = replace(crop, covered=_covered(crop))
            # What is missing is worse than what is smaller.
            if best is None or crop.covered * share**0.25 > best.covered * _share_of(best, tall, size_px) ** 0.25:
                best = crop
            if crop.covered >= _COVERED:
                return crop
    assert best is not None
    return best


def _share_of(crop: TreeCrop, tall: float, size_px: tuple[int, int]) -> float:
    return crop.units_per_px * size_px[1] / tall


def _looking_at(photo: PosedImage, target: Float64, tall: float, size_px: tuple[int, int]) -> TreeCrop:
    """With `target` in the middle and so much of the world, there, from top to bottom."""
    width, height = size_px
    x, y, z = (float(value) for value in target - photo.centre_src)
    level = max(float(np.hypot(x, y)), 1e-9)
    elevation = float(np.arctan2(z, level))
    pitch = np.sign(elevation) * max(0.0, abs(elevation) - _LEVEL_TO_RAD)
    ahead = np.array([x / level, y / level, 0.0])
    right, up = np.array([ahead[1], -ahead[0], 0.0]), np.array([0.0, 0.0, 1.0])
    forward = np.cos(pitch) * ahead + np.sin(pitch) * up
    rotation = np.stack([right, np.cross(forward, right), forward])
    across, down, depth = rotation @ np.array([x, y, z])
    focal = height * depth / tall
    camera = CameraModel(
        "PINHOLE",
        width,
        height,
        (focal, focal, width / 2.0 - focal * across / depth, height / 2.0 - focal * down / depth),
    )
    pose = Similarity(rotation, -(rotation @ photo.centre_src))
    return TreeCrop(photo, PosedImage(photo.name, camera, pose), tall / height, 1.0)


def _photo_pixels(crop: TreeCrop, xy_px: Float64) -> tuple[Float64, Bool]:
    """(N, 2) pixels of the photo that (N, 2) pixels of the picture show, and (N,) whether inside it."""
    camera = crop.view.camera
    fx, fy, cx, cy = camera.params
    rays = np.column_stack([(xy_px[:, 0] - cx) / fx, (xy_px[:, 1] - cy) / fy, np.ones(len(xy_px))])
    turn = crop.photo.cam_from_source.rotation @ crop.view.cam_from_source.rotation.T
    return crop.photo.camera.project(rays @ turn.T)


def _covered(crop: TreeCrop) -> float:
    camera = crop.view.camera
    if crop.photo.camera.is_panorama and crop.photo.camera.params == (
        crop.photo.camera.width_px,
        crop.photo.camera.height_px,
    ):
        return 1.0
    steps = np.linspace(0.0, 1.0, _GRID)
    across, down = np.meshgrid(steps * camera.width_px, steps * camera.height_px)
    return float(_photo_pixels(crop, np.column_stack([across.ravel(), down.ravel()]))[1].mean())


def outline_px(view: PosedImage, points: Float) -> tuple[Float64, Float64]:
    """The left and the right edge of a trunk in a picture, from top to bottom.

    Args:
        view: The picture.
        points: (N, 3) of the trunk.

    Returns:
        (K, 2) and (K, 2) pixels, each row at one height; a row of NaN where the trunk's points leave a gap. Empty where
        the picture shows too few of them.
    """
    points = as_points(points, name="points")
    points = points[:: max(1, len(points) // _MOST_POINTS)]
    uv, is_inside = view.project(points)
    # What lies beside the picture still tells where the edge is: only above and below is left out.
    height = view.camera.height_px
    with np.errstate(invalid="ignore"):
        kept = np.isfinite(uv).all(axis=1) & (uv[:, 1] >= 0.0) & (uv[:, 1] < height)
    if not is_inside.any():
        return np.empty((0, 2)), np.empty((0, 2))
    x, row = uv[kept, 0], (uv[kept, 1] // _ROW_PX).astype(np.int64)
    order = np.lexsort((x, row))
    x, row = x[order], row[order]
    n_rows = -(-height // _ROW_PX)
    start = np.searchsorted(row, np.arange(n_rows + 1))
    count = np.diff(start)
    enough = np.flatnonzero(count >= _LEAST_IN_ROW)
    if len(enough) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    skipped = np.rint(_EDGE_QUANTILE * count[enough]).astype(np.int64)
    left, right = x[start[enough] + skipped], x[start[enough + 1] - 1 - skipped]
    whole = _whole_rows(right - left)
    left, right, enough = left[whole], right[whole], enough[whole]
    down = np.minimum((enough + 0.5) * _ROW_PX, height - 0.5)
    return _edge(left, down, enough), _edge(right, down, enough)


def _whole_rows(width: Float64) -> slice:
    """Without the ends at which a trunk was cut off aslant, as it is above sloping ground."""
    first, last = 0, len(width)
    while last - first > 4 and width[last - 1] < _CUT_SHARE * np.median(width[last - 5 : last - 1]):
        last -= 1
    while last - first > 4 and width[first] < _CUT_SHARE * np.median(width[first + 1 : first + 5]):
        first += 1
    return slice(first, last)


def _edge(x: Float64, down: Float64, rows: np.ndarray) -> Float64:
    """(K, 2) an edge, smoothed over its neighbours, and broken where rows are missing."""
    padded = np.concatenate([[x[0]] * 2, x, [x[-1]] * 2])
    middle = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    padded = np.concatenate([middle[:1], middle, middle[-1:]])
    smooth = padded[:-2] * 0.25 + padded[1:-1] * 0.5 + padded[2:] * 0.25
    edge = np.column_stack([smooth, down])
    gaps = np.flatnonzero(np.diff(rows) > _MOST_GAP_ROWS) + 1
    return np.insert(edge, gaps, np.nan, axis=0)


def ring_px(view: PosedImage, ring: Float, is_hidden: Bool | None = None) -> tuple[Float64, Bool]:
    """A closed ring about a stem in a picture.

    Args:
        view: The picture.
        ring: (M, 3) its corners, in order.
        is_hidden: (M,) where something else stands in front of it.

    Returns:
        (M + 1, 2) pixels, the first one again at the end; (M + 1,) whether it is seen there: it faces the camera, and
        nothing hides it.
    """
    ring = as_points(ring, name="ring").astype(np.float64)
    ring = np.concatenate([ring, ring[:1]])
    uv, _ = view.project(ring)
    middle = ring[:-1].mean(axis=0)
    facing = np.einsum("ij,ij->i", (ring - middle)[:, :2], (view.centre_src - ring)[:, :2]) > 0.0
    if is_hidden is not None:
        facing &= ~np.concatenate([is_hidden, is_hidden[:1]])
    return uv, facing


def runs(line_px: Float64, is_one: Bool) -> Iterator[tuple[Float64, bool]]:
    """A line in pieces that are all of one kind, neighbours sharing a point; breaks at NaN are left out."""
    if len(line_px) < 2:
        return
    # A stretch between two points is of the kind when both are.
    kind = is_one[:-1] & is_one[1:]
    fine = np.isfinite(line_px[:-1]).all(axis=1) & np.isfinite(line_px[1:]).all(axis=1)
    state = np.where(fine, kind.astype(np.int8), np.int8(-1))
    ends = np.concatenate([np.flatnonzero(np.diff(state)) + 1, [len(state)]])
    start = 0
    for end in ends.tolist():
        if state[start] >= 0:
            yield readonly(line_px[start : end + 1]), bool(state[start])
        start = end


def dashes(line_px: Float64, *, on_px: float = 6.0, off_px: float = 5.0) -> list[Float64]:
    """A line in dashes of a given length, whatever its points are apart."""
    step = np.linalg.norm(np.diff(line_px, axis=0), axis=1)
    along = np.concatenate([[0.0], step.cumsum()])
    if not along[-1] > 0.0:
        return []
    starts = np.arange(0.0, along[-1], on_px + off_px)
    pieces = []
    for start in starts:
        end = min(start + on_px, along[-1])
        inner = line_px[(along > start) & (along < end)]
        ends = np.column_stack([np.interp([start, end], along, line_px[:, axis]) for axis in (0, 1)])
        pieces.append(np.concatenate([ends[:1], inner, ends[1:]]))
    return pieces
