"""The closed curves a cross-section can be fitted with, by name.

A new curve is one class here and one name in `settings.CurveName`. The methods that are more than a curve on a section
(``shrinkage``, ``circle``) are `core.interval_methods`'.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from dbh_studio.core.curves.base import Curve
from dbh_studio.core.curves.bspline import BSpline
from dbh_studio.core.curves.ellipse import Ellipse
from dbh_studio.core.curves.fourier import Fourier

CURVES: Mapping[str, Curve] = MappingProxyType({"fourier": Fourier(), "ellipse": Ellipse(), "bspline": BSpline()})
"""Every curve with its default choices; `Curve.configured` applies the settings."""

CURVE_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "shrinkage": "shrinkage",
        "circle": "circle",
        "fourier": "Fourier",
        "ellipse": "ellipse",
        "bspline": "B-spline",
    }
)
"""What each is called within a sentence."""

__all__ = ["CURVES", "CURVE_WORDS", "BSpline", "Curve", "Ellipse", "Fourier"]
