"""The command line: everything the studio does, for scripts.

Exit status: 0 done; 1 it could not be done, and the message says why; 2 wrong usage; 3 the cloud needs a scale;
130 interrupted; 143 terminated.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any

from dbh_studio import __version__
from dbh_studio.errors import CancelledError, SettingError, StudioError, UnscaledCloudError

EXIT_OK, EXIT_ERROR, EXIT_USAGE, EXIT_UNSCALED, EXIT_INTERRUPTED, EXIT_TERMINATED = 0, 1, 2, 3, 130, 143

_log = logging.getLogger(__name__)

# Their value may begin with a minus, which argparse would take for the next option.
_SIGNED_OPTIONS = ("--up", "--ground-z", "--lidar-up")


class _TerminatedError(KeyboardInterrupt):
    """A polite kill: clean up and end, as for Ctrl+C."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; whatever goes wrong is told in a sentence, never as a traceback."""
    with contextlib.suppress(AttributeError, ValueError):  # what stands in for them may not have it
        for stream in (sys.stdout, sys.stderr):
            # A file name or a degree sign must not end the program where the terminal has no letter for it.
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    # Read when numpy is first imported, and by child processes. The matrices here are small and many: threads for each
    # of them double the processor time of a measurement, and on a busy machine make it ten times slower.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with _polite_kill():
        status = _run(sys.argv[1:] if arguments is None else arguments)
        problem = _settle_output()
    if problem is not None and not isinstance(problem, BrokenPipeError) and status == EXIT_OK:
        return _say(f"The output could not be written ({problem.strerror or problem}).", EXIT_ERROR)
    return status


def _run(arguments: Sequence[str]) -> int:
    """Parse, run, and turn what was raised into a sentence and a status."""
    try:
        # The commands import what they need when they run: --help and doctor are quick, and work on a broken machine.
        parser = build_parser()
        options = parser.parse_args(_joined(arguments))
        logging.basicConfig(
            level=logging.DEBUG if options.verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
        )
        if not hasattr(options, "command"):
            parser.print_help()
            return EXIT_USAGE
        return int(options.command(options))
    except SystemExit as ended:  # argparse has said what there is to say
        return ended.code if isinstance(ended.code, int) else EXIT_OK
    except UnscaledCloudError as error:
        return _say(str(error), EXIT_UNSCALED)
    except SettingError as error:
        return _say(str(error), EXIT_USAGE)
    except _TerminatedError:
        return _say("terminated", EXIT_TERMINATED)
    except (CancelledError, KeyboardInterrupt):
        return _say("interrupted", EXIT_INTERRUPTED)
    except StudioError as error:
        return _say(str(error), EXIT_ERROR)
    except BrokenPipeError:
        # The reader of our output has gone (`| head`), which is no failure of ours.
        return EXIT_OK
    except MemoryError:
        _log.debug("Out of memory", exc_info=True)
        return _say(
            "There is not enough memory for this. Check the scale; thin the cloud out, or crop it to the plot.",
            EXIT_ERROR,
        )
    except OSError as error:
        _log.debug("The system refused", exc_info=True)
        what = f"{error.filename}: " if error.filename else ""
        return _say(f"{what}{error.strerror or error}.", EXIT_ERROR)
    except Exception as error:  # noqa: BLE001 - a person is told in a sentence; the log has the rest
        _log.debug("Unexpected", exc_info=True)
        return _say(
            f"Unexpected {type(error).__name__}: {error}. This is a defect of the program. Run again with --verbose "
            "and report what it prints.",
            EXIT_ERROR,
        )


def _say(message: str, status: int) -> int:
    from dbh_studio.cli.common import plain

    with contextlib.suppress(OSError):  # nobody listens
        print(f"dbh-studio: {plain(message)}", file=sys.stderr)
    return status


def _settle_output() -> OSError | None:
    """Write out what is buffered; where that fails, say why, and keep the interpreter from trying again as it ends."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return error
    return None


@contextlib.contextmanager
def _polite_kill() -> Iterator[None]:
    """While a command runs, SIGTERM is as Ctrl+C is: what was begun is tidied up."""

    def stop(*_: Any) -> None:
        raise _TerminatedError

    is_ours = threading.current_thread() is threading.main_thread()
    if not is_ours or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _joined(arguments: Sequence[str]) -> list[str]:
    """``--up -z`` as ``--up=-z``."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in _SIGNED_OPTIONS and argument.startswith("-") and not argument.startswith("--"):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    from dbh_studio.cli import (
        doctor,
        evaluate,
        export,
        inventory_import,
        marker,
        masks,
        measure,
        models,
        run,
        scale,
        studio,
        transfer,
    )

    parser = argparse.ArgumentParser(
        prog="dbh-studio",
        description="Tree diameters at breast height from point clouds, in the browser or from scripts.",
        epilog="Exit status: 0 done, 1 failed (the message says why), 2 wrong usage, 3 the cloud needs a scale.",
    )
    parser.add_argument("--version", action="version", version=f"dbh-studio {__version__}")
    parser.add_argument("--verbose", action="store_true", help="log what is done to standard error")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    parts = (studio, run, measure, scale, evaluate, export, inventory_import, marker, masks, models, transfer, doctor)
    for module in parts:
        module.add_commands(commands)
    for command in commands.choices.values():
        # Also behind the command; without a default, which would undo the one in front of it.
        command.add_argument("--verbose", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    return parser
