"""The Document: what a human or a file decided about a plot, and nothing that can be computed from it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from dbh_studio.core.arrays import Float64
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.inventory import TREE_STATUSES, TreeRecord, TreeStatus
from dbh_studio.core.mask_record import MaskRecord
from dbh_studio.core.scale import ScaleEstimate
from dbh_studio.core.scale_evidence import ScaleEvidence
from dbh_studio.core.transforms import UP_AXES, Similarity, rotation_to_z_up
from dbh_studio.core.trunks import TrunkSet
from dbh_studio.settings import Settings

__all__ = [
    "TREE_STATUSES",
    "CameraFrame",
    "CameraSource",
    "Direction",
    "Document",
    "SourceInfo",
    "TreeRecord",
    "TreeStatus",
    "fingerprint",
]

Direction = tuple[float, float, float]
CameraFrame = Literal["cloud", "file"]

_HASH_CHUNK = 4_000_000


def fingerprint(cloud: PointCloud) -> str:
    """A digest of where the points are and in which order: trunks are indices, so both must be as they were.

    It is taken of the points, not of the file: a copy under another name has the same one, and a file that is read
    differently by a newer program has not. About 0.4 s for 20 million points.
    """
    digest = hashlib.blake2b(digest_size=16)
    digest.update(len(cloud).to_bytes(8, "little"))
    digest.update(cloud.origin.astype("<f8").tobytes())
    for start in range(0, len(cloud), _HASH_CHUNK):
        digest.update(np.ascontiguousarray(cloud.xyz[start : start + _HASH_CHUNK], dtype="<f4").data)
    return digest.hexdigest()


@dataclass(frozen=True)
class SourceInfo:
    """Which cloud the trunks of a plot are indices into.

    Attributes:
        path: What was opened: a cloud, a mesh or a folder.
        used: The files read of it.
        n_points: How many points the cloud has.
        fingerprint: Of the cloud, see `fingerprint`.
    """

    path: Path
    used: tuple[Path, ...]
    n_points: int
    fingerprint: str

    @classmethod
    def of(cls, cloud: PointCloud, path: Path | str, used: tuple[Path, ...] = ()) -> SourceInfo:
        """Describe a cloud that was read from `path`."""
        path = Path(path).absolute()
        return cls(path, tuple(Path(file).absolute() for file in used) or (path,), len(cloud), fingerprint(cloud))


def unit_direction(direction: Any) -> Direction:
    """The named axis (``+z``, ``-y``, …) or any three numbers, as a unit vector in the source frame.

    Raises:
        ValueError: It is neither, or it has no direction.
    """
    if isinstance(direction, str):
        vector = rotation_to_z_up(direction)[2]
    else:
        vector = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not np.isfinite(length) or length < 1e-12:
        raise ValueError(f"{direction!r} is neither a direction nor one of {', '.join(UP_AXES)}")
    if abs(length - 1) > 1e-12:  # else it is one already, and must not drift by another rounding
        vector = vector / length
    # Adding 0 turns -0.0 into 0.0, so that equal directions look equal in the saved file.
    x, y, z = (float(part) + 0.0 for part in vector)
    return x, y, z


def rotation_to_world(up: Direction) -> Float64:
    """(3, 3) rotation that turns `up` into +z: `updirection.rotation_from_up`, for the six axes without rounding."""
    for axis in UP_AXES:
        rotation = rotation_to_z_up(axis)
        if np.array_equal(rotation[2], up):
            return rotation
    from dbh_studio.core.updirection import rotation_from_up  # scipy, slow to import and rarely needed here

    return rotation_from_up(np.array(up))


def _heading(north: Float64) -> Float64:
    """(3, 3) rotation about z that turns the level part of `north` into +y; none where `north` stands upright."""
    length = float(np.hypot(north[0], north[1]))
    if length < 1e-6:
        return np.eye(3)
    sine, cosine = north[0] / length, north[1] / length
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class CameraSource:
    """Where the photos of a plot and their poses are.

    Attributes:
        path: The reconstruction: a file or a folder.
        images_dir: Where the photos are; None beside the reconstruction.
        frame: How the poses come to the cloud: they are in its frame, or the file's own transform brings them there.
    """

    path: Path
    images_dir: Path | None = None
    frame: CameraFrame = "cloud"

    @classmethod
    def of(cls, path: Path | str, images_dir: Path | str | None = None, frame: CameraFrame = "cloud") -> CameraSource:
        """With absolute paths."""
        return cls(Path(path).absolute(), None if images_dir is None else Path(images_dir).absolute(), frame)


@dataclass(frozen=True, eq=False)
class Document:
    """One state of a plot. Immutable: a command makes a new one, which shares whatever did not change.

    Attributes:
        plot_id: What the person calls the plot.
        source: The cloud the trunks are indices into.
        up_direction: Unit vector in the source frame that points to the sky.
        scale: Metres per source unit.
        settings: Of the ground, the trunks and the measurement.
        trunks: Indices into the cloud, so that a new scale, up direction or ground leaves them as they are.
        trees: What the person said about stems, by trunk id; stems nobody spoke of are not in it.
        north_direction: Direction in the source whose level part becomes +y; None leaves the source's own heading.
        origin_src: Where the world's origin is, source units from the cloud's origin.
        evidence: The known lengths the scale was, or may be, taken from.
        cameras: The photos; None where there are none.
        masks: Which masks the trunks were found by; None where they came from the cloud alone, from a file or by hand.
    """

    plot_id: str
    source: SourceInfo
    up_direction: Direction = (0.0, 0.0, 1.0)
    scale: ScaleEstimate = ScaleEstimate()
    settings: Settings = Settings()
    trunks: TrunkSet = TrunkSet()
    trees: Mapping[int, TreeRecord] = field(default_factory=dict)
    north_direction: Direction | None = None
    origin_src: Direction = (0.0, 0.0, 0.0)
    evidence: ScaleEvidence = ScaleEvidence()
    cameras: CameraSource | None = None
    masks: MaskRecord | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "up_direction", unit_direction(self.up_direction))
        if self.north_direction is not None:
            object.__setattr__(self, "north_direction", unit_direction(self.north_direction))
        # Kept as it is where it is one already: a listener sees by identity what a command left alone.
        if not isinstance(self.trees, MappingProxyType):
            object.__setattr__(self, "trees", MappingProxyType(dict(self.trees)))
        strangers = sorted(set(self.trees) - set(self.trunks.ids))
        if strangers:
            raise ValueError(f"trees {strangers} have a record but no trunk")

    def __reduce__(self) -> tuple[Any, ...]:
        # A mapping proxy cannot be pickled.
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return type(self), tuple((values | {"trees": dict(self.trees)}).values())

    @property
    def world_from_source(self) -> Similarity:
        """From `cloud.xyz` (source units, about the cloud's origin) to metres with z up.

        The world's origin is the cloud's unless somebody put it elsewhere. While the scale is unknown one source unit
        counts as one metre, for display.
        """
        scale = self.scale.metres_per_unit if self.scale.is_known else 1.0
        rotation = rotation_to_world(self.up_direction)
        if self.north_direction is not None:
            rotation = _heading(rotation @ np.array(self.north_direction)) @ rotation
        return Similarity(rotation, -scale * (rotation @ np.array(self.origin_src)), scale)

    def has_frame_of(self, other: Document) -> bool:
        """Whether the cloud lies in the world as it does for `other`."""
        return self is other or (
            self.scale.is_known == other.scale.is_known
            and (not self.scale.is_known or self.scale.metres_per_unit == other.scale.metres_per_unit)
            and self.up_direction == other.up_direction
            and self.north_direction == other.north_direction
            and self.origin_src == other.origin_src
        )

    def record(self, trunk_id: int) -> TreeRecord:
        """What is said about a stem; an empty record where nothing is."""
        return self.trees.get(trunk_id, TreeRecord())
