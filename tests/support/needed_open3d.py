"""Open3D for tests: it is an extra, and its library links to libraries of the system."""

from typing import Any

import pytest

from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification.registration import clouds


def open3d() -> Any:
    """Return the package, or skip the test."""
    try:
        return clouds.open3d()
    except MethodError as error:
        pytest.skip(f"Open3D cannot be loaded: {error.__cause__}")
