"""The example of a separate distribution, installed without network, is registered and passes the kit."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from errormotion import plugins
from errormotion.testing import check_plugin

EXAMPLE = Path(__file__).parents[2] / "examples" / "plugin_distribution"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the example as ``pip install -e`` does: its folder on the path, its entry points in a dist-info."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {target}" for name, target in points.items())]
    info = tmp_path / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLE)
    plugins.refresh()
    yield tmp_path
    monkeypatch.undo()
    plugins.refresh()


def test_it_is_registered_together_with_built_in_and_broken_plugins(installed):
    broken = installed / "wreck-0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: wreck\nVersion: 0\n")
    (broken / "entry_points.txt").write_text("[errormotion.instruments]\nwreck = wreck.driver:Wreck\n")
    plugins.refresh()
    listed = {plugin.id: plugin for plugin in plugins.available("instruments")}
    assert listed["line_gauge"].distribution == "errormotion-line-gauge 0.1.0"
    assert listed["line_gauge"].error == listed["optoncdt"].error == ""
    assert listed["wreck"].error == "ModuleNotFoundError: No module named 'wreck'"


@pytest.mark.usefixtures("installed")
def test_it_passes_every_check_of_the_kit():
    results = check_plugin("instruments", "line_gauge")
    assert {result.name: result.message for result in results if not result.ok} == {}
    # the protocol of the gauge has no refusals
    assert {result.name for result in results if result.skipped} == {"refusals"}


@pytest.mark.slow
def test_its_own_test_passes():
    arguments = ["-q", "-c", "pyproject.toml", "--rootdir", ".", "-p", "no:cacheprovider", "tests"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *arguments],
        cwd=EXAMPLE,
        env=os.environ
        | {"PYTHONPATH": str(EXAMPLE), "PYTHONDONTWRITEBYTECODE": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout


def test_it_is_small():
    lines = {path.name: len(path.read_text().splitlines()) for path in EXAMPLE.rglob("*.py")}
    assert lines["driver.py"] < 60
    assert lines["test_line_gauge.py"] <= 10
