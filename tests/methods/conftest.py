"""The statistical checks of the kit take many seeds: they are slow tests. Reports without figures."""

import pytest
from markupsafe import Markup

STATISTICAL = ("test_coverage", "test_differences", "test_sources_as_stated")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.name == "test_conformance.py" and item.name in STATISTICAL:
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what is in the figures of a report, for tests of its texts and tables."""
    from errormotion.report import canvas

    monkeypatch.setattr(canvas, "draw", lambda *_: Markup("<svg></svg>"))
