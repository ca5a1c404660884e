"""`dbh-studio doctor` and `dbh-studio settings`: what is there, and what can be set."""

from __future__ import annotations

import argparse
import json
from typing import Any


def add_commands(commands: Any) -> None:
    """Register the commands."""
    doctor = commands.add_parser(
        "doctor",
        help="what is installed, what is missing, and the line that mends it",
        description="Say what is installed, what is missing, what that costs, and the line that mends it. Status 0 "
        "where plots can be opened and measured.",
    )
    doctor.add_argument("--json", action="store_true", help="print JSON")
    doctor.set_defaults(command=run_doctor)
    settings = commands.add_parser(
        "settings",
        help="list every setting with its unit, bounds and default",
        description="List every setting that `--set NAME=VALUE` takes, with its default, unit and bounds.",
    )
    settings.add_argument("--json", action="store_true", help="print the defaults as JSON")
    settings.set_defaults(command=list_settings)


def run_doctor(options: argparse.Namespace) -> int:
    """Print the report; status 0 where the main job can be done."""
    from dbh_studio.app import doctor

    return doctor.main(["--json"] if options.json else [])


def list_settings(options: argparse.Namespace) -> int:
    """Print all settings."""
    from dbh_studio.settings import Settings, describe_settings

    print(json.dumps(Settings().model_dump(), indent=2) if options.json else describe_settings())
    return 0
