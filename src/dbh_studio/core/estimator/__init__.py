"""The estimator of stem diameters with honest intervals: `estimate_diameter`."""

from dbh_studio.core.estimator.estimate import estimate_diameter
from dbh_studio.core.estimator.result import Diameter, EstimatorResult, Flag

__all__ = ["Diameter", "EstimatorResult", "Flag", "estimate_diameter"]
