"""Why a stem has no diameter, and what would give it one, in words."""

from __future__ import annotations

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.estimator.evidence import Evidence
from dbh_studio.core.estimator.heap import HeapSigns
from dbh_studio.core.estimator.ring_count import OtherStem
from dbh_studio.core.estimator.tube import Tube
from dbh_studio.core.measured import Diameter, Refusal
from dbh_studio.settings import EstimatorSettings

_LOOK = "Look at the stem: remove what is not bark, or delete it if it is no tree."
_REMEDY = "Record the stem from its other side, or enter a tape value."
# Where so much is missing at a stretch it is said to be the arc, else the points.
_ARC_GAP_DEG = 120.0


def too_few(heights_m: Float64, n_used: int, stretch_m: tuple[float, float], least: int) -> Refusal:
    """Too few points, or none, between the lower and upper height of a stretch that must hold so many."""
    low, high = stretch_m
    if not len(heights_m):
        return Refusal("no_points", "The stem has no points.", "Segment the plot again, or add points by hand.")
    if n_used:
        reason = f"Only {n_used} points between {low:.2f} and {high:.2f} m above ground; {least} are needed."
        return Refusal("too_few_points", reason, "Record the stem from nearer, or enter a tape value.")
    lowest, highest = np.quantile(heights_m, [0.01, 0.99])
    return Refusal(
        "no_band",
        f"No points between {low:.2f} and {high:.2f} m above ground; they lie from {lowest:.2f} to {highest:.2f} m.",
        "Check the ground and the scale; if they are right, set another breast height.",
    )


def no_ring(n_points: int, settings: EstimatorSettings) -> Refusal:
    """Why points through which no ring can be laid have no diameter."""
    return Refusal(
        "no_ring",
        f"The {n_points} points about {settings.breast_height_m:.2f} m above ground do not form a ring.",
        _LOOK,
    )


def no_surface(settings: EstimatorSettings) -> Refusal:
    """Why a heap of points has no diameter, though some ring can be laid through any."""
    return Refusal(
        "no_ring",
        f"The points about {settings.breast_height_m:.2f} m above ground fill the place evenly; no ring stands out.",
        _LOOK,
    )


def clutter(signs: HeapSigns, settings: EstimatorSettings) -> Refusal:
    """Why what has a ring, but is none of bark, has no diameter."""
    return Refusal(
        "clutter",
        f"What is {settings.breast_height_m:.2f} m above ground looks like a shrub, a heap or a thing: {signs.words}.",
        "Delete it if it is no tree; if it is one, remove what is not bark, or enter a tape value.",
    )


def two_rings(main: Tube, others: tuple[OtherStem, ...], settings: EstimatorSettings) -> Refusal:
    """Why a section in which no one ring is clearly the stem meant has no diameter."""
    sizes = sorted((200.0 * tube.radius for tube in (main, *(each.tube for each in others))), reverse=True)
    said = ", ".join(f"{size:.0f}" for size in sizes[:-1]) + f" and {sizes[-1]:.0f} cm"
    where = f"at {settings.breast_height_m:.2f} m above ground"
    if any(each.kind == "fork" for each in others):
        reason = f"The stem forks below: {len(sizes)} rings {where}, about {said} thick."
        return Refusal("two_rings", reason, "Split it by stems and measure each, or measure below the fork.")
    reason = f"{len(sizes)} rings {where}, about {said} thick; none of them is clearly the stem meant."
    return Refusal("two_rings", reason, "Split it by stems, or remove the points of the other one.")


def too_uncertain(evidence: Evidence, chosen: Diameter, settings: EstimatorSettings) -> Refusal:
    """Why a diameter that is known too badly is not given."""
    between = f"anything from {chosen.low_cm:.0f} to {chosen.high_cm:.0f} cm would agree with the points"
    if evidence.gap_deg >= _ARC_GAP_DEG or evidence.arc_deg < settings.min_arc_deg:
        return Refusal("small_arc", f"Only {evidence.arc_deg:.0f}° of the ring seen: {between}.", _REMEDY)
    return Refusal("too_uncertain", f"The points are too few or too scattered; {between}.", _REMEDY)


def too_shallow(evidence: Evidence, sigma_m: float) -> Refusal:
    """Why an arc that is hardly deeper than its noise has no diameter: any curvature would agree with it."""
    scatter = f"the points scatter by {1000 * sigma_m:.0f} mm"
    if evidence.gap_deg >= _ARC_GAP_DEG:
        seen = f"Only {evidence.arc_deg:.0f}° of the ring seen and {scatter}"
        return Refusal("small_arc", f"{seen}: many diameters would agree with that.", _REMEDY)
    remedy = "Record the stem from nearer, or enter a tape value."
    return Refusal("too_uncertain", f"The stem is too thin for its points: {scatter}.", remedy)


def implausible(chosen: Diameter, settings: EstimatorSettings) -> Refusal:
    """Why a diameter that no stem has is not given."""
    limits = f"{settings.min_diameter_cm:g} to {settings.max_diameter_cm:g} cm"
    reason = f"The ring is {chosen.value_cm:.1f} cm thick, outside {limits}."
    return Refusal("implausible", reason, "Check the scale of the cloud; if it is right, change the limits.")
