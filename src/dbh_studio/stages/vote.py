"""Masks of photos to labels of points: every photo is asked of every point near it that it sees.

    voters = make_voters(points, posed, ground=ground)
    votes = vote(voters, posed, masks_of)
    candidates = votes.carried_back(voters.thinned, voters.rows, len(points)).is_trunk(settings)
    segment_trunks(points, ground, candidates=candidates)

or all of it by `trunk_candidates`. Points and photos are in one frame, metres, +z up.

One point per small cube votes for all of its cube. Only cubes between ground and trunk top vote, and a photo is only
asked of those within `max_distance_m`, so that the work follows what can be trunk and not the size of the cloud.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from dbh_studio.core.arrays import Float, Float32, Float64, Int64, as_points
from dbh_studio.core.depth_map import DepthMap
from dbh_studio.core.ground import GroundModel
from dbh_studio.core.mask_views import MaskView
from dbh_studio.core.neighbours import point_spacing, surface_normals
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.votes import PhotoVotes, VoteCounter, Votes
from dbh_studio.core.voxels import Thinned, thin
from dbh_studio.settings import TrunkSettings, VoteSettings

MasksOf: TypeAlias = Callable[[PosedImage], "MaskView | None"]
"""The masks of a photo, None where it has none. Called from several threads where `map_photos` uses them."""

MapPhotos: TypeAlias = Callable[
    [Callable[[PosedImage], "PhotoVotes | None"], Sequence[PosedImage]], "Iterator[PhotoVotes | None]"
]
"""As the built-in `map`; `app.threads.map_in_threads` shares the photos between two threads."""

_CHUNK = 1 << 20
_PIECE = 1 << 16
_SPACING_SAMPLE = 300_000


@dataclass(frozen=True, eq=False)
class Points:
    """Thinned points in order of x, so that those near a camera are one stretch.

    Attributes:
        xyz: (M, 3) float32.
        spacing_m: Typical distance between neighbours.
        envelope_x: (M,) ascending; no less than x, and no more than a cube's edge above it.
        edge_m: Edge of the cubes.
    """

    xyz: Float32
    spacing_m: float
    envelope_x: Float32
    edge_m: float

    @classmethod
    def of(cls, thinned: Thinned) -> Points:
        """Of thinned points, which `core.voxels.thin` leaves in order of their cubes' x."""
        xyz = thinned.points
        envelope = np.maximum.accumulate(xyz[:, 0]) if len(xyz) else np.empty(0, np.float32)
        spacing = point_spacing(_middle_stretch(xyz))
        return cls(xyz, max(spacing, thinned.edge_m) if spacing > 0 else thinned.edge_m, envelope, thinned.edge_m)

    def near(self, centre: Float64, distance_m: float) -> tuple[Int64, Float32, Float32]:
        """(K,) ascending rows within a distance, (K, 3) their offsets from `centre`, (K,) their distances."""
        parts = list(self.pieces_near(centre, distance_m))
        if not parts:
            return np.empty(0, np.int64), np.empty((0, 3), np.float32), np.empty(0, np.float32)
        rows, offset, distance = (np.concatenate(each) for each in zip(*parts, strict=True))
        return rows, offset, distance

    def pieces_near(self, centre: Float64, distance_m: float) -> Iterator[tuple[Int64, Float32, Float32]]:
        """As `near`, in pieces that stay in the processor's cache from one step of the arithmetic to the next."""
        first = int(np.searchsorted(self.envelope_x, centre[0] - distance_m, side="left"))
        last = int(np.searchsorted(self.envelope_x, centre[0] + distance_m + 2.0 * self.edge_m, side="right"))
        middle = centre.astype(np.float32)
        for start in range(first, last, _PIECE):
            offset = self.xyz[start : min(start + _PIECE, last)] - middle
            distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
            inside = distance <= distance_m
            if inside.all():
                yield np.arange(start, start + len(offset)), offset, distance
            elif inside.any():
                rows = np.flatnonzero(inside)
                yield rows + start, offset[rows], distance[rows]


@dataclass(frozen=True, eq=False)
class Voters:
    """Who votes, and what hides it.

    Attributes:
        rows: (K,) points of the cloud that have a vote.
        thinned: These, thinned; its cubes are the voters.
        points: The cubes' points.
        occluders: Points of the whole cloud near the cameras.
        normals: (M, 3) float32 of the cubes' points, NaN where unknown; None where no weight asks for them.
        n_points: Of the cloud.
    """

    rows: Int64
    thinned: Thinned
    points: Points
    occluders: Points
    normals: Float32 | None
    n_points: int

    def __len__(self) -> int:
        return len(self.points.xyz)


