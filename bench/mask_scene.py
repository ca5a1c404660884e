"""Generated plots seen by panoramas: the true mask of every trunk, ray-cast, and the faults of masks that models make.

The masks come from triangles of the true stems, the ground and the plants, through Open3D's ray caster: nothing of the
program that is judged takes part. The cloud is the generator's, with its noise and its hidden sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from unittest import mock

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbh_studio.core.camera import CameraModel
from dbh_studio.core.ground import fit_ground
from dbh_studio.core.posed_images import PosedImage, PosedImages
from dbh_studio.core.synthetic import floor
from dbh_studio.core.synthetic import plot as plot_module
from dbh_studio.core.synthetic.plot import make_plot
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.scene import make_scene
from dbh_studio.core.transforms import Similarity

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Faults:
    """What is wrong with masks and poses.

    bleed_px grows every mask; missed drops a trunk from a photo; lost drops a photo; blobs are false ellipses per
    photo; impostors are places (a bush, a rucksack) called trunk in two photos of three; logs is how often a lying log
    is called trunk; people is how many stand about in a photo, called trunk, hiding what is behind; merged joins the
    masks of two trunks that meet in the picture; cut makes two masks of one, side by side or one above the other; pose
    errors are rms per axis.
    """

    name: str
    bleed_px: int = 0
    missed: float = 0.0
    lost: float = 0.0
    blobs: int = 0
    impostors: int = 0
    logs: float = 0.0
    people: int = 0
    merged: float = 0.0
    cut: float = 0.0
    pose_m: float = 0.0
    pose_deg: float = 0.0


ALL_OF_IT = Faults("all of it", 3, 0.2, 0.2, 2, 2, 0.7, 1, 0.1, 0.1, 0.01, 0.1)
LADDER = (
    Faults("exact masks"),
    Faults("20 % of trunks missed, 20 % of photos lost", missed=0.2, lost=0.2),
    Faults("outlines bleed 3 px", bleed_px=3),
    Faults("logs, people, bushes called trunk", logs=0.7, people=1, blobs=2, impostors=2),
    Faults("masks merged and cut", merged=0.2, cut=0.2),
    Faults("poses 2 cm, 0.2°", pose_m=0.02, pose_deg=0.2),
    ALL_OF_IT,
    replace(ALL_OF_IT, name="all of it, 40 % missed, poses 3 cm, 0.3°", missed=0.4, pose_m=0.03, pose_deg=0.3),
)


class MaskScene:
    """One plot and its true masks.

    Attributes: plot, ground, tree_ids (N,), height (N,), posed (true poses), labels (name → (H, W) uint8),
    spots (name → (H, W, 3) float16 what each pixel shows; infinite for sky), log_pixels (name → (H, W) uint8 which log
    each pixel shows, 0 none).
    """

    def __init__(self, seed: int, *, n_photos: int = 24, width_px: int = 2048, points: int = 1_000_000, recipe=None):
        recipe = PlotRecipe(
            seed=seed, points=points, n_trees=22, n_twins=2, n_thin=3, n_big=2, n_logs=3, side_m=24.0, slope_deg=6.0
        ).changed(**(recipe or {}))
        self.plot, self.logs = _plot_and_logs(recipe)
        self.points = self.plot.cloud.xyz
        self.tree_ids = self.plot.tree_ids
        self.ground = fit_ground(self.points)
        self.height = self.ground.height_above(self.points)
        self.rng = np.random.default_rng([seed, 99])
        self.camera = CameraModel("EQUIRECTANGULAR", width_px, width_px // 2, ())
        self.posed = self._walk(n_photos)
        self.labels, self.spots, self.log_pixels = {}, {}, {}
        self._cast(recipe)

    def _walk(self, n):
        places = self.plot.cameras_m[np.linspace(0, len(self.plot.cameras_m) - 1, n).astype(int)]
        images = []
        for k, place in enumerate(places):
            yaw = Rotation.from_rotvec([0, 0, self.rng.uniform(0, 2 * np.pi)]).as_matrix()
            tilt = Rotation.from_rotvec(self.rng.normal(0, 0.05, 3)).as_matrix()
            rotation = tilt @ LEVEL @ yaw
            images.append(PosedImage(f"{k:03d}.jpg", self.camera, Similarity(rotation, -(rotation @ place)), order=k))
        return PosedImages(tuple(images))

    def _cast(self, recipe):
        import open3d as o3d

        def mesh(vertices, triangles):
            return caster.add_triangles(
                o3d.core.Tensor(np.asarray(vertices, np.float32)), o3d.core.Tensor(np.asarray(triangles, np.uint32))
            )

        caster = o3d.t.geometry.RaycastingScene(nthreads=2)
        scene = make_scene(recipe, np.random.default_rng(np.random.SeedSequence([recipe.seed, 0xDB4])))
        tree_of = {}
        for stem in scene.stems:
            h = np.arange(-0.3, min(stem.height_m - 0.3, 14.0), 0.08)
            angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
            vertices, _ = stem.surface(np.tile(angle, len(h)), np.repeat(h, 48))
            tree_of[mesh(vertices, _strip(len(h), 48, wrap=True))] = stem.tree_id
        side = np.arange(-12.0, recipe.side_m + 12.0, 0.15)
        xy = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
        mesh(np.column_stack([xy, scene.terrain.z(xy)]), _strip(len(side), len(side), wrap=False))
        leaves = np.flatnonzero((self.tree_ids == 0) & (self.height > 0.12))
        leaves = self.points[self.rng.permutation(leaves)[:200_000]]
        corners = self.rng.normal(0, 0.012, (len(leaves), 3, 3))
        mesh((leaves[:, None] + corners).reshape(-1, 3), np.arange(3 * len(leaves)).reshape(-1, 3))
        table = np.zeros(max(tree_of) + 3, np.uint8)
        for geometry, tree in tree_of.items():
            table[geometry] = tree
        height, width = self.camera.height_px, self.camera.width_px
        across, down = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = self.camera.rays(np.column_stack([across.ravel(), down.ravel()])).astype(np.float32)
        for photo in self.posed:
            turned = rays @ photo.cam_from_source.rotation.astype(np.float32)
            given = np.hstack([np.broadcast_to(photo.centre_src.astype(np.float32), turned.shape), turned])
            hit = caster.cast_rays(o3d.core.Tensor(np.ascontiguousarray(given)))
            geometry, distance = hit["geometry_ids"].numpy(), hit["t_hit"].numpy()
            label = np.where(np.isfinite(distance), table[np.minimum(geometry, len(table) - 1)], 0)
            self.labels[photo.name] = label.reshape(height, width).astype(np.uint8)
            with np.errstate(invalid="ignore"):
                spots = photo.centre_src.astype(np.float32) + distance[:, None] * turned
            self.spots[photo.name] = spots.reshape(height, width, 3).astype(np.float16)
            self.log_pixels[photo.name] = self._logs_in(spots, label).reshape(height, width)

    def _logs_in(self, spots, label):
        found = np.zeros(len(spots), np.uint8)
        for number, tree in enumerate(self.logs, start=1):
            lower, upper = tree.mins - 0.1, tree.maxes + 0.1
            near = np.flatnonzero(((spots >= lower) & (spots <= upper)).all(axis=1) & (label == 0))
            found[near[tree.query(spots[near], distance_upper_bound=0.06)[0] < 0.06]] = number
        return found

    def faulty(self, faults: Faults):
        """Poses and (H, W) labels per photo, as the program would get them."""
        rng = np.random.default_rng([self.plot.cloud.xyz.shape[0], len(faults.name), 5])
        where = rng.uniform(3.0, 21.0, (faults.impostors, 2))
        centres = np.column_stack([where, self.ground.z_at(where) + 0.4])
        images, masks = [], {}
        for photo in self.posed:
            wrong = Rotation.from_rotvec(np.radians(rng.normal(0, faults.pose_deg, 3))).as_matrix()
            rotation = wrong @ photo.cam_from_source.rotation
            place = photo.centre_src + rng.normal(0, faults.pose_m, 3)
            images.append(PosedImage(photo.name, self.camera, Similarity(rotation, -(rotation @ place))))
            if rng.random() < faults.lost:
                continue
            masks[photo.name] = self._faulty_mask(photo.name, faults, centres, rng)
        return PosedImages(tuple(images)), masks

    def _faulty_mask(self, name, faults, centres, rng):
        return faulty_mask(
            self.labels[name], faults, rng, spots=self.spots[name], logs=self.log_pixels[name], centres=centres
        )


def faulty_mask(label, faults, rng, *, spots=None, logs=None, centres=()):
    """(H, W) uint8 labels as a model may give them, of true ones. Trees are below 150."""
    label = label.copy()
    for tree in np.unique(label[label > 0]):
        if rng.random() < faults.missed:
            label[label == tree] = 0
    _merge(label, faults.merged, rng)
    _cut(label, faults.cut, rng)
    if logs is not None:
        for log in np.unique(logs[logs > 0]):
            if rng.random() < faults.logs:
                label[(logs == log) & (label == 0)] = 150 + log
    for k, centre in enumerate(centres):
        if rng.random() < 0.67:
            near = np.linalg.norm(spots - centre, axis=2) < 0.55
            label[near & (label == 0)] = 200 + k
    height, width = label.shape
    per_degree = width / 360.0
    for k in range(faults.blobs):
        middle, size = (
            (rng.uniform(0, width), rng.uniform(0.35, 0.75) * height),
            (rng.uniform(5, 40), rng.uniform(10, 80)),
        )
        label[_ellipse(label.shape, middle, size)] = 220 + k
    for k in range(faults.people):
        # 1.75 m tall, 0.5 m wide, eyes of the camera at 1.6 m.
        away = rng.uniform(2.0, 6.0)
        top, foot = np.degrees(np.arctan2([0.15, -1.6], away))
        middle = (rng.uniform(0, width), height / 2 - 0.5 * (top + foot) * per_degree)
        size = (np.degrees(np.arctan(0.25 / away)) * per_degree, 0.5 * (top - foot) * per_degree)
        label[_ellipse(label.shape, middle, size)] = 240 + k
    if faults.bleed_px:
        grown = maximum_filter(label, 2 * faults.bleed_px + 1)
        label = np.where(label > 0, label, grown)
    return label


def _ellipse(shape, middle, size):
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return ((columns - middle[0]) / size[0]) ** 2 + ((rows - middle[1]) / size[1]) ** 2 < 1


def _merge(label, share, rng):
    """Trunks that meet in the picture become one mask."""
    if not share:
        return
    beside = np.stack([label[:, :-4].ravel(), label[:, 4:].ravel()], axis=1)
    pairs = np.unique(beside[(beside > 0).all(axis=1) & (beside[:, 0] != beside[:, 1])], axis=0)
    for first, second in np.unique(np.sort(pairs, axis=1), axis=0):
        if rng.random() < share:
            label[label == second] = first


def _cut(label, share, rng):
    """One trunk becomes two masks: most often one above the other, as by a branch before it."""
    if not share:
        return
    number = 100
    for tree in np.unique(label[(label > 0) & (label < 100)]):
        if rng.random() >= share:
            continue
        rows, columns = np.nonzero(label == tree)
        along = columns if rng.random() < 0.3 else rows
        far = along > np.quantile(along, rng.uniform(0.3, 0.7))
        label[rows[far], columns[far]] = number
        number += 1


def _plot_and_logs(recipe):
    """The plot, and a search tree of the points of each of its logs, which the plot itself does not tell."""
    kept = []

    def make_logs(scene, n_points):
        parts = floor.make_logs(scene, n_points)
        kept.extend(cKDTree(part.xyz) for part in parts)
        return parts

    with mock.patch.object(plot_module, "make_logs", make_logs):
        return make_plot(recipe), kept


def _strip(n_rows, n_columns, *, wrap):
    last = n_columns if wrap else n_columns - 1
    row, column = np.meshgrid(np.arange(n_rows - 1), np.arange(last), indexing="ij")
    following = (column + 1) % n_columns
    a, b = row * n_columns + column, row * n_columns + following
    c, d = a + n_columns, b + n_columns
    return np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
