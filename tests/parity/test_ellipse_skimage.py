"""The ellipse against scikit-image's independent implementation of the same algorithm."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.curves import Ellipse
from dbh_studio.core.curves.base import outline_metrics

pytestmark = pytest.mark.parity
measure = pytest.importorskip("skimage.measure")


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("arc_deg", [360, 220, 150])
@pytest.mark.parametrize("seed", [0, 1])
def test_same_ellipse(noise, arc_deg, seed):
    rng = np.random.default_rng(seed)
    t = rng.uniform(0, np.radians(arc_deg), 200)
    turn = rng.uniform(0, np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    uv = np.stack([1.1 * np.cos(t), 0.9 * np.sin(t)], axis=1) @ rotation.T + noise * rng.standard_normal((200, 2))
    model = measure.EllipseModel.from_estimate(uv)
    assert model
    a, b = model.axis_lengths
    angle = np.linspace(0, 2 * np.pi, 20001)
    theirs = np.hypot(*np.diff(np.stack([a * np.cos(angle), b * np.sin(angle)]), axis=1)).sum()
    ours = Ellipse()
    outline = ours.outline(ours.fit(uv, np.ones((1, 200), bool))[0])
    # Halíř and Flusser's problem depends on the frame's unit; the two normalise differently.
    assert outline_metrics(outline)[0] == pytest.approx(theirs, rel=1e-5)
    np.testing.assert_allclose(outline.mean(axis=0), model.center, atol=1e-5)
