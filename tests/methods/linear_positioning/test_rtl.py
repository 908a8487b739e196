"""Files .rtl: the layout on which published programs agree, and files with another layout."""

import random

import numpy as np
import pytest

from errormotion import datasets
from errormotion.datasets.importing import import_log
from errormotion.errors import DatasetError
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.rtl import read_rtl

MAP = 'schema = "errormotion.map.rtl/1"\naxis = "Y"\nlength_uncertainty = "0.4 um/m"\n'
TARGETS = [0.0, 10.5, 20.25, 30.0, 41.0, 50.0, 60.0]
HEAD = """HEADER::\r
File type  : rtl\r
Owner      : Linear\r
\r
TARGET DATA::\r
Filetype  : ISO\r
Target-count: 7\r
Targets :\r
0.000000  10.500000  20.250000  30.000000  41.000000 \r
50.000000  60.000000 \r
Flags: 0 0 2 0\r
\r
USER-TEXT::\r
Machine: M\u00fchle 7\r
TITLE:Y axis\r
\r
RUNS::\r
Run-count:{runs}\r
\r
DEVIATIONS::\r
Run Target Data:\r
"""
TAIL = "\r\nEQUIPMENT::\r\nSerial : 1234\r\n\r\nENVIRONMENT::\r\nAir temp   : 20.1\r\nEOF::\r\n"


def deviation(run, target):
    """Return a deviation that differs for each run and target, um."""
    return round(0.1 * target + 0.01 * run - (2.0 if run % 2 == 0 else 0.0), 4)


def text(runs=8):
    lines = []
    for run in range(1, runs + 1):
        order = range(1, 8) if run % 2 else range(7, 0, -1)
        lines += [f"   {run}    {target}    {deviation(run, target)}\r\n" for target in order]
    return HEAD.format(runs=runs) + "".join(lines) + TAIL


@pytest.fixture
def imported(tmp_path):
    def make(content, mapping=MAP):
        (tmp_path / "axis.rtl").write_bytes(content if isinstance(content, bytes) else content.encode("latin-1"))
        (tmp_path / "map.toml").write_text(mapping)
        return import_log(tmp_path / "axis.rtl", tmp_path / "map.toml", tmp_path / "raw.nc", overwrite=True)

    return make


def test_runs_become_approaches_with_their_positions_and_units(imported):
    raw = imported(text())
    assert dict(raw.sizes) == {"freedom": 1, "run": 4, "approach": 2, "target": 7}
    assert raw["freedom"].values.tolist() == ["EYY"]
    assert raw.attrs["machine"] == "M\u00fchle 7"
    np.testing.assert_allclose(raw["target_position"], np.array(TARGETS) * 1e-3)
    expected = [[[deviation(2 * run + 1 + a, t) for t in range(1, 8)] for a in range(2)] for run in range(4)]
    np.testing.assert_allclose(raw["deviation"].values[0], np.array(expected) * 1e-6, rtol=1e-12)
    errors = LinearPositioning().identify(raw, LinearPositioningSettings(axis="Y", trials=200))
    assert float(errors["B_mean"]) == pytest.approx(1.99e-6)  # 2 um less the step from run to run


def test_units_scale_and_freedom_are_those_of_the_map(imported):
    raw = imported(
        text().replace("Linear", "Angular"),
        MAP + 'deviation_unit = "arcsec"\nscale = -1\nfreedom = "EX"\n'.replace("EX", "EA"),
    )
    assert raw["freedom"].values.tolist() == ["EAY"]
    assert float(raw["deviation"][0, 0, 0, 0]) == pytest.approx(-deviation(1, 1) * np.pi / 648000)


@pytest.mark.parametrize(
    ("owner", "freedom", "said"),
    [
        ("Angular", "", "found Angular, but EYY in the map; set freedom to EA or EB or EC"),
        ("Straightness", "", "found Straightness, but EYY in the map; set freedom to EX or EZ"),
        ("Linear", "EA", "found Linear, but EAY in the map; set freedom to EY"),
        ("Rotary", "", "found Rotary, no error of a linear axis"),
        ("Squareness", "EX", "found Squareness, no error of a linear axis"),
    ],
)
def test_another_quantity_than_that_of_the_map_is_refused(imported, owner: str, freedom: str, said: str) -> None:
    with pytest.raises(DatasetError, match=said):
        imported(text().replace("Linear", owner), MAP + (f'freedom = "{freedom}"\n' if freedom else ""))


