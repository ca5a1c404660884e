"""Periodic cubic B-spline through the boundary of an alpha shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dbh_studio.core.arrays import Bool, Float64
from dbh_studio.core.curves.alpha import alpha_boundaries
from dbh_studio.core.curves.base import N_OUTLINE, distance_to_outline
from dbh_studio.settings import MeasureSettings

_SMOOTHNESS = 1e-4
_IN_CACHE = 100_000  # elements of a temporary array that is read again at once
_N_SECTORS, _N_OUTERMOST, _N_INNERMOST = 120, 4, 1


@dataclass(frozen=True)
class BSpline:
    """A uniform periodic cubic B-spline, fitted by least squares to the boundary's vertices.

    The paper names neither the alpha radius nor the number of control points nor the parametrisation; here:

    - the alpha radius is a multiple of the ring's radius (`MeasureSettings.alpha_radius`). Below about 1 the boundary
      of a partly seen stem runs back along the ring's inner side; at 2 it closes across the gap nearly by a chord;
    - `MeasureSettings.spline_controls` control points. More of them follow the noise and lengthen the perimeter;
    - vertices are parametrised by chord length. Where the boundary has too few vertices (a gap), a second-difference
      penalty 10⁻⁴ as strong as the data decides.

    Parameters are the control points, ``u1, v1, u2, v2, …``.
    """

    n_controls: int = 6
    alpha_radius: float = 2.0
    name: str = "bspline"
    n_score: int = 1500
    n_refit: int = 8

    @property
    def n_min(self) -> int:
        """As many points as control points."""
        return max(self.n_controls, 6)

    def configured(self, settings: MeasureSettings) -> BSpline:
        """With the control points and the alpha radius of the settings."""
        return replace(self, n_controls=settings.spline_controls, alpha_radius=settings.alpha_radius)

    def fit(self, uv: Float64, members: Bool) -> Float64:
        """(H, 2 n_controls) control points; one batched solve for all rows."""
        loops, valid = alpha_boundaries([_envelope(uv[row]) for row in members], radius=self.alpha_radius)
        count = valid.sum(axis=1)
        params = np.full((len(members), 2 * self.n_controls), np.nan)
        usable = (count >= 4) & (members.sum(axis=1) >= self.n_min)
        if usable.any():
            params[usable] = self._fit_loops(loops[usable], valid[usable])
        return params

    def _fit_loops(self, loops: Float64, valid: Bool) -> Float64:
        n_loops, length, _ = loops.shape
        count = valid.sum(axis=1)
        centre = loops.sum(axis=1, keepdims=True) / count[:, None, None]
        following = np.roll(loops, -1, axis=1)
        following[np.arange(n_loops), count - 1] = loops[:, 0]
        chord = np.where(valid, np.hypot(*np.moveaxis(following - loops, 2, 0)), 0.0)
        travelled = np.cumsum(chord, axis=1)
        parameter = (travelled - chord) / travelled[:, -1:]
        basis = _periodic_basis(parameter.ravel(), self.n_controls).reshape(n_loops, length, -1) * valid[..., None]
        transposed = np.swapaxes(basis, 1, 2)
        identity = np.eye(self.n_controls)
        bend = np.roll(identity, 1, axis=0) - 2 * identity + np.roll(identity, -1, axis=0)
        normal = transposed @ basis / count[:, None, None] + _SMOOTHNESS / self.n_controls * bend.T @ bend
        controls: Float64 = np.linalg.solve(normal, transposed @ (loops - centre) / count[:, None, None]) + centre
        return controls.reshape(n_loops, -1)

    def distance(self, params: Float64, uv: Float64) -> Float64:
        """(H, N) distance to the outline: exact for one curve, to the nearest of 72 vertices for many.

        The latter is too large by 4 % of the radius on the curve, and by 0.4 % at a tolerance of a quarter of the
        radius, where it decides.
        """
        if len(params) == 1:
            outline = self.outline(params[0])
            return distance_to_outline(uv, outline)[None] if len(outline) else np.full((1, len(uv)), np.inf)
        n_vertices = 72
        basis = _periodic_basis(np.arange(n_vertices) / n_vertices, self.n_controls)
        vertices = basis @ params.reshape(len(params), self.n_controls, 2)
        # |v - p|² - |p|² as one matrix product.
        lifted = np.concatenate([-2.0 * vertices, (vertices**2).sum(axis=2, keepdims=True)], axis=2)
        points = np.concatenate([uv.T, np.ones((1, len(uv)))])
        distance2 = np.empty((len(params), len(uv)))
        step = max(1, _IN_CACHE // (n_vertices * max(len(uv), 1)))
        for start in range(0, len(params), step):
            distance2[start : start + step] = (lifted[start : start + step] @ points).min(axis=1)
        distance2 += (uv**2).sum(axis=1)
        return np.where(np.isfinite(distance2), np.sqrt(np.maximum(distance2, 0.0)), np.inf)

    def outline(self, params: Float64) -> Float64:
        """(720, 2) vertices at equal parameter steps; empty for NaN."""
        if not np.isfinite(params).all():
            return np.empty((0, 2))
        outline: Float64 = _periodic_basis(np.arange(N_OUTLINE) / N_OUTLINE, self.n_controls) @ params.reshape(-1, 2)
        return outline


def _envelope(uv: Float64) -> Float64:
    """Only what can lie on the boundary of a crowded set: the outermost and innermost points of each 3° sector.

    The alpha shape of 20 000 points costs 0.1 s, and nearly all of them are inside it.
    """
    if len(uv) <= _N_SECTORS * (_N_OUTERMOST + _N_INNERMOST):
        return uv
    sector = ((np.arctan2(uv[:, 1], uv[:, 0]) + np.pi) * (_N_SECTORS / (2 * np.pi))).astype(np.int64) % _N_SECTORS
    order = np.lexsort([np.hypot(uv[:, 0], uv[:, 1]), sector])
    sizes = np.bincount(sector, minlength=_N_SECTORS)
    ends = np.cumsum(sizes)
    rank = np.arange(len(uv)) - np.repeat(ends - sizes, sizes)
    from_end = np.repeat(sizes, sizes) - rank
    return uv[order[(rank < _N_INNERMOST) | (from_end <= _N_OUTERMOST)]]


def _periodic_basis(parameter: Float64, n_controls: int) -> Float64:
    """(M, n_controls) uniform periodic cubic B-spline basis at (M,) parameters in [0, 1)."""
    position = (parameter % 1.0) * n_controls
    knot = np.floor(position).astype(np.int64)
    t = position - knot
    weights = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    basis = np.zeros((len(parameter), n_controls))
    rows = np.arange(len(parameter))
    for shift, weight in enumerate(weights):
        basis[rows, (knot + shift) % n_controls] += weight / 6.0
    return basis
