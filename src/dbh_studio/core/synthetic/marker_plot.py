"""A walk with a 360° camera round a few markers: the pictures, and the poses structure from motion would believe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dbh_studio.core.arrays import Bool, Float64, UInt8
from dbh_studio.core.camera import CameraModel
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.synthetic.marker_scene import MarkerScene, random_scene, render
from dbh_studio.core.synthetic.picture_flaws import PictureFlaws, random_flaws
from dbh_studio.core.transforms import Similarity

_CAM_FROM_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_TILT_SIGMA_RAD = 0.05


@dataclass(frozen=True, eq=False)
class MarkerPlot:
    """Photos of markers.

    Attributes:
        posed: With the poses believed, in an arbitrary frame and unit.
        pictures: By name.
        metres_per_unit: The truth.
        scene: What was photographed, in metres.
        source_from_world_rotation: (3, 3) how the arbitrary frame is turned.
    """

    posed: PosedImages
    pictures: Mapping[str, UInt8]
    metres_per_unit: float
    scene: MarkerScene
    source_from_world_rotation: Float64

    def read(self, photo: PosedImage) -> UInt8:
        """The picture of a photo."""
        return self.pictures[photo.name]


def world_rays(camera: CameraModel, cam_from_world: Float64) -> Callable[[Float64], Float64]:
    """(N, 2) pixels to (N, 3) directions in the world, for `render`."""

    def rays(uv_px: Float64) -> Float64:
        return camera.rays(uv_px) @ cam_from_world

    return rays


class _WholePicture:
    """The directions of all pixels, computed once for all photos of a camera: that is half the work of a photo."""

    def __init__(self, camera: CameraModel, background_step: int) -> None:
        self._camera = camera
        self._n_pixels = camera.width_px * camera.height_px // background_step**2
        self._uv: Float64 | None = None
        self._rays: Float64 = np.zeros((0, 3), np.float32)

    def turned(self, cam_from_world: Float64) -> Callable[[Float64], Float64]:
        """As `world_rays`."""

        def rays(uv_px: Float64) -> Float64:
            if len(uv_px) != self._n_pixels:
                return self._camera.rays(uv_px) @ cam_from_world
            if self._uv is None or not np.array_equal(self._uv, uv_px):
                self._uv, self._rays = uv_px, self._camera.rays(uv_px).astype(np.float32)
            return np.asarray(self._rays @ cam_from_world.astype(np.float32))

        return rays


def _turn_to_seam(towards_m: Float64) -> float:
    """The turn of a level panorama that brings a direction to its left and right border."""
    return float(-np.pi / 2 - np.arctan2(towards_m[1], towards_m[0]))


def marker_plot(
    seed: int,
    codes: Sequence[tuple[tuple[str, int], Bool, float]],
    *,
    n_photos: int = 14,
    width_px: int = 2048,
    reach_m: tuple[float, float] = (2.0, 5.5),
    pose_sigma_mm: float = 3.0,
    pose_sigma_deg: float = 0.05,
    scene: MarkerScene | None = None,
    flaws: PictureFlaws | None = None,
    on_seam: bool = False,
) -> MarkerPlot:
    """Render a walk round the markers.

    Args:
        seed: Of everything.
        codes: Per marker its (dictionary, id), its (n, n) bits with border, and its side in metres.
        n_photos: Panoramas.
        width_px: Of the panoramas; a multiple of 16, and of 32 from 4096 on.
        reach_m: Nearest and farthest distance of the camera from the middle of the plot.
        pose_sigma_mm: Error of the believed places, per axis.
        pose_sigma_deg: Error of the believed directions, per axis.
        scene: Instead of a random one.
        flaws: Instead of random ones.
        on_seam: Whether the left and right border of each panorama cut a marker, each one in its turn.
    """
    rng = np.random.default_rng([seed, 7])
    scene = scene or random_scene(seed, codes)
    flaws = flaws or random_flaws(seed)
    camera = CameraModel("EQUIRECTANGULAR", width_px, width_px // 2, ())
    metres_per_unit = float(rng.uniform(0.3, 3.0))
    turn = Rotation.from_rotvec(rng.normal(0, 1.0, 3)).as_matrix()
    background_step = max(1, width_px // 2048)
    whole = _WholePicture(camera, background_step)
    images, pictures = [], {}
    start = rng.uniform(0, 2 * np.pi)
    for number in range(n_photos):
        angle = start + 2 * np.pi * number / n_photos + rng.normal(0, 0.1)
        reach = rng.uniform(*reach_m)
        centre = np.array([reach * np.cos(angle), reach * np.sin(angle), 0.0])
        centre[2] = float(scene.ground_m(centre[0], centre[1])) + rng.uniform(1.5, 2.3)
        turned = rng.uniform(0, 2 * np.pi)
        if on_seam:
            turned = _turn_to_seam(scene.boards[number % len(scene.boards)].centre_m - centre)
        yaw = Rotation.from_rotvec([0, 0, turned]).as_matrix()
        tilt = Rotation.from_rotvec(rng.normal(0, _TILT_SIGMA_RAD, 3)).as_matrix()
        cam_from_world = tilt @ _CAM_FROM_LEVEL @ yaw
        name = f"{number:03d}.jpg"
        pictures[name] = render(
            scene,
            whole.turned(cam_from_world),
            centre,
            (width_px, width_px // 2),
            flaws,
            wraps=True,
            seed=number,
            background_step=background_step,
        )
        wrong = Rotation.from_rotvec(np.radians(rng.normal(0, pose_sigma_deg, 3))).as_matrix()
        rotation = wrong @ cam_from_world @ turn.T
        place = turn @ (centre + rng.normal(0, pose_sigma_mm / 1000, 3)) / metres_per_unit
        images.append(PosedImage(name, camera, Similarity(rotation, -(rotation @ place)), order=number))
    return MarkerPlot(PosedImages(tuple(images)), pictures, metres_per_unit, scene, turn)
