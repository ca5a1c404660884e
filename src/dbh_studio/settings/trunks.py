"""Settings of the ground and of the trunks that stand on it."""

from __future__ import annotations

from typing import Literal

from dbh_studio.settings.base import SettingsModel, setting


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
