"""Pages without figures, for tests of their texts and tables."""

from collections.abc import Iterator

import pytest
from markupsafe import Markup

from errormotion.report import canvas


@pytest.fixture
def undrawn() -> Iterator[None]:
    """Write pages with empty figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canvas, "draw", lambda *_, **__: Markup("<svg></svg>"))
        yield
