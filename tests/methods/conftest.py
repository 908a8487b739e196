"""The statistical checks of the kit take many seeds: they are slow tests."""

import pytest

STATISTICAL = ("test_coverage", "test_differences", "test_sources_as_stated")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.name == "test_conformance.py" and item.name in STATISTICAL:
            item.add_marker(pytest.mark.slow)
