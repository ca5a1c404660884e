"""The points on the stems: where they are dense, how they are coloured, and what is true of each stem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Bool, Float, Float64, Int32, UInt8, readonly
from dbh_studio.core.progress import Progress
from dbh_studio.core.synthetic.capture import draw_cells
from dbh_studio.core.synthetic.fields import WaveField
from dbh_studio.core.synthetic.plants import SUN, Painted, paint
from dbh_studio.core.synthetic.recipe import TreeTruth
from dbh_studio.core.synthetic.scene import Scene
from dbh_studio.core.synthetic.stems import BREAST_HEIGHT_M, TRUTH_HEIGHTS_M, Stem

_N_ANGLES = 72
_FAINT = 0.05
_BAND_M = (1.22, 1.52)
_HIDDEN_HALF_ANGLE = np.radians(19.0)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Patches of all stems: which stem, the lower corner in angle and height, the height step, area and view."""

    stem: Int32
    angle: Float64
    height: Float64
    step: Float64
    weight: Float64
    cameras: Int32


def _stem_cells(scene: Scene) -> _Cells:
    """Cut every stem's surface into patches and weigh them by area and view."""
    number, angles, heights, steps, areas, middles, normals = [], [], [], [], [], [], []
    for index, stem in enumerate(scene.stems):
        visible = stem.height_m * 0.97
        edges = np.concatenate([np.arange(-0.3, 3.0, 0.15), np.arange(3.0, visible + 0.5, 0.5)])
        edges = edges[edges <= max(visible, 3.0)]
        low, step = edges[:-1], np.diff(edges)
        angle, h = np.meshgrid(np.arange(_N_ANGLES) * (2 * np.pi / _N_ANGLES), low)
        step = np.broadcast_to(step[:, None], h.shape).ravel()
        angle, h = angle.ravel(), h.ravel()
        middle, normal = stem.surface(angle + np.pi / _N_ANGLES, h + step / 2)
        number.append(np.full(len(h), index, np.int32))
        angles.append(angle)
        heights.append(h)
        steps.append(step)
        areas.append(step * stem.mean_radius(h) * (2 * np.pi / _N_ANGLES))
        middles.append(middle)
        normals.append(normal)
    seen = scene.see(np.concatenate(middles), np.concatenate(normals))
    stem_of, angle, height = np.concatenate(number), np.concatenate(angles), np.concatenate(heights)
    # What is seen too faintly is dropped by the confidence filter of every dense matcher.
    weight = np.concatenate(areas) * np.maximum(seen.weight - _FAINT, 0.0)
    # Above, stems blur into branches and into the sky's glare, whatever the distance.
    weight *= 1.0 / (1.0 + (np.maximum(height - 3.0, 0) / 5.0) ** 2)
    for index, stem in enumerate(scene.stems):
        if stem.hidden_azimuth is not None:
            off = np.abs((angle - stem.hidden_azimuth + np.pi) % (2 * np.pi) - np.pi)
            mine = stem_of == index
            # The shrubs thin out above head height, unevenly around the stem.
            above = np.clip((height - 1.8 - 0.25 * np.sin(3 * angle) - 0.15 * np.sin(7 * angle)) / 1.2, 0, 1)
            weight[mine & (off > _HIDDEN_HALF_ANGLE + np.pi * above)] = 0.0
            weight[mine] *= 0.6 + 0.4 * above[mine]
    return _Cells(stem_of, angle, height, np.concatenate(steps), weight, seen.cameras)


def _bark_colour(stem: Stem, angle: Float, height: Float, normals: Float, patches: WaveField, points: Float) -> UInt8:
    """Bark, darker in its furrows and near the ground, lighter in the sun, with moss on the north side below."""
    base = np.array((150, 146, 140) if stem.status == "dead" else stem.species.bark_rgb, np.float32)
    if stem.species.name == "Scots pine":
        # The bark of Scots pine turns from grey-brown to orange with height.
        share = np.clip((height - 2.0) / 5.0, 0, 1)[:, None]
        base = (1 - share) * np.array([132, 106, 88], np.float32) + share * np.array([196, 124, 76], np.float32)
    blotch = patches(points)
    moss = np.clip(1.1 - height / 1.6 + 0.6 * normals[:, 1] + 0.6 * blotch, 0, 1)[:, None] ** 2 * 0.75
    colour = (1 - moss) * base + moss * np.array([104, 122, 58], np.float32)
    furrow = stem.ridges(angle - stem.twist * height, height)
    contrast = 0.05 if stem.species.ridge < 0.003 else 0.17
    shade = 0.74 + 0.40 * np.maximum(normals @ SUN, 0) + contrast * furrow + 0.06 * blotch
    shade *= 0.72 + 0.28 * np.clip(height / 0.5 + 0.3, 0, 1)
    return paint(colour, shade)


