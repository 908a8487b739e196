"""The server over HTTP: access control of all addresses, names as text, files in a sandbox, figures."""

import gc
import http.client
import json
import logging
import socket
import ssl
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from coded import raises
from tornado.web import Application

from errormotion.dashboard.access import access_for
from errormotion.dashboard.lab import Lab
from errormotion.dashboard.pages.page import Context, Guarded
from errormotion.dashboard.server import Options, application, run

PAGES = ["/", "/now", "/results", "/run", "/compare", "/compensate", "/compensate/effect", "/nowhere"]
DATA = [
    "/now/values.json",
    "/now/figure.json",
    "/now/history.json",
    "/run/figure.json",
    "/run/values.csv",
    "/run/file",
    "/run/space.html",
]
DATA += ["/compensate/state.json", "/compensate/curves.json", "/compensate/figure.json", "/compensate/effect.html"]
DATA += ["/compare/figure.json", "/compare/report.html", "/compare/history.html"]
PATHS = [*PAGES, *DATA]


def _handlers(found: Application) -> list[Any]:
    rules = [rule for each in found.default_router.rules for rule in each.target.rules]
    return [rule.target for rule in rules]


def test_every_handler_is_guarded(runs: Path) -> None:
    with ThreadPoolExecutor(1) as workers:
        context = Context(access_for("127.0.0.1"), Lab(runs), 5006, workers, workers, ())
    handlers = _handlers(application(context))
    assert len(handlers) >= len(PATHS) - 1
    assert all(issubclass(each, Guarded) for each in handlers)


@pytest.mark.parametrize("path", PATHS)
def test_nothing_is_read_without_the_token(open_to_the_network: Any, path: str) -> None:
    status, headers, text = open_to_the_network.ask(path)
    assert (status, headers["Location"], text) == (302, "/login", "")
    status, _, text = open_to_the_network.ask(path, Accept="application/json")
    assert (status, json.loads(text)) == (403, {"error": "The token is required", "code": "request.forbidden"})


@pytest.mark.parametrize("path", [*PATHS, "/login", "/static/dashboard.css"])
def test_a_foreign_host_name_is_rejected_by_all_handlers(open_to_this_computer: Any, path: str) -> None:
    status, _, text = open_to_this_computer.ask(path, Host="evil.example:5006")
    assert status == 421
    assert "Mill" not in text


def test_the_token_gives_access_and_is_in_no_log(open_to_the_network: Any, caplog: pytest.LogCaptureFixture) -> None:
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
    assert "The token is wrong" in text
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
        assert found["code"] in (
            "request.number.form",
            "request.point.form",
            "request.index.outside",
            "errors.point.form",
        )


def test_values_and_data_are_sent_whole(open_to_this_computer: Any, runs: Path, key: str) -> None:
    status, headers, text = open_to_this_computer.ask(f"/run/values.csv?run={key}")
    assert (status, len(text.splitlines())) == (200, 5001)
    assert headers["Content-Disposition"].startswith('attachment; filename="')
    size = open_to_this_computer.ask(f"/run/file?run={key}&file=log")[1]
    assert size["Content-Type"] == "application/x-ndjson"


def test_a_certificate_needs_its_key(tmp_path: Path) -> None:
    with raises("server.certificate.half"):
        run(Options(tmp_path, cert=tmp_path / "a.pem"), lambda *_: None)
    with raises("server.certificate.unusable"):
        run(Options(tmp_path, cert=tmp_path / "a.pem", key=tmp_path / "b.pem"), lambda *_: None)


@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket")
def test_an_address_in_use_is_named(open_to_this_computer: Any, tmp_path: Path) -> None:
    port = int(open_to_this_computer.address.rstrip("/").rpartition(":")[2])
    with raises("server.not_listening"):
        run(Options(tmp_path, port=port), lambda *_: None)
    gc.collect()  # tornado leaves the socket that it could not bind to the collector


def test_another_server_has_another_secret(serving: Callable[..., Any], runs: Path, open_to_this_computer: Any) -> None:
    assert serving(runs).access.session != open_to_this_computer.access.session


def test_the_connection_is_encrypted_with_a_certificate(
    serving: Callable[..., Any], runs: Path, tmp_path: Path
) -> None:
    key, cert = _certificate(tmp_path)
    served = serving(runs, host="0.0.0.0", cert=cert, key=key)
    port = int(served.address.rstrip("/").rpartition(":")[2])
    assert served.address.startswith("https://")
    assert served.access.secure
    trust = ssl.create_default_context(cafile=str(cert))
    connection = http.client.HTTPSConnection("127.0.0.1", port, timeout=20, context=trust)
    body = urlencode({"token": served.access.token})
    kind = "application/x-www-form-urlencoded"
    connection.request("POST", "/login", body, {"Origin": f"https://127.0.0.1:{port}", "Content-Type": kind})
    answer = connection.getresponse()
    answer.read()
    assert answer.status == 302
    assert "Secure" in str(answer.headers["Set-Cookie"])
    assert int(answer.headers["Strict-Transport-Security"].removeprefix("max-age=")) >= 180 * 24 * 3600
    connection.request("GET", "/nowhere")
    answer = connection.getresponse()
    connection.close()
    assert "Strict-Transport-Security" in answer.headers


def test_a_client_that_does_not_read_delays_no_other_client(open_to_this_computer: Any, key: str) -> None:
    port = int(open_to_this_computer.address.rstrip("/").rpartition(":")[2])
    with ExitStack() as stack:
        for _ in range(8):  # more than there are threads
            hanging = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            hanging.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            hanging.sendall(f"GET /run/file?run={key}&file=errors HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        stack.enter_context(socket.create_connection(("127.0.0.1", port))).sendall(b"GET /results HTT")
        assert open_to_this_computer.ask("/results")[0] == 200


def _certificate(folder: Path) -> tuple[Path, Path]:
    """Write a key and a self-signed certificate of 127.0.0.1; return both files."""
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "lab")])
    now = datetime.now(UTC)
    cert = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    files = folder / "key.pem", folder / "cert.pem"
    none = serialization.NoEncryption()
    pem = serialization.Encoding.PEM
    files[0].write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, none))
    files[1].write_bytes(cert.public_bytes(pem))
    return files
