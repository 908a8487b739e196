"""Every command prints text or JSON, and returns the exit code of the reference."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
import xarray as xr
from command_line import Result

from errormotion import datasets, plugins
from errormotion.cli.root import SECTIONS
from errormotion.plugins.contracts import Status

Run = Callable[..., Result]
Answer = Callable[..., Any]
ROOT = Path(__file__).parents[2]

HEAVY = ("numpy", "scipy", "xarray", "zarr", "matplotlib", "numba", "pandas", "pint", "h5py", "serial")


def python(*arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["plugins", "--help"], ["--version"]])
def test_help_loads_nothing_heavy(words: list[str]) -> None:
    script = (
        "import sys\nfrom errormotion.cli import main\n"
        f"try:\n    main({words!r})\nexcept SystemExit as end:\n    assert not end.code\n"
        f"print('loaded:', *(name for name in {HEAVY!r} if name in sys.modules))"
    )
    result = python("-c", script)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "loaded:"


def test_what_scipy_asks_numpy_for_is_loaded_when_it_is_used() -> None:
    script = (
        "import sys\nfrom errormotion.cli import main\n"
        "try:\n    main(['--version'])\nexcept SystemExit as end:\n    assert not end.code\n"
        "import scipy.special, numpy\n"
        "print('numpy.f2py.crackfortran' in sys.modules, 'numpy.testing._private' in sys.modules)\n"
        "numpy.testing.assert_equal(1, 1)\nfrom numpy.testing import assert_allclose\nassert_allclose(1.0, 1.0)\n"
        "print(callable(numpy.f2py.run_main), numpy.f2py.crackfortran.__name__)\n"
    )
    result = python("-c", script)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[1:] == ["False False", "True numpy.f2py.crackfortran"]


def test_module_is_the_command() -> None:
    result = python("-m", "errormotion", "--help")
    for name in sum(SECTIONS.values(), ()):
        assert f"\n  {name} " in result.stdout
    assert "import" in result.stdout
    assert "...\n" not in result.stdout.partition("Measure:")[2]  # no sentence is cut


def test_unknown_commands_and_options_are_usage_errors(run: Run) -> None:
    run("frobnicate", code=2)
    run("plugins", "list", "--frobnicate", code=2)
    assert "--resume" in run("run", code=2).stderr


def test_plugins_are_listed_with_their_kind(run: Run, answer: Answer) -> None:
    found = {plugin["id"]: plugin for plugin in answer("plugins", "list")["plugins"]}
    assert found["spindle_drift"]["group"] == "methods"
    assert found["optoncdt"]["kind"] == "point_lds"
    assert found["optoncdt"]["status"] in get_args(Status)
    assert "Micro-Epsilon" in run("plugins", "list").stdout


def test_broken_plugin_is_listed_with_its_error(run: Run, answer: Answer, monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import EntryPoint

    point = EntryPoint("broken", "nowhere_at_all:Thing", "errormotion.instruments")
    monkeypatch.setattr(
        plugins.registry, "_found", lambda: {**dict.fromkeys(plugins.GROUPS, ()), "instruments": (point,)}
    )
    (plugin,) = answer("plugins", "list")["plugins"]
    assert plugin["status"] == "broken"
    assert "ModuleNotFoundError" in run("plugins", "list").stdout
    assert "does not load: ModuleNotFoundError" in run("plugins", "show", "broken", code=1).stderr


def test_plugin_shows_its_settings(run: Run, answer: Answer) -> None:
    text = run("plugins", "show", "dcon_temperature").stdout
    assert "thermometer" in text
    assert "channels" in text
    assert answer("plugins", "show", "spindle_drift")["settings"]["properties"]["average"]["default"] == 0.5


def test_an_unknown_plugin_is_reported_with_the_nearest_name(run: Run) -> None:
    assert "did you mean 'optoncdt'?" in run("plugins", "show", "optoncd", code=1).stderr


def test_plugin_check_prints_each_check_and_fails_with_the_plugin(
    run: Run, answer: Answer, monkeypatch: pytest.MonkeyPatch
) -> None:
    from errormotion import testing
    from errormotion.testing.kit import CheckResult

    good, bad = CheckResult("open", True, "opens", 0.1), CheckResult("close", False, "a thread is left", 0.2)
    monkeypatch.setattr(testing, "check_plugin", lambda group, plugin, **more: [good], raising=False)
    assert "dcon_temperature: passes" in run("plugins", "check", "dcon_temperature").stdout
    monkeypatch.setattr(testing, "check_plugin", lambda group, plugin, **more: [good, bad], raising=False)
    assert answer("plugins", "check", "dcon_temperature", code=3)["ok"] is False
    text = run("plugins", "check", "dcon_temperature", code=3).stdout
    assert "FAILED  close" in text
    assert "1 of 2 checks failed" in text


def test_single_checks_of_a_plugin_are_chosen_by_name(run: Run, answer: Answer) -> None:
    found = answer("plugins", "check", "dcon_temperature", "--only", "identify", "--only", "info_complete")
    assert [each["name"] for each in found["checks"]] == ["info_complete", "identify"]
    assert (
        "Did you mean 'identify'?" in run("plugins", "check", "dcon_temperature", "--only", "identity", code=1).stderr
    )


def test_identify_writes_errors_once(run: Run, answer: Answer, raw: Path, tmp_path: Path) -> None:
    found = answer("identify", raw, "--method", "spindle_drift", "--out", "errors.nc", "--set", "average=2 s")
    assert found["component"] == "spindle"
    assert {result["name"].split()[0] for result in found["results"]} >= {"EX", "EY", "EZ", "EA", "EB"}
    errors = datasets.load(tmp_path / "errors.nc")
    assert json.loads(errors.attrs["provenance"])["settings"]["average"] == 2.0
    again = run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc", code=1)
    assert "never overwritten" in again.stderr


@pytest.mark.parametrize("many", [False, True])
def test_identify_states_an_interruption_of_unknown_duration(
    run: Run, record: xr.Dataset, tmp_path: Path, many: bool
) -> None:
    """The method overwrites the notes with its own."""
    join = {"index": 100, "seconds": None, "reason": "the wall clock was set back", "time": 50.25}
    raw = datasets.save(record.assign_attrs(joins=json.dumps([join])), tmp_path / "interrupted.nc")
    other = [datasets.save(record, tmp_path / "other.nc")] if many else []
    out, how = ("many", ["--scheduler", "sync"]) if many else ("errors.nc", [])
    run("identify", raw, *other, "--method", "spindle_drift", *how, "--out", out)
    errors = datasets.load(tmp_path / (f"{out}/interrupted.nc" if many else out))
    assert any("before sample 100, for an unknown time" in note for note in errors.em.notes)
    assert len(errors.em.notes) > 1


def test_identify_accepts_many_runs_and_reports_failures(run: Run, answer: Answer, raw: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.nc").write_bytes(raw.read_bytes()[:5000])
    command = ("identify", "raw.nc", "cut.nc", "--method", "spindle_drift", "--out", "results", "--scheduler", "sync")
    text = run(*command, code=1).stdout
    assert text.startswith("results: 1 identified, 0 existed already, 1 failed\n  failed: cut.nc: is truncated")
    found = answer(*command, code=1)
    assert found["ok"] is False
    assert found["scheduler"] == "sync"
    assert [entry["stepped_over"] for entry in found["runs"]] == [True, False]
    assert [entry["errors"] for entry in found["runs"]] == ["results/raw.nc", None]
    assert [entry["raw"] for entry in found["runs"]] == ["raw.nc", "cut.nc"]
    assert "truncated" in found["runs"][1]["reason"]
    alone = answer("identify", "raw.nc", "--method", "spindle_drift", "--out", "results", "--scheduler", "sync")
    assert alone["ok"] is True
    wrong = run("identify", "raw.nc", "cut.nc", "--method", "spindle_drift", "--out", "raw.nc", code=1)
    assert "raw.nc: expected a folder" in wrong.stderr


def test_an_internal_error_in_one_of_many_runs_names_the_log(
    run: Run, raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> None:
        raise KeyError("oops")

    monkeypatch.setattr(plugins.get("methods", "spindle_drift"), "identify", broken)
    result = run("identify", raw, "--method", "spindle_drift", "--out", "all", "--scheduler", "sync", code=70)
    log = tmp_path / "state" / "errormotion" / "errormotion.log"
    assert str(log) in result.stderr
    assert "KeyError: 'oops'" in result.stdout
    assert "Traceback" in log.read_text()


def test_settings_come_from_a_file_and_single_ones_over_it(run: Run, raw: Path, tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text('average = "4 s"\nnoise = "stated"\n')
    options = ("--settings", "settings.toml", "--set", "average='2 s'", "--set", "layout.rate=1.5 kHz")
    run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc", *options)
    settings = json.loads(datasets.load(tmp_path / "errors.nc").attrs["provenance"])["settings"]
    assert (settings["average"], settings["noise"], settings["layout"]["rate"]) == (2.0, "stated", 1500.0)


def test_all_wrong_settings_are_reported_at_once(run: Run, raw: Path, tmp_path: Path) -> None:
    options = ("--set", "average=2", "--set", "avrage=2 s", "--set", "bar_radius_uncertainty=1 s")
    text = run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc", *options, code=1).stderr
    assert "--set: 3 mistakes" in text
    assert "average: expected a time with its unit" in text
    assert "avrage: unknown key; did you mean 'average'?" in text
    assert "bar_radius_uncertainty: expected a length" in text
    assert not (tmp_path / "errors.nc").exists()
    wrong = run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc", "--set", "average", code=1)
    assert "expected key=value" in wrong.stderr


def test_an_error_is_one_message_with_the_traceback_in_the_log(run: Run, answer: Answer, tmp_path: Path) -> None:
    result = run("identify", "nothing.nc", "--method", "spindle_drift", "--out", "errors.nc", code=1)
    assert "nothing.nc: cannot be read: there is no such file" in result.stderr
    assert "Traceback" not in result.stderr
    assert "Traceback" in (tmp_path / "state" / "errormotion" / "errormotion.log").read_text()
    error = answer("identify", "nothing.nc", "--method", "spindle_drift", "--out", "errors.nc", code=1)["error"]
    assert error["code"] == "file.unreadable"
    assert error["type"] == "DatasetError"
    assert error["exit_code"] == 1


@pytest.mark.parametrize(
    ("words", "code", "status"),
    [
        (["identify", "--nonsense"], "option.unknown", 2),
        (["run"], "option.missing", 2),
        (["run", "none.toml"], "toml.unreadable", 1),
        (["bench", "validate", "none.toml"], "toml.unreadable", 3),
        (["validate", "none.nc"], "file.violations", 3),
        (["plugins", "show", "nothing"], "plugin.unknown", 1),
        (["history", "none", "--machine", "x", "--figure", "y", "--at", "1,2"], "option.form", 2),
        (["demo", "--controller", "none"], "option.choice", 2),
        (["compensate", "status", "none"], "compensation.folder.other", 1),
        (["note", "none", "text"], "run.folder.not_found", 1),
        (["plugins", "check", "r_test", "--only", "nothing"], "check.unknown", 1),
    ],
)
def test_a_failure_states_its_code_as_json(answer: Answer, words: list[str], code: str, status: int) -> None:
    found = answer(*words, code=status)
    assert (found["ok"], found["error"]["code"]) == (False, code)
    assert found["error"]["message"]


def test_an_internal_error_has_a_specific_exit_code_and_names_the_log(
    run: Run, raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> None:
        raise KeyError("oops")

    monkeypatch.setattr(plugins.get("methods", "spindle_drift"), "identify", broken)
    result = run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc", code=70)
    assert "KeyError: 'oops'" in result.stderr
    assert str(tmp_path / "state" / "errormotion" / "errormotion.log") in result.stderr
    assert "Traceback" not in result.stderr


def test_validate_reports_every_violation(run: Run, answer: Answer, raw: Path, tmp_path: Path) -> None:
    assert answer("validate", raw)["ok"] is True
    assert "raw.nc: valid" in run("validate", raw).stdout
    with datasets.load(raw) as good:
        bad = good.load().drop_vars(["bar_radius", "level"])
    datasets.save(bad, tmp_path / "bad.nc")
    found = answer("validate", "bad.nc", code=3)
    assert len(found["violations"]) == 2
    assert "bar_radius" in run("validate", "bad.nc", code=3).stdout
    (tmp_path / "cut.nc").write_bytes(raw.read_bytes()[:5000])
    assert "truncated" in answer("validate", "cut.nc", code=3)["violations"][0]


def test_report_of_a_file_of_errors(run: Run, answer: Answer, raw: Path, tmp_path: Path) -> None:
    run("identify", raw, "--method", "spindle_drift", "--out", "errors.nc")
    assert answer("report", "errors.nc")["report"] == "errors.html"
    assert "<html" in (tmp_path / "errors.html").read_text()
    assert "run folder" in run("report", tmp_path, code=1).stderr
    before = (tmp_path / "errors.nc").read_bytes()
    for name in ("page.pdf", "errors.nc", "page"):  # the PDF would replace the page, the page the result
        refused = run("report", "errors.nc", "--pdf", "--out", name, code=1).stderr
        assert f"{name}: expected a name that ends in .html" in refused
    assert (tmp_path / "errors.nc").read_bytes() == before
    assert not (tmp_path / "page.pdf").exists()


def test_import_reports_its_result(run: Run, answer: Answer, tmp_path: Path) -> None:
    names = ("X1", "X2", "Y1", "Y2", "Z")
    lines = ["t," + ",".join(names), *(f"{k / 2},1.1,1.2,1.3,1.4,1.{k}" for k in range(9))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    head = 'schema = "errormotion.map/1"\nmachine = "C-frame"\nbar_radius = "5 mm"\ndistance_noise = "0.3 um"\n'
    head += 'levels = ["10 mm", "50 mm"]\ntime = {column = "t", unit = "s"}\n'
    places = ["6 mm,0 mm,10 mm", "6 mm,0 mm,50 mm", "0 mm,6 mm,10 mm", "0 mm,6 mm,50 mm", "0 mm,0 mm,-1 mm"]
    directions = ["[-1,0,0]", "[-1,0,0]", "[0,-1,0]", "[0,-1,0]", "[0,0,1]"]
    for name, place, direction in zip(names, places, directions, strict=True):
        head += (
            f'[channels.{name}]\ncolumn = "{name}"\nunit = "mm"\norigin = {place.split(",")}\ndirection = {direction}\n'
        )
    (tmp_path / "map.toml").write_text(head)
    found = answer("import", "log.csv", "--map", "map.toml", "--out", "raw.nc")
    assert found["sizes"] == {"channel": 5, "time": 9, "direction": 3, "height": 2, "p": 6, "p_": 6}
    (tmp_path / "log.csv").write_text("t,X1\n")
    run("import", "log.csv", "--map", "map.toml", "--out", "other.nc", code=1)


def test_import_proposes_a_map(run: Run, answer: Answer, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("Zeit [s];T1 [C];T2 [C]\n0;20,1;21\n60;20,2;22\n120;20,3;23\n")
    shown = run("import", "log.csv", "--propose", "map.toml").stdout
    assert "temperature.T1" in shown
    found = answer("import", "log.csv", "--map", "map.toml", "--out", "raw.nc")
    assert found["sizes"] == {"time": 3, "sensor": 2, "source": 1}
    run("import", "log.csv", "--propose", "map.toml", code=1)
    run("import", "log.csv", "--map", "map.toml", code=2)
    assert answer("import", "log.csv", "--propose", "other.toml")["schema"] == "errormotion.raw.monitor/1"


def test_doctor_reports_valid_and_faulty_installations(
    run: Run, answer: Answer, monkeypatch: pytest.MonkeyPatch
) -> None:
    from errormotion.cli.commands import doctor as examination

    monkeypatch.setattr(examination, "MIN_FREE_DISK", 0)
    assert answer("doctor")["ok"] is True
    monkeypatch.setattr(examination, "MIN_FREE_DISK", 2**60)
    assert "BAD  disk here" in run("doctor", code=1).stdout


BENCH = ROOT / "examples" / "virtual_cframe" / "bench.toml"


def test_several_files_are_validated_and_reported_at_once(run: Run, answer: Answer, raw: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.nc").write_bytes(raw.read_bytes()[:400])
    found = answer("validate", raw, "cut.nc", code=3)["files"]
    assert [bool(each["violations"]) for each in found] == [False, True]
    text = run("validate", raw, "cut.nc", code=3).stdout
    assert "raw.nc: valid" in text
    assert "cut.nc: 1 violation" in text
    for name in ("a.nc", "b.nc"):
        run("identify", raw, "--out", name)
    pages = [each["report"] for each in answer("report", "a.nc", "b.nc")["reports"]]
    assert pages == ["a.html", "b.html"]
    assert "expected one run; found 2" in run("report", "a.nc", "b.nc", "--out", "c.html", code=2).stderr


def test_a_folder_without_a_run_names_the_runs_in_it(run: Run, tmp_path: Path) -> None:
    assert "expected a run folder with a run.json; found none" in run("report", ".", code=1).stderr
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "run.json").write_text("{}")
    assert "found the folders of runs first" in run("report", ".", code=1).stderr


def test_bench_validate_opens_nothing(run: Run, answer: Answer, tmp_path: Path) -> None:
    assert [i["kind"] for i in answer("bench", "validate", BENCH)["instruments"]] == [
        "spindle_frame",
        "controller",
        "thermometer",
    ]
    (tmp_path / "bench.toml").write_text(BENCH.read_text().replace('"5 mm"', "5").replace("rate", "raet"))
    text = run("bench", "validate", "bench.toml", code=3).stderr
    assert "bench.toml: 2 mistakes" in text
    assert "instruments.frame.bar_radius: expected a length with its unit" in text
    assert "instruments.frame.raet: unknown key; did you mean 'rate'?" in text
    assert answer("bench", "validate", "bench.toml", code=3)["ok"] is False


def test_bench_probe_reads_every_instrument(run: Run, answer: Answer, tmp_path: Path) -> None:
    found = answer("bench", "probe", BENCH)
    assert found["ok"] is True
    assert len(found["instruments"][0]["reading"]) == 5
    text = BENCH.read_text().replace("sim://cframe/thermometer?seed=3", "tcp://127.0.0.1:1")
    (tmp_path / "bench.toml").write_text(text)
    table = run("bench", "probe", "bench.toml", code=1).stdout.splitlines()
    assert "five_sensor_frame with ILD2300" in table[2]
    assert "FAILED: " in table[4]


def test_bench_probe_reads_a_profiler_that_waits_for_its_encoder(run: Run) -> None:
    profiler, control = run("bench", "probe", ROOT / "examples" / "virtual_gantry" / "bench.toml").stdout.splitlines()[
        2:
    ]
    assert profiler.endswith("800 values, 0 known")  # the axis stands between two artefacts
    assert control.count("alarms none") == 1


def test_without_a_state_folder_a_command_states_its_error_and_writes_no_log_elsewhere(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    found = run("identify", "nothing.nc", "--method", "spindle_drift", "--out", "errors.nc", code=1)
    assert "nothing.nc" in found.stderr
    assert not (tmp_path / "errormotion.log").exists()


def test_reference_names_every_command_and_option() -> None:
    import typer

    from errormotion.cli.app import app

    page = (ROOT / "docs" / "reference" / "cli.md").read_text()
    missing = []
    commands: list[tuple[str, Any]] = [("errormotion", typer.main.get_command(app))]
    for name, command in commands:
        below = getattr(command, "commands", {})
        commands += [(f"{name} {child}", each) for child, each in below.items()]
        if not below and name not in page:
            missing.append(name)
        options = [option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)]
        missing += [f"{name} {option}" for option in options if option.startswith("--") and f"`{option}" not in page]
    assert missing == []


def test_validate_counts_the_mistakes_of_a_campaign_and_of_its_bench(answer: Answer, tmp_path: Path) -> None:
    text = BENCH.read_text()
    (tmp_path / "bench.toml").write_text(text.replace("X-Y-bed", "X-X-bed").replace("rate =", "raet ="))
    (tmp_path / "campaign.toml").write_text(
        'schema = "errormotion.campaign/1"\nname = "one"\nbench = "bench.toml"\ncolour = 1\n'
        '[[test]]\nname = "drift"\nmethod = "spindle_drift"\n'
    )
    found = answer("validate", "campaign.toml", code=3)["violations"]
    assert [line.partition(":")[0] for line in found] == ["colour", "bench.toml", "bench.toml"]
    assert answer("validate", "bench.toml", code=3)["violations"][0].startswith("machine.chain: expected every axis")


def test_validate_does_not_take_another_file_for_a_bench(answer: Answer, tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text('schema = "errormotion.map/1"\n')
    [found] = answer("validate", "map.toml", code=3)["violations"]
    assert found.startswith("schema: expected that of a bench, a campaign or tolerances")
    assert "found 'errormotion.map/1'" in found


def test_every_command_has_h_o_and_terms_of_the_field(run: Run) -> None:
    import typer

    from errormotion.cli.app import app

    commands: list[Any] = [typer.main.get_command(app)]
    for command in commands:
        commands += getattr(command, "commands", {}).values()
        for parameter in command.params:
            assert ("--out" in parameter.opts) == ("-o" in parameter.opts), command.name
    text = run("compare", "-h").stdout
    assert re.search(r"^ +RESULT  Error datasets", text, re.MULTILINE)
    assert re.search(r"-o, --out FILE +Write the comparison", text)
    assert "<path>" not in text + run("plan", "-h").stdout + run("program", "-h").stdout
    assert "-o, --out FOLDER" in run("program", "-h").stdout


def test_settings_are_shown_with_their_units(run: Run) -> None:
    text = run("plugins", "show", "spindle_drift").stdout
    assert re.search(r"^average +0\.5 s +averaging time", text, re.MULTILINE)
    assert re.search(r"^reference_time +- \(a time\)", text, re.MULTILINE)


def test_doctor_states_how_to_install_missing_parts(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import PackageNotFoundError

    from errormotion.cli.commands import doctor

    def version(name: str) -> str:
        if name in ("asyncua", "zarr"):
            raise PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(doctor, "version", version)
    found = {finding.name: finding for finding in doctor.examine()}
    assert re.search(r"not installed: zarr>=\S+\. Install: \S+ -m pip install 'zarr>=", found["packages"].message)
    assert not found["packages"].ok
    assert found["optional: opcua"].ok
    assert found["optional: opcua"].absent
    assert not found["packages"].absent
    assert re.search(r"^- +optional: opcua +not installed", run("doctor", code=1).stdout, re.MULTILINE)
    assert found["optional: opcua"].message.endswith("-m pip install 'errormotion[opcua]'")
