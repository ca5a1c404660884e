"""A known length that is being marked, point by point, in the cloud or in photos; nothing of the page is in here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from dbh_studio.app.photo_points import Suggestion, TriangulatedPoint, photos_of_point, point_from_sights
from dbh_studio.core.arrays import Float64
from dbh_studio.core.bars import BarRole
from dbh_studio.core.dbh import Refusal
from dbh_studio.core.posed_images import PosedImages
from dbh_studio.core.scale_evidence import MarkedPoint, MarkerSquare, PointSrc, ScaleBar, Sight

LengthKind = Literal["bar", "square"]
PickPlace = Literal["cloud", "photos"]

POINT_NAMES: dict[LengthKind, tuple[str, ...]] = {
    "bar": ("one end", "the other end"),
    "square": ("the top-left corner", "the top-right corner", "the bottom-right corner", "the bottom-left corner"),
}
_N_OFFERED = 6


@dataclass(frozen=True, eq=False)
class Pick:
    """One point as far as it is marked.

    Attributes:
        point: Where it is; None while that is not known.
        sights: The photos it is marked in.
        found: What the photos say together, where they say something.
        refusal: Why they do not.
        rough_src: Where it may be, from one photo and the cloud.
    """

    point: MarkedPoint | None = None
    sights: tuple[Sight, ...] = ()
    found: TriangulatedPoint | None = None
    refusal: Refusal | None = None
    rough_src: PointSrc | None = None

    @property
    def place_src(self) -> PointSrc | None:
        """Where it is, or may be."""
        return self.point.xyz_src if self.point is not None else self.rough_src


@dataclass(eq=False)
class PointPicks:
    """The length at hand. Only the tab's own thread touches it.

    Attributes:
        kind: A bar has two points, a square four.
        place: Where the person was asked to click; either place is taken at any time.
        edited: Name of the length whose points are marked anew; empty for a new one.
        role: Of the length.
        picks: One per point, in order.
        chosen: The point that the next click in a photo, or the close-up, is about.
        is_moving: The next click in the cloud moves the chosen point and adds none.
        seen_from_src: From where the first point was seen.
        typed: The true length as it stands in the page; None while nobody has touched it.
    """

    kind: LengthKind
    place: PickPlace
    edited: str = ""
    role: BarRole = "control"
    picks: list[Pick] = field(default_factory=list)
    chosen: int = 0
    is_moving: bool = False
    seen_from_src: Float64 | None = None
    typed: str | None = None

    def __post_init__(self) -> None:
        self.picks = self.picks or [Pick() for _ in POINT_NAMES[self.kind]]

    @classmethod
    def of(cls, length: ScaleBar | MarkerSquare) -> PointPicks:
        """To mark the points of a length anew."""
        is_bar = isinstance(length, ScaleBar)
        points = length.ends if isinstance(length, ScaleBar) else length.corners
        place: PickPlace = "photos" if any(point.sights for point in points) else "cloud"
        picks = [Pick(point, point.sights) for point in points]
        return cls("bar" if is_bar else "square", place, length.name, length.role, picks)

    # ---- how far it is

    @property
    def names(self) -> tuple[str, ...]:
        """What the points are called."""
        return POINT_NAMES[self.kind]

    @property
    def is_complete(self) -> bool:
        """Whether all points are known."""
        return all(pick.point is not None for pick in self.picks)

    @property
    def is_begun(self) -> bool:
        """Whether anything is marked."""
        return any(pick.point is not None or pick.sights for pick in self.picks)

    @property
    def current(self) -> Pick:
        """The chosen point."""
        return self.picks[self.chosen]

    def choose(self, number: int) -> None:
        """Turn to another point."""
        if 0 <= number < len(self.picks):
            self.chosen, self.is_moving = number, False

    def next_open(self) -> int | None:
        """The first point that is not known yet; None where all are."""
        return next((number for number, pick in enumerate(self.picks) if pick.point is None), None)

    # ---- in the cloud

    def target_of_click(self) -> int | None:
        """Which point a click in the cloud is for; None where all are marked and none is to be moved."""
        return self.chosen if self.is_moving else self.next_open()

    def put(self, number: int, point: MarkedPoint, *, seen_from_src: Float64 | None = None) -> None:
        """Mark a point of the cloud."""
        self.picks[number] = Pick(point)
        self.chosen, self.is_moving = number, False
        if self.seen_from_src is None:
            self.seen_from_src = seen_from_src

    # ---- in photos

    def put_sight(self, sight: Sight, posed: PosedImages, rough_of: Callable[[Sight], PointSrc | None]) -> None:
        """Mark the chosen point in a photo, in place of where it was marked in it before.

        Args:
            sight: Where.
            posed: The photos, in the cloud's frame.
            rough_of: Where a single sight meets the cloud, as well as that can be told.
        """
        others = [each for each in self.current.sights if each.image != sight.image]
        self._take((*others, sight), posed, rough_of)

    def remove_sight(self, image: str, posed: PosedImages, rough_of: Callable[[Sight], PointSrc | None]) -> None:
        """Take the mark of the chosen point out of a photo."""
        self._take(tuple(each for each in self.current.sights if each.image != image), posed, rough_of)

    def _take(
        self, sights: tuple[Sight, ...], posed: PosedImages, rough_of: Callable[[Sight], PointSrc | None]
    ) -> None:
        rough = rough_of(sights[0]) if sights else None
        if len(sights) < 2:
            self.picks[self.chosen] = Pick(None, sights, rough_src=rough)
            return
        result = point_from_sights(sights, posed)
        if isinstance(result, Refusal):
            self.picks[self.chosen] = Pick(None, sights, refusal=result, rough_src=rough)
            return
        self.picks[self.chosen] = Pick(result.point, sights, result, rough_src=rough)
        if self.seen_from_src is None:
            self.seen_from_src = posed.by_name(sights[0].image).centre_src

    def offered(self, posed: PosedImages) -> tuple[Suggestion, ...]:
        """Photos that should show the chosen point too, the best first."""
        place = self.current.place_src
        if place is None:
            return ()
        used = [sight.image for sight in self.current.sights]
        return photos_of_point(np.array(place), posed, without=used, at_most=_N_OFFERED)

    # ---- taking back, and keeping

    def remove(self, number: int) -> None:
        """Forget a point."""
        self.picks[number] = Pick()
        self.chosen, self.is_moving = number, False
        if not self.is_begun:
            self.seen_from_src = None

    def remove_last(self) -> bool:
        """Forget the last point that is marked. False where there is none."""
        marked = [number for number, pick in enumerate(self.picks) if pick.point is not None or pick.sights]
        if marked:
            self.remove(marked[-1])
        return bool(marked)

    def length(
        self, name: str, true_m: float, before: ScaleBar | MarkerSquare | None = None
    ) -> ScaleBar | MarkerSquare:
        """The length as marked; `before` is the one whose points were marked anew.

        Raises:
            ValueError: A point is missing.
        """
        points = [pick.point for pick in self.picks if pick.point is not None]
        if len(points) < len(self.picks):
            raise ValueError("a point is missing")
        if self.kind == "bar":
            first, second = points
            if isinstance(before, ScaleBar):
                return replace(before, ends=(first, second), length_m=true_m)
            return ScaleBar(name, (first, second), true_m, role=self.role)
        corners = self._clockwise(points)
        if isinstance(before, MarkerSquare):
            # Corners that a person moved are no longer those a program found.
            return replace(
                before,
                corners=corners,
                side_m=true_m,
                marker=None,
                n_views=None,
                side_sigma_src=None,
                systematic_src=0.0,
            )
        return MarkerSquare(name, corners, true_m, role=self.role)

    def _clockwise(self, points: list[MarkedPoint]) -> tuple[MarkedPoint, MarkedPoint, MarkedPoint, MarkedPoint]:
        """As printed: a square that was gone round the other way has its sky underneath."""
        first, second, third, fourth = points
        if self.seen_from_src is not None:
            xyz = np.array([point.xyz_src for point in points])
            upwards = np.cross(xyz[2] - xyz[0], xyz[1] - xyz[3])
            if float(upwards @ (self.seen_from_src - xyz.mean(axis=0))) < 0:
                return first, fourth, third, second
        return first, second, third, fourth
