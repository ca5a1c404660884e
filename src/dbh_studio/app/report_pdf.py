"""The report as PDF, printed by a browser that is on this computer: it lays out pages better than a library would."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

from dbh_studio.app.doctor import find_chromium
from dbh_studio.errors import FileError, MissingComponentError
from dbh_studio.io.exports.columns import unwritten, written_whole

_LONGEST_S = 300.0


def write_report_pdf(path: Path, page: str) -> Path:
    """Print a page that needs nothing beside it.

    Args:
        path: Of the PDF.
        page: HTML of ours.

    Raises:
        MissingComponentError: There is no Chromium or Chrome.
        FileError: The browser could not print it, or the file cannot be written.
    """
    browser = find_chromium()
    if browser is None:
        raise MissingComponentError(
            "A PDF is printed by Chromium or Chrome, and neither was found.",
            "Hand in the HTML report, or open it in any browser and print it into a PDF.",
        )
    try:
        content = _printed(path, page, browser)
    except OSError as error:
        raise unwritten(path, error) from error
    with written_whole(path) as file:
        file.write(content)
    return path


def _printed(path: Path, page: str, browser: str) -> bytes:
    """The PDF. Raises FileError where the browser cannot print it, OSError where there is no room for it."""
    with tempfile.TemporaryDirectory(prefix="dbh-report-", ignore_cleanup_errors=True) as folder:
        source, made = Path(folder) / "report.html", Path(folder) / "report.pdf"
        source.write_text(page, encoding="utf-8", errors="replace")
        command = [
            browser, "--headless=new", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--disable-background-networking", "--no-pdf-header-footer", f"--user-data-dir={folder}/profile",
            f"--print-to-pdf={made}", source.as_uri(),
        ]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            # Chromium's sandbox does not run as root; the page is ours and runs no scripts.
            command.insert(1, "--no-sandbox")
        try:
            done = subprocess.run(command, capture_output=True, timeout=_LONGEST_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise FileError(path, f"The browser could not print it ({error}).", _INSTEAD) from error
        if not made.is_file() or not made.stat().st_size:
            raise FileError(path, f"The browser could not print it (exit status {done.returncode}).", _INSTEAD)
        return made.read_bytes()


_INSTEAD = "Open the HTML report in a browser and print it into a PDF."
