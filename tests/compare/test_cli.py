"""``errormotion compare``: files, run folders, folders of runs, names, and error messages."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.cli.app import app
from errormotion.compare import compare as compared
from errormotion.datasets import DOF

pytestmark = pytest.mark.usefixtures("translated")

FEW = ("--freedoms", "EX,EY,EZ")


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def call(*arguments, code=0):
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exit_code == code, result.output
        return result

    return call


@pytest.fixture(scope="module")
def brought(results, tmp_path_factory):
    """Return a folder with the files of `ALTERED`, without extras of the methods, and an empty folder."""
    folder = tmp_path_factory.mktemp("brought")
    (folder / "empty").mkdir()
    drift, probing = (results[name][[*DOF, "time_index", "covariance", "influence"]] for name in ("drift", "probing"))
    for name, alter in ALTERED.items():
        datasets.save(alter(drift, probing), folder / name)
    return folder


@pytest.fixture
def files(tmp_path, brought):
    for name in ("drift.nc", "probing.nc"):
        shutil.copy(brought / name, tmp_path)


def stored(folder: Path, ds, test, created=""):
    """Store a result in a run folder like a campaign."""
    made = RunFolder.create(folder.parent, "test", "1", {"test": test})
    made.path.rename(folder)
    run = RunFolder.open(folder)
    (folder / "errors" / "example-1").mkdir(parents=True)
    datasets.save(ds, folder / "errors" / "example-1" / "errors.nc")
    run.save(errors="errors/example-1/errors.nc", **({"created": created} if created else {}))


def without(ds, *names):
    """Return a result with unknown freedoms."""
    k = [["EX", "EY", "EZ", "EA", "EB", "EC"].index(name) for name in names]
    ds = ds.assign({name: ds[name] * np.nan for name in names}).copy(deep=True)
    ds["covariance"].values[:, k] = np.nan
    ds["covariance"].values[:, :, k] = np.nan
    ds["influence"].values[..., k] = np.nan
    return ds


def both_ways(ds):
    """Return the result of a foreign method, over an additional dimension and time."""
    twice = np.stack([ds.em.twist().values] * 2)
    return datasets.build_errors(
        twice, np.stack([ds["covariance"].values] * 2), dims=("way", "time"),
        coords={"way": ("way", ["up", "down"], {"long_name": "direction of travel"}), "time": ds["time"].values},
        method="foreign", method_version="1", provenance={}, start=ds.attrs["start"],
        **{name: ds.attrs[name] for name in ("component", "machine", "frame", "functional_point", "reference")},
    )  # fmt: skip


@pytest.mark.slow
def test_a_freedom_unknown_to_one_dataset_is_omitted(run, files, results):
    datasets.save(without(results["probing"], "EX", "EA", "EB"), "blind.nc")
    run("compare", "drift.nc", "blind.nc", "--out", "c.nc")
    assert datasets.load("c.nc")["dof"].values.tolist() == ["EY", "EZ"]


@pytest.mark.parametrize("rank", [0, 1])
def test_a_singular_covariance_is_compared_unless_it_is_zero(run, results, rank):
    """Values without any uncertainty are an error; freedoms may be fully correlated."""
    for name, ds in results.items():
        u = np.where(np.isfinite(ds.em.twist().values), 1e-6 * rank, np.nan)
        one = ds.drop_dims("source").assign(covariance=(ds["covariance"].dims, u[:, :, None] * u[:, None, :]))
        datasets.save(one, f"{name}.nc")
    shown = run("compare", "drift.nc", "probing.nc", *FEW, "--report", "c.html", code=1 - rank)
    assert "Traceback" not in shown.output
    assert ("its covariance is 0 everywhere" if rank == 0 else "datasets") in shown.output


def test_files_are_compared_and_the_result_is_written(run, files):
    shown = run("compare", "drift.nc", "probing.nc", *FEW, "--out", "c.nc", "--report", "c.html").stdout
    assert "agree within their uncertainties" in shown
    assert "drift - probing" in shown
    datasets.validate(datasets.load("c.nc"))
    assert "drift - probing" in Path("c.html").read_text()
    run("report", "c.nc", "--out", "again.html")
    assert "drift - probing" in Path("again.html").read_text()


def test_the_page_is_in_the_language_and_has_a_pdf(run, files, monkeypatch):
    from errormotion.report.exports import pdf

    monkeypatch.setattr(pdf, "write", lambda page, out: out.write_bytes(page.read_bytes()))
    form = ("--report", "c.html", "--pdf", "--paper", "Letter", "--language", "de")
    assert "written: c.pdf" in run("compare", "drift.nc", "probing.nc", *FEW, *form).stdout
    page = Path("c.html").read_text()
    assert "Vergleich von drift, probing" in page
    assert "stimmen im Rahmen ihrer Unsicherheiten überein" in page
    assert "size: letter" in page
    Path("d.pdf").write_text("mine")
    again = run("compare", "drift.nc", "probing.nc", *FEW, "--report", "d.html", "--pdf", code=1)
    assert "d.pdf: already exists" in again.stderr
    assert "--pdf: allowed with a page only" in run("compare", "drift.nc", "probing.nc", *FEW, "--pdf", code=1).stderr


def test_a_result_is_never_overwritten(run, files):
    for option, name in (("--out", "c.nc"), ("--report", "c.html")):
        Path(name).write_text("mine")
        assert "already exists" in run("compare", "drift.nc", "probing.nc", *FEW, option, name, code=1).stderr
        assert Path(name).read_text() == "mine"


def test_a_run_folder_is_named_after_its_test(run, results, tmp_path):
    stored(tmp_path / "r1", results["drift"], "five sensors")
    stored(tmp_path / "r2", results["probing"], "balls")
    said = json.loads(run("compare", "r1", "r2", *FEW, "--json").stdout)
    assert [pair["pair"] for pair in said["pairs"]] == ["five sensors - balls"]
    assert said["agree"] is True
    assert said["pairs"][0]["p"] > 0.05
    assert set(said["pairs"][0]["p_of_freedoms"]) == {"EX", "EY", "EZ"}


def test_a_folder_of_runs_stands_for_the_newest_of_each_test(run, results, tmp_path):
    wrong = results["drift"].assign(EX=results["drift"]["EX"] + 1e-4)
    stored(tmp_path / "runs" / "b", wrong, "drift", "2026-03-01T07:00:00+00:00")
    stored(tmp_path / "runs" / "a", results["drift"], "drift", "2026-03-02T07:00:00+00:00")
    stored(tmp_path / "runs" / "c", results["probing"], "probing", "2026-03-02T07:00:00+00:00")
    (tmp_path / "runs" / "damaged").mkdir()
    (tmp_path / "runs" / "damaged" / "run.json").write_text("{")
    assert "damaged/run.json: is not valid JSON" in run("compare", "runs", *FEW, "--out", "c.nc").stdout
    found = datasets.load("c.nc")
    assert found["dataset"].values.tolist() == ["drift", "probing"]
    assert np.nanmax(np.abs(found["value"].sel(dataset="drift", dof="EX").values)) < 5e-5


def test_names_and_the_functional_point_can_be_given(run, files):
    run("compare", "drift.nc", "--name", "balls=probing.nc", *FEW, "--at", "0,0,-20", "--out", "c.nc")
    found = datasets.load("c.nc")
    assert found["pair"].values.tolist() == ["drift - balls"]
    np.testing.assert_allclose(found.attrs["functional_point"], [0, 0, -0.02])


def silent(ds, attribute="start"):
    return ds.drop_attrs(deep=False).assign_attrs({name: ds.attrs[name] for name in ds.attrs if name != attribute})


ALTERED = {
    "drift.nc": lambda drift, _: drift,
    "probing.nc": lambda _, probing: probing,
    "unknown.nc": lambda _, probing: silent(probing),
    "later.nc": lambda _, probing: probing.assign_attrs(start="2027-03-02T07:00:00+00:00"),
    "other.nc": lambda _, probing: probing.assign_attrs(machine="another"),
    "elsewhere.nc": lambda _, probing: probing.assign_attrs(frame="table"),
    "frameless.nc": lambda _, probing: silent(probing, "frame"),
    "axis.nc": lambda _, probing: probing.assign_attrs(component="X"),
    "blind.nc": lambda _, probing: without(probing, "EX"),
    "turning.nc": lambda _, probing: without(probing, "EX", "EY", "EZ"),
    "moving.nc": lambda drift, _: without(drift, "EA", "EB", "EC"),
    "both-ways.nc": lambda _, probing: both_ways(probing),
    "raw.nc": lambda drift, _: xr.Dataset({"a": 1.0}),
    "c.nc": lambda drift, probing: compared({"a": drift, "b": probing}, freedoms=["EX"], causes=False),
    "moment.nc": lambda _, probing: probing.isel(time=-1, drop=True).drop_vars("time_index"),
}
"""What a stranger may bring."""


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("drift.nc",), 1, "at least two datasets"),
        (("drift.nc", "missing.nc"), 1, "no such file"),
        (("drift.nc", "drift.nc"), 1, "same dataset"),
        (("drift.nc", "probing.nc", "--at", "1,2"), 2, "three numbers in mm"),
        (("drift.nc", "--name", "probing.nc"), 1, "NAME=PATH"),
        (("drift.nc", "probing.nc", "--freedoms", "EC"), 1, "does not state EC"),
        (("drift.nc", "unknown.nc"), 1, "no attribute 'start'"),
        (("drift.nc", "later.nc"), 1, "do not overlap"),
        (("drift.nc", "other.nc"), 1, "machine"),
        (("drift.nc", "empty"), 1, "expected a run folder"),
        (("drift.nc", "elsewhere.nc"), 1, "different attributes 'frame' ('drift': machine; 'elsewhere': table)"),
        (("drift.nc", "frameless.nc"), 1, "attribute 'frame': missing; expected coordinate system"),
        (("drift.nc", "axis.nc"), 1, "different attributes 'component'"),
        (("drift.nc", "blind.nc", "--freedoms", "EX"), 1, "'blind' does not state EX; it states EY"),
        (("turning.nc", "moving.nc"), 1, "have no freedom in common: 'turning': EA, EB; 'moving': EX, EY, EZ"),
        (("drift.nc", "both-ways.nc"), 1, "'both-ways': its errors depend on way, time; select one value"),
        (("drift.nc", "raw.nc"), 1, "raw.nc: The dataset breaks its schema"),
        (("drift.nc", "c.nc"), 1, "'c': '.em.names' belongs to error datasets"),
        (("drift.nc", "probing.nc", "--since", "1e9"), 1, "since: expected a time from"),
        (("drift.nc", "moment.nc"), 1, "depend on different dimensions ('drift': time; 'moment': none)"),
    ],
)
def test_errors_state_the_expected_input(run, brought, monkeypatch, arguments, code, message):
    monkeypatch.chdir(brought)
    result = run("compare", *arguments, code=code)
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_a_failure_is_json_too(run, files):
    said = json.loads(run("compare", "drift.nc", "--json", code=1).stdout)
    assert said["ok"] is False
    assert said["error"]["exit_code"] == 1


def test_results_over_two_dimensions_are_compared_over_one(tmp_path, run):
    first = datasets.load(Path(__file__).parents[1] / "data" / "datasets" / "crossbeam_scan_scan.nc").load()
    other = first.copy(deep=True)
    other["EX"].values[...] += 1e-8
    other["EX"].values[0] = first["EX"].values[0]
    for name, ds in (("a", first), ("b", other)):
        datasets.save(ds, tmp_path / f"{name}.nc")
    assert "select one value" in run("compare", "a.nc", "b.nc", code=1).output
    assert "--select position=0 (0 to 2)" in run("compare", "a.nc", "b.nc", "--over", "time", code=1).output
    found = json.loads(
        run("compare", "a.nc", "b.nc", "--over", "time", "--select", "position=2", "--same-start", "--json").output
    )
    assert found["ok"]
    text = "'a' has the elements position=0 to position=2"
    assert text in run("compare", "a.nc", "b.nc", "--select", "position=3", code=1).output
    assert "--select 3" in run("compare", "a.nc", "b.nc", "--select", "3", code=1).output
    words = run("compare", "a.nc", "b.nc", "--over", "target", "--select", "position=0", "--same-start", code=1).output
    assert "compared over time" in words
