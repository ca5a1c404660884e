"""Names and codes of tree species, to be offered while a person types.

The list that comes with the program has trees of temperate forests: scientific and common English name, FIA code and
USDA PLANTS symbol (both as in the species table of the US Forest Inventory and Analysis programme), EPPO code; a code
is empty where there is none or it is not certain. A person's own lists go before it: ``species.csv`` in the folder in
which the plot lies, and ``species.csv`` in the folder of the person's settings.
"""

from __future__ import annotations

import csv
import functools
import io
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from dbh_studio.errors import MalformedFileError

OWN_LIST = "species.csv"
_LARGEST_BYTES = 2_000_000
# What a heading of somebody's own list may be called.
_HEADINGS = {
    "scientific_name": ("scientificname", "scientific", "latin", "latinname", "species", "name"),
    "common_name": ("commonname", "common", "english", "englishname", "trivialname"),
    "fia_code": ("fiacode", "fia", "spcd"),
    "usda_symbol": ("usdasymbol", "usda", "symbol", "plants"),
    "eppo_code": ("eppocode", "eppo"),
    "own_code": ("owncode", "code", "abbreviation", "short"),
}


@dataclass(frozen=True)
class Species:
    """One species; what is not known is empty.

    Attributes:
        scientific_name: What is written into the inventory.
        common_name: In English, or in the person's language.
        fia_code: Of the US Forest Inventory and Analysis programme.
        usda_symbol: Of USDA PLANTS.
        eppo_code: Of the European and Mediterranean Plant Protection Organization.
        own_code: Of the person's own list.
    """

    scientific_name: str
    common_name: str = ""
    fia_code: str = ""
    usda_symbol: str = ""
    eppo_code: str = ""
    own_code: str = ""

    @property
    def codes(self) -> tuple[str, ...]:
        """The codes it has."""
        return tuple(filter(None, (self.own_code, self.fia_code, self.usda_symbol, self.eppo_code)))

    def words(self) -> str:
        """Name and codes, for the person to see that it is the one that is meant."""
        named = (("FIA", self.fia_code), ("USDA", self.usda_symbol), ("EPPO", self.eppo_code), ("code", self.own_code))
        codes = [f"{title} {code}" for title, code in named if code]
        return " · ".join(filter(None, (self.scientific_name, self.common_name, *codes)))


def known_species(text: str, species: Iterable[Species]) -> Species | None:
    """The species whose name or code `text` is, whatever its capitals; None where it is nobody's."""
    wanted = text.strip().casefold()
    if not wanted:
        return None
    return next((each for each in species if wanted in _names(each)), None)


def matching_species(text: str, species: Sequence[Species], *, at_most: int = 6) -> tuple[Species, ...]:
    """What somebody who has typed `text` may mean, best first; nothing for an empty text.

    First those whose name or code it is, then those it begins (any word of a name, any code), then those it is
    inside; of equals in the order of the list. Two beginnings fit a scientific name, too: ``qu ro``.
    """
    wanted = text.strip().casefold()
    if not wanted:
        return ()
    ranked = [(rank, number) for number, each in enumerate(species) if (rank := _rank(wanted, each)) is not None]
    return tuple(species[number] for _, number in sorted(ranked)[:at_most])


def _names(species: Species) -> tuple[str, ...]:
    return tuple(name.casefold() for name in (species.scientific_name, species.common_name, *species.codes) if name)


def _rank(wanted: str, species: Species) -> int | None:
    names = _names(species)
    if wanted in names:
        return 0
    if any(name.startswith(wanted) for name in names):
        return 1
    if any(word.startswith(wanted) for name in names for word in name.replace("-", " ").split()):
        return 2
    parts, words = wanted.split(), species.scientific_name.casefold().split()
    if 1 < len(parts) <= len(words) and all(map(str.startswith, words, parts)):
        return 2
    return 3 if len(wanted) > 2 and any(wanted in name for name in names) else None


@functools.cache
def shipped_species() -> tuple[Species, ...]:
    """The list that comes with the program."""
    text = resources.files("dbh_studio.app").joinpath("species_lists/trees.csv").read_text(encoding="utf-8")
    return parse_species(text, Path("trees.csv"))


def settings_folder() -> Path:
    """The folder of the person's own settings on this computer; it need not exist."""
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming") / "dbh-studio"
    given = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(given) if os.path.isabs(given) else Path.home() / ".config") / "dbh-studio"  # noqa: PTH117


def own_lists(plot_folder: Path | None) -> tuple[Path, ...]:
    """Where a person's own lists may be, the plot's first."""
    beside = () if plot_folder is None else (plot_folder / OWN_LIST,)
    return (*beside, settings_folder() / OWN_LIST)


def species_list(plot_folder: Path | None) -> tuple[Species, ...]:
    """All species to offer: the person's own before those that come with the program, each name once.

    Args:
        plot_folder: The folder in which the plot lies.

    Raises:
        MalformedFileError: One of the person's own lists cannot be read.
    """
    every: list[Species] = []
    for path in own_lists(plot_folder):
        if path.is_file():
            every.extend(read_species(path))
    named = {each.scientific_name.casefold() for each in every}
    every.extend(each for each in shipped_species() if each.scientific_name.casefold() not in named)
    return tuple(every)


def read_species(path: Path) -> tuple[Species, ...]:
    """A person's own list: a CSV with headings, or one name a line.

    Raises:
        MalformedFileError: It is no such table.
    """
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise MalformedFileError(path, "it is too large for a list of species.", "Keep one line per species in it.")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise MalformedFileError(path, "it is not written as UTF-8.", "Save it as CSV in UTF-8.") from None
    except OSError as error:
        raise MalformedFileError(path, f"it could not be read: {error.strerror}.", "Check the file.") from None
    return parse_species(text, path)


def parse_species(text: str, path: Path) -> tuple[Species, ...]:
    """As `read_species`, of a text; `path` is what a complaint names."""
    first = text.lstrip().split("\n", 1)[0]
    separator = max(",;\t", key=first.count)
    rows = [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text), delimiter=separator) if any(row)]
    if not rows:
        return ()
    columns = {}
    for at, heading in enumerate(rows[0]):
        plain = "".join(filter(str.isalnum, heading.casefold()))
        for field, titles in _HEADINGS.items():
            if plain in titles and field not in columns:
                columns[field] = at
    if not columns:
        columns = {"scientific_name": 0}
        if len(rows[0]) > 1:
            raise MalformedFileError(
                path,
                "none of its headings is known.",
                "Call the columns scientific_name, common_name, code, fia_code, usda_symbol, eppo_code.",
            )
    else:
        rows = rows[1:]
    name_at = columns.get("scientific_name", columns.get("common_name"))
    if name_at is None:
        raise MalformedFileError(path, "it has codes but no names.", "Add a column scientific_name.")
    found = []
    for row in rows:
        values = {field: row[at] for field, at in columns.items() if at < len(row)}
        name = values.pop("scientific_name", "") or values.get("common_name", "")
        if name:
            found.append(Species(name, **values))
    return tuple(found)
