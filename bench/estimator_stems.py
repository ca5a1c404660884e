"""Stems with an exactly known girth, seen the way phones and scanners see them.

The stems are those of `dbh_studio.core.synthetic.stems` (lean, sweep, taper, ovals, waves, buttresses, bark). What is
seen of them is made here: cameras stand in a sector, so a stem is seen from as much of the ring as they can see, errors
lie along their rays, each pass of cameras may be shifted as a whole, and there is clutter of six kinds.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.synthetic.fields import WaveField
from dbh_studio.core.synthetic.recipe import PlotRecipe
from dbh_studio.core.synthetic.stems import BREAST_HEIGHT_M, Stem, make_stems
from dbh_studio.settings import EstimatorSettings

Range = tuple[float, float]
_LOW_M, _HIGH_M = 0.25, 2.4
_SEEN_FROM_ONE_DEG = 150.0  # of a ring, by one camera: grazing views do not match


@dataclass(frozen=True)
class Scenario:
    """A way to see stems; ranges are drawn from evenly, of `points`, `dbh_cm` and `noise_m` in the logarithm.

    Attributes:
        arc_deg: Of the ring seen, per face.
        faces: How many opposite faces are seen.
        noise_m: Robust standard deviation along the ray.
        tail: Degrees of freedom of Student's t; 30 is nearly normal.
        smooth: Part of the noise that neighbours share, relative.
        bloat_m: Mean of an outward, exponential error.
        passes: Passes of cameras, shifted as a whole,
        drift_m: with this standard deviation per axis.
        clutter: Clutter points as a share of all.
        lean_deg: Lean.
        irregularity: Of the section; 1 is what the plot generator calls normal.
        dbh_cm: Diameters.
        points: Points between 0.25 and 2.4 m.
        touching: Whether a second stem stands against it.
        buttress: Whether root swell reaches breast height.
    """

    arc_deg: Range = (360.0, 360.0)
    faces: int = 1
    noise_m: Range = (0.003, 0.012)
    tail: float = 3.0
    smooth: float = 0.4
    bloat_m: Range = (0.0, 0.002)
    passes: int = 1
    drift_m: Range = (0.0, 0.0)
    clutter: Range = (0.0, 0.1)
    lean_deg: Range = (0.0, 6.0)
    irregularity: Range = (0.5, 1.5)
    dbh_cm: Range = (12.0, 70.0)
    points: Range = (600.0, 12000.0)
    touching: bool = False
    buttress: bool = False


SCENARIOS = {
    "full": Scenario(),
    "full, noisy": Scenario(noise_m=(0.012, 0.03)),
    "arc 300": Scenario(arc_deg=(300, 300)),
    "arc 240": Scenario(arc_deg=(240, 240)),
    "arc 180": Scenario(arc_deg=(180, 180)),
    "arc 140": Scenario(arc_deg=(140, 140)),
    "arc 100": Scenario(arc_deg=(100, 100)),
    "arc 70": Scenario(arc_deg=(70, 70)),
    "two faces": Scenario(arc_deg=(70, 110), faces=2),
    "partial, noisy": Scenario(arc_deg=(140, 260), noise_m=(0.012, 0.03), clutter=(0.05, 0.25)),
    "drift": Scenario(arc_deg=(220, 360), passes=3, drift_m=(0.006, 0.025)),
    "bloat": Scenario(arc_deg=(200, 360), bloat_m=(0.004, 0.02)),
    "clutter": Scenario(arc_deg=(160, 360), clutter=(0.25, 0.45)),
    "lean": Scenario(arc_deg=(160, 360), lean_deg=(8, 20)),
    "irregular": Scenario(arc_deg=(160, 360), irregularity=(1.8, 3.0)),
    "buttress": Scenario(arc_deg=(200, 360), buttress=True, dbh_cm=(35, 100)),
    "small": Scenario(arc_deg=(150, 360), dbh_cm=(5, 15), noise_m=(0.004, 0.012), points=(200, 3000)),
    "lidar": Scenario(
        arc_deg=(300, 360),
        noise_m=(0.01, 0.025),
        tail=30,
        smooth=0.2,
        passes=2,
        drift_m=(0.004, 0.015),
        points=(200, 3000),
    ),
    "lidar, partial": Scenario(
        arc_deg=(120, 220),
        noise_m=(0.01, 0.025),
        tail=30,
        smooth=0.2,
        passes=2,
        drift_m=(0.004, 0.015),
        points=(200, 3000),
    ),
    "neighbour": Scenario(arc_deg=(180, 320), touching=True),
    # The paper's categories, which mix what stands apart above.
    "partial": Scenario(arc_deg=(80, 240), noise_m=(0.005, 0.02), clutter=(0.0, 0.25)),
    "backpack": Scenario(arc_deg=(120, 360), noise_m=(0.005, 0.015), clutter=(0.05, 0.25)),
    "drone": Scenario(
        arc_deg=(90, 360), noise_m=(0.01, 0.03), bloat_m=(0.002, 0.01), clutter=(0.05, 0.3), points=(200, 3000)
    ),
    "short": Scenario(arc_deg=(240, 360), noise_m=(0.003, 0.01)),
    "long": Scenario(
        arc_deg=(90, 360),
        noise_m=(0.006, 0.02),
        passes=3,
        drift_m=(0.004, 0.02),
        clutter=(0.05, 0.25),
        points=(200, 4000),
    ),
    "clean": Scenario(noise_m=(0.001, 0.003), bloat_m=(0.0, 1e-9), clutter=(0.0, 1e-9), irregularity=(1e-3, 2e-3)),
}


@dataclass(frozen=True, eq=False)
class Case:
    """One stem as seen: (N, 3) points, z above ground, and the three diameters at 1.30 m."""

    points_m: np.ndarray
    tape_cm: float
    curve_cm: float
    area_cm: float
    arc_deg: float


def make_case(name: str, seed: int, scenario: Scenario | None = None) -> Case:
    """The stem of a scenario and a seed; seen as another scenario says, where one is given."""
    scenario = SCENARIOS[name] if scenario is None else scenario
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    stem = stem_of(scenario, seed, rng)
    n_points = int(_log_uniform(rng, scenario.points))
    n_clutter = int(n_points * rng.uniform(*scenario.clutter))
    arc = float(rng.uniform(*scenario.arc_deg))
    parts = [seen_of(scenario, stem, n_points - n_clutter, arc, rng)]
    parts += clutter_about(stem, n_clutter, rng)
    if scenario.touching:
        other = _neighbour(stem, rng)
        other_arc = float(rng.uniform(120, 240))
        n_other = int(rng.uniform(0.2, 0.7) * n_points)
        parts.append(seen_of(replace(scenario, touching=False), other, n_other, other_arc, rng))
    points = np.concatenate(parts)
    # Where breast height is depends on the ground, which is known to some centimetres.
    points[:, 2] += rng.normal(0.0, 0.02)
    points = points[(points[:, 2] > 0.3) & (points[:, 2] < 2.3)]
    tape, curve, area = stem.diameters_cm(BREAST_HEIGHT_M)
    return Case(points[rng.permutation(len(points))], tape, curve, area, arc * scenario.faces)


def in_stretch(points: np.ndarray) -> np.ndarray:
    """(N,) whether points are on the stretch of stem that the estimator uses."""
    settings = EstimatorSettings()
    above = points[:, 2] - settings.breast_height_m
    return (above >= -settings.below_m) & (above <= settings.above_m)


def _log_uniform(rng: np.random.Generator, bounds: Range) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def stem_of(scenario: Scenario, seed: int, rng: np.random.Generator) -> Stem:
    recipe = PlotRecipe(
        n_trees=1, seed=seed, irregularity=float(rng.uniform(*scenario.irregularity)), side_m=10.0, lean_max_deg=6.0
    )
    stem = make_stems(rng, recipe)[0]
    radius = 0.005 * _log_uniform(rng, scenario.dbh_cm)
    azimuth, lean = rng.uniform(0, 2 * np.pi), np.tan(np.radians(rng.uniform(*scenario.lean_deg)))
    butt = stem.butt.copy()
    if scenario.buttress:
        butt[0], butt[1], butt[3] = rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.15, 0.5)
    height = 3.3 + 27 * (1 - np.exp(-6.8 * radius)) * rng.uniform(0.9, 1.1)
    return replace(
        stem,
        base=np.zeros(3),
        radius_m=radius,
        ridge_m=stem.ridge_m * radius / stem.radius_m,
        lean=lean * np.array([np.cos(azimuth), np.sin(azimuth)]),
        sweep=rng.normal(0, 0.006 * height, 2),
        height_m=height,
        butt=butt,
    )


def _neighbour(stem: Stem, rng: np.random.Generator) -> Stem:
    radius = stem.radius_m * rng.uniform(0.4, 1.1)
    azimuth = rng.uniform(0, 2 * np.pi)
    away = (stem.radius_m + radius) * 1.05 + rng.uniform(0.0, 0.08)
    base = np.array([away * np.cos(azimuth), away * np.sin(azimuth), 0.0])
    return replace(stem, base=base, radius_m=radius, harmonics=stem.harmonics * [1, 1, -1], ridge_m=0.3 * stem.ridge_m)


def seen_of(scenario: Scenario, stem: Stem, n_points: int, arc_deg: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points of the bark with the errors of the cameras that saw them."""
    middle = rng.uniform(0, 2 * np.pi)
    faces = middle + np.arange(scenario.faces) * (2 * np.pi / scenario.faces)
    face = rng.integers(0, scenario.faces, n_points)
    half = np.radians(arc_deg / 2)
    # Thinner towards the edges, and unevenly all round.
    off = half * np.clip(rng.triangular(-1.15, 0.0, 1.15, 3 * n_points), -1, 1)
    even = rng.uniform(-half, half, 3 * n_points)
    off = np.where(rng.random(3 * n_points) < 0.6, even, off)[:n_points]
    angle = faces[face] + off
    height = rng.uniform(_LOW_M, _HIGH_M, n_points)
    keep = _without_holes(stem, angle, height, rng)
    angle, height, off, face = angle[keep], height[keep], off[keep], face[keep]
    points, normals = stem.surface(angle, height)
    # The camera that saw a point stands in the sector from which the arc can be seen, as straight before it as it may.
    reach = max(half - np.radians(_SEEN_FROM_ONE_DEG / 2), 0.0)
    from_angle = faces[face] + np.clip(off, -reach, reach)
    distance = rng.uniform(2.0, 7.0)
    eyes = np.column_stack([distance * np.cos(from_angle), distance * np.sin(from_angle), np.full(len(angle), 1.7)])
    ray = eyes + [*stem.base[:2], 0.0] - points
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    noise = _log_uniform(rng, scenario.noise_m)
    along = np.clip(rng.standard_t(scenario.tail, len(points)), -8, 8) * noise
    field = WaveField.random(rng, n_dims=3, wavelengths_m=(0.12, 1.2), amplitude=scenario.smooth * noise)
    along += field(points)
    points = points + along[:, None] * ray + rng.normal(0, 0.25 * noise, points.shape)
    points += rng.exponential(max(rng.uniform(*scenario.bloat_m), 1e-9), len(points))[:, None] * normals
    drift = rng.uniform(*scenario.drift_m)
    shifts = np.column_stack([rng.normal(0, drift, (scenario.passes, 2)), np.zeros(scenario.passes)])
    # Passes follow each other round the stem and overlap.
    turn = (off / (2 * half) + 0.5) * scenario.passes + rng.normal(0, 0.35, len(points))
    return points + shifts[np.clip(turn.astype(int), 0, scenario.passes - 1)]


