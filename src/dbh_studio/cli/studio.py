"""`dbh-studio open` and `dbh-studio demo`: the studio in the browser."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import add_cloud_options, progress_for
from dbh_studio.errors import StudioError

if TYPE_CHECKING:
    from dbh_studio.ui.studio import Studio


def add_commands(commands: Any) -> None:
    """Register the commands."""
    opened = commands.add_parser("open", help="open a plot in the browser")
    opened.add_argument(
        "plot", type=Path, nargs="?", help="a cloud, a mesh, a folder, or a saved NAME.dbh; none for an empty studio"
    )
    add_cloud_options(opened)
    _add_server_options(opened)
    opened.set_defaults(command=open_studio)
    demo = commands.add_parser("demo", help="make the synthetic demo plot, measure it, and open it in the browser")
    demo.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for the plot and its inventory"
    )
    demo.add_argument("--no-serve", action="store_true", help="write the inventory and stop")
    _add_server_options(demo)
    demo.set_defaults(command=run_demo)


def _add_server_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=int, help="port to listen on; default 8080 or the next free one")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; others can connect if it is not loopback"
    )
    parser.add_argument(
        "--allowed-host",
        action="append",
        default=[],
        metavar="NAME",
        help="a further name the studio may be addressed by",
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument("--display-points", type=int, metavar="N", help="how many points a browser is sent at most")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def open_studio(options: argparse.Namespace) -> int:
    """Serve a plot until interrupted."""
    studio = _start(options)
    if options.plot is not None:
        # Opened before the address is printed, so that a wrong file is told on the command line.
        try:
            _open_here(studio, options.plot, options)
        except BaseException:
            studio.close()
            raise
    return _serve(studio, options)


def run_demo(options: argparse.Namespace) -> int:
    """Make the demo plot, write its inventory, and serve it."""
    from dbh_studio.app import opening, pipeline
    from dbh_studio.app.demo import demo_plot

    progress = progress_for(options)
    demo = demo_plot(progress=progress)
    project = options.out / f"{demo.path.stem}.dbh"
    if (project / "project.json").exists():
        from dbh_studio.io.inventory_csv import write_inventory_csv

        session = opening.open_plot(project, relocate=demo.path, background_save=False, progress=progress)
        if not len(session.document.trunks):
            pipeline.segment(session, progress=progress)
        csv_path = write_inventory_csv(options.out / f"{demo.path.stem}.csv", session.inventory(progress))
        session.close()
    else:
        result = pipeline.run_plot(demo.path, options.out, progress=progress)
        csv_path = result.csv_path
        result.session.close()
    getattr(progress, "finish", lambda: None)()
    print(f"The demo plot is synthetic: {demo.path}")
    print(f"Its true diameters:  {demo.truth_csv}")
    print(f"Its inventory:       {csv_path}")
    if options.no_serve:
        return 0
    options.scale = options.up = None
    studio = _start(options)
    try:
        _open_here(studio, project, options)
    except BaseException:
        studio.close()
        raise
    return _serve(studio, options)


def _start(options: argparse.Namespace) -> Studio:
    try:
        from dbh_studio.ui.server import start_server
        from dbh_studio.ui.studio import DEFAULT_DISPLAY_POINTS, Studio
    except ImportError as error:
        raise StudioError(f"The studio cannot start: {error}.", "Run `dbh-studio doctor`.") from error

    server = start_server(
        host=options.host,
        port=options.port or 8080,
        strict_port=options.port is not None,
        allowed_hosts=tuple(options.allowed_host),
    )
    return Studio(server, display_points=options.display_points or DEFAULT_DISPLAY_POINTS)


def _open_here(studio: Studio, path: Path, options: argparse.Namespace) -> None:
    from dbh_studio.app import opening
    from dbh_studio.io.project import is_project

    progress = progress_for(options)
    project_dir = None if is_project(path) else studio.project_dir_for(path)
    studio.adopt(
        opening.open_plot(path, scale=options.scale, up=options.up, project_dir=project_dir, progress=progress)
    )
    getattr(progress, "finish", lambda: None)()


def _serve(studio: Studio, options: argparse.Namespace) -> int:
    """Print the address and wait for Ctrl+C or a polite kill."""
    if studio.server.note:
        print(studio.server.note)
    print(
        f"\nDBH Studio is open at\n\n    {studio.server.url}\n\nCtrl+C ends it; the plot is saved after every change.",
        flush=True,
    )
    if not options.no_browser and sys.stdout.isatty():
        threading.Thread(target=webbrowser.open, args=(studio.server.url,), daemon=True).start()
    stop = threading.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: stop.set())
    while not stop.wait(3600):
        pass
    studio.close()
    return 0
