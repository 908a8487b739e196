"""``errormotion open`` and ``errormotion export``."""

import csv
import io
import json
import webbrowser
import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr
from command_line import Result

from errormotion import datasets
from errormotion.datasets import provenance

Run = Callable[..., Result]
NS = {"m": "http://schemas.openxmlformats.org/spreadsheetml/2006/main"}


def errors(labels: tuple[str, ...] = ("T1", "T2"), machine: str = "M") -> xr.Dataset:
    n = len(labels)
    values = np.arange(6.0 * n).reshape(n, 6) * 1e-6
    values[0, 5] = np.nan
    return datasets.build_errors(
        values, np.tile(np.eye(6) * 1e-14, (n, 1, 1)), dims=("target",),
        coords={"target": list(labels), **{axis: ("target", 0.1 * np.arange(n)) for axis in "xyz"}},
        component="tool", machine=machine, frame="machine", functional_point=(0, 0, 0.05), reference="nominal",
        method="own", method_version="1", provenance=provenance.make({}, None, None),
    )  # fmt: skip


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    seen: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(seen.append(address) or True))
    return seen


def make_run(path: Path, created: str, page: bool = True) -> Path:
    path.mkdir(parents=True)
    state = {"schema": "errormotion.run/1", "id": path.name, "test": "drift", "created": created, "status": "finished"}
    (path / "run.json").write_text(json.dumps(state))
    if page:
        (path / "report.html").write_text("<p>")
    return path


def test_open_shows_the_newest_report_and_prints_its_path(run: Run, tmp_path: Path, opened: list[str]) -> None:
    make_run(tmp_path / "runs" / "a", "2026-01-01T08:00:00+00:00")
    newest = make_run(tmp_path / "runs" / "b", "2026-01-02T08:00:00+00:00") / "report.html"
    make_run(tmp_path / "runs" / "c", "2026-01-03T08:00:00+00:00", page=False)
    assert run("open").stdout.splitlines() == [str(newest.resolve())]
    assert opened == [newest.resolve().as_uri()]
    run("open", "runs/a", "--no-browser")
    assert len(opened) == 1
    assert "has no report.html. Write it with 'errormotion report runs/c'" in run("open", "runs/c", code=1).stderr


def test_open_reports_a_missing_browser_and_follows_no_link_out_of_the_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_run(tmp_path / "runs" / "a", "2026-01-01T08:00:00+00:00")
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    assert "No browser was found" in run("open", folder).stdout
    (tmp_path / "other.html").write_text("<p>")
    (folder / "report.html").unlink()
    (folder / "report.html").symlink_to(tmp_path / "other.html")
    assert "holds no run with a report.html" in run("open", "runs", code=1).stderr


def test_export_writes_a_table_in_field_units(run: Run, tmp_path: Path) -> None:
    datasets.save(errors(), tmp_path / "errors.nc")
    run("export", "errors.nc", "-o", "out.csv", "--freedoms", "EX,EC", "-k", "3", "--at", "0,0,150")
    head, *rows = csv.reader(io.StringIO((tmp_path / "out.csv").read_text()))
    assert head == ["target", "x / mm", "y / mm", "z / mm", "EX / um", "U(EX) / um", "EC / arcsec", "U(EC) / arcsec"]
    moved = errors().em.at((0, 0, 0.15))
    assert float(rows[1][4]) == pytest.approx(1e6 * float(moved["EX"][1]))
    assert float(rows[1][5]) == pytest.approx(3e6 * float(np.sqrt(moved["covariance"][1, 0, 0])))
    assert rows[0][6:] == ["", ""]  # unknown
    assert "is not replaced" in run("export", "errors.nc", "-o", "out.csv", code=1).stderr
    assert "ends in .csv, .xlsx, .nc, .zarr" in run("export", "errors.nc", "-o", "out.txt", code=1).stderr
    run("export", "errors.nc", "-o", "out.nc")
    xr.testing.assert_identical(datasets.load(tmp_path / "out.nc"), errors())


def test_a_dataset_without_errors_is_named_and_nothing_is_written(run: Run, tmp_path: Path) -> None:
    comparison = datasets.load(Path(__file__).parents[1] / "data" / "datasets" / "comparison.nc")
    datasets.save(comparison, tmp_path / "other.nc")
    for out in ("out.csv", "out.nc"):
        told = run("export", "other.nc", "-o", out, code=1)
        assert "other.nc: '.em" in told.stderr
        assert not (tmp_path / out).exists()


def test_foreign_texts_are_no_formulas(run: Run, tmp_path: Path) -> None:
    datasets.save(errors(("=1+1", "<b>&")), tmp_path / "errors.nc")
    run("export", "errors.nc", "-o", "out.csv")
    assert "\n'=1+1," in (tmp_path / "out.csv").read_text()
    run("export", "errors.nc", "-o", "out.xlsx")
    with zipfile.ZipFile(tmp_path / "out.xlsx") as archive:
        book = ElementTree.fromstring(archive.read("xl/workbook.xml"))
        assert [each.get("name") for each in book.iter(f"{{{NS['m']}}}sheet")] == [
            "1 errors",
            "2 figures of merit",
            "3 about",
        ]
        sheet = ElementTree.fromstring(archive.read("xl/worksheets/sheet1.xml"))
    texts = [each.text for each in sheet.iter(f"{{{NS['m']}}}t")]
    assert {"=1+1", "<b>&", "EX / um"} <= set(texts)
    assert not list(sheet.iter(f"{{{NS['m']}}}f"))


@pytest.mark.parametrize("software", ["3", "[1]", "null", '{"a": [[]]}'])
def test_software_of_another_type_in_a_foreign_file_is_no_internal_error(
    run: Run, tmp_path: Path, software: str
) -> None:
    found = errors()
    found.attrs["provenance"] = f'{{"software": {software}}}'
    datasets.save(found, tmp_path / "errors.nc")
    run("export", "errors.nc", "-o", "out.xlsx")
