"""The shape of a stem: an axis that leans and sweeps, and a section that is not a circle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from dbh_studio.core.arrays import Float, Float64
from dbh_studio.core.synthetic.recipe import PlotRecipe

BREAST_HEIGHT_M = 1.3
TRUTH_HEIGHTS_M = np.array([0.3, 0.5, 0.8, 1.0, 1.1, 1.2, 1.25, 1.3, 1.35, 1.37, 1.4, 1.5, 1.7, 2.0, 2.5, 3.0])
_OUTLINE_POINTS = 4096


@dataclass(frozen=True)
class Species:
    """How a kind of tree looks.

    Attributes:
        name: Common English name.
        conifer: Whorls of drooping branches instead of a rounded crown.
        bark_rgb: Its colour in the light.
        ridge: Height of the bark's ridges as a share of the diameter.
        furrows: How many ridges there are around the stem.
        leaf_rgb: Colour of leaves or needles.
        crown_base: Where the crown begins, as a share of the height.
        share: How common it is.
    """

    name: str
    conifer: bool
    bark_rgb: tuple[int, int, int]
    ridge: float
    furrows: int
    leaf_rgb: tuple[int, int, int]
    crown_base: float
    share: float


SPECIES = (
    Species("Norway spruce", True, (138, 104, 82), 0.006, 30, (62, 98, 58), 0.42, 0.30),
    Species("Scots pine", True, (166, 112, 78), 0.012, 17, (84, 116, 66), 0.62, 0.20),
    Species("Douglas fir", True, (122, 98, 82), 0.014, 15, (58, 94, 62), 0.50, 0.15),
    Species("European beech", False, (158, 156, 148), 0.001, 40, (122, 158, 62), 0.40, 0.20),
    Species("sessile oak", False, (128, 116, 100), 0.012, 19, (108, 138, 58), 0.38, 0.15),
)


@dataclass(frozen=True, eq=False)
class Stem:
    """One stem. Heights are above the mean ground around it; angles turn about its axis, radians.

    Attributes:
        tree_id: 1, 2, …
        base: (3,) where the axis meets the mean ground.
        height_m: Of the tree.
        radius_m: Mean radius at breast height.
        lean: (2,) horizontal offset per metre of height.
        sweep: (2,) how far the middle of the stem bows out, metres.
        fork: (2,) direction a twin leans away from its other half; zeros for single stems.
        harmonics: (K, 3) order, relative amplitude and phase of the outline's departures from a circle.
        twist: Turn of the outline, radians per metre of height.
        butt: (4,) swell, height of the swell in metres, number of buttresses and their relative height.
        species: Kind of tree.
        status: ``live``, ``dead`` or ``twin``.
        hidden_azimuth: Middle of the only sector in sight; None where nothing hides the stem.
        bark_phase: (3,) of the ridges.
        ridge_m: Half the height of the bark's ridges.
    """

    tree_id: int
    base: Float64
    height_m: float
    radius_m: float
    lean: Float64
    sweep: Float64
    fork: Float64
    harmonics: Float64
    twist: float
    butt: Float64
    species: Species
    status: str
    hidden_azimuth: float | None
    bark_phase: Float64
    ridge_m: float

    def axis(self, height_m: Float) -> Float64:
        """(N, 3) points of the axis at (N,) heights."""
        h = np.asarray(height_m, np.float64)[:, None]
        bow = np.sin(np.pi * np.clip(h / self.height_m, 0, 1))
        # The halves of a twin part at 0.2 m and bend upright again with height.
        apart = 0.85 * self.radius_m + 0.9 * (1 - np.exp(-np.maximum(h - 0.2, 0) / 2.5))
        xy = self.base[:2] + self.lean * h + self.sweep * bow + self.fork * apart
        return np.concatenate([xy, self.base[2] + h], axis=1)

    def frames(self, height_m: Float) -> tuple[Float64, Float64, Float64]:
        """(N, 3) unit vectors u, v across the axis and w along it."""
        h = np.asarray(height_m, np.float64)
        along = self.axis(h + 0.01) - self.axis(h - 0.01)
        w = along / np.linalg.norm(along, axis=1, keepdims=True)
        u = np.array([1.0, 0.0, 0.0]) - w[:, :1] * w
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        return u, np.cross(w, u), w

    def mean_radius(self, height_m: Float) -> Float64:
        """(N,) radius without bark, buttresses and departures from the circle."""
        h = np.asarray(height_m, np.float64)
        share = np.clip((self.height_m - h) / (self.height_m - BREAST_HEIGHT_M), 0.0, None)
        swell = self.butt[0] * (np.exp(-h / self.butt[1]) - np.exp(-BREAST_HEIGHT_M / self.butt[1]))
        radius: Float64 = self.radius_m * (share**0.8 + swell)
        return np.maximum(radius, 0.004)

    def radius(self, angle: Float, height_m: Float, *, bark: bool = True) -> Float64:
        """(N,) radius at (N,) angles and heights."""
        h = np.asarray(height_m, np.float64)
        turned = np.asarray(angle, np.float64) - self.twist * h
        shape = np.ones_like(turned)
        for order, amplitude, phase in self.harmonics:
            shape += amplitude * np.cos(order * turned - phase)
        buttress = self.butt[3] * np.exp(-np.maximum(h, 0) / 0.45)
        shape += buttress * np.cos(self.butt[2] * turned + self.bark_phase[0])
        radius: Float64 = self.mean_radius(h) * shape
        if bark:
            radius += self.ridge_m * self.ridges(turned, h)
        return radius

    def ridges(self, angle: Float, height_m: Float) -> Float64:
        """(N,) height of the bark, about -1..1 with mean 0: long ridges that wander and break."""
        n = self.species.furrows
        wander = 0.5 * np.sin(3.1 * height_m + self.bark_phase[0]) + 0.35 * np.sin(7.7 * height_m + self.bark_phase[1])
        waves = np.cos(n * angle + 2 * wander + self.bark_phase[1])
        waves += 0.6 * np.cos((n + 5) * angle - 2.3 * wander + self.bark_phase[2] + 9 * height_m)
        waves += 0.3 * np.cos(2 * n * angle + 31 * height_m)
        ridges: Float64 = waves / 1.3
        return ridges

    def surface(self, angle: Float, height_m: Float) -> tuple[Float64, Float64]:
        """(N, 3) points on the bark and (N, 3) outward unit normals."""
        u, v, _ = self.frames(height_m)
        r = self.radius(angle, height_m)[:, None]
        step = 0.02
        slope = (self.radius(np.asarray(angle) + step, height_m)[:, None] - r) / (step * r)
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        radial, tangent = cos * u + sin * v, cos * v - sin * u
        normals = radial - np.clip(slope, -1.5, 1.5) * tangent
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return self.axis(height_m) + r * radial, normals

    def diameters_cm(self, height_m: float) -> tuple[float, float, float]:
        """Tape, curve and area diameter of the section across the axis at one height."""
        angle = np.arange(_OUTLINE_POINTS) * (2 * np.pi / _OUTLINE_POINTS)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        h = np.full(_OUTLINE_POINTS, height_m)
        bark = self.radius(angle, h)[:, None] * direction
        curve = self.radius(angle, h, bark=False)[:, None] * direction
        girth = ConvexHull(bark).area  # in two dimensions `area` is the perimeter
        following = np.roll(curve, -1, axis=0)
        perimeter = np.linalg.norm(following - curve, axis=1).sum()
        area = 0.5 * np.abs((curve[:, 0] * following[:, 1] - curve[:, 1] * following[:, 0]).sum())
        return 100 * girth / np.pi, 100 * float(perimeter) / np.pi, 200 * float(np.sqrt(area / np.pi))


def _outline(rng: np.random.Generator, irregularity: float) -> Float64:
    """(7, 3) order, amplitude, phase: an ellipse of up to 12 % and harmonics 3 to 8 that die away."""
    orders = np.arange(2, 9)
    amplitudes = np.abs(rng.normal(0, 0.016, 7)) * (3.0 / np.maximum(orders, 3)) ** 1.6
    amplitudes[0] = rng.uniform(0.0, 0.055)
    return np.stack([orders, irregularity * amplitudes, rng.uniform(0, 2 * np.pi, 7)], axis=1)


def _diameters(rng: np.random.Generator, recipe: PlotRecipe) -> Float64:
    """(n_trees,) breast-height diameters in metres: the twins' first, then hidden, big, thin and ordinary ones."""
    low, high = recipe.dbh_min_cm, recipe.dbh_max_cm
    middle = low + (high - low) * rng.beta(1.6, 2.0, recipe.n_trees)
    n_first = 2 * recipe.n_twins + recipe.n_hidden
    middle[n_first : n_first + recipe.n_big] = rng.uniform(60, 90, recipe.n_big)
    start = n_first + recipe.n_big
    middle[start : start + recipe.n_thin] = rng.uniform(8, 12, recipe.n_thin)
    return middle / 100


