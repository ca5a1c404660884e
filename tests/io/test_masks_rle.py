"""Run lengths and polygons: by hand, by properties, and against what pycocotools wrote."""

import contextlib
import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dbh_studio.io.masks.rle import decode_counts, decode_text, encode_counts, encode_text, fill_polygons

MASKS = hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=40))


def test_counts_by_hand_go_down_the_columns():
    mask = np.array([[0, 1, 1], [0, 1, 0]], bool)
    # Columns: 00, 11, 10: two outside, three inside, one outside.
    assert encode_counts(mask).tolist() == [2, 3, 1]
    assert np.array_equal(decode_counts([2, 3, 1], 2, 3), mask)


def test_counts_of_a_mask_that_begins_inside_start_with_a_zero():
    assert encode_counts(np.ones((2, 2))).tolist() == [0, 4]
    assert encode_counts(np.zeros((2, 2))).tolist() == [4]
    assert decode_counts([0, 4], 2, 2).all()


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        # By hand after maskApi.c: 2 = 00010 -> chr(48+2); 33 = 00001 + more, then 1 -> chr(48+32+1), chr(48+1).
        ([2], "2"),
        ([33], "Q1"),
        # 16 needs a second character, for its fifth bit would be a sign.
        ([16], "`0"),
        # The fourth is a difference to the second: 5 - 7 = -2 = 11110 -> chr(48+30).
        ([4, 7, 3, 5], "473N"),
        # The fifth to the third: 1 - 3 = -2.
        ([4, 7, 3, 5, 1], "473NN"),
        ([0, 4], "04"),
    ],
)
def test_text_by_hand(counts, text):
    assert encode_text(counts) == text
    assert decode_text(text).tolist() == counts
    assert decode_text(text.encode()).tolist() == counts


def test_a_box_by_hand():
    mask = np.zeros((9, 10), bool)
    mask[3:7, 2:5] = True
    assert encode_counts(mask).tolist() == [21, 4, 5, 4, 5, 4, 47]
    # 21 = 10101 would be negative: 10101 + more, 0. The differences are 0 but for the last: 42 = 01010 + more, 1.
    assert encode_text(encode_counts(mask)) == "e0450" + "00" + "Z1"


def test_text_as_pycocotools_writes_it():
    """Both texts were written by pycocotools 2.0.11 from the same rules."""
    y, x = np.mgrid[:37, :53]
    disc = (x - 25) ** 2 + (y - 18) ** 2 < 200
    text = "X=3n08J4M2N2N2N2N2O0O2O00000O2O0001N1000001N101N2N2N2N2N3L6Hd>"
    assert encode_text(encode_counts(disc)) == text
    assert np.array_equal(decode_counts(decode_text(text), 37, 53), disc)
    speckled = encode_text(encode_counts((x * x + 3 * y * y) % 97 < 40))
    digest = "b061503b971e105e95fb2f358414f53225154db5d8dde9844525872a3b20e4f4"
    assert hashlib.sha256(speckled.encode()).hexdigest() == digest


@given(MASKS)
def test_every_mask_survives_both_forms(mask):
    counts = encode_counts(mask)
    assert counts.sum() == mask.size and np.all(counts[1:] > 0)
    assert np.array_equal(decode_counts(counts, *mask.shape), mask)
    assert np.array_equal(decode_counts(decode_text(encode_text(counts)), *mask.shape), mask)


@given(st.lists(st.integers(0, 2**31), max_size=50))
def test_text_holds_any_counts(counts):
    assert decode_text(encode_text(counts)).tolist() == counts


@given(st.text(max_size=30))
def test_any_text_is_counts_or_a_value_error(text):
    with contextlib.suppress(ValueError):
        assert decode_text(text).dtype == np.int64


@pytest.mark.parametrize("counts", [[3], [5], [-1, 5], [2**62, 2**62, 2**62, 2**62, 4], [[4]], ["4"], [4.0], [2**70]])
def test_counts_that_do_not_fit_are_refused(counts):
    with pytest.raises((ValueError, OverflowError)):
        decode_counts(counts, 2, 2)


@pytest.mark.parametrize("text", ["Q", "4\x7f", "4 4", "ö", "oooooooooo0"])
def test_damaged_text_is_refused(text):
    with pytest.raises(ValueError):
        decode_text(text)


def test_a_box_on_pixel_borders_fills_exactly_its_pixels():
    mask = fill_polygons([[1, 2, 4, 2, 4, 3, 1, 3]], 5, 6)
    expected = np.zeros((5, 6), bool)
    expected[2, 1:4] = True
    assert np.array_equal(mask, expected)


def test_a_pixel_belongs_to_the_side_its_centre_is_on():
    assert fill_polygons([[0, 0, 1.49, 0, 1.49, 1, 0, 1]], 1, 3).tolist() == [[True, False, False]]
    assert fill_polygons([[0, 0, 1.51, 0, 1.51, 1, 0, 1]], 1, 3).tolist() == [[True, True, False]]


def test_neighbours_share_no_pixel_and_leave_none():
    left, right = [[0, 0, 17.3, 0, 9.1, 30, 0, 30]], [[17.3, 0, 40, 0, 40, 30, 9.1, 30]]
    a, b = fill_polygons(left, 30, 40), fill_polygons(right, 30, 40)
    assert not np.any(a & b) and np.all(a | b)


def test_a_polygon_is_where_an_independent_test_of_each_centre_says():
    rng = np.random.default_rng(5)
    centres = np.stack(np.meshgrid(np.arange(60) + 0.5, np.arange(50) + 0.5), axis=-1).reshape(-1, 2)
    for _ in range(20):
        corners = rng.uniform(-10, 70, (rng.integers(3, 9), 2))
        # Even-odd by winding of angles would fail for crossings; count the edges a ray to the right meets instead.
        inside = np.zeros(len(centres), bool)
        for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            spans = (p[1] > centres[:, 1]) != (q[1] > centres[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                at = p[0] + (centres[:, 1] - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
            inside ^= spans & (centres[:, 0] < at)
        assert np.array_equal(fill_polygons([corners.ravel()], 50, 60).ravel(), inside)


def test_the_area_of_a_disc():
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    disc = np.stack([100 + 60.3 * np.cos(angle), 90 + 60.3 * np.sin(angle)], axis=1)
    area = fill_polygons([disc.ravel()], 200, 220).sum()
    assert area == pytest.approx(np.pi * 60.3**2, rel=0.002)


def test_parts_outside_the_picture_are_cut_off():
    assert fill_polygons([[-1e9, -1e9, 1e9, -1e9, 1e9, 1e9, -1e9, 1e9]], 4, 5).all()
    assert not fill_polygons([[50, 50, 60, 50, 60, 60]], 4, 5).any()


@pytest.mark.parametrize(
    "polygon", [[], [1, 2, 3, 4], [1, 2, 3, 4, 5], [0, 0, 1, 1, np.nan, 2], [0, 0, 1, 1, np.inf, 2]]
)
def test_what_is_no_polygon_is_refused(polygon):
    with pytest.raises(ValueError):
        fill_polygons([polygon], 4, 4)
