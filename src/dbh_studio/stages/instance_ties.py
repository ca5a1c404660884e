"""Trunks put right by what the masks tell apart: one that holds two stems is cut, fragments of one stem are joined.

Masks alone decide neither. Two parts of a trunk come apart where several photos have a mask for each, and their
sections are not one ring; two trunks become one where the masks on both belong together, and both lie on one ring or
one axis. Every point stays in a trunk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float, Float32, Float64, Int32, Int64, readonly
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.instances import InstanceTies
from dbh_studio.core.neighbours import N_WORKERS
from dbh_studio.core.rings import Rings, find_rings
from dbh_studio.settings import TrunkSettings
from dbh_studio.stages.stem_detection import LAYER_M, Stem
from dbh_studio.stages.vote import Voters

Sections = Literal["one", "two", "unclear", "stacked"]

# A part of a trunk that the masks set apart is at least so much of what they say of it, and so many voters.
_LEAST_PART, _LEAST_VOTERS = 0.15, 12
# Photos that see two masks where geometry sees two rings, and where it cannot tell.
_SURE_PHOTOS, _UNSURE_PHOTOS = 2, 4
# Two stems stand at least so far apart.
_LEAST_APART_M = 0.06
# Shares of a layer's points on its ring, and of the layers that must agree.
_ON_ONE, _ON_EACH, _LAYERS = 0.75, 0.6, 0.5
_MAX_RING_POINTS = 128
_LEAST_ON_LAYER = 10
# How far a fragment may lie beside the axis of the other: radii, metres, and metres per metre between them.
_BESIDE_RADII, _BESIDE_M, _BESIDE_SLOPE = 0.6, 0.04, 0.08
# Fragments farther apart than this along the stem are not joined.
_LONGEST_GAP_M = 2.0


@dataclass(frozen=True, eq=False)
class TiedTrunks:
    """Trunks after the masks were heard.

    Attributes:
        point_sets: As those given, cut and joined: sorted indices, disjoint, the same points in all.
        stems: What the detector saw of each, or None.
        doubts: Number of a trunk -> what a person should look at.
        n_split: Trunks that were cut.
        n_joined: Fragments that went to another trunk.
    """

    point_sets: tuple[Int32, ...]
    stems: tuple[Stem | None, ...]
    doubts: dict[int, str]
    n_split: int = 0
    n_joined: int = 0


@dataclass(frozen=True, eq=False)
class _Part:
    """A trunk or a part of one.

    Attributes: points: rows of the cloud. voters: rows of the voters. tie: number of the ties' trunk that most of its
    tied voters belong to, 0 where none. stem: what the detector saw. doubt: what a person should look at.
    """

    points: Int32
    voters: Int64
    tie: int
    stem: Stem | None
    doubt: str = ""


def tie_trunks(
    points_world: Float,
    ground: GroundModel,
    voters: Voters,
    ties: InstanceTies,
    point_sets: Sequence[Int32],
    stems: Sequence[Stem | None],
    *,
    settings: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
) -> TiedTrunks:
    """Cut trunks that hold two stems, and join fragments of one.

    Args:
        points_world: (N, 3) points, metres, +z up.
        ground: Of the plot.
        voters: Who voted.
        ties: What the masks of all photos tell apart, of these voters.
        point_sets: Per trunk the sorted indices of its points.
        stems: What the detector saw of each.
        settings: Diameters.
    """
    if not ties.n_trunks:
        return TiedTrunks(tuple(point_sets), tuple(stems), {})
    hearing = _Hearing(points_world, ground, voters, ties, settings)
    parts: list[_Part] = []
    n_split = 0
    for points, stem in zip(point_sets, stems, strict=True):
        cut = hearing.cut(points, stem)
        n_split += len(cut) > 1
        parts += cut
    joined = hearing.joined(parts)
    doubts = {number: part.doubt for number, part in enumerate(joined) if part.doubt}
    return TiedTrunks(
        tuple(readonly(part.points) for part in joined),
        tuple(part.stem for part in joined),
        doubts,
        n_split,
        len(parts) - len(joined),
    )


class _Hearing:
    """Masks and geometry of one plot, heard about its trunks one by one."""

    def __init__(
        self, points: Float, ground: GroundModel, voters: Voters, ties: InstanceTies, settings: TrunkSettings
    ) -> None:
        self.points, self.ground, self.ties, self.settings = points, ground, ties, settings
        self.rows = voters.rows
        self.voter_of_row = voters.thinned.labels_of_points(np.arange(len(voters), dtype=np.int32))
        self.xyz = voters.points.xyz
        self.spacing_m = voters.points.spacing_m

    # ---- cutting

    def cut(self, points: Int32, stem: Stem | None) -> list[_Part]:
        """The trunk in as many parts as it has stems; one where nothing speaks for more."""
        voter = self._voter_of(points)
        voters = np.unique(voter[voter >= 0])
        tie = self.ties.trunk_of_voter[voters]
        names, counts = np.unique(tie[tie > 0], return_counts=True)
        whole = _Part(points, voters, int(names[counts.argmax()]) if len(names) else 0, stem)
        large = names[(counts >= _LEAST_PART * counts.sum()) & (counts >= _LEAST_VOTERS)]
        if len(large) < 2:
            return [whole]
        levelled = self._levelled(voters)
        group, doubt = self._groups(large, voters, tie, levelled)
        if group.max() == 0:
            return [_Part(points, voters, whole.tie, stem, doubt)]
        number = np.full(len(voters), -1, np.int64)
        for name, belongs in zip(large, group, strict=True):
            number[tie == name] = belongs
        known = number >= 0
        nearest = cKDTree(levelled[known]).query(levelled[~known], workers=N_WORKERS)[1]
        number[~known] = number[known][nearest]
        number = self._by_rings(number, levelled)
        return self._in_parts(points, voters, number, levelled, stem)

    def _groups(self, names: Int32, voters: Int64, tie: Int32, levelled: Float32) -> tuple[Int64, str]:
        """(K,) which stem each of the ties' trunks is, and what is to be looked at."""
        same, doubt = [], ""
        for i, j in combinations(range(len(names)), 2):
            first, second = tie == names[i], tie == names[j]
            n_apart, n_together = self.ties.apart_and_together(voters[first], voters[second])
            sections = self.sections(levelled[first], levelled[second])
            enough = _SURE_PHOTOS if sections == "two" else _UNSURE_PHOTOS
            apart = n_apart >= enough and n_apart > (1 if sections == "two" else 2) * n_together
            if not apart or sections in ("one", "stacked"):
                same.append((i, j))
            if apart and sections == "one":
                doubt = f"{n_apart} photos have two masks here, side by side on what looks like one stem"
        pairs = np.array(same, np.int64).reshape(-1, 2)
        graph = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(names), len(names)))
        return connected_components(graph, directed=False)[1].astype(np.int64), doubt

    def _by_rings(self, number: Int64, levelled: Float32) -> Int64:
        """(K,) the parts, drawn sharply: where all have a ring, the nearest surface has the point."""
        low = float(levelled[:, 2].min())
        layers = np.arange(low, float(levelled[:, 2].max()) + LAYER_M, LAYER_M)
        layer = np.minimum(((levelled[:, 2] - low) / LAYER_M).astype(np.int64), len(layers) - 1)
        gaps = []
        for k in range(int(number.max()) + 1):
            rings = self._rings(levelled[number == k], layers)
            good = rings.enough & (rings.arc_deg >= 75.0) & (rings.share >= _ON_EACH)
            xy, radius = rings.xy[layer], np.where(good, rings.radius, np.nan)[layer]
            gaps.append(np.abs(np.hypot(*(levelled[:, :2] - xy).T) - radius))
        gap = np.stack(gaps, axis=1)
        clear = np.isfinite(gap).all(axis=1)
        sharp = number.copy()
        sharp[clear] = gap[clear].argmin(axis=1)
        # Rings that would leave a part with next to nothing are no rings of it.
        before, after = (np.bincount(each, minlength=gap.shape[1]) for each in (number, sharp))
        return sharp if (after >= 0.5 * before).all() else number

    def _in_parts(
        self, points: Int32, voters: Int64, number: Int64, levelled: Float32, stem: Stem | None
    ) -> list[_Part]:
        """The trunk's points with the nearest voter's part; what the detector saw goes to the part it lies in."""
        nearest = cKDTree(self.xyz[voters]).query(self.points[points], workers=N_WORKERS)[1]
        of_point = number[nearest]
        home = -1
        if stem is not None:
            axis = stem.axis[0] + levelled[:, 2:3] * stem.axis[1]
            gap = np.abs(np.hypot(*(levelled[:, :2] - axis).T) - stem.radius_m)
            home = int(np.argmin([np.median(gap[number == k]) for k in range(int(number.max()) + 1)]))
        parts = []
        for k in range(int(number.max()) + 1):
            inside, own = points[of_point == k], voters[number == k]
            if len(inside):
                tie = self.ties.trunk_of_voter[own]
                parts.append(_Part(inside, own, int(np.bincount(tie).argmax()), stem if k == home else None))
        return parts

    # ---- joining

    def joined(self, parts: Sequence[_Part]) -> list[_Part]:
        """Parts of one stem together, in the place of the first."""
        by_tie: dict[int, list[int]] = {}
        for index, part in enumerate(parts):
            # Much of it must be tied: a shrub that one mask brushed is no fragment.
            own = self.ties.trunk_of_voter[part.voters]
            if part.tie and np.count_nonzero(own == part.tie) >= 0.5 * len(own):
                by_tie.setdefault(part.tie, []).append(index)
        pairs = [
            pair
            for indices in by_tie.values()
            for pair in combinations(indices, 2)
            if self._is_one_stem(parts[pair[0]], parts[pair[1]])
        ]
        linked = np.array(pairs, np.int64).reshape(-1, 2)
        graph = csr_matrix((np.ones(len(linked)), (linked[:, 0], linked[:, 1])), shape=(len(parts), len(parts)))
        group = connected_components(graph, directed=False)[1]
        together: dict[int, list[_Part]] = {}
        for name, part in zip(group.tolist(), parts, strict=True):
            together.setdefault(name, []).append(part)
        return [_united(each) for each in together.values()]

    def _is_one_stem(self, first: _Part, second: _Part) -> bool:
        n_apart, n_together = self.ties.apart_and_together(first.voters, second.voters)
        if n_apart > n_together:
            return False
        a, b = self._levelled(first.voters), self._levelled(second.voters)
        sections = self.sections(a, b)
        return sections == "one" or (sections == "stacked" and self._on_one_axis(a, b))

    def _on_one_axis(self, first: Float32, second: Float32) -> bool:
        """Whether the axis of the longer one, carried on, meets the other."""
        longer, other = (first, second) if np.ptp(first[:, 2]) >= np.ptp(second[:, 2]) else (second, first)
        centres, radius = self._centres(longer)
        ends, _ = self._centres(other)
        if len(centres) < 4 or not len(ends):
            return False
        height = ends[:, 2]
        gap_m = float(np.maximum(height.min() - centres[:, 2].max(), centres[:, 2].min() - height.max()))
        if gap_m > _LONGEST_GAP_M:
            return False
        slope, foot = np.polyfit(centres[:, 2], centres[:, :2], 1)
        beside = np.hypot(*(ends[:, :2] - (foot + height[:, None] * slope)).T)
        away = np.maximum(np.abs(height - np.clip(height, centres[:, 2].min(), centres[:, 2].max())), 0.0)
        return bool(np.median(beside - _BESIDE_SLOPE * away) <= _BESIDE_RADII * radius + _BESIDE_M)

    # ---- geometry

    def sections(self, first: Float32, second: Float32) -> Sections:
        """Whether the sections of two parts are those of one stem or of two, or one part is above the other.

        Args:
            first: (K, 3) levelled points of the one.
            second: Likewise.
        """
        low = max(float(np.quantile(part[:, 2], 0.02)) for part in (first, second))
        high = min(float(np.quantile(part[:, 2], 0.98)) for part in (first, second))
        if high - low < LAYER_M:
            return "stacked"
        layers = np.arange(low, high, LAYER_M)[: max(int((high - low) / LAYER_M), 1)]
        both = np.concatenate([first, second])
        of_both, of_first, of_second = (self._rings(part, layers) for part in (both, first, second))
        ok = of_first.enough & of_second.enough
        n_layers = int(np.count_nonzero(ok))
        if n_layers == 0:
            return "unclear"
        one = ok & (of_both.share >= _ON_ONE) & (of_both.inside <= 0.35) & (of_both.arc_deg >= 75.0)
        apart = np.hypot(*(of_first.xy - of_second.xy).T)
        each = (of_first.share >= _ON_EACH) & (of_second.share >= _ON_EACH)
        each &= (of_first.arc_deg >= 75.0) & (of_second.arc_deg >= 75.0)
        two = ok & ~one & each & (apart >= 0.8 * np.maximum(of_first.radius, of_second.radius))
        if np.count_nonzero(one) >= _LAYERS * n_layers:
            return "one"
        middles = np.hypot(*(np.median(first[:, :2], axis=0) - np.median(second[:, :2], axis=0)))
        if middles < _LEAST_APART_M:
            return "one"
        return "two" if np.count_nonzero(two) >= _LAYERS * n_layers else "unclear"

    def _rings(self, levelled: Float32, layers: Float64) -> _LayerRings:
        """The best ring of each layer."""
        layer = np.floor((levelled[:, 2] - layers[0]) / LAYER_M).astype(np.int64)
        inside = (layer >= 0) & (layer < len(layers))
        rings = find_rings(
            levelled[inside, :2],
            layer[inside],
            radius_min=0.5e-2 * self.settings.min_diameter_cm,
            radius_max=0.5e-2 * self.settings.max_diameter_cm,
            tolerance=max(0.02, 0.6 * self.spacing_m),
            n_rounds=1,
        )
        return _LayerRings.of(rings, np.bincount(layer[inside], minlength=len(layers)))

    def _centres(self, levelled: Float32) -> tuple[Float64, float]:
        """(L, 3) centres of the rings of every layer that has one, and the typical radius."""
        low, high = float(levelled[:, 2].min()), float(levelled[:, 2].max())
        layers = np.arange(low, max(high, low + 1e-6), LAYER_M)
        rings = self._rings(levelled, layers)
        good = rings.enough & (rings.arc_deg >= 75.0) & (rings.share >= _ON_EACH)
        centres = np.column_stack([rings.xy[good], layers[good] + 0.5 * LAYER_M])
        return centres, float(np.median(rings.radius[good])) if good.any() else float("nan")

    def _levelled(self, voters: Int64) -> Float32:
        """(K, 3) x, y and height above ground."""
        levelled = self.xyz[voters].astype(np.float32)
        levelled[:, 2] = self.ground.height_above(self.xyz[voters])
        return levelled

    def _voter_of(self, points: Int32) -> Int64:
        """(K,) voter of every point, -1 where it has none."""
        if not len(self.rows):
            return np.full(len(points), -1, np.int64)
        at = np.minimum(np.searchsorted(self.rows, points), len(self.rows) - 1)
        return np.where(self.rows[at] == points, self.voter_of_row[at], -1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class _LayerRings:
    """(L,) and (L, 2) of each layer: its best ring, and whether it has points enough to say anything."""

    xy: Float64
    radius: Float64
    share: Float64
    inside: Float64
    arc_deg: Float64
    enough: Bool

    @classmethod
    def of(cls, rings: Rings, counts: Int64) -> _LayerRings:
        n = len(counts)
        xy, radius = np.full((n, 2), np.nan), np.full(n, np.nan)
        share, inside, arc_deg = np.zeros(n), np.zeros(n), np.zeros(n)
        xy[rings.group], radius[rings.group] = rings.xy, rings.radius
        share[rings.group] = rings.n_on / np.maximum(np.minimum(counts[rings.group], _MAX_RING_POINTS), 1)
        inside[rings.group], arc_deg[rings.group] = rings.inside_share, rings.coverage_deg
        return cls(xy, radius, share, inside, arc_deg, np.asarray(counts >= _LEAST_ON_LAYER))


def _united(parts: Sequence[_Part]) -> _Part:
    if len(parts) == 1:
        return parts[0]
    stems = [part.stem for part in parts if part.stem is not None]
    return _Part(
        np.sort(np.concatenate([part.points for part in parts])),
        np.unique(np.concatenate([part.voters for part in parts])),
        parts[0].tie,
        max(stems, key=lambda stem: stem.score) if stems else None,
        next((part.doubt for part in parts if part.doubt), ""),
    )
