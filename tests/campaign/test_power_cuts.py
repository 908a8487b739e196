"""After a power cut at any instant, all that was stated to be on the disk is there, and is read.

`make power` tries a thousand cuts; these are some of them.
"""

import os
import random
from pathlib import Path

import pytest
from power_cuts import Cut, recorded
from power_trials import KINDS, try_cuts


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_committed_is_lost_in_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))  # of another computer, so to say: it lost no power
    trials = try_cuts(kind, tmp_path, 20)
    assert trials.faults == []
    assert trials.lossy > 5
    assert trials.committed > 5


def write(path: Path, text: str, *, flush: bool) -> None:
    with path.open("w") as file:
        file.write(text)
        if flush:
            file.flush()
            os.fsync(file.fileno())


def after(folder: Path, program, count: int = 300) -> set[tuple[tuple[str, str], ...]]:  # type: ignore[no-untyped-def]
    """Return the disks that are possible after the whole program: names and contents."""
    disk = folder / "disk"
    disk.mkdir()
    with recorded(disk) as recording:
        program(disk)
    found = set()
    for number in range(count):
        cut = Cut(recording, len(recording.operations), random.Random(number))
        cut.write(folder / str(number))
        found.add(tuple(sorted((each.name, each.read_text()) for each in (folder / str(number)).iterdir())))
    return found


def flush_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


def test_a_name_is_not_on_the_disk_before_its_folder_is_flushed(tmp_path: Path) -> None:
    assert after(tmp_path, lambda disk: write(disk / "a", "x", flush=True)) == {(), (("a", "x"),)}


def test_a_content_is_not_on_the_disk_before_its_file_is_flushed(tmp_path: Path) -> None:
    def program(disk: Path) -> None:
        write(disk / "a", "x", flush=False)
        flush_folder(disk)

    assert after(tmp_path, program) == {(("a", ""),), (("a", "x"),), (("a", "\0"),)}


def test_a_file_that_is_renamed_before_it_is_flushed_may_be_empty(tmp_path: Path) -> None:
    def program(disk: Path) -> None:
        write(disk / "a", "old", flush=True)
        flush_folder(disk)
        write(disk / "b", "new", flush=False)
        (disk / "b").replace(disk / "a")

    found = after(tmp_path, program)
    assert (("a", ""),) in found
    possible = {"old", *("new"[:k] for k in range(4)), *("\0" * k for k in range(4))}
    assert {dict(each)["a"] for each in found} <= possible


def test_a_flushed_file_that_is_renamed_is_the_old_or_the_new_one(tmp_path: Path) -> None:
    def program(disk: Path) -> None:
        write(disk / "a", "old", flush=True)
        flush_folder(disk)
        write(disk / "b", "new", flush=True)
        (disk / "b").replace(disk / "a")

    assert {dict(each)["a"] for each in after(tmp_path, program)} == {"old", "new"}


def test_sectors_of_an_unflushed_change_may_be_mixed(tmp_path: Path) -> None:
    def program(disk: Path) -> None:
        write(disk / "a", "o" * 2048, flush=True)
        flush_folder(disk)
        write(disk / "a", "n" * 2048, flush=False)

    contents = {dict(each)["a"] for each in after(tmp_path, program)}
    assert any("o" in each and "n" in each for each in contents)
