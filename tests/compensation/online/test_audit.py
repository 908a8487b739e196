"""An altered audit log is recognised."""

from pathlib import Path

import pytest

from errormotion.compensation.online.audit import AuditLog, verify
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
