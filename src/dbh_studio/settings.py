"""Every setting a person may change: title, unit, bounds, and why one would.

The fields build the panels, ``--help`` and the error text, so what they say is said once. Frozen: a change is a new
value.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dbh_studio.errors import SettingError

CurveName = Literal["fourier", "ellipse", "bspline"]


def setting(default: Any, title: str, *, unit: str = "", help: str = "", **bounds: Any) -> Any:
    """A pydantic field with the unit kept where the panels and the command line find it."""
    return Field(default, title=title, description=help, json_schema_extra={"unit": unit}, **bounds)


class SettingsModel(BaseModel):
    """Frozen, and strict about names: a misspelt setting is an error, not silence.

    Attributes:
        ascending: Pairs of fields of which the first must be the smaller.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)
    ascending: ClassVar[tuple[tuple[str, str], ...]] = ()

    @model_validator(mode="after")
    def _check_ascending(self) -> SettingsModel:
        fields = type(self).model_fields
        for low, high in self.ascending:
            if not getattr(self, low) < getattr(self, high):
                raise ValueError(
                    f"{fields[low].title} ({low}) is {getattr(self, low)} but must be less than "
                    f"{fields[high].title} ({high}), which is {getattr(self, high)}"
                )
        return self

    def changed(self, **values: Any) -> Any:
        """A copy with some fields changed and checked.

        Raises:
            SettingError: Names the setting, the value and the allowed range.
        """
        try:
            return type(self).model_validate({**self.model_dump(), **values})
        except ValidationError as error:
            raise setting_error(type(self), error) from None


def setting_error(model: type[BaseModel], error: ValidationError) -> SettingError:
    """The first problem of a pydantic error, in plain words."""
    first = error.errors()[0]
    if first["type"] == "value_error":  # of our own checks, which name the settings themselves
        return SettingError(f"{first['ctx']['error']}.")
    path = [str(part) for part in first["loc"]]
    owner: Any = model
    for part in path[:-1]:
        annotation = owner.model_fields[part].annotation if part in getattr(owner, "model_fields", {}) else None
        owner = annotation if annotation is not None else owner
    field = getattr(owner, "model_fields", {}).get(path[-1]) if path else None
    title = f"{field.title} ({'.'.join(path)})" if field is not None and field.title else ".".join(path)
    return SettingError(f"{title}: {first['msg']}.", f"The value given was {first.get('input')!r}.")


class GroundSettings(SettingsModel):
    """How the ground under the stems is found."""

    method: Literal["terrain", "plane"] = setting(
        "terrain", "Ground model", help="terrain follows slopes and hollows; plane is the paper's single RANSAC plane"
    )
    cell_m: float = setting(0.5, "Terrain cell", unit="m", ge=0.1, le=5.0, help="larger on sparse clouds")
    max_slope_deg: float = setting(
        60.0, "Steepest terrain", unit="°", ge=10.0, le=80.0, help="what is steeper is taken for a stem or a shrub"
    )
    plane_tolerance_m: float = setting(
        0.15, "Plane tolerance", unit="m", ge=0.01, le=2.0, help="points this near the plane count as ground"
    )
    plane_iterations: int = setting(1000, "Plane RANSAC iterations", ge=10, le=100_000)