def _positions(rng: np.random.Generator, recipe: PlotRecipe, radii: Float64) -> Float64:
    """(n_trees, 2) places that keep apart; twins share one. Falls back to the roomiest of the places tried."""
    margin = min(2.0, 0.15 * recipe.side_m)
    room = 0.62 * (recipe.side_m - 2 * margin) / np.sqrt(max(recipe.n_trees, 1))
    places: list[NDArray[np.float64]] = []
    for index, radius in enumerate(radii):
        if index < 2 * recipe.n_twins and index % 2:
            places.append(places[-1])
            continue
        tries = rng.uniform(margin, recipe.side_m - margin, (60, 2))
        if not places:
            places.append(tries[0])
            continue
        others = np.array(places)
        gaps = np.linalg.norm(tries[:, None] - others, axis=2) - radii[: len(others)] - radius
        nearest = gaps.min(axis=1)
        enough = np.flatnonzero(nearest > min(room, 2.5))
        places.append(tries[enough[0] if len(enough) else int(nearest.argmax())])
    return np.array(places).reshape(-1, 2)


def make_stems(rng: np.random.Generator, recipe: PlotRecipe) -> list[Stem]:
    """All stems of a plot, standing at z = 0; the scene sets them on its ground."""
    diameters = _diameters(rng, recipe)
    places = _positions(rng, recipe, diameters / 2)
    stems: list[Stem] = []
    for index, (diameter, place) in enumerate(zip(diameters, places, strict=True)):
        stems.append(_make_stem(rng, recipe, index, float(diameter), place, stems[-1] if stems else None))
    return stems


