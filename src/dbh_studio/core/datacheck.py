"""What a cloud looks like before anything is measured in it, in plain words.

**The rule for units.** Numbers alone cannot tell an arbitrary structure-from-motion unit from a metre: at 1.33 metres
per unit every extent and every trunk still looks right. So provenance decides, and numbers only veto:

1. Degrees are refused. A factor given by the person is taken.
2. A unit declared by the file (its coordinate system, or E57, whose standard says metres) is taken.
3. A LiDAR format (LAS, LAZ, PCD) that names no photogrammetry software is taken as metres where heights, extent and
   trunk diameters are plausible in metres, and asked about where they are not (feet, millimetres).
4. Anything else (PLY, OBJ, GLB, STL, text, and LAS from photogrammetry without a coordinate system) **needs a scale**
   until the person gives one or says that it is metres, however plausible it looks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from dbh_studio.core.arrays import Float32, Float64
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.reconstruction import Provenance
from dbh_studio.core.stemcheck import StemEvidence, low_surface, stem_evidence
from dbh_studio.core.transforms import UP_AXES
from dbh_studio.core.treeids import find_tree_id_attribute
from dbh_studio.core.updirection import UpDirection, axis_vector, estimate_up, rotation_from_up

Level = Literal["ok", "note", "warn", "stop"]
Unit = Literal["metres", "feet", "millimetres", "arbitrary", "unclear"]
_LEVELS: tuple[Level, ...] = ("ok", "note", "warn", "stop")
_SAMPLE = 2_000_000
_BREAST_HEIGHT_M = 1.3
# The tallest tree is 116 m, but few plots pass 70 m; above that feet are likelier than metres.
_TALLEST_M = 70.0
_TALLEST_FEET = 250.0
_WIDEST_M = 5000.0
_SMALLEST_SFM = 3.0
_FEW_POINTS_PER_STEM = 100
_FEET = 0.3048
_THINNEST_M = 0.01


@dataclass(frozen=True)
class Finding:
    """One line of the check.

    Attributes:
        topic: ``points``, ``extent``, ``up``, ``unit``, ``density``, ``colour``, ``crs`` or ``tree ids``.
        level: ``ok``, ``note`` (good to know), ``warn`` (look at it) or ``stop`` (must be settled before measuring).
        message: What was found.
        remedy: What to do; empty where nothing is to be done.
    """

    topic: str
    level: Level
    message: str
    remedy: str = ""


@dataclass(frozen=True, eq=False)
class DataCheck:
    """The result of `check_cloud`.

    Attributes:
        findings: In the order they are shown.
        up_axis: The nearest of `UP_AXES`.
        up_confidence: 0 (assumed) to 1; 1 where the person chose.
        up_direction_src: (3,) unit vector; an axis exactly, unless the frame is tilted.
        rotation_world_from_source: (3, 3) the rotation that levels the cloud.
        has_ground: Whether a ground surface was seen.
        unit: What the source unit is taken or suspected to be.
        needs_scale: Whether nothing may be measured until the person gives a scale.
        metres_per_unit: The factor known; None while `needs_scale`.
        suggested_metres_per_unit: A factor to offer; None where there is no good guess.
        n_points: Number of points.
        extent_src: (3,) size of the levelled cloud, source units: two horizontal, then height.
        spacing_src: Estimated distance between neighbouring points, source units.
        stems: What stands at breast height; None where there is no scale, or no such height.
        tree_id_attribute: The attribute with existing tree ids, or None.
    """

    findings: tuple[Finding, ...]
    up_axis: str
    up_confidence: float
    up_direction_src: Float64
    rotation_world_from_source: Float64
    has_ground: bool
    unit: Unit
    needs_scale: bool
    metres_per_unit: float | None
    suggested_metres_per_unit: float | None
    n_points: int
    extent_src: Float64
    spacing_src: float
    stems: StemEvidence | None
    tree_id_attribute: str | None

    @property
    def level(self) -> Level:
        """The most serious level of all findings."""
        return max((finding.level for finding in self.findings), key=_LEVELS.index, default="ok")

    def finding(self, topic: str) -> Finding | None:
        """The finding on a topic, if there is one."""
        return next((finding for finding in self.findings if finding.topic == topic), None)


@dataclass(frozen=True)
class _UnitVerdict:
    unit: Unit
    metres_per_unit: float | None
    suggested: float | None
    finding: Finding
    stems: StemEvidence | None = None  # with the factor, where the verdict rests on them


def check_cloud(
    cloud: PointCloud,
    *,
    up_axis: str | None = None,
    metres_per_unit: float | None = None,
    provenance: Provenance | None = None,
) -> DataCheck:
    """Look at a cloud before measuring: points, extent, density, colour, up, coordinate system, units.

    Args:
        cloud: As loaded.
        up_axis: One of `UP_AXES` where the person chose; None estimates it.
        metres_per_unit: The scale where it is known; None applies the rule in this module's docstring.
        provenance: What the file says about itself; None goes by the suffix of the cloud's name.

    Raises:
        ValueError: `up_axis` or `metres_per_unit` is not valid.
    """
    if up_axis is not None and up_axis not in UP_AXES:
        raise ValueError(f"up axis {up_axis!r} is none of {', '.join(UP_AXES)}")
    if metres_per_unit is not None and not 0 < metres_per_unit < float("inf"):
        raise ValueError(f"metres per unit is {metres_per_unit} but must be positive")
    provenance = provenance or Provenance(cloud.name.rsplit(".", 1)[-1].lower() if "." in cloud.name else "")
    if not len(cloud):
        return _empty_check(up_axis)
    levelled = provenance.is_lidar or cloud.crs is not None
    # In a coordinate system the third coordinate is the height; nothing in the points overrules that.
    up = _up(cloud, up_axis or ("+z" if cloud.crs is not None else None), levelled)
    rotation = rotation_from_up(up.direction)
    sample = _levelled(cloud.xyz[:: max(1, len(cloud) // _SAMPLE)], rotation)
    extent = _extent(cloud, rotation)
    height = float(np.subtract(*np.quantile(sample[:, 2], [0.999, 0.001])))
    share = len(sample) / len(cloud)
    verdict = _unit(cloud, sample, share, extent, height, metres_per_unit, provenance)
    stems = verdict.stems
    if verdict.metres_per_unit is not None and height * verdict.metres_per_unit > _BREAST_HEIGHT_M:
        stems = stems or stem_evidence(sample, metres_per_unit=verdict.metres_per_unit, share=share)
        verdict = _doubted(verdict, stems)
    ids = find_tree_id_attribute(cloud)
    findings = (
        _points_finding(cloud),
        _extent_finding(extent, verdict),
        _up_finding(up, chosen=up_axis is not None, levelled=levelled, georeferenced=cloud.crs is not None),
        verdict.finding,
        _density_finding(stems, height, verdict),
        _colour_finding(cloud),
        _crs_finding(cloud, provenance),
        *_id_findings(ids),
    )
    return DataCheck(
        findings, up.axis, up.confidence, up.direction, rotation, up.has_ground, verdict.unit,
        verdict.metres_per_unit is None, verdict.metres_per_unit, verdict.suggested, len(cloud), extent,
        _spacing(sample, len(cloud)), stems, ids,
    )  # fmt: skip


def _empty_check(up_axis: str | None) -> DataCheck:
    axis = up_axis or "+z"
    finding = Finding("points", "stop", "The cloud has no points.", "Choose another file.")
    up = axis_vector(axis)
    zero = np.zeros(3)
    return DataCheck(
        (finding,), axis, 0.0, up, rotation_from_up(up), False, "unclear", True, None, None, 0, zero, 0.0, None, None
    )


def _up(cloud: PointCloud, up_axis: str | None, levelled: bool) -> UpDirection:
    """The person's choice, or the estimate; what is within its error of an axis is that axis."""
    if up_axis is not None:
        has_ground = estimate_up(cloud.xyz, axes_only=True, prior=up_axis).has_ground
        return UpDirection(axis_vector(up_axis), up_axis, 0.0, 1.0, has_ground)
    up = estimate_up(cloud.xyz, axes_only=levelled, prior="+z" if levelled else None)
    # Without ground only the stems tell, and single stems lean by some degrees.
    if up.off_axis_deg <= (1.5 if up.has_ground else 5.0) or up.confidence < 0.15:
        axis = up.axis if up.confidence >= 0.15 else "+z"
        return UpDirection(axis_vector(axis), axis, 0.0, up.confidence, up.has_ground)
    return up


