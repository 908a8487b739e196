"""The page Compare over HTTP: verdict, causes and messages are those of the functions."""

import json
import threading
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion import datasets
from errormotion.compare import compare
from errormotion.compare.text import verdict
from errormotion.dashboard.pages import compare as compare_page


@pytest.fixture(scope="module")
def served(serving: Callable[..., Any], pair_of_runs: tuple[Path, list[str]]) -> Any:
    return serving(pair_of_runs[0])


def _query(keys: list[str], **more: str) -> str:
    return urlencode([*(("run", key) for key in keys), *more.items()])


def test_the_verdict_is_that_of_the_function(served: Any, pair_of_runs: tuple[Path, list[str]]) -> None:
    root, keys = pair_of_runs
    status, _, text = served.ask(f"/compare?{_query(keys)}")
    expected = verdict(compare({name: datasets.load(root / name / "errors.nc") for name in keys}))[0]
    assert "contradict each other" in expected
    assert status == 200
    assert escape(expected) in text
    assert "Most likely cause" in text
    assert "<script>window" not in text
    assert all(f"drift {key[:16]} {key[-8:]}" in text for key in keys)  # tests of one name
    status, _, text = served.ask(f"/compare/figure.json?{_query(keys)}")
    assert (status, bool(json.loads(text)["item"]["doc"]["roots"])) == (200, True)


def test_freedoms_reference_and_point_are_passed_on(served: Any, pair_of_runs: tuple[Path, list[str]]) -> None:
    root, keys = pair_of_runs
    _, _, text = served.ask(f"/compare?{_query(keys, freedom='EX', since='10', x='0', y='0', z='-100')}")
    names = {name: datasets.load(root / name / "errors.nc") for name in keys}
    found = compare(names, at=(0.0, 0.0, -0.1), freedoms=["EX"], since=600.0)
    assert escape(verdict(found)[0]) in text
    assert "p of EX" in text
    assert "p of EZ" not in text
    assert "expected a time in min" in served.ask(f"/compare?{_query(keys, since='x')}")[2]


def test_the_report_of_a_comparison_is_in_a_sandbox(served: Any, pair_of_runs: tuple[Path, list[str]]) -> None:
    _, headers, text = served.ask(f"/compare/report.html?{_query(pair_of_runs[1])}")
    assert headers["Content-Security-Policy"].startswith("sandbox")
    assert "Comparison of" in text
    assert "<script>window" not in text


def test_incomparable_results_are_reported_next_to_the_selection(
    served: Any, pair_of_runs: tuple[Path, list[str]]
) -> None:
    keys = pair_of_runs[1]
    for query, message in (
        (_query(keys[:1]), "Select at least one more result"),
        (_query([*keys, "nowhere"]), "No run"),
        (urlencode({"history_machine": "nobody", "figure": "EZ"}), 'role="alert"'),
    ):
        status, _, text = served.ask(f"/compare?{query}")
        assert status == 200
        assert message in text
        assert text.count('type="checkbox" name="run"') == 2
    assert served.ask("/compare?" + _query([f"r{k}" for k in range(21)]))[0] == 400


def test_a_figure_over_time(served: Any, markup: str) -> None:
    query = urlencode({"machine": f"Mill {markup}", "figure": "EZ"})
    status, headers, text = served.ask(f"/compare/history.html?{query}")
    assert (status, headers["Content-Security-Policy"][:7]) == (200, "sandbox")
    assert "over time" in text
    assert "<script>window" not in text


def test_long_comparisons_do_not_delay_other_requests(
    served: Any, pair_of_runs: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    release = threading.Event()
    monkeypatch.setattr(compare_page, "compare", lambda *_, **__: release.wait(30))
    asking = [
        threading.Thread(target=served.ask, args=[f"/compare/report.html?{_query(pair_of_runs[1], since=str(k + 1))}"])
        for k in range(6)
    ]
    try:
        for thread in asking:
            thread.start()
        assert served.ask("/results")[0] == 200
        assert all(thread.is_alive() for thread in asking)
    finally:
        release.set()
        for thread in asking:
            thread.join()
