"""Maps ``errormotion.map/2``: short forms, units and dates of the file, several files, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion.datasets.importing import import_files
from errormotion.errors import DatasetError

DRIFT = """schema = "errormotion.map/2"
raw = "errormotion.raw.spindle_drift/1"
[columns]
time = "t"
distance = ["a", "b", "c", "d", "e"]
[values]
bar_radius = "5 mm"
distance_noise = "0.3 um"
level = "10 50 mm"
beam_origin = ["6 0 10 mm", "6 0 50 mm", "0 6 10 mm", "0 6 50 mm", "0 0 -1 mm"]
beam_direction = [[-1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]]
"""
LOG = """t [s],a [um],b [um],c [um],d [um],e [um]
0,1000,998,1001,999,1000
30,1001,999,1002,1000,1002
60,1002,1000,1003,1001,1004
"""
POSITIONING = 'schema = "errormotion.map/2"\nraw = "errormotion.raw.linear_positioning/1"\nattributes = {axis = "X"}\n'
MONITOR = 'schema = "errormotion.map/2"\nraw = "errormotion.raw.monitor/1"\n'
PLACES = "[columns]\nposition = ['a', 'b', 'c']\ntime = 't'\n"
TRACKER = (
    'schema = "errormotion.map/2"\nraw = "errormotion.raw.multilateration/1"\nvalues.displacement_noise = "1 um"\n'
)


def with_(text: str) -> str:
    """Return the map of a drift with further keys before its columns."""
    return DRIFT.replace("[columns]", text + "[columns]")


@pytest.fixture
def imported(tmp_path: Path):
    def run(text: str, **files: str | bytes):
        (tmp_path / "map.toml").write_text(text, encoding="utf-8")
        paths = []
        for name, content in files.items():
            path = tmp_path / f"{name}.csv"
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
            paths.append(path)
        return import_files(paths, tmp_path / "map.toml")

    return run


def test_the_file_states_units_and_the_map_the_rest(imported) -> None:
    raw = imported(DRIFT, log=LOG)
    np.testing.assert_allclose(raw["distance"].sel(channel="X1"), [1e-3, 1.001e-3, 1.002e-3])
    np.testing.assert_allclose(raw["distance"].sel(channel="Z"), [1e-3, 1.002e-3, 1.004e-3])
    np.testing.assert_allclose(raw["time"], [0, 30, 60])
    np.testing.assert_allclose(raw["beam_origin"].sel(channel="Y2"), [0, 6e-3, 50e-3])


def test_beams_without_an_uncertainty_have_the_assumed_one(imported) -> None:
    """As a map of the former schema: 0.1 mm and 5 mrad, which is noted; stated ones are taken."""
    raw = imported(DRIFT, log=LOG)
    C = raw["beam_covariance"].sel(channel="X1").values
    np.testing.assert_allclose(np.sqrt(np.diag(C)), [1e-4, 1e-4, 1e-4, 0, 5e-3, 5e-3])
    assert raw.attrs["beam_uncertainty"] == "assumed"
    stated = DRIFT + "beam_origin_uncertainty = '1 1 1 1 2 um'\nbeam_direction_uncertainty = '1 1 1 1 1 mrad'\n"
    raw = imported(stated, log=LOG)
    np.testing.assert_allclose(np.sqrt(np.diag(raw["beam_covariance"].sel(channel="Z"))), [2e-6] * 3 + [1e-3, 1e-3, 0])
    assert "beam_uncertainty" not in raw.attrs
    assert "beam_origin_uncertainty" not in raw


@pytest.mark.parametrize("stated", ["", 'units.deviation = "um"\n'])
def test_the_unit_is_that_of_the_map_or_else_of_the_file(imported, stated: str) -> None:
    text = POSITIONING + 'sequence = "P"\n' + stated + '[columns]\ntarget_position = "P"\ndeviation = {EXX = "D"}\n'
    title = "D" if stated else "D [µm]"
    log = f"P [mm];{title}\n0;0,5\n100;1,5\n200;2,5\n200;2\n100;1\n0;0\n"
    raw = imported(text, log=log)
    found = raw["deviation"].sel(freedom="EXX", approach="backward").squeeze()
    np.testing.assert_allclose(found, [0, 1e-6, 2e-6])


def test_a_deviation_is_the_difference_of_two_columns(imported) -> None:
    text = POSITIONING + 'sequence = "Soll"\n[columns]\ntarget_position = "Soll"\n'
    text += 'deviation.EXX = {column = "Ist", minus = "Soll"}\n'
    raw = imported(text, log="Soll [mm];Ist [mm]\n0;0,0005\n100;100,0015\n200;200,0025\n")
    np.testing.assert_allclose(raw["deviation"].squeeze(), [0.5e-6, 1.5e-6, 2.5e-6], rtol=1e-6)


def test_columns_of_different_units_are_not_subtracted(imported) -> None:
    text = POSITIONING + 'sequence = "Soll"\n[columns]\ntarget_position = "Soll"\n'
    text += 'deviation.EXX = {column = "Ist", minus = "Soll"}\n'
    with pytest.raises(DatasetError, match=r"columns.deviation.EXX.minus: expected a column in um; found mm"):
        imported(text, log="Soll [mm];Ist [um]\n0;0,5\n100;100001,5\n200;200002,5\n")


def test_a_matrix_has_one_line(imported) -> None:
    text = POSITIONING + 'labels = {target = "Target"}\n[columns]\ntarget_position = "Target"\n'
    text += 'deviation.EXX = {columns = ["1+", "1-"], unit = "um", labels = {run = [1, 1], '
    text += 'approach = ["forward", "backward"]}}\n'
    raw = imported(text, log="Target [mm];1+;1-\n0;1;4\n100;2;5\n200;3;6\n")
    found = raw["deviation"].squeeze().transpose("approach", "target")
    np.testing.assert_allclose(found, [[1e-6, 2e-6, 3e-6], [4e-6, 5e-6, 6e-6]])


def test_columns_are_those_of_any_dimension(imported) -> None:
    """A column for each station, though the last dimension of the readings is the target."""
    text = TRACKER.replace("values.", 'labels = {target = "P"}\nvalues.')
    text += '[columns]\ntarget_nominal = ["X", "Y", "Z"]\ndisplacement = {station = {A = "L1", B = "L2"}}\n'
    log = "P,X [mm],Y [mm],Z [mm],L1 [mm],L2 [mm]\n" + "".join(f"{k},{k},0,0,{100 + k},{200 + k}\n" for k in range(5))
    raw = imported(text, log=log)
    np.testing.assert_allclose(raw["displacement"].sel(station="B"), 0.2 + 1e-3 * np.arange(5))


def test_a_log_of_temperatures_needs_no_other_column(imported) -> None:
    text = MONITOR + '[columns]\ntime = ["Datum", "Zeit"]\ntemperature = ["T1", "T2"]\n'
    log = (
        "Datum;Zeit;T1 [°C];T2 [°C]\n27.10.2024;01:00:00;20,1;21,0\n27.10.2024;01:30:00;;\n27.10.2024;02:00:00;20,2;\n"
    )
    raw = imported(text, log=log.encode("cp1252"))
    assert raw.attrs["start"] == "2024-10-27T01:00:00"
    np.testing.assert_allclose(raw["temperature"].sel(sensor="T1"), [20.1, np.nan, 20.2])
    np.testing.assert_array_equal(raw["gap"].squeeze(), [0, 1, 0])


def test_temperatures_of_another_file_are_interpolated_to_the_readings(imported) -> None:
    text = with_('file = "log*"\n')
    text += '[[tables]]\nfile = "warm*"\n[tables.columns]\ntime = "t"\ntemperature = {frame = "T"}\n'
    raw = imported(text, warm="t [s],T [degC]\n20,20\n40,22\n", log=LOG)
    np.testing.assert_allclose(raw["temperature"].squeeze(), [np.nan, 21.0, np.nan])
    (note, _) = json.loads(raw.attrs["import_notes"])
    assert note == (
        "temperature of warm.csv interpolated to the times of the readings; 2 of them are beyond its times, where the "
        "values are unknown"
    )


def test_dates_in_one_file_only_are_refused(imported) -> None:
    text = DRIFT + '[[tables]]\n[tables.columns]\ntime = "t"\ntemperature = {frame = "T"}\n'
    with raises("map.times"):
        imported(text, log=LOG, warm="t,T [degC]\n2026-05-04 10:00:00,20\n2026-05-04 10:01:00,22\n")


WRONG = [
    ("an unknown key", DRIFT + "[colums]\n", LOG, "colums: unknown key; did you mean 'columns'"),
    ("an unknown variable", DRIFT.replace("distance =", "distanc ="), LOG, "columns.distanc.*: unknown variable"),
    ("a unit of no column", with_("[units]\nlength = 'mm'\n"), LOG, "'length' has no column"),
    ("too few columns", DRIFT.replace('"d", "e"', '"d"'), LOG, r"expected 5 columns \(X1 X2 Y1 Y2 Z\); found 4"),
    ("another order", DRIFT.replace('"a", "b"', '"X2", "X1"'), LOG, "in the order X1 X2 Y1 Y2 Z; found 'X2' for X1"),
    ("a unit of two meanings", MONITOR + PLACES, LOG.replace("a [um]", "a [grad]"), "found 'grad'"),
    ("no unit", DRIFT, LOG.replace("a [um]", "a"), "units.distance.X1: log.csv states no unit for column 'a'"),
    ("another unit", DRIFT, LOG.replace("a [um]", "a [V]"), "expected a unit of the kind of m; found 'V'"),
    ("no such column", DRIFT, LOG.replace("a [um]", "f [um]"), "columns.distance.X1: no column 'a'"),
    ("an open order of dates", DRIFT, LOG.replace("t [s]", "t").replace("\n0,", "\n03/04/2026 10:00:00,").replace(
        "\n30,", "\n03/04/2026 10:01:00,").replace("\n60,", "\n03/04/2026 10:02:00,"),
     "units.time: the order of dates such as '03/04/2026 10:00:00'.*'mm/dd/yyyy' or 'dd/mm/yyyy'"),
    ("another schema", DRIFT.replace("spindle_drift/1", "spindel_drift/1"), LOG, "raw: expected a raw schema"),
    ("another variant", with_('variant = "drft"\n'), LOG, "variant: did you mean 'drift'"),
    ("no file of a pattern", with_('file = "warm*"\n'), LOG, "expected one file with a name like"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "log", "message"), [case[1:] for case in WRONG], ids=[case[0] for case in WRONG])
def test_mistakes_name_the_key(imported, text: str, log: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        imported(text, log=log)


def test_a_map_of_one_file_does_not_take_two(imported) -> None:
    with raises("map.files"):
        imported(DRIFT, log=LOG, other=LOG)
