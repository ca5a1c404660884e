"""A forest plot with known truth, as 360° photogrammetry or a scanner would give it.

The sections, noise and occlusion are made to be as awkward as real ones: ellipses with decaying harmonics, bark ridges,
buttresses, lean and sweep; errors along the viewing ray with heavy tails; stems seen from one side only.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Bool, Float64, Int32, readonly
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.progress import Progress, ignore_progress, subprogress
from dbh_studio.core.synthetic import plants
from dbh_studio.core.synthetic.boles import make_boles
from dbh_studio.core.synthetic.floor import make_ground, make_logs
from dbh_studio.core.synthetic.plants import Painted
from dbh_studio.core.synthetic.recipe import PlotRecipe, SyntheticPlot, TreeTruth
from dbh_studio.core.synthetic.scene import Scene, make_scene


def _budget(recipe: PlotRecipe) -> dict[str, int]:
    """Points for each part of the plot."""
    shares = {
        "stems": 0.27 if recipe.n_trees else 0.0,
        "ground": 0.40 * recipe.ground,
        "logs": 0.006 * recipe.n_logs,
        "understorey": 0.15 * recipe.understorey,
        "crowns": 0.17 * recipe.crowns if recipe.n_trees else 0.0,
    }
    total = sum(shares.values())
    return {name: round(recipe.points * share / total) if total else 0 for name, share in shares.items()}


def _make_understorey(scene: Scene, n_points: int) -> Painted:
    """Ferns, grass and shrubs in clumps, and the thickets that hide stems."""
    rng, recipe = scene.rng, scene.recipe
    area = recipe.side_m**2 * min(recipe.understorey, 2.0)
    places = [
        plants.clumps(rng, recipe, round(area * density), n_per_clump=size, spread_m=spread)
        for density, size, spread in ((0.26, 14, 1.2), (0.22, 18, 0.9), (0.035, 3, 0.8))
    ]
    places = [p[_clear_of(p, scene.circles, gap)] for p, gap in zip(places, (0.3, 0.15, 0.75), strict=True)]
    heights = rng.uniform(0.5, 1.6, len(places[2]))
    parts = [
        plants.ferns(rng, places[0], scene.terrain, int(n_points * 0.45)),
        plants.grass(rng, places[1], scene.terrain, int(n_points * 0.20)),
        plants.shrubs(rng, places[2], heights, scene.terrain, int(n_points * 0.35)),
    ]
    for stem in scene.stems:
        if stem.hidden_azimuth is not None:
            around, tall = plants.thicket(rng, stem)
            parts.append(plants.shrubs(rng, around, tall, scene.terrain, n_points // 8))
    return Painted.join(parts)


def _clear_of(places: Float64, circles: Float64, gap_m: float) -> Bool:
    """Which (P, 2) places are at least `gap_m` from all bark."""
    clear = np.ones(len(places), bool)
    for x, y, radius in circles:
        clear &= np.hypot(places[:, 0] - x, places[:, 1] - y) > radius + gap_m
    return clear


def _make_crowns(scene: Scene, n_points: int) -> Painted:
    """Branches and leaves of all trees, in proportion to their size."""
    sizes = np.array([(stem.radius_m + 0.06) ** 1.3 * (0.35 if stem.status == "dead" else 1.0) for stem in scene.stems])
    shares = (n_points * sizes / sizes.sum()).astype(int)
    parts = [Painted.empty()]
    for stem, n in zip(scene.stems, shares, strict=True):
        parts += [plants.crown(scene.rng, stem, int(0.95 * n)), plants.stubs(scene.rng, stem, int(0.05 * n))]
    return Painted.join(parts)


def _seen_plants(scene: Scene, plant: Painted) -> Painted:
    """Noise for leaves and branches, seen from the nearest camera."""
    points = plant.xyz.copy()
    if len(scene.cameras) and len(points):
        nearest = cKDTree(scene.cameras[:, :2]).query(points[:, :2])[1].astype(np.int32)
        eyes = scene.eyes(points, None, nearest)
    else:
        eyes = scene.eyes(points, None, np.zeros(len(points), np.int32))
    scene.noise.apply(points, None, eyes, scene.rng)
    return Painted(points, plant.rgb)


def make_plot(recipe: PlotRecipe, *, progress: Progress = ignore_progress) -> SyntheticPlot:
    """Make the plot of a recipe. The same recipe gives the same points.

    The cloud is in metres with z up; x and y run from 0 to `recipe.side_m`.
    """
    rng = np.random.default_rng(np.random.SeedSequence([recipe.seed, 0xDB4]))
    progress(0.0, "Laying out the plot.")
    scene = make_scene(recipe, rng)
    budget = _budget(recipe)
    stem_parts, ids, trees = make_boles(scene, budget["stems"], subprogress(progress, 0.02, 0.5))
    progress(0.5, "Covering the ground.")
    others = [make_ground(scene, budget["ground"])] if budget["ground"] else []
    others += make_logs(scene, budget["logs"])
    progress(0.7, "Planting the understorey.")
    if budget["understorey"]:
        others.append(_seen_plants(scene, _make_understorey(scene, budget["understorey"])))
    progress(0.8, "Growing the crowns.")
    if budget["crowns"]:
        others.append(_seen_plants(scene, _make_crowns(scene, budget["crowns"])))
    progress(0.9, "Putting the points in order.")
    everything = Painted.join([Painted.empty(), *stem_parts, *others])
    tree_ids = np.zeros(len(everything.xyz), np.int32)
    stem_ids = np.concatenate([np.zeros(0, np.int32), *ids])
    tree_ids[: len(stem_ids)] = stem_ids
    return _in_order(everything, tree_ids, tuple(trees), scene)


def _in_order(everything: Painted, tree_ids: Int32, trees: tuple[TreeTruth, ...], scene: Scene) -> SyntheticPlot:
    """Shuffle, then sort by half-metre cells: the order tells nothing of the trees, and the file compresses well."""
    xyz = everything.xyz
    shuffled = scene.rng.permutation(len(xyz)).astype(np.int32)
    cell = np.floor(xyz[shuffled] * np.float32(2)).astype(np.int64) + 10_000
    order = shuffled[np.argsort((cell[:, 0] * 20_000 + cell[:, 1]) * 20_000 + cell[:, 2], kind="stable")]
    cloud = PointCloud(xyz[order], np.zeros(3), everything.rgb[order], name=scene.recipe.name)
    return SyntheticPlot(cloud, readonly(tree_ids[order]), trees, readonly(scene.cameras))
