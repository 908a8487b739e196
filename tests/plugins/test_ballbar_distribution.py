"""A method in a separate distribution: from raw data to report by the command line."""

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
EXAMPLE = ROOT / "examples" / "ballbar_distribution"
FIGURES = ("G(CCW) XY", "G(CW) XY", "G(b) XY", "H XY", "Fmax XY", "Fmin XY", "D XY")


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Install a copy of the distribution into a folder without network; return a function that runs `errormotion`."""
    folder = tmp_path_factory.mktemp("ballbar")
    source, site, work = folder / "source", folder / "site", folder / "work"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-info"))
    # An environment that uv has made has no pip.
    pip = ["uv", "pip"] if find_spec("pip") is None else [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    here = ["--python", sys.executable] if pip[0] == "uv" else []
    options = [*here, "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", site]
    subprocess.run([*pip, "install", *options, source], check=True)
    work.mkdir()
    for name in ("bench.toml", "campaign.toml", "import.toml"):
        shutil.copy(EXAMPLE / name, work)

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
    """Write simulated raw data, their truth, and the same readings as a CSV file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(installed.site)
        from ballbar_test.method import Ballbar

        raw, truth = Ballbar.simulate(Ballbar.Settings(), 3)
        for name in [each for each in sys.modules if each.partition(".")[0] == "ballbar_test"]:
            del sys.modules[name]
    datasets.save(raw, installed.work / "raw.nc")
    datasets.save(truth, installed.work / "truth.nc")
    (installed.work / "readings.csv").write_text(as_csv(raw))
    (installed.work / "log.txt").write_text(as_log(raw))
    return installed.work


def as_csv(raw):
    lines = [
        "# schema = errormotion.raw.ballbar/1",
        "# machine = virtual machine",
        f"# nominal_radius = {float(raw['nominal_radius']) * 1e3} mm",
        f"# feed = {float(raw['feed']) * 6e4} mm/min",
        "# centre = 0 0 0 mm",
        f"# length_noise = {float(raw['length_noise']) * 1e6} um",
        f"# length_uncertainty = {float(raw['length_uncertainty']) * 1e6} um",
        f"# expansion = {float(raw['expansion'])} 1/K",
        f"# expansion_uncertainty = {float(raw['expansion_uncertainty'])} 1/K",
        f"# temperature_uncertainty = {float(raw['temperature_uncertainty'])} K",
        "direction_of_travel,run,length [mm],angle [deg],reading_time [s]",
    ]
    for k, direction in enumerate(raw["direction_of_travel"].values):
        for run_number in range(raw.sizes["run"]):
            here = raw.isel(direction_of_travel=k, run=run_number)
            rows = zip(here["length"].values, here["angle"].values, here["reading_time"].values, strict=True)
            lines += [
                f"{direction},{run_number + 1},{'' if np.isnan(length) else f'{1e3 * length:.7f}'},"
                f"{np.degrees(angle):.6f},{time:.4f}"
                for length, angle, time in rows
            ]
    lines += ["", "direction_of_travel,run,temperature [degC]"]
    for k, direction in enumerate(raw["direction_of_travel"].values):
        lines += [f"{direction},{n + 1},{value:.6f}" for n, value in enumerate(raw["temperature"].values[k])]
    lines += ["", "axis,axis_direction_x [1],axis_direction_y [1],axis_direction_z [1]", "X,1,0,0", "Y,0,1,0"]
    return "\n".join(lines) + "\n"


def as_log(raw):
    """Return the readings with their temperatures as one table."""
    lines = ["direction;circle;length;angle;time;T"]
    for direction in raw["direction_of_travel"].values:
        for number in range(raw.sizes["run"]):
            here = raw.sel(direction_of_travel=direction).isel(run=number)
            for length, angle, time in zip(
                here["length"].values, here["angle"].values, here["reading_time"].values, strict=True
            ):
                shown = "" if np.isnan(length) else f"{1e3 * length:.7f}"
                temperature = f"{float(here['temperature']):.6f}"
                lines.append(f"{direction};{number + 1};{shown};{np.degrees(angle):.6f};{time:.4f};{temperature}")
    return "\n".join(lines) + "\n"


