"""The mask of one photo as a person sees and changes it: drawn over any look, painted through any look, exactly.

A pixel of the mask is painted where its middle lies under the brush as the photo is seen, so a round brush is round on
the screen wherever it is used: over the seam of a panorama, at its poles, and in a photo that is turned.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dbh_studio.core.arrays import Bool, Float64, UInt8
from dbh_studio.core.camera import CameraModel

if TYPE_CHECKING:
    from dbh_studio.io.masks import TrunkMask
    from dbh_studio.ui.photo_look import Look

Tool = Literal["add", "erase"]
UInt16 = NDArray[np.uint16]

IGNORED = 65535
# A new mask is as fine as the photo, up to this: finer than any model makes them.
MOST_SIDE_PX = 4096
_CHUNK = 1 << 19
_UNDO_STROKES, _UNDO_BYTES = 100, 300_000_000
# Corners of the outline about a brush: the polygon is drawn round the circle, not into it.
_CORNERS = 24
_MOSTLY = 0.9
_RIM = np.array([255, 255, 255], np.float32)
_DIM = np.float32(0.45)


class MaskCanvas:
    """One mask, shared by the tabs that look at it; any thread may call.

    Args:
        mask: As it is now; None for a photo that has none: nothing painted then says nothing.
        camera: Of the photo.

    Attributes:
        camera: Of the photo.
        has_instances: Whether each number is one trunk.
        version: Counts the changes.
    """

    def __init__(self, mask: TrunkMask | None, camera: CameraModel) -> None:
        self.camera = camera
        self.version = 0
        self.has_instances = True
        self._scores: dict[int, float] | None = None
        if mask is None:
            factor = min(1.0, MOST_SIDE_PX / max(camera.width_px, camera.height_px))
            shape = (max(round(camera.height_px * factor), 1), max(round(camera.width_px * factor), 1))
            self._levels = np.full(shape, IGNORED, np.uint16)
        else:
            self._levels = np.array(mask.labels, np.uint16)
            if mask.ignored is not None:
                self._levels[mask.ignored] = IGNORED
            self.has_instances, self._scores = mask.has_instances, mask.scores
        # What is erased becomes what the rest of the mask is: no trunk, or nothing said.
        is_silent = np.count_nonzero(self._levels == IGNORED) > _MOSTLY * self._levels.size
        self._background = IGNORED if is_silent else 0
        self._strokes: list[list[tuple[NDArray[np.uint32], UInt16]]] = []
        self._lock = threading.RLock()

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the mask, pixels."""
        return self._levels.shape[1], self._levels.shape[0]

    @property
    def n_bytes(self) -> int:
        """Memory taken."""
        return int(self._levels.nbytes) + sum(_bytes_of(stroke) for stroke in self._strokes)

    @property
    def can_undo(self) -> bool:
        """Whether a stroke can be taken back."""
        return bool(self._strokes)

    @property
    def is_silent(self) -> bool:
        """Whether the mask says nothing where no trunk is painted."""
        return self._background == IGNORED

    def numbers(self) -> tuple[int, ...]:
        """The trunks that are in it."""
        with self._lock:
            occurs = np.zeros(65536, bool)
            occurs[self._levels] = True
        return tuple(int(number) for number in np.flatnonzero(occurs) if 0 < number < IGNORED)

    def largest(self) -> tuple[float, float] | None:
        """The pixel of the photo in the middle of the trunk that takes most of the mask; None where there is none."""
        with self._lock:
            counts = np.bincount(self._levels.reshape(-1), minlength=IGNORED + 1)
            counts[[0, IGNORED]] = 0
            number = int(counts.argmax())
            if not counts[number]:
                return None
            rows, columns = np.nonzero(self._levels == number)
        row = int(np.median(rows))
        # One over the seam has its middle at one of the borders, not between them.
        beside = columns[np.abs(rows - row) <= 1]
        column = int(beside[np.abs(beside - np.median(beside)).argmin()])
        across, down = self._per_px()
        return (column + 0.5) / across, (row + 0.5) / down

    def mask(self) -> TrunkMask:
        """What is painted now."""
        from dbh_studio.io.masks import TrunkMask

        with self._lock:
            levels = self._levels.copy()
        ignored = levels == IGNORED
        levels[ignored] = 0
        return TrunkMask(levels, ignored if ignored.any() else None, self.has_instances, self._scores)

    # ---- painting

    def begin(self) -> None:
        """From here on everything is one stroke, taken back at once."""
        with self._lock:
            if not self._strokes or self._strokes[-1]:
                self._strokes.append([])
            while len(self._strokes) > 1 and (
                len(self._strokes) > _UNDO_STROKES or sum(map(_bytes_of, self._strokes)) > _UNDO_BYTES
            ):
                del self._strokes[0]

    def number_for(self, tool: Tool, look: Look, at_xy: tuple[float, float]) -> int:
        """What a stroke that begins here paints: the trunk it begins on, a new one beside all, or none."""
        if tool == "erase":
            return self._background
        with self._lock:
            index = self._under(look, np.array([at_xy]))
            level = int(self._levels.reshape(-1)[index[0]]) if len(index) else 0
            if 0 < level < IGNORED:
                return level
            return self.new_number()

    def new_number(self) -> int:
        """The number of one more trunk; 1 where the mask does not tell trunks apart."""
        if not self.has_instances:
            return 1
        return min(max(self.numbers(), default=0) + 1, IGNORED - 1)

    def paint(self, look: Look, points_xy: ArrayLike, radius_px: float, number: int) -> int:
        """Paint along a line with a round brush; how many pixels it changed.

        Args:
            look: How the photo is seen.
            points_xy: (K, 2) the pointer's way, pixels of the view; one point is a dab.
            radius_px: Of the brush, pixels of the view.
            number: From `number_for`.
        """
        points = np.asarray(points_xy, np.float64).reshape(-1, 2)
        if not len(points):
            return 0
        starts, ends = (points[:-1], points[1:]) if len(points) > 1 else (points, points)
        changed = 0
        with self._lock:
            for a, b in zip(starts, ends, strict=True):
                index = self._within(look, _about(a, b, radius_px), _near_segment(a, b, radius_px))
                changed += self._set(index, number)
            # A pixel of the photo may be larger than the brush.
            return changed + self._set(self._under(look, points), number)

    def fill(self, look: Look, shape: Bool, number: int) -> int:
        """Paint what a picture of the whole view shows as true; how many pixels it changed.

        Args:
            look: How the photo is seen.
            shape: (h, w) of the view, in any size.
            number: What to paint.
        """
        rows, columns = np.flatnonzero(shape.any(axis=1)), np.flatnonzero(shape.any(axis=0))
        if not len(rows):
            return 0
        per_x, per_y = shape.shape[1] / look.width_px, shape.shape[0] / look.height_px
        x0, x1 = columns[0] / per_x, (columns[-1] + 1) / per_x
        y0, y1 = rows[0] / per_y, (rows[-1] + 1) / per_y

        def inside(xy: Float64) -> Bool:
            found = np.zeros(len(xy), bool)
            with np.errstate(invalid="ignore"):
                is_in = (xy[:, 0] >= x0) & (xy[:, 0] < x1) & (xy[:, 1] >= y0) & (xy[:, 1] < y1)
            at = (xy[is_in] * (per_x, per_y)).astype(np.int64)
            found[is_in] = shape[np.minimum(at[:, 1], shape.shape[0] - 1), np.minimum(at[:, 0], shape.shape[1] - 1)]
            return found

        outline = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        with self._lock:
            return self._set(self._within(look, outline, inside), number)

    def undo(self) -> bool:
        """Take the last stroke back; False where there is none."""
        with self._lock:
            while self._strokes:
                stroke = self._strokes.pop()
                if not stroke:
                    continue
                flat = self._levels.reshape(-1)
                for index, before in reversed(stroke):
                    flat[index] = before
                self.version += 1
                return True
        return False

    def _set(self, index: NDArray[np.uint32], number: int) -> int:
        flat = self._levels.reshape(-1)
        before = flat[index]
        # What is not to be looked at stays so under the eraser.
        is_new = (before > 0) & (before < IGNORED) if number in (0, IGNORED) else before != number
        if not is_new.any():
            return 0
        index, before = index[is_new], before[is_new]
        flat[index] = number
        if not self._strokes:
            self._strokes.append([])
        self._strokes[-1].append((index, before))
        self.version += 1
        return len(index)

    def _per_px(self) -> tuple[float, float]:
        """Pixels of the mask for one of the photo, across and down."""
        return self.size[0] / self.camera.width_px, self.size[1] / self.camera.height_px

    def _under(self, look: Look, points_xy: Float64) -> NDArray[np.uint32]:
        """The pixels shown at these places of the view."""
        uv = look.photo_from_view(points_xy)
        uv = uv[np.isfinite(uv).all(axis=1)] * self._per_px()
        width, height = self.size
        at = np.clip(np.floor(uv), 0, (width - 1, height - 1)).astype(np.int64)
        return np.unique(at[:, 1] * width + at[:, 0]).astype(np.uint32)

    def _within(self, look: Look, outline_xy: Float64, inside: Callable[[Float64], Bool]) -> NDArray[np.uint32]:
        """The pixels whose middles are seen where `inside` says so; none beyond the outline is asked."""
        width, height = self.size
        across, down = self._per_px()
        parts, (v0, v1) = look.reach(outline_xy)
        rows = _pixels(v0 * down, v1 * down, height)
        found = []
        for u0, u1 in parts:
            columns = _pixels(u0 * across, u1 * across, width)
            step = max(1, _CHUNK // max(len(columns), 1))
            for first in range(0, len(rows) if len(columns) else 0, step):
                some = rows[first : first + step]
                v, u = np.meshgrid((some + 0.5) / down, (columns + 0.5) / across, indexing="ij")
                xy, _ = look.view_from_photo(np.stack([u.ravel(), v.ravel()], axis=1))
                at = np.add.outer(some * width, columns).ravel()
                found.append(at[inside(xy)].astype(np.uint32))
        return np.concatenate(found) if found else np.zeros(0, np.uint32)

    # ---- showing

    def draw(self, look: Look, view: UInt8, opacity: float) -> UInt8:
        """(h, w, 3) the view with the mask over it: a colour per trunk, its outline, and dim what is not looked at.

        Args:
            look: How the photo is seen.
            view: (h, w, 3) the photo, as `PhotoPixels.render` gives it.
            opacity: Share of the colours, 0..1.
        """
        levels = self.seen(look)
        picture = view.astype(np.float32)
        is_trunk = (levels > 0) & (levels < IGNORED)
        strength = np.float32(min(max(opacity, 0.0), 1.0))
        if not self.is_silent:
            hidden = levels == IGNORED
            picture[hidden] *= 1.0 - strength * _DIM
        if is_trunk.any():
            picture[is_trunk] = (1 - strength) * picture[is_trunk] + strength * colours(levels[is_trunk])
            rim = _rim(levels) & is_trunk
            picture[rim] = 0.25 * picture[rim] + 0.75 * _RIM
        return np.clip(np.round(picture), 0, 255).astype(np.uint8)

    def seen(self, look: Look) -> UInt16:
        """(h, w) the level that each pixel of the view shows; 0 beside the photo."""
        u, v = look.maps()
        across, down = self._per_px()
        columns, rows = np.floor(u * np.float32(across)), np.floor(v * np.float32(down))
        width, height = self.size
        if self.camera.is_panorama:
            columns, outside = np.mod(columns, width), None
        else:
            outside = (columns < 0) | (columns >= width) | (rows < 0) | (rows >= height)
        at = np.clip(rows, 0, height - 1).astype(np.intp) * width + np.clip(columns, 0, width - 1).astype(np.intp)
        with self._lock:
            levels = self._levels.reshape(-1)[at]
        if outside is not None:
            levels[outside] = 0
        return levels


def colours(numbers: NDArray[np.integer]) -> NDArray[np.float32]:
    """(N, 3) colours 0..255 of trunks; the hues of the overlays that are written, in three shades.

    Every eighth hue is nearly the same; with the shade the trunks that stand together in a photo differ all the same.
    """
    from dbh_studio.io.masks.meaning import colours_of

    shade = np.array([1.0, 0.62, 0.82], np.float32)[(np.asarray(numbers) // 5) % 3]
    return colours_of(numbers) * shade[:, None]


def _bytes_of(stroke: list[tuple[NDArray[np.uint32], UInt16]]) -> int:
    return sum(int(index.nbytes + before.nbytes) for index, before in stroke)


def _pixels(low: float, high: float, count: int) -> NDArray[np.int64]:
    """The pixels whose middles lie between, and one more at each end for what was rounded."""
    return np.arange(max(int(np.floor(low - 0.5)), 0), min(int(np.ceil(high + 0.5)), count), dtype=np.int64)


def _about(a: Float64, b: Float64, radius: float) -> Float64:
    """(K, 2) corners of a convex outline about the line from a to b, a brush wide."""
    angles = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
    ring = radius / np.cos(np.pi / _CORNERS) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([a + ring, b + ring])


def _near_segment(a: Float64, b: Float64, radius: float) -> Callable[[Float64], Bool]:
    along = b - a
    length2 = float(along @ along)

    def inside(xy: Float64) -> Bool:
        with np.errstate(invalid="ignore"):
            t = np.clip((xy - a) @ along / length2, 0.0, 1.0) if length2 > 0.0 else np.zeros(len(xy))
            off = xy - a - t[:, None] * along
            near: Bool = (off * off).sum(axis=1) <= radius * radius
        return near

    return inside


def _rim(levels: UInt16) -> Bool:
    """Pixels of the view beside which something else is shown."""
    edge = np.zeros(levels.shape, bool)
    across, down = levels[:, :-1] != levels[:, 1:], levels[:-1] != levels[1:]
    edge[:, :-1] |= across
    edge[:, 1:] |= across
    edge[:-1] |= down
    edge[1:] |= down
    return edge
