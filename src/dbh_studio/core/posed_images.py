"""Photos whose camera and place are known, and whether they belong to a given cloud.

Frame `source` is that of the reconstruction file. Where the cloud lies in another one and the file says how they relate
(a georeferenced export), `PosedImages.cloud_from_cameras` brings `source` to the cloud's frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float64, Int64, UInt8, as_points, readonly
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.transforms import Similarity


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One photo.

    Attributes:
        name: As the reconstruction calls it, with ``/`` between folders.
        camera: Its lens and size.
        cam_from_source: Rigid: takes source coordinates to the camera's frame; its scale is 1.
        path: Where the file is; None where it has not been found yet.
        order: Its place in the order of capture, as well as it is known: by time, else by name.
        time_s: When it was taken, seconds since 1970 or since the first one; None where the file does not say.
    """

    name: str
    camera: CameraModel
    cam_from_source: Similarity
    path: str | None = None
    order: int = 0
    time_s: float | None = None

    def __post_init__(self) -> None:
        if abs(self.cam_from_source.scale - 1.0) > 1e-9:
            raise ValueError(f"cam_from_source has scale {self.cam_from_source.scale} but a pose has none")
        if self.path is not None:
            object.__setattr__(self, "path", str(self.path))

    @cached_property
    def centre_src(self) -> Float64:
        """(3,) the camera's centre, source coordinates."""
        centre: Float64 = readonly(self.cam_from_source.inverse().translation)
        return centre

    def project(self, points_src: ArrayLike) -> tuple[Float64, Bool]:
        """(N, 2) pixels of (N, 3) points and (N,) whether they are in view; see `CameraModel.project`.

        Visible means inside the image, not that nothing stands in front.
        """
        points = as_points(points_src, name="points_src").astype(np.float64)
        # From the centre first: coordinates of a survey (4 500 000) would lose digits in the product.
        return self.camera.project((points - self.centre_src) @ self.cam_from_source.rotation.T)

    def ray(self, uv_px: ArrayLike) -> tuple[Float64, Float64]:
        """(3,) origin and (N, 3) unit directions in source coordinates, for (N, 2) pixels; NaN where there is none."""
        return self.centre_src, self.camera.rays(uv_px) @ self.cam_from_source.rotation

    def moved(self, target_from_source: Similarity) -> PosedImage:
        """The same photo in another frame."""
        rotation = self.cam_from_source.rotation @ target_from_source.rotation.T
        centre = target_from_source.apply(self.centre_src[None])[0]
        return replace(self, cam_from_source=Similarity(rotation, -(rotation @ centre)))


@dataclass(frozen=True, eq=False)
class PosedImages:
    """The photos of a plot, as one reconstruction knows them.

    Attributes:
        images: In the order of capture.
        sparse_points_src: (M, 3) float64 points the reconstruction is made of, or None.
        sparse_rgb: (M, 3) uint8 their colours, or None.
        source_format: ``colmap``, ``metashape``, ``opensfm`` or ``table``.
        notes: What the person should know: what was skipped or assumed.
        cloud_from_cameras: Brings `source` to the frame of the cloud made with it; None where the file does not say.
        reprojection_error_px: The mean reprojection error the file states; None where it states none.
    """

    images: tuple[PosedImage, ...]
    sparse_points_src: Float64 | None = None
    sparse_rgb: UInt8 | None = None
    source_format: str = ""
    notes: tuple[str, ...] = ()
    cloud_from_cameras: Similarity | None = None
    reprojection_error_px: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "images", tuple(self.images))
        names = {image.name for image in self.images}
        if len(names) != len(self.images):
            raise ValueError("two images have the same name")
        if self.sparse_points_src is not None:
            points = as_points(self.sparse_points_src, name="sparse_points_src").astype(np.float64, copy=False)
            object.__setattr__(self, "sparse_points_src", readonly(points))
            if self.sparse_rgb is not None:
                if self.sparse_rgb.shape != points.shape:
                    raise ValueError(f"sparse_rgb has shape {self.sparse_rgb.shape} but {points.shape} is needed")
                object.__setattr__(self, "sparse_rgb", readonly(np.asarray(self.sparse_rgb, np.uint8)))

    def __len__(self) -> int:
        return len(self.images)

    def __iter__(self) -> Iterator[PosedImage]:
        return iter(self.images)

    def by_name(self, name: str) -> PosedImage:
        """The image of this name.

        Raises:
            KeyError: There is none.
        """
        return self._by_name[name]

    @cached_property
    def _by_name(self) -> dict[str, PosedImage]:
        return {image.name: image for image in self.images}

    @cached_property
    def centres_src(self) -> Float64:
        """(K, 3) camera centres in the order of capture."""
        centres = np.array([image.centre_src for image in self.images], np.float64).reshape(-1, 3)
        return readonly(centres)

    def moved(self, target_from_source: Similarity) -> PosedImages:
        """All images and points in another frame, such as that of the cloud."""
        points: Float64 | None = None
        if self.sparse_points_src is not None:
            points = target_from_source.apply(self.sparse_points_src).astype(np.float64, copy=False)
        onward = None if self.cloud_from_cameras is None else self.cloud_from_cameras @ target_from_source.inverse()
        images = tuple(image.moved(target_from_source) for image in self.images)
        return replace(self, images=images, sparse_points_src=points, cloud_from_cameras=onward)

    def in_cloud_frame(self) -> PosedImages:
        """The images in the frame of the cloud, where the file says how to get there; else unchanged."""
        return self if self.cloud_from_cameras is None else self.moved(self.cloud_from_cameras)


