"""`dbh-studio run`: a plot in, an inventory out, without a browser."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from dbh_studio.cli.common import add_cloud_options, add_settings_options, progress_for, settings_from


def add_commands(commands: Any) -> None:
    """Register the command."""
    run = commands.add_parser(
        "run",
        help="read a plot, find and measure its trunks, write the inventory",
        description="Read a plot, find and measure its trunks, and write NAME.csv and the saved plot NAME.dbh.",
    )
    run.add_argument("plot", type=Path, help="a cloud, a mesh, a folder of them, or a saved NAME.dbh")
    run.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the inventory and the saved plot"
    )
    add_cloud_options(run)
    add_settings_options(run)
    run.add_argument("--name", default="", help="what to call the plot; the file's name by default")
    run.add_argument(
        "--overwrite", action="store_true", help="replace the saved plot of an earlier run, and edits made in it"
    )
    run.add_argument("--json", action="store_true", help="print the result as JSON")
    run.add_argument("--quiet", action="store_true", help="no progress, no summary")
    run.set_defaults(command=run_plot)


def run_plot(options: argparse.Namespace) -> int:
    """Run the whole chain."""
    from dbh_studio.app import pipeline

    progress = progress_for(options)
    customised = options.assignments or options.curve or options.breast_height is not None or options.ground
    try:
        result = pipeline.run_plot(
            options.plot,
            options.out,
            scale=options.scale,
            up=options.up,
            settings=settings_from(options) if customised else None,
            plot_id=options.name,
            overwrite=options.overwrite,
            progress=progress,
        )
    finally:
        getattr(progress, "finish", lambda: None)()
    inventory = result.session.inventory()
    scale = result.session.document.scale
    result.session.close()
    if options.json:
        summary = {
            "plot": result.session.document.plot_id,
            "csv": str(result.csv_path),
            "project": str(result.project_dir),
            "n_stems": len(inventory),
            "n_measured": len(inventory) - inventory.n_refused,
            "n_refused": inventory.n_refused,
            "metres_per_unit": scale.metres_per_unit,
            "scale_source": scale.source,
            "notes": list(result.notes),
            "seconds": {step: round(seconds, 3) for step, seconds in result.timings_s.items()},
            "stems": [
                {"stem_id": row.stem_id, "dbh_cm": row.dbh_cm, "x_m": row.x_m, "y_m": row.y_m, "reason": row.reason}
                for row in inventory
            ],
        }
        print(json.dumps(summary, indent=2))
    elif not options.quiet:
        for note in result.notes:
            print(f"note: {note}", file=sys.stderr)
        print(_table(inventory))
        print(f"\n{len(inventory)} stems, {len(inventory) - inventory.n_refused} with a diameter: {result.csv_path}")
        print(f"Look at them: dbh-studio open {result.project_dir}")
    return 0


def _table(inventory: Any) -> str:
    lines = [f"{'stem':>5} {'DBH cm':>7} {'quality':<8} {'arc':>4}  remark"]
    for row in inventory:
        diameter = "-" if row.dbh_cm is None else f"{row.dbh_cm:.1f}"
        arc = "-" if row.coverage_deg is None else f"{row.coverage_deg:.0f}"
        lines.append(f"{row.stem_id:>5} {diameter:>7} {row.quality or '-':<8} {arc:>4}  {row.reason or row.note or ''}")
    return "\n".join(lines)
