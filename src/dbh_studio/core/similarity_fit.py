"""The similarity between two sets of corresponding points, and the one that keeps the vertical upright."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dbh_studio.core.arrays import as_points
from dbh_studio.core.transforms import Similarity


def fit_similarity(source: ArrayLike, target: ArrayLike, *, with_scale: bool = True) -> tuple[Similarity, float]:
    """``target_from_source`` of least squares (Umeyama 1991), and the root mean square distance left.

    Args:
        source: (N, 3), at least three points that do not lie on one line.
        target: (N, 3) the same points in the other frame.
        with_scale: Whether the scale is free; else it is 1.

    Raises:
        ValueError: Too few points, or they lie on one line, so a turn about it is not determined.
    """
    source_points = as_points(source, name="source").astype(np.float64)
    target_points = as_points(target, name="target").astype(np.float64)
    if source_points.shape != target_points.shape or len(source_points) < 3:
        raise ValueError(f"{source_points.shape} and {target_points.shape} points; at least three pairs are needed")
    source_mean, target_mean = source_points.mean(axis=0), target_points.mean(axis=0)
    a, b = source_points - source_mean, target_points - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    if singular[1] <= 1e-12 * singular[0]:
        raise ValueError("the points lie on one line, so the rotation is not determined")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float((singular * signs).sum() / (a * a).sum() * len(a)) if with_scale else 1.0
    fitted = Similarity(rotation, target_mean - scale * rotation @ source_mean, scale)
    left = target_points - fitted.apply(source_points)
    return fitted, float(np.sqrt((left * left).sum(axis=1).mean()))


def fit_upright(source: ArrayLike, target: ArrayLike, *, with_scale: bool = True) -> tuple[Similarity, float]:
    """As `fit_similarity` where both frames have z up: only the turn about the vertical is free.

    Args:
        source: (N, 3), at least two points that do not lie above each other; a straight level line is enough.
        target: (N, 3) the same points in the other frame.
        with_scale: Whether the scale is free; else it is 1.

    Raises:
        ValueError: Too few points, or they lie above each other, so the turn is not determined.
    """
    source_points = as_points(source, name="source").astype(np.float64)
    target_points = as_points(target, name="target").astype(np.float64)
    if source_points.shape != target_points.shape or len(source_points) < 2:
        raise ValueError(f"{source_points.shape} and {target_points.shape} points; at least two pairs are needed")
    source_mean, target_mean = source_points.mean(axis=0), target_points.mean(axis=0)
    a, b = source_points - source_mean, target_points - target_mean
    # In plan, as complex numbers, the turn is the direction of this product.
    product = complex((np.conj(a[:, 0] + 1j * a[:, 1]) * (b[:, 0] + 1j * b[:, 1])).sum())
    if abs(product) <= 1e-12 * float((a * a).sum()):
        raise ValueError("the points lie above each other, so the turn is not determined")
    cosine, sine = product.real / abs(product), product.imag / abs(product)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    scale = (abs(product) + float((a[:, 2] * b[:, 2]).sum())) / float((a * a).sum()) if with_scale else 1.0
    if not scale > 0.0:
        raise ValueError("the heights of the points contradict each other")
    fitted = Similarity(rotation, target_mean - scale * rotation @ source_mean, scale)
    left = target_points - fitted.apply(source_points)
    return fitted, float(np.sqrt((left * left).sum(axis=1).mean()))