class TrunkSettings(SettingsModel):
    """How trunks are found: a geometric detector or given labels, then the paper's chain."""

    ascending = (("slab_low_m", "slab_high_m"), ("min_diameter_cm", "max_diameter_cm"))

    normal_max_deg: float = setting(
        45.0,
        "Largest trunk tilt",
        unit="°",
        ge=5.0,
        le=85.0,
        help="a trunk's surface normal is within this of horizontal",
    )
    ground_clearance_m: float = setting(
        0.30, "Ground clearance", unit="m", ge=0.0, le=1.0, help="points lower than this above ground are not trunk"
    )
    slab_low_m: float = setting(0.6, "Search from", unit="m", ge=0.1, le=5.0, help="height above ground")
    slab_high_m: float = setting(3.5, "Search to", unit="m", ge=1.0, le=20.0, help="height above ground")
    stem_length_m: float = setting(
        1.0,
        "Shortest stem seen",
        unit="m",
        ge=0.4,
        le=10.0,
        help="rings must stack up over so much of the search heights",
    )
    min_arc_deg: float = setting(
        100.0,
        "Smallest arc seen",
        unit="°",
        ge=30.0,
        le=350.0,
        help="mean arc of a stem's rings; larger finds fewer, surer",
    )
    trunk_top_m: float = setting(
        8.0, "Trunk top", unit="m", ge=2.0, le=40.0, help="trunks are followed up to this height"
    )
    thinning_m: float = setting(
        0.02,
        "Working resolution",
        unit="m",
        ge=0.005,
        le=0.2,
        help="one point per cube of this edge; coarser on large plots",
    )
    normal_radius_m: float = setting(
        0.08, "Normal radius", unit="m", ge=0.01, le=1.0, help="neighbourhood of a normal; wider on sparse clouds"
    )
    cluster_distance_m: float = setting(
        0.10, "Cluster distance", unit="m", ge=0.005, le=1.0, help="DBSCAN: neighbours nearer than this belong together"
    )
    cluster_min_points: int = setting(
        10, "Cluster neighbours", ge=2, le=10_000, help="DBSCAN: a core point has so many"
    )
    small_clusters: Literal["evidence", "otsu", "keep"] = setting(
        "evidence",
        "Small clusters",
        help="evidence: Otsu's threshold on size, but stems proven by rings stay; otsu: the paper; keep: all stay",
    )
    expand_distance_m: float = setting(
        0.06, "Expansion distance", unit="m", ge=0.0, le=1.0, help="points this near a cluster join it"
    )
    min_diameter_cm: float = setting(5.0, "Thinnest trunk", unit="cm", ge=1.0, le=100.0)
    max_diameter_cm: float = setting(200.0, "Thickest trunk", unit="cm", ge=10.0, le=1000.0)
    use_existing_ids: bool = setting(
        True, "Take over tree ids", help="use treeID, tree_id, PredInstance … where the cloud has them"
    )


class MeasureSettings(SettingsModel):
    """How a diameter is measured."""

    ascending = (("min_diameter_cm", "max_diameter_cm"),)

    curve: CurveName = setting("fourier", "Curve", help="the paper's three; it found Fourier the most robust")
    breast_height_m: float = setting(
        1.30,
        "Breast height",
        unit="m",
        ge=0.3,
        le=5.0,
        help="1.30 Europe and Canada, 1.37 USA (4.5 ft), 1.40 New Zealand",
    )
    band_below_m: float = setting(
        0.08,
        "Band below",
        unit="m",
        ge=0.01,
        le=1.0,
        help="0.08 below and 0.22 above 1.30 m is the paper's 1.22-1.52 m",
    )
    band_above_m: float = setting(0.22, "Band above", unit="m", ge=0.01, le=1.0)
    definition: Literal["curve", "tape", "area"] = setting(
        "curve",
        "Diameter",
        help="curve: perimeter/π (the paper); tape: convex girth/π, what a tape reads; area: of the equal circle",
    )
    ransac_samples: int = setting(50, "RANSAC sample", unit="points", ge=6, le=1000)
    ransac_tolerance_m: float = setting(0.05, "RANSAC tolerance", unit="m", ge=0.002, le=0.5)
    ransac_iterations: int = setting(100, "RANSAC iterations", ge=1, le=10_000)
    axis: Literal["stem", "vertical"] = setting(
        "stem", "Stem axis", help="stem: fitted to the stem around breast height, vertical where too little is seen"
    )
    polar_origin: Literal["ring", "centroid"] = setting(
        "ring",
        "Polar origin",
        help="ring: centre of a robust circle; centroid: mean point, pulled towards the seen side",
    )
    fourier_degree: int = setting(2, "Fourier degree", ge=1, le=8, help="the paper's is 2")
    spline_controls: int = setting(
        6, "Spline control points", ge=4, le=64, help="more follow the bark, and the noise, more closely"
    )
    alpha_radius: float = setting(
        2.0, "Alpha radius", unit="ring radii", ge=0.1, le=50.0, help="smaller follows hollows of the boundary"
    )
    ring_gate: float = setting(
        0.35,
        "Ring gate",
        unit="ring radii",
        ge=0.0,
        le=10.0,
        help="points farther than this and the tolerance from a robust circle are left out; 0 keeps all (the paper)",
    )
    tolerance_share: float = setting(
        0.5,
        "Tolerance of thin stems",
        unit="ring radii",
        ge=0.0,
        le=10.0,
        help="the RANSAC tolerance is at most this share of the radius; 0 keeps it fixed (the paper)",
    )
    min_diameter_cm: float = setting(2.0, "Smallest diameter", unit="cm", ge=0.5, le=100.0)
    max_diameter_cm: float = setting(300.0, "Largest diameter", unit="cm", ge=10.0, le=1500.0)
    min_points: int = setting(30, "Fewest points in the band", ge=8, le=100_000)
    min_coverage_deg: float = setting(
        90.0, "Smallest arc seen", unit="°", ge=0.0, le=360.0, help="with less of the ring seen no diameter is given"
    )
    seed: int = setting(0, "Random seed", ge=0, le=2**31 - 1)


