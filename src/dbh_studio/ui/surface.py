"""A mesh as the page draws it."""

from __future__ import annotations

from typing import Any

import numpy as np

from dbh_studio.core.reconstruction import TriangleMesh
from dbh_studio.core.transforms import Similarity

# Vertex colours of a GLB are linear light, a file's are not: unchanged, they come out washed out.
_LINEAR = (255.0 * (np.arange(256) / 255.0) ** 2.2 + 0.5).astype(np.uint8)


def glb_of(mesh: TriangleMesh, world_from_source: Similarity) -> bytes:
    """The mesh in the world frame as a GLB file.

    Colours are drawn as they are: the light of the day is in them already, and a lamp above leaves stems black. A mesh
    without colours is lit, or it would be a silhouette.
    """
    import trimesh  # slow to import, and rarely needed here

    colours = None if mesh.vertex_rgb is None else _LINEAR[mesh.vertex_rgb]
    surface = trimesh.Trimesh(
        world_from_source.apply(mesh.vertices), mesh.faces, vertex_colors=colours, process=False, validate=False
    )
    scene: Any = trimesh.Scene(surface)
    after = _without_lamps if colours is not None else None
    return bytes(scene.export(file_type="glb", tree_postprocessor=after))


def _without_lamps(tree: dict[str, Any]) -> None:
    """Give every part a material that no light changes, seen from both sides."""
    tree["materials"] = [
        {
            "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0]},
            "extensions": {"KHR_materials_unlit": {}},
            "doubleSided": True,
        }
    ]
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), "KHR_materials_unlit"})
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
