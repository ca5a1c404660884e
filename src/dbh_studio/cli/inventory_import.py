"""`dbh-studio import`: take species, notes and the like of one's own inventory into a saved plot."""

from __future__ import annotations

import argparse
import json
from typing import Any

from dbh_studio.cli.common import add_relocation_option, path_argument, plain, progress_for


def add_commands(commands: Any) -> None:
    """Register the command."""
    bring = commands.add_parser(
        "import",
        help="take species, notes, tags and tape values of one's own inventory into a saved plot",
        description="Take what a table says of the stems into a saved plot (NAME.dbh), as one edit that can be undone: "
        "species, status, note, tag, health, crown class, fields of one's own, tape values, and which stems are one "
        "tree. Stems are told by stem_id. Diameters are never touched.",
    )
    bring.add_argument("plot", type=path_argument, help="a saved NAME.dbh")
    bring.add_argument("table", type=path_argument, help="an inventory that was exported here, edited or not")
    bring.add_argument(
        "--skip-misfits", action="store_true", help="leave out stems that the plot has not, or that stand elsewhere"
    )
    bring.add_argument(
        "--clear-empty", action="store_true", help="an empty cell takes back what was said; else it says nothing"
    )
    bring.add_argument("--no-fields", action="store_true", help="columns of other names do not become fields")
    bring.add_argument("--dry-run", action="store_true", help="say what would change, and change nothing")
    add_relocation_option(bring)
    bring.add_argument("--json", action="store_true", help="print what changed as JSON")
    bring.add_argument("--quiet", action="store_true", help="no progress")
    bring.set_defaults(command=import_table)


def import_table(options: argparse.Namespace) -> int:
    """Take the table over and say what changed."""
    from dbh_studio.app.inventory_import import ImportOptions, apply_import, plan_import
    from dbh_studio.app.opening import open_plot
    from dbh_studio.errors import SettingError
    from dbh_studio.io.project import is_project

    if not is_project(options.plot):
        raise SettingError(
            f"{options.plot.name} is no saved plot.", "Give a NAME.dbh; `dbh-studio run` makes one of a cloud."
        )
    wanted = ImportOptions(options.skip_misfits, options.clear_empty, not options.no_fields)
    with progress_for(options) as progress:
        session = open_plot(
            options.plot,
            relocate=options.cloud,
            read_only=options.dry_run,
            background_save=False,
            progress=progress,
        )
        try:
            document = session.document
            plan = plan_import(session, options.table, wanted)
            if not options.dry_run:
                apply_import(session, document, plan)
                session.flush()
        finally:
            session.close()
    if options.json:
        print(json.dumps({"stems": plan.n_changed, "changes": dict(plan.changes), "notes": list(plan.notes)}))
        return 0
    for line in (plan.words, *plan.notes):
        print(plain(line))
    return 0
