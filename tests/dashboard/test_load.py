"""Load by clients that may read: the pages and both stops answer, and no file costs more than its budget."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion.campaign.folder import RunFolder
from errormotion.dashboard import load
from errormotion.dashboard.load import Load, client_of
from errormotion.record.runs.entry import MAX_FIGURES, MAX_READ, first_keys, read_entry

SOON = 10.0
"""Time for an answer to a request to stop, on a computer with other work, s."""
CONNECTIONS = 300
FORM = "application/x-www-form-urlencoded"

ATTACKER = """
import asyncio, sys
host, port, number, *request = sys.argv[1:]
head = request[0].encode().decode("unicode_escape").encode()

async def hold(reached):
    while True:
        try:
            reader, writer = await asyncio.open_connection(host, int(port))
            while True:
                writer.write(head)
                reached()
                length, line = 0, await reader.readline()
                while line not in (b"\\r\\n", b""):
                    name, _, value = line.partition(b":")
                    length = int(value) if name.lower() == b"content-length" else length
                    line = await reader.readline()
                if not line:
                    break
                await reader.readexactly(length)
        except (OSError, EOFError):
            await asyncio.sleep(0.01)

async def main():
    sent = 0
    def reached():
        nonlocal sent
        sent += 1
        if sent == int(number):
            print("sent", flush=True)
    await asyncio.gather(*(hold(reached) for _ in range(int(number))))

asyncio.run(main())
"""
"""A process whose connections send one request again and again, each as soon as it has an answer."""


@contextmanager
def attacked(served: Any, path: str, number: int = CONNECTIONS) -> Iterator[None]:
    where = urlsplit(served.address)
    cookie = f"Cookie: {served.cookie}\\r\\n" if served.cookie else ""
    accepted = "Accept: text/html\\r\\nAccept-Encoding: gzip\\r\\n"
    head = f"GET {path} HTTP/1.1\\r\\nHost: {where.netloc}\\r\\n{accepted}{cookie}\\r\\n"
    words = (str(where.hostname), str(where.port), str(number), head)
    with subprocess.Popen([sys.executable, "-c", ATTACKER, *words], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"sent\n"
            time.sleep(0.3)  # all of them at work
            yield
        finally:
            process.kill()


def stops(served: Any) -> list[tuple[int, float]]:
    """Return status and time (s) of a request to stop on either page, for what does not exist."""
    found = []
    origin = {"Origin": served.address.rstrip("/"), "Accept": "application/json"}
    for path, body, kind in (
        ("/compensate/stop", urlencode({"run": "none"}), FORM),
        ("/measure/stop", json.dumps({"process": "none"}), "application/json"),
    ):
        start = time.monotonic()
        status = served.ask(path, "POST", body, **{"Content-Type": kind, **origin})[0]
        found.append((status, time.monotonic() - start))
    return found


def answered(served: Any, path: str) -> str:
    """Return a page as soon as the share of this client permits."""
    end = time.monotonic() + SOON
    while (found := served.ask(path))[0] == 503 and time.monotonic() < end:
        time.sleep(0.2)
    assert found[0] == 200
    return str(found[2])


@pytest.fixture(scope="module")
def heavy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a folder of runs, and the key of one whose ``run.json`` has 60 000 figures."""
    root = tmp_path_factory.mktemp("heavy")
    folder = RunFolder.create(
        root, "drift", "00000001", {"bench": {"machine": "Mill"}, "steps": [], "status": "finished"}
    )
    figure = {"name": "drift " + 40 * "x", "value": 1e-6, "expanded_uncertainty": 1e-7, "unit": "m", "limit": None}
    folder.save(results=[figure] * 60_000)
    return root, folder.path.name


@pytest.fixture(scope="module")
def served(serving: Callable[..., Any], heavy: tuple[Path, str], tmp_path_factory: pytest.TempPathFactory) -> Any:
    return serving(heavy[0], campaigns=tmp_path_factory.mktemp("campaigns"), control=True)


@pytest.mark.parametrize(
    "path",
    [
        "/run?run={key}",
        *(
            pytest.param(each, marks=pytest.mark.slow)
            for each in (
                "/results",
                "/run/file?run={key}&file=run",
                "/static/bokeh.min.js",
                "/login",
                "/nothing",
                "/measure",
            )
        ),
    ],
)
def test_both_stops_answer_at_once_under_load(served: Any, heavy: tuple[Path, str], path: str) -> None:
    with attacked(served, path.format(key=heavy[1])):
        found = stops(served)
    assert [status for status, _ in found] == [400, 400]
    assert max(seconds for _, seconds in found) < SOON