def _make_stem(
    rng: np.random.Generator, recipe: PlotRecipe, index: int, diameter_m: float, place: Float64, previous: Stem | None
) -> Stem:
    """One stem. What it is follows from its place in the order; see `_diameters`."""
    n_twin = 2 * recipe.n_twins
    twin, hidden = index < n_twin, n_twin <= index < n_twin + recipe.n_hidden
    dead = index >= recipe.n_trees - recipe.n_dead
    half = previous if twin and index % 2 else None
    angle, fork_angle = rng.uniform(0, 2 * np.pi, 2)
    fork = np.array([np.cos(fork_angle), np.sin(fork_angle)]) if twin else np.zeros(2)
    lean = np.tan(np.radians(recipe.lean_max_deg * rng.beta(1.2, 2.5) * (0.3 if twin else 1.0)))
    species = SPECIES[int(rng.choice(len(SPECIES), p=[species.share for species in SPECIES]))]
    if half is not None:
        fork, species = -half.fork, half.species
    height = float(3.3 + 27 * (1 - np.exp(-3.4 * diameter_m)) * rng.uniform(0.9, 1.1))
    buttress = recipe.irregularity * rng.uniform(0, 0.12)
    return Stem(
        tree_id=index + 1,
        base=np.array([place[0], place[1], 0.0]),
        height_m=height,
        radius_m=diameter_m / 2,
        lean=lean * np.array([np.cos(angle), np.sin(angle)]),
        sweep=rng.normal(0, 0.006 * height, 2),
        fork=fork,
        harmonics=_outline(rng, recipe.irregularity),
        twist=float(rng.normal(0, 0.05)),
        butt=np.array([rng.uniform(0.1, 0.45), rng.uniform(0.15, 0.3), float(rng.integers(3, 7)), buttress]),
        species=species,
        status="twin" if twin else "dead" if dead else "live",
        hidden_azimuth=float(rng.uniform(0, 2 * np.pi)) if hidden else None,
        bark_phase=rng.uniform(0, 2 * np.pi, 3),
        ridge_m=float(min(recipe.irregularity, 1.5) * species.ridge * diameter_m * rng.uniform(0.6, 1.3)),
    )
