"""Plans without the search of the best set-up, or with a short one."""

import pytest

from errormotion.methods.beam_direction.planning import design


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the best set-ups, which have no effect on the expected uncertainty of the set-up in the settings."""
    monkeypatch.setattr(design, "optimise", lambda limits, start: design.equal_strokes(start, limits))


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search with a fifth of the evaluations, for a test that needs no optimum."""
    monkeypatch.setattr(design, "_MAX_EVALUATIONS", design._MAX_EVALUATIONS // 5)
