"""Files are read with a limit of their size; the memory depends on the size, not on the limit."""

import tracemalloc
from pathlib import Path

import pytest
from coded import raises

from errormotion.datasets.files.reading import DEEPEST, parse_json, read_bytes
from errormotion.datasets.files.runfile import SCHEMA, read_run


def test_a_small_file_takes_little_memory_with_any_limit(tmp_path: Path) -> None:
    path = tmp_path / "small"
    path.write_bytes(b"x" * 1000)
    tracemalloc.start()
    try:
        assert read_bytes(path, 64 << 20) == b"x" * 1000
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_file_above_the_limit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "large"
    path.write_bytes(b"x" * 1001)
    with pytest.raises(OSError, match="expected at most 1000 bytes"):
        read_bytes(path, 1000)


@pytest.mark.parametrize(("start", "end"), [('{"a":', "}"), ("[", "]")])
def test_json_is_read_up_to_a_limited_depth(start: str, end: str) -> None:
    parse_json(start * DEEPEST + "1" + end * DEEPEST)
    for levels in (DEEPEST + 1, 900, 100_000):
        with pytest.raises(ValueError, match="nested too deeply"):
            parse_json(start * levels + "1" + end * levels)


def test_a_nested_run_json_is_refused_with_its_name(tmp_path: Path) -> None:
    """Python reads 900 levels, but a recursion over them raises a RecursionError."""
    deep = '{"a":' * 900 + "1" + "}" * 900
    (tmp_path / "run.json").write_text(f'{{"schema": "{SCHEMA}", "x": {deep}}}')
    with raises("run.file.no_json"):
        read_run(tmp_path)
