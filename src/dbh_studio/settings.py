"""Every setting a person may change: title, unit, bounds, and why one would.

The fields build the panels, ``--help`` and the error text, so what they say is said once. Frozen: a change is a new
value.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dbh_studio.errors import SettingError

CurveName = Literal["shrinkage", "circle", "fourier", "ellipse", "bspline"]
SlopeBase = Literal["uphill", "midpoint", "downhill"]
HeightAlong = Literal["vertical", "stem"]
MeasureAbove = Literal["nothing", "bulge", "buttress"]


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

    @classmethod
    def paper(cls) -> GroundSettings:
        """The paper's single plane."""
        return cls(method="plane")


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
    smallest_cluster_points: int = setting(
        0,
        "Smallest cluster",
        unit="points",
        ge=0,
        le=100_000_000,
        help="a smaller cluster is no trunk; 0: Otsu's threshold says what is small",
    )
    part_touching: bool = setting(
        True, "Part stems that touch", help="by their rings; off as in the paper, for masks that tell them apart"
    )
    expand_distance_m: float = setting(
        0.06, "Expansion distance", unit="m", ge=0.0, le=1.0, help="points this near a cluster join it"
    )
    min_diameter_cm: float = setting(5.0, "Thinnest trunk", unit="cm", ge=1.0, le=100.0)
    max_diameter_cm: float = setting(200.0, "Thickest trunk", unit="cm", ge=10.0, le=1000.0)
    use_existing_ids: bool = setting(
        True, "Take over tree ids", help="use treeID, tree_id, PredInstance … where the cloud has them"
    )

    @classmethod
    def paper(cls) -> TrunkSettings:
        """The paper's chain, for candidates from masks: size alone judges clusters, and rings tell nothing."""
        return cls(small_clusters="otsu", part_touching=False, trunk_top_m=40.0, use_existing_ids=False)


