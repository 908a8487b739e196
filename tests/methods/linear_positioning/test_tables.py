"""Readings in text files: a column of deviations has a unit of length or of angle."""

import numpy as np
import pytest

from errormotion import datasets
from errormotion.datasets.importing import import_log
from errormotion.errors import DatasetError

HEAD = "# schema = errormotion.raw.linear_positioning/1\nfreedom,run,approach,target,deviation [{unit}]\n"
TARGETS = "\ntarget,target_position [mm]\n1,0\n2,100\n3,200\n"


def table(tmp_path, unit, freedom="EXX"):
    lines = [
        f"{freedom},{run},{way},{i},{run + i}"
        for run in range(4)
        for way in ("forward", "backward")
        for i in range(1, 4)
    ]
    path = tmp_path / "readings.csv"
    path.write_text(HEAD.format(unit=unit) + "\n".join(lines) + "\n" + TARGETS)
    return path


@pytest.mark.parametrize(
    ("unit", "freedom", "size"), [("um", "EXX", 1e-6), ("arcsec", "EBX", np.pi / 648000), ("mm", "EXX", 1e-3)]
)
def test_deviations_are_read_in_their_unit(tmp_path, unit, freedom, size):
    raw = datasets.load(table(tmp_path, unit, freedom))
    found = raw["deviation"].sel(freedom=freedom, approach="backward").transpose("run", "target").values
    np.testing.assert_allclose(found, size * (np.arange(4)[:, None] + np.arange(1, 4)), rtol=1e-12)


def test_another_unit_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="expected a unit of the kind of m; found 'kg'"):
        datasets.load(table(tmp_path, "kg"))


@pytest.mark.parametrize(("unit", "freedom", "kind"), [("arcsec", "EXX", "m"), ("um", "EBX", "rad")])
def test_a_unit_of_the_other_kind_is_refused_with_the_freedom(tmp_path, unit: str, freedom: str, kind: str) -> None:
    with pytest.raises(DatasetError, match=rf"{freedom}: expected a unit of the kind of {kind}; found '{unit}'"):
        datasets.load(table(tmp_path, unit, freedom))


def test_slopes_of_levels_are_angles(tmp_path) -> None:
    raw = datasets.load(table(tmp_path, "um/m", "EBX"))
    assert float(raw["deviation"].sel(freedom="EBX").max()) == pytest.approx(6e-6)


def test_lengths_and_angles_in_one_column_are_refused(tmp_path) -> None:
    path = table(tmp_path, "um")
    path.write_text(path.read_text().replace("EXX,3,backward", "EBX,3,backward"))
    with pytest.raises(
        DatasetError, match=r"expected lengths and angles in columns .*; found EXX in line 3, EBX in line 24"
    ):
        datasets.load(path)


@pytest.mark.parametrize(("freedom", "unit"), [("EXX", "arcsec"), ("EBX", "um")])
def test_a_map_with_a_unit_of_the_other_kind_is_refused(tmp_path, freedom: str, unit: str) -> None:
    log = tmp_path / "log.csv"
    log.write_text("Run,Way,P,Target,Error\n1,forward,1,0,1.5\n1,forward,2,100,-1\n")
    (tmp_path / "map.toml").write_text(
        'schema = "errormotion.raw.linear_positioning/1"\n'
        'labels = {run = "Run", approach = "Way", target = "P"}\n'
        f'[columns]\ndeviation.{freedom} = {{column = "Error", unit = "{unit}"}}\n'
        'target_position = {column = "Target", unit = "mm"}\n'
    )
    with pytest.raises(DatasetError, match=rf"columns.deviation.{freedom}.unit: {freedom}: expected a unit"):
        import_log(log, tmp_path / "map.toml", tmp_path / "raw.nc")


def test_each_freedom_of_a_log_has_its_own_unit(tmp_path):
    log, out = tmp_path / "log.csv", tmp_path / "raw.nc"
    log.write_text("Run,Way,P,Target,Error,Pitch\n1,forward,1,0,1.5,2\n1,forward,2,100,-1,0\n1,forward,3,200,0,-2\n")
    (tmp_path / "map.toml").write_text(
        'schema = "errormotion.raw.linear_positioning/1"\n'
        'labels = {run = "Run", approach = "Way", target = "P"}\n'
        "[columns]\n"
        'deviation.EXX = {column = "Error", unit = "um"}\n'
        'deviation.EBX = {column = "Pitch", unit = "arcsec"}\n'
        'target_position = {column = "Target", unit = "mm"}\n'
    )
    raw = import_log(log, tmp_path / "map.toml", out)
    assert raw["deviation"].sel(freedom="EXX").values.ravel() == pytest.approx([1.5e-6, -1e-6, 0.0])
    assert raw["deviation"].sel(freedom="EBX").values.ravel()[0] == pytest.approx(2 * np.pi / 648000)
