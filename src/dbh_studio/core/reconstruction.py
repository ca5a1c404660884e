"""What a reconstruction file or folder gave: a cloud, perhaps a mesh, and where they came from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dbh_studio.core.arrays import Float32, Int32, UInt8, readonly
from dbh_studio.core.cloud import PointCloud

LIDAR_FORMATS = frozenset({"las", "laz", "e57", "pcd"})


@dataclass(frozen=True)
class Provenance:
    """What a file says about itself; numbers alone cannot tell an SfM unit from a metre.

    Attributes:
        format: ``las``, ``laz``, ``pcd``, ``e57``, ``ply``, ``xyz``, ``obj``, ``glb``, ``stl`` or none.
        software: What wrote the file, as the file says; empty where it does not.
        metres_per_unit: The length unit the file declares, by its coordinate system or format; None where none.
        is_geographic: Whether the coordinates are degrees.
    """

    format: str = ""
    software: str = ""
    metres_per_unit: float | None = None
    is_geographic: bool = False

    @property
    def is_lidar(self) -> bool:
        """Whether the file comes from a scanner's tool chain: a LiDAR format not written by photogrammetry software."""
        return self.format in LIDAR_FORMATS and not self.is_photogrammetry

    @property
    def is_photogrammetry(self) -> bool:
        """Whether the file names photogrammetry software as its writer."""
        names = ("metashape", "photoscan", "pix4d", "colmap", "realitycapture", "opensfm", "odm", "meshroom", "mvs")
        return any(name in self.software.lower() for name in names)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A surface in the `source` frame, about the same origin as the cloud it came with.

    Attributes:
        vertices: (V, 3) float32, source units, relative to the cloud's origin.
        faces: (F, 3) int32 indices into `vertices`.
        vertex_rgb: (V, 3) uint8 colours, or None.
    """

    vertices: Float32
    faces: Int32
    vertex_rgb: UInt8 | None = None

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or self.vertices.dtype != np.float32:
            raise ValueError(f"vertices are {self.vertices.shape} {self.vertices.dtype} but (V, 3) float32 is needed")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3 or self.faces.dtype != np.int32:
            raise ValueError(f"faces are {self.faces.shape} {self.faces.dtype} but (F, 3) int32 is needed")
        if len(self.faces) and not 0 <= self.faces.min() <= self.faces.max() < len(self.vertices):
            raise ValueError(f"faces point outside the {len(self.vertices)} vertices")
        if self.vertex_rgb is not None and self.vertex_rgb.shape != self.vertices.shape:
            raise ValueError(f"vertex_rgb is {self.vertex_rgb.shape} but {self.vertices.shape} is needed")
        object.__setattr__(self, "vertices", readonly(self.vertices))
        object.__setattr__(self, "faces", readonly(self.faces))
        if self.vertex_rgb is not None:
            object.__setattr__(self, "vertex_rgb", readonly(self.vertex_rgb))


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A plot as loaded.

    Attributes:
        cloud: Its points; sampled from the mesh where there was no cloud.
        mesh: Its surface, to be shown; None where there is none.
        used: The files read.
        notes: What the person should know: what was ignored, dropped or assumed.
        provenance: What the cloud's file says about itself, for `core.datacheck.check_cloud`.
    """

    cloud: PointCloud
    mesh: TriangleMesh | None = None
    used: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)
