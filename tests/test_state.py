"""The user's state folder and its log are for the user only."""

from pathlib import Path

import pytest

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
