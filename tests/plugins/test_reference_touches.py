"""A method in a separate distribution: from a file of its readings to the report by the command line."""

import json
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from forked_commands import Commands

from errormotion import datasets

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "reference_touches"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Install a copy of the distribution into a folder without network; return a function that runs `errormotion`."""
    folder = tmp_path_factory.mktemp("reference_touches")
    source, site, work = folder / "source", folder / "site", folder / "work"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    # An environment that uv has made has no pip.
    pip = ["uv", "pip"] if find_spec("pip") is None else [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    here = ["--python", sys.executable] if pip[0] == "uv" else []
    options = [*here, "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", site]
    subprocess.run([*pip, "install", *options, source], check=True)
    work.mkdir()
    shutil.copy(EXAMPLE / "import.toml", work)

    with Commands([site, ROOT]) as commands:

        def command(*arguments, cwd=work, code=0):
            """Return the output of a command in a process forked from one with this path."""
            environment = {"COLUMNS": "200", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
            done = commands.run(*arguments, cwd=cwd, environment=environment)
            assert done.returncode == code, done.stdout + done.stderr
            return done.stdout

        command.work, command.site, command.source = work, site, source
        yield command


@pytest.fixture(scope="module")
def measured(installed):
    """Write simulated raw data, their truth, and the same readings as a table."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(installed.site)
        from reference_touches import ReferenceTouches, ReferenceTouchesSettings

        raw, truth = ReferenceTouches().simulate(ReferenceTouchesSettings(), 3)
        del sys.modules["reference_touches"]
    datasets.save(raw, installed.work / "raw.nc")
    datasets.save(truth, installed.work / "truth.nc")
    (installed.work / "touches.csv").write_text(as_table(raw))
    return installed.work


def as_table(raw):
    """Return the readings with their temperatures as one table."""
    lines = ["Time,Repeat,X,Y,Z,T"]
    for time in raw["time"].values:
        here = raw.sel(time=time)
        for repeat in range(raw.sizes["repeat"]):
            place = ",".join(f"{1e3 * value:.9f}" for value in here["touch"].values[:, repeat])
            lines.append(f"{time:.3f},{repeat + 1},{place},{float(here['temperature']):.9f}")
    return "\n".join(lines) + "\n"


def test_the_package_does_not_refer_to_it():
    files = [path for path in (ROOT / "errormotion").rglob("*") if path.suffix in (".py", ".toml", ".j2")]
    assert [path for path in files if "reference_touches" in path.read_text()] == []


def test_it_is_listed_with_its_distribution(installed):
    listed = installed("plugins", "list")
    assert re.search(r"(?m)^reference_touches +simulated_only +errormotion-reference-touches 0\.1\.0", listed)


def test_its_raw_data_are_validated_with_its_table(installed, measured):
    for name in ("raw.nc", "truth.nc"):
        assert "valid" in installed("validate", name)
    raw = datasets.load(measured / "raw.nc").load()
    raw["height"] = raw["height"] * 1e3
    datasets.save(raw.drop_vars("touch_noise"), measured / "wrong.nc")
    answer = installed("validate", "wrong.nc", "--json", code=3)
    assert "is it in mm?" in answer
    assert "touch_noise(): missing" in answer


@pytest.fixture(scope="module")
def identified(installed, measured):
    """Identify the stored raw dataset, and an imported table."""
    answer = json.loads(installed("identify", "raw.nc", "--out", "errors.nc", "--json"))
    installed("import", "touches.csv", "--map", "import.toml", "--out", "imported.nc")
    installed("identify", "imported.nc", "--out", "from_table.nc")
    return answer


def test_the_command_line_prints_its_figures(identified, measured):
    assert [figure["name"] for figure in identified["results"]] == ["drift of X", "drift of Y", "drift of Z"]
    with datasets.load(measured / "truth.nc") as truth:
        for figure, name in zip(identified["results"], ("EX", "EY", "EZ"), strict=True):
            assert figure["unit"] == "um"
            true = 1e6 * float(truth[name][-1])
            assert abs(figure["value"] - true) < 2 * figure["expanded_uncertainty"], figure  # four u


def test_the_imported_table_has_the_same_errors(identified, measured):
    with datasets.load(measured / "errors.nc") as one, datasets.load(measured / "from_table.nc") as other:
        np.testing.assert_allclose(one["EZ"].values, other["EZ"].values, atol=1e-11)


def test_the_report_is_the_generic_chapter(installed, identified):
    installed("report", "errors.nc", "--out", "report.html")
    page = (installed.work / "report.html").read_text(encoding="utf-8")
    for text in ("drift of Z", "expansion of the stand", "reference state", "SIMULATED DATA"):
        assert text in page


@pytest.mark.slow
def test_it_passes_the_kit(installed):
    answer = installed("plugins", "check", "reference_touches")
    assert "reference_touches: passes" in answer


@pytest.mark.slow
def test_its_own_tests_pass(installed):
    """Without the kit, which is run by the command above."""
    options = ("-q", "-c", "pyproject.toml", "--rootdir", ".", "-p", "no:cacheprovider", "-k", "not TestReference")
    assert "passed" in installed("pytest", *options, "tests", cwd=installed.source)