def make_voters(
    points_world: Float,
    posed: PosedImages,
    *,
    ground: GroundModel | None = None,
    settings: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    trunks: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
    progress: Progress = ignore_progress,
) -> Voters:
    """Choose and thin the points that vote.

    Args:
        points_world: (N, 3) points, metres, +z up.
        posed: The photos, in the same frame.
        ground: To leave out what is below the ground clearance or above the trunk top; None lets all heights vote.
        settings: Resolutions, and the farthest point a photo is asked of.
        trunks: The heights.
        progress: Called in between.

    Raises:
        ValueError: Wrong shape.
        CancelledError: From `progress`.
    """
    points = as_points(points_world, name="points_world")
    near = _near_cameras(points, posed, settings.max_distance_m)
    progress(0.1, "Choosing the points that vote")
    rows = near if ground is None else _between_heights(points, near, ground, trunks, subprogress(progress, 0.1, 0.4))
    thinned = thin(points[rows].astype(np.float32, copy=False), settings.thinning_m)
    progress(0.6, "Choosing the points that vote")
    voting = Points.of(thinned)
    if not settings.occlusion:
        occluders = Points.of(thin(np.empty((0, 3), np.float32), settings.occluder_m))
    else:
        occluders = Points.of(thin(points[near].astype(np.float32, copy=False), settings.occluder_m))
    normals = None
    if settings.weighting == "incidence":
        radius = max(trunks.normal_radius_m, 3.0 * voting.spacing_m)
        rest = subprogress(progress, 0.7, 1.0)
        normals = surface_normals(voting.xyz, radius=radius, progress=rest)[0].astype(np.float32)
    return Voters(rows, thinned, voting, occluders, normals, len(points))


def vote(
    voters: Voters,
    posed: PosedImages,
    masks_of: MasksOf,
    *,
    settings: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    counter: VoteCounter | None = None,
    on_photo: Callable[[VoteCounter, PhotoVotes], None] | None = None,
    map_photos: MapPhotos = map,
    progress: Progress = ignore_progress,
) -> Votes:
    """Ask every photo.

    Args:
        voters: From `make_voters` with the same settings.
        posed: The photos, in the frame of the points.
        masks_of: Their masks.
        settings: What hides a point, and weights.
        counter: Photos it has counted are not asked again: from `new_counter` or `VoteCounter.from_state`.
        on_photo: Called after each photo, in order: to save the counter, or to gather instances.
        map_photos: How photos are shared between threads.
        progress: Called after each photo.

    Returns:
        (M,) votes of the voters; `Votes.carried_back` gives those of all points.

    Raises:
        ValueError: The counter is for other voters.
        CancelledError: From `progress`; the counter holds all photos counted until then.
    """
    counter = new_counter(voters, posed, settings) if counter is None else counter
    if len(counter) != len(voters):
        raise ValueError(f"the counter is for {len(counter)} voters but there are {len(voters)}")
    waiting = [photo for photo in posed if photo.name not in counter.done]

    def ask(photo: PosedImage) -> PhotoVotes | None:
        view = masks_of(photo)
        return None if view is None else photo_votes(voters, photo, view, settings)

    n_done = len(posed) - len(waiting)
    for photo, answer in zip(waiting, map_photos(ask, waiting), strict=True):
        if answer is None:
            counter.skip(photo.name)
        else:
            counter.add(answer)
            if on_photo is not None:
                on_photo(counter, answer)
        n_done += 1
        progress(n_done / len(posed), f"Photo {n_done} of {len(posed)}")
    return counter.votes()


def photo_votes(voters: Voters, photo: PosedImage, view: MaskView, settings: VoteSettings) -> PhotoVotes:
    """What one photo says of the voters it sees."""
    centre = photo.centre_src
    depth = None
    if settings.occlusion:
        _, around, _ = voters.occluders.near(centre, settings.max_distance_m)
        depth = DepthMap.of(around, spacing=voters.occluders.spacing_m, size=settings.depth_size_px)
    turn = photo.cam_from_source.rotation.astype(np.float32)
    seen, found, weighed = [np.empty(0, np.int32)], [np.empty(0, np.int32)], [np.empty(0, np.float32)]
    for rows, offset, distance in voters.points.pieces_near(centre, settings.max_distance_m):
        if depth is not None:
            hidden = depth.is_hidden(offset, tolerance=settings.tolerance_m, tolerance_share=settings.tolerance_share)
            in_sight = np.flatnonzero(~hidden)
            rows, offset, distance = rows[in_sight], offset[in_sight], distance[in_sight]
        labels, is_known = view.look_up(offset @ turn.T)
        if not is_known.all():
            known = np.flatnonzero(is_known)
            rows, offset, distance, labels = rows[known], offset[known], distance[known], labels[known]
        seen.append(rows.astype(np.int32))
        found.append(labels)
        weights = _weights(voters, rows, offset, distance, settings)
        if weights is not None:
            weighed.append(weights)
    joined = None if settings.weighting == "none" else np.concatenate(weighed)
    return PhotoVotes(photo.name, np.concatenate(seen), np.concatenate(found), joined, view.has_instances)


