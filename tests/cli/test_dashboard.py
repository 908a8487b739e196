"""``errormotion dashboard``: options and messages; the pages are tested in tests/dashboard."""

from pathlib import Path
from typing import Any

import pytest

from errormotion.cli.commands import dashboard


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--interval", "5"], "--interval: expected a time with its unit"),
        (["--interval", "1 ms"], "--interval: expected 0.1 s or more; found '1 ms'"),
        (["--cert", "lab.pem"], "--cert and --key: expected both, or neither"),
        (["--bench", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_invalid_options_are_named(run: Any, arguments: list[str], message: str) -> None:
    pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")
    assert message in run("dashboard", *arguments, code=1).output


def test_a_missing_extra_is_named(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dashboard, "find_spec", lambda name: None)
    assert "pip install 'errormotion[dashboard]'" in run("dashboard", code=1).output


def test_the_token_is_printed_once_and_only_for_the_network(
    run: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    server = pytest.importorskip("errormotion.dashboard.server", reason="pip install 'errormotion[dashboard]'")
    from errormotion.dashboard.access import access_for

    given = {}

    def serve(options: Any, started: Any) -> None:
        given[options.host] = access_for(options.host)
        started(f"http://{options.host}:{options.port}/", given[options.host])
        raise KeyboardInterrupt

    monkeypatch.setattr(server, "run", serve)
    assert "oken" not in run("dashboard").output
    output = run("dashboard", "--host", "0.0.0.0").output
    assert output.count(given["0.0.0.0"].token) == 1
    assert "not encrypted" in output