def test_the_package_does_not_refer_to_it():
    files = [path for path in (ROOT / "errormotion").rglob("*") if path.suffix in (".py", ".toml", ".j2")]
    knowing = [path for path in files if re.search(r"ballbar_test|[\"']ballbar[\"']|raw\.ballbar", path.read_text())]
    assert knowing == []


def test_it_is_listed_with_its_distribution(installed):
    listed = installed("plugins", "list")
    assert re.search(r"(?m)^ballbar +simulated_only +errormotion-ballbar 0\.1\.0", listed)


def test_its_raw_data_are_validated_with_its_table(installed, measured):
    for name in ("raw.nc", "truth.nc", "readings.csv"):
        assert "valid" in installed("validate", name)
    raw = datasets.load(measured / "raw.nc").load()
    raw["length"] = raw["length"] * 1e3
    datasets.save(raw.drop_vars("feed"), measured / "wrong.nc")
    answer = installed("validate", "wrong.nc", "--json", code=3)
    assert "is it in mm?" in answer
    assert "feed(): missing" in answer


@pytest.fixture(scope="module")
def identified(installed, measured):
    """Identify the stored raw dataset, the CSV file and an imported log."""
    limit = "circular_deviation_limit=10 um"
    printed = installed("identify", "raw.nc", "--out", "errors.nc", "--set", limit)
    answer = json.loads(installed("identify", "readings.csv", "--out", "from_csv.nc", "--json"))
    installed("import", "log.txt", "--map", "import.toml", "--out", "imported.nc")
    installed("identify", "imported.nc", "--out", "from_log.nc")
    return printed, answer


def test_the_command_line_prints_its_figures(identified, measured):
    printed, answer = identified
    for name in FIGURES:
        assert re.search(rf"^{re.escape(name)} +-?\d", printed, flags=re.MULTILINE), printed
    assert [figure["name"] for figure in answer["results"]] == list(FIGURES)
    with datasets.load(measured / "truth.nc") as truth:
        for figure, true in zip(answer["results"], 1e6 * truth["figures"].values, strict=True):
            assert figure["unit"] == "um"
            assert abs(figure["value"] - true) < 2 * figure["expanded_uncertainty"], figure  # four u


def test_the_csv_file_and_the_imported_log_have_the_same_errors(identified, measured):
    with datasets.load(measured / "errors.nc") as one:
        assert one["deviation"].dims == ("direction_of_travel", "angle")
        for name in ("from_csv.nc", "from_log.nc"):
            with datasets.load(measured / name) as other:
                assert other.attrs["plane"] == "XY"
                np.testing.assert_allclose(one["deviation"].values, other["deviation"].values, atol=1e-9)


def test_the_report_has_its_chapter_with_the_polar_plot(installed, identified):
    installed("report", "errors.nc", "--out", "report.html")
    page = (installed.work / "report.html").read_text(encoding="utf-8")
    assert "Circular test in plane XY" in page
    assert 'aria-label="Polar plot of the radial deviation.' in page
    assert page.count("<svg") == 2
    polar = page.partition('aria-label="Polar plot')[2].partition("</figure>")[0]
    for text in ("+X", "−Y", "CCW", "G(b)", "µm per division"):
        assert text in polar
    for text in ("squareness of Y to X", "backlash of X", "above its limit", "calibration of the bar"):
        assert text in page
    assert "SIMULATED DATA" in page


def test_a_campaign_is_planned(installed):
    answer = json.loads(installed("plan", "campaign.toml", "--out", "plan.nc", "--json"))
    (planned,) = answer["plans"]
    assert [row["name"] for row in planned["expected"]] == ["deviation"]
    assert 1.0 < planned["expected"][0]["expanded_uncertainty"] < 1.5  # 2 x 0.5 um of the bar, and little else
    assert "G(b)" in planned["notes"][0]


@pytest.mark.slow
def test_it_passes_the_kit(installed):
    answer = installed("plugins", "check", "ballbar")
    assert "ballbar: passes" in answer


@pytest.mark.slow
def test_its_own_tests_pass(installed):
    """Without the kit, which is run by the command above."""
    arguments = ("-q", "-c", "pyproject.toml", "--rootdir", ".", "-p", "no:cacheprovider", "-k", "not TestBallbar")
    assert "passed" in installed("pytest", *arguments, "tests", cwd=installed.source)
