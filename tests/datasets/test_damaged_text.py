"""Damaged text files: every mutant is read, or refused with an error of the project, in bounded time."""

import warnings
from collections.abc import Callable
from pathlib import Path

import mutants
import pytest

from errormotion.datasets.importing import import_log
from errormotion.datasets.storage import load
from errormotion.datasets.text.dates import Clock, zone_of
from errormotion.datasets.units import KINDS, convert
from errormotion.errors import DatasetError

LOG = """Tracker software 3.1
Length noise: 0,5
Setup;Point;X;Y;Z;Length;T;Day;Clock
S1;P1;0;0;0;1.000,5;20,1;27.10.2024;01:30:00
S1;P2;100;0;50;;20,1;27.10.2024;02:30:00
S2;P1;0;0;0;900,25;20,2;27.10.2024;02:30:00,5
S2;P2;100;0;50;880;20,2;27.10.2024;03:30:00
"""
MAP = """schema = "errormotion.raw.multilateration/1"
labels = {station = "Setup", target = "Point"}
values.displacement_noise = {key = "Length noise", unit = "um"}
values.vacuum_wavelength = "633 nm"
[format]
decimal = ","
thousands = "."
zone = "Europe/Berlin"
skip = 2
[columns]
displacement = {column = "Length", unit = "mm", scale = 1.0, offset = "2 mm"}
air_temperature = {column = "T", unit = "degC"}
reading_time = {column = ["Day", "Clock"], unit = "dd.mm.yyyy"}
target_nominal.x = {column = "X", unit = "mm"}
target_nominal.y = {column = 4, unit = "mm"}
target_nominal.z = {column = "Z", unit = "mm"}
"""
DRIFT = "t,X1,X2,Y1,Y2,Z,T\n" + "".join(f"2024-05-31T14:0{k}:00,1.{k},1.2,1.3,1.4,1.5,20.5\n" for k in range(6))
DRIFT_MAP = """schema = "errormotion.map/1"
bar_radius = "5 mm"
distance_noise = "0.3 um"
levels = ["10 mm", "50 mm"]
time = {column = "t", unit = "iso8601"}
temperatures.frame = {column = "T", unit = "degC"}
""" + "".join(
    f'[channels.{name}]\ncolumn = "{name}"\nunit = "mm"\norigin = ["0 mm", "0 mm", "10 mm"]\ndirection = [1, 0, 0]\n'
    for name in ("X1", "X2", "Y1", "Y2", "Z")
)
READINGS = """# schema = errormotion.raw.beam_direction/1
# nominal_direction = 0.342 0 0.940
# distance_noise = 0.1 um
# machine = "C-frame"
plane,distance [mm],stage_x [mm],stage_y [mm],stage_z [mm]
1,-2.004,100.000,50.000,20.000
1,-1.508,101.000,50.000,20.000
2,-1.1,100.5,50.1,20.1
2,,100.5,50.1,20.1

plane,nominal_normal_x [1],nominal_normal_y [1],nominal_normal_z [1]
1,0,0,1
2,0,1,0
"""


@pytest.fixture
def reader(tmp_path: Path) -> Callable[..., Callable[[bytes], object]]:
    """Return a function that makes readers: of the log, or of its map."""

    def reader(log: str, mapping: str, which: str) -> Callable[[bytes], object]:
        texts = {"log.csv": log.encode(), "map.toml": mapping.encode()}

        def read(data: bytes) -> object:
            for name, text in texts.items():
                (tmp_path / name).write_bytes(data if name == which else text)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                return import_log(tmp_path / "log.csv", tmp_path / "map.toml", tmp_path / "raw.nc", overwrite=True)

        return read

    return reader


@pytest.mark.parametrize("which", ["log.csv", "map.toml"])
@pytest.mark.parametrize(("log", "mapping"), [(LOG, MAP), (DRIFT, DRIFT_MAP)], ids=["any schema", "drift"])
def test_damaged_logs_and_maps(reader, log: str, mapping: str, which: str) -> None:
    data = (log if which == "log.csv" else mapping).encode()
    refused = mutants.check(reader(log, mapping, which), data, seed=1, number=mutants.count(250))
    assert refused > 100  # of changes to a file of this kind most are mistakes


def test_damaged_readings(tmp_path: Path) -> None:
    def read(data: bytes) -> object:
        (tmp_path / "readings.csv").write_bytes(data)
        return load(tmp_path / "readings.csv")

    assert mutants.check(read, READINGS.encode(), seed=2, number=mutants.count(500)) > 200


def test_damaged_units_and_quantities() -> None:
    def read(data: bytes) -> None:
        text = data.decode("utf-8", "replace")
        for target in ("m", "K", "1", "1/min"):
            try:
                convert(1.0, text, target)
            except DatasetError:
                continue
        for quantity in KINDS:
            message = ""
            try:
                quantity.parse(f"5 {text}")
            except ValueError as error:
                message = str(error)
            assert not message or f"expected {quantity.kind} with its unit" in message

    for seed, unit in enumerate(("mm", "W m-2 K-1", "um/degC", "1/min", "m.s-1", "degC", "kg·m²/s²")):
        mutants.check(read, unit.encode(), seed=seed, number=mutants.count(60), limit=2.0)


@pytest.mark.parametrize(
    ("unit", "text"), [("iso8601", "2024-05-31T14:05:09.25+02:00"), ("dd.mm.yyyy", "27.10.2024 02:30:09,5 PM")]
)
def test_damaged_dates(unit: str, text: str) -> None:
    def read(data: bytes) -> None:
        clock = Clock(unit, zone_of("Europe/Berlin"))
        for each in (text.replace("02:30", "01:30"), data.decode("utf-8", "replace")):
            message = each
            try:
                clock.seconds(each)
            except ValueError as error:
                message = str(error)
            assert each in message

    mutants.check(read, text.encode(), seed=3, number=mutants.count(1000), limit=1.0)
