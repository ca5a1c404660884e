"""Every real file of the collection: the number of points it holds, read here and counted by its own header."""

from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.core.treeids import find_tree_id_attribute, point_sets_from_ids
from dbh_studio.io.reader import read_reconstruction

COUNTS = {
    "format_zoo/laspy/1_4_w_evlr.laz": 1000,
    "format_zoo/laspy/append-bug.laz": 37805,
    "format_zoo/laspy/autzen_geo_proj.las": 106,
    "format_zoo/laspy/extra.laz": 1065,
    "format_zoo/laspy/extrabytes.las": 1065,
    "format_zoo/laspy/fullwave.laz": 10750,
    "format_zoo/lasr/Example.las": 30,
    "format_zoo/lasr/Example.laz": 30,
    "format_zoo/lasr/Example.pcd": 30,
    "format_zoo/lasr/example.copc.laz": 30,
    "format_zoo/lasr/extra_byte.las": 62,
    "format_zoo/lasr/las14_pdrf6.laz": 135,
    "format_zoo/lasr/malformed_extrabytes.las": 10,
    "format_zoo/lasr/nocrs.las": 30,
    "format_zoo/lasr/pcd_ascii.pcd": 69977,
    "format_zoo/lasr/pcd_binary.pcd": 69977,
    "format_zoo/lidr/MixedConifer.laz": 37657,
    "itsme_tree_1/pc_tree.las": 30826,
    "itsme_tree_1/pc_tree.ply": 30826,
    "itsme_tree_1/pc_tree.txt": 30826,
    "plots/LPine1_demo.laz": 1544202,
    "plots/pine.laz": 73851,
    "plots/pine_plot.laz": 114024,
    "sfm/sceaux_castle/Example.asc": 7817,
    "sfm/sceaux_castle/Example.ply": 7817,
    "sfm/sceaux_castle/Example_colors.ply": 7817,
    "sfm/sceaux_castle/simple.las": 1065,
    "sfm/sceaux_castle/simple.laz": 1065,
    "synthetic_360/dense_unscaled.ply": 1967270,
    "treescope_trunk_slices/tree_8_main_trunk.pcd": 16221,
}


def _points(path):
    cloud = read_reconstruction(path).cloud
    return cloud.xyz.astype(np.float64) + cloud.origin


@pytest.mark.parametrize("name", COUNTS)
def test_number_of_points(shared_data, name):
    assert len(read_reconstruction(shared_data / name).cloud) == COUNTS[name]


def test_the_whole_zoo_is_covered(shared_data):
    files = {str(p.relative_to(shared_data)).replace("\\", "/") for p in (shared_data / "format_zoo").rglob("*.*")}
    assert files <= set(COUNTS)


def test_three_readers_agree_on_one_tree(shared_data):
    las, ply, txt = (_points(shared_data / "itsme_tree_1" / f"pc_tree.{kind}") for kind in ("las", "ply", "txt"))
    assert np.abs(ply - txt).max() < 1e-5
    # The LAS is rounded to a millimetre about an offset.
    assert np.abs(las - txt).max() < 1.001e-3


def test_both_pcd_hold_the_same_cloud(shared_data):
    text, binary = (_points(shared_data / "format_zoo" / "lasr" / f"pcd_{kind}.pcd") for kind in ("ascii", "binary"))
    assert np.abs(text - binary).max() < 1e-4


def test_las_laz_and_copc_agree(shared_data):
    las, laz, copc = (
        _points(shared_data / "format_zoo/lasr" / n) for n in ("Example.las", "Example.laz", "example.copc.laz")
    )
    assert (las == laz).all()
    # COPC reorders the points.
    assert (np.sort(copc, axis=0) == np.sort(las, axis=0)).all()


def test_existing_tree_ids(shared_data):
    cloud = read_reconstruction(shared_data / "format_zoo/lidr/MixedConifer.laz").cloud
    assert find_tree_id_attribute(cloud) == "treeID"
    sets = point_sets_from_ids(cloud.attributes["treeID"])
    # Ids run to 205; the largest double marks points without a tree.
    assert 150 < len(sets) <= 205
    assert sum(map(len, sets)) < len(cloud)


def test_coordinate_systems(shared_data):
    zoo = shared_data / "format_zoo"
    assert read_reconstruction(zoo / "lasr/Example.las").cloud.crs == "EPSG:26917"
    assert read_reconstruction(zoo / "laspy/fullwave.laz").cloud.crs == "EPSG:32723"
    assert read_reconstruction(zoo / "lasr/nocrs.las").cloud.crs is None
    broken = read_reconstruction(zoo / "lasr/las14_pdrf6.laz")
    assert any("could not be understood" in note for note in broken.notes)


def test_a_folder_of_slices_is_one_plot(shared_data):
    reconstruction = read_reconstruction(shared_data / "treescope_trunk_slices")
    assert len(reconstruction.used) == 8
    assert len(reconstruction.cloud) == 100042
