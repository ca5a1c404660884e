"""The estimator of stem diameters with honest intervals: `estimate_diameter`."""

from dbh_studio.core.estimator.estimate import assess_stem, estimate_diameter, heap_signs, stem_line
from dbh_studio.core.estimator.result import EstimatorResult
from dbh_studio.core.estimator.verdict import Assessment

__all__ = ["Assessment", "EstimatorResult", "assess_stem", "estimate_diameter", "heap_signs", "stem_line"]
