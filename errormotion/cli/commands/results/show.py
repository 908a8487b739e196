"""``errormotion open``: opens the newest report in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from errormotion.cli.output import show, show_json
from errormotion.datasets.files.reading import leaves
from errormotion.errors import RunError

PAGE = "report.html"


def open_report(path: Path, *, browser: bool, as_json: bool) -> None:
    """Print the path of a report and open it in the browser.

    Parameters
    ----------
    path : Path
        A run folder, a folder of runs (its newest run with a report), or a page.
    browser : bool
        False: only print the path.

    Raises
    ------
    RunError
        There is no report.
    """
    page = _page(path).resolve()
    opened = browser and _opened(page.as_uri())
    if as_json:
        show_json({"ok": True, "report": str(page), "opened": opened})
        return
    show(str(page))
    if browser and not opened:
        show("No browser was found on this computer. Open the file above, or copy it; it needs no other files.")


def _opened(address: str) -> bool:
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


def _page(place: Path) -> Path:
    if place.is_file():
        if place.suffix.lower() not in (".html", ".htm"):
            raise RunError(
                f"{place}: expected a run folder, a folder of runs, or a page (.html)", code="run.folder.not_found"
            )
        return place
    if not place.is_dir():
        raise RunError(
            f"{place}: there is no such folder; expected a run folder or a folder of runs", code="run.folder.not_found"
        )
    if (place / "run.json").exists():
        page = _inside(place)
        if page is None:
            raise RunError(
                f"{place}: has no {PAGE}. Write it with 'errormotion report {place}'", code="run.page.missing"
            )
        return page
    from errormotion.record.runs.listing import list_runs

    for path, _ in list_runs([place]).runs:
        page = _inside(path)
        if page is not None:
            return page
    raise RunError(
        f"{place}: holds no run with a {PAGE}. Write one with 'errormotion report RUN'", code="run.page.missing"
    )


def _inside(folder: Path) -> Path | None:
    """Return the report of a run folder; None where there is none, or a link leads out of the folder."""
    page = folder / PAGE
    return page if page.is_file() and not leaves(folder, page) else None