def _levelled(xyz: Float32, rotation: Float64) -> Float64:
    """(N, 3) turned points; each coordinate lies in one piece, which all that follows is several times quicker on."""
    turned = np.empty((3, len(xyz)))
    axes = _axes_of(rotation)
    if axes is None:
        turned[:] = (np.asarray(xyz, np.float64) @ rotation.T).T
    else:
        for row, column, sign in axes:
            np.multiply(xyz[:, column], sign, out=turned[row])
    return turned.T


def _axes_of(rotation: Float64) -> list[tuple[int, int, float]] | None:
    """Row, column and sign of a rotation that only makes coordinates change places; else None."""
    signs = np.rint(rotation)
    if not np.allclose(rotation, signs, rtol=0.0, atol=1e-12):
        return None
    return [(row, int(column), float(signs[row, column])) for row, column in enumerate(np.abs(signs).argmax(axis=1))]


def _extent(cloud: PointCloud, rotation: Float64) -> Float64:
    """(3,) size along the levelled axes, over all points, a block at a time."""
    axes = _axes_of(rotation)
    if axes is not None:
        return np.array([float(np.ptp(cloud.xyz[:, column])) for _, column, _ in axes])
    turn = rotation.T.astype(np.float32)
    blocks = (cloud.xyz[i : i + 1_000_000] @ turn for i in range(0, len(cloud), 1_000_000))
    corners = [[[part.min(), part.max()] for part in block.T] for block in blocks]
    size: Float64 = np.max(corners, axis=0)[:, 1] - np.min(corners, axis=0)[:, 0]
    return size.astype(np.float64)