def _without_holes(stem: Stem, angle: np.ndarray, height: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    keep = np.ones(len(angle), bool)
    for _ in range(rng.poisson(2.0)):
        middle, low, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 2.2), rng.uniform(0.03, 0.15)
        across = ((angle - middle + np.pi) % (2 * np.pi) - np.pi) * stem.radius_m
        keep &= np.hypot(across, (height - low) / 1.6) > min(size, 0.5 * stem.radius_m)
    return keep


def clutter_about(stem: Stem, n_points: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Ferns, stubs, ivy, a bank of soil, a bush and stray points, in random shares."""
    share = rng.dirichlet(np.full(6, 0.6))
    fern, stub, ivy, bank, bush, stray = np.floor(n_points * share).astype(int)
    azimuth = rng.uniform(0, 2 * np.pi, 6)
    r0 = stem.radius_m
    parts = []
    where = (r0 + rng.uniform(0.1, 0.5)) * np.array([np.cos(azimuth[0]), np.sin(azimuth[0])])
    fronds = np.column_stack([where + rng.normal(0, 0.25, (fern, 2)), rng.gamma(3.0, 0.3, fern)])
    parts.append(fronds)
    length = rng.uniform(0.02, 0.5, stub)
    which = rng.integers(0, 3, stub)
    heights, turns = rng.uniform(0.8, 2.0, 3), rng.uniform(0, 2 * np.pi, 3)
    out = (r0 + length)[:, None] * np.column_stack([np.cos(turns[which]), np.sin(turns[which])])
    parts.append(np.column_stack([out, heights[which] + 0.3 * length]) + rng.normal(0, 0.015, (stub, 3)))
    angle = azimuth[2] + rng.uniform(-0.6, 0.6, ivy)
    height = rng.uniform(_LOW_M, rng.uniform(0.9, 2.3), ivy)
    bark, normals = stem.surface(angle, height)
    parts.append(bark + rng.exponential(0.03, ivy)[:, None] * normals)
    ground = rng.uniform(-1.0, 1.0, (bank, 2))
    uphill = ground @ np.array([np.cos(azimuth[3]), np.sin(azimuth[3])])
    parts.append(np.column_stack([ground, 0.9 * uphill + rng.normal(0, 0.03, bank)]))
    where = (r0 + rng.uniform(0.2, 0.6)) * np.array([np.cos(azimuth[4]), np.sin(azimuth[4])])
    ball = rng.normal(0, 0.2, (bush, 3))
    parts.append(ball + [*where, rng.uniform(0.8, 1.8)])
    parts.append(rng.uniform([-0.8, -0.8, _LOW_M], [0.8, 0.8, _HIGH_M], (stray, 3)))
    centre = stem.axis(np.array([BREAST_HEIGHT_M]))[0, :2]
    result = [part + [*centre, 0.0] if index != 2 else part for index, part in enumerate(parts)]
    # Stems are opaque: nothing is seen inside them.
    return [
        part[np.hypot(*(part - stem.axis(part[:, 2]))[:, :2].T) > stem.mean_radius(np.maximum(part[:, 2], 0)) - 0.005]
        for part in result
    ]
