"""Names of files made for a plot can be written on every system."""

from __future__ import annotations

import pytest

from dbh_studio.app.names import file_name


@pytest.mark.parametrize(
    ("plot", "name"),
    [
        ("oak hill", "oak hill"), ("a/b\\c:d", "a_b_c_d"), ("..", "plot"), ("", "plot"), ("x\x07y", "x_y"),
        ("NUL", "_NUL"), ("com1.north", "_com1.north"), ("console", "console"), ("Ö" * 300, "Ö" * 90),
    ],
)  # fmt: skip
def test_a_name_is_portable_and_short(plot, name):
    assert file_name(plot) == name
