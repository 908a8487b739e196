"""The user's state folder and its log are for the user only."""

import os
import stat
from pathlib import Path
from typing import Any

import pytest

import errormotion
from errormotion import state
from errormotion.cli.guard import _log
from errormotion.state import own_folder, state_folder


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "errormotion"


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def write_log() -> None:
    import logging

    with _log():
        logging.getLogger("errormotion.tests").warning("a message")


def test_folder_and_log_are_for_the_user_only(home: Path) -> None:
    write_log()
    assert (mode(home), mode(home / "errormotion.log")) == (0o700, 0o600)
    assert mode(own_folder("a", "b")) == 0o700
    assert own_folder("a", "b") == home / "a" / "b" == state_folder() / "a" / "b"


def test_those_of_an_earlier_version_are_closed_to_others(home: Path) -> None:
    home.mkdir(mode=0o755)
    (home / "errormotion.log").touch()
    home.chmod(0o755)
    (home / "errormotion.log").chmod(0o664)
    write_log()
    assert (mode(home), mode(home / "errormotion.log")) == (0o700, 0o600)


def test_a_link_instead_of_the_log_is_not_followed(home: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    victim.chmod(0o644)
    home.mkdir()
    (home / "errormotion.log").symlink_to(victim)
    write_log()
    assert (victim.read_text(), mode(victim)) == ("mine", 0o644)


@pytest.fixture(params=["flag", "no flag"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Open files as a system does that has a flag against links, and as one that has none."""
    if request.param == "no flag":
        monkeypatch.setattr(state, "_NO_FOLLOW", 0)
    return str(request.param)


CREATE = os.O_WRONLY | os.O_APPEND | os.O_CREAT


@pytest.mark.usefixtures("system")
def test_neither_links_nor_pipes_are_opened(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "link").symlink_to("secret")
    (tmp_path / "to nothing").symlink_to("new")
    os.mkfifo(tmp_path / "pipe")
    for flags in (os.O_RDONLY, os.O_WRONLY | os.O_APPEND, CREATE, CREATE | os.O_EXCL):
        for name in ("link", "to nothing", "pipe", "."):
            with pytest.raises(OSError):  # noqa: PT011 - which one depends on the system
                state.open_itself(tmp_path / name, flags)
    assert not (tmp_path / "new").exists()
    assert (tmp_path / "secret").read_text() == "secret"
    for reader in (os.O_RDONLY, CREATE):
        with pytest.raises(OSError, match="is a link"):
            state.open_itself(tmp_path / "link", reader)


@pytest.mark.usefixtures("system")
def test_a_file_is_created_once_extended_and_not_inherited(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        state.open_itself(tmp_path / "log", os.O_RDONLY)
    for text in (b"one", b"two"):
        descriptor = state.open_itself(tmp_path / "log", CREATE)
        assert not os.get_inheritable(descriptor)
        os.write(descriptor, text)
        os.close(descriptor)
    assert (tmp_path / "log").read_bytes() == b"onetwo"
    assert stat.S_IMODE((tmp_path / "log").stat().st_mode) == 0o600
    with pytest.raises(FileExistsError):
        state.open_itself(tmp_path / "log", CREATE | os.O_EXCL)


def test_a_link_that_replaces_a_file_while_it_is_opened_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state, "_NO_FOLLOW", 0)
    path, opened = tmp_path / "log", os.open
    path.write_text("")
    (tmp_path / "secret").write_text("secret")

    def replaced(found: Any, flags: int, mode: int = 0o777) -> int:
        if not flags & os.O_EXCL and not path.is_symlink():
            path.unlink()
            path.symlink_to("secret")
        return opened(found, flags, mode)

    monkeypatch.setattr(os, "open", replaced)
    with pytest.raises(OSError, match="is a link"):
        state.open_itself(path, CREATE)


def test_only_one_module_opens_files_with_flags_against_links() -> None:
    root = Path(errormotion.__file__).parent
    bridge = root / "instruments" / "controller" / "linuxcnc" / "bridge.py"  # runs without this package
    stated = [path for path in root.rglob("*.py") if "O_NOFOLLOW" in path.read_text("utf-8")]
    assert sorted(stated) == sorted([root / "state.py", bridge])
