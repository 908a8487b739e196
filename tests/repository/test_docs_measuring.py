"""Examples of the pages on measurements and calibrations.

How examples are written and run: see conftest.py.
"""

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.mark.timeout(400)
def test_examples_run_as_written(documented: Path, run_examples: Callable[[Path], None]) -> None:
    run_examples(documented)
