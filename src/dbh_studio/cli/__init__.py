"""The command line: everything the studio does, for scripts.

Exit status: 0 done; 1 it could not be done, and the message says why; 2 wrong usage; 3 the cloud needs a scale;
130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence

from dbh_studio import __version__
from dbh_studio.errors import CancelledError, StudioError, UnscaledCloudError

EXIT_OK, EXIT_ERROR, EXIT_USAGE, EXIT_UNSCALED, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    # The commands import what they need when they run: --help and doctor are quick, and work on a broken machine.
    parser = build_parser()
    options = parser.parse_args(arguments)
    logging.basicConfig(
        level=logging.DEBUG if options.verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    if not hasattr(options, "command"):
        parser.print_help()
        return EXIT_USAGE
    try:
        return int(options.command(options))
    except UnscaledCloudError as error:
        return _fail(error, EXIT_UNSCALED)
    except (CancelledError, KeyboardInterrupt):
        print("\ninterrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except StudioError as error:
        return _fail(error, EXIT_ERROR)
    except BrokenPipeError:
        # The reader of our output has gone (`| head`): no message, and none at interpreter exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK


def _fail(error: StudioError, status: int) -> int:
    print(f"dbh-studio: {error}", file=sys.stderr)
    return status


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    from dbh_studio.cli import doctor, measure, run, studio

    parser = argparse.ArgumentParser(
        prog="dbh-studio",
        description="Tree diameters at breast height from point clouds, in the browser or from scripts.",
        epilog="Exit status: 0 done, 1 failed (the message says why), 2 wrong usage, 3 the cloud needs a scale.",
    )
    parser.add_argument("--version", action="version", version=f"dbh-studio {__version__}")
    parser.add_argument("--verbose", action="store_true", help="log what is done to standard error")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for module in (studio, run, measure, doctor):
        module.add_commands(commands)
    return parser
