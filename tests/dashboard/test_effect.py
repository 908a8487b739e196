"""The page of the effect of a compensation over HTTP: texts and figures are those of the functions."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion import datasets
from errormotion.compensation.effect import effect, text
from errormotion.report.text import signs


def test_the_effect_is_that_of_the_function(serving: Callable[..., Any], pair_of_runs: tuple[Path, list[str]]) -> None:
    root, (less, more) = pair_of_runs
    served = serving(root)
    query = urlencode({"before": more, "after": less})
    _, _, page = served.ask(f"/compensate/effect?{query}")
    found = effect(*(datasets.load(root / key / "errors.nc") for key in (more, less)))
    assert escape(signs(text.verdict(found)[0])) in page
    assert " um" not in page
    for row in text.rows(found):
        assert all(escape(signs(cell)) in page for cell in row)
    assert "<script>window" not in page
    _, headers, report = served.ask(f"/compensate/effect.html?{query}")
    assert headers["Content-Security-Policy"].startswith("sandbox")
    assert "<h1>Effect of " in report
    status, _, page = served.ask("/compensate/effect?" + urlencode({"before": more, "after": "nowhere"}))
    assert (status, "No run" in page) == (200, True)
