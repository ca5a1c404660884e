"""Direct least-squares ellipse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dbh_studio.core.arrays import Bool, Float64
from dbh_studio.core.curves.base import N_OUTLINE
from dbh_studio.settings import MeasureSettings

_POWERS = [(i, j) for i in range(5) for j in range(5 - i)]
_COLUMN = {power: column for column, power in enumerate(_POWERS)}
_QUADRATIC, _LINEAR = ((2, 0), (1, 1), (0, 2)), ((1, 0), (0, 1), (0, 0))


def _columns(rows: tuple[tuple[int, int], ...], others: tuple[tuple[int, int], ...]) -> list[list[int]]:
    """Where the moments Σ of the products of two sets of monomials stand."""
    return [[_COLUMN[a + c, b + d] for c, d in others] for a, b in rows]


_S1, _S2, _S3 = _columns(_QUADRATIC, _QUADRATIC), _columns(_QUADRATIC, _LINEAR), _columns(_LINEAR, _LINEAR)


@dataclass(frozen=True)
class Ellipse:
    """Fitzgibbon, Pilu and Fisher (1999), in the numerically stable form of Halíř and Flusser (1998).

    Parameters are the conic ``A x² + B x y + C y² + D x + E y + F = 0``. The distance of a point is Sampson's
    first-order one, |f| / |∇f|, which on the outline's normal equals the geometric distance near the curve.
    """

    name: str = "ellipse"
    n_min: int = 6
    n_score: int = 1000
    n_refit: int = 0

    def configured(self, settings: MeasureSettings) -> Ellipse:
        """There is nothing to set."""
        return self

    def fit(self, uv: Float64, members: Bool) -> Float64:
        """(H, 6) conics. The scatter matrices of all rows come from fifteen moments, by one matrix product."""
        x, y = uv[:, :1] ** np.arange(5), uv[:, 1:] ** np.arange(5)
        monomials = np.stack([x[:, i] * y[:, j] for i, j in _POWERS], axis=1)
        count = members.sum(axis=1)
        moments = (members.astype(np.float64) @ monomials) / np.maximum(count, 1)[:, None]
        s1, s2, s3 = moments[:, _S1], moments[:, _S2], moments[:, _S3]
        usable = (count >= self.n_min) & (np.abs(np.linalg.det(s3)) > 1e-12)
        conics = np.full((len(members), 6), np.nan)
        if usable.any():
            conics[usable] = _constrained(s1[usable], s2[usable], s3[usable])
        return conics

    def distance(self, params: Float64, uv: Float64) -> Float64:
        """(H, N) Sampson distance; infinite for NaN rows."""
        x, y = uv.T
        one, zero = np.ones_like(x), np.zeros_like(x)
        value = params @ np.stack([x * x, x * y, y * y, x, y, one])
        slope_x = params @ np.stack([2 * x, y, zero, one, zero, zero])
        slope_y = params @ np.stack([zero, x, 2 * y, zero, one, zero])
        slope = np.sqrt(slope_x * slope_x + slope_y * slope_y)
        distance = np.abs(value) / np.maximum(slope, 1e-12)
        return np.where(np.isfinite(distance), distance, np.inf)

    def outline(self, params: Float64) -> Float64:
        """(720, 2) vertices at equal eccentric angles; empty where the conic is not a real ellipse."""
        a, b, c, d, e, f = params
        # Also false for NaN. What is left out are parabolas and hyperbolas, and ellipses 10⁵ times longer than wide.
        if not 4 * a * c - b * b > 1e-10 * max(a * a, b * b, c * c):
            return np.empty((0, 2))
        quadratic = np.array([[a, b / 2], [b / 2, c]])
        centre = np.linalg.solve(-2 * quadratic, np.array([d, e]))
        level = -(f + 0.5 * (d * centre[0] + e * centre[1]))
        eigenvalues, vectors = np.linalg.eigh(quadratic)
        squared = level / eigenvalues
        if not (squared > 0).all():
            return np.empty((0, 2))
        angle = np.arange(N_OUTLINE) * (2 * np.pi / N_OUTLINE)
        circle = np.stack([np.cos(angle), np.sin(angle)])
        outline: Float64 = centre + (vectors @ (np.sqrt(squared)[:, None] * circle)).T
        return outline


def _constrained(s1: Float64, s2: Float64, s3: Float64) -> Float64:
    """(H, 6) conics of least algebraic error under 4AC - B² = 1, from (H, 3, 3) scatter matrices."""
    linear_from_quadratic = -np.linalg.solve(s3, np.swapaxes(s2, 1, 2))
    reduced = s1 + s2 @ linear_from_quadratic
    reduced = np.stack([reduced[:, 2] / 2, -reduced[:, 1], reduced[:, 0] / 2], axis=1)
    _, vectors = np.linalg.eig(reduced)
    vectors = np.real(vectors)
    discriminant = 4 * vectors[:, 0] * vectors[:, 2] - vectors[:, 1] ** 2
    choice = discriminant.argmax(axis=1)
    rows = np.arange(len(choice))
    quadratic = vectors[rows, :, choice]
    quadratic[discriminant[rows, choice] <= 0] = np.nan
    linear = (linear_from_quadratic @ quadratic[..., None])[..., 0]
    return np.concatenate([quadratic, linear], axis=1)