def make_boles(scene: Scene, n_points: int, progress: Progress) -> tuple[list[Painted], list[Int32], list[TreeTruth]]:
    """The points, ids and truth of every stem."""
    rng, parts, ids, truths = scene.rng, [], [], []
    if not scene.stems:
        return [], [], []
    cells = _stem_cells(scene)
    chosen = draw_cells(rng, cells.weight, n_points)
    starts = np.searchsorted(cells.stem[chosen], np.arange(len(scene.stems) + 1))
    patches = WaveField.random(rng, n_dims=3, wavelengths_m=(0.15, 1.5), amplitude=1.0)
    for index, stem in enumerate(scene.stems):
        progress(index / len(scene.stems), "Growing the stems.")
        mine = chosen[starts[index] : starts[index + 1]]
        angle = cells.angle[mine] + rng.random(len(mine)) * (2 * np.pi / _N_ANGLES)
        height = cells.height[mine] + rng.random(len(mine)) * cells.step[mine]
        keep = _without_holes(scene, stem, angle, height)
        angle, height, mine = angle[keep], height[keep], mine[keep]
        exact, normals = stem.surface(angle, height)
        exposed = _exposed(scene, stem, exact)
        angle, height, mine = angle[exposed], height[exposed], mine[exposed]
        exact, normals = exact[exposed], normals[exposed]
        colour = _bark_colour(stem, angle, height, normals, patches, exact)
        points = exact.astype(np.float32)
        which = cells.cameras[mine, rng.integers(0, 2, len(mine))]
        eyes = scene.eyes(points, normals, which)
        ray = eyes - points
        facing = np.einsum("ij,ij->i", ray, normals) / np.linalg.norm(ray, axis=1)
        scene.noise.fly(points, facing < 0.35, eyes, rng)
        scene.noise.apply(points, normals, eyes, rng)
        parts.append(Painted(points, colour))
        ids.append(np.full(len(points), stem.tree_id, np.int32))
        truths.append(_truth(stem, angle, height))
    return parts, ids, truths


def _without_holes(scene: Scene, stem: Stem, angle: Float, height: Float) -> Bool:
    """Which points are not in one of the few places where matching failed."""
    keep = np.ones(len(angle), bool)
    if scene.recipe.noise == 0:
        return keep
    rng = scene.rng
    n_holes = rng.poisson(3.0)
    middles, lows, sizes = rng.uniform([[0.0], [0.2], [0.03]], [[2 * np.pi], [6.0], [0.16]], (3, n_holes))
    for middle, low, size in zip(middles, lows, sizes, strict=True):
        across = ((angle - middle + np.pi) % (2 * np.pi) - np.pi) * stem.radius_m
        keep &= np.hypot(across, (height - low) / 1.6) > min(size, 0.5 * stem.radius_m)
    return keep


def _exposed(scene: Scene, stem: Stem, points: Float) -> Bool:
    """Which points are above the ground and not inside the other half of a twin."""
    keep = points[:, 2] > scene.terrain.z(points)
    for other in scene.stems:
        if stem.status == "twin" and other is not stem and np.array_equal(other.base[:2], stem.base[:2]):
            height = points[:, 2] - other.base[2]
            away = np.linalg.norm((points - other.axis(height))[:, :2], axis=1)
            keep &= away > 0.97 * other.mean_radius(np.maximum(height, 0))
    return keep


def _truth(stem: Stem, angle: Float, height: Float) -> TreeTruth:
    """What is known of a stem, and how much of its ring the points show."""
    band = (height >= _BAND_M[0]) & (height <= _BAND_M[1])
    per_sector = np.bincount((angle[band] * (_N_ANGLES / (2 * np.pi))).astype(np.intp) % _N_ANGLES, minlength=_N_ANGLES)
    centre = stem.axis(np.array([BREAST_HEIGHT_M]))[0]
    along = stem.frames(np.array([BREAST_HEIGHT_M]))[2][0]
    diameters = np.array([stem.diameters_cm(h) for h in TRUTH_HEIGHTS_M])
    return TreeTruth(
        tree_id=stem.tree_id,
        x_m=float(centre[0]),
        y_m=float(centre[1]),
        z_ground_m=float(stem.base[2]),
        lean_deg=float(np.degrees(np.arccos(np.clip(along[2], -1, 1)))),
        lean_azimuth_deg=float(np.degrees(np.arctan2(along[0], along[1])) % 360),
        height_m=stem.height_m,
        species=stem.species.name,
        status=stem.status,
        seen_arc_deg=float((per_sector > 0).sum() * 360 / _N_ANGLES),
        n_points=len(height),
        n_points_band=int(band.sum()),
        heights_m=readonly(TRUTH_HEIGHTS_M),
        tape_cm=readonly(diameters[:, 0]),
        curve_cm=readonly(diameters[:, 1]),
        area_cm=readonly(diameters[:, 2]),
    )