class MeasureSettings(SettingsModel):
    """How a diameter is measured."""

    ascending = (("min_diameter_cm", "max_diameter_cm"),)

    curve: CurveName = setting(
        "shrinkage",
        "Method",
        help="shrinkage: a closed curve that shrinks to a circle where nothing was seen; circle: a robust circle; both "
        "with an interval. fourier, ellipse, bspline: the paper's three, which have none",
    )
    breast_height_m: float = setting(
        1.30,
        "Breast height",
        unit="m",
        ge=0.3,
        le=5.0,
        help="1.30 Europe and Canada, 1.37 USA (4.5 ft), 1.40 New Zealand",
    )
    base: SlopeBase = setting(
        "midpoint",
        "Base on a slope",
        help="where the height is measured from: the ground on the stem's uphill or downhill side, or their mean",
    )
    along: HeightAlong = setting(
        "vertical", "Height of a leaning stem", help="vertical: above the base; stem: along the stem's axis"
    )
    above: MeasureAbove = setting(
        "nothing",
        "Measure above",
        help="bulge: where the stem is swollen at breast height, measure where that ends; buttress: also above a "
        "buttress or root swell that reaches breast height; nothing: at breast height whatever is there",
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
    definition: Literal["tape", "curve", "area"] = setting(
        "tape",
        "Diameter",
        help="tape: convex girth/π, what a tape reads; curve: perimeter/π (the paper); area: of the equal circle",
    )
    max_half_width: float = setting(
        0.40,
        "Widest interval",
        gt=0.01,
        le=2.0,
        help="half the 90 % interval, relative; a diameter known less well is not given (shrinkage, circle)",
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
    roundness: float = setting(
        0.016, "Roundness", unit="radii", gt=0.0, le=0.5, help="shrinkage: expected size of an oval; smaller is rounder"
    )
    bark_share: float = setting(
        0.011,
        "Bark under the tape",
        ge=0.0,
        le=0.1,
        help="shrinkage, circle: a tape lies on the bark's ridges, a curve runs through their middle; relative",
    )
    bloat_chance: float = setting(
        0.2,
        "Chance of bloat",
        ge=0.0,
        lt=1.0,
        help="shrinkage, circle: that bark is smeared outwards far more than usual, before looking; 0: never",
    )
    bloat_m: float = setting(
        0.001,
        "Usual bloat",
        unit="m",
        ge=0.0,
        le=0.1,
        help="shrinkage, circle: by how much points lie outside the bark on average; 0: not at all",
    )
    min_diameter_cm: float = setting(2.0, "Smallest diameter", unit="cm", ge=0.5, le=100.0)
    max_diameter_cm: float = setting(300.0, "Largest diameter", unit="cm", ge=10.0, le=1500.0)
    min_points: int = setting(
        30,
        "Fewest points in the band",
        ge=8,
        le=100_000,
        help="shrinkage, circle: in the stretch of stem used; a third of them within 0.6 m of breast height",
    )
    min_coverage_deg: float = setting(
        90.0, "Smallest arc seen", unit="°", ge=0.0, le=360.0, help="with less of the ring seen no diameter is given"
    )
    seed: int = setting(0, "Random seed", ge=0, le=2**31 - 1)

    @classmethod
    def paper(cls) -> MeasureSettings:
        """The paper's way, as far as it says: Fourier, perimeter/π, no gate, a fixed tolerance, the mean as origin."""
        return cls(curve="fourier", definition="curve", ring_gate=0.0, tolerance_share=0.0, polar_origin="centroid")


class EstimatorSettings(SettingsModel):
    """How the estimator of partly seen stems works; what its numbers rest on stands in `core.estimator`."""

    ascending = (("min_diameter_cm", "max_diameter_cm"),)

    method: Literal["ring", "circle"] = setting(
        "ring", "Method", help="ring: closed curve with a roundness prior; circle: a robust circle, nothing else"
    )
    axis: Literal["stem", "vertical"] = setting(
        "stem", "Stem axis", help="stem: fitted together with taper; vertical: taken as upright (circle only)"
    )
    definition: Literal["tape", "curve", "area"] = setting(
        "tape",
        "Diameter",
        help="tape: convex girth/π; curve: perimeter/π (the paper); area: of the equal circle",
    )
    # Lower than the 0.1 m a person may ask for: along a stem that leans by 45° that is 0.07 m above the base.
    breast_height_m: float = setting(1.30, "Height of measurement", unit="m", ge=0.05, le=100.0)
    below_m: float = setting(
        0.70, "Stem used below", unit="m", ge=0.05, le=2.0, help="axis and taper are found from this stretch of stem"
    )
    above_m: float = setting(0.90, "Stem used above", unit="m", ge=0.05, le=3.0)
    band_m: float = setting(
        0.60, "Circle's band", unit="m", ge=0.02, le=2.0, help="height of the band the plain circle is fitted to"
    )
    tolerance_m: float = setting(
        0.05, "Circle's tolerance", unit="m", ge=0.002, le=0.5, help="points farther away do not move the circle"
    )
    waves: int = setting(
        6, "Highest wave", ge=2, le=12, help="detail of the outline; the prior decides how much is used"
    )
    roundness: float = setting(
        0.016, "Roundness", unit="radii", gt=0.0, le=0.5, help="expected size of an oval's wave; smaller is rounder"
    )
    taper: float = setting(
        0.010, "Expected taper", unit="m/m", ge=-0.05, le=0.1, help="loss of radius per metre of stem"
    )
    taper_sd: float = setting(0.004, "Spread of taper", unit="m/m", gt=0.0, le=0.1)
    bark_share: float = setting(
        0.011,
        "Bark under the tape",
        ge=0.0,
        le=0.1,
        help="expected share of the diameter by which a tape on the ridges exceeds the curve; visible bark decides",
    )
    bloat_chance: float = setting(
        0.2, "Chance of bloat", ge=0.0, lt=1.0, help="that a surface is smeared far more than usual; 0: never"
    )
    bloat_m: float = setting(
        0.001, "Usual bloat", unit="m", ge=0.0, le=0.1, help="by how much surfaces are smeared outwards, on average"
    )
    max_points: int = setting(2500, "Most points used", ge=200, le=1_000_000)
    min_points: int = setting(30, "Fewest points", ge=15, le=100_000)
    min_arc_deg: float = setting(
        90.0, "Smallest arc seen", unit="°", ge=0.0, le=360.0, help="with less of the ring seen no diameter is given"
    )
    max_half_width: float = setting(
        0.40, "Widest interval", gt=0.01, le=2.0, help="half the 90 % interval, relative; wider is refused"
    )
    max_depth_noise: float = setting(
        0.15, "Most noise of an arc", gt=0.0, le=10.0, help="scatter over the depth of the arc seen; more is refused"
    )
    max_clutter: float = setting(
        0.9, "Most like clutter", gt=0.0, le=1.0, help="chance of being no stem; with more it is refused; 1: never"
    )
    min_diameter_cm: float = setting(2.0, "Smallest diameter", unit="cm", ge=0.5, le=100.0)
    max_diameter_cm: float = setting(300.0, "Largest diameter", unit="cm", ge=10.0, le=1500.0)
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
        ge=0.02,
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


class VoteSettings(SettingsModel):
    """How masks of photos become labels of points: who votes, what hides it, and what is enough."""

    rule: Literal["share", "count"] = setting(
        "share",
        "Rule",
        help="share: of the photos that see a point, enough call it trunk; count: the paper's label count",
    )
    min_share: float = setting(
        0.4, "Smallest share", gt=0.0, le=1.0, help="of the weighted votes; below a half, because masks miss trunks"
    )
    min_count: int = setting(2, "Fewest votes for", ge=1, le=1000, help="photos that call it trunk; the paper's is 1")
    occlusion: bool = setting(
        True, "Hidden points do not vote", help="off as in the paper: what stands behind a trunk takes its label too"
    )
    weighting: Literal["none", "distance", "incidence"] = setting(
        "none",
        "Weight of a vote",
        help="distance: near photos count more; incidence: those that look straight at it too",
    )
    weight_distance_m: float = setting(
        4.0, "Full weight up to", unit="m", ge=0.5, le=100.0, help="beyond, the weight falls with the square"
    )
    max_distance_m: float = setting(
        15.0, "Farthest point asked", unit="m", ge=1.0, le=1000.0, help="thin stems are a few pixels wide beyond it"
    )
    edge_px: int = setting(
        0, "Silent edge", unit="px", ge=0, le=50, help="a mask says nothing so near to its outline, where it bleeds"
    )
    tolerance_m: float = setting(
        0.12, "Depth tolerance", unit="m", ge=0.0, le=5.0, help="what is so little behind the nearest surface is seen"
    )
    tolerance_share: float = setting(
        0.02, "Depth tolerance, share of distance", ge=0.0, le=0.5, help="for poses and clouds that are off"
    )
    thinning_m: float = setting(
        0.02, "Voting resolution", unit="m", ge=0.002, le=0.5, help="one point per cube votes for all of its cube"
    )
    occluder_m: float = setting(
        0.04, "Hiding resolution", unit="m", ge=0.005, le=1.0, help="one point per cube hides what is behind"
    )
    depth_size_px: Literal[128, 256, 512, 1024] = setting(
        512, "Depth map", unit="px", help="pixels across a quarter of the horizon"
    )

    tell_apart: bool = setting(
        True,
        "Masks tell trunks apart",
        help="where they have numbers: a trunk with two masks in several photos is cut, fragments are joined",
    )
    second_look: bool = setting(
        True, "Look for stems by shape too", help="stems that no mask shows are offered, trunks without a stem flagged"
    )

    @classmethod
    def paper(cls) -> VoteSettings:
        """The paper's rule: every photo, nothing hides anything, a label count of one is enough."""
        return cls(
            rule="count",
            min_count=1,
            occlusion=False,
            weighting="none",
            max_distance_m=1000.0,
            edge_px=0,
            tell_apart=False,
        )


class ModelRunSettings(SettingsModel):
    """On what trained models run. None of it decides what is found, but precision and that only a little."""

    provider: Literal["auto", "cpu", "cuda", "directml", "coreml"] = setting(
        "auto", "Run on", help="auto: a graphics card where the installed onnxruntime knows it, else the processor"
    )
    precision: Literal["auto", "float32", "float16", "int8"] = setting(
        "auto", "Precision", help="float16: for graphics cards; int8: quicker, how much accuracy it costs is not known"
    )
    threads: int = setting(0, "Threads", ge=0, le=256, help="of the processor; 0: one per core")
    low_memory: bool = setting(
        True, "Save memory", help="a third less memory; off is up to a fifth quicker where there are 16 GB or more"
    )


class MaskDetectorSettings(SettingsModel):
    """How trunks are found in photos: what is looked for, in which part of the photo, and what is believed."""

    prompt: str = setting("tree trunk", "Look for", help="several things with full stops between: tree trunk. pole")
    box_threshold: float = setting(
        0.30, "Box threshold", ge=0.01, le=0.99, help="how sure the detector must be; lower finds more, and more wrong"
    )
    text_threshold: float = setting(
        0.25, "Text threshold", ge=0.01, le=0.99, help="which words of the prompt are said to be in a box"
    )
    box_overlap: float = setting(
        0.7, "Same box", ge=0.1, le=1.0, help="boxes that overlap more are one (intersection over union)"
    )
    max_box_share: float = setting(
        0.75, "Widest box", ge=0.05, le=1.0, help="share of the picture's width; a wider box is the forest, not a trunk"
    )
    min_box_px: float = setting(
        4.0, "Thinnest box", unit="px", ge=1.0, le=200.0, help="of the picture the detector looks at"
    )
    picture_shape: Literal["padded", "squashed"] = setting(
        "padded",
        "Oblong pictures",
        help="padded: shrunk to fit the detector's square; squashed: stretched over it, as the model's card does",
    )
    mask_threshold: float = setting(
        0.5, "Mask threshold", ge=0.05, le=0.95, help="probability above which a pixel is trunk"
    )
    mask_overlap: float = setting(
        0.5, "Same mask", ge=0.1, le=1.0, help="a mask of which surer ones cover more than this is left out"
    )
    panorama: Literal["tiles", "whole"] = setting(
        "tiles",
        "Panoramas",
        help="tiles: straight views all round; whole: the panorama as it is, the paper's way, where stems are thin",
    )
    tile_count: int = setting(
        5, "Tiles all round", ge=3, le=24, help="4 of 100° are quicker, 6 of 90° more thorough than 5 of 90°"
    )
    tile_fov_deg: float = setting(
        90.0, "Width of a tile", unit="°", ge=20.0, le=120.0, help="360 divided by the number of tiles, and some more"
    )
    tile_size_px: int = setting(
        1024, "Side of a tile", unit="px", ge=256, le=4096, help="the models shrink it to 800 and 1024 pixels"
    )
    tile_pitches_deg: tuple[float, ...] = setting(
        (0.0,), "Rows of tiles", unit="°", help="above the horizon: 0 for a walk, -25 too for a drone; 90 is the zenith"
    )
    mask_size_px: int = setting(
        2048, "Longest side of a mask", unit="px", ge=256, le=16384, help="masks of whole photos are no finer"
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
            kinds = ("ge", "gt", "le", "lt")
            bounds = {key: getattr(rule, key) for rule in field.metadata for key in kinds if hasattr(rule, key)}
            lowest, highest = (bounds.get(a, bounds.get(b, "")) for a, b in (("ge", "gt"), ("le", "lt")))
            limits = f" [{lowest}..{highest}]" if bounds else ""
            choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
            limits += f" [{' | '.join(map(str, choices))}]" if choices else ""
            text = f"{field.title}{': ' + field.description if field.description else ''}"
            value = (
                f"{section}.{name} = {field.default}{' ' + str(extra.get('unit')) if extra.get('unit') else ''}{limits}"
            )
            lines.append(f"{value}\n    {text}")
    return "\n".join(lines)