def test_a_large_run_file_is_shown_in_part_and_says_so(served: Any, heavy: tuple[Path, str]) -> None:
    entry = read_entry(heavy[0] / heavy[1])
    assert (heavy[0] / heavy[1] / "run.json").stat().st_size > MAX_READ
    assert (entry.machine, entry.status, len(entry.figures or ())) == ("Mill", "finished", MAX_FIGURES)
    assert "what stands after the key" in entry.partial
    text = answered(served, "/run?" + urlencode({"run": heavy[1]}))
    assert "what stands after the key" in text
    assert text.count("drift xxxx") <= MAX_FIGURES
    assert "what stands after the key" in answered(served, "/results")


@pytest.mark.parametrize("spaces", [None, 1, "\t"])
def test_every_start_of_a_document_is_read_up_to_its_last_complete_value(spaces: Any) -> None:
    whole = {
        "schema": "a",
        "text": 'with "[1, {" and \\',
        "n": -1.5e3,
        "none": None,
        "list": [{"a": [1, 2]}, 3],
        "end": {},
    }
    text = json.dumps(whole, indent=spaces)
    for end in range(1, len(text) + 1):
        try:
            found = first_keys(text[:end])
        except ValueError:
            assert end < len('{"schema": "a"') + 6
            continue
        for (name, value), (expected_name, expected) in zip(found.items(), whole.items(), strict=False):
            assert name == expected_name
            is_start = isinstance(expected, list) and value == expected[: len(value)]
            cut_number = isinstance(expected, float) and name == list(found)[-1]  # the end of a number is not marked
            assert value == expected or is_start or cut_number
    assert first_keys(text) == whole


@pytest.mark.parametrize("text", ["", "[", "{", "nothing", '{"schema"', "{1: 2}", "{" * 100_000])
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises((ValueError, RecursionError)):
        first_keys(text)


def test_the_shares_of_a_client_are_bounded_and_separate() -> None:
    now = [0.0]
    shares = Load(clock=lambda: now[0])
    assert all(shares.begin("10.0.0.1", "reading") for _ in range(load.AT_ONCE))
    assert not shares.begin("10.0.0.1", "reading")
    assert shares.begin("10.0.0.1", "stopping")
    assert shares.begin("10.0.0.2", "reading")
    shares.end("10.0.0.1", "reading")
    assert shares.begin("10.0.0.1", "reading")
    others = [shares.begin(f"10.0.1.{k}", "reading") for k in range(load.MOST)]
    assert sum(others) == load.MOST - load.AT_ONCE - 1
    assert all(shares.begin(f"10.0.1.{k}", "stopping") for k in range(load.MOST - 1))


def test_the_rate_of_a_client_is_bounded() -> None:
    now = [0.0]
    shares = Load(clock=lambda: now[0])

    def served_of(number: int) -> int:
        found = 0
        for _ in range(number):
            if shares.begin("10.0.0.1", "open"):
                shares.end("10.0.0.1", "open")
                found += 1
        return found

    assert served_of(1000) == load.BURST
    now[0] += 1.0
    assert served_of(1000) == load.RATE
    now[0] += 1e6
    assert served_of(1000) == load.BURST


def test_the_memory_of_clients_is_bounded_and_keeps_those_with_requests() -> None:
    shares = Load(clock=lambda: 0.0)
    assert shares.begin("10.0.0.1", "reading")
    for k in range(3 * load.KEPT):
        if shares.begin(f"10.1.{k // 256}.{k % 256}", "open"):
            shares.end(f"10.1.{k // 256}.{k % 256}", "open")
    assert len(shares.clients) <= load.KEPT + 1
    assert shares.clients["10.0.0.1", "reading"].busy == 1


def test_a_network_of_ipv6_is_one_client() -> None:
    assert client_of("2001:db8::1") == client_of("2001:db8::ffff") != client_of("2001:db8:0:1::1")
    assert client_of("::ffff:10.0.0.1") == client_of("10.0.0.1") != client_of("10.0.0.2")
    assert client_of("fe80::1%eth0") == client_of("fe80::2%eth1")
