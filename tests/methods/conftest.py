"""The statistical checks of the kit, which share the results of many seeds, are slow tests. Reports without figures."""

import pytest
from markupsafe import Markup

STATISTICAL = ("test_coverage", "test_differences", "test_figures", "test_sources_as_stated")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.name == "test_conformance.py" and item.name in STATISTICAL:
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what is in the figures of a report, for tests of its texts and tables."""
    from errormotion.report import canvas

    monkeypatch.setattr(canvas, "draw", lambda *_: Markup("<svg></svg>"))


@pytest.fixture
def unprinted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fill the figures of a report, but do not print them, for tests of what may be missing in a result."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", lambda _, buffer, **__: buffer.write("<svg></svg>"))
