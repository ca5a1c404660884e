"""`dbh-studio open` and `dbh-studio demo`: the studio in the browser."""

from __future__ import annotations

import argparse
import itertools
import logging
import signal
import sys
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import (
    ProgressLine,
    add_cloud_options,
    add_relocation_option,
    path_argument,
    plain,
    port_number,
    positive_integer,
    progress_for,
)
from dbh_studio.errors import ProjectError, ProjectLockedError, StudioError

if TYPE_CHECKING:
    from dbh_studio.app.demo import DemoPlot
    from dbh_studio.app.session import Session
    from dbh_studio.ui.studio import Studio


def add_commands(commands: Any) -> None:
    """Register the commands."""
    opened = commands.add_parser(
        "open",
        help="open a plot in the browser",
        description="Open a plot in the browser. What is done to PLOT.laz is saved beside it, in PLOT.dbh, after every "
        "change; the cloud itself is never written. Ctrl+C ends it.",
    )
    opened.add_argument(
        "plot",
        type=path_argument,
        nargs="?",
        help="a cloud, a mesh, a folder, or a saved NAME.dbh; none for an empty studio",
    )
    add_cloud_options(opened, otherwise="you set it in the studio")
    add_relocation_option(opened)
    opened.add_argument("--read-only", action="store_true", help="look only: write nothing, wait for no other program")
    _add_server_options(opened)
    opened.set_defaults(command=open_studio)
    demo = commands.add_parser(
        "demo",
        help="make the synthetic demo plot, measure it, and open it in the browser",
        description="Make the synthetic demo plot, measure it, and open it in the browser. It is made once and kept in "
        "the user's cache, or in the folder that the environment variable DBH_STUDIO_CACHE names.",
    )
    demo.add_argument(
        "--out",
        type=path_argument,
        default=Path("demo"),
        metavar="DIR",
        help="folder for the saved plot and its inventory; demo by default",
    )
    demo.add_argument("--no-serve", action="store_true", help="write the inventory and stop")
    _add_server_options(demo)
    demo.set_defaults(command=run_demo)


