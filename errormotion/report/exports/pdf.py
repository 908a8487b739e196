"""The report as PDF: printed by a browser of this computer, or by the package weasyprint.

Browsers of the Chromium family print page numbers in margins from version 131 on.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from errormotion.datasets.files.writing import whole
from errormotion.errors import RunError

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "microsoft-edge-stable",
    "msedge",
)
_PLACES = {
    "win32": (
        r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
        r"C:\Program Files\Microsoft\Edge\Application\msedge.exe",
        r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    ),
    "darwin": (
        "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
        "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
        "/Applications/Chromium.app/Contents/MacOS/Chromium",
    ),
}
LONGEST = 180.0
"""Time for printing, s."""
WHAT_TO_INSTALL = (
    "Printing a report needs a browser of the Chromium family, version 131 or later (Debian and Ubuntu: apt install "
    "chromium; Windows: Microsoft Edge is one), or the package weasyprint: pip install 'errormotion[pdf]'. Without "
    "them, open the report in any browser and print it there."
)


def browser() -> str:
    """Return the path of a browser that prints; empty if there is none."""
    found = (shutil.which(name) for name in BROWSERS)
    places = (place for place in _PLACES.get(sys.platform, ()) if Path(place).is_file())
    return next((path for path in (*found, *places) if path), "")


def write(page: Path, out: Path) -> Path:
    """Print a page as PDF; an older file is replaced in one step.

    Raises
    ------
    RunError
        No program for printing was found, or printing failed.
    """
    with whole(out) as beside:
        program = browser()
        if program:
            _by_browser(program, page, beside)
        else:
            _by_weasyprint(page, beside)
        if not beside.is_file() or not beside.read_bytes()[:5] == b"%PDF-":
            raise RunError(f"{out}: {program or 'weasyprint'} did not write a PDF file", code="pdf.not_written")
    return out


def _by_browser(program: str, page: Path, out: Path) -> None:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            program, "--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--no-pdf-header-footer",
            f"--user-data-dir={profile}", f"--print-to-pdf={out.resolve()}", page.resolve().as_uri(),
        ]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:  # Chromium has no sandbox for root
            command.insert(1, "--no-sandbox")
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=LONGEST, check=False, cwd=profile
            )
        except subprocess.TimeoutExpired as error:
            raise RunError(f"{page}: {program} did not print it within {LONGEST:g} s", code="pdf.timeout") from error
        except OSError as error:
            raise RunError(
                f"{page}: {program} could not be started: {error.strerror}", code="pdf.not_started"
            ) from error
    if done.returncode:
        raise RunError(
            f"{page}: {program} could not print it (exit code {done.returncode}). "
            f"{done.stderr.decode(errors='replace').strip()[-300:]}",
            code="pdf.failed",
        )


def _by_weasyprint(page: Path, out: Path) -> None:
    try:
        from weasyprint import HTML
        from weasyprint.urls import URLFetcher
    except (ImportError, OSError) as error:  # OSError: its own libraries are missing
        raise RunError(WHAT_TO_INSTALL, code="pdf.no_program") from error
    only_inside = URLFetcher(allowed_protocols=("data",))
    HTML(string=page.read_text(encoding="utf-8"), url_fetcher=only_inside).write_pdf(out)