def _spacing(sample: Float64, n_points: int) -> float:
    """Distance between neighbours: that of a thinned sample, corrected for points that lie on surfaces."""
    thin = sample[:: max(1, len(sample) // 200_000)]
    if len(thin) < 2:
        return 0.0
    queries = thin[:: max(1, len(thin) // 2000)]
    # Neither balanced nor compact: built in half the time, and there are few queries.
    distances = cKDTree(thin, balanced_tree=False, compact_nodes=False).query(queries, k=2)[0][:, 1]
    return float(np.median(distances) * np.sqrt(len(thin) / n_points))


def _unit(
    cloud: PointCloud,
    sample: Float64,
    share: float,
    extent: Float64,
    height: float,
    given: float | None,
    provenance: Provenance,
) -> _UnitVerdict:
    """Apply the rule of the module's docstring."""
    if provenance.is_geographic:
        message = "The coordinates are degrees of longitude and latitude, in which nothing can be measured."
        remedy = "Convert the cloud to a projected system (UTM, or the national grid) first."
        return _UnitVerdict("unclear", None, None, Finding("unit", "stop", message, remedy))
    if given is not None:
        unit: Unit = _nearest_unit(given)
        return _UnitVerdict(unit, given, given, Finding("unit", "ok", f"One unit is {given:.6g} m, as given."))
    declared = provenance.metres_per_unit
    if declared is not None:
        unit = _nearest_unit(declared)
        message = f"The file says that its unit is {'the metre' if declared == 1.0 else f'{declared:.6g} m ({unit})'}."
        return _UnitVerdict(unit, declared, declared, Finding("unit", "ok", message))
    canopy = float(np.quantile(low_surface(sample).height_above(sample), 0.995))
    if provenance.is_lidar:
        return _lidar_unit(sample, share, extent, min(canopy, height), provenance)
    return _sfm_unit(cloud, extent, min(canopy, height))


def _doubted(verdict: _UnitVerdict, stems: StemEvidence) -> _UnitVerdict:
    """A known scale that makes the stems impossible is kept, but said to be doubtful."""
    diameter = stems.median_diameter_m
    if diameter is None or stems.n_round < 3 or diameter >= _THINNEST_M:
        return verdict
    message = f"{verdict.finding.message} The stems would be {100 * diameter:,.3g} cm thick."
    return replace(verdict, finding=Finding("unit", "warn", message, "Check the scale."))


def _nearest_unit(factor: float) -> Unit:
    if abs(factor - 1.0) < 1e-9:
        return "metres"
    if abs(factor - _FEET) < 1e-5:
        return "feet"
    return "millimetres" if abs(factor - 0.001) < 1e-9 else "arbitrary"


def _ask(unit: Unit, suggested: float | None, message: str) -> _UnitVerdict:
    remedy = (
        "Give a scale: say which unit it is, type metres per unit, or measure markers or a known distance (in the "
        "studio under Scale, on the command line with `dbh-studio scale`)."
    )
    return _UnitVerdict(unit, None, suggested, Finding("unit", "stop", message, remedy))


def _lidar_unit(sample: Float64, share: float, extent: Float64, canopy: float, provenance: Provenance) -> _UnitVerdict:
    """Metres, unless the numbers say that they cannot be."""
    name = provenance.format.upper()
    widest = float(extent.max())
    if canopy > 1000.0 and widest < 1000.0 * _WIDEST_M:
        return _ask("millimetres", 0.001, f"The vegetation is {canopy:,.0f} units high: these look like millimetres.")
    if canopy > _TALLEST_M:
        suggested = _FEET if canopy <= _TALLEST_FEET else None
        looks = "these look like feet" if suggested else "these cannot be metres"
        return _ask(
            "feet" if suggested else "unclear", suggested, f"The vegetation is {canopy:.0f} units high: {looks}."
        )
    if widest > _WIDEST_M or widest < 0.05:
        return _ask("unclear", None, f"The cloud is {widest:,.4g} units wide, which is not a plot in metres.")
    stems = stem_evidence(sample, metres_per_unit=1.0, share=share) if canopy > _BREAST_HEIGHT_M else None
    diameter = stems.median_diameter_m if stems is not None and stems.n_round >= 3 else None
    if diameter is not None and diameter < _THINNEST_M:
        return _ask("unclear", None, f"Taken as metres, the stems would be {100 * diameter:,.2g} cm thick.")
    message = f"{name} files come from scanners and are in metres unless they say otherwise; the numbers agree."
    return _UnitVerdict("metres", 1.0, 1.0, Finding("unit", "ok", message), stems)


def _sfm_unit(cloud: PointCloud, extent: Float64, canopy: float) -> _UnitVerdict:
    """A scale is asked for; the numbers only choose the words."""
    widest = float(extent.max())
    if widest > _WIDEST_M and 1000.0 < canopy < 1000.0 * _TALLEST_M:
        return _ask("millimetres", 0.001, f"The cloud is {widest:,.0f} units wide: these may be millimetres.")
    if widest < _SMALLEST_SFM or widest > _WIDEST_M:
        return _ask("arbitrary", None, f"The cloud is {widest:,.3g} units wide: it has an arbitrary scale.")
    if np.abs(cloud.origin[:2]).max() > 10_000.0:
        message = "The coordinates look like those of a survey grid, probably in metres, but the file does not say so."
        return _ask("unclear", 1.0, message)
    message = (
        "The file does not say what its unit is. Photogrammetry without markers has an arbitrary scale, which looks"
        " like metres and is not."
    )
    return _ask("unclear", None, message)


def _points_finding(cloud: PointCloud) -> Finding:
    if len(cloud) < 1000:
        return Finding("points", "warn", f"There are only {len(cloud):,} points.", "Load the dense cloud.")
    return Finding("points", "ok", f"{len(cloud):,} points.")


def _extent_finding(extent: Float64, verdict: _UnitVerdict) -> Finding:
    factor = verdict.metres_per_unit or 1.0
    name = "m" if verdict.metres_per_unit else "units"
    width, depth, height = extent * factor
    return Finding("extent", "ok", f"{width:.4g} x {depth:.4g} {name}, {height:.4g} {name} high.")


def _up_finding(up: UpDirection, *, chosen: bool, levelled: bool, georeferenced: bool) -> Finding:
    remedy = "If the plot lies on its side or head, choose the up axis yourself."
    if chosen:
        return Finding("up", "ok", f"{up.axis} is up, as chosen.")
    if georeferenced:
        return Finding("up", "ok", f"{up.axis} is up, as in every coordinate system.")
    if up.confidence < 0.15:
        if levelled and up.axis == "+z":
            return Finding("up", "ok", "+z is up, as in every survey format.")
        return Finding("up", "warn", f"The up direction is not clear; {up.axis} was assumed.", remedy)
    if up.off_axis_deg > 0:
        message = f"The frame is tilted: up is {up.off_axis_deg:.1f}° off {up.axis}. The plot is levelled."
        return Finding("up", "note", message, remedy)
    if up.axis == "+z":
        return Finding("up", "ok", "+z is up.")
    return Finding("up", "note", f"{up.axis} is up in this file; the plot is turned.", remedy)


def _density_finding(stems: StemEvidence | None, height: float, verdict: _UnitVerdict) -> Finding:
    if verdict.metres_per_unit is None:
        return Finding("density", "note", "The density at breast height can be judged once there is a scale.")
    if stems is None:
        tall = height * verdict.metres_per_unit
        return Finding("density", "note", f"The cloud is a slice {tall:.2f} m high, without ground or crowns.")
    if not stems.n_stems:
        return Finding(
            "density",
            "warn",
            "Nothing that looks like a stem stands at breast height.",
            "Check the scale and the up axis.",
        )
    message = (
        f"About {stems.n_stems} stem-like groups at breast height, {stems.points_per_stem:,.0f} points each"
        f" ({stems.points_per_m2:,.0f} points per m² of bark)."
    )
    if stems.points_per_stem < _FEW_POINTS_PER_STEM:
        return Finding("density", "warn", message, "That is sparse: use the dense cloud, or take more pictures.")
    return Finding("density", "ok", message)


def _colour_finding(cloud: PointCloud) -> Finding:
    if cloud.rgb is None:
        return Finding("colour", "note", "The points have no colours; they are shown by height.")
    return Finding("colour", "ok", "The points have colours.")


def _crs_finding(cloud: PointCloud, provenance: Provenance) -> Finding:
    if cloud.crs is None:
        return Finding("crs", "note", "The file names no coordinate system; positions are local.")
    name = cloud.crs if len(cloud.crs) < 40 else cloud.crs.split('"')[1] if '"' in cloud.crs else cloud.crs[:40]
    return Finding("crs", "warn" if provenance.is_geographic else "ok", f"Coordinate system: {name}.")


def _id_findings(attribute: str | None) -> tuple[Finding, ...]:
    if attribute is None:
        return ()
    return (Finding("tree ids", "ok", f"The points carry tree ids ({attribute}), which can be taken over."),)
