"""Text that people type becomes text of a page or a drawing, whatever is in it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

from hypothesis import given
from hypothesis import strategies as st

from dbh_studio.core.markup import markup, without_controls


@given(st.text(st.characters()))
def test_any_text_makes_well_formed_xml_that_says_the_same(text):
    told = ElementTree.fromstring(f'<a b="{markup(text)}">{markup(text)}</a>')
    # XML readers turn every line end into a line feed, and those of an attribute into blanks.
    clean = without_controls(text).replace("\r\n", "\n").replace("\r", "\n")
    assert (told.text or "") == clean


def test_what_no_xml_may_hold_is_left_out_and_all_else_stays():
    assert without_controls("a\x00b\x07c\x1bd\x7fe\ufffef\ud800g") == "abcdefg"
    kept = "tab\tline\nÄ ½ – 中 🌲 \xa0"
    assert without_controls(kept) == kept
    assert markup("<b>\"'&") == "&lt;b&gt;&quot;&#x27;&amp;"
