"""Truncated Fourier series in polar coordinates: the paper's most robust curve (section III-E)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Bool, Float, Float64
from dbh_studio.core.curves.base import N_OUTLINE
from dbh_studio.settings import MeasureSettings


@dataclass(frozen=True)
class Fourier:
    """r(t) = a0 + Σ aᵢ cos(i t) + bᵢ sin(i t), by one linear least-squares problem in the radius.

    Parameters are ``a0, a1, b1, a2, b2, …``. The distance of a point is radial, |r - r(t)|, which is what the paper's
    linear problem minimises. The paper leaves the polar origin open: see `MeasureSettings.polar_origin`.
    """

    degree: int = 2
    name: str = "fourier"
    n_score: int = 1000
    n_refit: int = 0

    @property
    def n_min(self) -> int:
        """As many points as coefficients, and one more."""
        return 2 * self.degree + 2

    def configured(self, settings: MeasureSettings) -> Fourier:
        """With the degree of the settings."""
        return replace(self, degree=settings.fourier_degree)

    def fit(self, uv: Float64, members: Bool) -> Float64:
        """(H, 2 degree + 1) coefficients; normal equations of all rows by one matrix product."""
        basis, radius = self._basis(np.arctan2(uv[:, 1], uv[:, 0])), np.hypot(uv[:, 0], uv[:, 1])
        n_params = basis.shape[1]
        products = (basis[:, :, None] * basis[:, None, :]).reshape(len(uv), n_params**2)
        sums = members.astype(np.float64) @ np.concatenate([products, basis * radius[:, None]], axis=1)
        normal = sums[:, : n_params**2].reshape(-1, n_params, n_params)
        count = members.sum(axis=1)
        # A ridge far below any measurement keeps rows whose points share few directions solvable.
        normal = normal + 1e-10 * np.maximum(count, 1)[:, None, None] * np.eye(n_params)
        params = np.linalg.solve(normal, sums[:, n_params**2 :, None])[..., 0]
        params[count < self.n_min] = np.nan
        return params

    def distance(self, params: Float64, uv: Float64) -> Float64:
        """(H, N) radial distance; infinite for NaN rows."""
        basis, radius = self._basis(np.arctan2(uv[:, 1], uv[:, 0])), np.hypot(uv[:, 0], uv[:, 1])
        distance = np.abs(params @ basis.T - radius)
        return np.where(np.isfinite(distance), distance, np.inf)

    def outline(self, params: Float64) -> Float64:
        """(720, 2) vertices at equal angles; empty where the radius is not positive everywhere."""
        angle = np.arange(N_OUTLINE) * (2 * np.pi / N_OUTLINE)
        radius = self._basis(angle) @ params
        if not (np.isfinite(radius).all() and radius.min() > 0):
            return np.empty((0, 2))
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)

    def _basis(self, angle: Float) -> Float64:
        multiples = angle[:, None] * np.arange(1, self.degree + 1)
        waves = np.stack([np.cos(multiples), np.sin(multiples)], axis=2).reshape(len(angle), 2 * self.degree)
        return np.concatenate([np.ones((len(angle), 1)), waves], axis=1)