def test_a_test_of_one_direction_has_no_missing_readings(imported) -> None:
    head, _, rest = text().partition("Run Target Data:\r\n")
    lines = "".join(f"{run} {k} {deviation(2 * run - 1, k)}\r\n" for run in range(1, 6) for k in range(1, 8))
    raw = imported(
        head.replace("Run-count:8", "Run-count:5") + "Run Target Data:\r\n" + lines + rest[rest.index("\r\nEQUIP") :]
    )
    assert raw["approach"].values.tolist() == ["forward"]
    assert raw.attrs["missing_values"] == "{}"
    notes = " ".join(LinearPositioning().identify(raw, LinearPositioningSettings(axis="Y", trials=200)).em.notes)
    assert "missing" not in notes
    assert "approached forward only" in notes


def test_a_name_in_another_encoding_is_read(imported) -> None:
    assert (
        imported(text().replace("M\u00fchle 7", "\u78e8\u5e8a\u4e00\u53f7\u673a").encode("gb18030")).attrs["machine"]
        == "\u78e8\u5e8a\u4e00\u53f7\u673a"
    )


def test_targets_that_a_run_has_not_reached_are_unknown(imported):
    content = text().replace(f"   8    1    {deviation(8, 1)}\r\n", "")
    raw = imported(content)
    assert np.isnan(raw["deviation"].values).sum() == 1
    assert raw.attrs["missing_values"] == '{"deviation": 1}'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Target-count: 7", "Target-count: 8", "Target-count: expected the number of targets, 7"),
        ("Run-count:8", "Run-count:9", "Run-count: expected the number of runs with deviations, 8"),
        ("10.500000", "10,5", "expected positions in mm; found '10,5'"),
        ("10.500000", "0.000000", "different positions"),
        ("   1    1    0.11", "   1    9    0.11", "a target from 1 to 7; found 1 and 9"),
        ("   1    1    0.11", "   1    1    nan", "expected a deviation; found 'nan'"),
        ("   1    1    0.11", "   1    2    0.11", "run 1: expected each target once; found target 2 twice"),
        ("   1    1    0.11", "   1    1", "expected run, target and deviation"),
        ("Run Target Data:", "Other:", "found none"),
        ("TARGET DATA::", "TARGETS::", "found 0"),
    ],
)
def test_a_file_with_another_layout_is_refused_with_its_mistakes(imported, old, new, message):
    content = text()
    assert old in content
    with pytest.raises(DatasetError, match=message):
        imported(content.replace(old, new, 1))


def test_a_run_with_unordered_positions_is_refused(imported):
    a, b = f"   1    3    {deviation(1, 3)}\r\n", f"   1    4    {deviation(1, 4)}\r\n"
    with pytest.raises(DatasetError, match="run 1: expected positions that all increase or all decrease"):
        imported(text().replace(a + b, b + a))


def test_any_changed_bytes_are_read_or_refused(tmp_path):
    (tmp_path / "map.toml").write_text(MAP)
    generator, good = random.Random(7), text().encode("latin-1")
    for _ in range(150):
        data = bytearray(good)
        for _ in range(generator.randint(1, 5)):
            place = generator.randrange(len(data))
            data[place : place + generator.randint(0, 3)] = generator.randbytes(generator.randint(0, 4))
        (tmp_path / "axis.rtl").write_bytes(data)
        try:
            datasets.validate(read_rtl(tmp_path / "axis.rtl", tmp_path / "map.toml"))
        except DatasetError:
            continue


def test_a_large_file_is_not_read(tmp_path):
    (tmp_path / "map.toml").write_text(MAP)
    with open(tmp_path / "axis.rtl", "wb") as file:
        file.truncate(5 << 20)
    with pytest.raises(DatasetError, match="at most 4194304 bytes"):
        read_rtl(tmp_path / "axis.rtl", tmp_path / "map.toml")
