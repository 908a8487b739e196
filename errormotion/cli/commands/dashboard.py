"""``errormotion dashboard``: runs and instruments in a browser."""

from __future__ import annotations

import sys
import threading
import webbrowser
from importlib.util import find_spec
from pathlib import Path

from errormotion.cli.output import show
from errormotion.datasets.units import TIME
from errormotion.errors import BenchError, RunError

MIN_INTERVAL = 0.1
"""Shortest interval between readings of the bench, s."""


def run(
    runs: Path,
    bench: Path | None,
    interval: str,
    host: str,
    port: int,
    names: list[str],
    cert: Path | None,
    key: Path | None,
    browser: bool,
    campaigns: Path,
    control: bool,
) -> None:
    """Serve the dashboard until Ctrl-C.

    Raises
    ------
    RunError
        A package is missing, or the server cannot listen on the address.
    BenchError
        The bench file or the interval is invalid.
    """
    if find_spec("bokeh") is None:
        raise RunError(
            "The dashboard needs the package bokeh: pip install 'errormotion[dashboard]'", code="package.missing"
        )
    try:
        step = TIME.parse(interval)
    except ValueError as error:
        raise BenchError(f"--interval: {error}", code="option.form") from None
    if not step >= MIN_INTERVAL:
        raise BenchError(f"--interval: expected {MIN_INTERVAL:g} s or more; found '{interval}'", code="option.outside")
    from errormotion.dashboard.access import Access, is_loopback
    from errormotion.dashboard.server import Options, run

    def started(address: str, access: Access) -> None:
        show(f"The dashboard is at {address}  (Ctrl-C ends it)")
        if access.token:
            show(f"Token, shown only here: {access.token}")
            if not access.secure and not is_loopback(host):
                show("The connection is not encrypted: anyone on the network can read it. Give --cert and --key.")
        sys.stdout.flush()
        if browser and is_loopback(host) and sys.stdout.isatty():  # in a thread: some browsers block until they exit
            threading.Thread(target=webbrowser.open, args=[address], daemon=True).start()

    try:
        run(Options(runs, host, port, tuple(names), cert, key, bench, step, control, campaigns), started)
    except KeyboardInterrupt:  # Ctrl-C ends the command
        show()
