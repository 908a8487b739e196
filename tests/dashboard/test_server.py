"""The server over HTTP: rules of access on every address, names as text, files in a sandbox, figures."""

import gc
import json
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from tornado.web import Application

from errormotion.dashboard.access import access_for
from errormotion.dashboard.lab import Lab
from errormotion.dashboard.pages.page import Context, Guarded
from errormotion.dashboard.server import Options, application, run
from errormotion.errors import RunError

PAGES = ["/", "/now", "/results", "/run", "/compare", "/nowhere"]
DATA = ["/now/values.json", "/now/figure.json", "/now/history.json", "/run/figure.json", "/run/values.csv", "/run/file"]
DATA += ["/compare/figure.json", "/compare/report.html", "/compare/history.html"]
PATHS = [*PAGES, *DATA]


def _handlers(found: Application) -> list[Any]:
    rules = [rule for each in found.default_router.rules for rule in each.target.rules]
    return [rule.target for rule in rules]


def test_every_handler_is_guarded(runs: Path) -> None:
    with ThreadPoolExecutor(1) as workers:
        context = Context(access_for("127.0.0.1"), Lab(runs), 5006, workers, ())
    handlers = _handlers(application(context))
    assert len(handlers) >= len(PATHS) - 1
    assert all(issubclass(each, Guarded) for each in handlers)


@pytest.mark.parametrize("path", PATHS)
def test_nothing_is_read_without_the_token(open_to_the_network: Any, path: str) -> None:
    status, headers, text = open_to_the_network.ask(path)
    assert (status, headers["Location"], text) == (302, "/login", "")
    status, _, text = open_to_the_network.ask(path, Accept="application/json")
    assert (status, json.loads(text)) == (403, {"error": "The token is required"})


@pytest.mark.parametrize("path", [*PATHS, "/login", "/static/dashboard.css"])
def test_a_foreign_name_is_refused_everywhere(open_to_this_computer: Any, path: str) -> None:
    status, _, text = open_to_this_computer.ask(path, Host="evil.example:5006")
    assert status == 421
    assert "Mill" not in text


def test_the_token_opens_and_no_log_holds_it(open_to_the_network: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    served, token = open_to_the_network, open_to_the_network.access.token
    origin = {"Origin": served.address.rstrip("/"), "Content-Type": "application/x-www-form-urlencoded"}
    assert served.ask("/login", "POST", urlencode({"token": token}))[0] == 403  # no origin
    assert (
        served.ask("/login", "POST", urlencode({"token": token}), **{**origin, "Origin": "https://evil.example"})[0]
        == 403
    )
    status, headers, text = served.ask("/login", "POST", urlencode({"token": token[:-1]}), **origin)
    assert (status, "Set-Cookie" in headers) == (403, False)
    assert "This is not the token" in text
    status, headers, _ = served.ask("/login", "POST", urlencode({"token": token}), **origin)
    assert status == 302
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    session = cookie.partition(";")[0]
    assert served.ask("/results", Cookie=session)[0] == 200
    assert served.ask("/results", Cookie=session[:-1])[0] == 302
    assert caplog.text
    assert not any(secret in caplog.text for secret in (token, served.access.session))


def test_names_are_text_on_every_page(open_to_this_computer: Any, runs: Path, key: str, markup: str) -> None:
    for path in (
        "/results",
        "/results?" + urlencode({"text": markup}),
        f"/run?run={key}",
        "/run?" + urlencode({"run": markup}),
    ):
        status, headers, text = open_to_this_computer.ask(path)
        assert "<script>window" not in text, path
        assert "script-src 'self';" in headers["Content-Security-Policy"]
        assert (status == 404) == ("%3C" in path and "run?" in path)
    assert "Mill &lt;script&gt;" in open_to_this_computer.ask("/results")[2]


def test_a_report_is_shown_in_a_sandbox_without_a_network(open_to_this_computer: Any, key: str) -> None:
    status, headers, text = open_to_this_computer.ask(f"/run/file?run={key}&file=report")
    policy = headers["Content-Security-Policy"]
    assert status == 200
    assert "id=written" in text
    assert "sandbox" in policy
    assert "default-src 'none'" in policy
    assert "allow-same-origin" not in policy
    assert "Content-Disposition" in open_to_this_computer.ask(f"/run/file?run={key}&file=report&save=1")[1]


def test_the_figure_follows_the_functional_point(open_to_this_computer: Any, key: str) -> None:
    def figure(**question: str) -> tuple[int, Any]:
        status, _, text = open_to_this_computer.ask(
            "/run/figure.json?" + urlencode({"run": key, **question}), Accept="application/json"
        )
        return status, json.loads(text)

    status, found = figure(x="0", y="0", z="-200")
    assert (status, found["point"]) == (200, [0.0, 0.0, -200.0])
    assert found["item"]["doc"]["roots"]
    for wrong in ({"x": "far"}, {"x": "1e9", "y": "0", "z": "0"}, {"x": "1", "y": "", "z": "0"}, {"at": "time:-1"}):
        status, found = figure(**wrong)
        assert status == 400
        assert "expected" in found["error"]


def test_values_and_data_are_sent_whole(open_to_this_computer: Any, runs: Path, key: str) -> None:
    status, headers, text = open_to_this_computer.ask(f"/run/values.csv?run={key}")
    assert (status, len(text.splitlines())) == (200, 5001)
    assert headers["Content-Disposition"].startswith('attachment; filename="')
    size = open_to_this_computer.ask(f"/run/file?run={key}&file=log")[1]
    assert size["Content-Type"] == "application/x-ndjson"


def test_a_certificate_needs_its_key(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="expected both"):
        run(Options(tmp_path, cert=tmp_path / "a.pem"), lambda *_: None)
    with pytest.raises(RunError, match="cannot be used as certificate and key"):
        run(Options(tmp_path, cert=tmp_path / "a.pem", key=tmp_path / "b.pem"), lambda *_: None)


@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket")
def test_an_address_in_use_is_named(open_to_this_computer: Any, tmp_path: Path) -> None:
    port = int(open_to_this_computer.address.rstrip("/").rpartition(":")[2])
    with pytest.raises(RunError, match=f"port {port}: cannot be listened on"):
        run(Options(tmp_path, port=port), lambda *_: None)
    gc.collect()  # tornado leaves the socket that it could not bind to the collector


def test_another_server_has_another_secret(serving: Callable[..., Any], runs: Path, open_to_this_computer: Any) -> None:
    assert serving(runs).access.session != open_to_this_computer.access.session
