"""Searches of the best layout with fewer evaluations."""

import pytest

from errormotion.methods.multilateration.planning import layout


def _shorten(patch):
    for name in ("_TRIED", "_GLOBAL", "_LOCAL"):
        patch.setattr(layout, name, getattr(layout, name) // 5)


@pytest.fixture
def short_search(monkeypatch):
    """Search with a fifth of the evaluations, for a test that needs no optimum."""
    _shorten(monkeypatch)


@pytest.fixture(scope="module")
def short_searches():
    """Search with a fifth of the evaluations in all tests of a module."""
    with pytest.MonkeyPatch.context() as patch:
        _shorten(patch)
        yield