class MarkerSettings(SettingsModel):
    """How printed markers are found in photos, and what is believed of their size."""

    dictionaries: tuple[str, ...] = setting(
        (), "Marker dictionaries", help="such as DICT_4X4_50; none named: they are guessed from the photos"
    )
    ids: tuple[int, ...] = setting((), "Marker ids", help="only these; none named: all of the dictionary")
    side_m: float = setting(
        1.0,
        "Marker side",
        unit="m",
        gt=0.0,
        le=10.0,
        help="outer edge of the black square, for markers without their own",
    )
    side_error_mm: float = setting(
        0.5, "Error of the side", unit="mm", ge=0.0, le=50.0, help="how well the side was measured with a ruler"
    )
    detection_width_px: int = setting(
        3072,
        "Search width",
        unit="px",
        ge=512,
        le=16384,
        help="photos are shrunk to this for the search, not for the fit",
    )
    min_match: float = setting(
        0.8, "Smallest match", ge=0.3, le=0.99, help="correlation of a marker's inner cells with its pattern"
    )
    systematic_px: float = setting(
        0.03,
        "Shared corner error",
        unit="px",
        ge=0.0,
        le=1.0,
        help="what blur leaves in every edge and no number of photos averages out",
    )
    max_offset_px: float = setting(
        3.0,
        "Largest offset",
        unit="px",
        ge=0.2,
        le=50.0,
        help="a photo whose ray misses the marker by more is left out",
    )


class Settings(SettingsModel):
    """All settings of a plot."""

    ground: GroundSettings = GroundSettings()
    trunks: TrunkSettings = TrunkSettings()
    measure: MeasureSettings = MeasureSettings()


def describe_settings() -> str:
    """Every setting on a line of its own: name, default, unit, bounds, and what it is."""
    lines = []
    for section, owner in Settings.model_fields.items():
        model = owner.annotation
        assert isinstance(model, type) and issubclass(model, SettingsModel)
        for name, field in model.model_fields.items():
            extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            bounds = {key: getattr(rule, key) for rule in field.metadata for key in ("ge", "le") if hasattr(rule, key)}
            limits = f" [{bounds.get('ge', '')}..{bounds.get('le', '')}]" if bounds else ""
            choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
            limits += f" [{' | '.join(map(str, choices))}]" if choices else ""
            text = f"{field.title}{': ' + field.description if field.description else ''}"
            value = (
                f"{section}.{name} = {field.default}{' ' + str(extra.get('unit')) if extra.get('unit') else ''}{limits}"
            )
            lines.append(f"{value}\n    {text}")
    return "\n".join(lines)
