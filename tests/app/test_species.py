"""Names and codes of species: what is shipped, what is offered while somebody types, and lists of one's own."""

import pytest

from dbh_studio.app.species import (
    OWN_LIST,
    Species,
    known_species,
    matching_species,
    read_species,
    settings_folder,
    shipped_species,
    species_list,
)
from dbh_studio.errors import MalformedFileError


@pytest.fixture(autouse=True)
def no_settings_of_this_computer(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "config"))


def named(text):
    return [each.scientific_name for each in matching_species(text, shipped_species())]


def test_the_shipped_list_has_each_name_and_each_code_once():
    species = shipped_species()
    assert len(species) > 150
    names = [each.scientific_name for each in species]
    assert names == sorted(set(names))
    for field in ("fia_code", "usda_symbol", "eppo_code"):
        codes = [code for each in species if (code := getattr(each, field))]
        assert len(codes) == len(set(codes))
    assert all(each.common_name for each in species)


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("802", "Quercus alba"),
        ("QUAL", "Quercus alba"),
        ("acsa3", "Acer saccharum"),
        ("202", "Pseudotsuga menziesii"),
        ("PIUSI", "Pinus sylvestris"),
        ("fausy", "Fagus sylvatica"),
        ("PIEAB", "Picea abies"),
        ("PIAB", "Picea abies"),
        ("91", "Picea abies"),
    ],
)
def test_a_code_of_the_forest_services_is_known(code, name):
    found = known_species(code, shipped_species())
    assert found is not None and found.scientific_name == name
    assert named(code)[0] == name


def test_a_list_is_in_the_shape_its_codes_have():
    for each in shipped_species():
        assert each.fia_code.isdigit() or not each.fia_code
        assert len(each.eppo_code) in (0, 5)
        assert each.usda_symbol.rstrip("0123456789").isupper() or not each.usda_symbol


def test_beginnings_of_words_find_a_species():
    assert named("qu ro") == ["Quercus robur"]
    assert named("silv fir") == []
    assert "Betula pendula" in named("silver b")
    assert named("") == []
    assert all("beech" in each.common_name for each in matching_species("beech", shipped_species()))


def test_what_is_typed_in_full_comes_first():
    assert named("white oak")[0] == "Quercus alba"


def test_ones_own_list_goes_first_and_its_names_stand_once(tmp_path):
    (tmp_path / OWN_LIST).write_text("code;species;english\nBu;Fagus sylvatica;our beech\n", encoding="utf-8")
    species = species_list(tmp_path)
    assert species[0] == Species("Fagus sylvatica", "our beech", own_code="Bu")
    assert [each.scientific_name for each in species].count("Fagus sylvatica") == 1
    assert known_species("bu", species) == species[0]


def test_a_list_in_the_settings_folder_is_read_too(tmp_path):
    folder = settings_folder()
    folder.mkdir(parents=True)
    (folder / OWN_LIST).write_text("Ginkgo biloba\nMetasequoia glyptostroboides\n", encoding="utf-8")
    assert [each.scientific_name for each in species_list(tmp_path)[:2]] == [
        "Ginkgo biloba",
        "Metasequoia glyptostroboides",
    ]


@pytest.mark.parametrize("content", [b"colour,size\nred,3\n", b"fia\n12\n", b"\xff\xfe\x00S"])
def test_a_table_without_names_is_refused_by_its_name(tmp_path, content):
    path = tmp_path / OWN_LIST
    path.write_bytes(content)
    with pytest.raises(MalformedFileError, match=OWN_LIST):
        read_species(path)


def test_empty_lines_and_an_empty_file_are_no_species(tmp_path):
    path = tmp_path / OWN_LIST
    path.write_text("species\n\nAbies alba\n  \n", encoding="utf-8")
    assert [each.scientific_name for each in read_species(path)] == ["Abies alba"]
    path.write_text("", encoding="utf-8")
    assert read_species(path) == ()
