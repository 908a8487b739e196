"""Plans without the search of the best set-up."""

import pytest

from errormotion.methods.beam_direction.planning import design


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the best set-ups, which have no effect on the expected uncertainty of the set-up in the settings."""
    monkeypatch.setattr(design, "optimise", lambda limits, start: design.equal_strokes(start, limits))