def _add_server_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=port_number, help="port to listen on; by default 8080 or the next free one")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; others can connect, with the link, if it is not loopback",
    )
    parser.add_argument(
        "--allowed-host",
        action="append",
        default=[],
        metavar="NAME",
        help="a further name the studio may be addressed by",
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument(
        "--display-points", type=positive_integer, metavar="N", help="how many points a browser is sent at most"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")


# ---- open


def open_studio(options: argparse.Namespace) -> int:
    """Serve a plot until interrupted."""
    studio = _start(options)
    try:
        if options.plot is not None:
            # Opened before the address is printed, so that a wrong file is told on the command line.
            with progress_for(options) as progress:
                studio.adopt(_open(studio, options, progress))
        return _serve(studio, options)
    finally:
        studio.close()


def _open(studio: Studio, options: argparse.Namespace, progress: ProgressLine) -> Session:
    from dbh_studio.app import opening
    from dbh_studio.io.project import is_project

    path, is_saved = options.plot, is_project(options.plot)
    if options.cloud is not None and not is_saved:
        raise StudioError(f"{path.name} is not a saved plot.", "Leave --cloud away, or name a NAME.dbh.")
    try:
        return opening.open_or_read(
            path,
            scale=options.scale,
            up=options.up,
            project_dir=None if is_saved else studio.project_dir_for(path),
            read_only=options.read_only,
            relocate=options.cloud,
            progress=progress,
        )
    except ProjectLockedError as error:
        raise ProjectLockedError(error.problem, "Close it there, or look at it here with --read-only.") from None


# ---- demo


def run_demo(options: argparse.Namespace) -> int:
    """Make the demo plot, write its inventory, and serve it."""
    from dbh_studio.app.demo import demo_plot
    from dbh_studio.io.inventory_csv import check_not_source, check_replaceable, write_inventory_csv

    with progress_for(options) as progress:
        demo = demo_plot(progress=progress)
        session, name = _demo_session(demo, options.out, progress)
        csv_path = options.out / f"{name}.csv"
        try:
            check_not_source(csv_path, [demo.path, demo.truth_csv])
            check_replaceable(csv_path)
            write_inventory_csv(csv_path, session.inventory(progress))
            session.flush()
        except BaseException:
            session.close()
            raise
    print(f"The demo plot is synthetic: {demo.path}")
    print(f"Its true diameters:  {demo.truth_csv}")
    print(f"Its inventory:       {csv_path}")
    if options.no_serve:
        session.close()
        return 0
    sys.stdout.flush()
    try:
        studio = _start(options)
    except BaseException:
        session.close()
        raise
    try:
        studio.adopt(session)
        return _serve(studio, options)
    finally:
        studio.close()


def _demo_session(demo: DemoPlot, out: Path, progress: ProgressLine) -> tuple[Session, str]:
    """The demo plot, open and with trunks, and its name in `out`.

    A plot that an earlier version of the demo left there is kept, edits and all; the new one gets a number.
    """
    from dbh_studio.app import opening, pipeline, plot_run
    from dbh_studio.app.autosave import Autosave
    from dbh_studio.io.project import FOLDER_SUFFIX, PROJECT_FILE, ProjectWriter

    for number in itertools.count(1):
        name = demo.path.stem if number == 1 else f"{demo.path.stem}-{number}"
        project = out / f"{name}{FOLDER_SUFFIX}"
        if not (project / PROJECT_FILE).exists():
            result = plot_run.run_plot(demo.path, out, plot_id="" if number == 1 else name, progress=progress)
            # From now on an edit need not wait for the disk. Closed first: a plot has one writer.
            result.session.close()
            Autosave(result.session, ProjectWriter(project), label="Open the demo plot")
            return result.session, name
        try:
            session = opening.open_plot(project, relocate=demo.path, progress=progress)
        except ProjectLockedError as error:
            raise ProjectLockedError(
                error.problem, "The demo is probably open already: use that window, or close it there."
            ) from None
        except ProjectError as error:
            progress.finish()
            print(f"note: {plain(error.problem)} It is kept as it is, and a new plot is made.", file=sys.stderr)
            continue
        try:
            if not len(session.document.trunks):
                pipeline.segment(session, progress=progress, in_process=True)
        except BaseException:
            session.close()
            raise
        return session, name
    raise AssertionError("the numbers do not end")


# ---- serving


def _start(options: argparse.Namespace) -> Studio:
    try:
        from dbh_studio.ui.server import start_server
        from dbh_studio.ui.studio import DEFAULT_DISPLAY_POINTS, Studio
    except ImportError as error:
        raise StudioError(f"The studio cannot start: {error}.", "Run `dbh-studio doctor`.") from error

    # What it says of the address is printed with the address.
    logging.getLogger("dbh_studio.ui.server").setLevel(logging.ERROR)
    server = start_server(
        host=options.host,
        port=options.port or 8080,
        strict_port=options.port is not None,
        allowed_hosts=tuple(options.allowed_host),
    )
    return Studio(server, display_points=options.display_points or DEFAULT_DISPLAY_POINTS)


def _serve(studio: Studio, options: argparse.Namespace) -> int:
    """Print the address and wait for Ctrl+C or a polite kill."""
    stop = threading.Event()
    # Before the address is out: who reads it may send the signal at once.
    before = {name: signal.signal(name, lambda *_: stop.set()) for name in (signal.SIGINT, signal.SIGTERM)}
    try:
        if studio.server.note:
            print(studio.server.note)
        print(f"\nDBH Studio is open at\n\n    {studio.server.url}\n\n{_closing_words(studio)}", flush=True)
        if not options.no_browser and sys.stdout.isatty():
            threading.Thread(target=webbrowser.open, args=(studio.server.url,), daemon=True).start()
        while not stop.wait(3600):
            pass
        if studio.session is not None:
            # Here, where it still ends in words and a status; closing would only log it.
            studio.session.flush()
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
    return 0


def _closing_words(studio: Studio) -> str:
    session = studio.session
    if session is not None and session.saver is not None:
        return f"The plot is kept in {plain(str(session.saver.folder))}, saved after every change. Ctrl+C ends it."
    if session is not None and session.read_only_note:
        return f"{plain(session.read_only_note)} Ctrl+C ends it."
    return "Ctrl+C ends it." if session is None else "Nothing is saved: it is open for reading only. Ctrl+C ends it."