def new_counter(voters: Voters, posed: PosedImages, settings: VoteSettings) -> VoteCounter:
    """A counter with nothing in it. Its key tells these voters, poses and settings from all others.

    The masks are not part of the key: whoever changes one starts anew.
    """
    digest = hashlib.sha256()
    # What decides afterwards is left out: another threshold needs no new votes.
    after = {"rule", "min_share", "min_count", "tell_apart", "second_look"}
    digest.update(settings.model_dump_json(exclude=after).encode())
    digest.update(np.ascontiguousarray(voters.points.xyz).data)
    for photo in posed:
        camera = photo.camera
        digest.update(repr((photo.name, camera.kind, camera.width_px, camera.height_px, camera.params)).encode())
        digest.update(np.concatenate([photo.centre_src, photo.cam_from_source.rotation.ravel()]).tobytes())
    return VoteCounter(len(voters), digest.hexdigest())


def trunk_candidates(
    points_world: Float,
    posed: PosedImages,
    masks_of: MasksOf,
    *,
    ground: GroundModel | None = None,
    settings: VoteSettings = VoteSettings(),  # noqa: B008 - frozen
    trunks: TrunkSettings = TrunkSettings(),  # noqa: B008 - frozen
    map_photos: MapPhotos = map,
    progress: Progress = ignore_progress,
) -> Votes:
    """Votes of all (N,) points of a cloud; `Votes.is_trunk` makes them the candidates of `segment_trunks`.

    Arguments and errors as in `make_voters` and `vote`.
    """
    voters = make_voters(
        points_world, posed, ground=ground, settings=settings, trunks=trunks, progress=subprogress(progress, 0.0, 0.2)
    )
    votes = vote(
        voters, posed, masks_of, settings=settings, map_photos=map_photos, progress=subprogress(progress, 0.2, 1.0)
    )
    return votes.carried_back(voters.thinned, voters.rows, voters.n_points)


def _weights(voters: Voters, rows: Any, offset: Float32, distance: Float32, settings: VoteSettings) -> Float32 | None:
    """(M,) weight of each vote; None where all are 1."""
    if settings.weighting == "none":
        return None
    # A pixel's patch on a surface grows with the square of the distance.
    weights = (settings.weight_distance_m / np.maximum(distance, settings.weight_distance_m)) ** 2
    if settings.weighting == "incidence" and voters.normals is not None:
        facing = np.abs(np.einsum("ij,ij->i", voters.normals[rows], offset)) / np.maximum(distance, 1e-6)
        weights = weights * np.nan_to_num(np.clip(facing, 0.05, 1.0), nan=0.5)
    return weights.astype(np.float32)


def _near_cameras(points: Float, posed: PosedImages, distance_m: float) -> Int64:
    """Rows of the finite points in the box around the cameras that the distance gives."""
    if not len(posed):
        return np.empty(0, np.int64)
    lower, upper = posed.centres_src.min(axis=0) - distance_m, posed.centres_src.max(axis=0) + distance_m
    found = []
    for start in range(0, len(points), _CHUNK):
        part = points[start : start + _CHUNK]
        inside = np.ones(len(part), bool)
        for axis in range(3):
            # A comparison with NaN is False, so points without a place drop out too.
            inside &= (part[:, axis] >= lower[axis]) & (part[:, axis] <= upper[axis])
        found.append(np.flatnonzero(inside) + start)
    return np.concatenate([np.empty(0, np.int64), *found])


def _between_heights(
    points: Float, rows: Int64, ground: GroundModel, trunks: TrunkSettings, progress: Progress
) -> Int64:
    """Of the rows, those between ground clearance and trunk top."""
    found = []
    for start in range(0, len(rows), _CHUNK):
        progress(start / len(rows), "Heights above ground")
        part = rows[start : start + _CHUNK]
        height = ground.height_above(points[part])
        found.append(part[(height >= trunks.ground_clearance_m) & (height < trunks.trunk_top_m)])
    return np.concatenate([np.empty(0, np.int64), *found])


def _middle_stretch(xyz: Float32) -> Float32:
    """A stretch of the points from the middle of the plot: all are too many for a tree of neighbours."""
    if len(xyz) <= _SPACING_SAMPLE:
        return xyz
    first = (len(xyz) - _SPACING_SAMPLE) // 2
    return xyz[first : first + _SPACING_SAMPLE]
