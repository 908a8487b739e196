"""An altered audit log is recognised."""

from pathlib import Path

import pytest

from errormotion.compensation.online.audit import AuditLog, AuditReader, verify
from errormotion.errors import CompensationError


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "audit.jsonl"
    with AuditLog(path) as audit:
        audit.write({"state": "armed", "cause": 'a "quote" and µm'})
        audit.write({"state": "following", "offset": [1e-6, 0.0, 0.0]}, sync=True)
    return path


def test_it_is_continued(log: Path) -> None:
    with AuditLog(log) as audit:
        audit.write({"state": "off"})
    assert verify(log)[0] == 3
    assert log.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    "alter",
    [
        lambda lines: [lines[0].replace(b"armed", b"arme_"), lines[1]],
        lambda lines: lines[1:],
        lambda lines: [lines[1], lines[0]],
        lambda lines: [*lines, lines[1]],
        lambda lines: [lines[0], lines[1][:-10]],
        lambda lines: [lines[0], b"\xff\x00\n", lines[1]],
        lambda lines: [lines[0], b"x" * 100_000],
    ],
    ids=["changed", "removed", "exchanged", "repeated", "cut off", "bytes", "long"],
)
def test_an_altered_log_is_recognised_and_not_continued(log: Path, alter: object) -> None:
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(alter(lines)))  # type: ignore[operator]
    for use in (verify, AuditLog):
        with pytest.raises(CompensationError, match="does not follow"):
            use(log)  # type: ignore[operator]


def test_a_log_is_checked_while_it_grows(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    reader = AuditReader(path)
    with pytest.raises(CompensationError, match="cannot be read"):
        reader.read(10)
    with AuditLog(path) as log:
        for k in range(5):
            log.write({"k": k})
        assert [entry["k"] for entry in reader.read(3)] == [0, 1, 2]
        log.write({"k": 5})
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])  # the last line is being written
    assert [entry["k"] for entry in reader.read(10)] == [3, 4]
    path.write_bytes(whole)
    assert [entry["k"] for entry in reader.read(10)] == [5]
    assert (reader.count, reader.hash) == verify(path)
    path.write_bytes(whole + whole.splitlines(keepends=True)[-1])
    with pytest.raises(CompensationError, match="line 7"):
        reader.read(10)
