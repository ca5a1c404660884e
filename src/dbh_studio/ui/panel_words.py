"""What the program says, in the words of the panels: a person who clicks knows no options of the command line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from dbh_studio.errors import StudioError

Words = Sequence[tuple[str, str]]


def reworded(text: str, words: Words) -> str:
    """The text with the panel's names of things; `words` are (what the command line says, what the panel says)."""
    for said, shown in words:
        text = text.replace(said, shown)
    return text


@contextlib.contextmanager
def errors_reworded(words: Words) -> Iterator[None]:
    """Let what is raised here be told in the words of the panel."""
    try:
        yield
    except StudioError as error:
        error.args = tuple(reworded(part, words) if isinstance(part, str) else part for part in error.args)
        error.problem, error.remedy = reworded(error.problem, words), reworded(error.remedy, words)
        raise
