"""`dbh-studio marker`: a marker to print."""

from __future__ import annotations

import argparse
import json
from typing import Any

from dbh_studio.cli.common import counted, finite_number, path_argument, plain
from dbh_studio.errors import FileError


def add_commands(commands: Any) -> None:
    """Register the command."""
    marker = commands.add_parser(
        "marker",
        help="write a marker to print, as a PDF",
        description="Write a marker to print. Glue it on a stiff board, measure the outer edge of its black square "
        "with a ruler, and give the program what you measured.",
    )
    marker.add_argument("--out", type=path_argument, required=True, metavar="FILE.pdf", help="the PDF to write")
    marker.add_argument("--side", type=finite_number, default=1.0, metavar="M", help="outer edge of the square, metres")
    marker.add_argument("--dictionary", default="DICT_4X4_50", metavar="NAME", help="its dictionary")
    marker.add_argument("--id", type=int, default=0, dest="marker_id", metavar="N", help="its number")
    marker.add_argument(
        "--paper",
        choices=("A4", "sheet"),
        default="A4",
        help="A4: pages to glue together; sheet: one page of the size needed, for a copy shop",
    )
    marker.add_argument("--overwrite", action="store_true", help="replace the file")
    marker.add_argument("--json", action="store_true", help="print what was written as JSON")
    marker.set_defaults(command=write_marker)


def write_marker(options: argparse.Namespace) -> int:
    """Write the PDF."""
    from dbh_studio.io.marker_pdf import write_marker_pdf

    if options.out.exists() and not options.overwrite:
        raise FileError(options.out, "There is such a file already.", "Choose another name, or add --overwrite.")
    written = write_marker_pdf(
        options.out,
        dictionary=options.dictionary,
        marker_id=options.marker_id,
        side_m=options.side,
        paper=options.paper,
    )
    if options.json:
        content = {"path": str(written.path), "n_pages": written.n_pages, "side_m": written.side_m}
        print(json.dumps(content, indent=2))
    else:
        print(plain(f"{written.path}: {counted(written.n_pages, 'page')}, black square {1000 * written.side_m:.0f} mm"))
    return 0
