"""The plot to look at in 3D: one HTML file that is opened by a double click and needs neither network nor server.

The viewer is ours (`scene.js`, WebGL without a framework): fifteen kilobytes that tie each stem to its row, where the
client of the studio would bring most of a megabyte and know no rows.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from dbh_studio.core.arrays import Float64, Int32, UInt8
from dbh_studio.core.inventory import InventoryRow
from dbh_studio.core.markup import markup
from dbh_studio.core.tree_record import TreeRecord
from dbh_studio.io.exports.columns import Table, written_whole
from dbh_studio.io.exports.pages import Words, data_block, document, facts
from dbh_studio.io.exports.report_stems import stem_facts

MOST_STEMS = 65_535
_STEPS = 65_535
_RING_CORNERS = 48
_LABEL_ABOVE_M = 0.9
_SHORTEST_M = 1e-3


@dataclass(frozen=True, eq=False)
class Scene:
    """What the page shows.

    Attributes:
        title: Name of the plot.
        words: A line below it.
        table: The inventory.
        records: What was said about the stems, by id.
        points_m: (N, 3) places, world; a thinned picture of the cloud.
        rgb: (N, 3) their own colours.
        owner: (N,) id of the stem each belongs to, 0 where none.
        colours: Of the stems, by id.
        rings: (M, 3) outline measured at breast height, world, by id of the stem; those without a diameter have none.
    """

    title: str
    words: str
    table: Table
    records: Mapping[int, TreeRecord]
    points_m: Float64
    rgb: UInt8
    owner: Int32
    colours: Mapping[int, tuple[int, int, int]]
    rings: Mapping[int, Float64]


def write_scene_html(path: Path | str, scene: Scene) -> Path:
    """Write the page.

    Raises:
        FileError: It cannot be written.
        ValueError: There are more stems than a page can tell apart.
    """
    path = Path(path)
    content = scene_html(scene).encode("utf-8", errors="replace")
    with written_whole(path) as file:
        file.write(content)
    return path


def scene_html(scene: Scene) -> str:
    """The whole page.

    Raises:
        ValueError: As `write_scene_html`.
    """
    if len(scene.table.inventory) > MOST_STEMS:
        raise ValueError(f"a page can tell {MOST_STEMS:,} stems apart, not {len(scene.table.inventory):,}")
    folder = resources.files("dbh_studio.io.exports")
    style, script = (folder.joinpath(name).read_text(encoding="utf-8") for name in ("scene.css", "scene.js"))
    places, low, step, middle = _quantised(scene.points_m)
    number = {row.stem_id: k for k, row in enumerate(scene.table.inventory, start=1)}
    owners = _numbered(scene.owner, number)
    data = {
        "n": len(places),
        "low": low.tolist(),
        "step": step.tolist(),
        "centre": _centre(scene, middle),
        "reach": float(0.5 * np.linalg.norm(step * _STEPS)),
        "grain": _grain(step, len(places)),
        "stems": [_stem(row, scene, middle) for row in scene.table.inventory],
    }
    blocks = [
        data_block("scene-data", data),
        _bytes_block("scene-places", places.astype("<u2").tobytes()),
        _bytes_block("scene-owners", owners.astype("<u2").tobytes()),
        _bytes_block("scene-colours", np.ascontiguousarray(scene.rgb, np.uint8).tobytes()),
    ]
    return document(f"{scene.title} – 3D", style, _body(scene) + "\n".join(blocks), script=script)


def _bytes_block(name: str, content: bytes) -> str:
    return f'<script type="text/plain" id="{name}">{base64.b64encode(content).decode("ascii")}</script>'


def _quantised(points_m: Float64) -> tuple[Any, Float64, Float64, Float64]:
    """(N, 3) places in 65 535 steps from the lowest corner; the corner about the middle; the step; the middle."""
    if not len(points_m):
        return np.empty((0, 3), np.uint16), np.zeros(3), np.full(3, _SHORTEST_M), np.zeros(3)
    lowest, highest = points_m.min(axis=0).astype(np.float64), points_m.max(axis=0).astype(np.float64)
    middle = 0.5 * (lowest + highest)
    step = np.maximum(highest - lowest, _SHORTEST_M) / _STEPS
    return np.rint((points_m - lowest) / step).astype(np.uint16), lowest - middle, step, middle


def _numbered(owner: Int32, number: Mapping[int, int]) -> Int32:
    """The stems by their place in the table, from 1."""
    table = np.zeros(int(owner.max(initial=0)) + 1, np.int32)
    for stem_id, place in number.items():
        if stem_id < len(table):
            table[stem_id] = place
    return np.asarray(table[owner], np.int32)


def _centre(scene: Scene, middle: Float64) -> list[float]:
    """What the camera turns about: the stems at breast height, or the middle of the cloud."""
    places = [p for row in scene.table.inventory if (p := _place(row)) is not None]
    centre = np.mean(places, axis=0) - middle if places else np.zeros(3)
    return [round(float(part), 3) for part in centre]


def _grain(step: Float64, n_points: int) -> float:
    """How large a point is drawn, metres: about the distance to the next, were all of them spread over the ground."""
    area = float(step[0] * step[1]) * _STEPS**2
    return min(0.06, max(0.012, 0.7 * math.sqrt(area / max(n_points, 1))))


def _place(row: InventoryRow) -> Float64 | None:
    if row.x_m is None or row.y_m is None:
        return None
    return np.array([row.x_m, row.y_m, (row.z_ground_m or 0.0) + (row.hom_m or 1.3)], np.float64)


def _stem(row: InventoryRow, scene: Scene, middle: Float64) -> dict[str, Any]:
    place, ring = _place(row), scene.rings.get(row.stem_id)
    words = Words(scene.table.units)
    made: dict[str, Any] = {
        "id": row.stem_id,
        "measured": row.dbh_cm is not None,
        "dbh": words.diameter(row.dbh_cm, unit=True) if row.dbh_cm is not None else "no diameter",
        "colour": [int(part) for part in scene.colours[row.stem_id]],
    }
    if place is not None:
        at = place - middle
        made["at"] = np.round(at, 3).tolist()
        made["top"] = np.round(at + [0.0, 0.0, _LABEL_ABOVE_M], 3).tolist()
    if ring is not None and len(ring):
        chosen = np.linspace(0, len(ring), min(_RING_CORNERS, len(ring)), endpoint=False).astype(int)
        made["ring"] = np.round(ring[chosen] - middle, 3).ravel().tolist()
    return made


def _body(scene: Scene) -> str:
    words = Words(scene.table.units)
    rows = "".join(_row(row, words) for row in scene.table.inventory)
    cards = "".join(_card(row, scene, words) for row in scene.table.inventory)
    return (
        '<main id="stage"><canvas id="view"></canvas><canvas id="labels" tabindex="0" aria-label="The plot in 3D: drag '
        'to turn, click a stem"></canvas><p id="said"></p><div class="bar">'
        '<button type="button" id="reset">Whole plot</button><button type="button" id="above">From above</button>'
        '<button type="button" id="names" aria-pressed="true">Numbers</button>'
        '<button type="button" id="tint" aria-pressed="true">Colour the stems</button></div>'
        '<div class="hint">Drag: turn · right drag or two fingers: move · wheel or pinch: nearer · click: choose a stem'
        "</div></main>"
        f'<aside><header><h1>{markup(scene.title)}</h1><p class="soft">{markup(scene.words)}</p>'
        '<noscript><p class="soft">The 3D picture needs JavaScript; the table does not.</p></noscript></header>'
        '<div class="list"><table><thead><tr><th class="n">Stem</th><th class="n">DBH '
        f"{words.diameter_unit}</th><th>Species</th><th>Remark</th></tr></thead><tbody>{rows}</tbody></table></div>"
        f'<div id="card" hidden>{cards}</div></aside>\n'
    )


def _row(row: InventoryRow, words: Words) -> str:
    remark = row.note or (row.reason if row.dbh_cm is None else "")
    return (
        f'<tr data-stem="{row.stem_id}"><td class="n"><a href="#stem-{row.stem_id}">{row.stem_id}</a></td>'
        f'<td class="n">{words.diameter(row.dbh_cm)}</td><td>{markup(row.species)}</td><td>{markup(remark)}</td></tr>'
    )


def _card(row: InventoryRow, scene: Scene, words: Words) -> str:
    record = scene.records.get(row.stem_id, TreeRecord())
    ends = f" (90 %: {words.interval(row)})" if row.dbh_lo_cm is not None else ""
    number = words.diameter(row.dbh_cm, unit=True) + ends if row.dbh_cm is not None else "none"
    tree = str(row.tree_id) if row.tree_id != row.stem_id else ""
    first = [("Diameter", number), ("Tree", tree), ("Species", row.species), ("Tag", row.tag)]
    said = facts([*first, *stem_facts(row, record, words)])
    return (
        f'<article data-stem="{row.stem_id}" id="stem-{row.stem_id}" hidden><h2>Stem {row.stem_id}</h2>{said}</article>'
    )