FitStatus = Literal["fits", "moved", "unclear"]


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Whether cloud and photos lie in one frame.

    Attributes:
        status: ``fits``; ``moved``: they do not; ``unclear``: they may, but what is known does not settle it.
        message: What was found, in plain words.
        remedy: What to do; empty where they fit.
        cloud_from_source: What brings the photos to the cloud: the identity, or the file's `cloud_from_cameras`,
            whichever fits better; None where neither does.
        share_in_view: Share of the cloud's points that some photo has in view.
        sparse_distance: How far the sparse points lie from the cloud, in units of the sample's own spacing (that of
            the nearest third); None without sparse points.
        share_cameras_inside: Share of the photos taken inside the cloud's bounding box, inflated by half its diagonal.
    """

    status: FitStatus
    message: str
    remedy: str
    cloud_from_source: Similarity | None = None
    share_in_view: float = 0.0
    sparse_distance: float | None = None
    share_cameras_inside: float = 0.0


_N_CLOUD, _N_SPARSE, _N_IMAGES, _N_SEEN, _MIN_SPARSE = 100_000, 2_000, 200, 2_000, 30
_ON_CLOUD, _BESIDE_CLOUD, _MAX_SHIFT, _CLEARLY_BETTER = 3.0, 10.0, 1.0, 0.08
_REMEDY = (
    "Export the cloud and the cameras from the same project in the same coordinate system, without moving, scaling or "
    "turning either afterwards."
)


def fit_check(cloud_points_sample: ArrayLike, posed: PosedImages) -> FrameFit:
    """Whether the photos belong to the cloud as they are.

    Both the file's own frame and, where the file gives one, its `cloud_from_cameras` are tried. Sparse points decide
    where there are some: they lie on the surfaces the cloud shows. Without them, most cameras must stand in or near the
    cloud and see most of it, and even then the answer is only ``unclear``.

    Args:
        cloud_points_sample: (N, 3) points of the cloud, spread over all of it, absolute source coordinates; about
            100 000, more are thinned out.
        posed: The photos.
    """
    cloud = as_points(cloud_points_sample, name="cloud_points_sample").astype(np.float64)
    cloud = _thinned(cloud[np.isfinite(cloud).all(axis=1)], _N_CLOUD)
    if len(cloud) < 10 or not len(posed):
        missing = "no image has a pose" if not len(posed) else "the cloud has too few points"
        return FrameFit("unclear", f"It cannot be told whether photos and cloud fit: {missing}.", _REMEDY)
    fits = [_fit_as_is(cloud, posed, Similarity.identity())]
    if posed.cloud_from_cameras is not None:
        fits.insert(0, _fit_as_is(cloud, posed.in_cloud_frame(), posed.cloud_from_cameras))
    return min(fits, key=_badness)


def _badness(fit: FrameFit) -> tuple[int, float, float]:
    order = {"fits": 0, "unclear": 1, "moved": 2}[fit.status]
    distance = np.inf if fit.sparse_distance is None else fit.sparse_distance
    return order, distance, -(fit.share_in_view + fit.share_cameras_inside)


def _fit_as_is(cloud: Float64, posed: PosedImages, cloud_from_source: Similarity) -> FrameFit:
    """Compare in the cloud's frame, where `posed` is given."""
    low, high = np.percentile(cloud, [0.5, 99.5], axis=0)
    margin = 0.5 * float(np.linalg.norm(high - low))
    centres = posed.centres_src
    inside = float(((centres >= low - margin) & (centres <= high + margin)).all(axis=1).mean())
    seen = _share_in_view(cloud, posed)
    distance, shift = _compare_points(cloud, posed.sparse_points_src)
    status, message = _judge(seen, inside, distance, shift)
    remedy = "" if status == "fits" else _REMEDY
    chosen = None if status == "moved" else cloud_from_source
    return FrameFit(status, message, remedy, chosen, seen, distance, inside)


