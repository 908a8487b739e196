"""Temporary folders of the conformance kits."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path


def temporary_folder() -> Path:
    """Return a new folder that is deleted at the end of this process."""
    folder = Path(tempfile.mkdtemp(prefix="errormotion-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
