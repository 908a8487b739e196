"""Files are read with a bound on their size, and memory follows the size, not the bound."""

import tracemalloc
from pathlib import Path

import pytest

from errormotion.datasets.files.reading import read_bytes


def test_a_small_file_takes_little_memory_whatever_the_bound(tmp_path: Path) -> None:
    path = tmp_path / "small"
    path.write_bytes(b"x" * 1000)
    tracemalloc.start()
    try:
        assert read_bytes(path, 64 << 20) == b"x" * 1000
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_file_beyond_the_bound_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "large"
    path.write_bytes(b"x" * 1001)
    with pytest.raises(OSError, match="expected at most 1000 bytes"):
        read_bytes(path, 1000)
