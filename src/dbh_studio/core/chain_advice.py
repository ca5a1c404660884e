"""Why the search for trunks lost something, and which setting with which value would bring it back.

Every value is computed from the criterion that dropped it. For clusters it is tried out on all clusters of that search,
so that it is known what else comes back with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from dbh_studio.core.chain_steps import NO_NORMAL, ChainSteps, Cluster, NearMiss, Step, keep_clusters
from dbh_studio.errors import SettingError
from dbh_studio.settings import TrunkSettings

# How far from the surface of a near miss a point still belongs to it.
_AT_MISS_M = 0.25


@dataclass(frozen=True)
class Advice:
    """Something to try.

    Attributes:
        text: In plain words.
        changes: Fields of `TrunkSettings` and their values; empty where no such setting would help.
        n_others: Dropped clusters that would come back, too.
    """

    text: str
    changes: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    n_others: int = 0


@dataclass(frozen=True)
class Story:
    """What became of one point or cluster.

    Attributes:
        step: Of the point.
        text: In plain words.
        advice: What would bring it back, what changes least first.
        cluster: Index of the cluster it was dropped with, or None.
    """

    step: Step
    text: str
    advice: tuple[Advice, ...] = ()
    cluster: int | None = None


def title(name: str) -> str:
    """What the panel calls a setting of the search."""
    return f"“{TrunkSettings.model_fields[name].title}”"


# ---- clusters


def story_of_cluster(steps: ChainSteps, index: int) -> Story:
    """Why a cluster is no trunk, and what would make it one."""
    cluster = steps.clusters[index]
    if cluster.kept:
        return Story(Step.KEPT, f"{cluster.n_points:,} points: kept as a trunk.")
    least = f"{math.ceil(steps.size_threshold):,}"
    allowed = f"the {least} that Otsu's threshold asks for"
    if steps.settings.smallest_cluster_points:
        allowed = f"the {least} that {title('smallest_cluster_points')} asks for"
    why = f"{cluster.n_points:,} points are fewer than {allowed}"
    if steps.settings.small_clusters == "otsu":
        why += ", and size alone decides"
        why += ", though it has the rings of a stem" if cluster.has_rings else ""
    else:
        why += ", and no rings of a stem were seen in it"
    return Story(Step.DROPPED, f"{why}.", _advice_for_cluster(steps, cluster), index)


def _advice_for_cluster(steps: ChainSteps, cluster: Cluster) -> tuple[Advice, ...]:
    tried: list[dict[str, Any]] = [
        {"smallest_cluster_points": _rounded_down(cluster.n_points)},
        {"smallest_cluster_points": cluster.n_points},
        {"small_clusters": "evidence", "smallest_cluster_points": 0},
        {"small_clusters": "keep"},
    ]
    found: list[tuple[int, int, Advice]] = []
    for changes in tried:
        effect = _effect(steps, changes)
        if effect is None or cluster not in effect[0]:
            continue
        back, lost = effect
        advice = Advice(
            _cluster_text(cluster, changes, len(back) - 1, len(lost)), MappingProxyType(changes), len(back) - 1
        )
        found.append((len(lost), len(back) - 1, advice))
    found.sort(key=lambda one: one[:2])
    kept: list[Advice] = []
    for *_, advice in found:
        # Of the round and the exact number one is enough.
        if all(advice.changes.keys() != other.changes.keys() for other in kept):
            kept.append(advice)
    return tuple(kept)


def _effect(steps: ChainSteps, changes: Mapping[str, Any]) -> tuple[list[Cluster], list[Cluster]] | None:
    """Clusters that changed settings would bring back, and those they would drop; None where they are out of bounds."""
    try:
        settings = steps.settings.changed(**changes)
    except SettingError:
        return None
    size = np.array([cluster.n_points for cluster in steps.clusters], np.float64)
    kept = keep_clusters(size, np.array([cluster.has_rings for cluster in steps.clusters], bool), settings)[0]
    pairs = list(zip(steps.clusters, kept.tolist(), strict=True))
    return [c for c, is_kept in pairs if is_kept > c.kept], [c for c, is_kept in pairs if is_kept < c.kept]


def _cluster_text(cluster: Cluster, changes: Mapping[str, Any], n_others: int, n_lost: int) -> str:
    rule, least = changes.get("small_clusters"), changes.get("smallest_cluster_points")
    if rule == "keep":
        text = f"Set {title('small_clusters')} to keep: all clusters stay"
    elif rule == "evidence" and cluster.has_rings:
        text = f"Set {title('small_clusters')} to evidence: what has rings of a stem stays"
    elif rule == "evidence":
        text = f"Set {title('small_clusters')} to evidence: the threshold then drops only what is smaller by far"
    else:
        text = f"Set {title('smallest_cluster_points')} to {least:,}"
    others = f"{n_others:,} other dropped {'cluster comes' if n_others == 1 else 'clusters come'} back too"
    lost = f"{n_lost:,} kept {'cluster goes' if n_lost == 1 else 'clusters go'}"
    effects = ", ".join(part for part, n in ((others, n_others), (lost, n_lost)) if n)
    return f"{text} ({effects or 'nothing else changes'})."


def _rounded_down(number: int) -> int:
    """To two digits."""
    unit = 10 ** max(len(str(number)) - 2, 0)
    return max(number // unit * unit, 1)


# ---- near misses


def story_of_miss(steps: ChainSteps, miss: NearMiss) -> Story:
    """Why rings that stack up are no stem, and what would make them one."""
    said = {
        "stem_length_m": f"they stack up over {miss.span_m:.1f} m only",
        "min_arc_deg": f"their mean arc is {miss.coverage_deg:.0f}°",
    }
    but = " and ".join(said[name] for name in miss.reasons)
    text = f"Rings of about {100 * miss.diameter_m:.0f} cm were seen here, but {but}."
    values = {
        "stem_length_m": _floor(miss.span_m, 0.1),
        "min_arc_deg": _floor(miss.coverage_deg, 1.0),
    }
    changes = {name: values[name] for name in miss.reasons}
    return Story(Step.NO_CANDIDATE, text, _if_allowed(steps, changes, "A stem is found here"))


def _floor(value: float, unit: float) -> float:
    # A hair less first: 0.8 in layers of 0.2 is 0.8000000001 or 0.79999999, and either must pass.
    return round(math.floor((value - 1e-6) / unit) * unit, 6)


def _if_allowed(steps: ChainSteps, changes: Mapping[str, Any], then: str) -> tuple[Advice, ...]:
    try:
        steps.settings.changed(**changes)
    except SettingError:
        return ()
    named = " and ".join(f"{title(name)} to {_value(name, value)}" for name, value in changes.items())
    return (Advice(f"Set {named}: {then}.", MappingProxyType(dict(changes))),)


def _value(name: str, value: Any) -> str:
    extra = TrunkSettings.model_fields[name].json_schema_extra
    unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
    return f"{value:g}{'' if unit == '°' else ' '}{unit}".rstrip()


# ---- points


def story_of_point(
    steps: ChainSteps, point: int, *, height_m: float, xy_m: tuple[float, float], n_near: int | None = None
) -> Story:
    """What became of one point of the cloud, and what would bring it to a trunk.

    Args:
        steps: Of the search.
        point: Row in the cloud.
        height_m: Its height above ground; NaN where not known.
        xy_m: Where it is, world.
        n_near: Points that faced sideways within the cluster distance of it, itself included, where they were counted.
    """
    step = Step(int(steps.labels[point]))
    if step == Step.DROPPED:
        return story_of_cluster(steps, steps.cluster_of(point) or 0)
    if step == Step.NO_CANDIDATE:
        return _no_candidate(steps, xy_m)
    if step in (Step.TOO_LOW, Step.TOO_HIGH):
        return _wrong_height(steps, step, height_m)
    if step == Step.NOT_SIDEWAYS:
        return _tilted(steps, steps.tilt_of(point) or NO_NORMAL)
    if step == Step.LOOSE:
        return _loose(steps, n_near)
    if step == Step.JOINED:
        return Story(step, f"It joined a trunk that is nearer than {title('expand_distance_m')}.")
    return Story(step, "It is part of a trunk's cluster.")


def _no_candidate(steps: ChainSteps, xy_m: tuple[float, float]) -> Story:
    settings = steps.settings
    if steps.from_masks:
        text = "The masks do not call it trunk: no photo does, or too few of those that see it."
        advice = Advice("Ask for fewer votes, or repaint the masks of the photos that show it.")
        return Story(Step.NO_CANDIDATE, text, (advice,))
    for miss in steps.near_misses:
        away = math.dist(xy_m, (miss.x_m, miss.y_m)) - 0.5 * miss.diameter_m
        if away <= _AT_MISS_M:
            return story_of_miss(steps, miss)
    s = settings
    text = (
        f"It is on no stem that was seen. A stem shows as rings, between {s.slab_low_m:g} and {s.slab_high_m:g} m "
        f"above ground, that stack up over {s.stem_length_m:g} m, have {s.min_arc_deg:g}° of arc and are "
        f"{s.min_diameter_cm:g} to {s.max_diameter_cm:g} cm thick."
    )
    names = ("stem_length_m", "min_arc_deg", "min_diameter_cm")
    lower = f"Lower {', '.join(title(name) for name in names[:2])} or {title(names[2])}, or mark the trunk by hand."
    return Story(Step.NO_CANDIDATE, text, (Advice(lower),))


def _wrong_height(steps: ChainSteps, step: Step, height_m: float) -> Story:
    settings = steps.settings
    # A stray point far outside is at the height of a stem, perhaps, and was not looked at all the same.
    is_told = height_m < settings.ground_clearance_m if step == Step.TOO_LOW else height_m >= settings.trunk_top_m
    if not is_told:
        return Story(step, "It is too far up, or too far outside the plot, to be looked at.")
    if step == Step.TOO_LOW:
        least = f"{title('ground_clearance_m')} is {settings.ground_clearance_m:g} m"
        text = f"It is {height_m:.2f} m above the ground; {least}."
        if height_m < 0.0:
            return Story(step, text, (Advice("It lies below the ground that was found: look at the ground settings."),))
        changes = {"ground_clearance_m": max(_floor(height_m, 0.01), 0.0)}
    else:
        text = f"It is {height_m:.1f} m above the ground; {title('trunk_top_m')} is {settings.trunk_top_m:g} m."
        changes = {"trunk_top_m": round(math.floor(height_m * 10.0 + 1.0) / 10.0, 6)}
    return Story(step, text, _if_allowed(steps, changes, "its height drops it no more"))


def _tilted(steps: ChainSteps, tilt_deg: int) -> Story:
    settings = steps.settings
    if tilt_deg == NO_NORMAL:
        text = "It has too few neighbours to tell which way the surface faces."
        changes = {"normal_radius_m": min(2.0 * settings.normal_radius_m, 1.0)}
        return Story(Step.NOT_SIDEWAYS, text, _if_allowed(steps, changes, "more neighbours are asked"))
    text = f"The surface leans {tilt_deg}° here; {title('normal_max_deg')} is {settings.normal_max_deg:g}°."
    advice = _if_allowed(steps, {"normal_max_deg": float(tilt_deg)}, "the surface is upright enough")
    return Story(Step.NOT_SIDEWAYS, text, advice)


def _loose(steps: ChainSteps, n_near: int | None) -> Story:
    settings = steps.settings
    text = "It is in no cluster: too few points are near it"
    text += "." if n_near is None else f" ({n_near:,}, where {settings.cluster_min_points:,} make a cluster)."
    changes: dict[str, Any] = {"cluster_distance_m": round(min(2.0 * settings.cluster_distance_m, 1.0), 3)}
    if n_near is not None and 2 <= n_near < settings.cluster_min_points:
        changes = {"cluster_min_points": n_near}
    return Story(Step.LOOSE, text, _if_allowed(steps, changes, "it has neighbours enough"))
