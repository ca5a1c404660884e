"""Text for SVG, HTML and XML: escaped, and without what no XML may hold."""

from __future__ import annotations

import re
from html import escape

# XML 1.0 allows none of these, not even as entities: one of them in a note, and no browser draws the picture.
_NOT_XML = re.compile(r"[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufdcf\ufdf0-\ufffd\U00010000-\U0010ffff]")


def without_controls(text: str) -> str:
    """The text without control characters, lone surrogates and other signs that XML forbids."""
    return _NOT_XML.sub("", text)


def markup(text: object) -> str:
    """Text to put between tags or into a quoted attribute."""
    return escape(without_controls(str(text)), quote=True)
