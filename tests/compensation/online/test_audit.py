"""An altered audit log is recognised."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from coded import raises

from errormotion.compensation.online import anchors, audit
from errormotion.compensation.online.audit import START, AuditError, AuditLog, AuditReader, Verdict, check, verify
from errormotion.errors import CompensationError


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the user's state folder."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "errormotion"


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
        with raises("audit.altered"):
            use(log)  # type: ignore[operator]


def test_a_log_is_checked_while_it_grows(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    reader = AuditReader(path)
    with raises("audit.unreadable"):
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


def computed_anew(lines: list[bytes], *, coded: bool) -> bytes:
    """Return entries whose hashes follow from each other, with codes of another key: the work of a forger."""
    text, before = "", START
    for k, line in enumerate(lines):
        entry = json.dumps(json.loads(line)["entry"], ensure_ascii=False)
        first = (
            f'"log":"{json.loads(lines[0]).get("log", "0" * 32)}","key":"{json.loads(lines[0]).get("key", "0" * 16)}",'
        )
        body = f'{first if not k else ""}"entry":{entry}' if coded else entry
        before = hashlib.sha256(f"{before}{body}".encode()).hexdigest()
        code = hashlib.sha256(f"a guess {before}".encode()).hexdigest()
        head = f'"hash":"{before}"' + (f',"code":"{code}",{body}' if coded else f',"entry":{body}')
        text += f"{{{head}}}\n"
    return text.encode()


def falsified(lines: list[bytes]) -> list[bytes]:
    return [line.replace(b"armed", b"shadow") for line in lines]


@pytest.mark.parametrize(
    ("verdict", "alter"),
    [
        (Verdict.CUT, lambda lines: b"".join(lines[:-1])),
        (Verdict.CUT, lambda lines: lines[0]),
        (Verdict.EMPTIED, lambda lines: b""),
        (Verdict.ALTERED, lambda lines: computed_anew(falsified(lines), coded=True)),
        (Verdict.ALTERED, lambda lines: computed_anew(falsified(lines), coded=False)),
        (Verdict.ALTERED, lambda lines: computed_anew(lines, coded=False)),
        (Verdict.ALTERED, lambda lines: computed_anew(lines[:1], coded=True)),
        (Verdict.ALTERED, lambda lines: b"".join(falsified(lines))),
        (Verdict.ALTERED, lambda lines: b"".join(lines) + b"\n"),
        (Verdict.ALTERED, lambda lines: b"".join(lines).replace(b'"end":3,', b"")),
        (Verdict.ALTERED, lambda lines: b"".join(lines).replace(b'"key":"', b'"key":"0')),
    ],
)
def test_each_attack_on_an_ended_log_has_its_verdict(
    tmp_path: Path, verdict: Verdict, alter: Callable[[list[bytes]], bytes]
) -> None:
    path = tmp_path / "audit.jsonl"
    with AuditLog(path) as log:
        log.write({"event": "armed"})
        log.write({"offset": [1e-6, 0.0, 0.0]})
        log.write({"event": "ended"}, last=True)
    assert check(path) == audit.Checked(Verdict.UNBROKEN, *verify(path), True)
    path.write_bytes(alter(path.read_bytes().splitlines(keepends=True)))
    assert check(path).verdict is verdict
    with pytest.raises(AuditError) as error:
        verify(path)
    assert error.value.verdict is verdict
    reader = AuditReader(path)
    for _ in range(2):
        with pytest.raises(AuditError):
            reader.read(10)
    with pytest.raises(AuditError):
        AuditLog(path)


def test_a_removed_log_was_emptied(log: Path) -> None:
    log.unlink()
    assert check(log).verdict is Verdict.EMPTIED


def test_a_log_that_was_moved_keeps_its_number_of_entries(log: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere" / "audit.jsonl"
    moved.parent.mkdir()
    log.rename(moved)
    assert check(moved).verdict is Verdict.UNBROKEN
    moved.write_bytes(moved.read_bytes().splitlines(keepends=True)[0])
    assert check(moved).verdict is Verdict.CUT


def test_the_log_of_another_run_is_not_this_one(log: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.jsonl"
    with AuditLog(other) as written:
        for k in range(5):
            written.write({"k": k})
    shutil.copy(other, log)
    assert check(log).verdict is Verdict.ALTERED


def test_a_log_is_cut_while_it_is_read(log: Path) -> None:
    reader = AuditReader(log)
    assert len(reader.read(10)) == 2
    log.write_bytes(log.read_bytes().splitlines(keepends=True)[0])
    with raises("audit.cut"):
        reader.read(10)


def test_a_killed_program_leaves_a_log_without_end_and_the_rest_of_its_entries_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "audit.jsonl"
    killed = AuditLog(path)
    killed.write({"event": "armed"}, sync=True)
    killed.write({"offset": 1})  # later than the last number: no cut after it is excluded, and none is invented
    assert check(path) == audit.Checked(Verdict.UNBROKEN, *verify(path), False)
    monkeypatch.setattr(audit, "SYNC_INTERVAL", 0.0)
    killed.write({"offset": 2})
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:2]))
    assert check(path).verdict is Verdict.CUT


def test_an_old_log_has_no_key_and_is_not_continued(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_bytes(computed_anew([b'{"entry": {"k": 1}}', b'{"entry": {"k": 2}}'], coded=False))
    assert check(path) == audit.Checked(Verdict.WITHOUT_KEY, *verify(path), False)
    path.write_bytes(path.read_bytes().replace(b": 2", b": 3"))
    with raises("audit.altered"):
        verify(path)
    path.write_bytes(computed_anew([b'{"entry": {"k": 1}}'], coded=False))
    with raises("audit.key.other"):
        AuditLog(path)


def test_another_user_checks_the_hashes_without_the_key(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    assert check(log).verdict is Verdict.WITHOUT_KEY
    anchors.own_key()
    assert check(log).verdict is Verdict.WITHOUT_KEY
    log.write_bytes(log.read_bytes().replace(b"armed", b"shado"))
    assert check(log).verdict is Verdict.ALTERED


def test_the_key_is_for_its_user_only(log: Path, state: Path) -> None:
    key = state / anchors.KEY
    assert [each.stat().st_mode & 0o777 for each in (state, key, state / "audit")] == [0o700, 0o600, 0o700]
    assert key.read_text() not in log.read_text()
    key.chmod(0o644)
    with raises("audit.key.form"):
        AuditLog(log)
    key.unlink()
    key.symlink_to(log)
    with raises("audit.key.form"):
        AuditLog(log)


@pytest.mark.parametrize("how", ["missing", "readable", "a link", "empty", "a pipe"])
def test_without_a_usable_key_a_log_is_not_called_altered(log: Path, state: Path, how: str) -> None:
    key = state / anchors.KEY
    content = key.read_bytes()
    key.unlink()
    if how == "a link":
        key.symlink_to(log)
    elif how == "a pipe":
        os.mkfifo(key, 0o600)
    elif how != "missing":
        key.touch(0o600)
        key.write_bytes(content if how == "readable" else b"")
        key.chmod(0o644 if how == "readable" else 0o600)
    assert check(log).verdict is Verdict.WITHOUT_KEY
    whole = log.read_bytes()
    log.write_bytes(b"".join(whole.splitlines(keepends=True)[:-1]))
    assert check(log).verdict is Verdict.CUT  # the number of entries is known without the key
    key.unlink(missing_ok=True)
    key.touch(0o600)
    key.write_bytes(content)
    log.write_bytes(whole)
    assert check(log).verdict is Verdict.UNBROKEN
