#!/usr/bin/env python3
"""Write docs/guide/settings.md from the settings themselves.

.venv/bin/python tools/guide_settings.py            # write it
.venv/bin/python tools/guide_settings.py --check    # fail where it is not current
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from dbh_studio.settings import describe_settings

PAGE = Path(__file__).resolve().parents[1] / "docs" / "guide" / "settings.md"
# "trunks.slab_low_m = 0.6 m [0.1..5.0]" and below it "    Search from: height above ground"
_ENTRY = re.compile(r"(?P<section>\w+)\.(?P<name>\w+) = (?P<value>.*?)(?: \[(?P<limits>[^\]]*)\])?\n    (?P<text>.*)")

_INTRODUCTION = """\
# Settings

<!-- Written by tools/guide_settings.py; change the texts in src/dbh_studio/settings/. -->

Few plots need any of these. Where they are:

| | in the browser | on the command line | in Python |
|---|---|---|---|
| ground | step 3, *Ground settings* | `--set ground.cell_m=1` | `plot.settings("ground", cell_m=1)` |
| trunks | step 3, *Trunk settings* | `--set trunks.trunk_top_m=6` | `plot.settings("trunks", trunk_top_m=6)` |
| measure | step 4, *How diameters are measured* | `--set measure.seed=1` | `plot.settings("measure", seed=1)` |

In the browser the ones used most are in sight and the others under *More settings*. Settings are kept with the plot,
and each change can be undone. New ground and trunk settings take effect with *Find trunks*, new measuring settings with
*Measure again*; the curve and the usual breast heights take effect as soon as they are chosen.

What the curves, the quality and the reasons mean is in [the guide](README.md), how they are computed in
[the method](../method.md).
"""
_SECTIONS = {
    "ground": "Ground: how the ground under the stems is found",
    "trunks": "Trunks: how trunks are found",
    "measure": "Measure: how a diameter is measured",
}


def page() -> str:
    """The whole page."""
    parts, section = [_INTRODUCTION], ""
    for entry in _ENTRY.finditer(describe_settings()):
        if entry["section"] != section:
            section = entry["section"]
            parts.append(f"{'' if len(parts) == 1 else chr(10)}## {_SECTIONS[section]}\n")
            parts.append("| setting | name | default | range | |\n|---|---|---|---|---|")
        parts.append(_row(entry))
    return "\n".join(parts) + "\n"


def _row(entry: re.Match[str]) -> str:
    title, _, help_text = entry["text"].partition(": ")
    limits = (entry["limits"] or "").replace("..", " to ").replace(" | ", ", ")
    if entry["value"] in ("True", "False"):
        value, limits = ("on" if entry["value"] == "True" else "off"), "on, off"
    else:
        value = entry["value"]
    return f"| {title} | `{entry['name']}` | {value} | {limits} | {help_text} |".replace("|  |", "| |")


def main(arguments: list[str]) -> int:
    if "--check" not in arguments:
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    if PAGE.is_file() and PAGE.read_text(encoding="utf-8") == page():
        return 0
    print(f"{PAGE.name} is not current: run tools/guide_settings.py", file=sys.stderr)
    return 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
