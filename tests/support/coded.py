"""An expected error, by its code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from errormotion.errors import ErrormotionError


@contextmanager
def raises(code: str) -> Iterator[pytest.ExceptionInfo[ErrormotionError]]:
    """Fail unless the block raises an error of the package with this code; its message is free."""
    with pytest.raises(ErrormotionError) as caught:
        yield caught
    assert caught.value.code == code, (
        f"expected an error with the code {code}; found {caught.value.code}: {caught.value}"
    )
