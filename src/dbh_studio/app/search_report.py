"""The last search for trunks as a file: its steps and clusters for other programs to read."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from pathlib import Path
from typing import Any

from dbh_studio.app.session import Session
from dbh_studio.core.chain_advice import Story, story_of_cluster, story_of_miss
from dbh_studio.core.chain_steps import ChainSteps, Step
from dbh_studio.errors import CommandError, FileError, SettingError
from dbh_studio.io.atomic import atomic_file

SUFFIXES = (".json", ".csv")
_COLUMNS = ("n_points", "kept", "has_rings", "x_m", "y_m", "z_m", "width_m", "low_m", "high_m", "why", "advice")


def check_report(path: Path, *, overwrite: bool) -> None:
    """Look, before the work is done, whether a report can be written to `path`.

    Raises:
        SettingError: Its suffix is none of `SUFFIXES`.
        FileError: It is there already and `overwrite` is False, or its folder is not.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise SettingError(
            f"The steps cannot be written as {path.name}.", f"Give a name that ends in {' or '.join(SUFFIXES)}."
        )
    if not overwrite and os.path.lexists(path):
        raise FileError(
            path, "There is such a file already.", "Choose another name, or say that it may be overwritten."
        )
    if not path.absolute().parent.is_dir():
        raise FileError(path, "There is no such folder.", "Make it, or choose another.")


def search_report(session: Session) -> dict[str, Any]:
    """The last search of a plot: its settings, points by step, clusters with why they were dropped, near misses.

    Positions are in the plot's world frame, as in the inventory.

    Raises:
        CommandError: No search is remembered.
    """
    search = session.last_search
    if search is None:
        raise CommandError("The trunks of this plot were not searched for.", "Find them first.")
    steps = search.steps
    return {
        "when": search.when.isoformat(),
        "candidates_from": "masks" if steps.from_masks else "geometry",
        "n_trunks": search.n_trunks,
        "settings": {"ground": search.ground.model_dump(), "trunks": steps.settings.model_dump()},
        "points": {
            "all": steps.n_points,
            "candidates": steps.n_candidates,
            "within_heights": steps.n_above_ground,
            "facing_sideways": steps.n_facing_sideways,
            "in_clusters": steps.n_clustered,
            "in_kept_clusters": steps.n_in_clusters,
            "in_trunks": steps.n_expanded,
        },
        "points_by_last_step": {step.name.lower(): steps.counts[step] for step in Step},
        "joined_after": {step.name.lower(): steps.joined_from[step] for step in Step},
        "size_threshold": _number(steps.size_threshold),
        "clusters": _clusters(session, steps),
        "near_misses": [
            {
                "x_m": _number(miss.x_m),
                "y_m": _number(miss.y_m),
                "low_m": _number(miss.low_m),
                "high_m": _number(miss.high_m),
                "diameter_m": _number(miss.diameter_m),
                "coverage_deg": _number(miss.coverage_deg),
                **_told(story_of_miss(steps, miss)),
            }
            for miss in steps.near_misses
        ],
    }


def write_search_report(path: Path, session: Session) -> None:
    """Write `search_report` as JSON, or its clusters as CSV, one in each line; by the suffix of `path`.

    Raises:
        CommandError: No search is remembered.
        FileError: It cannot be written.
    """
    report = search_report(session)
    content = json.dumps(report, indent=2, allow_nan=False) + "\n"
    if path.suffix.lower() == ".csv":
        table = io.StringIO(newline="")
        writer = csv.writer(table)
        writer.writerow(_COLUMNS)
        for cluster in report["clusters"]:
            texts = "; ".join(advice["text"] for advice in cluster["advice"])
            writer.writerow([texts if name == "advice" else cluster[name] for name in _COLUMNS])
        content = table.getvalue()
    try:
        with atomic_file(path) as file:
            file.write(content.encode())
    except OSError as error:
        raise FileError(path, f"It cannot be written: {error.strerror or error}.", "Choose another place.") from None


def _clusters(session: Session, steps: ChainSteps) -> list[dict[str, Any]]:
    places = session.points_world()[[cluster.point for cluster in steps.clusters]]
    return [
        {
            "n_points": cluster.n_points,
            "kept": cluster.kept,
            "has_rings": cluster.has_rings,
            **dict(zip(("x_m", "y_m", "z_m"), (_number(float(value)) for value in place), strict=True)),
            "width_m": _number(cluster.width_m),
            "low_m": _number(cluster.low_m),
            "high_m": _number(cluster.high_m),
            **_told(story_of_cluster(steps, number)),
        }
        for number, (cluster, place) in enumerate(zip(steps.clusters, places, strict=True))
    ]


def _told(story: Story) -> dict[str, Any]:
    advice = [{"text": each.text, "changes": dict(each.changes), "also_back": each.n_others} for each in story.advice]
    return {"why": story.text, "advice": advice}


def _number(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
