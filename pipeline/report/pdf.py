"""A page printed to PDF by a Chromium that the machine has; boresight brings none."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.whole_file import write_whole

__all__ = ["chromium", "print_page"]

# Programs that are looked for, in this order.
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Of Chromium: no window, and nothing asked or printed beside the page.
SWITCHES = ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer")
# Longest time, s, that a browser may take to print the page.
LONGEST_S = 120.0


def chromium() -> str | None:
    """Path of a Chromium or Chrome on the search path; None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def print_page(page: Path) -> Path:
    """Print an HTML page to the PDF of its name beside it, A4; its path.

    `RawDataError` where no Chromium is installed or it fails.
    """
    printed = page.with_suffix(".pdf")
    if (program := chromium()) is None:
        wanted = f"one of {', '.join(NAMES)} on PATH; or print {page.name} from a browser"
        raise RawDataError("--pdf", "browser", "no Chromium", wanted)

    def write(target: Path) -> None:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            command = [program, *SWITCHES, f"--user-data-dir={profile}", f"--print-to-pdf={target.resolve()}"]
            try:
                ran = subprocess.run(
                    [*command, page.resolve().as_uri()], capture_output=True, text=True, timeout=LONGEST_S
                )
            except subprocess.TimeoutExpired as error:
                raise RawDataError("--pdf", program, f"no PDF after {LONGEST_S:.0f} s", "a PDF") from error
        if not target.is_file() or not target.stat().st_size:
            said = (ran.stderr.strip().splitlines() or ["no message"])[-1]
            raise RawDataError("--pdf", program, f"status {ran.returncode}: {said}", "a PDF")

    write_whole(printed, write)
    return printed