def _judge(seen: float, inside: float, distance: float | None, shift: float) -> tuple[FitStatus, str]:
    views = f"{seen:.0%} of the cloud lies in the photos' view and {inside:.0%} of the photos were taken in or near it"
    if distance is not None:
        if distance > _BESIDE_CLOUD or seen <= 0.2:
            return "moved", (
                "The photos do not fit the cloud: their own 3D points lie beside it, by "
                f"{distance:.0f} times the distance between its neighbouring points; {views}."
            )
        if shift > _MAX_SHIFT:
            return "moved", (
                "The photos almost fit the cloud, but their own 3D points would lie on it better after a small shift "
                f"or change of scale; {views}."
            )
        if distance <= _ON_CLOUD:
            return "fits", f"The photos fit the cloud: their own 3D points lie on it, {views}."
        return "unclear", f"The photos may not fit the cloud: their own 3D points lie near it but not on it; {views}."
    if inside < 0.2 or seen < 0.2:
        return "moved", f"The photos do not fit the cloud: {views}."
    if inside >= 0.8 and seen >= 0.6:
        return "unclear", (
            f"The photos seem to fit the cloud ({views}), but the file has no 3D points to confirm it: check that the "
            "outlines of stems in the photos lie on the stems."
        )
    return "unclear", f"The photos may not fit the cloud: {views}."


def _share_in_view(cloud: Float64, posed: PosedImages) -> float:
    sample = _thinned(cloud, _N_SEEN)
    is_seen = np.zeros(len(sample), bool)
    for index in _spread(len(posed), _N_IMAGES):
        is_seen[~is_seen] = posed.images[index].project(sample[~is_seen])[1]
        if is_seen.all():
            break
    return float(is_seen.mean())


def _compare_points(cloud: Float64, sparse: Float64 | None) -> tuple[float | None, float]:
    """How far the sparse points lie from the cloud, and how far moving them onto it moves them; in its spacing.

    A plot cut out of a larger reconstruction leaves many sparse points outside, and some stand where the cloud was
    cleaned, so the nearest third of those inside the cloud's box tells.
    """
    if sparse is None:
        return None, 0.0
    tree = cKDTree(cloud)
    spacing = float(np.median(tree.query(_thinned(cloud, _N_SPARSE), k=2)[0][:, 1]))
    is_inside = ((sparse >= cloud.min(axis=0) - spacing) & (sparse <= cloud.max(axis=0) + spacing)).all(axis=1)
    points = _thinned(sparse[is_inside if is_inside.sum() >= _MIN_SPARSE else slice(None)], _N_SPARSE)
    points = points[np.isfinite(points).all(axis=1)]
    if not spacing > 0.0 or len(points) < _MIN_SPARSE:
        return None, 0.0
    first = np.sort(tree.query(points)[0])[len(points) // 3]
    if first > _BESIDE_CLOUD * spacing:
        return float(first) / spacing, np.inf
    return float(first) / spacing, _better_shift(tree, points, spacing)


def _better_shift(tree: cKDTree, points: Float64, spacing: float) -> float:
    """How far the points lie from where they would lie on the cloud best, in its spacing; 0 where they lie best as is.

    A search by ever smaller steps along the axes and in scale. The cost is a mean logarithm, so that points on stems
    count although the ground, along which everything slides, has most of them.
    """
    middle = points.mean(axis=0)
    radius = max(float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean())), spacing)

    def cost(change: Float64) -> float:
        moved = middle + (points - middle) * (1.0 + change[3] * spacing / radius) + change[:3] * spacing
        return float(np.log(tree.query(moved)[0] / spacing + 0.1).mean())

    best, step = np.zeros(4), 8.0
    at_start = lowest = cost(best)
    while step >= 0.5:
        trials = [best + step * direction for direction in np.vstack([np.eye(4), -np.eye(4)])]
        costs = [cost(trial) for trial in trials]
        if min(costs) < lowest - 1e-3:
            best, lowest = trials[int(np.argmin(costs))], min(costs)
        else:
            step *= 0.5
    return float(np.linalg.norm(best)) if at_start - lowest >= _CLEARLY_BETTER else 0.0


def _spread(n: int, at_most: int) -> Int64:
    return np.unique(np.linspace(0, n - 1, min(n, at_most)).astype(np.int64))


def _thinned(points: Float64, at_most: int) -> Float64:
    return points if len(points) <= at_most else points[_spread(len(points), at_most)]
