"""What the scale of a plot was taken from: known lengths between marked points, and square markers.

Evidence is kept in absolute source coordinates, so that no scale, up direction or origin changes it: a length marked
once can be corrected, struck or tested against long after the trees were measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, readonly
from dbh_studio.core.bars import Bar, BarLie, BarRole, KnownLength, ScaleReport, scale_from_bars
from dbh_studio.core.scale import ScaleSource, ScaleVerdict

PointSrc = tuple[float, float, float]
MarkerKey = tuple[str, int]

# Sides and diagonals of a flat square agree better than this share of the side.
MAX_UNEVENNESS = 0.02
# In fewer photos a marker is not seen from enough sides for its error to be believed.
WELL_SEEN = 4
_SIDES = ((0, 1), (1, 2), (2, 3), (3, 0))
_DIAGONALS = ((0, 2), (1, 3))


@dataclass(frozen=True)
class Sight:
    """Where a photo shows a point.

    Attributes:
        image: Name of the photo.
        u_px: Column, pixels of the camera, the centre of the first pixel at 0.5.
        v_px: Row.
    """

    image: str
    u_px: float
    v_px: float


@dataclass(frozen=True)
class MarkedPoint:
    """A point somebody marked, in the cloud or in photos.

    Attributes:
        xyz_src: Absolute source coordinates.
        sigma_src: Standard error of each of them.
        sights: The photos it was marked in; empty for a point of the cloud.
    """

    xyz_src: PointSrc
    sigma_src: float = 0.0
    sights: tuple[Sight, ...] = ()

    def __post_init__(self) -> None:
        xyz = tuple(float(value) for value in self.xyz_src)
        if len(xyz) != 3 or not np.isfinite(xyz).all() or not 0.0 <= self.sigma_src < float("inf"):
            raise ValueError(f"a marked point at {self.xyz_src} ± {self.sigma_src} is nowhere")
        object.__setattr__(self, "xyz_src", xyz)
        object.__setattr__(self, "sights", tuple(self.sights))


@dataclass(frozen=True)
class ScaleBar:
    """A known distance between two marked points.

    Attributes:
        name: Unique in the evidence.
        ends: Its two points.
        length_m: The true distance.
        length_se_m: Standard error of it: the tape, the print.
        role: ``control`` sets the scale, ``check`` only tests it.
    """

    name: str
    ends: tuple[MarkedPoint, MarkedPoint]
    length_m: float
    length_se_m: float = 0.001
    role: BarRole = "control"

    def as_known_length(self) -> Bar:
        """The same for `scale_from_bars`."""
        p, q = (np.array(end.xyz_src) for end in self.ends)
        sigma = float(np.hypot(self.ends[0].sigma_src, self.ends[1].sigma_src))
        return Bar(p, q, self.length_m, self.length_se_m, self.role, sigma, self.name)


@dataclass(frozen=True)
class MarkerSquare:
    """A square marker of known side: found in photos, or marked corner by corner.

    Attributes:
        name: Unique in the evidence.
        corners: Outer corners, top left first, clockwise as printed.
        side_m: The true side: the outer edge of the black square.
        side_se_m: Standard error of it.
        role: ``control`` sets the scale, ``check`` only tests it.
        marker: Its (dictionary, id) where a program found it; None where a person marked it.
        n_views: Photos it was measured in; None for a square marked in the cloud.
        side_sigma_src: Standard error of the side from scatter; None derives it from the corners'.
        systematic_src: Standard error of the side from what all markers in these photos share.
    """

    name: str
    corners: tuple[MarkedPoint, MarkedPoint, MarkedPoint, MarkedPoint]
    side_m: float
    side_se_m: float = 0.0005
    role: BarRole = "control"
    marker: MarkerKey | None = None
    n_views: int | None = None
    side_sigma_src: float | None = None
    systematic_src: float = 0.0

    def __post_init__(self) -> None:
        if len(self.corners) != 4:
            raise ValueError(f"a square has 4 corners, not {len(self.corners)}")

    @property
    def corners_src(self) -> Float64:
        """(4, 3) corners, absolute source coordinates."""
        return readonly(np.array([corner.xyz_src for corner in self.corners], np.float64))

    @property
    def length_m(self) -> float:
        """The true side."""
        return self.side_m

    @property
    def length_se_m(self) -> float:
        """Standard error of the true side."""
        return self.side_se_m

    @property
    def measured_src(self) -> float:
        """The side that its four sides and two diagonals say, source units."""
        return float(self._as_sides().mean())

    @property
    def sigma_src(self) -> float:
        """Standard error of `measured_src` from scatter."""
        if self.side_sigma_src is not None:
            return self.side_sigma_src
        # Each corner pulls its two sides and its diagonal: a quarter of its error in each of two directions.
        return float(np.sqrt(0.125 * sum(corner.sigma_src**2 for corner in self.corners)))

    @property
    def unevenness(self) -> float:
        """Largest departure of a side or diagonal from the square, or of a corner from its plane; share of the side."""
        sides, corners = self._as_sides(), self.corners_src
        mean = float(sides.mean())
        if not mean > 0.0:
            return float("inf")
        normal = np.cross(corners[2] - corners[0], corners[3] - corners[1])
        normal /= max(float(np.linalg.norm(normal)), 1e-300)
        off_plane = float(np.abs((corners - corners.mean(axis=0)) @ normal).max())
        return max(float(np.abs(sides / mean - 1).max()), off_plane / mean)

    @property
    def is_uneven(self) -> bool:
        """Whether it is less of a flat square than the errors of its corners explain."""
        noise = 4 * self.sigma_src / max(self.measured_src, 1e-300)
        return self.unevenness > max(MAX_UNEVENNESS, noise)

    def lie(self, up_src: Float64 | None) -> BarLie:
        """A square has sides in two directions: it tells nothing apart."""
        del up_src
        return "unknown"

    def frame(self) -> tuple[PointSrc, PointSrc, PointSrc]:
        """Unit normal of the printed side, middle, and unit direction to the top edge: up, origin and north of a plot.

        Raises:
            ValueError: The corners span no plane.
        """
        corners = self.corners_src
        north = (corners[0] + corners[1] - corners[2] - corners[3]) / 2
        east = (corners[1] + corners[2] - corners[0] - corners[3]) / 2
        up = np.cross(east, north)
        length = float(np.linalg.norm(up))
        if not length > 1e-9 * self.measured_src**2:
            raise ValueError("the corners of the marker lie on a line")
        up = up / length
        north = north - (north @ up) * up
        return _point(up), _point(corners.mean(axis=0)), _point(north / np.linalg.norm(north))

    def _as_sides(self) -> Float64:
        """(6,) sides, and diagonals over the root of two."""
        corners = self.corners_src
        lengths = np.array([np.linalg.norm(corners[a] - corners[b]) for a, b in (*_SIDES, *_DIAGONALS)])
        lengths[4:] /= np.sqrt(2)
        return np.asarray(lengths)


def _point(values: Any) -> PointSrc:
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True)
class ScaleEvidence:
    """All known lengths of a plot.

    Attributes:
        bars: Distances between two points.
        squares: Markers.
        struck: (photo, dictionary, id) of detections a person called false; the next search leaves them out.
    """

    bars: tuple[ScaleBar, ...] = ()
    squares: tuple[MarkerSquare, ...] = ()
    struck: tuple[tuple[str, str, int], ...] = field(default=())

    def __post_init__(self) -> None:
        names = [length.name for length in self]
        if len(set(names)) != len(names):
            raise ValueError("two known lengths have the same name")

    def __iter__(self) -> Iterator[ScaleBar | MarkerSquare]:
        yield from self.squares
        yield from self.bars

    def __len__(self) -> int:
        return len(self.bars) + len(self.squares)

    def __contains__(self, name: object) -> bool:
        return any(length.name == name for length in self)

    def __getitem__(self, name: str) -> ScaleBar | MarkerSquare:
        for length in self:
            if length.name == name:
                return length
        raise KeyError(name)

    def free_name(self, stem: str) -> str:
        """`stem` and the lowest number that no length has: ``Bar 3``."""
        number = 1
        while f"{stem} {number}" in self:
            number += 1
        return f"{stem} {number}"

    def with_length(self, length: ScaleBar | MarkerSquare) -> ScaleEvidence:
        """With one more, or with this one in place of that of its name."""
        if isinstance(length, ScaleBar):
            others = self.without(length.name) if any(s.name == length.name for s in self.squares) else self
            return replace(others, bars=_put(others.bars, length))
        others = self.without(length.name) if any(b.name == length.name for b in self.bars) else self
        return replace(others, squares=_put(others.squares, length))

    def with_changed(self, name: str, length: ScaleBar | MarkerSquare) -> ScaleEvidence:
        """With `length`, which may be called otherwise, in the place of the one called `name`."""
        if isinstance(length, ScaleBar):
            return replace(self, bars=tuple(length if bar.name == name else bar for bar in self.bars))
        return replace(self, squares=tuple(length if square.name == name else square for square in self.squares))

    def without(self, name: str) -> ScaleEvidence:
        """Without the length of this name."""
        bars = tuple(bar for bar in self.bars if bar.name != name)
        squares = tuple(square for square in self.squares if square.name != name)
        return replace(self, bars=bars, squares=squares)

    def with_found(self, squares: Iterable[MarkerSquare]) -> ScaleEvidence:
        """With newly found markers in place of those found before; what a person marked stays.

        A marker found again keeps the role and the side a person gave it. One that has the name of a length marked by
        hand gets another.
        """
        before: dict[MarkerKey | None, MarkerSquare] = {s.marker: s for s in self.squares if s.marker is not None}
        # A number that stands at two places gives two squares, which only their names tell apart.
        by_name = {square.name: square for square in before.values()} | {s.name: s for s in self.squares if s.marker}
        by_hand = tuple(square for square in self.squares if square.marker is None)
        taken = {square.name for square in by_hand} | {bar.name for bar in self.bars}
        found = []
        for square in squares:
            old = by_name.get(square.name)
            old = old if old is not None and old.marker == square.marker else before.get(square.marker)
            if old is not None:
                square = replace(square, role=old.role, side_m=old.side_m, side_se_m=old.side_se_m)
            while square.name in taken:
                square = replace(square, name=f"{square.name} (found)")
            taken.add(square.name)
            found.append(square)
        return replace(self, squares=(*found, *by_hand))

    def report(self, up_src: Float64 | None = None) -> ScaleReport:
        """The scale all control lengths fit best, tested on the others.

        Args:
            up_src: (3,) up direction in the source; None leaves lying and standing bars apart unknown.
        """
        source: ScaleSource = "marker" if any(square.role == "control" for square in self.squares) else "bars"
        lengths: list[KnownLength] = [*self.squares, *(bar.as_known_length() for bar in self.bars)]
        report = scale_from_bars(lengths, up_src=up_src, source=source)
        controls = [square for square in self.squares if square.role == "control"]
        views = [square.n_views for square in controls if square.n_views is not None]
        report = replace(report, n_views=min(views) if views else None)
        doubt = _doubt(list(self), report)
        return report if doubt is None else replace(report, verdict=doubt)


def _doubt(lengths: Sequence[ScaleBar | MarkerSquare], report: ScaleReport) -> ScaleVerdict | None:
    """What the lengths alone do not tell: how the markers that set the scale were seen. None where that is in order."""
    if report.estimate is None:
        return None
    controls = [each for each in lengths if isinstance(each, MarkerSquare) and each.role == "control"]
    bent = [square for square in controls if square.is_uneven]
    if bent:
        return _bent(max(bent, key=lambda square: square.unevenness))
    # What the lengths say against each other weighs more.
    if report.verdict.level != "good" and report.verdict.code != "unchecked":
        return None
    said = (
        f"The scale is known to ±{100 * (report.estimate.standard_error or 0) / report.estimate.metres_per_unit:.2f} %"
    )
    found = [square.marker for square in controls if square.marker is not None]
    if len(set(found)) < len(found):
        return ScaleVerdict(
            "caution",
            "twice",
            f"{said}, but one marker number stands at two places.",
            "Use each marker number once in a plot.",
        )
    # One length that is known better, and agrees, is a test of the others.
    if report.n_views is not None and all(map(_is_little_seen, lengths)):
        return ScaleVerdict(
            "caution",
            "few_views",
            f"{said}, by markers seen in {report.n_views} photos only.",
            "Take more photos of it, from all sides, or mark another known length to test it.",
        )
    return None


def _is_little_seen(length: ScaleBar | MarkerSquare) -> bool:
    return isinstance(length, MarkerSquare) and length.n_views is not None and length.n_views < WELL_SEEN


def _bent(square: MarkerSquare) -> ScaleVerdict:
    return ScaleVerdict(
        "caution",
        "bent",
        f"{square.name} is not a flat square: its sides and diagonals differ by {100 * square.unevenness:.1f} %.",
        "Check its corners and their order; a marker bent round a trunk, or a stretched reconstruction, looks so too.",
    )


def _put(lengths: tuple[Any, ...], length: Any) -> tuple[Any, ...]:
    """In the place of the one of the same name, or at the end."""
    if any(other.name == length.name for other in lengths):
        return tuple(length if other.name == length.name else other for other in lengths)
    return (*lengths, length)
