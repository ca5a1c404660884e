"""Robust fitting: the paper's RANSAC for any curve, and a robust circle for what must hold before a curve is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Bool, Float64, Int64
from dbh_studio.core.curves.base import Curve
from dbh_studio.core.medians import median

_HYPOTHESES_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class RansacFit:
    """The winner of a RANSAC.

    Attributes:
        params: (P,) of the curve, in the unit of the points.
        inliers: (N,) which points are within the tolerance of it.
    """

    params: Float64
    inliers: Bool


@dataclass(frozen=True, eq=False)
class Circle:
    """A robust circle.

    Attributes:
        centre_m: (2,) centre.
        radius_m: Radius.
        sigma_m: Robust standard deviation of the points it was fitted to.
    """

    centre_m: Float64
    radius_m: float
    sigma_m: float


def canonical_order(points: Float64) -> Int64:
    """(N,) indices that sort (N, D) finite points by their coordinates, whatever order they came in; the last first."""
    last = np.ascontiguousarray(points[:, -1])
    order = np.argsort(last)
    ranked = last[order]
    again = ranked[1:] == ranked[:-1]
    if again.any():  # only those that share the last coordinate need the others: ten times quicker than all by all
        places = np.flatnonzero(np.append(again, False) | np.insert(again, 0, False))
        tied = np.sort(order[places])
        order[places] = tied[np.lexsort(points[tied].T)]
    return order


def thinned(points: Float64, n_most: int, rng: np.random.Generator) -> Float64:
    """At most `n_most` of (N, D) points, drawn without replacement; their order is kept."""
    return points if len(points) <= n_most else points[np.sort(rng.choice(len(points), n_most, replace=False))]


def ransac(
    uv: Float64, curve: Curve, *, n_samples: int, tolerance: float, n_iterations: int, rng: np.random.Generator
) -> RansacFit | None:
    """The paper's loop (section III-E), batched: sample, fit, collect inliers, refit to them, keep the best supported.

    Departures: hypotheses with the same inliers are refitted once; a curve may refit only its best supported ones and
    may score on a random part of a large section (`Curve.n_refit`, `Curve.n_score`), the winner is then refitted to
    all of its inliers. With fewer than 5/4 `n_samples` points, four fifths of them are sampled. Equal support goes to
    the smaller residual.

    Args:
        uv: (N, 2) points.
        curve: What is fitted.
        n_samples: Points per hypothesis (paper: 50).
        tolerance: Inlier distance in the unit of `uv` (paper: 5 cm).
        n_iterations: Hypotheses (paper: 100).
        rng: Source of the samples.

    Returns:
        None where no closed curve has `curve.n_min` inliers.
    """
    if len(uv) < curve.n_min:
        return None
    scored = thinned(uv, curve.n_score, rng)
    n_samples = max(curve.n_min, min(n_samples, 4 * len(scored) // 5))
    best: tuple[float, Float64] | None = None
    for start in range(0, n_iterations, _HYPOTHESES_AT_ONCE):
        members = _samples(len(scored), n_samples, min(_HYPOTHESES_AT_ONCE, n_iterations - start), rng)
        candidate = _best_hypothesis(scored, curve, members, tolerance)
        if candidate is not None and (best is None or candidate[0] > best[0]):
            best = candidate
    if best is None:
        return None
    params = best[1]
    inliers = curve.distance(params[None], uv)[0] < tolerance
    if len(scored) < len(uv):
        refitted = curve.fit(uv, inliers[None])[0]
        if len(curve.outline(refitted)):
            params, inliers = refitted, curve.distance(refitted[None], uv)[0] < tolerance
    return RansacFit(params, inliers)


def _samples(n_points: int, n_samples: int, n_rows: int, rng: np.random.Generator) -> Bool:
    """(n_rows, n_points) with `n_samples` true per row, drawn without replacement."""
    members = np.zeros((n_rows, n_points), bool)
    if n_samples >= n_points:
        members[:] = True
        return members
    keys = rng.random((n_rows, n_points), dtype=np.float32)
    chosen = np.argpartition(keys, n_samples, axis=1)[:, :n_samples]
    np.put_along_axis(members, chosen, True, axis=1)
    return members


def _best_hypothesis(uv: Float64, curve: Curve, members: Bool, tolerance: float) -> tuple[float, Float64] | None:
    """Score and parameters of the best refitted hypothesis that is a closed curve."""
    inliers = curve.distance(curve.fit(uv, members), uv) < tolerance
    inliers = _unique_rows(inliers[inliers.sum(axis=1) >= curve.n_min])
    if not len(inliers):
        return None
    if curve.n_refit:
        inliers = inliers[np.argsort(-inliers.sum(axis=1), kind="stable")[: curve.n_refit]]
    params = curve.fit(uv, inliers)
    distance = curve.distance(params, uv)
    support = distance < tolerance
    # Below 1, so it decides between equal counts only.
    spread = (
        np.sqrt((np.where(support, distance, 0.0) ** 2).sum(axis=1) / np.maximum(support.sum(axis=1), 1)) / tolerance
    )
    score = support.sum(axis=1) - 0.99 * spread
    for row in np.argsort(-score, kind="stable"):
        if score[row] < curve.n_min - 1:
            break
        if len(curve.outline(params[row])):
            return float(score[row]), params[row]
    return None


def _unique_rows(rows: Bool) -> Bool:
    if len(rows) < 2:
        return rows
    first = {row.tobytes(): index for index, row in reversed(list(enumerate(np.packbits(rows, axis=1))))}
    return rows[sorted(first.values())]


def robust_circle(
    uv_m: Float64,
    *,
    tolerance_m: float,
    max_radius_m: float,
    rng: np.random.Generator,
    hint: Circle | None = None,
    effort: float = 1.0,
) -> Circle | None:
    """The circle most points lie on, whatever else is there: three-point circles by MSAC, refined by Tukey weights.

    MSAC: Torr and Zisserman (2000). Its score is reduced by the points well inside a circle, since stems are opaque:
    a wide circle through a stem and a shrub has the stem inside.

    Args:
        uv_m: (N, 2) points; at most 500 are looked at to choose among 200 hypotheses, 2000 to refine the best.
        tolerance_m: The RANSAC tolerance; a quarter of it, or of a smaller radius, counts as on the circle.
        max_radius_m: Larger circles are not considered.
        rng: Source of the samples.
        hint: A circle known from elsewhere: one more to consider, and only those within 40 % of it are.
        effort: Factor on these three numbers.

    Returns:
        None with fewer than 8 points, or where none lie on a circle of at most `max_radius_m`.
    """
    if len(uv_m) < 8:
        return None
    fitted = thinned(uv_m, int(2000 * effort), rng)
    scored = thinned(fitted, int(500 * effort), rng)
    triples = scored[rng.integers(0, len(scored), (int(200 * effort), 3))]
    centres, radii = circumcircles(triples)
    possible = np.isfinite(radii) & (radii < max_radius_m) & (radii > 0.1 * tolerance_m)
    if hint is not None:
        centres, radii = np.vstack([centres, hint.centre_m]), np.append(radii, hint.radius_m)
        distance = np.hypot(*(centres - hint.centre_m).T)
        possible = (distance < 0.4 * hint.radius_m) & (np.abs(radii / hint.radius_m - 1.0) < 0.4)
    centres, radii = centres[possible], radii[possible]
    if not len(radii):
        return None
    # Not `hypot`, which guards against overflows that metres do not have and takes five times as long.
    across, along = (scored[:, i] - centres[:, i, None] for i in (0, 1))
    error = np.sqrt(across * across + along * along) - radii[:, None]
    width = np.minimum(0.25 * tolerance_m, 0.25 * radii)[:, None]
    on = np.maximum(0.0, 1.0 - (error / width) ** 2)
    score = (on - 0.5 * (error < -2.5 * width)).sum(axis=1)
    best = int(score.argmax())
    return _refined(fitted, centres[best], float(radii[best]), tolerance_m, max_radius_m)


def circumcircles(triples: Float64) -> tuple[Float64, Float64]:
    """(H, 2) centres and (H,) radii through (H, 3, 2) points; not finite where these are on a line."""
    a = triples[:, 0]
    b, c = triples[:, 1] - a, triples[:, 2] - a
    doubled = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    b2, c2 = (b**2).sum(axis=1), (c**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x = (c[:, 1] * b2 - b[:, 1] * c2) / doubled
        y = (b[:, 0] * c2 - c[:, 0] * b2) / doubled
    return a + np.stack([x, y], axis=1), np.hypot(x, y)


def _refined(
    uv_m: Float64, centre_m: Float64, radius_m: float, tolerance_m: float, max_radius_m: float
) -> Circle | None:
    """Geometric circle by Gauss-Newton with Tukey's biweight; the weights' width follows the residuals."""
    state = np.array([*centre_m, radius_m])
    gate = min(tolerance_m, 0.4 * radius_m)
    sigma = gate
    for _ in range(12):
        offset = uv_m - state[:2]
        distance = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-12)
        error = distance - state[2]
        near = np.abs(error) < gate
        if near.sum() < 6:
            return None
        sigma = max(tukey_sigma(error[near]), 0.01 * tolerance_m)
        weight = tukey_weight(error, sigma) * near
        jacobian = np.column_stack([-offset / distance[:, None], -np.ones(len(uv_m))])
        normal = (jacobian * weight[:, None]).T @ jacobian
        step = np.linalg.solve(normal + 1e-9 * np.eye(3) * max(normal[2, 2], 1.0), -(jacobian.T @ (weight * error)))
        state = state + np.clip(step, -0.3 * radius_m, 0.3 * radius_m)
        if np.abs(step).max() < 1e-4 * radius_m:
            break
    if not (0.05 * tolerance_m < state[2] < max_radius_m):
        return None
    return Circle(state[:2], float(state[2]), float(sigma))


def tukey_sigma(error: Float64) -> float:
    """Robust standard deviation about zero: 1.4826 times the median absolute value."""
    return 1.4826 * median(np.abs(error))


def tukey_weight(error: Float64, sigma: float) -> Float64:
    """Tukey's biweight with the usual 4.685 sigma."""
    weight: Float64 = np.maximum(0.0, 1.0 - (error / (4.685 * sigma)) ** 2) ** 2
    return weight
