from __future__ import annotations

import numpy as np
import pytest

from dbh_studio.errors import MalformedFileError, TruncatedFileError
from dbh_studio.io.pcd import lzf_decompress, read_pcd

_ENCODINGS = ["ascii", "binary", "binary_compressed"]


@pytest.fixture
def columns(rng):
    xyz = rng.normal(size=(300, 3)).astype(np.float32)
    packed = rng.integers(0, 1 << 24, 300).astype(np.uint32)
    return {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "rgb": packed, "label": np.arange(300, dtype=np.int32)}


@pytest.mark.parametrize("encoding", _ENCODINGS)
def test_all_encodings_give_the_same(tmp_path, columns, write_pcd, encoding):
    write_pcd(tmp_path / "a.pcd", columns, encoding)
    cloud = read_pcd(tmp_path / "a.pcd").cloud
    assert (cloud.xyz == np.stack([columns[a] for a in "xyz"], axis=1)).all()
    assert (cloud.rgb[:, 0] == columns["rgb"] >> 16).all()
    assert (cloud.rgb[:, 2] == columns["rgb"] & 255).all()
    assert (cloud.attributes["label"] == np.arange(300)).all()


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_colours_as_float_bits(tmp_path, columns, write_pcd, encoding):
    expected = (columns["rgb"] >> 8) & 255
    columns["rgb"] = columns["rgb"].view(np.float32)
    write_pcd(tmp_path / "a.pcd", columns, encoding)
    assert (read_pcd(tmp_path / "a.pcd").cloud.rgb[:, 1] == expected).all()


@pytest.mark.parametrize("encoding", _ENCODINGS)
def test_truncated(tmp_path, columns, write_pcd, encoding):
    path = tmp_path / "a.pcd"
    write_pcd(path, columns, encoding)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(TruncatedFileError):
        read_pcd(path)


@pytest.mark.parametrize("encoding", _ENCODINGS)
def test_a_huge_count_is_refused(tmp_path, columns, write_pcd, encoding):
    write_pcd(tmp_path / "a.pcd", columns, encoding, POINTS=10**12, WIDTH=10**12)
    with pytest.raises(TruncatedFileError):
        read_pcd(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    "changes",
    [{"FIELDS": "a b c d e"}, {"SIZE": "4 4"}, {"TYPE": "Q Q Q Q Q"}, {"DATA": "zip"}, {"COUNT": "0 1 1 1 1"}],
)
def test_malformed_header(tmp_path, columns, write_pcd, changes):
    write_pcd(tmp_path / "a.pcd", columns, "binary", **changes)
    with pytest.raises(MalformedFileError):
        read_pcd(tmp_path / "a.pcd")


def test_missing_points_of_an_organised_cloud_are_dropped(tmp_path, columns, write_pcd):
    columns["x"] = columns["x"].copy()
    columns["x"][:60] = np.nan
    write_pcd(tmp_path / "a.pcd", columns, "binary", WIDTH=30, HEIGHT=10)
    loaded = read_pcd(tmp_path / "a.pcd")
    assert len(loaded.cloud) == 240
    assert "60 points" in loaded.notes[0]


def test_lzf_copies():
    # A literal "abc", a copy of 3 from 3 back, and an overlapping long copy of 1 byte (a run of "c").
    assert lzf_decompress(b"\x02abc" + bytes([0x20, 0x02]), 6) == b"abcabc"
    assert lzf_decompress(b"\x02abc" + bytes([0xE0, 0x01, 0x00]), 13) == b"abc" + b"c" * 10
    assert lzf_decompress(b"\x01ab" + bytes([0x60, 0x01]), 7) == b"ababab" + b"a"


@pytest.mark.parametrize("packed", [b"\x05ab", bytes([0x20, 0x09]), b"\x02abc\x20", b"\x02abc" * 9])
def test_damaged_lzf(packed):
    with pytest.raises(ValueError, match=r".+"):
        lzf_decompress(packed, 6)
