"""Rules for the files of the repository."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

import errormotion

ROOT = Path(__file__).parents[2]
MAX_MODULES = 20
TEXT: dict[str, Any] = {"capture_output": True, "text": True}
TARGETS = {"setup", "demo", "test", "lint", "docs", "bench", "validate"}


def _tracked() -> list[Path]:
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"not a git checkout: {error}")
    return [path for name in listed.split("\0") if name and (path := ROOT / name).is_file()]


def _lines(paths: list[Path], pattern: str) -> list[tuple[str, str]]:
    """Return the lines that contain a pattern; most files do not, which is one search for each."""
    found = []
    for path in paths:
        text = path.read_bytes().decode(errors="replace")
        if "\0" not in text and re.search(pattern, text):
            name = path.relative_to(ROOT)
            lines = enumerate(text.splitlines(), 1)
            found += [(f"{name}:{n}", line) for n, line in lines if re.search(pattern, line)]
    return found


@pytest.mark.parametrize(
    ("what", "pattern"),
    [
        ("a path of one machine", r"(?<![\w.$}])/(?:root|home|work|Users)/\w"),
        ("the address of a package index", r"pypi\.|pythonhosted|(?:--|extra-)index" + "-url=?\\s*\\S*://"),
        ("the number of an issue", r"(?i)\b(?:issue|ticket|task) ?#?\d"),
    ],
)
def test_no_tracked_file_contains(what: str, pattern: str) -> None:
    found = [f"{where}: {line.strip()[:100]}" for where, line in _lines(_tracked(), pattern)]
    found = [line for line in found if not line.startswith("tests/repository/test_tree.py:")]
    assert not found, f"{what} stands in\n" + "\n".join(found)


CONNECTIONS = """
import socket, asyncio, can, serial.tools
import tornado.web
import urllib.parse, urllib.request
from http import client
from urllib import request
def later():
    from asyncua import ua
    from pymodbus.client import ModbusTcpClient
"""


def _banned(file: str) -> int:
    """Return the number of imports that ruff forbids a module of the package."""
    command = [sys.executable, "-m", "ruff", "check", "--select", "TID251", "--output-format", "json"]
    done = subprocess.run([*command, "--stdin-filename", file, "-"], cwd=ROOT, input=CONNECTIONS, **TEXT)
    return len(json.loads(done.stdout))


def test_a_new_package_may_not_open_connections() -> None:
    assert _banned("errormotion/new/module.py") == _banned("errormotion/record/module.py") == 10
    assert _banned("errormotion/instruments/transports/module.py") == 0


def test_version_is_one() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == errormotion.__version__


def test_changelog_names_this_version() -> None:
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert any(heading.startswith(("Unreleased", errormotion.__version__)) for heading in headings)


def test_makefile_has_the_targets_that_the_docs_promise() -> None:
    have = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    code = re.compile(r"^```(?:sh|console)$.*?^```|`[^`\n]+`", re.MULTILINE | re.DOTALL)
    called = re.compile(r"(?:^|`|\$ |&& )make ([a-z-]+)", re.MULTILINE)
    blocks = [block for page in pages for block in code.findall(page.read_text())]
    promised = {target for block in blocks for target in called.findall(block)}
    assert have >= TARGETS
    assert promised <= have


def test_every_package_has_tests() -> None:
    packages = {path.parent.name for path in (ROOT / "errormotion").glob("*/__init__.py")}
    tested = {path.parent.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").glob("*/**/test_*.py")}
    assert packages <= tested


def test_no_folder_has_more_than_twenty_modules() -> None:
    full = {
        str(folder.relative_to(ROOT)): count
        for folder in sorted({path.parent for path in (ROOT / "errormotion").rglob("*.py")})
        if (count := sum(path.name != "__init__.py" for path in folder.glob("*.py"))) > MAX_MODULES
    }
    assert not full, "Modules in one folder: divide them into rooms, each a package with one purpose"


def test_links_between_pages_have_targets() -> None:
    broken = []
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert not broken


def test_every_example_has_a_readme() -> None:
    folders = [path for path in sorted((ROOT / "examples").iterdir()) if path.is_dir()]
    assert [path.name for path in folders if not (path / "README.md").is_file()] == []
